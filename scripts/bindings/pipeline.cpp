// SPDX-License-Identifier: MIT
/// The way of one scan: the images that it uses, their semantics, motion, view and fusion.
#include <pybind11/stl.h>

#include <limits>
#include <map>

#include "arrays.h"
#include "bindings.h"
#include "cloud_array.h"
#include "scan.h"
#include "semantic_lidar_fusion/common/cloud_bytes.h"
#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/fusion/scan_pipeline.h"

namespace py = pybind11;

namespace semantic_lidar_fusion {
namespace {

/// A camera's image, and which camera it is of.
struct CameraImage {
  std::size_t camera = 0;
  SegmentedImage image;
};

/// What fuse gives: the cloud, and the class set that names its fields.
struct FusedCloud {
  SemanticCloud cloud;
  LabelSet classes;
};

/// ScanPipeline with the rig's names in place of its numbers.
class Pipeline {
 public:
  explicit Pipeline(std::shared_ptr<Rig> rig) : rig_(std::move(rig)), pipeline_(*rig_) {}

  /// t_ref and each camera's raw image stamp, decided with all stamps that are given.
  py::tuple choose(const Scan& scan, const std::map<std::string, std::vector<StampNs>>& stamps,
                   const std::map<std::string, std::pair<std::shared_ptr<CameraModel>, Doubles>>&
                       cameras) const {
    SelectorConfig config = rig_->selectorConfig();
    config.image_history_ns = std::numeric_limits<StampNs>::max() / 4;
    ScanSelector selector(config);
    SelectorScan times;
    times.interval = scanInterval(scan.cloud);
    if (rig_->image_choice == ImageChoice::kClosestToSweep) {
      for (const CameraConfig& camera : rig_->cameras) {
        const auto known = cameras.find(camera.name);
        CameraPlace place;
        if (known != cameras.end()) {
          place = {known->second.first, camera.nudge.applied(transformOf(known->second.second))};
        }
        times.sweep_ns.push_back(sweepTime(scan.cloud, place));
      }
    }
    selector.addScan(times, 0);
    for (const auto& [name, of_camera] : stamps) {
      const int index = static_cast<int>(indexOf(name));
      for (const StampNs stamp : of_camera) selector.addImage(index, stamp);
    }
    const SelectorDecisions decisions = selector.finish();
    py::dict images;
    for (const SelectionDecision& decision : decisions.selections) {
      images[py::str(rig_->cameras[static_cast<std::size_t>(decision.camera)].name)] =
          decision.image_stamp;
    }
    StampNs reference_ns = times.interval.middleNs();
    if (!decisions.references.empty()) reference_ns = decisions.references.front().reference_ns;
    return py::make_tuple(reference_ns, images);
  }

  std::unique_ptr<CameraImage> segment(const std::string& camera, StampNs stamp,
                                       const py::object& image, const py::object& input) {
    auto result = std::make_unique<CameraImage>();
    result->camera = indexOf(camera);
    result->image.stamp = stamp;
    struct Owners {
      std::shared_ptr<const void> image, input;
    };
    const auto owners = std::make_shared<Owners>();
    result->image.image = matOf(image, &owners->image);
    result->image.input = matOf(input, &owners->input);
    result->image.owner = owners;
    const py::gil_scoped_release release;
    pipeline_.segment(result->camera, &result->image);
    return result;
  }

  py::array probabilities(const CameraImage& image) const {
    return arrayOf(pipeline_.probabilities(image.image));
  }

  std::unique_ptr<Cloud> compensate(const Scan& scan, StampNs reference_ns,
                                    const PoseBuffer& odometry,
                                    const py::object& T_vehicle_lidar) const {
    const std::optional<Transform> T = optionalTransformOf(T_vehicle_lidar);
    const py::gil_scoped_release release;
    return std::make_unique<Cloud>(
        pipeline_.compensate(scan.cloud, reference_ns, odometry, T).cloud);
  }

  std::unique_ptr<CameraView> view(const std::string& camera, std::shared_ptr<CameraModel> model,
                                   const Doubles& T_camera_lidar, const CameraImage* image,
                                   StampNs reference_ns, const PoseBuffer& odometry,
                                   const py::object& T_vehicle_lidar) const {
    const std::size_t index = indexOf(camera);
    if (image && image->camera != index) {
      throw DataError("the image is of camera " + rig_->cameras[image->camera].name + ", not of " +
                      camera);
    }
    const CameraPlace place{std::move(model),
                            rig_->cameras[index].nudge.applied(transformOf(T_camera_lidar))};
    if (image && place.model && !image->image.image.empty()) {
      const ImageSize size{image->image.image.cols, image->image.image.rows};
      if (size != place.model->imageSize()) {
        throw DataError("camera " + camera + ": the image is " + sizeText(size) +
                        "; its model is of " + sizeText(place.model->imageSize()));
      }
    }
    return std::make_unique<CameraView>(
        pipeline_.view(index, place, image ? &image->image : nullptr, reference_ns, odometry,
                       optionalTransformOf(T_vehicle_lidar)));
  }

  std::unique_ptr<FusedCloud> fuse(const Cloud& cloud,
                                   const std::vector<const CameraView*>& views) const {
    std::vector<CameraView> copies;
    for (const CameraView* view : views) copies.push_back(*view);
    const py::gil_scoped_release release;
    return std::make_unique<FusedCloud>(
        FusedCloud{pipeline_.fuse(cloud, std::move(copies), false).cloud, rig_->classes});
  }

 private:
  std::size_t indexOf(const std::string& camera) const {
    std::string known;
    for (std::size_t i = 0; i < rig_->cameras.size(); ++i) {
      if (rig_->cameras[i].name == camera) return i;
      known += (known.empty() ? "" : ", ") + rig_->cameras[i].name;
    }
    throw DataError("the rig has no camera " + camera + " (it has " +
                    (known.empty() ? "none" : known) + ")");
  }

  std::shared_ptr<Rig> rig_;
  ScanPipeline pipeline_;
};

template <typename T>
py::array_t<T> column(const py::object& fused, std::vector<T> SemanticCloud::*member) {
  return viewOf(fused.cast<const FusedCloud&>().cloud.*member, fused);
}

py::array probabilitiesOf(const py::object& fused) {
  const SemanticCloud& cloud = fused.cast<const FusedCloud&>().cloud;
  return py::array_t<float>(
      {static_cast<py::ssize_t>(cloud.size()), static_cast<py::ssize_t>(cloud.class_count)},
      cloud.probabilities.data(), fused);
}

}  // namespace

void addPipeline(py::module_& module) {
  py::class_<CameraImage>(module, "SegmentedImage")
      .def_property_readonly("stamp_ns", [](const CameraImage& i) { return i.image.stamp; })
      .def_property_readonly("superpixels",
                             [](const CameraImage& i) { return arrayOf(i.image.superpixels.ids); })
      .def_property_readonly("share", [](const CameraImage& i) { return arrayOf(i.image.share); });
  py::class_<CameraView>(module, "CameraView")
      .def_readonly("camera", &CameraView::name)
      .def_readonly("has_image", &CameraView::has_image);
  py::class_<FusedCloud>(module, "FusedCloud")
      .def("__len__", [](const FusedCloud& fused) { return fused.cloud.size(); })
      .def_property_readonly("frame", [](const FusedCloud& f) { return f.cloud.points.frame_id; })
      .def_property_readonly("stamp_ns", [](const FusedCloud& f) { return f.cloud.points.stamp; })
      .def_property_readonly(
          "cloud", [](const FusedCloud& f) { return &f.cloud.points; },
          py::return_value_policy::reference_internal)
      .def_property_readonly("status",
                             [](const py::object& f) {
                               return viewOf(f.cast<const FusedCloud&>().cloud.points.status, f);
                             })
      .def_property_readonly("label",
                             [](const py::object& f) { return column(f, &SemanticCloud::label); })
      .def_property_readonly(
          "confidence", [](const py::object& f) { return column(f, &SemanticCloud::confidence); })
      .def_property_readonly("entropy",
                             [](const py::object& f) { return column(f, &SemanticCloud::entropy); })
      .def_property_readonly("cameras",
                             [](const py::object& f) { return column(f, &SemanticCloud::cameras); })
      .def_property_readonly("probabilities", &probabilitiesOf)
      .def("points", [](const FusedCloud& f) {
        return structuredArray(semanticCloudBytes(f.cloud, f.classes));
      });
  py::class_<Pipeline>(module, "ScanPipeline")
      .def(py::init<std::shared_ptr<Rig>>(), py::arg("rig"))
      .def("choose_images", &Pipeline::choose, py::arg("scan"), py::arg("stamps_ns"),
           py::arg("cameras") =
               std::map<std::string, std::pair<std::shared_ptr<CameraModel>, Doubles>>{})
      .def("segment", &Pipeline::segment, py::arg("camera"), py::arg("stamp_ns"),
           py::arg("image") = py::none(), py::arg("input") = py::none())
      .def("probabilities", &Pipeline::probabilities, py::arg("image"))
      .def("compensate", &Pipeline::compensate, py::arg("scan"), py::arg("reference_ns"),
           py::arg("odometry"), py::arg("T_vehicle_lidar"))
      // The view reads the image's scores where they are.
      .def("view", &Pipeline::view, py::keep_alive<0, 5>(), py::arg("camera"), py::arg("model"),
           py::arg("T_camera_lidar"), py::arg("image"), py::arg("reference_ns"),
           py::arg("odometry"), py::arg("T_vehicle_lidar"))
      .def("fuse", &Pipeline::fuse, py::arg("cloud"), py::arg("views"));
}

}  // namespace semantic_lidar_fusion
