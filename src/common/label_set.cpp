// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/common/label_set.h"

#include <algorithm>
#include <cstdio>
#include <set>

#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/common/yaml_reader.h"

namespace semantic_lidar_fusion {
namespace {

constexpr const char* kNameRule = "must be 1 to 64 characters of a-z, 0-9 and _";

bool isClassName(const std::string& name) {
  return !name.empty() && name.size() <= 64 && std::all_of(name.begin(), name.end(), [](char c) {
    return (c >= 'a' && c <= 'z') || (c >= '0' && c <= '9') || c == '_';
  });
}

std::string itemPath(const std::string& list, std::size_t index) {
  return list + "[" + std::to_string(index) + "]";
}

ClassInfo readClass(const YAML::Node& node, std::size_t index, std::vector<std::string>* problems) {
  ClassInfo info;
  YamlSection section(node, itemPath("classes", index), problems);
  section.text("name", &info.name);
  if (node.IsMap() && !isClassName(info.name)) section.problem("name", kNameRule);

  int id = static_cast<int>(index);
  section.integer("id", &id, 0, LabelSet::kMaxClasses - 1);
  if (id != static_cast<int>(index)) {
    section.problem("id", "must be the position in the list, " + std::to_string(index));
  }

  std::vector<double> color;
  const std::size_t problems_before = problems->size();
  section.numbers("color", &color, {0, 255});
  const bool whole =
      std::all_of(color.begin(), color.end(), [](double c) { return c == static_cast<int>(c); });
  if (color.size() == 3 && whole) {
    for (std::size_t i = 0; i < 3; ++i) info.color_rgb[i] = static_cast<std::uint8_t>(color[i]);
  } else if (node.IsMap() && problems->size() == problems_before) {
    section.problem("color", "must be [red, green, blue], whole numbers from 0 to 255");
  }

  section.boolean("dynamic", &info.dynamic);
  if (section.has("lidar")) {
    bool lidar = true;
    section.boolean("lidar", &lidar);
    info.lidar = lidar;
  }
  section.finish();
  return info;
}

std::vector<ClassInfo> readClasses(const YAML::Node& list, std::vector<std::string>* problems) {
  std::vector<ClassInfo> classes;
  if (!list.IsSequence() || list.size() == 0 || list.size() > LabelSet::kMaxClasses) {
    problems->push_back("classes = " + describeValue(list) + ": must be a list of 1 to " +
                        std::to_string(LabelSet::kMaxClasses) + " classes");
    return classes;
  }
  std::set<std::string> names;
  for (std::size_t i = 0; i < list.size(); ++i) {
    classes.push_back(readClass(list[i], i, problems));
    const std::string& name = classes.back().name;
    if (isClassName(name) && !names.insert(name).second) {
      problems->push_back(itemPath("classes", i) + ".name = " + name +
                          ": two classes have this name");
    }
  }
  return classes;
}

void appendJson(const std::string& text, std::string* json) {
  *json += '"';
  for (const char c : text) {
    const auto code = static_cast<unsigned char>(c);
    if (c == '"' || c == '\\') {
      *json += '\\';
      *json += c;
    } else if (code < 0x20) {
      char escaped[8];
      std::snprintf(escaped, sizeof(escaped), "\\u%04x", static_cast<unsigned>(code));
      *json += escaped;
    } else {
      *json += c;
    }
  }
  *json += '"';
}

}  // namespace

std::optional<int> LabelSet::idOf(const std::string& name) const {
  for (int id = 0; id < size(); ++id) {
    if (classes_[static_cast<std::size_t>(id)].name == name) return id;
  }
  return {};
}

LabelSet LabelSet::fromYaml(const YAML::Node& root, const std::string& source_name) {
  std::vector<std::string> problems;
  LabelSet set;
  YamlSection section(root.IsSequence() ? YAML::Node() : root, "", &problems);
  set.classes_ = readClasses(root.IsSequence() ? root : section.get("classes"), &problems);

  std::vector<std::string> class_names;
  for (const ClassInfo& info : set.classes_) class_names.push_back(info.name);
  std::vector<bool> used(class_names.size(), false);
  // Ids of `names`; each class may be discarded or merged once in all.
  const auto useClasses = [&](const std::vector<std::string>& names, const std::string& path) {
    std::vector<int> ids;
    for (const std::string& name : names) {
      const std::string thing = path + " = " + describeValue(YAML::Node(name)) + ": ";
      const std::optional<int> id = set.idOf(name);
      if (!id) {
        const std::string nearest = nearestName(name, class_names);
        problems.push_back(thing + "must be a class of the set" +
                           (nearest.empty() ? "" : "; did you mean '" + nearest + "'?"));
      } else if (used[static_cast<std::size_t>(*id)]) {
        problems.push_back(thing + "a class may be discarded or merged once only");
      } else {
        used[static_cast<std::size_t>(*id)] = true;
        ids.push_back(*id);
      }
    }
    return ids;
  };

  YamlSection evaluation(section.get("evaluation"), "evaluation", &problems);
  std::vector<std::string> discard;
  evaluation.texts("discard", &discard);
  set.discarded_ = useClasses(discard, "evaluation.discard");

  const YAML::Node merge_node = evaluation.get("merge");
  YamlSection merge(merge_node, "evaluation.merge", &problems);
  if (merge_node.IsDefined() && merge_node.IsMap()) {
    for (const auto& item : merge_node) {
      if (!item.first.IsScalar()) continue;
      MergedClass merged;
      merged.name = item.first.Scalar();
      if (merge.has(merged.name)) {
        std::vector<std::string> members;
        merge.texts(merged.name, &members);
        merged.members = useClasses(members, merge.pathOf(describeValue(item.first)));
        if (!isClassName(merged.name))
          merge.problem(merged.name, std::string("its name ") + kNameRule);
        const bool member = std::find(members.begin(), members.end(), merged.name) != members.end();
        if (set.idOf(merged.name) && !member) {
          merge.problem(merged.name, "must hold the class of the same name");
        }
        if (members.empty() && item.second.IsSequence()) {
          merge.problem(merged.name, "must name at least one class");
        }
      }
      set.merged_.push_back(std::move(merged));
    }
  }
  merge.finish();
  evaluation.finish();
  section.finish();

  if (!problems.empty()) {
    for (std::string& problem : problems) problem = source_name + ": " + problem;
    throw ConfigError(std::move(problems));
  }
  return set;
}

LabelSet LabelSet::fromFile(const std::string& path) { return fromYaml(parseYamlFile(path), path); }

std::string LabelSet::toJson() const {
  std::string json = "{\"classes\": [";
  for (int id = 0; id < size(); ++id) {
    const ClassInfo& info = (*this)[id];
    json += (id ? ", " : "") + std::string("{\"id\": ") + std::to_string(id) + ", \"name\": ";
    appendJson(info.name, &json);
    json += ", \"color\": [" + std::to_string(info.color_rgb[0]) + ", " +
            std::to_string(info.color_rgb[1]) + ", " + std::to_string(info.color_rgb[2]) +
            "], \"dynamic\": " + (info.dynamic ? "true" : "false");
    if (info.lidar) json += std::string(", \"lidar\": ") + (*info.lidar ? "true" : "false");
    json += "}";
  }
  const auto appendNames = [&](const std::vector<int>& ids) {
    json += "[";
    for (std::size_t i = 0; i < ids.size(); ++i) {
      if (i > 0) json += ", ";
      appendJson((*this)[ids[i]].name, &json);
    }
    json += "]";
  };
  json += "], \"discard\": ";
  appendNames(discarded_);
  json += ", \"merge\": {";
  for (std::size_t i = 0; i < merged_.size(); ++i) {
    if (i > 0) json += ", ";
    appendJson(merged_[i].name, &json);
    json += ": ";
    appendNames(merged_[i].members);
  }
  return json + "}}";
}

}  // namespace semantic_lidar_fusion
