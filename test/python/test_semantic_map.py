# SPDX-License-Identifier: MIT
"""Voxel maps: values by hand, exactness of adding, and the plain numpy version against the compiled
one."""

import math

import numpy as np
import pytest

from semantic_lidar_fusion.bags.poses import to_rotation, transform_points
from semantic_lidar_fusion.errors import ConfigError, DataError
from semantic_lidar_fusion.labels import ClassInfo, LabelSet
from semantic_lidar_fusion.maps.map_file import MapHeader, MapReader, MapWriter
from semantic_lidar_fusion.maps.numpy_map import crossed_voxels
from semantic_lidar_fusion.maps.query import MapQuery, label_at
from semantic_lidar_fusion.maps.reading import (
    DYNAMIC,
    GONE,
    STATIC,
    labels_and_confidences,
    layers_of,
    read,
)
from semantic_lidar_fusion.maps.records import (
    BRICK,
    MAX_PASSES,
    bricks_of,
    free_voxels,
    positions,
    voxel_indices,
)
from semantic_lidar_fusion.maps.semantic_map import MapConfig, VoxelMap, native_module

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
        True, marks=pytest.mark.skipif(native_module() is None, reason="_core is not built")
    ),
]
UNIT = 1 << 20
# Of one observation: rounding, and the error of the single-precision logarithm, in units of 2^-20.
EVIDENCE_ERROR = 1.2


def add_points(
    voxels, xyz, probabilities, status=None, pose=None, stamp_ns=0, intensity=None, origins=None, passes=None
):  # fmt: skip
    xyz = np.atleast_2d(np.asarray(xyz, dtype=np.float32))
    probabilities = np.atleast_2d(np.asarray(probabilities, dtype=np.float32))
    status = np.zeros(len(xyz), np.uint8) if status is None else np.asarray(status, np.uint8)
    intensity = np.zeros(len(xyz)) if intensity is None else np.asarray(intensity)
    return voxels.integrate_columns(
        list(xyz.T),
        intensity,
        status,
        probabilities,
        np.eye(4) if pose is None else pose,
        stamp_ns,
        origins,
        passes,
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
    assert (record["x"], record["y"], record["z"]) == (2, -1, 0)
    assert (record["observations"], record["looks"], record["labelled"]) == (3, 3, 3)
    assert (record["first_ns"], record["last_ns"]) == (98, 100)
    by_hand = [
        0.5 * (math.log(0.7 / 0.5) + math.log(0.6 / 0.5) + math.log(0.25 / 0.5)),
        0.5 * (math.log(0.2 / 0.25) + math.log(0.4 / 0.25) + math.log(0.5 / 0.25)),
        0.5 * (math.log(0.1 / 0.25) + math.log(0.01 / 0.25) + math.log(0.25 / 0.25)),
    ]
    np.testing.assert_allclose(
        record["evidence"] / UNIT, by_hand, rtol=0, atol=3 * EVIDENCE_ERROR / UNIT
    )
    reading = read(voxels.records(), voxels.config, LABELS)
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
    reading = read(voxels.records(), voxels.config, LABELS)
    np.testing.assert_allclose(reading.probabilities[0], np.array([1.375, 0.75, 0.375]) / 2.5)


@pytest.mark.parametrize("native", BACKENDS)
def test_clamp_acts_on_reading_only(native):
    voxels = VoxelMap(MapConfig(weight=1.0, clamp=2.0), LABELS, native)
    for _ in range(50):
        add_points(voxels, [0.1, 0.1, 0.1], [0.9, 0.05, 0.05])
    reading = read(voxels.records(), voxels.config, LABELS)
    expected = 1.0 / (1.0 + 2.0 * math.exp(-2.0))
    assert reading.confidence[0] == pytest.approx(expected, abs=1e-6)
    # What was added beyond the clamp is still there: it takes as much to turn the label.
    for _ in range(49):
        add_points(voxels, [0.1, 0.1, 0.1], [0.05, 0.9, 0.05])
    assert read(voxels.records(), voxels.config, LABELS).label[0] == 0


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
    reading = read(records, voxels.config, LABELS)
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
    # A beam without a return is no point, whatever the least range.
    counts = add_points(voxels, xyz + [[0, 0, 0]], p + [[0.8, 0.1, 0.1]])
    assert (counts["labelled"], counts["out_of_range"], counts["invalid"]) == (1, 2, 4)
    (record,) = voxels.records()
    assert (record["observations"], record["labelled"]) == (2, 1)
    far = np.eye(4)
    far[0, 3] = 1e12
    assert add_points(voxels, [[5, 0, 0]], [[0.8, 0.1, 0.1]], pose=far)["out_of_range"] == 1


@pytest.mark.parametrize("native", BACKENDS)
def test_points_of_one_scan_are_one_look(native):
    """Their distributions are averaged, whatever their number, and give evidence once."""
    prior = (1 / 3,) * 3
    voxels = VoxelMap(MapConfig(voxel_size_m=1.0, floor=1e-3), LABELS, native)
    seen = [[0.9, 0.1, 0.0], [0.5, 0.2, 0.3], [0.1, 0.3, 0.6]]
    add_points(voxels, [[0.5, 0.5, 0.5]] * 4, seen + [[0, 0, 0]], status=[0, 0, 0, 1])
    (record,) = voxels.records()
    assert (record["observations"], record["looks"], record["labelled"]) == (4, 1, 1)
    expected = np.log(np.mean(seen, axis=0) / prior[0])
    # Each probability is rounded to 2^-20 before it is averaged.
    np.testing.assert_allclose(
        record["evidence"] / UNIT, expected, rtol=0, atol=(EVIDENCE_ERROR + 0.5 / 0.3) / UNIT
    )


@pytest.mark.parametrize("native", BACKENDS)
def test_classes_that_no_return_can_be_of_take_no_part(native):
    names = [("sky", None), ("road", None), ("fog", False), ("car", None)]
    labels = LabelSet([ClassInfo(n, (0, 0, 0), n == "car", lidar) for n, lidar in names])
    assert labels.returns.tolist() == [False, True, False, True]
    voxels = VoxelMap(MapConfig(voxel_size_m=1.0), labels, native)
    add_points(voxels, [[0.5, 0.5, 0.5]], [[0.5, 0.3, 0.1, 0.1]])
    add_points(voxels, [[1.5, 0.5, 0.5]], [[0.9995, 0.0002, 0.0001, 0.0002]])
    records = voxels.records()
    # The second one's 0.0004 say nothing about road and car.
    assert records["labelled"].tolist() == [1, 0] and records["looks"].tolist() == [1, 1]
    assert records["evidence"][0, [0, 2]].tolist() == [0, 0]
    reading = read(records, voxels.config, labels)
    np.testing.assert_allclose(reading.probabilities[0], [0, 0.75, 0, 0.25], atol=1e-5)
    assert reading.label.tolist() == [1, 255]
    label, confidence = labels_and_confidences(records, voxels.config, labels)
    assert label.tolist() == [1, 255]
    np.testing.assert_allclose(confidence, reading.confidence, atol=1e-6)


def layers(voxels, **options):
    records = voxels.records()
    label, confidence = labels_and_confidences(records, voxels.config, LABELS)
    return layers_of(records, label, confidence, voxels.config, LABELS, **options).tolist()


@pytest.mark.parametrize("native", BACKENDS)
@pytest.mark.parametrize(
    "dynamic, moving", [("apart", DYNAMIC), ("exclude", GONE), ("keep", STATIC)]
)
def test_the_posterior_decides_the_layer(native, dynamic, moving):
    """One voxel, one posterior: a doubtful look at a car does not make a wall one."""
    voxels = VoxelMap(MapConfig(voxel_size_m=1.0, dynamic=dynamic), LABELS, native)
    for p in ([0.1, 0.8, 0.1], [0.1, 0.4, 0.5], [0.1, 0.8, 0.1]):
        add_points(voxels, [[0.5, 0.5, 0.5], [1.5, 0.5, 0.5]], [p, p[::-1]])
    for _ in range(3):
        add_points(voxels, [[1.5, 0.5, 0.5]], [[0.1, 0.1, 0.8]])
    assert len(voxels) == 2
    assert layers(voxels) == [STATIC, moving]


@pytest.mark.parametrize("native", BACKENDS)
def test_rays_clear_what_has_moved_away(native):
    pose = np.eye(4)
    pose[:3, 3] = 0.5
    voxels = VoxelMap(MapConfig(voxel_size_m=1.0), LABELS, native)
    car, wall = [0.05, 0.05, 0.9], [0.02, 0.96, 0.02]
    there = np.array([[5.0, 0, 0]], dtype=np.float32)
    behind = np.array([[9.0, 0, 0]], dtype=np.float32)
    for stamp in range(3):
        add_points(voxels, there, [car], pose=pose, stamp_ns=stamp)
    assert layers(voxels) == [DYNAMIC]
    # As many rays as looks must pass.
    expected = [[DYNAMIC, STATIC], [DYNAMIC, STATIC], [GONE, STATIC]]
    for number, wanted in enumerate(expected):
        add_points(voxels, behind, [wall], pose=pose, stamp_ns=3 + number)
        assert layers(voxels) == wanted
    records = voxels.records()
    assert records["passes_after"].tolist() == [3, 0] and records["passes"].tolist() == [3, 0]
    assert layers(voxels, is_ground=np.array([True, False])) == [DYNAMIC, STATIC]
    voxel, passes = free_voxels(voxels.bricks())
    order = np.argsort(voxel[:, 0])
    # The neighbours of what a scan itself saw are spared: 4 by the first three, 8 always. Of the
    # lidar's own voxel the ray crosses but half.
    assert voxel[order].tolist() == [[x, 0, 0] for x in range(1, 8) if x != 5]
    assert passes[order].tolist() == [6, 6, 6, 3, 3, 3]
    # It comes back: what passed before says nothing about what is there now.
    add_points(voxels, there, [car], pose=pose, stamp_ns=9)
    assert layers(voxels) == [DYNAMIC, STATIC]
    assert voxels.records()["passes_after"].tolist() == [0, 0]
    assert voxels.records()["passes"].tolist() == [3, 0]


@pytest.mark.parametrize("native", BACKENDS)
def test_a_later_map_clears_an_earlier_one(native):
    """Monday's barrier, which Tuesday's drive passes through; in the order of time only."""
    config = MapConfig(voxel_size_m=1.0)
    maps = []
    for far, looks in ((5.0, 4), (9.0, 10)):
        voxels = VoxelMap(config, LABELS, native)
        for stamp in range(looks):
            add_points(voxels, [[far + 0.5, 0.5, 0.5]], [[0.02, 0.96, 0.02]], stamp_ns=stamp)
        maps.append(voxels)
    monday, tuesday = maps
    both = VoxelMap(config, LABELS, native)
    for part in (monday, tuesday):
        both.add(part.records(), part.bricks())
    assert both.records()["passes_after"].tolist() == [10, 0]
    assert layers(both) == [GONE, STATIC]
    other = VoxelMap(config, LABELS, native)
    for part in (tuesday, monday):
        other.add(part.records(), part.bricks())
    assert other.records()["passes_after"].tolist() == [0, 0]


def test_rays_cross_what_lies_on_them():
    """Against an oracle: a ray crosses a voxel if enough of its closely spaced points lie in it."""
    random = np.random.default_rng(8)
    origin, end = random.uniform(-5, 5, (40, 3)), random.uniform(-25, 25, (40, 3))
    end[0] = origin[0] + [7, 0, 0]
    step = 1e-3
    for a, b in zip(origin, end):
        length = np.linalg.norm(b - a)
        reach = min(length, 20.0)
        t = np.arange(step / 2, reach, step)
        cells = np.floor(a + t[:, None] * (b - a) / length).astype(int)
        voxel, count = np.unique(cells, axis=0, return_counts=True)
        chord = dict(zip(map(tuple, voxel.tolist()), count * step))
        found = set(map(tuple, crossed_voxels(a[None], b[None], 20.0).tolist()))
        # Chords are sampled: doubtful within two steps.
        for cell, way in chord.items():
            if abs(way - 0.8) > 2 * step:
                assert (cell in found) == (way > 0.8), (cell, way)
        assert found <= set(chord)


def test_bricks_hold_what_is_put_in():
    random = np.random.default_rng(2)
    voxels = np.unique(random.integers(-400, 400, (3000, 3)), axis=0)
    passes = random.integers(1, MAX_PASSES + 1, len(voxels))
    bricks = bricks_of(voxels, passes)
    assert bricks.dtype == BRICK
    got, counts = free_voxels(bricks)
    order = np.lexsort(got.T[::-1])
    np.testing.assert_array_equal(got[order], voxels)
    np.testing.assert_array_equal(counts[order], passes)


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
    still = dict(ray_range_m=0.0)
    whole = mapped(scans, native, **still).records()
    assert len(whole) > 5000
    assert mapped(scans[::-1], native, **still).records().tobytes() == whole.tobytes()
    parts = [mapped(scans[i::3], native, **still) for i in range(3)]
    total = VoxelMap(parts[0].config, LABELS, native)
    for part in (parts[2], parts[0], parts[1]):
        total.add(part.records(in_order=False))
    assert total.records().tobytes() == whole.tobytes()
    # Cut into halves in space and put together again.
    low, high = [-(2**30)] * 3, [2**30] * 3
    middle = int(np.median(whole["x"]))
    left, right = mapped(scans, native, **still), mapped(scans, native, **still)
    left.keep_inside(low, [middle] + high[1:])
    right.keep_inside([middle + 1] + low[1:], high)
    assert 0 < len(left) < len(whole) and len(left) + len(right) == len(whole)
    left.add(right.records())
    assert left.records().tobytes() == whole.tobytes()
    # A map that was cut goes on like any other.
    add_points(right, **scans[0])
    assert len(right) > len(whole) - len(left)


@pytest.mark.parametrize("native", BACKENDS)
def test_with_rays_parts_in_order_of_time_change_no_bit(native):
    scans = random_scans(5, 200)
    whole = mapped(scans, native)
    records, bricks = whole.records(), whole.bricks()
    assert records["passes_after"].max() > 0 and len(bricks) > 100
    for cut in (1, 3):
        total = mapped(scans[:cut], native)
        rest = mapped(scans[cut:], native)
        total.add(rest.records(in_order=False), rest.bricks(in_order=False))
        assert total.records().tobytes() == records.tobytes()
        assert total.bricks().tobytes() == bricks.tobytes()
    # Cut along a brick's side and put together again.
    low, high = [-(2**30)] * 3, [2**30] * 3
    middle = int(np.median(records["x"])) >> 3 << 3
    left, right = mapped(scans, native), mapped(scans, native)
    left.keep_inside(low, [middle - 1] + high[1:])
    right.keep_inside([middle] + low[1:], high)
    left.add(right.records(), right.bricks())
    assert left.records().tobytes() == records.tobytes()
    assert left.bricks().tobytes() == bricks.tobytes()
    # Through the middle of a brick, no voxel outside stays.
    right.keep_inside([middle + 3] + low[1:], high)
    assert free_voxels(right.bricks())[0][:, 0].min() >= middle + 3
    assert voxel_indices(right.records())[:, 0].min() >= middle + 3


@pytest.mark.skipif(native_module() is None, reason="_core is not built")
@pytest.mark.parametrize("kind", ["log", "dirichlet"])
@pytest.mark.parametrize("rays", [0.0, 12.0])
def test_numpy_gives_the_same_bytes(kind, rays):
    config = dict(kind=kind, weight=0.37, floor=1e-4, max_range_m=40.0, ray_range_m=rays)
    config["prior"] = (0.5, 0.3, 0.2)
    scans = random_scans(3, 400)
    random = np.random.default_rng(4)
    for scan in scans:
        scan["origins"] = scan["pose"][:3, 3] + random.normal(0, 0.5, (len(scan["xyz"]), 3))
    plain, compiled = mapped(scans, False, **config), mapped(scans, True, **config)
    assert plain.records().tobytes() == compiled.records().tobytes()
    assert plain.bricks().tobytes() == compiled.bricks().tobytes()
    assert (len(plain.bricks()) > 0) == (rays > 0)
    for scan in scans:
        assert add_points(plain, **scan) == add_points(compiled, **scan)
    moved = [moved_map(scans, source, MOVE) for source in (plain, compiled)]
    assert moved[0].records().tobytes() == moved[1].records().tobytes()
    assert moved[0].bricks().tobytes() == moved[1].bricks().tobytes()
    # Some of the map's old space is known, in pieces of it that the rays did not reach, too.
    assert (len(moved[0].bricks()) > 0) == (rays > 0)


# A turn about all axes, and a way that is no whole number of voxels.
MOVE = np.eye(4)
MOVE[:3, :3] = to_rotation(np.array([0.05, -0.02, 0.2, 1.0]))
MOVE[:3, 3] = (3.3, -0.77, 0.14)


def moved_map(scans, source, move):
    """The map of the same scans, seen from poses `move` @ theirs, without rays of its own."""
    result = VoxelMap(source.config, source.labels, source.native)
    for scan in scans:
        known = source.passes_at(list(scan["xyz"].astype(np.float32).T), scan["pose"])
        there = {name: scan[name] for name in scan if name not in ("pose", "origins")}
        add_points(result, pose=move @ scan["pose"], passes=known, **there)
    result.add_moved(source.bricks(), np.linalg.inv(move))
    return result


@pytest.mark.parametrize("native", BACKENDS)
def test_a_map_is_placed_anew_without_its_rays(native):
    scans = random_scans(3, 80)
    whole = mapped(scans, native, ray_range_m=12.0)
    still = moved_map(scans, whole, np.eye(4))
    records, expected = still.records(), whole.records()
    for name in expected.dtype.names:
        if name != "passes":  # which are only those since the last return
            np.testing.assert_array_equal(records[name], expected[name])
    assert still.bricks().tobytes() == whole.bricks().tobytes()
    # By whole voxels nothing is lost, either.
    size, by = whole.config.voxel_size_m, np.array([5, -3, 9])
    move = np.eye(4)
    move[:3, 3] = by * size
    shifted = moved_map(scans, whole, move)
    voxels, passes = free_voxels(shifted.bricks())
    at, before = free_voxels(whole.bricks())
    assert {(*v, p) for v, p in zip(voxels.tolist(), passes.tolist())} == {
        (*v, p) for v, p in zip((at + by).tolist(), before.tolist())
    }
    # Turned, a voxel has been crossed as often as what was at its centre.
    turned = moved_map(scans, whole, MOVE)
    here, passes = free_voxels(turned.bricks())
    there = np.floor(transform_points(np.linalg.inv(MOVE), (here + 0.5) * size) / size)
    count = {tuple(v): p for v, p in zip(at.tolist(), before.tolist())}
    found = np.array([count.get(tuple(v), 0) for v in there.astype(int).tolist()])
    # Where a centre lies within a rounding error of a side, either voxel is right.
    assert (found != passes).mean() < 1e-3
    # A turn keeps volumes: to the square root of their number, and to what returns claim.
    assert abs(len(found) / len(at) - 1) < 0.05


def test_bad_configurations_are_told_whole():
    with pytest.raises(ConfigError) as error:
        VoxelMap(MapConfig(voxel_size_m=0, weight=2, floor=0, kind="bayes", prior=(1.0,)), LABELS)
    for name in ("voxel_size_m", "weight", "floor", "kind", "prior"):
        assert name in str(error.value)
    with pytest.raises(DataError):
        voxels = VoxelMap(MapConfig(), LABELS)
        add_points(voxels, [0, 0, 0], [1, 0, 0], pose=np.full((4, 4), np.nan))


def test_positions_are_asked_for(tmp_path):
    """Every point of the map at its own voxel, others nowhere; coarser voxels hold the sum."""
    scans = random_scans(2, 3000)
    voxels = mapped(scans)
    path = str(tmp_path / "map.voxels")
    with MapWriter(path, MapHeader(voxels.config, LABELS, "map")) as writer:
        writer.write(voxels.records(), voxels.bricks())
    reader = MapReader(path)
    query = MapQuery(reader)
    records = voxels.records()
    centers = (voxel_indices(records) + 0.5) * 0.2
    found = query.at(centers)
    np.testing.assert_array_equal(found.voxel, np.arange(len(records)))
    reading = read(records, voxels.config, LABELS)
    np.testing.assert_array_equal(found.label, reading.label)
    np.testing.assert_allclose(found.confidence, reading.confidence, atol=1e-6)
    strange = np.array([[0, 0, 0], [np.nan, 0, 0], [1e300, 0, 0], centers[0] + [0, 0, 900]])
    assert query.at(strange).label.tolist() == [255] * 4
    np.testing.assert_array_equal(label_at(reader, centers), reading.label)
    coarse = MapQuery(reader, 2)
    assert coarse.size_m == 0.8 and len(coarse.records) < len(records)
    of = coarse.at(centers).voxel
    assert (of >= 0).all()
    total = np.zeros((len(coarse.records), 3), dtype=np.int64)
    np.add.at(total, of, records["evidence"])
    np.testing.assert_array_equal(coarse.records["evidence"], total)
    assert coarse.records["observations"].sum() == records["observations"].sum()
    middle = np.zeros((len(coarse.records), 3))
    np.add.at(middle, of, positions(records, 0.2) * records["observations"][:, None])
    middle /= coarse.records["observations"][:, None]
    np.testing.assert_allclose(positions(coarse.records, 0.8), middle, atol=1e-5)
