# SPDX-License-Identifier: MIT
"""A map as a grid_map message in a bag, where grid_map_msgs is installed."""

import os
from typing import Any, Dict

import numpy as np

from semantic_lidar_fusion import cli
from semantic_lidar_fusion.bags.bag_io import to_stamp
from semantic_lidar_fusion.errors import DataError
from semantic_lidar_fusion.labels import NO_LABEL
from semantic_lidar_fusion.maps.raster import UNKNOWN, Rasters
from semantic_lidar_fusion.maps.source import MapSource

TOPIC = "/grid_map"


def layers(rasters: Rasters) -> Dict[str, np.ndarray]:
    """Layers of a grid map, (height, width) float32 each; NaN = unknown."""
    label = np.where(rasters.label == NO_LABEL, np.nan, rasters.label.astype(np.float32))
    return {
        "elevation": rasters.elevation_m,
        "class": label.astype(np.float32),
        "confidence": np.where(np.isnan(label), np.nan, rasters.confidence).astype(np.float32),
        "cost": np.where(rasters.cost == UNKNOWN, np.nan, rasters.cost).astype(np.float32),
    }


def to_message(rasters: Rasters, frame_id: str, stamp_ns: int) -> Any:
    """A grid_map_msgs/GridMap. Its first index runs against x, its second against y; the data is
    column-major."""
    from grid_map_msgs.msg import GridMap
    from std_msgs.msg import Float32MultiArray, MultiArrayDimension

    frame = rasters.frame
    message = GridMap()
    message.info.header.frame_id = frame_id
    message.info.header.stamp = to_stamp(stamp_ns)
    message.info.resolution = frame.cell_m
    message.info.length_x = frame.width * frame.cell_m
    message.info.length_y = frame.height * frame.cell_m
    message.info.pose.position.x = frame.origin[0] + message.info.length_x / 2
    message.info.pose.position.y = frame.origin[1] + message.info.length_y / 2
    message.info.pose.orientation.w = 1.0
    for name, values in layers(rasters).items():
        # Rows of the matrix are x from the greatest, columns y from the greatest.
        matrix = values.T[::-1, ::-1]
        data = Float32MultiArray()
        rows, columns = matrix.shape
        data.layout.dim = [
            MultiArrayDimension("column_index", columns, rows * columns),
            MultiArrayDimension("row_index", rows, rows),
        ]
        data.data = matrix.T.reshape(-1).tolist()
        message.layers.append(name)
        message.data.append(data)
    message.basic_layers = ["elevation"]
    return message


def write_grid_map(source: MapSource, folder: str) -> Dict[str, Any]:
    """grid_map.bag: one message on TOPIC with the layers elevation, class, confidence and cost."""
    cli.require("grid_map_msgs.msg", "rosbag")
    import rosbag

    found = list(source.blocks())
    if len(found) > 1:
        raise DataError("the map is too large for one grid_map message")
    path = source.reader.path
    stamp_ns = int(path["stamp_ns"][-1]) if len(path) else 0
    message = to_message(found[0].rasters, source.header.frame_id, stamp_ns)
    with rosbag.Bag(os.path.join(folder, "grid_map.bag"), "w") as bag:
        bag.write(TOPIC, message, to_stamp(max(stamp_ns, 1)))
    return {}
