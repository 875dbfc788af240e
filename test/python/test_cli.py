# SPDX-License-Identifier: MIT
"""Commands: help without ROS, one-line errors, exit codes."""

import os
import subprocess
import sys

import pytest

from semantic_lidar_fusion import cli
from semantic_lidar_fusion.errors import DataError

SOURCE_DIR = os.path.abspath(os.path.join(os.path.dirname(__file__), "..", ".."))
SCRIPT = os.path.join(SOURCE_DIR, "scripts", "import_dataset.py")


def run_bare(*arguments):
    """An interpreter without site packages: no numpy, no ROS."""
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    return subprocess.run(
        [sys.executable, "-S", SCRIPT] + list(arguments),
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        universal_newlines=True,
    )


@pytest.mark.parametrize("arguments", [[], ["kitti"], ["semantickitti"], ["rellis"]])
def test_help_needs_neither_numpy_nor_ros(arguments):
    done = run_bare(*arguments, "--help")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("usage:") and not done.stderr


def test_missing_module_is_one_line_with_the_interpreter():
    done = run_bare("kitti", "nowhere", "out.bag")
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert "cannot import numpy" in done.stderr and sys.executable in done.stderr


def test_missing_rosbag_is_one_line(tmp_path):
    (tmp_path / "rosbag.py").write_text("raise ImportError('No module named rosbag')\n")
    environment = dict(os.environ, PYTHONPATH=str(tmp_path))
    done = subprocess.run(
        [sys.executable, SCRIPT, "kitti", "nowhere", "out.bag"],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        universal_newlines=True,
    )
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert "cannot import rosbag" in done.stderr and sys.executable in done.stderr


@pytest.mark.parametrize("arguments", [["kitti"], ["mars", "a", "b"], []])
def test_wrong_usage_exits_2(arguments):
    done = run_bare(*arguments)
    assert done.returncode == 2 and "usage:" in done.stderr


def leave(main, capsys):
    with pytest.raises(SystemExit) as leaving:
        cli.run(main)
    return leaving.value.code, capsys.readouterr().err


def test_known_errors_are_one_line(capsys):
    def main():
        raise DataError("file.bin: no such file")

    code, err = leave(main, capsys)
    assert code == 1
    assert err.endswith(": error: file.bin: no such file\n") and err.count("\n") == 1


def test_unknown_errors_show_their_trace():
    with pytest.raises(ZeroDivisionError):
        cli.run(lambda: 1 // 0)


def test_interrupt_and_success(capsys):
    def interrupted():
        raise KeyboardInterrupt

    code, err = leave(interrupted, capsys)
    assert code == 130 and err.count("\n") == 1
    assert leave(lambda: None, capsys)[0] == 0
    assert leave(lambda: 3, capsys)[0] == 3


def test_progress_passes_everything_on():
    assert list(cli.progress(range(5), 5, "x")) == [0, 1, 2, 3, 4]
