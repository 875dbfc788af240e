# SPDX-License-Identifier: MIT
"""Frames and odometry: what tf says, against the lidar's own motion and the ground.

The lidar's own motion between two consecutive scans is found by matching, in plan view, what stands
between 0.4 and 2.5 m above the ground (rings on the ground move with the sensor and would vote for
standing still).
"""

from typing import Any, List, NamedTuple, Optional, Tuple

import numpy as np

from semantic_lidar_fusion.bags.poses import invert, transform_points
from semantic_lidar_fusion.rigcheck import scenes
from semantic_lidar_fusion.rigcheck.findings import Finding, Verdict
from semantic_lidar_fusion.rigcheck.sample import Sample

MAX_MOUNT_M = 10.0  # of a sensor from the vehicle's frame
MIN_STEP_M, MIN_TURN_DEG = 0.15, 0.4  # of motion between scans that tells a direction
MAX_POINTS = 1500
MAX_PAIRS = 12


def frame_findings(sample: Sample) -> List[Finding]:
    """Transforms that are needed, told twice, too long, or that put the ground above the lidar."""
    result: List[Finding] = []
    vehicle = str(sample.rig["vehicle_frame"])
    for frame, told in sample.static_told.items():
        parents = {parent.lstrip("/") for parent, _ in told}
        if len(parents) > 1:
            figure = "%s has the parents %s" % (frame, " and ".join(sorted(parents)))
            cure = "publish one of them only"
            result.append(Finding("bag", "tf", Verdict.WRONG, figure, "two parents", cure))
        largest = max(np.abs(matrix - told[0][1]).max() for _, matrix in told)
        if largest > 1e-6:
            figure = "the static transform of %s is told with values that differ by %.3g" % (
                frame,
                largest,
            )
            cure = "publish it once; the last one wins"
            result.append(Finding("bag", "tf", Verdict.SUSPECT, figure, "told twice", cure))
    T_vehicle_lidar = sample.T_vehicle_lidar()
    if sample.scans and T_vehicle_lidar is None:
        figure = "no static transform from %s to %s" % (vehicle, sample.lidar_frame)
        cure = "publish it on tf_static (frames seen: %s)" % (_frames(sample) or "none")
        result.append(Finding("lidar", "frame", Verdict.WRONG, figure, "", cure))
    elif T_vehicle_lidar is not None:
        result += _mount("lidar", T_vehicle_lidar)
        result += _ground(sample, T_vehicle_lidar)
    for camera in sample.cameras:
        if camera.info is None:
            continue
        T_camera_vehicle = sample.T_camera_vehicle(camera)
        if T_camera_vehicle is None:
            figure = "no static transform from %s to %s" % (vehicle, camera.info.header.frame_id)
            cure = "publish it on tf_static (frames seen: %s)" % (_frames(sample) or "none")
            result.append(Finding(camera.name, "frame", Verdict.WRONG, figure, "", cure))
            continue
        T_vehicle_camera = invert(T_camera_vehicle)
        result += _mount(camera.name, T_vehicle_camera)
        result += _axis(camera.name, T_vehicle_camera)
    return result


def _frames(sample: Sample) -> str:
    return ", ".join(sorted(sample.static_told)[:12])


def _mount(sensor: str, T_vehicle_sensor: np.ndarray) -> List[Finding]:
    x, y, z = T_vehicle_sensor[:3, 3]
    figure = "at (%.2f, %.2f, %.2f) m in the vehicle's frame" % (x, y, z)
    if np.linalg.norm((x, y, z)) > MAX_MOUNT_M:
        cause = "no vehicle is that large: the translation is in millimetres or centimetres"
        cure = "divide the translation by 1000 (or 100)"
        return [Finding(sensor, "position", Verdict.WRONG, figure, cause, cure)]
    return [Finding(sensor, "position", Verdict.OK, figure)]


def _axis(sensor: str, T_vehicle_camera: np.ndarray) -> List[Finding]:
    """An optical axis points along the ground, and the image's down is the vehicle's down."""
    forward, down = T_vehicle_camera[:3, 2], T_vehicle_camera[:3, 1]
    figure = "optical axis (%.2f, %.2f, %.2f), image down (%.2f, %.2f, %.2f)" % (*forward, *down)
    if abs(forward[2]) > 0.85:
        cause = "the camera looks %s: its frame is not optical, or the transform is inverted" % (
            "up" if forward[2] > 0 else "down"
        )
        cure = "z must point forward and x right; see REP 103, suffix _optical"
        return [Finding(sensor, "axes", Verdict.SUSPECT, figure, cause, cure)]
    if down[2] > 0.5:
        cause = "the camera stands on its head in tf"
        cure = "turn the transform by 180 deg about z, if the images are upright"
        return [Finding(sensor, "axes", Verdict.SUSPECT, figure, cause, cure)]
    return [Finding(sensor, "axes", Verdict.OK, figure)]


def _ground(sample: Sample, T_vehicle_lidar: np.ndarray) -> List[Finding]:
    heights, shares = [], []
    for scan in sample.scans[:8]:
        found = scenes.ground_of(transform_points(T_vehicle_lidar, scenes.xyz(scan.points)))
        if found is not None:
            heights.append(found.height_m)
            shares.append(found.share)
    if not heights:
        return [Finding("lidar", "ground", Verdict.NOT_OBSERVABLE, "too few points near by")]
    above = float(T_vehicle_lidar[2, 3] - np.median(heights))
    figure = "the fullest plane lies %.2f m below the lidar (%.0f %% of the points within 20 m)" % (
        above,
        100 * float(np.median(shares)),
    )
    if float(np.median(shares)) < 0.15:
        return [Finding("lidar", "ground", Verdict.NOT_OBSERVABLE, figure)]
    if above < -0.3:
        cause = "the ground is above the lidar: it stands upside down in tf"
        cure = "correct the rotation of the lidar's transform (roll of 180 deg)"
        return [Finding("lidar", "ground", Verdict.WRONG, figure, cause, cure)]
    return [Finding("lidar", "ground", Verdict.OK, figure)]


class Step(NamedTuple):
    """Motion of the vehicle between two scans, in its own frame: x, y (m), yaw (rad)."""

    x: float
    y: float
    yaw: float


def odometry_findings(sample: Sample) -> List[Finding]:
    """Coverage, pose against twist, and both against the lidar's own motion."""
    odometry = sample.odometry
    if not len(odometry):
        if not sample.corrects_motion():
            return [Finding("odometry", "poses", Verdict.OK, "not used (motion.enabled: false)")]
        figure = "no pose of %s in %s" % (sample.rig["vehicle_frame"], sample.rig["fixed_frame"])
        cure = "publish it on tf"
        if sample.odometry_message:
            cure = "set odometry.source: topic and odometry.topic; the bag has nav_msgs/Odometry"
        return [Finding("odometry", "poses", Verdict.WRONG, figure, "", cure)]
    result = _coverage(sample)
    result += _twist(sample)
    result += _against_lidar(sample)
    return result


def _coverage(sample: Sample) -> List[Finding]:
    stamps = sample.odometry.stamps_ns
    rate = (len(stamps) - 1) * 1e9 / max(1, stamps[-1] - stamps[0]) if len(stamps) > 1 else 0.0
    middles = np.array([scan.middle_ns for scan in sample.scans], dtype=np.int64)
    covered = (
        float(((middles >= stamps[0]) & (middles <= stamps[-1])).mean()) if len(middles) else 0.0
    )
    figure = "%.0f Hz, covers %.0f %% of the scans" % (rate, 100 * covered)
    if covered < 0.5:
        gap = 0.0
        if len(middles):
            gap = min(np.abs(middles - stamps[0]).min(), np.abs(middles - stamps[-1]).min()) / 1e9
        cause = "lidar and odometry do not overlap in time (nearest %.1f s)" % gap
        cure = "synchronise the clocks, or set lidar.time_offset"
        return [Finding("odometry", "coverage", Verdict.WRONG, figure, cause, cure)]
    return [Finding("odometry", "coverage", Verdict.OK, figure)]


def _twist(sample: Sample) -> List[Finding]:
    """The path of the poses against the integral of the message's own twist."""
    readings = sample.odometry_message
    if len(readings) < 20:
        return []
    stamps = np.array([entry[0] for entry in readings], dtype=np.int64)
    poses = np.array([entry[1] for entry in readings])
    twists = np.array([entry[2] for entry in readings])
    if not np.abs(twists).max() > 0.05:
        return []
    seconds = np.diff(stamps) / 1e9
    near = (seconds > 0) & (seconds < 0.2)
    if near.sum() < 10:
        return []
    relative = invert(poses[:-1]) @ poses[1:]
    moved = relative[near, 0, 3].sum()
    turned = np.arctan2(relative[near, 1, 0], relative[near, 0, 0])
    told = (twists[:-1, 0][near] * seconds[near]).sum()
    told_turn = twists[:-1, 5][near] * seconds[near]
    result = []
    figure = "poses go %.1f m forward, the twist %.1f m" % (moved, told)
    if max(abs(moved), abs(told)) > 1.0 and abs(moved - told) > 0.25 * max(abs(moved), abs(told)):
        cause = _ratio_cause(moved / told if abs(told) > 1e-6 else np.inf, "motion")
        cure = "check the wheel or localiser driver; pose and twist must agree"
        result.append(Finding("odometry", "pose/twist", Verdict.WRONG, figure, cause, cure))
    else:
        result.append(Finding("odometry", "pose/twist", Verdict.OK, figure))
    if np.abs(told_turn).sum() > np.radians(5):
        slope = float(turned @ told_turn / (told_turn @ told_turn))
        if slope < 0.5:
            figure = "yaw of the poses is %.2f of the twist's" % slope
            cause = _ratio_cause(slope, "yaw")
            cure = "check the sign of yaw (counter-clockwise is positive, REP 103)"
            result.append(Finding("odometry", "pose/twist", Verdict.WRONG, figure, cause, cure))
    return result


def _ratio_cause(ratio: float, what: str) -> str:
    if ratio < -0.3:
        return "the poses' %s has the opposite sign" % what
    if abs(ratio) < 0.3:
        return "the poses are frozen"
    return "the poses' %s is %.2f of the twist's" % (what, ratio)


def _against_lidar(sample: Sample) -> List[Finding]:
    T_vehicle_lidar = sample.T_vehicle_lidar()
    if T_vehicle_lidar is None:
        return []
    told: List[Step] = []
    seen: List[Step] = []
    every = max(1, len(sample.pairs) // MAX_PAIRS)
    for a, b in sample.pairs[::every]:
        step = _odometry_step(sample, a, b)
        own = _lidar_step(sample, a, b, T_vehicle_lidar, step)
        if step is not None and own is not None:
            told.append(step)
            seen.append(own)
    if len(seen) < 3:
        return [Finding("odometry", "lidar", Verdict.NOT_OBSERVABLE, "too little stands near by")]
    return _compare(np.array(told), np.array(seen))


def _compare(told: np.ndarray, seen: np.ndarray) -> List[Finding]:
    """Slopes of the odometry's steps over the lidar's own, forward and yaw."""
    result: List[Finding] = []
    forward, figure_of = seen[:, 0], "odometry moves %.2f of the lidar's own motion (%.2f m a scan)"
    mean = float(np.median(np.abs(forward)))
    if mean > MIN_STEP_M:
        slope = float(told[:, 0] @ forward / (forward @ forward))
        figure = figure_of % (slope, mean)
        cause = cure = ""
        verdict = Verdict.OK
        if slope < -0.3:
            cause = "odometry is inverted: the vehicle drives backwards in it"
            cure = "exchange parent and child of the odometry's transform, or invert it"
        elif slope < 0.3:
            cause = "odometry is frozen"
            cure = "check that the odometry node runs and uses the right inputs"
        elif not 0.85 < slope < 1.15:
            cause = "odometry has another scale"
            cure = "correct the wheel's diameter or the odometry's unit"
            verdict = Verdict.SUSPECT
        if cause and verdict == Verdict.OK:
            verdict = Verdict.WRONG
        result.append(Finding("odometry", "scale", verdict, figure, cause, cure))
    elif float(np.median(np.abs(told[:, 0]))) > 3 * MIN_STEP_M:
        figure = "odometry moves %.2f m a scan, the lidar %.2f m" % (
            np.median(np.abs(told[:, 0])),
            mean,
        )
        result.append(
            Finding(
                "odometry", "scale", Verdict.SUSPECT, figure, "odometry moves, the lidar does not"
            )
        )
    else:
        figure = "the vehicle moves %.2f m a scan" % mean
        result.append(Finding("odometry", "scale", Verdict.NOT_OBSERVABLE, figure))
    turning = np.abs(seen[:, 2]) > np.radians(MIN_TURN_DEG)
    if turning.sum() >= 2 and (mean > MIN_STEP_M or turning.sum() >= 4):
        a, b = told[turning, 2], seen[turning, 2]
        slope = float(a @ b / (b @ b))
        figure = "odometry turns %.2f of the lidar's own yaw (%d turning pairs)" % (
            slope,
            turning.sum(),
        )
        if slope < -0.3 and not any(f.cause.startswith("odometry is inverted") for f in result):
            cause, cure = "the sign of yaw is wrong", "yaw is positive counter-clockwise (REP 103)"
            result.append(Finding("odometry", "yaw", Verdict.WRONG, figure, cause, cure))
        elif slope < 0.5 and not any(f.verdict == Verdict.WRONG for f in result):
            cause, cure = "odometry turns too little", "check the gyroscope or the steering model"
            result.append(Finding("odometry", "yaw", Verdict.SUSPECT, figure, cause, cure))
        else:
            result.append(Finding("odometry", "yaw", Verdict.OK, figure))
    else:
        result.append(Finding("odometry", "yaw", Verdict.NOT_OBSERVABLE, "hardly any turning"))
    return result


def _odometry_step(sample: Sample, a: int, b: int) -> Optional[Step]:
    times = np.array([sample.scans[a].middle_ns, sample.scans[b].middle_ns])
    poses, covered = sample.odometry.lookup(times)
    if not covered.all():
        return None
    relative = invert(poses[0]) @ poses[1]
    return Step(relative[0, 3], relative[1, 3], float(np.arctan2(relative[1, 0], relative[0, 0])))


def _lidar_step(
    sample: Sample, a: int, b: int, T_vehicle_lidar: np.ndarray, hint: Optional[Step]
) -> Optional[Step]:
    """The lidar's own motion by matching two scans in plan view, from several first guesses."""
    first, second = (_standing(sample, k, T_vehicle_lidar) for k in (a, b))
    if first is None or second is None:
        return None
    from scipy.spatial import cKDTree

    tree = cKDTree(first)
    guesses = [Step(x, 0.0, 0.0) for x in (-1.2, 0.0, 1.2)]
    guesses += [hint] if hint is not None else []
    results = [_icp(tree, first, second, guess) for guess in guesses]
    residual, step = min(results, key=lambda item: item[0])
    return step if residual < 0.3 else None


def _standing(sample: Sample, k: int, T_vehicle_lidar: np.ndarray) -> Optional[np.ndarray]:
    """(N, 2) plan view of what stands on the ground, without correction of motion (its error is the
    same in both scans)."""
    points = transform_points(T_vehicle_lidar, scenes.xyz(sample.scans[k].points))
    points = points[np.isfinite(points).all(axis=1)]
    ground = scenes.ground_of(points)
    if ground is None:
        return None
    height = points[:, 2] - ground.height_m
    distance = np.hypot(points[:, 0], points[:, 1])
    standing = points[(height > 0.4) & (height < 2.5) & (distance > 2.5) & (distance < 35), :2]
    if len(standing) < 150:
        return None
    return standing[:: max(1, len(standing) // MAX_POINTS)]


def _icp(tree: Any, first: np.ndarray, second: np.ndarray, guess: Step) -> Tuple[float, Step]:
    """Point to point in the plane, the nearer 70 % of the pairs; returns the mean distance (m)."""
    angle, shift = guess.yaw, np.array([guess.x, guess.y])
    residual = np.inf
    for _ in range(25):
        c, s = np.cos(angle), np.sin(angle)
        moved = second @ np.array([[c, s], [-s, c]]) + shift
        distance, index = tree.query(moved, distance_upper_bound=2.0)
        valid = np.isfinite(distance)
        if valid.sum() < 100:
            return np.inf, guess
        limit = np.quantile(distance[valid], 0.7)
        keep = valid & (distance <= limit)
        source, target = second[keep], first[index[keep]]
        sm, tm = source.mean(axis=0), target.mean(axis=0)
        h = (source - sm).T @ (target - tm)
        new_angle = float(np.arctan2(h[0, 1] - h[1, 0], h[0, 0] + h[1, 1]))
        c, s = np.cos(new_angle), np.sin(new_angle)
        new_shift = tm - sm @ np.array([[c, s], [-s, c]])
        residual = float(distance[keep].mean()) / max(valid.mean(), 0.1)
        done = abs(new_angle - angle) < 1e-5 and np.abs(new_shift - shift).max() < 1e-4
        angle, shift = new_angle, new_shift
        if done:
            break
    return residual, Step(float(shift[0]), float(shift[1]), angle)
