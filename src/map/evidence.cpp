// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/map/evidence.h"

#include <cmath>
#include <sstream>
#include <string>

#include "map_kernels.h"
#include "semantic_lidar_fusion/common/error.h"

namespace semantic_lidar_fusion {
namespace {

constexpr double kLeastProbability = 1e-6;
constexpr std::size_t kMaxClasses = 255;

std::string broken(const std::string& name, double value, const std::string& rule) {
  std::ostringstream text;
  text << name << " = " << value << ": must be " << rule;
  return text.str();
}

void check(const EvidenceConfig& config) {
  std::vector<std::string> problems;
  if (!(config.weight > 0.0 && config.weight <= 1.0))
    problems.push_back(broken("weight", config.weight, "above 0 and at most 1"));
  if (!(config.floor >= kLeastProbability && config.floor < 1.0))
    problems.push_back(broken("floor", config.floor, "from 1e-6 to below 1"));
  if (config.prior.empty() || config.prior.size() > kMaxClasses)
    problems.push_back(
        broken("prior", static_cast<double>(config.prior.size()), "of 1 to 255 classes"));
  double sum = 0.0;
  for (std::size_t c = 0; c < config.prior.size(); ++c) {
    sum += config.prior[c];
    if (!(config.prior[c] >= kLeastProbability && config.prior[c] <= 1.0))
      problems.push_back(
          broken("prior[" + std::to_string(c) + "]", config.prior[c], "from 1e-6 to 1"));
  }
  if (!config.prior.empty() && !(std::abs(sum - 1.0) <= 1e-6))
    problems.push_back(broken("sum of prior", sum, "1"));
  if (!problems.empty()) throw ConfigError(problems);
}

}  // namespace

EvidenceModel::EvidenceModel(const EvidenceConfig& config) : kind_(config.kind) {
  check(config);
  class_count_ = static_cast<int>(config.prior.size());
  floor_ = static_cast<float>(config.floor);
  if (kind_ == EvidenceKind::kDirichlet) {
    scale_ = static_cast<float>(std::ldexp(config.weight, kEvidenceBits));
    kernel_ = countEvidence();
    prior_.assign(static_cast<std::size_t>(kMaxRows) * class_count_, 0);
    return;
  }
  // With w <= 1 and every probability >= 1e-6 all sums stay below 2^31.
  const double unit = std::ldexp(config.weight, kEvidenceBits + kGuardBits);
  scale_ = static_cast<float>(unit);
  octave_ = static_cast<std::int32_t>(std::lround(unit * 0.69314718055994531));
  kernel_ = logEvidence();
  for (int row = 0; row < kMaxRows; ++row) {
    for (double prior : config.prior)
      prior_.push_back(static_cast<std::int32_t>(std::lround(unit * std::log(prior))));
  }
}

void EvidenceModel::compute(const float* probabilities, int rows, std::int32_t* evidence) const {
  kernel_(probabilities, static_cast<std::size_t>(rows) * class_count_,
          EvidenceConstants{floor_, scale_, octave_}, prior_.data(), evidence);
}

}  // namespace semantic_lidar_fusion
