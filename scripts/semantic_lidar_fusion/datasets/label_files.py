# SPDX-License-Identifier: MIT
"""Semantic clouds as a SemanticKITTI sequence, which labelling and evaluation tools read, and labels
of such a sequence as points_truth.

Layout of the folder: velodyne/NNNNNN.bin (x y z intensity, float32, m), labels/NNNNNN.label (uint32,
the class in the lower 16 bits), poses.txt and calib.txt (the lidar's poses in the fixed frame; Tr is
the identity), times.txt (s after the first scan), scans.csv (what each file is of) and classes.yaml
(ids, names, colours and learning map, as SemanticKITTI's tools read them). Points are those of
points_semantic, in its order, as the lidar sees them at t_ref.

Ids: `own`: 0 = none, class id + 1; `semantickitti`: those of that data set.
"""

import csv
import os
from typing import Any, Dict, List, NamedTuple, Optional, Sequence, Tuple

import numpy as np
import yaml

from semantic_lidar_fusion import cli
from semantic_lidar_fusion.bags.bag_io import BagReader, BagWriter, write_text
from semantic_lidar_fusion.bags.cloud_io import FUSED, SemanticCloud, from_array, point_dtype, xyz
from semantic_lidar_fusion.bags.clouds import TOPIC, Clouds
from semantic_lidar_fusion.bags.poses import TransformTree
from semantic_lidar_fusion.datasets import records, semantickitti
from semantic_lidar_fusion.datasets.writer import TRUTH_TOPIC
from semantic_lidar_fusion.errors import ConfigError, DataError, cannot_write
from semantic_lidar_fusion.labels import NO_LABEL, LabelSet

SCHEMES = ("own", "semantickitti")
_SCANS = "scans.csv"
_HEADER = ("number", "stamp_ns", "first_ns", "points", "frame")


class Scan(NamedTuple):
    """One line of scans.csv: the cloud's stamp t_ref and its first point's time, ns."""

    number: int
    stamp_ns: int
    first_ns: int
    points: int
    frame: str


def file_ids(labels: LabelSet, scheme: str) -> Dict[int, int]:
    """Class id -> id in .label files; ConfigError names a class that the scheme has not."""
    if scheme == "own":
        return {i: i + 1 for i in range(len(labels))}
    result: Dict[int, int] = {}
    for there, here in semantickitti.class_ids(labels).items():
        if there != 1 and here != NO_LABEL:
            result.setdefault(here, there)
    missing = [name for i, name in enumerate(labels.names) if i not in result]
    if missing:
        cli.warn("SemanticKITTI has no class for %s: written as 0" % ", ".join(missing))
    return result


def class_ids_of(labels: LabelSet, scheme: str) -> Dict[int, int]:
    """Id in .label files -> class id."""
    if scheme == "semantickitti":
        # What the class set has not is no error: it becomes no class.
        none = dict.fromkeys(semantickitti.CLASSES, NO_LABEL)
        return {**none, **semantickitti.class_ids(labels)}
    table = {there: here for here, there in file_ids(labels, scheme).items()}
    table[0] = NO_LABEL
    return table


def _make_folder(folder: str) -> None:
    if os.path.isdir(folder) and os.listdir(folder):
        raise ConfigError("%s: is not empty" % folder)
    try:
        for name in ("velodyne", "labels"):
            os.makedirs(os.path.join(folder, name), exist_ok=True)
    except OSError as error:
        raise cannot_write(folder, error) from error


def first_ns(cloud: SemanticCloud) -> int:
    """The time of the cloud's first point, ns, to the rounding of `dt`."""
    dt = cloud.optional("dt")
    if dt is None or not len(dt):
        return cloud.stamp_ns
    return cloud.stamp_ns + int(round(float(dt.min()) * 1e9))


def _bin_of(cloud: SemanticCloud) -> np.ndarray:
    values = np.zeros((len(cloud), 4), dtype="<f4")
    values[:, :3] = xyz(cloud.points, np.float32)
    intensity = cloud.optional("intensity")
    if intensity is not None:
        values[:, 3] = intensity
    return values


def _ids_of(cloud: SemanticCloud, table: Dict[int, int]) -> np.ndarray:
    lookup = np.zeros(256, dtype="<u4")
    for here, there in table.items():
        lookup[here] = there
    label = np.where(cloud.status == FUSED, cloud.label, NO_LABEL)
    return lookup[label]


def export(
    bag_path: str,
    folder: str,
    scheme: str,
    every: int = 1,
    labelled: bool = True,
    fixed_frame: str = "odom",
) -> Tuple[int, int]:
    """Writes every `every`-th cloud of a fused bag; (clouds, points) written. `labelled`: with the
    classes that the points have, else all 0, for people to fill in."""
    _make_folder(folder)
    scans: List[Scan] = []
    points = 0
    with Clouds(bag_path) as clouds:
        if clouds.labels is None:
            raise DataError("%s: no class_info, so the classes have no names" % bag_path)
        labels = clouds.labels
        table = file_ids(labels, scheme)
        for index, cloud in enumerate(cli.progress(clouds, len(clouds), "exporting")):
            if index % every:
                continue
            number = len(scans)
            name = "%06d" % number
            _bin_of(cloud).tofile(os.path.join(folder, "velodyne", name + ".bin"))
            ids = _ids_of(cloud, table) if labelled else np.zeros(len(cloud), dtype="<u4")
            ids.tofile(os.path.join(folder, "labels", name + ".label"))
            scans.append(Scan(number, cloud.stamp_ns, first_ns(cloud), len(cloud), cloud.frame_id))
            points += len(cloud)
    if not scans:
        raise DataError("%s: %s is empty" % (bag_path, TOPIC))
    _write_scans(folder, scans)
    _write_poses(folder, bag_path, scans, fixed_frame)
    write_text(os.path.join(folder, "classes.yaml"), classes_text(labels, table))
    return len(scans), points


def _write_scans(folder: str, scans: Sequence[Scan]) -> None:
    lines = [",".join(_HEADER)] + [",".join(map(str, scan)) for scan in scans]
    write_text(os.path.join(folder, _SCANS), "\n".join(lines) + "\n")
    begin = scans[0].stamp_ns
    times = ["%.9f" % ((scan.stamp_ns - begin) * 1e-9) for scan in scans]
    write_text(os.path.join(folder, "times.txt"), "\n".join(times) + "\n")


def _write_poses(folder: str, bag_path: str, scans: Sequence[Scan], fixed_frame: str) -> None:
    """Poses for tools that lay scans over each other; without tf the scans stand alone."""
    with BagReader(bag_path) as reader:
        tree = TransformTree.from_bag(reader)
    try:
        stamps = np.array([scan.stamp_ns for scan in scans])
        poses, valid = tree.lookup(fixed_frame, scans[0].frame, stamps)
    except DataError as error:
        cli.warn("no poses.txt: %s" % error)
        return
    if not valid.all():
        cli.warn("no poses.txt: tf does not cover %d scans" % (~valid).sum())
        return
    # Near the origin, as 32 bits of a viewer hold them.
    poses[:, :3, 3] -= poses[0, :3, 3].copy()
    rows = [" ".join("%.9g" % value for value in pose[:3].ravel()) for pose in poses]
    write_text(os.path.join(folder, "poses.txt"), "\n".join(rows) + "\n")
    identity = " ".join("%g" % value for value in np.eye(4)[:3].ravel())
    calib = "".join("%s: %s\n" % (name, identity) for name in ("P0", "P1", "P2", "P3", "Tr"))
    write_text(os.path.join(folder, "calib.txt"), calib)


def classes_text(labels: LabelSet, table: Dict[int, int]) -> str:
    """The class set as SemanticKITTI's tools read one: colours are blue, green, red."""
    tree: Dict[str, Any] = {"labels": {0: "unlabeled"}, "color_map": {0: [0, 0, 0]}}
    tree["learning_map"], tree["learning_map_inv"] = {0: 0}, {0: 0}
    tree["learning_ignore"] = {0: True}
    for here, there in sorted(table.items(), key=lambda pair: pair[1]):
        info = labels.classes[here]
        tree["labels"].setdefault(there, info.name)
        tree["color_map"].setdefault(there, [int(v) for v in reversed(info.color_rgb)])
        tree["learning_map"].setdefault(there, here + 1)
        tree["learning_map_inv"][here + 1] = there
        tree["learning_ignore"][here + 1] = here in labels.discarded
    tree["split"] = {"train": [], "valid": [0], "test": []}
    return yaml.safe_dump(tree, sort_keys=False)


def read_scans(folder: str) -> List[Scan]:
    """scans.csv of an exported folder."""
    path = records.require_file(os.path.join(folder, _SCANS))
    with open(path, encoding="utf-8", newline="") as file:
        rows = list(csv.reader(file))
    if not rows or tuple(rows[0]) != _HEADER:
        raise DataError("%s: its first line must be %s" % (path, ",".join(_HEADER)))
    try:
        return [Scan(int(r[0]), int(r[1]), int(r[2]), int(r[3]), r[4]) for r in rows[1:]]
    except (ValueError, IndexError) as error:
        raise DataError("%s: %s" % (path, error)) from error


def bring_back(
    folder: str, bag_path: str, truth_path: str, scheme: str, label_folder: Optional[str] = None
) -> Tuple[int, int]:
    """Writes the labels of an exported folder as points_truth of the fused bag that it came from;
    (scans, points with a label). Every point must be that of the bag, bit by bit: DataError names
    the scan and the point that is not."""
    folder = records.require_folder(folder)
    scans = {scan.stamp_ns: scan for scan in read_scans(folder)}
    label_folder = label_folder or os.path.join(folder, "labels")
    written = labelled = 0
    with Clouds(bag_path) as clouds:
        if clouds.labels is None:
            raise DataError("%s: no class_info, so the classes have no names" % bag_path)
        table = class_ids_of(clouds.labels, scheme)
        with BagWriter(truth_path) as writer:
            for cloud in cli.progress(clouds, len(clouds), "matching"):
                scan = scans.pop(cloud.stamp_ns, None)
                if scan is None:
                    continue
                label = _labels_of(folder, label_folder, scan, cloud, table)
                truth = np.zeros(len(cloud), dtype=point_dtype(_TRUTH_FIELDS))
                for axis in "xyz":
                    truth[axis] = cloud.points[axis]
                truth["label"] = label
                message = from_array(truth, scan.first_ns, cloud.frame_id)
                writer.write(TRUTH_TOPIC, message, cloud.stamp_ns)
                written += 1
                labelled += int((label != NO_LABEL).sum())
            if scans:
                raise DataError(
                    "%s: scan %06d is of no cloud of %s"
                    % (folder, next(iter(scans.values())).number, bag_path)
                )
    return written, labelled


_TRUTH_FIELDS = [("x", "f4"), ("y", "f4"), ("z", "f4"), ("label", "u1")]


def _labels_of(
    folder: str, label_folder: str, scan: Scan, cloud: SemanticCloud, table: Dict[int, int]
) -> np.ndarray:
    """Class ids (N,) of a scan's .label file, whose points must be the cloud's."""
    name = "%06d" % scan.number
    positions, _ = records.read_points(os.path.join(folder, "velodyne", name + ".bin"))
    if len(positions) != len(cloud):
        raise DataError(
            "%s: scan %s has %d points, the cloud at %d ns %d"
            % (folder, name, len(positions), scan.stamp_ns, len(cloud))
        )
    differ = (np.asarray(positions, np.float32) != xyz(cloud.points, np.float32)).any(axis=1)
    if differ.any():
        raise DataError(
            "%s: point %d of scan %s is not that of the bag: fuse with the rig of the export"
            % (folder, int(np.flatnonzero(differ)[0]), name)
        )
    path = os.path.join(label_folder, name + ".label")
    ids = records.read_label_ids(path, len(positions))
    unknown = sorted(set(np.unique(ids)) - set(table))
    if unknown:
        raise DataError("%s: label %d is none of classes.yaml" % (path, unknown[0]))
    return records.map_ids(ids, table)
