// SPDX-License-Identifier: MIT
// All fuzz targets without a fuzzer: their seeds, and seeded mutations of them. Covers a machine
// without clang, and runs under every sanitizer that the tests run under.
#include <gtest/gtest.h>

#include <cstdlib>
#include <random>

#include "fuzz_target.h"

namespace semantic_lidar_fusion {
namespace fuzz {
namespace {

int executions() {
  const char* const wanted = std::getenv("SLF_FUZZ_RUNS");
  return wanted == nullptr ? 10000 : std::atoi(wanted);
}

class Mutator {
 public:
  explicit Mutator(const Target& target) : target_(target), seeds_(target.seeds()) {}

  Bytes next() {
    Bytes bytes = seeds_[below(seeds_.size())];
    for (std::size_t edits = 1 + below(6); edits > 0; --edits) edit(&bytes);
    return bytes;
  }

 private:
  std::size_t below(std::size_t n) { return n == 0 ? 0 : random_() % n; }

  void edit(Bytes* bytes) {
    const std::size_t at = below(bytes->size());
    const auto here = bytes->begin() + static_cast<std::ptrdiff_t>(at);
    switch (below(7)) {
      case 0:
        bytes->insert(here, static_cast<std::uint8_t>(random_()));
        break;
      case 1:
        bytes->erase(
            here, here + static_cast<std::ptrdiff_t>(std::min(bytes->size() - at, 1 + below(40))));
        break;
      case 2:
        if (!bytes->empty()) *here ^= static_cast<std::uint8_t>(1u << below(8));
        break;
      case 3:
        for (std::size_t i = at; i < std::min(bytes->size(), at + 4); ++i) {
          (*bytes)[i] = static_cast<std::uint8_t>(random_());
        }
        break;
      case 4: {  // numbers at their limits
        static const std::uint8_t kLimits[] = {0x00, 0xFF, 0x7F, 0x80};
        const std::uint8_t limit = kLimits[below(4)];
        for (std::size_t i = at; i < std::min(bytes->size(), at + 8); ++i) (*bytes)[i] = limit;
        break;
      }
      case 5: {
        std::size_t words = 0;
        while (target_.words[words] != nullptr) ++words;
        if (words == 0) break;
        const std::string word = target_.words[below(words)];
        bytes->insert(here, word.begin(), word.end());
        break;
      }
      default: {
        const Bytes& other = seeds_[below(seeds_.size())];
        const std::size_t from = below(other.size());
        const std::size_t length = std::min(other.size() - from, below(200));
        bytes->insert(here, other.begin() + static_cast<std::ptrdiff_t>(from),
                      other.begin() + static_cast<std::ptrdiff_t>(from + length));
      }
    }
  }

  const Target& target_;
  std::vector<Bytes> seeds_;
  std::mt19937 random_{20};
};

class Replay : public testing::TestWithParam<Target> {};

std::string hex(const Bytes& bytes) {
  std::string text;
  for (const std::uint8_t byte : bytes) {
    text += "0123456789abcdef"[byte >> 4];
    text += "0123456789abcdef"[byte & 15];
  }
  return text;
}

TEST_P(Replay, SeedsAndMutationsKeepEveryPromise) {
  const Target& target = GetParam();
  const std::vector<Bytes> seeds = target.seeds();
  ASSERT_FALSE(seeds.empty());
  Mutator mutator(target);
  for (int i = 0; i < static_cast<int>(seeds.size()) + executions(); ++i) {
    const auto number = static_cast<std::size_t>(i);
    const Bytes input = number < seeds.size() ? seeds[number] : mutator.next();
    try {
      target.run(input.data(), input.size());
    } catch (const std::exception& error) {
      FAIL() << "input " << i << ": " << error.what() << "\n" << hex(input);
    }
  }
}

INSTANTIATE_TEST_SUITE_P(Parsers, Replay, testing::ValuesIn(targets()),
                         [](const auto& info) { return std::string(info.param.name); });

}  // namespace
}  // namespace fuzz
}  // namespace semantic_lidar_fusion
