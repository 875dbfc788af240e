#!/usr/bin/python3
# SPDX-License-Identifier: MIT
"""Scores semantic clouds against truth: the paper's Table I for direct projection, with motion
correction, with motion correction and occlusion mask (all with the paper's settings), and for the
rig as it is; and F1* over the points that a camera truly sees."""

import argparse
import os
import sys

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))

from semantic_lidar_fusion import cli  # noqa: E402

EPILOG = """\
The truth is the topic /points_truth (PointCloud2: x y z, label u8 = class id; the same points in the
same order as the scan); simulate_drive, import_dataset.py and exchange_labels.py write it. Written to
--out: report.html (everything in one file, for a browser), report.md, tables.tex, table1.csv, summary.csv, confusion_*.csv, visibility.csv, temperatures.csv, masks.csv, and PNG plots.
docs/results.md explains every table.

  evaluate.py drive.bag --rig rig.yaml --out results
  evaluate.py seed1.bag seed2.bag seed3.bag --rig rig.yaml --out results
  evaluate.py drives/ --rig rig.yaml --workers 4 --out results
  evaluate.py drive.bag --rig rig.yaml --masks --out results
  evaluate.py drive.bag --rig rig.yaml --clouds online=recorded.bag --out results
  evaluate.py drive.bag --rig rig.yaml --fit-temperature --fit-on other.bag --out results
  evaluate.py --board acfr_a0_vlp16 --out results
  evaluate.py --images camvid --model enet.yaml --classes classes.yaml --fit-temperature --out results
"""


def make_parser():
    parser = argparse.ArgumentParser(
        description=__doc__, epilog=EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "bags",
        metavar="IN.bag",
        nargs="*",
        help="a drive with points_truth, or a folder of such bags; several are scored together and "
        "one by one",
    )
    parser.add_argument("--rig", metavar="FILE", help="the rig file of the drive")
    parser.add_argument(
        "--out",
        metavar="DIR",
        default="evaluation",
        help="folder of the results (default: evaluation)",
    )
    parser.add_argument(
        "--clouds",
        metavar="NAME=BAG",
        action="append",
        default=[],
        help="score the clouds of this bag instead of running fuse_bag; repeatable, in the order "
        "of the table's columns",
    )
    parser.add_argument(
        "--live",
        metavar="BAG",
        help="score this bag too, recorded from the nodelets (replay.launch record:=...), and say "
        "how many of its clouds equal those of the last column",
    )
    parser.add_argument("--truth", metavar="BAG", help="bag with points_truth (default: IN.bag)")
    parser.add_argument(
        "--set",
        metavar="KEY=VALUE",
        action="append",
        default=[],
        dest="settings",
        help="override a key of the rig file in all runs; repeatable",
    )
    parser.add_argument(
        "--paper",
        action="store_true",
        help="only the paper's settings, whatever the rig says: without the last column, which is "
        "the rig as it is",
    )
    parser.add_argument(
        "--bounds",
        action="store_true",
        help="also the rig with true visibility, with true odometry and with both, from the truth "
        "of simulate_drive",
    )
    parser.add_argument(
        "--compare",
        metavar=("A", "B"),
        nargs=2,
        default=(),
        help="two columns of the table: differences of F1, B minus A, with paired intervals",
    )
    parser.add_argument(
        "--min-edge-px",
        metavar="PX",
        type=_not_negative,
        default=0.0,
        help="score only points further than this from a class edge in every image that shows them, "
        "and really seen by every camera that contributed (the truth's fields edge_px, visible)",
    )
    parser.add_argument(
        "--fit-temperature",
        action="store_true",
        help="compare raw softmax, share temperature, one fitted constant, and both: fitted to the "
        "even scans, reported on the odd ones",
    )
    parser.add_argument(
        "--fit-on",
        metavar="BAG",
        help="fit to this bag with truth instead, report on all of IN.bag",
    )
    parser.add_argument(
        "--images",
        metavar="DIR",
        help="instead of a drive: images NAME.* with label images NAME_annot.png (class ids)",
    )
    parser.add_argument(
        "--board",
        metavar="DIR",
        help="instead of a drive: calibration poses of a board (poseN.jpg, poseN.npz, "
        "extrinsic_runs.csv); compares `transfer: pixel` and `expected` on them",
    )
    parser.add_argument("--model", metavar="FILE", help="the network for --images")
    parser.add_argument("--classes", metavar="FILE", help="the class set of --images")
    parser.add_argument(
        "--label-suffix", metavar="TEXT", default="_annot", help="of label images (default: _annot)"
    )
    parser.add_argument(
        "--pixel-step",
        metavar="N",
        type=cli.positive,
        default=2,
        help="score every N-th pixel in both directions (default: 2)",
    )
    parser.add_argument(
        "--masks",
        action="store_true",
        help="instead of Table I: what the occlusion masks catch and lose on each drive (adaptive, and "
        "the paper's at its 0.1 deg and at a VLP-16's 0.2 deg)",
    )
    parser.add_argument(
        "--registration",
        action="store_true",
        help="instead of Table I: how thick flat surfaces are in ten scans laid over each other, and "
        "how well a registration (small_gicp, if it is installed) follows the vehicle, without "
        "motion correction, with that of packets and of firings, and without moving classes",
    )
    parser.add_argument(
        "--map",
        action="store_true",
        help="also score voxel maps of the clouds (see build_semantic_map.py), with the tf of IN.bag",
    )
    parser.add_argument(
        "--voxel",
        metavar="M",
        type=float,
        default=0.2,
        help="edge of the map's voxels (default: 0.2)",
    )
    parser.add_argument(
        "--frame", metavar="NAME", help="frame of the map (default: map or odom, as tf has it)"
    )
    parser.add_argument("--fuse-bag", metavar="FILE", help="the program (default: looked for)")
    parser.add_argument(
        "--jobs",
        metavar="N",
        type=cli.positive,
        help="threads of fuse_bag (default: one for each processor); no effect on the results",
    )
    parser.add_argument(
        "--workers",
        metavar="N",
        type=cli.positive,
        default=1,
        help="processes that share several drives (default: 1); no effect on the results",
    )
    parser.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        type=cli.address,
        help="share them on an existing Dask cluster instead, whose workers reach the files and --out "
        "under the same names, such as tcp://10.0.0.5:8786",
    )
    parser.add_argument("--keep-bags", action="store_true", help="keep the fused bags in --out")
    parser.add_argument("--force", action="store_true", help="replace earlier results in --out")
    return parser


def _not_negative(text):
    value = float(text)
    if not value >= 0:
        raise argparse.ArgumentTypeError("must not be negative")
    return value


def bags_of(parser, given):
    """The bags that are named, and those of the folders that are named, by name."""
    bags = []
    for path in given:
        if not os.path.isdir(path):
            bags.append(path)
            continue
        found = [name for name in sorted(os.listdir(path)) if name.endswith(".bag")]
        if not found:
            parser.error("%s: a folder without a bag" % path)
        bags += [os.path.join(path, name) for name in found]
    return bags


def check(parser, options):
    """Leaves with exit code 2 unless the options fit together."""
    if sum(map(bool, (options.bags, options.images, options.board))) != 1:
        parser.error("give IN.bag, --images or --board, one of them")
    if options.images:
        for name in ("model", "classes"):
            if not getattr(options, name):
                parser.error("--images needs --" + name)
    alone = "images" if options.images else "board"
    if options.images or options.board:
        for name in (
            "rig",
            "truth",
            "clouds",
            "fit_on",
            "live",
            "masks",
            "registration",
            "map",
            "paper",
            "bounds",
            "compare",
        ):
            if getattr(options, name):
                parser.error("--%s and --%s exclude each other" % (alone, name.replace("_", "-")))
    if options.board and options.fit_temperature:
        parser.error("--board and --fit-temperature exclude each other")
    if options.bags and not options.rig and not options.clouds:
        parser.error("give --rig, or --clouds of existing bags")
    for name in ("masks", "registration"):
        if getattr(options, name) and not options.rig:
            parser.error("--%s needs --rig" % name)
    for name in ("paper", "bounds"):
        if getattr(options, name) and options.clouds:
            parser.error("--%s runs fuse_bag; it has no use for --clouds" % name)
    for name in ("truth", "clouds", "live", "fit_temperature", "map", "paper", "bounds"):
        single = name not in ("paper", "bounds")
        if single and getattr(options, name) and len(options.bags) > 1:
            parser.error("--%s is for one IN.bag" % name.replace("_", "-"))
        for alone in ("masks", "registration"):
            if getattr(options, name) and getattr(options, alone) and name != "truth":
                parser.error("--%s and --%s exclude each other" % (alone, name.replace("_", "-")))
    if options.masks and options.registration:
        parser.error("--masks and --registration exclude each other")
    if options.clouds and options.fit_temperature:
        parser.error("--fit-temperature runs fuse_bag; it has no use for --clouds")
    if options.fit_on and not options.fit_temperature:
        parser.error("--fit-on needs --fit-temperature")
    if options.workers > 1 and options.scheduler:
        parser.error("give --workers or --scheduler, one of them")
    if options.masks and (options.workers > 1 or options.scheduler):
        parser.error("--masks excludes --workers and --scheduler")
    names = [text.partition("=")[0] for text in options.clouds]
    for text, name in zip(options.clouds, names):
        if not name or not text.partition("=")[2] or not name.replace("_", "").isalnum():
            parser.error("--clouds %s: must be NAME=BAG, NAME of letters, digits and _" % text)
        if names.count(name) > 1:
            parser.error("--clouds %s: the name occurs twice" % name)


def main():
    parser = make_parser()
    options = parser.parse_args()
    options.bags = bags_of(parser, options.bags)
    check(parser, options)
    cli.require("numpy", "scipy", "yaml", "rosbag", "matplotlib")
    from semantic_lidar_fusion.evaluation import run

    values = dict(vars(options))
    for name in ("bags", "settings", "compare"):
        values[name] = tuple(values[name])
    values["clouds"] = tuple(tuple(text.split("=", 1)) for text in options.clouds)
    print(run.evaluate(run.Options(**values)))


if __name__ == "__main__":
    cli.run(main)
