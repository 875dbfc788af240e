// SPDX-License-Identifier: MIT
/// The command lines of the offline tools, and what their main functions do alike.
#pragma once

#include <functional>
#include <map>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "edge/version.h"

namespace semantic_lidar_fusion {

/// The command line is wrong; what() says how.
class UsageError : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

/// What every tool understands.
struct CommonOptions {
  bool force = false;    ///< --force
  bool quiet = false;    ///< --quiet, -q
  bool version = false;  ///< --version
  bool help = false;     ///< --help, -h
};

/// A number from `least` to `most`. Throws UsageError, which names the option.
double numberOf(const std::string& name, const std::string& text, double least, double most);
double wholeNumberOf(const std::string& name, const std::string& text, double least, double most);

/// Reads options; each is one line of the tool. Values follow as `--name VALUE` or
/// `--name=VALUE`; `--` ends the options. --help and --version end the reading.
class OptionReader {
 public:
  using Take = std::function<void(const std::string& value)>;

  /// `common` outlives the reader.
  explicit OptionReader(CommonOptions* common);

  /// `set` becomes true where the option is given.
  OptionReader& flag(const std::string& name, bool* set);
  OptionReader& text(const std::string& name, std::string* value);
  OptionReader& number(const std::string& name, double least, double most, double* value);
  template <typename Integer>
  OptionReader& wholeNumber(const std::string& name, double least, double most, Integer* value) {
    return this->value(name, [=](const std::string& text) {
      *value = static_cast<Integer>(wholeNumberOf(name, text, least, most));
    });
  }
  /// As many numbers as `values`, between commas; each from 0 to its own of `most`.
  OptionReader& numbers(const std::string& name, const std::vector<double>& most,
                        const std::vector<double*>& values);
  /// One of a few words, each with what it means.
  template <typename Value>
  OptionReader& choice(const std::string& name,
                       const std::vector<std::pair<std::string, Value>>& values, Value* value) {
    return this->value(name, [name, values, value](const std::string& text) {
      std::string known;
      for (const auto& [word, meaning] : values) {
        if (word == text) {
          *value = meaning;
          return;
        }
        known += (known.empty() ? "" : ", ") + word;
      }
      throw UsageError(name + " is '" + text + "'; it must be one of " + known);
    });
  }
  /// Any other; `take` throws UsageError where it does not like the value.
  OptionReader& value(const std::string& name, const Take& take);

  /// The arguments that are no options, in their order. Throws UsageError.
  std::vector<std::string> read(const std::vector<std::string>& arguments) const;

 private:
  CommonOptions* common_;
  std::map<std::string, bool*> flags_;
  std::map<std::string, Take> values_;
};

/// Throws what runMain() reports as an interruption if a signal that ends programs came.
void endIfInterrupted();

/// Throws Error where nobody takes the text: a full disk, a closed stdout.
void printText(const std::string& text);

/// Runs a main function: signals, errors as one line. The exit code is 0 if all is done, 1 if it
/// failed, 2 if the command line is wrong, 128 + the number of a signal.
int runMain(const std::string& name, const std::function<void()>& run);

/// A main function. Options derive from CommonOptions; `parse` throws UsageError.
template <typename Options>
int runTool(const std::string& name, const std::string& usage,
            Options (*parse)(const std::vector<std::string>& arguments),
            void (*work)(const Options& options), int argc, char** argv) {
  return runMain(name, [=] {
    const Options options = parse(std::vector<std::string>(argv + 1, argv + argc));
    if (options.help) {
      printText(usage);
    } else if (options.version) {
      printText(name + " " + kVersion + "\n");
    } else {
      work(options);
    }
  });
}

}  // namespace semantic_lidar_fusion
