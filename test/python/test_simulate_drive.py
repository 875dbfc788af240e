# SPDX-License-Identifier: MIT
"""The simulated drive against itself: packets, truth, pictures, poses, and the same bytes twice."""

import json
import os
import struct
import subprocess
import sys

import cv2
import numpy as np
import pytest

rosbag = pytest.importorskip("rosbag")

sys.path.insert(0, os.path.join(os.path.dirname(os.path.abspath(__file__)), "..", "benchmark"))
import network_errors  # noqa: E402
from semantic_lidar_fusion.bags import cloud_io  # noqa: E402

PROGRAM = os.path.join(os.environ.get("SLF_BIN_DIR", ""), "simulate_drive")
pytestmark = pytest.mark.skipif(
    not os.access(PROGRAM, os.X_OK), reason="simulate_drive is not built (Embree is absent)"
)

CAMERAS = ("A0", "A1", "A2", "B0", "B1")
DECLARED = 12  # classes
QUANTUM_M = 0.002
# VLP-16 manual, table 9-1: elevation of each laser in firing order.
ELEVATIONS_DEG = np.array([-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15])


def simulate(path, *options):
    return subprocess.run(
        [PROGRAM, "--out", str(path), "--quiet"] + list(options), capture_output=True, text=True
    )


@pytest.fixture(scope="module")
def exact_bag(tmp_path_factory):
    path = tmp_path_factory.mktemp("drive") / "exact.bag"
    done = simulate(path, "--duration", "0.3", "--scale", "0.2", "--exact")
    assert done.returncode == 0, done.stderr
    return str(path)


@pytest.fixture(scope="module")
def noisy_bag(tmp_path_factory):
    path = tmp_path_factory.mktemp("drive") / "noisy.bag"
    done = simulate(path, "--duration", "0.3", "--scale", "0.2", "--seed", "3")
    assert done.returncode == 0, done.stderr
    return str(path)


def read(bag, topic):
    with rosbag.Bag(bag) as opened:
        return [message for _, message, _ in opened.read_messages([topic])]


def ranges_of(scan):
    """Ranges (m) and elevations (deg) of a VelodyneScan's returns in the order of their data."""
    ranges, elevations = [], []
    for packet in scan.packets:
        data = bytes(packet.data)
        for block in range(12):
            assert data[100 * block : 100 * block + 2] == b"\xff\xee"
            for at in range(32):
                raw = struct.unpack_from("<H", data, 100 * block + 4 + 3 * at)[0]
                if raw:
                    ranges.append(QUANTUM_M * raw)
                    elevations.append(ELEVATIONS_DEG[at % 16])
    return np.array(ranges), np.array(elevations)


def test_truth_is_in_the_order_of_the_packets(noisy_bag):
    scans = read(noisy_bag, "/velodyne/front/velodyne_packets")
    truths = read(noisy_bag, "/points_truth")
    assert len(scans) == len(truths) == 3
    for scan, message in zip(scans, truths):
        truth = cloud_io.to_array(message)
        ranges, elevations = ranges_of(scan)
        assert len(ranges) == len(truth) > 15000
        xyz = np.stack([truth["x"], truth["y"], truth["z"]], axis=1).astype(float)
        # float32 coordinates up to 100 m
        np.testing.assert_allclose(np.linalg.norm(xyz, axis=1), ranges, atol=2e-5)
        sines = np.sin(np.radians(elevations))
        np.testing.assert_allclose(xyz[:, 2] / ranges, sines, atol=1e-5)
        assert scan.packets[0].stamp <= message.header.stamp <= scan.packets[0].stamp + _ms(2)


def _ms(milliseconds):
    import rospy

    return rospy.Duration(0, int(milliseconds * 1e6))


def test_scans_are_whole_turns_without_gaps(noisy_bag):
    stamps = [
        packet.stamp.to_nsec()
        for scan in read(noisy_bag, "/velodyne/front/velodyne_packets")
        for packet in scan.packets
    ]
    # 24 firings of 55.296 us
    assert set(np.diff(stamps)) == {24 * 55296}
    assert abs(len(stamps) - 0.3e9 / (24 * 55296)) < 1


def edge_distance(labels):
    """Distance (px) from each pixel's centre to that of the nearest pixel of another class."""
    result = np.full(labels.shape, np.inf, np.float32)
    for kind in np.unique(labels):
        inside = (labels == kind).astype(np.uint8)
        if inside.all():
            continue
        distance = cv2.distanceTransform(inside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        result[inside > 0] = distance[inside > 0]
    return result


def matrix(position, q):
    x, y, z, w = q.x, q.y, q.z, q.w
    result = np.eye(4)
    result[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    result[:3, 3] = [position.x, position.y, position.z]
    return result


def told_errors(bag):
    """/truth/errors, or what it would be where nothing is wrong."""
    said = read(bag, "/truth/errors")
    assert len(said) <= 1
    return json.loads(said[0].data) if said else None


def mounts_and_lenses(bag, errors):
    """Per camera: T_base_camera and (fx, fy, cx, cy) as they really are, and the camera_info."""
    statics = {
        t.child_frame_id: matrix(t.transform.translation, t.transform.rotation)
        for message in read(bag, "/tf_static")
        for t in message.transforms
    }
    result = {}
    for name in CAMERAS:
        info = read(bag, "/gmsl/%s/camera_info" % name)[0]
        mount, lens = statics[info.header.frame_id], (info.K[0], info.K[4], info.K[2], info.K[5])
        if errors:
            told = errors["cameras"][name]
            moved = np.eye(4)
            moved[:3, :3] = cv2.Rodrigues(np.array(told["rotation_rad"], float))[0]
            moved[:3, 3] = told["translation_m"]
            mount, lens = mount @ moved, told["fx_fy_cx_cy"]
        result[name] = mount, lens, info
    return statics, result


def line_time(u, v, size, readout, direction, stamp_row):
    """s after the image's time at which the line through pixel (u, v) is exposed."""
    lines, at = (size[1], v) if direction in ("down", "up") else (size[0], u)
    order = at if direction in ("down", "right") else lines - 1 - at
    stamped = {"first": 0, "middle": 0.5 * (lines - 1), "last": lines - 1}[stamp_row]
    return (order - stamped) * readout / lines


def bend(p, lens, d):
    """Pixels of points in the camera's frame: the equidistant lens."""
    r = np.hypot(p[:, 0], p[:, 1])
    theta = np.arctan2(r, p[:, 2])
    t2 = theta * theta
    bent = theta * (1 + t2 * (d[0] + t2 * (d[1] + t2 * (d[2] + t2 * d[3]))))
    return lens[0] * bent * p[:, 0] / r + lens[2], lens[1] * bent * p[:, 1] / r + lens[3]


ALL_ERRORS = ["--extrinsic-error", "1,0.05", "--intrinsic-error", "0.01,10"] + [
    "--stamp-jitter",
    "0.004",
    "--odometry-error",
    "0.2,1,0.2",
]


@pytest.mark.parametrize(
    "shutter, options",
    [
        ((0.0, "down", "first"), ["--exact"]),
        ((0.04, "left", "middle"), ["--exact"]),
        ((0.03, "up", "last"), ["--exact"] + ALL_ERRORS),
    ],
)
def test_visible_points_fall_on_their_class(tmp_path, shutter, options):
    """Standing world: the measured points, moved by the true poses to the time of the line that
    shows them and seen through the true lens, meet pixels of their own class wherever an edge is
    more than 2 px away."""
    bag = str(tmp_path / "standing.bag")
    turn = ["--readout", str(shutter[0]), "--shutter-direction", shutter[1]]
    turn += ["--stamp-row", shutter[2], "--speed", "15"]
    done = simulate(bag, "--duration", "0.2", "--scale", "0.25", "--static", *(turn + options))
    assert done.returncode == 0, done.stderr
    errors = told_errors(bag)
    assert (errors is None) == (shutter[0] == 0)
    poses = read(bag, "/truth/poses")
    times = np.array([message.header.stamp.to_nsec() for message in poses])
    T_world_base = np.array([matrix(m.pose.pose.position, m.pose.pose.orientation) for m in poses])
    statics, cameras = mounts_and_lenses(bag, errors)

    def pose(stamps):
        """(N, 4, 4), linear between two readings 10 ms apart: off by less than 0.4 mm."""
        stamps = np.asarray(stamps, float)
        right = np.searchsorted(times, stamps)
        weight = ((stamps - times[right - 1]) / (times[right] - times[right - 1]))[:, None, None]
        return (1 - weight) * T_world_base[right - 1] + weight * T_world_base[right]

    checked = wrong = told_wrong = 0
    truths = [cloud_io.to_array(m) for m in read(bag, "/points_truth")]
    scans = read(bag, "/velodyne/front/velodyne_packets")
    for scan, truth in zip(scans, truths):
        stamps = network_errors.return_times(scan)
        assert len(stamps) == len(truth)
        lidar = pose(stamps) @ statics[scan.header.frame_id]
        local = np.stack([truth["x"], truth["y"], truth["z"], np.ones(len(truth))], axis=1)
        world = np.einsum("nij,nj->ni", lidar, local)
        middle = scan.packets[len(scan.packets) // 2].stamp.to_nsec()
        for index, name in enumerate(CAMERAS):
            mount, lens, info = cameras[name]
            images = read(bag, "/gmsl/%s/labels_truth" % name)
            image = min(images, key=lambda m: abs(m.header.stamp.to_nsec() - middle))
            labels = np.frombuffer(image.data, np.uint8).reshape(image.height, image.width)
            stamp = image.header.stamp.to_nsec()
            size = (image.width, image.height)
            seen = (truth["visible"] >> index & 1).astype(bool)
            late = errors["cameras"][name]["exposed_late_s"][str(stamp)] if errors else 0.0
            after = np.zeros(seen.sum())
            for _ in range(8):
                T = np.linalg.inv(pose(stamp + 1e9 * (late + after)) @ mount)
                p = np.einsum("nij,nj->ni", T, world[seen])[:, :3]
                u, v = bend(p, lens, info.D)
                after = line_time(u, v, size, *shutter)
            column, row = np.floor(u + 0.5).astype(int), np.floor(v + 0.5).astype(int)
            inside = (column >= 0) & (row >= 0) & (column < image.width) & (row < image.height)
            # Points at the border may fall just outside, by their rounded poses.
            assert inside.mean() > 0.995
            column, row = column[inside], row[inside]
            far = edge_distance(labels)[row, column] > 2.0
            label = truth["label"][seen][inside]
            checked += far.sum()
            wrong += (labels[row, column] != label)[far].sum()
            # The same by what the bag says of the rig.
            said = np.linalg.inv(pose([stamp])[0] @ statics[info.header.frame_id])
            u, v = bend(
                (world[seen] @ said.T)[:, :3], (info.K[0], info.K[4], info.K[2], info.K[5]), info.D
            )
            column = np.clip(np.floor(u + 0.5).astype(int), 0, image.width - 1)[inside]
            row = np.clip(np.floor(v + 0.5).astype(int), 0, image.height - 1)[inside]
            told_wrong += (labels[row, column] != label)[far].sum()
    assert checked > 15000
    # What shows through a gap smaller than a pixel has another class than its pixel.
    assert wrong <= 1e-3 * checked
    # Whoever ignores shutter and errors is wrong at far more points.
    assert shutter[0] == 0 or told_wrong > 5 * wrong + 0.003 * checked


LENS = """model: omni
resolution: [384, 240]
focal: [400.0, 399.0]
centre: [191.3, 119.2]
coefficients: [1.2, -0.05, 0.01, 0.0004, -0.0004]
"""


def test_lens_and_shutter_of_the_rig_are_those_of_the_drive(tmp_path):
    """A drive through a lens that camera_info cannot name, its rows exposed one after another: fused
    with both told, every point that a camera sees more than a pixel from an edge gets its label; with
    the shutter left out, turned round or stamped elsewhere many do not, and with the lens left out
    nothing is fused."""
    lens, bag = tmp_path / "lens.yaml", tmp_path / "drive.bag"
    lens.write_text(LENS)
    options = ["--lens", str(lens), "--readout", "0.04", "--stamp-row", "middle", "--speed", "15"]
    done = simulate(bag, "--duration", "0.2", "--static", "--exact", *options)
    assert done.returncode == 0, done.stderr
    info = read(bag, "/gmsl/B0/camera_info")[0]
    assert (info.width, info.height, info.distortion_model) == (384, 240, "omni")
    truths = [cloud_io.to_array(m) for m in read(bag, "/points_truth")]
    rig = os.path.join(os.path.dirname(os.path.abspath(__file__)), "../../config/demo.yaml")

    def fuse(*keys):
        out = str(tmp_path / "fused.bag")
        overrides = ["occlusion.mode=off"]
        overrides += ["cameras.%s.%s" % (name, key) for name in CAMERAS for key in keys]
        arguments = [str(bag), out, "--rig", rig, "--quiet", "--force"]
        for override in overrides:
            arguments += ["--set", override]
        program = os.path.join(os.path.dirname(PROGRAM), "fuse_bag")
        return out, subprocess.run([program] + arguments, capture_output=True, text=True)

    def wrong(*keys):
        """The share with another label, of the points that are labelled by those cameras that see
        them (no mask is on) and lie beyond the pixels of an edge."""
        out, ran = fuse("lens.file=%s" % lens, *keys)
        assert ran.returncode == 0, ran.stderr
        count = missed = 0
        for truth, message in zip(truths, read(out, "/points_semantic")):
            cloud = cloud_io.to_array(message)
            seen = (cloud["status"] == 0) & (cloud["cameras"] == truth["visible"])
            seen &= truth["edge_px"] > 1
            count += seen.sum()
            missed += (seen & (cloud["label"] != truth["label"])).sum()
        assert count > 30000
        return missed / count

    shutter = ["shutter.readout_s=0.04", "shutter.stamp_row=middle"]
    right = wrong(*shutter)
    assert right < 5e-4
    assert wrong() > right + 0.003
    assert wrong(*(shutter + ["shutter.direction=up"])) > right + 0.009
    assert wrong("shutter.readout_s=0.04") > right + 0.03
    _, ran = fuse()
    assert ran.returncode == 1 and "omni" in ran.stderr


def test_odometry_errs_as_it_is_told(tmp_path):
    """Velocity and rate errors are Ornstein-Uhlenbeck processes: what they add up to in 10 ms has the
    standard deviation and the correlation of one with the next that the process's integral has."""
    bag, tau = str(tmp_path / "drift.bag"), 0.01
    done = simulate(
        bag, "--duration", "0.2", "--scale", "0.1", "--odometry-error", "0.3,2,%g" % tau
    )
    assert done.returncode == 0, done.stderr
    assert told_errors(bag)["odometry"] == {
        "velocity_mps": 0.3,
        "rate_dps": 2,
        "correlation_s": tau,
    }
    true, said = (
        [matrix(m.pose.pose.position, m.pose.pose.orientation) for m in read(bag, topic)]
        for topic in ("/truth/poses", "/zio/odometry/rear")
    )
    assert np.allclose(true[0], said[0])
    values = []
    for k in range(1, len(true)):
        step, believed = (np.linalg.inv(T[k - 1]) @ T[k] for T in (true, said))
        turn = cv2.Rodrigues(step[:3, :3].T @ believed[:3, :3])[0][:, 0]
        values.append(np.r_[believed[:3, 3] - step[:3, 3], turn] / 0.01)
    values = np.array(values)  # (readings - 1, 6)
    assert len(values) == 100
    x = 0.01 / tau
    variance = 2 * (x - 1 + np.exp(-x)) / x**2
    kept = (1 - np.exp(-x)) ** 2 / x**2 / variance
    # Correlations fall by exp(-x) a step. Of 300 values, the spread of the mean square is that of
    # fewer independent ones; four of its standard deviations.
    independent = 300 / (1 + 2 * kept**2 / (1 - np.exp(-2 * x)))
    for part, size in ((values[:, :3], 0.3), (values[:, 3:], np.radians(2))):
        assert abs(np.sqrt(np.mean(part**2) / variance) / size - 1) < 4 / np.sqrt(2 * independent)
        following = np.mean(part[1:] * part[:-1]) / np.mean(part**2)
        assert abs(following - kept) < 4 / np.sqrt(297)


def test_a_place_is_taken_for_the_same_again(noisy_bag):
    """From one scan to the next, 1 m on, most of what is wrong stays wrong: a real network's
    correlation is 0.7, that of errors drawn anew for each picture 0.1."""
    names, labels_seen = network_errors.class_names(), {}
    errors = network_errors.Errors(names)
    for labels, scores in network_errors.from_bag(noisy_bag, None, labels_seen):
        errors.add(labels, scores)
    again = network_errors.persistence(network_errors.SeenDrive(noisy_bag, labels_seen), names)
    assert 0.55 < again[1]["correlation"] < 0.85
    assert again[1]["changed"] < 0.2
    # Its confidence is that of ENet on labelled photos (0.10, 0.67, 0.925), as far as one short
    # drive tells.
    assert 0.06 < errors.reliability.ece < 0.14
    assert 0.4 < errors.reliability.nll < 0.95
    assert 0.85 < np.median(np.concatenate(errors.wrong_claims)) < 0.96


def test_edge_distance_is_that_of_the_label_image(exact_bag):
    truth = np.concatenate([cloud_io.to_array(m) for m in read(exact_bag, "/points_truth")])
    each = np.stack([truth["edge_px_" + name] for name in CAMERAS], axis=1)
    seen = np.stack([truth["visible"] >> i & 1 for i in range(5)], axis=1).astype(bool)
    assert np.array_equal(each >= 0, seen)
    least = np.where(seen, each, np.inf).min(axis=1)
    least[~seen.any(axis=1)] = -1
    assert np.array_equal(least.astype(np.float32), truth["edge_px"])
    assert 0.3 < seen.any(axis=1).mean() < 1.0


def test_hidden_points_are_catchable_beside_their_occluder(exact_bag):
    truth = np.concatenate([cloud_io.to_array(m) for m in read(exact_bag, "/points_truth")])
    visible, catchable, silhouette, apart = (
        np.stack([truth[name] >> i & 1 for i in range(5)], axis=1).astype(bool)
        for name in ("visible", "catchable", "silhouette", "apart")
    )
    assert not (catchable & visible).any() and not (apart & visible).any()
    assert not (silhouette & ~visible).any()
    # Most of what hides a point from a camera 0.6 m away is measured there, but not all of it.
    assert catchable.sum() > 100
    # Some of it stands close behind, as the far side of a thin thing does, most of it does not.
    assert 0.5 < (catchable & apart).sum() / catchable.sum() < 1.0
    # Silhouettes are few, yet a point in front of nothing is not the rule in a street.
    assert 0.01 < silhouette.sum() / visible.sum() < 0.5


def test_every_class_occurs(noisy_bag):
    labels = np.concatenate(
        [cloud_io.to_array(m)["label"] for m in read(noisy_bag, "/points_truth")]
    )
    pixels = [
        np.frombuffer(m.data, np.uint8)
        for c in CAMERAS
        for m in read(noisy_bag, "/gmsl/%s/labels_truth" % c)
    ]
    assert set(np.unique(np.concatenate(pixels))) == set(range(DECLARED))
    assert set(range(DECLARED)) - set(np.unique(labels)) == {1}  # the sky returns nothing


def test_scores_err_like_a_network_and_a_perfect_one_does_not(noisy_bag, exact_bag):
    right = total = 0
    for name in CAMERAS:
        for image, score in zip(
            read(noisy_bag, "/gmsl/%s/labels_truth" % name),
            read(noisy_bag, "/gmsl/%s/scores" % name),
        ):
            assert image.header.stamp == score.header.stamp and score.encoding == "32FC12"
            assert (score.width, score.height) == (240, 151)
            scores = np.frombuffer(score.data, np.float32).reshape(151, 240, 12)
            labels = np.frombuffer(image.data, np.uint8).reshape(image.height, image.width)
            rows = ((np.arange(151) + 0.5) * image.height / 151).astype(int)
            columns = ((np.arange(240) + 0.5) * image.width / 240).astype(int)
            right += (scores.argmax(axis=2) == labels[rows][:, columns]).sum()
            total += 151 * 240
    assert 0.75 < right / total < 0.95
    for name in CAMERAS:
        image = read(exact_bag, "/gmsl/%s/labels_truth" % name)[0]
        score = read(exact_bag, "/gmsl/%s/scores" % name)[0]
        scores = np.frombuffer(score.data, np.float32).reshape(image.height * image.width, 12)
        assert np.array_equal(
            scores.argmax(axis=1).astype(np.uint8), np.frombuffer(image.data, np.uint8)
        )


def test_odometry_drifts_slowly_and_exact_odometry_does_not(noisy_bag, exact_bag):
    def positions(bag, topic):
        points = [m.pose.pose.position for m in read(bag, topic)]
        return np.array([[p.x, p.y, p.z] for p in points])

    true, said = positions(noisy_bag, "/truth/poses"), positions(noisy_bag, "/zio/odometry/rear")
    error = np.linalg.norm(said - true, axis=1)
    way = np.linalg.norm(np.diff(true, axis=0), axis=1).sum()
    assert error[0] < 1e-9
    # Three standard deviations of the scale, and the noise of the readings.
    assert 1e-4 < error[-1] < 3 * 0.005 * way + 0.05
    assert np.array_equal(
        positions(exact_bag, "/truth/poses"), positions(exact_bag, "/zio/odometry/rear")
    )
    transforms = [t for m in read(noisy_bag, "/tf") for t in m.transforms]
    assert len(transforms) == len(said)
    assert {(t.header.frame_id, t.child_frame_id) for t in transforms} == {("odom", "base_link")}
    stamps = [t.header.stamp.to_nsec() for t in transforms]
    assert set(np.diff(stamps)) == {10000000}


def test_the_same_seed_gives_the_same_bytes(tmp_path):
    bags = []
    for number, threads in enumerate(("1", "3")):
        path = tmp_path / ("%d.bag" % number)
        done = simulate(path, "--duration", "0.2", "--scale", "0.1", "--threads", threads)
        assert done.returncode == 0, done.stderr
        bags.append(path.read_bytes())
    assert bags[0] == bags[1]
    other = tmp_path / "other.bag"
    assert simulate(other, "--duration", "0.2", "--scale", "0.1", "--seed", "2").returncode == 0
    assert other.read_bytes() != bags[0]


def test_wrong_command_lines_are_named(tmp_path):
    for options, words in (
        (["--speed", "50"], ["--speed", "'50'", "5 to 15"]),
        (["--speed=51"], ["--speed", "'51'", "5 to 15"]),
        (["--static=1"], ["unknown option --static=1"]),
        (["--", "--static"], ["unknown argument --static"]),
        (["--duration", "x"], ["--duration", "'x'"]),
        (["--images", "some"], ["--images", "'some'"]),
        (["--image-choice", "best"], ["--image-choice", "'best'", "closest_to_sweep"]),
        (["--readout", "1"], ["--readout", "'1'", "0 to 0.1"]),
        (["--shutter-direction", "in"], ["--shutter-direction", "'in'", "down, up, right, left"]),
        (["--stamp-row", "2"], ["--stamp-row", "'2'", "first, middle, last"]),
        (["--extrinsic-error", "1"], ["--extrinsic-error", "'1'", "2 numbers"]),
        (["--odometry-error", "1,1,0"], ["--odometry-error", "correlation time"]),
        (["--lens", "no.yaml", "--scale", "0.5"], ["--scale", "--lens"]),
        (["--lens-camera", "cam0"], ["--lens-camera", "--lens FILE"]),
        (["--nonsense"], ["--nonsense"]),
        (["--seed"], ["--seed", "value"]),
    ):
        done = simulate(tmp_path / "no.bag", *options)
        assert done.returncode == 2
        for word in words:
            assert word in done.stderr
    assert os.listdir(str(tmp_path)) == []
    kept = tmp_path / "kept.bag"
    kept.write_text("mine")
    done = simulate(kept, "--duration", "0.2")
    assert done.returncode == 1 and "--force" in done.stderr
    assert kept.read_text() == "mine"
