# SPDX-License-Identifier: MIT
"""The live map node: a rolling window of the map as an occupancy grid and a coloured cloud.

Everything is published from one timer thread; the mapper's lock is held only while records are
copied. Parameters are read once; every wrong one is reported at once.
"""

import os
import threading
import time
from typing import Any, Dict, List, Optional, Tuple

import numpy as np

from semantic_lidar_fusion.bags.bag_io import to_stamp
from semantic_lidar_fusion.bags.cloud_io import from_array, point_dtype
from semantic_lidar_fusion.errors import ConfigError, SemanticLidarFusionError
from semantic_lidar_fusion.labels import LabelSet, package_file
from semantic_lidar_fusion.maps.semantic_map import (
    MapConfig,
    labels_and_confidences,
    positions,
)
from semantic_lidar_fusion.maps.build import Accumulator
from semantic_lidar_fusion.maps.export import FORMATS, MAP_FILE, class_colors
from semantic_lidar_fusion.maps.live import LiveMapper, drop_values
from semantic_lidar_fusion.maps.output import OutputFolder, export_map
from semantic_lidar_fusion.maps.raster import (
    Columns,
    CostGrid,
    Costs,
    Frame2d,
    Surfaces,
)

_MAP_DEFAULTS = MapConfig()
DEFAULTS: Dict[str, Any] = {
    "frame": "odom",
    "classes": "",
    "costs": "",
    "voxel_size_m": 0.2,
    "evidence": "log",
    "weight": _MAP_DEFAULTS.weight,
    "floor": _MAP_DEFAULTS.floor,
    "clamp": _MAP_DEFAULTS.clamp,
    "min_range_m": 0.0,
    "max_range_m": 50.0,
    "dynamic": "apart",
    "window_m": 60.0,
    "grid_period_s": 1.0,
    "full_grid_period_s": 10.0,
    "cloud_period_s": 2.0,
    "tf_timeout_s": 0.5,
    "tf_cache_s": 10.0,
    "save_folder": "~",
    "save_formats": "ply,pcd,grid",
}


class Settings:
    """The node's private parameters; ConfigError with every problem."""

    def __init__(self, given: Dict[str, Any]):
        problems = []
        values = dict(DEFAULTS)
        for name, value in given.items():
            if name not in DEFAULTS:
                problems.append("~%s: unknown parameter (known: %s)" % (name, ", ".join(DEFAULTS)))
                continue
            if isinstance(DEFAULTS[name], float):
                if isinstance(value, bool) or not isinstance(value, (int, float)):
                    problems.append("~%s = %s: must be a number" % (name, value))
                    continue
                value = float(value)
            else:
                value = str(value)
            values[name] = value
        for name in ("window_m", "grid_period_s", "full_grid_period_s", "cloud_period_s"):
            if not values[name] > 0:
                problems.append("~%s = %s: must be above 0" % (name, values[name]))
        for name in ("tf_timeout_s", "tf_cache_s"):
            if not values[name] >= 0:
                problems.append("~%s = %s: must not be negative" % (name, values[name]))
        self.save_formats = [name for name in values["save_formats"].split(",") if name]
        for name in self.save_formats:
            if name not in FORMATS:
                problems.append("~save_formats: no format %s (of %s)" % (name, ", ".join(FORMATS)))
        self.values = values
        self.config = MapConfig(
            voxel_size_m=values["voxel_size_m"],
            kind=values["evidence"],
            weight=values["weight"],
            floor=values["floor"],
            clamp=values["clamp"],
            min_range_m=values["min_range_m"],
            max_range_m=values["max_range_m"],
            dynamic=values["dynamic"],
        )
        problems += ["~" + text for text in self.config.problems(1)]
        if problems:
            raise ConfigError("; ".join(problems))

    def __getitem__(self, name: str) -> Any:
        return self.values[name]


class Window:
    """The voxels that the node keeps: a square of cells around the vehicle, moved in steps."""

    def __init__(self, half_width_m: float, cell_m: float):
        self._half = max(1, int(round(half_width_m / cell_m)))
        self._step = max(1, self._half // 4)
        self._cell_m = cell_m
        self.frame: Optional[Frame2d] = None

    def follow(self, x_m: float, y_m: float) -> bool:
        """Whether the window moved."""
        center = [int(np.floor(v / self._cell_m / self._step)) * self._step for v in (x_m, y_m)]
        low = (center[0] - self._half, center[1] - self._half)
        size = 2 * self._half + self._step
        if self.frame is not None and (self.frame.min_x, self.frame.min_y) == low:
            return False
        self.frame = Frame2d(low[0], low[1], size, size, self._cell_m)
        return True

    def bounds(self) -> Tuple[List[int], List[int]]:
        """Voxel indices of its corners, all heights."""
        assert self.frame is not None
        f, deep = self.frame, 1 << 30
        low = [f.min_x, f.min_y, -deep]
        return low, [f.min_x + f.width - 1, f.min_y + f.height - 1, deep]


class SemanticMapServer:
    """Subscribes points_semantic and class_info; publishes semantic_grid, its updates and
    semantic_map; serves ~save and ~clear."""

    def __init__(self) -> None:
        import rospy
        from diagnostic_msgs.msg import DiagnosticArray
        from nav_msgs.msg import OccupancyGrid
        from sensor_msgs.msg import PointCloud2
        from std_srvs.srv import Trigger

        try:
            from map_msgs.msg import OccupancyGridUpdate
        except ImportError:
            OccupancyGridUpdate = None
        self._rospy = rospy
        self.settings = Settings(rospy.get_param("~", {}))
        labels = None
        if self.settings["classes"]:
            labels = LabelSet.from_file(self.settings["classes"])
        self._costs_file = self.settings["costs"] or package_file("config/map_costs.yaml")
        self._window = Window(self.settings["window_m"], self.settings.config.voxel_size_m)
        self._costs: Optional[Costs] = None
        self._stamp_ns = 0
        self._grid: Optional[np.ndarray] = None
        self._grid_frame: Optional[Frame2d] = None
        self._full_at = 0.0  # monotonic time of the next whole grid
        self._publishing = threading.Lock()
        self._cpu_s, self._cpu_at = time.process_time(), time.monotonic()
        self._clouds_before = 0
        self._grids = rospy.Publisher("semantic_grid", OccupancyGrid, queue_size=1, latch=True)
        self._updates = None
        if OccupancyGridUpdate is not None:
            self._updates = rospy.Publisher(
                "semantic_grid_updates", OccupancyGridUpdate, queue_size=2
            )
        else:
            rospy.loginfo("map_msgs is not installed: every change publishes the whole grid")
        self._clouds = rospy.Publisher("semantic_map", PointCloud2, queue_size=1)
        self._diagnostics = rospy.Publisher("/diagnostics", DiagnosticArray, queue_size=5)
        self.mapper = LiveMapper(
            "points_semantic",
            self.settings["frame"],
            lambda classes: self.settings.config.checked(len(classes)),
            labels,
            self.settings["tf_timeout_s"],
            self.settings["tf_cache_s"],
            self._on_cloud,
        )
        self._services = [
            rospy.Service("~save", Trigger, self._save),
            rospy.Service("~clear", Trigger, self._clear),
        ]
        self._stopping = threading.Event()
        self._publisher = threading.Thread(target=self._publish_loop, daemon=True)
        self._publisher.start()

    def close(self) -> None:
        self._stopping.set()
        self._publisher.join(timeout=5.0)
        self.mapper.close()

    def _on_cloud(self, cloud: Any, pose: np.ndarray) -> None:
        """With the mapper's lock held: the window follows the vehicle."""
        self._stamp_ns = cloud.stamp_ns
        if self._window.follow(pose[0, 3], pose[1, 3]):
            assert self.mapper.voxels is not None
            self.mapper.voxels.keep_inside(*self._window.bounds())

    def _snapshot(self) -> Optional[Tuple[np.ndarray, MapConfig, LabelSet, Frame2d, int]]:
        with self.mapper.lock:
            voxels = self.mapper.voxels
            if voxels is None or self._window.frame is None:
                return None
            records = voxels.records(in_order=False)
            return records, voxels.config, voxels.labels, self._window.frame, self._stamp_ns

    def _publish_loop(self) -> None:
        """Wall-clock periods, so that a paused clock shows what there is."""
        periods = {
            self._publish_grid: self.settings["grid_period_s"],
            self._publish_cloud: self.settings["cloud_period_s"],
            self._publish_diagnostics: 1.0,
        }
        due = dict.fromkeys(periods, time.monotonic())
        while not self._stopping.wait(max(0.01, min(due.values()) - time.monotonic())):
            for publish, period in periods.items():
                if time.monotonic() < due[publish]:
                    continue
                due[publish] = time.monotonic() + period
                try:
                    publish()
                except SemanticLidarFusionError as error:
                    self._rospy.logerr_throttle(30, str(error))
                except self._rospy.ROSException:
                    return  # the node ends
        self._stopping.set()

    def compute_grid(self, snapshot: Any) -> np.ndarray:
        """(height, width) int8 of a snapshot."""
        records, config, labels, frame, _ = snapshot
        if self._costs is None:
            self._costs = Costs.from_file(self._costs_file, labels)
        columns = Columns(records, config, frame)
        surfaces = Surfaces(frame, self._costs)
        surfaces.add(columns)
        grid = CostGrid(surfaces, self._costs)
        grid.add(columns)
        return grid.grid

    def _publish_grid(self) -> None:
        with self._publishing:
            snapshot = self._snapshot()
            if snapshot is None:
                return
            grid, frame = self.compute_grid(snapshot), snapshot[3]
            before, self._grid = self._grid, grid
            moved = frame != self._grid_frame
            now = time.monotonic()
            if moved or before is None or self._updates is None or now > self._full_at:
                if not moved and before is not None and np.array_equal(before, grid):
                    return
                self._grid_frame = frame
                self._full_at = now + self.settings["full_grid_period_s"]
                self._grids.publish(self._grid_message(grid, frame, snapshot[4]))
                return
            changed = before != grid
            rows, columns = np.flatnonzero(changed.any(axis=1)), np.flatnonzero(changed.any(axis=0))
            if len(rows):
                self._updates.publish(
                    self._update_message(grid, rows[[0, -1]], columns[[0, -1]], snapshot[4])
                )

    def _grid_message(self, grid: np.ndarray, frame: Frame2d, stamp_ns: int) -> Any:
        from nav_msgs.msg import OccupancyGrid

        message = OccupancyGrid()
        message.header.stamp = to_stamp(stamp_ns)
        message.header.frame_id = self.mapper.frame_id
        message.info.map_load_time = message.header.stamp
        message.info.resolution = frame.cell_m
        message.info.width, message.info.height = frame.width, frame.height
        message.info.origin.position.x, message.info.origin.position.y = frame.origin
        message.info.origin.orientation.w = 1.0
        message.data = grid.reshape(-1).tolist()
        return message

    def _update_message(
        self, grid: np.ndarray, rows: np.ndarray, columns: np.ndarray, stamp_ns: int
    ) -> Any:
        from map_msgs.msg import OccupancyGridUpdate

        message = OccupancyGridUpdate()
        message.header.stamp = to_stamp(stamp_ns)
        message.header.frame_id = self.mapper.frame_id
        part = grid[rows[0] : rows[1] + 1, columns[0] : columns[1] + 1]
        message.x, message.y = int(columns[0]), int(rows[0])
        message.height, message.width = part.shape
        message.data = part.reshape(-1).tolist()
        return message

    def _publish_cloud(self) -> None:
        if not self._clouds.get_num_connections():
            return
        snapshot = self._snapshot()
        if snapshot is None:
            return
        records, config, labels, _, stamp_ns = snapshot
        label, confidence = labels_and_confidences(records, config)
        fields = [(axis, "f4") for axis in "xyz"] + [("rgb", "f4"), ("confidence", "f4")]
        points = np.zeros(
            len(records),
            dtype=point_dtype(fields + [("observations", "u4"), ("label", "u1"), ("layer", "u1")]),
        )
        for column, axis in enumerate("xyz"):
            points[axis] = positions(records, config.voxel_size_m)[:, column]
        color = class_colors(labels, label).astype(np.uint32)
        points["rgb"] = (color[:, 0] << 16 | color[:, 1] << 8 | color[:, 2]).view(np.float32)
        points["confidence"], points["label"] = confidence, label
        points["observations"], points["layer"] = records["observations"], records["layer"]
        self._clouds.publish(from_array(points, stamp_ns, self.mapper.frame_id))

    def _publish_diagnostics(self) -> None:
        from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

        mapper = self.mapper
        now, cpu_s = time.monotonic(), time.process_time()
        elapsed = max(now - self._cpu_at, 1e-6)
        clouds = mapper.totals.clouds
        with mapper.lock:
            voxels = 0 if mapper.voxels is None else len(mapper.voxels)
            memory = 0 if mapper.voxels is None else mapper.voxels.memory_bytes
        values = {
            "input topic": mapper.topic,
            "clouds received": mapper.received,
            "clouds mapped": clouds - mapper.totals.without_pose,
            "clouds per second": "%.2f" % ((clouds - self._clouds_before) / elapsed),
            "voxels": voxels,
            "map memory (MB)": "%.1f" % (memory / 1048576.0),
            "processor share": "%.3f" % ((cpu_s - self._cpu_s) / elapsed),
            "compiled module": mapper.voxels.native if mapper.voxels is not None else "?",
            "last error": mapper.last_error or "none",
        }
        values.update(drop_values(mapper.drops))
        values.update({"points, " + k: n for k, n in mapper.totals.points.items()})
        stuck = mapper.received and clouds == mapper.totals.without_pose
        status = DiagnosticStatus(
            name=self._rospy.get_name().lstrip("/") + ": map",
            hardware_id="none",
            level=DiagnosticStatus.WARN if stuck else DiagnosticStatus.OK,
            message="no cloud could be mapped" if stuck else "mapping" if clouds else "waiting",
            values=[KeyValue(key, str(value)) for key, value in values.items()],
        )
        self._cpu_s, self._cpu_at, self._clouds_before = cpu_s, now, clouds
        message = DiagnosticArray()
        message.header.stamp = self._rospy.Time.now()
        message.status = [status]
        self._diagnostics.publish(message)

    def _save(self, request: Any) -> Any:
        from std_srvs.srv import TriggerResponse

        del request
        folder = os.path.join(
            os.path.expanduser(self.settings["save_folder"]),
            time.strftime("semantic_map_%Y%m%d_%H%M%S"),
        )
        try:
            with self.mapper.lock:
                header, voxels = self.mapper.header(), self.mapper.voxels
                records = None if voxels is None else voxels.records(in_order=False)
                totals = self.mapper.totals
            if header is None or records is None or not len(records):
                return TriggerResponse(False, "the map is empty")
            with OutputFolder(folder, False) as output:
                accumulator = Accumulator(header, output.partial, 1 << 62)
                accumulator.add(records)
                accumulator.write(os.path.join(output.partial, MAP_FILE))
                costs = Costs.from_file(self._costs_file, header.labels)
                facts = {"clouds": totals.clouds, "points": dict(totals.points)}
                title = "%s, frame %s" % (self.mapper.topic, header.frame_id)
                export_map(output.partial, self.settings.save_formats, costs, title, facts)
        except SemanticLidarFusionError as error:
            self._rospy.logerr(str(error))
            return TriggerResponse(False, str(error))
        return TriggerResponse(True, folder)

    def _clear(self, request: Any) -> Any:
        from std_srvs.srv import TriggerResponse

        del request
        self.mapper.clear()
        return TriggerResponse(True, "")
