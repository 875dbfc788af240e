# SPDX-License-Identifier: MIT
"""Rotations, interpolation of poses and the tf of a bag."""

import numpy as np
import pytest

from semantic_lidar_fusion.bags import poses
from semantic_lidar_fusion.errors import DataError

Rotation = pytest.importorskip("scipy.spatial.transform").Rotation


def random_transforms(count, seed=5):
    rotation = Rotation.random(count, random_state=seed)
    result = np.repeat(np.eye(4)[None], count, axis=0)
    result[:, :3, :3] = rotation.as_matrix()
    result[:, :3, 3] = np.random.RandomState(seed).randn(count, 3) * 10
    return result, rotation.as_quat()


def test_quaternions_against_scipy():
    transforms, quaternions = random_transforms(200)
    np.testing.assert_allclose(poses.to_rotation(quaternions), transforms[:, :3, :3], atol=1e-12)
    for transform, expected in zip(transforms, quaternions):
        found = poses.to_quaternion(transform[:3, :3])
        assert found[3] >= 0
        np.testing.assert_allclose(found * np.sign(found @ expected), expected, atol=1e-9)
    half_turns = [np.diag([1, -1, -1]), np.diag([-1, 1, -1]), np.diag([-1, -1, 1]), np.eye(3)]
    for matrix in half_turns:
        back = poses.to_rotation(poses.to_quaternion(np.array(matrix, dtype=float)))
        np.testing.assert_allclose(back, matrix, atol=1e-12)


def test_inverse_and_points():
    transforms, _ = random_transforms(20)
    np.testing.assert_allclose(
        poses.invert(transforms) @ transforms, np.repeat(np.eye(4)[None], 20, 0), atol=1e-12
    )
    t = poses.make_transform(np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]]), [10, 20, 30])
    np.testing.assert_allclose(poses.transform_points(t, np.array([[1.0, 2, 3]])), [[8, 21, 33]])


def test_interpolation_is_linear_and_slerp():
    start = poses.make_transform(np.eye(3), [331275.0, 6250099.0, 0])
    end = poses.make_transform(
        Rotation.from_euler("z", 40, degrees=True).as_matrix(), [331279.0, 6250099.0, 2]
    )
    # Given out of order, with a doubled time of which the last holds.
    wrong = poses.make_transform(np.eye(3), [0, 0, 0])
    series = poses.PoseSeries([2000, 1000, 2000], [wrong, start, end])
    found, covered = series.lookup([999, 1000, 1250, 2000, 2001])
    assert covered.tolist() == [False, True, True, True, False]
    assert np.isnan(found[0]).all() and np.isnan(found[4]).all()
    np.testing.assert_allclose(found[1], start, atol=1e-9)
    np.testing.assert_allclose(found[3], end, atol=1e-9)
    np.testing.assert_allclose(found[2][:3, 3], [331276.0, 6250099.0, 0.5], atol=1e-9)
    expected = Rotation.from_euler("z", 10, degrees=True).as_matrix()
    np.testing.assert_allclose(found[2][:3, :3], expected, atol=1e-9)
    assert len(poses.PoseSeries([], np.zeros((0, 4, 4)))) == 0
    assert not poses.PoseSeries([], np.zeros((0, 4, 4))).lookup([1])[1].any()


def test_tree_of_a_bag():
    pytest.importorskip("geometry_msgs.msg")
    t_base_lidar = poses.make_transform(
        Rotation.from_euler("y", 7, degrees=True).as_matrix(), [1, 0, 2]
    )
    t_base_camera = poses.make_transform(
        Rotation.from_euler("x", -90, degrees=True).as_matrix(), [2, 1, 0]
    )
    tree = poses.TransformTree()
    tree.add(poses.to_message("base_link", "lidar", t_base_lidar), True)
    tree.add(poses.to_message("base_link", "/camera", t_base_camera), True)
    for i in range(3):
        moved = poses.make_transform(np.eye(3), [i, 0, 0])
        tree.add(poses.to_message("odom", "base_link", moved, 10**9 * (i + 1)), False)
        tree.add(poses.to_message("elsewhere", "lidar", moved, 10**9 * (i + 1)), False)
    np.testing.assert_allclose(
        tree.static("camera", "lidar"), np.linalg.inv(t_base_camera) @ t_base_lidar, atol=1e-12
    )
    found, valid = tree.lookup("odom", "lidar", [1500000000, 4 * 10**9])
    assert valid.tolist() == [True, False]
    np.testing.assert_allclose(found[0][:3, 3], [1.5, 0, 2], atol=1e-12)
    with pytest.raises(DataError, match="not connected"):
        tree.lookup("map", "lidar", [10**9])
    with pytest.raises(DataError, match="no frame map"):
        tree.static("map", "lidar")
    with pytest.raises(DataError, match="not static"):
        tree.static("odom", "lidar")


def test_loops_are_refused():
    pytest.importorskip("geometry_msgs.msg")
    tree = poses.TransformTree()
    tree.add(poses.to_message("a", "b", np.eye(4)), True)
    tree.add(poses.to_message("b", "a", np.eye(4)), True)
    with pytest.raises(DataError, match="loop"):
        tree.lookup("c", "b", [1])


def test_unusable_transforms_are_dropped_and_said(tmp_path, capfd):
    pytest.importorskip("rosbag")
    from tf2_msgs.msg import TFMessage

    from semantic_lidar_fusion.bags.bag_io import BagReader, BagWriter

    def moving(x, stamp_ns, parent="odom", child="base_link", **rotation):
        made = poses.to_message(parent, child, np.eye(4), stamp_ns)
        made.transform.translation.x = x
        for axis, value in rotation.items():
            setattr(made.transform.rotation, axis, value)
        return made

    path = str(tmp_path / "tf.bag")
    with BagWriter(path, "none") as writer:
        for number, transform in enumerate(
            [
                moving(0.0, 10),
                moving(7.0, 11, w=0.0),
                moving(7.0, 12, w=float("nan")),
                moving(7.0, 13, w=2.0),
                moving(float("inf"), 14),
                moving(7.0, 0),
                moving(7.0, 15, parent=""),
                moving(7.0, 16, child="odom"),
                moving(2.0, 20, w=1.005),
            ]
        ):
            writer.write("/tf", TFMessage([transform]), number + 1)
    with BagReader(path) as bag:
        tree = poses.TransformTree.from_bag(bag)
    assert sum(tree.dropped.values()) == 7
    found, known = tree.lookup("odom", "base_link", np.array([10, 15, 20]))
    assert known.all()
    np.testing.assert_allclose(found[:, 0, 3], [0.0, 1.0, 2.0])
    said = capfd.readouterr().err
    for reason in ("norm 0; 1 is wanted", "norm 2", "not finite", "stamp is 0", "frames are empty"):
        assert reason in said
    assert path in said and "Traceback" not in said
    for bad in ([0, 0, 0, 0], [0, 0, np.nan, 1]):
        with pytest.raises(DataError):
            poses.to_rotation(np.array(bad))
