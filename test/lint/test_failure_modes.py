# SPDX-License-Identifier: MIT
"""test/README.md: every failure mode has its tests and each of them exists; and what source text
alone can show of them."""

import glob
import os
import re

SOURCE_DIR = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
FAILURE_MODES = 82


def read(path):
    with open(path, encoding="utf-8") as file:
        return file.read()


def rows(text):
    """Number of a failure mode -> its row."""
    return {int(m.group(1)): m.group(0) for m in re.finditer(r"^\| (\d+) \|.*$", text, re.M)}


def test_names(text):
    """Names in backquotes that look like tests."""
    pattern = r"`((?:\w+\.py::\w+)|(?:\w+\.sh)|(?:[A-Z]\w*\.[A-Z]\w*))`"
    return set(re.findall(pattern, text))


test_names.__test__ = False


def existing_tests():
    """Names of all tests, in the form of the table."""
    found = set()
    for path in glob.glob(os.path.join(SOURCE_DIR, "test", "**", "*.cpp"), recursive=True):
        for suite, name in re.findall(r"^TEST(?:_[FP])?\((\w+),\s*(\w+)\)", read(path), re.M):
            found.add("%s.%s" % (suite, name))
    for folder in ("python", "lint", "gate", "ros"):
        for path in glob.glob(os.path.join(SOURCE_DIR, "test", folder, "*.py")):
            for name in re.findall(r"^\s*def (test_\w+)\(", read(path), re.M):
                found.add("%s::%s" % (os.path.basename(path), name))
    for path in glob.glob(os.path.join(SOURCE_DIR, "test", "shell", "*.sh")):
        found.add(os.path.basename(path))
    return found


def table():
    return read(os.path.join(SOURCE_DIR, "test", "README.md"))


def test_every_failure_mode_has_a_row_with_tests():
    found = rows(table())
    assert sorted(found) == list(range(1, FAILURE_MODES + 1))
    without = [number for number, row in found.items() if not test_names(row)]
    assert without == []


def test_every_test_of_the_table_exists():
    assert sorted(test_names(table()) - existing_tests()) == []


def test_rostests_of_the_table_are_started():
    """A Python file below test/ros runs only if a .test file names it."""
    started = "".join(
        read(path) for path in glob.glob(os.path.join(SOURCE_DIR, "test", "ros", "*.test"))
    )
    for name in test_names(table()):
        file = name.split("::")[0]
        if os.path.isfile(os.path.join(SOURCE_DIR, "test", "ros", file)):
            assert 'type="%s"' % file in started, file


def sources(*folders):
    for folder in folders:
        for path in glob.glob(os.path.join(SOURCE_DIR, folder, "**", "*"), recursive=True):
            if path.endswith((".h", ".cpp", ".py")):
                yield path, read(path)


def test_nothing_publishes_tf():
    """But for the nodelet whose work it is, which is silent where somebody else does."""
    for path, text in sources("nodelets", "src", "include", "scripts"):
        if os.path.basename(path) == "odometry_tf_nodelet.cpp":
            continue
        assert "TransformBroadcaster" not in text, path
        assert not re.search(r"advertise<tf2?_msgs", text), path


def test_every_subscription_is_without_delay():
    """All go through subscribeChecked, which also looks at the lengths that messages declare."""
    calls = 0
    for path, text in sources("nodelets"):
        calls += len(re.findall(r"subscribeChecked<\w", text))
        own = re.findall(r"(?:handle|transport|NodeHandle\(\))\.subscribe[<(]", text)
        if path.endswith("declared_lengths.h"):
            assert len(own) == 1 and "TransportHints().tcpNoDelay()" in text
        else:
            assert not own, path
    assert calls >= 4


def test_nothing_waits_inside_tf():
    for path, text in sources("nodelets", "src", "include"):
        for word in ("MessageFilter", "message_filters/", "waitForTransform", "tf2_ros/buffer"):
            assert word not in text, (path, word)


def test_what_respawns_waits_and_no_launch_file_enters_a_folder():
    """A folder of the caller's may be missing or unreadable for the node."""
    respawning = 0
    for path in glob.glob(os.path.join(SOURCE_DIR, "launch", "*.launch")):
        text = read(path)
        for node in re.findall(r"<node\b[^>]*>", text):
            if re.search(r'respawn="(?!false)', node):
                respawning += 1
                assert re.search(r'respawn_delay="[1-9]', node), (path, node)
        assert "chdir" not in text and not re.search(r'\bcwd="', text), path
    assert respawning >= 2
