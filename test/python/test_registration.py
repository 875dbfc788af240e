# SPDX-License-Identifier: MIT
"""evaluate.py --registration: surfaces of known thickness, trajectories of known error, one drive."""
import csv
import os
import types

import numpy as np
import pytest

bag_factory = pytest.importorskip("bag_factory")
from bag_factory import Drive  # noqa: E402

from semantic_lidar_fusion.evaluation import registration  # noqa: E402


def turned(angle):
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    pose[:3, 3] = [300.0 * angle, -7.0, 2.0]
    return pose


def wall(noise, pose, rng, count=6400):
    """A wall 20 m wide and 4 m high across x = 5.2, seen from `pose`."""
    world = np.stack(
        [
            5.2 + noise * rng.standard_normal(count),
            rng.uniform(-10, 10, count),
            rng.uniform(0, 4, count),
        ],
        axis=1,
    )
    return (world - pose[:3, 3]) @ pose[:3, :3]


def test_a_walls_thickness_is_that_of_its_points():
    rng = np.random.default_rng(1)
    poses = [turned(0.1 * k) for k in range(10)]
    clouds = [(wall(0.02, pose, rng), pose) for pose in poses]
    found = registration.thickness(clouds)
    # 40 x 8 cells of 0.5 m lie across the wall; 200 points each, so that the deviation of one is
    # known to 5 %, and the median of 320 to 0.4 %. The smallest of three directions is that across.
    assert len(found) == 320
    assert np.median(found) == pytest.approx(0.02, rel=0.015)
    # Half of the scans 6 cm off: the sum of both variances.
    for number in range(5):
        clouds[number] = (clouds[number][0], poses[number].copy())
        clouds[number][1][0, 3] += 0.06
    expected = np.hypot(0.02, 0.03)
    assert np.median(registration.thickness(clouds)) == pytest.approx(expected, rel=0.03)


def test_lines_and_few_points_are_no_surface():
    rng = np.random.default_rng(2)
    line = np.zeros((1000, 3))
    line[:, 2] = rng.uniform(0, 2, 1000)
    assert len(registration.thickness([(line + 0.25, np.eye(4))])) == 0
    few = wall(0.01, np.eye(4), rng, 320 * 5)
    assert len(registration.thickness([(few, np.eye(4))])) == 0
    assert len(registration.thickness([])) == 0


def test_errors_of_a_trajectory():
    true = np.repeat(np.eye(4)[None], 5, axis=0)
    true[:, 0, 3] = 2.0 * np.arange(5)
    true = turned(0.7) @ true  # begins anywhere
    found = np.repeat(np.eye(4)[None], 5, axis=0)
    found[:, 0, 3] = 2.1 * np.arange(5)
    step, drift = registration.trajectory_error(found, true)
    assert step == pytest.approx(0.1) and drift == pytest.approx(0.4 / 8)
    assert np.isnan(registration.trajectory_error(found[:1], true[:1])).all()


def test_each_cloud_is_aligned_to_all_before_it_from_the_last_step_on():
    """What the module is asked, by a stand-in that answers 1 m forward each time."""
    asked, inserted = [], []

    class Map:
        def __init__(self, leaf):
            assert leaf == 1.0

        def insert(self, cloud, pose):
            inserted.append((cloud, pose[0, 3]))

    def align(target, cloud, init_T_target_source):
        asked.append((cloud, init_T_target_source[0, 3]))
        pose = np.eye(4)
        pose[0, 3] = float(len(asked))
        return types.SimpleNamespace(T_target_source=pose)

    module = types.SimpleNamespace(
        GaussianVoxelMap=Map, align=align, preprocess_points=lambda xyz, size: (xyz[0, 0], None)
    )
    clouds = [(np.full((1, 3), k, np.float32), np.eye(4)) for k in range(4)]
    poses = registration.follow(clouds, module)
    assert poses[:, 0, 3].tolist() == [0, 1, 2, 3]
    assert inserted == [(0, 0), (1, 1), (2, 2), (3, 3)]
    assert asked == [(1, 0), (2, 2), (3, 3)]


def test_motion_correction_makes_walls_thinner(run_command, tmp_path, monkeypatch):
    if not os.path.exists(os.path.join(os.environ.get("SLF_BIN_DIR", ""), "fuse_bag")):
        pytest.skip("fuse_bag is not built (SLF_BIN_DIR)")
    monkeypatch.setattr(registration, "LEAST_POINTS", 4)  # its lidar has few beams
    drive = Drive(scans=4, speed=12.0, yaw_rate=1.5)
    bag, rig, out = tmp_path / "in.bag", tmp_path / "rig.yaml", tmp_path / "out"
    bag_factory.write_bag(str(bag), drive)
    rig.write_text(bag_factory.rig_text(drive))
    code, text, err = run_command("evaluate.py", bag, "--rig", rig, "--registration", "--out", out)
    assert code in (0, None), err
    assert "Registration of in" in text
    with open(out / "registration_in.csv") as file:
        rows = {row["cloud"]: row for row in csv.DictReader(file)}
    names = ["raw", "packet", "firing", "firing, moving classes left out"]
    assert list(rows) == names
    assert all(int(row["cells"]) > 0 for row in rows.values())
    raw, firing = (float(rows[name]["thickness_m"]) for name in ("raw", "firing"))
    print("thickness: raw %.1f mm, firing %.1f mm" % (1e3 * raw, 1e3 * firing))
    assert firing < 0.5 * raw
