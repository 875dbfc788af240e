# SPDX-License-Identifier: MIT
"""Start and end of a replay: what start_replay.py and finish_replay.py do, as nodes beside player,
chain and recorder."""

import os
import signal
import subprocess
import sys
import threading
import time
import xmlrpc.client
from dataclasses import dataclass
from typing import Any, Callable, Dict, List, Optional, Set, Tuple

import genpy.dynamic
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

    def timed_out(self) -> Dict[str, int]:
        """Camera -> scans in which a deadline decided about it."""
        found: Dict[str, int] = {}
        with self._lock:
            for values in self._values.values():
                for key, value in values.items():
                    camera, _, end = key.partition(": ")
                    if end in ("timed out", "no image, timed out"):
                        found[camera] = found.get(camera, 0) + int(value)
        return {camera: scans for camera, scans in sorted(found.items()) if scans}


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
    return CLOCK_STALL_S + 5 * max(timeouts) + REPORT_LAG_S


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


def _summary(reports: Reports, topic: str) -> str:
    """What came out and what did not, in lines."""

    def listed(counts: Dict[str, int]) -> str:
        return ", ".join("%s (%d)" % item for item in counts.items()) or "nothing"

    lines = ["%d clouds on %s" % (reports.published(topic), topic)]
    lines.append("dropped: " + listed(reports.dropped()))
    timed_out = reports.timed_out()
    if timed_out:
        lines.append(
            "cameras that timed out (scans): %s; their images or scores are missing, or come later "
            "than the rig's `timeout`: play slower, or raise it" % listed(timed_out)
        )
    return "\n".join(lines)


@dataclass(frozen=True)
class Finish:
    """What finish_replay.py is asked for; empty: not wanted."""

    rig: str
    overrides: List[str]  # of the rig file, key=value
    recorded: str  # the bag that the node `recorder` writes
    evaluate: str  # the folder of the tables
    bag: str  # that is played, with points_truth
    player_within_s: float


def _evaluate(wanted: Finish, recorded: str) -> None:
    command = [
        sys.executable,
        os.path.join(os.path.dirname(os.path.abspath(sys.argv[0])), "evaluate.py"),
        wanted.bag,
        "--rig=" + wanted.rig,
        "--clouds=%s=%s" % (PACKAGE, recorded),
        "--out=" + wanted.evaluate,
        "--force",
    ]
    command += ["--set=" + setting for setting in wanted.overrides]
    if subprocess.run(command).returncode != 0:
        raise DataError("%s: the evaluation failed, see above" % recorded)


def finish(wanted: Finish) -> None:
    """Waits for the end, then does what is wanted."""
    rig = Rig.load(wanted.rig, wanted.overrides)
    rospy.init_node("finish_replay", disable_signals=False)
    reports = Reports()
    player, output = rospy.resolve_name("player"), rospy.resolve_name("points_semantic")
    if not _wait(lambda: _node(player), wanted.player_within_s):
        raise DataError("%s does not run: can the bag be read? See its message above" % player)
    _wait(lambda: _node(player) is None)
    _wait_for_last_scans(reports, output, _longest_wait_s(rig))
    print(_summary(reports, output))
    sys.stdout.flush()
    if wanted.recorded:
        recorded = _end_recorder(wanted.recorded)
        if wanted.evaluate:
            _evaluate(wanted, recorded)


def end_launch() -> None:
    """Ends the roslaunch that started this process as Ctrl-C does: a node that is `required` would
    end it too, but with a red line even where all is well."""
    parent = os.getppid()
    try:
        with open("/proc/%d/cmdline" % parent, "rb") as file:
            is_roslaunch = b"roslaunch" in file.read()
    except OSError:
        return
    if is_roslaunch:
        os.kill(parent, signal.SIGINT)


def _links_out(name: str) -> Set[Tuple[str, str]]:
    """(listener, topic) of each live connection of a node that runs."""
    try:
        node = _node(name)
        answer: Any = node.getBusInfo(rospy.get_name()) if node else [1, "", []]
        info = answer[2]
    except (OSError, xmlrpc.client.Error):
        return set()
    return {(e[1], e[4]) for e in info if e[2] == "o" and (len(e) < 6 or e[5])}


def _missing_links(player: str, manager: str, rig: Rig, recorded: bool) -> List[str]:
    """What is not connected yet, in words; a chain to whose output nobody listens sleeps."""
    try:
        publishers, subscribers = rosgraph.Master(rospy.get_name()).getSystemState()[:2]
    except (rosgraph.MasterException, OSError):
        return ["the ROS master"]
    listeners = {topic: set(nodes) for topic, nodes in subscribers}
    from_player, from_manager = _links_out(player), _links_out(manager)
    output = rospy.resolve_name("points_semantic")
    missing = []
    recorder = rospy.resolve_name("recorder")
    if recorded and (recorder, output) not in from_manager:
        missing.append("%s on %s" % (recorder, output))
    if listeners.get(output):
        inner = ["scan_reference", "points_compensated"]
        inner += [str(c["name"]) + "/selection" for c in rig.tree["cameras"]]
        for topic in map(rospy.resolve_name, inner):
            if (manager, topic) not in from_manager:
                missing.append("%s on %s" % (manager, topic))
        lidar = rospy.resolve_name(rig.text("lidar.topic"))
        if (manager, lidar) not in from_player:
            missing.append("%s on %s" % (manager, lidar))
    for topic, nodes in publishers:
        if player in nodes:
            for node in listeners.get(topic, ()):
                if (node, topic) not in from_player and _node(node):
                    missing.append("%s on %s" % (node, topic))
    return missing


@dataclass(frozen=True)
class Start:
    """What start_replay.py is asked for."""

    rig: str
    overrides: List[str]  # of the rig file, key=value
    manager: str  # the nodelet manager
    recorded: bool  # wait for the node `recorder` too
    within_s: float  # after this the bag is played anyway
    player_within_s: float


def start(wanted: Start) -> None:
    """Lets the waiting player go once chain and recorder are connected."""
    rig = Rig.load(wanted.rig, wanted.overrides)
    rospy.init_node("start_replay", disable_signals=False)
    player, manager = rospy.resolve_name("player"), rospy.resolve_name(wanted.manager)
    if not _wait(lambda: _node(player), wanted.player_within_s):
        raise DataError("%s does not run: can the bag be read? See its message above" % player)
    missing: List[str] = []

    def is_connected() -> bool:
        nonlocal missing
        missing = _missing_links(player, manager, rig, wanted.recorded)
        return not missing

    # Twice: a subscription may be made between two looks.
    connected = _wait(is_connected, wanted.within_s) and _wait(is_connected, wanted.within_s)
    if not connected:
        rospy.logwarn("the bag is played though not connected: %s", ", ".join(missing))
    name = player + "/pause_playback"
    try:
        rospy.wait_for_service(name, wanted.player_within_s)
        done = rospy.ServiceProxy(name, _set_bool())(False).success
    except (rospy.ROSException, rospy.ServiceException) as error:
        raise DataError("%s does not start: %s" % (player, error)) from error
    if not done:
        raise DataError("%s does not start" % player)


def _set_bool() -> Any:
    """std_srvs/SetBool, whose package need not be installed."""

    def message(name: str, text: str) -> Any:
        return genpy.dynamic.generate_dynamic(name, text)[name]

    return type(
        "SetBool",
        (),
        {
            "_type": "std_srvs/SetBool",
            "_md5sum": "09fb03525b03e7ea1fd3992bafd87e16",
            "_request_class": message("std_srvs/SetBoolRequest", "bool data\n"),
            "_response_class": message(
                "std_srvs/SetBoolResponse", "bool success\nstring message\n"
            ),
        },
    )
