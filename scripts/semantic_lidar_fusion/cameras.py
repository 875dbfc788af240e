# SPDX-License-Identifier: MIT
"""Camera models of sensor_msgs/CameraInfo in numpy, for drawing.

The rules are those of semantic_lidar_fusion/camera/camera_model.h: equidistant (also `fisheye`),
plumb_bob, rational_polynomial, pinhole; rectified images use P alone.
"""

from typing import Any, Tuple

import numpy as np

from semantic_lidar_fusion.errors import DataError

_BROWN_CONRADY = {"": (0,), "plumb_bob": (0, 4, 5), "rational_polynomial": (8,)}
_EQUIDISTANT = ("equidistant", "fisheye")


class Camera:
    """Projection of one camera; size is (width, height) after ROI and binning."""

    def __init__(self, info: Any, rectified: bool = False):
        self.frame_id = info.header.frame_id
        roi = info.roi
        full = (roi.width or info.width, roi.height or info.height)
        binning = (max(1, info.binning_x), max(1, info.binning_y))
        self.size = (int(full[0] // binning[0]), int(full[1] // binning[1]))
        self.rectified = rectified
        self._scale = np.array(binning, dtype=float)
        self._offset = np.array([roi.x_offset, roi.y_offset], dtype=float)
        self._k = np.array(info.K, dtype=float).reshape(3, 3)
        self._p = np.array(info.P, dtype=float).reshape(3, 4)
        self._model, self._d = info.distortion_model, np.array(info.D, dtype=float)
        rotation = np.array(info.R, dtype=float).reshape(3, 3)
        self._rotation = rotation.T if rotation.any() else np.eye(3)
        self._limit = np.inf  # of theta (equidistant) or of the radius
        if rectified:
            self._center = np.linalg.solve(self._p[:, :3], -self._p[:, 3])
            return
        self._center = np.zeros(3)
        if self._model in _EQUIDISTANT:
            counts: Tuple[int, ...] = (4,)
            self._limit = _first_fall(
                lambda t: t * (1 + t**2 * np.polyval(self._d[::-1], t**2)), np.pi
            )
        elif self._model in _BROWN_CONRADY:
            counts = _BROWN_CONRADY[self._model]
            if len(self._d):
                self._limit = _first_fall(lambda r: r * self._radial(r * r), 10.0)
        else:
            raise DataError("camera_info: unknown distortion model %s" % self._model)
        if len(self._d) not in counts and len(self._d.nonzero()[0]):
            raise DataError(
                "camera_info: %s with %d coefficients" % (self._model or "pinhole", len(self._d))
            )

    def _radial(self, r2: np.ndarray) -> np.ndarray:
        k = np.zeros(8)
        k[: len(self._d)] = self._d[:8]
        over = 1 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))
        return over / (1 + r2 * (k[5] + r2 * (k[6] + r2 * k[7])))

    def theta(self, points: np.ndarray) -> np.ndarray:
        """(N,) angle from the optical axis, rad, of points (N, 3) in the camera's frame."""
        p = (points - self._center) @ (np.eye(3) if self.rectified else self._rotation.T)
        return np.arctan2(np.hypot(p[:, 0], p[:, 1]), p[:, 2])

    def project(self, points: np.ndarray) -> Tuple[np.ndarray, np.ndarray]:
        """Pixels (N, 2) of points (N, 3) in the camera's frame, m, and whether they are in the
        image (N,) bool. Pixels elsewhere mean nothing."""
        with np.errstate(divide="ignore", invalid="ignore"):
            if self.rectified:
                h = points @ self._p[:, :3].T + self._p[:, 3]
                valid = h[:, 2] > 0
                pixel = h[:, :2] / h[:, 2:]
            else:
                pixel, valid = self._project_raw(points @ self._rotation.T)
            pixel = (pixel - self._offset) / self._scale
            inside = (pixel >= -0.5) & (pixel < np.array(self.size) - 0.5)
        return pixel, valid & inside.all(axis=1)

    def _project_raw(self, p: np.ndarray) -> Tuple[np.ndarray, np.ndarray]:
        radius = np.hypot(p[:, 0], p[:, 1])
        skew = 0.0
        if self._model in _EQUIDISTANT:
            theta = np.arctan2(radius, p[:, 2])
            bent = theta * (1 + theta**2 * np.polyval(self._d[::-1], theta**2))
            direction = np.where(radius[:, None] > 0, p[:, :2] / radius[:, None], 0.0)
            xy, valid = direction * bent[:, None], theta <= self._limit
            skew = self._k[0, 1]
        else:
            xy = p[:, :2] / p[:, 2:]
            r2 = np.square(xy).sum(axis=1)
            valid = (p[:, 2] > 0) & (r2 <= self._limit**2)
            if len(self._d):
                p1, p2 = self._d[2], self._d[3]
                x, y = xy.T
                factor = self._radial(r2)
                xy = np.stack(
                    [
                        x * factor + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                        y * factor + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
                    ],
                    axis=1,
                )
        u = self._k[0, 0] * xy[:, 0] + skew * xy[:, 1] + self._k[0, 2]
        return np.stack([u, self._k[1, 1] * xy[:, 1] + self._k[1, 2]], axis=1), valid


def _first_fall(function: Any, end: float) -> float:
    """Where a function that rises from 0 first falls or is no number; infinite if it does not."""
    places = np.linspace(0.0, end, 20001)
    values = function(places)
    falls = np.flatnonzero(~(np.diff(values) > 0))
    return float(places[falls[0]]) if len(falls) else np.inf
