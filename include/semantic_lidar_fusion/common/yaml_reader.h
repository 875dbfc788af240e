// SPDX-License-Identifier: MIT
/// Strict reading of YAML maps: every key is known, every value checked, every problem collected.
///
/// A problem is one line: the key's path, its value, the rule ("superpixels.count = -5: must be a
/// whole number from 1 to 10000000"). A key that is absent leaves the default of its variable.
#pragma once

#include <yaml-cpp/yaml.h>

#include <algorithm>
#include <limits>
#include <string>
#include <utility>
#include <vector>

#include "semantic_lidar_fusion/common/yaml_writer.h"

namespace semantic_lidar_fusion {

/// The one document of a YAML text as a tree without anchors: bounded in size and depth, and free
/// to change. An empty text gives an empty map. Throws ConfigError naming `source_name`, line and
/// column.
YAML::Node parseYaml(const std::string& text, const std::string& source_name);
/// The same for a file.
YAML::Node parseYamlFile(const std::string& path);
/// A copy that shares nothing with `node`. Throws ConfigError if it refers to itself or is absurdly
/// deep or large.
YAML::Node copyTree(const YAML::Node& node, const std::string& source_name);

/// A value for a message, on one line: a scalar in short form, else its kind.
std::string describeValue(const YAML::Node& node);
/// The name most like `word`, if one is near enough to be meant; else empty.
std::string nearestName(const std::string& word, const std::vector<std::string>& names);

/// Bounds of a number; open bounds exclude themselves.
struct NumberRange {
  double least = -std::numeric_limits<double>::max();
  double most = std::numeric_limits<double>::max();
  bool open_least = false;
};

/// One map of a configuration. Every key that is asked for becomes a known key; `finish` reports
/// the rest. What each key came to, given or by default, is kept in the order of asking, so that
/// the settings can be written whole: no reader of a key can forget its writer.
class YamlSection {
 public:
  /// `node` may be undefined or empty (no keys); anything but a map is a problem. `path` names the
  /// section in messages, empty for the root. Problems go to `problems`, which must outlive this.
  YamlSection(const YAML::Node& node, std::string path, std::vector<std::string>* problems);

  /// The map below a key, which puts what its keys came to into `this` when it finishes; `this`
  /// must then still be there.
  YamlSection child(const std::string& key);

  bool has(const std::string& key) const;
  /// The value of a key, undefined if absent.
  YAML::Node get(const std::string& key);
  std::string pathOf(const std::string& key) const;

  void number(const std::string& key, double* value, const NumberRange& range = {});
  void integer(const std::string& key, int* value, int least, int most);
  void boolean(const std::string& key, bool* value);
  /// Any scalar, as it is written.
  void text(const std::string& key, std::string* value);
  void texts(const std::string& key, std::vector<std::string>* values);
  /// False if something of the list was no number within the range; it is a problem then.
  bool numbers(const std::string& key, std::vector<double>* values, const NumberRange& range = {});
  /// One of some names; of several names for a value the first is the one in messages.
  template <typename Value>
  void choice(const std::string& key, Value* value,
              const std::vector<std::pair<const char*, Value>>& options) {
    std::vector<std::string> names, shown;
    for (auto option = options.begin(); option != options.end(); ++option) {
      names.emplace_back(option->first);
      const auto earlier = std::find_if(options.begin(), option, [&](const auto& other) {
        return other.second == option->second;
      });
      if (earlier == option) shown.emplace_back(option->first);
    }
    const int index = indexOfChoice(key, names, shown);
    if (index >= 0) *value = (options.begin() + index)->second;
    const auto chosen = std::find_if(options.begin(), options.end(),
                                     [&](const auto& option) { return option.second == *value; });
    if (chosen != options.end()) keep(key, YamlTree::text(chosen->first));
  }

  /// Reports that the value of `key` breaks `rule` ("must be ...").
  void problem(const std::string& key, const std::string& rule);
  /// Keeps what a key came to in the end, where that differs from what was read.
  void keep(const std::string& key, YamlTree value) { resolved_.put(key, std::move(value)); }
  /// What all keys came to.
  const YamlTree& resolved() const { return resolved_; }
  /// Reports duplicate and unknown keys.
  void finish();

 private:
  bool present(const std::string& key);
  void readTexts(const std::string& key, std::vector<std::string>* values);
  bool readNumbers(const std::string& key, std::vector<double>* values, const NumberRange& range);
  int indexOfChoice(const std::string& key, const std::vector<std::string>& names,
                    const std::vector<std::string>& shown);

  YAML::Node node_;
  std::string path_;
  std::vector<std::string>* problems_;
  std::vector<std::string> known_;
  YamlTree resolved_ = YamlTree::map();
  YamlSection* parent_ = nullptr;
  std::string key_in_parent_;
};

}  // namespace semantic_lidar_fusion
