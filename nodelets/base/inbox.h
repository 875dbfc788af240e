// SPDX-License-Identifier: MIT
#pragma once

#include <ros/callback_queue_interface.h>

#include <boost/enable_shared_from_this.hpp>
#include <boost/make_shared.hpp>
#include <boost/weak_ptr.hpp>
#include <cstddef>
#include <deque>
#include <functional>
#include <mutex>
#include <utility>

namespace semantic_lidar_fusion {

/// The messages of one subscription that wait for a callback queue's turn, oldest first.
///
/// roscpp's own queue of a subscription drops its oldest message without a word when it is full.
/// This one says so: a subscription whose callback does nothing but `add` is never behind, and what
/// a slow consumer has no time for is dropped here, where it is counted. Messages are handed over
/// in order and one at a time, also on a queue that several threads serve. Thread-safe; lives as
/// long as the subscription's callback holds it, and what still waits then is lost.
template <class Message>
class Inbox : public boost::enable_shared_from_this<Inbox<Message>> {
 public:
  using Handle = std::function<void(const Message&)>;
  /// `handle` runs on `queue`, which must outlive every call of `add`. `overflowed` runs within
  /// `add`, once for each message that is dropped; `lost` at the end, with the number of messages
  /// that still wait, if there are any.
  Inbox(ros::CallbackQueueInterface* queue, std::size_t capacity, Handle handle,
        std::function<void()> overflowed, std::function<void(std::size_t)> lost)
      : queue_(queue),
        capacity_(capacity),
        handle_(std::move(handle)),
        overflowed_(std::move(overflowed)),
        lost_(std::move(lost)) {}
  ~Inbox() {
    if (!waiting_.empty()) lost_(waiting_.size());
  }
  Inbox(const Inbox&) = delete;
  Inbox& operator=(const Inbox&) = delete;

  void add(const Message& message) {
    bool full = false;
    {
      std::lock_guard<std::mutex> lock(mutex_);
      full = waiting_.size() >= capacity_;
      if (full) waiting_.pop_front();
      waiting_.push_back(message);
    }
    if (full) {
      overflowed_();  // the turn of the message that is gone is still to come
    } else {
      queue_->addCallback(boost::make_shared<Turn>(this->weak_from_this()));
    }
  }

 private:
  /// One message's place in the callback queue.
  class Turn : public ros::CallbackInterface {
   public:
    explicit Turn(boost::weak_ptr<Inbox> inbox) : inbox_(std::move(inbox)) {}
    CallResult call() override {
      const boost::shared_ptr<Inbox> inbox = inbox_.lock();
      return inbox ? inbox->handleNext() : Invalid;
    }

   private:
    boost::weak_ptr<Inbox> inbox_;
  };

  ros::CallbackInterface::CallResult handleNext() {
    std::unique_lock<std::mutex> one_at_a_time(handling_, std::try_to_lock);
    if (!one_at_a_time) return ros::CallbackInterface::TryAgain;
    Message message;
    {
      std::lock_guard<std::mutex> lock(mutex_);
      if (waiting_.empty()) return ros::CallbackInterface::Success;
      message = std::move(waiting_.front());
      waiting_.pop_front();
    }
    handle_(message);
    return ros::CallbackInterface::Success;
  }

  ros::CallbackQueueInterface* const queue_;
  const std::size_t capacity_;
  const Handle handle_;
  const std::function<void()> overflowed_;
  const std::function<void(std::size_t)> lost_;
  std::mutex handling_;  ///< held while a message is handled
  std::mutex mutex_;     ///< guards what follows
  std::deque<Message> waiting_;
};

}  // namespace semantic_lidar_fusion
