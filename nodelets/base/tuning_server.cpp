// SPDX-License-Identifier: MIT
#include "base/tuning_server.h"

#include <sys/stat.h>
#include <unistd.h>
#include <yaml-cpp/yaml.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <map>
#include <sstream>

#include "edge/version.h"
#include "semantic_lidar_fusion/common/error.h"

namespace semantic_lidar_fusion {
namespace {

using dynamic_reconfigure::Config;
using dynamic_reconfigure::ConfigDescription;

TunedParameter numberParameter(const std::string& name, const std::string& key,
                               const std::string& description, double least, double most,
                               std::function<double(const Rig&)> value) {
  TunedParameter parameter;
  parameter.name = name;
  parameter.key = key;
  parameter.type = "double";
  parameter.description = description;
  parameter.least = least;
  parameter.most = most;
  parameter.number = std::move(value);
  return parameter;
}

TunedParameter wholeParameter(const std::string& name, const std::string& key,
                              const std::string& description, double least, double most,
                              std::function<double(const Rig&)> value) {
  TunedParameter parameter = numberParameter(name, key, description, least, most, std::move(value));
  parameter.type = "int";
  return parameter;
}

TunedParameter choiceParameter(const std::string& name, const std::string& key,
                               const std::string& description, std::vector<std::string> choices,
                               std::function<std::string(const Rig&)> value) {
  TunedParameter parameter;
  parameter.name = name;
  parameter.key = key;
  parameter.type = "str";
  parameter.description = description;
  parameter.choices = std::move(choices);
  parameter.text = std::move(value);
  return parameter;
}

std::vector<std::string> occlusionNames() {
  std::vector<std::string> names;
  for (const OcclusionMode* mode : occlusionModes()) names.push_back(mode->name);
  return names;
}

/// The value of a key of a resolved rig, as text.
std::string textOf(const Rig& rig, const std::string& key) {
  return YAML::Load(rig.yaml)[key].as<std::string>();
}

void addShared(std::vector<TunedParameter>* all) {
  all->push_back(choiceParameter("occlusion_mode", "occlusion.mode", "How hidden points are found",
                                 occlusionNames(),
                                 [](const Rig& rig) { return rig.occlusion.mode->name; }));
  all->push_back(numberParameter("depth_margin_m", "occlusion.depth_margin_m",
                                 "Points this much behind a surface are hidden by it, m", 0, 10,
                                 [](const Rig& rig) { return rig.occlusion.depth_margin_m; }));
  all->push_back(numberParameter("depth_margin_ratio", "occlusion.depth_margin_ratio",
                                 "The same as a part of the surface's distance", 0, 1,
                                 [](const Rig& rig) { return rig.occlusion.depth_margin_ratio; }));
  all->push_back(numberParameter("temperature", "uncertainty.temperature",
                                 "Of the softmax over a pure superpixel", 0.01, 20,
                                 [](const Rig& rig) { return rig.uncertainty.temperature; }));
  all->push_back(numberParameter("exponent", "uncertainty.exponent",
                                 "Of the share; 0 ignores the superpixels", 0, 10,
                                 [](const Rig& rig) { return rig.uncertainty.exponent; }));
  all->push_back(wholeParameter(
      "smoothing_iterations", "smoothing.iterations", "Along the lidar's surfaces; 0 = off", 0,
      SmoothingConfig::kMostIterations, [](const Rig& rig) { return rig.smoothing.iterations; }));
  all->push_back(numberParameter("smoothing_distance_m", "smoothing.distance_m",
                                 "Neighbours at this distance count 1/e, m", 0.01, 10,
                                 [](const Rig& rig) { return rig.smoothing.distance_m; }));
  all->push_back(numberParameter("smoothing_intensity", "smoothing.intensity",
                                 "Neighbours of this difference in intensity count 1/e; 0 = all", 0,
                                 255, [](const Rig& rig) { return rig.smoothing.intensity; }));
  all->push_back(
      choiceParameter("overlap", "overlap", "How cameras that see one point are merged",
                      {"mean", "product", "nearest_in_time", "most_central", "geometric_mean"},
                      [](const Rig& rig) { return textOf(rig, "overlap"); }));
  all->push_back(wholeParameter("threads", "threads", "That share the cameras of a scan", 1, 64,
                                [](const Rig& rig) { return rig.threads; }));
}

void addCamera(const Rig& rig, std::size_t i, std::vector<TunedParameter>* all) {
  const std::string& name = rig.cameras[i].name;
  const std::string key = "cameras." + name + ".";
  const auto add = [&](TunedParameter parameter) {
    parameter.group = name;
    all->push_back(std::move(parameter));
  };
  add(numberParameter(name + "_time_offset", key + "time_offset",
                      "True time of an image = its stamp + this, s", -0.5, 0.5,
                      [i](const Rig& r) { return r.cameras[i].time_offset_s; }));
  const char* const turns[] = {"roll", "pitch", "yaw"};
  for (std::size_t axis = 0; axis < 3; ++axis) {
    add(numberParameter(
        name + "_" + turns[axis] + "_deg", key + "nudge.deg[" + std::to_string(axis) + "]",
        std::string("Turn of the camera about the lidar's ") + "xyz"[axis] + " axis, deg", -10, 10,
        [i, axis](const Rig& r) { return r.cameras[i].nudge.deg[axis]; }));
  }
  for (std::size_t axis = 0; axis < 3; ++axis) {
    add(numberParameter(
        name + "_" + "xyz"[axis] + "_m", key + "nudge.m[" + std::to_string(axis) + "]",
        std::string("Shift of the camera along the lidar's ") + "xyz"[axis] + " axis, m", -1, 1,
        [i, axis](const Rig& r) { return r.cameras[i].nudge.m[axis]; }));
  }
}

/// All digits, so that the rig holds the number that was asked for.
std::string digits(double value) {
  char text[40];
  std::snprintf(text, sizeof(text), "%.17g", value);
  return text;
}

/// The values of a request by name, as YAML.
std::map<std::string, std::string> valuesOf(const Config& request) {
  std::map<std::string, std::string> values;
  for (const auto& given : request.doubles) values[given.name] = digits(given.value);
  for (const auto& given : request.ints) values[given.name] = std::to_string(given.value);
  for (const auto& given : request.bools) values[given.name] = given.value ? "true" : "false";
  for (const auto& given : request.strs) values[given.name] = given.value;
  return values;
}

std::string defaultFile(const Rig& rig) {
  const char* ros_home = std::getenv("ROS_HOME");
  const char* home = std::getenv("HOME");
  const std::string folder = ros_home ? ros_home : std::string(home ? home : ".") + "/.ros";
  return folder + "/" + (rig.name.empty() ? "rig" : rig.name) + "_tuned.yaml";
}

/// Writes aside, then renames: the file is the old one or a whole new one.
void writeWhole(const std::string& path, const std::string& text) {
  const std::string aside = path + ".part";
  {
    std::ofstream file(aside, std::ios::binary | std::ios::trunc);
    file << text;
    file.close();
    if (!file) throw DataError(path + ": cannot be written");
  }
  if (std::rename(aside.c_str(), path.c_str()) != 0) {
    std::remove(aside.c_str());
    throw DataError(path + ": cannot be written");
  }
}

}  // namespace

std::vector<TunedParameter> tunedParameters(const Rig& rig) {
  std::vector<TunedParameter> all;
  addShared(&all);
  for (std::size_t i = 0; i < rig.cameras.size(); ++i) addCamera(rig, i, &all);
  return all;
}

Rig retuned(const Rig& rig, const Config& request) {
  std::map<std::string, std::string> values = valuesOf(request);
  std::vector<std::string> overrides, problems;
  std::map<std::string, std::array<std::string, 3>> lists;
  for (const TunedParameter& parameter : tunedParameters(rig)) {
    const std::size_t bracket = parameter.key.find('[');
    const auto given = values.find(parameter.name);
    std::string value = parameter.number ? digits(parameter.number(rig)) : std::string();
    if (given != values.end()) value = given->second;
    if (bracket != std::string::npos) {
      lists[parameter.key.substr(0, bracket)][parameter.key[bracket + 1] - '0'] = value;
    } else if (given != values.end()) {
      overrides.push_back(parameter.key + "=" + value);
    }
    if (given != values.end()) values.erase(given);
  }
  for (const auto& [key, list] : lists) {
    overrides.push_back(key + "=[" + list[0] + ", " + list[1] + ", " + list[2] + "]");
  }
  for (const auto& unknown : values) problems.push_back(unknown.first + ": no such parameter");
  if (!problems.empty()) throw ConfigError(problems);
  return rigFromYaml(YAML::Load(rig.yaml), ".", "set_parameters", overrides);
}

Config tunedValues(const Rig& rig) {
  Config config;
  dynamic_reconfigure::GroupState root;
  root.name = "Default";
  root.state = true;
  config.groups.push_back(root);
  std::map<std::string, int> ids;
  for (const TunedParameter& parameter : tunedParameters(rig)) {
    if (!parameter.group.empty() && ids.emplace(parameter.group, ids.size() + 1).second) {
      dynamic_reconfigure::GroupState group = root;
      group.name = parameter.group;
      group.id = ids[parameter.group];
      config.groups.push_back(group);
    }
    if (parameter.type == "str") {
      dynamic_reconfigure::StrParameter value;
      value.name = parameter.name;
      value.value = parameter.text(rig);
      config.strs.push_back(value);
    } else if (parameter.type == "int") {
      dynamic_reconfigure::IntParameter value;
      value.name = parameter.name;
      value.value = static_cast<int>(std::lround(parameter.number(rig)));
      config.ints.push_back(value);
    } else {
      dynamic_reconfigure::DoubleParameter value;
      value.name = parameter.name;
      value.value = parameter.number(rig);
      config.doubles.push_back(value);
    }
  }
  return config;
}

namespace {

/// The choices, as dynamic_reconfigure's Python side writes and reads them.
std::string enumText(const TunedParameter& parameter) {
  if (parameter.choices.empty()) return {};
  std::ostringstream text;
  text << "{'enum': [";
  for (std::size_t i = 0; i < parameter.choices.size(); ++i) {
    const std::string& choice = parameter.choices[i];
    text << (i ? ", " : "") << "{'name': '" << choice << "', 'type': 'str', 'value': '" << choice
         << "', 'description': '" << choice
         << "', 'srcline': 0, 'srcfile': '', 'cconsttype': 'const char * const', 'ctype': "
            "'std::string'}";
  }
  text << "], 'enum_description': '" << parameter.description << "'}";
  return text.str();
}

}  // namespace

ConfigDescription tunedDescription(const Rig& rig) {
  ConfigDescription description;
  description.dflt = description.min = description.max = tunedValues(rig);
  dynamic_reconfigure::Group root;
  root.name = "Default";
  description.groups.push_back(root);
  for (const TunedParameter& parameter : tunedParameters(rig)) {
    if (!parameter.group.empty() && description.groups.back().name != parameter.group) {
      dynamic_reconfigure::Group group;
      group.name = parameter.group;
      group.id = static_cast<int>(description.groups.size());
      description.groups.push_back(group);
    }
    dynamic_reconfigure::ParamDescription shown;
    shown.name = parameter.name;
    shown.type = parameter.type;
    shown.description = parameter.description;
    shown.edit_method = enumText(parameter);
    description.groups.back().parameters.push_back(shown);
    for (auto& value : description.min.doubles) {
      if (value.name == parameter.name) value.value = parameter.least;
    }
    for (auto& value : description.max.doubles) {
      if (value.name == parameter.name) value.value = parameter.most;
    }
    for (auto& value : description.min.ints) {
      if (value.name == parameter.name) value.value = static_cast<int>(parameter.least);
    }
    for (auto& value : description.max.ints) {
      if (value.name == parameter.name) value.value = static_cast<int>(parameter.most);
    }
  }
  for (auto* bounds : {&description.min, &description.max}) {
    for (auto& value : bounds->strs) value.value.clear();
  }
  return description;
}

TuningServer::TuningServer(const ros::NodeHandle& node, const Rig& rig,
                           std::function<void(const Rig&)> changed,
                           std::function<void(const std::string&)> refused)
    : node_(node),
      rig_(rig),
      original_(rig),
      changed_(std::move(changed)),
      refused_(std::move(refused)),
      file_(node.param<std::string>("tuned_rig_file", defaultFile(rig))) {
  descriptions_ = node_.advertise<ConfigDescription>("parameter_descriptions", 1, true);
  updates_ = node_.advertise<Config>("parameter_updates", 1, true);
  descriptions_.publish(tunedDescription(rig_));
  updates_.publish(tunedValues(rig_));
  set_ = node_.advertiseService("set_parameters", &TuningServer::set, this);
  save_ = node_.advertiseService("save_rig", &TuningServer::save, this);
}

bool TuningServer::set(dynamic_reconfigure::Reconfigure::Request& request,
                       dynamic_reconfigure::Reconfigure::Response& response) {
  try {
    const Rig next = retuned(rig_, request.config);
    changed_(next);
    rig_ = next;
  } catch (const std::exception& problem) {
    refused_(problem.what());
  }
  // The values in force: a client sees by them what was refused.
  response.config = tunedValues(rig_);
  updates_.publish(response.config);
  return true;
}

bool TuningServer::save(std_srvs::Trigger::Request& /*request*/,
                        std_srvs::Trigger::Response& response) {
  try {
    writeWhole(file_, configurationText(rig_));
    response.success = true;
    response.message = file_;
  } catch (const std::exception& problem) {
    response.message = problem.what();
  }
  return true;
}

}  // namespace semantic_lidar_fusion
