// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include <algorithm>

#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/common/label_set.h"
#include "semantic_lidar_fusion/common/yaml_reader.h"

namespace semantic_lidar_fusion {
namespace {

LabelSet parse(const std::string& text) {
  return LabelSet::fromYaml(parseYaml(text, "set.yaml"), "set.yaml");
}

/// what() of the ConfigError that `text` causes.
std::string problemsOf(const std::string& text) {
  try {
    parse(text);
  } catch (const ConfigError& error) {
    return error.what();
  }
  return "(no error)";
}

const char* const kGood = R"(
classes:
  - {name: road, color: [1, 2, 3]}
  - {id: 1, name: car, color: [255, 0, 0], dynamic: true}
  - {name: bike, color: [0, 0, 0], dynamic: true}
  - {name: sky, color: [9, 9, 9]}
evaluation:
  discard: [sky]
  merge: {vehicle: [car, bike]}
)";

TEST(LabelSetTest, ReadsNamesColoursAndEvaluation) {
  const LabelSet set = parse(kGood);
  ASSERT_EQ(set.size(), 4);
  EXPECT_EQ(set[0].name, "road");
  EXPECT_EQ(set[1].color_rgb, (std::array<std::uint8_t, 3>{255, 0, 0}));
  EXPECT_FALSE(set[0].dynamic);
  EXPECT_TRUE(set[1].dynamic);
  EXPECT_EQ(set.idOf("sky"), 3);
  EXPECT_FALSE(set.idOf("tree"));
  EXPECT_EQ(set.discarded(), (std::vector<int>{3}));
  ASSERT_EQ(set.merged().size(), 1u);
  EXPECT_EQ(set.merged()[0].name, "vehicle");
  EXPECT_EQ(set.merged()[0].members, (std::vector<int>{1, 2}));
}

TEST(LabelSetTest, JsonIsExactAndReadsAsYaml) {
  const LabelSet set = parse(kGood);
  EXPECT_EQ(set.toJson(),
            "{\"classes\": ["
            "{\"id\": 0, \"name\": \"road\", \"color\": [1, 2, 3], \"dynamic\": false}, "
            "{\"id\": 1, \"name\": \"car\", \"color\": [255, 0, 0], \"dynamic\": true}, "
            "{\"id\": 2, \"name\": \"bike\", \"color\": [0, 0, 0], \"dynamic\": true}, "
            "{\"id\": 3, \"name\": \"sky\", \"color\": [9, 9, 9], \"dynamic\": false}], "
            "\"discard\": [\"sky\"], \"merge\": {\"vehicle\": [\"car\", \"bike\"]}}");
  const YAML::Node read = YAML::Load(set.toJson());
  EXPECT_EQ(read["merge"]["vehicle"][1].as<std::string>(), "bike");
  EXPECT_EQ(LabelSet().toJson(), "{\"classes\": [], \"discard\": [], \"merge\": {}}");
}

TEST(LabelSetTest, ReportsEveryProblemAtOnce) {
  const std::string problems = problemsOf(R"(
classes:
  - {name: Road, color: [1, 2, 3]}
  - {id: 2, name: car, color: [256, 0, 0]}
  - {name: car, color: [0, 0], dynamic: perhaps}
  - {name: tree, colour: [0, 0, 0]}
  - just a word
evaluation:
  discard: [ski, car]
  merge: {car: [tree], empty: [], 'Big Name': [car]}
  discrad: []
)");
  for (const char* expected :
       {"set.yaml: classes[0].name = Road: must be 1 to 64 characters of a-z, 0-9 and _",
        "set.yaml: classes[1].id = 2: must be the position in the list, 1",
        "set.yaml: classes[1].color[0] = 256: must be a number from 0 to 255",
        "set.yaml: classes[2].color = (a list of 2): must be [red, green, blue]",
        "set.yaml: classes[2].dynamic = perhaps: must be true or false",
        "set.yaml: classes[2].name = car: two classes have this name",
        "set.yaml: classes[3].colour = (a list of 3): unknown key; did you mean 'color'?",
        "set.yaml: classes[3].color = (missing): must be [red, green, blue]",
        "set.yaml: classes[4] = just a word: must be a map",
        "set.yaml: evaluation.discard = ski: must be a class of the set",
        "set.yaml: evaluation.merge.car = (a list of 1): must hold the class of the same name",
        "set.yaml: evaluation.merge.empty = (a list of 0): must name at least one class",
        "set.yaml: evaluation.merge.Big Name = car: a class may be discarded or merged once only",
        "set.yaml: evaluation.merge.Big Name = (a list of 1): its name must be",
        "set.yaml: evaluation.discrad = (a list of 0): unknown key; did you mean 'discard'?"}) {
    EXPECT_NE(problems.find(expected), std::string::npos) << expected << "\nin\n" << problems;
  }
}

TEST(LabelSetTest, RefusesEmptyAndOversizedSets) {
  EXPECT_NE(problemsOf("classes: []").find("list of 1 to 255"), std::string::npos);
  EXPECT_NE(problemsOf("").find("classes = (missing)"), std::string::npos);
  EXPECT_NE(problemsOf("classes: {a: 1}").find("(a map of 1)"), std::string::npos);
  std::string text = "classes:\n";
  const auto append = [&](int id) {
    text += "  - {name: c" + std::to_string(id) + ", color: [0, 0, 0]}\n";
  };
  for (int id = 0; id < LabelSet::kMaxClasses; ++id) append(id);
  EXPECT_EQ(parse(text).size(), 255);
  append(255);
  EXPECT_NE(problemsOf(text).find("(a list of 256)"), std::string::npos);
}

struct ShippedSet {
  const char* file;
  int classes, discarded;
};

TEST(LabelSetTest, ShippedSetsLoad) {
  for (const ShippedSet& shipped :
       {ShippedSet{"usyd12", 12, 2}, ShippedSet{"camvid12", 12, 2}, ShippedSet{"cityscapes", 19, 1},
        ShippedSet{"rellis", 20, 2}, ShippedSet{"semantickitti", 20, 1}}) {
    const LabelSet set = LabelSet::fromFile(std::string(SLF_SOURCE_DIR) + "/config/classes_" +
                                            shipped.file + ".yaml");
    EXPECT_EQ(set.size(), shipped.classes) << shipped.file;
    EXPECT_EQ(static_cast<int>(set.discarded().size()), shipped.discarded) << shipped.file;
  }
}

TEST(LabelSetTest, UsydSetHasTheSevenFinalClassesOfThePaper) {
  const LabelSet set =
      LabelSet::fromFile(std::string(SLF_SOURCE_DIR) + "/config/classes_usyd12.yaml");
  std::vector<bool> separate(static_cast<std::size_t>(set.size()), true);
  for (const int id : set.discarded()) separate[static_cast<std::size_t>(id)] = false;
  for (const MergedClass& merged : set.merged()) {
    for (const int id : merged.members) separate[static_cast<std::size_t>(id)] = false;
  }
  EXPECT_EQ(std::count(separate.begin(), separate.end(), true) +
                static_cast<std::ptrdiff_t>(set.merged().size()),
            7);
}

}  // namespace
}  // namespace semantic_lidar_fusion
