# SPDX-License-Identifier: MIT
"""Voxel maps of class distributions: what they hold, how points enter, and how voxels are read.

A map is a set of records of whole numbers (`record_dtype`), kept by the compiled module
semantic_lidar_fusion._voxel_map (include/semantic_lidar_fusion/map/voxel_map.h) or, with the same
bytes, by numpy (numpy_map). Nothing in a record depends on the order of its points; maps
of parts of a drive add up to the map of the whole. Only reading (`Reading`) normalises and clamps.

Lengths are m in the map frame, times integer ns.
"""

import dataclasses
from typing import Any, Dict, List, NamedTuple, Optional, Sequence, Tuple

import numpy as np

from semantic_lidar_fusion.bags.cloud_io import SemanticCloud
from semantic_lidar_fusion.errors import ConfigError, DataError
from semantic_lidar_fusion.labels import NO_LABEL, LabelSet

EVIDENCE_BITS = 20
UNIT = float(1 << EVIDENCE_BITS)  # of evidence, positions (m) and intensities
STATIC, DYNAMIC = 0, 1  # layers
TILE_BITS = 8  # a tile is 256 voxels wide in x and y
COUNTS = ("labelled", "occupied", "no_odometry", "out_of_range", "excluded", "invalid")


def record_dtype(class_count: int) -> np.dtype:
    """A voxel's record (72 + 8 C bytes): voxel index x y z; layer; observations (points of status 0
    to 3), of which labelled (status 0); sums of the offset from the voxel's corner (2^-20 m) and of
    the intensity (2^-20); stamps of the first and last cloud; evidence of each class (2^-20)."""
    return np.dtype(
        [("x", "<i4"), ("y", "<i4"), ("z", "<i4")]
        + [("layer", "<u4"), ("observations", "<u4"), ("labelled", "<u4")]
        + [("sum_x", "<i8"), ("sum_y", "<i8"), ("sum_z", "<i8"), ("sum_intensity", "<i8")]
        + [("first_ns", "<i8"), ("last_ns", "<i8"), ("evidence", "<i8", (class_count,))]
    )


@dataclasses.dataclass(frozen=True)
class MapConfig:
    """How a map is made and read. Maps that differ in nothing but `clamp` can be added.

    kind: "log" adds w (ln max(P, floor) - ln prior), "dirichlet" adds w P per class.
    prior: one per class, sum 1; None = uniform. dynamic: "apart" gives points of the class set's
    dynamic classes a layer of their own, "exclude" drops them, "keep" treats them like others.
    clamp: reading only; no class is taken for less likely than the best one by more than a factor
    exp(clamp) (log) - or the sum of the prior counts (dirichlet)."""

    voxel_size_m: float = 0.2
    kind: str = "log"
    weight: float = 0.7
    floor: float = 1e-3
    prior: Optional[Tuple[float, ...]] = None
    clamp: float = 5.0
    min_range_m: float = 0.0
    max_range_m: float = 0.0
    dynamic: str = "apart"

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
        return dataclasses.replace(self, clamp=1.0) == dataclasses.replace(other, clamp=1.0)


def native_module() -> Optional[Any]:
    """semantic_lidar_fusion._voxel_map, or None where it is not built."""
    try:
        from semantic_lidar_fusion import _voxel_map
    except ImportError:
        return None
    return _voxel_map


class VoxelMap:
    """A map in memory. `native`: True needs the compiled module, False takes numpy, None takes the
    faster one that is there. Both give the same bytes."""

    def __init__(self, config: MapConfig, labels: LabelSet, native: Optional[bool] = None):
        self.labels = labels
        self.config = config.checked(len(labels))
        self.dtype = record_dtype(len(labels))
        module = None if native is False else native_module()
        if native and module is None:
            raise ConfigError("the module semantic_lidar_fusion._voxel_map is not built")
        self.native = module is not None
        dynamic = [1 if info.dynamic else 0 for info in labels.classes]
        arguments = (
            self.config.voxel_size_m,
            self.config.kind == "dirichlet",
            self.config.weight,
            self.config.floor,
            list(self.config.prior or ()),
            self.config.min_range_m,
            self.config.max_range_m,
            dynamic,
            self.config.dynamic,
        )
        if module is not None:
            self._map = module.VoxelMap(*arguments)
        else:
            from semantic_lidar_fusion.maps.numpy_map import NumpyVoxelMap

            self._map = NumpyVoxelMap(*arguments)

    def __len__(self) -> int:
        """Number of voxels."""
        return len(self._map)

    @property
    def memory_bytes(self) -> int:
        return int(self._map.memory_bytes)

    def integrate(self, cloud: SemanticCloud, pose: np.ndarray) -> Dict[str, int]:
        """Adds a cloud seen from the pose T_map_lidar (4, 4) at its stamp; what became of its points
        (`COUNTS`). DataError if the cloud has other classes."""
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
            cloud.label,
            cloud.probabilities,
            pose,
            cloud.stamp_ns,
        )

    def integrate_columns(
        self,
        xyz: Sequence[np.ndarray],
        intensity: np.ndarray,
        status: np.ndarray,
        label: np.ndarray,
        probabilities: np.ndarray,
        pose: np.ndarray,
        stamp_ns: int,
    ) -> Dict[str, int]:
        """The same for columns: x, y, z and intensity (N,) float32, status and label (N,) uint8,
        probabilities (N, C) float32."""

        def as_type(values: np.ndarray, dtype: Any) -> np.ndarray:
            return values if values.dtype == dtype else values.astype(dtype)

        columns = [as_type(np.asarray(v), np.float32) for v in (*xyz, intensity)]
        columns += [as_type(np.asarray(v), np.uint8) for v in (status, label)]
        probabilities = as_type(np.asarray(probabilities), np.float32)
        if probabilities.shape[1] > 1 and probabilities.strides[1] != 4:
            probabilities = np.ascontiguousarray(probabilities)
        pose = np.ascontiguousarray(pose, dtype=np.float64)
        if not np.isfinite(pose).all():
            raise DataError("the pose of a cloud is not finite")
        result = self._map.integrate(*columns, probabilities, pose, int(stamp_ns))
        return dict(zip(COUNTS, (int(value) for value in result)))

    def add(self, records: np.ndarray) -> None:
        """Adds records (N,) of a map with the same configuration."""
        if records.dtype != self.dtype:
            raise DataError("map: records of other classes")
        self._map.add(np.ascontiguousarray(records).view(np.uint8).reshape(-1))

    def records(self, in_order: bool = True) -> np.ndarray:
        """(N,) of `record_dtype`; in canonical order (tile in x, tile in y, layer, then x, y, z)
        equal maps give equal bytes."""
        return self._map.records(in_order).view(self.dtype)

    def keep_inside(self, low: Sequence[int], high: Sequence[int]) -> None:
        """Forgets voxels outside [low, high], voxel indices x, y, z."""
        self._map.keep_inside([int(v) for v in low], [int(v) for v in high])

    def clear(self) -> None:
        self._map.clear()


def canonical_order(records: np.ndarray) -> np.ndarray:
    """Indices (N,) that sort records: tile in x, tile in y, layer, x, y, z."""
    x, y = records["x"], records["y"]
    keys = (records["z"], y, x, records["layer"], y >> TILE_BITS, x >> TILE_BITS)
    return np.lexsort(keys)


class Reading(NamedTuple):
    """What N records say.

    position: (N, 3) float64, mean of the points; intensity: (N,) float32, mean;
    probabilities: (N, C) float32; label: (N,) uint8, lowest id on ties, 255 = none; confidence:
    (N,) float32, its probability; entropy: (N,) float32, H / ln C. A voxel without labelled points
    has probabilities and confidence 0 and entropy 1."""

    position: np.ndarray
    intensity: np.ndarray
    probabilities: np.ndarray
    label: np.ndarray
    confidence: np.ndarray
    entropy: np.ndarray


def voxel_indices(records: np.ndarray) -> np.ndarray:
    """(N, 3) int64."""
    return np.stack([records[axis].astype(np.int64) for axis in "xyz"], axis=1)


def positions(records: np.ndarray, voxel_size_m: float) -> np.ndarray:
    """(N, 3) float64: mean position of the points of each voxel."""
    count = np.maximum(records["observations"], 1).astype(np.float64)
    result = voxel_indices(records) * voxel_size_m
    for column, axis in enumerate("xyz"):
        result[:, column] += records["sum_" + axis] / UNIT / count
    return result


def heights(records: np.ndarray, voxel_size_m: float) -> np.ndarray:
    """(N,) float64: z of `positions`."""
    count = np.maximum(records["observations"], 1).astype(np.float64)
    return records["z"] * voxel_size_m + records["sum_z"] / UNIT / count


def distributions(records: np.ndarray, config: MapConfig) -> np.ndarray:
    """(N, C) float64 of records with labelled points; others give the prior."""
    evidence = records["evidence"] / UNIT
    prior = np.asarray(config.prior, dtype=np.float64)
    if config.kind == "dirichlet":
        counts = np.maximum(evidence, 0.0) + prior
    else:
        logarithms = evidence + np.log(prior)
        if len(records):
            logarithms -= logarithms.max(axis=1, keepdims=True)
        counts = np.exp(np.maximum(logarithms, -config.clamp))
    return counts / counts.sum(axis=1, keepdims=True)


def labels_of(records: np.ndarray, config: MapConfig) -> np.ndarray:
    """(N,) uint8: most likely class, lowest id on ties, 255 = none."""
    # From the whole numbers themselves: rounding cannot decide it.
    prior = np.asarray(config.prior)
    bias = np.log(prior) if config.kind == "log" else prior
    evidence = records["evidence"] + np.rint(bias * UNIT).astype(np.int64)
    label = np.argmax(evidence, axis=1).astype(np.uint8)
    return np.where(records["labelled"] > 0, label, NO_LABEL).astype(np.uint8)


def labels_and_confidences(records: np.ndarray, config: MapConfig) -> Tuple[np.ndarray, np.ndarray]:
    """(N,) uint8 and (N,) float32 of `read`, without the rest (single precision throughout)."""
    label = labels_of(records, config)
    labelled = label != NO_LABEL
    p = (records["evidence"] * np.float32(1 / UNIT)).astype(np.float32)
    if config.kind == "dirichlet":
        p = np.maximum(p, 0) + np.asarray(config.prior, dtype=np.float32)
    else:
        p += np.log(np.asarray(config.prior)).astype(np.float32)
        p -= p.max(axis=1, keepdims=True)
        np.maximum(p, np.float32(-config.clamp), out=p)
        np.exp(p, out=p)
    best = p[np.arange(len(p)), np.minimum(label, p.shape[1] - 1)]
    return label, np.where(labelled, best / p.sum(axis=1), np.float32(0)).astype(np.float32)


def read(records: np.ndarray, config: MapConfig) -> Reading:
    """Reads records of a map with this (checked) configuration."""
    label = labels_of(records, config)
    labelled = label != NO_LABEL
    p = distributions(records, config)
    confidence = p[np.arange(len(p)), np.minimum(label, p.shape[1] - 1)]
    with np.errstate(divide="ignore", invalid="ignore"):
        entropy = -np.sum(np.where(p > 0, p * np.log(p), 0.0), axis=1)
    entropy = entropy / np.log(p.shape[1]) if p.shape[1] > 1 else np.zeros(len(p))
    count = np.maximum(records["observations"], 1)
    return Reading(
        positions(records, config.voxel_size_m),
        (records["sum_intensity"] / UNIT / count).astype(np.float32),
        np.where(labelled[:, None], p, 0.0).astype(np.float32),
        label,
        np.where(labelled, confidence, 0.0).astype(np.float32),
        np.where(labelled, np.clip(entropy, 0.0, 1.0), 1.0).astype(np.float32),
    )
