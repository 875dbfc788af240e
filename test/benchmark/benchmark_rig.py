#!/usr/bin/python3
# SPDX-License-Identifier: MIT
"""The whole rig under load: CPU time of the nodelet manager per scan, latency, memory, lost scans.

Needs a bag of simulate_drive and the package's environment (build/devel/setup.bash). Starts a ROS
master of its own. Rows:

  pointers    the player is in the manager: raw images, messages pass by pointer
  late        the same, but scores come 120 ms after their image, when the scan is there already
  tcp         the player is another process: JPEG images, everything passes over TCP

A scan counts as lost if no cloud comes out, or one without a point of every camera. The latency is
from the moment that the scan, its odometry and the scores of its images are delivered until the cloud
is there. The CPU time is that of the process less what the player uses: playing to nobody, and copies
of messages that are still held when they are to be played again.
"""

import argparse
import contextlib
import json
import os
import shutil
import socket
import subprocess
import sys
import tempfile

SCAN_PERIOD = 0.1
WARM_UP = 2.0  # s at the start that do not count
SUPERPIXEL_WIDTH = 640
GOALS = {"cpu_ms_per_scan": (50.0, 25.0)}  # must, aim


def fail(text):
    sys.exit("benchmark_rig: " + text)


@contextlib.contextmanager
def master():
    """A ROS master on a free port as long as the block runs; yields the environment."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    environment = dict(os.environ, ROS_MASTER_URI="http://127.0.0.1:%d" % port, ROS_IP="127.0.0.1")
    program = shutil.which("rosmaster") or fail("rosmaster is not installed")
    process = subprocess.Popen(
        ["/usr/bin/python3", program, "--core", "-p", str(port)],
        env=environment,
        stdout=subprocess.DEVNULL,
    )
    try:
        for _ in range(600):
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", port)) == 0:
                    break
            try:
                process.wait(0.1)
                fail("rosmaster does not run")
            except subprocess.TimeoutExpired:
                pass
        yield environment
    finally:
        process.terminate()
        process.wait()


def write_rig(source, path, transport, image_width):
    """The rig file with another transport, and superpixels 640 pixels wide."""
    with open(source) as file:
        text = file.read()
    folder = os.path.dirname(os.path.abspath(source))
    text = text.replace("file: ", "file: %s/" % folder)
    text = text.replace("transport: compressed", "transport: " + transport)
    text += "superpixels:\n  scale: %.6f\n" % min(1.0, (SUPERPIXEL_WIDTH + 0.01) / image_width)
    with open(path, "w") as file:
        file.write(text)


def start(program, environment, role, rig, out, *arguments):
    """Starts the program and waits until it is ready."""
    command = [program, "--role", role, "--rig", rig, "--out", out] + list(arguments)
    process = subprocess.Popen(
        command,
        env=environment,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        universal_newlines=True,
    )
    for line in process.stdout:
        if line.strip() == "ready":
            return process
    fail("%s ended with %d" % (" ".join(command), process.wait()))


def finish(process, out):
    """Waits for its end and returns its log."""
    process.communicate()
    if process.returncode != 0:
        fail("rig_benchmark ended with %d" % process.returncode)
    with open(out) as file:
        return json.load(file)


def quantile(values, share):
    values = sorted(values)
    return values[min(len(values) - 1, int(share * len(values)))] if values else float("nan")


def between(samples, begin, end):
    """Those whose moment, their first entry, lies between two."""
    return [s for s in samples if begin <= s[0] <= end]


def cpu_per_scan(log, begin, end):
    """CPU time (ms) of the process per scan period between two moments (ns)."""
    samples = between(log["samples"], begin, end)
    if len(samples) < 2:
        fail("played for too short a time; at least 5 s are needed")
    seconds = 1e-9 * (samples[-1][0] - samples[0][0])
    return 1e-6 * (samples[-1][1] - samples[0][1]) / seconds * SCAN_PERIOD


def evaluate(manager, player_log, alone, shared):
    """One row of figures from the logs of manager and player; `shared`: they are one process."""
    player = player_log["player"]
    begin = player["start"] + int(1e9 * WARM_UP)
    deliveries = player["deliveries"]
    end = max(d[3] for d in deliveries)
    odometry = sorted((d[1], d[3]) for d in deliveries if d[0] == "odometry")
    scores = {(d[0], d[1]): d[3] for d in deliveries if d[0] not in ("odometry", "scan")}
    cameras = {d[0] for d in deliveries if d[0] not in ("odometry", "scan")}
    scans = sorted((d[1], d[2], d[3]) for d in deliveries if d[0] == "scan")
    arrival = {r[0]: r for r in manager["results"]}
    decisions = {}
    for what, scan, chosen in manager["decisions"]:
        decisions.setdefault(scan, {})[what] = chosen

    latencies, lost, fused = [], 0, []
    counted = [s for s in scans if begin <= s[2] and s[2] < end - int(2.5e8)]
    for first, until, delivered in counted:
        # A scan's first point is that of its first packet, or a little later.
        found = [s for s in decisions if -1000000 <= s - first < 50000000]
        decision = decisions[found[0]] if found else {}
        result = arrival.get(decision.get("reference"))
        if result is None or bin(result[4]).count("1") < len(cameras):
            lost += 1
            continue
        there = [delivered]
        for camera in cameras:
            stamp = decision.get(camera, 0)
            there.append(scores.get((camera, stamp), delivered))
            until = max(until, stamp)
        there += [moment for stamp, moment in odometry if stamp >= until][:1]
        latencies.append(1e-6 * (result[1] - max(there)))
        fused.append(result[3])
    samples = between(manager["samples"], begin, end)
    total = cpu_per_scan(manager, begin, end)
    # The copies that the player makes of messages which are still held are its own affair.
    copies = between(player["copies"], samples[0][0], samples[-1][0])
    periods = 1e-9 * (samples[-1][0] - samples[0][0]) / SCAN_PERIOD
    playing = alone + 1e3 * sum(c[1] for c in copies) / periods if shared else 0.0
    return {
        "cpu_ms_per_scan": total - playing,
        "player_ms_per_scan": playing,
        "latency_ms_median": quantile(latencies, 0.5),
        "latency_ms_p99": quantile(latencies, 0.99),
        "resident_mb": 1e-6 * (max(s[2] for s in samples) - manager["resident_before"]),
        "scans": len(counted),
        "scans_lost": lost,
        "fused_points_per_scan": quantile(fused, 0.5),
        "copies_by_player": len(copies),
        "largest_lag_of_player_ms": 1e-6 * player["largest_lag_ns"],
    }


def run(arguments, folder):
    import rosbag

    with rosbag.Bag(arguments.bag) as bag:
        infos = bag.read_messages(topics=["/gmsl/A0/camera_info"])
        width = next((message.width for _, message, _ in infos), None)
    if width is None:
        fail("%s has no /gmsl/A0/camera_info; it must come from simulate_drive" % arguments.bag)
    rigs = {}
    for transport in ("raw", "compressed"):
        rigs[transport] = os.path.join(folder, transport + ".yaml")
        write_rig(arguments.rig, rigs[transport], transport, width)
    log = os.path.join(folder, "log.json")
    other = os.path.join(folder, "player.json")
    program = os.path.join(arguments.bin_dir, "rig_benchmark")
    play = ["--bag", arguments.bag, "--seconds"]
    seconds = str(arguments.seconds)
    rows = {}
    with master() as environment:
        alone = {}
        for transport in ("raw", "compressed"):
            process = start(
                program, environment, "player", rigs[transport], log, *play, "8", "--alone"
            )
            result = finish(process, log)
            begin = result["player"]["start"] + int(1e9)
            alone[transport] = cpu_per_scan(result, begin, begin + int(6e9))
        for name, latency in (("pointers", "0"), ("late", "0.12")):
            if name not in arguments.rows:
                continue
            process = start(
                program,
                environment,
                "both",
                rigs["raw"],
                log,
                *play,
                seconds,
                "--score-latency",
                latency,
            )
            result = finish(process, log)
            rows[name] = evaluate(result, result, alone["raw"], True)
            if arguments.logs:
                shutil.copy(log, os.path.join(arguments.logs, name + ".json"))
        if "tcp" in arguments.rows:
            manager = start(program, environment, "manager", rigs["compressed"], log)
            player = start(
                program, environment, "player", rigs["compressed"], other, *play, seconds
            )
            played = finish(player, other)
            rows["tcp"] = evaluate(finish(manager, log), played, 0.0, False)
    return {"image_width": width, "seconds": arguments.seconds, "rows": rows, "goals": GOALS}


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--bin-dir", required=True, help="folder of rig_benchmark")
    parser.add_argument("--bag", required=True, help="bag of simulate_drive")
    parser.add_argument("--rig", required=True, help="its rig file, config/demo.yaml")
    parser.add_argument("--seconds", type=float, default=60.0, help="each row (default 60)")
    parser.add_argument(
        "--rows",
        type=lambda text: text.split(","),
        default=["pointers", "late", "tcp"],
        help="which rows, with commas (default: all)",
    )
    parser.add_argument("--json", help="file for the figures")
    parser.add_argument("--logs", help="folder that keeps the raw logs")
    arguments = parser.parse_args()
    unknown = set(arguments.rows) - {"pointers", "late", "tcp"}
    if unknown:
        parser.error("no such row: %s" % ", ".join(sorted(unknown)))
    if arguments.seconds < 5.0:
        parser.error("--seconds is %g, must be at least 5" % arguments.seconds)
    with tempfile.TemporaryDirectory(prefix="slf_rig_") as folder:
        figures = run(arguments, folder)
    for name, row in figures["rows"].items():
        print(
            "%-9s %6.1f core-ms a scan (player alone %.1f)  latency %.1f ms median, %.1f ms 99 %%  "
            "%.0f MB  %d of %d scans lost  %.0f points fused"
            % (
                name,
                row["cpu_ms_per_scan"],
                row["player_ms_per_scan"],
                row["latency_ms_median"],
                row["latency_ms_p99"],
                row["resident_mb"],
                row["scans_lost"],
                row["scans"],
                row["fused_points_per_scan"],
            )
        )
    if arguments.json:
        with open(arguments.json, "w") as file:
            json.dump(figures, file, indent=1)


if __name__ == "__main__":
    main()
