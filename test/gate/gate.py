#!/usr/bin/python3
# SPDX-License-Identifier: MIT
"""Decides from the evidence whether the tests passed; exit codes are not believed.

The ROS 1 test tools report success when a node crashes, when a plugin does not load, when a
`required` node takes the test down, when a .test file holds no test, and when a test never ran.
So every test that CMake registered (expected_tests.txt) must have left

  * a section in CTest's log that says it passed,
  * a readable result with at least one executed case (or only skipped ones, each with a reason),
    for a rostest also one for each of its <test> elements,
  * no trace of a crash, of a node that died or of a sanitizer's report, in CTest's log or in the
    logs of its nodes.

A .test file that kills a node on purpose says so: <!-- gate: killed NODE SIGNAL_NUMBER -->; one that
runs a launch file whose required node ends it when all is done: <!-- gate: ends NODE -->

Prints what is wrong and, as its last line, `N passed, N failed`, where N counts test cases and
each piece of bad evidence; exit code 0 only if nothing failed.
"""

import argparse
import glob
import os
import re
import sys
import xml.etree.ElementTree as ET

TRACES = [
    (re.compile(pattern), meaning)
    for pattern, meaning in [
        (r"terminate called", "an exception ended a process"),
        (r"(Address|Leak|Thread|Memory)Sanitizer:|SUMMARY: \w*Sanitizer", "sanitizer report"),
        (r"\.(c|cc|cpp|h|hpp):\d+:\d+: runtime error:", "sanitizer report"),
        (r"Segmentation fault|Illegal instruction|Bus error|Floating point exception", "crash"),
        (r"^Aborted\b|\(core dumped\)", "crash"),
        (r"double free|free\(\): invalid|malloc\(\): |corrupted (size|double)", "heap corruption"),
        (r"stack smashing detected|buffer overflow detected", "memory corruption"),
        (r"Assertion .* failed", "failed assertion"),
        (r"Failed to load (nodelet|library)|Could not load library", "a plugin did not load"),
        (r"escalating to SIG(TERM|KILL)", "a node did not end when asked to"),
        (r"bad callback: ", "an exception in a callback of rospy"),
    ]
]
DIED = re.compile(
    r"\[(?P<node>[^\]\s]+?)(-\d+)?\] process has died"
    r"( without exit code)?( \[pid \d+(, exit code (?P<code>-?\d+))?)?"
)
# Only in rostest's own log: how a node ended when it was asked to, at the end of the test.
ENDED = re.compile(
    r"process\[(?P<node>[^\]\s]+?)(-\d+)?\]: SIG\w+ killed with return value (?P<code>-?\d+)"
)
REQUIRED = re.compile(r"REQUIRED process \[(?P<node>[^\]\s]+?)(-\d+)?\] has died")
CRASH_CODES = {-4, -6, -7, -8, -11, 66, 134, 139}
ALLOWED = re.compile(r"<!--\s*gate:\s*killed\s+(\S+)\s+(\d+)\s*-->")
ENDS = re.compile(r"<!--\s*gate:\s*ends\s+(\S+)\s*-->")
COLOUR = re.compile(r"\x1b\[[0-9;]*m")


class Report:
    """Counts and complaints of one test."""

    def __init__(self, name):
        self.name = name
        self.passed = 0
        self.skipped = []
        self.failures = []

    def fail(self, message):
        if message not in self.failures:
            self.failures.append(message)


def read_text(path):
    with open(path, "rb") as file:
        return file.read().decode("utf-8", "replace")


def expected_tests(build_dir):
    """(ctest name, result file, .test file or "") of each test that CMake registered."""
    rows = []
    for line in read_text(os.path.join(build_dir, "expected_tests.txt")).splitlines():
        if line.strip():
            rows.append(tuple((line.split("\t") + ["", ""])[:3]))
    return rows


def ctest_sections(build_dir):
    """Test name -> its part of CTest's log."""
    path = os.path.join(build_dir, "Testing", "Temporary", "LastTest.log")
    if not os.path.isfile(path):
        return {}
    heads = re.compile(r"^\d+/\d+ Test(?:ing)?: (.+)$", re.MULTILINE)
    log = read_text(path)
    found = list(heads.finditer(log))
    sections = {}
    for i, head in enumerate(found):
        end = found[i + 1].start() if i + 1 < len(found) else len(log)
        name = head.group(1).strip()
        sections[name] = sections.get(name, "") + log[head.start() : end]
    return sections


def skip_reason(case, log):
    """Why `case` was skipped; "" if nothing says so. Older gtest tells only the log."""
    skip = case.find("skipped")
    if skip is not None:
        reason = (skip.get("message") or skip.text or "").strip()
        if reason:
            return reason
    name = "%s.%s" % (case.get("classname", ""), case.get("name", ""))
    part = log.split("[ RUN      ] " + name, 1)
    if len(part) == 2:
        lines = part[1].split("[  SKIPPED ]", 1)[0].strip().splitlines()
        reason = " ".join(line for line in lines if not line.rstrip().endswith("Skipped")).strip()
        return reason
    return ""


def read_result(report, path, log):
    """Adds the cases of the result file `path` to `report`; returns whether any case executed."""
    name = os.path.basename(path)
    if not os.path.isfile(path):
        report.fail("no result file %s" % name)
        return False
    if os.path.getsize(path) == 0:
        report.fail("empty result file %s" % name)
        return False
    try:
        root = ET.parse(path).getroot()
    except ET.ParseError as error:
        report.fail("unreadable result file %s: %s" % (name, error))
        return False

    executed = bad = 0
    skipped = []
    for case in root.iter("testcase"):
        label = "%s.%s" % (case.get("classname", ""), case.get("name", "?"))
        troubles = case.findall("failure") + case.findall("error")
        if troubles:
            bad += 1
            message = (troubles[0].get("message") or troubles[0].text or "").strip()
            report.fail("%s: %s" % (label, message.splitlines()[0][:200] if message else "failed"))
        elif case.get("status") == "notrun":
            continue  # disabled in the source: neither passed nor failed
        elif case.find("skipped") is not None or case.get("result") == "skipped":
            skipped.append((label, skip_reason(case, log)))
        else:
            executed += 1
            report.passed += 1

    # Failures outside a case, such as in the set-up of a whole suite, stand only in the totals.
    suites = [root] if root.tag == "testsuite" else root.findall("testsuite")
    declared = sum(int(s.get(key) or 0) for s in suites for key in ("failures", "errors"))
    if declared > bad:
        report.fail("%s declares %d failures, its cases show %d" % (name, declared, bad))

    report.skipped += skipped
    for label, reason in skipped:
        if not reason:
            report.fail("%s is skipped and does not say why" % label)
    if executed + bad == 0 and not skipped:
        report.fail("%s: no test case was executed" % name)
    return executed + bad > 0


def check_logs(report, logs, allowed):
    """Looks for traces of crashes in `logs` (list of (title, text)).

    `allowed` is the set of (node, signal) that the test sends itself, with signal 0 for a required
    node that ends its launch."""
    for title, text in logs:
        for line in COLOUR.sub("", text).splitlines():
            required = REQUIRED.search(line)
            if required:
                if (required.group("node"), 0) not in allowed:
                    report.fail("%s: a required node ended: %s" % (title, line.strip()[:200]))
                continue
            died = DIED.search(line)
            if died:
                code = int(died.group("code") or 0)
                if (died.group("node"), -code) not in allowed:
                    report.fail("%s: node died: %s" % (title, line.strip()[:200]))
                continue
            ended = ENDED.search(line)
            if ended and int(ended.group("code")) in CRASH_CODES:
                report.fail("%s: node crashed at its end: %s" % (title, line.strip()[:200]))
                continue
            for pattern, meaning in TRACES:
                if pattern.search(line):
                    report.fail("%s: %s: %s" % (title, meaning, line.strip()[:200]))
                    break


def rostest_names(report, test_file):
    """Test names of the .test file and the kills that it announces."""
    text = read_text(test_file)
    allowed = {(node, int(signal)) for node, signal in ALLOWED.findall(text)}
    allowed |= {(node, 0) for node in ENDS.findall(text)}
    try:
        root = ET.fromstring(text)
    except ET.ParseError as error:
        report.fail("unreadable %s: %s" % (os.path.basename(test_file), error))
        return [], allowed
    names = [test.get("test-name", "") for test in root.iter("test")]
    if not names:
        report.fail("%s holds no <test>" % os.path.basename(test_file))
    return names, allowed


def judge(build_dir, row, section, owners):
    """The report on one expected test."""
    name, result, test_file = row
    report = Report(name)
    if section is None:
        report.fail("it did not run")
        return report

    allowed = set()
    if test_file:
        names, allowed = rostest_names(report, test_file)
        # rostest's own file repeats the cases of its tests: count those where they were made.
        summary = Report(name)
        read_result(summary, result, section)
        for failure in summary.failures:
            report.fail(failure)
        for test_name in names:
            if owners.setdefault(test_name, test_file) != test_file:
                report.fail("test-name %s is also in %s" % (test_name, owners[test_name]))
            read_result(
                report, os.path.join(os.path.dirname(result), "rosunit-%s.xml" % test_name), section
            )
    else:
        read_result(report, result, section)

    logs = [("output", section)]
    found = glob.glob(os.path.join(build_dir, "ros_home", name, "**", "*.log"), recursive=True)
    for path in sorted({os.path.realpath(path) for path in found}):
        if os.path.isfile(path):
            logs.append((os.path.basename(path), read_text(path)))
    check_logs(report, logs, allowed)
    if not re.search(r"^Test Passed\.", section, re.MULTILINE) and not report.failures:
        report.fail("its command failed or timed out although its result shows no failure")
    return report


def main(argv=None):
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("build_dir", help="the build folder in which ctest ran")
    parser.add_argument("--filter", default="", help="judge only tests whose name matches (regex)")
    options = parser.parse_args(argv)

    try:
        rows = expected_tests(options.build_dir)
    except OSError as error:
        print("gate: no list of tests: %s" % error)
        print("0 passed, 1 failed")
        return 1
    rows = [row for row in rows if re.search(options.filter, row[0])]
    sections = ctest_sections(options.build_dir)
    owners = {}
    reports = [judge(options.build_dir, row, sections.get(row[0]), owners) for row in rows]

    passed = sum(report.passed for report in reports)
    failed = sum(len(report.failures) for report in reports)
    skipped = [item for report in reports for item in report.skipped]
    if not rows:
        print("gate: no test matches '%s'" % options.filter)
        failed = 1
    for label, reason in skipped:
        print("skipped: %s: %s" % (label, " ".join(reason.split())[:200]))
    for report in reports:
        for failure in report.failures:
            print("FAILED: %s: %s" % (report.name, failure))
    print("%d tests, %d cases skipped" % (len(reports), len(skipped)))
    print("%d passed, %d failed" % (passed, failed))
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
