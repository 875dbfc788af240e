// SPDX-License-Identifier: MIT
/// Whether an ONNX file is a network that can be run. OpenCV's importer trusts the file: damaged
/// ones make it read where nothing is. So a file is first read and run once in a process of its
/// own, the program `check_network` beside the library.
#pragma once

#include <string>

#include "semantic_lidar_fusion/common/types.h"

namespace semantic_lidar_fusion {

constexpr int kMaxNetworkChannels = 4096;

/// The size of a network's output.
struct NetworkShape {
  int channels = 0;
  int rows = 0;
  int columns = 0;
};

/// Throws DataError where the tensors of an ONNX file do not hold the bytes that their shapes say.
void checkOnnxTensors(const std::string& path);

/// Reads a network and runs it on zeros, in this process: it may crash. Throws DataError where it
/// cannot be read, takes no 1 x 3 x height x width, or gives no 1 x channels x rows x columns of a
/// size that suits the input.
NetworkShape examineNetwork(const std::string& path, const ImageSize& input);

/// The same in a process of its own, also safe while other threads run; a crash, more than
/// `kCheckSeconds` of computing, or too much memory is a DataError too.
NetworkShape examineNetworkApart(const std::string& path, const ImageSize& input);
constexpr int kCheckSeconds = 120;

}  // namespace semantic_lidar_fusion
