// SPDX-License-Identifier: MIT
#pragma once

#include <cstddef>
#include <string>

namespace semantic_lidar_fusion {

/// A text from outside (a frame, an encoding, a class name) as it may stand in a log, in
/// diagnostics or in JSON: one line of printable UTF-8 of at most about `longest` bytes. Control
/// characters and bytes that are no UTF-8 become `\xNN`; what is too long loses its middle.
std::string plainText(const std::string& text, std::size_t longest = 80);

}  // namespace semantic_lidar_fusion
