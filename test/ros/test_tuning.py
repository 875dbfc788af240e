#!/usr/bin/python3
# SPDX-License-Identifier: MIT
"""A rig that is tuned while it runs: what the next scans show, what is refused, what is saved."""
import os
import sys
import unittest

import rospy
import rostest
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import String

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
import live  # noqa: E402
from bag_factory import Drive  # noqa: E402

NODES = ("/image_selection", "/superpixel_uncertainty", "/projection")
CHANGES = {
    "occlusion_mode": "paper",
    "temperature": 1.5,
    "smoothing_iterations": 3,
    "overlap": "product",
    "left_time_offset": 0.012,
    "left_yaw_deg": 2.5,
    "front_z_m": -0.1,
}


def trigger(name):
    """Calls a service of type std_srvs/Trigger."""
    from std_srvs.srv import Trigger

    rospy.wait_for_service(name, 20.0)
    return rospy.ServiceProxy(name, Trigger)()


class Tuning(unittest.TestCase):
    def passed(self, feed, clouds, count):
        """One pass of the drive: its clouds by the stamps of the bag."""
        clouds.clear()
        feed.publish(feed.next_drive())
        clouds.wait_for(count, 60.0)
        shift = rospy.Duration(feed.passes * feed.SHIFT_S)
        result = {}
        for message in clouds.messages:
            message.header.stamp -= shift
            result[message.header.stamp.to_nsec()] = message
        return result

    def compare(self, expected, got):
        self.assertEqual(sorted(expected), sorted(got))
        for stamp, message in got.items():
            self.assertEqual(live.difference(message, expected[stamp]), "")

    def test_changes(self):
        from dynamic_reconfigure.client import Client

        overrides = live.patience() + ["segmentation.mode=free_running"]
        with live.folder() as path:
            os.environ["ROS_HOME"] = path  # of the nodes that are launched
            made = live.Made(path, Drive(scans=4, cameras=live.cameras(), points_per_scan=3200))
            before = made.fused(*overrides)
            feed = live.Feed(made)
            clouds = live.Received("/points_semantic", PointCloud2)
            told = {name: live.Received(name + "/configuration", String) for name in NODES}
            with live.launched(
                "fusion.launch", rig=made.rig, bond="false", overrides=" ".join(overrides)
            ):
                live.wait_for_chain(feed.topics - {"/tf_static"}, rospy.get_name())
                self.compare(before, self.passed(feed, clouds, len(before)))

                client = Client("/projection", timeout=20.0)
                shown = {p["name"]: p for p in client.get_parameter_descriptions()}
                self.assertEqual(set(CHANGES) - set(shown), set())
                self.assertIn("adaptive", shown["occlusion_mode"]["edit_method"])
                self.assertEqual(client.get_configuration()["occlusion_mode"], "adaptive")
                answer = client.update_configuration(dict(CHANGES))
                for name, value in CHANGES.items():
                    self.assertEqual(answer[name], value)
                saved = trigger("/projection/save_rig")
                self.assertTrue(saved.success, saved.message)
                with open(saved.message) as file:
                    text = file.read()
                for name, topic in told.items():
                    live.wait_until(
                        lambda: topic.messages and topic.messages[-1].data == text,
                        "the tuned rig of " + name,
                    )
                made.rig = saved.message
                after = made.fused()
                self.compare(after, self.passed(feed, clouds, len(after)))
                same = [s for s in before if before[s].data == after[s].data]
                self.assertEqual(same, [])

                # What breaks a rule is refused as a whole, and said by the values in force.
                refused = client.update_configuration({"temperature": -1.0, "overlap": "mean"})
                self.assertEqual((refused["temperature"], refused["overlap"]), (1.5, "product"))
                self.compare(after, self.passed(feed, clouds, len(after)))
            feed.close()


if __name__ == "__main__":
    rospy.init_node("test_tuning")
    rostest.rosrun("semantic_lidar_fusion", "tuning", Tuning)
