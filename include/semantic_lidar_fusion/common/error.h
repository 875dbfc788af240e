// SPDX-License-Identifier: MIT
/// The package's exceptions. Core functions throw them for what a caller or a user can mend;
/// absent data is an empty optional or an empty result instead.
#pragma once

#include <stdexcept>
#include <string>
#include <vector>

namespace semantic_lidar_fusion {

/// Base of every error of this package; what() is one line for a user: the thing, the value, the
/// rule.
class Error : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

/// Malformed or unusable input data (a message, an image, a cloud). The data is dropped, work goes
/// on.
class DataError : public Error {
 public:
  using Error::Error;
};

/// A configuration that breaks one or more rules; what() lists every problem, one a line.
class ConfigError : public Error {
 public:
  explicit ConfigError(std::vector<std::string> problems);
  const std::vector<std::string>& problems() const { return problems_; }

 private:
  std::vector<std::string> problems_;
};

}  // namespace semantic_lidar_fusion
