# SPDX-License-Identifier: MIT
"""Bags: reading by topic and type, velodyne messages without their package, atomic writing."""

import errno
import io
import os
import struct
import subprocess
import sys

import numpy as np
import pytest

pytest.importorskip("rosbag")
from geometry_msgs.msg import TransformStamped  # noqa: E402
from sensor_msgs.msg import Image  # noqa: E402
from std_msgs.msg import Int32, String  # noqa: E402
from tf2_msgs.msg import TFMessage  # noqa: E402

from conftest import SOURCE_DIR  # noqa: E402
from semantic_lidar_fusion import files  # noqa: E402
from semantic_lidar_fusion.bags import bag_io  # noqa: E402
from semantic_lidar_fusion.errors import ConfigError, DataError  # noqa: E402
from semantic_lidar_fusion.labels import load_yaml  # noqa: E402


def write_sample(path, count=4):
    with bag_io.BagWriter(path) as writer:
        writer.write("/text", String("hello"), 5, latched=True)
        for i in range(count):
            writer.write("/number", Int32(i), 10**18 + i)
    return path


def test_round_trip_in_integer_ns(tmp_path):
    path = write_sample(str(tmp_path / "a.bag"))
    with bag_io.BagReader(path) as reader:
        assert reader.topics == {"/text": "std_msgs/String", "/number": "std_msgs/Int32"}
        assert reader.topics_of_type("std_msgs/Int32") == ["/number"]
        assert reader.count() == 5 and reader.count(["/number"]) == 4
        entries = list(reader.read())
        assert [e.stamp_ns for e in entries] == [5] + [10**18 + i for i in range(4)]
        assert entries[0].topic == "/text" and entries[0].message.data == "hello"
        assert [e.message.data for e in reader.read(types=["std_msgs/Int32"])] == [0, 1, 2, 3]
        middle = reader.read(["/number"], start_ns=10**18 + 1, end_ns=10**18 + 2, label="x")
        assert [e.message.data for e in middle] == [1, 2]
        assert list(reader.read(["/none"])) == []
        reader.require_topic("/text", "std_msgs/String")
        with pytest.raises(DataError, match="no topic /none .*it has: /number, /text"):
            reader.require_topic("/none")
        with pytest.raises(DataError, match="/text is std_msgs/String, not std_msgs/Int32"):
            reader.require_topic("/text", "std_msgs/Int32")


def test_latched_topics_say_so(tmp_path):
    import rosbag

    path = write_sample(str(tmp_path / "a.bag"))
    with rosbag.Bag(path) as bag:
        latching = {c.topic: c.header.get("latching") for c in bag._get_connections()}
    assert latching["/text"] in (b"1", "1") and not latching["/number"]


def test_names_without_a_leading_slash_are_those_with_one(tmp_path):
    """`rosbag record number` writes the topic's name as it was given."""
    import rosbag

    path = str(tmp_path / "a.bag")
    with rosbag.Bag(path, "w") as bag:
        bag.write("number", Int32(1), bag_io.to_stamp(1))
        bag.write("/number", Int32(2), bag_io.to_stamp(2))
    with bag_io.BagReader(path) as reader:
        assert reader.topics == {"/number": "std_msgs/Int32"}
        reader.require_topic("/number")
        assert reader.count(["/number"]) == 2
        found = [(e.topic, e.message.data) for e in reader.read(["/number"])]
    assert found == [("/number", 1), ("/number", 2)]


def test_stamps():
    for stamp_ns in (0, 1, 999999999, 10**9, 1546300800123456789):
        assert bag_io.to_ns(bag_io.to_stamp(stamp_ns)) == stamp_ns
    for stamp_ns in (-1, 2**32 * 10**9):
        with pytest.raises(DataError, match="no ROS time"):
            bag_io.to_stamp(stamp_ns)


def test_velodyne_messages(tmp_path):
    scan_class = bag_io.message_class("velodyne_msgs/VelodyneScan")
    packet_class = bag_io.message_class("velodyne_msgs/VelodynePacket")
    assert scan_class._md5sum == "50804fc9533a0e579e6322c04ae70566"
    assert packet_class._md5sum == "ae4f90a23256f44e82baa08dd45c3456"
    random = np.random.RandomState(1)
    scan = scan_class()
    scan.header.stamp, scan.header.frame_id = bag_io.to_stamp(7 * 10**9 + 5), "velodyne"
    for i in range(3):
        data = random.randint(0, 256, 1206).astype(np.uint8).tobytes()
        scan.packets.append(packet_class(bag_io.to_stamp(7 * 10**9 + i), data))
    path = str(tmp_path / "v.bag")
    with bag_io.BagWriter(path) as writer:
        writer.write("/velodyne_packets", scan, 7 * 10**9)
    with bag_io.BagReader(path) as reader:
        assert reader.topics == {"/velodyne_packets": "velodyne_msgs/VelodyneScan"}
        back = next(reader.read()).message
    assert back.header.frame_id == "velodyne" and len(back.packets) == 3
    for packet, wanted in zip(back.packets, scan.packets):
        assert bytes(packet.data) == wanted.data and packet.stamp == wanted.stamp


def test_unknown_message_type():
    with pytest.raises(DataError, match="no_such_msgs/Thing is not installed"):
        bag_io.message_class("no_such_msgs/Thing")
    assert bag_io.message_class("sensor_msgs/Image") is Image


def test_nothing_is_left_of_a_failed_write(tmp_path):
    path = tmp_path / "a.bag"
    with pytest.raises(RuntimeError):
        with bag_io.BagWriter(str(path)) as writer:
            writer.write("/number", Int32(1), 1)
            assert not path.exists() and len(os.listdir(str(tmp_path))) == 1
            raise RuntimeError("stop")
    assert os.listdir(str(tmp_path)) == []


def test_a_failed_write_keeps_the_old_file(tmp_path):
    path = write_sample(str(tmp_path / "a.bag"))
    before = open(path, "rb").read()
    with pytest.raises(DataError):
        with bag_io.BagWriter(path) as writer:
            writer.write("/number", Int32(1), -1)
    assert open(path, "rb").read() == before and os.listdir(str(tmp_path)) == ["a.bag"]


def test_unwritable_places(tmp_path):
    with pytest.raises(DataError, match="does not exist"):
        bag_io.BagWriter(str(tmp_path / "none" / "a.bag"))
    with pytest.raises(DataError, match="is a folder"):
        bag_io.BagWriter(str(tmp_path))


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full")
def test_full_disk(tmp_path, monkeypatch):
    class Full(bag_io.AtomicFile):
        def __init__(self, path):
            self.path, self.temporary, self._lock = path, "/dev/full", -1

        def discard(self):
            pass

    monkeypatch.setattr(bag_io, "AtomicFile", Full)
    monkeypatch.setattr(files, "AtomicFile", Full)
    with pytest.raises(DataError, match="cannot be written .*No space left"):
        with bag_io.BagWriter(str(tmp_path / "a.bag")) as writer:
            for i in range(200):
                writer.write("/text", String("x" * 10000), i + 1)
    with pytest.raises(DataError, match="cannot be written .*No space left"):
        bag_io.write_text(str(tmp_path / "a.yaml"), "text")


def test_a_name_of_its_own_and_no_link_followed(tmp_path):
    target = str(tmp_path / "a.txt")
    first, second = files.AtomicFile(target), files.AtomicFile(target)
    assert first.temporary != second.temporary
    with open(first.temporary, "w") as file:
        file.write("first")
    second.discard()
    second.discard()
    # The name itself may be a link: it is replaced, and what it pointed to stays as it is.
    (tmp_path / "other").write_text("untouched")
    os.symlink(str(tmp_path / "other"), target)
    first.commit()
    first.discard()
    assert sorted(os.listdir(str(tmp_path))) == ["a.txt", "other"]
    assert (tmp_path / "other").read_text() == "untouched"
    assert open(target).read() == "first" and not os.path.islink(target)


def test_what_a_killed_run_left_is_removed_and_named(tmp_path, capfd):
    target = str(tmp_path / "a.txt")
    program = (
        "import sys, os, signal; sys.path.insert(0, %r)\n"
        "from semantic_lidar_fusion.files import AtomicFile\n"
        "file = AtomicFile(%r); os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    scripts = os.path.join(SOURCE_DIR, "scripts")
    subprocess.run([sys.executable, "-c", program % (scripts, target)])
    (left,) = os.listdir(str(tmp_path))
    users = tmp_path / ".a.txt.mine.partial"
    users.write_text("a file that nobody here has made")
    running = files.AtomicFile(target)
    err = capfd.readouterr().err
    assert left in err and "removed" in err and err.count("\n") == 1
    files.write_text(target, "whole")
    # Neither that of the other writer, which still runs, nor the user's own.
    assert os.path.exists(running.temporary) and users.exists()
    running.discard()
    assert capfd.readouterr().err == ""
    assert sorted(os.listdir(str(tmp_path))) == [".a.txt.mine.partial", "a.txt"]


@pytest.mark.parametrize("make", [lambda p: os.mkfifo(p), lambda p: os.symlink("/dev/zero", p)])
def test_pipes_and_devices_are_no_files(tmp_path, make):
    path = str(tmp_path / "pipe")
    make(path)
    for read in (bag_io.BagReader, files.open_file, load_yaml):
        with pytest.raises((DataError, ConfigError), match="pipe: must be a file"):
            read(path)
    with pytest.raises(DataError, match="is a pipe or a device"):
        files.AtomicFile(path)


def test_an_index_that_leads_to_a_message_of_another_topic_is_damage(tmp_path):
    path = str(tmp_path / "a.bag")
    with bag_io.BagWriter(path, "none") as writer:
        writer.write("/tf", TFMessage(), 1)
        writer.write("/text", String("text"), 1)
    with bag_io.BagReader(path) as bag:
        entries = [e for one in bag._bag._connection_indexes.values() for e in one]
        first, second = (struct.pack("<III", 0, 1, entry.offset) for entry in entries)
    with open(path, "rb") as file:
        data = file.read()
    assert data.count(first) == 1
    with open(path, "wb") as file:
        file.write(data.replace(first, second))
    for read in ("read", "read_raw"):
        with bag_io.BagReader(path) as bag, pytest.raises(
            DataError, match="damaged.*another topic"
        ):
            list(getattr(bag, read)(["/tf"]))


@pytest.mark.parametrize(
    "number, text",
    [(errno.ENOSPC, "the temporary folder .*No space left.*TMPDIR"), (errno.EIO, "Input/output")],
)
def test_a_full_temporary_folder_and_a_failing_disk_are_no_damage(tmp_path, number, text):
    path = str(tmp_path / "a.bag")
    with bag_io.BagWriter(path, "none") as writer:
        writer.write("/text", String("text"), 1)

    def failing():
        raise OSError(number, os.strerror(number))
        yield

    with bag_io.BagReader(path) as bag, pytest.raises(DataError, match=text) as refusal:
        list(bag._guarded(failing()))
    assert path in str(refusal.value) and "damaged" not in str(refusal.value)


def test_whatever_a_damaged_bag_raises_is_a_data_error(tmp_path):
    path = str(tmp_path / "a.bag")
    message = TFMessage([TransformStamped(child_frame_id="lidar")])
    stream = io.BytesIO()
    message.serialize(stream)
    content = stream.getvalue()
    with bag_io.BagWriter(path, "none") as writer:
        writer.write("/tf", message, 1)
        writer.write("/text", String("text"), 1)
    with open(path, "rb") as file:
        data = file.read()
    # A list that claims to be longer than its message; a foreign type whose declaration is none.
    no_end = data.replace(content, b"\xff" + content[1:])
    foreign = data.replace(b"std_msgs/", b"odd_msgs/").replace(b"string data", b"strong data")
    foreign = foreign.replace(String._md5sum[:8].encode(), b"0" * 8)  # rosbag keeps types by this
    for damaged in (no_end, foreign):
        assert damaged != data
        with open(path, "wb") as file:
            file.write(damaged)
        with bag_io.BagReader(path) as bag, pytest.raises(DataError, match="damaged"):
            list(bag.read())
        with bag_io.BagReader(path) as bag, pytest.raises(DataError, match="damaged"):
            for item in bag.read_raw():
                item.message()
    # What the reader of the messages raises is its own error.
    with open(path, "wb") as file:
        file.write(data)
    with bag_io.BagReader(path) as bag, pytest.raises(ZeroDivisionError):
        for _ in bag.read():
            1 // 0


def test_bad_bags(tmp_path):
    with pytest.raises(DataError, match="none.bag: No such file"):
        bag_io.BagReader(str(tmp_path / "none.bag"))
    empty = tmp_path / "empty.bag"
    empty.write_bytes(b"")
    with pytest.raises(DataError, match="empty.bag"):
        bag_io.BagReader(str(empty))
    text = tmp_path / "text.bag"
    text.write_bytes(b"this is not a bag\n" * 10)
    with pytest.raises(DataError, match="text.bag: not a readable bag"):
        bag_io.BagReader(str(text))
    whole = open(write_sample(str(tmp_path / "a.bag"), 500), "rb").read()
    for part in (0.3, 0.7, 0.97):
        cut = tmp_path / "cut.bag"
        cut.write_bytes(whole[: int(len(whole) * part)])
        with pytest.raises(DataError, match="cut.bag"):
            with bag_io.BagReader(str(cut)) as reader:
                list(reader.read())


def test_write_text(tmp_path):
    path = str(tmp_path / "a.txt")
    bag_io.write_text(path, "one\n")
    bag_io.write_text(path, "two\n")
    assert open(path).read() == "two\n" and os.listdir(str(tmp_path)) == ["a.txt"]
