// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/common/thread_pool.h"

#include <string>

#include "semantic_lidar_fusion/common/error.h"

namespace semantic_lidar_fusion {

ThreadPool::ThreadPool(int threads) {
  if (threads < 1 || threads > kMaxThreads) {
    throw ConfigError(
        {"threads: " + std::to_string(threads) + " must be in 1.." + std::to_string(kMaxThreads)});
  }
  workers_.reserve(static_cast<std::size_t>(threads) - 1);
  for (int i = 1; i < threads; ++i) workers_.emplace_back([this] { run(); });
}

ThreadPool::~ThreadPool() {
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    stop_ = true;
  }
  job_given_.notify_all();
  for (std::thread& worker : workers_) worker.join();
}

void ThreadPool::forEach(int count, const std::function<void(int)>& work) {
  std::unique_lock<std::mutex> lock(mutex_);
  if (workers_.empty() || count < 2 || work_ != nullptr) {
    lock.unlock();
    for (int item = 0; item < count; ++item) work(item);
    return;
  }
  work_ = &work;
  next_ = 0;
  count_ = unfinished_ = count;
  failure_ = nullptr;
  job_given_.notify_all();
  takeItems(&lock);
  job_ended_.wait(lock, [this] { return unfinished_ == 0; });
  work_ = nullptr;
  const std::exception_ptr failure = failure_;
  failure_ = nullptr;
  lock.unlock();
  if (failure) std::rethrow_exception(failure);
}

void ThreadPool::run() {
  std::unique_lock<std::mutex> lock(mutex_);
  for (;;) {
    job_given_.wait(lock, [this] { return stop_ || (work_ != nullptr && next_ < count_); });
    if (stop_) return;
    takeItems(&lock);
  }
}

void ThreadPool::takeItems(std::unique_lock<std::mutex>* lock) {
  while (work_ != nullptr && next_ < count_) {
    const int item = next_++;
    const std::function<void(int)>* const work = work_;
    lock->unlock();
    std::exception_ptr failure;
    try {
      (*work)(item);
    } catch (...) {
      failure = std::current_exception();
    }
    lock->lock();
    if (failure && (!failure_ || item < failed_item_)) {
      failure_ = failure;
      failed_item_ = item;
    }
    if (--unfinished_ == 0) job_ended_.notify_all();
  }
}

void forEach(ThreadPool* pool, int count, const std::function<void(int)>& work) {
  if (pool != nullptr) {
    pool->forEach(count, work);
    return;
  }
  for (int item = 0; item < count; ++item) work(item);
}

}  // namespace semantic_lidar_fusion
