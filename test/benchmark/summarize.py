#!/usr/bin/python3
# SPDX-License-Identifier: MIT
"""Prints one table of what the benchmarks left in a folder, and writes it there as summary.json.

Reads stage_*.json (Google Benchmark), superpixels.json (compare_fast_slic.py), rig.json
(benchmark_rig.py) and offline.json (benchmark_fuse_bag.py); what is absent is left out. Ratios are those of medians of CPU times that were
taken in one run; goals are the least ratio (must) and the wanted one (aim).
"""

import argparse
import glob
import json
import os
import platform
import re
import statistics

# stage, our row, the peer's row, what the peer is, must, aim (None: no goal)
PAIRS = [
    (
        "SLIC 960x604, cold",
        "BM_SlicCold/960/604/1000",
        "BM_OpenCvSlic/960/604/1000",
        "OpenCV SLIC",
        None,
        None,
    ),
    (
        "SLIC 960x604, cold",
        "BM_SlicCold/960/604/1000",
        "BM_OpenCvSlico/960/604/1000",
        "OpenCV SLICO",
        None,
        None,
    ),
    (
        "SLIC 960x604, cold",
        "BM_SlicCold/960/604/1000",
        "BM_OpenCvSeeds/960/604/1000",
        "OpenCV SEEDS",
        None,
        None,
    ),
    (
        "softmax of 1920x1208x12",
        "BM_SoftmaxAtPoints/1920/1208",
        "BM_SoftmaxDense/1920/1208",
        "dense, vectorised by the compiler",
        None,
        None,
    ),
    ("motion", r"motion/ours", r"motion/tf2.*", "pcl_ros + tf2 per packet", 8, 11),
    ("motion", r"motion/ours", r"motion_by_firing/tf2.*", "pcl_ros + tf2 per firing", None, None),
    (
        "projection",
        r"projection/ours.*",
        r"projection/(?!ours).*",
        "cv::fisheye::projectPoints",
        10,
        20,
    ),
    (
        "occlusion, paper",
        r"occlusion/ours",
        r"occlusion/kdtree.*",
        "k-d tree + cv::rectangle",
        25,
        50,
    ),
    (
        "occlusion, adaptive",
        r"occlusion_adaptive/ours",
        r"occlusion/kdtree.*",
        "k-d tree + cv::rectangle",
        None,
        None,
    ),
    *(
        (
            "share of %s" % name,
            r"share/%s/%s" % (kind, arguments),
            r"share/float/%s" % arguments,
            "the same of float scores",
            1.0,
            2.5,
        )
        for name, kind, arguments in [
            ("u8 scores, 640 wide", "u8", "640/12"),
            ("u8 scores, 1920 wide", "u8", "1920/12"),
            ("u8 scores, 240 wide, 150 classes", "u8", "240/150"),
            ("u16 scores, 1920 wide", "u16", "1920/12"),
        ]
    ),
    *(
        (
            "lidar part, " + name,
            r"lidar/ours/%s" % arguments,
            r"lidar/cv::fisheye.*/%s" % peer_arguments,
            "cv::fisheye + cv::rectangle, without transfer",
            None,
            None,
        )
        for name, arguments, peer_arguments in [
            ("16 rings, 10 Hz", "16/1800/5/12", "16/1800/5/12"),
            ("64 rings, 10 Hz", "64/2048/5/12", "64/2048/5/12"),
            ("64 rings, 20 Hz", "64/1024/5/12", "64/1024/5/12"),
            ("128 rings, 10 Hz", "128/2048/5/12", "128/2048/5/12"),
            ("128 rings, 20 Hz", "128/1024/5/12", "128/1024/5/12"),
            ("16 rings, 16 cameras", "16/1800/16/12", "16/1800/16/12"),
            ("16 rings, 150 classes", "16/1800/5/150", "16/1800/5/12"),
        ]
    ),
    (
        "voxel map",
        r"voxelMap/dirichlet:0",
        r"octomapTree/logarithms:1",
        "OctoMap, 12 floats a node",
        4,
        6,
    ),
]
ONE_WORKER = "fuse_five_cameras/ours_paper(/.*)?"
TWO_WORKERS = "fuse_five_cameras/ours_paper_two_threads(/.*)?"
FAST_SLIC_GOALS = {
    ("960x604", "cold"): (3, 5),
    ("960x604", "warm"): (4, 8),
    ("1920x1208", "warm"): (5, 9),
}
QUALITY_LIMIT = 1.02
LATENCY_GOAL_MS = 30.0
RIG_NAMES = {
    "pointers": "whole rig, messages by pointer",
    "late": "whole rig, scores 120 ms late",
    "tcp": "whole rig, JPEG images over TCP",
}
# s of bag per s on two threads: must, aim; and of three outputs against one, in time.
OFFLINE_GOALS = {"1920x1208": (2.0, 3.0), "960x604": (3.0, 5.0)}
OUTPUTS_GOAL = (1.6, 1.3)
UNITS = {"ns": 1e-6, "us": 1e-3, "ms": 1.0, "s": 1e3}


def load(path):
    if not os.path.exists(path):
        return None
    with open(path) as file:
        return json.load(file)


def stage_medians(folder, clock="cpu_time"):
    """Median time (ms) of every row of Google Benchmark."""
    times = {}
    for path in sorted(glob.glob(os.path.join(folder, "stage_*.json"))):
        for row in load(path)["benchmarks"]:
            if row.get("run_type", "iteration") == "iteration" and not row.get("error_occurred"):
                name = row.get("run_name", row["name"])
                times.setdefault(name, []).append(row[clock] * UNITS[row["time_unit"]])
    return {name: statistics.median(values) for name, values in times.items()}


def found(times, pattern):
    """The slowest row that the pattern matches wholly: of several the one that claims least."""
    values = [t for name, t in times.items() if re.fullmatch(re.escape(pattern), name)]
    values = values or [t for name, t in times.items() if re.fullmatch(pattern, name)]
    return values


def verdict(value, must, aim, less=False):
    if must is None:
        return ""
    reaches = (lambda goal: value <= goal) if less else (lambda goal: value >= goal)
    return "aim" if reaches(aim) else "must" if reaches(must) else "MISSED"


def milliseconds(value):
    return "%.3g ms" % value if value < 100 else "%.0f ms" % value


def ratio_row(stage, ours, peer_name, peer, must, aim, ratio=None):
    ratio = peer / ours if ratio is None else ratio
    return {
        "stage": stage,
        "ours_ms": ours,
        "peer": peer_name,
        "peer_ms": peer,
        "ratio": ratio,
        "must": must,
        "aim": aim,
        "met": verdict(ratio, must, aim),
    }


def ratio_rows(folder):
    rows = []
    superpixels = load(os.path.join(folder, "superpixels.json"))
    for row in superpixels["times"] if superpixels else []:
        for mode in ("cold", "warm"):
            must, aim = FAST_SLIC_GOALS.get((row["size"], mode), (None, None))
            stage = "SLIC %s, %s" % (row["size"], mode)
            ratio = min(row["ratio_" + mode], row["quiet_ratio_" + mode])
            rows.append(
                ratio_row(stage, row[mode], "fast-slic 0.4", row["fast_slic"], must, aim, ratio)
            )
    times = stage_medians(folder)
    for stage, ours, peer, peer_name, must, aim in PAIRS:
        our_times, peer_times = found(times, ours), found(times, peer)
        if our_times and peer_times:
            rows.append(ratio_row(stage, max(our_times), peer_name, min(peer_times), must, aim))
    wall = stage_medians(folder, "real_time")
    two, one = found(wall, TWO_WORKERS), found(wall, ONE_WORKER)
    if two and one:
        stage = "five cameras, two workers (wall time)"
        rows.append(ratio_row(stage, two[0], "one worker", one[0], 1.7, 1.9))
    return rows


def quality_rows(folder):
    superpixels = load(os.path.join(folder, "superpixels.json"))
    rows = []
    for row in superpixels["quality"] if superpixels else []:
        for mode in ("cold", "warm", "warm_10hz"):
            if mode in row:
                error, recall = row[mode]["error_ratio"], row[mode]["recall_ratio"]
                held = error <= QUALITY_LIMIT and recall >= 1 / QUALITY_LIMIT
                rows.append(
                    {
                        "set": row["set"],
                        "superpixels": round(row["fast_slic"]["superpixels"]),
                        "mode": mode,
                        "error_ratio": error,
                        "recall_ratio": recall,
                        "held": held,
                    }
                )
    return rows


def offline_rows(folder):
    """Cells of the table of fuse_bag's throughput."""
    rows = []
    for size, figures in (load(os.path.join(folder, "offline.json")) or {}).items():
        two, plain = figures["two threads"]["speed"], figures["plain chain"]["speed"]
        times = two / figures["three outputs"]["speed"]
        rows.append(
            [
                "fuse_bag, five JPEG cameras, " + size,
                "%.2f" % figures["one thread"]["speed"],
                "%.2f" % two,
                *goal(*OFFLINE_GOALS[size]),
                verdict(two, *OFFLINE_GOALS[size]),
                "%.0f core-ms" % figures["two threads"]["cpu_ms_per_scan"],
                "%.1fx" % (two / plain),
                "%.2fx, %s" % (times, verdict(times, *OUTPUTS_GOAL, less=True)),
            ]
        )
    return rows


def machine(load_before):
    """What was measured on, as far as it tells."""
    with open("/proc/cpuinfo") as file:
        text = file.read()
    model = re.search(r"model name\s*: (.*)", text)
    flags = re.search(r"flags\s*: (.*)", text)
    flags = set(flags.group(1).split()) if flags else set()
    with open("/proc/meminfo") as file:
        memory = int(re.search(r"MemTotal:\s*(\d+)", file.read()).group(1))
    return {
        "processor": model.group(1) if model else platform.machine(),
        "processors": os.cpu_count(),
        "vector_instructions": [f for f in ("avx2", "avx512bw") if f in flags],
        "memory_gb": round(memory / 1e6, 1),
        "system": "%s %s" % (platform.system(), platform.release()),
        "load_before": load_before,
        "load_after": "%.2f %.2f %.2f" % os.getloadavg(),
    }


def goal(must, aim, unit=""):
    """The two cells of a row's goals."""
    return ["", ""] if must is None else ["%g%s" % (value, unit) for value in (must, aim)]


def table(head, rows, style):
    rows = [[str(cell) for cell in row] for row in rows]
    if style == "markdown":
        lines = [head, ["---"] * len(head)] + rows
        return "\n".join("| " + " | ".join(line) + " |" for line in lines)
    widths = [max(len(line[i]) for line in [head] + rows) for i in range(len(head))]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(line, widths)).rstrip()
        for line in [head] + rows
    )


def missed_by(row):
    """Which goals of the rig a row misses; those of latency and loss hold for all rows."""
    missed = ["latency"] if row["latency_ms_median"] > LATENCY_GOAL_MS else []
    missed += ["scans lost"] if row["scans_lost"] else []
    return "MISSED: " + ", ".join(missed) if missed else "met"


def print_tables(summary, style):
    rows = [
        [
            row["stage"],
            milliseconds(row["ours_ms"]),
            "%s: %s" % (row["peer"], milliseconds(row["peer_ms"])),
            "%.1fx" % row["ratio"],
            *goal(row["must"], row["aim"], "x"),
            row["met"],
        ]
        for row in summary["ratios"]
    ]
    for row in summary["rig"]:
        rows.append(
            [
                row["stage"],
                "%.1f core-ms a scan" % row["cpu_ms_per_scan"],
                "",
                "",
                *goal(*(row["goal"] or (None, None)), " core-ms"),
                row["met"],
            ]
        )
    print(table(["stage", "ours", "peer", "ratio", "must", "aim", "met"], rows, style))
    if summary["rig"]:
        print()
        head = ["", "latency median", "99 %", "memory", "scans lost", "player", "goals"]
        rows = [
            [
                row["stage"],
                "%.1f ms" % row["latency_ms_median"],
                "%.1f ms" % row["latency_ms_p99"],
                "%.0f MB" % row["resident_mb"],
                "%d of %d" % (row["scans_lost"], row["scans"]),
                "%.1f core-ms a scan" % row["player_ms_per_scan"],
                missed_by(row),
            ]
            for row in summary["rig"]
        ]
        print(table(head, rows, style))
    if summary["offline"]:
        print()
        head = [
            "s of bag per s (rosbag play: 1)",
            "one thread",
            "two threads",
            "must",
            "aim",
            "met",
            "a scan",
            "plain numpy and OpenCV chain",
            "three outputs, must 1.6x (1.3x)",
        ]
        print(table(head, summary["offline"], style))
    if summary["quality"]:
        held = [row for row in summary["quality"] if row["held"]]
        worst = max(summary["quality"], key=lambda row: row["error_ratio"])
        print(
            "\nSuperpixel quality at fast-slic's count: within %.0f %% of its undersegmentation error "
            "and boundary recall in %d of %d comparisons; the largest error is %.3f of fast-slic's "
            "(%s, %s, %d superpixels)."
            % (
                100 * (QUALITY_LIMIT - 1),
                len(held),
                len(summary["quality"]),
                worst["error_ratio"],
                worst["set"],
                worst["mode"],
                worst["superpixels"],
            )
        )
    about = summary["machine"]
    print(
        "\n%s, %d processors, %s, %s GB; load average %s before and %s after. CPU times of one "
        "thread, medians; ratios within one run count."
        % (
            about["processor"],
            about["processors"],
            " and ".join(about["vector_instructions"]) or "no AVX2",
            about["memory_gb"],
            about["load_before"],
            about["load_after"],
        )
    )


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", help="where the benchmarks left their figures")
    parser.add_argument("--style", choices=["text", "markdown"], default="text")
    parser.add_argument("--load-before", default="?", help="load average before they ran")
    arguments = parser.parse_args()

    rig = load(os.path.join(arguments.folder, "rig.json"))
    rig_rows = []
    for name, row in rig["rows"].items() if rig else []:
        # The goal is that of a rig whose messages pass by pointer.
        bounds = None if name == "tcp" else rig["goals"]["cpu_ms_per_scan"]
        met = verdict(row["cpu_ms_per_scan"], *bounds, less=True) if bounds else ""
        rig_rows.append(dict(row, stage=RIG_NAMES[name], goal=bounds, met=met))
    summary = {
        "machine": machine(arguments.load_before),
        "ratios": ratio_rows(arguments.folder),
        "rig": rig_rows,
        "offline": offline_rows(arguments.folder),
        "quality": quality_rows(arguments.folder),
    }
    if not any(summary[part] for part in ("ratios", "rig", "offline")):
        raise SystemExit("summarize: no figures in " + arguments.folder)
    print_tables(summary, arguments.style)
    with open(os.path.join(arguments.folder, "summary.json"), "w") as file:
        json.dump(summary, file, indent=1)


if __name__ == "__main__":
    main()
