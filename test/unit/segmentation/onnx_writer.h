// SPDX-License-Identifier: MIT
/// Writes small ONNX networks as protobuf bytes, so that tests need neither a file nor a library:
/// a 3-channel image through one 1x1 convolution.
#pragma once

#include <cstdint>
#include <cstring>
#include <fstream>
#include <string>
#include <vector>

namespace semantic_lidar_fusion {

/// A protobuf message under construction.
class ProtoMessage {
 public:
  ProtoMessage& integer(int field, std::uint64_t value) {
    varint(static_cast<std::uint64_t>(field) << 3);
    varint(value);
    return *this;
  }
  ProtoMessage& bytes(int field, const std::string& value) {
    varint(static_cast<std::uint64_t>(field) << 3 | 2);
    varint(value.size());
    bytes_ += value;
    return *this;
  }
  ProtoMessage& message(int field, const ProtoMessage& value) { return bytes(field, value.bytes_); }
  const std::string& text() const { return bytes_; }

 private:
  void varint(std::uint64_t value) {
    for (; value >= 0x80; value >>= 7) bytes_ += static_cast<char>(value | 0x80);
    bytes_ += static_cast<char>(value);
  }

  std::string bytes_;
};

inline ProtoMessage onnxTensor(const std::string& name, const std::vector<int>& shape,
                               const std::vector<float>& values) {
  ProtoMessage tensor;
  for (const int n : shape) tensor.integer(1, static_cast<std::uint64_t>(n));
  std::string raw(values.size() * sizeof(float), '\0');  // little endian, as is the machine
  std::memcpy(&raw[0], values.data(), raw.size());
  return tensor.integer(2, 1).bytes(8, name).bytes(9, raw);
}

inline ProtoMessage onnxValue(const std::string& name, const std::vector<int>& shape) {
  ProtoMessage dims;
  for (const int n : shape) {
    dims.message(1, ProtoMessage().integer(1, static_cast<std::uint64_t>(n)));
  }
  return ProtoMessage().bytes(1, name).message(
      2, ProtoMessage().message(1, ProtoMessage().integer(1, 1).message(2, dims)));
}

inline ProtoMessage onnxInts(const std::string& name, const std::vector<int>& values) {
  ProtoMessage attribute;
  attribute.bytes(1, name);
  for (const int n : values) attribute.integer(8, static_cast<std::uint64_t>(n));
  return attribute.integer(20, 7);
}

/// y = weights * x + bias at every `stride`-th pixel; `weights` is (outputs x 3), row-major.
inline void writeConvolution(const std::string& path, int width, int height, int stride,
                             const std::vector<float>& weights, const std::vector<float>& bias) {
  const int outputs = static_cast<int>(bias.size());
  ProtoMessage node;
  for (const char* input : {"image", "weights", "bias"}) node.bytes(1, input);
  node.bytes(2, "logits").bytes(3, "convolution").bytes(4, "Conv");
  node.message(5, onnxInts("kernel_shape", {1, 1}));
  node.message(5, onnxInts("strides", {stride, stride}));
  ProtoMessage graph;
  graph.message(1, node).bytes(2, "graph");
  graph.message(5, onnxTensor("weights", {outputs, 3, 1, 1}, weights));
  graph.message(5, onnxTensor("bias", {outputs}, bias));
  graph.message(11, onnxValue("image", {1, 3, height, width}));
  graph.message(
      12, onnxValue("logits", {1, outputs, (height - 1) / stride + 1, (width - 1) / stride + 1}));
  ProtoMessage model;
  model.integer(1, 6).message(7, graph).message(8, ProtoMessage().integer(2, 11));
  std::ofstream(path, std::ios::binary) << model.text();
}

}  // namespace semantic_lidar_fusion
