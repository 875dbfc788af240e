# SPDX-License-Identifier: MIT
"""KITTI raw drives (Geiger et al., "Vision meets robotics") and the compact form of one.

Public layout, as it unpacks:
  DATE/calib_cam_to_cam.txt, calib_velo_to_cam.txt, calib_imu_to_velo.txt
  DATE/DATE_drive_NNNN_sync/       rectified PNG images, everything at 10 Hz
  DATE/DATE_drive_NNNN_extract/    raw (distorted) images, oxts at 100 Hz, scans as .txt
    image_02, image_03             data/NNNNNNNNNN.png, timestamps.txt
    velodyne_points                data/*.bin|txt, timestamps[|_start|_end].txt
    oxts                           data/*.txt, timestamps.txt
Compact form: numbered .jpg and .npz (xyz_2mm int16, intensity) beside calib_and_kissicp_poses.npz.

Time of a point. The HDL-64E turns clockwise seen from above (azimuth atan2(y, x) falls with time),
from straight behind to straight behind, and triggers the cameras looking ahead; timestamps_start,
timestamps and timestamps_end are those three moments. (The data set's readme says
counter-clockwise; a car that closes in from behind shows the seam, and its left part is measured
first.) The files do not tell by how much single lasers are turned against that, a few degrees or up
to 2 ms; so within a few degrees of straight behind a point may get the wrong end of the sweep.

Frames. `base_link` is the IMU, `velodyne` and `camera_0N_optical_frame` hang below. `odom` has its
origin at the first oxts reading, x east, y north, z up. The baseline of a rectified camera stands
in tf, so P of camera_info has no fourth column.
"""

import os
import re
from typing import Callable, Dict, List, NamedTuple, Optional, Tuple

import numpy as np

from semantic_lidar_fusion.datasets import records
from semantic_lidar_fusion.datasets.timed_frames import Frames, frames_of, read_times
from semantic_lidar_fusion.bags import poses
from semantic_lidar_fusion.cli import warn
from semantic_lidar_fusion.errors import DataError
from semantic_lidar_fusion.labels import LabelSet

LIDAR_FRAME = "velodyne"
LIDAR_TOPIC = "/velodyne_points"
_EARTH_RADIUS_M = 6378137.0
_COMPACT_FILE = "calib_and_kissicp_poses.npz"
_COMPACT_PERIOD_NS = 100000000
_COMPACT_UNIT_M = 0.002


def read(
    folder: str, labels: LabelSet, cameras: Optional[List[str]], first: int, last: Optional[int]
) -> records.Drive:
    """A drive in either form. `cameras`: image folders, default image_02 and image_03 as they
    exist; `first`, `last`: numbers of the first and last frame to take."""
    records.require_folder(folder)
    if os.path.isfile(os.path.join(folder, _COMPACT_FILE)):
        return _read_compact(folder, labels, first, last)
    return _read_raw(os.path.abspath(folder), labels, cameras, first, last)


def mercator_poses(readings: np.ndarray) -> np.ndarray:
    """T_odom_imu (M, 4, 4) of oxts rows (M, >= 6): lat, lon (deg), alt (m), roll, pitch, yaw (rad).

    Mercator projection scaled at the first latitude, relative to the first position;
    x east, y north.
    """
    latitude, longitude = readings[:, 0], readings[:, 1]
    scale = np.cos(np.radians(latitude[0]))
    position = np.stack(
        [
            scale * _EARTH_RADIUS_M * np.radians(longitude),
            scale * _EARTH_RADIUS_M * np.log(np.tan(np.radians(90.0 + latitude) / 2.0)),
            readings[:, 2],
        ],
        axis=1,
    )
    result = np.repeat(np.eye(4)[None], len(readings), axis=0)
    result[:, :3, 3] = position - position[0]
    roll, pitch, yaw = readings[:, 3], readings[:, 4], readings[:, 5]
    about_x = np.stack([np.sin(roll / 2), 0 * roll, 0 * roll, np.cos(roll / 2)], axis=1)
    about_y = np.stack([0 * pitch, np.sin(pitch / 2), 0 * pitch, np.cos(pitch / 2)], axis=1)
    about_z = np.stack([0 * yaw, 0 * yaw, np.sin(yaw / 2), np.cos(yaw / 2)], axis=1)
    result[:, :3, :3] = (
        poses.to_rotation(about_z) @ poses.to_rotation(about_y) @ poses.to_rotation(about_x)
    )
    return result


def _read_oxts(folder: str) -> Tuple[np.ndarray, np.ndarray]:
    frames = frames_of(folder, [".txt"])
    records.say_gaps(folder, frames.gaps)
    rows = []
    for number, file in sorted(frames.files.items()):
        lines = records.read_lines(file)
        if not lines:
            raise DataError("%s: empty" % file)
        rows.append(records.parse_numbers(lines[0], 30, file))
    readings = np.array(rows)
    if (np.abs(readings[:, 0]) > 89).any() or (np.abs(readings[:, 1]) > 360).any():
        raise DataError("%s: a latitude or longitude is out of range" % folder)
    stamps = [frames.times[number] for number in sorted(frames.files)]
    return np.array(stamps, dtype=np.int64), mercator_poses(readings)


def _read_rigid(path: str) -> np.ndarray:
    entry = records.read_calibration(path, {"R": 9, "T": 3})
    rotation = records.check_rotation(entry["R"].reshape(3, 3), path + " (R)")
    return poses.make_transform(rotation, entry["T"])


def _read_camera(
    frames: Frames, name: str, calibration: str, t_velo_cam0: np.ndarray, rectified: bool
) -> records.CameraRecord:
    """One camera; `t_velo_cam0` places the unrectified reference camera in the lidar's frame."""
    number = name[-2:]
    images = [records.ImageRecord(frames.times[n], f) for n, f in sorted(frames.files.items())]
    if rectified:
        entry = records.read_calibration(calibration, {"P_rect_" + number: 12, "R_rect_00": 9})
        r_rect = records.check_rotation(
            entry["R_rect_00"].reshape(3, 3), calibration + " (R_rect_00)"
        )
        t_velo_rect = t_velo_cam0 @ poses.invert(poses.make_transform(r_rect, np.zeros(3)))
        k, t_velo_camera = records.rectified_camera(
            entry["P_rect_" + number].reshape(3, 4), t_velo_rect
        )
        model, d = "plumb_bob", [0.0] * 5
    else:
        keys = {"K_" + number: 9, "D_" + number: 5, "R_" + number: 9, "T_" + number: 3}
        entry = records.read_calibration(calibration, keys)
        rotation = records.check_rotation(
            entry["R_" + number].reshape(3, 3), "%s (R_%s)" % (calibration, number)
        )
        t_camera_cam0 = poses.make_transform(rotation, entry["T_" + number])
        t_velo_camera = t_velo_cam0 @ poses.invert(t_camera_cam0)
        k, model, d = entry["K_" + number].reshape(3, 3), "plumb_bob", list(entry["D_" + number])
    camera = "camera_" + number
    frame = camera + "_optical_frame"
    return records.CameraRecord(
        camera, frame, LIDAR_FRAME, t_velo_camera, k, model, d, rectified, images
    )


def _scan_loader(
    path: str, start_ns: int, forward_ns: int, end_ns: int
) -> Callable[[], records.Scan]:
    def load() -> records.Scan:
        xyz, intensity = records.read_points(path)
        times = records.sweep_times(xyz, start_ns, forward_ns, end_ns)
        return records.Scan(xyz, intensity, records.rings_of_scan(xyz), times, None)

    return load


def _read_scans(folder: str, first: int, last: Optional[int]) -> List[records.ScanRecord]:
    """The scans from number `first` to `last` whose sweep is known."""
    frames = frames_of(folder, [".bin", ".txt"])
    start = read_times(os.path.join(folder, "timestamps_start.txt"))
    end = read_times(os.path.join(folder, "timestamps_end.txt"))
    gaps = frames.within(first, last)
    result = []
    odd = 0
    for n in records.pick(frames.files, first, last, folder):
        if n not in start or n not in end:
            gaps[n] = "no start or end of its sweep"
            continue
        if not 0 < end[n] - start[n] <= 10**9:
            gaps[n] = "its sweep takes %.3f s" % ((end[n] - start[n]) * 1e-9)
            continue
        middle = frames.times[n]
        if not start[n] < middle < end[n]:
            odd += 1
            middle = (start[n] + end[n]) // 2
        load = _scan_loader(frames.files[n], start[n], middle, end[n])
        result.append(records.ScanRecord(start[n], load))
    kept = records.rising([scan.stamp_ns for scan in result])
    if len(kept) < len(result):
        warn("%s: %d scans start before the one before" % (folder, len(result) - len(kept)))
    records.say_gaps(folder, gaps)
    if odd:
        warn(
            "%s: %d lines of timestamps.txt lie outside their sweep; the middle of the sweep is used"
            % (folder, odd)
        )
    if not kept:
        raise DataError("%s: the sweep of no scan is known" % folder)
    return [result[i] for i in kept]


def _camera_frames(
    folder: str, cameras: List[str], first: int, last: Optional[int], same_numbers: bool
) -> Dict[str, Frames]:
    """Image frames of each camera that has any. `same_numbers`: as those of the scans."""
    found: Dict[str, Frames] = {}
    problems = []
    for camera in cameras:
        try:
            found[camera] = frames_of(os.path.join(folder, camera), [".png", ".jpg"])
        except DataError as error:
            problems.append(str(error))
            continue
        gaps = found[camera].within(first, last) if same_numbers else found[camera].gaps
        records.say_gaps(os.path.join(folder, camera), gaps)
    if not found:
        raise DataError("; ".join(problems))
    for problem in problems:
        warn("a camera is left out: %s" % problem)
    return found


def _read_raw(
    folder: str, labels: LabelSet, cameras: Optional[List[str]], first: int, last: Optional[int]
) -> records.Drive:
    name = os.path.basename(folder)
    unrectified = name.endswith("_extract")
    calibration = os.path.dirname(folder)
    if os.path.isfile(os.path.join(folder, "calib_cam_to_cam.txt")):
        calibration = folder
    if cameras is None:
        cameras = [c for c in ("image_02", "image_03") if os.path.isdir(os.path.join(folder, c))]
        if not cameras:
            raise DataError(
                "%s: neither image_02 nor image_03 (is it the folder of a drive?)" % folder
            )
    for camera in cameras:
        if not re.match(r"image_0[0-3]\Z", camera):
            raise DataError("--cameras %s: must be image_00 to image_03" % camera)
    t_velo_imu = _read_rigid(os.path.join(calibration, "calib_imu_to_velo.txt"))
    t_cam0_velo = _read_rigid(os.path.join(calibration, "calib_velo_to_cam.txt"))
    cam_to_cam = os.path.join(calibration, "calib_cam_to_cam.txt")
    frames = _camera_frames(folder, cameras, first, last, not unrectified)
    read_cameras = [
        _read_camera(frames[c], c, cam_to_cam, poses.invert(t_cam0_velo), not unrectified)
        for c in cameras
        if c in frames
    ]
    odometry = _read_oxts(os.path.join(folder, "oxts"))
    scans = _read_scans(os.path.join(folder, "velodyne_points"), first, last)
    return records.Drive(
        name,
        labels,
        [
            c._replace(images=_beside(c.images, scans, whole=first == 0 and last is None))
            for c in read_cameras
        ],
        LIDAR_TOPIC,
        LIDAR_FRAME,
        poses.invert(t_velo_imu),
        scans,
        odometry,
        True,
        [
            "KITTI raw drive %s; odometry at %.0f Hz from oxts."
            % (name, (len(odometry[0]) - 1) * 1e9 / max(1, odometry[0][-1] - odometry[0][0])),
            "The images are %s." % ("distorted" if unrectified else "rectified"),
        ],
    )


def _beside(
    images: List[records.ImageRecord], scans: List[records.ScanRecord], whole: bool
) -> List[records.ImageRecord]:
    """The images around the chosen scans; in extracted drives the numbers differ."""
    begin, end = scans[0].stamp_ns, scans[-1].stamp_ns + 200000000
    chosen = [i for i in images if whole or begin <= i.stamp_ns <= end]
    if not chosen:
        raise DataError("%s: no image in the time of the scans" % os.path.dirname(images[0].path))
    return chosen


def unfold_compact(xyz_units: np.ndarray) -> np.ndarray:
    """(N, 3) m of the compact form's int16 coordinates, which overflow beyond 65.5 m.

    Such a point jumps out of the order of azimuth that its neighbours keep: where x or y taken one
    turn (2^16 units) further puts it back in line, that is its place.
    """
    xyz = xyz_units.astype(float) * _COMPACT_UNIT_M
    if len(xyz) < 3:
        return xyz
    turn = 65536 * _COMPACT_UNIT_M
    direction = xyz[:, 0] + 1j * xyz[:, 1]
    half = 20
    padded = np.pad(direction / np.maximum(np.abs(direction), 1e-9), half, mode="reflect")
    shape, strides = (len(xyz), 2 * half + 1), padded.strides * 2
    window = np.lib.stride_tricks.as_strided(padded, shape, strides, writeable=False)
    usual = np.conj(np.median(window.real, axis=1) + 1j * np.median(window.imag, axis=1))

    def off(candidate: np.ndarray) -> np.ndarray:
        return np.abs(np.angle(candidate * usual))

    best = off(direction)
    lost = best > np.radians(4.0)
    for axis in (0, 1):
        moved = xyz[:, axis] - np.copysign(turn, xyz[:, axis])
        candidate = moved + 1j * direction.imag if axis == 0 else direction.real + 1j * moved
        distance = off(candidate)
        # The sensor reaches 120 m.
        good = lost & (distance < np.radians(2.0)) & (distance < best) & (np.abs(candidate) < 125.0)
        xyz[good, :2] = np.stack([candidate.real, candidate.imag], axis=1)[good]
        best = np.where(good, distance, best)
    return xyz


def _compact_loader(path: str) -> Callable[[], records.Scan]:
    def load() -> records.Scan:
        try:
            with np.load(path) as arrays:
                units, intensity = arrays["xyz_2mm"], arrays["intensity"]
        except (OSError, ValueError, KeyError) as error:
            raise DataError("%s: %s" % (path, error)) from error
        if units.dtype != np.int16 or units.shape != (len(intensity), 3):
            raise DataError("%s: xyz_2mm must be int16 (N, 3) and intensity (N,)" % path)
        xyz = unfold_compact(units).astype(np.float32)
        half = _COMPACT_PERIOD_NS // 2
        times = records.sweep_times(xyz, 0, half, 2 * half)
        # As in the public files: 0 to 1.
        level = intensity.astype(np.float32) / (255.0 if intensity.dtype == np.uint8 else 1.0)
        return records.Scan(xyz, level, records.rings_of_scan(xyz), times, None)

    return load


def _read_compact(folder: str, labels: LabelSet, first: int, last: Optional[int]) -> records.Drive:
    """The compact form has no times: frame n is taken at n * 0.1 s, its sweep 50 ms to either side,
    and its pose, which an odometry found for the uncorrected scan, holds at the sweep's middle."""
    path = os.path.join(folder, _COMPACT_FILE)
    try:
        with np.load(path) as arrays:
            projection = np.array(arrays["P_rect_02"], dtype=float).reshape(3, 4)
            r_rect = np.array(arrays["R_rect_00"], dtype=float).reshape(4, 4)
            t_cam0_velo = np.array(arrays["T_velo_to_cam0"], dtype=float).reshape(4, 4)
            frame_ids = np.array(arrays["frame_ids"]).astype(np.int64)
            trajectory = np.array(arrays["kiss_icp_poses_world_from_velo"], dtype=float)
    except (OSError, ValueError, KeyError) as error:
        raise DataError("%s: %s" % (path, error)) from error
    if trajectory.shape != (len(frame_ids), 4, 4) or not np.isfinite(trajectory).all():
        raise DataError("%s: the poses must be finite (M, 4, 4), one for each frame id" % path)
    records.check_rotation(r_rect[:3, :3], path + " (R_rect_00)")
    scan_files = records.numbered_files(folder, [".npz"])
    image_files = records.numbered_files(folder, [".jpg", ".png"])
    if sorted(scan_files) != sorted(image_files):
        raise DataError(
            "%s: %d scans (.npz) and %d images with other numbers"
            % (folder, len(scan_files), len(image_files))
        )
    numbers = records.pick(scan_files, first, last, folder)

    def at(number: int) -> int:
        return records.EPOCH_NS + number * _COMPACT_PERIOD_NS

    k, t_velo_camera = records.rectified_camera(
        projection, poses.invert(t_cam0_velo) @ poses.invert(r_rect)
    )
    camera = records.CameraRecord(
        "camera_02",
        "camera_02_optical_frame",
        LIDAR_FRAME,
        t_velo_camera,
        k,
        "plumb_bob",
        [0.0] * 5,
        True,
        [records.ImageRecord(at(n), image_files[n]) for n in numbers],
    )
    scans = [
        records.ScanRecord(at(n) - _COMPACT_PERIOD_NS // 2, _compact_loader(scan_files[n]))
        for n in numbers
    ]
    stamps = np.array([at(int(n)) for n in frame_ids], dtype=np.int64)
    return records.Drive(
        os.path.basename(os.path.abspath(folder)),
        labels,
        [camera],
        LIDAR_TOPIC,
        LIDAR_FRAME,
        np.eye(4),
        scans,
        (stamps, trajectory),
        True,
        [
            "Compact form of a KITTI raw drive: times are frame number * 0.1 s, odometry is of the",
            "lidar at 10 Hz (not ground truth), and base_link is the lidar.",
            "The images are rectified.",
        ],
    )
