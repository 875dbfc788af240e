#!/usr/bin/python3
# SPDX-License-Identifier: MIT
"""Draws the paper's figures of one scan of a fused bag: superpixels and share (2), score maps before
and after (3), points in the images without and with the mask (5), panorama and top views (6)."""

import argparse
import os
import sys

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))

from semantic_lidar_fusion import cli  # noqa: E402


def make_parser():
    parser = argparse.ArgumentParser(
        description=__doc__,
        epilog="First: fuse_bag IN.bag FUSED.bag --rig FILE --all; then: make_figures.py FUSED.bag "
        "--source IN.bag --rig FILE --out figures",
    )
    parser.add_argument("bag", metavar="FUSED.bag", help="written by fuse_bag --all")
    parser.add_argument(
        "--rig", metavar="FILE", help="the rig file (default: the rig that FUSED.bag tells)"
    )
    parser.add_argument(
        "--source", metavar="IN.bag", help="the bag that was fused: images, camera_info and tf"
    )
    parser.add_argument(
        "--out", metavar="DIR", default="figures", help="folder of the PNGs (default: figures)"
    )
    parser.add_argument(
        "--scan", metavar="N", type=int, help="number of the scan, from 0 (default: the middle one)"
    )
    parser.add_argument(
        "--camera", metavar="NAME", help="for figures 2 and 3 (default: the first with data)"
    )
    parser.add_argument(
        "--figures",
        metavar="N,...",
        type=_figures,
        default=("2", "3", "5", "6"),
        help="which ones (default: 2,3,5,6)",
    )
    parser.add_argument("--force", action="store_true", help="replace earlier figures")
    return parser


def _figures(text):
    chosen = tuple(text.split(","))
    if not set(chosen) <= {"2", "3", "5", "6"}:
        raise argparse.ArgumentTypeError("must be of 2, 3, 5 and 6")
    return chosen


def main():
    options = make_parser().parse_args()
    cli.require("numpy", "scipy", "yaml", "rosbag", "matplotlib", "cv2")
    from semantic_lidar_fusion.figures import paper_figures
    from semantic_lidar_fusion.errors import DataError
    from semantic_lidar_fusion.rig import Rig

    if not options.force and os.path.isdir(options.out):
        old = [name for name in os.listdir(options.out) if name.startswith("figure")]
        if old:
            raise DataError("%s: holds %s; --force replaces them" % (options.out, min(old)))
    rig = Rig.load(options.rig) if options.rig else None
    scene = paper_figures.load_scene(options.bag, options.source, rig, options.scan)
    for path in paper_figures.make(scene, options.out, options.figures, options.camera):
        print(path)


if __name__ == "__main__":
    cli.run(main)
