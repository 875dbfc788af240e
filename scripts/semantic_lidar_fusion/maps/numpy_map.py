# SPDX-License-Identifier: MIT
"""The voxel map in numpy: plain, slower, and bit for bit what the compiled module makes.

It serves where that module is not built, and as its reference in tests. Every operation in floating
point is one that IEEE 754 defines, in the order of the C++ source."""

import math
from typing import List, Sequence, Tuple

import numpy as np

from semantic_lidar_fusion.maps.records import (
    BRICK,
    EVIDENCE_BITS,
    MAX_PASSES,
    UNIT,
    bricks_of,
    canonical_order,
    free_voxels,
    record_dtype,
    voxel_indices,
)

_GUARD_BITS = 6  # of the logarithm, below the bits of the result
_ROOT_HALF = np.int32(0x3F3504F3)  # the bits of sqrt(1/2)
_MAX_INDEX = float(1 << 29)
_MAX_INTENSITY = np.float32(1e6)
_LEAST_SHARE = 1e-3  # of a look's probability, on classes that returns can be of
_LEAST_CHORD = 0.8  # of a ray through a voxel, in edges of it
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


class _Keys:
    """Voxel indices as sortable numbers, relative to the least one of all that are compared."""

    def __init__(self, *indices: np.ndarray):
        every = np.concatenate(indices)
        self._low = every.min(axis=0) if len(every) else np.zeros(3, dtype=np.int64)
        span = every.max(axis=0) - self._low + 1 if len(every) else np.ones(3, dtype=np.int64)
        self._span = [int(v) for v in span]

    def of(self, indices: np.ndarray) -> np.ndarray:
        x, y, z = (indices - self._low).T
        return (x * self._span[1] + y) * self._span[2] + z


def _find(sorted_keys: np.ndarray, keys: np.ndarray) -> np.ndarray:
    """(M,) position of each key, -1 = none."""
    if not len(sorted_keys):
        return np.full(len(keys), -1)
    at = np.minimum(np.searchsorted(sorted_keys, keys), len(sorted_keys) - 1)
    return np.where(sorted_keys[at] == keys, at, -1)


def merge_records(records: np.ndarray, bits: int, voxel_size_m: float) -> np.ndarray:
    """Records (M,) of voxels 2^bits as wide, in canonical order: points and evidence added up. What
    rays say of parts of a voxel is nothing about the whole: passes are 0."""
    coarse = records.copy()
    for axis in "xyz":
        coarse[axis] = records[axis] >> bits
        within = (records[axis] - (coarse[axis] << bits)) * (voxel_size_m * UNIT)
        coarse["sum_" + axis] += np.rint(within).astype(np.int64) * records["observations"]
    coarse["passes"] = coarse["passes_after"] = 0
    keys = _Keys(voxel_indices(coarse)).of(voxel_indices(coarse))
    result, _ = _added(coarse, keys)
    return result[canonical_order(result)]


def _added(records: np.ndarray, keys: np.ndarray) -> Tuple[np.ndarray, np.ndarray]:
    """Records with the same key added up, but for their passes; and their keys, in ascending order."""
    order = np.argsort(keys, kind="stable")
    starts = np.flatnonzero(np.append(True, np.diff(keys[order]) != 0)[: len(order)])
    result = records[order][starts].copy()
    if len(result):
        for name in ("sum_x", "sum_y", "sum_z", "sum_intensity", "evidence"):
            result[name] = np.add.reduceat(records[name][order], starts, axis=0)
        for name in ("observations", "looks", "labelled"):
            total = np.add.reduceat(records[name][order].astype(np.uint64), starts)
            result[name] = np.minimum(total, np.uint64(0xFFFFFFFF))
        result["first_ns"] = np.minimum.reduceat(records["first_ns"][order], starts)
        result["last_ns"] = np.maximum.reduceat(records["last_ns"][order], starts)
    return result, keys[order][starts]


class _State:
    """Records in canonical order, and crossed voxels (N, 3) without a record with their passes."""

    def __init__(self, records: np.ndarray, free: np.ndarray, passes: np.ndarray):
        self.records, self.free, self.passes = records, free, passes

    def then(self, later: "_State") -> "_State":
        """Both, one after the other in time."""
        mine, other = voxel_indices(self.records), voxel_indices(later.records)
        keys = _Keys(mine, other, self.free, later.free)
        k_mine, k_other = keys.of(mine), keys.of(other)
        k_free, k_later = keys.of(self.free), keys.of(later.free)
        both = np.concatenate([self.records, later.records])
        result, k_result = _added(both, np.concatenate([k_mine, k_other]))
        before = _passes(k_result, (k_mine, self.records["passes"]), (k_free, self.passes))
        after = _passes(k_result, (k_other, later.records["passes"]), (k_later, later.passes))
        result["passes"] = np.minimum(before + after, MAX_PASSES)
        since = _passes(k_result, (k_mine, self.records["passes_after"]), (k_free, self.passes))
        since = np.minimum(since + after, MAX_PASSES)
        seen = np.isin(k_result, k_other)
        latest = _passes(k_result, (k_other, later.records["passes_after"]))
        result["passes_after"] = np.where(seen, latest, since)
        free = np.concatenate([self.free, later.free])
        k_all = np.concatenate([k_free, k_later])
        kept = ~np.isin(k_all, k_result)
        unique, first, of = np.unique(k_all[kept], return_index=True, return_inverse=True)
        counts = np.bincount(of, np.concatenate([self.passes, later.passes])[kept], len(unique))
        return _State(
            result[canonical_order(result)],
            free[kept][first],
            np.minimum(counts, MAX_PASSES).astype(np.int64),
        )


def _passes(keys: np.ndarray, *sources: Tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """(N,) int64: what the sources (keys, counts) hold for each key; of one key, one source has it."""
    result = np.zeros(len(keys), dtype=np.int64)
    for own, counts in sources:
        order = np.argsort(own)
        at = _find(own[order], keys)
        result += np.where(at >= 0, counts[order][at].astype(np.int64), 0) if len(own) else 0
    return result


def crossed_voxels(origin: np.ndarray, end: np.ndarray, reach: float) -> np.ndarray:
    """(M, 3) int64: voxels that rays from `origin` to `end` (N, 3; in voxels) cross within `reach`
    of their origins, with repetitions. See src/map/free_space.cpp."""
    way = end - origin
    length = np.sqrt(way[:, 0] * way[:, 0] + way[:, 1] * way[:, 1] + way[:, 2] * way[:, 2])
    cell = np.floor(origin)
    with np.errstate(divide="ignore", invalid="ignore"):
        delta = np.where(way != 0.0, 1.0 / np.abs(way), np.inf)
        first = np.where(way > 0.0, cell + 1.0 - origin, origin - cell)
        leave = np.where(way != 0.0, first * delta, np.inf)
        last = np.where(length > reach, reach / length, 1.0)
        least = _LEAST_CHORD / length
    step = np.where(way > 0.0, 1, -1)
    at = cell.astype(np.int64)
    entered = np.zeros(len(way))
    result = []
    while len(at):
        leaves = np.minimum(leave.min(axis=1), last)
        result.append(at[leaves - entered >= least])
        # The first axis of the least, as the comparisons of the C++ source take it.
        axis = np.argmin(leave, axis=1)
        rows = np.arange(len(at))
        goes_on = leave[rows, axis] < last
        at, leave, delta, step = at[goes_on], leave[goes_on], delta[goes_on], step[goes_on]
        last, least, entered = last[goes_on], least[goes_on], leaves[goes_on]
        rows, axis = np.arange(len(at)), axis[goes_on]
        leave[rows, axis] += delta[rows, axis]
        at[rows, axis] += step[rows, axis]
    return np.concatenate(result) if result else np.zeros((0, 3), dtype=np.int64)


class NumpyVoxelMap:
    """The methods of _core.VoxelMap."""

    def __init__(
        self,
        voxel_size_m: float,
        dirichlet: bool,
        weight: float,
        floor: float,
        prior: Sequence[float],
        min_range_m: float,
        max_range_m: float,
        ray_range_m: float,
        returns: Sequence[int],
    ):
        self._size = voxel_size_m
        self._dirichlet = dirichlet
        self._floor = np.float32(floor)
        self._least = min_range_m * min_range_m
        self._most = max_range_m * max_range_m if max_range_m > 0 else np.inf
        self._reach = ray_range_m / voxel_size_m
        self._returns = np.asarray(returns, dtype=bool)
        self._dtype = record_dtype(len(prior))
        fine = weight * 2.0 ** (EVIDENCE_BITS + _GUARD_BITS)
        self._scale = np.float32(weight * UNIT if dirichlet else fine)
        self._octave = np.int32(_round(fine * 0.69314718055994531))
        self._prior = np.array([_round(fine * math.log(p)) for p in prior], dtype=np.int32)
        self.clear()

    def clear(self) -> None:
        self._state = _State(
            np.zeros(0, self._dtype), np.zeros((0, 3), np.int64), np.zeros(0, np.int64)
        )

    def __len__(self) -> int:
        return len(self._state.records)

    @property
    def memory_bytes(self) -> int:
        return self._state.records.nbytes + self._state.free.nbytes + self._state.passes.nbytes

    def add(self, records: np.ndarray, bricks: np.ndarray) -> None:
        free, passes = free_voxels(bricks.view(BRICK))
        if not self._reach:
            free, passes = free[:0], passes[:0]
        self._state = self._state.then(_State(records.view(self._dtype), free, passes))

    def records(self, in_order: bool) -> np.ndarray:
        del in_order  # they always are
        return self._state.records.view(np.uint8).reshape(-1).copy()

    def bricks(self, in_order: bool) -> np.ndarray:
        del in_order
        bricks = bricks_of(self._state.free, self._state.passes)
        return bricks.view(np.uint8).reshape(-1)

    def keep_inside(self, low: Sequence[int], high: Sequence[int]) -> None:
        def inside(indices: np.ndarray) -> np.ndarray:
            return np.asarray(((indices >= low) & (indices <= high)).all(axis=1))

        state = self._state
        kept = inside(state.free)
        records = state.records[inside(voxel_indices(state.records))]
        self._state = _State(records, state.free[kept], state.passes[kept])

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
        probabilities: np.ndarray,
        pose: np.ndarray,
        stamp_ns: int,
        origins: np.ndarray,
        passes: np.ndarray,
    ) -> List[int]:
        known = status <= 3
        px, py, pz = (v.astype(np.float64) for v in (x, y, z))
        squared_range = px * px + py * py + pz * pz
        finite = (squared_range > 0) & (squared_range <= np.finfo(np.float64).max)
        near = (squared_range >= self._least) & (squared_range <= self._most)
        chosen = known & finite & near
        counts = [0, 0, int((~known).sum()), int((known & finite & ~near).sum()), 0]
        counts[4] = int((known & ~finite).sum())
        at, whole, offsets, inside = self._placed((px, py, pz), pose)
        counts[3] += int((chosen & ~inside).sum())
        chosen &= inside
        labelled = chosen & (status == 0)
        broken = labelled & ~np.isfinite(probabilities).all(axis=1)
        counts[4] += int(broken.sum())
        labelled &= ~broken
        counts[0] = int(labelled.sum())
        counts[1] = int(chosen.sum()) - counts[0]
        indices = whole[chosen].astype(np.int64)
        usable = np.where(np.abs(intensity) <= _MAX_INTENSITY, intensity, np.float32(0))
        intensities = np.floor(usable[chosen].astype(np.float64) * UNIT + 0.5).astype(np.int64)
        looks, first = self._looks(
            indices, offsets[chosen], intensities, labelled[chosen], probabilities[chosen], stamp_ns
        )
        if len(passes):
            self._add_passed(looks, indices, passes[chosen])
            return counts
        free = np.zeros((0, 3), dtype=np.int64)
        if self._reach and len(first):
            begin = np.broadcast_to(pose[:3, 3], (len(x), 3)) if not len(origins) else origins
            free = self._crossed(begin[chosen][first], at[chosen][first], voxel_indices(looks))
        self._state = self._state.then(_State(looks, free, np.ones(len(free), dtype=np.int64)))
        return counts

    def _placed(
        self, xyz: Sequence[np.ndarray], pose: np.ndarray
    ) -> Tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Positions (N, 3) m, voxels (N, 3), offsets from their corners (N, 3; 2^-20 m) and whether
        they are usable (N,), of points x, y, z (N,) float64."""
        x, y, z = xyz
        at, inside = np.empty((len(x), 3)), np.ones(len(x), dtype=bool)
        whole, offsets = np.empty((len(x), 3)), np.empty((len(x), 3), dtype=np.int64)
        for axis, row in enumerate(pose[:3]):
            with np.errstate(invalid="ignore"):
                at[:, axis] = row[0] * x + row[1] * y + row[2] * z + row[3]
                cell = at[:, axis] / self._size
                good = (cell < _MAX_INDEX) & (cell > -_MAX_INDEX)
            inside &= good
            whole[:, axis] = np.floor(np.where(good, cell, 0.0))
            within = np.where(good, at[:, axis], 0.0) - whole[:, axis] * self._size
            offsets[:, axis] = np.floor(within * UNIT + 0.5)
        return at, whole, offsets, inside

    def passes_at(
        self, x: np.ndarray, y: np.ndarray, z: np.ndarray, pose: np.ndarray
    ) -> np.ndarray:
        _, whole, _, inside = self._placed([v.astype(np.float64) for v in (x, y, z)], pose)
        voxels, mine = whole.astype(np.int64), voxel_indices(self._state.records)
        keys = _Keys(voxels, mine)
        source = (keys.of(mine), self._state.records["passes_after"])
        return np.where(inside, _passes(keys.of(voxels), source), 0).astype(np.uint8)

    def _add_passed(self, looks: np.ndarray, indices: np.ndarray, passes: np.ndarray) -> None:
        """Adds a cloud's looks; their voxels have passed the least of their points (indices (N, 3)),
        of all clouds."""
        mine = self._state.records
        own, theirs = voxel_indices(mine), voxel_indices(looks)
        keys = _Keys(own, theirs)
        k_own, k_looks, k_points = keys.of(own), keys.of(theirs), keys.of(indices)
        least: np.ndarray = np.full(len(looks), MAX_PASSES, dtype=np.int64)
        order = np.argsort(k_looks)
        np.minimum.at(least, order[_find(k_looks[order], k_points)], passes)
        known = np.isin(k_looks, k_own)
        before = _passes(k_looks, (k_own, mine["passes"]))
        least = np.where(known, np.minimum(least, before), least)
        self._state = self._state.then(_State(looks, np.zeros((0, 3), np.int64), least[:0]))
        records = self._state.records
        k_all = keys.of(voxel_indices(records))
        now = np.where(np.isin(k_all, k_looks), _passes(k_all, (k_looks, least)), records["passes"])
        records["passes"] = records["passes_after"] = now

    def add_moved(self, bricks: np.ndarray, T_theirs_ours: np.ndarray) -> None:
        voxels, passes = free_voxels(bricks.view(BRICK))
        if not self._reach or not len(voxels):
            return
        moved = T_theirs_ours[:3].copy()
        moved[:, 3] = T_theirs_ours[:3, 3] / self._size
        # All that may have their centre in one of theirs: around the centre of each.
        here = np.floor((voxels + 0.5 - moved[:, 3]) @ moved[:, :3]).astype(np.int64)
        around = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3), axis=-1).reshape(-1, 1, 3)
        ours = np.unique((here + around).reshape(-1, 3), axis=0)
        x, y, z = (ours + 0.5).T
        at = [row[0] * x + (row[1] * y + row[2] * z + row[3]) for row in moved]
        theirs = np.floor(np.stack(at, axis=1)).astype(np.int64)
        keys = _Keys(theirs, voxels)
        found = _passes(keys.of(theirs), (keys.of(voxels), passes))
        mine = voxel_indices(self._state.records)
        keys = _Keys(ours, mine)
        kept = (found > 0) & ~np.isin(keys.of(ours), keys.of(mine))
        nothing = np.zeros(0, self._dtype)
        self._state = self._state.then(_State(nothing, ours[kept], found[kept]))

    def _looks(
        self,
        indices: np.ndarray,
        offsets: np.ndarray,
        intensities: np.ndarray,
        labelled: np.ndarray,
        probabilities: np.ndarray,
        stamp_ns: int,
    ) -> Tuple[np.ndarray, np.ndarray]:
        """Records of a cloud's points in canonical order, and the first point of each."""
        keys = _Keys(indices).of(indices)
        _, first, of = np.unique(keys, return_index=True, return_inverse=True)
        records = np.zeros(len(first), dtype=self._dtype)
        for column, axis in enumerate("xyz"):
            records[axis] = indices[first, column]
            np.add.at(records["sum_" + axis], of, offsets[:, column])
        np.add.at(records["sum_intensity"], of, intensities)
        records["observations"] = np.bincount(of, minlength=len(first))
        records["looks"] = 1
        records["first_ns"] = records["last_ns"] = stamp_ns
        p = np.minimum(np.maximum(probabilities[labelled], np.float32(0)), np.float32(1))
        quantised = (p * np.float32(UNIT) + np.float32(0.5)).astype(np.int32).astype(np.int64)
        sums = np.zeros((len(first), probabilities.shape[1]), dtype=np.int64)
        np.add.at(sums, of[labelled], quantised)
        total, kept = sums.sum(axis=1), sums[:, self._returns].sum(axis=1)
        says = (kept > _LEAST_SHARE * total) & (np.bincount(of, labelled, len(first)) > 0)
        mean = (sums[says] / kept[says, None].astype(np.float64)).astype(np.float32)
        mean[:, ~self._returns] = 0
        evidence = self._evidence(mean)
        evidence[:, ~self._returns] = 0
        records["labelled"] = says
        records["evidence"][says] = evidence
        order = canonical_order(records)
        return records[order], first[order]

    def _crossed(self, begin: np.ndarray, end: np.ndarray, own: np.ndarray) -> np.ndarray:
        """(M, 3) int64: what the rays of a cloud cross, each once, but for its own voxels and their
        neighbours."""
        origin = begin / self._size
        usable = (np.abs(origin) < _MAX_INDEX).all(axis=1)
        crossed = crossed_voxels(origin[usable], end[usable] / self._size, self._reach)
        around = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3), axis=-1).reshape(-1, 1, 3)
        spared = (own + around).reshape(-1, 3)
        keys = _Keys(crossed, spared)
        _, first = np.unique(keys.of(crossed), return_index=True)
        crossed = crossed[first]
        return crossed[~np.isin(keys.of(crossed), keys.of(spared))]


def _round(value: float) -> int:
    """Half away from zero, as lround."""
    return int(np.floor(abs(value) + 0.5)) * (1 if value >= 0 else -1)
