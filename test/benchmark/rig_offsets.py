#!/usr/bin/python3
# SPDX-License-Identifier: MIT
"""Draws small offsets of two cameras (turns within +-1 deg about each axis, stamps within +-30 ms) on
simulated drives, and prints what check_rig.py finds of them: errors, what it calls not observable,
and verdicts that are false.

An `ok` is false if the true offset is beyond the limit by more than the goal, a `suspect` or `wrong`
if it is within the limit.
"""

import argparse
import os
import subprocess
import sys
import tempfile

HERE = os.path.dirname(os.path.abspath(__file__))
SOURCE_DIR = os.path.dirname(os.path.dirname(HERE))
sys.path[:0] = [os.path.join(SOURCE_DIR, "scripts"), os.path.join(SOURCE_DIR, "test", "python")]

# By axis: name, goal, limit from which a rig is suspect, unit's size, unit.
AXES = (
    ("pitch", 0.4, 0.3, 57.29577951308232, "deg"),
    ("yaw", 0.2, 0.3, 57.29577951308232, "deg"),
    ("roll", 0.5, 0.6, 57.29577951308232, "deg"),
    ("time", 3.0, 5.0, 1e3, "ms"),
)


def make_parser():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--bin-dir", required=True, help="folder of fuse_bag and simulate_drive")
    parser.add_argument("--bags", type=int, default=20)
    parser.add_argument("--streets", type=int, default=4, help="drives that the bags are made of")
    parser.add_argument("--simulate", default="--duration 4 --scale 0.33")
    parser.add_argument("--seed", type=int, default=1)
    return parser


def drawn(random, items, mistakes):
    """(items with offsets, {camera: (4,) pitch yaw roll (rad) time (s) that corrects them})."""
    import copy

    import numpy as np
    from scipy.spatial.transform import Rotation
    from semantic_lidar_fusion.bags.poses import make_transform

    items = copy.deepcopy(items)
    truth = {}
    for name in (mistakes.FRONT, mistakes.LEFT):
        turn = np.radians(random.uniform(-1, 1, 3))
        later = random.uniform(-0.03, 0.03)
        matrix = make_transform(Rotation.from_rotvec(turn).as_matrix(), np.zeros(3))
        mistakes._cameras(lambda m, matrix=matrix: m @ matrix, (name,))(items)
        mistakes._stamps(-later, "/%s/(image/compressed|scores|labels)" % name)(items)
        truth[name] = np.append(turn, later)
    return items, truth


def judge(result, truth, counts):
    """Prints a line for each camera and adds to `counts`."""
    from semantic_lidar_fusion.rigcheck.findings import Verdict

    verdicts = {(f.sensor, f.check): f.verdict for f in result.findings}
    common = verdicts.get(("lidar", "time"), Verdict.OK) >= Verdict.SUSPECT
    for one in result.aligned:
        name, found = one.camera.name, one.result
        parts = []
        for axis, (label, goal, limit, size, unit) in enumerate(AXES):
            true, value = truth[name][axis] * size, found.offset[axis] * size
            verdict = verdicts.get((name, label), Verdict.NOT_OBSERVABLE)
            if label == "time" and common:
                verdict = Verdict.WRONG
            count = counts[label]
            if verdict == Verdict.NOT_OBSERVABLE:
                count["not observable"] += 1
                parts.append("%s n.o. (%+.2f for %+.2f)" % (label, value, true))
                continue
            count["errors"].append(abs(value - true))
            count["beyond the goal"] += abs(value - true) > goal
            count["beyond its half-width"] += abs(value - true) > found.half_width[axis] * size
            count["false ok"] += verdict == Verdict.OK and abs(true) > limit + goal
            count["false suspect"] += verdict >= Verdict.SUSPECT and abs(true) < limit
            parts.append("%s %+.2f for %+.2f %s" % (label, value, true, verdict.text))
        print("  %s: %s; lift %.2f" % (name, ", ".join(parts), found.best.lift), flush=True)
        if one.remedy:
            print("    taken for: " + one.remedy.cause)


def main():
    options = make_parser().parse_args()
    import numpy as np
    import rig_mistakes
    import yaml
    from semantic_lidar_fusion.rig import Rig
    from semantic_lidar_fusion.rigcheck import run
    from semantic_lidar_fusion.rigcheck.sample import sampled

    program = os.path.join(options.bin_dir, "fuse_bag")
    demo = os.path.join(SOURCE_DIR, "config", "demo.yaml")
    classes = os.path.join(SOURCE_DIR, "config", "classes_usyd12.yaml")
    names = ("not observable", "beyond the goal", "beyond its half-width", "false ok")
    counts = {
        axis[0]: dict({name: 0 for name in names + ("false suspect",)}, errors=[]) for axis in AXES
    }
    random = np.random.RandomState(options.seed)
    with tempfile.TemporaryDirectory() as folder:
        drive, raw, bag, rig = (
            os.path.join(folder, name) for name in ("drive.bag", "raw.bag", "in.bag", "rig.yaml")
        )
        with open(rig, "w") as file:
            yaml.safe_dump(rig_mistakes.rig(classes), file)
        tree = Rig.load(rig, [], program)
        for number in range(options.bags):
            if number % -(-options.bags // options.streets) == 0:
                seed = ["--seed", str(100 + number)]
                simulator = os.path.join(options.bin_dir, "simulate_drive")
                simulate = [simulator, "--quiet", "--force", "--out", drive, *seed]
                subprocess.check_call(simulate + options.simulate.split())
                fuse = [program, drive, raw, "--force", "--quiet", "--rig", demo]
                subprocess.check_call(fuse + ["--set", "motion.enabled=false"])
                items = rig_mistakes.plain_bag(drive, raw)
            made, truth = drawn(random, items, rig_mistakes)
            rig_mistakes.write(bag, made)
            print("bag %d" % (number + 1))
            with sampled([bag], rig, tree.tree, [], program) as sample:
                judge(run.check(sample, tree.labels), truth, counts)
    for label, goal, _, _, unit in AXES:
        count = counts[label]
        errors = np.array(count.pop("errors") or [np.nan])
        print(
            "%s: RMS %.2f, largest %.2f %s (goal %.1f); %s"
            % (
                label,
                np.sqrt((errors**2).mean()),
                errors.max(),
                unit,
                goal,
                ", ".join("%s %d" % item for item in count.items()),
            )
        )


if __name__ == "__main__":
    main()
