// SPDX-License-Identifier: MIT
/// --report: a page about a fused bag, which make_report.py writes from the bag alone.
#pragma once

#include <string>

namespace semantic_lidar_fusion {

/// make_report.py beside this program. Throws Error if it is not there.
std::string reportProgram();

/// Runs `program` on `bag`; it says itself on stderr why it fails. Throws Error then, too.
void writeReport(const std::string& program, const std::string& bag, const std::string& page,
                 bool quiet);

}  // namespace semantic_lidar_fusion
