#!/usr/bin/python3
# SPDX-License-Identifier: MIT
"""Damages a network at random and has fuse_bag use it: each run must end whole or in one line,
without a signal, a hang, or more than 2 GB (its check of the network, a process of its own,
included).

  SLF_BIN_DIR=build/devel/lib/semantic_lidar_fusion test/python/damage_networks.py --count 1000

Without --network it is a convolution of three hundred bytes. Most draws turn one to three bits, half
of them near names, where the structure of a large network is; one in eight cuts the file's end off.
All are drawn from --seed.
"""

import argparse
import os
import random
import re
import shutil
import sys
import tempfile
from typing import List, NamedTuple, Optional

import damage

_NEAR = 40  # bytes around a name


class Network(NamedTuple):
    path: Optional[str]  # None: a convolution
    width: int
    height: int


def make_inputs(folder: str, network: Network) -> bytes:
    """Writes a bag without scores, a rig with the network; returns the network's file."""
    import bag_factory
    import onnx_factory

    drive = bag_factory.Drive(scans=1, points_per_scan=200, semantics="none")
    bag_factory.write_bag(os.path.join(folder, "in.bag"), drive)
    with open(os.path.join(folder, "rig.yaml"), "w") as file:
        file.write(bag_factory.rig_text(drive, "segmentation: {model: model.yaml}\n"))
    names = bag_factory.CLASS_NAMES
    with open(os.path.join(folder, "model.yaml"), "w") as file:
        file.write("file: net.onnx\ninput: {width: %d, height: %d}\n" % network[1:])
        file.write("classes: {%s}\n" % ", ".join("%s: [%d]" % (n, i) for i, n in enumerate(names)))
    if network.path is not None:
        with open(network.path, "rb") as source:
            return source.read()
    weights = [[0.1 * i, 0.2, -0.1 * i] for i in range(len(names))]
    return onnx_factory.convolution(network.width, network.height, weights, [0.0] * len(names))


def damaged(data: bytes, draw: random.Random, names: List[int]) -> bytes:
    if draw.random() < 0.125:
        return data[: draw.randrange(len(data))]
    changed = bytearray(data)
    for _ in range(draw.randint(1, 3)):
        place = draw.randrange(len(data))
        if draw.random() < 0.5:
            place = min(max(draw.choice(names) + draw.randint(-_NEAR, _NEAR), 0), len(data) - 1)
        changed[place] ^= 1 << draw.randrange(8)
    return bytes(changed)


def campaign(count: int, seed: int, network: Network) -> damage.Summary:
    """Uses `count` networks that are damaged."""
    folder = tempfile.mkdtemp(prefix="slf_networks_")
    draw = random.Random(seed)
    program = os.path.join(damage.BIN_DIR, "fuse_bag")
    case = damage.Case(
        "fuse_bag",
        "net.onnx",
        lambda source, out: [program, source + "/in.bag", out + "/o.bag", "--quiet"]
        + ["--rig", source + "/rig.yaml"],
        "o.bag",
    )
    try:
        whole = make_inputs(folder, network)
        names = [found.start() for found in re.finditer(rb"[A-Za-z_][A-Za-z_.0-9]{3,}", whole)]
        path = os.path.join(folder, case.damaged)
        found: List[str] = []
        refused, longest, most = 0, 0.0, 0
        for number in range(-1, count):  # the whole one first
            with open(path, "wb") as file:
                file.write(whole if number < 0 else damaged(whole, draw, names))
            outcome = damage.run(case, folder)
            if number < 0:
                assert outcome.code == 0 and outcome.has_result, outcome
                continue
            # Scores of nothing but NaN are a result without classes.
            written = outcome.code == 1 and "no point got a class" in outcome.errors
            faults = damage.faults(outcome._replace(has_result=False) if written else outcome)
            refused += outcome.code == 1
            longest, most = max(longest, outcome.seconds), max(most, outcome.most_bytes)
            for fault in faults:
                found.append("run %d: %s\n%s" % (number, fault, outcome.errors[-600:]))
                print(found[-1], file=sys.stderr, flush=True)
        return damage.Summary(count, refused, found, longest, most)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=1000, help="damaged networks (default: 1000)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--network", metavar="FILE", help="another network")
    parser.add_argument("--size", type=int, nargs=2, default=(32, 24), metavar=("WIDTH", "HEIGHT"))
    options = parser.parse_args()
    network = Network(options.network, options.size[0], options.size[1])
    summary = campaign(options.count, options.seed, network)
    print(damage.summary_text(summary))
    return 1 if summary.faults else 0


if __name__ == "__main__":
    sys.exit(main())
