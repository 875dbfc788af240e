# SPDX-License-Identifier: MIT
"""Commands: help without ROS, one-line errors, exit codes."""

import glob
import os
import re
import shlex
import signal
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


def test_unknown_errors_are_one_line_with_their_place(capsys, monkeypatch):
    monkeypatch.delenv("SLF_TRACEBACK", raising=False)
    code, err = leave(lambda: 1 // 0, capsys)
    assert code == 1 and err.count("\n") == 1
    assert "unexpected ZeroDivisionError at test_cli.py:" in err and "SLF_TRACEBACK=1" in err
    monkeypatch.setenv("SLF_TRACEBACK", "1")
    assert "Traceback" in leave(lambda: 1 // 0, capsys)[1]


COMMANDS = sorted(
    os.path.basename(path)
    for path in glob.glob(os.path.join(SOURCE_DIR, "scripts", "*.py"))
    if "cli.run(main)" in open(path).read()
)


@pytest.mark.parametrize("script", COMMANDS)
def test_every_command_knows_its_version(script):
    done = subprocess.run(
        [sys.executable, os.path.join(SOURCE_DIR, "scripts", script), "--version"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        universal_newlines=True,
    )
    assert done.returncode == 0, done.stderr
    with open(os.path.join(SOURCE_DIR, "package.xml")) as file:
        wanted = re.search("<version>(.*)</version>", file.read()).group(1)
    assert done.stdout == "%s %s\n" % (script, wanted)


def small_program(body):
    return [
        sys.executable,
        "-c",
        "import sys; sys.path.insert(0, %r); sys.argv[0] = 'small'\n"
        "from semantic_lidar_fusion import cli\n%s\ncli.run(main)\n"
        % (os.path.join(SOURCE_DIR, "scripts"), body),
    ]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGINT])
def test_signals_end_it_as_control_c_does(number, tmp_path):
    body = (
        "import os, time\nfrom semantic_lidar_fusion.files import AtomicFile\n"
        "def main():\n    file = AtomicFile(%r)\n    try:\n        print('ready', flush=True)\n"
        "        time.sleep(60)\n    finally:\n        file.discard()" % str(tmp_path / "a")
    )
    process = subprocess.Popen(
        small_program(body),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        universal_newlines=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    assert process.stdout.readline() == "ready\n"
    process.send_signal(number)
    err = process.communicate(timeout=30)[1]
    assert process.returncode == 128 + number and err.count("\n") == 1, err
    assert os.listdir(str(tmp_path)) == []


def test_nohup_holds():
    body = (
        "import os, signal\ndef main():\n    os.kill(os.getpid(), signal.SIGHUP)\n    print('on')"
    )
    done = subprocess.run(
        small_program(body),
        stdout=subprocess.PIPE,
        preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_IGN),
    )
    assert (done.returncode, done.stdout) == (0, b"on\n")


@pytest.mark.parametrize("closed", ["<&-", ">&-", "2>&-", "<&- >&- 2>&-"])
def test_closed_streams_do_not_become_files(tmp_path, closed):
    body = (
        "def main():\n    file = open(%r, 'w')\n    print('out')\n"
        "    print('err', file=sys.stderr)\n    file.write('data')" % str(tmp_path / "a")
    )
    command = " ".join(map(shlex.quote, small_program(body))) + " " + closed
    done = subprocess.run(["sh", "-c", command], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "a").read_text() == "data"


def test_a_full_stdout_is_one_line_and_an_early_reader_none():
    body = "def main():\n    print('x' * 100000)"
    with open("/dev/full", "w") as full:
        done = subprocess.run(small_program(body), stdout=full, stderr=subprocess.PIPE)
    assert done.returncode == 1
    assert done.stderr == b"small: error: stdout: No space left on device\n"
    process = subprocess.Popen(small_program(body), stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    process.stdout.close()
    assert process.stderr.read() == b"" and process.wait() == 141
    process.stderr.close()


def test_interrupt_and_success(capsys):
    def interrupted():
        raise KeyboardInterrupt

    code, err = leave(interrupted, capsys)
    assert code == 130 and err.count("\n") == 1
    assert leave(lambda: None, capsys)[0] == 0
    assert leave(lambda: 3, capsys)[0] == 3


def test_progress_passes_everything_on():
    assert list(cli.progress(range(5), 5, "x")) == [0, 1, 2, 3, 4]


def test_texts_of_messages_become_one_short_printable_line():
    from semantic_lidar_fusion.texts import plain_text

    assert plain_text("/velodyne_link") == "/velodyne_link"
    assert plain_text("Straße 3") == "Straße 3"
    assert plain_text("a\nb\x1b[31m\u2028") == r"a\nb\x1b[31m\u2028"
    long = plain_text("x" * 1000000)
    assert len(long) < 120 and "1000000 characters" in long
