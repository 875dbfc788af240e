// SPDX-License-Identifier: MIT
/// Class ids, names and colours as one table, loaded from a class-set YAML file.
///
/// File format (see config/classes_*.yaml): `classes:` a list of {name, color: [r, g, b], dynamic,
/// lidar} whose position is the class id (an explicit `id` must equal it); `evaluation:` {discard:
/// [names], merge: {merged_name: [names]}}. Names match [a-z0-9_]+, since `p_<name>` is a cloud
/// field.
#pragma once

#include <array>
#include <cstdint>
#include <optional>
#include <string>
#include <vector>

namespace YAML {
class Node;
}

namespace semantic_lidar_fusion {

struct ClassInfo {
  std::string name;
  std::array<std::uint8_t, 3> color_rgb{};
  bool dynamic = false;  ///< moves by itself (vehicles, people): maps keep it apart
  /// Whether a lidar's return can be of it; maps leave the others out. Not given: by its name.
  std::optional<bool> lidar;
};

/// Merged class of the evaluation: the union of `members` (class ids).
struct MergedClass {
  std::string name;
  std::vector<int> members;
};

class LabelSet {
 public:
  /// Most classes of one set: score images have at most 512 channels, labels are 8 bits with 255
  /// reserved.
  static constexpr int kMaxClasses = 255;

  LabelSet() = default;
  /// `root`: a class-set file's map, or its list of classes alone. Throws ConfigError with every
  /// problem (empty set, bad or duplicate names, unknown names in discard or merge, a class in two
  /// of them, a merged class named like a class that it does not hold, unknown keys).
  static LabelSet fromYaml(const YAML::Node& root, const std::string& source_name);
  static LabelSet fromFile(const std::string& path);

  int size() const { return static_cast<int>(classes_.size()); }
  const ClassInfo& operator[](int id) const { return classes_.at(static_cast<std::size_t>(id)); }
  const std::vector<ClassInfo>& classes() const { return classes_; }
  std::optional<int> idOf(const std::string& name) const;
  /// Classes left out of evaluation tables (the paper: sky and unlabelled).
  const std::vector<int>& discarded() const { return discarded_; }
  /// Merge map for evaluation; a class that is neither merged nor discarded stands alone.
  const std::vector<MergedClass>& merged() const { return merged_; }
  /// The `class_info` message: {"classes": [{"id", "name", "color": [r, g, b], "dynamic"
  /// and, if it was given, "lidar"}], "discard": [names], "merge": {name: [names]}}.
  std::string toJson() const;

 private:
  std::vector<ClassInfo> classes_;
  std::vector<int> discarded_;
  std::vector<MergedClass> merged_;
};

}  // namespace semantic_lidar_fusion
