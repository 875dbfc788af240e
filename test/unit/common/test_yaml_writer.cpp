// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>
#include <yaml-cpp/yaml.h>

#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <random>
#include <string>
#include <vector>

#include "semantic_lidar_fusion/common/yaml_reader.h"
#include "semantic_lidar_fusion/common/yaml_writer.h"

namespace semantic_lidar_fusion {
namespace {

TEST(YamlTree, WritesBlocksInTheOrderOfThePuts) {
  YamlTree camera = YamlTree::map();
  camera.put("name", YamlTree::text("A0"));
  camera.put("timeout", YamlTree::number(0.2));
  YamlTree cameras = YamlTree::list();
  cameras.add(camera);
  YamlTree offsets = YamlTree::list();
  offsets.add(YamlTree::number(-0.5));
  offsets.add(YamlTree::integer(3));
  YamlTree root = YamlTree::map();
  root.put("mode", YamlTree::text("paper"));
  root.put("cameras", cameras);
  root.put("offsets", offsets);
  root.put("nothing", YamlTree::list());
  root.put("mode", YamlTree::text("off"));
  EXPECT_EQ(root.toYaml(),
            "mode: \"off\"\n"
            "cameras:\n"
            "  - name: A0\n"
            "    timeout: 0.2\n"
            "offsets: [-0.5, 3]\n"
            "nothing: []\n");
}

TEST(YamlTree, NumbersKeepTheirBitsAndLookLikeNumbersToEveryParser) {
  std::mt19937_64 random(7);
  std::vector<double> values = {0.0,  1.0, -3.0,  1e-5,
                                1e22, 0.1, 1e300, std::numeric_limits<double>::max()};
  for (int i = 0; i < 1000; ++i) {
    double value = 0;
    const std::uint64_t bits = random();
    static_assert(sizeof(value) == sizeof(bits), "");
    std::memcpy(&value, &bits, sizeof(value));
    if (std::isnormal(value)) values.push_back(value);
  }
  for (const double value : values) {
    const std::string text = YamlTree::number(value).toYaml();
    EXPECT_EQ(YAML::Load(text).as<double>(), value) << text;
    // YAML 1.1: [-+]?[0-9]+ \. [0-9]* ([eE][-+][0-9]+)?
    EXPECT_NE(text.find('.'), std::string::npos) << text;
  }
}

TEST(YamlTree, TextsComeBackAsTheyWere) {
  for (const std::string text : {"",
                                 "off",
                                 "Yes",
                                 "null",
                                 "~",
                                 "1e3",
                                 "0x10",
                                 "a: b",
                                 "# no",
                                 "- x",
                                 " blank ",
                                 "a\"b\\c",
                                 "line\nbreak\ttab",
                                 "\x01\x7f",
                                 "k\xc3\xb6ln",
                                 "/plain/topic_1",
                                 "{a}",
                                 "*x",
                                 "!y",
                                 "%"}) {
    YamlTree root = YamlTree::map();
    root.put("key", YamlTree::text(text));
    const YAML::Node node = YAML::Load(root.toYaml())["key"];
    ASSERT_TRUE(node.IsScalar()) << text;
    EXPECT_EQ(node.as<std::string>(), text) << root.toYaml();
  }
}

TEST(YamlSection, KeepsWhatEveryKeyCameTo) {
  const YAML::Node root = YAML::Load("{count: 3, inner: {on: false}}");
  std::vector<std::string> problems;
  YamlSection section(root, "", &problems);
  int count = 1;
  double ratio = 0.5;
  std::string name = "none";
  std::vector<double> numbers;
  section.integer("count", &count, 0, 9);
  section.number("ratio", &ratio);
  section.text("name", &name);
  section.numbers("numbers", &numbers);
  YamlSection inner = section.child("inner");
  bool on = true;
  inner.boolean("on", &on);
  inner.finish();
  section.finish();
  EXPECT_TRUE(problems.empty());
  EXPECT_EQ(section.resolved().toYaml(),
            "count: 3\nratio: 0.5\nname: none\nnumbers: []\ninner:\n  \"on\": false\n");
}

}  // namespace
}  // namespace semantic_lidar_fusion
