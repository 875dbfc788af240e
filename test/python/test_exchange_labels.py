# SPDX-License-Identifier: MIT
"""Clouds to SemanticKITTI's layout and labels back, point by point."""

import os
import sys

import numpy as np
import pytest
import yaml

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
bag_factory = pytest.importorskip("bag_factory")

from bag_factory import CLASS_COLORS, CLASS_NAMES, Drive  # noqa: E402
from semantic_lidar_fusion.evaluation import scoring  # noqa: E402
from test_fuse_bag import Made  # noqa: E402

COMMAND = "exchange_labels.py"


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    made = Made(tmp_path_factory.mktemp("labels"), Drive(scans=3, points_per_scan=1600))
    return made, made.fuse("--tf")


def files(folder, kind, suffix):
    return sorted((folder / kind).glob("*" + suffix))


def test_export_is_what_the_bag_holds(room, tmp_path, run_command):
    made, fused = room
    code, out, err = run_command(COMMAND, "export", fused.path, tmp_path / "seq", "--every", 2)
    assert code == 0, err
    clouds = fused.clouds()[::2]
    assert "2 scans (%d points)" % sum(map(len, clouds)) in out
    folder = tmp_path / "seq"
    for cloud, scan, label in zip(
        clouds, files(folder, "velodyne", ".bin"), files(folder, "labels", ".label")
    ):
        points = np.fromfile(str(scan), "<f4").reshape(-1, 4)
        for column, name in enumerate(("x", "y", "z", "intensity")):
            np.testing.assert_array_equal(points[:, column], cloud[name])
        ids = np.fromfile(str(label), "<u4")
        wanted = np.where(cloud["status"] == 0, cloud["label"].astype(int) + 1, 0)
        np.testing.assert_array_equal(ids, wanted)
        assert len(set(ids)) > 2
    classes = yaml.safe_load((folder / "classes.yaml").read_text())
    assert [classes["labels"][i + 1] for i in range(len(CLASS_NAMES))] == list(CLASS_NAMES)
    assert classes["color_map"][1] == list(reversed(CLASS_COLORS[0]))  # blue, green, red
    # The poses lay the scans over each other: what moved between them is the vehicle.
    poses = np.loadtxt(str(folder / "poses.txt")).reshape(-1, 3, 4)
    truth = [
        made.drive.pose((stamp - bag_factory.START_NS) * 1e-9) @ made.drive.lidar_pose
        for stamp in (m.header.stamp.to_nsec() for m in fused.of("/points_semantic")[::2])
    ]
    np.testing.assert_array_equal(poses[0, :, 3], 0.0)
    np.testing.assert_allclose(
        poses[1, :, 3], truth[1][:3, 3] - truth[0][:3, 3], atol=2e-3
    )  # odometry comes every 10 ms
    assert len(np.loadtxt(str(folder / "times.txt"))) == 2


def test_labels_come_back_onto_the_points_they_were_given(room, tmp_path, run_command):
    made, fused = room
    folder = tmp_path / "seq"
    code, _, err = run_command(COMMAND, "export", fused.path, folder, "--unlabelled")
    assert code == 0, err
    given = []
    for number, label in enumerate(files(folder, "labels", ".label")):
        ids = np.fromfile(str(label), "<u4")
        assert len(ids) and not ids.any()
        world = scan_in_world(made, fused, number)
        ids[:] = made.drive.class_of(world) + 1
        ids[::7] = 0  # nobody labels every point
        # An instance in the upper half is none of the class.
        (ids | np.uint32(5 << 16)).tofile(str(label))
        given.append(np.where(ids == 0, 255, ids.astype(int) - 1))
    truth_bag = tmp_path / "truth.bag"
    code, out, err = run_command(COMMAND, "import", folder, fused.path, truth_bag)
    assert code == 0, err
    assert "truth of 3 scans" in out
    truth = scoring.Truth(str(truth_bag), len(CLASS_NAMES))
    bag = scoring.FusedBag(str(fused.path), CLASS_NAMES)
    count = 0
    for (index, cloud, scan), wanted in zip(scoring.paired(truth, bag), given):
        np.testing.assert_array_equal(scan.label, wanted)
        np.testing.assert_array_equal(scan.points["x"], cloud.points["x"])
        chosen = cloud.fused & (scan.label != 255)
        assert (cloud.label[chosen] == scan.label[chosen]).mean() > 0.9
        count += 1
    assert count == 3


def scan_in_world(made, fused, number):
    message = fused.of("/points_semantic")[number]
    cloud = fused.clouds()[number]
    seconds = (message.header.stamp.to_nsec() - bag_factory.START_NS) * 1e-9
    T = made.drive.pose(seconds) @ made.drive.lidar_pose
    points = np.stack([cloud[axis] for axis in "xyz"], axis=-1).astype(float)
    return points @ T[:3, :3].T + T[:3, 3]


def test_a_point_that_is_another_is_named(room, tmp_path, run_command):
    _, fused = room
    folder = tmp_path / "seq"
    assert run_command(COMMAND, "export", fused.path, folder)[0] == 0
    scan = files(folder, "velodyne", ".bin")[1]
    points = np.fromfile(str(scan), "<f4")
    points[4 * 17] = np.nextafter(points[4 * 17], np.float32(9e9))
    points.tofile(str(scan))
    code, _, err = run_command(COMMAND, "import", folder, fused.path, tmp_path / "t.bag")
    assert code == 1 and "point 17 of scan 000001 is not that of the bag" in err
    assert not (tmp_path / "t.bag").exists()
    points[:-4].tofile(str(scan))
    code, _, err = run_command(COMMAND, "import", folder, fused.path, tmp_path / "t.bag")
    assert code == 1 and "scan 000001 has" in err
    code, _, err = run_command(COMMAND, "export", fused.path, folder)
    assert code == 1 and "is not empty" in err


def test_unknown_labels_and_foreign_ids(room, tmp_path, run_command):
    _, fused = room
    folder = tmp_path / "seq"
    code, _, err = run_command(COMMAND, "export", fused.path, folder, "--ids", "semantickitti")
    assert code == 0 and "has no class for wall, door" in err
    ids = np.fromfile(str(files(folder, "labels", ".label")[0]), "<u4")
    assert set(ids) == {0, 40}  # road
    code, _, err = run_command(
        COMMAND, "import", folder, fused.path, tmp_path / "t.bag", "--ids", "semantickitti"
    )
    assert code == 0, err
    ids[0] = 777
    ids.tofile(str(files(folder, "labels", ".label")[0]))
    code, _, err = run_command(
        COMMAND, "import", folder, fused.path, tmp_path / "u.bag", "--ids", "semantickitti"
    )
    assert code == 1 and "label 777 is none of classes.yaml" in err
