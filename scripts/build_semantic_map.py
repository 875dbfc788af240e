#!/usr/bin/python3
# SPDX-License-Identifier: MIT
"""Builds a voxel map of class distributions from semantic clouds (bags, a live topic, or earlier
maps) and exports it for other programs."""

import argparse
import os
import sys

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))

from semantic_lidar_fusion import cli  # noqa: E402
from semantic_lidar_fusion.maps import formats  # noqa: E402

EPILOG = """\
INPUT is a bag with points_semantic (and class_info), as fuse_bag writes it, a map.submaps, which has
all that its bags had and takes other --poses, or a map.voxels of an earlier run with the same options,
which is added. Poses come from tf at each cloud's stamp,
interpolated: fuse_bag copies tf into its bags, and --tf names other bags that hold it. Or they come
from files of corrected poses:

  build_semantic_map.py fused.bag --out map
  build_semantic_map.py monday.bag tuesday.bag --tf monday_raw.bag tuesday_raw.bag --out map --workers 4
  build_semantic_map.py fused.bag --poses slam.tum --poses-frame base_link --tf drive.bag --out map
  build_semantic_map.py fused.bag --tf drive.bag --out map --scheduler tcp://10.0.0.5:8786
  build_semantic_map.py --live points_semantic --out map        (Ctrl-C ends it and writes the map)
  build_semantic_map.py a/map.voxels b/map.voxels --out both
  build_semantic_map.py fused.bag --tf drive.bag --submaps --out map
  build_semantic_map.py map/map.submaps --poses slam.tum --out corrected     (without the bags)

Written to --out: map.voxels (the map itself, first of all), map.json (what it is), and the --formats.
A format that fails is left out with a warning, and the exit code is 1; the rest is there. Without
map.voxels there is no folder. Exit codes: 0 done; 1 failed; 2 wrong command line; 130 interrupted."""


def make_parser():
    parser = argparse.ArgumentParser(
        description=__doc__, epilog=EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "inputs", metavar="INPUT", nargs="*", help="bags, map.submaps or map.voxels"
    )
    parser.add_argument(
        "--out", metavar="DIR", required=True, help="folder of the map; must be new"
    )
    parser.add_argument(
        "--overwrite", "--force", action="store_true", help="replace an earlier map in --out"
    )
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
        help="of %s (default: all that can be written here)" % ", ".join(formats.names()),
    )
    parser.add_argument(
        "--poses", metavar="FILE", nargs="+", default=[], help="poses to take instead of tf, one file "
        "for each bag (and each drive of a map.submaps, in order): TUM (stamp x y z qx qy qz qw), or "
        "KITTI (3 x 4 matrices, one for each cloud)",
    )  # fmt: skip
    parser.add_argument(
        "--poses-frame",
        metavar="NAME",
        default="",
        help="the frame of tf whose poses --poses holds (default: that of the clouds)",
    )
    parser.add_argument(
        "--vehicle-frame",
        metavar="NAME",
        default="base_link",
        help="the frame along whose path the ground is free (default: base_link, or the clouds')",
    )
    parser.add_argument(
        "--epsg", metavar="CODE", type=cli.positive, help="coordinate system of the map, for GIS"
    )
    parser.add_argument(
        "--scan-labels",
        action="store_true",
        help="also write labels/000000.label, ...: the map's class for each point of each cloud, with "
        "the ids of SemanticKITTI",
    )
    parser.add_argument(
        "--submaps",
        action="store_true",
        help="also write map.submaps (half of the bags' size): an INPUT that other --poses place anew, "
        "without the bags and without casting rays",
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
        "--max-range",
        metavar="M",
        type=float,
        default=120.0,
        help="from the lidar, 0 = no limit (default: 120)",
    )
    model.add_argument(
        "--rays",
        metavar="M",
        type=float,
        default=45.0,
        help="how far from the lidar its rays clear what is no longer there, 0 = never (default: 45)",
    )
    model.add_argument(
        "--footprint",
        metavar="M",
        type=float,
        default=0.9,
        help="half the width of the vehicle, whose path is free in 2-D maps, 0 = it is not "
        "(default: 0.9)",
    )
    model.add_argument(
        "--dynamic",
        choices=["apart", "exclude", "keep"],
        default="apart",
        help="voxels of classes that move by themselves: a layer of their own, none, or like all "
        "others (default: apart)",
    )
    model.add_argument(
        "--costs", metavar="FILE", help="what the classes mean in 2-D (default: the package's "
        "config/map_costs.yaml)",
    )  # fmt: skip
    work = parser.add_argument_group("the work")
    work.add_argument(
        "--workers",
        metavar="N",
        type=cli.positive,
        default=1,
        help="processes here, for parts of the drives and then for formats (default: 1)",
    )
    work.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        type=cli.address,
        help="an existing Dask cluster, whose workers reach the bags under the same paths",
    )
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
    try:
        return tuple(formats.split(text))
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error))


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
    bags = [path for path in options.inputs if not path.endswith((".voxels", ".submaps"))]
    kept = [path for path in options.inputs if path.endswith(".submaps")]
    if (options.scan_labels or options.submaps) and not bags:
        parser.error("--scan-labels and --submaps need bags")
    if options.live and (options.tf or options.poses or options.workers > 1 or options.scheduler):
        parser.error("--live excludes --tf, --poses, --workers and --scheduler")
    if options.duration is not None and not options.live:
        parser.error("--duration needs --live")
    if options.workers > 1 and options.scheduler:
        parser.error("give --workers or --scheduler, one of them")
    if options.tf and len(bags) != 1 and len(options.tf) != len(bags):
        parser.error("--tf: give one bag for each input (%d), in their order" % len(bags))
    if options.poses and not kept and len(options.poses) != len(bags):
        parser.error("--poses: give one file for each bag (%d), in their order" % len(bags))
    if options.poses_frame and not options.poses:
        parser.error("--poses-frame needs --poses")


def request_of(options):
    """The options as what `run.build` takes."""
    from semantic_lidar_fusion.maps.run import Request
    from semantic_lidar_fusion.maps.semantic_map import MapConfig
    from semantic_lidar_fusion.work import Work

    defaults = MapConfig()

    def given(value, default):
        return default if value is None else value

    config = MapConfig(
        voxel_size_m=options.voxel,
        kind=options.evidence,
        weight=given(options.weight, defaults.weight),
        floor=given(options.floor, defaults.floor),
        clamp=given(options.clamp, defaults.clamp),
        min_range_m=options.min_range,
        max_range_m=options.max_range,
        ray_range_m=options.rays,
        dynamic=options.dynamic,
        footprint_m=options.footprint,
    )
    return Request(
        out=options.out,
        inputs=tuple(options.inputs),
        live=options.live or "",
        duration=options.duration,
        overwrite=options.overwrite,
        formats=options.formats,
        epsg=options.epsg,
        scan_labels=options.scan_labels,
        submaps=options.submaps,
        tf=tuple(options.tf),
        topic=options.topic,
        odometry=options.odometry,
        poses=tuple(options.poses),
        poses_frame=options.poses_frame,
        vehicle_frame=options.vehicle_frame,
        frame=options.frame or "",
        classes=options.classes or "",
        costs=options.costs or "",
        prior=tuple(options.prior.items()),
        config=config,
        work=Work(options.workers, options.scheduler),
        memory_mb=options.memory,
    )


def main():
    parser = make_parser()
    options = parser.parse_args()
    check(parser, options)
    cli.require("numpy", "yaml", "rosbag", "scipy", "matplotlib", "cv2")
    from semantic_lidar_fusion.maps import run

    text, complete = run.build(request_of(options))
    print(text)
    return 0 if complete else 1


if __name__ == "__main__":
    cli.run(main)
