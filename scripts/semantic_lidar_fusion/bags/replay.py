# SPDX-License-Identifier: MIT
"""The end of a replay: what finish_replay.py does, as a node beside player, chain and recorder."""

import os
import subprocess
import sys
import threading
import time
import xmlrpc.client
from typing import Any, Callable, Dict, Optional

import rosgraph
import rospy
from diagnostic_msgs.msg import DiagnosticArray

from semantic_lidar_fusion.errors import DataError
from semantic_lidar_fusion.evaluation.scoring import PACKAGE
from semantic_lidar_fusion.rig import Rig

# A nodelet takes a clock that stands still for longer as the end of a bag (fusion_nodelet.cpp), s.
CLOCK_STALL_S = 3.0
# Nodelets report once a second; twice that, and a second for a machine that is busy.
REPORT_LAG_S = 3.0


class Reports:
    """The newest counters of all nodelets, from /diagnostics."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._values: Dict[str, Dict[str, str]] = {}
        self._subscriber = rospy.Subscriber("/diagnostics", DiagnosticArray, self._add)

    def _add(self, message: DiagnosticArray) -> None:
        with self._lock:
            for status in message.status:
                self._values[status.name.split(":")[0]] = {p.key: p.value for p in status.values}

    def published(self, topic: str) -> int:
        """Messages that a nodelet says it has published there."""
        key = "output %s messages" % topic
        with self._lock:
            return max((int(v[key]) for v in self._values.values() if key in v), default=0)

    def dropped(self) -> Dict[str, int]:
        """ "nodelet: reason" -> count, of all that was lost."""
        with self._lock:
            return {
                "%s: %s" % (name, key[len("dropped: ") :]): int(value)
                for name, values in sorted(self._values.items())
                for key, value in sorted(values.items())
                if key.startswith("dropped: ")
            }


def _node(name: str) -> Optional[xmlrpc.client.ServerProxy]:
    """A node that runs, or None."""
    try:
        node = xmlrpc.client.ServerProxy(rosgraph.Master(rospy.get_name()).lookupNode(name))
        node.getPid(rospy.get_name())
        return node
    except (rosgraph.MasterException, OSError, xmlrpc.client.Error):
        return None


def _wait(condition: Callable[[], Any], timeout_s: Optional[float] = None) -> bool:
    """Whether the condition came true in time. Wall time: the bag's clock ends with the bag."""
    start = time.monotonic()
    while not condition():
        if rospy.is_shutdown():
            raise KeyboardInterrupt
        if timeout_s is not None and time.monotonic() - start > timeout_s:
            return False
        time.sleep(0.1)
    return True


def _longest_wait_s(rig: Rig) -> float:
    """The time after the last message of a bag in which its last scan may still come out."""
    timeouts = [camera.timeout_s for camera in rig.cameras]
    timeouts += [rig.number("reference.timeout"), rig.number("odometry.timeout")]
    return CLOCK_STALL_S + 3 * max(timeouts) + REPORT_LAG_S


def _wait_for_last_scans(reports: Reports, topic: str, quiet_s: float) -> None:
    """Returns when no new cloud has been reported for `quiet_s` seconds."""
    count, since = reports.published(topic), time.monotonic()

    def is_quiet() -> bool:
        nonlocal count, since
        if reports.published(topic) != count:
            count, since = reports.published(topic), time.monotonic()
        return time.monotonic() - since > quiet_s

    _wait(is_quiet)


def _end_recorder(path: str) -> str:
    """Ends the node `recorder`; returns the finished bag that it wrote to `path`."""
    path = path if path.endswith(".bag") else path + ".bag"
    name = rospy.resolve_name("recorder")
    recorder = _node(name)
    if recorder is None:
        raise DataError("%s does not run: nothing is recorded" % name)
    recorder.shutdown(rospy.get_name(), "the replay has ended")
    if not _wait(lambda: os.path.exists(path) and not os.path.exists(path + ".active"), 60.0):
        raise DataError("%s: %s has not finished it" % (path, name))
    return path


def _evaluate(options: Any, recorded: str, settings: list) -> None:
    command = [
        sys.executable,
        os.path.join(os.path.dirname(os.path.abspath(sys.argv[0])), "evaluate.py"),
        options.bag,
        "--rig=" + options.rig,
        "--clouds=%s=%s" % (PACKAGE, recorded),
        "--out=" + options.evaluate,
        "--force",
    ]
    command += ["--set=" + setting for setting in settings]
    if subprocess.run(command).returncode != 0:
        raise DataError("%s: the evaluation failed, see above" % recorded)


def finish(options: Any) -> None:
    """Waits for the end, then does what the options of finish_replay.py ask for."""
    settings = options.overrides.split()
    rig = Rig.load(options.rig, settings)
    rospy.init_node("finish_replay", disable_signals=False)
    reports = Reports()
    player, output = rospy.resolve_name("player"), rospy.resolve_name("points_semantic")
    if not _wait(lambda: _node(player), options.player_within):
        raise DataError("%s does not run: can the bag be read? See its message above" % player)
    _wait(lambda: _node(player) is None)
    _wait_for_last_scans(reports, output, _longest_wait_s(rig))
    dropped = reports.dropped()
    print(
        "%d clouds on %s, dropped: %s" % (reports.published(output), output, dropped or "nothing")
    )
    sys.stdout.flush()
    if options.recorded:
        recorded = _end_recorder(options.recorded)
        if options.evaluate:
            _evaluate(options, recorded, settings)
