# SPDX-License-Identifier: MIT
"""Voxel maps: values by hand, exactness of adding, and the plain numpy version against the compiled
one."""

import math

import numpy as np
import pytest

from semantic_lidar_fusion.errors import ConfigError, DataError
from semantic_lidar_fusion.labels import ClassInfo, LabelSet
from semantic_lidar_fusion.maps.semantic_map import (
    DYNAMIC,
    STATIC,
    MapConfig,
    VoxelMap,
    native_module,
    positions,
    read,
)

LABELS = LabelSet(
    [
        ClassInfo("road", (128, 64, 128), False),
        ClassInfo("building", (70, 70, 70), False),
        ClassInfo("car", (0, 0, 142), True),
    ]
)
BACKENDS = [
    False,
    pytest.param(
        True, marks=pytest.mark.skipif(native_module() is None, reason="_voxel_map is not built")
    ),
]
UNIT = 1 << 20
# Of one observation: rounding, and the error of the single-precision logarithm, in units of 2^-20.
EVIDENCE_ERROR = 1.2


def add_points(voxels, xyz, probabilities, status=None, pose=None, stamp_ns=0, intensity=None):
    xyz = np.atleast_2d(np.asarray(xyz, dtype=np.float32))
    probabilities = np.atleast_2d(np.asarray(probabilities, dtype=np.float32))
    status = np.zeros(len(xyz), np.uint8) if status is None else np.asarray(status, np.uint8)
    intensity = np.zeros(len(xyz)) if intensity is None else np.asarray(intensity)
    return voxels.integrate_columns(
        list(xyz.T),
        intensity,
        status,
        np.argmax(probabilities, axis=1).astype(np.uint8),
        probabilities,
        np.eye(4) if pose is None else pose,
        stamp_ns,
    )


@pytest.mark.parametrize("native", BACKENDS)
def test_three_observations_by_hand(native):
    config = MapConfig(voxel_size_m=0.5, weight=0.5, floor=0.01, prior=(0.5, 0.25, 0.25), clamp=50)
    voxels = VoxelMap(config, LABELS, native)
    seen = [[0.7, 0.2, 0.1], [0.6, 0.4, 0.0], [0.25, 0.5, 0.25]]
    where = [[1.1, -0.2, 0.3], [1.2, -0.3, 0.1], [1.3, -0.4, 0.2]]
    for number, (p, xyz) in enumerate(zip(seen, where)):
        add_points(voxels, xyz, p, stamp_ns=100 - number, intensity=[10.0 * number])
    (record,) = voxels.records()
    assert (record["x"], record["y"], record["z"], record["layer"]) == (2, -1, 0, STATIC)
    assert (record["observations"], record["labelled"]) == (3, 3)
    assert (record["first_ns"], record["last_ns"]) == (98, 100)
    by_hand = [
        0.5 * (math.log(0.7 / 0.5) + math.log(0.6 / 0.5) + math.log(0.25 / 0.5)),
        0.5 * (math.log(0.2 / 0.25) + math.log(0.4 / 0.25) + math.log(0.5 / 0.25)),
        0.5 * (math.log(0.1 / 0.25) + math.log(0.01 / 0.25) + math.log(0.25 / 0.25)),
    ]
    np.testing.assert_allclose(
        record["evidence"] / UNIT, by_hand, rtol=0, atol=3 * EVIDENCE_ERROR / UNIT
    )
    reading = read(voxels.records(), voxels.config)
    posterior = np.exp(by_hand) * [0.5, 0.25, 0.25]
    posterior /= posterior.sum()
    np.testing.assert_allclose(reading.probabilities[0], posterior, atol=1e-5)
    assert reading.label[0] == np.argmax(posterior) == 0
    assert reading.confidence[0] == reading.probabilities[0, 0]
    entropy = -np.sum(posterior * np.log(posterior)) / math.log(3)
    assert reading.entropy[0] == pytest.approx(entropy, abs=1e-5)
    # Float coordinates, sums in 2^-20 m.
    np.testing.assert_allclose(reading.position[0], [1.2, -0.3, 0.2], atol=2e-6)
    assert reading.intensity[0] == pytest.approx(10.0)


@pytest.mark.parametrize("native", BACKENDS)
def test_dirichlet_by_hand(native):
    config = MapConfig(kind="dirichlet", weight=0.5, prior=(0.5, 0.25, 0.25))
    voxels = VoxelMap(config, LABELS, native)
    for p in ([0.5, 0.5, 0.0], [1.0, 0.0, 0.0], [0.25, 0.5, 0.25]):
        add_points(voxels, [0.05, 0.05, 0.05], p)
    (record,) = voxels.records()
    assert record["evidence"].tolist() == [0.875 * UNIT, 0.5 * UNIT, 0.125 * UNIT]
    reading = read(voxels.records(), voxels.config)
    np.testing.assert_allclose(reading.probabilities[0], np.array([1.375, 0.75, 0.375]) / 2.5)


@pytest.mark.parametrize("native", BACKENDS)
def test_clamp_acts_on_reading_only(native):
    voxels = VoxelMap(MapConfig(weight=1.0, clamp=2.0), LABELS, native)
    for _ in range(50):
        add_points(voxels, [0.1, 0.1, 0.1], [0.9, 0.05, 0.05])
    reading = read(voxels.records(), voxels.config)
    expected = 1.0 / (1.0 + 2.0 * math.exp(-2.0))
    assert reading.confidence[0] == pytest.approx(expected, abs=1e-6)
    # What was added beyond the clamp is still there: it takes as much to turn the label.
    for _ in range(49):
        add_points(voxels, [0.1, 0.1, 0.1], [0.05, 0.9, 0.05])
    assert read(voxels.records(), voxels.config).label[0] == 0


@pytest.mark.parametrize("native", BACKENDS)
def test_status_rules(native):
    voxels = VoxelMap(MapConfig(voxel_size_m=1.0), LABELS, native)
    xyz = [[n + 0.5, 0.5, 0.5] for n in range(6)]
    p = [[0.8, 0.1, 0.1]] * 6
    counts = add_points(voxels, xyz, p, status=[0, 1, 2, 3, 4, 200])
    assert (counts["labelled"], counts["occupied"], counts["no_odometry"]) == (1, 3, 2)
    records = voxels.records()
    assert records["x"].tolist() == [0, 1, 2, 3]
    assert records["observations"].tolist() == [1, 1, 1, 1]
    assert records["labelled"].tolist() == [1, 0, 0, 0]
    assert not records["evidence"][1:].any()
    reading = read(records, voxels.config)
    assert reading.label.tolist() == [0, 255, 255, 255]
    assert reading.confidence[1:].tolist() == [0, 0, 0]
    assert reading.entropy[1:].tolist() == [1, 1, 1]
    assert not reading.probabilities[1:].any()


@pytest.mark.parametrize("native", BACKENDS)
def test_ranges_and_broken_points(native):
    config = MapConfig(voxel_size_m=1.0, min_range_m=2.0, max_range_m=10.0)
    voxels = VoxelMap(config, LABELS, native)
    nan = float("nan")
    xyz = [[1, 0, 0], [5, 0, 0], [11, 0, 0], [nan, 5, 0], [5, 0, 0], [5, 0, float("inf")]]
    p = [[0.8, 0.1, 0.1]] * 4 + [[nan, 0.5, 0.5]] + [[0.8, 0.1, 0.1]]
    counts = add_points(voxels, xyz, p)
    assert (counts["labelled"], counts["out_of_range"], counts["invalid"]) == (1, 2, 3)
    (record,) = voxels.records()
    assert (record["observations"], record["labelled"]) == (2, 1)
    far = np.eye(4)
    far[0, 3] = 1e12
    assert add_points(voxels, [[5, 0, 0]], [[0.8, 0.1, 0.1]], pose=far)["out_of_range"] == 1


@pytest.mark.parametrize("native", BACKENDS)
@pytest.mark.parametrize("dynamic, layers", [("apart", [0, 1]), ("exclude", [0]), ("keep", [0])])
def test_dynamic_classes(native, dynamic, layers):
    voxels = VoxelMap(MapConfig(voxel_size_m=1.0, dynamic=dynamic), LABELS, native)
    counts = add_points(voxels, [[0.5, 0, 0], [0.5, 0, 0]], [[0.8, 0.1, 0.1], [0.1, 0.1, 0.8]])
    records = voxels.records()
    assert records["layer"].tolist() == layers
    assert counts["excluded"] == (1 if dynamic == "exclude" else 0)
    if dynamic == "apart":
        reading = read(records, voxels.config)
        assert reading.label.tolist() == [0, 2]
        assert records["layer"].tolist() == [STATIC, DYNAMIC]


@pytest.mark.parametrize("native", BACKENDS)
def test_utm_coordinates(native):
    """A map at UTM coordinates is the map at the origin, shifted by whole voxels."""
    random = np.random.default_rng(5)
    xyz = random.uniform(-30, 30, (500, 3)).astype(np.float32)
    p = random.dirichlet([1, 1, 1], 500)
    shift = np.array([1655000, 31250000, 40])  # voxels of 0.2 m: 331 000 m, 6 250 000 m
    maps = []
    for offset in (np.zeros(3), shift * 0.2):
        pose = np.eye(4)
        pose[:3, :3] = [[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1]]
        pose[:3, 3] = offset + [0.05, 0.07, 0.11]
        voxels = VoxelMap(MapConfig(voxel_size_m=0.2), LABELS, native)
        add_points(voxels, xyz, p, pose=pose)
        maps.append(voxels.records())
    here, there = maps
    indices = np.stack([there[a].astype(np.int64) for a in "xyz"], axis=1) - shift
    order = np.lexsort(indices.T)
    other = np.lexsort(np.stack([here[a] for a in "xyz"]))
    np.testing.assert_array_equal(indices[order], np.stack([here[a] for a in "xyz"], axis=1)[other])
    np.testing.assert_array_equal(there["evidence"][order], here["evidence"][other])
    # Doubles at 6 250 000 m are 1e-9 m apart; sums are kept in 2^-20 m.
    np.testing.assert_allclose(
        positions(there, 0.2)[order] - shift * 0.2, positions(here, 0.2)[other], atol=3e-6
    )


def random_scans(count=6, points=3000, seed=3):
    random = np.random.default_rng(seed)
    scans = []
    for number in range(count):
        pose = np.eye(4)
        angle = 0.3 * number
        c, s = math.cos(angle), math.sin(angle)
        pose[:2, :2] = [[c, -s], [s, c]]
        pose[:3, 3] = [331000.25 + 8 * number, 6250000.5, 30 + 0.1 * number]
        p = random.dirichlet([0.4, 0.4, 0.4], points).astype(np.float32)
        p[:3] = [[1, 0, 0], [0, 1e-30, 1], [1.0000001, 0, 0]]
        scans.append(
            {
                "xyz": random.normal(0, 15, (points, 3)).astype(np.float32),
                "probabilities": p,
                "status": random.choice([0, 0, 0, 0, 1, 2, 3, 4], points).astype(np.uint8),
                "pose": pose,
                "stamp_ns": 10**18 + number,
                "intensity": random.uniform(0, 255, points),
            }
        )
    return scans


def mapped(scans, native=None, **config):
    voxels = VoxelMap(MapConfig(**config), LABELS, native)
    for scan in scans:
        add_points(voxels, **scan)
    return voxels


@pytest.mark.parametrize("native", BACKENDS)
def test_order_splitting_and_merging_change_no_bit(native):
    scans = random_scans()
    whole = mapped(scans, native).records()
    assert len(whole) > 5000
    assert mapped(scans[::-1], native).records().tobytes() == whole.tobytes()
    parts = [mapped(scans[i::3], native) for i in range(3)]
    total = VoxelMap(parts[0].config, LABELS, native)
    for part in (parts[2], parts[0], parts[1]):
        total.add(part.records(in_order=False))
    assert total.records().tobytes() == whole.tobytes()
    # Cut into halves in space and put together again.
    low, high = [-(2**30)] * 3, [2**30] * 3
    middle = int(np.median(whole["x"]))
    left, right = mapped(scans, native), mapped(scans, native)
    left.keep_inside(low, [middle] + high[1:])
    right.keep_inside([middle + 1] + low[1:], high)
    assert 0 < len(left) < len(whole) and len(left) + len(right) == len(whole)
    left.add(right.records())
    assert left.records().tobytes() == whole.tobytes()
    # A map that was cut goes on like any other.
    add_points(right, **scans[0])
    assert len(right) > len(whole) - len(left)


@pytest.mark.skipif(native_module() is None, reason="_voxel_map is not built")
@pytest.mark.parametrize("kind", ["log", "dirichlet"])
@pytest.mark.parametrize("dynamic", ["apart", "exclude", "keep"])
def test_numpy_gives_the_same_bytes(kind, dynamic):
    config = dict(kind=kind, dynamic=dynamic, weight=0.37, floor=1e-4, max_range_m=40.0)
    config["prior"] = (0.5, 0.3, 0.2)
    scans = random_scans(3)
    plain, compiled = mapped(scans, False, **config), mapped(scans, True, **config)
    assert plain.records().tobytes() == compiled.records().tobytes()
    for scan in scans:
        assert add_points(plain, **scan) == add_points(compiled, **scan)


def test_bad_configurations_are_told_whole():
    with pytest.raises(ConfigError) as error:
        VoxelMap(MapConfig(voxel_size_m=0, weight=2, floor=0, kind="bayes", prior=(1.0,)), LABELS)
    for name in ("voxel_size_m", "weight", "floor", "kind", "prior"):
        assert name in str(error.value)
    with pytest.raises(DataError):
        voxels = VoxelMap(MapConfig(), LABELS)
        add_points(voxels, [0, 0, 0], [1, 0, 0], pose=np.full((4, 4), np.nan))
