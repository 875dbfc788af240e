// SPDX-License-Identifier: MIT
/// simulate_drive: a drive of known truth as a bag. See kUsage.
#include <console_bridge/console.h>

#include <cmath>
#include <csignal>
#include <cstdio>
#include <cstdlib>
#include <exception>
#include <limits>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "edge/version.h"
#include "tools/simulate_drive/drive_simulation.h"

namespace semantic_lidar_fusion {
namespace simulator {
namespace {

const char kUsage[] = R"(usage: simulate_drive --out BAG [options]

Drives five fisheye cameras (30 Hz, JPEG), a VLP-16 (10 Hz, packets) and odometry (100 Hz) through
a made-up street, casting every laser shot and every pixel at its own time, and writes the bag with
the truth beside it. config/demo.yaml is its rig. The same options give the same bytes.

  /points_truth            x y z as measured, label, visible (bit i: the i-th camera sees the
                           point), surface (object), edge_px (distance to the nearest class edge,
                           the least of all cameras that see it; -1: none), edge_px_<camera>,
                           catchable (bit i: hidden from camera i by something that the lidar has
                           measured within one ring and one azimuth step of the line of sight),
                           silhouette (bit i: camera i sees the point, as near to something before
                           it);
                           the decoder's points in their order, stamped with the first one's time
  /gmsl/*/labels_truth     class ids of the images that scans use
  /truth/poses             where the vehicle really is
  /truth/errors            with any of the options --readout and --*-error, --stamp-jitter: what was
                           drawn by the seed, as JSON (docs/simulator.md)

Scores imitate ENet at a stride of 8 full-size pixels, for the images that scans use: its borders,
confusions, thin things and overconfidence, as measured on labelled CamVid photos by
test/benchmark/network_errors.py. Compare: network_errors.py --bag BAG.

options:
  --out BAG            the bag to write (required)
  --duration S         0.2 to 300 (default 2)
  --speed M/S          5 to 15: on the straight; the vehicle brakes and turns too (default 10)
  --seed N             another street, other noise (default 1)
  --scale F            image size, 0.1 to 1 times 1920 x 1208 (default 0.5)
  --width PIXELS       the same, by the images' width
  --camera-drop M      cameras below the lidar, -1 to 1.2 (default 0.2); also --lidar-offset
  --image-rate HZ      1 to 100 (default 30)
  --images all|selected  also render images that no scan uses (default selected)
  --image-choice closest_to_reference|closest_to_sweep
                       as in the rig file: which images a scan uses, and truth is told for
                       (default closest_to_reference)
  --readout S          rolling shutter: time from the first line to the one after the last, 0 to 0.1
                       (default 0, all at one time)
  --shutter-direction down|up|right|left  where its readout goes in the image (default down)
  --stamp-row first|middle|last  the line that is exposed at the image's stamp (default first)
  --raw                images as sensor_msgs/Image, not JPEG (set transport: raw in the rig)
  --extrinsic-error DEG,M  the cameras stand otherwise than tf says, by standard deviations around
                       and along each axis
  --intrinsic-error SHARE,PX  their lenses are others than camera_info says: focal length, centre
                       (pixels of full-size images)
  --stamp-jitter S     images are exposed earlier or later than their stamps, 0 to 0.02
  --odometry-error M/S,DEG/S,S  velocity and rate errors along and around each axis of the vehicle,
                       and their correlation time, in place of those of wheels and gyroscope
  --static             nobody else moves
  --perfect-network    scores of the true class, at the images' resolution
  --exact              that, exact odometry and no range noise
  --threads N          1 to 64 (default 2); no effect on the result
  --pictures DIR       also write PNG files of the first pictures and labels there
  --force              replace BAG if it exists
  --quiet              no progress
  --version            print the version
  --help               this text

Exit codes: 0 done; 1 failed, and BAG is as before; 2 wrong command line.
)";

volatile std::sig_atomic_t caught_signal = 0;

void rememberSignal(int signal) { caught_signal = signal; }

/// A signal asked for the end; what was written is removed on the way out.
struct Interrupted {};

void endIfInterrupted() {
  if (caught_signal != 0) throw Interrupted();
}

class UsageError : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

double number(const std::string& name, const std::string& text, double least, double most) {
  char* end = nullptr;
  const double value = std::strtod(text.c_str(), &end);
  if (text.empty() || *end != '\0' || !(value >= least && value <= most)) {
    char range[80];
    std::snprintf(range, sizeof range, "%g to %g", least, most);
    throw UsageError(name + " is '" + text + "'; it must be a number from " + range);
  }
  return value;
}

double wholeNumber(const std::string& name, const std::string& text, double least, double most) {
  const double value = number(name, text, least, most);
  if (value != std::floor(value))
    throw UsageError(name + " is '" + text + "'; it must be a whole number");
  return value;
}

/// As many numbers as `most` has, between commas; each from 0 to its own of `most`.
std::vector<double> numbers(const std::string& name, const std::string& text,
                            const std::vector<double>& most) {
  std::vector<std::string> parts(1);
  for (const char c : text) {
    if (c == ',') {
      parts.emplace_back();
    } else {
      parts.back() += c;
    }
  }
  if (parts.size() != most.size()) {
    throw UsageError(name + " is '" + text + "'; it must be " + std::to_string(most.size()) +
                     " numbers with commas between them");
  }
  std::vector<double> values;
  for (std::size_t i = 0; i < most.size(); ++i) {
    values.push_back(number(name, parts[i], 0.0, most[i]));
  }
  return values;
}

template <typename Value>
Value choice(const std::string& name, const std::string& text,
             const std::vector<std::pair<std::string, Value>>& values) {
  std::string known;
  for (const auto& value : values) {
    if (value.first == text) return value.second;
    known += (known.empty() ? "" : ", ") + value.first;
  }
  throw UsageError(name + " is '" + text + "'; it must be one of " + known);
}

SimulationOptions parseOptions(const std::vector<std::string>& arguments) {
  SimulationOptions options;
  std::size_t i = 0;
  const auto value = [&]() -> const std::string& {
    if (i + 1 >= arguments.size()) throw UsageError(arguments[i] + " needs a value");
    return arguments[++i];
  };
  for (; i < arguments.size(); ++i) {
    const std::string name = arguments[i];
    if (name == "--out") {
      options.output = value();
    } else if (name == "--duration") {
      options.duration_s = number(name, value(), 0.2, 300.0);
    } else if (name == "--speed") {
      options.speed_mps = number(name, value(), 5.0, 15.0);
    } else if (name == "--seed") {
      options.seed = static_cast<std::uint64_t>(wholeNumber(name, value(), 0.0, 1e15));
    } else if (name == "--scale") {
      options.scale = number(name, value(), 0.1, 1.0);
    } else if (name == "--width") {
      options.scale = wholeNumber(name, value(), 192.0, 1920.0) / 1920.0;
    } else if (name == "--camera-drop" || name == "--lidar-offset") {
      options.camera_drop_m = number(name, value(), -1.0, 1.2);
    } else if (name == "--image-rate") {
      options.image_rate_hz = number(name, value(), 1.0, 100.0);
    } else if (name == "--images") {
      const std::string& which = value();
      if (which != "all" && which != "selected") {
        throw UsageError("--images is '" + which + "'; it must be all or selected");
      }
      options.all_images = which == "all";
    } else if (name == "--image-choice") {
      const std::string& choice = value();
      if (choice != "closest_to_reference" && choice != "closest_to_sweep") {
        throw UsageError("--image-choice is '" + choice +
                         "'; it must be closest_to_reference or closest_to_sweep");
      }
      options.image_choice = choice == "closest_to_sweep" ? ImageChoice::kClosestToSweep
                                                          : ImageChoice::kClosestToReference;
    } else if (name == "--readout") {
      options.shutter.readout_s = number(name, value(), 0.0, 0.1);
    } else if (name == "--shutter-direction") {
      options.shutter.way = choice<ReadoutWay>(name, value(),
                                               {{"down", ReadoutWay::kDown},
                                                {"up", ReadoutWay::kUp},
                                                {"right", ReadoutWay::kRight},
                                                {"left", ReadoutWay::kLeft}});
    } else if (name == "--stamp-row") {
      options.shutter.stamp_at =
          choice<double>(name, value(), {{"first", 0.0}, {"middle", 0.5}, {"last", 1.0}});
    } else if (name == "--extrinsic-error") {
      const auto sizes = numbers(name, value(), {5.0, 0.5});
      options.errors.rotation_deg = sizes[0];
      options.errors.translation_m = sizes[1];
    } else if (name == "--intrinsic-error") {
      const auto sizes = numbers(name, value(), {0.05, 50.0});
      options.errors.focal_share = sizes[0];
      options.errors.centre_px = sizes[1];
    } else if (name == "--stamp-jitter") {
      options.errors.stamp_s = number(name, value(), 0.0, 0.02);
    } else if (name == "--odometry-error") {
      const auto sizes = numbers(name, value(), {5.0, 60.0, 100.0});
      options.errors.velocity_mps = sizes[0];
      options.errors.rate_dps = sizes[1];
      options.errors.correlation_s = sizes[2];
      if (!(sizes[2] > 0.0)) throw UsageError(name + ": the correlation time must be above 0");
    } else if (name == "--raw") {
      options.raw_images = true;
    } else if (name == "--static") {
      options.moving = false;
    } else if (name == "--perfect-network") {
      options.perfect_network = true;
    } else if (name == "--exact") {
      options.perfect_network = options.exact_odometry = true;
      options.range_noise = false;
    } else if (name == "--threads") {
      options.threads = static_cast<int>(wholeNumber(name, value(), 1.0, 64.0));
    } else if (name == "--pictures") {
      options.pictures = value();
    } else if (name == "--force") {
      options.force = true;
    } else if (name == "--quiet") {
      options.quiet = true;
    } else if (name == "--version") {
      options.version = true;
      return options;
    } else if (name == "--help" || name == "-h") {
      options.help = true;
      return options;
    } else {
      throw UsageError("unknown argument " + name);
    }
  }
  if (options.output.empty()) throw UsageError("--out BAG is missing");
  return options;
}

int run(const std::vector<std::string>& arguments) {
  try {
    const SimulationOptions options = parseOptions(arguments);
    if (options.help) {
      std::fputs(kUsage, stdout);
      return 0;
    }
    if (options.version) {
      std::printf("simulate_drive %s\n", kVersion);
      return 0;
    }
    simulateDrive(options, endIfInterrupted);
    return 0;
  } catch (const UsageError& e) {
    std::fprintf(stderr, "simulate_drive: %s\nTry: simulate_drive --help\n", e.what());
    return 2;
  } catch (const Interrupted&) {
    std::fprintf(stderr, "simulate_drive: interrupted; nothing was written\n");
    return 128 + caught_signal;
  } catch (const std::exception& e) {
    std::fprintf(stderr, "simulate_drive: error: %s\n", e.what());
    return 1;
  }
}

}  // namespace
}  // namespace simulator
}  // namespace semantic_lidar_fusion

int main(int argc, char** argv) {
  // Libraries below report through exceptions too; their own lines would come twice.
  console_bridge::setLogLevel(console_bridge::CONSOLE_BRIDGE_LOG_NONE);
  struct sigaction action {};
  action.sa_handler = semantic_lidar_fusion::simulator::rememberSignal;
  ::sigaction(SIGINT, &action, nullptr);
  ::sigaction(SIGTERM, &action, nullptr);
  ::signal(SIGXFSZ, SIG_IGN);  // a file size limit is then an error of the write
  return semantic_lidar_fusion::simulator::run(std::vector<std::string>(argv + 1, argv + argc));
}
