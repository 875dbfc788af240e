# SPDX-License-Identifier: MIT
"""Voxel maps against truth: what evaluate.py --map does.

It measures the map that build_semantic_map.py makes by default. The truth of a voxel is the most
frequent true row of all points of the drive in it, at the positions of the last configuration (motion
corrected, if any is). A map is scored where it has a class and the truth a row: IoU and calibration
over voxels, completeness (true voxels that have a class in the map) and strays (voxels with a class
where no point truly lies). Point by point, the label of the scan and that of the map's voxel are
compared on the same points: what fusion over time gains. The 2-D map is judged by what it says along
the path that was driven, and where obstacles truly are.

`row`: a class of the evaluation's tables (labels.LabelSet.evaluation_classes), R of them.
"""

import dataclasses
import math
from typing import Any, Dict, List, NamedTuple, Sequence, Tuple

import numpy as np

from semantic_lidar_fusion.bags.cloud_io import NO_ODOMETRY
from semantic_lidar_fusion.bags.poses import transform_points
from semantic_lidar_fusion.errors import DataError
from semantic_lidar_fusion.evaluation.metrics import Confusion, Reliability, ratio
from semantic_lidar_fusion.evaluation.scoring import FusedBag, Truth, paired
from semantic_lidar_fusion.installation import package_file
from semantic_lidar_fusion.labels import NO_LABEL, LabelSet
from semantic_lidar_fusion.maps.drive import Poses
from semantic_lidar_fusion.maps.ground import GROUND_BAND_M, ground_surface, lowest_heights
from semantic_lidar_fusion.maps.map_file import joined_path
from semantic_lidar_fusion.maps.raster import OCCUPIED, Costs, Frame2d, flatten, passed_at
from semantic_lidar_fusion.maps.reading import (
    GONE,
    distributions,
    labels_and_confidences,
    labels_of,
    layers_of,
    read,
)
from semantic_lidar_fusion.maps.records import heights, pose_of_path, voxel_indices
from semantic_lidar_fusion.maps.semantic_map import MapConfig, VoxelMap

# Voxels by the number of their points: least, and first that is too many.
OBSERVATIONS = ((1, 4), (4, 10), (10, 30), (30, 1 << 32))
# From this cost on a planner takes a cell for an obstacle (as occupancy.yaml does).
BLOCKED = 65
# Weights that are compared; each reads the same map, for evidence grows in proportion to the weight.
WEIGHTS = (1.0, 0.7, 0.5, 0.35, 0.25, 0.18, 0.12, 0.08, 0.05, 0.03, 0.02, 0.01)


def iou(confusion: Confusion) -> np.ndarray:
    """(R,) hits / (points of the row + points taken for it - hits); NaN for rows of neither."""
    taken = confusion.matrix[:, :-1].sum(axis=0)
    return ratio(confusion.hits, confusion.support + taken - confusion.hits)


def _share(part: float, whole: float) -> float:
    """NaN of nothing."""
    return part / whole if whole else math.nan


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


class TrueVoxels(NamedTuple):
    """Voxels (N, 3) with their true row (N,), most frequent true class (N,) and number of points (N,);
    `finder` finds them."""

    finder: VoxelIndex
    row: np.ndarray
    label: np.ndarray
    voxels: np.ndarray
    points: np.ndarray


def true_voxels(
    truth: Truth, fused: FusedBag, labels: LabelSet, poses: Poses, frame_id: str, size: float
) -> TrueVoxels:
    """The truth of a drive as voxels."""
    found, seen_labels = [], []
    for _, cloud, scan in paired(truth, fused, "truth"):
        seen = poses.seen(cloud, frame_id)
        if seen is None:
            continue
        usable = (cloud.status != NO_ODOMETRY) & (scan.label < len(labels))
        cells = transform_points(seen.pose, cloud.xyz[usable]) / size
        found.append(np.floor(cells).astype(np.int64))
        seen_labels.append(scan.label[usable])
    if not found:
        return TrueVoxels(VoxelIndex(np.zeros((0, 3), np.int64)), *[np.zeros(0, np.uint8)] * 4)
    voxels, of = np.unique(np.concatenate(found), axis=0, return_inverse=True)
    label = np.concatenate(seen_labels)
    counts = np.zeros((len(voxels), len(labels)))
    np.add.at(counts, (of.reshape(-1), label), 1.0)
    by_row = counts @ labels.merge_matrix()
    row = np.where(by_row.sum(axis=1) > 0, by_row.argmax(axis=1), NO_LABEL).astype(np.uint8)
    label = counts.argmax(axis=1).astype(np.uint8)
    return TrueVoxels(VoxelIndex(voxels), row, label, voxels, counts.sum(axis=1))


@dataclasses.dataclass
class MapScore:
    """One configuration's map. voxels: confusion over voxels; scan, fused: over the same points, by
    the scan's own label and by the map's; by_observations: calibration of voxels by OBSERVATIONS;
    flat: figures of the 2-D map, and of what is gone."""

    name: str
    rows: List[str]
    voxels: Confusion
    reliability: Reliability
    scan: Confusion
    fused: Confusion
    scan_reliability: Reliability
    fused_reliability: Reliability
    by_observations: List[Reliability] = dataclasses.field(
        default_factory=lambda: [Reliability() for _ in OBSERVATIONS]
    )
    flat: Dict[str, float] = dataclasses.field(default_factory=dict)
    completeness: float = math.nan
    strays: float = math.nan
    count: int = 0
    clouds: int = 0
    without_pose: int = 0


def merged_rows(
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


class _Built(NamedTuple):
    """A map with its path."""

    voxels: VoxelMap
    path: np.ndarray


def _build(
    score: MapScore,
    truth: Truth,
    fused: FusedBag,
    labels: LabelSet,
    poses: Poses,
    frame_id: str,
    config: MapConfig,
) -> _Built:
    voxels = VoxelMap(config, labels)
    path = []
    for _, cloud, _ in paired(truth, fused, "map " + score.name):
        seen = poses.seen(cloud, frame_id)
        score.clouds += 1
        if seen is None:
            score.without_pose += 1
            continue
        voxels.integrate(cloud, seen.pose, seen.origins)
        path.append(pose_of_path(cloud.stamp_ns, seen.vehicle))
    return _Built(voxels, joined_path(path))


def score_map(
    name: str,
    truth: Truth,
    fused: FusedBag,
    labels: LabelSet,
    poses: Poses,
    frame_id: str,
    config: MapConfig,
    true: TrueVoxels,
) -> Tuple[MapScore, VoxelMap]:
    """Maps a fused bag and scores the map and its points."""
    rows = [row.name for row in labels.evaluation_classes()]
    confusions = [Confusion(len(rows)) for _ in range(3)]
    score = MapScore(
        name,
        rows,
        confusions[0],
        Reliability(),
        confusions[1],
        confusions[2],
        Reliability(),
        Reliability(),
    )
    built = _build(score, truth, fused, labels, poses, frame_id, config)
    voxels = built.voxels
    records = voxels.records()
    if not len(records):
        return score, voxels
    reading = read(records, voxels.config, labels)
    named = np.flatnonzero(reading.label != NO_LABEL)
    indices = voxel_indices(records)
    place = true.finder.find(indices[named])
    hit = place >= 0
    score.count = len(named)
    score.strays = _share(int((~hit).sum()), len(named))
    row = np.where(hit, true.row[np.maximum(place, 0)], NO_LABEL)
    merged, predicted, confidence = merged_rows(
        reading.probabilities[named], reading.label[named], labels
    )
    score.voxels.add(row, predicted)
    score.reliability.add(merged, row, predicted, confidence)
    for (low, high), reliability in zip(OBSERVATIONS, score.by_observations):
        count = records["observations"][named]
        chosen = (count >= low) & (count < high)
        reliability.add(merged[chosen], row[chosen], predicted[chosen], confidence[chosen])
    has_row = int((true.row != NO_LABEL).sum())
    score.completeness = _share(int((row != NO_LABEL).sum()), has_row)
    score.flat = _flat_figures(records, built, labels, true)
    _score_points(
        score, truth, fused, labels, poses, frame_id, reading, VoxelIndex(indices), config
    )
    return score, voxels


def _flat_figures(
    records: np.ndarray, built: _Built, labels: LabelSet, true: TrueVoxels
) -> Dict[str, float]:
    """Figures of the 2-D map, of the dynamic layer, and of what rays removed."""
    config = built.voxels.config
    costs = Costs.from_file(package_file("config/map_costs.yaml"), labels)
    x, y = records["x"], records["y"]
    low, high = (int(x.min()), int(y.min())), (int(x.max()), int(y.max()))
    frame = Frame2d.around(low, high, config.voxel_size_m)
    size = config.voxel_size_m
    ground = ground_surface(lowest_heights(records, size, *low, frame.shape), size)
    flat = flatten(records, built.voxels.bricks(), frame, ground, built.path, config, labels, costs)
    near = passed_at(built.path, frame, config.footprint_m) != np.iinfo(np.int64).min
    label, confidence = labels_and_confidences(records, config, labels)
    above = heights(records, size) - ground.reshape(-1)[frame.cells(records)]
    layer = layers_of(records, label, confidence, config, labels, above <= GROUND_BAND_M)
    place = true.finder.find(voxel_indices(records))
    known = (place >= 0) & (true.row[np.maximum(place, 0)] != NO_LABEL)
    moves = np.isin(true.label[np.maximum(place, 0)], labels.dynamic_ids) & known
    named = known & (label != NO_LABEL)
    taken = named & np.isin(label, labels.dynamic_ids)
    shown = Confusion(len(labels.evaluation_classes()))
    chosen = named & (layer != GONE)
    shown.add(true.row[place[chosen]], labels.merge_lookup()[label[chosen]])
    result = {
        "mean IoU of voxels that are not gone": float(np.nanmean(iou(shown)))
        if chosen.any()
        else math.nan,
        "path occupied": _share(int((flat.cost[near] >= BLOCKED).sum()), int(near.sum())),
        "path unknown": _share(int((flat.cost[near] < 0).sum()), int(near.sum())),
        "dynamic precision": _share(int((taken & moves).sum()), int(taken.sum())),
        "dynamic recall": _share(int((taken & moves).sum()), int((named & moves).sum())),
        "static lost": _share(
            int((known & ~moves & (layer == GONE)).sum()), int((known & ~moves).sum())
        ),
        "dynamic gone": _share(int((moves & (layer == GONE)).sum()), int(moves.sum())),
    }
    result.update(_obstacles_found(flat.cost, frame, ground, costs, labels, true))
    return result


def _obstacles_found(
    cost: np.ndarray,
    frame: Frame2d,
    ground: np.ndarray,
    costs: Costs,
    labels: LabelSet,
    true: TrueVoxels,
) -> Dict[str, float]:
    """Share of the cells that are occupied, of those where something static of each class truly
    rises, half a voxel inside the heights of obstacles: of all, and of those with as many points as
    the 2-D map asks for, and one more that may lie at a border."""
    x, y = true.voxels[:, 0] - frame.min_x, true.voxels[:, 1] - frame.min_y
    inside = (x >= 0) & (x < frame.width) & (y >= 0) & (y < frame.height)
    cell = np.where(inside, y * frame.width + x, 0)
    size = frame.cell_m
    above = (true.voxels[:, 2] + 0.5) * size - ground.reshape(-1)[cell]
    rises = inside & (above > costs.min_obstacle_height_m + size / 2)
    rises &= above < costs.clearance_m - size / 2
    result = {}
    for number, info in enumerate(labels.classes):
        if info.dynamic or costs.ground[number] or costs.cost[number] < OCCUPIED:
            continue
        own = rises & (true.label == number)
        cells, of = np.unique(cell[own], return_inverse=True)
        points = np.bincount(of, true.points[own], len(cells))
        found = cost.reshape(-1)[cells] >= BLOCKED
        for name, least in (("found: ", costs.min_points + 1), ("found, any: ", 1)):
            if (points >= least).any():
                result[name + info.name] = float(found[points >= least].mean())
    return result


def _score_points(
    score: MapScore,
    truth: Truth,
    fused: FusedBag,
    labels: LabelSet,
    poses: Poses,
    frame_id: str,
    reading: Any,
    index: VoxelIndex,
    config: MapConfig,
) -> None:
    """The scan's own label and the map's on the same points."""
    lookup = labels.merge_lookup()
    for _, cloud, scan in paired(truth, fused, "points " + score.name):
        seen = poses.seen(cloud, frame_id)
        if seen is None:
            continue
        chosen = cloud.fused
        cells = transform_points(seen.pose, cloud.xyz[chosen]) / config.voxel_size_m
        at = index.find(np.floor(cells).astype(np.int64))
        # A point at a border may round to the voxel beside its own; a voxel may have no class.
        usable = at >= 0
        usable[usable] = reading.label[at[usable]] != NO_LABEL
        chosen = np.flatnonzero(chosen)[usable]
        at = at[usable]
        row = lookup[scan.label[chosen]]
        for probabilities, label, confusion, reliability in (
            (cloud.probabilities[chosen], cloud.label[chosen], score.scan, score.scan_reliability),
            (reading.probabilities[at], reading.label[at], score.fused, score.fused_reliability),
        ):
            merged, predicted, confidence = merged_rows(probabilities, label, labels)
            confusion.add(row, predicted)
            reliability.add(merged, row, predicted, confidence)


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
    place = true.finder.find(voxel_indices(records))
    row = np.where(place >= 0, true.row[np.maximum(place, 0)], NO_LABEL)
    label = labels_of(records, voxels.config, labels)
    result = []
    for weight in WEIGHTS:
        scaled = records.copy()
        factor = weight / voxels.config.weight
        scaled["evidence"] = np.rint(records["evidence"] * factor).astype(np.int64)
        p = distributions(scaled, voxels.config, labels)
        reliability = Reliability()
        merged, predicted, confidence = merged_rows(p, label, labels)
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
    poses: Poses,
    frame_id: str,
    config: MapConfig,
) -> MapResults:
    """Scores the maps of several configurations of one drive; weights on the last one."""
    true = true_voxels(truth, fused[-1], labels, poses, frame_id, config.voxel_size_m)
    if not (true.row != NO_LABEL).any():
        raise DataError("no point of the truth lies in the map; does the bag hold tf?")
    scores: List[MapScore] = []
    for name, bag in zip(names, fused):
        score, voxels = score_map(name, truth, bag, labels, poses, frame_id, config, true)
        scores.append(score)
    return MapResults(scores, compare_weights(voxels, labels, true), config)


def _flat_table(scores: Sequence[MapScore], files: Dict[str, str]) -> str:
    """The 2-D map and what is gone, a row for each figure."""
    from semantic_lidar_fusion.evaluation.tables import csv_text, markdown, number

    names = list(dict.fromkeys(name for score in scores for name in score.flat))
    header = ["2-D map, layers"] + [score.name for score in scores]
    rows: List[List[Any]] = [
        [name] + [score.flat.get(name, math.nan) for score in scores] for name in names
    ]
    files["map_flat.csv"] = csv_text(header, rows)
    return markdown(header, [[row[0]] + [number(v, 4) for v in row[1:]] for row in rows])


def _observations_table(score: MapScore, files: Dict[str, str]) -> str:
    """Calibration of voxels by the number of their points."""
    from semantic_lidar_fusion.evaluation.tables import csv_text, markdown, number

    header = ["points of a voxel of " + score.name, "voxels", "NLL", "ECE", "confidence - accuracy"]
    rows: List[List[Any]] = []
    for (low, high), reliability in zip(OBSERVATIONS, score.by_observations):
        name = "%d to %d" % (low, high - 1) if high < 1 << 32 else "%d or more" % low
        said = float(reliability.confidence_sum.sum() - reliability.right_count.sum())
        gap = _share(said, reliability.total)
        values = [reliability.nll, reliability.ece, gap]
        rows.append([name, reliability.total] + values)
    files["map_observations.csv"] = csv_text(header, rows)
    shown = [row[:2] + [number(v, 4) for v in row[2:]] for row in rows]
    return markdown(header, [[str(v) for v in row] for row in shown])


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
    text += "\n" + _flat_table(scores, files)
    text += "\n" + _observations_table(last, files)
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
