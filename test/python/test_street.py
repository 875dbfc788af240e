# SPDX-License-Identifier: MIT
"""The whole chain on the simulated street: exact where it can be, better step by step elsewhere."""

import csv
import os
import subprocess

import numpy as np
import pytest

rosbag = pytest.importorskip("rosbag")

from conftest import SOURCE_DIR  # noqa: E402
from semantic_lidar_fusion.rig import Rig  # noqa: E402
from semantic_lidar_fusion.evaluation import scoring  # noqa: E402

BIN_DIR = os.environ.get("SLF_BIN_DIR", "")
PROGRAMS = [os.path.join(BIN_DIR, name) for name in ("simulate_drive", "fuse_bag")]
pytestmark = pytest.mark.skipif(
    not all(os.access(program, os.X_OK) for program in PROGRAMS),
    reason="simulate_drive or fuse_bag is not built (Embree is absent)",
)
RIG = os.path.join(SOURCE_DIR, "config", "demo.yaml")


def run(*command):
    done = subprocess.run([str(word) for word in command], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_nothing_is_wrong_where_nothing_is_uncertain(tmp_path):
    """Exact odometry, a perfect network, no range noise, a standing street: every point that its
    cameras really see, further than 1.5 px from a class edge, gets its own class."""
    bag, fused = tmp_path / "exact.bag", tmp_path / "fused.bag"
    simulate = [PROGRAMS[0], "--out", bag, "--duration", "0.3", "--scale", "0.3", "--quiet"]
    run(*(simulate + ["--exact", "--static", "--speed", "15"]))
    run(PROGRAMS[1], bag, fused, "--rig", RIG, "--quiet", "--set", "smoothing.iterations=0")
    rig = Rig.load(RIG)
    truth = scoring.Truth(str(bag), len(rig.labels))
    clouds = scoring.FusedBag(str(fused), rig.labels.names)
    score = scoring.Score("exact", rig.labels, 1.5)
    names = [camera.name for camera in rig.cameras]
    checked, wrong = np.zeros(len(names), int), np.zeros(len(names), int)
    for _, cloud, scan in scoring.paired(truth, clouds):
        chosen = score.select(cloud, scan)
        bits = cloud.optional("cameras")
        bad = cloud.label != scan.label
        for index, name in enumerate(names):
            # By its own image: edges in others are of no concern to it.
            here = chosen & (bits >> index & 1).astype(bool)
            assert (scan.points["edge_px_" + name][here] > 1.5).all()
            checked[index] += here.sum()
            wrong[index] += (here & bad).sum()
    assert wrong.tolist() == [0] * len(names)
    # Each of the five cameras has seen its part of three scans.
    assert (checked > 3000).all(), checked


def test_each_step_helps_on_a_fast_drive(tmp_path):
    """With the perfect network, what is left to err is geometry: motion correction and mask must
    both make it less, and F1 of every class must rise from the first to the last."""
    bag = tmp_path / "drive.bag"
    simulate = [PROGRAMS[0], "--out", bag, "--duration", "0.3", "--scale", "0.3", "--quiet"]
    run(*(simulate + ["--perfect-network", "--static", "--speed", "15"]))
    rig = Rig.load(RIG)
    truth = scoring.Truth(str(bag), len(rig.labels))
    scores = []
    targets = {
        entry.name: scoring.FuseTarget(str(tmp_path / (entry.name + ".bag")), entry.settings)
        for entry in scoring.configurations(rig)
    }
    scoring.run_fuse_bag(PROGRAMS[1], str(bag), RIG, list(targets.values()))
    for name, target in targets.items():
        clouds = scoring.FusedBag(target.path, rig.labels.names)
        scores.append(scoring.score_bag(name, clouds, truth, rig.labels))
    accuracy = [score.confusion.accuracy for score in scores]
    assert accuracy[0] < accuracy[1] < accuracy[-1]
    first, last = scores[0].confusion, scores[-1].confusion
    present = last.support > 100
    assert present.sum() >= 6
    assert (last.f1[present] > first.f1[present]).all()


def test_bounds_take_visibility_and_odometry_from_the_truth(tmp_path, run_command):
    """With the true visibility no camera labels what it does not see, and misses nothing of what
    lies in its image and it sees; F1* can only gain by it where the network is perfect."""
    bag, out = tmp_path / "drive.bag", tmp_path / "out"
    simulate = [PROGRAMS[0], "--out", bag, "--duration", "0.3", "--scale", "0.3", "--quiet"]
    run(*(simulate + ["--perfect-network", "--static"]))
    code, text, err = run_command(
        "evaluate.py", bag, "--rig", RIG, "--bounds", "--keep-bags", "--out", out
    )
    assert code == 0, err
    with open(str(out / "summary.csv")) as file:
        counts = {row["configuration"]: row for row in csv.DictReader(file)}
    assert list(counts)[3:] == ["package", "true_visibility", "true_odometry", "true_both"]
    star = {name: float(row["mean_f1_star"]) for name, row in counts.items()}
    assert star["motion_mask"] < star["package"] < star["true_visibility"]
    # The simulated odometry is good: to know it exactly moves a few points over a border.
    assert star["true_both"] == pytest.approx(star["true_visibility"], abs=0.002)
    assert star["true_both"] > 0.97
    rig = Rig.load(RIG)
    truth = scoring.Truth(str(bag), len(rig.labels))
    clouds = scoring.FusedBag(str(out / "true_both.bag"), rig.labels.names)
    seen = 0
    for _, cloud, scan in scoring.paired(truth, clouds):
        visible, bits = scan.flags("visible"), cloud.optional("cameras")
        assert not (bits & ~visible).any()
        seen += int((bits != 0).sum())
        # At a border a point may be on either side: projections differ by rounding.
        assert ((visible & ~bits) != 0).mean() < 0.001
    assert seen > 10000
    assert "true_both: F1*" in text
