#!/usr/bin/python3
# SPDX-License-Identifier: MIT
"""How fast fuse_bag is, beside what else would be done with a bag.

Needs bags of simulate_drive and the package's environment (build/devel/setup.bash). For each bag, in
s of bag per s of wall time, the best of several runs that take turns:

  one thread, two threads    fuse_bag --jobs 1 and 2
  three outputs              the paper's three configurations in one run with two threads
  plain chain                the same bag through rosbag, cv2.imdecode, a dense softmax of the scores,
                             cv2.fisheye.projectPoints and a look-up at each point: numpy and OpenCV
                             on what fuse_bag has compensated, without superpixels and occlusion

What rosbag play makes of it is 1. The CPU time of a scan does not depend on the load of the machine.
"""

import argparse
import json
import os
import resource
import subprocess
import tempfile
import time

import cv2
import numpy as np
import rosbag
from sensor_msgs.msg import Image

from semantic_lidar_fusion.bags.bag_io import BagReader
from semantic_lidar_fusion.bags.cloud_io import to_array
from semantic_lidar_fusion.bags.poses import TransformTree

PAPER = ["smoothing.iterations=0", "motion.granularity=firing"]
CONFIGURATIONS = {
    "direct": PAPER + ["motion.enabled=false", "occlusion.mode=off"],
    "motion": PAPER + ["occlusion.mode=off"],
    "motion_mask": PAPER + ["occlusion.mode=paper"],
}
CAMERAS = ("A0", "A1", "A2", "B0", "B1")  # of simulate_drive


def measured(work):
    """Wall and CPU time (s) of work(), its children included."""

    def cpu():
        both = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
        return sum(sum(resource.getrusage(who)[:2]) for who in both)

    begin, cpu_begin = time.perf_counter(), cpu()
    work()
    return time.perf_counter() - begin, cpu() - cpu_begin


def plain_chain(bag, fused, target):
    """Projects the compensated clouds of `fused` into the images of `bag`; the mean of the cameras'
    distributions goes to `target`."""
    with BagReader(bag) as reader:
        tree = TransformTree.from_bag(reader)
    clouds, chosen = [], {}
    with rosbag.Bag(fused) as results:
        for topic, message, _ in results.read_messages():
            if topic == "/points_compensated":
                clouds.append(to_array(message))
            elif topic.endswith("/selection"):
                key = (topic.split("/")[-2], message.time_ref.to_nsec())
                chosen.setdefault(key, []).append(len(clouds))
    lenses, images, sums, seen = {}, {}, {}, {}
    with rosbag.Bag(bag) as drive, rosbag.Bag(target, "w", compression="lz4") as out:
        for topic, message, _ in drive.read_messages():
            camera = topic.split("/")[2] if topic.startswith("/gmsl/") else ""
            if topic.endswith("/camera_info"):
                K, D = np.reshape(message.K, (3, 3)), np.array(message.D[:4])
                T = tree.static(message.header.frame_id, "velodyne_front_link")
                lenses[camera] = (K, D, T)
                continue
            key = (camera, message.header.stamp.to_nsec() if camera else 0)
            if key not in chosen:
                continue
            if topic.endswith("/compressed"):
                images[key] = cv2.imdecode(np.frombuffer(message.data, np.uint8), cv2.IMREAD_COLOR)
            if not topic.endswith("/scores") or key not in images:
                continue
            scores = np.frombuffer(message.data, np.float32)
            scores = scores.reshape(message.height, message.width, -1)
            weights = np.exp(scores - scores.max(axis=2, keepdims=True))
            dense = weights / weights.sum(axis=2, keepdims=True)
            height, width = images.pop(key).shape[:2]
            for index in chosen[key]:
                if index >= len(clouds):
                    continue
                points = clouds[index]
                K, D, T = lenses[camera]
                xyz = np.stack([points["x"], points["y"], points["z"]], 1).astype(np.float64)
                ahead = xyz @ T[:3, :3].T + T[:3, 3]
                front = np.flatnonzero(ahead[:, 2] > 0.1)
                uv, _ = cv2.fisheye.projectPoints(
                    ahead[front, None, :], np.zeros(3), np.zeros(3), K, D
                )
                u, v = np.floor(uv[:, 0] + 0.5).astype(int).T
                inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
                rows = v[inside] * dense.shape[0] // height
                columns = u[inside] * dense.shape[1] // width
                total = sums.setdefault(index, np.zeros((len(points), dense.shape[2]), np.float32))
                total[front[inside]] += dense[rows, columns]
                count = seen.setdefault(index, [0])
                count[0] += 1
                if count[0] == len(CAMERAS):
                    total = sums.pop(index)
                    cloud = Image(height=1, width=len(points), encoding="32FC%d" % total.shape[1])
                    cloud.data = (total / np.maximum(total.sum(1, keepdims=True), 1e-9)).tobytes()
                    out.write("/points", cloud)
    if len(seen) < len(clouds) - 1:
        raise SystemExit("benchmark_fuse_bag: the plain chain has lost scans")


def drive_seconds(fused):
    """What the scans last: their number times their period."""
    with rosbag.Bag(fused) as bag:
        times = [time.to_sec() for _, _, time in bag.read_messages("/scan_reference")]
    return (times[-1] - times[0]) * len(times) / (len(times) - 1), len(times)


def rows_of(bag, program, rig, repetitions, folder):
    out = os.path.join(folder, "out.bag")

    def fuse(*options):
        command = [program, bag, out, "--rig", rig, "--quiet", "--force"]
        subprocess.run(command + list(options), check=True, stdout=subprocess.DEVNULL)

    three = []
    for number, values in enumerate(CONFIGURATIONS.values()):
        three += ["--also", os.path.join(folder, "%d.bag" % number)] if number else []
        three += [argument for value in values for argument in ("--set", value)]
    fused = os.path.join(folder, "fused.bag")
    fuse()
    os.replace(out, fused)
    works = {
        "one thread": lambda: fuse("--jobs", "1"),
        "two threads": lambda: fuse("--jobs", "2"),
        "three outputs": lambda: fuse("--jobs", "2", *three),
        "plain chain": lambda: plain_chain(bag, fused, os.path.join(folder, "plain.bag")),
    }
    times = {name: [] for name in works}
    for _ in range(repetitions):
        for name, work in works.items():
            times[name].append(measured(work))
    seconds, scans = drive_seconds(fused)
    return {
        name: {
            "speed": seconds / min(wall for wall, _ in runs),
            "cpu_ms_per_scan": 1e3 * min(cpu for _, cpu in runs) / scans,
        }
        for name, runs in times.items()
    }


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("bags", nargs="+", metavar="NAME=BAG", help="named bags of simulate_drive")
    parser.add_argument("--fuse-bag", required=True, help="the program")
    parser.add_argument("--rig", required=True, help="config/demo.yaml")
    parser.add_argument("--repetitions", type=int, default=3)
    parser.add_argument("--json", help="also write the figures here")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    result = {}
    for entry in arguments.bags:
        name, _, bag = entry.partition("=")
        with tempfile.TemporaryDirectory() as folder:
            result[name] = rows_of(
                bag, arguments.fuse_bag, arguments.rig, arguments.repetitions, folder
            )
        for row, figures in result[name].items():
            print(
                "%-12s %-14s %6.2f s of bag per s, %6.1f core-ms a scan"
                % (name, row, figures["speed"], figures["cpu_ms_per_scan"])
            )
    if arguments.json:
        with open(arguments.json, "w") as file:
            json.dump(result, file, indent=1)


if __name__ == "__main__":
    main()
