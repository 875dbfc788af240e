#!/usr/bin/python3
# SPDX-License-Identifier: MIT
"""A lidar of 128 rings and 2048 columns at 20 Hz (262 144 points a scan) through fuse_bag and live.

Makes a drive through a room (test/python/bag_factory.py) with five JPEG cameras, fuses it, and plays it
in its own time through replay.launch over TCP, while one node listens to points_semantic. Prints

  offline   CPU time of a scan, and how long the drive takes beside how long it is
  live      scans that came out, CPU time and memory of the manager, what its summary says

Needs the package's environment (build/devel/setup.bash). Figures of a busy machine are too long.
"""

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import threading
import time
import xmlrpc.client

import numpy as np

SOURCE_DIR = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
sys.path.insert(0, os.path.join(SOURCE_DIR, "test", "python"))

from bag_factory import Camera, Drive, rig_text, write_bag  # noqa: E402
from load_live_map import processor_s  # noqa: E402

LIMITS = "lidar.max_range_m=80"


def make_parser():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scans", type=int, default=100)
    parser.add_argument("--rings", type=int, default=128)
    parser.add_argument("--columns", type=int, default=2048)
    parser.add_argument("--rate", type=float, default=20.0, help="scans a second (default: 20)")
    parser.add_argument("--cameras", type=int, default=5)
    parser.add_argument("--offline-only", action="store_true")
    parser.add_argument("--port", type=int, default=11913, help="of the master")
    return parser


def drive_of(options):
    """The drive: cameras of 640x480 with 10 images a second, spread around the vehicle."""
    headings = 2 * np.pi * np.arange(options.cameras) / options.cameras
    cameras = [
        Camera(
            "camera%d" % number,
            heading,
            (1.2 * np.cos(heading), 0.6 * np.sin(heading), 0.2),
            phase_ns=13_000_000 * number,
            period_ns=100_000_000,
            width=640,
            height=480,
            focal=220.0,
        )
        for number, heading in enumerate(headings)
    ]
    return Drive(
        scans=options.scans,
        rings=options.rings,
        points_per_scan=options.rings * options.columns,
        scan_ns=int(1e9 / options.rate),
        elevations_deg=(-25.0, 15.0),
        cameras=cameras,
        image_transport="jpeg",
        speed=2.0,
        yaw_rate=0.2,
    )


def offline(options, bag, rig, out):
    begin = time.perf_counter()
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(["fuse_bag", bag, out, "--rig", rig, "--quiet", "--set", LIMITS], check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    wall = time.perf_counter() - begin
    print(
        "offline: %.0f core-ms a scan, %.2f s of drive a s, %.0f MB"
        % (1e3 * cpu / options.scans, options.scans / options.rate / wall, after.ru_maxrss / 1024)
    )


def manager_figures(pid):
    """CPU time (s) so far and largest memory (MB) of a process."""
    with open("/proc/%d/status" % pid) as file:
        peak = next(line for line in file if line.startswith("VmHWM"))
    return processor_s(pid), int(peak.split()[1]) / 1024


def live(options, bag, rig):
    os.environ["ROS_MASTER_URI"] = "http://127.0.0.1:%d" % options.port
    os.environ["ROS_IP"] = "127.0.0.1"
    command = ["roslaunch", "-p", str(options.port), "semantic_lidar_fusion", "replay.launch"]
    command += ["bag:=" + bag, "rig:=" + rig, "exit:=true", "overrides:=" + LIMITS]
    launch = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    lines = []
    reader = threading.Thread(target=lambda: lines.extend(launch.stdout), daemon=True)
    reader.start()
    import rosgraph
    import rospy
    from diagnostic_msgs.msg import DiagnosticArray

    deadline = time.time() + 60
    while not rosgraph.is_master_online() and time.time() < deadline:
        time.sleep(0.1)
    rospy.init_node("listener", disable_signals=True)
    # Python may be too slow for what comes: the manager's own counters tell what it published.
    rospy.Subscriber("/points_semantic", rospy.AnyMsg, lambda message: None, buff_size=1 << 25)
    health = {}
    rospy.Subscriber(
        "/diagnostics",
        DiagnosticArray,
        lambda message: health.update(
            {s.name: {v.key: v.value for v in s.values} for s in message.status}
        ),
    )
    pid, figures = None, (0.0, 0.0)
    while launch.poll() is None:
        try:
            if pid is None:
                address = rosgraph.Master("/listener").lookupNode("/fusion_manager")
                pid = xmlrpc.client.ServerProxy(address).getPid("/listener")[2]
            else:
                figures = manager_figures(pid)
        except (OSError, StopIteration, IndexError, rosgraph.MasterException):
            pass  # the manager is not there yet, or has ended
        time.sleep(0.2)
    reader.join()
    projection = health.get("projection: fusion", {})
    came = int(projection.get("output /points_semantic messages", 0))
    print(
        "live: %d of %d scans came out; manager: %.0f core-ms a scan, %.0f MB"
        % (came, options.scans, 1e3 * figures[0] / max(came, 1), figures[1])
    )
    print("".join(line for line in lines if "finish_replay" in line or "dropped" in line).strip())
    return launch.returncode


def main():
    options = make_parser().parse_args()
    with tempfile.TemporaryDirectory() as folder:
        bag, rig = os.path.join(folder, "dense.bag"), os.path.join(folder, "rig.yaml")
        drive = drive_of(options)
        write_bag(bag, drive)
        with open(rig, "w") as file:
            file.write(rig_text(drive))
        offline(options, bag, rig, os.path.join(folder, "out.bag"))
        os.remove(os.path.join(folder, "out.bag"))
        return 0 if options.offline_only else live(options, bag, rig)


if __name__ == "__main__":
    sys.exit(main())
