# SPDX-License-Identifier: MIT
"""import_dataset.py on made-up data sets whose numbers are known, and on compact real ones."""

import itertools
import os
import shutil
import sys
import types

import numpy as np
import pytest
import yaml

pytest.importorskip("rosbag")
cv2 = pytest.importorskip("cv2")
import dataset_factory as made  # noqa: E402
import rosbag  # noqa: E402

from semantic_lidar_fusion.bags import bag_io, cloud_io, poses  # noqa: E402
from semantic_lidar_fusion.datasets import kitti, records  # noqa: E402
from semantic_lidar_fusion.datasets import rellis, table, writer  # noqa: E402
from semantic_lidar_fusion.errors import DataError  # noqa: E402
from semantic_lidar_fusion.labels import LabelSet, package_file  # noqa: E402

SCRIPT = "import_dataset.py"
# Rotations pass through quaternions of doubles, positions through text of 13 digits.
PIXEL_TOLERANCE = 1e-6


class Imported:
    """All that an import wrote."""

    def __init__(self, bag, rig):
        with open(rig) as file:
            self.rig = yaml.safe_load(file)
        self.messages = {}
        with bag_io.BagReader(bag) as reader:
            self.types = reader.topics
            self.tree = poses.TransformTree.from_bag(reader)
            last = 0
            for entry in reader.read():
                assert entry.stamp_ns >= last
                last = entry.stamp_ns
                message = entry.message
                if hasattr(message, "header"):
                    assert bag_io.to_ns(message.header.stamp) == entry.stamp_ns
                self.messages.setdefault(entry.topic, []).append(message)

    def cloud(self, topic, index=0):
        return cloud_io.to_array(self.messages[topic][index])

    def stamps(self, topic):
        return [bag_io.to_ns(m.header.stamp) for m in self.messages[topic]]

    def in_camera(self, topic, lidar_topic, points):
        """Positions (N, 3) of lidar points in a camera's optical frame, through tf."""
        frames = [self.messages[t][0].header.frame_id for t in (topic, lidar_topic)]
        return poses.transform_points(self.tree.static(*frames), points)


def import_one(run_command, tmp_path, *arguments):
    bag = str(tmp_path / "out" / "drive.bag")
    os.makedirs(os.path.dirname(bag), exist_ok=True)
    code, out, err = run_command(SCRIPT, *(list(arguments) + [bag]))
    assert code == 0, err
    assert sorted(os.listdir(os.path.dirname(bag))) == ["drive.bag", "drive.yaml"]
    return Imported(bag, bag[:-4] + ".yaml"), out, err


def kitti_pixel(point, projection):
    """Pixel of a lidar point by the data set's own formula: P_rect R_rect T_cam0_velo x."""
    rect = np.eye(4)
    rect[:3, :3] = made.R_RECT
    y = projection @ rect @ made.T_CAM0_VELO @ np.append(point, 1.0)
    return y[:2] / y[2]


def check_points(cloud, expected_times_ns):
    for column, name in enumerate(("x", "y", "z", "intensity")):
        np.testing.assert_array_equal(cloud[name], made.POINTS[:, column])
    assert cloud["ring"].tolist() == made.RINGS and cloud["ring"].dtype == np.uint16
    # The made-up azimuths are off by up to 1e-4 rad: 5 us of a sweep of 0.1 s.
    np.testing.assert_allclose(cloud["t"], expected_times_ns, atol=5000)


class TestKitti:
    def test_sync(self, run_command, tmp_path):
        got, out, err = import_one(run_command, tmp_path, "kitti", made.kitti(tmp_path))
        assert not err and "3 scans (24 points), 6 images, 4 odometry readings" in out
        assert got.types == {
            "/camera_02/camera_info": "sensor_msgs/CameraInfo",
            "/camera_02/image/compressed": "sensor_msgs/CompressedImage",
            "/camera_03/camera_info": "sensor_msgs/CameraInfo",
            "/camera_03/image/compressed": "sensor_msgs/CompressedImage",
            "/tf": "tf2_msgs/TFMessage",
            "/tf_static": "tf2_msgs/TFMessage",
            "/velodyne_points": "sensor_msgs/PointCloud2",
        }
        # Every line of the time files ends in 123 ns.
        offset = made.START_NS + 123
        assert got.stamps("/velodyne_points") == [offset + s[0] * 10**6 for s in made.SWEEPS_MS]
        images = [offset + ms * 10**6 for ms in made.IMAGES_MS]
        assert got.stamps("/camera_02/image/compressed") == images
        assert got.stamps("/camera_03/camera_info") == images
        for index in range(3):
            check_points(got.cloud("/velodyne_points", index), np.array(made.TIMES_MS) * 1e6)

    def test_pixels_through_tf_and_camera_info(self, run_command, tmp_path):
        got, _, _ = import_one(run_command, tmp_path, "kitti", made.kitti(tmp_path))
        for camera, factor in (("02", 1.0), ("03", -8.0)):
            info = got.messages["/camera_%s/camera_info" % camera][0]
            projection = np.array(info.P).reshape(3, 4)
            # The baseline stands in tf alone.
            assert not projection[:, 3].any()
            np.testing.assert_allclose(projection[:, :3].reshape(-1), info.K)
            assert (info.width, info.height) == (made.WIDTH, made.HEIGHT)
            assert info.distortion_model == "plumb_bob" and not any(info.D)
            points = np.array([[10.0, 1.0, 0.5], [25.0, -3.0, -1.0], [4.0, 0.2, 0.1]])
            in_camera = got.in_camera("/camera_%s/camera_info" % camera, "/velodyne_points", points)
            for point, p in zip(points, in_camera):
                pixel = (projection[:, :3] @ p)[:2] / p[2]
                wanted = kitti_pixel(point, made.P_RECT * [1, 1, 1, factor])
                np.testing.assert_allclose(pixel, wanted, atol=PIXEL_TOLERANCE)
        assert [c["rectified"] for c in got.rig["cameras"]] == [True, True]

    def test_image_bytes_are_untouched(self, run_command, tmp_path):
        drive = made.kitti(tmp_path)
        got, _, _ = import_one(run_command, tmp_path, "kitti", drive)
        message = got.messages["/camera_02/image/compressed"][2]
        with open(os.path.join(drive, "image_02", "data", "0000000002.png"), "rb") as file:
            assert bytes(message.data) == file.read()
        assert message.format == "png"
        assert message.header.frame_id == "camera_02_optical_frame"

    def test_odometry(self, run_command, tmp_path):
        got, _, _ = import_one(run_command, tmp_path, "kitti", made.kitti(tmp_path))
        stamps = np.array([made.START_NS + 123 + ms * 10**6 for ms in (100, 200, 300, 400)])
        found, valid = got.tree.lookup("odom", "base_link", stamps)
        assert valid.all()
        # 1e-6 deg of latitude is 6378137 m * pi / 180e6 = 0.1113195 m to the north (y).
        for n in range(4):
            np.testing.assert_allclose(found[n][:3, 3], [0, 0.1113195 * n, n], atol=1e-6)
            # The vehicle's x axis points north; nose up by 0.02 rad (pitch is positive downwards).
            np.testing.assert_allclose(found[n][:3, 0], [0, np.cos(0.02), np.sin(0.02)], atol=1e-9)
            # Left side (west) up by 0.01 rad.
            np.testing.assert_allclose(
                found[n][:3, 1], [-np.cos(0.01), -0.02 * 0.01, np.sin(0.01)], atol=1e-5
            )
        t_velo_imu = got.tree.static("velodyne", "base_link")
        np.testing.assert_allclose(t_velo_imu, made.T_VELO_IMU, atol=1e-9)

    def test_rig(self, run_command, tmp_path):
        drive = made.kitti(tmp_path)
        got, _, _ = import_one(
            run_command, tmp_path, "kitti", drive, "--cameras", "image_03", "--model", "m/net.yaml"
        )
        rig = got.rig
        assert rig["cameras"] == [
            {"name": "camera_03", "transport": "compressed", "rectified": True}
        ]
        assert rig["lidar"] == {"input": "points", "topic": "/velodyne_points"}
        assert rig["motion"] == {"enabled": True}
        assert rig["reference"]["camera"] == "camera_03"
        assert (rig["fixed_frame"], rig["vehicle_frame"]) == ("odom", "base_link")
        labels = LabelSet.from_tree(rig["classes"], "rig")
        assert labels == LabelSet.from_file(package_file("config/classes_cityscapes.yaml"))
        model = os.path.join(str(tmp_path / "out"), rig["segmentation"]["model"])
        assert os.path.realpath(model) == os.path.realpath("m/net.yaml")
        assert "/camera_02/camera_info" not in got.types

    def test_raw_images_and_part_of_a_drive(self, run_command, tmp_path):
        got, _, _ = import_one(
            run_command,
            tmp_path,
            "kitti",
            made.kitti(tmp_path),
            "--images",
            "raw",
            "--first",
            "1",
            "--last",
            "1",
        )
        assert got.stamps("/velodyne_points") == [made.START_NS + 123 + 200 * 10**6]
        image = got.messages["/camera_02/image"][0]
        assert (image.encoding, image.width, image.height) == ("bgr8", made.WIDTH, made.HEIGHT)
        pixels = np.frombuffer(image.data, np.uint8).reshape(made.HEIGHT, made.WIDTH, 3)
        assert pixels[7, 3].tolist() == [35, 35, 35]
        assert "transport" not in got.rig["cameras"][0]

    def test_extract(self, run_command, tmp_path):
        drive = made.kitti(tmp_path, unrectified=True, oxts_hz=100)
        got, out, _ = import_one(run_command, tmp_path, "kitti", drive)
        assert "34 odometry readings" in out
        check_points(got.cloud("/velodyne_points"), np.array(made.TIMES_MS) * 1e6)
        info = got.messages["/camera_02/camera_info"][0]
        np.testing.assert_allclose(np.array(info.K).reshape(3, 3), made.K_RAW)
        np.testing.assert_allclose(info.D, made.D_RAW)
        assert info.distortion_model == "plumb_bob"
        assert "rectified" not in got.rig["cameras"][0]
        point = np.array([[12.0, 1.0, -0.5]])
        p = got.in_camera("/camera_02/camera_info", "/velodyne_points", point)
        in_cam0 = (made.T_CAM0_VELO @ np.append(point[0], 1.0))[:3]
        wanted, _ = cv2.projectPoints(
            in_cam0[None],
            cv2.Rodrigues(made.R_RAW)[0],
            made.T_RAW,
            made.K_RAW,
            np.array(made.D_RAW),
        )
        found, _ = cv2.projectPoints(
            p, np.zeros(3), np.zeros(3), np.array(info.K).reshape(3, 3), np.array(info.D)
        )
        np.testing.assert_allclose(found, wanted, atol=PIXEL_TOLERANCE)


def test_sweep_direction_and_uneven_halves():
    angles = np.radians([179.999, 135, 90, 0.001, 0, -90, -179.999])
    xyz = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1) * 7
    times = records.sweep_times(xyz, 1000, 1000 + 40000, 1000 + 100000)
    np.testing.assert_allclose(times, [0, 10000, 20000, 40000, 40000, 70000, 100000], atol=1)


def test_rings_keep_the_largest_falls():
    # 70 lasers of 2 points: the six smallest falls are no new laser.
    last = np.radians(np.where(np.arange(70) < 64, 350.0, 300.0))
    angles = np.stack([np.full(70, np.radians(5.0)), last], axis=1).reshape(-1)
    xyz = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    rings = records.rings_of_rows(xyz)
    assert rings[0] == 63 and rings[-1] == 0 and len(np.unique(rings)) == 64
    assert len(records.rings_of_rows(np.zeros((0, 3)))) == 0


def test_rings_of_scans_that_are_not_laser_by_laser():
    # 64 lasers of the HDL-64E at 10 m, 90 azimuths; seen by the sensor's order, shuffled, by columns.
    lasers = np.radians(np.concatenate([2.0 - np.arange(32) / 3, -8.83 - 0.5 * np.arange(32)]))
    elevation = np.repeat(lasers, 90)
    azimuth = np.tile(np.radians(np.arange(90) * 4.0 + 1.0), 64)
    xyz = 10 * np.stack(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ],
        axis=1,
    )
    truth = 63 - np.repeat(np.arange(64), 90)
    for order in (
        np.arange(len(xyz)),
        np.random.RandomState(1).permutation(len(xyz)),
        np.arange(len(xyz)).reshape(64, 90).T.reshape(-1),
    ):
        assert (records.rings_of_scan(xyz[order]) == truth[order]).all()


def test_overflowed_coordinates_return_to_their_place():
    angles = np.radians(np.arange(1.0, 359.0, 0.2))
    distance = np.where((np.arange(len(angles)) % 37) < 3, 80.0, 20.0)
    xyz = np.stack([distance * np.cos(angles), distance * np.sin(angles), 0.1 * angles], axis=1)
    units = np.rint(xyz / 0.002).astype(np.int64)
    overflowed = (np.abs(units) > 32767).any(axis=1)
    assert overflowed.sum() > 50
    found = kitti.unfold_compact(units.astype(np.int16))
    np.testing.assert_allclose(found, xyz, atol=0.0011)


class TestSemanticKitti:
    def test_everything(self, run_command, tmp_path):
        got, out, err = import_one(
            run_command, tmp_path, "semantickitti", made.semantickitti(tmp_path)
        )
        # Seven of eight points have a class, `unlabeled` among them.
        assert not err and "21 labelled points" in out
        stamps = [records.EPOCH_NS + ns for ns in (0, 103646000, 207302000)]
        for topic in ("/velodyne_points", "/points_truth", "/camera_2/image/compressed"):
            assert got.stamps(topic) == stamps
        cloud, truth = got.cloud("/velodyne_points"), got.cloud("/points_truth")
        assert "t" not in cloud.dtype.names and cloud["ring"].tolist() == made.RINGS
        np.testing.assert_array_equal(cloud_io.xyz(truth), cloud_io.xyz(cloud))
        labels = LabelSet.from_tree(got.rig["classes"], "rig")
        names = [labels[i].name if i != 255 else None for i in truth["label"]]
        assert names == made.SEMANTICKITTI_NAMES and truth["label"].dtype == np.uint8
        assert got.rig["motion"] == {"enabled": False}
        found, _ = got.tree.lookup("odom", "velodyne", stamps)
        rotation = made.T_CAM0_VELO[:3, :3]
        for n in range(3):
            # Forward for the camera is x for the lidar.
            np.testing.assert_allclose(found[n][:3, 3], [1.5 * n, 0, 0], atol=1e-9)
            np.testing.assert_allclose(found[n][:3, :3], rotation.T @ rotation, atol=1e-9)
        info = got.messages["/camera_2/camera_info"][0]
        point = np.array([[9.0, -0.4, 0.3]])
        p = got.in_camera("/camera_2/camera_info", "/velodyne_points", point)[0]
        wanted = (made.P_RECT * [1, 1, 1, 2]) @ made.T_CAM0_VELO @ np.append(point[0], 1.0)
        pixel = (np.array(info.P).reshape(3, 4)[:, :3] @ p)[:2] / p[2]
        np.testing.assert_allclose(pixel, wanted[:2] / wanted[2], atol=PIXEL_TOLERANCE)

    def test_other_class_set(self, run_command, tmp_path):
        got, _, _ = import_one(
            run_command,
            tmp_path,
            "semantickitti",
            made.semantickitti(tmp_path),
            "--classes",
            package_file("config/classes_usyd12.yaml"),
        )
        labels = LabelSet.from_tree(got.rig["classes"], "rig")
        names = [labels[i].name if i != 255 else None for i in got.cloud("/points_truth")["label"]]
        assert names == [
            "road",
            "vehicle",
            "vehicle",
            "pedestrian",
            "vegetation",
            "unlabeled",
            "road",
            None,
        ]

    def test_without_labels_and_poses(self, run_command, tmp_path):
        folder = made.semantickitti(tmp_path)
        shutil.rmtree(os.path.join(folder, "labels"))
        os.remove(os.path.join(folder, "poses.txt"))
        got, _, _ = import_one(run_command, tmp_path, "semantickitti", folder)
        assert "/points_truth" not in got.types and "/tf" not in got.types


class TestRellis:
    def check_labels(self, got):
        labels = LabelSet.from_tree(got.rig["classes"], "rig")
        truth = got.cloud("/points_truth")
        names = [labels[i].name if i != 255 else None for i in truth["label"]]
        assert names == made.RELLIS_NAMES
        return labels

    def test_ply(self, run_command, tmp_path):
        got, _, err = import_one(run_command, tmp_path, "rellis", made.rellis(tmp_path))
        assert not err
        second = 1581624663 * 10**9
        topic = "/os1_cloud_node/points"
        assert got.stamps(topic) == [second + ms * 10**6 for ms in made.RELLIS_SCANS_MS]
        assert got.stamps("/pylon/image/compressed") == [
            second + ms * 10**6 for ms in made.RELLIS_IMAGES_MS
        ]
        cloud = got.cloud(topic)
        # The return at the origin is none.
        assert len(cloud) == 8
        assert cloud["t"].tolist() == [1000 * i + 7 for i in range(8)]
        assert cloud["ring"].tolist() == made.RINGS_TOP_DOWN[:8]
        np.testing.assert_array_equal(cloud["intensity"], made.POINTS[:, 3])
        self.check_labels(got)
        assert got.rig["motion"] == {"enabled": True}
        found, _ = got.tree.lookup("odom", "os1_cloud_node", got.stamps(topic))
        np.testing.assert_allclose(found[:, 0, 3], [0, 1, 2], atol=1e-9)

    def test_camera(self, run_command, tmp_path):
        got, _, _ = import_one(run_command, tmp_path, "rellis", made.rellis(tmp_path))
        info = got.messages["/pylon/camera_info"][0]
        assert info.K == (100.0, 0, 31.0, 0, 110.0, 23.0, 0, 0, 1) and not any(info.D)
        p = got.in_camera(
            "/pylon/camera_info", "/os1_cloud_node/points", np.array([[10.2, 1.0, 0.4]])
        )[0]
        # 10 m ahead of the camera, 1 m to its left, 0.5 m above it.
        np.testing.assert_allclose(p, [-1.0, -0.5, 10.0], atol=1e-9)

    def test_distortion_option(self, run_command, tmp_path):
        got, _, _ = import_one(
            run_command,
            tmp_path,
            "rellis",
            made.rellis(tmp_path),
            "--distortion",
            "published",
        )
        d = got.messages["/pylon/camera_info"][0].D
        assert d == (-0.134313, -0.025905, 0.002181, 0.00084, 0.0)

    def test_bin_only(self, run_command, tmp_path):
        got, _, _ = import_one(
            run_command, tmp_path, "rellis", made.rellis(tmp_path, with_ply=False)
        )
        topic = "/os1_cloud_node/points"
        assert got.stamps(topic) == got.stamps("/pylon/image/compressed")
        assert set(got.cloud(topic).dtype.names) == {"x", "y", "z", "intensity"}
        assert len(got.cloud(topic)) == 8
        self.check_labels(got)
        assert got.rig["motion"] == {"enabled": False}

    def test_one_hot_scores(self, run_command, tmp_path):
        got, out, _ = import_one(
            run_command,
            tmp_path,
            "rellis",
            made.rellis(tmp_path),
            "--scores",
            "onehot",
            "--score-stride",
            "4",
            "--score-gain",
            "7.5",
        )
        assert "2 score images" in out
        labels = LabelSet.from_tree(got.rig["classes"], "rig")
        # The middle image has no human labels.
        stamps = got.stamps("/pylon/image/compressed")
        assert got.stamps("/pylon/scores") == [stamps[0], stamps[2]]
        message = got.messages["/pylon/scores"][0]
        assert (message.encoding, message.width, message.height) == ("32FC20", 16, 12)
        scores = np.frombuffer(message.data, "<f4").reshape(12, 16, 20)
        assert message.step == 16 * 20 * 4
        expected = np.zeros((12, 16, 20))
        expected[:6, 2:, labels.id_of("sky")] = 7.5
        expected[6:, 2:, labels.id_of("grass")] = 7.5
        np.testing.assert_array_equal(scores, expected)


def test_one_hot_cells_follow_the_interface():
    # Cell i of n lies over pixel floor((i + 0.5) * m / n) of m.
    labels = np.arange(7 * 10).reshape(7, 10).astype(np.uint8)
    scores = writer.one_hot_scores(labels, 100, 3, 1.0)
    assert scores.shape == (3, 4, 100)
    for i in range(3):
        for j in range(4):
            pixel = labels[int((i + 0.5) * 7 / 3), int((j + 0.5) * 10 / 4)]
            assert scores[i, j].argmax() == pixel and scores[i, j].sum() == 1.0


def remove(*path):
    def change(folder):
        os.remove(os.path.join(folder, *path))

    return change


def remove_folder(*path):
    return lambda folder: shutil.rmtree(os.path.join(folder, *path))


def replace(path, text):
    def change(folder):
        made.write(os.path.join(folder, *path), text)

    return change


def cut(path, size):
    def change(folder):
        name = os.path.join(folder, *path)
        data = open(name, "rb").read()
        made.write_bytes(name, data[:size])

    return change


def put_bytes(path, data):
    return lambda folder: made.write_bytes(os.path.join(folder, *path), data)


UP = os.pardir
NAN = np.full((8, 4), np.nan, dtype="<f4").tobytes()
T0, T1, T2 = made.stamps([100]), made.stamps([200]), made.stamps([300])
BAD = [
    (
        "kitti",
        replace(
            ["oxts", "timestamps.txt"], made.stamps([100, 200, 300, 400]).replace("2011", "6011")
        ),
        "timestamps.txt line 1: its time lies outside 1970 to 2106",
    ),
    ("kitti", remove(UP, "calib_cam_to_cam.txt"), "calib_cam_to_cam.txt: no such file"),
    ("kitti", remove(UP, "calib_velo_to_cam.txt"), "calib_velo_to_cam.txt: no such file"),
    ("kitti", remove(UP, "calib_imu_to_velo.txt"), "calib_imu_to_velo.txt: no such file"),
    ("kitti", replace([UP, "calib_velo_to_cam.txt"], "T: 0 0 0\n"), "no entry R"),
    (
        "kitti",
        replace([UP, "calib_velo_to_cam.txt"], "R: 1 0 0 0 1 0 0 0\nT: 0 0 0\n"),
        "line 1 (R): 8 numbers; must be 9",
    ),
    (
        "kitti",
        replace([UP, "calib_velo_to_cam.txt"], "R: 2 0 0 0 1 0 0 0 1\nT: 0 0 0\n"),
        "not a rotation",
    ),
    (
        "kitti",
        replace([UP, "calib_velo_to_cam.txt"], "R: 1 0 0 0 1 0 0 0 x\nT: 0 0 0\n"),
        "could not convert",
    ),
    ("kitti", remove_folder("velodyne_points"), "velodyne_points"),
    ("kitti", remove_folder("oxts"), "oxts"),
    (
        "kitti",
        lambda folder: [
            shutil.rmtree(os.path.join(folder, name)) for name in ("image_02", "image_03")
        ],
        "neither image_02 nor image_03",
    ),
    ("kitti", remove("velodyne_points", "timestamps_start.txt"), "timestamps_start.txt"),
    ("kitti", cut(["velodyne_points", "data", "0000000001.bin"], 100), "not a multiple of 16"),
    ("kitti", put_bytes(["velodyne_points", "data", "0000000001.bin"], NAN), "not finite"),
    ("kitti", cut(["image_03", "data", "0000000001.png"], 60), "the PNG is cut off"),
    (
        "kitti",
        put_bytes(["image_02", "data", "0000000001.png"], b"GIF89a"),
        "neither a PNG nor a JPEG",
    ),
    (
        "kitti",
        lambda folder: made.write_image(
            os.path.join(folder, "image_02", "data", "0000000001.png"), np.zeros((9, 7), np.uint8)
        ),
        "7 x 9; the images before it are 64 x 48",
    ),
    ("kitti", replace(["oxts", "data", "0000000002.txt"], "49 8 100\n"), "3 numbers; must be 30"),
    ("kitti", replace(["oxts", "data", "0000000002.txt"], "nan " * 30), "not finite"),
    ("kitti", replace(["oxts", "data", "0000000002.txt"], "91 " * 30), "out of range"),
    ("semantickitti", remove("times.txt"), "times.txt: no such file"),
    ("semantickitti", remove("calib.txt"), "calib.txt: no such file"),
    ("semantickitti", replace(["calib.txt"], "P2: " + "1 " * 12), "no entry Tr"),
    ("semantickitti", remove_folder("image_2"), "image_2: no such folder"),
    ("semantickitti", remove("labels", "000001.label"), "times.txt has 3 lines (no number 1)"),
    ("semantickitti", remove("velodyne", "000002.bin"), "times.txt has 3 lines (no number 2)"),
    ("semantickitti", cut(["labels", "000001.label"], 28), "7 labels; its scan has 8 points"),
    ("semantickitti", replace(["times.txt"], "0\n0\n1\n"), "time 2 is not after"),
    ("semantickitti", replace(["times.txt"], "0\n1\n1e308\n"), "line 3: 1e+308 s"),
    ("semantickitti", replace(["poses.txt"], "1e300 " * 12 + "\n"), "not a rotation"),
    ("semantickitti", replace(["poses.txt"], "1 0 0 0\n"), "poses.txt line 1: 4 numbers"),
    ("rellis", remove("camera_info.txt"), "camera_info.txt: no such file"),
    ("rellis", replace(["camera_info.txt"], "1 2 3"), "3 numbers; must be 4"),
    ("rellis", replace(["transforms.yaml"], "a: 1"), "no os1_cloud_node-pylon_camera_node"),
    (
        "rellis",
        replace(
            ["transforms.yaml"],
            "os1_cloud_node-pylon_camera_node:\n"
            "  {q: {x: .nan, y: 0, z: 0, w: 1}, t: {x: 0, y: 0, z: 0}}\n",
        ),
        "q must be a unit quaternion",
    ),
    ("rellis", remove_folder("pylon_camera_node"), "pylon_camera_node: no such folder"),
    (
        "rellis",
        put_bytes(["pylon_camera_node", "photo.jpg"], b""),
        "photo.jpg: not named frameNNNNNN-SECONDS_MILLIS",
    ),
    (
        "rellis",
        cut(["os1_cloud_node_color_ply", "frame000001-1581624663_100.ply"], 300),
        "cut off, 9 points expected",
    ),
    (
        "rellis",
        put_bytes(["os1_cloud_node_color_ply", "frame000001-1581624663_100.ply"], b"x"),
        "not a PLY file",
    ),
    (
        "rellis",
        cut(["pylon_camera_node", "frame000001-1581624663_150.jpg"], 500),
        "the JPEG is cut off",
    ),
    ("rellis", replace(["poses.txt"], made.numbers(np.eye(4)[:3]) + "\n"), "1 poses"),
]


GAPS = [
    # What the drive lacks; scans, left images and odometry readings that remain; what is said.
    (remove("velodyne_points", "data", "0000000001.bin"), (2, 3, 4), "number 1: no file"),
    (put_bytes(["velodyne_points", "data", "0000000001.bin"], b""), (2, 3, 4), "file is empty"),
    (remove("image_02", "data", "0000000002.png"), (3, 2, 4), "number 2: no file"),
    (remove("oxts", "data", "0000000001.txt"), (3, 3, 3), "number 1: no file"),
    (replace(["oxts", "data", "0000000002.txt"], ""), (3, 3, 3), "its file is empty"),
    (
        replace(["velodyne_points", "timestamps_end.txt"], made.stamps([150, 250])),
        (2, 3, 4),
        "no start or end of its sweep",
    ),
    (replace(["velodyne_points", "timestamps.txt"], T0 + "\n" + T2), (2, 3, 4), "no time"),
    (replace(["image_02", "timestamps.txt"], T1 + T0 + T2), (3, 2, 4), "not after"),
    # A receiver that repeats itself and one that steps back once.
    (
        replace(["oxts", "timestamps.txt"], made.stamps([100, 200, 200, 400])),
        (3, 3, 3),
        "its time is not after the one before it",
    ),
    (
        replace(["oxts", "timestamps.txt"], made.stamps([100, 900, 300, 400])),
        (3, 3, 3),
        "number 1: its time is not after",
    ),
    (replace(["image_03", "timestamps.txt"], "yesterday\n" * 3), (3, 3, 4), "line 1: 'yesterday'"),
]


@pytest.mark.parametrize("change, remain, text", GAPS)
def test_kitti_as_published_has_gaps(run_command, tmp_path, change, remain, text):
    folder = made.kitti(tmp_path)
    change(folder)
    out = tmp_path / "out.bag"
    code, _, err = run_command("import_dataset.py", "kitti", folder, out)
    assert code == 0, err
    assert text in err and "warning" in err
    with rosbag.Bag(str(out)) as bag:
        counts = {topic: entry[1] for topic, entry in bag.get_type_and_topic_info()[1].items()}
    images = [n for topic, n in counts.items() if "camera_02/image" in topic]
    assert (counts["/velodyne_points"], images[0], counts["/tf"]) == remain


def test_gaps_outside_the_frames_asked_for_are_not_said(run_command, tmp_path):
    folder = made.kitti(tmp_path)
    os.remove(os.path.join(folder, "velodyne_points", "data", "0000000002.bin"))
    arguments = ("--first", 0, "--last", 1)
    code, _, err = run_command("import_dataset.py", "kitti", folder, tmp_path / "o.bag", *arguments)
    assert code == 0 and "left out" not in err, err


def test_rising_keeps_the_most(tmp_path):
    assert records.rising([]) == []
    assert records.rising([5, 6, 7]) == [0, 1, 2]
    assert records.rising([1, 9000, 2, 3]) == [0, 2, 3]
    assert records.rising([1, 1, 1]) in ([0], [1], [2])
    random = np.random.RandomState(2)
    for _ in range(50):
        stamps = random.randint(0, 12, 8).tolist()
        chosen = [stamps[i] for i in records.rising(stamps)]
        assert all(b > a for a, b in zip(chosen, chosen[1:]))
        best = max(
            sum(1 for _ in part)
            for size in range(9)
            for part in itertools.combinations(stamps, size)
            if all(b > a for a, b in zip(part, part[1:]))
        )
        assert len(chosen) == best


@pytest.mark.parametrize("dataset, change, text", BAD)
def test_one_line_errors_and_nothing_half_written(run_command, tmp_path, dataset, change, text):
    folder = getattr(made, dataset)(tmp_path)
    change(folder)
    out = tmp_path / "out"
    out.mkdir()
    code, _, err = run_command(SCRIPT, dataset, folder, out / "a.bag")
    assert code == 1, err
    assert err.count("\n") == 1 and "error: " in err and text in err, err
    assert os.listdir(str(out)) == []


def test_names_that_tell_no_ros_time(run_command, tmp_path):
    folder = made.rellis(tmp_path)
    images = os.path.join(folder, "pylon_camera_node")
    first = os.path.join(images, sorted(os.listdir(images))[0])
    os.rename(first, os.path.join(images, "frame000000-%s_000.jpg" % ("9" * 30)))
    code, _, err = run_command(SCRIPT, "rellis", folder, tmp_path / "a.bag")
    assert code == 1 and err.count("\n") == 1 and "outside 1970 to 2106" in err, err


def test_bad_line_of_a_text_scan(run_command, tmp_path):
    drive = made.kitti(tmp_path, unrectified=True)
    path = os.path.join(drive, "velodyne_points", "data", "0000000001.txt")
    for text, problem in (
        ("1 2 3 4\n1 2 3\n", "line 2: 3 numbers"),
        ("1 2 x 4\n", "line 1: could"),
    ):
        made.write(path, text)
        code, _, err = run_command(SCRIPT, "kitti", drive, tmp_path / "a.bag")
        assert code == 1 and err.count("\n") == 1 and problem in err, err


def test_bad_options(run_command, tmp_path):
    folder, bag = made.kitti(tmp_path), tmp_path / "a.bag"
    for arguments, text in (
        (["kitti", tmp_path / "none", bag], "none: no such folder"),
        (["kitti", folder, tmp_path / "no" / "a.bag"], "does not exist"),
        (["kitti", folder, bag, "--cameras", "front"], "must be image_00 to image_03"),
        (["kitti", folder, bag, "--first", "7"], "no scan among the chosen frames"),
        (["kitti", folder, bag, "--classes", tmp_path / "none.yaml"], "none.yaml: No such file"),
        (["kitti", folder, bag, "--rig-out", bag], "have the same name"),
        (["rellis", folder, bag], "pylon_camera_node: no such folder"),
    ):
        code, _, err = run_command(SCRIPT, *arguments)
        assert code == 1 and err.count("\n") == 1 and text in err, err
    assert not bag.exists()


def test_scores_without_labels(run_command, tmp_path):
    folder = made.rellis(tmp_path)
    shutil.rmtree(os.path.join(folder, "pylon_camera_node_label_id"))
    code, _, err = run_command(SCRIPT, "rellis", folder, tmp_path / "a.bag", "--scores", "onehot")
    assert code == 1 and "no human image labels" in err


def test_a_forward_time_outside_its_sweep_is_said(run_command, tmp_path):
    drive = made.kitti(tmp_path)
    made.write(
        os.path.join(drive, "velodyne_points", "timestamps.txt"), made.stamps([99, 240, 340])
    )
    got, _, err = import_one(run_command, tmp_path, "kitti", drive)
    assert "1 lines of timestamps.txt lie outside their sweep" in err
    assert abs(int(got.cloud("/velodyne_points")["t"][0]) - 50000000) < 5000


def test_images_too_far_are_said(run_command, tmp_path):
    drive = made.kitti(tmp_path)
    for camera in ("image_02", "image_03"):
        made.write(os.path.join(drive, camera, "timestamps.txt"), made.stamps([210, 242, 343]))
    _, _, err = import_one(run_command, tmp_path, "kitti", drive)
    assert "1 of 3 scans have no image within 50 ms of their middle" in err


def test_unknown_class_set_for_the_data():
    with pytest.raises(DataError, match="has no class of this data set"):
        labels = LabelSet.from_tree({"classes": [{"name": "x", "color": [0, 0, 0]}]}, "x")
        records.class_table({1: ["road"]}, labels)


class TestCompactKitti:
    @pytest.fixture
    def folder(self, optional_data):
        return optional_data("data/kitti_drive")

    def test_drive(self, run_command, tmp_path, folder):
        got, out, err = import_one(
            run_command, tmp_path, "kitti", folder, "--first", "2", "--last", "3"
        )
        assert not err and "2 scans" in out and "2 images" in out
        images = got.stamps("/camera_02/image/compressed")
        assert images == [records.EPOCH_NS + n * 10**8 for n in (2, 3)]
        # The image is taken at the middle of the sweep.
        assert got.stamps("/velodyne_points") == [ns - 5 * 10**7 for ns in images]
        cloud = got.cloud("/velodyne_points")
        assert len(cloud) > 110000
        assert cloud["ring"].min() == 0 and cloud["ring"].max() == 63
        assert 0 <= cloud["t"].min() < 10**6 and 99 * 10**6 < cloud["t"].max() <= 10**8
        # Rings rise with elevation where a laser's height does not matter (beyond 12 m).
        xyz = cloud_io.xyz(cloud)
        elevation = np.arctan2(xyz[:, 2], np.hypot(xyz[:, 0], xyz[:, 1]))
        far = np.linalg.norm(xyz, axis=1) > 12
        medians = [np.median(elevation[far & (cloud["ring"] == r)]) for r in range(30, 64)]
        assert (np.diff(medians) > 0).all()
        info = got.messages["/camera_02/camera_info"][0]
        assert (info.width, info.height) == (1242, 375)
        found, valid = got.tree.lookup("odom", "velodyne", images)
        assert valid.all()

    def test_pixels(self, run_command, tmp_path, folder):
        """Against the calibration's own formula P R_rect T_velo_to_cam."""
        got, _, _ = import_one(
            run_command, tmp_path, "kitti", folder, "--first", "2", "--last", "2"
        )
        with np.load(os.path.join(folder, "calib_and_kissicp_poses.npz")) as file:
            chain = file["P_rect_02"] @ file["R_rect_00"] @ file["T_velo_to_cam0"]
        xyz = cloud_io.xyz(got.cloud("/velodyne_points"))
        xyz = xyz[xyz[:, 0] > 3]
        wanted = np.hstack([xyz, np.ones((len(xyz), 1))]) @ chain.T
        p = got.in_camera("/camera_02/camera_info", "/velodyne_points", xyz)
        k = np.array(got.messages["/camera_02/camera_info"][0].K).reshape(3, 3)
        found = p @ k.T
        difference = found[:, :2] / found[:, 2:] - wanted[:, :2] / wanted[:, 2:]
        # The calibration's rotations are rounded to seven digits, tf's are exact ones.
        inside = np.abs(found[:, 0] / found[:, 2] - 621) < 700
        assert np.abs(difference[inside]).max() < 2e-3

    def test_the_sensor_turns_clockwise(self, run_command, tmp_path, folder):
        """A car follows and closes in. On one laser its front has a step, always at azimuth 180.5
        deg whatever the distance: the seam of the sweep. What is nearer is later: beyond it."""
        got, _, _ = import_one(run_command, tmp_path, "kitti", folder, "--last", "3")
        front = []
        for index in range(4):
            cloud = got.cloud("/velodyne_points", index)
            azimuth = np.mod(np.degrees(np.arctan2(cloud["y"], cloud["x"])), 360)
            laser = (cloud["ring"] == 45) & (cloud["x"] < -11) & (cloud["x"] > -17)
            left = laser & (azimuth > 179) & (azimuth < 180)
            right = laser & (azimuth > 181) & (azimuth < 182)
            assert left.sum() >= 4 and right.sum() >= 4
            front.append(np.median(cloud["x"][left]))
            step = np.median(cloud["x"][right]) - front[-1]
            assert 0.1 < step < 0.4
            assert cloud["t"][left].max() < 10**6 and cloud["t"][right].min() > 99 * 10**6
        # The car comes nearer by as much a sweep.
        assert 0.1 < (front[-1] - front[0]) / 3 < 0.4


class TestCompactRellis:
    def test_frame(self, run_command, tmp_path, optional_data):
        folder = optional_data("data/rellis3d_000104")
        got, out, err = import_one(run_command, tmp_path, "rellis", folder, "--scores", "onehot")
        assert not err and "1 score images" in out
        cloud, truth = got.cloud("/os1_cloud_node/points"), got.cloud("/points_truth")
        assert len(cloud) == len(truth) == 77708 and cloud["t"].max() == 99886336
        assert got.rig["motion"] == {"enabled": False}
        message = got.messages["/pylon/scores"][0]
        assert (message.width, message.height, message.encoding) == (240, 150, "32FC20")
        labels = LabelSet.from_tree(got.rig["classes"], "rig")
        drive = rellis.read(folder, labels, "none", 0, None)
        human = drive.label_values(drive.cameras[0].images[0].label_path)
        # Human labels at the points' pixels agree with the points' labels on 77.3 %, as known.
        k = np.array(got.messages["/pylon/camera_info"][0].K).reshape(3, 3)
        p = got.in_camera("/pylon/camera_info", "/os1_cloud_node/points", cloud_io.xyz(cloud))
        front = p[:, 2] > 0
        pixel = np.floor((p @ k.T)[:, :2] / np.where(front, p[:, 2], 1)[:, None] + 0.5).astype(int)
        inside = front & (pixel >= 0).all(axis=1) & (pixel < [1920, 1200]).all(axis=1)
        agreement = np.mean(human[pixel[inside, 1], pixel[inside, 0]] == truth["label"][inside])
        assert inside.sum() == 7429 and round(100 * agreement, 1) == 77.3


def test_a_row_adds_a_data_set(run_command, tmp_path, monkeypatch):
    """A data set that the package does not have: one point a scan, as far as its option says."""
    module = types.ModuleType("semantic_lidar_fusion.datasets.dummy")

    def read(folder, labels, first, last, distance):
        def load():
            xyz = np.array([[distance, 0, 0]], np.float32)
            return records.Scan(xyz, np.ones(1, np.float32), None, None, None)

        stamps = [records.EPOCH_NS + n * 10**8 for n in range(first, last + 1)]
        scans = [records.ScanRecord(stamp, load) for stamp in stamps]
        image = os.path.join(folder, "image.png")
        images = [records.ImageRecord(stamp, image) for stamp in stamps]
        k = np.diag([40.0, 40.0, 1.0])
        camera = records.CameraRecord(
            "front", "lens", "lidar", np.eye(4), k, "plumb_bob", (0.0,) * 5, False, images
        )
        about = ["Made up."]
        return records.Drive(
            "dummy",
            labels,
            [camera],
            "/points",
            "lidar",
            np.eye(4),
            scans,
            None,
            False,
            about,
            None,
        )

    made.write_image(str(tmp_path / "image.png"))
    module.read = read
    monkeypatch.setitem(sys.modules, module.__name__, module)
    options = (table.option("--distance", type=float, default=1.0, help="m"),)
    row = table.Dataset("dummy", "dummy:read", "config/classes_usyd12.yaml", "a", "b", options)
    monkeypatch.setattr(table, "DATASETS", table.DATASETS + [row])
    out = tmp_path / "out.bag"
    arguments = ["dummy", tmp_path, out, "--distance", "7", "--first", "2", "--last", "4"]
    code, said, err = run_command(SCRIPT, *arguments)
    assert code in (0, None), err
    assert "3 scans (3 points), 3 images" in said
    got = Imported(out, tmp_path / "out.yaml")
    assert got.cloud("/points")["x"].tolist() == [7.0]
    assert got.stamps("/points")[0] == records.EPOCH_NS + 2 * 10**8
    assert got.rig["classes"]["classes"][0]["name"] == "unlabeled"
