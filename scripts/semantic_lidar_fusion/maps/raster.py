# SPDX-License-Identifier: MIT
"""2-D maps from voxels: ground, cost and class of each column of voxels.

Grids are arrays [row, column] = [voxel y - min y, voxel x - min x]: row 0 is the southern edge, as
in nav_msgs/OccupancyGrid. Image files have the northern row first.
"""

import os
from typing import Any, Callable, Dict, Iterable, Iterator, NamedTuple, Tuple

import numpy as np

from semantic_lidar_fusion.errors import ConfigError, DataError
from semantic_lidar_fusion.labels import NO_LABEL, LabelSet, load_yaml
from semantic_lidar_fusion.maps.semantic_map import (
    DYNAMIC,
    STATIC,
    MapConfig,
    heights,
    labels_and_confidences,
)

UNKNOWN = -1  # of a cost grid
OCCUPIED = 100
MAX_CELLS = 1 << 28
# A cell without ground takes that of the nearest cell that has some, if it is not further (m).
GROUND_REACH_M = 5.0
# Something that moves stands there no more if the ground below it was seen so much later (ns).
GONE_AFTER_NS = 300 * 10**6


class Costs(NamedTuple):
    """A cost file for a class set. cost: (C,) int, -1 = says nothing; min_probability: (C,); ground:
    (C,) bool."""

    cost: np.ndarray
    min_probability: np.ndarray
    ground: np.ndarray
    min_obstacle_height_m: float
    clearance_m: float

    @staticmethod
    def from_file(path: str, labels: LabelSet) -> "Costs":
        return Costs.from_tree(load_yaml(path), labels, path)

    @staticmethod
    def from_tree(tree: Any, labels: LabelSet, source: str) -> "Costs":
        """Checks a parsed cost file; ConfigError with every problem."""
        problems = []
        if not isinstance(tree, dict):
            raise ConfigError("%s: must be a mapping" % source)
        known = ("default", "min_obstacle_height_m", "clearance_m", "classes")
        problems += ["%s: unknown key" % key for key in tree if key not in known]
        heights = []
        for key, value in (("min_obstacle_height_m", 0.3), ("clearance_m", 2.5)):
            heights.append(_number(tree.get(key, value), 0, 1000, key, problems))
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
            heights[0],
            heights[1],
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
        """All voxels from low to high, inclusive; DataError if they are absurdly many."""
        width, height = high[0] - low[0] + 1, high[1] - low[1] + 1
        if width * height > MAX_CELLS:
            raise DataError(
                "the map is %d x %d voxels wide, too much for a picture; limit the range of the "
                "points, or leave the 2-D maps out" % (width, height)
            )
        return Frame2d(low[0], low[1], width, height, cell_m)

    @property
    def shape(self) -> Tuple[int, int]:
        return self.height, self.width

    @property
    def origin(self) -> Tuple[float, float]:
        """The south-western corner (m)."""
        return self.min_x * self.cell_m, self.min_y * self.cell_m

    def cells(self, records: np.ndarray) -> np.ndarray:
        """(N,) int64: index of each record's cell in the flattened grid."""
        row = records["y"].astype(np.int64) - self.min_y
        return row * self.width + (records["x"].astype(np.int64) - self.min_x)


class Columns:
    """Whole columns of voxels, sorted once by cell and height.

    Arrays (N,) in that order: cell, z (m), label, confidence, layer, last_ns; `starts`: the first
    voxel of each column."""

    def __init__(self, records: np.ndarray, config: MapConfig, frame: Frame2d):
        cell = frame.cells(records)
        order = np.argsort((cell << 32) + records["z"], kind="stable")
        records = records[order]
        self.cell = cell[order]
        self.z = heights(records, config.voxel_size_m).astype(np.float32)
        self.label, self.confidence = labels_and_confidences(records, config)
        self.layer, self.last_ns = records["layer"], records["last_ns"]
        self.starts = _starts(self.cell)

    def sure(self, costs: "Costs") -> np.ndarray:
        """(N,) bool: whose class is likely enough to count."""
        label = np.minimum(self.label, len(costs.cost) - 1)
        return (self.label != NO_LABEL) & (self.confidence >= costs.min_probability[label])


def _starts(cells: np.ndarray) -> np.ndarray:
    """Indices where a new value begins in sorted cells."""
    new = np.ones(len(cells), dtype=bool)
    new[1:] = cells[1:] != cells[:-1]
    return np.flatnonzero(new)


class Surfaces:
    """Ground and uppermost class of each cell, gathered tile by tile.

    ground_m: height of the lowest ground voxel, NaN = none; ground_ns: when ground was last seen;
    lowest_m: lowest voxel; label, confidence: of the uppermost labelled voxel of the static layer
    (of the other, where that has none)."""

    def __init__(self, frame: Frame2d, costs: Costs):
        self.frame, self._costs = frame, costs
        count = frame.width * frame.height
        self.ground_m = np.full(count, np.nan, dtype=np.float32)
        self.lowest_m = np.full(count, np.nan, dtype=np.float32)
        self.ground_ns = np.full(count, np.iinfo(np.int64).min)
        self.label = np.full(count, NO_LABEL, dtype=np.uint8)
        self.confidence = np.zeros(count, dtype=np.float32)

    def add(self, columns: Columns) -> None:
        """Columns that were not added before."""
        if not len(columns.cell):
            return
        cells = columns.cell
        self.lowest_m[cells[columns.starts]] = columns.z[columns.starts]
        is_ground = self._costs.ground[np.minimum(columns.label, len(self._costs.ground) - 1)]
        ground = np.flatnonzero(columns.sure(self._costs) & is_ground & (columns.layer == STATIC))
        if len(ground):
            starts = _starts(cells[ground])
            first = ground[starts]
            self.ground_m[cells[first]] = columns.z[first]
            latest = np.maximum.reduceat(columns.last_ns[ground], starts)
            self.ground_ns[cells[first]] = latest
        # In ascending height: of equal cells the last assignment holds. Static ones go last.
        for layer in (DYNAMIC, STATIC):
            named = np.flatnonzero((columns.label != NO_LABEL) & (columns.layer == layer))
            self.label[cells[named]] = columns.label[named]
            self.confidence[cells[named]] = columns.confidence[named]

    def reference_m(self) -> np.ndarray:
        """(cells,) float32: the ground to measure heights from: its own, else that of the nearest
        cell within GROUND_REACH_M, else the lowest voxel; NaN where there is nothing."""
        import cv2

        missing = np.isnan(self.ground_m).reshape(self.frame.shape)
        if missing.all():
            return self.lowest_m
        distance, region = cv2.distanceTransformWithLabels(
            missing.astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
        )
        table = np.zeros(int(region.max()) + 1, dtype=np.float32)
        known = ~missing
        table[region[known]] = self.ground_m.reshape(self.frame.shape)[known]
        filled = table[region].reshape(-1)
        near = distance.reshape(-1) * self.frame.cell_m <= GROUND_REACH_M
        return np.where(near, filled, self.lowest_m)


class CostGrid:
    """nav_msgs/OccupancyGrid values: 0 free to 100 occupied, -1 unknown; gathered tile by tile."""

    def __init__(self, surfaces: Surfaces, costs: Costs):
        self.frame, self._costs, self._surfaces = surfaces.frame, costs, surfaces
        self._ground_m = surfaces.reference_m()
        self.cost = np.full(len(self._ground_m), UNKNOWN, dtype=np.int8)

    def add(self, columns: Columns) -> None:
        """Columns that were not added before."""
        if not len(columns.cell):
            return
        costs, cells = self._costs, columns.cell
        above = columns.z - self._ground_m[cells]
        label = np.minimum(columns.label, len(costs.cost) - 1)
        cost = np.where(columns.sure(costs), costs.cost[label], UNKNOWN)
        # What has no class is an obstacle if it rises from the ground.
        rises = above > costs.min_obstacle_height_m
        cost = np.where((cost == UNKNOWN) & rises, OCCUPIED, cost)
        gone = self._surfaces.ground_ns[cells] > columns.last_ns + GONE_AFTER_NS
        cost[(columns.layer == DYNAMIC) & gone] = UNKNOWN
        cost[above > costs.clearance_m] = UNKNOWN
        worst = np.maximum.reduceat(cost, columns.starts)
        self.cost[cells[columns.starts]] = worst.astype(np.int8)

    @property
    def grid(self) -> np.ndarray:
        """(height, width) int8."""
        return self.cost.reshape(self.frame.shape)


class Rasters(NamedTuple):
    """All 2-D maps of a voxel map, (height, width) each."""

    frame: Frame2d
    cost: np.ndarray
    label: np.ndarray
    confidence: np.ndarray
    elevation_m: np.ndarray


def rasterise(
    tiles: Callable[[], Iterable[np.ndarray]], frame: Frame2d, config: MapConfig, costs: Costs
) -> Rasters:
    """2-D maps from two passes over the tiles."""
    surfaces = Surfaces(frame, costs)
    for records in tiles():
        surfaces.add(Columns(records, config, frame))
    costs_of_cells = CostGrid(surfaces, costs)
    for records in tiles():
        costs_of_cells.add(Columns(records, config, frame))
    elevation = np.where(np.isnan(surfaces.ground_m), surfaces.lowest_m, surfaces.ground_m)
    return Rasters(
        frame,
        costs_of_cells.grid,
        surfaces.label.reshape(frame.shape),
        surfaces.confidence.reshape(frame.shape),
        elevation.reshape(frame.shape),
    )


def extent(tiles: Iterable[np.ndarray]) -> Iterator[Tuple[int, int, int, int]]:
    """(min x, min y, max x, max y) of each tile."""
    for records in tiles:
        if len(records):
            x, y = records["x"], records["y"]
            yield int(x.min()), int(y.min()), int(x.max()), int(y.max())


def write_pgm(path: str, image: np.ndarray) -> None:
    """An 8-bit grey image, northern row first."""
    with open(path, "wb") as file:
        file.write(b"P5\n%d %d\n255\n" % (image.shape[1], image.shape[0]))
        file.write(np.ascontiguousarray(image, dtype=np.uint8))


def _map_server_yaml(image: str, frame: Frame2d, mode: str) -> str:
    return (
        "image: %s\nresolution: %.9g\norigin: [%.9f, %.9f, 0.0]\nnegate: 0\n"
        "occupied_thresh: 0.65\nfree_thresh: 0.196\nmode: %s\n"
        % (image, frame.cell_m, frame.origin[0], frame.origin[1], mode)
    )


def write_occupancy(folder: str, rasters: Rasters) -> None:
    """Two maps for map_server: costs.yaml (mode raw: every cost, 255 = unknown) and occupancy.yaml
    (mode trinary, for programs that know no other: free below the cost 65, occupied from there)."""
    cost = rasters.cost[::-1]
    write_pgm(os.path.join(folder, "costs.pgm"), cost.astype(np.uint8))
    grey = np.where(cost < 0, 205, np.where(cost >= 65, 0, 254))
    write_pgm(os.path.join(folder, "occupancy.pgm"), grey)
    for name, mode in (("costs", "raw"), ("occupancy", "trinary")):
        with open(os.path.join(folder, name + ".yaml"), "w", encoding="utf-8") as file:
            file.write(_map_server_yaml(name + ".pgm", rasters.frame, mode))


ELEVATION_STEP_M = 0.01


def write_rasters(folder: str, rasters: Rasters, labels: LabelSet) -> Dict[str, Any]:
    """classes.png (class colours, transparent = none), labels.png (ids, 255 = none),
    confidence.png (255 = certain) and elevation.png (16 bits), with world files. Returns how to read
    the elevation."""
    colors = np.zeros((256, 4), dtype=np.uint8)
    colors[: len(labels), :3] = labels.colors_rgb[:, ::-1]
    colors[: len(labels), 3] = 255
    elevation = rasters.elevation_m.astype(np.float64)
    known = ~np.isnan(elevation)
    lowest = float(np.floor(elevation[known].min())) if known.any() else 0.0
    steps = np.rint((np.where(known, elevation, lowest) - lowest) / ELEVATION_STEP_M) + 1
    images = {
        "classes.png": colors[rasters.label],
        "labels.png": rasters.label,
        "confidence.png": np.rint(rasters.confidence * 255).astype(np.uint8),
        "elevation.png": np.where(known, np.clip(steps, 1, 65535), 0).astype(np.uint16),
    }
    frame = rasters.frame
    # Centre of the upper left pixel.
    left = (frame.min_x + 0.5) * frame.cell_m
    top = (frame.min_y + frame.height - 0.5) * frame.cell_m
    world = "%.9f\n0.0\n0.0\n%.9f\n%.9f\n%.9f\n" % (frame.cell_m, -frame.cell_m, left, top)
    for name, image in images.items():
        _write_png(os.path.join(folder, name), image[::-1])
        with open(os.path.join(folder, name[:-4] + ".pgw"), "w", encoding="ascii") as file:
            file.write(world)
    return {
        "unknown": 0,
        "metres": "offset_m + step_m * value",
        "step_m": ELEVATION_STEP_M,
        "offset_m": lowest - ELEVATION_STEP_M,
    }


def _write_png(path: str, image: np.ndarray) -> None:
    import cv2

    try:
        good = cv2.imwrite(path, np.ascontiguousarray(image))
    except cv2.error as error:
        raise DataError("%s: cannot be written (%s)" % (path, error)) from error
    if not good:
        raise DataError("%s: cannot be written" % path)


_EMPTY_RGB = (214, 222, 232)
_UNNAMED_RGB = (165, 172, 180)


def _core(known: np.ndarray) -> Tuple[slice, slice]:
    """Rows and columns of a grid that hold nearly all of its known cells: single far points would
    make the picture small."""
    result = []
    for axis in (1, 0):
        share = np.cumsum(known.sum(axis=axis)) / max(int(known.sum()), 1)
        first, last = np.searchsorted(share, [0.003, 0.997])
        result.append(slice(max(0, int(first) - 5), int(last) + 6))
    return result[0], result[1]


def draw_picture(path: str, rasters: Rasters, labels: LabelSet, title: str) -> None:
    """The map from above in class colours, paler where it is less sure, with a legend."""
    from matplotlib.patches import Patch

    from semantic_lidar_fusion.figures import plotting

    pyplot = plotting.pyplot()
    frame = rasters.frame
    rows, columns = _core(~np.isnan(rasters.elevation_m))
    label = rasters.label[rows, columns]
    # Neither white nor grey: classes may have these colours.
    image = np.full(label.shape + (3,), _EMPTY_RGB, dtype=np.uint8)
    named = label != NO_LABEL
    color = labels.colors_rgb[np.minimum(label, len(labels) - 1)].astype(np.float64)
    strength = 0.35 + 0.65 * rasters.confidence[rows, columns][..., None]
    image[named] = (color * strength + np.array(_EMPTY_RGB) * (1 - strength))[named].round()
    image[~named & ~np.isnan(rasters.elevation_m[rows, columns])] = _UNNAMED_RGB
    west = (frame.min_x + columns.start) * frame.cell_m
    south = (frame.min_y + rows.start) * frame.cell_m
    east, north = west + label.shape[1] * frame.cell_m, south + label.shape[0] * frame.cell_m
    ratio = label.shape[0] / label.shape[1]
    width = 11.0 if ratio < 1 else max(5.0, 9.0 / ratio)
    figure, axes = pyplot.subplots(figsize=(width, min(11.0, max(3.0, width * ratio + 1.6))))
    axes.imshow(image, origin="lower", extent=(west, east, south, north), interpolation="nearest")
    axes.set_title(title)
    axes.set_xlabel("x (m)")
    axes.set_ylabel("y (m)")
    axes.ticklabel_format(useOffset=False, style="plain")
    shown = [i for i in range(len(labels)) if (label == i).any()]
    handles = [
        Patch(facecolor=labels.colors_rgb[i] / 255.0, edgecolor="0.5", label=labels[i].name)
        for i in shown
    ]
    unnamed = np.array(_UNNAMED_RGB) / 255.0
    handles.append(Patch(facecolor=unnamed, edgecolor="0.5", label="no class"))
    axes.legend(
        handles=handles,
        loc="upper center",
        bbox_to_anchor=(0.5, -0.32 if ratio < 0.3 else -0.12),
        ncol=min(len(handles), 7),
        frameon=False,
    )
    plotting.save(figure, path)
