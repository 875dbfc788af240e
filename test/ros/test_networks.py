#!/usr/bin/python3
# SPDX-License-Identifier: MIT
"""Scores of a network, an external one or the package's own, give what fuse_bag gives."""
import os
import sys

import rosbag
import rospy
import rostest

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
import live  # noqa: E402
import onnx_factory  # noqa: E402
from bag_factory import CLASS_COLORS, CLASS_NAMES, Drive, read_cloud  # noqa: E402

FREE_RUNNING = ["segmentation.mode=free_running"]
ON_REQUEST = ["segmentation.mode=on_request"]


def drive(**changes):
    return Drive(scans=4, cameras=live.cameras(), points_per_scan=3200, **changes)


def scores_of(made):
    """Camera -> stamp in ns -> scores, of all images of a bag."""
    answers = {camera.name: {} for camera in made.drive.cameras}
    with rosbag.Bag(made.bag) as bag:
        for topic, message, _ in bag.read_messages():
            if topic.endswith("/scores"):
                answers[topic.split("/")[1]][message.header.stamp.to_nsec()] = message
    return answers


class Networks(live.ReplayCase):
    def external_network(self, mode, images, latency_s):
        """A bag without scores, and another node that makes them."""
        with live.folder() as path:
            whole = live.Made(path, drive(), name="whole")
            bare = live.Made(path, drive(semantics="none"), name="bare")
            expected = whole.fused(*live.patience())
            network = live.Network(scores_of(whole), images, latency_s)
            try:
                self.assert_replay_gives(
                    expected,
                    bare.bag,
                    bare.rig,
                    live.patience() + ["reference.timeout=20"] + mode,
                    bare.topics(),
                    network=network,
                )
            finally:
                network.close()
            return network, bare

    def test_external_network_on_request_with_latency(self):
        network, bare = self.external_network(ON_REQUEST, "/%s/image_selected", 0.3)
        for asked in network.asked.values():
            self.assertEqual(len(asked), bare.drive.scans, "one image for each scan")
            self.assertEqual(len(set(asked)), len(asked), "an image is asked for twice")

    def test_external_free_running_network_with_latency(self):
        network, bare = self.external_network(FREE_RUNNING, "/%s/image", 0.3)
        for camera in bare.drive.cameras:
            self.assertGreater(len(network.asked[camera.name]), 2 * bare.drive.scans)

    def test_the_packages_own_network(self):
        with live.folder() as path:
            a_drive = drive(semantics="none")
            size = a_drive.cameras[0].width, a_drive.cameras[0].height
            made = live.Made(path, a_drive, "segmentation: {model: model.yaml}\n")
            # Twice the colour of the class times the pixel, less the colour's square: the nearest
            # colour has the highest score.
            weights = [[2.0 * value for value in color] for color in CLASS_COLORS]
            bias = [-float(sum(value * value for value in color)) for color in CLASS_COLORS]
            with open(os.path.join(path, "net.onnx"), "wb") as file:
                file.write(onnx_factory.convolution(*size, weights, bias))
            with open(os.path.join(path, "model.yaml"), "w") as file:
                file.write(
                    "file: net.onnx\ninput: {width: %d, height: %d, channels: rgb, scale: 1}\n"
                    % size
                    + "classes: {%s}\n"
                    % ", ".join("%s: [%d]" % item for item in zip(CLASS_NAMES, range(4)))
                )
            patience = live.patience() + ["reference.timeout=20"]
            expected = made.fused(*patience)
            # An image is superseded by the next of its camera if the network has not taken it.
            clouds = self.assert_replay_gives(
                expected,
                made.bag,
                made.rig,
                patience,
                made.topics(),
                rate=live.RATE / 4,
                segmentation="true",
            )
            for cloud in map(read_cloud, clouds):
                self.assertLessEqual({0, 1}, set(cloud["label"][cloud["status"] == 0]))


if __name__ == "__main__":
    rospy.init_node("test_networks")
    rostest.rosrun("semantic_lidar_fusion", "networks", Networks)
