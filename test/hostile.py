#!/usr/bin/python3
# SPDX-License-Identifier: MIT
"""Good drives through the nodelets while everything around them is hostile; started by
scripts/soak.sh --hostile.

Attacks take turns and overlap: floods, messages of another type, tf of invented frames and absurd
values, lengths that lie, a camera whose clock flaps, listeners that come and go. Good drives follow
each other all the time, each at stamps of its own, so that each is a jump of time too. Prints a line
now and then and, at the end, what was measured against its limit; exit code 0 only if all hold."""
import argparse
import os
import random
import statistics
import struct
import subprocess
import sys
import threading
import time

import rospy

sys.path.insert(0, os.path.join(os.path.dirname(os.path.abspath(__file__)), "ros"))
import live  # noqa: E402
from bag_factory import Drive, read_cloud  # noqa: E402
from geometry_msgs.msg import TransformStamped  # noqa: E402
from sensor_msgs.msg import Image, PointCloud2  # noqa: E402
from soak import Process, counters, tell  # noqa: E402
from tf2_msgs.msg import TFMessage  # noqa: E402

SCANS = 3
# Scans in, but neither out nor counted: those that were under way.
UNDER_WAY = 12
GROWTH_MB = 20.0
MORE_THREADS = 8  # connections of roscpp that are being made


class Lying(TFMessage):
    """Declares a hundred million transforms, and holds none."""

    def serialize(self, buff):
        buff.write(struct.pack("<I", 10**8) + b"\0" * 100)


def random_name(draw):
    return "%x" % draw.getrandbits(64) * draw.choice((1, 1, 1, 4, 10000))


class Attacks:
    """Each runs in a thread of its own, in bursts, until `stop`."""

    def __init__(self, feed):
        self._feed = feed
        self._ended = threading.Event()
        self.counts = {}
        self._threads = [
            threading.Thread(target=self._run, args=(attack, seed), daemon=True)
            for seed, attack in enumerate(
                (self.flood, self.frames, self.lies, self.types, self.listeners)
            )
        ]

    def start(self):
        for thread in self._threads:
            thread.start()

    def stop(self):
        self._ended.set()
        for thread in self._threads:
            thread.join()

    def _run(self, attack, seed):
        draw = random.Random(seed)
        while not self._ended.is_set():
            attack(draw)
            self.counts[attack.__name__] = self.counts.get(attack.__name__, 0) + 1
            self._ended.wait(draw.uniform(0.0, 2.0))

    def flood(self, draw):
        """A burst of images, whose stamps lie anywhere, for one camera."""
        publisher = self._feed.publishers["/left/image"]
        for _ in range(500):
            image = Image(height=8, width=8, step=8, encoding="mono8", data=b"\0" * 64)
            image.header.stamp = rospy.Time(draw.randrange(1, 2**32 - 1), draw.randrange(10**9))
            publisher.publish(image)
            if self._ended.wait(0.001):
                return

    def frames(self, draw):
        """Frames that nobody has heard of, with values from 0 to 1e39 m and NaN."""
        publisher = self._feed.publishers["/tf"]
        for _ in range(50):
            message = TFMessage()
            for _ in range(20):
                transform = TransformStamped(child_frame_id=random_name(draw))
                transform.header.frame_id = draw.choice(("odom", "base_link", random_name(draw)))
                transform.header.stamp = rospy.Time(draw.randrange(1, 2**32 - 1))
                transform.transform.rotation.w = draw.choice((1.0, 1.0, 1.02, 0.0))
                transform.transform.translation.x = draw.choice((1.0, 1e39, float("nan")))
                message.transforms.append(transform)
            publisher.publish(message)
            if self._ended.wait(0.02):
                return

    def lies(self, draw):
        for _ in range(20):
            self._feed.publishers["/tf"].publish(Lying())
            if self._ended.wait(draw.uniform(0.0, 0.1)):
                return

    def types(self, draw):
        """A node that publishes something else on a topic of the rig."""
        topic = draw.choice(("/points", "/front/image", "/left/scores", "/front/camera_info"))
        with open(os.devnull, "w") as nothing:
            other = subprocess.Popen(
                ["rostopic", "pub", "-r", "20", topic, "std_msgs/String", "data: x"],
                stdout=nothing,
                stderr=nothing,
            )
            self._ended.wait(5.0)
            other.terminate()
            other.wait()

    def listeners(self, draw):
        topics = ("/points_semantic", "/points_compensated", "/front/projection_overlay")
        here = [
            rospy.Subscriber(topic, rospy.AnyMsg, lambda _: None)
            for topic in draw.sample(topics, 2)
            for _ in range(draw.randrange(1, 4))
        ]
        self._ended.wait(draw.uniform(0.0, 1.0))
        for subscriber in here:
            subscriber.unregister()


def flapping(draw):
    """What a pass's messages become: the stamps of one camera are now and then an hour off."""
    off = draw.choice((0, 0, 3600, -3600))

    def change(topic, message):
        if off and topic.startswith("/left/"):
            message.header.stamp.secs += off
        return message

    return change


def run(minutes):
    diagnostics = live.Diagnostics()
    samples, whole, passes, arrived = [], 0, 0, 0
    with live.folder() as folder:
        made = live.Made(folder, Drive(scans=SCANS, points_per_scan=1600))
        expected = made.fused()
        feed = live.Feed(made)
        semantic = live.Received("/points_semantic", PointCloud2)
        keys = ("cameras.front", "cameras.left", "reference", "odometry")
        patience = " ".join("%s.timeout=1" % key for key in keys)
        with live.launched("fusion.launch", rig=made.rig, bond="false", overrides=patience):
            live.wait_for_chain(feed.topics, rospy.get_name())
            pid = live.pid_of(live.MANAGER)
            process, attacks, draw = Process(pid), Attacks(feed), random.Random(7)
            attacks.start()
            end = time.monotonic() + 60.0 * minutes
            warm = time.monotonic() + min(120.0, 15.0 * minutes)
            told = 0.0
            while time.monotonic() < end:
                semantic.clear()
                feed.publish(feed.next_drive(), flapping(draw))
                passes += 1
                limit = time.monotonic() + 8.0
                while len(semantic) < SCANS and time.monotonic() < limit:
                    time.sleep(0.02)
                arrived += min(len(semantic), SCANS)
                whole += len(semantic) >= SCANS
                if time.monotonic() - told > 10.0:
                    told = time.monotonic()
                    sample = process.sample()
                    print(
                        "RSS %6.1f MB, %3d threads, %3d fds; %d drives, %d of %d scans came"
                        % (
                            sample["rss_mb"],
                            sample["threads"],
                            sample["fds"],
                            passes,
                            arrived,
                            SCANS * passes,
                        ),
                        flush=True,
                    )
                    if told > warm:
                        samples.append(sample)
            attacks.stop()
            same = live.pid_of(live.MANAGER) == pid
            after = quiet_drive(feed, semantic, expected)
            time.sleep(2.5)  # diagnostics come once a second
            given, out, lost, _ = counters(diagnostics)
    return samples, (passes, whole, arrived), same, after, (given, out, lost), attacks.counts


def quiet_drive(feed, semantic, expected):
    """Whether a drive without attacks gives what fuse_bag gives; a second one, should the first have
    met what the attacks had left in the queues."""
    for _ in range(2):
        time.sleep(4.0)
        semantic.clear()
        feed.publish(feed.next_drive())
        try:
            received = semantic.wait_for(SCANS, timeout=30.0)
        except AssertionError:
            continue
        status = [read_cloud(m)["status"].tobytes() for m in received]
        if status == [read_cloud(expected[s])["status"].tobytes() for s in sorted(expected)]:
            return True
    return False


def judge(samples, drives, same, after, accounts, counts):
    """(what, measured, limit, holds) of each figure."""
    passes, whole, arrived = drives
    given, out, lost = accounts
    third = max(1, len(samples) // 3)
    first, last = (
        statistics.median(s["rss_mb"] for s in part) for part in (samples[:third], samples[-third:])
    )
    threads = [s["threads"] for s in samples]
    share = 100.0 * arrived / (SCANS * passes)
    left = given - out - sum(lost.values())
    return [
        ("attacks", str(sorted(counts.items())), "all", len(counts) == 5),
        ("manager", "same process" if same else "restarted", "same process", same),
        (
            "memory",
            "%.1f MB to %.1f MB (%+.1f MB)" % (first, last, last - first),
            "+%.0f MB" % GROWTH_MB,
            last - first <= GROWTH_MB,
        ),
        (
            "threads",
            "%d to %d" % (min(threads), max(threads)),
            "within %d" % MORE_THREADS,
            max(threads) - min(threads) <= MORE_THREADS,
        ),
        (
            "good scans",
            "%d of %d (%.2f %%), %d of %d drives whole"
            % (arrived, SCANS * passes, share, whole, passes),
            "95 %",
            share >= 95.0,
        ),
        (
            "in - out - dropped",
            "%d of %d; %s" % (left, given, sorted(lost.items())),
            "0 to %d" % UNDER_WAY,
            0 <= left <= UNDER_WAY,
        ),
        ("afterwards", "as fuse_bag" if after else "otherwise", "as fuse_bag", after),
    ]


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, required=True)
    options = parser.parse_args(rospy.myargv()[1:])
    rospy.init_node("hostile", disable_signals=True)
    return tell(judge(*run(options.minutes)))


if __name__ == "__main__":
    sys.exit(main())
