#!/usr/bin/python3
# SPDX-License-Identifier: MIT
"""Exports a made-up map of 10 x 10 km and prints the memory that it took: crossing roads, houses beside
them, and crossed space above. Source the build's setup.bash first.

  large_map.py /tmp/large --roads 2 --formats ply,grid,raster"""
import argparse
import os
import resource
import sys
import time

import numpy as np

SOURCE_DIR = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
sys.path.insert(0, os.path.join(SOURCE_DIR, "scripts"))

from semantic_lidar_fusion.installation import package_file  # noqa: E402
from semantic_lidar_fusion.labels import LabelSet  # noqa: E402
from semantic_lidar_fusion.maps import formats  # noqa: E402
from semantic_lidar_fusion.maps.formats import MAP_FILE  # noqa: E402
from semantic_lidar_fusion.maps.map_file import MapHeader, MapReader, MapWriter  # noqa: E402
from semantic_lidar_fusion.maps.output import OutputFolder, export_map  # noqa: E402
from semantic_lidar_fusion.maps.raster import Costs  # noqa: E402
from semantic_lidar_fusion.maps.records import PATH, bricks_of, canonical_order  # noqa: E402
from semantic_lidar_fusion.maps.records import record_dtype  # noqa: E402
from semantic_lidar_fusion.maps.semantic_map import MapConfig  # noqa: E402

TILE = 256
ROAD_M, HOUSE_M = 8.0, 6.0


def tile_of(column, row, centers, size_m, labels):
    """Records and bricks of a tile that roads along x and y at `centers` (voxels) cross."""
    x, y = np.meshgrid(column * TILE + np.arange(TILE), row * TILE + np.arange(TILE))
    away = np.minimum(
        *(np.abs(v[..., None] - centers).min(axis=-1) for v in (x, y))
    )  # voxels from the middle of the next road
    road = away <= ROAD_M / 2 / size_m
    house = ~road & (away <= ROAD_M / 2 / size_m + 1)
    cells = [np.stack([x[road], y[road], np.zeros(road.sum(), np.int64)], axis=1)]
    levels = np.arange(1, int(HOUSE_M / size_m))
    for level in levels:
        cells.append(np.stack([x[house], y[house], np.full(house.sum(), level)], axis=1))
    voxels = np.concatenate(cells)
    records = np.zeros(len(voxels), dtype=record_dtype(len(labels)))
    for axis, values in zip("xyz", voxels.T):
        records[axis] = values
    for name in ("observations", "looks", "labelled"):
        records[name] = 5
    label = np.where(voxels[:, 2] == 0, labels.id_of("road"), labels.id_of("building"))
    records["evidence"][np.arange(len(voxels)), label] = 4 << 20
    above = cells[0] + [0, 0, 3]
    bricks = bricks_of(above, np.full(len(above), 3)) if len(above) else None
    return records[canonical_order(records)], bricks


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out")
    parser.add_argument("--edge", type=float, default=10000.0, metavar="M")
    parser.add_argument("--roads", type=int, default=2, help="in each direction")
    parser.add_argument("--voxel", type=float, default=0.2, metavar="M")
    parser.add_argument("--formats", type=formats.split, default=formats.available())
    options = parser.parse_args()
    labels = LabelSet.from_file(package_file("config/classes_usyd12.yaml"))
    header = MapHeader(MapConfig(voxel_size_m=options.voxel).checked(len(labels)), labels, "map")
    cells = int(options.edge / options.voxel)
    centers = (np.arange(options.roads) + 0.5) * cells / options.roads
    centers[[0, -1]] = [20.0 / options.voxel, cells - 20.0 / options.voxel]
    count = 0
    begin = time.process_time()
    with OutputFolder(options.out, True) as output:
        with MapWriter(os.path.join(output.partial, MAP_FILE), header) as writer:
            for column in range(cells // TILE + 1):
                for row in range(cells // TILE + 1):
                    near = [np.abs((n + 0.5) * TILE - centers).min() for n in (column, row)]
                    if min(near) > TILE:
                        continue
                    records, bricks = tile_of(column, row, centers, options.voxel, labels)
                    if len(records):
                        writer.write(records, bricks)
                        count += len(records)
            writer.add_path(np.zeros(0, dtype=PATH))
        print("%d voxels written after %.0f s of a core" % (count, time.process_time() - begin))
        costs = Costs.from_file(package_file("config/map_costs.yaml"), labels)
        for name in options.formats:
            begin = time.process_time()
            done = export_map(output.partial, [name], costs, "large", {})
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
            told = done.failed.get(name, "written")
            print("%s: %s, %.0f s of a core, at most %.0f MB so far" % (name, told, time.process_time() - begin, peak), flush=True)  # fmt: skip
        assert len(MapReader(os.path.join(output.partial, MAP_FILE))) == count
    return 0


if __name__ == "__main__":
    sys.exit(main())
