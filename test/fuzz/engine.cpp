// SPDX-License-Identifier: MIT
// The target of one fuzz_<name>.cpp under libFuzzer. With SLF_FUZZ_SEEDS=FOLDER in the environment
// it writes its seeds there and ends.
#include <cstdio>
#include <cstdlib>
#include <fstream>

#include "fuzz_target.h"

using semantic_lidar_fusion::fuzz::targets;

extern "C" int LLVMFuzzerInitialize(int* /*argc*/, char*** /*argv*/) {
  const char* const folder = std::getenv("SLF_FUZZ_SEEDS");
  if (folder == nullptr) return 0;
  int number = 0;
  for (const auto& seed : targets().front().seeds()) {
    const std::string path = std::string(folder) + "/seed_" + std::to_string(number++);
    std::ofstream file(path, std::ios::binary);
    file.write(reinterpret_cast<const char*>(seed.data()),
               static_cast<std::streamsize>(seed.size()));
    if (!file.good()) {
      std::fprintf(stderr, "cannot write %s\n", path.c_str());
      std::exit(1);
    }
  }
  std::exit(0);
}

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  targets().front().run(data, size);  // what leaves it is a finding
  return 0;
}
