// SPDX-License-Identifier: MIT
/// Changes to the rig while it runs, from rqt_reconfigure and every other client of
/// dynamic_reconfigure.
///
/// The protocol is spoken here, without a generated class, because the rig decides which parameters
/// there are: those of each camera are in a group of its own. A request is the rig with some keys
/// changed, and goes through the one loader: what breaks a rule is refused as a whole.
#pragma once

#include <dynamic_reconfigure/ConfigDescription.h>
#include <dynamic_reconfigure/Reconfigure.h>
#include <ros/node_handle.h>
#include <std_srvs/Trigger.h>

#include <functional>
#include <string>
#include <utility>
#include <vector>

#include "semantic_lidar_fusion/config/rig.h"

namespace semantic_lidar_fusion {

/// One parameter: a number, or a text of a few.
struct TunedParameter {
  std::string name;   ///< as dynamic_reconfigure shows it
  std::string group;  ///< empty, or the camera
  std::string key;    ///< of the rig file, with dots; "[i]" at its end is one number of a list
  std::string type;   ///< "double", "int" or "str"
  std::string description;
  double least = 0.0, most = 0.0;    ///< of numbers
  std::vector<std::string> choices;  ///< of texts
  std::function<double(const Rig&)> number;
  std::function<std::string(const Rig&)> text;
};

/// All of a rig.
std::vector<TunedParameter> tunedParameters(const Rig& rig);
/// `rig` with the values of a request. Throws ConfigError; a parameter that is unknown is a
/// problem.
Rig retuned(const Rig& rig, const dynamic_reconfigure::Config& request);
/// What dynamic_reconfigure shows of a rig.
dynamic_reconfigure::Config tunedValues(const Rig& rig);
dynamic_reconfigure::ConfigDescription tunedDescription(const Rig& rig);

/// `~set_parameters`, `~parameter_updates`, `~parameter_descriptions`, and `~save_rig`. Callbacks
/// run one at a time with those of `node`'s queue.
class TuningServer {
 public:
  /// `changed` is given each new rig; the server has it from then on. `refused` is told why not.
  /// Parameter `tuned_rig_file` of `node`: what `~save_rig` writes, default
  /// ~/.ros/<rig>_tuned.yaml (ROS_HOME is honoured).
  TuningServer(const ros::NodeHandle& node, const Rig& rig, std::function<void(const Rig&)> changed,
               std::function<void(const std::string&)> refused);

 private:
  bool set(dynamic_reconfigure::Reconfigure::Request& request,
           dynamic_reconfigure::Reconfigure::Response& response);
  bool save(std_srvs::Trigger::Request& request, std_srvs::Trigger::Response& response);

  ros::NodeHandle node_;
  Rig rig_, original_;
  std::function<void(const Rig&)> changed_;
  std::function<void(const std::string&)> refused_;
  std::string file_;
  ros::Publisher descriptions_, updates_;
  ros::ServiceServer set_, save_;
};

}  // namespace semantic_lidar_fusion
