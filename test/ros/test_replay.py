#!/usr/bin/python3
# SPDX-License-Identifier: MIT
"""A bag played through the launch files gives, scan by scan, what fuse_bag gives."""
import os
import sys

import rospy
import rostest

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
import live  # noqa: E402
from bag_factory import Drive  # noqa: E402
from sensor_msgs.msg import PointCloud2  # noqa: E402


# Only images with scores are chosen from, as replay.launch says of bags that hold scores.
PATIENCE = live.patience() + ["segmentation.mode=free_running"]


class ReplayEqualsOffline(live.ReplayCase):
    def replay(self, drive, overrides=()):
        overrides = PATIENCE + list(overrides)
        with live.folder() as path:
            made = live.Made(path, drive)
            expected = made.fused(*overrides)
            self.assertEqual(len(expected), drive.scans)
            self.assert_replay_gives(expected, made.bag, made.rig, overrides, made.topics())

    def test_points(self):
        self.replay(Drive(scans=6, cameras=live.cameras(), points_per_scan=3200))

    def test_images_that_end_before_the_middle_of_the_last_scan(self):
        """Live a timeout decides its t_ref, offline the end of the bag: by one rule."""
        drive = Drive(
            scans=4, cameras=live.cameras(), points_per_scan=1600, images_until_s=0.1 + 0.3 + 0.045
        )
        last_middle = (drive.scan_start_ns(3) + drive.scan_start_ns(4)) // 2
        images = drive.image_stamps_ns(drive.cameras[0])
        self.assertLess(images[-1], last_middle)
        overrides = ["cameras.%s.timeout=3" % name for name in ("front", "left")]
        overrides += ["odometry.timeout=20", "segmentation.mode=free_running"]
        with live.folder() as path:
            made = live.Made(path, drive)
            expected = made.fused(*overrides)
            self.assertEqual(len(expected), drive.scans)
            self.assertIn(images[-1], expected)  # t_ref of the last scan
            self.assert_replay_gives(expected, made.bag, made.rig, overrides, made.topics())

    def test_packets_without_velodyne_msgs(self):
        """And with rows of the images that each side finds for itself."""
        drive = Drive(scans=4, cameras=live.cameras(), lidar="packets")
        rows = ["lidar.model=VLP16", "lidar.frame=velodyne"]
        rows += ["cameras.%s.lidar_rows=auto" % camera.name for camera in drive.cameras]
        self.replay(drive, rows)

    def test_second_pass_of_the_bag_gives_the_same(self):
        """The clock and all stamps jump back; nothing of the first pass is left in the second."""
        with live.folder() as path:
            drive = Drive(scans=14, cameras=live.cameras(), points_per_scan=1600)
            made = live.Made(path, drive)
            expected = made.fused(*PATIENCE)
            rospy.set_param("/use_sim_time", True)
            semantic = live.Received("/points_semantic", PointCloud2)
            overrides = " ".join(PATIENCE)
            with live.launched("fusion.launch", rig=made.rig, bond="false", overrides=overrides):
                for _ in range(2):
                    semantic.clear()
                    with live.played(made.bag, "--rate=%s" % live.RATE) as player:
                        live.wait_for_chain(made.topics(), "/player")
                        live.resume()
                        received = semantic.wait_for(drive.scans)
                        live.wait_until(lambda: player.poll() is not None, "the end of the bag")
                    self.assert_same(expected, received)
            semantic.close()


if __name__ == "__main__":
    rospy.init_node("test_replay")
    rostest.rosrun("semantic_lidar_fusion", "replay_equals_offline", ReplayEqualsOffline)
