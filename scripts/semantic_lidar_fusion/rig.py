# SPDX-License-Identifier: MIT
"""The rig as fuse_bag and the nodelets use it: every key, with what it came to.

The C++ loader alone knows the rules and defaults of rig files. It prints the resolved rig
(`fuse_bag --print-rig`), writes it into fused bags (/configuration) and publishes it; this module
reads that and has no default of its own.
"""

import os
import shutil
import subprocess
import sys
from typing import Any, Dict, NamedTuple, Optional, Sequence, Tuple

from semantic_lidar_fusion.bags.bag_io import BagReader
from semantic_lidar_fusion.errors import ConfigError, DataError
from semantic_lidar_fusion.labels import LabelSet, parse_yaml

CONFIGURATION_TOPIC = "/configuration"


def find_fuse_bag(given: Optional[str] = None) -> str:
    """The program: as given, from the folder SLF_BIN_DIR, beside the script, on the PATH, or where
    catkin has put it."""
    if given:
        if not os.access(given, os.X_OK) or os.path.isdir(given):
            raise ConfigError("--fuse-bag %s: not a program" % given)
        return os.path.abspath(given)
    folders = [os.environ.get("SLF_BIN_DIR", ""), os.path.dirname(os.path.abspath(sys.argv[0]))]
    for folder in folders:
        path = os.path.join(folder, "fuse_bag")
        if folder and os.access(path, os.X_OK):
            return path
    on_path = shutil.which("fuse_bag")
    if on_path:
        return on_path
    if shutil.which("catkin_find"):
        found = subprocess.run(
            ["catkin_find", "--first-only", "--libexec", "semantic_lidar_fusion", "fuse_bag"],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            universal_newlines=True,
        )
        path = found.stdout.strip()
        if path and os.access(path, os.X_OK):
            return path
    raise ConfigError(
        "fuse_bag: not found beside this script, on the PATH, or by catkin_find; build the package "
        "and source its setup.bash, or name the program with --fuse-bag"
    )


class CameraConfig(NamedTuple):
    """What Python needs of an entry of `cameras`; topics are absolute, times in s."""

    name: str
    image: str
    camera_info: str
    scores: str
    rectified: bool
    lens: Dict[str, str]  # file, camera and frame, empty texts where camera_info has it all
    timeout_s: float


class Rig:
    """A resolved rig: `path` names its source in messages, `labels` is its class set."""

    def __init__(self, tree: Any, path: str):
        """`tree`: the resolved rig as plain values. ConfigError if it is none."""
        if not isinstance(tree, dict):
            raise ConfigError("%s: holds no resolved rig" % path)
        self.path = path
        self._tree: Dict[str, Any] = tree
        classes = self._value("classes")
        self.labels = LabelSet([])
        if classes is not None:
            self.labels = LabelSet.from_tree(classes, path + ": classes")
        entries = self._value("cameras")
        if not isinstance(entries, list):
            raise ConfigError("%s: cameras = %s: must be a list" % (path, entries))
        self.cameras: Tuple[CameraConfig, ...] = tuple(map(self._camera, entries))

    @staticmethod
    def load(path: str, overrides: Sequence[str] = (), program: Optional[str] = None) -> "Rig":
        """A rig file with KEY=VALUE overrides, as `program` (default: looked for) resolves it.

        Raises ConfigError with that program's own words if it refuses the rig."""
        command = [find_fuse_bag(program), "--print-rig", "--rig", path]
        for setting in overrides:
            command += ["--set", setting]
        result = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        if result.returncode != 0:
            said = result.stderr.decode("utf-8", "replace").split("\nTry: ")[0]
            raise ConfigError(" ".join(said.split()).replace("fuse_bag: error: ", "", 1) or path)
        return Rig(parse_yaml(result.stdout, path), path)

    @staticmethod
    def from_bag(bag: BagReader) -> Optional["Rig"]:
        """The rig that a fused bag was made with; None if the bag does not tell."""
        for item in bag.read([CONFIGURATION_TOPIC], ["std_msgs/String"]):
            source = "%s: %s" % (bag.path, CONFIGURATION_TOPIC)
            try:
                return Rig(parse_yaml(item.message.data.encode("utf-8"), source), source)
            except ConfigError as error:
                raise DataError(str(error)) from error
        return None

    @property
    def tree(self) -> Dict[str, Any]:
        """The resolved rig as plain values."""
        return self._tree

    def has(self, key: str) -> bool:
        """Whether the loader knows a key ("occlusion.mode")."""
        tree: Any = self._tree
        for part in key.split("."):
            if not isinstance(tree, dict) or part not in tree:
                return False
            tree = tree[part]
        return True

    def text(self, key: str) -> str:
        return str(self._value(key))

    def number(self, key: str) -> float:
        value = self._value(key)
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise ConfigError("%s: %s = %s: must be a number" % (self.path, key, value))
        return float(value)

    def flag(self, key: str) -> bool:
        value = self._value(key)
        if not isinstance(value, bool):
            raise ConfigError("%s: %s = %s: must be true or false" % (self.path, key, value))
        return value

    def _value(self, key: str) -> Any:
        if not self.has(key):
            raise ConfigError("%s: the resolved rig has no %s" % (self.path, key))
        tree: Any = self._tree
        for part in key.split("."):
            tree = tree[part]
        return tree

    def _camera(self, entry: Any) -> CameraConfig:
        try:
            space = "/" + str(entry["namespace"]).strip("/") + "/"

            def topic(key: str) -> str:
                name = str(entry[key])
                return name if name.startswith("/") else space + name

            return CameraConfig(
                str(entry["name"]),
                topic("image"),
                topic("camera_info"),
                topic("scores"),
                bool(entry["rectified"]),
                {str(key): str(value) for key, value in entry.get("lens", {}).items()},
                float(entry["timeout"]),
            )
        except (KeyError, TypeError, ValueError) as error:
            raise ConfigError("%s: a camera without %s" % (self.path, error)) from error
