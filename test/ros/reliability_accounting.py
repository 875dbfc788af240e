#!/usr/bin/python3
# SPDX-License-Identifier: MIT
"""Input = output + counted drops, exactly: in good times, with data missing, and in a burst."""
import os
import signal
import sys
import time

import rospy
import rostest

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
import live  # noqa: E402
from reliability_feed import Drive, Feed, read_cloud, small_cameras  # noqa: E402

BURST = 40  # scans at once; the chain holds a dozen
STALL_S = 6.0  # longer than a bond's patience
# Where a scan goes in each nodelet: input, output, and the reasons for which it ends there.
STAGES = {
    "image_selection": (
        "input /points messages",
        "output /scan_reference messages",
        [
            "empty scans",
            "dropped: stamp 0 on points",
            "dropped: points, stamp disagrees with points",
            "dropped: scan older than all that are remembered",
            "dropped: no longer subscribed, /points",
            "dropped: error in /points",
            "dropped: queue full, /points",
            "dropped: scan, too many wait for images",
            "dropped: scan pending at a clock jump",
            "dropped: scan of a known stamp",
        ],
    ),
    "motion_compensation": (
        "input /points messages",
        "output /points_compensated messages",
        [
            "dropped: scan of stamp 0",
            "dropped: points, stamp disagrees with points",
            "dropped: scan of a known stamp",
            "dropped: no longer subscribed, /points",
            "dropped: error in /points",
            "dropped: queue full, /points",
            "dropped: scan, too many wait for odometry or scan_reference",
            "dropped: scan pending at a clock jump",
            "dropped: scan without scan_reference",
        ],
    ),
    "projection": (
        "input /points_compensated messages",
        "output /points_semantic messages",
        [
            "dropped: points_compensated, stamp disagrees with scan_reference",
            "dropped: scan behind the last one, or known",
            "dropped: no longer subscribed, /points_compensated",
            "dropped: error in /points_compensated",
            "dropped: error in fusion",
            "dropped: queue full, /points_compensated",
            "dropped: scan, too many wait for cameras",
            "dropped: scan pending at a clock jump",
        ],
    ),
}
CAMERA_ENDS = [
    "images used",
    "no image in time",
    "timed out",
    "no scores",
    "semantics left the buffer",
]


class Accounting(Feed):
    drive = Drive(scans=4, cameras=small_cameras(), points_per_scan=1600)
    timeouts = {"cameras.front": 2, "cameras.left": 2, "odometry": 2, "reference": 2}

    def balance(self):
        """(nodelet, in, out, dropped) of each stage."""
        return [
            (
                nodelet,
                self.count(nodelet, given),
                self.count(nodelet, made),
                self.total(nodelet, reasons),
            )
            for nodelet, (given, made, reasons) in STAGES.items()
        ]

    def assert_balanced(self, scans):
        """`scans` went in since the start, and every one is accounted for at each stage."""

        def balanced():
            stages = self.balance()
            first = stages[0][1] == scans and stages[1][1] == scans
            chained = stages[2][1] == stages[1][2]
            return first and chained and all(n == out + lost for _, n, out, lost in stages)

        live.wait_until(
            balanced,
            lambda: "the balance %s of %d scans\n%s"
            % (self.balance(), scans, self.diagnostics.text()),
        )
        # A scan without points asks no camera.
        fused = self.count("projection", "scans") - self.count("motion_compensation", "empty scans")
        for camera in ("front", "left"):
            ends = ["%s: %s" % (camera, end) for end in CAMERA_ENDS]
            self.assertEqual(self.total("projection", ends), fused, camera)
            self.assertEqual(
                self.count("image_selection", "output /%s/selection messages" % camera),
                self.count("image_selection", "output /scan_reference messages"),
            )

    def test_1_nothing_is_lost_in_good_times(self):
        type(self).sent = self.drive.scans
        self.run_drive(pace=2.0)
        self.assert_balanced(self.sent)
        self.assertEqual([lost for _, _, _, lost in self.balance()], [0, 0, 0])

    def test_2_missing_and_bad_data(self):
        """A malformed cloud, an empty one, one of stamp 0, one twice; no scores of one camera."""
        seen = []

        def change(topic, message):
            if topic == "/front/scores":
                return None
            if topic == "/points":
                seen.append(message)
                if len(seen) == 1:
                    message.point_step = 7
                elif len(seen) == 2:
                    message.width = message.row_step = 0
                    message.data = b""
            return message

        messages = self.shifted()
        scans = [row for row in messages if row[1] == "/points"]
        self.run_drive(change, scans=3, messages=messages)
        self.publishers["/points"].publish(scans[-1][2])
        zero = scans[-2][2]
        zero.header.stamp = rospy.Time()
        self.publishers["/points"].publish(zero)
        type(self).sent += self.drive.scans + 2
        self.assert_balanced(self.sent)
        self.assertGreaterEqual(self.count("motion_compensation", "dropped: error in /points"), 1)
        self.assertEqual(self.count("motion_compensation", "dropped: scan of stamp 0"), 1)
        self.assertEqual(self.count("image_selection", "dropped: scan of a known stamp"), 1)
        self.assertGreaterEqual(self.count("projection", "front: timed out"), 2)

    def test_3_a_burst_drops_the_oldest_counts_and_says_so(self):
        """The manager stands still while many scans come; then all are there at once."""
        messages = self.shifted()
        others = [row for row in messages if row[1] != "/points"]
        cloud = next(row[2] for row in messages if row[1] == "/points")
        self.publish(others)
        self.semantic.clear()
        stamp, before = cloud.header.stamp, self.balance()
        os.kill(self.pid, signal.SIGSTOP)
        try:
            for index in range(BURST):
                cloud.header.stamp = stamp + rospy.Duration(0, index * 5_000_000)
                self.publishers["/points"].publish(cloud)
                rospy.rostime.wallsleep(STALL_S / BURST)
        finally:
            os.kill(self.pid, signal.SIGCONT)
        start = time.monotonic()
        type(self).sent += BURST
        self.assert_balanced(self.sent)
        took = time.monotonic() - start
        received = self.semantic.messages
        dropped = sum(row[3] for row in self.balance()) - sum(row[3] for row in before)
        self.assertGreater(dropped, 0)
        # The queues bound what is worked off, and so the latency, whatever came.
        self.assertLess(len(received), BURST)
        self.assertLess(took, 30.0)
        self.assertGreaterEqual(len(received), 1)
        newest = max(float(read_cloud(m)["dt"].max()) + m.header.stamp.to_sec() for m in received)
        self.assertGreater(newest, cloud.header.stamp.to_sec(), "the newest scan was dropped")
        self.said.wait_for(r"messages come faster than they are worked off|a scan is dropped")
        # and then all is well again
        self.assertEqual(len(self.run_drive(pace=2.0)), self.drive.scans)
        type(self).sent += self.drive.scans
        self.assert_balanced(self.sent)


if __name__ == "__main__":
    rospy.init_node("reliability_accounting")
    rostest.rosrun("semantic_lidar_fusion", "reliability_accounting", Accounting)
