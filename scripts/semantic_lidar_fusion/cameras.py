# SPDX-License-Identifier: MIT
"""Cameras of sensor_msgs/CameraInfo, and of lens files, for drawing.

The models are the core's own (semantic_lidar_fusion/camera/camera_model.h), called through the
module semantic_lidar_fusion.core, which is built where pybind11 is installed.
"""

from typing import Any, Mapping, Optional, Tuple

import numpy as np

from semantic_lidar_fusion.errors import DataError


class Camera:
    """Projection of one camera; size is (width, height) after ROI and binning.

    ``lens`` is the rig's ``cameras[].lens`` with an absolute path. Raises DataError, naming field,
    value and rule, if camera_info or lens file is unusable or the module is not built.
    """

    def __init__(
        self,
        info: Any,
        rectified: bool = False,
        lens: Optional[Mapping[str, str]] = None,
        max_theta_deg: float = 0.0,
    ):
        try:
            from semantic_lidar_fusion import core
        except ImportError as error:
            raise DataError(
                "camera models need the compiled module: build with pybind11 and Python.h (%s)"
                % error
            ) from error
        lens = lens or {}
        self.frame_id: str = lens.get("frame") or info.header.frame_id
        roi = info.roi
        self._model = core.CameraModel(
            frame=info.header.frame_id,
            size=(info.width, info.height),
            distortion_model=info.distortion_model,
            d=list(info.D),
            k=list(info.K),
            r=list(info.R),
            p=list(info.P),
            binning=(info.binning_x, info.binning_y),
            roi=(roi.x_offset, roi.y_offset, roi.width, roi.height),
            rectified=rectified,
            max_theta_deg=max_theta_deg,
            lens_file=lens.get("file") or "",
            lens_camera=lens.get("camera") or "",
        )
        self.size: Tuple[int, int] = self._model.size
        self.max_theta: float = self._model.max_theta

    def theta(self, points: np.ndarray) -> np.ndarray:
        """(N,) angle from the optical axis, rad, of points (N, 3) in the camera's frame."""
        return np.asarray(self._model.theta(points))

    def project(self, points: np.ndarray) -> Tuple[np.ndarray, np.ndarray]:
        """Pixels (N, 2) of points (N, 3) in the camera's frame, m, and whether they are in the
        image (N,) bool. Points without a pixel have NaN."""
        pixel = np.asarray(self._model.project(points))
        with np.errstate(invalid="ignore"):
            inside = (pixel >= -0.5) & (pixel < np.array(self.size) - 0.5)
        return pixel, np.asarray(inside.all(axis=1))

    def rays(self, pixels: np.ndarray) -> np.ndarray:
        """Unit rays (N, 3) in the camera's frame of pixels (N, 2); NaN where no ray maps to one."""
        return np.asarray(self._model.rays(pixels))
