# SPDX-License-Identifier: MIT
"""Voxel maps of class distributions: how they are configured, and how points enter.

A map is a set of records of whole numbers and the space that rays crossed (`records`), kept by the
compiled module semantic_lidar_fusion._core (include/semantic_lidar_fusion/map/voxel_map.h) or,
with the same bytes, by numpy (numpy_map). What points leave does not depend on their order; rays
count what came after, so that clouds and maps are added in the order of time. Only `reading`
normalises, clamps and judges.

Lengths are m in the map frame, times integer ns.
"""

import dataclasses
import importlib
from typing import Any, Dict, List, Optional, Sequence, Tuple

import numpy as np

from semantic_lidar_fusion.bags.cloud_io import SemanticCloud
from semantic_lidar_fusion.errors import ConfigError, DataError
from semantic_lidar_fusion.labels import LabelSet
from semantic_lidar_fusion.maps.numpy_map import NumpyVoxelMap
from semantic_lidar_fusion.maps.records import BRICK, record_dtype

COUNTS = ("labelled", "occupied", "no_odometry", "out_of_range", "invalid")
# Fields of MapConfig that act on reading alone.
_READING = ("clamp", "dynamic", "footprint_m")


@dataclasses.dataclass(frozen=True)
class MapConfig:
    """How a map is made and read. Maps that differ in what acts on reading alone can be added.

    kind: "log" adds w (ln max(P, floor) - ln prior) for each look, "dirichlet" adds w P.
    prior: one per class, sum 1; None = uniform. ray_range_m: how far from the lidar rays clear;
    0 = no rays.
    Reading only: clamp: no class is taken for less likely than the best one by more than a factor
    exp(clamp) (log) - or the sum of the prior counts (dirichlet). dynamic: "apart" gives voxels of
    the class set's dynamic classes a layer of their own, "exclude" leaves them out, "keep" treats
    them like others. footprint_m: half the width of the vehicle, whose path is free in 2-D maps;
    0 = it is not."""

    voxel_size_m: float = 0.2
    kind: str = "log"
    weight: float = 1.0
    floor: float = 1e-2
    prior: Optional[Tuple[float, ...]] = None
    clamp: float = 4.5
    min_range_m: float = 0.0
    max_range_m: float = 120.0
    ray_range_m: float = 45.0
    dynamic: str = "apart"
    footprint_m: float = 0.9

    def problems(self, class_count: int) -> List[str]:
        """What is wrong, one sentence each."""
        found = []

        def check(name: str, good: bool, rule: str) -> None:
            if not good:
                found.append("%s = %s: must be %s" % (name, getattr(self, name), rule))

        check("voxel_size_m", 1e-3 <= self.voxel_size_m <= 1e3, "from 0.001 to 1000")
        check("kind", self.kind in ("log", "dirichlet"), "log or dirichlet")
        check("weight", 0 < self.weight <= 1, "above 0 and at most 1")
        check("floor", 1e-6 <= self.floor < 1, "from 1e-6 to below 1")
        check("clamp", 0 < self.clamp <= 1000, "above 0 and at most 1000")
        check("min_range_m", self.min_range_m >= 0, "0 or more")
        check(
            "max_range_m",
            self.max_range_m == 0 or self.max_range_m > self.min_range_m,
            "0 (no limit) or above min_range_m",
        )
        check("ray_range_m", 0 <= self.ray_range_m <= 1e4, "from 0 (no rays) to 10000")
        check("footprint_m", 0 <= self.footprint_m <= 20, "from 0 to 20")
        check("dynamic", self.dynamic in ("apart", "exclude", "keep"), "apart, exclude or keep")
        if self.prior is not None:
            check("prior", len(self.prior) == class_count, "of %d classes" % class_count)
            check("prior", all(1e-6 <= p <= 1 for p in self.prior), "from 1e-6 to 1 each")
            check("prior", abs(sum(self.prior) - 1) <= 1e-6, "of sum 1")
        return found

    def checked(self, class_count: int) -> "MapConfig":
        """Itself with the prior written out; ConfigError with every problem."""
        problems = self.problems(class_count)
        if problems:
            raise ConfigError("map: " + "; ".join(problems))
        prior = self.prior or (1.0 / class_count,) * class_count
        return dataclasses.replace(self, prior=tuple(float(p) for p in prior))

    def tree(self) -> Dict[str, Any]:
        return dataclasses.asdict(self)

    @staticmethod
    def from_tree(tree: Dict[str, Any]) -> "MapConfig":
        values = dict(tree)
        if values.get("prior") is not None:
            values["prior"] = tuple(values["prior"])
        try:
            return MapConfig(**values)
        except TypeError as error:
            raise DataError("map: %s" % error) from error

    def can_add(self, other: "MapConfig") -> bool:
        """Whether the evidence of two maps means the same."""
        alike = {name: getattr(self, name) for name in _READING}
        return self == dataclasses.replace(other, **alike)


def native_module() -> Optional[Any]:
    """semantic_lidar_fusion._core, or None where it is not built."""
    try:
        return importlib.import_module("semantic_lidar_fusion._core")
    except ImportError:
        return None


def _as_type(values: np.ndarray, dtype: Any) -> np.ndarray:
    return values if values.dtype == dtype else values.astype(dtype)


class VoxelMap:
    """A map in memory. `native`: True needs the compiled module, False takes numpy, None takes the
    faster one that is there. Both give the same bytes."""

    def __init__(self, config: MapConfig, labels: LabelSet, native: Optional[bool] = None):
        self.labels = labels
        self.config = config.checked(len(labels))
        self.dtype = record_dtype(len(labels))
        module = None if native is False else native_module()
        if native and module is None:
            raise ConfigError("the module semantic_lidar_fusion._core is not built")
        self.native = module is not None
        make = NumpyVoxelMap if module is None else module.VoxelMap
        self._map: Any = make(
            self.config.voxel_size_m,
            self.config.kind == "dirichlet",
            self.config.weight,
            self.config.floor,
            list(self.config.prior or ()),
            self.config.min_range_m,
            self.config.max_range_m,
            self.config.ray_range_m,
            [int(value) for value in labels.returns],
        )

    def __len__(self) -> int:
        """Number of voxels."""
        return len(self._map)

    @property
    def memory_bytes(self) -> int:
        return int(self._map.memory_bytes)

    def integrate(
        self, cloud: SemanticCloud, pose: np.ndarray, origins: Optional[np.ndarray] = None
    ) -> Dict[str, int]:
        """Adds a cloud seen from the pose T_map_lidar (4, 4) at its stamp; what became of its points
        (`COUNTS`). `origins` (N, 3): where the lidar was when it measured each point, in the map
        frame; None: at the pose. DataError if the cloud has other classes."""
        if cloud.class_names != self.labels.names:
            raise DataError(
                "the cloud's classes are %s; the map's are %s"
                % (", ".join(cloud.class_names), ", ".join(self.labels.names))
            )
        points = cloud.points
        intensity = cloud.optional("intensity")
        if intensity is None:
            intensity = np.zeros(len(points), dtype=np.float32)
        return self.integrate_columns(
            [points[axis] for axis in "xyz"],
            intensity,
            cloud.status,
            cloud.probabilities,
            pose,
            cloud.stamp_ns,
            origins,
        )

    def integrate_columns(
        self,
        xyz: Sequence[np.ndarray],
        intensity: np.ndarray,
        status: np.ndarray,
        probabilities: np.ndarray,
        pose: np.ndarray,
        stamp_ns: int,
        origins: Optional[np.ndarray] = None,
        passes: Optional[np.ndarray] = None,
    ) -> Dict[str, int]:
        """The same for columns: x, y, z and intensity (N,) float32, status (N,) uint8,
        probabilities (N, C) float32. `passes` (N,) uint8: what `passes_at` said of these points in
        another map; they take the place of rays."""
        columns = [_as_type(np.asarray(v), np.float32) for v in (*xyz, intensity)]
        columns.append(_as_type(np.asarray(status), np.uint8))
        probabilities = _as_type(np.asarray(probabilities), np.float32)
        if probabilities.shape[1] > 1 and probabilities.strides[1] != 4:
            probabilities = np.ascontiguousarray(probabilities)
        pose = np.ascontiguousarray(pose, dtype=np.float64)
        if not np.isfinite(pose).all():
            raise DataError("the pose of a cloud is not finite")
        begin = np.zeros((0, 3)) if origins is None else origins
        begin = np.ascontiguousarray(begin, dtype=np.float64)
        known = np.zeros(0, dtype=np.uint8) if passes is None else passes
        result = self._map.integrate(*columns, probabilities, pose, int(stamp_ns), begin, known)
        return dict(zip(COUNTS, (int(value) for value in result)))

    def add(self, records: np.ndarray, bricks: Optional[np.ndarray] = None) -> None:
        """Adds records (N,) and bricks (M,) of a later map with the same configuration."""
        bricks = np.zeros(0, dtype=BRICK) if bricks is None else bricks
        if records.dtype != self.dtype or bricks.dtype != BRICK:
            raise DataError("map: records of other classes")
        parts = [
            np.ascontiguousarray(part).view(np.uint8).reshape(-1) for part in (records, bricks)
        ]
        self._map.add(*parts)

    def add_moved(self, bricks: np.ndarray, T_theirs_ours: np.ndarray) -> None:
        """Adds bricks (M,) of a map whose frame lies elsewhere: a voxel here was crossed as often as
        theirs at its centre. Voxels with a record stay as they are."""
        data = np.ascontiguousarray(bricks).view(np.uint8).reshape(-1)
        self._map.add_moved(data, np.ascontiguousarray(T_theirs_ours, dtype=np.float64))

    def passes_at(self, xyz: Sequence[np.ndarray], pose: np.ndarray) -> np.ndarray:
        """(N,) uint8: passes_after of the voxel of each point, 0 without one; x, y, z (N,) in the lidar
        frame, seen from the pose T_map_lidar (4, 4)."""
        columns = [_as_type(np.asarray(v), np.float32) for v in xyz]
        found: np.ndarray = self._map.passes_at(
            *columns, np.ascontiguousarray(pose, dtype=np.float64)
        )
        return found

    def records(self, in_order: bool = True) -> np.ndarray:
        """(N,) of `record_dtype`; in canonical order (tile in x, tile in y, then x, y, z) equal maps
        give equal bytes."""
        return self._map.records(in_order).view(self.dtype)

    def bricks(self, in_order: bool = True) -> np.ndarray:
        """(M,) of BRICK: crossed voxels without a record, likewise."""
        return self._map.bricks(in_order).view(BRICK)

    def keep_inside(self, low: Sequence[int], high: Sequence[int]) -> None:
        """Forgets voxels outside [low, high], voxel indices x, y, z."""
        self._map.keep_inside([int(v) for v in low], [int(v) for v in high])

    def clear(self) -> None:
        self._map.clear()
