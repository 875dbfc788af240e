# SPDX-License-Identifier: MIT
"""fuse_bag on bags of exactly known truth (bag_factory), and on bags that are none."""
import hashlib
import json
import os
import resource
import shlex
import signal
import struct
import subprocess
import sys
import time

import numpy as np
import pytest

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
bag_factory = pytest.importorskip("bag_factory")
import onnx_factory  # noqa: E402
import rosbag  # noqa: E402
from nav_msgs.msg import Odometry  # noqa: E402

from semantic_lidar_fusion.bags.bag_io import BagReader  # noqa: E402
from semantic_lidar_fusion.errors import DataError  # noqa: E402
from bag_factory import CLASS_NAMES, START_NS, Camera, Drive, read_cloud  # noqa: E402


def program():
    """fuse_bag of this build."""
    candidates = [os.environ.get("SLF_BIN_DIR", ""), os.environ.get("SLF_BUILD_DIR", "")]
    for folder in candidates:
        path = os.path.join(folder, "fuse_bag")
        if folder and os.path.exists(path):
            return path
    pytest.fail("fuse_bag is not built; SLF_BIN_DIR names its folder")


def run(*arguments, **options):
    """Runs fuse_bag; returns the completed process with text output."""
    return subprocess.run(
        [program()] + [str(a) for a in arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        universal_newlines=True,
        timeout=120,
        **options,
    )


class Made:
    """A bag of a drive, with its rig file, and what fuse_bag makes of it."""

    def __init__(self, folder, drive, rig_extra=""):
        self.folder, self.drive = folder, drive
        self.bag, self.rig = folder / "in.bag", folder / "rig.yaml"
        bag_factory.write_bag(str(self.bag), drive)
        self.rig.write_text(bag_factory.rig_text(drive, rig_extra))

    def fuse(self, *options, name="out.bag", expect=0):
        result = run(self.bag, self.folder / name, "--rig", self.rig, *options)
        assert result.returncode == expect, result.stderr + result.stdout
        return Fused(self.folder / name, result) if expect == 0 else result


class Fused:
    """The messages of an output bag by topic."""

    def __init__(self, path, result):
        self.path, self.result = path, result
        self.messages = {}
        with rosbag.Bag(str(path)) as bag:
            for topic, message, time in bag.read_messages():
                self.messages.setdefault(topic, []).append((time.to_nsec(), message))
            self.types = {t: i.msg_type for t, i in bag.get_type_and_topic_info().topics.items()}

    def of(self, topic):
        return [message for _, message in self.messages[topic]]

    def clouds(self, topic="/points_semantic"):
        return [read_cloud(message) for message in self.of(topic)]


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """The default drive: three scans of PointCloud2, two cameras."""
    return Made(tmp_path_factory.mktemp("room"), Drive())


@pytest.fixture(scope="module")
def fused(room):
    return room.fuse()


def world_points(drive, cloud, t_ref_ns):
    """Points of a cloud that is rigid at t_ref, in the fixed frame."""
    T = drive.pose((t_ref_ns - START_NS) * 1e-9) @ drive.lidar_pose
    xyz = np.stack([cloud["x"], cloud["y"], cloud["z"]], axis=-1).astype(np.float64)
    return xyz @ T[:3, :3].T + T[:3, 3]


def pixels_in(drive, camera, world, time_ns):
    """Pixels (n, 2) of points in the fixed frame, and whether the image holds them."""
    T = np.linalg.inv(drive.pose((time_ns - START_NS) * 1e-9) @ camera.pose())
    uv, theta = camera.project(world @ T[:3, :3].T + T[:3, 3])
    inside = (uv > -0.5).all(axis=1) & (uv < [camera.width - 0.5, camera.height - 0.5]).all(axis=1)
    return uv, inside & (theta < np.pi)


def margin_to_border(camera, uv):
    """Distance in px of pixels (n, 2) to the border of the image, inside or outside."""
    u, v = uv[:, 0] + 0.5, uv[:, 1] + 0.5
    return np.min(np.abs([u, camera.width - u, v, camera.height - v]), axis=0)


def check_truth(drive, fused, surface_tolerance, least_fused):
    """Labels, statuses and geometry of the semantic clouds against the room."""
    total = right = 0
    for index, message in enumerate(fused.of("/points_semantic")):
        cloud, t_ref = read_cloud(message), message.header.stamp.to_nsec()
        world = world_points(drive, cloud, t_ref)
        assert drive.surface_gap(world).max() < surface_tolerance
        seen = np.zeros(len(cloud), bool)
        certain = np.ones(len(cloud), bool)
        on_edge = np.zeros(len(cloud), bool)
        for bit, camera in enumerate(drive.cameras):
            selection = fused.of("/%s/selection" % camera.name)[index].time_ref.to_nsec()
            assert selection > 0
            uv, inside = pixels_in(drive, camera, world, selection)
            seen |= inside
            certain &= margin_to_border(camera, uv) > 0.3
            labels = drive.label_image(camera, (selection - START_NS) * 1e-9)
            pixel = np.clip(np.floor(uv + 0.5), 0, [camera.width - 1, camera.height - 1])
            column, row = pixel.astype(int).T
            reach = 2 * camera.score_step
            for du in (-reach, 0, reach):
                for dv in (-reach, 0, reach):
                    r = np.clip(row + dv, 0, camera.height - 1)
                    c = np.clip(column + du, 0, camera.width - 1)
                    on_edge |= inside & (labels[r, c] != labels[row, column])
            contributed = (cloud["cameras"] >> bit & 1) == 1
            assert (inside | ~certain)[contributed].all(), camera.name
        in_status = np.isin(cloud["status"], (0, 1))
        assert np.array_equal(in_status[certain], seen[certain])
        assert (cloud["status"][certain & ~seen] == 2).all()
        ok = (cloud["status"] == 0) & ~on_edge & certain
        truth = drive.class_of(world)
        total += ok.sum()
        right += (cloud["label"][ok] == truth[ok]).sum()
        assert (cloud["status"] == 0).sum() > least_fused * seen.sum()
    assert total > 500
    assert right == total


def test_labels_statuses_and_motion_are_those_of_the_room(room, fused):
    # One point's range is cast exactly; f32 coordinates up to 40 m are good to 4e-6 m, and the
    # poses between readings 10 ms apart to 8 m/s * 0.5 rad/s * (10 ms)^2 / 8 = 0.05 mm.
    check_truth(room.drive, fused, 1e-3, 0.9)


def test_without_occlusion_every_seen_point_is_fused(room):
    fused = room.fuse("--set", "occlusion.mode=off", name="off.bag")
    check_truth(room.drive, fused, 1e-3, 0.999)
    for cloud in fused.clouds():
        assert not (cloud["status"] == 1).any()


def test_packets_give_the_same_truth(tmp_path):
    made = Made(tmp_path, Drive(lidar="packets", scans=2))
    # A range unit is 2 mm: half of it; the azimuth unit of 0.01 deg at 24 m makes 2 mm more along
    # the surface, which grazing incidence turns into a distance of at most that.
    check_truth(made.drive, made.fuse(), 6e-3, 0.9)


def test_large_coordinates_change_nothing(tmp_path):
    made = Made(tmp_path, Drive(scans=1, origin=(331275.0, 6250099.0)))
    check_truth(made.drive, made.fuse(), 1e-3, 0.9)


def test_compressed_images_and_bag_give_the_same_as_raw(tmp_path, fused):
    made = Made(tmp_path, Drive(image_transport="compressed", compression="lz4"))
    other = made.fuse()
    for ours, theirs in zip(other.of("/points_semantic"), fused.of("/points_semantic")):
        assert ours.data == theirs.data


def test_wrong_transport_is_told(room, tmp_path):
    result = run(
        room.bag,
        tmp_path / "out.bag",
        "--rig",
        room.rig,
        "--set",
        "cameras.front.transport=compressed",
    )
    assert result.returncode == 0
    assert "transport: raw" in result.stderr


def test_scans_without_a_point_are_the_reason(room, tmp_path):
    def change(topic, message):
        if topic == "/points":
            message.data = b"\0" * len(message.data)

    rewritten(room.bag, tmp_path / "in.bag", change)
    result = run(tmp_path / "in.bag", tmp_path / "out.bag", "--rig", room.rig, "--quiet")
    assert result.returncode == 1
    error = result.stderr.splitlines()[-1]
    assert "no point of its scans came out" in error and "points without a return" in error, error


WITHOUT_TRANSFORM = [
    # What of /tf_static is missing, frames that messages give another name, and what is said.
    (("velodyne", "front", "left"), {}, "no transform has a frame 'velodyne', of base_link, odom;"),
    (("velodyne",), {}, "from 'velodyne' to 'base_link': no transform has a frame 'velodyne'"),
    (("front", "left"), {}, "from 'velodyne' to 'left': no transform has a frame 'left'"),
    ((), {"/points": "velodyn"}, "a frame 'velodyn'; did you mean 'velodyne'?"),
    (
        (),
        {"/front/camera_info": "optical", "/left/camera_info": ""},
        "'optical', of base_link, front",
    ),
    ((), {"/front/camera_info": "", "/left/camera_info": ""}, "header.frame_id of its messages is"),
    ((), {"parent": "body"}, "one hangs below 'odom', the other below 'body'"),
]


@pytest.mark.parametrize("missing, names, text", WITHOUT_TRANSFORM)
def test_a_missing_transform_is_the_reason(room, tmp_path, missing, names, text):
    def change(topic, message):
        if topic in names:
            message.header.frame_id = names[topic]
        if topic == "/tf_static":
            message.transforms = [t for t in message.transforms if t.child_frame_id not in missing]
            for transform in message.transforms:
                if transform.child_frame_id != "velodyne":
                    transform.header.frame_id = names.get("parent", transform.header.frame_id)

    rewritten(room.bag, tmp_path / "in.bag", change)
    result = run(tmp_path / "in.bag", tmp_path / "out.bag", "--rig", room.rig, "--quiet")
    assert result.returncode == 1
    error = result.stderr.splitlines()[-1]
    assert "error: " in error and text in error and "publish it" in error, error
    assert "odometry does not cover" not in result.stderr


@pytest.mark.parametrize("transport", ["raw", "compressed"])
def test_images_of_another_size_than_camera_info_are_told(tmp_path, transport):
    made = Made(tmp_path, Drive(scans=1, image_transport=transport))
    size = made.drive.cameras[1].width, made.drive.cameras[1].height

    def change(topic, message):
        if topic == "/left/camera_info":
            message.width *= 2

    rewritten(made.bag, tmp_path / "wide.bag", change)
    result = run(tmp_path / "wide.bag", tmp_path / "out.bag", "--rig", made.rig)
    assert result.returncode == 0, result.stderr
    sizes = size + (2 * size[0], size[1])
    assert "is %dx%d; camera_info says %dx%d" % sizes in result.stderr
    cloud = Fused(tmp_path / "out.bag", result).clouds()[0]
    assert set(cloud["cameras"][cloud["status"] == 0]) == {1}


def test_odometry_topic_gives_the_same_as_tf(tmp_path, fused):
    made = Made(tmp_path, Drive(odometry="topic"))
    for ours, theirs in zip(made.fuse().clouds(), fused.clouds()):
        for axis in "xyz":
            assert np.abs(ours[axis] - theirs[axis]).max() < 1e-5


@pytest.mark.parametrize("semantics", ["labels", "probabilities"])
def test_other_inputs(tmp_path, semantics):
    made = Made(tmp_path, Drive(scans=1, semantics=semantics))
    check_truth(made.drive, made.fuse(), 1e-3, 0.9)


def test_topics_types_and_stamps(room, fused):
    expected = {
        "/class_info": "std_msgs/String",
        "/configuration": "std_msgs/String",
        "/scan_reference": "sensor_msgs/TimeReference",
        "/front/selection": "sensor_msgs/TimeReference",
        "/left/selection": "sensor_msgs/TimeReference",
        "/points_compensated": "sensor_msgs/PointCloud2",
        "/points_semantic": "sensor_msgs/PointCloud2",
        "/tf": "tf2_msgs/TFMessage",
        "/tf_static": "tf2_msgs/TFMessage",
    }
    assert fused.types == expected
    for topic, messages in fused.messages.items():
        if topic not in ("/class_info", "/configuration", "/tf", "/tf_static"):
            assert [t for t, _ in messages] == [m.header.stamp.to_nsec() for _, m in messages]
            assert len(messages) == room.drive.scans
    for index, reference in enumerate(fused.of("/scan_reference")):
        first = room.drive.scan_start_ns(index)
        assert reference.header.stamp.to_nsec() == first
        columns = room.drive.points_per_scan // 16
        last = first + (columns - 1) * (100_000_000 // columns)
        middle = first + (last - first) // 2
        stamps = room.drive.image_stamps_ns(room.drive.cameras[0])
        t_ref = min(stamps, key=lambda s: (abs(s - middle), s))
        assert reference.time_ref.to_nsec() == t_ref
        for camera in room.drive.cameras:
            stamps = room.drive.image_stamps_ns(camera)
            closest = min(stamps, key=lambda s: (abs(s - t_ref), s))
            chosen = fused.of("/%s/selection" % camera.name)[index]
            assert chosen.header.stamp.to_nsec() == first
            assert chosen.time_ref.to_nsec() == closest
        for topic in ("/points_compensated", "/points_semantic"):
            cloud = fused.of(topic)[index]
            assert cloud.header.stamp.to_nsec() == t_ref
            assert cloud.header.frame_id == "velodyne"
            assert (cloud.height, cloud.is_dense) == (1, True)
    classes = json.loads(fused.of("/class_info")[0].data)["classes"]
    assert [c["name"] for c in classes] == list(CLASS_NAMES)


def test_fields_of_points_without_a_class(fused):
    for cloud in fused.clouds():
        none = cloud["status"] != 0
        assert none.any() and (~none).any()
        assert (cloud["label"][none] == 255).all()
        assert (cloud["confidence"][none] == 0).all()
        assert (cloud["entropy"][none] == 1).all()
        assert (cloud["cameras"][none] == 0).all()
        p = np.stack([cloud["p_" + name] for name in CLASS_NAMES], axis=-1)
        assert (p[none] == 0).all()
        assert np.abs(p[~none].sum(axis=1) - 1).max() < 1e-5
        assert np.array_equal(p[~none].argmax(axis=1), cloud["label"][~none])
        assert np.array_equal(p[~none].max(axis=1), cloud["confidence"][~none])
        assert np.isfinite(cloud["entropy"]).all()


def test_semantic_cloud_holds_the_compensated_points(fused):
    for semantic, rigid in zip(fused.clouds(), fused.clouds("/points_compensated")):
        for field in ("x", "y", "z", "intensity", "ring", "dt"):
            assert np.array_equal(semantic[field], rigid[field])
        assert (rigid["status"] == 0).all()


def test_same_bag_twice_gives_the_same_bytes(room, fused):
    again = room.fuse(name="again.bag")
    assert digest(again.path) == digest(fused.path)


def test_all_outputs_are_deterministic_and_complete(room):
    first = room.fuse("--all", name="all1.bag")
    second = room.fuse("--all", name="all2.bag")
    assert digest(first.path) == digest(second.path)
    for camera in room.drive.cameras:
        chosen = {m.time_ref.to_nsec() for m in first.of("/%s/selection" % camera.name)}
        sizes = {
            "superpixels": ("32SC1", camera.score_step),
            "share": ("32FC1", camera.score_step),
            "probabilities": ("32FC4", camera.score_step),
            "projection_overlay": ("bgr8", None),
            "uncertainty_overlay": ("bgr8", None),
        }
        for name, (encoding, step) in sizes.items():
            messages = first.of("/%s/%s" % (camera.name, name))
            assert {m.header.stamp.to_nsec() for m in messages} == chosen, name
            for m in messages:
                assert m.encoding == encoding
                assert m.header.frame_id == camera.name
                if step:
                    assert (m.width, m.height) == (camera.width // step, camera.height // step)
        for m in first.of("/%s/superpixels" % camera.name):
            ids = np.frombuffer(m.data, np.int32)
            assert np.array_equal(np.unique(ids), np.arange(ids.max() + 1))
        for m in first.of("/%s/share" % camera.name):
            share = np.frombuffer(m.data, np.float32)
            assert share.min() > 0 and share.max() == 1


ERRORS = (
    "errors.stamps_s={lidar: 0.001, camera: 0.002}",
    "errors.lidar={range_m: 0.02, beam_deg: [0.2, 0.1]}",
    "errors.motion.velocity_mps=[0.1, 0.1, 0.1]",
    "cameras.front.errors={extrinsics: {deg: [0.5, 0.5, 0.5], m: [0.02, 0.02, 0.02]}}",
)


def test_errors_give_every_pixel_a_covariance_and_spread_its_distribution(room, fused):
    settings = [part for entry in ERRORS for part in ("--set", entry)]
    expected = room.fuse("--all", *settings, name="errors.bag")
    for camera in room.drive.cameras:
        stamps = [m.header.stamp for m in expected.of("/points_semantic")]
        messages = expected.of("/%s/points_pixel" % camera.name)
        assert [m.header.stamp for m in messages] == stamps
    drive, camera = room.drive, room.drive.cameras[0]
    pixels = expected.clouds("/front/points_pixel")[0]
    selection = expected.of("/front/selection")[0].time_ref.to_nsec()
    stamp = expected.of("/front/points_pixel")[0].header.stamp.to_nsec()
    uv, _ = pixels_in(drive, camera, world_points(drive, pixels, stamp), selection)
    assert np.abs(uv - np.stack([pixels["u"], pixels["v"]], axis=1)).max() < 0.1
    # The camera's own turning alone moves a pixel by its focal length times 0.5 deg.
    least = np.sqrt(pixels["cov_uu"] * pixels["cov_vv"] - pixels["cov_uv"] ** 2)
    assert (least > 0).all() and np.isfinite(least).all()
    cell = camera.score_step**2 / 12.0
    told = room.fuse("--all", name="exact.bag").clouds("/front/points_pixel")[0]
    assert told["cov_uu"] == pytest.approx(cell, rel=1e-6)
    assert (told["cov_uv"] == 0).all()
    assert np.median(pixels["cov_uu"]) > 2 * cell
    assert np.array_equal(told["u"], pixels["u"]) and np.array_equal(
        told["status"], pixels["status"]
    )

    # Distributions spread, and with `pixel` the errors change no byte of a cloud.
    ours, theirs = expected.clouds()[0], fused.clouds()[0]
    assert np.array_equal(ours["status"], theirs["status"])
    assert ours["entropy"].mean() > 1.02 * theirs["entropy"].mean()
    pixel = room.fuse(*settings, "--set", "transfer=pixel", name="pixel.bag")
    for ours, theirs in zip(pixel.of("/points_semantic"), fused.of("/points_semantic")):
        assert ours.data == theirs.data


def test_dense_probabilities_equal_those_of_the_points(room):
    fused = room.fuse("--all", "--set", "overlap=most_central", name="dense.bag")
    drive, camera = room.drive, room.drive.cameras[0]
    selection = fused.of("/front/selection")[0].time_ref.to_nsec()
    message = [
        m for m in fused.of("/front/probabilities") if m.header.stamp.to_nsec() == selection
    ][0]
    dense = np.frombuffer(message.data, np.float32).reshape(message.height, message.width, -1)
    cloud = fused.clouds()[0]
    only = cloud["cameras"] == 1
    world = world_points(drive, cloud, fused.of("/points_semantic")[0].header.stamp.to_nsec())
    uv, _ = pixels_in(drive, camera, world, selection)
    pixel = np.floor(uv + 0.5)
    sure = only & (np.abs(uv + 0.5 - pixel - 0.5) < 0.45).all(axis=1)
    assert sure.sum() > 100
    column, row = (pixel[sure] / camera.score_step).astype(int).T
    ours = np.stack([cloud["p_" + name][sure] for name in CLASS_NAMES], axis=-1)
    # Both round the same double to float.
    assert np.abs(ours - dense[row, column]).max() < 1e-6


def test_clamped_superpixel_count_and_time_field_are_said_once(room, fused):
    # 120 x 90 score cells / 64 = 168, of 200 wanted
    assert fused.result.stderr.count("superpixels.count = 200") == 1
    assert "168" in fused.result.stderr
    assert fused.result.stdout.count("field 't' (uint32) in ns after the header stamp") == 1
    enough = room.fuse("--set", "superpixels.count=168", name="enough.bag")
    assert "superpixels.count" not in enough.result.stderr


def test_set_overrides_the_rig_file(room):
    kept = room.fuse("--set", "keep_unlabelled=false", name="kept.bag")
    for cloud in kept.clouds():
        assert (cloud["status"] == 0).all()
    assert "keep_unlabelled" in kept.result.stdout


def test_rig_without_cameras(tmp_path):
    made = Made(tmp_path, Drive(cameras=[], scans=2))
    fused = made.fuse()
    assert set(fused.types) == {
        "/class_info",
        "/configuration",
        "/scan_reference",
        "/points_compensated",
        "/points_semantic",
        "/tf",
        "/tf_static",
    }
    for cloud in fused.clouds():
        assert len(cloud) == made.drive.points_per_scan
        assert (cloud["status"] == 2).all()
    for index, reference in enumerate(fused.of("/scan_reference")):
        assert abs(reference.time_ref.to_nsec() - made.drive.scan_start_ns(index) - 5e7) < 1e6


def test_missing_camera_affects_only_itself(tmp_path, fused):
    made = Made(tmp_path, Drive(images_for=["front"]))
    other = made.fuse()
    assert all(m.time_ref.to_nsec() == 0 for m in other.of("/left/selection"))
    statuses = set()
    left = made.drive.cameras[1]
    for message, cloud, whole in zip(other.of("/points_semantic"), other.clouds(), fused.clouds()):
        alone = whole["cameras"] == 1
        assert np.array_equal(cloud["label"][alone], whole["label"][alone])
        # Status 3 is judged with the camera where it was at t_ref.
        t_ref = message.header.stamp.to_nsec()
        uv, inside = pixels_in(made.drive, left, world_points(made.drive, cloud, t_ref), t_ref)
        certain = (margin_to_border(left, uv) > 0.3) & ~np.isin(cloud["status"], (0, 1))
        assert np.array_equal((cloud["status"] == 3)[certain], inside[certain])
        statuses |= set(cloud["status"])
    assert statuses >= {0, 2, 3}
    assert "/left/image" in other.result.stderr


def test_camera_without_camera_info_sees_nothing(tmp_path):
    made = Made(tmp_path, Drive(scans=1, camera_info_for=["front"]))
    fused = made.fuse()
    cloud = fused.clouds()[0]
    assert set(cloud["cameras"]) == {0, 1}
    assert set(cloud["status"]) <= {0, 1, 2}
    assert "/left/camera_info" in fused.result.stderr
    assert "/front/camera_info" in fused.result.stderr  # the candidate


def camchain(drive):
    """The drive's cameras as Kalibr writes them; the second 0.5 m from where tf has it."""
    text = ""
    for i, camera in enumerate(drive.cameras):
        centre = ((camera.width - 1) / 2.0, (camera.height - 1) / 2.0)
        text += "cam%d:\n  camera_model: pinhole\n  distortion_model: equidistant\n" % i
        text += "  intrinsics: [%r, %r, %r, %r]\n" % ((camera.focal,) * 2 + centre)
        text += "  distortion_coeffs: [0.0, 0.0, 0.0, 0.0]\n"
        text += "  resolution: [%d, %d]\n" % (camera.width, camera.height)
        if i > 0:
            T = np.linalg.inv(camera.pose()) @ drive.cameras[i - 1].pose()
            T[0, 3] += 0.5
            rows = ", ".join(str(row.tolist()) for row in T)
            text += "  T_cn_cnm1: [%s]\n" % rows
    return text


def test_lens_file_serves_like_camera_info_and_without_it(tmp_path, fused):
    made = Made(tmp_path, Drive(camera_info_for=[]))
    (tmp_path / "camchain.yaml").write_text(camchain(made.drive))
    lens = "cameras.%s.lens={file: " + str(tmp_path / "camchain.yaml") + ", camera: %s, frame: %s}"
    sets = [lens % (c.name, "cam%d" % i, c.name) for i, c in enumerate(made.drive.cameras)]
    by_file = made.fuse("--set", sets[0], "--set", sets[1])
    for ours, theirs in zip(by_file.of("/points_semantic"), fused.of("/points_semantic")):
        assert ours.data == theirs.data
    # What the file and tf say of the cameras' places differs by 0.5 m: said once.
    text = by_file.result.stderr
    assert text.count("camera left: ") == 1 and "0.5 m apart" in text, text
    assert "camera_info" not in text, text


def test_zeros_behind_the_coefficients_are_said_once(tmp_path, fused, monkeypatch):
    original = bag_factory.camera_info_message

    def longer(camera, time_ns):
        message = original(camera, time_ns)
        message.D = [0.0] * 5
        return message

    monkeypatch.setattr(bag_factory, "camera_info_message", longer)
    five = Made(tmp_path, Drive()).fuse()
    for ours, theirs in zip(five.of("/points_semantic"), fused.of("/points_semantic")):
        assert ours.data == theirs.data
    assert five.result.stderr.count("D holds 5 coefficients") == len(Drive().cameras)


def test_odometry_that_ends_early_marks_firings(tmp_path):
    # The last scan starts at 0.3 s and lasts to 0.4 s; its t_ref is at 0.35 s.
    made = Made(tmp_path, Drive(odometry_until_s=0.3601))
    fused = made.fuse()
    for index, cloud in enumerate(fused.clouds()):
        rigid = fused.clouds("/points_compensated")[index]
        if index < 2:
            assert (rigid["status"] == 0).all()
            continue
        t_ref = fused.of("/points_compensated")[index].header.stamp.to_nsec()
        late = rigid["dt"] + (t_ref - START_NS) * 1e-9 > 0.36 + 1e-6
        assert np.array_equal(rigid["status"] == 4, late)
        assert np.array_equal(cloud["status"] == 4, late)
        assert late.any() and not late.all()
    assert "odom" in fused.result.stderr


def test_without_odometry_all_points_are_marked(tmp_path):
    made = Made(tmp_path, Drive(scans=1, odometry="none"))
    result = made.fuse(expect=1)  # done, but nothing to show for it
    assert "no point got a class: 100.0 % of" in result.stderr and "no odometry" in result.stderr
    fused = Fused(tmp_path / "out.bag", result)
    assert (fused.clouds()[0]["status"] == 4).all()
    points, _, _ = made.drive.scan_points(0)
    rigid = fused.clouds("/points_compensated")[0]
    assert np.array_equal(rigid["x"], points[:, 0].astype(np.float32))


def test_motion_disabled_needs_no_odometry(tmp_path):
    made = Made(tmp_path, Drive(scans=1, odometry="none", speed=0.0, yaw_rate=0.0))
    fused = made.fuse("--set", "motion.enabled=false")
    check_truth(made.drive, fused, 1e-3, 0.9)


def test_odometry_that_misses_an_image_gives_no_image_in_time(tmp_path):
    # The left camera's image 40 ms after t_ref is not covered.
    cameras = [
        Camera("front", 0.0, (1.5, 0.1, 0.2), period_ns=100_000_000, phase_ns=50_000_000),
        Camera("left", np.pi / 2, (0.8, 0.6, 0.1), period_ns=100_000_000, phase_ns=90_000_000),
    ]
    made = Made(tmp_path, Drive(scans=1, cameras=cameras, odometry_until_s=0.1701))
    fused = made.fuse()
    assert fused.of("/left/selection")[0].time_ref.to_nsec() == START_NS + 190_000_000
    cloud = fused.clouds()[0]
    assert set(cloud["cameras"]) == {0, 1}
    assert 3 in set(cloud["status"])


def test_empty_scan_gives_empty_clouds_with_its_header(tmp_path):
    made = Made(tmp_path, Drive(empty_scans=(1,)))
    fused = made.fuse()
    for topic in ("/points_compensated", "/points_semantic"):
        messages = fused.of(topic)
        assert [m.width > 0 for m in messages] == [True, False, True]
        assert messages[1].header.stamp.to_nsec() == made.drive.scan_start_ns(1)
        assert messages[1].header.frame_id == "velodyne"
        assert [f.name for f in messages[1].fields] == [f.name for f in messages[0].fields]


def test_one_image_can_serve_two_scans(tmp_path):
    cameras = [
        Camera("front", 0.0, (1.5, 0.1, 0.2)),
        Camera("left", np.pi / 2, (0.8, 0.6, 0.1), period_ns=200_000_000),
    ]
    made = Made(tmp_path, Drive(scans=2, cameras=cameras))
    fused = made.fuse("--all", "--set", "cameras.left.max_time_difference=0.06")
    chosen = [m.time_ref.to_nsec() for m in fused.of("/left/selection")]
    assert len(set(chosen)) == 1
    assert len(fused.of("/left/share")) == 1
    check_truth(made.drive, fused, 1e-3, 0.9)


def test_camera_with_a_clock_of_its_own(tmp_path, fused):
    cameras = bag_factory.default_cameras()
    cameras[1].clock_ahead_ns = 30_000_000
    other = Made(tmp_path, Drive(cameras=cameras)).fuse()
    for ours, theirs in zip(other.of("/points_semantic"), fused.of("/points_semantic")):
        assert ours.data == theirs.data
    for ours, theirs in zip(other.of("/left/selection"), fused.of("/left/selection")):
        assert ours.time_ref.to_nsec() == theirs.time_ref.to_nsec() + 30_000_000


def test_reference_camera_with_a_clock_of_its_own(tmp_path, fused):
    cameras = bag_factory.default_cameras()
    cameras[0].clock_ahead_ns = -40_000_000
    other = Made(tmp_path, Drive(cameras=cameras)).fuse()
    for ours, theirs in zip(other.of("/points_semantic"), fused.of("/points_semantic")):
        assert ours.header.stamp == theirs.header.stamp  # true time
        assert ours.data == theirs.data


def test_closest_to_sweep_takes_the_image_of_the_beams(tmp_path):
    cameras = bag_factory.default_cameras()
    cameras[1].period_ns = 20_000_000
    made = Made(tmp_path, Drive(scans=2, cameras=cameras), "image_choice: closest_to_sweep\n")
    fused = made.fuse()
    differs = False
    for index in range(made.drive.scans):
        points, _, after_ns = made.drive.scan_points(index)
        t_ref = fused.of("/scan_reference")[index].time_ref.to_nsec()
        for camera in made.drive.cameras:
            T = np.linalg.inv(camera.pose()) @ made.drive.lidar_pose
            uv, _ = camera.project(points @ T[:3, :3].T + T[:3, 3])
            inside = (uv > -0.5).all(axis=1)
            inside &= (uv < [camera.width - 0.5, camera.height - 0.5]).all(axis=1)
            target = made.drive.scan_start_ns(index) + int(after_ns[inside].mean())
            stamps = made.drive.image_stamps_ns(camera)
            chosen = fused.of("/%s/selection" % camera.name)[index].time_ref.to_nsec()
            assert chosen == min(stamps, key=lambda s: (abs(s - target), s))
            differs |= chosen != min(stamps, key=lambda s: (abs(s - t_ref), s))
    assert differs
    check_truth(made.drive, fused, 1e-3, 0.9)


def test_ego_mask_never_transfers(room, tmp_path):
    import cv2

    camera = room.drive.cameras[0]
    mask = np.full((camera.height, camera.width), 255, np.uint8)
    mask[:, : camera.width // 2] = 0
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    fused = room.fuse("--set", "cameras.front.mask=%s" % (tmp_path / "mask.png"), name="ego.bag")
    for message in fused.of("/points_semantic"):
        cloud = read_cloud(message)
        t_ref = message.header.stamp.to_nsec()  # the stamp of the front image
        uv, inside = pixels_in(room.drive, camera, world_points(room.drive, cloud, t_ref), t_ref)
        masked = inside & (uv[:, 0] < camera.width / 2 - 1)
        free = inside & (uv[:, 0] > camera.width / 2)
        assert (cloud["cameras"][masked] & 1 == 0).all()
        assert (cloud["cameras"][free] & 1 == 1).mean() > 0.9
        assert (cloud["status"][masked & (cloud["cameras"] == 0)] != 0).all()
    result = room.fuse("--set", "cameras.front.mask=%s" % (tmp_path / "no.png"), expect=1)
    assert "no.png" in result.stderr


def shared(relative):
    """A file of the optional data; the test is skipped without it."""
    folder = os.environ.get("SLF_SHARED_DIR")
    if not folder:
        here = os.path.dirname(os.path.abspath(__file__))
        folder = os.path.join(here, "..", "..", "..", "shared")
    path = os.path.join(folder, relative)
    if not os.path.exists(path):
        pytest.skip("optional data not found: " + relative)
    return path


def test_own_network_where_the_bag_has_no_scores(tmp_path):
    source = os.path.join(os.path.dirname(os.path.abspath(__file__)), "..", "..", "config")
    network = shared("models/enet_camvid12_480x360.onnx")
    with open(os.path.join(source, "models", "enet_camvid12.yaml")) as file:
        text = file.read().replace("file: enet_camvid12_480x360.onnx", "file: " + network)
    assert network in text
    (tmp_path / "enet.yaml").write_text(text)
    made = Made(tmp_path, Drive(scans=2, semantics="none"))
    rig = made.rig.read_text()
    classes = os.path.abspath(os.path.join(source, "classes_camvid12.yaml"))
    begin, end = rig.index("classes:"), rig.index("cameras:")
    made.rig.write_text(
        rig[:begin]
        + "classes: {file: %s}\n" % classes
        + rig[end:]
        + "segmentation: {model: enet.yaml}\n"
    )
    fused = made.fuse("--all")
    again = made.fuse("--all", name="again.bag")
    assert digest(fused.path) == digest(again.path)
    for camera in made.drive.cameras:
        chosen = [m.time_ref.to_nsec() for m in fused.of("/%s/selection" % camera.name)]
        scores = fused.of("/%s/scores" % camera.name)
        assert [m.header.stamp.to_nsec() for m in scores] == sorted(set(chosen))
        assert {m.encoding for m in scores} == {"32FC12"}
        assert {(m.width, m.height) for m in fused.of("/%s/share" % camera.name)} == {
            (m.width, m.height) for m in scores
        }
    for cloud in fused.clouds():
        assert (cloud["status"] == 0).any()


def test_real_packets_against_another_decoder(tmp_path):
    from scipy.spatial import cKDTree

    capture = np.load(shared("data/vlp16_packets/nebula_vlp16_scans.npz"))
    expected_path = shared("data/vlp16_packets/nebula_vlp16_expected_1673400472138016708.pcd")
    types = bag_factory.velodyne_types()
    with rosbag.Bag(str(tmp_path / "in.bag"), "w") as bag:
        for index, scan_stamp in enumerate(capture["scan_stamp"]):
            scan = types["velodyne_msgs/VelodyneScan"]()
            scan.header.frame_id = "velodyne"
            scan.header.stamp = bag_factory.stamp(int(scan_stamp * 1e9))
            for number in np.flatnonzero(capture["scan"] == index):
                packet = types["velodyne_msgs/VelodynePacket"]()
                packet.stamp = bag_factory.stamp(int(capture["packet_stamp"][number] * 1e9))
                packet.data = capture["packets"][number].tobytes()
                scan.packets.append(packet)
            bag.write("/velodyne_packets", scan, scan.header.stamp)
    (tmp_path / "rig.yaml").write_text("lidar: {input: packets}\nmotion: {enabled: false}\n")
    result = run(tmp_path / "in.bag", tmp_path / "out.bag", "--rig", tmp_path / "rig.yaml")
    assert result.returncode == 0, result.stderr
    clouds = Fused(tmp_path / "out.bag", result).clouds("/points_compensated")
    assert len(clouds) == len(capture["scan_stamp"])
    with open(expected_path, "rb") as file:
        data = file.read()
    at = data.index(b"DATA binary\n") + len(b"DATA binary\n")
    kinds = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rest", "V20")]
    size = int(data[data.index(b"POINTS ") :].split()[1])
    expected = np.frombuffer(data, np.dtype(kinds), size, at)
    expected = np.stack([expected[axis] for axis in "xyz"], axis=-1)
    medians = []
    for cloud in clouds:
        ours = np.stack([cloud[axis] for axis in "xyz"], axis=-1)
        medians.append(np.median(cKDTree(ours).query(expected)[0]))
    # One of the scans is the other decoder's: coordinates agree to the range unit of 2 mm.
    assert min(medians) < 2e-3, medians


# -- what can go wrong


def digest(path):
    return hashlib.sha256(path.read_bytes()).hexdigest()


def assert_fails(result, *words, code=1):
    """One line on stderr with all of `words`, and the exit code."""
    assert result.returncode == code, result.stderr + result.stdout
    errors = [line for line in result.stderr.splitlines() if "error:" in line]
    assert len(errors) == 1, result.stderr
    for word in words:
        assert word in errors[0]


def leftovers(folder):
    return [name for name in os.listdir(str(folder)) if name.startswith("out.bag")]


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["in.bag"],
        ["in.bag", "out.bag"],
        ["in.bag", "out.bag", "--rig"],
        ["in.bag", "out.bag", "--rig", "r.yaml", "--nonsense"],
        ["in.bag", "out.bag", "--rig", "r.yaml", "--all=yes"],
        ["in.bag", "out.bag", "--rig", "r.yaml", "--set", "novalue"],
        ["in.bag", "out.bag", "--rig", "r.yaml", "-x"],
    ],
)
def test_wrong_command_line(arguments):
    result = run(*arguments)
    assert result.returncode == 2
    assert "--help" in result.stderr


def test_help():
    result = run("--help")
    assert result.returncode == 0
    for word in ("--rig", "--set", "--all", "--force", "points_semantic"):
        assert word in result.stdout


@pytest.mark.parametrize(
    "content", [b"", b"\0" * 5000, b"#ROSBAG V2.0\n", b"not a bag at all" * 10], ids=repr
)
def test_files_that_are_no_bags(room, tmp_path, content):
    (tmp_path / "bad.bag").write_bytes(content)
    result = run(tmp_path / "bad.bag", tmp_path / "out.bag", "--rig", room.rig)
    assert_fails(result, "bad.bag")
    assert not leftovers(tmp_path)


def test_absent_files(room, tmp_path):
    result = run(tmp_path / "no.bag", tmp_path / "out.bag", "--rig", room.rig)
    assert_fails(result, "no.bag", "No such file")
    result = run(room.bag, tmp_path / "out.bag", "--rig", tmp_path / "no.yaml")
    assert_fails(result, "no.yaml")
    result = run(room.bag, tmp_path / "no" / "out.bag", "--rig", room.rig)
    assert_fails(result, "out.bag")
    result = run(tmp_path, tmp_path / "out.bag", "--rig", room.rig)
    assert_fails(result, "directory")


@pytest.mark.parametrize("part", [0.02, 0.5, 0.9, 0.999])
def test_truncated_bag(room, tmp_path, part):
    whole = room.bag.read_bytes()
    (tmp_path / "short.bag").write_bytes(whole[: int(len(whole) * part)])
    result = run(tmp_path / "short.bag", tmp_path / "out.bag", "--rig", room.rig)
    assert_fails(result, "short.bag")
    assert not leftovers(tmp_path)


def test_damaged_bag_ends_with_an_error_or_a_whole_output(room, tmp_path):
    random = np.random.RandomState(4)
    whole = bytearray(room.bag.read_bytes())
    for trial in range(6):
        data = bytearray(whole)
        for _ in range(40):
            data[random.randint(13, len(data))] = random.randint(256)
        (tmp_path / "bad.bag").write_bytes(bytes(data))
        out = tmp_path / ("out%d.bag" % trial)
        result = run(tmp_path / "bad.bag", out, "--rig", room.rig)
        assert result.returncode in (0, 1), result.stderr
        if result.returncode == 0:
            rosbag.Bag(str(out)).close()
        else:
            assert not out.exists()


def test_an_index_or_a_record_that_leads_beyond_its_chunk_costs_one_message(room, tmp_path):
    data = bytearray(room.bag.read_bytes())
    huge = (2**30).to_bytes(4, "little")
    with rosbag.Bag(str(room.bag)) as bag:
        topics = {c.topic: c.id for c in bag._get_connections()}

        def place(topic, number):
            """Bytes of an index entry, and where its record begins in the file."""
            entry = sorted(bag._connection_indexes[topics[topic]])[number]
            index = struct.pack("<III", entry.time.secs, entry.time.nsecs, entry.offset)
            return index, bag._chunk_headers[entry.chunk_pos].data_pos + entry.offset

        index, _ = place("/tf", 3)
        at = data.index(index)
        data[at + 8 : at + 12] = huge
        _, scan = place("/points", 1)
        data[scan : scan + 4] = huge  # length of the record's header
        _, info = place("/left/camera_info", 0)
        data[info + 4 : info + 8] = huge  # length of its first field
        _, scores = place("/front/scores", 2)
        header = int.from_bytes(data[scores : scores + 4], "little")
        data[scores + 4 + header : scores + 8 + header] = huge  # length of the message
    (tmp_path / "bad.bag").write_bytes(bytes(data))
    result = run(tmp_path / "bad.bag", tmp_path / "out.bag", "--rig", room.rig)
    assert result.returncode == 0, result.stderr
    assert "2 scans of 3" in result.stdout
    for counted in ("/tf", "/left/camera_info", "/front/scores"):
        assert "counted: %s: unusable message: 1" % counted in result.stdout
    assert "counted: scans: unusable: 1" in result.stdout


def test_a_bag_of_ros_2_is_told_with_the_cure(room, tmp_path):
    (tmp_path / "a.db3").write_bytes(b"SQLite format 3\0" + bytes(100))
    (tmp_path / "a.mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(100))
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "metadata.yaml").write_text("rosbag2_bagfile_information: {}\n")
    for name in ("a.db3", "a.mcap", "a"):
        result = run(tmp_path / name, tmp_path / "out.bag", "--rig", room.rig)
        assert_fails(
            result, name + ": is a bag of ROS 2; import_dataset.py ros2 makes one of ROS 1"
        )
        with pytest.raises(DataError, match="is a bag of ROS 2; import_dataset.py ros2"):
            BagReader(str(tmp_path / name))


def test_odometry_elsewhere_and_misspelt_frames_are_told_with_the_cure(room, tmp_path):
    with rosbag.Bag(str(room.bag)) as bag, rosbag.Bag(str(tmp_path / "in.bag"), "w") as out:
        for topic, message, time in bag.read_messages():
            if topic == "/tf":
                transform = message.transforms[0]
                topic, message = "/odom", Odometry(header=transform.header)
                message.child_frame_id = transform.child_frame_id
                message.pose.pose.position.x = transform.transform.translation.x
                message.pose.pose.orientation = transform.transform.rotation
            out.write(topic, message, time)
    result = run(tmp_path / "in.bag", tmp_path / "out.bag", "--rig", room.rig)
    assert result.returncode == 1
    assert "/odom exists: set odometry.source: topic and odometry.topic: /odom" in result.stderr
    options = ("--set", "fixed_frame=odon", "--force")
    result = run(room.bag, tmp_path / "out.bag", "--rig", room.rig, *options)
    assert result.returncode == 1
    assert "no transform has a frame 'odon'; did you mean 'odom'?" in result.stderr


def test_unindexed_bag(room, tmp_path):
    data = bytearray(room.bag.read_bytes())
    at = data.index(b"index_pos=") + len(b"index_pos=")
    data[at : at + 8] = b"\0" * 8
    (tmp_path / "open.bag").write_bytes(bytes(data))
    result = run(tmp_path / "open.bag", tmp_path / "out.bag", "--rig", room.rig)
    assert_fails(result, "open.bag", "reindex")
    assert not leftovers(tmp_path)


def test_bag_without_messages(room, tmp_path):
    rosbag.Bag(str(tmp_path / "empty.bag"), "w").close()
    result = run(tmp_path / "empty.bag", tmp_path / "out.bag", "--rig", room.rig)
    assert_fails(result, "empty.bag", "no messages")


def test_missing_lidar_topic_names_candidates(room, tmp_path):
    result = run(room.bag, tmp_path / "out.bag", "--rig", room.rig, "--set", "lidar.topic=/cloud")
    assert_fails(result, "/cloud", "/points")
    assert not leftovers(tmp_path)
    result = run(room.bag, tmp_path / "out.bag", "--rig", room.rig, "--set", "lidar.topic=/tf")
    assert_fails(result, "/tf", "tf2_msgs/TFMessage", "/points")


def test_bad_configuration(room, tmp_path):
    result = run(room.bag, tmp_path / "out.bag", "--rig", room.rig, "--set", "occlusion.mde=off")
    assert result.returncode == 1
    assert "mde" in result.stderr
    assert not leftovers(tmp_path)


def test_output_that_exists(room, tmp_path):
    out = tmp_path / "out.bag"
    out.write_text("mine")
    result = run(room.bag, out, "--rig", room.rig)
    assert_fails(result, "out.bag", "--force")
    assert out.read_text() == "mine"
    result = run(room.bag, out, "--rig", room.rig, "--force", "--quiet")
    assert result.returncode == 0
    assert (result.stdout, result.stderr) == ("", "")
    rosbag.Bag(str(out)).close()


def test_earlier_output_is_replaced_and_no_other_bag(room, tmp_path):
    out = tmp_path / "out.bag"
    out.write_bytes(b"")
    digests = set()
    for _ in range(2):
        result = run(room.bag, out, "--rig", room.rig)
        assert result.returncode == 0, result.stderr
        digests.add(digest(out))
    assert len(digests) == 1
    # A failure leaves it as it was.
    (tmp_path / "bad.bag").write_bytes(room.bag.read_bytes()[:5000])
    assert_fails(run(tmp_path / "bad.bag", out, "--rig", room.rig), "bad.bag")
    assert {digest(out)} == digests
    recording = tmp_path / "recording.bag"
    recording.write_bytes(room.bag.read_bytes())
    assert_fails(run(out, recording, "--rig", room.rig), "recording.bag", "--force")
    assert digest(recording) == digest(room.bag)


def test_output_is_the_input(room, tmp_path):
    before = digest(room.bag)
    link = tmp_path / "link.bag"
    os.symlink(str(room.bag), str(link))
    for out in (room.bag, link):
        assert_fails(run(room.bag, out, "--rig", room.rig, "--force"), "input")
    assert digest(room.bag) == before


@pytest.mark.parametrize("room_for_bytes", [0, 4000, 300_000])
def test_full_disk(room, tmp_path, room_for_bytes):
    def limit():
        # ThreadSanitizer writes a file of its own before main() can ignore the signal.
        if "libtsan" in os.environ.get("SLF_LAUNCH_PREFIX", ""):
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (room_for_bytes, room_for_bytes))

    result = run(room.bag, tmp_path / "out.bag", "--rig", room.rig, preexec_fn=limit)
    assert_fails(result, "out.bag")
    assert not leftovers(tmp_path)


def test_disk_full_at_the_very_end(room, fused, tmp_path):
    size = fused.path.stat().st_size
    for missing in (1, 2000):

        def limit():
            resource.setrlimit(resource.RLIMIT_FSIZE, (size - missing, size - missing))

        result = run(room.bag, tmp_path / "out.bag", "--rig", room.rig, preexec_fn=limit)
        assert_fails(result, "out.bag")
        assert not leftovers(tmp_path)


SLOW = ("--jobs", 1, "--set", "superpixels.scale=4", "--set", "superpixels.iterations=100")


def started(room, folder, *options):
    """A run that has begun to write folder/out.bag."""
    arguments = [room.bag, folder / "out.bag", "--rig", room.rig, "--all"] + list(options)
    before = set(os.listdir(str(folder)))
    process = subprocess.Popen(
        [program()] + [str(a) for a in arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    deadline = time.time() + 60
    while set(os.listdir(str(folder))) <= before:
        assert process.poll() is None and time.time() < deadline
        time.sleep(0.001)
    return process


def test_two_runs_with_one_output_do_not_meet(room, fused, tmp_path):
    runs = [started(room, tmp_path), started(room, tmp_path)]
    for process in runs:
        _, errors = process.communicate(timeout=120)
        assert process.returncode == 0, errors
        assert b"killed" not in errors
    assert leftovers(tmp_path) == ["out.bag"]
    with rosbag.Bag(str(tmp_path / "out.bag")) as bag:
        clouds = [m for _, m, _ in bag.read_messages("/points_semantic")]
    assert clouds == fused.of("/points_semantic")


def test_what_a_killed_run_leaves_is_removed_by_the_next(room, tmp_path):
    killed = started(room, tmp_path)
    killed.kill()
    killed.communicate(timeout=60)
    (left,) = leftovers(tmp_path)
    assert left.startswith("out.bag.unfinished-%d-" % killed.pid)
    writing = started(room, tmp_path)
    _, errors = writing.communicate(timeout=120)
    assert writing.returncode == 0 and left.encode() in errors, errors
    assert leftovers(tmp_path) == ["out.bag"]


def test_files_of_similar_names_are_left_alone(room, tmp_path):
    mine = [
        "out.bag.tmp",
        "out.bag.unfinished",
        "out.bag.unfinished-1-2.bag",
        "out.bag.unfinished-x-1",
    ]
    for name in mine:
        (tmp_path / name).write_text("my notes")
    goal = tmp_path / "notes"
    goal.write_text("more notes")
    (tmp_path / "out.bag.unfinished-1-2").symlink_to(goal)
    assert run(room.bag, tmp_path / "out.bag", "--rig", room.rig).returncode == 0
    assert goal.read_text() == "more notes"
    assert all((tmp_path / name).read_text() == "my notes" for name in mine)
    assert (tmp_path / "out.bag.unfinished-1-2").is_symlink()


@pytest.mark.parametrize("closed", ["<&- >&- 2>&-", "2>&-"])
def test_closed_streams_do_not_become_files(room, tmp_path, closed):
    command = [program(), room.bag, tmp_path / "out.bag", "--rig", room.rig]
    line = " ".join(shlex.quote(str(word)) for word in command) + " " + closed
    assert subprocess.run(["sh", "-c", line], timeout=120).returncode == 0
    expected = room.fuse(name="expected.bag").of("/points_semantic")
    with rosbag.Bag(str(tmp_path / "out.bag")) as bag:
        assert [m for _, m, _ in bag.read_messages("/points_semantic")] == expected


def test_pipes_and_devices_are_refused_at_once(room, tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(str(pipe))
    masked = "cameras.front.mask=%s"
    for odd in (pipe, "/dev/zero"):
        for words in (
            (odd, tmp_path / "out.bag", "--rig", room.rig),
            (room.bag, tmp_path / "out.bag", "--rig", odd),
            (room.bag, tmp_path / "out.bag", "--rig", room.rig, "--set", masked % odd),
        ):
            result = run(*words)
            assert_fails(result, str(odd))
            assert len(result.stderr.splitlines()) == 1, result.stderr


def test_a_model_that_the_bags_scores_replace_is_said(room, tmp_path):
    count = len(CLASS_NAMES)
    network = onnx_factory.convolution(64, 48, [[0.0] * 3] * count, [0.0] * count)
    (tmp_path / "net.onnx").write_bytes(network)
    model = tmp_path / "net.yaml"
    model.write_text(
        "file: net.onnx\ninput: {width: 64, height: 48, channels: rgb, scale: 1}\n"
        "classes: {%s}\n" % ", ".join("%s: [%d]" % (c, i) for i, c in enumerate(CLASS_NAMES))
    )
    fused = room.fuse("--set", "segmentation.model=%s" % model, name="model.bag")
    said = fused.result.stderr
    assert "camera front: its scores come from the bag" in said, said
    assert "segmentation.model is not used" in said
    assert fused.of("/points_semantic") == room.fuse(name="bag.bag").of("/points_semantic")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_interrupt_leaves_nothing(room, tmp_path, number):
    process = started(room, tmp_path, *SLOW)
    process.send_signal(number)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 128 + number, errors
    assert b"interrupted" in errors
    assert not leftovers(tmp_path)


def test_copied_transforms(room, fused):
    assert len(fused.of("/tf_static")) == 1
    with rosbag.Bag(str(room.bag)) as bag:
        originals = [m for _, m, _ in bag.read_messages("/tf")]
    assert fused.of("/tf") == originals
    without = room.fuse("--no-tf", name="without.bag")
    assert set(fused.messages) - set(without.messages) == {"/tf", "/tf_static"}


def test_transforms_of_other_names(room, fused, tmp_path):
    """A robot in a namespace of its own, as its recorder names its topics."""
    with rosbag.Bag(str(room.bag)) as old, rosbag.Bag(str(tmp_path / "ns.bag"), "w") as new:
        for topic, message, time in old.read_messages():
            new.write("/robot" + topic if topic.startswith("/tf") else topic, message, time)
    settings = ["tf.topic=/robot/tf", "tf.static_topic=/robot/tf_static"]
    options = [part for setting in settings for part in ("--set", setting)]
    result = run(tmp_path / "ns.bag", tmp_path / "out.bag", "--rig", room.rig, *options)
    assert result.returncode == 0, result.stderr
    other = Fused(tmp_path / "out.bag", result)
    assert [c.tobytes() for c in other.clouds()] == [c.tobytes() for c in fused.clouds()]
    assert len(other.of("/tf_static")) == 1 and other.of("/tf") == fused.of("/tf")


def rewritten(source, target, change, keep=lambda time: True):
    """Copies a bag; `change(topic, message)` alters messages, `keep(record time)` chooses them."""
    with rosbag.Bag(str(source)) as old, rosbag.Bag(str(target), "w") as new:
        for topic, message, time in old.read_messages():
            if keep(time):
                change(topic, message)
                header = None
                if topic == "/tf_static":
                    header = bag_factory.latching_header(topic, message)
                new.write(topic, message, time, connection_header=header)


def test_scores_without_an_image_of_their_stamp_are_said(tmp_path):
    made = Made(tmp_path, Drive(scans=2))

    def late(topic, message):
        if topic == "/front/scores":
            stamp = message.header.stamp.to_nsec() + 3_000_000
            message.header.stamp = bag_factory.stamp(stamp)

    rewritten(made.bag, tmp_path / "late.bag", late)
    result = run(tmp_path / "late.bag", tmp_path / "out.bag", "--rig", made.rig)
    assert result.returncode == 0  # the other camera goes on
    assert "camera front: none of the" in result.stderr
    assert "the nearest is 3.000000 ms after one" in result.stderr
    assert "camera front: scores without an image of their stamp" in result.stdout
    assert "camera left: scores without" not in result.stdout


def test_several_bags_are_one_drive(tmp_path):
    """As `rosbag record --split` leaves them, in any order: camera_info and /tf_static stand in the
    first part only."""
    made = Made(tmp_path, Drive(scans=6))
    whole = made.fuse()
    cut = bag_factory.START_NS + 420_000_000
    parts = [tmp_path / "one.bag", tmp_path / "two.bag"]
    rewritten(made.bag, parts[0], lambda *_: None, lambda time: time.to_nsec() <= cut)
    rewritten(made.bag, parts[1], lambda *_: None, lambda time: time.to_nsec() > cut)
    for order in (parts, parts[::-1]):
        out = tmp_path / "joined.bag"
        result = run(*order, out, "--rig", made.rig, "--force")
        assert result.returncode == 0, result.stderr
        joined = Fused(out, result)
        for topic in ("/points_semantic", "/points_compensated", "/scan_reference"):
            for a, b in zip(whole.of(topic), joined.of(topic)):
                a.header.seq = b.header.seq = 0
                assert a == b
            assert len(joined.of(topic)) == 6
    alone = run(parts[1], tmp_path / "alone.bag", "--rig", made.rig)
    assert alone.returncode == 1
    assert "scans: no extrinsics of the lidar" in alone.stderr
    assert "fuse_bag: warning: \n" not in alone.stderr
    assert "odometry does not cover" not in alone.stderr


@pytest.mark.parametrize("order", ["rggb", "bggr", "gbrg", "grbg"])
@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_compressed_mosaic_is_as_colourful_as_a_raw_one(tmp_path, order, suffix):
    import cv2
    from sensor_msgs.msg import CompressedImage, Image

    made = Made(tmp_path, Drive(scans=1))
    rig = made.rig.read_text()

    def colours(compressed):
        def change(topic, message):
            if topic != "/front/image":
                return
            pixels = np.frombuffer(message.data, np.uint8).reshape(message.height, message.width, 3)
            mosaic = np.zeros(pixels.shape[:2], np.uint8)
            for i, colour in enumerate(order):
                part = (slice(i // 2, None, 2), slice(i % 2, None, 2))
                mosaic[part] = pixels[part + ("bgr".index(colour),)]
            message.step, message.encoding = message.width, "bayer_%s8" % order
            message.data = mosaic.tobytes()

        bag = tmp_path / "mosaic.bag"
        rewritten(made.bag, bag, change)
        text = rig
        if compressed:
            with rosbag.Bag(str(bag)) as old, rosbag.Bag(str(tmp_path / "c.bag"), "w") as new:
                for topic, message, time in old.read_messages():
                    if topic == "/front/image":
                        pixels = np.frombuffer(message.data, np.uint8)
                        pixels = pixels.reshape(message.height, message.width)
                        topic += "/compressed"
                        kind = "png" if suffix == ".png" else "jpeg"
                        message = CompressedImage(
                            header=message.header,
                            format="%s; %s compressed " % (message.encoding, kind),
                            data=cv2.imencode(suffix, pixels, [cv2.IMWRITE_JPEG_QUALITY, 100])[
                                1
                            ].tobytes(),
                        )
                    header = None
                    if topic == "/tf_static":
                        header = bag_factory.latching_header(topic, message)
                    new.write(topic, message, time, connection_header=header)
            bag = tmp_path / "c.bag"
            text = rig.replace(
                "    namespace: /front\n", "    namespace: /front\n    transport: compressed\n"
            )
        (tmp_path / "m.yaml").write_text(text)
        out = tmp_path / "out.bag"
        result = run(bag, out, "--rig", tmp_path / "m.yaml", "--all", "--force")
        assert result.returncode == 0, result.stderr
        overlay = Fused(out, result).of("/front/projection_overlay")[0]
        assert isinstance(overlay._type, str) and overlay._type == Image._type
        pixels = np.frombuffer(overlay.data, np.uint8)
        pixels = pixels.reshape(overlay.height, overlay.width, -1)
        return pixels[5:60].astype(int).mean(axis=(0, 1))

    # The sky is blue; a grey mosaic has the same mean in all channels.
    raw, packed = colours(False), colours(True)
    assert packed == pytest.approx(raw, abs=3.0)
    assert np.ptp(packed) > 20
