#!/usr/bin/python3
# SPDX-License-Identifier: MIT
"""Odometry on a topic reaches tf, unless tf has it; RViz opens in a frame that exists; and what looks
wrong in the rig stands in the log and in /diagnostics."""
import math
import os
import subprocess
import sys
import unittest

import rospy
import rostest
import tf2_ros
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import CameraInfo, PointCloud2
from tf2_msgs.msg import TFMessage

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
import live  # noqa: E402
from rosgraph_msgs.msg import Log  # noqa: E402

RIG = """
classes: {file: %s/config/classes_usyd12.yaml}
cameras: [{name: front}]
lidar: {input: points}
odometry: {source: topic, topic: odom}
"""
YAW = 0.5


def transform(parent, child, x, y, z, yaw, stamp):
    message = TransformStamped()
    message.header.stamp, message.header.frame_id = stamp, parent
    message.child_frame_id = child
    t, r = message.transform.translation, message.transform.rotation
    t.x, t.y, t.z, r.z, r.w = x, y, z, math.sin(yaw / 2), math.cos(yaw / 2)
    return message


class Feed:
    """A vehicle at rest: odometry at 50 Hz, base_link 0.3 m above base_footprint; with `told`, also
    tf from odom."""

    def __init__(self, told):
        self._odometry = rospy.Publisher("/odom", Odometry, queue_size=10)
        self._static = rospy.Publisher("/tf_static", TFMessage, queue_size=1, latch=True)
        self._tf = rospy.Publisher("/tf", TFMessage, queue_size=10) if told else None
        static = transform("base_footprint", "base_link", 0, 0, 0.3, 0, rospy.Time(1))
        self._static.publish([static])
        self._timer = rospy.Timer(rospy.Duration(0.02), self._send)

    def _send(self, _):
        message = Odometry()
        message.header.stamp, message.header.frame_id = rospy.Time.now(), "odom"
        message.child_frame_id = "base_link"
        pose = message.pose.pose
        pose.position.x, pose.position.y, pose.position.z = 1.0, 2.0, 0.3
        pose.orientation.z, pose.orientation.w = math.sin(YAW / 2), math.cos(YAW / 2)
        self._odometry.publish(message)
        if self._tf:
            told = transform("odom", "base_footprint", 1, 2, 0, YAW, message.header.stamp)
            self._tf.publish([told])

    def close(self):
        self._timer.shutdown()
        for publisher in (self._odometry, self._static, self._tf):
            if publisher:
                publisher.unregister()


def opened_in(frame, within):
    """The frame in which open_rviz.py lets a command look."""
    script = os.path.join(live.SOURCE_DIR, "scripts", "open_rviz.py")
    command = [sys.executable, script, "--frame", frame, "--within", str(within), "echo", "rviz"]
    out = subprocess.check_output(command, timeout=60).decode().split()
    assert out[:2] == ["rviz", "--fixed-frame"], out
    return out[2]


class OdometryTf(unittest.TestCase):
    def setUp(self):
        self.said = live.Said()

    def rig(self, path):
        name = os.path.join(path, "rig.yaml")
        with open(name, "w") as file:
            file.write(RIG % live.SOURCE_DIR)
        return name

    def test_tf_gets_what_only_the_topic_has(self):
        buffer = tf2_ros.Buffer()
        tf2_ros.TransformListener(buffer)
        info = rospy.Publisher("/front/camera_info", CameraInfo, queue_size=1, latch=True)
        half = CameraInfo(width=640, height=400, distortion_model="plumb_bob")
        half.K = [200.0, 0, 160.0, 0, 200.0, 100.0, 0, 0, 1]
        half.header.frame_id = "front"
        info.publish(half)
        diagnostics = live.Diagnostics()
        feed = Feed(told=False)
        with live.folder() as path, live.launched(
            "fusion.launch", rig=self.rig(path), bond="false"
        ):
            live.wait_until(
                lambda: buffer.can_transform("odom", "base_footprint", rospy.Time(0)), "tf", 60.0
            )
            found = buffer.lookup_transform("odom", "base_footprint", rospy.Time(0)).transform
            place = found.translation
            # base_link, 0.3 m up, is at z = 0.3; a turn about z leaves the foot below it.
            self.assertAlmostEqual(place.x, 1.0, 9)
            self.assertAlmostEqual(place.y, 2.0, 9)
            self.assertAlmostEqual(place.z, 0.0, 9)
            self.assertAlmostEqual(2 * math.atan2(found.rotation.z, found.rotation.w), YAW, 9)
            self.said.wait_for("from odom to base_footprint is broadcast", Log.INFO)

            cloud = rospy.Publisher("/points_semantic", PointCloud2, queue_size=1, latch=True)
            message = PointCloud2()
            message.header.frame_id = "base_footprint"
            cloud.publish(message)
            self.assertEqual(opened_in("odom", 30), "odom")
            self.assertEqual(opened_in("map", 1), "base_footprint")

            self.said.wait_for("check: camera front: its principal point.*check_rig.py")
            live.wait_until(
                lambda: "principal point"
                in (diagnostics.value("projection", "check camera front") or ""),
                diagnostics.text,
            )
            self.assertGreaterEqual(diagnostics.levels["projection"], 1)
        for end in (feed, diagnostics):
            end.close()
        info.unregister()

    def test_nothing_is_broadcast_where_tf_has_it(self):
        heard = live.Received("/tf", TFMessage)
        feed = Feed(told=True)
        with live.folder() as path, live.launched(
            "fusion.launch", rig=self.rig(path), bond="false"
        ):
            self.said.wait_for("base_link in odom from elsewhere", Log.INFO)
            senders = {m._connection_header["callerid"] for m in heard.messages}
            self.assertEqual(senders, {rospy.get_name()})
        feed.close()
        heard.close()


if __name__ == "__main__":
    rospy.init_node("test_odometry_tf")
    rostest.rosrun("semantic_lidar_fusion", "odometry_tf", OdometryTf)
