// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/common/yaml_reader.h"

namespace semantic_lidar_fusion {
namespace {

std::string problemOf(const std::string& text) {
  try {
    parseYaml(text, "rig.yaml");
  } catch (const ConfigError& error) {
    return error.what();
  }
  return "(no error)";
}

TEST(ParseYamlTest, NamesLineAndColumnOfASyntaxError) {
  const std::string problem = problemOf("a: 1\nb: c: d\n");
  EXPECT_EQ(problem.find("rig.yaml:2:5: is not YAML"), 0u) << problem;
}

TEST(ParseYamlTest, EmptyTextsAreEmptyMaps) {
  for (const char* text : {"", "\n\n", "# only a comment\n", "---\n", "%", "~"}) {
    const YAML::Node root = parseYaml(text, "rig.yaml");
    EXPECT_TRUE(root.IsMap()) << text;
    EXPECT_EQ(root.size(), 0u) << text;
  }
}

TEST(ParseYamlTest, RefusesWhatCouldExhaustStackOrMemory) {
  EXPECT_NE(problemOf(std::string(100000, '[')).find("nests"), std::string::npos);
  EXPECT_NE(problemOf(std::string(100000, '{')).find("nests"), std::string::npos);
  std::string dashes, steps;
  for (int i = 0; i < 100000; ++i) dashes += "- ";
  for (int i = 0; i < 400; ++i) steps += std::string(i, ' ') + "a:\n";
  EXPECT_NE(problemOf(dashes).find("nests"), std::string::npos);
  EXPECT_NE(problemOf(steps).find("nests"), std::string::npos);
  EXPECT_NE(problemOf("a: &a [*a]").find("alias refers to itself"), std::string::npos);
  EXPECT_NE(problemOf("a: &a {b: {c: *a}}").find("alias refers to itself"), std::string::npos);
  std::string laughs = "a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n";
  for (int i = 1; i < 12; ++i) {
    const std::string before = "*a" + std::to_string(i - 1);
    laughs += "a" + std::to_string(i) + ": &a" + std::to_string(i) + " [" + before;
    for (int k = 0; k < 9; ++k) laughs += ", " + before;
    laughs += "]\n";
  }
  EXPECT_NE(problemOf(laughs).find("more than"), std::string::npos);
  EXPECT_NE(problemOf(std::string((1 << 20) + 1, ' ')).find("longer"), std::string::npos);
  EXPECT_NE(problemOf("a: 1\n---\nb: 2\n").find("one YAML document"), std::string::npos);
  EXPECT_NE(problemOf(",%%").find("one YAML document"), std::string::npos);
}

/// Each text is one that a version of yaml-cpp never ends on, if nothing is done.
TEST(ParseYamlTest, EndsOnEveryText) {
  for (const char* text : {",", "{a:]", "{a:", "[a:]", "[a:", "[a:\x04 b]", "b: {c: d, e:] f}\n"}) {
    try {
      parseYaml(text, "rig.yaml");
    } catch (const ConfigError& error) {
      EXPECT_NE(std::string(error.what()).find("rig.yaml"), std::string::npos) << text;
    }
  }
  EXPECT_TRUE(parseYaml("a:", "rig.yaml")["a"].IsNull());
}

TEST(ParseYamlTest, AliasesBecomeCopies) {
  YAML::Node root = parseYaml("a: &a {x: 1}\nb: *a\n", "rig.yaml");
  root["b"]["x"] = 2;
  EXPECT_EQ(root["a"]["x"].as<int>(), 1);
}

TEST(ParseYamlFileTest, NamesAFileThatCannotBeRead) {
  for (const std::string path : {"/nonexistent/rig.yaml", "/tmp", ""}) {
    try {
      parseYamlFile(path);
      ADD_FAILURE() << path;
    } catch (const ConfigError& error) {
      EXPECT_EQ(std::string(error.what()), path + ": cannot be read; must be a readable file");
    }
  }
}

class YamlSectionTest : public testing::Test {
 protected:
  YamlSection section(const std::string& text) {
    return YamlSection(YAML::Load(text), "top", &problems_);
  }
  std::vector<std::string> problems_;
};

TEST_F(YamlSectionTest, ReadsGoodValuesAndLeavesDefaults) {
  YamlSection top = section("{n: -1.5e1, i: 7, b: true, t: some text, c: two, l: [1, 2.5]}");
  double n = 0, absent = 42;
  int i = 0, c = 0;
  bool b = false;
  std::string t;
  std::vector<double> l;
  top.number("n", &n);
  top.number("absent", &absent);
  top.integer("i", &i, 0, 10);
  top.boolean("b", &b);
  top.text("t", &t);
  top.choice<int>("c", &c, {{"one", 1}, {"two", 2}});
  top.numbers("l", &l);
  top.finish();
  EXPECT_TRUE(problems_.empty()) << problems_[0];
  EXPECT_EQ(n, -15);
  EXPECT_EQ(absent, 42);
  EXPECT_EQ(i, 7);
  EXPECT_TRUE(b);
  EXPECT_EQ(t, "some text");
  EXPECT_EQ(c, 2);
  EXPECT_EQ(l, (std::vector<double>{1, 2.5}));
}

TEST_F(YamlSectionTest, RefusesWhatIsNoNumber) {
  for (const char* value : {".nan", ".inf", "-.inf", "1e999", "0x10", "1_000", "five", "5 m", "''",
                            "[1]", "{a: 1}", "", "true", "1,5"}) {
    problems_.clear();
    YamlSection top = section(std::string("k: ") + value);
    double number = 42;
    top.number("k", &number);
    EXPECT_EQ(number, 42) << value;
    ASSERT_EQ(problems_.size(), 1u) << value;
    EXPECT_NE(problems_[0].find("top.k = "), std::string::npos) << problems_[0];
    EXPECT_NE(problems_[0].find("must be a finite number"), std::string::npos) << problems_[0];
  }
  for (const char* value : {"99999999999999999999", "-1", "2.5", "11", ".nan"}) {
    problems_.clear();
    YamlSection top = section(std::string("k: ") + value);
    int whole = 42;
    top.integer("k", &whole, 0, 10);
    EXPECT_EQ(whole, 42) << value;
    ASSERT_EQ(problems_.size(), 1u) << value;
    EXPECT_NE(problems_[0].find("must be a whole number from 0 to 10"), std::string::npos);
  }
}

TEST_F(YamlSectionTest, SaysTheRangeItWants) {
  YamlSection top = section("{a: 0, b: -1, c: 7}");
  double value = 0;
  top.number("a", &value, {0, 5, true});
  top.number("b", &value, {0});
  top.number("c", &value, {-5, 5});
  ASSERT_EQ(problems_.size(), 3u);
  EXPECT_EQ(problems_[0], "top.a = 0: must be a number above 0, at most 5");
  EXPECT_EQ(problems_[1], "top.b = -1: must be a number of at least 0");
  EXPECT_EQ(problems_[2], "top.c = 7: must be a number from -5 to 5");
}

TEST_F(YamlSectionTest, NamesUnknownDuplicateAndOddKeys) {
  YamlSection top = section("{cuont: 1, count: 1, count: 2, zzzzzz: 3, ? [a, b] : 4}");
  int count = 0;
  top.integer("count", &count, 0, 10);
  top.finish();
  ASSERT_EQ(problems_.size(), 4u);
  EXPECT_EQ(problems_[0], "top.cuont = 1: unknown key; did you mean 'count'?");
  EXPECT_EQ(problems_[1], "top.count = 2: the key is given twice");
  EXPECT_EQ(problems_[2], "top.zzzzzz = 3: unknown key; known here: count");
  EXPECT_EQ(problems_[3], "top.(a list of 2): a key must be a text");
}

TEST_F(YamlSectionTest, KeepsMessagesOnOneLine) {
  YamlSection top = section("k: \"a\\nb\"");
  double value = 0;
  top.number("k", &value);
  ASSERT_EQ(problems_.size(), 1u);
  EXPECT_EQ(problems_[0], "top.k = a?b: must be a finite number");
}

TEST(NearestNameTest, FindsMisspellingsOnly) {
  const std::vector<std::string> names = {"timeout", "time_offset", "mask"};
  EXPECT_EQ(nearestName("timeuot", names), "timeout");
  EXPECT_EQ(nearestName("Time_Offset", names), "time_offset");
  EXPECT_EQ(nearestName("masks", names), "mask");
  EXPECT_EQ(nearestName("superpixels", names), "");
  EXPECT_EQ(nearestName("", names), "");
}

}  // namespace
}  // namespace semantic_lidar_fusion
