# SPDX-License-Identifier: MIT
"""The live map node: a rolling window of the map as an occupancy grid and a coloured cloud.

Everything is published from one timer thread; the mapper's lock is held only while records are
copied. Parameters are read once; every wrong one is reported at once.
"""

import os
import tempfile
import threading
import time
from typing import Any, Dict, List, NamedTuple, Optional, Tuple

import numpy as np

from semantic_lidar_fusion.bags.bag_io import to_stamp
from semantic_lidar_fusion.bags.cloud_io import from_array, point_dtype
from semantic_lidar_fusion.errors import ConfigError, DataError, SemanticLidarFusionError
from semantic_lidar_fusion.installation import package_file
from semantic_lidar_fusion.labels import LabelSet
from semantic_lidar_fusion.maps import formats
from semantic_lidar_fusion.maps.formats import MAP_FILE
from semantic_lidar_fusion.maps.ground import GROUND_BAND_M, ground_surface, lowest_heights
from semantic_lidar_fusion.maps.live import LONGEST_TEXT, LiveMapper, drop_values, write_snapshot
from semantic_lidar_fusion.maps.map_file import MapHeader
from semantic_lidar_fusion.maps.output import OutputFolder, export_map
from semantic_lidar_fusion.maps.raster import Costs, Frame2d, flatten
from semantic_lidar_fusion.maps.reading import DYNAMIC, GONE, labels_and_confidences, layers_of
from semantic_lidar_fusion.maps.records import BRICK_BITS, heights, positions
from semantic_lidar_fusion.maps.semantic_map import MapConfig
from semantic_lidar_fusion.maps.source import class_colors
from semantic_lidar_fusion.texts import plain_text

_MAP_DEFAULTS = MapConfig()
SAVE_PREFIX = "semantic_map_"
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
    "ray_range_m": _MAP_DEFAULTS.ray_range_m,
    "footprint_m": _MAP_DEFAULTS.footprint_m,
    "dynamic": "apart",
    "window_m": 60.0,
    "grid_period_s": 1.0,
    "full_grid_period_s": 10.0,
    "cloud_period_s": 2.0,
    "tf_timeout_s": 0.5,
    "tf_cache_s": 10.0,
    "save_folder": "~",
    "save_formats": "ply,pcd,grid",
    "max_saves": 20.0,
    "memory_mb": 512.0,
    "disk_mb": 4096.0,
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
        for name in (
            "window_m",
            "grid_period_s",
            "full_grid_period_s",
            "cloud_period_s",
            "memory_mb",
        ):
            if not values[name] > 0:
                problems.append("~%s = %s: must be above 0" % (name, values[name]))
        for name in ("tf_timeout_s", "tf_cache_s", "max_saves", "disk_mb"):
            if not values[name] >= 0:
                problems.append("~%s = %s: must not be negative" % (name, values[name]))
        try:
            self.save_formats = formats.split(values["save_formats"])
        except ValueError as error:
            problems.append("~save_formats: %s" % error)
        self.values = values
        self.config = MapConfig(
            voxel_size_m=values["voxel_size_m"],
            kind=values["evidence"],
            weight=values["weight"],
            floor=values["floor"],
            clamp=values["clamp"],
            min_range_m=values["min_range_m"],
            max_range_m=values["max_range_m"],
            ray_range_m=values["ray_range_m"],
            footprint_m=values["footprint_m"],
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
        # In whole bricks, so that nothing is cut when it leaves.
        whole = 1 << BRICK_BITS
        self._half = max(1, int(np.ceil(half_width_m / cell_m / whole))) * whole
        self._step = max(1, self._half // 4 // whole) * whole
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


class Snapshot(NamedTuple):
    """The window at a moment: records, bricks, path and stamp (ns)."""

    records: np.ndarray
    bricks: np.ndarray
    path: np.ndarray
    header: MapHeader
    frame: Frame2d
    stamp_ns: int

    def ground(self) -> np.ndarray:
        """(height, width) float32."""
        f, size = self.frame, self.header.config.voxel_size_m
        lowest = lowest_heights(self.records, size, f.min_x, f.min_y, f.shape)
        return ground_surface(lowest, size)


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
        self._saving = threading.Lock()
        self._spilled = tempfile.TemporaryDirectory(prefix="semantic_map.")
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
            self._spilled.name,
            labels,
            self.settings["tf_timeout_s"],
            self.settings["tf_cache_s"],
            int(self.settings["memory_mb"]) << 20,
            int(self.settings["disk_mb"]) << 20,
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
        self._spilled.cleanup()

    def _on_cloud(self, cloud: Any, pose: np.ndarray) -> None:
        """With the mapper's lock held: the window follows the vehicle."""
        self._stamp_ns = cloud.stamp_ns
        if self._window.follow(pose[0, 3], pose[1, 3]):
            assert self.mapper.store is not None
            self.mapper.store.spill(self._window.bounds())

    def _snapshot(self) -> Optional[Snapshot]:
        with self.mapper.lock:
            store, frame = self.mapper.store, self._window.frame
            if store is None or frame is None:
                return None
            records = store.voxels.records(in_order=False)
            bricks = store.voxels.bricks(in_order=False)
            return Snapshot(records, bricks, store.path(), store.header, frame, self._stamp_ns)

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
                    self.mapper.warn(publish.__name__, str(error))
                except Exception as error:  # one bad moment must not end the publishing
                    if self._rospy.is_shutdown():
                        return
                    self.mapper.last_error = "%s: %s" % (type(error).__name__, error)
                    self.mapper.warn(publish.__name__, self.mapper.last_error)
        self._stopping.set()

    def compute_grid(self, snapshot: Snapshot) -> np.ndarray:
        """(height, width) int8 of a snapshot."""
        header, frame = snapshot.header, snapshot.frame
        if self._costs is None:
            self._costs = Costs.from_file(self._costs_file, header.labels)
        inside = frame.holds(snapshot.records)
        rasters = flatten(
            snapshot.records[inside],
            snapshot.bricks,
            frame,
            snapshot.ground(),
            snapshot.path,
            header.config,
            header.labels,
            self._costs,
        )
        return rasters.cost

    def _publish_grid(self) -> None:
        with self._publishing:
            snapshot = self._snapshot()
            if snapshot is None:
                return
            grid, frame = self.compute_grid(snapshot), snapshot.frame
            before, self._grid = self._grid, grid
            moved = frame != self._grid_frame
            now = time.monotonic()
            if moved or before is None or self._updates is None or now > self._full_at:
                if not moved and before is not None and np.array_equal(before, grid):
                    return
                self._grid_frame = frame
                self._full_at = now + self.settings["full_grid_period_s"]
                self._grids.publish(self._grid_message(grid, frame, snapshot.stamp_ns))
                return
            changed = before != grid
            rows, columns = np.flatnonzero(changed.any(axis=1)), np.flatnonzero(changed.any(axis=0))
            if len(rows):
                self._updates.publish(
                    self._update_message(grid, rows[[0, -1]], columns[[0, -1]], snapshot.stamp_ns)
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
        header, frame = snapshot.header, snapshot.frame
        config, labels = header.config, header.labels
        records = snapshot.records[frame.holds(snapshot.records)]
        label, confidence = labels_and_confidences(records, config, labels)
        ground = snapshot.ground().reshape(-1)[frame.cells(records)]
        is_ground = heights(records, config.voxel_size_m) - ground <= GROUND_BAND_M
        layer = layers_of(records, label, confidence, config, labels, is_ground)
        there = layer != GONE
        records, label, confidence, layer = (v[there] for v in (records, label, confidence, layer))
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
        points["observations"], points["layer"] = records["observations"], layer == DYNAMIC
        self._clouds.publish(from_array(points, snapshot.stamp_ns, self.mapper.frame_id))

    def _publish_diagnostics(self) -> None:
        from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

        mapper = self.mapper
        now, cpu_s = time.monotonic(), time.process_time()
        elapsed = max(now - self._cpu_at, 1e-6)
        clouds = mapper.totals.clouds
        with mapper.lock:
            store = mapper.store
            voxels = 0 if store is None else len(store.voxels)
            memory = 0 if store is None else store.voxels.memory_bytes
            disk = 0 if store is None else store.spilled_bytes
            forgotten = 0 if store is None else store.forgotten
        values = {
            "input topic": mapper.topic,
            "clouds received": mapper.received,
            "clouds mapped": clouds - mapper.totals.without_pose,
            "clouds per second": "%.2f" % ((clouds - self._clouds_before) / elapsed),
            "voxels": voxels,
            "map memory (MB)": "%.1f" % (memory / 1048576.0),
            "map on disk (MB)": "%.1f" % (disk / 1048576.0),
            "voxels forgotten for want of ~disk_mb": forgotten,
            "processor share": "%.3f" % ((cpu_s - self._cpu_s) / elapsed),
            "compiled module": store.voxels.native if store is not None else "?",
            "last error": plain_text(mapper.last_error or "none", LONGEST_TEXT),
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
        with self._saving:  # one after the other: each needs the memory of a map
            try:
                return self._save_now(TriggerResponse)
            except SemanticLidarFusionError as error:
                self._rospy.logerr(str(error))
                return TriggerResponse(False, str(error))
            except Exception as error:  # a caller gets an answer, whatever it is
                text = "%s: %s" % (type(error).__name__, error)
                self._rospy.logerr(text)
                return TriggerResponse(False, text)

    def _save_folder(self) -> str:
        """A new folder's name; DataError if there are ~max_saves already."""
        parent = os.path.expanduser(self.settings["save_folder"])
        try:
            saved = [name for name in os.listdir(parent) if name.startswith(SAVE_PREFIX)]
        except OSError as error:
            raise DataError("~save_folder %s: %s" % (parent, error.strerror or error)) from error
        if len(saved) >= int(self.settings["max_saves"]):
            raise DataError(
                "%s holds %d saved maps, as many as ~max_saves allows; remove some"
                % (parent, len(saved))
            )
        name = time.strftime(SAVE_PREFIX + "%Y%m%d_%H%M%S")
        number = 1
        while name in saved or os.path.lexists(os.path.join(parent, name)):
            number += 1
            name = time.strftime(SAVE_PREFIX + "%Y%m%d_%H%M%S") + "_%d" % number
        return os.path.join(parent, name)

    def _save_now(self, response: Any) -> Any:
        folder = self._save_folder()
        with self.mapper.lock:
            store, totals = self.mapper.store, self.mapper.totals
            snapshot = None if store is None else store.snapshot()
        if store is None or snapshot is None:
            return response(False, "the map is empty")
        header = store.header
        with OutputFolder(folder, False) as output:
            target = os.path.join(output.partial, MAP_FILE)
            if not write_snapshot(snapshot, header, output.partial, target):
                raise DataError("the map is empty")
            costs = Costs.from_file(self._costs_file, header.labels)
            facts = {"clouds": totals.clouds, "points": dict(totals.points)}
            title = "%s, frame %s" % (self.mapper.topic, header.frame_id)
            exported = export_map(output.partial, self.settings.save_formats, costs, title, facts)
        for name, reason in exported.failed.items():
            self._rospy.logwarn("%s is not written: %s", name, reason)
        return response(True, folder)

    def _clear(self, request: Any) -> Any:
        from std_srvs.srv import TriggerResponse

        del request
        self.mapper.clear()
        return TriggerResponse(True, "")
