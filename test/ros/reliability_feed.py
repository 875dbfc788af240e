# SPDX-License-Identifier: MIT
"""What the reliability rostests share: a launched chain that a test feeds message by message."""
import copy
import os
import sys
import unittest

import rospy

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
import live  # noqa: E402
from bag_factory import Camera, Drive, read_cloud  # noqa: E402,F401
from sensor_msgs.msg import PointCloud2  # noqa: E402

CASE_S = 20  # between the stamps of two cases: a jump, so that each starts anew


def small_cameras():
    """Two cameras whose images cost next to nothing."""
    size = dict(width=80, height=60, focal=28.0, score_step=2)
    return [
        Camera("front", 0.0, (1.5, 0.1, 0.2), **size),
        Camera("left", 1.5707963, (0.8, 0.6, 0.1), phase_ns=7_000_000, **size),
    ]


class Feed(unittest.TestCase):
    """One manager for all cases of a class, on the wall clock; it must live through all of them."""

    drive = Drive(scans=2, cameras=small_cameras(), points_per_scan=800)
    rig_extra = ""
    timeouts = {"cameras.front": 3, "cameras.left": 3, "odometry": 3, "reference": 3}

    @classmethod
    def setUpClass(cls):
        cls.said = live.Said()
        cls.diagnostics = live.Diagnostics()
        cls.context = live.folder()
        cls.folder = cls.context.__enter__()
        cls.made = live.Made(cls.folder, cls.drive, cls.rig_extra)
        cls.messages = cls.made.messages()
        types = {topic: type(message) for _, topic, message in cls.messages}
        cls.publishers = {
            topic: rospy.Publisher(topic, kind, queue_size=1000, tcp_nodelay=True)
            for topic, kind in types.items()
        }
        cls.semantic = live.Received("/points_semantic", PointCloud2)
        overrides = " ".join("%s.timeout=%s" % item for item in sorted(cls.timeouts.items()))
        cls.launch = live.launched(
            "fusion.launch", rig=cls.made.rig, bond="false", overrides=overrides, threads=2
        )
        cls.launch.__enter__()
        live.wait_for_chain(types, rospy.get_name())
        cls.pid = live.pid_of(live.MANAGER)
        cls.case = 0

    @classmethod
    def tearDownClass(cls):
        cls.launch.__exit__(None, None, None)
        cls.context.__exit__(None, None, None)

    def tearDown(self):
        self.assertEqual(live.pid_of(live.MANAGER), self.pid, "the manager has died")

    def shifted(self):
        """The drive at stamps that no other case has used: (time in ns, topic, message)."""
        type(self).case += 1
        shift = rospy.Duration(self.case * CASE_S)
        result = []
        for time_ns, topic, original in self.messages:
            message = copy.deepcopy(original)
            for stamped in getattr(message, "transforms", [message]):
                stamped.header.stamp += shift
            result.append((time_ns, topic, message))
        return result

    def publish(self, messages, change=None, pace=None):
        """Publishes in order; `change(topic, message)` gives what goes out, None for nothing.

        `pace`: wall s for each s of record time; None = 3 ms between messages."""
        start, first_ns = rospy.rostime.time.monotonic(), None
        for time_ns, topic, message in messages:
            message = message if change is None else change(topic, message)
            if message is None:
                continue
            if pace is None:
                rospy.rostime.wallsleep(0.003)
            else:
                first_ns = time_ns if first_ns is None else first_ns
                due = start + pace * (time_ns - first_ns) * 1e-9
                rospy.rostime.wallsleep(max(0.0, due - rospy.rostime.time.monotonic()))
            self.publishers[topic].publish(message)

    def run_drive(self, change=None, scans=None, messages=None, pace=None):
        """Clouds of the drive, in the order in which they came."""
        scans = self.drive.scans if scans is None else scans
        self.semantic.clear()
        self.publish(self.shifted() if messages is None else messages, change, pace)
        return self.semantic.wait_for(scans)[:scans]

    def count(self, nodelet, key):
        """A counter of /diagnostics; 0 while there is none."""
        return int(self.diagnostics.value(nodelet, key) or 0)

    def total(self, nodelet, keys):
        return sum(self.count(nodelet, key) for key in keys)
