# SPDX-License-Identifier: MIT
"""A data set in neutral form: what its readers give and the writer turns into a bag and a rig file.

One reader per layout (kitti, kitti360, semantickitti, rellis, nuscenes, acfr_calibration) fills a `Drive`; its
images and scans are read only when they are written. Also here: what the readers share (listing and
checking files, image headers, rings and times of spinning lidars).
"""

import bisect
import os
import re
from typing import Any, Callable, Dict, Iterable, List, NamedTuple, Optional, Sequence, Tuple

import numpy as np

from semantic_lidar_fusion.cli import warn
from semantic_lidar_fusion.errors import DataError
from semantic_lidar_fusion.files import open_file
from semantic_lidar_fusion.labels import NO_LABEL, LabelSet

# Data sets that count time from zero start here: a ROS stamp must not be 0.
EPOCH_NS = 1300000000 * 1000000000
NO_RING = 65535
HDL64_RINGS = 64


class ImageRecord(NamedTuple):
    """An image file (PNG or JPEG) with its time, and its human labels where there are any."""

    stamp_ns: int
    path: str
    label_path: Optional[str] = None


class CameraRecord(NamedTuple):
    """A camera: `k` (3, 3), `d` distortion of `model` ("" = none), images in order of time.

    `t_parent_camera` places the optical frame (x right, y down, z forward) in `parent`. `lens`: file
    that calibrates the lens in place of camera_info, or empty.
    """

    name: str
    frame: str
    parent: str
    t_parent_camera: np.ndarray
    k: np.ndarray
    model: str
    d: Sequence[float]
    rectified: bool
    images: List[ImageRecord]
    lens: str = ""


class Scan(NamedTuple):
    """One scan: `xyz` (N, 3) f32 m, `intensity` (N,) f32, `ring` (N,) u16 or None, `time_ns` (N,)
    u32 after the scan's stamp or None, `label` (N,) u8 of the rig's classes (255 = none) or None.
    """

    xyz: np.ndarray
    intensity: np.ndarray
    ring: Optional[np.ndarray]
    time_ns: Optional[np.ndarray]
    label: Optional[np.ndarray]


class ScanRecord(NamedTuple):
    """A scan to be read later; `stamp_ns` is the time that its points count from."""

    stamp_ns: int
    load: Callable[[], Scan]


class Drive(NamedTuple):
    """A data set. `odometry`: times (M,) ns and poses T_odom_base (M, 4, 4), or None."""

    name: str
    labels: LabelSet
    cameras: List[CameraRecord]
    lidar_topic: str
    lidar_frame: str
    t_base_lidar: np.ndarray
    scans: List[ScanRecord]
    odometry: Optional[Tuple[np.ndarray, np.ndarray]]
    motion_enabled: bool
    notes: List[str]  # what a reader of the rig file should know
    label_values: Optional[Callable[[str], np.ndarray]] = None  # label image file -> (H, W) u8 ids


def require_folder(path: str) -> str:
    if not os.path.isdir(path):
        raise DataError("%s: no such folder" % path)
    return path


def require_file(path: str) -> str:
    if not os.path.isfile(path):
        raise DataError("%s: no such file" % path)
    return path


def numbered_files(folder: str, endings: Sequence[str]) -> Dict[int, str]:
    """Number -> path of the files of a folder whose names are a number and one of the endings."""
    require_folder(folder)
    found: Dict[int, str] = {}
    for name in sorted(os.listdir(folder)):
        stem, ending = os.path.splitext(name)
        if ending.lower() in endings and re.match(r"\d+\Z", stem):
            if int(stem) in found:
                raise DataError("%s: two files have the number %d" % (folder, int(stem)))
            found[int(stem)] = os.path.join(folder, name)
    if not found:
        raise DataError("%s: no numbered %s files" % (folder, " or ".join(endings)))
    return found


def read_bytes(path: str) -> bytes:
    try:
        with open_file(path) as file:
            return file.read()
    except OSError as error:
        raise DataError("%s: %s" % (path, error.strerror or error)) from error


def read_lines(path: str) -> List[str]:
    """The lines of a text file without trailing empty ones."""
    try:
        lines = read_bytes(path).decode("utf-8").splitlines()
    except UnicodeDecodeError as error:
        raise DataError("%s: not a text file" % path) from error
    while lines and not lines[-1].strip():
        lines.pop()
    return lines


def parse_numbers(text: str, count: int, where: str) -> np.ndarray:
    """(count,) finite floats of a line; DataError names `where`."""
    words = text.split()
    try:
        values = np.array([float(word) for word in words])
    except ValueError as error:
        raise DataError("%s: %s" % (where, error)) from error
    if len(values) != count:
        raise DataError("%s: %d numbers; must be %d" % (where, len(values), count))
    if not np.isfinite(values).all():
        raise DataError("%s: a number is not finite" % where)
    return values


def read_calibration(path: str, wanted: Dict[str, int]) -> Dict[str, np.ndarray]:
    """Entries `key: numbers` of a KITTI calibration file, each with its count of numbers."""
    found: Dict[str, np.ndarray] = {}
    for number, line in enumerate(read_lines(require_file(path)), 1):
        key, colon, rest = line.partition(":")
        if colon and key.strip() in wanted:
            where = "%s line %d (%s)" % (path, number, key.strip())
            found[key.strip()] = parse_numbers(rest, wanted[key.strip()], where)
    for key in wanted:
        if key not in found:
            raise DataError("%s: no entry %s" % (path, key))
    return found


def check_rotation(rotation: np.ndarray, where: str) -> np.ndarray:
    """The rotation (3, 3) itself, if it is one within the rounding of a text file."""
    largest = np.abs(rotation).max()
    error = np.abs(rotation @ rotation.T - np.eye(3)).max() if largest <= 2.0 else largest
    if not error <= 1e-3 or np.linalg.det(rotation) < 0:
        raise DataError("%s: not a rotation (off by %.2g)" % (where, error))
    return rotation


def read_poses(path: str) -> np.ndarray:
    """(M, 4, 4) poses of a file with 12 numbers a line (KITTI odometry's format)."""
    poses = []
    for number, line in enumerate(read_lines(require_file(path)), 1):
        where = "%s line %d" % (path, number)
        pose = np.vstack([parse_numbers(line, 12, where).reshape(3, 4), [0, 0, 0, 1]])
        check_rotation(pose[:3, :3], where)
        poses.append(pose)
    if not poses:
        raise DataError("%s: empty" % path)
    return np.array(poses)


def read_points(path: str) -> Tuple[np.ndarray, np.ndarray]:
    """xyz (N, 3) and intensity (N,) f32 of a KITTI scan: .bin (x y z r float32) or .txt."""
    if path.endswith(".txt"):
        values = _text_points(path)
    else:
        data = read_bytes(path)
        if len(data) % 16:
            raise DataError("%s: %d bytes, not a multiple of 16 (x y z r)" % (path, len(data)))
        values = np.frombuffer(data, dtype="<f4").reshape(-1, 4)
    if not np.isfinite(values).all():
        raise DataError("%s: a point is not finite" % path)
    return np.ascontiguousarray(values[:, :3]), np.ascontiguousarray(values[:, 3])


def _text_points(path: str) -> np.ndarray:
    lines = read_lines(path)
    try:
        values = np.array(" ".join(lines).split(), dtype=np.float32)
    except ValueError:
        values = np.zeros(0, dtype=np.float32)
    if len(values) != 4 * len(lines):
        for number, line in enumerate(lines, 1):
            parse_numbers(line, 4, "%s line %d" % (path, number))
        raise DataError("%s: not lines of x y z r" % path)
    return values.reshape(-1, 4)


def read_label_ids(path: str, count: int) -> np.ndarray:
    """(count,) class ids of a SemanticKITTI .label file: the lower 16 of 32 bits."""
    data = read_bytes(require_file(path))
    if len(data) != 4 * count:
        raise DataError("%s: %d labels; its scan has %d points" % (path, len(data) // 4, count))
    return (np.frombuffer(data, dtype="<u4") & 0xFFFF).astype(np.int64)


def map_ids(ids: np.ndarray, table: Dict[int, int]) -> np.ndarray:
    """Data-set ids (any shape) -> u8 ids of the rig's classes; 255 for ids that have none."""
    lookup = np.full(65536, NO_LABEL, dtype=np.uint8)
    for source, target in table.items():
        lookup[source] = target
    return lookup[ids]


def class_table(names: Dict[int, Sequence[str]], labels: LabelSet) -> Dict[int, int]:
    """Data-set id -> id in `labels`: the first of its candidate names that the set has."""
    table = {}
    for source, candidates in names.items():
        ids = [labels.id_of(name) for name in candidates]
        chosen = next((i for i in ids if i is not None), None)
        if chosen is not None:
            table[source] = chosen
    if not table:
        raise DataError(
            "the class set (%s) has no class of this data set" % ", ".join(labels.names)
        )
    return table


def image_size(data: bytes, path: str) -> Tuple[int, int, str]:
    """(width, height, "png" or "jpeg") of an encoded image, read from its header."""
    if data[:8] == b"\x89PNG\r\n\x1a\n" and len(data) >= 24:
        if b"IEND" not in data[-16:]:
            raise DataError("%s: the PNG is cut off" % path)
        return int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big"), "png"
    if data[:2] == b"\xff\xd8":
        if b"\xff\xd9" not in data[-1024:]:
            raise DataError("%s: the JPEG is cut off" % path)
        at = 2
        while at + 9 < len(data) and data[at] == 0xFF:
            marker, length = data[at + 1], int.from_bytes(data[at + 2 : at + 4], "big")
            # The frame headers SOF0..15 without the tables among them (DHT, JPG, DAC).
            if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
                height = int.from_bytes(data[at + 5 : at + 7], "big")
                width = int.from_bytes(data[at + 7 : at + 9], "big")
                return width, height, "jpeg"
            at += 1 if marker == 0xFF else 2 + length
    raise DataError("%s: neither a PNG nor a JPEG image" % path)


def rings_of_rows(xyz: np.ndarray) -> np.ndarray:
    """(N,) u16 ring, 0 = lowest, of a KITTI scan, whose points come laser by laser from the top one
    down, each once around to the left from straight ahead: a new laser starts where the azimuth
    falls back (by more than 30 deg; of more than 63 falls the largest)."""
    if not len(xyz):
        return np.zeros(0, dtype=np.uint16)
    azimuth = np.mod(np.arctan2(xyz[:, 1], xyz[:, 0]), 2 * np.pi)
    fall = azimuth[:-1] - azimuth[1:]
    ends = np.flatnonzero(fall > np.radians(30.0))
    if len(ends) > HDL64_RINGS - 1:
        ends = ends[np.argsort(-fall[ends], kind="stable")[: HDL64_RINGS - 1]]
    starts = np.zeros(len(xyz), dtype=np.int64)
    starts[ends + 1] = 1
    row = np.cumsum(starts)
    return (row[-1] - row).astype(np.uint16)


def rings_of_elevation(xyz: np.ndarray) -> np.ndarray:
    """(N,) u16 ring, 0 = lowest, of the HDL-64E's laser that points nearest to each point's
    elevation: 32 lasers 1/3 deg apart down from 2 deg, 32 lasers 1/2 deg apart below them."""
    upper = 2.0 - np.arange(32) / 3.0
    lower = upper[-1] - 0.5 * np.arange(1, 33)
    lasers = np.concatenate([upper, lower])[::-1]
    elevation = np.degrees(np.arctan2(xyz[:, 2], np.hypot(xyz[:, 0], xyz[:, 1])))
    return np.searchsorted((lasers[1:] + lasers[:-1]) / 2.0, elevation).astype(np.uint16)


def rings_of_scan(xyz: np.ndarray) -> np.ndarray:
    """(N,) u16 ring, 0 = lowest, of a KITTI scan: by the order of its points where that is laser by
    laser (exact), else by their elevation (some rings off, for the lasers differ in height)."""
    rings = rings_of_rows(xyz)
    rows = int(rings.max()) + 1 if len(rings) else 0
    if len(xyz) < 32 * HDL64_RINGS:
        return rings  # too few points to tell
    elevation = np.degrees(np.arctan2(xyz[:, 2], np.hypot(xyz[:, 0], xyz[:, 1])))
    spread = [np.ptp(np.percentile(elevation[rings == r], [10, 90])) for r in range(rows)]
    # The lasers of real scans spread over up to 4.3 deg, for their height differs on the sensor.
    by_laser = rows >= HDL64_RINGS // 4 and np.median(spread) < 8.0
    return rings if by_laser else rings_of_elevation(xyz)


def sweep_times(xyz: np.ndarray, start_ns: int, forward_ns: int, end_ns: int) -> np.ndarray:
    """(N,) u32 ns after start_ns at which a KITTI scan's points were measured.

    The scanner turns clockwise seen from above, from straight behind over the left side; it looks
    straight ahead (x) at forward_ns and ends behind at end_ns. Linear between the three.
    """
    azimuth = np.arctan2(xyz[:, 1].astype(float), xyz[:, 0].astype(float))
    before = (np.pi - azimuth) / np.pi * (forward_ns - start_ns)
    after = (forward_ns - start_ns) - azimuth / np.pi * (end_ns - forward_ns)
    times = np.where(azimuth > 0, before, after)
    return np.clip(np.rint(times), 0, end_ns - start_ns).astype(np.uint32)


def rectified_camera(
    projection: np.ndarray, t_parent_rect: np.ndarray
) -> Tuple[np.ndarray, np.ndarray]:
    """K (3, 3) and T_parent_camera (4, 4) of a rectified KITTI camera with P (3, 4) = K [I | b].

    `t_parent_rect` places the rectified reference camera. b, the camera's place in it, goes into
    the transform (all three numbers of it), so that P of camera_info has no fourth column.
    """
    k = projection[:, :3].copy()
    offset = np.linalg.solve(k, projection[:, 3])
    t_camera_rect = np.eye(4)
    t_camera_rect[:3, 3] = offset
    return k, t_parent_rect @ np.linalg.inv(t_camera_rect)


def check_stamp(stamp_ns: int, where: str) -> int:
    """The stamp (ns); DataError outside what a ROS time holds."""
    if not 0 < stamp_ns < 2**32 * 1000000000:
        raise DataError("%s: its time lies outside 1970 to 2106" % where)
    return stamp_ns


def check_increasing(stamps_ns: Sequence[int], where: str) -> None:
    for index, (a, b) in enumerate(zip(stamps_ns, stamps_ns[1:])):
        if b <= a:
            raise DataError("%s: time %d is not after the one before it" % (where, index + 2))


def rising(stamps_ns: Sequence[int]) -> List[int]:
    """Positions of the longest part of a series in which each time is after the one before it: a
    clock that repeats itself or steps back costs its own readings, and no other's."""
    ends: List[int] = []  # position of the least last time of a part of each length
    times: List[int] = []
    before = [-1] * len(stamps_ns)
    for position, stamp in enumerate(stamps_ns):
        length = bisect.bisect_left(times, stamp)
        before[position] = ends[length - 1] if length else -1
        ends[length:], times[length:] = (
            [position] + ends[length + 1 :],
            [stamp] + times[length + 1 :],
        )
    chosen = [ends[-1]] if ends else []
    while chosen and before[chosen[-1]] >= 0:
        chosen.append(before[chosen[-1]])
    return chosen[::-1]


def say_gaps(where: str, gaps: Dict[int, str]) -> None:
    """Warns of frames that are left out: number -> what it lacks."""
    if gaps:
        first = min(gaps)
        warn(
            "%s: %d frames are left out (the first is number %d: %s)"
            % (where, len(gaps), first, gaps[first])
        )


def pick(numbers: Iterable[int], first: int, last: Optional[int], where: str) -> List[int]:
    """The frame numbers from first to last inclusive (None = no end), sorted; at least one."""
    chosen = sorted(n for n in numbers if n >= first and (last is None or n <= last))
    if not chosen:
        raise DataError("%s: no scan among the chosen frames" % where)
    return chosen
