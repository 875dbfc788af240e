#!/usr/bin/python3
# SPDX-License-Identifier: MIT
"""Plays a bag in a loop through the nodelets and watches the manager; started by scripts/soak.sh.

Prints one line for each sample and, at the end, what was measured against its limit; exit code 0
only if all limits hold."""
import argparse
import os
import re
import statistics
import sys
import threading
import time

import rospy

sys.path.insert(0, os.path.join(os.path.dirname(os.path.abspath(__file__)), "ros"))
import live  # noqa: E402

CLOUD = "/points_semantic"
# A scan whose images end with the bag is under way when the bag starts anew.
AT_THE_LOOP = "dropped: scan pending at a clock jump"
# Drops of points, of references and of a camera's messages, which are no scans.
OF_NO_SCAN = re.compile(
    "dropped: (points |packets |scan_reference|.*/scan_reference|"
    r".*[ /](images?|image_selected|semantics|scores|labels|probabilities|share|selection)\b)"
)


def make_parser():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("bag")
    parser.add_argument("rig")
    parser.add_argument("--minutes", type=float, required=True)
    parser.add_argument("--warm-up", type=float, required=True, help="min before the first sample")
    parser.add_argument("--rate", type=float, required=True, help="speed of playback")
    parser.add_argument("--growth-mb", type=float, default=20.0)
    parser.add_argument("--growth-percent", type=float, default=2.0)
    parser.add_argument("--drift-ms", type=float, default=50.0)
    parser.add_argument("--pairs-percent", type=float, default=99.0)
    parser.add_argument("--overload", action="store_true", help="scans may be dropped if counted")
    parser.add_argument("--overrides", default="", help="changes to the rig, as in fusion.launch")
    parser.add_argument("--csv", default="", help="file for the samples")
    return parser


class Process:
    """Memory, threads, file descriptors and CPU time of a process."""

    def __init__(self, pid):
        self.pid = pid

    def sample(self):
        with open("/proc/%d/status" % self.pid) as file:
            status = dict(line.split(":", 1) for line in file if ":" in line)
        with open("/proc/%d/stat" % self.pid) as file:
            fields = file.read().rpartition(")")[2].split()
        ticks = os.sysconf("SC_CLK_TCK")
        return {
            "rss_mb": int(status["VmRSS"].split()[0]) / 1024.0,
            "threads": int(status["Threads"]),
            "fds": len(os.listdir("/proc/%d/fd" % self.pid)),
            "cpu_s": (int(fields[11]) + int(fields[12])) / ticks,
        }


class Latency:
    """Wall time (ms) from the clock's passing of a cloud's stamp to the cloud's arrival."""

    def __init__(self, rate):
        self.rate = rate
        self._lock = threading.Lock()
        self._values = []  # (monotonic s, ms)
        self._subscriber = rospy.Subscriber(CLOUD, rospy.AnyMsg, self._add, buff_size=1 << 24)

    def _add(self, message):
        # Only the header: seq, secs, nsecs.
        secs = int.from_bytes(message._buff[4:8], "little")
        nsecs = int.from_bytes(message._buff[8:12], "little")
        now = rospy.Time.now().to_sec()
        with self._lock:
            self._values.append((time.monotonic(), (now - secs - nsecs * 1e-9) * 1e3 / self.rate))

    def between(self, start, end):
        """Without clouds that arrive when the clock has started anew."""
        with self._lock:
            return [ms for at, ms in self._values if start <= at < end and 0 <= ms < 60e3]


def counters(diagnostics):
    """Scans in, out, and dropped by reason, in the nodelet that sees every scan; pairs by camera."""
    motion = diagnostics.values.get("motion_compensation", {})
    projection = diagnostics.values.get("projection", {})
    given = sum(
        int(v)
        for k, v in motion.items()
        if k.startswith("input ") and k.endswith(" messages") and "scan_reference" not in k
    )
    out = int(projection.get("output %s messages" % CLOUD, 0))
    lost = {}
    for values in (motion, projection):
        for key, value in values.items():
            if key.startswith("dropped:") and not OF_NO_SCAN.match(key):
                lost[key] = lost.get(key, 0) + int(value)
    used = {k.split(":")[0]: int(v) for k, v in projection.items() if k.endswith(": images used")}
    return given, out, lost, used


def watch(options):
    diagnostics = live.Diagnostics()
    latency = Latency(options.rate)
    samples = []
    csv = open(options.csv, "w") if options.csv else None
    with live.launched(
        "replay.launch",
        bag=options.bag,
        rig=options.rig,
        rate=options.rate,
        loop="true",
        overrides=options.overrides,
    ):
        pid = live.wait_until(lambda: live.pid_of(live.MANAGER), "the manager", 60.0)
        process = Process(pid)
        live.wait_until(lambda: diagnostics.value("projection", "scans"), "the first scan", 120.0)
        start = time.monotonic() + 60.0 * options.warm_up
        end = start + 60.0 * (options.minutes - options.warm_up)
        period = min(10.0, 60.0 * options.minutes / 20.0)
        while time.monotonic() < end:
            time.sleep(period)
            sample = process.sample()
            given, out, lost, _ = counters(diagnostics)
            sample.update(t=time.monotonic() - start, given=given, out=out, lost=sum(lost.values()))
            line = (
                "%7.1f s: RSS %6.1f MB, %d threads, %d fds, CPU %.0f s, scans %d in, %d out, %d dropped"
                % (
                    sample["t"],
                    sample["rss_mb"],
                    sample["threads"],
                    sample["fds"],
                    sample["cpu_s"],
                    given,
                    out,
                    sample["lost"],
                )
            )
            print(line, flush=True)
            if csv:
                csv.write(",".join("%s=%s" % item for item in sorted(sample.items())) + "\n")
                csv.flush()
            if sample["t"] >= 0:
                samples.append(sample)
        same = live.pid_of(live.MANAGER) == pid
        time.sleep(2.5)  # diagnostics come once a second
        final = counters(diagnostics)
    if csv:
        csv.close()
    return samples, final, latency, (start, end), same


def judge(options, samples, final, latency, window, same):
    """(what, measured, limit, holds) of each figure."""
    given, out, lost, used = final
    third = max(1, len(samples) // 3)
    first_mb = statistics.median(s["rss_mb"] for s in samples[:third])
    last_mb = statistics.median(s["rss_mb"] for s in samples[-third:])
    growth = last_mb - first_mb
    start, end = window
    part = (end - start) / 3
    early, late = latency.between(start, start + part), latency.between(end - part, end)
    ms = [statistics.median(part) if part else float("nan") for part in (early, late)]
    in_work = given - out - sum(lost.values())
    real_losses = sum(lost.values()) - lost.get(AT_THE_LOOP, 0)
    worst_pair = min((100.0 * n / max(1, out) for n in used.values()), default=0.0)
    figures = [
        ("manager", "same process" if same else "restarted", "same process", same),
        (
            "memory",
            "%.1f MB to %.1f MB (%+.1f MB, %+.2f %%)"
            % (first_mb, last_mb, growth, 100 * growth / first_mb),
            "+%.0f MB and +%.0f %%" % (options.growth_mb, options.growth_percent),
            growth <= options.growth_mb and growth <= options.growth_percent / 100 * first_mb,
        ),
    ]
    for name in ("threads", "fds"):
        least, most = min(s[name] for s in samples), max(s[name] for s in samples)
        figures.append((name, "%d to %d" % (least, most), "constant", least == most))
    figures += [
        ("scans", "%d in, %d out" % (given, out), "some", out > 0),
        (
            "scans lost",
            "%d, and %d at the end of a loop; %s"
            % (real_losses, lost.get(AT_THE_LOOP, 0), sorted(lost.items())),
            "counted" if options.overload else "0",
            options.overload or real_losses == 0,
        ),
        ("in - out - dropped", "%d" % in_work, "0 to 12 (under way)", 0 <= in_work <= 12),
        (
            "latency",
            "median %.0f ms, then %.0f ms; longest %.0f ms"
            % (ms[0], ms[1], max(early + late, default=float("nan"))),
            "drift %.0f ms" % options.drift_ms,
            ms[1] - ms[0] <= options.drift_ms,
        ),
        (
            "camera pairs",
            "worst %.2f %%; %s" % (worst_pair, sorted(used.items())),
            "%.1f %%" % options.pairs_percent,
            options.overload or worst_pair >= options.pairs_percent,
        ),
    ]
    return figures


def tell(figures):
    """Prints (what, measured, limit, holds) of each figure; returns the exit code."""
    print()
    for what, measured, limit, holds in figures:
        print("%-4s %-18s %s (limit: %s)" % ("ok" if holds else "BAD", what, measured, limit))
    return 0 if all(figure[3] for figure in figures) else 1


def main():
    options = make_parser().parse_args(rospy.myargv()[1:])
    rospy.init_node("soak", disable_signals=True)
    return tell(judge(options, *watch(options)))


if __name__ == "__main__":
    sys.exit(main())
