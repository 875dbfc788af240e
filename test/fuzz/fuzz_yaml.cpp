// SPDX-License-Identifier: MIT
// Rig files, class sets and overrides as texts. What loads can be used: nothing that a rig's check
// lets through is refused later.
#include <filesystem>
#include <fstream>
#include <sstream>

#include "edge/lidar_decoder.h"
#include "fuzz_target.h"
#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/common/yaml_reader.h"
#include "semantic_lidar_fusion/config/rig.h"
#include "semantic_lidar_fusion/fusion/camera_superpixels.h"
#include "semantic_lidar_fusion/fusion/scan_pipeline.h"
#include "semantic_lidar_fusion/sync/scan_selector.h"

namespace semantic_lidar_fusion {
namespace fuzz {
namespace {

enum Kind : unsigned { kRig, kClassSet, kOverrides, kKinds };

const char* const kClassSetText =
    "classes: {classes: [{name: road, color: [1, 2, 3]}, {name: car, color: [4, 5, 6], "
    "dynamic: true}], evaluation: {discard: [car]}}\n";

Bytes textSeed(unsigned kind, const std::string& text) {
  return Writer().byte(kind).text(text).bytes();
}

std::vector<Bytes> seeds() {
  std::vector<Bytes> all{Bytes{}};
  const std::string cameras = "cameras: [{name: front}, {name: left, input: labels}]\n";
  all.push_back(textSeed(kRig, kClassSetText + cameras));
  all.push_back(textSeed(kRig, kClassSetText + cameras +
                                   "lidar: {input: points, model: VLP32C, time_field: t, "
                                   "time_unit: ns, time_reference: scan_end, min_range_m: 1, "
                                   "max_range_m: 100, time_offset: -0.015}\n"
                                   "occlusion: {mode: paper, vertical_step_deg: 2}\n"
                                   "odometry: {source: topic, on_missing: extrapolate}\n"
                                   "reference: {choose: scan_middle, timeout: 0.5}\n"
                                   "overlap: product\nimage_choice: closest_to_sweep\n"));
  all.push_back(textSeed(kOverrides,
                         "cameras.front.max_theta_deg=50\nocclusion.mode=off\n"
                         "superpixels={count: 20, compactness: 5, iterations: 3}\n"
                         "uncertainty.temperature=1.5\ncameras.left.mask="));
  for (const auto& entry : std::filesystem::directory_iterator(SLF_SOURCE_DIR "/config")) {
    if (entry.path().extension() != ".yaml") continue;
    std::ifstream file(entry.path());
    std::stringstream text;
    text << file.rdbuf();
    const bool is_class_set = entry.path().filename().string().rfind("classes_", 0) == 0;
    all.push_back(textSeed(is_class_set ? kClassSet : kRig, text.str()));
  }
  std::sort(all.begin(), all.end());  // folders have no order
  return all;
}

/// Everything a nodelet makes of a rig when it starts.
void use(const Rig& rig) {
  ScanSelector selector(rig.selectorConfig());
  LidarDecoder lidar(rig.lidar, [](const std::string&, std::uint64_t) {});
  if (rig.classes.size() > 0) SemanticProjector projector(fusionConfig(rig));
  const auto map = CameraSuperpixels(rig.superpixels).mapSize({1920, 1208});
  expect(!map || (map->width >= 1 && map->height >= 1), "a superpixel map has pixels");
  parseYaml(rig.classes.toJson(), "class_info");
}

void run(const std::uint8_t* data, std::size_t size) {
  Reader reader(data, size);
  const unsigned kind = reader.choice(kKinds);
  const std::string text = reader.text(reader.left());
  std::optional<Rig> rig;
  try {
    switch (kind) {
      case kRig:
        rig = rigFromYaml(parseYaml(text, "input"), SLF_SOURCE_DIR "/config", "input");
        break;
      case kClassSet:
        LabelSet::fromYaml(parseYaml(text, "input"), "input").toJson();
        break;
      default: {
        std::vector<std::string> overrides;
        std::istringstream lines(text);
        for (std::string line; std::getline(lines, line);) overrides.push_back(line);
        const std::string base = std::string(kClassSetText) + "cameras: [{name: front}]\n";
        rig = rigFromYaml(parseYaml(base, "input"), "/nowhere", "input", overrides);
      }
    }
  } catch (const ConfigError& error) {
    expect(!error.problems().empty(), "a refusal has a reason");
    for (const std::string& problem : error.problems()) {
      expect(!problem.empty() && problem.find('\n') == std::string::npos, "a problem is one line");
    }
    return;
  }
  if (rig) use(*rig);
}

const char* const kWords[] = {"cameras:", "lidar: {", "name: ", ": ",   "{",    "}",    "[",
                              "]",        "- ",       "&a ",    "*a",   "<<: ", ".nan", "1e999",
                              "-1",       "~",        "!!int ", "\n  ", "true", "|",    "0x7f",
                              "\t",       "#",        "'",      "\"",   "off",  nullptr};
const Registration kRegistered({"yaml", seeds, run, kWords});

}  // namespace
}  // namespace fuzz
}  // namespace semantic_lidar_fusion
