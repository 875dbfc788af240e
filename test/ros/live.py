# SPDX-License-Identifier: MIT
"""What the rostests share: launching, playing, receiving, and asking the master who listens.

Every wait is for a condition and bounded; nothing here sleeps for a fixed time to be in step.
"""
import contextlib
import copy
import hashlib
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import unittest
import xmlrpc.client

import genpy
import genpy.dynamic
import rosbag
import rosgraph
import rospy
from diagnostic_msgs.msg import DiagnosticArray
from rosgraph_msgs.msg import Log
from sensor_msgs.msg import Image, PointCloud2

HERE = os.path.dirname(os.path.abspath(__file__))
SOURCE_DIR = os.path.dirname(os.path.dirname(HERE))
sys.path.insert(0, os.path.join(SOURCE_DIR, "test", "python"))

import bag_factory  # noqa: E402,F401

if not hasattr(threading.Thread, "isAlive"):
    # The rospy of Debian 11 calls it at the end; Python 3.9 has no such name any more.
    threading.Thread.isAlive = threading.Thread.is_alive

MANAGER = "/fusion_manager"


def _dynamic(name, text):
    return genpy.dynamic.generate_dynamic(name, text)[name]


class SetBool:
    """std_srvs/SetBool, whose package need not be installed."""

    _type = "std_srvs/SetBool"
    _md5sum = "09fb03525b03e7ea1fd3992bafd87e16"
    _request_class = _dynamic("std_srvs/SetBoolRequest", "bool data\n")
    _response_class = _dynamic("std_srvs/SetBoolResponse", "bool success\nstring message\n")


# bond/Status, whose Python package need not be installed.
BOND_STATUS = _dynamic(
    "bond/Status",
    "Header header\nstring id\nstring instance_id\nbool active\nfloat32 heartbeat_timeout\n"
    "float32 heartbeat_period\n" + "=" * 80 + "\nMSG: std_msgs/Header\nuint32 seq\ntime stamp\n"
    "string frame_id\n",
)


def wait_until(condition, what, timeout=30.0):
    """Returns the first true value of `condition()`; fails after `timeout` s."""
    deadline = time.monotonic() + timeout
    while True:
        value = condition()
        if value:
            return value
        if time.monotonic() > deadline:
            raise AssertionError(
                "waited %.0f s for %s" % (timeout, what() if callable(what) else what)
            )
        time.sleep(0.02)


def _stop(process, timeout=20.0):
    """Ends a process that was started here, as Ctrl-C does: with its children, if it leads a
    session of its own."""
    if process.poll() is None:
        if os.getpgid(process.pid) == process.pid:
            os.killpg(process.pid, signal.SIGINT)
        else:
            process.send_signal(signal.SIGINT)
        try:
            process.wait(timeout)
        except subprocess.TimeoutExpired:
            process.kill()
            raise AssertionError("%s does not end" % process.args)


def launch_command(name, **arguments):
    """The command that starts a launch file of the package; a sanitizer reaches its manager."""
    # The map's node is Python without instrumented code.
    if os.environ.get("SLF_LAUNCH_PREFIX") and name != "semantic_map.launch":
        arguments.setdefault("launch_prefix", os.environ["SLF_LAUNCH_PREFIX"])
    command = ["roslaunch", "--skip-log-check", os.path.join(SOURCE_DIR, "launch", name)]
    return command + ["%s:=%s" % item for item in arguments.items()]


@contextlib.contextmanager
def launched(name, **arguments):
    """A launch file of the package as long as the block runs."""
    process = subprocess.Popen(launch_command(name, **arguments))
    try:
        yield process
    finally:
        _stop(process)


@contextlib.contextmanager
def folder():
    """A temporary folder."""
    path = tempfile.mkdtemp(prefix="slf_ros_")
    try:
        yield path
    finally:
        shutil.rmtree(path)


class Made:
    """A bag of a drive with its rig file, and what fuse_bag makes of it."""

    def __init__(self, path, drive, rig_extra="", name="in"):
        self.drive = drive
        self.bag = os.path.join(path, name + ".bag")
        self.rig = os.path.join(path, name + ".yaml")
        bag_factory.write_bag(self.bag, drive)
        with open(self.rig, "w") as file:
            file.write(bag_factory.rig_text(drive, rig_extra))

    def fused(self, *overrides):
        """Semantic clouds of fuse_bag by stamp (ns)."""
        out = self.bag + ".out"
        program = os.path.join(os.environ["SLF_BIN_DIR"], "fuse_bag")
        command = [program, self.bag, out, "--rig", self.rig, "--force", "--quiet"]
        for override in overrides:
            command += ["--set", override]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, timeout=60)
        with rosbag.Bag(out) as bag:
            return {
                m.header.stamp.to_nsec(): m for _, m, _ in bag.read_messages(["/points_semantic"])
            }

    def topics(self):
        with rosbag.Bag(self.bag) as bag:
            return set(bag.get_type_and_topic_info().topics)

    def messages(self):
        """(time in ns, topic, message) in the order of record."""
        with rosbag.Bag(self.bag) as bag:
            return [
                (time.to_nsec(), topic, message) for topic, message, time in bag.read_messages()
            ]


class Received:
    """The messages of a topic, from now on."""

    def __init__(self, topic, message_type):
        self.topic = topic
        self._lock = threading.Lock()
        self._messages = []
        self._subscriber = rospy.Subscriber(
            topic, message_type, self._add, queue_size=1000, buff_size=1 << 24, tcp_nodelay=True
        )

    def _add(self, message):
        with self._lock:
            self._messages.append(message)

    @property
    def messages(self):
        with self._lock:
            return list(self._messages)

    def __len__(self):
        with self._lock:
            return len(self._messages)

    def by_stamp(self):
        return {m.header.stamp.to_nsec(): m for m in self.messages}

    def clear(self):
        with self._lock:
            self._messages.clear()

    def wait_for(self, count, timeout=30.0):
        wait_until(
            lambda: len(self) >= count,
            lambda: "%d messages on %s, %d came" % (count, self.topic, len(self)),
            timeout,
        )
        return self.messages

    def close(self):
        self._subscriber.unregister()


def subscribers_of(topic):
    """Nodes that subscribe to a topic, after the master."""
    for name, nodes in rosgraph.Master(rospy.get_name()).getSystemState()[1]:
        if name == topic:
            return set(nodes)
    return set()


def node_proxy(node):
    return xmlrpc.client.ServerProxy(rosgraph.Master(rospy.get_name()).lookupNode(node))


def pid_of(node):
    """Process id of a node; None while there is none."""
    try:
        return node_proxy(node).getPid(rospy.get_name())[2]
    except (rosgraph.MasterException, OSError):
        return None


def connections_of(node, direction):
    """Topics over which `node` has a live connection out ("o") or in ("i")."""
    try:
        info = node_proxy(node).getBusInfo(rospy.get_name())[2]
    except (rosgraph.MasterException, OSError):
        return set()
    return {entry[4] for entry in info if entry[2] == direction and (len(entry) < 6 or entry[5])}


def wait_for_chain(rig_topics, publisher, timeout=90.0, manager=MANAGER):
    """Waits until `publisher` is connected to listeners of all these topics, and the chain's last
    link stands: nodelets share a connection, so that one of them may come after it."""

    def missing():
        return (set(rig_topics) - connections_of(publisher, "o")) | (
            {"/scan_reference"} - connections_of(manager, "o")
        )

    wait_until(lambda: not missing(), lambda: "listeners of %s" % sorted(missing()), timeout)


def resume(player="/player"):
    """Lets a player that waits at the start of its bag go."""
    name = player + "/pause_playback"
    rospy.wait_for_service(name, 20.0)
    assert rospy.ServiceProxy(name, SetBool)(False).success


@contextlib.contextmanager
def played(bag, *options):
    """`rosbag play --clock` that waits at the start of the bag for resume()."""
    command = ["rosbag", "play", "--quiet", "--clock", "--hz=1000", "--delay=0", "--pause"]
    process = subprocess.Popen(
        command + list(options) + [bag, "__name:=player"],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        start_new_session=True,  # `rosbag` of Debian 11 leaves its player alone when interrupted
    )
    try:
        yield process
    finally:
        _stop(process)


def difference(a, b):
    """What differs between two clouds apart from header.seq, in words; empty = nothing."""
    if a.header.stamp != b.header.stamp or a.header.frame_id != b.header.frame_id:
        return "headers differ"
    for name in ("height", "width", "fields", "is_bigendian", "point_step", "row_step", "is_dense"):
        # As text: a bag's messages are of generated classes.
        if str(getattr(a, name)) != str(getattr(b, name)):
            return "%s differs: %s and %s" % (name, getattr(a, name), getattr(b, name))
    if a.data == b.data:
        return ""
    ours, theirs = bag_factory.read_cloud(a), bag_factory.read_cloud(b)
    parts = []
    for name in ours.dtype.names:
        count = int((ours[name] != theirs[name]).sum())
        if count:
            parts.append("%s of %d points" % (name, count))
    return "data differs: " + (", ".join(parts) or "padding")


class Feed:
    """Publishes a drive again and again on the wall clock, at stamps that no other pass has used:
    each pass is a jump of time, so that each starts anew."""

    SHIFT_S = 20

    def __init__(self, made):
        self._messages = made.messages()
        types = {topic: type(message) for _, topic, message in self._messages}
        self.topics = set(types)
        self.publishers = {
            topic: rospy.Publisher(topic, kind, queue_size=100, tcp_nodelay=True)
            for topic, kind in types.items()
        }
        self.passes = 0

    def next_drive(self):
        """The drive's messages at the stamps of the next pass: (topic, message)."""
        self.passes += 1
        result = []
        for _, topic, original in self._messages:
            message = copy.deepcopy(original)
            for stamped in getattr(message, "transforms", [message]):
                stamped.header.stamp.secs += self.passes * self.SHIFT_S
            for packet in getattr(message, "packets", []):
                packet.stamp.secs += self.passes * self.SHIFT_S
            result.append((topic, message))
        return result

    def publish(self, messages, change=None):
        """Publishes; `change(topic, message)` gives what goes out instead, None for nothing."""
        for topic, message in messages:
            message = message if change is None else change(topic, message)
            if message is not None:
                self.publishers[topic].publish(message)
                rospy.rostime.wallsleep(0.003)  # the pace of a drive; no step waits for it

    def close(self):
        for publisher in self.publishers.values():
            publisher.unregister()


class Network:
    """A segmentation node of somebody else: answers each image with the scores of its stamp, in
    order, `latency_s` (wall time) after it came."""

    def __init__(self, answers, images, latency_s):
        """`answers`: camera -> {stamp in ns: message}; `images`: topic of images, with %s for the
        camera."""
        self.latency_s = latency_s
        self.asked = {camera: [] for camera in answers}
        self._answers = answers
        self._publishers = {
            camera: rospy.Publisher("/%s/scores" % camera, Image, queue_size=100)
            for camera in answers
        }
        self._subscribers = [
            rospy.Subscriber(images % camera, Image, self._answer, camera, buff_size=1 << 24)
            for camera in answers
        ]

    def _answer(self, image, camera):
        stamp = image.header.stamp.to_nsec()
        self.asked[camera].append(stamp)
        scores = self._answers[camera][stamp]
        threading.Timer(self.latency_s, self._publishers[camera].publish, [scores]).start()

    def wait_until_connected(self):
        def is_connected():
            ends = list(self._publishers.values()) + self._subscribers
            return all(end.get_num_connections() for end in ends)

        wait_until(is_connected, "the network's neighbours")

    def close(self):
        for end in list(self._publishers.values()) + self._subscribers:
            end.unregister()


# Slower than real time: what counts is the result, not whether the machine keeps up.
RATE = 0.25


def cameras():
    """Different phases and rates."""
    return [
        bag_factory.Camera("front", 0.0, (1.5, 0.1, 0.2), width=240, height=180, focal=85.0),
        bag_factory.Camera(
            "left",
            1.5707963,
            (0.8, 0.6, 0.1),
            phase_ns=7_000_000,
            period_ns=33_000_000,
            width=240,
            height=180,
            focal=85.0,
        ),
    ]


def patience(names=("front", "left")):
    """Overrides with which nothing is late on a busy machine: all decisions are the stamps'."""
    return ["cameras.%s.timeout=20" % name for name in names] + ["odometry.timeout=20"]


class ReplayCase(unittest.TestCase):
    """What is played through replay.launch is compared with what fuse_bag makes of a bag."""

    def assert_same(self, expected, received):
        """`expected`: clouds by stamp (ns); `received`: messages."""
        self.assertEqual(sorted(expected), sorted(m.header.stamp.to_nsec() for m in received))
        for message in received:
            offline = expected[message.header.stamp.to_nsec()]
            self.assertEqual(difference(message, offline), "")

    def assert_replay_gives(
        self,
        expected,
        bag,
        rig,
        overrides,
        topics,
        rate=RATE,
        network=None,
        before_the_end=lambda: None,
        **arguments,
    ):
        """Plays `bag` when all of `topics` have listeners and the external network, if there is
        one, is connected. Returns the clouds that came. `before_the_end` is called before the
        nodes end."""
        semantic = Received("/points_semantic", PointCloud2)
        try:
            with launched(
                "replay.launch",
                bag=bag,
                rig=rig,
                paused="true",
                rate=rate,
                delay=0,
                overrides=" ".join(overrides),
                **arguments,
            ):
                wait_for_chain(topics, "/player")
                if network is not None:
                    network.wait_until_connected()
                resume()
                received = semantic.wait_for(len(expected), timeout=60.0)
                before_the_end()
        finally:
            semantic.close()
        self.assert_same(expected, received)
        fused = sum((bag_factory.read_cloud(m)["status"] == 0).sum() for m in received)
        self.assertGreater(fused, 1000)
        return received


def digest(data):
    return hashlib.sha1(bytes(data)).hexdigest()


class Diagnostics:
    """The last /diagnostics of each nodelet: name -> {key: value}, and its level and message."""

    def __init__(self):
        self.values, self.levels, self.summaries = {}, {}, {}
        self._subscriber = rospy.Subscriber("/diagnostics", DiagnosticArray, self._add)

    def _add(self, message):
        for status in message.status:
            name = status.name.split(":")[0]
            self.values[name] = {pair.key: pair.value for pair in status.values}
            level = status.level if isinstance(status.level, int) else ord(status.level)
            self.levels[name] = level
            self.summaries.setdefault(name, set()).add((level, status.message))

    def value(self, name, key):
        return self.values.get(name, {}).get(key)

    def text(self):
        """All of it, for the log of a test that fails."""
        lines = []
        for name, values in sorted(self.values.items()):
            lines.append(name)
            lines += ["  %s: %s" % item for item in sorted(values.items())]
        return "\n".join(lines)

    def close(self):
        self._subscriber.unregister()


class Said:
    """The lines of /rosout."""

    def __init__(self):
        self._lock = threading.Lock()
        self._lines = []
        self._subscriber = rospy.Subscriber("/rosout", Log, self._add, queue_size=1000)

    def _add(self, message):
        with self._lock:
            self._lines.append((message.level, message.name, message.msg))

    def find(self, pattern, level=Log.WARN):
        """Lines at least as grave as `level` that match."""
        with self._lock:
            lines = list(self._lines)
        return [line for line in lines if line[0] >= level and re.search(pattern, line[2])]

    def wait_for(self, pattern, level=Log.WARN, timeout=60.0):
        with_text = lambda: "a line like '%s'; said: %s" % (pattern, self._lines)  # noqa: E731
        return wait_until(lambda: self.find(pattern, level), with_text, timeout)
