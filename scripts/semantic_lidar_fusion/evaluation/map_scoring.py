# SPDX-License-Identifier: MIT
"""Voxel maps against truth: what evaluate.py --map does.

The truth of a voxel is the most frequent true row of all points of the drive in it, at the positions
of the last configuration (motion corrected, if any is). A map is scored where it has a class and the
truth a row: IoU and calibration over voxels, completeness (true voxels that have a class in the map)
and strays (voxels with a class where no point truly lies). Point by point, the label of the scan and
that of the map's voxel are compared on the same points: what fusion over time gains.

`row`: a class of the evaluation's tables (labels.LabelSet.evaluation_classes), R of them.
"""

import dataclasses
import math
from typing import Any, Dict, List, NamedTuple, Sequence, Tuple

import numpy as np

from semantic_lidar_fusion.bags.cloud_io import NO_ODOMETRY, SemanticCloud
from semantic_lidar_fusion.errors import DataError
from semantic_lidar_fusion.evaluation.scoring import FusedBag, Truth, paired
from semantic_lidar_fusion.labels import NO_LABEL, ClassInfo, LabelSet
from semantic_lidar_fusion.evaluation.metrics import Confusion, Reliability, ratio
from semantic_lidar_fusion.bags.poses import TransformTree, transform_points
from semantic_lidar_fusion.maps.semantic_map import (
    MapConfig,
    VoxelMap,
    distributions,
    labels_of,
    read,
)

# Weights that are compared; each reads the same map, for evidence grows in proportion to the weight.
WEIGHTS = (1.0, 0.7, 0.5, 0.35, 0.25, 0.18, 0.12, 0.08, 0.05, 0.03, 0.02, 0.01)


def iou(confusion: Confusion) -> np.ndarray:
    """(R,) hits / (points of the row + points taken for it - hits); NaN for rows of neither."""
    taken = confusion.matrix[:, :-1].sum(axis=0)
    return ratio(confusion.hits, confusion.support + taken - confusion.hits)


class VoxelIndex:
    """Finds voxels by their indices."""

    def __init__(self, indices: np.ndarray):
        """`indices`: (N, 3) integers, no two alike."""
        self._low = indices.min(axis=0) if len(indices) else np.zeros(3, dtype=np.int64)
        span = indices.max(axis=0) - self._low + 1 if len(indices) else np.ones(3, dtype=np.int64)
        if float(np.prod(span.astype(np.float64))) > 2.0**62:
            raise DataError("the map is too large to be scored at once")
        self._span = span
        keys = self._keys(indices)
        self._order = np.argsort(keys)
        self._sorted = keys[self._order]

    def _keys(self, indices: np.ndarray) -> np.ndarray:
        x, y, z = (indices - self._low).T
        return (x * self._span[1] + y) * self._span[2] + z

    def find(self, indices: np.ndarray) -> np.ndarray:
        """(M,) position among the voxels of each of (M, 3) indices, -1 = none."""
        if not len(self._sorted):
            return np.full(len(indices), -1)
        inside = ((indices >= self._low) & (indices < self._low + self._span)).all(axis=1)
        keys = np.where(inside, self._keys(indices), -1)
        place = np.minimum(np.searchsorted(self._sorted, keys), len(self._sorted) - 1)
        return np.where(self._sorted[place] == keys, self._order[place], -1)


def _indices(records: np.ndarray) -> np.ndarray:
    return np.stack([records[axis].astype(np.int64) for axis in "xyz"], axis=1)


class TrueVoxels(NamedTuple):
    """Voxels with their true row (N,); `index` finds them."""

    index: VoxelIndex
    row: np.ndarray


def _pose(tree: TransformTree, cloud: SemanticCloud, frame_id: str) -> Tuple[np.ndarray, bool]:
    poses, covered = tree.lookup(frame_id, cloud.frame_id, np.array([cloud.stamp_ns]))
    return poses[0], bool(covered[0])


def true_voxels(
    truth: Truth, fused: FusedBag, labels: LabelSet, tree: TransformTree, frame_id: str, size: float
) -> TrueVoxels:
    """The truth of a drive as voxels."""
    rows = labels.evaluation_classes()
    row_labels = LabelSet([ClassInfo("row_%d" % i, (0, 0, 0), False) for i in range(len(rows))])
    config = MapConfig(voxel_size_m=size, kind="dirichlet", weight=1.0, dynamic="keep")
    voxels = VoxelMap(config, row_labels)
    lookup = labels.merge_lookup()
    for _, cloud, scan in paired(truth, fused, "truth"):
        pose, covered = _pose(tree, cloud, frame_id)
        if not covered:
            continue
        row = lookup[scan.label]
        known = row != NO_LABEL
        counts = np.zeros((len(cloud), len(rows)), dtype=np.float32)
        counts[known, row[known]] = 1.0
        status = np.where(cloud.status == NO_ODOMETRY, NO_ODOMETRY, np.where(known, 0, 1))
        columns = [cloud.points[axis] for axis in "xyz"]
        voxels.integrate_columns(
            columns, np.zeros(len(cloud)), status, row, counts, pose, cloud.stamp_ns
        )
    records = voxels.records()
    return TrueVoxels(VoxelIndex(_indices(records)), labels_of(records, voxels.config))


@dataclasses.dataclass
class MapScore:
    """One configuration's map. voxels: confusion over voxels; scan, fused: over the same points, by
    the scan's own label and by the map's."""

    name: str
    rows: List[str]
    voxels: Confusion
    reliability: Reliability
    scan: Confusion
    fused: Confusion
    scan_reliability: Reliability
    fused_reliability: Reliability
    completeness: float = math.nan
    strays: float = math.nan
    count: int = 0
    clouds: int = 0
    without_pose: int = 0


def _merged(
    probabilities: np.ndarray, label: np.ndarray, labels: LabelSet
) -> Tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distributions over rows (N, R), predicted row (N,), its confidence (N,), of distributions over
    classes and their labels."""
    merged = probabilities.astype(np.float64) @ labels.merge_matrix()
    predicted = labels.merge_lookup()[label]
    place = np.arange(len(label))
    confidence = np.where(
        predicted == NO_LABEL,
        probabilities[place, np.minimum(label, len(labels) - 1)],
        merged[place, np.minimum(predicted, merged.shape[1] - 1)],
    )
    return merged, predicted, confidence


def score_map(
    name: str,
    truth: Truth,
    fused: FusedBag,
    labels: LabelSet,
    tree: TransformTree,
    frame_id: str,
    config: MapConfig,
    true: TrueVoxels,
) -> Tuple[MapScore, VoxelMap]:
    """Maps a fused bag and scores the map and its points."""
    rows = [row.name for row in labels.evaluation_classes()]
    count = len(rows)
    score = MapScore(
        name,
        rows,
        Confusion(count),
        Reliability(),
        Confusion(count),
        Confusion(count),
        Reliability(),
        Reliability(),
    )
    voxels = VoxelMap(dataclasses.replace(config, dynamic="keep"), labels)
    for _, cloud, _ in paired(truth, fused, "map " + name):
        pose, covered = _pose(tree, cloud, frame_id)
        score.clouds += 1
        if covered:
            voxels.integrate(cloud, pose)
        else:
            score.without_pose += 1
    records = voxels.records()
    reading = read(records, voxels.config)
    named = np.flatnonzero(reading.label != NO_LABEL)
    indices = _indices(records)
    place = true.index.find(indices[named])
    hit = place >= 0
    score.count = len(named)
    score.strays = float(ratio(int((~hit).sum()), len(named)))
    row = np.where(hit, true.row[np.maximum(place, 0)], NO_LABEL)
    merged, predicted, confidence = _merged(
        reading.probabilities[named], reading.label[named], labels
    )
    score.voxels.add(row, predicted)
    score.reliability.add(merged, row, predicted, confidence)
    has_row = int((true.row != NO_LABEL).sum())
    score.completeness = float(ratio(int((row != NO_LABEL).sum()), has_row))
    index = VoxelIndex(indices)
    lookup = labels.merge_lookup()
    for _, cloud, scan in paired(truth, fused, "points " + name):
        pose, covered = _pose(tree, cloud, frame_id)
        if not covered:
            continue
        chosen = cloud.fused
        cells = transform_points(pose, cloud.xyz[chosen]) / config.voxel_size_m
        at = index.find(np.floor(cells).astype(np.int64))
        # A point at a border may round to the voxel beside its own.
        chosen = np.flatnonzero(chosen)[at >= 0]
        at = at[at >= 0]
        row = lookup[scan.label[chosen]]
        for probabilities, label, confusion, reliability in (
            (cloud.probabilities[chosen], cloud.label[chosen], score.scan, score.scan_reliability),
            (reading.probabilities[at], reading.label[at], score.fused, score.fused_reliability),
        ):
            merged, predicted, confidence = _merged(probabilities, label, labels)
            confusion.add(row, predicted)
            reliability.add(merged, row, predicted, confidence)
    return score, voxels


class WeightScore(NamedTuple):
    """Calibration of a map's voxels, read as if made with another weight."""

    weight: float
    nll: float
    ece: float
    brier: float


def compare_weights(voxels: VoxelMap, labels: LabelSet, true: TrueVoxels) -> List[WeightScore]:
    """Calibration over voxels for WEIGHTS, all from one map."""
    records = voxels.records()
    records = records[records["labelled"] > 0]
    place = true.index.find(_indices(records))
    row = np.where(place >= 0, true.row[np.maximum(place, 0)], NO_LABEL)
    label = labels_of(records, voxels.config)
    result = []
    for weight in WEIGHTS:
        scaled = records.copy()
        factor = weight / voxels.config.weight
        scaled["evidence"] = np.rint(records["evidence"] * factor).astype(np.int64)
        p = distributions(scaled, voxels.config)
        reliability = Reliability()
        merged, predicted, confidence = _merged(p, label, labels)
        reliability.add(merged, row, predicted, confidence)
        result.append(WeightScore(weight, reliability.nll, reliability.ece, reliability.brier))
    return result


class MapResults(NamedTuple):
    scores: List[MapScore]
    weights: List[WeightScore]
    config: MapConfig


def evaluate_maps(
    names: Sequence[str],
    fused: Sequence[FusedBag],
    truth: Truth,
    labels: LabelSet,
    tree: TransformTree,
    frame_id: str,
    config: MapConfig,
) -> MapResults:
    """Scores the maps of several configurations of one drive; weights on the last one."""
    true = true_voxels(truth, fused[-1], labels, tree, frame_id, config.voxel_size_m)
    if not (true.row != NO_LABEL).any():
        raise DataError("no point of the truth lies in the map; does the bag hold tf?")
    scores: List[MapScore] = []
    for name, bag in zip(names, fused):
        score, voxels = score_map(name, truth, bag, labels, tree, frame_id, config, true)
        scores.append(score)
    return MapResults(scores, compare_weights(voxels, labels, true), config)


def tables(results: MapResults) -> Tuple[str, Dict[str, str]]:
    """A section of the report, and CSV files by name."""
    from semantic_lidar_fusion.figures.plotting import title_of
    from semantic_lidar_fusion.evaluation.tables import csv_text, markdown, number

    scores, last = results.scores, results.scores[-1]
    files: Dict[str, str] = {}
    header = ["class", "points", "scan IoU", "map IoU"]
    header += ["voxels", *("voxel IoU: " + score.name for score in scores)]
    rows: List[List[Any]] = []
    scan, fused = iou(last.scan), iou(last.fused)
    by_map = [iou(score.voxels) for score in scores]
    for i, name in enumerate(last.rows):
        if not last.scan.support[i] and not last.voxels.support[i]:
            continue
        values = [float(scan[i]), float(fused[i])]
        row: List[Any] = [title_of(name), int(last.scan.support[i])] + values
        row += [int(last.voxels.support[i])] + [float(values[i]) for values in by_map]
        rows.append(row)
    mean: List[Any] = ["mean", int(last.scan.total)]
    for column in range(2, len(header)):
        if header[column] == "voxels":
            mean.append(int(last.voxels.total))
        else:
            mean.append(float(np.nanmean([row[column] for row in rows])) if rows else math.nan)
    rows.append(mean)
    files["map_iou.csv"] = csv_text(header, rows)
    shown = [[number(v) if isinstance(v, float) else str(v) for v in row] for row in rows]
    text = "## Map of %.3g m voxels\n\n" % results.config.voxel_size_m
    text += "Scan and map IoU: on the same points of %s, by the scan's own label and by the label "
    text %= last.name
    text += "of their voxel.\n\n" + markdown(header, shown)
    names = ["map", "clouds", "without pose", "voxels with class", "completeness", "strays"]
    names += ["accuracy", "NLL", "Brier", "ECE"]
    facts: List[List[Any]] = []
    for score in scores:
        row = [score.name, score.clouds, score.without_pose, score.count, score.completeness]
        row += [score.strays, score.voxels.accuracy]
        facts.append(row + [getattr(score.reliability, n) for n in ("nll", "brier", "ece")])
    files["map_summary.csv"] = csv_text(names, facts)
    shown = [[number(v, 4) if isinstance(v, float) else str(v) for v in row] for row in facts]
    text += "\n" + markdown(names, shown)
    points = []
    for name, confusion, reliability in (
        ("scan", last.scan, last.scan_reliability),
        ("map", last.fused, last.fused_reliability),
    ):
        values = [confusion.accuracy, reliability.nll, reliability.brier, reliability.ece]
        points.append([name] + values)
    names = ["points of " + last.name, "accuracy", "NLL", "Brier", "ECE"]
    files["map_points.csv"] = csv_text(names, points)
    shown = [[number(v, 4) if isinstance(v, float) else str(v) for v in row] for row in points]
    text += "\n" + markdown(names, shown)
    names = ["weight", "NLL", "ECE", "Brier"]
    weights = [[w.weight, w.nll, w.ece, w.brier] for w in results.weights]
    files["map_weights.csv"] = csv_text(names, weights)
    best = min(results.weights, key=lambda w: w.nll)
    shown = [["%.3g" % row[0]] + [number(v, 4) for v in row[1:]] for row in weights]
    text += "\nThe map of %s read with other weights (made with %.3g); least NLL: %.3g.\n\n" % (
        last.name,
        results.config.weight,
        best.weight,
    )
    return text + markdown(names, shown), files
