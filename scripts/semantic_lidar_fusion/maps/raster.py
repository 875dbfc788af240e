# SPDX-License-Identifier: MIT
"""2-D maps from voxels: ground, cost and class of each column of voxels.

What a column costs follows from its geometry first: whatever rises from the ground is an obstacle,
whatever its class; what lies on the ground costs what its class does; flat ground without a class is
ground. Voxels that rays show to be gone (reading.layers_of) take no part.

Grids are arrays [row, column] = [voxel y - min y, voxel x - min x]: row 0 is the southern edge, as
in nav_msgs/OccupancyGrid. Image files have the northern row first.
"""

from typing import Any, Dict, NamedTuple, Tuple

import numpy as np

from semantic_lidar_fusion.errors import ConfigError
from semantic_lidar_fusion.labels import NO_LABEL, LabelSet, load_yaml
from semantic_lidar_fusion.maps.ground import GROUND_BAND_M
from semantic_lidar_fusion.maps.reading import (
    DYNAMIC,
    GONE,
    STATIC,
    labels_and_confidences,
    layers_of,
)
from semantic_lidar_fusion.maps.records import free_voxels, heights
from semantic_lidar_fusion.maps.semantic_map import MapConfig

UNKNOWN = -1  # of a cost grid
OCCUPIED = 100
# A cell without voxels is free ground if rays crossed so many clouds' worth of it, so high above the
# ground (m).
FREE_PASSES, FREE_BAND_M = 2, (0.1, 1.0)
# Poses further apart are not joined to one path (m).
PATH_GAP_M = 5.0
# What was last seen so much later than the vehicle was there has come since (ns); earlier, it drives
# behind it.
CAME_LATER_NS = 60 * 10**9


class Costs(NamedTuple):
    """A cost file for a class set. cost: (C,) int, -1 = says nothing; min_probability: (C,); ground:
    (C,) bool. The other fields are explained in config/map_costs.yaml."""

    cost: np.ndarray
    min_probability: np.ndarray
    ground: np.ndarray
    min_obstacle_height_m: float
    low_obstacle_height_m: float
    clearance_m: float
    single_point_probability: float
    min_points: int
    unnamed_ground_cost: int

    @staticmethod
    def from_file(path: str, labels: LabelSet) -> "Costs":
        return Costs.from_tree(load_yaml(path), labels, path)

    @staticmethod
    def from_tree(tree: Any, labels: LabelSet, source: str) -> "Costs":
        """Checks a parsed cost file; ConfigError with every problem."""
        problems = []
        if not isinstance(tree, dict):
            raise ConfigError("%s: must be a mapping" % source)
        numbers = (
            ("min_obstacle_height_m", 0.3, 1000.0),
            ("low_obstacle_height_m", 0.15, 1000.0),
            ("clearance_m", 2.5, 1000.0),
            ("single_point_probability", 0.7, 1.0),
            ("min_points", 2.0, 1000.0),
            ("unnamed_ground_cost", 0.0, 100.0),
        )
        known = ("default", "classes", *(name for name, _, _ in numbers))
        problems += ["%s: unknown key" % key for key in tree if key not in known]
        values = [
            _number(tree.get(key, default), 0, most, key, problems)
            for key, default, most in numbers
        ]
        entry = _entry(tree.get("default", {}), "default", problems)
        default = dict({"cost": 100, "min_probability": 0.5, "ground": False}, **entry)
        classes = tree.get("classes", {})
        if not isinstance(classes, dict):
            problems.append("classes: must be a mapping")
            classes = {}
        rows = {}
        for name, value in classes.items():
            rows[name] = dict(default, **_entry(value, "classes.%s" % name, problems))
        if problems:
            raise ConfigError("%s: %s" % (source, "; ".join(problems)))
        chosen = [rows.get(name, default) for name in labels.names]
        return Costs(
            np.array([-1 if row["cost"] is None else row["cost"] for row in chosen], np.int16),
            np.array([row["min_probability"] for row in chosen], dtype=np.float64),
            np.array([row["ground"] for row in chosen], dtype=bool),
            values[0],
            values[1],
            values[2],
            values[3],
            int(values[4]),
            int(values[5]),
        )


def _number(value: Any, least: float, most: float, key: str, problems: list) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        problems.append("%s = %s: must be a number" % (key, value))
        return least
    if not least <= value <= most:
        problems.append("%s = %s: must be from %g to %g" % (key, value, least, most))
    return float(value)


def _entry(entry: Any, key: str, problems: list) -> Dict[str, Any]:
    if not isinstance(entry, dict):
        problems.append("%s = %s: must be a mapping" % (key, entry))
        return {}
    for name, value in entry.items():
        path = "%s.%s" % (key, name)
        if name == "cost":
            if value is not None:
                _number(value, 0, 100, path, problems)
        elif name == "min_probability":
            _number(value, 0, 1, path, problems)
        elif name == "ground":
            if not isinstance(value, bool):
                problems.append("%s = %s: must be true or false" % (path, value))
        else:
            problems.append("%s: unknown key (known: cost, min_probability, ground)" % path)
    return entry


class Frame2d(NamedTuple):
    """The cells of a grid: voxels min_x <= x < min_x + width, likewise y."""

    min_x: int
    min_y: int
    width: int
    height: int
    cell_m: float

    @staticmethod
    def around(low: Tuple[int, int], high: Tuple[int, int], cell_m: float) -> "Frame2d":
        """All voxels from low to high, inclusive."""
        return Frame2d(low[0], low[1], high[0] - low[0] + 1, high[1] - low[1] + 1, cell_m)

    @property
    def shape(self) -> Tuple[int, int]:
        return self.height, self.width

    @property
    def origin(self) -> Tuple[float, float]:
        """The south-western corner (m)."""
        return self.min_x * self.cell_m, self.min_y * self.cell_m

    def holds(self, records: np.ndarray) -> np.ndarray:
        """(N,) bool: whether each record's column is one of the grid's."""
        x, y = (
            records["x"].astype(np.int64) - self.min_x,
            records["y"].astype(np.int64) - self.min_y,
        )
        return (x >= 0) & (x < self.width) & (y >= 0) & (y < self.height)

    def cells(self, records: np.ndarray) -> np.ndarray:
        """(N,) int64: index of each record's cell in the flattened grid."""
        row = records["y"].astype(np.int64) - self.min_y
        return row * self.width + (records["x"].astype(np.int64) - self.min_x)


class Rasters(NamedTuple):
    """All 2-D maps of a part of a voxel map, (height, width) each. cost: int8, UNKNOWN = -1; label:
    uint8 and confidence: float32 of the uppermost voxel with a class, of the static layer where that
    has one; elevation_m: float32, the ground, NaN = not seen."""

    frame: Frame2d
    cost: np.ndarray
    label: np.ndarray
    confidence: np.ndarray
    elevation_m: np.ndarray

    @staticmethod
    def empty(frame: Frame2d) -> "Rasters":
        return Rasters(
            frame,
            np.full(frame.shape, UNKNOWN, dtype=np.int8),
            np.full(frame.shape, NO_LABEL, dtype=np.uint8),
            np.zeros(frame.shape, dtype=np.float32),
            np.full(frame.shape, np.nan, dtype=np.float32),
        )

    def paste(self, part: "Rasters") -> None:
        """Takes over what a part holds inside this frame."""
        mine, other = self.frame, part.frame
        x, y = other.min_x - mine.min_x, other.min_y - mine.min_y
        left, bottom = max(x, 0), max(y, 0)
        right, top = min(x + other.width, mine.width), min(y + other.height, mine.height)
        for target, source in zip(self[1:], part[1:]):
            target[bottom:top, left:right] = source[bottom - y : top - y, left - x : right - x]


def _starts(cells: np.ndarray) -> np.ndarray:
    """Indices where a new value begins in sorted cells."""
    new = np.ones(len(cells), dtype=bool)
    new[1:] = cells[1:] != cells[:-1]
    return np.flatnonzero(new)


def passed_at(path: np.ndarray, frame: Frame2d, half_width_m: float) -> np.ndarray:
    """(height, width) int64: when the vehicle, `half_width_m` to each side of its path, was last
    there; the least integer = never."""
    never = np.iinfo(np.int64).min
    result = np.full(frame.shape, never)
    if half_width_m <= 0 or not len(path):
        return result
    points = np.stack([path["x"], path["y"]], axis=1)
    reach = half_width_m + frame.cell_m
    west, south = frame.origin
    size = np.array([frame.width, frame.height]) * frame.cell_m
    low_corner, high_corner = (
        np.array([west, south]) - reach,
        np.array([west, south]) + size + reach,
    )
    before = points[np.maximum(np.arange(len(points)) - 1, 0)]
    meets = (np.maximum(points, before) >= low_corner) & (np.minimum(points, before) <= high_corner)
    for number in np.flatnonzero(meets.all(axis=1)):
        a, b = points[max(number - 1, 0)], points[number]
        if np.hypot(*(b - a)) > PATH_GAP_M:
            a = b
        low = np.maximum(np.minimum(a, b) - reach - (west, south), 0.0)
        high = np.minimum(np.maximum(a, b) + reach - (west, south), size)
        if (low >= high).any():
            continue
        first = (low / frame.cell_m).astype(int)
        last = np.minimum(np.ceil(high / frame.cell_m).astype(int), [frame.width, frame.height])
        x = west + (np.arange(first[0], last[0]) + 0.5) * frame.cell_m
        y = south + (np.arange(first[1], last[1]) + 0.5) * frame.cell_m
        way = b - a
        squared = max(float(way @ way), 1e-12)
        dx, dy = x[None, :] - a[0], y[:, None] - a[1]
        ratio = np.clip((dx * way[0] + dy * way[1]) / squared, 0.0, 1.0)
        near = np.hypot(dx - ratio * way[0], dy - ratio * way[1]) <= half_width_m
        part = result[first[1] : last[1], first[0] : last[0]]
        part[near] = np.maximum(part[near], path["stamp_ns"][number])
    return result


def _costs_of_voxels(
    label: np.ndarray, confidence: np.ndarray, above_m: np.ndarray, costs: Costs
) -> np.ndarray:
    """(N,) int16: what each voxel costs by its height above the ground, then its class."""
    index = np.minimum(label, len(costs.cost) - 1)
    by_class = costs.cost[index]
    sure = (label != NO_LABEL) & (confidence >= costs.min_probability[index]) & (by_class >= 0)
    on_ground = sure & costs.ground[index]
    cost = np.full(len(label), costs.unnamed_ground_cost, dtype=np.int16)
    cost[on_ground] = by_class[on_ground]
    low = sure & ~on_ground & (above_m > costs.low_obstacle_height_m)
    cost[low] = by_class[low]
    rises = above_m > costs.min_obstacle_height_m
    cost[rises] = np.where(sure & ~on_ground, by_class, OCCUPIED)[rises]
    # Without ground nearby only the class can tell.
    adrift = np.isnan(above_m)
    cost[adrift] = np.where(sure, by_class, UNKNOWN)[adrift]
    cost[above_m > costs.clearance_m] = UNKNOWN
    return cost


def flatten(
    records: np.ndarray,
    bricks: np.ndarray,
    frame: Frame2d,
    ground_m: np.ndarray,
    path: np.ndarray,
    config: MapConfig,
    labels: LabelSet,
    costs: Costs,
) -> Rasters:
    """The 2-D maps of whole columns of voxels, all inside `frame`, above the ground (height, width)."""
    ground = ground_m.reshape(-1)
    passed = passed_at(path, frame, config.footprint_m).reshape(-1)
    order = np.argsort(
        (frame.cells(records) << 32) + (records["z"].astype(np.int64) + (1 << 30)), kind="stable"
    )
    records = records[order]
    label, confidence = labels_and_confidences(records, config, labels)
    above = (heights(records, config.voxel_size_m) - ground[frame.cells(records)]).astype(
        np.float32
    )
    is_ground = above <= GROUND_BAND_M
    layer = layers_of(records, label, confidence, config, labels, is_ground)
    there = layer != GONE
    records, label, confidence = records[there], label[there], confidence[there]
    above, layer, is_ground = above[there], layer[there], is_ground[there]
    cells = frame.cells(records)
    cost = _costs_of_voxels(label, confidence, above, costs)
    # Where the vehicle has been since, nothing was.
    blocks = (cost > 0) & ~is_ground
    cost[blocks & (records["last_ns"] <= passed[cells] + CAME_LATER_NS)] = UNKNOWN
    # A column needs so many points of what rises in it, or one that is sure of its class.
    count = frame.width * frame.height
    rising = above > costs.min_obstacle_height_m
    points = np.bincount(cells[rising], records["observations"][rising], count)
    on_ground = (label != NO_LABEL) & costs.ground[np.minimum(label, len(costs.ground) - 1)]
    sure = ~on_ground & (confidence >= costs.single_point_probability)
    cost[rising & ~sure & (points[cells] < costs.min_points)] = UNKNOWN
    grid = np.full(count, UNKNOWN, dtype=np.int8)
    starts = _starts(cells)
    if len(cells):
        grid[cells[starts]] = np.maximum.reduceat(cost, starts)
    free = (passed != np.iinfo(np.int64).min) | _crossed(bricks, frame, ground, config)
    grid[(grid == UNKNOWN) & free] = costs.unnamed_ground_cost
    return Rasters(
        frame,
        grid.reshape(frame.shape),
        *_uppermost(frame, cells, label, confidence, layer),
        _elevation(frame, cells, above, ground),
    )


def _uppermost(
    frame: Frame2d, cells: np.ndarray, label: np.ndarray, confidence: np.ndarray, layer: np.ndarray
) -> Tuple[np.ndarray, np.ndarray]:
    """Label and confidence of each cell, of voxels in ascending height."""
    count = frame.width * frame.height
    labels, confidences = np.full(count, NO_LABEL, dtype=np.uint8), np.zeros(count, np.float32)
    # Of equal cells the last assignment holds. Static ones go last.
    for wanted in (DYNAMIC, STATIC):
        named = np.flatnonzero((label != NO_LABEL) & (layer == wanted))
        labels[cells[named]] = label[named]
        confidences[cells[named]] = confidence[named]
    return labels.reshape(frame.shape), confidences.reshape(frame.shape)


def _elevation(
    frame: Frame2d, cells: np.ndarray, above: np.ndarray, ground: np.ndarray
) -> np.ndarray:
    """(height, width) float32: the height of the lowest voxel, where that belongs to the ground."""
    result = np.full(len(ground), np.nan, dtype=np.float32)
    starts = _starts(cells)
    lowest = starts[above[starts] <= GROUND_BAND_M] if len(cells) else starts[:0]
    result[cells[lowest]] = above[lowest] + ground[cells[lowest]]
    return result.reshape(frame.shape)


def _crossed(
    bricks: np.ndarray, frame: Frame2d, ground: np.ndarray, config: MapConfig
) -> np.ndarray:
    """(cells,) bool: rays crossed it closely above the ground."""
    result = np.zeros(len(ground), dtype=bool)
    if not len(bricks):
        return result
    voxels, passes = free_voxels(bricks)
    x, y = voxels[:, 0] - frame.min_x, voxels[:, 1] - frame.min_y
    inside = (x >= 0) & (x < frame.width) & (y >= 0) & (y < frame.height) & (passes >= FREE_PASSES)
    cell = (y * frame.width + x)[inside]
    above = (voxels[inside, 2] + 0.5) * config.voxel_size_m - ground[cell]
    result[cell[(above >= FREE_BAND_M[0]) & (above <= FREE_BAND_M[1])]] = True
    return result
