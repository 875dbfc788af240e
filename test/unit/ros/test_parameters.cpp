// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>
#include <yaml-cpp/yaml.h>

#include <string>

#include "base/parameters.h"
#include "semantic_lidar_fusion/common/error.h"

namespace semantic_lidar_fusion {
namespace {

using XmlRpc::XmlRpcValue;

/// What rosparam makes of a YAML file: scalars by their look.
XmlRpcValue asParameter(const YAML::Node& node) {
  XmlRpcValue value;
  if (node.IsMap()) {
    value.begin();  // an empty struct is a struct too
    for (const auto& member : node) {
      value[member.first.as<std::string>()] = asParameter(member.second);
    }
  } else if (node.IsSequence()) {
    value.setSize(static_cast<int>(node.size()));
    for (int i = 0; i < value.size(); ++i) {
      value[i] = asParameter(node[static_cast<std::size_t>(i)]);
    }
  } else {
    const std::string text = node.as<std::string>();
    if (text == "true" || text == "false") return XmlRpcValue(text == "true");
    std::size_t end = 0;
    try {
      const double number = std::stod(text, &end);
      if (end == text.size()) {
        return text.find_first_of(".eE") == std::string::npos
                   ? XmlRpcValue(static_cast<int>(number))
                   : XmlRpcValue(number);
      }
    } catch (const std::exception&) {
    }
    return XmlRpcValue(text);
  }
  return value;
}

TEST(YamlTree, KeepsTypesAndDigits) {
  XmlRpcValue value;
  value["flag"] = true;
  value["count"] = -7;
  value["small"] = 0.1;
  value["exact"] = 1.0 / 3.0;
  value["text"] = std::string("A0");
  value["list"][0] = 1;
  value["list"][1] = std::string("x: y");
  value["inner"]["deep"] = 2.5e-9;
  const YAML::Node tree = yamlTree(value, "/rig");
  EXPECT_TRUE(tree["flag"].as<bool>());
  EXPECT_EQ(tree["count"].as<int>(), -7);
  EXPECT_EQ(tree["small"].as<double>(), 0.1);
  EXPECT_EQ(tree["exact"].as<double>(), 1.0 / 3.0);
  EXPECT_EQ(tree["text"].as<std::string>(), "A0");
  ASSERT_EQ(tree["list"].size(), 2u);
  EXPECT_EQ(tree["list"][1].as<std::string>(), "x: y");
  EXPECT_EQ(tree["inner"]["deep"].as<double>(), 2.5e-9);
}

TEST(YamlTree, RefusesWhatAFileCannotHold) {
  XmlRpcValue value;
  value["cameras"][0]["blob"] = XmlRpcValue(const_cast<char*>("abc"), 3);
  try {
    yamlTree(value, "/fusion/rig");
    FAIL() << "binary data was taken";
  } catch (const ConfigError& e) {
    EXPECT_NE(std::string(e.what()).find("/fusion/rig/cameras[0]/blob"), std::string::npos)
        << e.what();
  }
}

TEST(YamlTree, GivesTheSameRigAsTheFile) {
  const std::string folder = std::string(SLF_SOURCE_DIR) + "/config";
  const std::string path = folder + "/usyd.yaml";
  const Rig from_file = loadRig(path);
  const YAML::Node tree = yamlTree(asParameter(YAML::LoadFile(path)), "/rig");
  const Rig from_parameters = rigFromYaml(tree, folder, "parameter /rig");
  EXPECT_EQ(from_parameters.classes.toJson(), from_file.classes.toJson());
  ASSERT_EQ(from_parameters.cameras.size(), from_file.cameras.size());
  for (std::size_t i = 0; i < from_file.cameras.size(); ++i) {
    EXPECT_EQ(from_parameters.cameras[i].name, from_file.cameras[i].name);
    EXPECT_EQ(from_parameters.cameras[i].ns, from_file.cameras[i].ns);
    EXPECT_EQ(from_parameters.cameras[i].max_theta_deg, from_file.cameras[i].max_theta_deg);
  }
  EXPECT_EQ(from_parameters.lidar.topic, from_file.lidar.topic);
  EXPECT_EQ(from_parameters.odometry.topic, from_file.odometry.topic);
  EXPECT_EQ(from_parameters.occlusion.vertical_step_deg, from_file.occlusion.vertical_step_deg);
  EXPECT_EQ(from_parameters.superpixels.count, from_file.superpixels.count);
}

}  // namespace
}  // namespace semantic_lidar_fusion
