// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/segmentation/network_check.h"

#include <dlfcn.h>
#include <fcntl.h>
#include <spawn.h>
#include <sys/wait.h>
#include <unistd.h>

#include <cerrno>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <fstream>
#include <iterator>
#include <opencv2/dnn.hpp>
#include <string_view>
#include <vector>

#include "opencv_error.h"
#include "semantic_lidar_fusion/common/error.h"

extern char** environ;

namespace semantic_lidar_fusion {
namespace {

/// An output is no larger than the input enlarged by this, each way, and no layer has more values
/// than this many channels of the input's size.
constexpr int kMaxEnlargement = 4;
constexpr std::size_t kMaxLayerChannels = 2048;
constexpr std::size_t kMaxAnswer = 4096;

// ---- The few fields of onnx.proto that hold tensors.

enum WireType : unsigned { kVarint = 0, kFixed64 = 1, kBytes = 2, kFixed32 = 5 };

/// One field of a protobuf message at a time.
class ProtoReader {
 public:
  explicit ProtoReader(std::string_view bytes) : bytes_(bytes) {}

  /// False at the end. Throws DataError on what is no protobuf.
  bool next() {
    if (bytes_.empty()) return false;
    const std::uint64_t tag = varint();
    field = static_cast<unsigned>(tag >> 3);
    type = static_cast<unsigned>(tag & 7);
    switch (type) {
      case kVarint:
        number = varint();
        return true;
      case kFixed64:
        text = take(8);
        return true;
      case kBytes:
        text = take(varint());
        return true;
      case kFixed32:
        text = take(4);
        return true;
      default:
        throw DataError("is no ONNX file, or damaged");
    }
  }
  std::uint64_t varint() {
    std::uint64_t value = 0;
    for (unsigned shift = 0; shift < 64; shift += 7) {
      const auto byte = static_cast<std::uint8_t>(take(1)[0]);
      value |= static_cast<std::uint64_t>(byte & 0x7Fu) << shift;
      if ((byte & 0x80u) == 0) return value;
    }
    throw DataError("is no ONNX file, or damaged");
  }
  bool empty() const { return bytes_.empty(); }

  unsigned field = 0, type = 0;
  std::uint64_t number = 0;  ///< of a varint
  std::string_view text;     ///< of all others

 private:
  std::string_view take(std::uint64_t size) {
    if (size > bytes_.size()) throw DataError("is cut off, or damaged");
    const std::string_view taken = bytes_.substr(0, size);
    bytes_.remove_prefix(size);
    return taken;
  }

  std::string_view bytes_;
};

std::size_t countVarints(std::string_view packed) {
  ProtoReader reader(packed);
  std::size_t count = 0;
  for (; !reader.empty(); ++count) reader.varint();
  return count;
}

/// Bytes of one element of raw data, by TensorProto.DataType; 0 = none that is known.
std::size_t elementSize(std::uint64_t data_type) {
  switch (data_type) {
    case 2:  // uint8
    case 3:  // int8
    case 9:  // bool
      return 1;
    case 4:   // uint16
    case 5:   // int16
    case 10:  // float16
    case 16:  // bfloat16
      return 2;
    case 1:   // float
    case 6:   // int32
    case 12:  // uint32
      return 4;
    case 7:   // int64
    case 11:  // double
    case 13:  // uint64
      return 8;
    default:
      return 0;
  }
}

void checkTensor(std::string_view bytes) {
  std::uint64_t elements = 1, data_type = 0;
  std::size_t values = 0;
  std::string name;
  bool has_raw = false, is_external = false;
  std::string_view raw;
  const auto dimension = [&](std::uint64_t n) {
    constexpr std::uint64_t kMost = std::uint64_t{1} << 40;
    elements = n > kMost || elements > kMost ? kMost + 1 : elements * n;
    if (elements > kMost) throw DataError("has a tensor of an impossible shape");
  };
  for (ProtoReader reader(bytes); reader.next();) {
    const bool packed = reader.type == kBytes;
    switch (reader.field) {
      case 1:  // dims
        if (!packed) dimension(reader.number);
        if (packed) {
          for (ProtoReader dims(reader.text); !dims.empty();) dimension(dims.varint());
        }
        break;
      case 2:
        data_type = reader.number;
        break;
      case 4:  // float_data
        values += packed ? reader.text.size() / 4 : 1;
        break;
      case 10:  // double_data
        values += packed ? reader.text.size() / 8 : 1;
        break;
      case 5:   // int32_data
      case 7:   // int64_data
      case 11:  // uint64_data
        values += packed ? countVarints(reader.text) : 1;
        break;
      case 8:
        name = std::string(reader.text);
        break;
      case 9:
        has_raw = true;
        raw = reader.text;
        break;
      case 14:
        is_external = reader.number == 1;
        break;
      default:
        break;
    }
  }
  if (is_external) throw DataError("has tensors in other files, which OpenCV does not read");
  const std::size_t size = elementSize(data_type);
  const bool fits = has_raw ? size == 0 || raw.size() == elements * size
                            : data_type == 8 || values == elements;  // 8: strings
  if (fits) return;
  throw DataError("tensor '" + name.substr(0, 60) + "' has the shape of " +
                  std::to_string(elements) + " values and data of " +
                  (has_raw ? std::to_string(raw.size()) + " bytes" : std::to_string(values)) +
                  ": the file is damaged");
}

void checkGraph(std::string_view bytes, int depth);

void checkNode(std::string_view bytes, int depth) {
  for (ProtoReader node(bytes); node.next();) {
    if (node.field != 5 || node.type != kBytes) continue;
    for (ProtoReader attribute(node.text); attribute.next();) {
      if (attribute.type != kBytes) continue;
      if (attribute.field == 5 || attribute.field == 10) checkTensor(attribute.text);
      if (attribute.field == 6 || attribute.field == 11) checkGraph(attribute.text, depth + 1);
    }
  }
}

void checkGraph(std::string_view bytes, int depth) {
  constexpr int kMaxDepth = 16;
  if (depth > kMaxDepth) throw DataError("has graphs within graphs without end");
  for (ProtoReader graph(bytes); graph.next();) {
    if (graph.type != kBytes) continue;
    if (graph.field == 1) checkNode(graph.text, depth);
    if (graph.field == 5) checkTensor(graph.text);
  }
}

// ---- What OpenCV makes of it.

std::string shapeText(const std::vector<cv::dnn::MatShape>& shapes) {
  std::string text;
  for (const cv::dnn::MatShape& one : shapes) {
    for (const int n : one) text += (text.empty() ? "" : "x") + std::to_string(n);
  }
  return text;
}

/// Rows, columns and channels of the network's output, without running it.
NetworkShape outputShape(const cv::dnn::Net& net, const ImageSize& input) {
  const std::vector<int> outputs = net.getUnconnectedOutLayers();
  if (outputs.size() != 1) {
    throw DataError("has " + std::to_string(outputs.size()) + " outputs, must have one");
  }
  const cv::dnn::MatShape input_shape{1, 3, input.height, input.width};
  std::vector<cv::dnn::MatShape> in, out;
  net.getLayerShapes(input_shape, outputs[0], in, out);
  if (out.size() != 1 || out[0].size() != 4 || out[0][0] != 1 || out[0][1] < 1 || out[0][2] < 1 ||
      out[0][3] < 1) {
    throw DataError("output is " + shapeText(out) + ", must be 1 x channels x rows x columns");
  }
  if (out[0][1] > kMaxNetworkChannels || out[0][2] > kMaxEnlargement * input.height ||
      out[0][3] > kMaxEnlargement * input.width) {
    throw DataError("output is " + shapeText(out) + ", must have at most " +
                    std::to_string(kMaxNetworkChannels) + " channels and " +
                    std::to_string(kMaxEnlargement) + " times the input's rows and columns");
  }
  return {out[0][1], out[0][2], out[0][3]};
}

void checkLayers(const cv::dnn::Net& net, const ImageSize& input) {
  std::vector<int> ids;
  std::vector<std::vector<cv::dnn::MatShape>> in, out;
  net.getLayersShapes(cv::dnn::MatShape{1, 3, input.height, input.width}, ids, in, out);
  const double most = static_cast<double>(kMaxLayerChannels) * input.width * input.height;
  for (const std::vector<cv::dnn::MatShape>& shapes : out) {
    for (const cv::dnn::MatShape& shape : shapes) {
      double values = 1;
      for (const int n : shape) values *= n;
      if (values > most) {
        throw DataError("has a layer of " + shapeText({shape}) + " values, more than " +
                        std::to_string(kMaxLayerChannels) + " times the input");
      }
    }
  }
}

// ---- The process of its own.

/// semantic_lidar_fusion/check_network in the folder of this library, in devel and install space;
/// or beside that folder: Debian keeps libraries, not programs, in a folder of their architecture.
std::string checkerPath() {
  Dl_info info{};
  if (dladdr(reinterpret_cast<void*>(&checkOnnxTensors), &info) == 0 || info.dli_fname == nullptr) {
    return {};
  }
  const std::string library = info.dli_fname;
  const std::size_t slash = library.rfind('/');
  const std::string folder = slash == std::string::npos ? "." : library.substr(0, slash);
  const std::string name = "/semantic_lidar_fusion/check_network";
  const std::string beside = folder + "/.." + name;
  return access(beside.c_str(), X_OK) == 0 && access((folder + name).c_str(), X_OK) != 0
             ? beside
             : folder + name;
}

/// What the program writes to its standard output, at most `kMaxAnswer` bytes, and how it ended.
std::string answerOf(const std::vector<std::string>& command, int* status) {
  int ends[2];
  if (pipe2(ends, O_CLOEXEC) != 0) {
    throw DataError(std::string("cannot be checked: pipe: ") + std::strerror(errno));
  }
  posix_spawn_file_actions_t actions;
  posix_spawn_file_actions_init(&actions);
  posix_spawn_file_actions_addopen(&actions, STDIN_FILENO, "/dev/null", O_RDONLY, 0);
  posix_spawn_file_actions_adddup2(&actions, ends[1], STDOUT_FILENO);
  posix_spawn_file_actions_addopen(&actions, STDERR_FILENO, "/dev/null", O_WRONLY, 0);
  std::vector<char*> arguments;
  for (const std::string& word : command) arguments.push_back(const_cast<char*>(word.c_str()));
  arguments.push_back(nullptr);
  pid_t child = 0;
  const int failure =
      posix_spawn(&child, arguments[0], &actions, nullptr, arguments.data(), environ);
  posix_spawn_file_actions_destroy(&actions);
  close(ends[1]);
  std::string answer;
  char buffer[1024];
  while (failure == 0) {
    const ssize_t n = read(ends[0], buffer, sizeof(buffer));
    if (n < 0 && errno == EINTR) continue;
    if (n <= 0) break;
    answer.append(buffer, std::min<std::size_t>(static_cast<std::size_t>(n),
                                                kMaxAnswer - std::min(kMaxAnswer, answer.size())));
  }
  close(ends[0]);
  if (failure != 0) {
    throw DataError("cannot be checked: " + command[0] + ": " + std::strerror(failure));
  }
  while (waitpid(child, status, 0) < 0 && errno == EINTR) {
  }
  return answer;
}

}  // namespace

void checkOnnxTensors(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  const std::string bytes((std::istreambuf_iterator<char>(file)), std::istreambuf_iterator<char>());
  if (!file.good() && !file.eof()) throw DataError("cannot be read");
  for (ProtoReader model(bytes); model.next();) {
    if (model.field == 7 && model.type == kBytes) checkGraph(model.text, 0);
  }
}

NetworkShape examineNetwork(const std::string& path, const ImageSize& input) {
  checkOnnxTensors(path);
  std::string failure = "cannot be read by OpenCV " CV_VERSION ": ";
  try {
    cv::dnn::Net net = cv::dnn::readNetFromONNX(path);
    net.setPreferableBackend(cv::dnn::DNN_BACKEND_OPENCV);
    net.setPreferableTarget(cv::dnn::DNN_TARGET_CPU);
    failure = "does not take an input of " + sizeText(input) + ": ";
    const NetworkShape shape = outputShape(net, input);
    checkLayers(net, input);
    const int sizes[] = {1, 3, input.height, input.width};
    net.setInput(cv::Mat(4, sizes, CV_32F, cv::Scalar(0)));
    const cv::Mat output = net.forward();
    if (output.dims != 4 || output.type() != CV_32F || output.size[1] != shape.channels ||
        output.size[2] != shape.rows || output.size[3] != shape.columns) {
      throw DataError("gives another output than it says");
    }
    return shape;
  } catch (const cv::Exception& error) {
    throw DataError(failure + firstLine(error.err));
  }
}

NetworkShape examineNetworkApart(const std::string& path, const ImageSize& input) {
  int status = 0;
  const std::string answer = answerOf(
      {checkerPath(), path, std::to_string(input.width), std::to_string(input.height)}, &status);
  NetworkShape shape;
  if (WIFEXITED(status) && WEXITSTATUS(status) == 0 &&
      std::sscanf(answer.c_str(), "%d %d %d", &shape.channels, &shape.rows, &shape.columns) == 3) {
    return shape;
  }
  if (WIFEXITED(status) && WEXITSTATUS(status) == 1) throw DataError(firstLine(answer));
  throw DataError(WIFSIGNALED(status)
                      ? "crashes OpenCV " CV_VERSION " (signal " +
                            std::to_string(WTERMSIG(status)) + "): the file is damaged"
                      : "ends its check with exit code " + std::to_string(WEXITSTATUS(status)));
}

}  // namespace semantic_lidar_fusion
