#!/usr/bin/python3
# SPDX-License-Identifier: MIT
"""Builds a voxel map of class distributions from semantic clouds (bags, a live topic, or earlier
maps) and exports it for other programs."""

import argparse
import os
import sys

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))

from semantic_lidar_fusion import cli  # noqa: E402

FORMATS = ("ply", "pcd", "npz", "octomap", "grid", "raster", "picture")
EPILOG = """\
INPUT is a bag with points_semantic (and class_info), as fuse_bag writes it, or a map.voxels of an
earlier run with the same options, which is added. Poses come from tf at each cloud's stamp,
interpolated; fused bags hold no tf, so name the bags that do:

  build_semantic_map.py fused.bag --tf drive.bag --out map
  build_semantic_map.py monday.bag tuesday.bag --tf monday_raw.bag tuesday_raw.bag --out map --workers 4
  build_semantic_map.py fused.bag --tf drive.bag --out map --scheduler tcp://10.0.0.5:8786
  build_semantic_map.py --live points_semantic --out map        (Ctrl-C ends it and writes the map)
  build_semantic_map.py a/map.voxels b/map.voxels --out both

Written to --out: map.voxels (the map itself), map.json (what it is), map.ply, map.pcd, map.npz, map.ot
and map.bt (OctoMap), costs.pgm/.yaml and occupancy.pgm/.yaml (map_server), classes, labels, confidence
and elevation as PNG with world files, and map.png; dynamic.ply and dynamic.pcd hold what moves. The
folder is there whole or not at all. Exit codes: 0 done; 1 failed; 2 wrong command line; 130
interrupted."""


def make_parser():
    parser = argparse.ArgumentParser(
        description=__doc__, epilog=EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("inputs", metavar="INPUT", nargs="*", help="bags, or map.voxels files")
    parser.add_argument(
        "--out", metavar="DIR", required=True, help="folder of the map; must be new"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an earlier map in --out")
    parser.add_argument(
        "--tf", metavar="BAG", nargs="+", default=[], help="bags with the tf of the inputs: one for "
        "each, in their order, or all for one input (default: the inputs themselves)",
    )  # fmt: skip
    parser.add_argument("--topic", default="/points_semantic", help="default: /points_semantic")
    parser.add_argument(
        "--odometry", metavar="TOPIC", default="", help="nav_msgs/Odometry to take beside tf"
    )
    parser.add_argument(
        "--frame", metavar="NAME", help="frame of the map (default: map or odom, as tf has it)"
    )
    parser.add_argument("--classes", metavar="FILE", help="class set (default: topic class_info)")
    parser.add_argument(
        "--formats",
        metavar="NAME,...",
        type=_formats,
        default=None,
        help="of %s (default: all that can be written here)" % ", ".join(FORMATS),
    )
    model = parser.add_argument_group("the map")
    model.add_argument("--voxel", metavar="M", type=float, default=0.2, help="edge (default: 0.2)")
    model.add_argument(
        "--evidence",
        choices=["log", "dirichlet"],
        default="log",
        help="log: w (log max(P, eps) - log prior) per observation; dirichlet: w P (default: log)",
    )
    model.add_argument(
        "--weight", metavar="W", type=float, help="w, above 0 and at most 1 (default: calibrated)"
    )
    model.add_argument("--floor", metavar="P", type=float, help="eps, the least P that is believed")
    model.add_argument(
        "--prior",
        metavar="NAME=P,...",
        type=_prior,
        default={},
        help="prior of some classes; the others share the rest evenly (default: uniform)",
    )
    model.add_argument(
        "--clamp", metavar="NATS", type=float, help="greatest ratio of two classes when read"
    )
    model.add_argument(
        "--min-range", metavar="M", type=float, default=0.0, help="from the lidar (default: none)"
    )
    model.add_argument(
        "--max-range", metavar="M", type=float, default=0.0, help="from the lidar (default: none)"
    )
    model.add_argument(
        "--dynamic",
        choices=["apart", "exclude", "keep"],
        default="apart",
        help="points of classes that move by themselves: a layer of their own, none, or like all "
        "others (default: apart)",
    )
    model.add_argument(
        "--costs", metavar="FILE", help="what the classes mean in 2-D (default: the package's "
        "config/map_costs.yaml)",
    )  # fmt: skip
    work = parser.add_argument_group("the work")
    work.add_argument(
        "--workers", metavar="N", type=cli.positive, default=1, help="processes here (default: 1)"
    )
    work.add_argument(
        "--scheduler", metavar="ADDRESS", help="an existing Dask cluster, whose workers reach the "
        "bags under the same paths",
    )  # fmt: skip
    work.add_argument(
        "--memory",
        metavar="MB",
        type=cli.positive,
        default=1024,
        help="of voxels to hold before they go to disk (default: 1024)",
    )
    live = parser.add_argument_group("a live topic")
    live.add_argument("--live", metavar="TOPIC", help="map this topic until Ctrl-C, or --duration")
    live.add_argument(
        "--duration", metavar="S", type=float, help="end the live map after S seconds"
    )
    return parser


def _formats(text):
    chosen = [name for name in text.split(",") if name]
    wrong = sorted(set(chosen) - set(FORMATS))
    if wrong:
        raise argparse.ArgumentTypeError("no format %s (of %s)" % (wrong[0], ", ".join(FORMATS)))
    return chosen


def _prior(text):
    result = {}
    for entry in text.split(","):
        name, equals, value = entry.partition("=")
        try:
            result[name] = float(value)
        except ValueError:
            equals = ""
        if not equals:
            raise argparse.ArgumentTypeError("%s: must be NAME=P" % entry)
    return result


def check(parser, options):
    """Leaves with exit code 2 unless the options fit together."""
    if bool(options.inputs) == bool(options.live):
        parser.error("give INPUT files or --live, one of them")
    if options.live and (options.tf or options.workers > 1 or options.scheduler):
        parser.error("--live excludes --tf, --workers and --scheduler")
    if options.duration is not None and not options.live:
        parser.error("--duration needs --live")
    if options.workers > 1 and options.scheduler:
        parser.error("give --workers or --scheduler, one of them")
    bags = [path for path in options.inputs if not path.endswith(".voxels")]
    if options.tf and len(bags) != 1 and len(options.tf) != len(bags):
        parser.error("--tf: give one bag for each input (%d), in their order" % len(bags))


def main():
    parser = make_parser()
    options = parser.parse_args()
    check(parser, options)
    cli.require("numpy", "yaml", "rosbag", "scipy", "matplotlib", "cv2")
    from semantic_lidar_fusion.maps import run

    print(run.build(options))


if __name__ == "__main__":
    cli.run(main)
