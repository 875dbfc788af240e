# SPDX-License-Identifier: MIT
"""Where and when a camera looks, and through which lens: lidar edges against image edges, under the
rig as it is, corrected by small offsets, and under the mistakes that people make."""

import dataclasses
from typing import Callable, Dict, List, Optional, Tuple

import numpy as np

from semantic_lidar_fusion.bags.poses import invert
from semantic_lidar_fusion.cameras import Camera
from semantic_lidar_fusion.rigcheck import alignment, scenes, stated
from semantic_lidar_fusion.rigcheck.alignment import PITCH, ROLL, TIME, YAW, Alignment, Score, View
from semantic_lidar_fusion.rigcheck.findings import Finding, Verdict, judged, worst
from semantic_lidar_fusion.rigcheck.sample import CameraSample, Sample

# Offsets from which on a rig is suspect, and wrong: deg and s.
SUSPECT_DEG, WRONG_DEG = 0.3, 1.0
SUSPECT_S, WRONG_S = 0.005, 0.02
SUSPECT_READOUT_S = 0.008
# The rig's own score below this share of the best one is in doubt.
FAR_BETTER = 0.5
MIN_SPEED_MPS = 1.0
MIN_VIEWS = 3  # scans with an image; fewer say nothing against a rig
# A mistake is named if its remedy lifts the score by this and reaches MIN_LIFT twice over.
REMEDY_GAIN = 0.08
# from a body's axes (x forward, y left, z up) to optical ones (x right, y down, z forward)
OPTICAL = np.eye(4)
OPTICAL[:3, :3] = [[0, -1, 0], [0, 0, -1], [1, 0, 0]]


@dataclasses.dataclass
class Aligned:
    """What is known of one camera after the search."""

    camera: CameraSample
    model: Camera
    T_camera_vehicle: np.ndarray
    views: List[View]
    result: Alignment
    speed_mps: float
    stamps: Dict[int, alignment.ImageEdges]  # raw stamp of an image -> its edges
    remedy: Optional["Remedy"] = None
    readout: Optional[alignment.Readout] = None


@dataclasses.dataclass(frozen=True)
class Remedy:
    """A mistake whose correction makes the edges meet. scope: `camera` or `lidar`."""

    cause: str
    cure: str
    scope: str
    score: Score


def align(sample: Sample) -> List[Aligned]:
    """Searches every camera that has images, extrinsics and a lens."""
    T_vehicle_lidar = sample.T_vehicle_lidar()
    if T_vehicle_lidar is None:
        return []
    edges = scenes.edges_of(sample)
    cache: Dict[Tuple[str, int], alignment.ImageEdges] = {}
    found: List[Aligned] = []
    for camera in sample.cameras:
        model, T_camera_vehicle = camera.model(), sample.T_camera_vehicle(camera)
        if model is None or T_camera_vehicle is None:
            continue
        views = scenes.views_of(sample, camera, edges, T_vehicle_lidar, cache)
        if not views:
            continue
        speed = scenes.motion_of(views)
        result = alignment.fit(views, model.project, T_camera_vehicle, speed > MIN_SPEED_MPS)
        stamps = {stamp: known for (name, stamp), known in cache.items() if name == camera.name}
        found.append(Aligned(camera, model, T_camera_vehicle, views, result, speed, stamps))
    for one in found:
        one.remedy = _remedy(sample, one, found, edges, cache)
        if one.remedy is None and one.result.observable[TIME]:
            one.readout = alignment.readout(
                one.views,
                one.model.project,
                one.T_camera_vehicle,
                one.result,
                _shutter(one.camera)[1],
            )
    return found


def _shutter(camera: CameraSample) -> Tuple[float, bool]:
    """The stated readout, s, negative if the last row or column is taken first; whether it goes by
    columns."""
    shutter = camera.config.get("shutter") or {}
    direction = str(shutter.get("direction", "down"))
    sign = -1.0 if direction in ("up", "left") else 1.0
    return sign * float(shutter.get("readout_s", 0.0)), direction in ("right", "left")


def _remedy(
    sample: Sample,
    one: Aligned,
    others: List[Aligned],
    edges: List[scenes.Edges],
    cache: Dict[Tuple[str, int], alignment.ImageEdges],
) -> Optional[Remedy]:
    """The ordinary mistake whose correction fits best, if it fits clearly better than the rig with
    any small offset. Each is tried with small turns of the camera, as no calibration is exact."""
    views = alignment.thinned(one.views, 3000)
    project = one.model.project
    T = one.T_camera_vehicle
    name, frame = one.camera.name, one.camera.info.header.frame_id  # type: ignore[union-attr]
    tried: List[Tuple[str, str, str, Callable[[], Score]]] = []

    def with_extrinsics(
        matrix: np.ndarray, lens: alignment.Projection = project
    ) -> Callable[[], Score]:
        return lambda: _turned(views, lens, matrix)

    tried.append(
        (
            "the extrinsics are inverted",
            "exchange parent and child of the transform of %s, or invert it" % frame,
            "camera",
            with_extrinsics(invert(T)),
        )
    )
    tried.append(
        (
            "the camera's frame has x forward; an optical frame has z forward, x right",
            "add a frame %s_optical with the rotation (-0.5, 0.5, -0.5, 0.5) below %s and name it in "
            "camera_info" % (frame, frame),
            "camera",
            with_extrinsics(OPTICAL @ T),
        )
    )
    for other in others:
        if other is not one:
            tried.append(
                (
                    "the extrinsics are those of camera %s" % other.camera.name,
                    "exchange the transforms (or the image topics) of %s and %s"
                    % (name, other.camera.name),
                    "camera",
                    with_extrinsics(other.T_camera_vehicle),
                )
            )
    if np.linalg.norm(T[:3, 3]) > 15.0:
        smaller = invert(T)
        smaller[:3, 3] /= 1000.0
        tried.append(
            (
                "the camera's position is in millimetres",
                "divide the translation of %s by 1000" % frame,
                "camera",
                with_extrinsics(invert(smaller)),
            )
        )
    for cause, cure, lens in _lenses(one.camera):
        tried.append((cause, cure, "camera", with_extrinsics(T, lens)))
    for cause, cure, matrix in _lidar_mistakes():
        tried.append((cause, cure, "lidar", _with_lidar(sample, one, edges, cache, matrix)))

    best: Optional[Remedy] = None
    for cause, cure, scope, evaluate in tried:
        found = evaluate()
        if best is None or found.lift > best.score.lift:
            best = Remedy(cause, cure, scope, found)
    if best is None or best.score.edges < alignment.MIN_EDGES // 3:
        return None
    clear = best.score.lift > one.result.best.lift + REMEDY_GAIN
    return best if clear and best.score.lift > alignment.MIN_LIFT * 1.5 else None


def _turned(views: List[View], lens: alignment.Projection, matrix: np.ndarray) -> Score:
    """The best score with up to 0.5 deg of pitch and yaw."""
    best = Score(-1.0, 0.0, 0)
    if not views:
        return best
    stack = alignment.Stack(views)
    for pitch in np.radians((-0.5, 0.0, 0.5)):
        for yaw in np.radians((-0.5, 0.0, 0.5)):
            found = stack.score(lens, matrix, np.array([pitch, yaw, 0.0, 0.0]))
            if found.lift > best.lift:
                best = found
    return best


def _lidar_mistakes() -> List[Tuple[str, str, np.ndarray]]:
    result = []
    for cause, diagonal in (
        ("the lidar stands upside down in tf (it is not, on the vehicle)", (1, -1, -1)),
        ("the lidar's x points backwards in tf", (-1, -1, 1)),
        ("the lidar's scans are mirrored (azimuth counted the other way)", (1, -1, 1)),
    ):
        matrix = np.diag([*diagonal, 1.0]).astype(float)
        result.append((cause, "correct the transform of the lidar's frame", matrix))
    for degrees in (90, -90):
        angle = np.radians(degrees)
        matrix = np.eye(4)
        matrix[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        cause = "the lidar is turned by %d deg about its axis in tf" % -degrees
        result.append((cause, "correct the transform of the lidar's frame", matrix))
    return result


def _with_lidar(
    sample: Sample,
    one: Aligned,
    edges: List[scenes.Edges],
    cache: Dict[Tuple[str, int], alignment.ImageEdges],
    matrix: np.ndarray,
) -> Callable[[], Score]:
    def evaluate() -> Score:
        T_vehicle_lidar = sample.T_vehicle_lidar()
        assert T_vehicle_lidar is not None
        views = scenes.views_of(sample, one.camera, edges[::2], T_vehicle_lidar @ matrix, cache)
        project = one.model.project
        return _turned(alignment.thinned(views, 3000), project, one.T_camera_vehicle)

    return evaluate


def _lenses(camera: CameraSample) -> List[Tuple[str, str, alignment.Projection]]:
    """Other readings of the same camera_info."""
    import copy

    info = camera.info
    assert info is not None
    if camera.has_lens_file:
        return []
    image = next(iter(camera.images.values()), None)
    result: List[Tuple[str, str, alignment.Projection]] = []

    def add(cause: str, cure: str, changed: object, rectified: bool) -> None:
        other = CameraSample(dict(camera.config, rectified=rectified), changed)
        model = other.model()
        if model is not None:
            result.append((cause, cure, model.project))

    rectified = bool(camera.config.get("rectified", False))
    if rectified:
        add(
            "`rectified: true`, but the images are raw",
            "remove `rectified` from the camera",
            info,
            False,
        )
    elif np.any(info.P):
        add(
            "the images are rectified already, the rig takes them for raw",
            "set `rectified: true` for the camera",
            info,
            True,
        )
    for model, names in (
        ("equidistant", ("equidistant", "fisheye")),
        ("plumb_bob", ("plumb_bob",)),
    ):
        if info.distortion_model not in names and not rectified:
            changed = copy.deepcopy(info)
            changed.distortion_model = model
            changed.D = (list(info.D) + [0.0] * 4)[:4]
            add(
                "the lens is %s, camera_info says %s" % (model, info.distortion_model or "pinhole"),
                "set distortion_model: %s in the calibration file" % model,
                changed,
                False,
            )
            zero = copy.deepcopy(changed)
            zero.D = [0.0] * 4
            add(
                "the lens is %s; the coefficients of camera_info do not fit it" % model,
                "calibrate the lens as %s" % model,
                zero,
                False,
            )
    if image is not None and info.K[2] > 0 and not rectified:
        for factor in (0.5, 2.0, image.shape[1] / (2.0 * info.K[2])):
            if abs(factor - 1) < 0.1:
                continue
            changed = copy.deepcopy(info)
            k = np.array(info.K, dtype=float)
            k[:6] *= factor
            changed.K = list(k)
            add(
                "K belongs to images of %.0f %% of this width" % (100 / factor),
                "scale fx, fy, cx, cy of camera_info by %.3g" % factor,
                changed,
                False,
            )
    return result


def alignment_findings(sample: Sample, aligned: List[Aligned]) -> List[Finding]:
    """One finding for each axis of each camera, or the mistake that explains all of them."""
    result: List[Finding] = []
    common = _common_time(sample, aligned)
    if common is not None:
        result.append(common)
    for one in aligned:
        result += _one_camera(sample, one, common is not None)
    seen = {one.camera.name for one in aligned}
    for camera in sample.cameras:
        if camera.name not in seen:
            result.append(
                Finding(
                    camera.name,
                    "alignment",
                    Verdict.NOT_OBSERVABLE,
                    "no image, lens or extrinsics to look at",
                )
            )
    lidar_wide = [one.remedy for one in aligned if one.remedy and one.remedy.scope == "lidar"]
    if lidar_wide and len(lidar_wide) * 2 >= len(aligned):
        best = max(lidar_wide, key=lambda remedy: remedy.score.lift)
        result.append(Finding("lidar", "frame", Verdict.WRONG, _lift(best), best.cause, best.cure))
    return result


def _lift(remedy: Remedy) -> str:
    return "edges meet with %.2f once this is corrected" % remedy.score.lift


def _one_camera(sample: Sample, one: Aligned, time_is_common: bool) -> List[Finding]:
    name, found = one.camera.name, one.result
    if one.remedy is not None:
        figure = (
            "edges meet with %.2f as it is, %.2f at the best small offset, %.2f with the cure"
            % (
                found.now.lift,
                found.best.lift,
                one.remedy.score.lift,
            )
        )
        return [
            Finding(name, "extrinsics", Verdict.WRONG, figure, one.remedy.cause, one.remedy.cure)
        ]
    figure = "edges meet with %.2f, with %.2f at the best offset (%d edges)" % (
        found.now.lift,
        found.best.lift,
        found.best.edges,
    )
    if found.best.edges < alignment.MIN_EDGES:
        return [Finding(name, "alignment", Verdict.NOT_OBSERVABLE, figure + ": too few edges")]
    if found.best.lift < alignment.MIN_LIFT and (
        found.now.chance > alignment.MAX_CHANCE or len(one.views) < MIN_VIEWS
    ):
        why = ": too few scans" if len(one.views) < MIN_VIEWS else ": the image is full of edges"
        return [Finding(name, "alignment", Verdict.NOT_OBSERVABLE, figure + why)]
    if found.best.lift < alignment.MIN_LIFT:
        return [
            Finding(
                name,
                "alignment",
                Verdict.SUSPECT,
                figure,
                "image and lidar do not show the same scene, and no ordinary mistake explains it",
                "check the image topic, the frame of camera_info and its transform by hand",
            )
        ]
    result: List[Finding] = []
    for axis, label in ((PITCH, "pitch"), (YAW, "yaw"), (ROLL, "roll")):
        value, half = np.degrees(found.offset[axis]), np.degrees(found.half_width[axis])
        text = "%+.2f +- %.2f deg, contrast %.0f %%" % (value, half, 100 * found.contrast[axis])
        verdict = judged(value, half, SUSPECT_DEG, WRONG_DEG) if found.observable[axis] else None
        if axis == ROLL and verdict == Verdict.SUSPECT and abs(value) - half < 2 * SUSPECT_DEG:
            verdict = Verdict.OK  # the flattest axis
        result.append(
            Finding(
                name,
                label,
                Verdict.NOT_OBSERVABLE if verdict is None else verdict,
                text,
                "the camera is turned by %+.1f deg of %s" % (value, label)
                if verdict in (Verdict.SUSPECT, Verdict.WRONG)
                else "",
                "use the corrected extrinsics of the patch"
                if verdict in (Verdict.SUSPECT, Verdict.WRONG)
                else "",
            )
        )
    result.append(_time(one, time_is_common))
    explained = time_is_common or worst(result) >= Verdict.SUSPECT
    result.insert(0, _edges(name, found, figure, explained=explained))
    result += _readout(one)
    result += stated.findings(name, one.camera.config, sample.rig, found)
    return result


def _edges(name: str, found: Alignment, figure: str, explained: bool) -> Finding:
    """Edges that meet far better a little aside are no `ok`, even if no axis alone tells why."""
    if explained or found.now.lift >= FAR_BETTER * found.best.lift:
        return Finding(name, "edges", Verdict.OK, figure)
    return Finding(
        name,
        "edges",
        Verdict.SUSPECT,
        figure,
        "the edges meet far better with small offsets of several axes together",
        "check a drive with more turns and standing things; the offsets are in the lines below",
    )


def _readout(one: Aligned) -> List[Finding]:
    """Whether what remains depends on the row: the shutter."""
    if one.readout is None:
        return []
    name, found = one.camera.name, one.readout
    stated_s, by_columns = _shutter(one.camera)
    figure = "readout %+.0f +- %.0f ms over the %s, the rig says %+.0f ms" % (
        1e3 * found.value_s,
        1e3 * found.half_width_s,
        "width" if by_columns else "height",
        1e3 * stated_s,
    )
    verdict = None
    if found.observable:
        verdict = judged(found.value_s - stated_s, found.half_width_s, SUSPECT_READOUT_S, np.inf)
    if verdict is None:
        return [Finding(name, "shutter", Verdict.NOT_OBSERVABLE, figure)]
    if verdict == Verdict.OK:
        return [Finding(name, "shutter", Verdict.OK, figure)]
    cause = "the time of an edge depends on its row: a rolling shutter"
    directions = ("right", "left") if by_columns else ("down", "up")
    cure = "set cameras.%s.shutter: {readout_s: %.3f, direction: %s, stamp_row: middle}" % (
        name,
        abs(found.value_s),
        directions[0] if found.value_s > 0 else directions[1],
    )
    return [Finding(name, "shutter", Verdict.SUSPECT, figure, cause, cure)]


def _time(one: Aligned, is_common: bool) -> Finding:
    found = one.result
    value, half = found.offset[TIME], found.half_width[TIME]
    if one.speed_mps <= MIN_SPEED_MPS:
        figure = "the vehicle moves at %.1f m/s" % one.speed_mps
        return Finding(one.camera.name, "time", Verdict.NOT_OBSERVABLE, figure)
    text = "%+.1f +- %.1f ms, contrast %.0f %%" % (
        1e3 * value,
        1e3 * half,
        100 * found.contrast[TIME],
    )
    verdict = judged(value, half, SUSPECT_S, WRONG_S) if found.observable[TIME] else None
    if verdict is None:
        return Finding(one.camera.name, "time", Verdict.NOT_OBSERVABLE, text)
    if verdict == Verdict.OK or is_common:
        return Finding(one.camera.name, "time", Verdict.OK, text)
    offset = one.camera.offset_ns / 1e9 + value
    return Finding(
        one.camera.name,
        "time",
        verdict,
        text,
        "the images are taken %.0f ms %s than the rig says"
        % (abs(1e3 * value), "later" if value > 0 else "earlier"),
        "set cameras.%s.time_offset to %.3f" % (one.camera.name, offset),
    )


def _common_time(sample: Sample, aligned: List[Aligned]) -> Optional[Finding]:
    """The same offset in all cameras is the lidar's (or the odometry's), not theirs."""
    timed = [one for one in aligned if one.result.observable[TIME] and one.remedy is None]
    if len(timed) < 2 or len(timed) * 2 < len(aligned):
        return None
    values = np.array([one.result.offset[TIME] for one in timed])
    middle = float(np.median(values))
    if abs(middle) < WRONG_S or np.abs(values - middle).max() > max(0.008, 0.2 * abs(middle)):
        return None
    period = scan_period_s(sample)
    if period and abs(abs(middle) - period) < 0.25 * period:
        if middle > 0:
            cause = "the lidar's times are one scan too late: its stamps are of the scan's end"
            cure = "set lidar.time_reference: scan_end"
        else:
            cause = "the lidar's times are one scan too early: its stamps are of the scan's start"
            cure = "remove lidar.time_reference: scan_end (or set scan_start)"
        cure += "; if the lidar is right, the cameras' stamps are off: see their time_offset"
    else:
        cause = "all cameras differ from the lidar by the same time"
        cure = "set lidar.time_offset to %+.3f more than it is, or each camera's to %+.3f" % (
            -middle,
            middle,
        )
    figure = "all cameras at %+.0f ms (spread %.0f ms)" % (1e3 * middle, 1e3 * np.ptp(values))
    return Finding("lidar", "time", Verdict.WRONG, figure, cause, cure)


def scan_period_s(sample: Sample) -> Optional[float]:
    """Seconds from one scan to the next; None without consecutive scans."""
    gaps = [sample.scans[b].stamp_ns - sample.scans[a].stamp_ns for a, b in sample.pairs]
    return float(np.median(gaps)) / 1e9 if gaps else None
