# SPDX-License-Identifier: MIT
"""The C++ core for numpy arrays: what fuse_bag and the nodelets compute, without ROS.

Times are integer nanoseconds. Transforms are (4, 4) and named T_target_source: they take points of
the source frame to the target frame. Lengths are in m, angles in rad unless the name says degrees.
Arrays that come out of an object (a scan's ``x``) are views of it, as are the arrays of pixels and
scores that go in, so do not change those while they are used. What is wrong with data raises
DataError, what is wrong with a setting ConfigError, an array of another shape or type ValueError.

One scan::

    rig = core.Rig.load("rig.yaml")
    pipeline = core.ScanPipeline(rig)
    scan = core.LidarDecoder(rig).decode_points(points, stamp_ns, "velodyne")
    odometry = core.PoseBuffer(stamps_ns, poses)
    reference_ns, chosen = pipeline.choose_images(scan, {"front": image_stamps_ns})
    image = pipeline.segment("front", chosen["front"], pixels, scores)
    cloud = pipeline.compensate(scan, reference_ns, odometry, T_vehicle_lidar)
    view = pipeline.view("front", camera, T_camera_lidar, image, reference_ns, odometry,
                         T_vehicle_lidar)
    fused = pipeline.fuse(cloud, [view])

Every name is typed in _core.pyi; docs/python.md explains them. The module is there where the package
was built with pybind11, or installed by pip.
"""

from semantic_lidar_fusion._core import (
    CameraModel,
    CameraView,
    Cloud,
    ConfigError,
    DataError,
    FusedCloud,
    LidarDecoder,
    PoseBuffer,
    Rig,
    Scan,
    ScanPipeline,
    SegmentedImage,
    share,
    smooth,
    superpixels,
    tempered_softmax,
    transform,
    visible,
)

__all__ = [
    "CameraModel",
    "CameraView",
    "Cloud",
    "ConfigError",
    "DataError",
    "FusedCloud",
    "LidarDecoder",
    "PoseBuffer",
    "Rig",
    "Scan",
    "ScanPipeline",
    "SegmentedImage",
    "share",
    "smooth",
    "superpixels",
    "tempered_softmax",
    "transform",
    "visible",
]
