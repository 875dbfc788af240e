// SPDX-License-Identifier: MIT
/// A drive through the street, written to a bag.
#pragma once

#include <cstdint>
#include <string>

#include "semantic_lidar_fusion/sync/scan_selector.h"
#include "tools/common/command_line.h"
#include "tools/simulate_drive/errors.h"
#include "tools/simulate_drive/exposure.h"
#include "tools/simulate_drive/rig.h"

namespace semantic_lidar_fusion {
namespace simulator {

struct SimulationOptions : CommonOptions {
  std::string output;
  double duration_s = 2.0;
  double speed_mps = 10.0;
  std::uint64_t seed = 1;
  Optics optics;               ///< of all cameras
  double camera_drop_m = 0.2;  ///< of the cameras below the lidar
  double image_rate_hz = 30.0;
  bool moving = true;  ///< other road users move
  bool exact_odometry = false;
  bool range_noise = true;
  bool perfect_network = false;
  Shutter shutter;                                              ///< of all cameras
  ErrorSizes errors;                                            ///< of what the bag says of the rig
  ImageChoice image_choice = ImageChoice::kClosestToReference;  ///< that scans are taken to make
  bool all_images = false;  ///< else only those that a scan uses
  bool raw_images = false;  ///< else JPEG
  int threads = 2;
  std::string pictures;  ///< folder for PNG files of the first used image of each camera
};

/// `checkpoint` is called between steps and may throw. Throws Error; the output is then as before.
void simulateDrive(const SimulationOptions& options, void (*checkpoint)());

}  // namespace simulator
}  // namespace semantic_lidar_fusion
