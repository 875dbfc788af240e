#!/usr/bin/python3
# SPDX-License-Identifier: MIT
"""demo.launch makes a drive of packets and five cameras, plays it, and evaluates what comes out;
clouds and table are those of fuse_bag and evaluate.py."""
import os
import subprocess
import sys

import rosbag
import rospy
import rostest

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
import live  # noqa: E402

RIG = os.path.join(live.SOURCE_DIR, "config", "demo.yaml")
CAMERAS = ("A0", "A1", "A2", "B0", "B1")
# Slow and patient: what counts is the result, not whether the machine keeps up.
OVERRIDES = live.patience(CAMERAS) + ["reference.timeout=0.5", "occlusion.depth_margin_m=0.25"]
CLOUD_TOPICS = ("points_semantic", "/points_semantic")


def clouds_of(path):
    with rosbag.Bag(path) as bag:
        return {m.header.stamp.to_nsec(): m for _, m, _ in bag.read_messages(CLOUD_TOPICS)}


def run(program, *arguments):
    path = os.path.join(os.environ["SLF_BIN_DIR"], program)
    subprocess.run([path] + list(arguments), check=True, timeout=100)


class Demo(live.ReplayCase):
    def test_demo_evaluates_what_it_shows(self):
        if not os.path.exists(os.path.join(os.environ["SLF_BIN_DIR"], "simulate_drive")):
            self.skipTest("simulate_drive is not built: it needs Embree")
        with live.folder() as path:
            bag, recorded = os.path.join(path, "drive.bag"), os.path.join(path, "live.bag")
            online, offline = os.path.join(path, "online"), os.path.join(path, "offline")
            with live.launched(
                "demo.launch",
                bag=bag,
                simulate="--duration 0.6 --scale 0.15 --quiet",
                rviz="false",
                rate=0.2,
                record=recorded,
                evaluate="true",
                evaluation_folder=online,
                overrides=" ".join(OVERRIDES),
            ) as launch:
                live.wait_until(lambda: launch.poll() is not None, "the end of the demo", 700.0)
            settings = ["--set=" + override for override in OVERRIDES]
            fused = os.path.join(path, "fused.bag")
            free_running = "--set=segmentation.mode=free_running"
            run("fuse_bag", bag, fused, "--rig=" + RIG, "--quiet", free_running, *settings)
            self.assert_same(clouds_of(fused), list(clouds_of(recorded).values()))
            self.assertEqual(len(clouds_of(fused)), 6)

            clouds = "--clouds=package=" + fused
            run("evaluate.py", bag, "--rig=" + RIG, clouds, "--out=" + offline, *settings)
            for name in ("table1.csv", "summary.csv", "confusion_package.csv"):
                with open(os.path.join(online, name)) as a, open(os.path.join(offline, name)) as b:
                    self.assertEqual(a.read(), b.read(), name)


if __name__ == "__main__":
    rospy.init_node("test_demo")
    rostest.rosrun("semantic_lidar_fusion", "demo", Demo)
