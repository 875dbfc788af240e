# SPDX-License-Identifier: MIT
"""import_dataset.py usyd on a made-up bag with videos beside it, in the data set's layout."""

import os
import shutil

import numpy as np
import pytest
import yaml

pytest.importorskip("rosbag")
cv2 = pytest.importorskip("cv2")

from semantic_lidar_fusion.bags import bag_io  # noqa: E402

SCRIPT = "import_dataset.py"
WIDTH, HEIGHT, FRAMES = 160, 96, 9
SECOND = 10**9
START_NS = 1535525025 * SECOND  # record time of the bag's begin
PERIOD_NS = 33333000
FIRST_COUNTER = {"A0": 2, "B1": 0}  # the first frame that the bag tells of
_HEADER = "=" * 80 + "\nMSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n"
FRAME_INFO = (
    "Header header\ntime ros_timestamp\nuint64 camera_timestamp\nuint32 frame_counter\n"
    "uint32 global_counter\n" + _HEADER
)


def grey_of(frame):
    return 20 + 25 * frame


def write_video(path):
    """Frame k is grey, 20 + 25 k; h264 where OpenCV's ffmpeg has an encoder, else Motion JPEG."""
    for code in ("H264", "MJPG"):
        # The container is told by the file's contents, not by its name.
        target = path if code == "H264" else path + ".avi"
        writer = cv2.VideoWriter(
            target, cv2.CAP_FFMPEG, cv2.VideoWriter_fourcc(*code), 30, (WIDTH, HEIGHT)
        )
        if writer.isOpened():
            break
    else:
        pytest.skip("this OpenCV can write no video")
    for frame in range(FRAMES):
        writer.write(np.full((HEIGHT, WIDTH, 3), grey_of(frame), np.uint8))
    writer.release()
    if target != path:
        os.rename(target, path)


def write_bag(path, bias_ns=0):
    """Scans at 10 Hz, odometry, tf_static, and for each camera camera_info and frame_info; the
    camera's clock is `bias_ns` behind."""
    import genpy.dynamic
    from geometry_msgs.msg import TransformStamped
    from nav_msgs.msg import Odometry
    from sensor_msgs.msg import CameraInfo
    from tf2_msgs.msg import TFMessage

    frame_info = genpy.dynamic.generate_dynamic("gmsl_frame_msg/FrameInfo", FRAME_INFO)
    scan_type = bag_io.message_class("velodyne_msgs/VelodyneScan")
    entries = []
    transform = TransformStamped()
    transform.header.frame_id, transform.child_frame_id = "base_link", "velodyne_front_link"
    transform.transform.rotation.w = 1.0
    for number in range(4):
        stamp_ns = START_NS + number * SECOND // 10
        scan = scan_type()
        scan.header.stamp = bag_io.to_stamp(stamp_ns)
        entries.append((stamp_ns, "/velodyne/front/velodyne_packets", scan))
        entries.append((stamp_ns + 1, "/zio/odometry/rear", Odometry()))
    for camera, frame_id in (("A0", "gmsl_centre_link"), ("B1", "gmsl_right_side_link")):
        info = CameraInfo(width=WIDTH, height=HEIGHT, distortion_model="equidistant")
        info.header.frame_id = frame_id
        info.D, info.K = [0.0] * 4, [80.0, 0, 80, 0, 80, 48, 0, 0, 1]
        entries.append((START_NS + 2, "/gmsl/%s/camera_info" % camera, info))
        for frame in range(FIRST_COUNTER[camera], FRAMES):
            message = frame_info["gmsl_frame_msg/FrameInfo"]()
            taken_ns = START_NS + frame * PERIOD_NS
            message.header.stamp = bag_io.to_stamp(taken_ns)
            message.ros_timestamp = bag_io.to_stamp(taken_ns + 5000000)
            message.camera_timestamp = (taken_ns - bias_ns) // 1000
            message.frame_counter = frame
            message.global_counter = 100 + frame
            entries.append((taken_ns + 5000000, "/gmsl/%s/frame_info" % camera, message))
    with bag_io.BagWriter(path, "none") as writer:
        writer.write("/tf_static", TFMessage([transform]), START_NS, latched=True)
        for stamp_ns, topic, message in sorted(entries, key=lambda entry: entry[:2]):
            writer.write(topic, message, stamp_ns)


@pytest.fixture(scope="module")
def week(tmp_path_factory):
    """A folder as the data set has them; the bag's name is one with a known time correction."""
    folder = tmp_path_factory.mktemp("Week25_2018-08-29")
    stem = str(folder / "2018-08-29-17-03-45_Dataset_year")
    write_bag(stem + ".bag")
    write_video(stem + "-A0.h264")
    shutil.copy(stem + "-A0.h264", stem + "-B1_.h264")
    return folder


def import_week(run_command, tmp_path, *arguments):
    bag = str(tmp_path / "out.bag")
    code, out, err = run_command(SCRIPT, "usyd", *(list(arguments) + [bag]))
    assert code == 0, err
    with open(str(tmp_path / "out.yaml")) as stream:
        rig = yaml.safe_load(stream)
    with bag_io.BagReader(bag) as reader:
        messages = {}
        for item in reader.read_raw():
            messages.setdefault(item.topic, []).append((item.stamp_ns, item.message()))
    return messages, rig, out, err


def test_frames_become_images_with_their_own_stamps(run_command, week, tmp_path):
    messages, rig, out, _ = import_week(run_command, tmp_path, str(week))
    for camera in ("A0", "B1"):
        images = messages["/gmsl/%s/image_color/compressed" % camera]
        frames = range(FIRST_COUNTER[camera], FRAMES)
        assert len(images) == len(frames)
        for frame, (record_ns, image) in zip(frames, images):
            # camera_timestamp is in us; the correction of this bag is 15 ms.
            taken_us = (START_NS + frame * PERIOD_NS) // 1000
            assert bag_io.to_ns(image.header.stamp) == taken_us * 1000 - 15000000
            assert record_ns == START_NS + frame * PERIOD_NS + 5000000
            pixels = cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_COLOR)
            assert pixels.shape == (HEIGHT, WIDTH, 3)
            # Neighbouring frames are 25 apart; the codecs' colour spaces round.
            assert abs(pixels.mean() - grey_of(frame)) < 6
    assert images[0][1].header.frame_id == "gmsl_right_side_link"
    assert "time correction 0.0150 s" in out and "A0 7" in out and "B1 9" in out
    assert [camera["name"] for camera in rig["cameras"]] == ["A0", "B1"]
    assert {camera["transport"] for camera in rig["cameras"]} == {"compressed"}
    assert rig["odometry"]["topic"] == "/zio/odometry/rear"
    # The paper's rig keeps the paper's mask and temperature.
    assert rig["occlusion"]["mode"] == "paper" and rig["uncertainty"]["exponent"] == 2.0


def test_everything_else_passes_as_it_is(run_command, week, tmp_path):
    messages, _, _, _ = import_week(run_command, tmp_path, str(week))
    source = str(week / "2018-08-29-17-03-45_Dataset_year.bag")
    with bag_io.BagReader(source) as reader, bag_io.BagReader(str(tmp_path / "out.bag")) as got:
        copied = [i for i in got.read_raw() if not i.topic.endswith("/compressed")]
        wanted = list(reader.read_raw())
    assert [(i.topic, i.stamp_ns, i.content[1]) for i in copied] == [
        (i.topic, i.stamp_ns, i.content[1]) for i in wanted
    ]
    assert [i.latched for i in copied if i.topic == "/tf_static"] == [True]


def test_clocks_far_apart_are_aligned(run_command, week, tmp_path):
    stem = str(tmp_path / "drive")
    write_bag(stem + ".bag", bias_ns=86400 * SECOND)
    shutil.copy(str(week / "2018-08-29-17-03-45_Dataset_year-A0.h264"), stem + "-A0.h264")
    arguments = [stem + ".bag", "--images", "raw", "--time-correction", "-0.25"]
    messages, rig, out, _ = import_week(run_command, tmp_path, *arguments)
    record_ns, image = messages["/gmsl/A0/image_color"][0]
    assert image.encoding == "bgr8" and abs(np.frombuffer(image.data, np.uint8).mean() - 70) < 6
    # The bias is that of the first frame_info, whose camera_timestamp is cut to us.
    expected_ns = START_NS + FIRST_COUNTER["A0"] * PERIOD_NS + 250000000
    assert abs(bag_io.to_ns(image.header.stamp) - expected_ns) < 2000
    assert "clocks 86400.000 s apart" in out
    assert rig["cameras"][0]["transport"] == "raw"


def test_a_part_of_the_bag(run_command, week, tmp_path):
    arguments = [str(week), "--start", "0.15", "--duration", "0.1", "--cameras", "B1"]
    messages, rig, _, _ = import_week(run_command, tmp_path, *arguments)
    assert len(messages["/velodyne/front/velodyne_packets"]) == 1
    assert "/tf_static" in messages and "/gmsl/B1/camera_info" in messages
    stamps = [stamp_ns for stamp_ns, _ in messages["/gmsl/B1/image_color/compressed"]]
    assert len(stamps) == 3 and min(stamps) >= START_NS + 150000000
    _, image = messages["/gmsl/B1/image_color/compressed"][0]
    pixels = cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_COLOR)
    assert abs(pixels.mean() - grey_of(5)) < 6
    assert [camera["name"] for camera in rig["cameras"]] == ["B1"]


def test_what_is_missing_is_named(run_command, week, tmp_path):
    stem = str(tmp_path / "drive")
    code, _, err = run_command(SCRIPT, "usyd", str(tmp_path), stem + "_out.bag")
    assert code == 1 and "0 bags" in err
    write_bag(stem + ".bag")
    code, _, err = run_command(SCRIPT, "usyd", stem + ".bag", stem + "_out.bag")
    assert code == 1 and "drive-CAMERA.h264" in err
    with open(stem + "-A0.h264", "wb") as stream:
        stream.write(b"nothing of a video")
    code, _, err = run_command(SCRIPT, "usyd", stem + ".bag", stem + "_out.bag")
    assert code == 1 and "not a video" in err
    shutil.copy(str(week / "2018-08-29-17-03-45_Dataset_year-A0.h264"), stem + "-A0.h264")
    arguments = [stem + ".bag", stem + "_out.bag", "--cameras", "A0,A1"]
    code, _, err = run_command(SCRIPT, "usyd", *arguments)
    assert code == 1 and "no video of camera A1" in err
    arguments = [stem + ".bag", stem + "_out.bag", "--first-frame", "-1"]
    assert run_command(SCRIPT, "usyd", *arguments)[0] == 2
    assert not os.path.exists(stem + "_out.bag") and not os.path.exists(stem + "_out.yaml")


def test_a_video_that_ends_early_is_named(run_command, week, tmp_path):
    arguments = [str(week), "--first-frame", "3"]
    _, _, _, err = import_week(run_command, tmp_path, *arguments)
    # The first 3 of B1's frames are said to lie before the video, the last 0.
    assert "camera B1: its video lacks 3 of 9 frames" in err
