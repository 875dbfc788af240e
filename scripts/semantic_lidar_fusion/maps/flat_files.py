# SPDX-License-Identifier: MIT
"""2-D maps as files: map_server's maps, images with world files, and the picture.

What is too large for one file comes in blocks, in the folder TILES_FOLDER, with the block's number in
each name."""

import os
from typing import Any, Dict, Iterator, Sequence, Tuple

import numpy as np

from semantic_lidar_fusion.errors import DataError
from semantic_lidar_fusion.labels import NO_LABEL, LabelSet
from semantic_lidar_fusion.maps.formats import TILES_FOLDER
from semantic_lidar_fusion.maps.raster import Frame2d, Rasters
from semantic_lidar_fusion.maps.source import MapSource

# Of images of the elevation.
ELEVATION_STEP_M = 0.01
_PICTURE_CELLS = 4000  # to a side, at most


def blocks(source: MapSource, folder: str) -> Iterator[Tuple[str, str, Rasters]]:
    """Folder, ending of the names, and 2-D maps of each block."""
    for block in source.blocks():
        target = folder
        if block.name:
            target = os.path.join(folder, TILES_FOLDER)
            os.makedirs(target, exist_ok=True)
        yield target, block.name, block.rasters


def write_pgm(path: str, image: np.ndarray) -> None:
    """An 8-bit grey image, northern row first."""
    with open(path, "wb") as file:
        file.write(b"P5\n%d %d\n255\n" % (image.shape[1], image.shape[0]))
        file.write(np.ascontiguousarray(image, dtype=np.uint8).tobytes())


def _map_server_yaml(image: str, frame: Frame2d, mode: str) -> str:
    return (
        "image: %s\nresolution: %.9g\norigin: [%.9f, %.9f, 0.0]\nnegate: 0\n"
        "occupied_thresh: 0.65\nfree_thresh: 0.196\nmode: %s\n"
        % (image, frame.cell_m, frame.origin[0], frame.origin[1], mode)
    )


def write_grid(source: MapSource, folder: str) -> Dict[str, Any]:
    """Two maps for map_server: costs.yaml (mode raw: every cost, 255 = unknown) and occupancy.yaml
    (mode trinary, for programs that know no other: free below the cost 65, occupied from there)."""
    for target, ending, rasters in blocks(source, folder):
        cost = rasters.cost[::-1]
        grey = np.where(cost < 0, 205, np.where(cost >= 65, 0, 254))
        for name, image, mode in (
            ("costs", cost.astype(np.uint8), "raw"),
            ("occupancy", grey, "trinary"),
        ):
            path = os.path.join(target, name + ending)
            write_pgm(path + ".pgm", image)
            with open(path + ".yaml", "w", encoding="utf-8") as file:
                file.write(_map_server_yaml(name + ending + ".pgm", rasters.frame, mode))
    return {}


def write_rasters(source: MapSource, folder: str) -> Dict[str, Any]:
    """classes.png (class colours, transparent = none), labels.png (ids, 255 = none),
    confidence.png (255 = certain) and elevation.png (of the ground, 16 bits, 0 = not seen), with world
    files. Returns how to read the elevation."""
    colors = np.zeros((256, 4), dtype=np.uint8)
    colors[: len(source.labels), :3] = source.labels.colors_rgb[:, ::-1]
    colors[: len(source.labels), 3] = 255
    lowest = np.floor(source.extent.low[2] * source.config.voxel_size_m)
    for target, ending, rasters in blocks(source, folder):
        elevation = rasters.elevation_m.astype(np.float64)
        known = ~np.isnan(elevation)
        steps = np.rint((np.where(known, elevation, lowest) - lowest) / ELEVATION_STEP_M) + 1
        images = {
            "classes": colors[rasters.label],
            "labels": rasters.label,
            "confidence": np.rint(rasters.confidence * 255).astype(np.uint8),
            "elevation": np.where(known, np.clip(steps, 1, 65535), 0).astype(np.uint16),
        }
        for name, image in images.items():
            path = os.path.join(target, name + ending)
            _write_png(path + ".png", image[::-1])
            with open(path + ".pgw", "w", encoding="ascii") as file:
                file.write(_world_file(rasters.frame))
    about = {
        "unknown": 0,
        "metres": "offset_m + step_m * value",
        "step_m": ELEVATION_STEP_M,
        "offset_m": float(lowest) - ELEVATION_STEP_M,
    }
    return {"elevation": about}


def _world_file(frame: Frame2d) -> str:
    # Centre of the upper left pixel.
    left = (frame.min_x + 0.5) * frame.cell_m
    top = (frame.min_y + frame.height - 0.5) * frame.cell_m
    return "%.9f\n0.0\n0.0\n%.9f\n%.9f\n%.9f\n" % (frame.cell_m, -frame.cell_m, left, top)


def write_picture(source: MapSource, folder: str) -> Dict[str, Any]:
    """map.png. Of a large map every n-th cell is drawn."""
    low, high = source.extent.low, source.extent.high
    step = -(-max(high[0] - low[0] + 1, high[1] - low[1] + 1) // _PICTURE_CELLS)
    size = source.config.voxel_size_m * step
    drawn = Rasters.empty(
        Frame2d.around((low[0] // step, low[1] // step), (high[0] // step, high[1] // step), size)
    )
    for block in source.blocks():
        frame = block.rasters.frame
        x, y = -frame.min_x % step, -frame.min_y % step
        corner = ((frame.min_x + x) // step, (frame.min_y + y) // step)
        parts = [values[y::step, x::step] for values in block.rasters[1:]]
        part = Frame2d(corner[0], corner[1], parts[0].shape[1], parts[0].shape[0], size)
        drawn.paste(Rasters(part, *parts))
    draw_picture(os.path.join(folder, "map.png"), drawn, source.labels, source.title)
    return {}


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


def _matplotlib_color(rgb: Sequence[int]) -> Tuple[float, float, float]:
    red, green, blue = (float(value) / 255.0 for value in rgb)
    return red, green, blue


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
    seen = (rasters.label != NO_LABEL) | ~np.isnan(rasters.elevation_m) | (rasters.cost > 0)
    rows, columns = _core(seen)
    label = rasters.label[rows, columns]
    # Neither white nor grey: classes may have these colours.
    image = np.full(label.shape + (3,), _EMPTY_RGB, dtype=np.uint8)
    named = label != NO_LABEL
    color = labels.colors_rgb[np.minimum(label, len(labels) - 1)].astype(np.float64)
    strength = 0.35 + 0.65 * rasters.confidence[rows, columns][..., None]
    image[named] = (color * strength + np.array(_EMPTY_RGB) * (1 - strength))[named].round()
    image[~named & seen[rows, columns]] = _UNNAMED_RGB
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
        Patch(
            facecolor=_matplotlib_color(labels.colors_rgb[i]), edgecolor="0.5", label=labels[i].name
        )
        for i in shown
    ]
    handles.append(
        Patch(facecolor=_matplotlib_color(_UNNAMED_RGB), edgecolor="0.5", label="no class")
    )
    axes.legend(
        handles=handles,
        loc="upper center",
        bbox_to_anchor=(0.5, -0.32 if ratio < 0.3 else -0.12),
        ncol=min(len(handles), 7),
        frameon=False,
    )
    plotting.save(figure, path)
