// SPDX-License-Identifier: MIT
/// Settings as YAML text that every parser reads alike, whether it follows YAML 1.1 or 1.2.
#pragma once

#include <string>
#include <utility>
#include <vector>

namespace semantic_lidar_fusion {

/// A value, a list or a map of settings; a map keeps the order in which its keys were put.
///
/// Numbers keep all their digits, and a text that a parser could take for something else (`off`,
/// `1e3`, an empty one) is quoted.
class YamlTree {
 public:
  /// An empty value (null).
  YamlTree() = default;
  static YamlTree number(double value);
  static YamlTree integer(long long value);
  static YamlTree boolean(bool value);
  static YamlTree text(const std::string& value);
  static YamlTree map();
  static YamlTree list();

  /// Sets a key of a map; a key that is there already keeps its place.
  void put(const std::string& key, YamlTree value);
  /// Appends to a list.
  void add(YamlTree value);
  /// The value of a map's key; nullptr if absent.
  const YamlTree* find(const std::string& key) const;
  bool isEmpty() const { return items_.empty(); }

  /// Block style, ends with an end of line. Lists of scalars stand on one line.
  std::string toYaml() const;

 private:
  enum class Kind { kScalar, kMap, kList };

  static YamlTree scalar(std::string written);
  bool isFlat() const;
  std::string flow() const;
  void write(int indent, bool continues_line, std::string* out) const;

  Kind kind_ = Kind::kScalar;
  std::string written_ = "null";                         ///< of a scalar
  std::vector<std::pair<std::string, YamlTree>> items_;  ///< of a list the keys are empty
};

}  // namespace semantic_lidar_fusion
