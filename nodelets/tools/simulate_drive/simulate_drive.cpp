// SPDX-License-Identifier: MIT
/// simulate_drive: a drive of known truth as a bag. See kUsage.
#include <cmath>
#include <memory>
#include <string>
#include <vector>

#include "tools/common/command_line.h"
#include "tools/simulate_drive/drive_simulation.h"
#include "tools/simulate_drive/rig.h"

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
  --lens FILE          all cameras look through this lens, a file that the rig's cameras[].lens
                       reads; images have its resolution. Name it in the rig, too
  --lens-camera NAME   the entry of a file of several cameras
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

void addVehicleOptions(OptionReader* reader, SimulationOptions* options) {
  reader->number("--duration", 0.2, 300.0, &options->duration_s);
  reader->number("--speed", 5.0, 15.0, &options->speed_mps);
  reader->wholeNumber("--seed", 0.0, 1e15, &options->seed);
  reader->number("--camera-drop", -1.0, 1.2, &options->camera_drop_m);
  reader->number("--lidar-offset", -1.0, 1.2, &options->camera_drop_m);
  reader->number("--image-rate", 1.0, 100.0, &options->image_rate_hz);
}

/// How large the images are, and the lens.
struct OpticsChoice {
  double scale = NAN;  ///< not given
  std::string lens_file, lens_camera;

  void addTo(OptionReader* reader) {
    reader->number("--scale", 0.1, 1.0, &scale);
    reader->value("--width", [this](const std::string& width) {
      scale = wholeNumberOf("--width", width, 192.0, kFullWidth) / kFullWidth;
    });
    reader->text("--lens", &lens_file);
    reader->text("--lens-camera", &lens_camera);
  }

  Optics optics() const {
    Optics result;
    if (!std::isnan(scale)) result.scale = scale;
    if (lens_file.empty()) {
      if (!lens_camera.empty()) throw UsageError("--lens-camera needs --lens FILE");
      return result;
    }
    if (!std::isnan(scale)) {
      throw UsageError("--scale and --width do not go with --lens, whose file gives the size");
    }
    result.lens = std::make_shared<const LensCalibration>(loadLens(lens_file, lens_camera));
    return result;
  }
};

void addShutterOptions(OptionReader* reader, Shutter* shutter) {
  reader->number("--readout", 0.0, 0.1, &shutter->readout_s);
  reader->choice<ReadoutWay>("--shutter-direction",
                             {{"down", ReadoutWay::kDown},
                              {"up", ReadoutWay::kUp},
                              {"right", ReadoutWay::kRight},
                              {"left", ReadoutWay::kLeft}},
                             &shutter->way);
  reader->choice<double>("--stamp-row", {{"first", 0.0}, {"middle", 0.5}, {"last", 1.0}},
                         &shutter->stamp_at);
}

void addErrorOptions(OptionReader* reader, ErrorSizes* errors) {
  reader->numbers("--extrinsic-error", {5.0, 0.5}, {&errors->rotation_deg, &errors->translation_m});
  reader->numbers("--intrinsic-error", {0.05, 50.0}, {&errors->focal_share, &errors->centre_px});
  reader->number("--stamp-jitter", 0.0, 0.02, &errors->stamp_s);
  reader->numbers("--odometry-error", {5.0, 60.0, 100.0},
                  {&errors->velocity_mps, &errors->rate_dps, &errors->correlation_s});
}

SimulationOptions parseOptions(const std::vector<std::string>& arguments) {
  SimulationOptions options;
  bool standing = false, exact = false;
  OptionReader reader(&options);
  reader.text("--out", &options.output);
  addVehicleOptions(&reader, &options);
  OpticsChoice optics;
  optics.addTo(&reader);
  reader.choice<bool>("--images", {{"all", true}, {"selected", false}}, &options.all_images);
  reader.choice<ImageChoice>("--image-choice",
                             {{"closest_to_reference", ImageChoice::kClosestToReference},
                              {"closest_to_sweep", ImageChoice::kClosestToSweep}},
                             &options.image_choice);
  addShutterOptions(&reader, &options.shutter);
  addErrorOptions(&reader, &options.errors);
  reader.flag("--raw", &options.raw_images);
  reader.flag("--static", &standing);
  reader.flag("--perfect-network", &options.perfect_network);
  reader.flag("--exact", &exact);
  reader.wholeNumber("--threads", 1.0, 64.0, &options.threads);
  reader.text("--pictures", &options.pictures);
  const std::vector<std::string> others = reader.read(arguments);
  if (options.help || options.version) return options;
  if (!others.empty()) throw UsageError("unknown argument " + others[0]);
  if (options.output.empty()) throw UsageError("--out BAG is missing");
  if (!(options.errors.correlation_s > 0.0)) {
    throw UsageError("--odometry-error: the correlation time must be above 0");
  }
  options.optics = optics.optics();
  options.moving = !standing;
  if (exact) {
    options.perfect_network = options.exact_odometry = true;
    options.range_noise = false;
  }
  return options;
}

void simulate(const SimulationOptions& options) { simulateDrive(options, endIfInterrupted); }

}  // namespace
}  // namespace simulator
}  // namespace semantic_lidar_fusion

int main(int argc, char** argv) {
  using namespace semantic_lidar_fusion;
  return runTool("simulate_drive", simulator::kUsage, simulator::parseOptions, simulator::simulate,
                 argc, argv);
}
