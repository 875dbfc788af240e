# SPDX-License-Identifier: MIT
"""Semantic clouds against truth: what evaluate.py does.

Runs fuse_bag, pairs its clouds with the topic points_truth, and adds up the scores. Only points
with status 0 (fused) are scored; the others are counted. The most likely class is taken before the
classes are merged to the rows of the table. True classes that the class set discards are left out; a
discarded prediction is a miss, never a false positive.
"""

import json
import os
import subprocess
import sys
from typing import Dict, Iterator, List, NamedTuple, Optional, Sequence, Tuple

import numpy as np

from semantic_lidar_fusion import cli
from semantic_lidar_fusion.evaluation import bootstrap
from semantic_lidar_fusion.bags.bag_io import BagReader, to_ns
from semantic_lidar_fusion.evaluation.calibration import Samples, Variant, fit_temperature
from semantic_lidar_fusion.bags.cloud_io import SemanticCloud, require_fields, to_array, xyz
from semantic_lidar_fusion.errors import ConfigError, DataError
from semantic_lidar_fusion.labels import NO_LABEL, LabelSet
from semantic_lidar_fusion.evaluation.metrics import (
    Confusion,
    Reliability,
    Visibility,
    VisibleConfusion,
    mean_over_rows,
)
from semantic_lidar_fusion.rig import Rig

TRUTH_TOPIC = "/points_truth"
CLOUD_TOPIC = "/points_semantic"
STATUS_NAMES = ("fused", "occluded", "outside", "no_image", "no_odometry")
# A scan and its truth belong together if their stamps are not further apart, ns: less than the
# period of any spinning lidar from one scan's stamp to the other end of the scan.
MAX_STAMP_GAP_NS = 150 * 10**6
# Motion during a scan changes a range by a metre or two; points in another order differ by more.
MAX_RANGE_GAP_M = 2.0


class Configuration(NamedTuple):
    """A way to run fuse_bag: `settings` are KEY=VALUE overrides of the rig file."""

    name: str
    settings: Tuple[str, ...]
    # Name of the configuration that differs from it in the mask alone, if there is one.
    without_mask: Optional[str] = None
    truth: Tuple[str, ...] = ()  # what fuse_bag takes from the bag's truth


# The settings of the paper, whatever the rig says, for the keys that the loader knows. A mask of
# fixed angles is that of the paper's lidar (VLP-16); other lidars' steps are those of their data.
PAPER = (
    ("image_choice", "closest_to_reference"),
    ("reference.choose", "closest_image"),
    ("motion.granularity", "firing"),
    ("odometry.lookup", "interpolate"),
    ("uncertainty.temperature", "1"),
    ("uncertainty.exponent", "2"),
    ("uncertainty.blend", "0"),
    ("transfer", "pixel"),
    ("overlap", "mean"),
    ("smoothing.iterations", "0"),
)
_PAPER_STEPS = {"VLP16": ("2", "0.1")}


def paper_settings(rig: Rig) -> Tuple[str, ...]:
    """The overrides that make a rig fuse as the paper does, without its mask."""
    return tuple("%s=%s" % setting for setting in PAPER if rig.has(setting[0]))


def paper_mask(rig: Rig) -> Tuple[str, ...]:
    """The overrides for the paper's mask."""
    vertical, horizontal = _PAPER_STEPS.get(rig.text("lidar.model"), ("0", "0"))
    return (
        "occlusion.mode=paper",
        "occlusion.vertical_step_deg=" + vertical,
        "occlusion.horizontal_step_deg=" + horizontal,
    )


PAPER_EXPONENT = float(dict(PAPER)["uncertainty.exponent"])
# The column of the rig as it is.
PACKAGE = "package"


def configurations(rig: Rig, paper_only: bool = False) -> List[Configuration]:
    """The columns of Table I: the paper's direct, motion and motion_mask, then the rig as it is
    (unless `paper_only`). A rig without motion has direct and mask instead."""
    paper = paper_settings(rig)
    still, open_view = ("motion.enabled=false",), ("occlusion.mode=off",)
    result = [Configuration("direct", paper + still + open_view)]
    if rig.flag("motion.enabled"):
        result.append(Configuration("motion", paper + open_view))
        result.append(Configuration("motion_mask", paper + paper_mask(rig), "motion"))
    else:
        result.append(Configuration("mask", paper + paper_mask(rig), "direct"))
    return result if paper_only else result + [Configuration(PACKAGE, ())]


# Odometry of no error: where the simulator's vehicle really was.
_TRUE_ODOMETRY = (
    "odometry.source=topic",
    "odometry.topic=/truth/poses",
    "odometry.time_offset=0",
    "fixed_frame=world",
)


def bounds(rig: Rig) -> List[Configuration]:
    """The rig as it is, but with what only a simulator knows: how much each step costs at most."""
    seen = ("visibility",)
    result = [Configuration("true_visibility", (), truth=seen)]
    if rig.flag("motion.enabled"):
        result.append(Configuration("true_odometry", _TRUE_ODOMETRY))
        result.append(Configuration("true_both", _TRUE_ODOMETRY, truth=seen))
    return result


# The masks that evaluate.py --masks compares; the paper's has no angle but the one it is told.
MASKS = (
    Configuration("adaptive", ("occlusion.mode=adaptive",)),
    Configuration(
        "paper, 0.1 deg",
        (
            "occlusion.mode=paper",
            "occlusion.vertical_step_deg=2",
            "occlusion.horizontal_step_deg=0.1",
        ),
    ),
    Configuration(
        "paper, 0.2 deg",
        (
            "occlusion.mode=paper",
            "occlusion.vertical_step_deg=2",
            "occlusion.horizontal_step_deg=0.2",
        ),
    ),
)


class FuseTarget(NamedTuple):
    """A bag that fuse_bag is to write: overrides of the rig file, and what it takes from the input's
    truth instead of deciding itself ("visibility")."""

    path: str
    settings: Tuple[str, ...]
    truth: Tuple[str, ...] = ()


def run_fuse_bag(
    program: str,
    bag: str,
    rig: str,
    targets: Sequence[FuseTarget],
    jobs: Optional[int] = None,
    compress: bool = False,
) -> None:
    """Fuses a bag into all targets, which share the work on its images; DataError with the program's
    own words if it fails. jobs: its threads (None: its own choice). compress: for bags that stay;
    others are read sooner as they are."""
    command = [program, bag, targets[0].path, "--rig", rig, "--force"]
    command += [] if sys.stderr.isatty() else ["--quiet"]
    command += [] if compress else ["--uncompressed"]
    command += ["--jobs", str(jobs)] if jobs else []
    for number, target in enumerate(targets):
        command += ["--also", target.path] if number else []
        command += ["--truth", ",".join(target.truth)] if target.truth else []
        for setting in target.settings:
            command += ["--set", setting]
    result = subprocess.run(command, stderr=subprocess.PIPE, universal_newlines=True)
    for line in result.stderr.splitlines():
        if result.returncode == 0 and "warn" in line.lower():
            print(line, file=sys.stderr)
    if result.returncode != 0:
        lines = [line for line in result.stderr.splitlines() if line.strip()]
        raise DataError("fuse_bag failed: %s" % " / ".join(lines[-3:] or ["no message"]))


def class_set_of(path: str) -> LabelSet:
    """The classes that a fused bag names in its topic class_info."""
    with BagReader(path) as bag:
        bag.require_topic("/class_info", "std_msgs/String")
        for item in bag.read(["/class_info"]):
            try:
                return LabelSet.from_class_info(json.loads(item.message.data))
            except (ValueError, RecursionError) as error:
                raise DataError("%s: class_info is not JSON (%s)" % (path, error)) from error
            except ConfigError as error:
                raise DataError("%s: %s" % (path, error)) from error
    raise DataError("%s: class_info is empty" % path)


class TruthScan(NamedTuple):
    """One message of points_truth: label (N,) uint8 class ids; points (N,), the structured array."""

    stamp_ns: int
    points: np.ndarray

    @property
    def label(self) -> np.ndarray:
        return self.points["label"]

    def flags(self, name: str) -> Optional[np.ndarray]:
        """(N,) uint16 of camera bits, or None if the bag has no such truth."""
        if name not in self.points.dtype.names:
            return None
        return self.points[name].astype(np.uint16)


class Truth:
    """The truth of a bag, scan by scan. has_visibility: it tells which cameras see each point."""

    def __init__(self, path: str, class_count: int, topic: str = TRUTH_TOPIC, offset_ns: int = 0):
        self.path, self.topic = path, topic
        self._classes, self._offset_ns = class_count, offset_ns
        with BagReader(path) as bag:
            bag.require_topic(topic, "sensor_msgs/PointCloud2")
            self.stamps_ns: List[int] = []
            self.has_visibility = True
            for item in bag.read([topic]):
                self.stamps_ns.append(to_ns(item.message.header.stamp) + offset_ns)
                self.has_visibility &= any(f.name == "visible" for f in item.message.fields)
        if not self.stamps_ns:
            raise DataError("%s: %s is empty" % (path, topic))

    def scans(self) -> Iterator[TruthScan]:
        with BagReader(self.path) as bag:
            for item in bag.read([self.topic]):
                points = to_array(item.message)
                what = "%s %s" % (self.path, self.topic)
                require_fields(points, ("x", "y", "z", "label"), what)
                if points["label"].dtype != np.uint8:
                    raise DataError(
                        "%s: label is %s; must be uint8" % (what, points["label"].dtype)
                    )
                wrong = (points["label"] >= self._classes) & (points["label"] != NO_LABEL)
                if wrong.any():
                    raise DataError(
                        "%s: label %d; must be below the %d classes, or 255"
                        % (what, points["label"][wrong][0], self._classes)
                    )
                finite = np.isfinite(xyz(points)).all(axis=1)
                yield TruthScan(
                    to_ns(item.message.header.stamp) + self._offset_ns,
                    points if finite.all() else points[finite],
                )


def pair_scans(truth_ns: Sequence[int], cloud_ns: Sequence[int]) -> List[int]:
    """For each cloud (time of its first point) its truth's index, -1 = none.

    As many of one as of the other go in order; else each truth to the nearest cloud, if that is
    nearer than MAX_STAMP_GAP_NS."""
    if len(truth_ns) == len(cloud_ns):
        gaps = np.abs(np.array(truth_ns, dtype=np.int64) - np.array(cloud_ns, dtype=np.int64))
        if len(gaps) and gaps.max() <= MAX_STAMP_GAP_NS:
            return list(range(len(cloud_ns)))
    result = [-1] * len(cloud_ns)
    for cloud, stamp in enumerate(cloud_ns):
        nearest = int(np.argmin([abs(stamp - other) for other in truth_ns]))
        if abs(stamp - truth_ns[nearest]) > MAX_STAMP_GAP_NS:
            continue
        rival = int(np.argmin([abs(truth_ns[nearest] - other) for other in cloud_ns]))
        if rival == cloud:
            result[cloud] = nearest
    return result


class FusedBag:
    """The semantic clouds of a bag that fuse_bag has written."""

    def __init__(self, path: str, names: Sequence[str]):
        self.path, self._names = path, list(names)
        with BagReader(path) as bag:
            bag.require_topic(CLOUD_TOPIC, "sensor_msgs/PointCloud2")
            first = {
                to_ns(item.message.time_ref): to_ns(item.message.header.stamp)
                for item in bag.read(["/scan_reference"], ["sensor_msgs/TimeReference"])
            }
            stamps = [to_ns(item.message.header.stamp) for item in bag.read([CLOUD_TOPIC])]
        self.first_ns = [first.get(stamp, stamp) for stamp in stamps]
        if not stamps:
            raise DataError("%s: %s is empty" % (path, CLOUD_TOPIC))

    def clouds(self, label: Optional[str] = None) -> Iterator[SemanticCloud]:
        with BagReader(self.path) as bag:
            for item in bag.read([CLOUD_TOPIC], label=label):
                cloud = SemanticCloud.from_message(item.message)
                if cloud.class_names != self._names:
                    raise DataError(
                        "%s: its classes are %s; the class set has %s"
                        % (self.path, ", ".join(cloud.class_names), ", ".join(self._names))
                    )
                yield cloud


def paired(
    truth: Truth, fused: FusedBag, label: Optional[str] = None
) -> Iterator[Tuple[int, SemanticCloud, TruthScan]]:
    """(index of the truth, cloud, truth) of all scans that have both, in order of time.

    DataError if there are none, or if the points of a pair are not the same."""
    pairs = pair_scans(truth.stamps_ns, fused.first_ns)
    if max(pairs) < 0:
        raise DataError(
            "%s and %s %s: no scan within %.2f s of its truth"
            % (fused.path, truth.path, truth.topic, MAX_STAMP_GAP_NS * 1e-9)
        )
    scans = enumerate(truth.scans())
    for number, cloud in zip(pairs, fused.clouds(label)):
        if number < 0:
            continue
        index, scan = next(((i, s) for i, s in scans if i == number), (-1, None))
        if scan is None:
            raise DataError("%s: the stamps of %s are not in order" % (truth.path, truth.topic))
        where = "%s: scan %d" % (fused.path, index)
        if len(scan.points) != len(cloud):
            raise DataError(
                "%s has %d points, its truth %d; both must hold the same points (set "
                "keep_unlabelled: true, and no range limits)"
                % (where, len(cloud), len(scan.points))
            )
        if len(cloud):
            ranges = np.linalg.norm(cloud.xyz, axis=1) - np.linalg.norm(xyz(scan.points), axis=1)
            if np.median(np.abs(ranges)) > MAX_RANGE_GAP_M:
                raise DataError(
                    "%s: its points are not those of its truth, or in another order (ranges "
                    "differ by %.1f m in the median)" % (where, np.median(np.abs(ranges)))
                )
        yield index, cloud, scan


class ScanCounts(NamedTuple):
    """What one scan adds to a Score: (R, R + 1) counts of its fused points, and those for F1*."""

    fused: np.ndarray
    visible: Optional[VisibleConfusion]


class Score:
    """Everything that is counted for one configuration."""

    def __init__(self, name: str, labels: LabelSet, min_edge_px: float = 0.0):
        self.name, self.labels = name, labels
        self.rows = [row.name for row in labels.evaluation_classes()]
        if not self.rows:
            raise ConfigError("the class set leaves no class to evaluate")
        self.confusion = Confusion(len(self.rows))
        # Of points that a camera really sees; None until a truth tells which.
        self.visible: Optional[VisibleConfusion] = None
        # Counts of each scan, for intervals: matrices of `confusion` and of `visible`, intruders.
        self.by_scan: List[ScanCounts] = []
        self.reliability = Reliability()
        self.status = np.zeros(len(STATUS_NAMES), dtype=np.int64)
        self.scans = 0
        self.without_truth = 0  # fused points whose truth is none or discarded
        # Points that carried a class in the same run without its mask, where that was made.
        self.labelled_without_mask: Optional[int] = None
        self._lookup, self._merge = labels.merge_lookup(), labels.merge_matrix()
        self._min_edge_px = min_edge_px

    def select(self, cloud: SemanticCloud, scan: TruthScan) -> np.ndarray:
        """(N,) bool: points to score."""
        chosen = cloud.fused.copy()
        if self._min_edge_px > 0:
            require_fields(scan.points, ("edge_px",), "truth (for --min-edge-px)")
            chosen &= scan.points["edge_px"] > self._min_edge_px
            cameras, visible = cloud.optional("cameras"), scan.flags("visible")
            if cameras is not None and visible is not None:
                chosen &= (cameras & ~visible) == 0
        return chosen

    def add(self, cloud: SemanticCloud, scan: TruthScan) -> None:
        self.scans += 1
        self.status += np.bincount(
            np.minimum(cloud.status, len(STATUS_NAMES) - 1), minlength=len(STATUS_NAMES)
        )
        chosen = self.select(cloud, scan)
        label = cloud.label[chosen]
        if (label >= len(self.labels)).any():
            raise DataError("scan %d: a fused point without a class" % (self.scans - 1))
        truth, predicted = self._lookup[scan.label[chosen]], self._lookup[label]
        distribution = cloud.probabilities[chosen].astype(np.float64)
        merged = distribution @ self._merge
        index = np.arange(len(label))
        confidence = np.where(
            predicted == NO_LABEL,
            distribution[index, label],
            merged[index, np.minimum(predicted, len(self.rows) - 1)],
        )
        self.without_truth += int((truth == NO_LABEL).sum())
        counted = Confusion(len(self.rows))
        counted.add(truth, predicted)
        self.confusion.merge(counted)
        seen = self._count_visible(cloud, scan)
        self.by_scan.append(ScanCounts(counted.matrix, seen))
        self.reliability.add(merged, truth, predicted, confidence)

    def _count_visible(self, cloud: SemanticCloud, scan: TruthScan) -> Optional[VisibleConfusion]:
        """Adds a scan to `visible`; returns its own counts, None without such a truth."""
        flags = scan.flags("visible")
        if flags is None:
            return None
        chosen: np.ndarray = np.ones(len(cloud), dtype=bool)
        if self._min_edge_px > 0:
            chosen = scan.points["edge_px"] > self._min_edge_px
        label = np.where(cloud.fused, cloud.label, NO_LABEL)[chosen]
        counted = VisibleConfusion(len(self.rows))
        counted.add(self._lookup[scan.label[chosen]], self._lookup[label], flags[chosen] != 0)
        if self.visible is None:
            self.visible = VisibleConfusion(len(self.rows))
        self.visible.merge(counted)
        return counted

    @property
    def f1_star(self) -> np.ndarray:
        """(R,) F1*; NaN where the truth does not tell what cameras see."""
        if self.visible is None:
            return np.full(len(self.rows), np.nan)
        return self.visible.f1

    def f1_interval(self) -> Tuple[float, float]:
        """95 % interval of the mean F1 over the rows."""
        counts = np.array([scan.fused for scan in self.by_scan])

        def score(matrix: np.ndarray) -> float:
            confusion = Confusion(len(self.rows))
            confusion.matrix = matrix
            return mean_over_rows(confusion.f1)

        return bootstrap.interval(counts, score)

    def f1_star_interval(self) -> Tuple[float, float]:
        """95 % interval of the mean F1* over the rows."""
        scans = [scan.visible for scan in self.by_scan if scan.visible is not None]
        if not scans or len(scans) != len(self.by_scan):
            return float("nan"), float("nan")
        counts = np.array(
            [np.column_stack([scan.confusion.matrix, scan.intruders]) for scan in scans]
        )

        def score(table: np.ndarray) -> float:
            visible = VisibleConfusion(len(self.rows))
            visible.confusion.matrix, visible.intruders = table[:, :-1], table[:, -1]
            return mean_over_rows(visible.f1)

        return bootstrap.interval(counts, score)

    def merge(self, other: "Score") -> None:
        """Adds another drive's counts."""
        self.confusion.merge(other.confusion)
        if other.visible is not None:
            self.visible = self.visible or VisibleConfusion(len(self.rows))
            self.visible.merge(other.visible)
        self.by_scan += other.by_scan
        self.reliability.merge(other.reliability)
        self.status += other.status
        self.scans += other.scans
        self.without_truth += other.without_truth
        if other.labelled_without_mask is not None:
            before = self.labelled_without_mask or 0
            self.labelled_without_mask = before + other.labelled_without_mask

    @property
    def points(self) -> int:
        return int(self.status.sum())

    @property
    def labelled(self) -> int:
        """Points that carry a class."""
        return int(self.status[0])


def score_bag(
    configuration: str,
    fused: FusedBag,
    truth: Truth,
    labels: LabelSet,
    min_edge_px: float = 0.0,
    parity: Optional[int] = None,
) -> Score:
    """Scores a fused bag. `parity`: only scans whose number in the truth is even (0) or odd (1)."""
    score = Score(configuration, labels, min_edge_px)
    for index, cloud, scan in paired(truth, fused, configuration):
        if parity is None or index % 2 == parity:
            score.add(cloud, scan)
    return score


def mask_visibility(
    unmasked: FusedBag, masked: FusedBag, truth: Truth, into: Optional[Visibility] = None
) -> Optional[Visibility]:
    """What the mask catches and loses, of two runs that differ in the mask alone, added to `into`;
    None if the bag has no truth about visibility."""
    result = Visibility() if into is None else into
    for first, second in zip(paired(truth, unmasked), paired(truth, masked)):
        (index, cloud, scan), (other, with_mask, _) = first, second
        visible = scan.flags("visible")
        if visible is None:
            return None
        before, after = cloud.optional("cameras"), with_mask.optional("cameras")
        if index != other or before is None or after is None:
            raise DataError(
                "%s and %s: not the same scans, or no field cameras" % (unmasked.path, masked.path)
            )
        truths = (scan.flags(name) for name in ("catchable", "silhouette", "apart"))
        result.add(before, after, visible, *truths)
    return result


def labelled_points(fused: FusedBag) -> int:
    """Points of all clouds that carry a class."""
    return sum(int(cloud.fused.sum()) for cloud in fused.clouds())


def compare_clouds(offline: FusedBag, live: FusedBag) -> Tuple[int, int, int]:
    """Scans that both bags have, those whose clouds are equal byte for byte, scans of `offline`."""

    def contents(fused: FusedBag) -> Dict[int, bytes]:
        with BagReader(fused.path) as bag:
            return {
                to_ns(item.message.header.stamp): bytes(item.message.data)
                for item in bag.read([CLOUD_TOPIC])
            }

    wanted, got = contents(offline), contents(live)
    both = [stamp for stamp in wanted if stamp in got]
    return len(both), sum(wanted[stamp] == got[stamp] for stamp in both), len(wanted)


def samples_of(
    fused: FusedBag, truth: Truth, labels: LabelSet, parity: Optional[int]
) -> Tuple[np.ndarray, np.ndarray]:
    """Distributions and true rows to fit to: of points that a single camera saw."""
    samples = Samples()
    lookup = labels.merge_lookup()
    for index, cloud, scan in paired(truth, fused):
        if parity is not None and index % 2 != parity:
            continue
        cameras = cloud.optional("cameras")
        chosen = cloud.fused.copy()
        if cameras is not None:
            chosen &= (cameras & (cameras - 1)) == 0
        samples.add(cloud.probabilities[chosen], lookup[scan.label[chosen]])
    return samples.arrays()


class CalibrationCase(NamedTuple):
    """A bag with its rig and truth, to fit to or to report on."""

    bag: str
    rig: Rig
    truth: Truth
    parity: Optional[int]


def compare_temperatures(
    program: str,
    fit: CalibrationCase,
    report: CalibrationCase,
    settings: Sequence[str],
    folder: str,
) -> List[Tuple[Variant, Score]]:
    """The raw softmax, the paper's share temperature, a fitted constant, and both combined.

    The constants are fitted to the points of `fit` and all four run on `report`, whole. `folder`
    takes the bags."""
    labels = report.rig.labels
    exponent = report.rig.number("uncertainty.exponent") or PAPER_EXPONENT

    def fused(case: CalibrationCase, variants: Sequence[Variant]) -> List[FusedBag]:
        targets = [
            FuseTarget(
                os.path.join(folder, "temperature_%d.bag" % number),
                tuple(settings)
                + (
                    "uncertainty.temperature=%.6g" % variant.temperature,
                    "uncertainty.exponent=%.6g" % variant.exponent,
                ),
            )
            for number, variant in enumerate(variants)
        ]
        run_fuse_bag(program, case.bag, case.rig.path, targets)
        return [FusedBag(target.path, labels.names) for target in targets]

    def scored(variant: Variant, bag: FusedBag) -> Tuple[Variant, Score]:
        return variant, score_bag(variant.name, bag, report.truth, labels, 0.0, report.parity)

    bases = [Variant("raw", 1.0, 0.0), Variant("share", 1.0, exponent)]
    bags = fused(report, bases)
    result = [scored(base, bag) for base, bag in zip(bases, bags)]
    sources = bags if fit.bag == report.bag else fused(fit, bases)
    constants = []
    for base, source, name in zip(bases, sources, ("constant", "combined")):
        probabilities, truth = samples_of(source, fit.truth, labels, fit.parity)
        temperature = fit_temperature(probabilities, truth, labels.merge_matrix())
        constants.append(Variant(name, float("%.4g" % temperature), base.exponent))
    bags = fused(report, constants)
    result += [scored(constant, bag) for constant, bag in zip(constants, bags)]
    for bag in bags:
        os.remove(bag.path)
    return result


def required_settings(rig: Rig) -> List[str]:
    """Overrides without which clouds and truth would not hold the same points."""
    result = []
    if not rig.flag("keep_unlabelled"):
        result.append("keep_unlabelled=true")
    if rig.text("odometry.on_missing") == "drop":
        result.append("odometry.on_missing=mark")
    for key in ("lidar.min_range_m", "lidar.max_range_m"):
        if rig.number(key):
            cli.warn("%s is set aside: the truth holds every point" % key)
            result.append("%s=0" % key)
    return result
