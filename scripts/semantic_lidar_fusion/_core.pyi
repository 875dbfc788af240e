# SPDX-License-Identifier: MIT
from typing import Any, Dict, List, Mapping, Optional, Sequence, Tuple

import numpy as np

from semantic_lidar_fusion.errors import ConfigError as ConfigError
from semantic_lidar_fusion.errors import DataError as DataError

has_octomap: bool

class Rig:
    """A rig file, loaded and checked as fuse_bag does; immutable."""

    @staticmethod
    def load(path: str, overrides: Sequence[str] = ...) -> Rig:
        """A rig file with changes ("occlusion.mode=paper"). ConfigError with every problem."""
    @staticmethod
    def parse(text: str, folder: str = ..., overrides: Sequence[str] = ...) -> Rig:
        """The same for YAML in memory; relative paths are relative to `folder`."""
    @property
    def yaml(self) -> str:
        """Every key with what it came to; a rig file of its own."""
    @property
    def name(self) -> str: ...
    @property
    def fixed_frame(self) -> str: ...
    @property
    def vehicle_frame(self) -> str: ...
    @property
    def class_names(self) -> List[str]:
        """By class id."""
    @property
    def class_colors(self) -> np.ndarray:
        """(C, 3) uint8, red, green, blue."""
    @property
    def camera_names(self) -> List[str]:
        """The position is the bit in a point's `cameras`."""

class CameraModel:
    """A camera of sensor_msgs/CameraInfo, or of a lens file."""

    def __init__(
        self,
        *,
        frame: str = ...,
        size: Tuple[int, int] = ...,
        distortion_model: str = ...,
        d: Sequence[float] = ...,
        k: Any = ...,
        r: Any = ...,
        p: Any = ...,
        binning: Tuple[int, int] = ...,
        roi: Tuple[int, int, int, int] = ...,
        rectified: bool = ...,
        max_theta_deg: float = ...,
        lens_file: str = ...,
        lens_camera: str = ...,
    ) -> None:
        """`size` is (width, height); `k` and `r` hold 9 numbers, `p` 12, in any shape. DataError
        that names field, value and rule."""
    @property
    def size(self) -> Tuple[int, int]:
        """(width, height) after binning and ROI."""
    @property
    def max_theta(self) -> float:
        """Largest angle from the axis that has a pixel, rad."""
    def project(self, points: Any) -> np.ndarray:
        """Pixels (N, 2) of points (N, 3) in the camera's frame; NaN where there is none, also
        outside the image."""
    def rays(self, pixels: Any) -> np.ndarray:
        """Unit rays (N, 3) of pixels (N, 2); NaN where no ray maps to one."""
    def theta(self, points: Any) -> np.ndarray:
        """(N,) angle from the axis, rad."""

class Scan:
    """Finite points as measured, each at its own time, in the sensor's order."""

    def __len__(self) -> int: ...
    @property
    def frame(self) -> str: ...
    @property
    def first_ns(self) -> int:
        """True time of the first point; the header's stamp without points."""
    @property
    def last_ns(self) -> int: ...
    @property
    def time_decision(self) -> str:
        """How the times of the points were understood, for people."""
    @property
    def counters(self) -> Dict[str, int]:
        """What came in and what was left out, by reason."""
    @property
    def x(self) -> np.ndarray: ...
    @property
    def y(self) -> np.ndarray: ...
    @property
    def z(self) -> np.ndarray: ...
    @property
    def intensity(self) -> np.ndarray: ...
    @property
    def ring(self) -> np.ndarray:
        """(N,) uint16, 0 = lowest laser, 65535 = unknown."""
    @property
    def time_ns(self) -> np.ndarray:
        """(N,) int64, true times."""

class LidarDecoder:
    """Packets and clouds to scans, as the rig says of its lidar."""

    def __init__(self, rig: Rig) -> None: ...
    def decode_packets(
        self, data: np.ndarray, stamps_ns: Any, header_stamp_ns: int, frame: str
    ) -> Scan:
        """Velodyne packets (P, 1206) uint8 with their stamps (P,)."""
    def decode_points(self, points: np.ndarray, header_stamp_ns: int, frame: str) -> Scan:
        """A structured array (N,) with the fields of a PointCloud2 (see cloud_io.to_array)."""

class PoseBuffer:
    """Poses T_fixed_vehicle in time; linear and slerp between two readings."""

    def __init__(self, stamps_ns: Any, poses: Any, fastest_mps: float = ...) -> None:
        """`poses`: (M, 4, 4), or (M, 7) of x y z and the quaternion x y z w. Steps faster than
        `fastest_mps` are jumps, across which nothing is interpolated; 0 = none is."""
    def __len__(self) -> int: ...
    def covers(self, stamp_ns: int) -> bool: ...
    def lookup(self, stamp_ns: int) -> Optional[np.ndarray]:
        """(4, 4), or None where no two readings enclose the time."""

class Cloud:
    """Points as the lidar sees them at one time (equation 5)."""

    def __init__(
        self,
        xyz: Any,
        ring: Any = ...,
        intensity: Any = ...,
        stamp_ns: int = ...,
        frame: str = ...,
    ) -> None:
        """One's own points (N, 3), all taken at `stamp_ns`."""
    def __len__(self) -> int: ...
    @property
    def frame(self) -> str: ...
    @property
    def stamp_ns(self) -> int:
        """t_ref."""
    @property
    def x(self) -> np.ndarray: ...
    @property
    def y(self) -> np.ndarray: ...
    @property
    def z(self) -> np.ndarray: ...
    @property
    def intensity(self) -> np.ndarray: ...
    @property
    def ring(self) -> np.ndarray: ...
    @property
    def dt(self) -> np.ndarray:
        """(N,) float32 s, when each point was measured, relative to t_ref."""
    @property
    def status(self) -> np.ndarray:
        """(N,) uint8: 0, or 4 = no odometry, as measured."""
    def points(self) -> np.ndarray:
        """The structured array of the topic points_compensated; a copy."""

class SegmentedImage:
    """An image with its superpixels and their share."""

    @property
    def stamp_ns(self) -> int:
        """Raw."""
    @property
    def superpixels(self) -> np.ndarray:
        """(rows, columns) int32; empty where probabilities came in."""
    @property
    def share(self) -> np.ndarray:
        """(rows, columns) float32; empty unless scores came in."""

class CameraView:
    """What one camera brings to one scan."""

    @property
    def camera(self) -> str: ...
    @property
    def has_image(self) -> bool:
        """False without an image, or where odometry does not cover its time."""

class FusedCloud:
    """The points with what the cameras say of each."""

    def __len__(self) -> int: ...
    @property
    def frame(self) -> str: ...
    @property
    def stamp_ns(self) -> int: ...
    @property
    def cloud(self) -> Cloud: ...
    @property
    def status(self) -> np.ndarray:
        """(N,) uint8: 0 fused, 1 occluded, 2 outside, 3 no image, 4 no odometry."""
    @property
    def label(self) -> np.ndarray:
        """(N,) uint8, 255 = none."""
    @property
    def confidence(self) -> np.ndarray: ...
    @property
    def entropy(self) -> np.ndarray: ...
    @property
    def cameras(self) -> np.ndarray:
        """(N,) uint16, a bit for each camera that contributed."""
    @property
    def probabilities(self) -> np.ndarray:
        """(N, C) float32."""
    def points(self) -> np.ndarray:
        """The structured array of the topic points_semantic, byte by byte; a copy."""

class ScanPipeline:
    """The steps of the fusion of one scan, as the rig says."""

    def __init__(self, rig: Rig) -> None: ...
    def choose_images(
        self,
        scan: Scan,
        stamps_ns: Mapping[str, Sequence[int]],
        cameras: Mapping[str, Tuple[CameraModel, Any]] = ...,
    ) -> Tuple[int, Dict[str, Optional[int]]]:
        """t_ref (a true time) and each camera's raw image stamp, None = none in time, of the raw
        stamps of all images there are. `cameras`, the model and T_camera_lidar by name, serve
        `image_choice: closest_to_sweep` alone."""
    def segment(
        self,
        camera: str,
        stamp_ns: int,
        image: Optional[np.ndarray] = ...,
        input: Optional[np.ndarray] = ...,
    ) -> SegmentedImage:
        """`image`: (rows, columns) or (rows, columns, 3) uint8, BGR. `input`: scores, labels or
        probabilities, as the camera's `input` says; None: the rig's own network makes scores.
        Images of one camera come in order of time."""
    def probabilities(self, image: SegmentedImage) -> np.ndarray:
        """P (rows, columns, C) float32 of every pixel of the superpixel map."""
    def compensate(
        self, scan: Scan, reference_ns: int, odometry: PoseBuffer, T_vehicle_lidar: Any
    ) -> Cloud:
        """Equation 5. `T_vehicle_lidar` None: unknown, so no point has odometry."""
    def view(
        self,
        camera: str,
        model: Optional[CameraModel],
        T_camera_lidar: Any,
        image: Optional[SegmentedImage],
        reference_ns: int,
        odometry: PoseBuffer,
        T_vehicle_lidar: Any,
    ) -> CameraView:
        """`T_camera_lidar` are the extrinsics; `image` None: there is none in time."""
    def fuse(self, cloud: Cloud, views: Sequence[CameraView]) -> FusedCloud:
        """Equations 12-14, merging and smoothing."""

def superpixels(
    image: np.ndarray,
    size: Optional[Tuple[int, int]] = ...,
    count: int = ...,
    compactness: float = ...,
    iterations: int = ...,
) -> np.ndarray:
    """Ids (rows, columns) int32 of an image; `size` is (columns, rows) of the map."""

def share(superpixels: np.ndarray, scores: np.ndarray) -> np.ndarray:
    """Of each pixel of the map the share of its superpixel's most frequent label, float32."""

def tempered_softmax(
    scores: Any, share: Any, temperature: float = ..., exponent: float = ...
) -> np.ndarray:
    """P (N, C) float64 of scores (N, C) and shares (N,), equation 3 with tau = temperature /
    share^exponent; uniform where a score is not finite or a share not in (0, 1]."""

def transform(translation: Any, quaternion: Any) -> np.ndarray:
    """(4, 4) of a position and a quaternion x y z w, as messages hold them. DataError unless the
    quaternion's norm is 1 to 1e-2."""

def visible(
    cloud: Cloud,
    camera: CameraModel,
    T_camera_lidar: Any,
    mode: str = ...,
    vertical_step_deg: float = ...,
    horizontal_step_deg: float = ...,
    depth_margin_m: float = ...,
    depth_margin_ratio: float = ...,
) -> Dict[str, np.ndarray]:
    """The points within the image: `index` into the cloud, `u`, `v` px, `distance` m, `theta` rad
    and whether the mask leaves them `visible`. Settings as the rig's `occlusion`."""

def smooth(
    cloud: Cloud,
    probabilities: Any,
    fused: Any,
    iterations: int = ...,
    distance_m: float = ...,
    intensity: float = ...,
) -> np.ndarray:
    """Distributions (N, C) float32 smoothed along the lidar's surfaces, over the points that are
    `fused` (N,) bool; the other rows come back as they are. Settings as the rig's `smoothing`."""

class VoxelMap:
    """See maps/semantic_map.py, its only user."""

    def __init__(
        self,
        voxel_size_m: float,
        dirichlet: bool,
        weight: float,
        floor: float,
        prior: List[float],
        min_range_m: float,
        max_range_m: float,
        ray_range_m: float,
        returns: List[int],
    ) -> None: ...
    def __len__(self) -> int: ...
    @property
    def memory_bytes(self) -> int: ...
    def integrate(self, *columns: Any) -> List[int]: ...
    def add(self, records: np.ndarray, bricks: np.ndarray) -> None: ...
    def add_moved(self, bricks: np.ndarray, T_theirs_ours: np.ndarray) -> None: ...
    def passes_at(
        self, x: np.ndarray, y: np.ndarray, z: np.ndarray, pose: np.ndarray
    ) -> np.ndarray: ...
    def records(self, sorted: bool) -> np.ndarray: ...
    def bricks(self, sorted: bool) -> np.ndarray: ...
    def keep_inside(self, *bounds: Any) -> Any: ...
    def clear(self) -> None: ...

def write_octomap(
    occupied: np.ndarray,
    rgb: np.ndarray,
    free: np.ndarray,
    size_m: float,
    color_path: str,
    binary_path: str,
) -> None: ...
