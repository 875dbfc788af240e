// SPDX-License-Identifier: MIT
#include "tools/fuse_bag/bag_fusion.h"

#include <yaml-cpp/yaml.h>

#include <algorithm>
#include <utility>

#include "semantic_lidar_fusion/common/error.h"

namespace semantic_lidar_fusion {
namespace {

/// How far ahead of a scan is read before it is decided, one after the other. The first holds what
/// drivers and networks take on a vehicle.
const std::optional<double> kAheadS[] = {0.5, 5.0, std::nullopt};
/// A decision is looked at again when so many times that is read; then at the end.
constexpr double kSecondLook = 10.0;
/// What a scan needs was recorded at most so long before it, mostly; else it is read again.
constexpr double kBehindS = 0.5;
/// Messages that are kept in memory until the scans that may need them are decided.
constexpr std::size_t kKeptBytes = 384u << 20;
/// With --start and --end: what is read around the scans that count.
constexpr double kBeforeS = 5.0, kAfterS = 10.0;

/// A scan would be decided otherwise with what was read after it.
struct Unsettled {};

ReadingWindow windowOf(const FuseBagOptions& options, bool all_ahead) {
  ReadingWindow window;
  window.start_s = options.start_s;
  window.end_s = options.end_s;
  window.before_s = kBeforeS;
  window.after_s = all_ahead ? ros::TIME_MAX.toSec() : kAfterS;
  window.kept_bytes = all_ahead ? 0 : kKeptBytes;
  return window;
}

/// Their files are made at once: what stands in the way is told before the bag is read.
std::deque<FusedOutput> madeOutputs(const FuseBagOptions& options,
                                    const std::vector<OutputOptions>& outputs,
                                    const std::vector<Rig>& rigs) {
  std::deque<FusedOutput> made;
  for (std::size_t i = 0; i < rigs.size(); ++i) made.emplace_back(options, outputs[i], rigs[i]);
  return made;
}

/// FNV-1a.
void addTo(std::uint64_t* hash, const void* data, std::size_t size) {
  const auto* bytes = static_cast<const std::uint8_t*>(data);
  for (std::size_t i = 0; i < size; ++i) *hash = (*hash ^ bytes[i]) * 0x100000001b3u;
}

}  // namespace

FusionRun::FusionRun(const FuseBagOptions& options, const std::vector<OutputOptions>& outputs,
                     const std::vector<Rig>& rigs, const BagInput& input,
                     std::optional<double> ahead_s)
    : options_(options),
      rig_(rigs.front()),
      input_(input),
      ahead_s_(ahead_s),
      watch_(rig_),
      poses_(tfPoseSourceConfig(rig_, 0)),
      outputs_(madeOutputs(options, outputs, rigs)),
      reader_(input, rig_, windowOf(options, !ahead_s), &poses_, &drops_, &watch_,
              [this](const rosbag::MessageInstance& message) { scans_->take(message); }),
      images_(rig_, reader_.index(), options.all),
      places_(rig_, reader_.index(), poses_, &drops_, &watch_),
      lidar_rows_(rig_),
      progress_("fusing", reader_.scanCount(), !options.quiet),
      most_under_way_(static_cast<std::size_t>(options.jobs) + 2) {
  const bool takes_truth =
      std::any_of(outputs.begin(), outputs.end(),
                  [](const OutputOptions& output) { return output.true_visibility; });
  if (takes_truth) truth_.emplace(input, toNs(rig_.lidar.time_offset_s));
  scans_ = std::make_unique<ScanSource>(rig_, reader_.index(), images_, &places_, &drops_, &watch_);
}

// --- The lines, from the end of a scan's way to its beginning

std::size_t FusionRun::fuseLine(const ScanTask& task) const {
  return 1 + task.scan.number % static_cast<std::size_t>(options_.jobs);
}

std::size_t FusionRun::imageLine(std::size_t camera) const {
  return 1 + static_cast<std::size_t>(options_.jobs) + images_.lineOf(camera);
}

std::size_t FusionRun::readLine() const {
  return 1 + static_cast<std::size_t>(options_.jobs) + images_.lineCount();
}

bool FusionRun::fuse(void (*checkpoint)()) {
  WorkLines lines(options_.jobs, readLine() + 1);
  lines_ = &lines;
  lines.add(readLine(), [this] { readOn(); });
  try {
    lines.wait(checkpoint);
  } catch (const Unsettled&) {
    return false;
  }
  reader_.finish();
  scans_->tellNotes();
  tellDoubts();
  if (options_.tf) {
    for (FusedOutput& output : outputs_) output.copyTransforms(reader_.index().transforms);
  }
  for (const FusedOutput& output : outputs_) {
    if (output.report().scansWritten() > 0) continue;
    const std::size_t count = scans_->taken();
    throw Error(input_.path() + ": none of its " + std::to_string(count) + " scan" +
                (count == 1 ? "" : "s") + " can be used");
  }
  for (FusedOutput& output : outputs_) output.commit();
  return true;
}

// --- Reading and deciding

bool FusionRun::isReady(const BagScan& scan) const {
  return has_ended_ ||
         (ahead_s_ && reader_.time().toSec() >= scan.message.getTime().toSec() + *ahead_s_);
}

/// Reads until a scan can start, starts it, and stands in line again.
void FusionRun::readOn() {
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    is_reading_ = under_way_.size() < most_under_way_;
    if (!is_reading_) return;  // writeScan wakes it
  }
  constexpr int kMostMessages = 64;  // then others may come first
  for (int i = 0; i < kMostMessages; ++i) {
    const BagScan* waiting = scans_->waiting();
    if (waiting != nullptr && isReady(*waiting)) {
      start(scans_->decide());
      waiting = scans_->waiting();
      reader_.release(waiting ? waiting->message.getTime() : reader_.time(), kBehindS);
      break;
    }
    if (has_ended_) {
      if (!std::all_of(decided_.begin(), decided_.end(),
                       [this](const Decided& decided) { return holds(decided); }) ||
          places_.haveChanged()) {
        throw Unsettled();
      }
      return;
    }
    has_ended_ = !reader_.readOne();
    lookAgain();
  }
  lines_->add(readLine(), [this] { readOn(); });
}

/// At decisions that were made a while ago, so that a bag of another order is noticed early.
void FusionRun::lookAgain() {
  if (!ahead_s_) return;
  const double until_s = reader_.time().toSec() - kSecondLook * *ahead_s_;
  for (; checked_ < decided_.size(); ++checked_) {
    if (decided_[checked_].scan.message.getTime().toSec() > until_s) return;
    if (!holds(decided_[checked_])) throw Unsettled();
  }
}

/// The times at which the camera_info in force is that of a scan's images.
std::vector<ros::Time> FusionRun::infoTimes(const BagScan& scan) const {
  std::vector<ros::Time> times(rig_.cameras.size(), scan.message.getTime());
  for (std::size_t c = 0; c < times.size(); ++c) {
    const ImagesByStamp& images = reader_.index().cameras[c].images;
    const auto image = scan.image_stamps[c] ? images.find(*scan.image_stamps[c]) : images.end();
    if (image != images.end()) times[c] = image->second.place.getTime();
  }
  return times;
}

/// A sum over all readings that have a part in the poses of a scan.
std::uint64_t FusionRun::posesAround(const BagScan& scan) {
  constexpr std::ptrdiff_t kBeside = 3;  // as many have a part in what a jump is
  StampNs from = std::min(scan.times.interval.first_ns, scan.reference_ns);
  StampNs to = std::max(scan.times.interval.last_ns, scan.reference_ns);
  for (std::size_t c = 0; c < scan.image_stamps.size(); ++c) {
    if (!scan.image_stamps[c]) continue;
    const StampNs time = images_.pipeline().imageTime(c, *scan.image_stamps[c]);
    from = std::min(from, time);
    to = std::max(to, time);
  }
  const auto& readings = poses_.odometry().readings();
  const auto earlier = [](const StampedPose& reading, StampNs t) { return reading.stamp < t; };
  auto begin = std::lower_bound(readings.begin(), readings.end(), from, earlier);
  auto end = std::lower_bound(begin, readings.end(), to, earlier);
  begin -= std::min(kBeside, begin - readings.begin());
  end += std::min<std::ptrdiff_t>(1, readings.end() - end);
  std::uint64_t sum = 0xcbf29ce484222325u;
  for (auto reading = begin; reading != end; ++reading) {
    addTo(&sum, &reading->stamp, sizeof(reading->stamp));
    addTo(&sum, reading->T_fixed_vehicle.data(), 16 * sizeof(double));
  }
  return sum;
}

std::ptrdiff_t FusionRun::camerasWithInfo() const {
  const auto& cameras = reader_.index().cameras;
  return std::count_if(cameras.begin(), cameras.end(),
                       [](const CameraTrack& track) { return !track.infos.empty(); });
}

/// Whether a decision would come out the same with what is known by now.
bool FusionRun::holds(const Decided& decided) {
  return scans_->holds(decided.scan) && camerasWithInfo() == decided.cameras_with_info &&
         posesAround(decided.scan) == decided.poses;
}

void FusionRun::start(BagScan scan) {
  const auto task = std::make_shared<ScanTask>(std::move(scan));
  try {
    plan(task);
  } catch (const DataError& e) {
    drops_.count("scans: not fused",
                 "scan " + std::to_string(task->scan.number) + " is dropped: " + e.what());
  }
}

void FusionRun::plan(const std::shared_ptr<ScanTask>& task) {
  TimedCloud raw = scans_->points(&task->scan);
  const std::vector<ros::Time> info_times = infoTimes(task->scan);
  if (rig_.motion_enabled) {
    const auto T_vehicle_lidar =
        places_.extrinsics(rig_.vehicle_frame, raw.frame_id, "all points have status 4");
    if (T_vehicle_lidar) watch_.lookAtMotion(raw, poses_.odometry(), *T_vehicle_lidar);
  }
  const auto& cameras = reader_.index().cameras;
  decided_.push_back({task->scan, camerasWithInfo(), posesAround(task->scan)});

  task->images.resize(cameras.size());
  for (std::size_t c = 0; c < cameras.size(); ++c) {
    const std::optional<StampNs>& stamp = task->scan.image_stamps[c];
    const CameraPlace place = places_.at(c, info_times[c], raw.frame_id);
    if (!stamp || !place.model) continue;
    bool is_new = false;
    task->images[c] = images_.find(c, *stamp, place.model->imageSize(), &is_new);
    if (!is_new) continue;
    task->images[c]->lidar_rows = lidar_rows_.of(c, place);
    task->images[c]->keeps_pixels = task->scan.number % RigWatch::kEdgesEvery == 0;
    task->new_images.push_back(task->images[c]);
  }
  for (FusedOutput& output : outputs_) {
    task->outputs.push_back(output.plan(*task, raw, &poses_, &places_, info_times,
                                        output.takesTruth() ? &*truth_ : nullptr));
  }
  launch(task);
}

/// Hands a planned scan over to the other lines.
void FusionRun::launch(const std::shared_ptr<ScanTask>& task) {
  const std::lock_guard<std::mutex> lock(mutex_);
  under_way_.push_back(task);
  for (const auto& image : task->images) {
    if (image && !image->is_made) ++task->missing_images;
  }
  for (const auto& image : task->new_images) {
    lines_->add(imageLine(image->camera), [this, image] {
      images_.make(image.get());
      imageMade(image);
    });
  }
  if (task->missing_images == 0) lines_->add(fuseLine(*task), [this, task] { fuseScan(task); });
}

// --- What the other lines do

void FusionRun::imageMade(const std::shared_ptr<ImageTask>& image) {
  const std::lock_guard<std::mutex> lock(mutex_);
  image->is_made = true;
  for (const auto& task : under_way_) {
    const std::ptrdiff_t uses = std::count(task->images.begin(), task->images.end(), image);
    if (uses == 0) continue;
    --task->missing_images;
    if (task->missing_images == 0) lines_->add(fuseLine(*task), [this, task] { fuseScan(task); });
  }
}

void FusionRun::fuseScan(const std::shared_ptr<ScanTask>& task) {
  for (std::size_t i = 0; i < outputs_.size(); ++i) outputs_[i].fuse(*task, &task->outputs[i]);
  const std::lock_guard<std::mutex> lock(mutex_);
  task->is_fused = true;
  for (const auto& next : under_way_) {
    if (!next->is_fused) break;
    if (std::exchange(next->is_written, true)) continue;
    lines_->add(0, [this, next] { writeScan(*next); });
  }
}

void FusionRun::writeScan(const ScanTask& task) {
  for (const auto& image : task.images) {
    if (!image || image->image) continue;
    const std::string name = "camera " + rig_.cameras[image->camera].name;
    drops_.count(name + ": unusable images or scores",
                 name + ", image " + std::to_string(image->stamp) + " ns: " + image->failure);
  }
  for (std::size_t i = 0; i < outputs_.size(); ++i) {
    outputs_[i].write(task, task.outputs[i]);
  }
  progress_.update(++written_);
  const std::lock_guard<std::mutex> lock(mutex_);
  under_way_.pop_front();
  if (!std::exchange(is_reading_, true)) lines_->add(readLine(), [this] { readOn(); });
}

// --- Reports

/// What was read, and what of it came out, where it looks wrong; one line for each doubt.
void FusionRun::tellDoubts() {
  std::vector<RigDoubt> doubts = watch_.takeDoubts();
  for (FusedOutput& output : outputs_) {
    output.finish();
    for (RigDoubt& doubt : output.watch().takeDoubts()) doubts.push_back(std::move(doubt));
  }
  for (const RigDoubt& doubt : doubts) {
    const std::string text = doubt.subject + ": " + doubt.text;
    if (std::find(doubts_.begin(), doubts_.end(), text) != doubts_.end()) continue;
    doubts_.push_back(text);
    DropLog::warn("check: " + text);
  }
}

std::map<std::string, std::uint64_t> FusionRun::dropsOf(const FusedOutput& output) const {
  std::map<std::string, std::uint64_t> drops = drops_.counts();
  for (const auto& drop : output.drops().counts()) drops[drop.first] += drop.second;
  return drops;
}

std::string FusionRun::whyNothingIsFused() {
  for (const FusedOutput& output : outputs_) {
    const RunReport& report = output.report();
    if (rig_.cameras.empty() || report.fusedPoints() > 0) continue;
    std::string text = input_.path() + ": no point got a class: " + report.commonestStatus();
    for (const auto& drop : dropsOf(output)) {
      text += "; " + drop.first + ": " + std::to_string(drop.second);
    }
    for (const std::string& reason : places_.missing()) text += "; " + reason;
    if (rig_.motion_enabled && poses_.odometry().empty()) text += "; " + poses_.gap(0, 0);
    if (!places_.missing().empty()) text += std::string("; ") + kTransformCure;
    return text + ". " + output.path() + " is written; check_rig.py looks for the cause";
  }
  return {};
}

std::string FusionRun::summary() const {
  std::string text;
  for (const FusedOutput& output : outputs_) {
    RunReport::Input input;
    input.output = output.path();
    input.scans = scans_->taken();
    input.time_decision = scans_->timeDecision();
    for (std::size_t c = 0; c < rig_.cameras.size(); ++c) {
      const CameraTrack& track = reader_.index().cameras[c];
      input.cameras.push_back({rig_.cameras[c].name, track.images.size(), track.semantics.size(),
                               output.watch().figures(c)});
    }
    input.doubts = doubts_;
    input.check_command = "check_rig.py";
    for (const std::string& bag : options_.inputs) input.check_command += " " + bag;
    input.check_command += " --rig " + options_.rig;
    text += output.report().text(input, dropsOf(output));
  }
  return text;
}

// --- All runs

namespace {

/// What of a rig says how the bag is read and its images are made: all but what comes after.
std::string readingOf(const Rig& rig) {
  YAML::Node root = YAML::Load(rig.yaml);
  for (const char* key :
       {"motion", "occlusion", "overlap", "smoothing", "keep_unlabelled", "threads"}) {
    root.remove(key);
  }
  if (!(rig.uncertainty.blend > 0.0)) root.remove("uncertainty");  // else images hold its result
  for (const char* key : {"lookup", "on_missing", "max_extrapolation"}) {
    root["odometry"].remove(key);
  }
  return YAML::Dump(root);
}

}  // namespace

BagFusion::BagFusion(const FuseBagOptions& options, void (*checkpoint)())
    : options_(options), checkpoint_(checkpoint), input_(options.inputs) {
  for (const OutputOptions& output : options.outputs) {
    Rig rig = loadRig(options.rig, output.overrides);
    const std::string reading = readingOf(rig);
    const auto known = std::find_if(groups_.begin(), groups_.end(),
                                    [&](const Group& group) { return group.reading == reading; });
    Group& group = known == groups_.end() ? groups_.emplace_back() : *known;
    group.reading = reading;
    group.outputs.push_back(output);
    group.rigs.push_back(std::move(rig));
  }
}

void BagFusion::run() {
  for (Group& group : groups_) {
    try {
      run(&group);
    } catch (const rosbag::BagException& e) {
      throw Error(bagErrorText(input_.path(), e));
    }
  }
}

void BagFusion::run(Group* group) {
  for (const std::optional<double>& ahead_s : kAheadS) {
    group->run.reset();  // its files go first
    group->run =
        std::make_unique<FusionRun>(options_, group->outputs, group->rigs, input_, ahead_s);
    if (group->run->fuse(checkpoint_)) return;
    if (!options_.quiet) {
      DropLog::note("a scan needs what was recorded more than " + std::to_string(*ahead_s) +
                    " s after it; the bag is read again, further ahead");
    }
  }
}

std::string BagFusion::summary() const {
  std::string text;
  for (const Group& group : groups_) text += group.run->summary();
  return text;
}

std::string BagFusion::whyNothingIsFused() const {
  for (const Group& group : groups_) {
    const std::string why = group.run->whyNothingIsFused();
    if (!why.empty()) return why;
  }
  return {};
}

}  // namespace semantic_lidar_fusion
