#!/usr/bin/python3
# SPDX-License-Identifier: MIT
"""One HTML file of a fused bag: points by status and class, scan by scan, a view of a scan and of the
map, and the settings. It needs no network and no other file."""

import argparse
import os
import sys

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))

from semantic_lidar_fusion import cli  # noqa: E402


def make_parser():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("bag", metavar="FUSED.bag", help="what fuse_bag has written")
    parser.add_argument(
        "--out", metavar="FILE", help="the page to write (default: FUSED.html beside the bag)"
    )
    parser.add_argument(
        "--fixed-frame", metavar="FRAME", help="of the map (default: that of the bag's own rig)"
    )
    parser.add_argument("--quiet", action="store_true", help="do not name the page that is written")
    return parser


def main():
    options = make_parser().parse_args()
    cli.require("numpy", "scipy", "yaml", "rosbag")
    from semantic_lidar_fusion.bags.bag_io import write_text
    from semantic_lidar_fusion.evaluation import html_report

    out = options.out or os.path.splitext(options.bag)[0] + ".html"
    title = os.path.basename(options.bag)
    parts = ["<h1>%s</h1>" % html_report.html.escape(title)]
    parts += html_report.bag_parts(options.bag, options.fixed_frame)
    write_text(out, html_report.page(title, parts))
    if not options.quiet:
        print("%s: %.1f MB" % (out, os.path.getsize(out) / 1e6))


if __name__ == "__main__":
    cli.run(main)
