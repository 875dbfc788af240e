#!/usr/bin/python3
# SPDX-License-Identifier: MIT
"""A real drive, imported and with a network's scores in the bag, gives, live, what fuse_bag gives,
and nothing is dropped. Skipped, saying so, without the data.

SLF_REPLAY_RATE=1 plays in real time, for a machine that does nothing else."""
import os
import subprocess
import sys

import numpy as np
import rosbag
import rospy
import rostest

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
import live  # noqa: E402

SHARED = os.environ.get("SLF_SHARED_DIR", os.path.join(live.SOURCE_DIR, "..", "shared"))
DRIVE = "data/kitti_drive"
NETWORK = "models/espnetv2_city20_1024x512.onnx"
CAMERA = "camera_02"
STRIDE = 8  # of the network before its last upsampling
RATE = float(os.environ.get("SLF_REPLAY_RATE", "0.25"))


def run(program, *arguments):
    path = os.path.join(os.environ["SLF_BIN_DIR"], program)
    subprocess.run([path] + list(arguments), check=True, timeout=200)


def with_scores(bare, fused, out):
    """Writes the bag `bare` with the scores of `fused`, at network stride, beside its images."""
    scores = {}
    with rosbag.Bag(fused) as bag:
        for _, message, _ in bag.read_messages(["/%s/scores" % CAMERA]):
            classes = int(message.encoding[len("32FC") :])
            values = np.frombuffer(message.data, np.float32)
            values = values.reshape(message.height, message.width, classes)
            cells = np.ascontiguousarray(values[STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE])
            message.height, message.width = cells.shape[:2]
            message.step, message.data = cells[0].nbytes, cells.tobytes()
            scores[message.header.stamp] = message
    with rosbag.Bag(bare) as source, rosbag.Bag(out, "w", compression="lz4") as target:
        for topic, message, time in source.read_messages():
            target.write(topic, message, time)
            if topic == "/%s/image/compressed" % CAMERA:
                target.write("/%s/scores" % CAMERA, scores[message.header.stamp], time)


class Kitti(live.ReplayCase):
    def test_replay_of_a_real_drive(self):
        for part in (DRIVE, NETWORK):
            if not os.path.exists(os.path.join(SHARED, part)):
                self.skipTest("optional data not found: " + part)
        with live.folder() as path:
            bare, fused, bag = (os.path.join(path, n + ".bag") for n in ("bare", "fused", "whole"))
            rig, model = os.path.join(path, "bare.yaml"), os.path.join(path, "model.yaml")
            name = os.path.basename(NETWORK)
            with open(os.path.join(live.SOURCE_DIR, "config/models/espnetv2_city20.yaml")) as file:
                text = file.read()
            self.assertIn("file: " + name, text)
            with open(model, "w") as file:
                network = os.path.abspath(os.path.join(SHARED, NETWORK))
                file.write(text.replace("file: " + name, "file: " + network))
            drive = os.path.join(SHARED, DRIVE)
            run("import_dataset.py", "kitti", drive, bare, "--last=5", "--model=" + model)
            run("fuse_bag", bare, fused, "--rig=" + rig, "--all", "--quiet")
            with_scores(bare, fused, bag)

            from_bag = ["segmentation.model="]
            offline = os.path.join(path, "offline.bag")
            run("fuse_bag", bag, offline, "--rig=" + rig, "--quiet", "--set=" + from_bag[0])
            with rosbag.Bag(offline) as source:
                clouds = [m for _, m, _ in source.read_messages(["/points_semantic"])]
            expected = {m.header.stamp.to_nsec(): m for m in clouds}
            self.assertEqual(len(expected), 6)
            with rosbag.Bag(bag) as source:
                topics = set(source.get_type_and_topic_info().topics)
            diagnostics = live.Diagnostics()
            reported = "output /points_semantic messages"

            def wait_for_report():
                count = str(len(expected))
                live.wait_until(
                    lambda: diagnostics.value("projection", reported) == count, "a report"
                )

            self.assert_replay_gives(
                expected, bag, rig, [], topics, rate=RATE, before_the_end=wait_for_report
            )
            dropped = {
                "%s: %s" % (nodelet, key): value
                for nodelet, values in diagnostics.values.items()
                for key, value in values.items()
                if key.startswith("dropped")
            }
            diagnostics.close()
            self.assertEqual(dropped, {})


if __name__ == "__main__":
    rospy.init_node("test_kitti")
    rostest.rosrun("semantic_lidar_fusion", "kitti", Kitti)
