# SPDX-License-Identifier: MIT
"""Submaps: what a map was made of, so that it can be placed anew when its poses change, without the
bags it came from.

A submap is a part of a drive. It keeps the points of its clouds in the lidar's own frame, with their
distributions, and the space that their rays crossed in the frame of the map that was built. Placed
anew, each cloud gets its own new pose, so that what returns say is the same, bit for bit, as in a map
built from the bags with these poses. The crossed space moves as a whole with the cloud in the
submap's middle, and no ray is cast again: how often a voxel was passed since its last return stays
with the points in it.

The file (map.submaps) is a zip archive without compression, whose checksums guard each member:
header.json; for each submap N.points (POINT), N.probabilities (float32, a row for each labelled
point) and N.bricks (BRICK); clouds (CLOUD) of all submaps, one after the other. Little-endian.
"""

import functools
import json
import os
import zipfile
from typing import Any, Dict, List, NamedTuple, Optional, Sequence, Tuple

import numpy as np

from semantic_lidar_fusion.bags.poses import PoseSeries, invert
from semantic_lidar_fusion.errors import DataError, cannot_write
from semantic_lidar_fusion.maps.drive import SeenCloud, pose_problem, read_poses
from semantic_lidar_fusion.maps.map_file import MapHeader, joined_path
from semantic_lidar_fusion.maps.records import BRICK, pose_of_path
from semantic_lidar_fusion.maps.semantic_map import COUNTS, VoxelMap

ENDING = ".submaps"
_VERSION = 1
# pose: T_map_lidar and vehicle: T_map_vehicle at the stamp, as the map was built; points: of which the
# first `labelled` have a distribution.
CLOUD = np.dtype(
    [("submap", "<u4"), ("drive", "<u4"), ("points", "<u4"), ("labelled", "<u4")]
    + [("stamp_ns", "<i8"), ("pose", "<f8", (4, 4)), ("vehicle", "<f8", (4, 4))]
)
# passes: of the point's voxel, after its last return in the submap.
POINT = np.dtype(
    [(name, "<f4") for name in ("x", "y", "z", "intensity")] + [("status", "u1"), ("passes", "u1")]
)


class Submap(NamedTuple):
    """clouds: CLOUD; points: POINT; probabilities: (labelled points, C) float32; bricks: BRICK."""

    clouds: np.ndarray
    points: np.ndarray
    probabilities: np.ndarray
    bricks: np.ndarray


class SubmapMaker:
    """Gathers a submap while its clouds are mapped."""

    def __init__(self) -> None:
        self._clouds: List[np.ndarray] = []
        self._points: List[np.ndarray] = []
        self._probabilities: List[np.ndarray] = []

    def add(self, seen: SeenCloud) -> None:
        cloud = seen.cloud
        order = np.argsort(~cloud.fused, kind="stable")
        labelled = int(cloud.fused.sum())
        points = np.zeros(len(cloud), dtype=POINT)
        for name in ("x", "y", "z", "status"):
            points[name] = cloud.points[name][order]
        intensity = cloud.optional("intensity")
        if intensity is not None:
            points["intensity"] = intensity[order]
        entry = (0, 0, len(cloud), labelled, cloud.stamp_ns, seen.pose, seen.vehicle)
        self._clouds.append(np.array([entry], dtype=CLOUD))
        self._points.append(points)
        self._probabilities.append(cloud.probabilities[order[:labelled]].astype(np.float32))

    def finish(self, voxels: VoxelMap) -> Submap:
        """The submap of the clouds, whose map this is."""
        for entry, points in zip(self._clouds, self._points):
            points["passes"] = voxels.passes_at([points[a] for a in "xyz"], entry["pose"][0])
        classes = len(voxels.labels)
        return Submap(
            np.concatenate([np.zeros(0, CLOUD), *self._clouds]),
            np.concatenate([np.zeros(0, POINT), *self._points]),
            np.concatenate([np.zeros((0, classes), np.float32), *self._probabilities]),
            voxels.bricks(),
        )


class KeptDrive(NamedTuple):
    """Where submaps come from: the bag's name, and the frames whose poses are kept."""

    name: str
    lidar_frame: str
    vehicle_frame: str


class SubmapWriter:
    """Writes the submaps of drives as they come; a context manager."""

    def __init__(self, path: str, header: MapHeader, drives: Sequence[KeptDrive]):
        self.path = path
        self._clouds: List[np.ndarray] = []
        tree = {
            "version": _VERSION,
            "map": header.encoded().decode("utf-8"),
            "drives": [list(drive) for drive in drives],
        }
        try:
            self._archive = zipfile.ZipFile(path, "w", zipfile.ZIP_STORED, allowZip64=True)
        except OSError as error:
            raise cannot_write(path, error) from error
        self._write("header.json", json.dumps(tree, sort_keys=True).encode("utf-8"))

    def __enter__(self) -> "SubmapWriter":
        return self

    def _write(self, name: str, data: bytes) -> None:
        try:
            self._archive.writestr(zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0)), data)
        except OSError as error:
            raise cannot_write(self.path, error) from error

    def add(self, submap: Submap, drive: int) -> None:
        """Appends a submap of drive number `drive`."""
        number = len(self._clouds)
        clouds = submap.clouds.copy()
        clouds["submap"], clouds["drive"] = number, drive
        self._clouds.append(clouds)
        for name in ("points", "probabilities", "bricks"):
            data = np.ascontiguousarray(getattr(submap, name)).tobytes()
            self._write("%d.%s" % (number, name), data)

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        if kind is None:
            clouds = np.concatenate([np.zeros(0, CLOUD), *self._clouds])
            self._write("clouds", clouds.tobytes())
        try:
            self._archive.close()
        except OSError as close_error:
            if kind is None:
                raise cannot_write(self.path, close_error) from close_error


class SubmapReader:
    """A file of submaps: `header`, `drives`, and `clouds` of all (CLOUD). DataError if it is damaged."""

    def __init__(self, path: str):
        self.path = path
        try:
            self._archive = zipfile.ZipFile(path)
        except (OSError, zipfile.BadZipFile) as error:
            raise DataError("%s: %s" % (path, error)) from error
        try:
            tree = json.loads(self._read("header.json").decode("utf-8"))
            if tree["version"] != _VERSION:
                raise DataError("%s: of version %s; build it again" % (path, tree["version"]))
            self.header = MapHeader.decoded(tree["map"].encode("utf-8"), path)
            self.drives = [KeptDrive(*(str(v) for v in drive)) for drive in tree["drives"]]
        except (ValueError, KeyError, TypeError) as error:
            raise DataError("%s: damaged header (%s)" % (path, error)) from error
        self.clouds = self._array("clouds", CLOUD)

    def _read(self, name: str) -> bytes:
        try:
            return self._archive.read(name)
        except (OSError, KeyError, zipfile.BadZipFile) as error:
            raise DataError("%s: damaged (%s)" % (self.path, error)) from error

    def _array(self, name: str, dtype: np.dtype) -> np.ndarray:
        data = self._read(name)
        if len(data) % dtype.itemsize:
            raise DataError("%s: damaged: %s has %d bytes" % (self.path, name, len(data)))
        return np.frombuffer(data, dtype=dtype)

    def __len__(self) -> int:
        """Number of submaps with clouds."""
        return len(np.unique(self.clouds["submap"]))

    def submap(self, number: int) -> Submap:
        clouds = self.clouds[self.clouds["submap"] == number]
        points = self._array("%d.points" % number, POINT)
        classes = len(self.header.labels)
        row = np.dtype(("<f4", (classes,)))
        probabilities = self._array("%d.probabilities" % number, np.dtype([("p", row)]))["p"]
        if len(points) != clouds["points"].sum() or len(probabilities) != clouds["labelled"].sum():
            raise DataError("%s: damaged: submap %d has other points" % (self.path, number))
        return Submap(clouds, points, probabilities, self._array("%d.bricks" % number, BRICK))

    def placed(self, files: Sequence[str], poses_frame: str) -> Tuple[np.ndarray, np.ndarray]:
        """T_map_lidar (N, 4, 4) of all clouds by files of poses, one for each drive (or none: as they
        were), and which of them are known (N,) bool. poses_frame: whose poses the files hold, "" =
        the lidar's."""
        poses, known = self.clouds["pose"].copy(), np.ones(len(self.clouds), dtype=bool)
        if not files:
            return poses, known
        for number, (drive, path) in enumerate(zip(self.drives, files)):
            own = np.flatnonzero(self.clouds["drive"] == number)
            clouds = self.clouds[own]
            stamps, found = read_poses(path)
            if stamps is None:
                if len(found) != len(clouds):
                    raise DataError(
                        "%s: %d poses without stamps for the %d clouds of %s in %s"
                        % (path, len(found), len(clouds), drive.name, self.path)
                    )
                stamps = clouds["stamp_ns"]
            poses[own], known[own] = PoseSeries(stamps, found).lookup(clouds["stamp_ns"])
            frame = poses_frame.lstrip("/")
            if frame == drive.vehicle_frame:
                poses[own] = poses[own] @ invert(clouds["vehicle"]) @ clouds["pose"]
            elif frame not in ("", drive.lidar_frame):
                raise DataError(
                    "--poses-frame %s: the submaps of %s know the frames %s and %s"
                    % (poses_frame, drive.name, drive.lidar_frame, drive.vehicle_frame)
                )
        for row in np.flatnonzero(known):
            known[row] = pose_problem(poses[row]) is None
        return poses, known


class Placed(NamedTuple):
    """A submap where new poses put it."""

    voxels: VoxelMap
    path: np.ndarray
    without_pose: int
    points: Dict[str, int]


def place(
    submap: Submap,
    poses: np.ndarray,
    known: np.ndarray,
    header: MapHeader,
    native: Optional[bool] = None,
) -> Placed:
    """The map of a submap whose clouds have the poses T_map_lidar (N, 4, 4), where they are known."""
    voxels = VoxelMap(header.config, header.labels, native)
    counts, path = dict.fromkeys(COUNTS, 0), []
    ends = np.cumsum(submap.clouds["points"].astype(np.int64))
    labelled_ends = np.cumsum(submap.clouds["labelled"].astype(np.int64))
    for number in np.flatnonzero(known):
        cloud = submap.clouds[number]
        points = submap.points[ends[number] - cloud["points"] : ends[number]]
        probabilities = np.empty((len(points), submap.probabilities.shape[1]), dtype=np.float32)
        begin = labelled_ends[number] - cloud["labelled"]
        probabilities[: cloud["labelled"]] = submap.probabilities[begin : labelled_ends[number]]
        result = voxels.integrate_columns(
            [points[axis] for axis in "xyz"],
            points["intensity"],
            points["status"],
            probabilities,
            poses[number],
            int(cloud["stamp_ns"]),
            passes=points["passes"],
        )
        for name, count in result.items():
            counts[name] += count
        vehicle = poses[number] @ invert(cloud["pose"]) @ cloud["vehicle"]
        path.append(pose_of_path(int(cloud["stamp_ns"]), vehicle))
    found = np.flatnonzero(known)
    if len(found):
        middle = found[len(found) // 2]
        voxels.add_moved(submap.bricks, submap.clouds["pose"][middle] @ invert(poses[middle]))
    return Placed(voxels, joined_path(path), len(known) - len(found), counts)


def reader_of(path: str) -> SubmapReader:
    """The reader of a file; this process keeps the last one."""
    try:
        return _reader_of(path, os.stat(path).st_mtime_ns, os.getpid())
    except OSError as error:
        raise DataError("%s: %s" % (path, error.strerror or error)) from error


@functools.lru_cache(maxsize=1)
def _reader_of(path: str, changed_ns: int, process: int) -> SubmapReader:
    del changed_ns, process  # processes do not share a place in the file
    return SubmapReader(path)
