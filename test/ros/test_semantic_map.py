#!/usr/bin/python3
# SPDX-License-Identifier: MIT
"""The live map: what it publishes, what it saves, and what it does without tf."""
import glob
import json
import os
import subprocess
import threading
import sys
import time
import unittest

import numpy as np
import rospy
import rostest

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
import live  # noqa: E402

sys.path.insert(0, os.path.join(live.SOURCE_DIR, "scripts"))
sys.path += glob.glob(os.path.join(os.environ["SLF_BIN_DIR"], "..", "python3*", "dist-packages"))

from live import wait_until  # noqa: E402
from nav_msgs.msg import OccupancyGrid  # noqa: E402
from sensor_msgs.msg import PointCloud2  # noqa: E402
from std_msgs.msg import String  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402
from tf2_msgs.msg import TFMessage  # noqa: E402

from semantic_lidar_fusion.bags.cloud_io import from_array, point_dtype, to_array  # noqa: E402
from semantic_lidar_fusion.bags.cloud_io import SemanticCloud  # noqa: E402
from semantic_lidar_fusion.labels import LabelSet  # noqa: E402
from semantic_lidar_fusion.bags.poses import to_message  # noqa: E402
from semantic_lidar_fusion.maps.semantic_map import MapConfig, VoxelMap  # noqa: E402
from semantic_lidar_fusion.maps.map_file import MapReader  # noqa: E402

CLASSES = {
    "classes": [
        {"name": "road", "color": [128, 64, 128]},
        {"name": "building", "color": [70, 70, 70]},
        {"name": "car", "color": [0, 0, 142], "dynamic": True},
    ]
}
LABELS = LabelSet.from_class_info(CLASSES)
UTM = np.array([331000.0, 6250000.0, 0.0])
NODE = "semantic_map"
START_NS = 1600000000 * 10**9
STEP_NS = 10**8


def pose_at(number):
    """T_odom_lidar of scan `number`: 1 m forward each."""
    pose = np.eye(4)
    pose[:3, 3] = UTM + [number, 0.0, 1.7]
    return pose


def scan(number):
    """Road below, a wall 6 m to the left, one car ahead; as a points_semantic message."""
    x, y = np.meshgrid(np.arange(-8, 8, 0.1), np.arange(-5, 5, 0.1))
    road = np.stack([x.ravel(), y.ravel(), np.full(x.size, -1.7)], axis=1)
    x, z = np.meshgrid(np.arange(-8, 8, 0.1), np.arange(-1.5, 2, 0.1))
    wall = np.stack([x.ravel(), np.full(x.size, 6.05), z.ravel()], axis=1)
    y, z = np.meshgrid(np.arange(-1, 1, 0.1), np.arange(-1.3, 0, 0.1))
    car = np.stack([np.full(y.size, 7.05), y.ravel(), z.ravel()], axis=1)
    xyz = np.concatenate([road, wall, car])
    label = np.repeat([0, 1, 2], [len(road), len(wall), len(car)])
    fields = [(name, "f4") for name in ("x", "y", "z", "intensity")]
    fields += [("label", "u1"), ("status", "u1")] + [("p_" + n, "f4") for n in LABELS.names]
    points = np.zeros(len(xyz), dtype=point_dtype(fields))
    for column, axis in enumerate("xyz"):
        points[axis] = xyz[:, column]
    points["label"] = label
    for number_of_class, name in enumerate(LABELS.names):
        points["p_" + name] = np.where(label == number_of_class, 0.9, 0.05)
    return from_array(points, START_NS + number * STEP_NS, "velodyne")


class Input:
    """Publishes clouds and tf by itself."""

    def __init__(self):
        self.info = rospy.Publisher("/class_info", String, queue_size=1, latch=True)
        self.clouds = rospy.Publisher("/points_semantic", PointCloud2, queue_size=20)
        self.tf = rospy.Publisher("/tf", TFMessage, queue_size=100)
        self.info.publish(json.dumps(CLASSES))
        wait_until(
            lambda: self.clouds.get_num_connections() and self.tf.get_num_connections(),
            "the node to subscribe",
            90.0,
        )

    def send_tf(self, number):
        stamp_ns = START_NS + number * STEP_NS
        self.tf.publish(TFMessage([to_message("odom", "velodyne", pose_at(number), stamp_ns)]))

    def send(self, number):
        self.clouds.publish(scan(number))


def offline(numbers, **options):
    """What the map must be, mapped here."""
    voxels = VoxelMap(MapConfig(voxel_size_m=0.2, max_range_m=50.0, **options), LABELS)
    for number in numbers:
        voxels.integrate(SemanticCloud.from_message(scan(number)), pose_at(number))
    return voxels


class SemanticMap(unittest.TestCase):
    def setUp(self):
        self.said = live.Said()
        self.diagnostics = live.Diagnostics()

    def tearDown(self):
        self.diagnostics.close()

    def value(self, key):
        return self.diagnostics.value(NODE, key)

    def wait_mapped(self, count):
        wait_until(
            lambda: self.value("clouds mapped") == str(count),
            lambda: "%d clouds mapped: %s" % (count, self.diagnostics.text()),
        )

    def test_grid_cloud_and_services(self):
        with live.folder() as path, live.launched(
            "semantic_map.launch",
            window_m=20,
            grid_period_s=0.2,
            cloud_period_s=0.2,
            save_folder=path,
            save_formats="ply",
            max_saves=5,
        ):
            source = Input()
            grids = live.Received("/semantic_grid", OccupancyGrid)
            clouds = live.Received("/semantic_map", PointCloud2)
            for number in range(3):
                source.send_tf(number)
                source.send(number)
            self.wait_mapped(3)
            # A late subscriber gets the latched grid.
            late = live.Received("/semantic_grid", OccupancyGrid)
            grid = late.wait_for(1)[0]
            self.assertEqual(grid.header.frame_id, "odom")
            cells = np.array(grid.data).reshape(grid.info.height, grid.info.width)

            def cell(x, y):
                origin = grid.info.origin.position
                column = int(np.floor((UTM[0] + x - origin.x) / grid.info.resolution))
                row = int(np.floor((UTM[1] + y - origin.y) / grid.info.resolution))
                return cells[row, column]

            self.assertEqual(cell(1.03, 0.03), 0)
            self.assertEqual(cell(1.03, 6.05), 100)
            self.assertEqual(cell(1.03, 9.0), -1)
            wait_until(lambda: len(clouds), "a map cloud")
            wait_until(
                # Without the car's earlier places, through which later rays have passed.
                lambda: 0.9 < len(to_array(clouds.messages[-1])) / len(offline(range(3))) <= 1.0,
                "the cloud to hold the voxels",
            )
            points = to_array(clouds.messages[-1])
            self.assertEqual(set(np.unique(points["label"])), {0, 1, 2})
            self.assertEqual(set(np.unique(points["layer"])), {0, 1})

            saved = rospy.ServiceProxy("/%s/save" % NODE, Trigger)()
            self.assertTrue(saved.success, saved.message)
            records = MapReader(os.path.join(saved.message, "map.voxels")).records()
            self.assertEqual(records.tobytes(), offline(range(3)).records().tobytes())
            self.assertTrue(os.path.exists(os.path.join(saved.message, "map.ply")))

            self.assertTrue(rospy.ServiceProxy("/%s/clear" % NODE, Trigger)().success)
            wait_until(lambda: self.value("voxels") == "0", "an empty map")
            empty = rospy.ServiceProxy("/%s/save" % NODE, Trigger)()
            self.assertFalse(empty.success)

            # The window rolls: what is far behind is forgotten.
            for number in (0, 100):
                source.send_tf(number)
                source.send(number)
            self.wait_mapped(2)
            wait_until(
                lambda: self.value("voxels") == str(len(offline([100]))), "only the new place"
            )
            # It is saved with the whole drive, and every caller of many gets a folder of its own.
            answers = []

            def save():
                answers.append(rospy.ServiceProxy("/%s/save" % NODE, Trigger)())

            threads = [threading.Thread(target=save) for _ in range(3)]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join(60.0)
            self.assertEqual([a.success for a in answers], [True] * 3, answers)
            self.assertEqual(len({a.message for a in answers}), 3)
            whole = offline([0, 100]).records()
            for answer in answers:
                records = MapReader(os.path.join(answer.message, "map.voxels")).records()
                self.assertEqual(records.tobytes(), whole.tobytes())
            # ~max_saves is 5: with the first one, these are four.
            self.assertTrue(rospy.ServiceProxy("/%s/save" % NODE, Trigger)().success)
            refused = rospy.ServiceProxy("/%s/save" % NODE, Trigger)()
            self.assertFalse(refused.success)
            self.assertIn("max_saves", refused.message)
            for received in (grids, late, clouds):
                received.close()

    def test_tf_late_and_missing(self):
        with live.launched("semantic_map.launch", grid_period_s=0.2):
            source = Input()
            source.send_tf(0)
            source.send(0)
            self.wait_mapped(1)
            # Later than the cloud, but in time.
            source.send(1)
            time.sleep(0.2)
            source.send_tf(1)
            self.wait_mapped(2)
            # Never: counted, named, and the next one is mapped.
            source.send(2)
            wait_until(lambda: self.value("dropped, tf late") == "1", self.diagnostics.text)
            self.said.wait_for(r"no tf from velodyne to odom")
            source.send_tf(3)
            source.send(3)
            self.wait_mapped(3)
            # Before the first tf there is.
            source.send(-1)
            wait_until(lambda: self.value("dropped, tf past") == "1", self.diagnostics.text)
            # A pose that is absurd, though finite, ends nothing.
            far = np.eye(4)
            far[0, 3] = 1e12
            stamp_ns = START_NS + 4 * STEP_NS
            source.tf.publish(TFMessage([to_message("odom", "velodyne", far, stamp_ns)]))
            source.send(4)
            wait_until(lambda: self.value("dropped, bad pose") == "1", self.diagnostics.text)
            broken = scan(3)
            broken.data = broken.data[:-1]
            source.clouds.publish(broken)
            wait_until(lambda: self.value("dropped, bad cloud") == "1", self.diagnostics.text)
            source.send(3)
            self.wait_mapped(4)

    def test_wrong_parameters_are_told_whole(self):
        # Not by roslaunch, for which a node that refuses has died.
        script = os.path.join(live.SOURCE_DIR, "scripts", "semantic_map_node.py")
        wrong = ["_weight:=7", "_windwo_m:=3", "_voxel_size_m:=0", "__name:=refusing"]
        done = subprocess.run(
            ["/usr/bin/python3", script] + wrong, stderr=subprocess.PIPE, timeout=60
        )
        self.assertEqual(done.returncode, 1)
        for word in ("weight = 7", "windwo_m", "voxel_size_m"):
            self.assertIn(word, done.stderr.decode())

    def test_build_script_maps_a_live_topic(self):
        with live.folder() as path:
            out = os.path.join(path, "map")
            script = os.path.join(live.SOURCE_DIR, "scripts", "build_semantic_map.py")
            process = subprocess.Popen(
                ["/usr/bin/python3", script, "--live", "/points_semantic", "--out", out]
                + ["--max-range", "50", "--formats", "npz", "--duration", "60"]
            )
            try:
                source = Input()
                for number in range(3):
                    source.send_tf(number)
                    source.send(number)
                time.sleep(2.0)
                live._stop(process, 30.0)
            finally:
                if process.poll() is None:
                    process.kill()
            self.assertEqual(process.returncode, 0)
            records = MapReader(os.path.join(out, "map.voxels")).records()
            self.assertEqual(records.tobytes(), offline(range(3)).records().tobytes())


if __name__ == "__main__":
    rospy.init_node("test_semantic_map")
    rostest.rosrun("semantic_lidar_fusion", "live_map", SemanticMap)
