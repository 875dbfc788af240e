# SPDX-License-Identifier: MIT
"""Class ids, names and colours as one table, read from the class-set YAML files in config/.

The format is that of semantic_lidar_fusion/common/label_set.h: `classes`, a list of {name,
color: [r, g, b], dynamic, lidar} whose position is the class id, and `evaluation: {discard: [names],
merge: {merged_name: [names]}}`.
"""

import re
from typing import Any, Dict, List, NamedTuple, Optional, Tuple

import numpy as np
import yaml

from semantic_lidar_fusion.errors import ConfigError, DataError
from semantic_lidar_fusion.files import open_file
from semantic_lidar_fusion.installation import package_file

__all__ = ["ClassInfo", "LabelSet", "MergedClass", "load_yaml", "package_file", "parse_yaml"]

NO_LABEL = 255  # label of a point without a class
MAX_CLASSES = 255
# Classes with these names are none that a lidar's return can be of, unless the set says otherwise.
NO_RETURN_NAMES = ("sky", "unlabeled", "unlabelled", "void")
_NAME = re.compile(r"[a-z0-9_]{1,64}\Z")
_NAME_RULE = "must be 1 to 64 characters of a-z, 0-9 and _"


class ClassInfo(NamedTuple):
    """One class; its id is its position in the set."""

    name: str
    color_rgb: Tuple[int, int, int]
    dynamic: bool
    lidar: Optional[bool] = None  # a return can be of it; None = by its name

    @property
    def returns(self) -> bool:
        return self.name not in NO_RETURN_NAMES if self.lidar is None else self.lidar


class MergedClass(NamedTuple):
    """A row of the evaluation's tables: the union of `members` (class ids)."""

    name: str
    members: Tuple[int, ...]


class LabelSet:
    """The classes of a rig; immutable."""

    def __init__(
        self,
        classes: List[ClassInfo],
        discarded: Tuple[int, ...] = (),
        merged: Tuple[MergedClass, ...] = (),
    ):
        self.classes = tuple(classes)
        self.discarded = tuple(discarded)
        self.merged = tuple(merged)
        self._ids = {info.name: i for i, info in enumerate(self.classes)}

    @staticmethod
    def from_file(path: str) -> "LabelSet":
        """Reads a class-set file; raises ConfigError with every problem."""
        return LabelSet.from_tree(load_yaml(path), path)

    @staticmethod
    def from_tree(tree: Any, source: str) -> "LabelSet":
        """Checks a parsed class set (a mapping, or just the list of classes)."""
        problems: List[str] = []
        result = _from_tree({"classes": tree} if isinstance(tree, list) else tree, problems)
        if problems:
            raise ConfigError("%s: %s" % (source, "; ".join(problems)))
        return result

    @staticmethod
    def from_class_info(tree: Any) -> "LabelSet":
        """From the parsed JSON of the `class_info` topic."""
        if not isinstance(tree, dict):
            raise ConfigError("class_info: must be a mapping")
        evaluation = {"discard": tree.get("discard", []), "merge": tree.get("merge", {})}
        return LabelSet.from_tree(
            {"classes": tree.get("classes"), "evaluation": evaluation}, "class_info"
        )

    def tree(self) -> Dict[str, Any]:
        """The set as plain lists and mappings, as a class-set file holds it."""
        classes: List[Dict[str, Any]] = []
        for i, info in enumerate(self.classes):
            entry: Dict[str, Any] = {"id": i, "name": info.name, "color": list(info.color_rgb)}
            if info.dynamic:
                entry["dynamic"] = True
            if info.lidar is not None:
                entry["lidar"] = info.lidar
            classes.append(entry)
        result: Dict[str, Any] = {"classes": classes}
        evaluation: Dict[str, Any] = {}
        if self.discarded:
            evaluation["discard"] = [self.classes[i].name for i in self.discarded]
        if self.merged:
            evaluation["merge"] = {
                m.name: [self.classes[i].name for i in m.members] for m in self.merged
            }
        if evaluation:
            result["evaluation"] = evaluation
        return result

    def __len__(self) -> int:
        return len(self.classes)

    def __getitem__(self, class_id: int) -> ClassInfo:
        return self.classes[class_id]

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, LabelSet):
            return False
        # Whether `lidar` is written out or follows from the name makes no difference.
        same = [a._replace(lidar=a.returns) for a in self.classes] == [
            b._replace(lidar=b.returns) for b in other.classes
        ]
        return same and (
            (self.discarded, sorted(self.merged)) == (other.discarded, sorted(other.merged))
        )

    def id_of(self, name: str) -> Optional[int]:
        """The id of a class name, or None."""
        return self._ids.get(name)

    @property
    def names(self) -> List[str]:
        return [info.name for info in self.classes]

    @property
    def colors_rgb(self) -> np.ndarray:
        """(C, 3) uint8."""
        return np.array([info.color_rgb for info in self.classes], dtype=np.uint8)

    @property
    def returns(self) -> np.ndarray:
        """(C,) bool: whether a lidar's return can be of the class; all, if it can be of none."""
        result = np.array([info.returns for info in self.classes], dtype=bool)
        return result if result.any() else ~result

    @property
    def dynamic_ids(self) -> List[int]:
        return [i for i, info in enumerate(self.classes) if info.dynamic]

    def evaluation_classes(self) -> List[MergedClass]:
        """Rows of the evaluation's tables, ordered by their first class id: the merged classes, and
        every class that is neither merged nor discarded on its own."""
        used = set(self.discarded).union(*(m.members for m in self.merged))
        alone = [MergedClass(c.name, (i,)) for i, c in enumerate(self.classes) if i not in used]
        return sorted(list(self.merged) + alone, key=lambda row: min(row.members))

    def merge_matrix(self) -> np.ndarray:
        """(C, R) float64 of 0 and 1: distribution @ matrix sums the classes of each row of
        `evaluation_classes`; discarded classes go nowhere."""
        rows = self.evaluation_classes()
        matrix = np.zeros((len(self), len(rows)))
        for column, row in enumerate(rows):
            matrix[list(row.members), column] = 1.0
        return matrix

    def merge_lookup(self) -> np.ndarray:
        """(256,) uint8: label -> row of `evaluation_classes`, 255 for discarded or no class."""
        lookup = np.full(256, NO_LABEL, dtype=np.uint8)
        for index, row in enumerate(self.evaluation_classes()):
            lookup[list(row.members)] = index
        return lookup


class _UniqueKeyLoader(yaml.SafeLoader):
    """Refuses a key that occurs twice in one mapping, of which YAML keeps only the last."""


def _unique_mapping(loader: _UniqueKeyLoader, node: yaml.MappingNode, deep: bool = False) -> Any:
    keys = set()
    for key_node, _ in node.value:
        key = loader.construct_object(key_node, deep=True)
        if isinstance(key, (list, dict)):
            continue
        if key in keys:
            raise yaml.constructor.ConstructorError(
                None, None, "the key '%s' occurs twice" % key, key_node.start_mark
            )
        keys.add(key)
    return yaml.SafeLoader.construct_mapping(loader, node, deep)


def _whole_mapping(loader: _UniqueKeyLoader, node: yaml.MappingNode) -> Any:
    return _unique_mapping(loader, node, True)


_UniqueKeyLoader.add_constructor(yaml.resolver.BaseResolver.DEFAULT_MAPPING_TAG, _whole_mapping)


MAX_YAML_BYTES = 1 << 20


def parse_yaml(data: bytes, source: str) -> Any:
    """The one YAML document of `data` as plain values; ConfigError names `source` and the line."""
    if len(data) > MAX_YAML_BYTES:
        raise ConfigError("%s: is longer than %d bytes" % (source, MAX_YAML_BYTES))
    try:
        return yaml.load(data.decode("utf-8"), Loader=_UniqueKeyLoader)
    except RecursionError as error:
        raise ConfigError("%s: nests too deeply" % source) from error
    # Values that only look like a date or a number end in errors of the constructors.
    except (yaml.YAMLError, ValueError, TypeError, AttributeError, OverflowError) as error:
        text = " ".join(str(error).split())
        raise ConfigError("%s: not readable as YAML: %s" % (source, text)) from error


def load_yaml(path: str) -> Any:
    """A YAML file as plain values; ConfigError names the file and the line."""
    try:
        with open_file(path) as file:
            data = file.read(MAX_YAML_BYTES + 1)
    except DataError as error:
        raise ConfigError(str(error)) from error
    return parse_yaml(data, path)


def _is_whole(value: Any, low: int, high: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and low <= value <= high


def _unknown_keys(tree: Dict[Any, Any], known: Tuple[str, ...], path: str) -> List[str]:
    return [
        "%s%s: unknown key (known: %s)" % (path, key, ", ".join(known))
        for key in tree
        if key not in known
    ]


def _class_from_tree(entry: Any, index: int, problems: List[str]) -> ClassInfo:
    path = "classes[%d]" % index
    if not isinstance(entry, dict):
        problems.append("%s = %s: must be a mapping" % (path, entry))
        return ClassInfo("", (0, 0, 0), False)
    problems += _unknown_keys(entry, ("id", "name", "color", "dynamic", "lidar"), path + ".")
    name, color = entry.get("name"), entry.get("color")
    dynamic = entry.get("dynamic", False)
    if not isinstance(name, str) or not _NAME.match(name):
        problems.append("%s.name = %s: %s" % (path, name, _NAME_RULE))
        name = ""
    if "id" in entry and (entry["id"] != index or isinstance(entry["id"], bool)):
        problems.append(
            "%s.id = %s: must be the position in the list, %d" % (path, entry["id"], index)
        )
    if (
        not isinstance(color, list)
        or len(color) != 3
        or not all(_is_whole(c, 0, 255) for c in color)
    ):
        problems.append(
            "%s.color = %s: must be [red, green, blue], whole numbers from 0 to 255" % (path, color)
        )
        color = [0, 0, 0]
    if not isinstance(dynamic, bool):
        problems.append("%s.dynamic = %s: must be true or false" % (path, dynamic))
        dynamic = False
    lidar = entry.get("lidar")
    if lidar is not None and not isinstance(lidar, bool):
        problems.append("%s.lidar = %s: must be true or false" % (path, lidar))
        lidar = None
    return ClassInfo(name, (color[0], color[1], color[2]), dynamic, lidar)


def _from_tree(tree: Any, problems: List[str]) -> LabelSet:
    if not isinstance(tree, dict):
        problems.append("must be a mapping with the key classes")
        return LabelSet([])
    problems += _unknown_keys(tree, ("classes", "evaluation"), "")
    entries = tree.get("classes")
    if not isinstance(entries, list) or not 1 <= len(entries) <= MAX_CLASSES:
        problems.append("classes: must be a list of 1 to %d classes" % MAX_CLASSES)
        return LabelSet([])
    classes = [_class_from_tree(entry, i, problems) for i, entry in enumerate(entries)]
    ids: Dict[str, int] = {}
    for i, info in enumerate(classes):
        if info.name and info.name in ids:
            problems.append("classes[%d].name = %s: two classes have this name" % (i, info.name))
        ids.setdefault(info.name, i)
    used = set()

    def use(names: Any, path: str) -> Tuple[int, ...]:
        members = []
        if not isinstance(names, list):
            problems.append("%s = %s: must be a list of class names" % (path, names))
            return ()
        for name in names:
            class_id = ids.get(name) if isinstance(name, str) and name else None
            if class_id is None:
                problems.append("%s = %s: must be a class of the set" % (path, name))
            elif class_id in used:
                problems.append(
                    "%s = %s: a class may be discarded or merged once only" % (path, name)
                )
            else:
                used.add(class_id)
                members.append(class_id)
        return tuple(members)

    evaluation = tree.get("evaluation") or {}
    if not isinstance(evaluation, dict):
        problems.append("evaluation: must be a mapping")
        evaluation = {}
    problems += _unknown_keys(evaluation, ("discard", "merge"), "evaluation.")
    discarded = use(evaluation.get("discard") or [], "evaluation.discard")
    merge = evaluation.get("merge") or {}
    if not isinstance(merge, dict):
        problems.append("evaluation.merge: must be a mapping")
        merge = {}
    merged = []
    for name, members in merge.items():
        path = "evaluation.merge.%s" % name
        if not isinstance(name, str) or not _NAME.match(name):
            problems.append("%s: its name %s" % (path, _NAME_RULE))
        row = MergedClass(str(name), use(members, path))
        if not row.members and isinstance(members, list) and not members:
            problems.append("%s: must hold at least one class" % path)
        if name in ids and ids[name] not in row.members:
            problems.append("%s: must hold the class of the same name" % path)
        merged.append(row)
    return LabelSet(classes, discarded, tuple(merged))
