// SPDX-License-Identifier: MIT
/// The whole rig under load: a nodelet manager with this package's nodelets, a player, or both in
/// one process, which is what benchmark_rig.py compares. See kUsage.
#include <nodelet/loader.h>
#include <ros/callback_queue.h>
#include <ros/ros.h>
#include <sensor_msgs/PointCloud2.h>
#include <sensor_msgs/TimeReference.h>
#include <sys/resource.h>
#include <unistd.h>

#include <atomic>
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <fstream>
#include <iostream>
#include <memory>
#include <mutex>
#include <string>
#include <thread>
#include <vector>

#include "edge/conversions.h"
#include "edge/topics.h"
#include "rig_player.h"
#include "semantic_lidar_fusion/common/error.h"

namespace semantic_lidar_fusion {
namespace {

const char kUsage[] =
    R"(usage: rig_benchmark --role both|manager|player --rig FILE --out FILE [options]

  --role both          manager and player in this process: messages pass by pointer
  --role manager       no player; ends with the standard input
  --role player        no manager; waits for listeners
  --rig FILE           rig file of all
  --out FILE           where to write the log (JSON)
  --bag FILE           what to play (all but manager)
  --seconds S          how long (default 60)
  --score-latency S    from an image's stamp to its scores (default 0)
  --alone              the player does not wait for listeners: what playing itself costs
)";

std::int64_t cpuNs() {
  rusage usage{};
  getrusage(RUSAGE_SELF, &usage);
  const auto ns = [](const timeval& time) {
    return time.tv_sec * std::int64_t{1000000000} + time.tv_usec * std::int64_t{1000};
  };
  return ns(usage.ru_utime) + ns(usage.ru_stime);
}

std::int64_t residentBytes() {
  std::ifstream statm("/proc/self/statm");
  std::int64_t total = 0, resident = 0;
  statm >> total >> resident;
  return resident * sysconf(_SC_PAGESIZE);
}

struct Sample {
  std::int64_t steady_ns, cpu_ns, resident_bytes;
};

/// Samples the process ten times a second.
class Monitor {
 public:
  Monitor() : thread_([this] { run(); }) {}
  ~Monitor() { stop(); }
  void stop() {
    stopped_ = true;
    if (thread_.joinable()) thread_.join();
  }
  const std::vector<Sample>& samples() const { return samples_; }

 private:
  void run() {
    while (!stopped_) {
      samples_.push_back({steadyNs(), cpuNs(), residentBytes()});
      std::this_thread::sleep_for(std::chrono::milliseconds(100));
    }
  }
  std::atomic<bool> stopped_{false};
  std::vector<Sample> samples_;
  std::thread thread_;
};

struct Result {
  StampNs stamp;
  std::int64_t steady_ns;
  std::uint32_t points, fused, cameras;
};

struct Decision {
  std::string what;  ///< "reference" or a camera's name
  StampNs scan, chosen;
};

/// Notes every cloud that is published, and which images it was to be made of. Its own work, done
/// on a thread of its own, is small.
class Sink {
 public:
  explicit Sink(const Rig& rig) {
    node_.setCallbackQueue(&queue_);
    clouds_ = subscribe<sensor_msgs::PointCloud2>(
        "points_semantic", [this](const sensor_msgs::PointCloud2ConstPtr& cloud) { note(*cloud); });
    decisions_.push_back(decision("scan_reference", "reference"));
    for (const CameraConfig& camera : rig.cameras) {
      decisions_.push_back(decision(cameraTopic(camera, "selection"), camera.name));
    }
    spinner_ = std::make_unique<ros::AsyncSpinner>(1, &queue_);
    spinner_->start();
  }
  void stop() { spinner_->stop(); }

  std::vector<Result> results;
  std::vector<Decision> decided;

 private:
  template <class M>
  ros::Subscriber subscribe(const std::string& topic,
                            const boost::function<void(const boost::shared_ptr<const M>&)>& use) {
    return node_.subscribe<M>(topic, 100, use, ros::VoidConstPtr(),
                              ros::TransportHints().tcpNoDelay());
  }
  ros::Subscriber decision(const std::string& topic, const std::string& what) {
    return subscribe<sensor_msgs::TimeReference>(
        topic, [this, what](const sensor_msgs::TimeReferenceConstPtr& message) {
          decided.push_back({what, stampNs(message->header.stamp), stampNs(message->time_ref)});
        });
  }
  void note(const sensor_msgs::PointCloud2& cloud) {
    Result result{stampNs(cloud.header.stamp), steadyNs(), cloud.width * cloud.height, 0, 0};
    std::size_t status_at = 0, cameras_at = 0;
    for (const auto& field : cloud.fields) {
      if (field.name == "status") status_at = field.offset;
      if (field.name == "cameras") cameras_at = field.offset;
    }
    for (std::size_t at = 0; at + cloud.point_step <= cloud.data.size(); at += cloud.point_step) {
      result.fused += cloud.data[at + status_at] == 0;
      std::uint16_t bits = 0;
      std::memcpy(&bits, &cloud.data[at + cameras_at], sizeof(bits));
      result.cameras |= bits;
    }
    results.push_back(result);
  }

  ros::CallbackQueue queue_;
  ros::NodeHandle node_;
  ros::Subscriber clouds_;
  std::vector<ros::Subscriber> decisions_;
  std::unique_ptr<ros::AsyncSpinner> spinner_;
};

struct Options {
  std::string role, rig, out;
  PlayerOptions player;
};

Options parsed(int argc, char** argv) {
  Options options;
  const auto refuse = [](const std::string& problem) {
    std::cerr << "rig_benchmark: " << problem << "\n" << kUsage;
    std::exit(2);
  };
  for (int i = 1; i < argc; ++i) {
    const std::string name = argv[i];
    if (name == "--alone") {
      options.player.wait_for_listeners = false;
      continue;
    }
    if (i + 1 >= argc) refuse(name + " is unknown or needs a value");
    const std::string value = argv[++i];
    if (name == "--role") {
      options.role = value;
    } else if (name == "--rig") {
      options.rig = value;
    } else if (name == "--out") {
      options.out = value;
    } else if (name == "--bag") {
      options.player.bag = value;
    } else if (name == "--seconds") {
      options.player.seconds = std::strtod(value.c_str(), nullptr);
    } else if (name == "--score-latency") {
      options.player.score_latency_s = std::strtod(value.c_str(), nullptr);
    } else {
      refuse("unknown argument " + name);
    }
  }
  if (options.role != "both" && options.role != "manager" && options.role != "player") {
    refuse("--role is '" + options.role + "'");
  }
  if (options.rig.empty() || options.out.empty()) refuse("--rig and --out are needed");
  if (options.role != "manager" && options.player.bag.empty()) refuse("--bag is needed");
  if (!(options.player.seconds > 0.0)) refuse("--seconds must be above 0");
  return options;
}

void loadNodelets(nodelet::Loader* loader) {
  for (const char* type : {"ImageSelectionNodelet", "SuperpixelUncertaintyNodelet",
                           "MotionCompensationNodelet", "ProjectionNodelet"}) {
    const std::string name = std::string("/") + type;
    if (!loader->load(name, std::string("semantic_lidar_fusion/") + type, {}, {})) {
      throw Error(name + " was not loaded; is the package's devel/setup.bash sourced?");
    }
  }
}

void writeLog(const std::string& path, std::int64_t resident_before, const Monitor& monitor,
              const RigPlayer* player, const Sink* sink) {
  std::ofstream out(path);
  out << "{\"resident_before\": " << resident_before << ",\n\"samples\": [";
  const char* comma = "";
  for (const Sample& sample : monitor.samples()) {
    out << comma << "[" << sample.steady_ns << "," << sample.cpu_ns << "," << sample.resident_bytes
        << "]";
    comma = ",\n";
  }
  out << "]";
  if (player != nullptr) {
    out << ",\n\"player\": {\"start\": " << player->startSteadyNs()
        << ", \"scans\": " << player->scanCount()
        << ", \"largest_lag_ns\": " << player->largestLagNs() << ", \"copies\": [";
    comma = "";
    for (const Copy& copy : player->copies()) {
      out << comma << "[" << copy.steady_ns << "," << copy.cpu_s << "]";
      comma = ",\n";
    }
    out << "], \"deliveries\": [";
    comma = "";
    for (const Delivery& delivery : player->deliveries()) {
      out << comma << "[\"" << delivery.what << "\"," << delivery.stamp << "," << delivery.until
          << "," << delivery.steady_ns << "]";
      comma = ",\n";
    }
    out << "]}";
  }
  if (sink != nullptr) {
    out << ",\n\"results\": [";
    comma = "";
    for (const Result& result : sink->results) {
      out << comma << "[" << result.stamp << "," << result.steady_ns << "," << result.points << ","
          << result.fused << "," << result.cameras << "]";
      comma = ",\n";
    }
    out << "],\n\"decisions\": [";
    comma = "";
    for (const Decision& decision : sink->decided) {
      out << comma << "[\"" << decision.what << "\"," << decision.scan << "," << decision.chosen
          << "]";
      comma = ",\n";
    }
    out << "]";
  }
  out << "}\n";
  out.close();
  if (!out) throw Error("cannot write " + path);
}

void run(const Options& options) {
  const Rig rig = loadRig(options.rig);
  ros::NodeHandle node;
  ros::param::set("/rig_file", options.rig);
  ros::AsyncSpinner spinner(1);
  spinner.start();

  std::unique_ptr<RigPlayer> player;
  if (options.role != "manager") player = std::make_unique<RigPlayer>(rig, options.player);
  const std::int64_t resident_before = residentBytes();
  std::unique_ptr<nodelet::Loader> manager;
  std::unique_ptr<Sink> sink;
  if (options.role != "player") {
    manager = std::make_unique<nodelet::Loader>();
    loadNodelets(manager.get());
    sink = std::make_unique<Sink>(rig);
  }
  std::cout << "ready" << std::endl;
  Monitor monitor;
  if (player) {
    player->play();
    std::this_thread::sleep_for(std::chrono::milliseconds(500));  // for the last scan
  } else {
    std::string line;
    while (std::getline(std::cin, line)) {
    }
  }
  monitor.stop();
  if (sink) sink->stop();
  writeLog(options.out, resident_before, monitor, player.get(), sink.get());
  if (manager) manager->clear();
}

}  // namespace
}  // namespace semantic_lidar_fusion

int main(int argc, char** argv) {
  ros::init(argc, argv, "rig_benchmark", ros::init_options::AnonymousName);
  const semantic_lidar_fusion::Options options = semantic_lidar_fusion::parsed(argc, argv);
  try {
    semantic_lidar_fusion::run(options);
  } catch (const std::exception& problem) {
    std::cerr << "rig_benchmark: " << problem.what() << "\n";
    return 1;
  }
  return 0;
}
