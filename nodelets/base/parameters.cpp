// SPDX-License-Identifier: MIT
#include "base/parameters.h"

#include <algorithm>
#include <iomanip>
#include <limits>
#include <set>
#include <sstream>
#include <vector>

#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/common/yaml_reader.h"

namespace semantic_lidar_fusion {
namespace {

using XmlRpc::XmlRpcValue;

/// Reads the parameter `name`, found from `node` upwards; an invalid value if there is none.
XmlRpcValue searched(const ros::NodeHandle& node, const std::string& name, std::string* key) {
  XmlRpcValue value;
  if (node.searchParam(name, *key)) node.getParam(*key, value);
  return value;
}

std::string text(const XmlRpcValue& value, const std::string& key) {
  if (!value.valid()) return {};
  if (value.getType() != XmlRpcValue::TypeString) {
    throw ConfigError({"parameter " + key + ": a string is wanted"});
  }
  XmlRpcValue copy = value;
  return static_cast<std::string>(copy);
}

std::vector<std::string> overrideList(XmlRpcValue value, const std::string& key) {
  std::vector<std::string> result;
  if (!value.valid()) return result;
  if (value.getType() == XmlRpcValue::TypeArray) {
    for (int i = 0; i < value.size(); ++i) {
      result.push_back(text(value[i], key + "[" + std::to_string(i) + "]"));
    }
    return result;
  }
  std::istringstream words(text(value, key));
  for (std::string word; words >> word;) result.push_back(word);
  return result;
}

/// Parameters outlive the launch that set them: a file of an earlier one hides a tree of today's.
std::string hiddenTree(const ros::NodeHandle& node) {
  std::string file_key, tree_key;
  const XmlRpcValue file = searched(node, "rig_file", &file_key);
  const bool has_file =
      file.valid() && (file.getType() != XmlRpcValue::TypeString || !text(file, file_key).empty());
  if (!has_file || !searched(node, "rig", &tree_key).valid()) return {};
  return "parameter " + file_key + " counts, and parameter " + tree_key +
         " is not read: is one of them of an earlier launch? rosparam delete it";
}

}  // namespace

YAML::Node yamlTree(XmlRpcValue value, const std::string& key) {
  switch (value.getType()) {
    case XmlRpcValue::TypeBoolean:
      return YAML::Node(static_cast<bool>(value));
    case XmlRpcValue::TypeInt:
      return YAML::Node(static_cast<int>(value));
    case XmlRpcValue::TypeDouble: {
      // All digits: the tree must hold the number that the file held.
      std::ostringstream digits;
      digits << std::setprecision(std::numeric_limits<double>::max_digits10)
             << static_cast<double>(value);
      return YAML::Node(digits.str());
    }
    case XmlRpcValue::TypeString:
      return YAML::Node(static_cast<std::string>(value));
    case XmlRpcValue::TypeArray: {
      YAML::Node list(YAML::NodeType::Sequence);
      for (int i = 0; i < value.size(); ++i) {
        list.push_back(yamlTree(value[i], key + "[" + std::to_string(i) + "]"));
      }
      return list;
    }
    case XmlRpcValue::TypeStruct: {
      YAML::Node map(YAML::NodeType::Map);
      for (auto& member : value) {
        map[member.first] = yamlTree(member.second, key + "/" + member.first);
      }
      return map;
    }
    default:
      throw ConfigError({"parameter " + key + ": has a type that a rig file cannot hold"});
  }
}

Rig loadRigFromParameters(const ros::NodeHandle& node) {
  std::string file_key, tree_key, directory_key, overrides_key;
  const XmlRpcValue file = searched(node, "rig_file", &file_key);
  const XmlRpcValue tree = searched(node, "rig", &tree_key);
  const XmlRpcValue directory = searched(node, "rig_directory", &directory_key);
  const std::vector<std::string> overrides =
      overrideList(searched(node, "overrides", &overrides_key), overrides_key);

  const std::string path = text(file, file_key);
  if (!path.empty()) return loadRig(path, overrides);
  if (tree.valid()) {
    const std::string base = text(directory, directory_key);
    return rigFromYaml(yamlTree(tree, tree_key), base.empty() ? "." : base, "parameter " + tree_key,
                       overrides);
  }
  throw ConfigError({"no rig: neither parameter " + node.resolveName("rig_file") + " nor " +
                     node.resolveName("rig") + ", nor one of these names in a namespace above"});
}

std::vector<std::string> unknownParameters(const ros::NodeHandle& node) {
  // `camera` is the superpixel nodelet's, `tuned_rig_file` the projection's, `diagnostic_period`
  // the diagnostic updater's.
  static const std::vector<std::string> kKnown = {"rig_file",      "rig",    "rig_directory",
                                                  "overrides",     "camera", "diagnostic_period",
                                                  "tuned_rig_file"};
  std::vector<std::string> names, problems;
  const std::string hidden = hiddenTree(node);
  if (!hidden.empty()) problems.push_back(hidden);
  node.getParamNames(names);
  const std::string prefix = node.getNamespace() + "/";
  std::set<std::string> seen;
  for (const std::string& name : names) {
    if (name.compare(0, prefix.size(), prefix) != 0) continue;
    const std::string key =
        name.substr(prefix.size(), name.find('/', prefix.size()) - prefix.size());
    if (std::find(kKnown.begin(), kKnown.end(), key) != kKnown.end() || !seen.insert(key).second) {
      continue;
    }
    const std::string meant = nearestName(key, kKnown);
    problems.push_back("parameter " + prefix + key + ": nothing reads it" +
                       (meant.empty() ? "" : "; is '" + meant + "' meant?"));
  }
  return problems;
}

}  // namespace semantic_lidar_fusion
