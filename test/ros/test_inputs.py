#!/usr/bin/python3
# SPDX-License-Identifier: MIT
"""Labels, probabilities and compressed images give, live, what fuse_bag gives of them."""
import os
import sys

import rospy
import rostest

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
import live  # noqa: E402
from bag_factory import Drive, read_cloud  # noqa: E402

FREE_RUNNING = ["segmentation.mode=free_running"]


def drive(**changes):
    return Drive(scans=4, cameras=live.cameras(), points_per_scan=3200, **changes)


class Inputs(live.ReplayCase):
    def replay(self, a_drive, *settings):
        with live.folder() as path:
            made = live.Made(path, a_drive)
            overrides = live.patience() + FREE_RUNNING + list(settings)
            expected = made.fused(*overrides)
            return self.assert_replay_gives(expected, made.bag, made.rig, overrides, made.topics())

    def test_labels(self):
        clouds = [read_cloud(m) for m in self.replay(drive(semantics="labels"))]
        # A histogram of labels, not one label: some superpixels hold two classes.
        sure = [(cloud["confidence"][cloud["status"] == 0] == 1.0).mean() for cloud in clouds]
        self.assertTrue(all(0.1 < share < 1.0 for share in sure), sure)

    def test_probabilities(self):
        clouds = [read_cloud(m) for m in self.replay(drive(semantics="probabilities"))]
        # What came is what a point gets: nothing is tempered. The bag holds 0 and 1 only.
        for cloud in clouds:
            confidence = cloud["confidence"][cloud["cameras"] == 1]
            self.assertGreater(len(confidence), 100)
            self.assertTrue((confidence == 1.0).all())

    def test_png(self):
        self.replay(drive(image_transport="compressed"))

    def test_jpeg_and_scores_blended_with_their_superpixels(self):
        self.replay(drive(image_transport="jpeg"), "uncertainty.blend=0.4")


if __name__ == "__main__":
    rospy.init_node("test_inputs")
    rostest.rosrun("semantic_lidar_fusion", "inputs", Inputs)
