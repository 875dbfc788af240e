# SPDX-License-Identifier: MIT
"""What can be said without geometry: topics, stamps, camera_info, scores, the lidar's own fields."""

from typing import Dict, List, Optional, Tuple

import numpy as np

from semantic_lidar_fusion.rigcheck.camera_checks import scan_period_s
from semantic_lidar_fusion.rigcheck.findings import Finding, Verdict
from semantic_lidar_fusion.rigcheck.sample import (
    CameraSample,
    Sample,
    Topic,
    image_topic,
    input_topic,
    lidar_topic,
    semantics_topic,
)
from semantic_lidar_fusion.rigcheck.scenes import xyz

AHEAD_S = 0.02  # a stamp this far ahead of its recording is not explained by clocks that NTP keeps
FOLD_MARGIN_DEG = 2.0  # before the fold-over, coefficients are bent already
CENTRE_SHARE = 0.2  # of the width, from the principal point to the image's centre
RESTART_NS = 500_000_000  # stamps that go back by more are no reordering
MAX_DRIFT, MIN_DRIFT_SPAN_S = 2e-4, 20.0  # s/s; quartz drifts by 5e-5 at most
MIN_SPAN_S, MAX_SPAN_S = 0.001, 1.0  # of one scan


def bag_findings(sample: Sample) -> List[Finding]:
    """Topics, gaps, stamps ahead of their recording, duplicates, overlap."""
    needed: Dict[str, str] = {lidar_topic(sample.rig): "lidar"}
    semantics: List[str] = []
    for camera in sample.cameras:
        needed[image_topic(camera.config)] = camera.name
        needed[
            input_topic(camera.config, str(camera.config.get("camera_info", "camera_info")))
        ] = camera.name
        if not sample.rig.get("segmentation", {}).get("model"):
            semantics.append(semantics_topic(camera.config))
            needed[semantics[-1]] = camera.name
    result: List[Finding] = []
    for name, sensor in needed.items():
        topic = sample.topics.get(name)
        if topic is None and name in semantics and not _images_like(name, sample):
            figure = "%s is not in the bag: geometry and times can be judged, classes cannot" % name
            result.append(Finding(sensor, "topic", Verdict.NOT_OBSERVABLE, figure))
            continue
        if topic is None:
            near = _similar(name, list(sample.topics))
            cure = "did you mean %s?" % near if near else "record it, or correct the rig's topic"
            result.append(
                Finding(sensor, "topic", Verdict.WRONG, "%s is not in the bag" % name, "", cure)
            )
            continue
        result += _stream(topic, sensor)
    spans = [sample.topics[n].times_ns for n in needed if n in sample.topics]
    spans = [times for times in spans if len(times) > 1]
    if spans:
        start, end = max(t[0] for t in spans), min(t[-1] for t in spans)
        whole = max(t[-1] for t in spans) - min(t[0] for t in spans)
        share = max(0.0, (end - start) / whole) if whole > 0 else 1.0
        verdict = Verdict.OK if share > 0.5 else Verdict.SUSPECT
        figure = "all needed topics overlap in %.0f %% of the bag" % (100 * share)
        cure = (
            ""
            if verdict == Verdict.OK
            else "pass all bags of the drive, or a bag that has all topics"
        )
        result.append(Finding("bag", "overlap", verdict, figure, "", cure))
    return result


def _images_like(name: str, sample: Sample) -> str:
    """An image topic that may be meant by `name`, and is no camera's; "" if there is none."""
    taken = {image_topic(camera.config) for camera in sample.cameras}
    kinds = {n for n, topic in sample.topics.items() if topic.kind == "sensor_msgs/Image"}
    return _similar(name, sorted(kinds - taken))


def _similar(name: str, names: List[str]) -> str:
    import difflib

    return next(iter(difflib.get_close_matches(name, names, 1, 0.6)), "")


def _stream(topic: Topic, sensor: str) -> List[Finding]:
    times = topic.times_ns
    figure = "%s: %d messages, %.1f Hz" % (topic.name, len(times), topic.rate_hz)
    if topic.kind == "sensor_msgs/CameraInfo":
        return [Finding(sensor, "topic", Verdict.OK, figure)]
    result = []
    gaps = np.diff(times) / 1e9
    if len(gaps) > 10 and gaps.max() > max(0.5, 5 * float(np.median(gaps))):
        text = figure + ", longest gap %.2f s" % gaps.max()
        cause = "messages are missing"
        result.append(
            Finding(sensor, "topic", Verdict.SUSPECT, text, cause, "record to a faster disk")
        )
    else:
        result.append(Finding(sensor, "topic", Verdict.OK, figure))
    if not topic.stamps:
        return result
    stamps = np.array(topic.stamps, dtype=np.int64)
    ahead = (stamps[:, 0] - stamps[:, 1]) / 1e9
    middle = float(np.median(ahead))
    if (stamps[:, 0] == 0).all():
        cure = "let the driver stamp its messages"
        return [*result, Finding(sensor, "stamps", Verdict.WRONG, "all stamps are 0", "", cure)]
    if abs(middle) > 1e6:
        figure = "stamps are %.0f s from the recording's clock" % middle
        cause = "the driver stamps with another clock (uptime, or GPS time without leap seconds)"
        verdict = Verdict.SUSPECT
        cure = "synchronise the sensor's clock, or set its time_offset"
        result.append(Finding(sensor, "stamps", verdict, figure, cause, cure))
    elif middle > AHEAD_S:
        figure = "stamps are %.0f ms ahead of the recording" % (1e3 * middle)
        cause = "no message can arrive before its time: the clock or the stamp is wrong"
        cure = "synchronise the clocks (PTP or chrony), or set time_offset by -%.3f" % middle
        result.append(Finding(sensor, "stamps", Verdict.WRONG, figure, cause, cure))
    else:
        result += _clock(stamps, sensor)
    unique = np.unique(stamps[:, 0])
    if len(unique) < 0.9 * len(np.unique(stamps[:, 1])) and len(stamps) > 5:
        figure = "%d stamps for %d messages" % (len(unique), len(stamps))
        cure = "remove the second publisher or recorder"
        result.append(
            Finding(sensor, "duplicates", Verdict.SUSPECT, figure, "messages come twice", cure)
        )
    return result


def _clock(stamps: np.ndarray, sensor: str) -> List[Finding]:
    """How the stamps (M, 2; stamp and record time, ns, by the latter) run against the recording."""
    back = int((np.diff(stamps[:, 0]) < -RESTART_NS).sum())
    if back:
        figure = "stamps go back by more than %.1f s %d times" % (RESTART_NS / 1e9, back)
        cure = "check the driver for restarts; split the bag there"
        return [
            Finding(sensor, "stamps", Verdict.SUSPECT, figure, "a clock or driver restarts", cure)
        ]
    delay = (stamps[:, 1] - stamps[:, 0]) / 1e9
    middle = float(np.median(delay))
    jitter = 1.4826 * float(np.median(np.abs(delay - middle)))
    figure = "recorded %.1f +- %.1f ms after their stamps" % (1e3 * middle, 1e3 * jitter)
    span = float(stamps[-1, 1] - stamps[0, 1]) / 1e9
    if span > MIN_DRIFT_SPAN_S:
        seconds = (stamps[:, 1] - stamps[0, 1]) / 1e9
        drift = float(np.polyfit(seconds, delay, 1)[0])
        figure += ", drift %+.0f us/s" % (1e6 * drift)
        # Queues jitter; a clock that drifts moves the delay by more than that.
        if abs(drift) > MAX_DRIFT and abs(drift) * span > max(0.01, 3 * jitter):
            cause = "the sensor's clock drifts against the recorder's"
            cure = "synchronise the clocks (PTP or chrony)"
            return [Finding(sensor, "stamps", Verdict.SUSPECT, figure, cause, cure)]
    return [Finding(sensor, "stamps", Verdict.OK, figure)]


def camera_info_findings(sample: Sample) -> List[Finding]:
    """camera_info against the images: size, principal point, focal length, fold-over."""
    result: List[Finding] = []
    for camera in sample.cameras:
        for problem in camera.problems[:3]:
            result.append(Finding(camera.name, "images", Verdict.SUSPECT, problem))
        if camera.info is None:
            result.append(
                Finding(camera.name, "camera_info", Verdict.WRONG, "no camera_info was read")
            )
            continue
        result += _one_info(camera)
        result += _fold_over(camera)
    return result


def _fold_over(camera: CameraSample) -> List[Finding]:
    """Whether the lens has a ray for every pixel; beyond the fold-over of its coefficients none has."""
    model = camera.model()
    if model is None:
        return []
    width, height = model.size
    u, v = np.meshgrid(np.linspace(0, width - 1, 40), np.linspace(0, height - 1, 40))
    rays = model.rays(np.column_stack([u.ravel(), v.ravel()]))
    share = float(np.isfinite(rays).all(axis=1).mean())
    degrees = float(np.degrees(model.max_theta))
    figure = "no point beyond %.1f deg from the axis; %.0f %% of the image has points" % (
        degrees,
        100 * share,
    )
    if share > 0.97 or float(camera.config.get("max_theta_deg", 0.0)) > 0:
        return [Finding(camera.name, "fold-over", Verdict.OK, figure)]
    cause = "the lens's coefficients turn back within the image: they do not hold at its border"
    cure = "calibrate with targets near the border, or set cameras.%s.max_theta_deg: %.0f" % (
        camera.name,
        np.floor(degrees - FOLD_MARGIN_DEG),
    )
    return [Finding(camera.name, "fold-over", Verdict.SUSPECT, figure, cause, cure)]


def _one_info(camera: CameraSample) -> List[Finding]:
    info = camera.info
    assert info is not None
    image = next(iter(camera.images.values()), None)
    k = np.array(info.P if camera.config.get("rectified") else info.K, dtype=float)
    fx, cx, cy = k[0], k[2], (k[6] if camera.config.get("rectified") else k[5])
    model = camera.model()
    if (fx <= 0 and not camera.has_lens_file) or model is None:
        figure = "fx is %g%s" % (fx, "; " + camera.problems[-1] if camera.problems else "")
        return [
            Finding(
                camera.name, "camera_info", Verdict.WRONG, figure, "no calibration", "calibrate"
            )
        ]
    width, height = model.size
    if image is not None and (image.shape[1], image.shape[0]) != (width, height):
        figure = "images are %dx%d, camera_info says %dx%d" % (
            image.shape[1],
            image.shape[0],
            width,
            height,
        )
        cause = "the calibration belongs to another resolution"
        cure = "publish the camera_info of this resolution (scale K, or set binning and ROI)"
        return [Finding(camera.name, "camera_info", Verdict.WRONG, figure, cause, cure)]
    if camera.has_lens_file:
        figure = "%dx%d, lens from a file" % (width, height)
        return [Finding(camera.name, "camera_info", Verdict.OK, figure)]
    roi = info.roi.x_offset, info.roi.y_offset
    cx, cy = (cx - roi[0]) / max(1, info.binning_x), (cy - roi[1]) / max(1, info.binning_y)
    away = max(abs(cx - width / 2) / width, abs(cy - height / 2) / height)
    figure = "principal point (%.0f, %.0f) of %dx%d, fx %.0f px" % (cx, cy, width, height, fx)
    if away > CENTRE_SHARE and not any(roi):
        guess = width / (2 * cx) if cx > 0 else 0.0
        cause = "K belongs to an image of another size"
        cure = "scale fx, fy, cx, cy by about %.3g" % guess
        return [Finding(camera.name, "camera_info", Verdict.WRONG, figure, cause, cure)]
    return [Finding(camera.name, "camera_info", Verdict.OK, figure)]


def offset_findings(sample: Sample) -> List[Finding]:
    """A camera's time_offset that moves its images away from the lidar's scans."""
    result: List[Finding] = []
    if not sample.scans:
        return result
    middles = np.array([scan.middle_ns for scan in sample.scans], dtype=np.int64)
    for camera in sample.cameras:
        if not camera.image_stamps or not camera.offset_ns:
            continue
        stamps = np.array(camera.image_stamps, dtype=np.int64)

        def gap_s(offset_ns: int) -> float:
            times = stamps + offset_ns
            return float(min(np.abs(times - middle).min() for middle in middles)) / 1e9

        if gap_s(camera.offset_ns) > 0.5 and gap_s(0) < 0.2:
            seconds = camera.offset_ns / 1e9
            figure = "time_offset %g s: the nearest image is %.1f s off" % (
                seconds,
                gap_s(camera.offset_ns),
            )
            cause = "without any time_offset the images fit; its unit is seconds"
            cure = "set cameras.%s.time_offset to 0 (or to %g, if ms were meant)" % (
                camera.name,
                seconds / 1e3,
            )
            result.append(Finding(camera.name, "time_offset", Verdict.WRONG, figure, cause, cure))
    return result


def semantics_findings(sample: Sample, classes: int) -> List[Finding]:
    """Scores, labels or probabilities of `classes` classes: stamps, channels, ranges, aspect."""
    result: List[Finding] = []
    if sample.rig.get("segmentation", {}).get("model"):
        return result
    for camera in sample.cameras:
        if not camera.semantics_stamps or not camera.image_stamps:
            continue
        pairing = _pairing(camera)
        result.append(pairing)
        maps = list(camera.semantics.values())
        if maps:
            result += _values(camera, maps, classes)
    return result


def _pairing(camera: CameraSample) -> Finding:
    images = np.unique(np.array(camera.image_stamps, dtype=np.int64))
    semantics = np.unique(np.array(camera.semantics_stamps, dtype=np.int64))
    equal = np.isin(semantics, images)
    share = float(equal.mean())
    figure = "%.0f %% of the scores carry the stamp of an image" % (100 * share)
    if share > 0.5:
        return Finding(camera.name, "scores", Verdict.OK, figure)
    place = np.clip(np.searchsorted(images, semantics), 1, max(1, len(images) - 1))
    before, after = images[place - 1], images[np.minimum(place, len(images) - 1)]
    nearest = np.where(semantics - before <= after - semantics, before, after)
    # The delay is the one that turns most stamps into those of images.
    differences = np.unique((semantics[:, None] - images[None, :]).ravel())
    differences = differences[np.abs(differences) < 500_000_000]
    tries = differences[np.argsort(np.abs(differences))][:200]
    hits = [np.isin(semantics - d, images).sum() for d in tries]
    delay = int(tries[int(np.argmax(hits))]) if len(tries) else 0
    nearest_ms = float(np.median(np.abs(semantics - nearest))) / 1e6
    cause = "scores must carry exactly the stamp of the image they were made from"
    cure = "copy the image's header in the segmentation node"
    figure += "; nearest image %.3f ms off" % nearest_ms
    if len(tries) and max(hits) > 0.5 * len(semantics):
        figure += "; all fit with a delay of %.3f ms" % (delay / 1e6)
    return Finding(camera.name, "scores", Verdict.WRONG, figure, cause, cure)


def _values(camera: CameraSample, maps: List[np.ndarray], classes: int) -> List[Finding]:
    result: List[Finding] = []
    first = maps[0]
    kind = camera.config.get("input", "scores")
    image = next(iter(camera.images.values()), None)
    if kind == "labels":
        values = np.unique(np.concatenate([np.unique(one) for one in maps]))
        # 255 is the usual mark of no class.
        over = [int(v) for v in values if v >= classes and v != 255]
        figure = "labels %d to %d, %d classes" % (
            values.min(),
            values[values != 255].max(initial=0),
            classes,
        )
        if over:
            cause = "labels at or above the number of classes: %s" % ", ".join(map(str, over[:5]))
            cure = "use the network's own class set (ids one too high? training ids are expected)"
            result.append(Finding(camera.name, "labels", Verdict.WRONG, figure, cause, cure))
        else:
            result.append(Finding(camera.name, "labels", Verdict.OK, figure))
    else:
        channels = first.shape[2] if first.ndim == 3 else 1
        if channels != classes:
            figure = "%d channels, %d classes" % (channels, classes)
            cure = "use the network's own class set"
            return [Finding(camera.name, "scores", Verdict.WRONG, figure, "", cure)]
        if kind == "scores":
            sums = np.concatenate([one.reshape(-1, channels).sum(axis=1)[::17] for one in maps])
            low = min(float(one.min()) for one in maps)
            if low >= 0 and np.abs(sums - 1).max(initial=0) < 1e-3 and channels > 1:
                cause = (
                    "these are probabilities: a second softmax makes every class about as likely"
                )
                cure = "set cameras.%s.input: probabilities" % camera.name
                figure = "every cell is positive and sums to 1"
                result.append(Finding(camera.name, "scores", Verdict.WRONG, figure, cause, cure))
    if image is not None:
        ratio = (first.shape[1] / first.shape[0]) / (image.shape[1] / image.shape[0])
        figure = "%dx%d for images of %dx%d" % (
            first.shape[1],
            first.shape[0],
            image.shape[1],
            image.shape[0],
        )
        if abs(ratio - 1) > 0.08:
            cause = "another aspect than the image: the network's input was letterboxed or cropped"
            cure = "cut the borders off, or resize the image to the network's input without borders"
            result.append(Finding(camera.name, "aspect", Verdict.WRONG, figure, cause, cure))
        else:
            result.append(Finding(camera.name, "aspect", Verdict.OK, figure))
    return result


def lidar_findings(sample: Sample) -> List[Finding]:
    """Span of the times against the rotation, range unit, no-return fillers, rings."""
    if not sample.scans:
        return [Finding("lidar", "scans", Verdict.WRONG, "no scan could be read")]
    spans, turns, medians, fillers = [], [], [], []
    for scan in sample.scans:
        dt = scan.points["dt"].astype(float)
        low, high = np.percentile(dt, (1, 99))
        spans.append((high - low) / 0.98)
        p = xyz(scan.points)
        azimuth = np.degrees(np.arctan2(p[:, 1], p[:, 0])).astype(int)
        turns.append(len(np.unique(azimuth)) / 360.0)
        distance = np.linalg.norm(p, axis=1)
        medians.append(float(np.median(distance)))
        fillers.append(float((distance < 1e-3).mean()))
    return [
        _span(sample, float(np.median(spans)), float(np.median(turns))),
        _range(float(np.median(medians))),
        _fillers(float(np.mean(fillers))),
        _rings(sample),
    ]


def _span(sample: Sample, span_s: float, turn: float) -> Finding:
    period = scan_period_s(sample)
    wanted = period * min(1.0, turn) if period else None
    figure = "a scan spans %.4g ms and %.0f deg" % (1e3 * span_s, 360 * turn)
    if period:
        figure += ", scans come every %.0f ms" % (1e3 * period)
    if span_s == 0 and not sample.corrects_motion():
        figure += ": times are not used (motion.enabled: false)"
        return Finding("lidar", "time unit", Verdict.OK, figure)
    if span_s == 0:
        cause = "no time per point: a whole scan is taken for one instant"
        cure = "set lidar.without_time: azimuth, or let the driver send a time field"
        return Finding("lidar", "time unit", Verdict.SUSPECT, figure, cause, cure)
    reference = wanted or 0.1
    for factor, unit in (
        (1e3, "us"),
        (1e6, "ms"),
        (1e9, "s"),
        (1e-3, "us"),
        (1e-6, "ns"),
        (1e-9, "ns"),
    ):
        if 0.4 < span_s * factor / reference < 2.5 and not 0.4 < span_s / reference < 2.5:
            cause = "the unit of the points' times is another than assumed"
            cure = "set lidar.time_unit (%s would span %.0f ms)" % (unit, 1e3 * span_s * factor)
            return Finding("lidar", "time unit", Verdict.WRONG, figure, cause, cure)
    if not MIN_SPAN_S <= span_s <= MAX_SPAN_S:
        cause = "no spinning lidar takes so %s" % ("little" if span_s < MIN_SPAN_S else "long")
        return Finding("lidar", "time unit", Verdict.WRONG, figure, cause, "set lidar.time_unit")
    if wanted and not 0.6 < span_s / wanted < 1.6 and turn > 0.8:
        cause = "the points' times do not fit the rotation"
        cure = "check lidar.time_field, time_unit and whether clouds overlap"
        return Finding("lidar", "time unit", Verdict.SUSPECT, figure, cause, cure)
    return Finding("lidar", "time unit", Verdict.OK, figure)


def _range(median_m: float) -> Finding:
    figure = "median range %.3g m" % median_m
    if median_m > 400:
        cause = "the points are in millimetres (or centimetres)"
        return Finding(
            "lidar", "range unit", Verdict.WRONG, figure, cause, "convert them to metres"
        )
    if median_m < 0.2:
        cause = "the points are in kilometres, or nearly all are of the vehicle itself"
        return Finding(
            "lidar", "range unit", Verdict.SUSPECT, figure, cause, "set lidar.min_range_m"
        )
    return Finding("lidar", "range unit", Verdict.OK, figure)


def _fillers(share: float) -> Finding:
    figure = "%.1f %% of the points lie at the origin" % (100 * share)
    if share > 0.001:
        cause = "beams without a return come as (0, 0, 0)"
        return Finding(
            "lidar", "no returns", Verdict.SUSPECT, figure, cause, "set lidar.min_range_m: 0.5"
        )
    return Finding("lidar", "no returns", Verdict.OK, figure)


def _rings(sample: Sample) -> Finding:
    rings = [len(np.unique(scan.points["ring"])) for scan in sample.scans]
    figure = "%d rings" % int(np.median(rings))
    if np.median(rings) < 2:
        cause = "no ring field: adaptive masks and this alignment need rings"
        cure = "use a driver that sends `ring`, or set occlusion.vertical_step_deg"
        return Finding("lidar", "rings", Verdict.NOT_OBSERVABLE, figure, cause, cure)
    return Finding("lidar", "rings", Verdict.OK, figure)


def points_per_camera(sample: Sample) -> List[Finding]:
    """How many of the fused points each camera contributed, from fuse_bag's own clouds."""
    if sample.failure and not any(camera.semantics_stamps for camera in sample.cameras):
        if not sample.rig.get("segmentation", {}).get("model"):
            figure = "no scores, labels or probabilities in the bag: nothing is fused"
            return [Finding("bag", "fuse_bag", Verdict.NOT_OBSERVABLE, figure)]
    if sample.failure:
        return [
            Finding(
                "bag", "fuse_bag", Verdict.WRONG, sample.failure, "", "correct what it names first"
            )
        ]
    clouds = list(sample.fused.values())
    if not clouds:
        return []
    total = sum(len(cloud) for cloud in clouds)
    result: List[Finding] = []
    for bit, camera in enumerate(sample.cameras):
        count = 0
        for cloud in clouds:
            cameras: Optional[np.ndarray] = cloud.optional("cameras")
            if cameras is not None:
                count += int(((cameras.astype(np.int64) >> bit) & 1).sum())
        figure = "%d of %d points (%.1f %%)" % (count, total, 100 * count / max(total, 1))
        if count == 0:
            cause = "the camera contributes nothing"
            cure = "see the other findings of this camera; fuse_bag's summary counts why"
            result.append(Finding(camera.name, "points", Verdict.WRONG, figure, cause, cure))
        else:
            result.append(Finding(camera.name, "points", Verdict.OK, figure))
    return result


def findings(sample: Sample, classes: int) -> List[Finding]:
    """All of this file, for a set of `classes` classes."""
    parts: Tuple[List[Finding], ...] = (
        bag_findings(sample),
        lidar_findings(sample),
        camera_info_findings(sample),
        offset_findings(sample),
        semantics_findings(sample, classes),
        points_per_camera(sample),
    )
    return [finding for part in parts for finding in part]
