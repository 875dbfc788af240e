# SPDX-License-Identifier: MIT
"""The voxel map in numpy: plain, slower, and bit for bit what the compiled module makes.

It serves where that module is not built, and as its reference in tests. Every operation in floating
point is one that IEEE 754 defines, in the order of the C++ source."""

import math
from typing import List, Sequence

import numpy as np

from semantic_lidar_fusion.maps.semantic_map import (
    EVIDENCE_BITS,
    UNIT,
    canonical_order,
    record_dtype,
)

_GUARD_BITS = 6  # of the logarithm, below the bits of the result
_ROOT_HALF = np.int32(0x3F3504F3)  # the bits of sqrt(1/2)
_MAX_INDEX = float(1 << 29)
_MAX_INTENSITY = np.float32(1e6)
# ln(1 + f) = f - f^2/2 + f^3 (k0 + f (k1 + ...)) (Cephes, logf)
_LOG = np.array(
    [
        3.3333331174e-1,
        -2.4999993993e-1,
        2.0000714765e-1,
        -1.6668057665e-1,
        1.4249322787e-1,
        -1.2420140846e-1,
        1.1676998740e-1,
        -1.1514610310e-1,
        7.0376836292e-2,
    ],
    dtype=np.float32,
)


def merged(records: np.ndarray) -> np.ndarray:
    """Records (M,) in canonical order, those of the same voxel added up."""
    if not len(records):
        return records
    records = records[canonical_order(records)]
    new = np.ones(len(records), dtype=bool)
    new[1:] = False
    for name in ("x", "y", "z", "layer"):
        new[1:] |= records[name][1:] != records[name][:-1]
    starts = np.flatnonzero(new)
    result = records[starts].copy()
    for name in ("sum_x", "sum_y", "sum_z", "sum_intensity", "evidence"):
        result[name] = np.add.reduceat(records[name], starts, axis=0)
    for name in ("observations", "labelled"):
        total = np.add.reduceat(records[name].astype(np.uint64), starts)
        result[name] = np.minimum(total, np.uint64(0xFFFFFFFF))
    result["first_ns"] = np.minimum.reduceat(records["first_ns"], starts)
    result["last_ns"] = np.maximum.reduceat(records["last_ns"], starts)
    return result


class NumpyVoxelMap:
    """The methods of _voxel_map.VoxelMap."""

    def __init__(
        self,
        voxel_size_m: float,
        dirichlet: bool,
        weight: float,
        floor: float,
        prior: Sequence[float],
        min_range_m: float,
        max_range_m: float,
        dynamic: Sequence[int],
        dynamic_points: str,
    ):
        self._size = voxel_size_m
        self._dirichlet = dirichlet
        self._floor = np.float32(floor)
        self._least = min_range_m * min_range_m
        self._most = max_range_m * max_range_m if max_range_m > 0 else np.inf
        self._dynamic = np.zeros(256, dtype=bool)
        self._dynamic[: len(dynamic)] = np.asarray(dynamic, dtype=bool)
        self._dynamic_points = dynamic_points
        self._dtype = record_dtype(len(prior))
        fine = weight * 2.0 ** (EVIDENCE_BITS + _GUARD_BITS)
        self._scale = np.float32(weight * UNIT if dirichlet else fine)
        self._octave = np.int32(_round(fine * 0.69314718055994531))
        self._prior = np.array([_round(fine * math.log(p)) for p in prior], dtype=np.int32)
        self.clear()

    def clear(self) -> None:
        self._merged = np.zeros(0, dtype=self._dtype)
        self._parts: List[np.ndarray] = []

    def _all(self) -> np.ndarray:
        if self._parts:
            self._merged = merged(np.concatenate([self._merged] + self._parts))
            self._parts = []
        return self._merged

    def __len__(self) -> int:
        return len(self._all())

    @property
    def memory_bytes(self) -> int:
        return self._merged.nbytes + sum(part.nbytes for part in self._parts)

    def add(self, data: np.ndarray) -> None:
        self._parts.append(merged(data.view(self._dtype)))
        if sum(map(len, self._parts)) > max(1 << 18, len(self._merged)):
            self._all()

    def records(self, in_order: bool) -> np.ndarray:
        del in_order  # they always are
        return self._all().view(np.uint8).reshape(-1).copy()

    def keep_inside(self, low: Sequence[int], high: Sequence[int]) -> None:
        records = self._all()
        kept = np.ones(len(records), dtype=bool)
        for axis, least, most in zip("xyz", low, high):
            kept &= (records[axis] >= least) & (records[axis] <= most)
        self._merged = records[kept]

    def _evidence(self, probabilities: np.ndarray) -> np.ndarray:
        """(N, C) int64."""
        one = np.float32(1)
        if self._dirichlet:
            p = np.minimum(np.maximum(probabilities, np.float32(0)), one)
            return (p * self._scale + np.float32(0.5)).astype(np.int32).astype(np.int64)
        p = np.minimum(np.maximum(probabilities, self._floor), one)
        above = np.ascontiguousarray(p).view(np.int32) - _ROOT_HALF
        exponent = above >> 23
        f = ((above & np.int32(0x007FFFFF)) + _ROOT_HALF).view(np.float32) - one
        y = np.full_like(f, _LOG[8])
        for k in range(7, -1, -1):
            y = y * f + _LOG[k]
        square = f * f
        y = f * square * y - np.float32(0.5) * square
        fine = ((f + y) * self._scale).astype(np.int32)
        total = exponent * self._octave + fine - self._prior
        return ((total + np.int32(1 << (_GUARD_BITS - 1))) >> _GUARD_BITS).astype(np.int64)

    def integrate(
        self,
        x: np.ndarray,
        y: np.ndarray,
        z: np.ndarray,
        intensity: np.ndarray,
        status: np.ndarray,
        label: np.ndarray,
        probabilities: np.ndarray,
        pose: np.ndarray,
        stamp_ns: int,
    ) -> List[int]:
        known = status <= 3
        px, py, pz = (v.astype(np.float64) for v in (x, y, z))
        squared_range = px * px + py * py + pz * pz
        finite = squared_range <= np.finfo(np.float64).max
        near = (squared_range >= self._least) & (squared_range <= self._most)
        chosen = known & finite & near
        moving = chosen & (status == 0) & self._dynamic[label]
        excluded = 0
        layer = np.zeros(len(x), dtype=np.uint32)
        if self._dynamic_points == "exclude":
            excluded = int(moving.sum())
            chosen &= ~moving
        elif self._dynamic_points == "apart":
            layer[moving] = 1
        counts = [0, 0, int((~known).sum()), int((known & finite & ~near).sum()), excluded, 0]
        counts[5] = int((known & ~finite).sum())
        indices, offsets = [], []
        inside = np.ones(len(x), dtype=bool)
        for row in pose[:3]:
            at = row[0] * px + row[1] * py + row[2] * pz + row[3]
            with np.errstate(invalid="ignore"):
                cell = at / self._size
                good = (cell < _MAX_INDEX) & (cell > -_MAX_INDEX)
            inside &= good
            whole = np.floor(np.where(good, cell, 0.0))
            indices.append(whole.astype(np.int32))
            offset = np.floor((np.where(good, at, 0.0) - whole * self._size) * UNIT + 0.5)
            offsets.append(offset.astype(np.int64))
        counts[3] += int((chosen & ~inside).sum())
        chosen &= inside
        labelled = chosen & (status == 0)
        broken = labelled & ~np.isfinite(probabilities).all(axis=1)
        counts[5] += int(broken.sum())
        labelled &= ~broken
        counts[0] = int(labelled.sum())
        counts[1] = int(chosen.sum()) - counts[0]
        points = np.zeros(counts[0] + counts[1], dtype=self._dtype)
        for axis, index, offset in zip("xyz", indices, offsets):
            points[axis] = index[chosen]
            points["sum_" + axis] = offset[chosen]
        usable = np.where(np.abs(intensity) <= _MAX_INTENSITY, intensity, np.float32(0))
        points["sum_intensity"] = np.floor(usable[chosen].astype(np.float64) * UNIT + 0.5)
        points["layer"] = layer[chosen]
        points["observations"] = 1
        points["labelled"] = labelled[chosen]
        points["first_ns"] = points["last_ns"] = stamp_ns
        points["evidence"][labelled[chosen]] = self._evidence(probabilities[labelled])
        self.add(points)
        return counts


def _round(value: float) -> int:
    """Half away from zero, as lround."""
    return int(np.floor(abs(value) + 0.5)) * (1 if value >= 0 else -1)
