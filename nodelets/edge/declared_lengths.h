// SPDX-License-Identifier: MIT
/// Serialised messages declare how many elements and bytes follow. The libraries allocate what is
/// declared before they find that it does not follow: a message of 100 bytes can take gigabytes.
/// Here the declared lengths are compared with the bytes that are there, before anything is
/// allocated.
#pragma once

#include <ros/ros.h>

#include <boost/make_shared.hpp>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <string>
#include <utility>

namespace semantic_lidar_fusion {

/// Throws DataError where a serialised message of type `datatype` declares more than its `size`
/// bytes can hold. Types that hold no lists pass.
void checkDeclaredLengths(const std::string& datatype, const std::uint8_t* data, std::size_t size);

/// A message of a bag that is only checked: `message.instantiate<DeclaredLengths<M>>()`.
template <class M>
struct DeclaredLengths {};

/// What roscpp calls with a message's bytes. A message that is damaged is told to `damaged` with
/// the reason, and goes no further.
template <class M>
class CheckedDeserializer
    : public ros::SubscriptionCallbackHelperT<const boost::shared_ptr<M const>&> {
  using Base = ros::SubscriptionCallbackHelperT<const boost::shared_ptr<M const>&>;

 public:
  CheckedDeserializer(const boost::function<void(const boost::shared_ptr<M const>&)>& callback,
                      std::function<void(const std::string&)> damaged)
      : Base(callback), damaged_(std::move(damaged)) {}

  ros::VoidConstPtr deserialize(
      const ros::SubscriptionCallbackHelperDeserializeParams& params) override {
    try {
      checkDeclaredLengths(ros::message_traits::datatype<M>(), params.buffer, params.length);
      return Base::deserialize(params);
    } catch (const std::exception& problem) {
      damaged_("a message of " + std::to_string(params.length) + " bytes " + problem.what());
      return {};
    }
  }

 private:
  std::function<void(const std::string&)> damaged_;
};

/// As NodeHandle::subscribe without Nagle's delay; see CheckedDeserializer.
template <class M>
ros::Subscriber subscribeChecked(
    ros::NodeHandle& handle, const std::string& topic, std::uint32_t queue_size,
    const boost::function<void(const boost::shared_ptr<M const>&)>& callback,
    const std::function<void(const std::string&)>& damaged) {
  ros::SubscribeOptions options;
  options.template init<M>(topic, queue_size, callback);
  options.helper = boost::make_shared<CheckedDeserializer<M>>(callback, damaged);
  options.transport_hints = ros::TransportHints().tcpNoDelay();
  return handle.subscribe(options);
}

}  // namespace semantic_lidar_fusion

namespace ros {
namespace message_traits {
template <class M>
struct IsMessage<semantic_lidar_fusion::DeclaredLengths<M>> : TrueType {};
template <class M>
struct MD5Sum<semantic_lidar_fusion::DeclaredLengths<M>> : MD5Sum<M> {
  static const char* value() { return MD5Sum<M>::value(); }
  static const char* value(const semantic_lidar_fusion::DeclaredLengths<M>&) { return value(); }
};
template <class M>
struct DataType<semantic_lidar_fusion::DeclaredLengths<M>> {
  static const char* value() { return DataType<M>::value(); }
  static const char* value(const semantic_lidar_fusion::DeclaredLengths<M>&) { return value(); }
};
}  // namespace message_traits
namespace serialization {
template <class M>
struct Serializer<semantic_lidar_fusion::DeclaredLengths<M>> {
  template <typename Stream>
  inline static void read(Stream& stream, semantic_lidar_fusion::DeclaredLengths<M>&) {
    semantic_lidar_fusion::checkDeclaredLengths(message_traits::DataType<M>::value(),
                                                stream.getData(), stream.getLength());
  }
};
}  // namespace serialization
}  // namespace ros
