#!/usr/bin/python3
# SPDX-License-Identifier: MIT
"""Damages a small drive at random and runs every command on it: each run must end in a whole result
or in one line, without a signal, a trace, a hang, or more than 2 GB.

  SLF_BIN_DIR=build/devel/lib/semantic_lidar_fusion test/python/damage.py --flips 500 --cuts 20

A flip turns one bit of a file, half of the time near the record headers of a bag; a cut leaves away
the rest of a file from some byte on. Both are drawn from --seed.
"""

import argparse
import importlib.util
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
from typing import Callable, Dict, List, NamedTuple, Optional

SOURCE_DIR = os.path.abspath(os.path.join(os.path.dirname(__file__), "..", ".."))
sys.path[:0] = [os.path.join(SOURCE_DIR, "scripts"), os.path.dirname(os.path.abspath(__file__))]
BIN_DIR = os.environ.get("SLF_BIN_DIR", "")
LONGEST_S = 60  # of CPU time, which does not depend on what else runs
LONGEST_WAIT_S = 300
MOST_BYTES = 2 * 10**9


class Case(NamedTuple):
    """A command whose input `damaged` (a file below the drive's folder) is damaged."""

    command: str
    damaged: str
    arguments: Callable[[str, str], List[str]]  # of the folder with the input, and the output
    result: str  # below the output's folder: exists if and only if the run was a success


class Outcome(NamedTuple):
    code: int
    errors: str
    seconds: float  # of CPU time
    most_bytes: int
    has_result: bool


def make_drive(folder: str) -> Dict[str, List[Case]]:
    """Writes the drive, its fused bag and a KITTI drive; returns the cases of each command."""
    import bag_factory
    import dataset_factory
    import subprocess
    from test_evaluation import add_truth

    drive = bag_factory.Drive(scans=2, points_per_scan=800)
    bag, rig, fused = (os.path.join(folder, n) for n in ("drive.bag", "rig.yaml", "fused.bag"))
    bag_factory.write_bag(bag, drive)
    add_truth(bag, drive)
    with open(rig, "w") as file:
        file.write(bag_factory.rig_text(drive))
    program = os.path.join(BIN_DIR, "fuse_bag")
    subprocess.run([program, bag, fused, "--rig", rig, "--all", "--tf", "--quiet"], check=True)
    kitti = os.path.relpath(dataset_factory.kitti(os.path.join(folder, "kitti")), folder)

    def of(name: str, *words: str) -> Callable[[str, str], List[str]]:
        """A command line; {in} and {out} are folders."""
        return lambda source, out: [
            w.replace("{in}", source).replace("{out}", out) for w in (name,) + words
        ]

    rig_option = ("--rig", "{in}/rig.yaml")
    cases = {
        "fuse_bag": [
            Case(
                "fuse_bag",
                name,
                of(program, "{in}/drive.bag", "{out}/o.bag", "--quiet", *rig_option),
                "o.bag",
            )
            for name in ("drive.bag", "drive.bag", "drive.bag", "rig.yaml")
        ],
        "build_semantic_map.py": [
            Case(
                "build_semantic_map.py",
                "fused.bag",
                of("build_semantic_map.py", "{in}/fused.bag", "--out", "{out}/map"),
                "map",
            )
        ],
        "evaluate.py": [
            Case(
                "evaluate.py",
                name,
                of("evaluate.py", "{in}/drive.bag", "--clouds", "a={in}/fused.bag")
                if clouds
                else of("evaluate.py", "{in}/drive.bag", "--paper", *rig_option),
                "evaluation/report.md",
            )
            for name, clouds in (("drive.bag", True), ("fused.bag", True), ("drive.bag", False))
        ],
        "make_figures.py": [
            Case(
                "make_figures.py",
                name,
                of("make_figures.py", "{in}/fused.bag", "--source", "{in}/drive.bag")
                if name != "rig.yaml"
                else of("make_figures.py", "{in}/fused.bag", *rig_option),
                "figures",
            )
            for name in ("drive.bag", "fused.bag", "rig.yaml")
        ],
    }
    names = [
        os.path.relpath(os.path.join(where, name), folder)
        for where, _, found in os.walk(os.path.join(folder, os.path.dirname(kitti)))
        for name in found
    ]
    cases["import_dataset.py"] = [
        Case(
            "import_dataset.py",
            name,
            of("import_dataset.py", "kitti", "{in}/" + kitti, "{out}/o.bag"),
            "o.bag",
        )
        for name in sorted(names)
    ]
    return cases


def damage(data: bytes, cut: bool, draw: random.Random) -> bytes:
    """The bytes with one bit turned, or without their end."""
    if not data:
        return data
    if cut:
        return data[: draw.randrange(len(data))]
    place = draw.randrange(len(data))
    heads = [at for at in _occurrences(data, b"op=")]
    if heads and draw.random() < 0.5:
        place = min(len(data) - 1, max(0, draw.choice(heads) + draw.randrange(-60, 60)))
    changed = bytearray(data)
    changed[place] ^= 1 << draw.randrange(8)
    return bytes(changed)


def _occurrences(data: bytes, word: bytes) -> List[int]:
    found, at = [], data.find(word)
    while at >= 0:
        found.append(at)
        at = data.find(word, at + 1)
    return found


def _main_of(script: str) -> Callable[[], Optional[int]]:
    path = os.path.join(SOURCE_DIR, "scripts", script)
    specification = importlib.util.spec_from_file_location("damaged_" + script[:-3], path)
    assert specification is not None and specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    main: Callable[[], Optional[int]] = module.main
    return main


def _become(words: List[str], folder: str, errors_path: str) -> None:
    """In the child process: runs a command in a folder, and never comes back."""
    os.chdir(folder)
    null = os.open(os.devnull, os.O_RDWR)
    errors = os.open(errors_path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(null, 0)
    os.dup2(null, 1)
    os.dup2(errors, 2)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    if not words[0].endswith(".py"):
        os.execv(words[0], words)
    from semantic_lidar_fusion import cli

    # A test runner has streams of its own in their place.
    sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w", 1)
    sys.argv = [os.path.join(SOURCE_DIR, "scripts", words[0])] + words[1:]
    cli.run(_main_of(words[0]))


def run(case: Case, source: str) -> Outcome:
    """Runs the command of a case on the folder `source`, in a child that shares our imports."""
    out = tempfile.mkdtemp(prefix="out_")
    errors_path = os.path.join(out, "errors.txt")
    words = case.arguments(source, out)
    child = os.fork()
    if child == 0:
        code = 70
        try:
            os.setpgid(0, 0)
            signal.signal(signal.SIGINT, signal.default_int_handler)
            _become(words, out, errors_path)
        except SystemExit as leaving:
            code = int(leaving.code or 0)
        finally:
            os._exit(code)
    status, usage = _wait(child, time.monotonic() + LONGEST_WAIT_S)
    try:
        with open(errors_path, encoding="utf-8", errors="replace") as file:
            errors = file.read()
        return Outcome(
            -os.WTERMSIG(status) if os.WIFSIGNALED(status) else os.WEXITSTATUS(status),
            errors,
            usage.ru_utime + usage.ru_stime,
            usage.ru_maxrss * 1024,
            os.path.exists(os.path.join(out, case.result)),
        )
    finally:
        shutil.rmtree(out, ignore_errors=True)


def _wait(child: int, until: float):  # type: ignore[no-untyped-def]
    while True:
        pid, status, usage = os.wait4(child, os.WNOHANG)
        if pid:
            return status, usage
        if time.monotonic() > until:
            os.killpg(child, signal.SIGKILL)
            _, status, usage = os.wait4(child, 0)
            return status, usage
        time.sleep(0.005)


def faults(outcome: Outcome) -> List[str]:
    """What is wrong with how a run ended; empty if nothing is."""
    found = []
    lines = [line for line in outcome.errors.splitlines() if line.strip()]
    told = [line for line in lines if "error:" in line]
    if outcome.seconds > LONGEST_S or outcome.code == -signal.SIGKILL:
        found.append("hangs")
    elif outcome.code < 0:
        found.append("ended by signal %d" % -outcome.code)
    elif outcome.code not in (0, 1):
        found.append("exit code %d" % outcome.code)
    if "Traceback" in outcome.errors or "error: unexpected " in outcome.errors:
        found.append("a trace")
    if outcome.most_bytes > MOST_BYTES:
        found.append("%.1f GB" % (outcome.most_bytes * 1e-9))
    if outcome.code == 0 and not outcome.has_result:
        found.append("success without a result")
    if outcome.code == 1 and outcome.has_result:
        found.append("a result in spite of the error")
    if outcome.code == 1 and len(told) != 1:
        found.append("%d lines of error" % len(told))
    return found


class Summary(NamedTuple):
    runs: int
    refused: int  # ended in one line
    faults: List[str]
    longest_s: float
    most_bytes: int


def campaign(
    flips: int, cuts: int, seed: int, commands: Optional[List[str]] = None, every: bool = False
) -> Summary:
    """Runs `flips` and `cuts`, drawn from `seed`, turn by turn on the commands; with `every` that
    many on each of them."""
    folder = tempfile.mkdtemp(prefix="slf_damage_")
    draw = random.Random(seed)
    try:
        whole = os.path.join(folder, "whole")
        os.makedirs(whole)
        cases = make_drive(whole)
        chosen = commands or list(cases)
        for script in chosen:  # import once what the children use
            if script.endswith(".py"):
                _main_of(script)
        _import_all()
        kinds = [False] * flips + [True] * cuts
        plan = [(name, cut) for name in chosen for cut in kinds] if every else []
        plan = plan or [(chosen[i % len(chosen)], cut) for i, cut in enumerate(kinds)]
        for name in chosen:
            outcome = run(cases[name][0], whole)
            assert outcome.code == 0 and outcome.has_result, (name, outcome)
        found: List[str] = []
        refused, longest, most = 0, 0.0, 0
        for number, (name, cut) in enumerate(plan):
            case = draw.choice(cases[name])
            path = os.path.join(whole, case.damaged)
            with open(path, "rb") as file:
                data = file.read()
            try:
                with open(path, "wb") as file:
                    file.write(damage(data, cut, draw))
                outcome = run(case, whole)
            finally:
                with open(path, "wb") as file:
                    file.write(data)
            refused += outcome.code == 1
            longest, most = max(longest, outcome.seconds), max(most, outcome.most_bytes)
            for fault in faults(outcome):
                kind = "cut" if cut else "flip"
                text = "run %d (%s, %s of %s): %s\n%s"
                text %= (number, name, kind, case.damaged, fault, outcome.errors[-600:])
                found.append(text)
                print(text, file=sys.stderr, flush=True)
        return Summary(len(plan), refused, found, longest, most)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def summary_text(summary: Summary) -> str:
    return "%d runs, %d refused in one line, %d faults; longest %.1f s, most memory %.0f MB" % (
        summary.runs,
        summary.refused,
        len(summary.faults),
        summary.longest_s,
        summary.most_bytes * 1e-6,
    )


def _import_all() -> None:
    import cv2  # noqa: F401
    import rosbag  # noqa: F401
    import sensor_msgs.msg  # noqa: F401
    import tf2_msgs.msg  # noqa: F401

    from semantic_lidar_fusion.datasets import kitti, writer  # noqa: F401
    from semantic_lidar_fusion.evaluation import run as evaluation  # noqa: F401
    from semantic_lidar_fusion.figures import paper_figures, plotting
    from semantic_lidar_fusion.maps import run as maps  # noqa: F401

    plotting.pyplot()


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--flips", type=int, default=500, help="on each command (default: 500)")
    parser.add_argument("--cuts", type=int, default=20, help="on each command (default: 20)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("commands", nargs="*", help="only these (default: all)")
    options = parser.parse_args()
    summary = campaign(options.flips, options.cuts, options.seed, options.commands or None, True)
    print(summary_text(summary))
    return 1 if summary.faults else 0


if __name__ == "__main__":
    sys.exit(main())
