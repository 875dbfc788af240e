// SPDX-License-Identifier: MIT
#include "tools/common/progress_bar.h"

#include <unistd.h>

#include <algorithm>
#include <cstdio>
#include <utility>

namespace semantic_lidar_fusion {

ProgressBar::ProgressBar(std::string label, std::size_t total, bool enabled)
    : label_(std::move(label)),
      total_(total),
      enabled_(enabled && total > 0),
      terminal_(::isatty(STDERR_FILENO) != 0) {}

ProgressBar::~ProgressBar() {
  if (open_line_) std::fputc('\n', stderr);
}

void ProgressBar::update(std::size_t done) {
  if (!enabled_) return;
  done = std::min(done, total_);
  const int percent = static_cast<int>(100 * done / total_);
  const int step = terminal_ ? percent : percent / 10;
  if (step == shown_) return;
  shown_ = step;
  if (!terminal_) {
    if (percent > 0) {
      std::fprintf(stderr, "%s: %d %% (%zu of %zu)\n", label_.c_str(), percent, done, total_);
    }
    return;
  }
  constexpr int kWidth = 40;
  const std::string bar(static_cast<std::size_t>(percent * kWidth / 100), '#');
  std::fprintf(stderr, "\r%-12s [%-*s] %3d %% (%zu of %zu)", label_.c_str(), kWidth, bar.c_str(),
               percent, done, total_);
  std::fflush(stderr);
  open_line_ = done < total_;
  if (!open_line_) std::fputc('\n', stderr);
}

}  // namespace semantic_lidar_fusion
