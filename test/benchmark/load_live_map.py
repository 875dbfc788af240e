#!/usr/bin/python3
# SPDX-License-Identifier: MIT
"""Processor time of semantic_map_node.py under load: starts a master and the node, publishes scans
of a made-up street with tf, and prints what the node took for each second of the drive.

Without enough of the machine fewer scans arrive in time; the time per scan still tells. Source the
build's setup.bash first."""
import argparse
import json
import os
import signal
import subprocess
import sys
import time

import numpy as np

SOURCE_DIR = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
sys.path.insert(0, os.path.join(SOURCE_DIR, "scripts"))

from semantic_lidar_fusion.bags.cloud_io import from_array, point_dtype  # noqa: E402
from semantic_lidar_fusion.labels import LabelSet, package_file  # noqa: E402
from semantic_lidar_fusion.bags.poses import to_message  # noqa: E402

RINGS, COLUMNS = 16, 1875  # 30 000 points


def street(labels, random):
    """One scan: ground 1.8 m below, houses 8 m to both sides; with noise."""
    azimuth = np.repeat(np.arange(COLUMNS) * 2 * np.pi / COLUMNS, RINGS)
    elevation = np.radians(np.tile(np.arange(RINGS) * 2.0 - 15.0, COLUMNS))
    across = np.maximum(np.abs(np.sin(azimuth)) * np.cos(elevation), 1e-6)
    distance = np.minimum(60.0, 8.0 / across)
    down = np.where(elevation < 0, 1.8 / np.maximum(np.sin(-elevation), 1e-6), np.inf)
    label = np.where(down < distance, labels.id_of("road"), labels.id_of("building"))
    distance = np.minimum(distance, down) + random.normal(0, 0.02, len(azimuth))
    fields = [(name, "f4") for name in ("x", "y", "z", "intensity")] + [("ring", "u2")]
    fields += [("dt", "f4"), ("rgb", "f4"), ("label", "u1"), ("confidence", "f4")]
    fields += [("entropy", "f4"), ("cameras", "u2"), ("status", "u1")]
    fields += [("p_" + name, "f4") for name in labels.names]
    points = np.zeros(len(azimuth), dtype=point_dtype(fields))
    points["x"] = distance * np.cos(elevation) * np.cos(azimuth)
    points["y"] = distance * np.cos(elevation) * np.sin(azimuth)
    points["z"] = distance * np.sin(elevation)
    points["label"] = label
    p = random.dirichlet(np.full(len(labels), 0.5), len(azimuth)) * 0.3
    p[np.arange(len(label)), label] += 0.7
    for number, name in enumerate(labels.names):
        points["p_" + name] = p[:, number]
    return points


def processor_s(pid):
    with open("/proc/%d/stat" % pid) as file:
        fields = file.read().rsplit(") ", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scans", type=int, default=300)
    parser.add_argument("--rate", type=float, default=10.0, help="scans a second (default: 10)")
    parser.add_argument("--speed", type=float, default=10.0, help="m/s (default: 10)")
    parser.add_argument("--rays", type=float, default=45.0, help="~ray_range_m, m (default: 45)")
    parser.add_argument("--port", type=int, default=11897, help="of the master")
    options = parser.parse_args()
    os.environ["ROS_MASTER_URI"] = "http://127.0.0.1:%d" % options.port
    os.environ["ROS_IP"] = "127.0.0.1"
    import rospy
    from diagnostic_msgs.msg import DiagnosticArray
    from sensor_msgs.msg import PointCloud2
    from std_msgs.msg import String
    from tf2_msgs.msg import TFMessage

    script = os.path.join(SOURCE_DIR, "scripts", "semantic_map_node.py")
    master = subprocess.Popen(["rosmaster", "--core", "-p", str(options.port)])
    time.sleep(2.0)
    node = subprocess.Popen(
        ["/usr/bin/python3", script, "_tf_timeout_s:=5.0", "_ray_range_m:=%g" % options.rays]
    )
    try:
        rospy.init_node("load", disable_signals=True)
        labels = LabelSet.from_file(package_file("config/classes_usyd12.yaml"))
        info = rospy.Publisher("class_info", String, queue_size=1, latch=True)
        tree = labels.tree()
        info.publish(json.dumps({"classes": tree["classes"]}))
        clouds = rospy.Publisher("points_semantic", PointCloud2, queue_size=20)
        tf = rospy.Publisher("/tf", TFMessage, queue_size=100)
        values = {}

        def on_diagnostics(message):
            for status in message.status:
                values.update({pair.key: pair.value for pair in status.values})

        rospy.Subscriber("/diagnostics", DiagnosticArray, on_diagnostics)
        random = np.random.default_rng(1)
        scans = [street(labels, random) for _ in range(5)]
        while not (clouds.get_num_connections() and tf.get_num_connections()):
            time.sleep(0.1)
        time.sleep(2.0)
        before, start = processor_s(node.pid), time.monotonic()
        for number in range(options.scans):
            seconds = number / options.rate
            for tenth in range(10):  # odometry at ten times the rate of the scans
                at = seconds + (tenth - 9) / (10 * options.rate)
                pose = np.eye(4)
                pose[0, 3], pose[2, 3] = options.speed * at, 1.8
                stamp_ns = int(1e18 + at * 1e9)
                tf.publish(TFMessage([to_message("odom", "velodyne", pose, stamp_ns)]))
            clouds.publish(from_array(scans[number % 5], int(1e18 + seconds * 1e9), "velodyne"))
            time.sleep(max(0.0, start + (number + 1) / options.rate - time.monotonic()))
        wall = time.monotonic() - start
        # What still waits counts, too.
        while values.get("clouds mapped") != str(options.scans) and time.monotonic() < start + 300:
            time.sleep(0.2)
        used = processor_s(node.pid) - before
        print(
            "%d scans of %d points in %.1f s: %.2f s of processor, %.1f ms a scan, %.3f of a core"
            % (options.scans, RINGS * COLUMNS, wall, used, 1e3 * used / options.scans, used / wall)
        )
        for name in ("clouds mapped", "voxels", "map memory (MB)"):
            print("%s: %s" % (name, values.get(name)))
    finally:
        for process in (node, master):
            process.send_signal(signal.SIGINT)
            process.wait(timeout=20)


if __name__ == "__main__":
    main()
