#!/usr/bin/python3
# SPDX-License-Identifier: MIT
"""A bag that loops, a clock that jumps, a clock that is silent."""
import os
import sys
import unittest

import rospy
import rostest

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
import live  # noqa: E402
from reliability_feed import Drive, small_cameras  # noqa: E402
from rosgraph_msgs.msg import Clock  # noqa: E402
from sensor_msgs.msg import PointCloud2  # noqa: E402

PATIENCE = ["%s.timeout=20" % key for key in ("cameras.front", "cameras.left", "odometry")]
PATIENCE += ["reference.timeout=20", "segmentation.mode=free_running"]
LOOPS = 3
RATE = 0.5  # slower than life: what counts is the result, not whether the machine keeps up


class Loop(unittest.TestCase):
    def setUp(self):
        self.said = live.Said()
        rospy.set_param("/use_sim_time", True)

    def test_1_a_silent_clock_is_named(self):
        """Row 24; also: diagnostics come although no ROS timer fires."""
        with live.folder() as path:
            made = live.Made(path, Drive(scans=1, cameras=small_cameras(), points_per_scan=160))
            diagnostics = live.Diagnostics()
            semantic = live.Received("/points_semantic", PointCloud2)
            with live.launched("fusion.launch", rig=made.rig, bond="false", manager="silent"):
                self.said.wait_for(
                    r"use_sim_time is true but /clock is silent; play with --clock", timeout=60.0
                )
                live.wait_until(
                    lambda: diagnostics.levels.get("projection") == 3,
                    "diagnostics that are stale",
                )
            semantic.close()
            diagnostics.close()

    def test_2_every_loop_of_a_bag_gives_the_same(self):
        """Rows 4 and 5. Scans whose images end with the bag may be under way when it starts anew;
        they are counted. Nothing else differs, and no tf warning is printed."""
        with live.folder() as path:
            drive = Drive(scans=14, cameras=small_cameras(), points_per_scan=1600)
            made = live.Made(path, drive)
            expected = made.fused(*PATIENCE)
            semantic = live.Received("/points_semantic", PointCloud2)
            diagnostics = live.Diagnostics()
            overrides = " ".join(PATIENCE)
            with live.launched("fusion.launch", rig=made.rig, bond="false", overrides=overrides):
                with live.played(made.bag, "--rate=%s" % RATE, "--loop"):
                    live.wait_for_chain(made.topics(), "/player")
                    live.resume()
                    loops = live.wait_until(
                        lambda: self.whole_loops(semantic.messages), "three loops", 90.0
                    )
            self.assertGreaterEqual(len(loops), LOOPS)
            first = min(expected)
            for loop in loops[:LOOPS]:
                self.assertEqual(loop[0].header.stamp.to_nsec(), first, "the first scan of a loop")
                self.assertGreaterEqual(len(loop), drive.scans - 2)
                for message in loop:
                    offline = expected[message.header.stamp.to_nsec()]
                    self.assertEqual(live.difference(message, offline), "")
            jumps = int(diagnostics.value("projection", "clock jumps") or 0)
            self.assertGreaterEqual(jumps, LOOPS - 1)
            self.assertEqual(self.said.find(r"TF_REPEATED_DATA|TF_OLD_DATA|redundant"), [])
            semantic.close()
            diagnostics.close()

    def whole_loops(self, messages):
        """The messages of each loop, once three have ended; None before."""
        loops, newest = [], None
        for message in messages:
            stamp = message.header.stamp
            if newest is None or (newest - stamp).to_sec() > 1.0:
                loops.append([])
                newest = stamp
            loops[-1].append(message)
            newest = max(newest, stamp)
        return loops if len(loops) > LOOPS else None

    def test_3_a_clock_that_jumps_ahead_and_back(self):
        """Rows 4 and 6: messages of another time follow each jump, at once or with the clock."""
        with live.folder() as path:
            drive = Drive(scans=3, cameras=small_cameras(), points_per_scan=800)
            made = live.Made(path, drive)
            messages = made.messages()
            types = {topic: type(message) for _, topic, message in messages}
            publishers = {
                topic: rospy.Publisher(topic, kind, queue_size=100, tcp_nodelay=True)
                for topic, kind in types.items()
            }
            clock = rospy.Publisher("/clock", Clock, queue_size=1000, tcp_nodelay=True)
            semantic = live.Received("/points_semantic", PointCloud2)
            overrides = " ".join(PATIENCE)
            with live.launched("fusion.launch", rig=made.rig, bond="false", overrides=overrides):
                live.wait_for_chain(types, rospy.get_name())
                for shift_s in (0, 3600, 0):  # there, an hour ahead, and back
                    semantic.clear()
                    for time_ns, topic, message in messages:
                        shift = rospy.Duration(shift_s)
                        now = rospy.Time(time_ns // 10**9, time_ns % 10**9) + shift
                        for stamped in getattr(message, "transforms", [message]):
                            stamped.header.stamp += shift
                        clock.publish(Clock(now))
                        publishers[topic].publish(message)
                        for stamped in getattr(message, "transforms", [message]):
                            stamped.header.stamp -= shift
                        rospy.rostime.wallsleep(0.004)
                    received = semantic.wait_for(drive.scans - 2)
                    expected = made.fused(*PATIENCE)
                    for cloud in received:
                        cloud.header.stamp -= rospy.Duration(shift_s)
                        offline = expected[cloud.header.stamp.to_nsec()]
                        self.assertEqual(live.difference(cloud, offline), "")
            semantic.close()


if __name__ == "__main__":
    rospy.init_node("reliability_loop")
    rostest.rosrun("semantic_lidar_fusion", "reliability_loop", Loop)
