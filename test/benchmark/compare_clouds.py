#!/usr/bin/python3
# SPDX-License-Identifier: MIT
"""How far the semantic clouds of two bags of fuse_bag differ, point by point: the share of the points
whose label, share of probabilities or status is another.

  compare_clouds.py whole.bag bands.bag
"""

import argparse
import os
import sys

import numpy as np

PACKAGE = os.path.join(os.path.dirname(os.path.abspath(__file__)), "..", "..")
sys.path.insert(0, os.path.join(PACKAGE, "scripts"))

STEPS = (0.0, 0.01, 0.05, 0.2)  # of the largest difference of a point's probabilities


def make_parser():
    parser = argparse.ArgumentParser(description=__doc__.split(":\n")[0].split(": ")[0])
    parser.add_argument("bags", nargs=2, metavar="BAG")
    return parser


def probabilities(points):
    names = [name for name in points.dtype.names if name.startswith("p_")]
    return np.stack([points[name] for name in names], axis=1)


def main(arguments=None):
    args = make_parser().parse_args(arguments)
    from semantic_lidar_fusion.bags.clouds import Clouds

    fused = points = labels = statuses = scans = 0
    above = np.zeros(len(STEPS), int)
    with Clouds(args.bags[0]) as first, Clouds(args.bags[1]) as second:
        for a, b in zip(first, second):
            if a.stamp_ns != b.stamp_ns or len(a.points) != len(b.points):
                sys.exit("%s: other scans than %s" % (args.bags[1], args.bags[0]))
            scans += 1
            points += len(a.points)
            statuses += int((a.points["status"] != b.points["status"]).sum())
            both = (a.points["status"] == 0) & (b.points["status"] == 0)
            fused += int(both.sum())
            labels += int((a.points["label"] != b.points["label"])[both].sum())
            change = np.abs(probabilities(a.points)[both] - probabilities(b.points)[both])
            above += [int((change.max(axis=1, initial=0.0) > step).sum()) for step in STEPS]
    print("%d scans, %d points, %d of them fused in both" % (scans, points, fused))
    print("status: %.3f %% of the points differ" % (100.0 * statuses / max(points, 1)))
    print("label: %.3f %% of the fused points differ" % (100.0 * labels / max(fused, 1)))
    for step, count in zip(STEPS, above):
        print(
            "probability: %.3f %% of the fused points differ by more than %g"
            % (100.0 * count / max(fused, 1), step)
        )


if __name__ == "__main__":
    main()
