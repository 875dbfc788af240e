#!/usr/bin/python3
# SPDX-License-Identifier: MIT
"""A manager that crashes, and one that stands still, come back by themselves."""
import os
import signal
import sys
import time
import unittest

import rospy
import rostest

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
import live  # noqa: E402
from bag_factory import Drive, read_cloud  # noqa: E402
from sensor_msgs.msg import PointCloud2  # noqa: E402

# s from the crash to the next cloud: the bond breaks after 4 s, then all is started anew, which on
# an idle machine is done within 8 s of the crash. Tests share their machine.
RECOVERY_S = 30.0
STANDSTILL_S = 6.0  # longer than the 4 s after which a bond breaks


class Recovery(unittest.TestCase):
    def setUp(self):
        self.context = live.folder()
        self.made = live.Made(self.context.__enter__(), Drive(scans=2, points_per_scan=1600))
        self.semantic = live.Received("/points_semantic", PointCloud2)
        self.feed = live.Feed(self.made)

    def tearDown(self):
        self.feed.close()
        self.semantic.close()
        self.context.__exit__(None, None, None)

    def wait_for_fused_cloud(self, timeout):
        """Feeds drive after drive until a cloud comes in which points are fused."""
        start = time.monotonic()

        def came():
            self.feed.publish(self.feed.next_drive())
            return any((read_cloud(m)["status"] == 0).any() for m in self.semantic.messages)

        self.semantic.clear()
        live.wait_until(came, "a cloud with fused points", timeout)
        return time.monotonic() - start

    def wait_for_bonds(self):
        """Returns when all nodelets of the manager and their loaders have heard of each other."""
        publishers = dict(rospy.get_master().getSystemState()[2][0])[live.MANAGER + "/bond"]
        count = len(publishers) - 1  # a loader of each nodelet, and the manager
        status = live.Received(live.MANAGER + "/bond", live.BOND_STATUS)

        # The third: upstream, a bond watches for silence from the second heartbeat on.
        def are_formed():
            sides = [(m.id, m.instance_id) for m in status.messages if m.active]
            beating = [bond_id for bond_id, _ in {s for s in sides if sides.count(s) >= 3}]
            return sum(beating.count(bond_id) == 2 for bond_id in set(beating)) == count

        live.wait_until(are_formed, "%d bonds" % count)
        status.close()

    def test_manager_that_crashes_comes_back_with_its_nodelets(self):
        with live.launched("fusion.launch", rig=self.made.rig, bond="true"):
            live.wait_for_chain(self.feed.topics, rospy.get_name())
            self.wait_for_fused_cloud(30.0)
            self.wait_for_bonds()
            pid = live.pid_of(live.MANAGER)
            os.kill(pid, signal.SIGKILL)
            took = self.wait_for_fused_cloud(RECOVERY_S)
            print("recovered %.1f s after the crash" % took)
            self.assertNotEqual(live.pid_of(live.MANAGER), pid)
            # When all end at once, bonds that break have the stock manager look for a nodelet in a
            # table that it has destroyed. The one that follows this one has no bonds yet.
            os.kill(live.pid_of(live.MANAGER), signal.SIGKILL)

    def test_manager_that_stands_still_goes_on_without_bonds(self):
        with live.launched("fusion.launch", rig=self.made.rig, bond="false"):
            live.wait_for_chain(self.feed.topics, rospy.get_name())
            self.wait_for_fused_cloud(30.0)
            pid = live.pid_of(live.MANAGER)
            os.kill(pid, signal.SIGSTOP)
            try:
                deadline = time.monotonic() + STANDSTILL_S
                while time.monotonic() < deadline:
                    self.feed.publish(self.feed.next_drive())
            finally:
                os.kill(pid, signal.SIGCONT)
            self.wait_for_fused_cloud(30.0)
            self.assertEqual(live.pid_of(live.MANAGER), pid)


if __name__ == "__main__":
    rospy.init_node("test_recovery")
    rostest.rosrun("semantic_lidar_fusion", "recovery", Recovery)
