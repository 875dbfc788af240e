#!/usr/bin/python3
# SPDX-License-Identifier: MIT
"""Packets and compressed images that are damaged: a clear line, and the chain goes on."""
import os
import sys
import unittest

import rospy
import rostest

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
import live  # noqa: E402
from bag_factory import Drive, read_cloud  # noqa: E402
from rosgraph_msgs.msg import Log  # noqa: E402
from sensor_msgs.msg import PointCloud2  # noqa: E402


class PacketTrouble(unittest.TestCase):
    """Each case with a manager of its own."""

    def setUp(self):
        self.said = live.Said()
        self.context = live.folder()
        a_drive = Drive(scans=2, lidar="packets", image_transport="jpeg")
        self.made = live.Made(self.context.__enter__(), a_drive)
        self.expected = self.made.fused()
        self.feed = live.Feed(self.made)
        self.semantic = live.Received("/points_semantic", PointCloud2)
        overrides = ["%s.timeout=3" % key for key in ("cameras.front", "cameras.left", "odometry")]
        self.launch = live.launched(
            "fusion.launch",
            rig=self.made.rig,
            bond="false",
            overrides=" ".join(overrides + ["reference.timeout=3"]),
        )
        self.launch.__enter__()
        live.wait_for_chain(self.feed.topics, rospy.get_name())
        self.pid = live.pid_of(live.MANAGER)

    def tearDown(self):
        self.assertEqual(live.pid_of(live.MANAGER), self.pid, "the manager has died")
        self.launch.__exit__(None, None, None)
        self.feed.close()
        self.semantic.close()
        self.context.__exit__(None, None, None)

    def run_drive(self, change=None):
        self.semantic.clear()
        self.feed.publish(self.feed.next_drive(), change)
        return [read_cloud(m) for m in self.semantic.wait_for(2)[:2]]

    def assert_good(self):
        sizes = [len(read_cloud(self.expected[stamp])) for stamp in sorted(self.expected)]
        clouds = self.run_drive()
        self.assertEqual([len(cloud) for cloud in clouds], sizes)
        for cloud in clouds:
            self.assertEqual(set(cloud["cameras"][cloud["status"] == 0]) - {3}, {1, 2})

    def test_truncated_packets(self):
        """The second half of some packets did not arrive: the rest of the scan is used."""

        def change(topic, message):
            if topic == "/velodyne_packets":
                for packet in message.packets[10:20]:
                    packet.data = packet.data[:603] + bytes(603)
            return message

        whole = [len(read_cloud(self.expected[stamp])) for stamp in sorted(self.expected)]
        for cloud, size in zip(self.run_drive(change), whole):
            self.assertLess(len(cloud), size)
            self.assertGreater(len(cloud), 0.85 * size)
        self.said.wait_for(r"/velodyne_packets: \d+ .*in a scan", Log.WARN)
        self.assert_good()

    def test_packets_of_another_sensor(self):
        def change(topic, message):
            if topic == "/velodyne_packets":
                for packet in message.packets:
                    packet.data = packet.data[:1205] + b"\x99"
            return message

        for cloud in self.run_drive(change):
            self.assertEqual(len(cloud), 0)
        self.said.wait_for(r"/velodyne_packets: \d+ packets with factory byte 0x99", Log.WARN)
        self.assert_good()

    def test_compressed_image_that_is_none(self):
        def change(topic, message):
            if topic == "/left/image/compressed":
                message.data = b"this is no JPEG"
            return message

        for cloud in self.run_drive(change):
            self.assertEqual(set(cloud["cameras"][cloud["status"] == 0]), {1})
        self.said.wait_for(r"left/image/compressed: .*(JPEG|decode)", Log.ERROR)
        self.assert_good()


if __name__ == "__main__":
    rospy.init_node("test_packet_trouble")
    rostest.rosrun("semantic_lidar_fusion", "packet_trouble", PacketTrouble)
