# SPDX-License-Identifier: MIT
"""The gate must see every kind of false success: seeded evidence, and real runs of rostest."""

import os
import stat
import subprocess
import sys
import textwrap
from concurrent.futures import ThreadPoolExecutor

import pytest

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
import gate  # noqa: E402

PASSING = '<testsuite tests="1"><testcase classname="A" name="b" status="run"/></testsuite>'
ROSTEST = '<launch><test test-name="alpha" pkg="p" type="t" time-limit="10"/></launch>'


def section(name, output="", passed=True):
    """CTest's log of one test, in its own format."""
    return (
        "1/1 Testing: {0}\n1/1 Test: {0}\nCommand: x\n"
        '"{0}" start time: Jan 01 00:00 UTC\nOutput:\n----------\n{1}\n<end of output>\n'
        "Test time =   0.01 sec\n----------\n{2}\n"
        '"{0}" end time: Jan 01 00:00 UTC\n\n'
    ).format(name, output, "Test Passed." if passed else "Test Failed.")


class Build:
    """A build folder with the evidence of tests that never were."""

    def __init__(self, folder):
        self.folder = str(folder)
        self.results = os.path.join(self.folder, "test_results")
        os.makedirs(self.results)
        os.makedirs(os.path.join(self.folder, "Testing", "Temporary"))
        self.rows, self.log = [], ""

    def add(self, name="unit", result=PASSING, output="", passed=True, ran=True, test_file=""):
        path = os.path.join(self.results, name + ".xml")
        if result is not None:
            with open(path, "w") as file:
                file.write(result)
        if ran:
            self.log += section(name, output, passed)
        self.rows.append("%s\t%s\t%s\n" % (name, path, test_file))
        return self

    def add_rostest(self, name="ros", text=ROSTEST, alpha=PASSING, node_log="", **kwargs):
        test_file = os.path.join(self.folder, name + ".test")
        with open(test_file, "w") as file:
            file.write(text)
        if alpha is not None:
            with open(os.path.join(self.results, "rosunit-alpha.xml"), "w") as file:
                file.write(alpha)
        log = os.path.join(self.folder, "ros_home", name, "log", "run")
        os.makedirs(log)
        with open(os.path.join(log, "manager-1-stdout.log"), "w") as file:
            file.write(node_log)
        return self.add(name, test_file=test_file, **kwargs)

    def judge(self, capsys, *options):
        """(exit code, last line, everything printed)"""
        with open(os.path.join(self.folder, "expected_tests.txt"), "w") as file:
            file.write("".join(self.rows))
        with open(os.path.join(self.folder, "Testing", "Temporary", "LastTest.log"), "w") as file:
            file.write(self.log)
        code = gate.main([self.folder] + list(options))
        out = capsys.readouterr().out
        return code, out.rstrip("\n").splitlines()[-1], out


@pytest.fixture(name="build")
def fixture_build(tmp_path):
    return Build(tmp_path)


def test_good_evidence_passes(build, capsys):
    build.add().add_rostest()
    assert build.judge(capsys)[:2] == (0, "2 passed, 0 failed")


SEEDS = {
    "missing result": dict(result=None),
    "empty result": dict(result=""),
    "truncated result": dict(result=PASSING[:40]),
    "not XML": dict(result="Segfault"),
    "no case": dict(result='<testsuite tests="0"/>'),
    "only disabled cases": dict(
        result='<testsuite tests="1"><testcase name="b" status="notrun"/></testsuite>'
    ),
    "failure": dict(
        result='<testsuite><testcase name="b"><failure message="1 != 2"/></testcase></testsuite>'
    ),
    "error": dict(
        result='<testsuite><testcase name="b"><error message="boom"/></testcase></testsuite>'
    ),
    "failure outside a case": dict(
        result='<testsuite tests="1" failures="1"><testcase name="b"/></testsuite>'
    ),
    "skipped without reason": dict(
        result='<testsuite><testcase name="b"><skipped/></testcase></testsuite>'
    ),
    "never ran": dict(ran=False),
    "exit code after a good result": dict(passed=False),
    "exception": dict(output="terminate called after throwing an instance of 'std::bad_alloc'"),
    "address sanitizer": dict(output="==12==ERROR: AddressSanitizer: heap-use-after-free on ..."),
    "leak sanitizer": dict(output="==12==ERROR: LeakSanitizer: detected memory leaks"),
    "thread sanitizer": dict(output="WARNING: ThreadSanitizer: data race (pid=12)"),
    "undefined sanitizer": dict(output="src/a/b.cpp:3:7: runtime error: signed integer overflow"),
    "segmentation fault": dict(output="Segmentation fault (core dumped)"),
    "heap corruption": dict(output="double free or corruption (!prev)"),
    "assertion": dict(output="x: a.cpp:3: void f(): Assertion `a' failed."),
}


@pytest.mark.parametrize("kind", sorted(SEEDS))
def test_bad_evidence_fails(build, capsys, kind):
    build.add(name="good").add(name="bad", **SEEDS[kind])
    code, last, out = build.judge(capsys)
    assert code == 1, out
    assert last.endswith(" 1 failed"), out
    assert "FAILED: bad: " in out


DIED = "[manager-2] process has died [pid 77, exit code %s, cmd /usr/bin/nodelet manager].\n"
ROS_SEEDS = {
    "crashed manager": dict(output=DIED % -11),
    "loader that failed": dict(output=DIED % 255),
    "death without exit code": dict(
        output="[manager-2] process has died without exit code [pid 77, cmd x]."
    ),
    "coloured death": dict(output="\x1b[31m" + DIED % -6 + "\x1b[0m"),
    "required node": dict(output="REQUIRED process [manager-2] has died!"),
    "plugin": dict(output="[ERROR] [1.2]: Failed to load nodelet [/a] of type [b/C]"),
    "trace only in the node's log": dict(node_log="terminate called without an active exception"),
    "crash at the end": dict(node_log="process[manager-2]: SIGINT killed with return value -11"),
    "node that does not end": dict(output="[manager-2] escalating to SIGTERM"),
    "exception in rospy": dict(node_log="[ERROR] bad callback: <function f at 0x1>"),
    "no <test>": dict(text='<launch><node pkg="p" type="t" name="n"/></launch>'),
    "broken .test file": dict(text="<launch><test"),
    "inner result missing": dict(alpha=None),
    "inner result empty": dict(alpha=""),
    "inner result without case": dict(alpha='<testsuite tests="0"/>'),
    "inner failure": dict(
        alpha='<testsuite><testcase name="b"><failure message="x"/></testcase></testsuite>'
    ),
    "summary failure": dict(
        result='<testsuite><testcase name="b"><failure message="x"/></testcase></testsuite>'
    ),
}


@pytest.mark.parametrize("kind", sorted(ROS_SEEDS))
def test_bad_rostest_evidence_fails(build, capsys, kind):
    build.add(name="good").add_rostest(name="bad", **ROS_SEEDS[kind])
    code, last, out = build.judge(capsys)
    assert code == 1, out
    assert last.endswith(" 1 failed"), out
    assert "FAILED: bad: " in out


def test_announced_kill_is_no_failure_but_another_signal_is(build, capsys):
    text = ROSTEST + "<!-- gate: killed manager 9 -->"
    build.add_rostest(text=text, output=DIED % -9)
    assert build.judge(capsys)[:2] == (0, "1 passed, 0 failed")
    build.log = section("ros", DIED % -11)
    assert build.judge(capsys)[0] == 1


def test_announced_end_of_a_launch_is_no_failure_but_another_nodes_is(build, capsys):
    text = ROSTEST + "<!-- gate: ends finish -->"
    build.add_rostest(text=text, output="REQUIRED process [finish-8] has died!")
    assert build.judge(capsys)[:2] == (0, "1 passed, 0 failed")
    build.log = section("ros", "REQUIRED process [manager-2] has died!")
    assert build.judge(capsys)[0] == 1


def test_two_files_with_one_test_name_fail(build, capsys):
    build.add_rostest(name="one").add_rostest(name="two")
    code, _, out = build.judge(capsys)
    assert code == 1 and "test-name alpha is also in" in out


def test_skips_with_a_reason_pass(build, capsys):
    build.add(
        name="new",
        result='<testsuite><testcase classname="A" name="b" result="skipped">'
        '<skipped message="optional data not found: x"/></testcase></testsuite>',
    )
    # gtest 1.10 tells the reason to the log alone.
    build.add(
        name="old",
        result='<testsuite><testcase classname="A" name="b" status="run" result="skipped"/></testsuite>',
        output="[ RUN      ] A.b\n/src/a.cpp:3: Skipped\noptional data not found: y\n\n[  SKIPPED ] A.b",
    )
    code, last, out = build.judge(capsys)
    assert (code, last) == (0, "0 passed, 0 failed"), out
    assert "optional data not found: x" in out and "optional data not found: y" in out


def test_no_list_of_tests_and_no_match_fail(build, capsys, tmp_path):
    assert gate.main([str(tmp_path / "nowhere")]) == 1
    assert capsys.readouterr().out.endswith("0 passed, 1 failed\n")
    build.add()
    assert build.judge(capsys, "--filter", "no such test")[:2] == (1, "0 passed, 1 failed")


def test_filter_judges_only_what_matches(build, capsys):
    build.add(name="good").add(name="bad", result=None)
    assert build.judge(capsys, "--filter", "^good$")[:2] == (0, "1 passed, 0 failed")


# ------------------------------------------------------------------ the real tools
NODES = {
    "crash": "import os, signal, time\ntime.sleep(1.0)\nos.kill(os.getpid(), signal.SIGSEGV)\n",
    "passes": """\
        import time, unittest, rostest
        class Passes(unittest.TestCase):
            def test_waits(self):
                time.sleep(4.0)
        rostest.rosrun("gate_seed", "%s", Passes)
        """,
}
TEST = '<test test-name="{0}" pkg="gate_seed" type="passes_{0}" time-limit="30"/>'
REAL = {
    "healthy": (TEST, True),
    "segfault": (TEST + '<node pkg="gate_seed" type="crash" name="crash"/>', False),
    "required": (TEST + '<node pkg="gate_seed" type="crash" name="crash" required="true"/>', False),
    "plugin": (
        TEST + '<node pkg="nodelet" type="nodelet" name="n" args="standalone no_such/Nodelet"/>',
        False,
    ),
    "empty": ('<node pkg="gate_seed" type="crash" name="crash"/>', False),
}


def executable(path, body):
    with open(path, "w") as file:
        file.write("#!/usr/bin/python3\n" + textwrap.dedent(body))
    os.chmod(path, os.stat(path).st_mode | stat.S_IXUSR)


def test_real_rostests(tmp_path, capsys):
    """Runs rostest on a healthy launch and on four that it lets pass or leaves half told."""
    package = tmp_path / "gate_seed"
    package.mkdir()
    (package / "package.xml").write_text(
        '<package format="2"><name>gate_seed</name><version>0.0.0</version><description>seeds'
        '</description><maintainer email="a@b.example">a</maintainer><license>MIT</license>'
        "</package>"
    )
    executable(str(package / "crash"), NODES["crash"])
    for kind in REAL:
        executable(str(package / ("passes_" + kind)), NODES["passes"] % kind)

    def run(kind):
        folder = tmp_path / kind
        test_file = folder / (kind + ".test")
        folder.mkdir()
        test_file.write_text("<launch>%s</launch>" % REAL[kind][0].format(kind))
        env = dict(os.environ)
        env["ROS_PACKAGE_PATH"] = str(package) + ":" + env.get("ROS_PACKAGE_PATH", "")
        env["ROS_LOG_DIR"] = str(folder / "ros_home" / kind / "log")
        env["ROS_HOME"] = str(folder / "ros_home" / kind)
        for key in ("ROS_TEST_RESULTS_DIR", "ROS_MASTER_URI"):
            env.pop(key, None)
        command = [sys.executable, "/usr/bin/rostest"]
        if not os.path.exists(command[1]):
            command = ["rostest"]
        done = subprocess.run(
            command
            + ["--pkgdir=" + str(package), "--package=gate_seed", "--results-filename", kind]
            + ["--results-base-dir", str(folder / "test_results"), str(test_file)],
            env=env,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )
        return kind, folder, test_file, done.returncode, done.stdout.decode("utf-8", "replace")

    with ThreadPoolExecutor(max_workers=len(REAL)) as pool:
        runs = list(pool.map(run, sorted(REAL)))
    for kind, folder, test_file, code, output in runs:
        result = folder / "test_results" / "gate_seed" / ("rostest-%s.xml" % kind)
        (folder / "expected_tests.txt").write_text("%s\t%s\t%s\n" % (kind, result, test_file))
        (folder / "Testing" / "Temporary").mkdir(parents=True)
        (folder / "Testing" / "Temporary" / "LastTest.log").write_text(
            section(kind, output, code == 0)
        )
        judged = gate.main([str(folder)])
        out = capsys.readouterr().out
        assert (judged == 0) == REAL[kind][1], "%s, rostest exit code %d\n%s\n%s" % (
            kind,
            code,
            out,
            output,
        )
        sys.stdout.write("%s: rostest exit code %d\n%s" % (kind, code, out))
