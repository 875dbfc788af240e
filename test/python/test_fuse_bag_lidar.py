# SPDX-License-Identifier: MIT
"""fuse_bag on what lidars and their drivers send: times, stamps and points that are wrong."""
import os
import sys

import numpy as np
import pytest

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
bag_factory = pytest.importorskip("bag_factory")
import rosbag  # noqa: E402
from sensor_msgs.msg import PointField  # noqa: E402

from bag_factory import START_NS, Drive, read_cloud, stamp  # noqa: E402
from test_fuse_bag import Made, run, world_points  # noqa: E402

SURFACE_M = 0.01  # right points lie on a surface; floats and odometry's interpolation cost less
ABSOLUTE = np.dtype(
    {
        "names": ["x", "y", "z", "intensity", "ring", "timestamp"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "<u2", "<f8"],
        "offsets": [0, 4, 8, 12, 16, 24],
        "itemsize": 32,
    }
)


def changed(folder, drive, change, rig_extra=""):
    """A bag of the drive in which `change(message)` altered each message of the lidar."""
    made = Made(folder, drive, rig_extra)
    raw = folder / "raw.bag"
    made.bag.rename(raw)
    with rosbag.Bag(str(raw)) as source, rosbag.Bag(str(made.bag), "w") as target:
        for topic, message, time in source.read_messages():
            if topic in ("/points", "/velodyne_packets"):
                change(message)
            header = bag_factory.latching_header(topic, message) if topic == "/tf_static" else None
            target.write(topic, message, time, connection_header=header)
    return made


def gaps(made, fused):
    """For each semantic cloud the distance of its points to the nearest surface, m."""
    result = []
    for message in fused.of("/points_semantic"):
        cloud = read_cloud(message)
        T = made.drive.pose((message.header.stamp.to_nsec() - START_NS) * 1e-9)
        T = T @ made.drive.lidar_pose
        xyz = np.stack([cloud["x"], cloud["y"], cloud["z"]], -1).astype(float)
        result.append(made.drive.surface_gap(xyz @ T[:3, :3].T + T[:3, 3]))
    return result


def absolute(message, unit=1e-9):
    """The cloud with its times as f64 since the epoch; `unit` of the field's values, s."""
    cloud = read_cloud(message)
    times = np.zeros(len(cloud), ABSOLUTE)
    for name in ABSOLUTE.names[:5]:
        times[name] = cloud[name]
    times["timestamp"] = (message.header.stamp.to_nsec() + cloud["t"].astype(float)) * 1e-9 / unit
    kinds = {"<f4": 7, "<u2": 4, "<f8": 8}
    message.fields = [
        PointField(name, ABSOLUTE.fields[name][1], kinds[ABSOLUTE.fields[name][0].str], 1)
        for name in ABSOLUTE.names
    ]
    message.point_step, message.row_step = 32, 32 * len(cloud)
    return times


def test_one_zero_timestamp_of_absolute_times(tmp_path):
    def change(message):
        cloud = absolute(message, unit=1.0)
        cloud["timestamp"][100] = 0.0
        message.data = cloud.tobytes()

    made = changed(tmp_path, Drive(scans=2), change)
    fused = made.fuse()
    for gap in gaps(made, fused):
        assert len(gap) == made.drive.points_per_scan - 1
        assert gap.max() < SURFACE_M
    assert "points with a time that is none of their scan's: 2" in fused.result.stdout


def test_times_that_change_their_unit_are_said(tmp_path):
    units = iter([1.0, 1e-9, 1.0])

    def change(message):
        message.data = absolute(message, unit=next(units)).tobytes()

    made = changed(tmp_path, Drive(scans=3), change)
    fused = made.fuse()
    assert max(gap.max() for gap in gaps(made, fused)) < SURFACE_M
    assert "read otherwise than those of the scan before" in fused.result.stderr


def test_beams_without_a_return(tmp_path):
    def change(message):
        cloud = read_cloud(message).copy()
        none = np.random.RandomState(0).rand(len(cloud)) < 0.3
        for axis in "xyz":
            cloud[axis][none] = 0.0
        message.data = cloud.tobytes()

    made = changed(tmp_path, Drive(scans=2), change)
    fused = made.fuse()
    for gap in gaps(made, fused):
        assert 0.6 * made.drive.points_per_scan < len(gap) < 0.8 * made.drive.points_per_scan
        assert gap.max() < SURFACE_M
    assert "points without a return" in fused.result.stdout


def test_a_packet_of_another_hour(tmp_path):
    def change(message):
        early = message.packets[40].stamp.to_nsec() - 3600 * 10**9
        message.packets[40].stamp = stamp(early)

    made = changed(tmp_path, Drive(scans=2, lidar="packets"), change)
    fused = made.fuse()
    for gap in gaps(made, fused):
        assert gap.max() < SURFACE_M
    assert "packets stamped far from the others of their scan: 2" in fused.result.stdout


def test_packets_of_one_stamp(tmp_path):
    def change(message):
        for packet in message.packets:
            packet.stamp = message.packets[0].stamp

    made = changed(tmp_path, Drive(scans=2, lidar="packets"), change)
    fused = made.fuse()
    assert max(gap.max() for gap in gaps(made, fused)) < SURFACE_M
    assert "all packets of a scan carry one stamp" in fused.result.stderr


def changed_tf(folder, change, drive=None):
    """A bag of a drive in which `change(message)` altered each message on /tf."""
    made = Made(folder, drive or Drive(scans=2))
    raw = folder / "raw.bag"
    made.bag.rename(raw)
    with rosbag.Bag(str(raw)) as source, rosbag.Bag(str(made.bag), "w") as target:
        for topic, message, time in source.read_messages():
            if topic == "/tf":
                change(message)
            header = bag_factory.latching_header(topic, message) if topic == "/tf_static" else None
            target.write(topic, message, time, connection_header=header)
    return made


def test_a_jump_of_the_pose(tmp_path):
    def change(message):
        if message.transforms[0].header.stamp.to_nsec() >= START_NS + 155_000_000:
            message.transforms[0].transform.translation.x += 10.0

    made = changed_tf(tmp_path, change)
    fused = made.fuse()
    gap = gaps(made, fused)[0]
    status = fused.clouds()[0]["status"]
    assert gap[status == 0].max() < SURFACE_M
    # The scan ends at 0.2 s; t_ref is 0.15 s, and the last reading before the jump is there.
    assert 0.4 < (status == 4).mean() < 0.6
    assert "jumps by 10.0" in fused.result.stderr
    assert "firings: odometry does not cover them" in fused.result.stdout


def test_a_static_transform_told_twice(tmp_path):
    drive = Drive(scans=2)

    def change(message):
        higher = drive.lidar_pose.copy()
        higher[2, 3] += 0.5
        stamp_ns = message.transforms[0].header.stamp.to_nsec()
        message.transforms.append(
            bag_factory.transform_message("base_link", "velodyne", stamp_ns, higher)
        )

    made = changed_tf(tmp_path, change, drive)
    fused = made.fuse()
    assert max(gap.max() for gap in gaps(made, fused)) < SURFACE_M
    (line,) = [x for x in fused.result.stderr.splitlines() if "base_link <- velodyne" in x]
    assert "(1.000, 0.000, 0.500)" in line and "(1.000, 0.000, 1.000)" in line


def test_a_refused_transform_says_why(tmp_path):
    def change(message):
        rotation = message.transforms[0].transform.rotation
        for axis in "xyzw":
            setattr(rotation, axis, 1.2 * getattr(rotation, axis))

    made = changed_tf(tmp_path, change)
    result = run(made.bag, made.folder / "out.bag", "--rig", made.rig)
    assert result.returncode == 1, "no point got a class"
    assert "odom <- base_link" in result.stderr and "1.2" in result.stderr


def test_a_transform_that_is_not_quite_normalised_is_taken(tmp_path):
    def change(message):
        rotation = message.transforms[0].transform.rotation
        for axis in "xyzw":
            setattr(rotation, axis, 1.02 * getattr(rotation, axis))

    made = changed_tf(tmp_path, change)
    result = run(made.bag, made.folder / "out.bag", "--rig", made.rig)
    assert result.returncode == 0, result.stderr
    lines = [line for line in result.stderr.splitlines() if "norm 1.02" in line]
    assert len(lines) == 1 and "warning" in lines[0] and "1 is wanted" in lines[0]


def test_a_lidar_of_128_rings_at_20_hz(tmp_path):
    """262 144 points a scan, 20 scans a second: each point comes out, where it is, with its class."""
    drive = Drive(
        scans=2,
        rings=128,
        points_per_scan=128 * 2048,
        scan_ns=50_000_000,
        elevations_deg=(-25.0, 15.0),
    )
    made = Made(tmp_path, drive)
    fused = made.fuse()
    clouds = fused.clouds()
    assert len(clouds) == drive.scans
    for message, cloud, gap in zip(fused.of("/points_semantic"), clouds, gaps(made, fused)):
        assert len(cloud) == drive.points_per_scan
        assert gap.max() < SURFACE_M
        world = world_points(drive, cloud, message.header.stamp.to_nsec())
        labelled = cloud["status"] == 0
        assert labelled.sum() > 0.3 * len(cloud)
        right = drive.class_of(world[labelled]) == cloud["label"][labelled]
        assert right.mean() > 0.98
    assert "nothing was dropped" in fused.result.stdout
