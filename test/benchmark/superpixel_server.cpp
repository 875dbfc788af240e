// SPDX-License-Identifier: MIT
/// Clusters images that come on standard input, for comparisons with libraries of other languages.
///
/// Each request is a line "width height count mode", then width * height * 3 bytes BGR. Modes:
/// cold; warm = start from the request before with the same count; first = of a sequence whose next
/// ones are warm. The answer is a line "CPU-milliseconds superpixels", then width * height 32-bit
/// ids in the machine's byte order. Ends at the end of input.
#include <time.h>

#include <cstdio>
#include <iostream>
#include <map>
#include <string>
#include <utility>

#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/superpixel/slic.h"

namespace {

double threadMilliseconds() {
  timespec now{};
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
  return 1e3 * static_cast<double>(now.tv_sec) + 1e-6 * static_cast<double>(now.tv_nsec);
}

}  // namespace

int main() {
  using semantic_lidar_fusion::Slic;
  using semantic_lidar_fusion::SlicConfig;
  std::ios::sync_with_stdio(false);
  cv::setNumThreads(1);
  std::map<std::pair<int, bool>, Slic> clusterers;  // by count and mode
  int width = 0, height = 0, count = 0;
  std::string mode;
  try {
    while (std::cin >> width >> height >> count >> mode) {
      std::cin.get();
      if (width < 1 || height < 1) {
        std::cerr << "image is " << width << "x" << height << ", must be at least 1x1\n";
        return 1;
      }
      cv::Mat image(height, width, CV_8UC3);
      if (!std::cin.read(reinterpret_cast<char*>(image.data),
                         static_cast<std::streamsize>(image.total() * 3))) {
        std::cerr << "input ends within an image\n";
        return 1;
      }
      SlicConfig config;
      config.count = count;
      config.warm_start = mode != "cold";
      Slic& slic = clusterers.try_emplace({count, config.warm_start}, config).first->second;
      if (mode == "first") slic.reset();
      const double start = threadMilliseconds();
      const auto map = slic.cluster(image, {width, height});
      std::cout << threadMilliseconds() - start << " " << map.count << "\n";
      std::cout.write(reinterpret_cast<const char*>(map.ids.data),
                      static_cast<std::streamsize>(map.ids.total() * sizeof(int)));
      std::cout.flush();
    }
  } catch (const semantic_lidar_fusion::Error& error) {
    std::cerr << error.what() << "\n";
    return 1;
  }
  return 0;
}
