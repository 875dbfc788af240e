# SPDX-License-Identifier: MIT
"""The tools on bags that are truncated, unindexed, empty, no bags, or may not be written; on a disk
that is full; and interrupted: one line that names the file, and no half of a result."""

import hashlib
import os
import resource
import signal
import struct
import subprocess
import sys
import time
import zlib

import numpy as np
import pytest

bag_factory = pytest.importorskip("bag_factory")
pytest.importorskip("matplotlib")
pytest.importorskip("cv2")
import dataset_factory  # noqa: E402
from command_line import assert_one_line  # noqa: E402
from conftest import SOURCE_DIR  # noqa: E402

BIN_DIR = os.environ.get("SLF_BIN_DIR", "")
needs_fuse_bag = pytest.mark.skipif(
    not os.access(os.path.join(BIN_DIR, "fuse_bag"), os.X_OK), reason="fuse_bag is not built"
)
needs_simulator = pytest.mark.skipif(
    not os.access(os.path.join(BIN_DIR, "simulate_drive"), os.X_OK),
    reason="simulate_drive is not built (Embree is absent)",
)


class Room:
    """A small drive with its rig and, for each kind of damage, a bag."""

    def __init__(self, path):
        drive = bag_factory.Drive(scans=2, points_per_scan=800)
        self.bag = str(path / "drive.bag")
        self.rig = str(path / "rig.yaml")
        bag_factory.write_bag(self.bag, drive)
        with open(self.rig, "w") as file:
            file.write(bag_factory.rig_text(drive))
        with open(self.bag, "rb") as file:
            whole = file.read()
        self.damaged = {}
        for name, data in {
            "truncated_header": whole[:40],
            "truncated_half": whole[: len(whole) // 2],
            "truncated_index": whole[:-200],
            "no_bytes": b"",
            "no_bag": b"#!/bin/sh\necho hello\n" * 20,
            "another_version": whole.replace(b"#ROSBAG V2.0", b"#ROSBAG V9.9", 1),
        }.items():
            self.damaged[name] = str(path / (name + ".bag"))
            with open(self.damaged[name], "wb") as file:
                file.write(data)
        # As a recorder leaves it that was killed: the header still points at no index.
        self.damaged["unindexed"] = str(path / "unindexed.bag")
        with open(self.damaged["unindexed"], "wb") as file:
            position = whole.find(b"index_pos=") + len(b"index_pos=")
            cut = int.from_bytes(whole[position : position + 8], "little")
            file.write(whole[:position] + bytes(8) + whole[position + 8 : cut])
        self.damaged["no_messages"] = str(path / "no_messages.bag")
        import rosbag

        rosbag.Bag(self.damaged["no_messages"], "w").close()
        self.damaged["absent"] = str(path / "absent.bag")
        self.damaged["a_folder"] = str(path)


DAMAGES = (
    "truncated_header",
    "truncated_half",
    "truncated_index",
    "no_bytes",
    "no_bag",
    "another_version",
    "unindexed",
    "no_messages",
    "absent",
    "a_folder",
)


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    return Room(tmp_path_factory.mktemp("room"))


def files_below(folder):
    return sorted(
        os.path.join(where, name) for where, _, names in os.walk(str(folder)) for name in names
    )


def digest(path):
    with open(path, "rb") as file:
        return hashlib.sha1(file.read()).hexdigest()


@pytest.mark.parametrize("damage", DAMAGES)
def test_evaluate(room, tmp_path, run_command, damage):
    bag, out = room.damaged[damage], tmp_path / "out"
    code, _, errors = run_command(
        "evaluate.py", room.bag, "--clouds", "x=" + bag, "--truth", bag, "--out", out
    )
    assert_one_line(code, errors, os.path.basename(bag))
    assert files_below(out) == []


@needs_fuse_bag
@pytest.mark.parametrize("damage", ("truncated_half", "unindexed", "no_messages", "absent"))
def test_evaluate_runs_fuse_bag_on_it(room, tmp_path, run_command, damage):
    bag, out = room.damaged[damage], tmp_path / "out"
    code, _, errors = run_command("evaluate.py", bag, "--rig", room.rig, "--out", out)
    assert_one_line(code, errors, os.path.basename(bag))
    assert files_below(out) == []


@pytest.mark.parametrize("damage", DAMAGES)
def test_make_figures(room, tmp_path, run_command, damage):
    bag, out = room.damaged[damage], tmp_path / "out"
    code, _, errors = run_command("make_figures.py", bag, "--rig", room.rig, "--out", out)
    assert_one_line(code, errors, os.path.basename(bag))
    assert files_below(out) == []


def command(script, *arguments):
    return [sys.executable, os.path.join(SOURCE_DIR, "scripts", script)] + [
        str(argument) for argument in arguments
    ]


@pytest.fixture(scope="module")
def kitti(tmp_path_factory):
    path = tmp_path_factory.mktemp("kitti")
    return str(dataset_factory.kitti(path))


def limited(most_bytes):
    """For preexec_fn: no file may grow beyond; what a full disk looks like to a program."""

    def limit():
        resource.setrlimit(resource.RLIMIT_FSIZE, (most_bytes, most_bytes))

    return limit


def test_import_dataset_on_a_full_disk(kitti, tmp_path):
    done = subprocess.run(
        command("import_dataset.py", "kitti", kitti, tmp_path / "out.bag"),
        capture_output=True,
        text=True,
        preexec_fn=limited(5000),
    )
    assert_one_line(done.returncode, done.stderr, "out.bag")
    assert files_below(tmp_path) == []


def interrupt(arguments, started):
    """Runs, waits until `started()`, and sends what Ctrl-C sends; (code, stderr)."""
    process = subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 60
    while not started():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.002)
    process.send_signal(signal.SIGINT)
    errors = process.communicate(timeout=60)[1]
    return process.returncode, errors


def test_import_dataset_interrupted(kitti, tmp_path):
    # A fifo in place of a scan: the import waits in it until it is interrupted.
    scans = sorted(path for path in files_below(kitti) if "velodyne_points/data/" in path)
    moved = scans[-1] + ".moved"
    os.rename(scans[-1], moved)
    os.mkfifo(scans[-1])
    try:
        code, errors = interrupt(
            command("import_dataset.py", "kitti", kitti, tmp_path / "out.bag"),
            lambda: any(os.path.getsize(path) > 0 for path in files_below(tmp_path)),
        )
    finally:
        os.remove(scans[-1])
        os.rename(moved, scans[-1])
    assert code == 130 and errors.strip().splitlines()[-1].endswith("interrupted"), errors
    assert files_below(tmp_path) == []


@needs_simulator
def test_simulate_drive_on_a_full_disk(tmp_path):
    done = subprocess.run(
        [os.path.join(BIN_DIR, "simulate_drive"), "--out", str(tmp_path / "out.bag")]
        + ["--duration", "0.2", "--scale", "0.1", "--quiet"],
        capture_output=True,
        text=True,
        preexec_fn=limited(20000),
    )
    assert done.returncode == 1
    assert len(done.stderr.strip().splitlines()) == 1 and "out.bag" in done.stderr
    assert files_below(tmp_path) == []


@needs_simulator
def test_simulate_drive_interrupted(tmp_path):
    code, errors = interrupt(
        [os.path.join(BIN_DIR, "simulate_drive"), "--out", str(tmp_path / "out.bag")]
        + ["--duration", "20", "--scale", "0.1", "--quiet"],
        lambda: bool(files_below(tmp_path)),
    )
    assert code == 130 and "interrupted" in errors, errors
    assert files_below(tmp_path) == []


@needs_simulator
def test_simulate_drive_where_it_may_not_write(tmp_path):
    for out in (tmp_path / "no_folder" / "out.bag", tmp_path, "/proc/out.bag"):
        done = subprocess.run(
            [os.path.join(BIN_DIR, "simulate_drive"), "--out", str(out), "--force", "--quiet"]
            + ["--duration", "0.2", "--scale", "0.1"],
            capture_output=True,
            text=True,
        )
        assert done.returncode in (1, 2), out
        assert len(done.stderr.strip().splitlines()) == 1 and str(out) in done.stderr
    assert files_below(tmp_path) == []


@needs_fuse_bag
def test_read_only_bags_are_read_and_stay_as_they_are(room, tmp_path, run_command):
    fused = str(tmp_path / "fused.bag")
    os.chmod(room.bag, 0o444)
    before = digest(room.bag)
    subprocess.run(
        [os.path.join(BIN_DIR, "fuse_bag"), room.bag, fused, "--rig", room.rig, "--all", "--quiet"],
        check=True,
    )
    os.chmod(fused, 0o444)
    fused_before = digest(fused)
    arguments = [fused, "--source", room.bag, "--rig", room.rig, "--figures", "5"]
    code, _, errors = run_command("make_figures.py", *arguments, "--out", tmp_path / "figures")
    assert code == 0, errors
    assert digest(room.bag) == before and digest(fused) == fused_before


@needs_fuse_bag
def test_make_figures_on_a_full_disk(room, tmp_path):
    fused = str(tmp_path / "fused.bag")
    subprocess.run(
        [os.path.join(BIN_DIR, "fuse_bag"), room.bag, fused, "--rig", room.rig, "--all", "--quiet"],
        check=True,
    )
    done = subprocess.run(
        command("make_figures.py", fused, "--source", room.bag, "--rig", room.rig)
        + ["--figures", "5", "--out", str(tmp_path / "figures")],
        capture_output=True,
        text=True,
        preexec_fn=limited(3000),
    )
    assert_one_line(done.returncode, done.stderr, "figure")
    assert files_below(tmp_path / "figures") == []


def test_a_picture_of_absurd_size_is_refused_before_anything_is_decoded(tmp_path):
    cv2 = pytest.importorskip("cv2")
    small = np.zeros((12, 16, 3), np.uint8)
    png = bytearray(cv2.imencode(".png", small)[1].tobytes())
    png[16:24] = struct.pack(">II", 20000, 20000)
    png[29:33] = struct.pack(">I", zlib.crc32(bytes(png[12:29])))
    (tmp_path / "absurd.png").write_bytes(bytes(png))
    (tmp_path / "absurd.pgm").write_bytes(b"P5 20000 20000 255\n" + bytes(1000))
    (tmp_path / "none.png").write_bytes(b"")
    # OpenCV takes its limit when it is loaded, so that this needs a process of its own.
    program = (
        "import sys, resource\n"
        "from semantic_lidar_fusion.errors import DataError\n"
        "from semantic_lidar_fusion.pictures import decoded\n"
        "for name in sys.argv[1:]:\n"
        "    try:\n"
        "        decoded(open(name, 'rb').read(), 'color', name)\n"
        "    except DataError as error:\n"
        "        print(error)\n"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)\n"
    )
    names = ["absurd.png", "absurd.pgm", "none.png"]
    lines = subprocess.run(
        [sys.executable, "-c", program] + names,
        cwd=str(tmp_path),
        env=dict(os.environ, PYTHONPATH=os.pathsep.join(p for p in sys.path if p)),
        stdout=subprocess.PIPE,
        universal_newlines=True,
        check=True,
    ).stdout.splitlines()
    for name, line in zip(names[:2], lines):
        assert line == name + ": not a readable image: more than 67108864 pixels"
    assert lines[2] == "none.png: not a readable image"
    assert int(lines[3]) < 500000  # kB; the pixels are 1.2 GB
