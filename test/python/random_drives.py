# SPDX-License-Identifier: MIT
"""Seeded drives without sense: every model, option and order of messages that the rig file knows.

Points, scores and images are random; what fuse_bag has to make of them says reference_fusion.
"""
import dataclasses
import math
import os
import struct
from typing import Any, Dict, List, Optional, Tuple

import cv2
import numpy as np
import rosbag
import yaml
from bag_factory import OPTICAL, image_message, stamp, transform_message, velodyne_types, yaw
from nav_msgs.msg import Odometry as OdometryMessage
from reference_fusion import LIDARS, Odometry, Scan, decode_packets, within_limits
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, PointCloud2, PointField
from tf2_msgs.msg import TFMessage

SECOND, MS = 10**9, 10**6
CLASSES = ["road", "wall", "car", "sky", "p_x"]
SCANS = 3
TIME_KINDS = [
    "u4",
    "f4 s",
    "f4 ms",
    "f4 us",
    "f4 back",
    "f8 s",
    "f8 after",
    "f8 ns",
    "u8",
    "u8 after",
]


@dataclasses.dataclass
class RandomCamera:
    """`semantics`: scores, labels or probabilities by raw stamp."""

    config: Dict[str, Any]
    info: CameraInfo
    T_vehicle_camera: np.ndarray
    has_info: bool
    mask: Optional[np.ndarray] = None
    semantics: Dict[int, np.ndarray] = dataclasses.field(default_factory=dict)

    @property
    def name(self) -> str:
        return self.config["name"]

    @property
    def offset_ns(self) -> int:
        return round(self.config["time_offset"] * 1e9)


class RandomDrive:
    """Makes rig and messages of a seed; `write` puts them into a folder."""

    def __init__(self, seed: int, folder: str):
        self.random = np.random.RandomState(seed)
        self.folder = folder
        self.start_ns = 1_600_000_000 * SECOND + int(self.random.randint(SECOND))
        self.messages: List[Tuple[int, str, Any]] = []  # record time, topic, message
        self.static: List[Any] = []
        self.rig = self._rig()
        self.odometry, self.T_vehicle_lidar = self._odometry()
        self.cameras = [self._camera(name) for name in self._camera_names()]
        self.rig["cameras"] = [camera.config for camera in self.cameras]
        if self._chance(0.5):
            self.rig["reference"]["camera"] = self.cameras[-1].name
        self.scans = [self._scan(index) for index in range(SCANS)]
        # Static transforms are read first, wherever they stand.
        at = self.start_ns + (5 if self._chance(0.5) else -3) * SECOND
        self.messages.append((at, "/tf_static", TFMessage(self.static)))

    def write(self) -> Tuple[str, str]:
        """Paths of bag and rig file."""
        bag_path = os.path.join(self.folder, "in.bag")
        rig_path = os.path.join(self.folder, "rig.yaml")
        with open(rig_path, "w") as file:
            yaml.safe_dump(self.rig, file)
        with rosbag.Bag(bag_path, "w") as bag:
            for time_ns, topic, message in sorted(self.messages, key=lambda m: m[0]):
                bag.write(topic, message, stamp(time_ns))
        return bag_path, rig_path

    def _chance(self, probability: float) -> bool:
        return bool(self.random.rand() < probability)

    def _pick(self, *values: Any) -> Any:
        return values[self.random.randint(len(values))]

    def _uniform(self, low: float, high: float) -> float:
        return round(float(self.random.uniform(low, high)), 4)

    def _camera_names(self) -> List[str]:
        return [str(n) for n in self.random.permutation(["a", "B", "c1", "Z9"])][
            : self._pick(1, 2, 3, 4)
        ]

    def _rig(self) -> Dict[str, Any]:
        colors = self.random.randint(0, 256, (len(CLASSES), 3))
        classes = [{"name": n, "color": [int(c) for c in rgb]} for n, rgb in zip(CLASSES, colors)]
        lidar: Dict[str, Any] = {
            "input": self._pick("packets", "points"),
            "time_offset": self._pick(0.0, 0.0123456, -0.05),
            "min_range_m": self._pick(0.0, 0.0, 4.0),
            "max_range_m": self._pick(0.0, 0.0, 18.0),
        }
        self.model = self._pick(*LIDARS)
        if lidar["input"] == "packets":
            lidar["packet_stamp"] = self._pick("start", "middle", "end")
            if self._chance(0.4):
                lasers = len(LIDARS[self.model].elevation_deg)
                lidar["vertical_offsets_m"] = [self._uniform(-0.05, 0.05) for _ in range(lasers)]
            if self._chance(0.3):
                lidar["model"] = self.model  # the packets tell another
        occlusion = {"mode": self._pick("off", "paper", "paper")}
        occlusion["vertical_step_deg"] = self._pick(1.0, 2.0, 4.0)
        occlusion["horizontal_step_deg"] = self._pick(0.1, 0.5, 1.0)
        superpixels: Dict[str, Any] = {"count": int(self.random.randint(20, 80))}
        if self._chance(0.5):
            superpixels["scale"] = self._pick(0.25, 0.3, 0.5, 0.77, 1.0, 1.5)
        return {
            "classes": {"classes": classes},
            "lidar": lidar,
            "motion": {
                "enabled": self._chance(0.85),
                "granularity": self._pick("firing", "packet"),
            },
            "odometry": {
                "source": self._pick("tf", "topic"),
                "time_offset": self._pick(0.0, 0.013, -0.021),
                "lookup": self._pick("interpolate", "interpolate", "closest"),
                "on_missing": self._pick("mark", "mark", "drop", "hold"),
            },
            "reference": {
                "choose": self._pick(
                    "closest_image", "closest_image", "scan_start", "scan_middle", "scan_end"
                )
            },
            "image_choice": self._pick("closest_to_reference", "closest_to_sweep"),
            "superpixels": superpixels,
            "uncertainty": {
                "temperature": self._pick(1.0, self._uniform(0.5, 3)),
                "exponent": self._pick(2.0, 0.0, 1.0, 3.5),
            },
            "occlusion": occlusion,
            "overlap": self._pick(
                "mean", "product", "nearest_in_time", "most_central", "geometric_mean"
            ),
            "keep_unlabelled": self._chance(0.85),
        }

    def _odometry(self) -> Tuple[Odometry, np.ndarray]:
        origin = self._pick(np.zeros(3), np.array([331275.0, 6250099.0, 40.0]))
        speed, turn = self.random.uniform(-15, 15), self.random.uniform(-0.6, 0.6)
        sway = self.random.uniform(-0.05, 0.05, 2)

        def pose(t_ns: int) -> np.ndarray:
            t = (t_ns - self.start_ns) * 1e-9
            angles = [sway[0] * math.sin(7 * t), sway[1] * math.cos(5 * t), turn * t]
            T = np.eye(4)
            T[:3, :3] = Rotation.from_rotvec(angles).as_matrix()
            T[:3, 3] = origin + [speed * t, 2 * math.sin(t), 0.1 * math.sin(9 * t)]
            return T

        begin, end = self.start_ns - SECOND, self.start_ns + SECOND * (SCANS + 13) // 10
        gap = self.random.rand()
        if gap < 0.15:
            end = self.start_ns + 270 * MS  # within the last scan
        elif gap < 0.3:
            begin = self.start_ns + 130 * MS
        times = [t + int(self.random.randint(3 * MS)) for t in range(begin, end, 10 * MS)]
        odometry = Odometry(times, [pose(t) for t in times])

        T_vehicle_lidar, T_vehicle_imu = np.eye(4), np.eye(4)
        angles = [0.02, -0.03, self.random.uniform(-3, 3)]
        T_vehicle_lidar[:3, :3] = Rotation.from_euler("xyz", angles).as_matrix()
        T_vehicle_lidar[:3, 3] = [1.1, 0.1, 1.6]
        T_vehicle_imu[:3, :3], T_vehicle_imu[:3, 3] = yaw(0.4), [0.3, -0.2, 0.5]
        self.static.append(transform_message("base_link", "mount", 0, T_vehicle_lidar))
        self.static.append(transform_message("mount", "velodyne", 0, np.eye(4)))
        self.static.append(transform_message("base_link", "imu", 0, T_vehicle_imu))
        offset_ns = round(self.rig["odometry"]["time_offset"] * 1e9)
        of_imu = self._chance(0.5)
        for t, T in zip(times, odometry.poses):
            raw = t - offset_ns
            if self.rig["odometry"]["source"] == "tf":
                moving = transform_message("odom", "base_link", raw, T)
                self.messages.append((raw, "/tf", TFMessage([moving])))
                continue
            child, T = ("imu", T @ T_vehicle_imu) if of_imu else ("base_link", T)
            moving = transform_message("odom", child, raw, T)
            message = OdometryMessage(header=moving.header, child_frame_id=child)
            message.pose.pose.orientation = moving.transform.rotation
            for axis in "xyz":
                value = getattr(moving.transform.translation, axis)
                setattr(message.pose.pose.position, axis, value)
            self.messages.append((raw, "/odom", message))
        return odometry, T_vehicle_lidar

    # -- cameras

    def _info(self, frame: str) -> CameraInfo:
        info = CameraInfo()
        info.header.frame_id = frame
        info.header.stamp = stamp(12345)  # never compared
        width, height = (int(n) for n in self.random.randint([120, 90], [300, 200]))
        info.width, info.height = width, height
        fy = self._uniform(0.3, 0.7) * width
        fx = fy * self._uniform(0.9, 1.1)
        cx, cy = width / 2 + self._uniform(-9, 9), height / 2 + self._uniform(-9, 9)
        skew = self._pick(0.0, 0.04 * fx)  # for the fisheye only
        info.distortion_model = self._pick(
            "equidistant", "fisheye", "plumb_bob", "rational_polynomial", ""
        )
        size = {"plumb_bob": 5, "rational_polynomial": 8, "": 0}.get(info.distortion_model, 4)
        widest = {
            4: [0.03, 0.015, 0.006, 0.003],
            5: [0.4, 0.2, 0.004, 0.004, 0.05],
            8: [1.0, 0.5, 0.002, 0.003, 0.1, 1.0, 0.5, 0.1],
            0: [],
        }[size]
        info.D = [self._uniform(-w, w) for w in widest]
        info.K = [fx, skew, cx, 0, fy, cy, 0, 0, 1]
        info.R = [1, 0, 0, 0, 1, 0, 0, 0, 1]
        baseline = self._uniform(-60, 60), self._uniform(-9, 9)
        info.P = [1.1 * fx, 0, cx + 3, baseline[0], 0, 0.95 * fy, cy - 2, baseline[1], 0, 0, 1, 0]
        if self._chance(0.4):
            info.binning_x, info.binning_y = self._pick(0, 1, 2, 3), self._pick(0, 1, 2)
        if self._chance(0.4):
            info.roi.x_offset, info.roi.y_offset = self._pick(0, 7, 30), self._pick(0, 9, 20)
            info.roi.width = int(self.random.randint(60, width - 30))
            info.roi.height = int(self.random.randint(50, height - 20))
        return info

    def _camera(self, name: str) -> RandomCamera:
        config: Dict[str, Any] = {
            "name": name,
            "namespace": "/drivers/" + name,
            "rectified": self._chance(0.3),
            "max_theta_deg": self._pick(0.0, 0.0, self._uniform(20, 100)),
            "time_offset": self._pick(0.0, 0.0, 0.02, -0.033),
            "max_time_difference": self._pick(0.05, 0.05, 0.02, 0.008),
            "input": self._pick("scores", "scores", "scores", "labels", "probabilities"),
            "score_scale": self._pick(1.0, 0.02, -0.005),
            "score_offset": self._uniform(-3, 3),
        }
        T_vehicle_camera = np.eye(4)
        T_vehicle_camera[:3, :3] = yaw(self.random.uniform(-3, 3)) @ OPTICAL
        T_vehicle_camera[:3, 3] = self.random.uniform(-1, 1, 3) + [0, 0, 1]
        frame = "camera_" + name
        self.static.append(transform_message("base_link", frame, 0, T_vehicle_camera))
        camera = RandomCamera(config, self._info(frame), T_vehicle_camera, self._chance(0.95))
        if camera.has_info:
            at = self.start_ns + int(self.random.randint(-SECOND, SECOND))
            self.messages.append((at, "%s/camera_info" % config["namespace"], camera.info))
        info = camera.info
        width = (info.roi.width or info.width) // max(1, info.binning_x)
        height = (info.roi.height or info.height) // max(1, info.binning_y)
        if self._chance(0.35):
            size = tuple(int(n) for n in self.random.randint(5, [2 * width, 2 * height]))
            coarse = self.random.rand(6, 7).astype(np.float32)
            camera.mask = np.where(cv2.resize(coarse, size) < 0.35, 0, 255).astype(np.uint8)
            config["mask"] = "mask_%s.png" % name
            cv2.imwrite(os.path.join(self.folder, config["mask"]), camera.mask)
        self._images(camera, width, height)
        return camera

    def _images(self, camera: RandomCamera, width: int, height: int) -> None:
        random, namespace = self.random, camera.config["namespace"]
        depth = self._pick("f4", "f4", "u2", "u1")
        cell_columns, cell_rows = (int(n) for n in random.randint(8, [width + 20, height + 20]))
        period = self._pick(20 * MS, 33_333_333, 100 * MS)
        falls_silent = self._chance(0.1)
        image = random.randint(0, 256, (height, width, 3)).astype(np.uint8)
        image = cv2.GaussianBlur(image, (0, 0), 5)
        begin = self.start_ns - 300 * MS + int(random.randint(period))
        for time_ns in range(begin, self.start_ns + (SCANS * 100 + 400) * MS, period):
            raw = time_ns - camera.offset_ns
            shifted = np.roll(image, int(random.randint(50)), axis=1)
            self.messages.append(
                (raw, namespace + "/image", image_message(shifted, "bgr8", raw, ""))
            )
            # Some images never get scores.
            if (falls_silent and time_ns > self.start_ns) or self._chance(0.1):
                continue
            pixels, encoding = self._semantics(
                camera.config["input"], depth, cell_columns, cell_rows
            )
            topic = "%s/%s" % (namespace, camera.config["input"])
            self.messages.append((raw + 1000, topic, image_message(pixels, encoding, raw, "")))
            camera.semantics[raw] = pixels

    def _semantics(self, kind: str, depth: str, columns: int, rows: int) -> Tuple[np.ndarray, str]:
        random, n = self.random, len(CLASSES)
        patches = random.randint(0, n, (rows // 6 + 1, columns // 6 + 1)).astype(np.uint8)
        labels = cv2.resize(patches, (columns, rows), interpolation=cv2.INTER_NEAREST)
        if kind == "labels":
            labels[random.rand(rows, columns) < 0.05] = 200  # no class of the set
            return labels, "mono8"
        scores = random.normal(0, 1, (rows, columns, n)) + 3 * (labels[..., None] == np.arange(n))
        if kind == "probabilities":
            p = np.exp(scores)
            return (p / p.sum(axis=-1, keepdims=True)).astype(np.float32), "32FC%d" % n
        if depth == "u1":
            return np.clip((scores + 5) * 20, 0, 255).astype(np.uint8), "8UC%d" % n
        if depth == "u2":
            return np.clip((scores + 5) * 1000, 0, 65535).astype(np.uint16), "16UC%d" % n
        scores = scores.astype(np.float32)
        if self._chance(0.5):
            scores = np.round(scores)  # ties
        if self._chance(0.3):
            scores *= 1000
        broken = random.rand(rows, columns) < 0.02
        scores[broken, random.randint(n)] = self._pick(np.nan, np.inf, -np.inf)
        return scores, "32FC%d" % n

    # -- lidar

    def _scan(self, index: int) -> Scan:
        begin = self.start_ns + index * 100 * MS + int(self.random.randint(1000))
        raw = begin - round(self.rig["lidar"]["time_offset"] * 1e9)
        return (
            self._packets(raw, begin)
            if self.rig["lidar"]["input"] == "packets"
            else self._points(raw)
        )

    def _packets(self, raw_begin: int, begin: int) -> Scan:
        lidar, random, types = LIDARS[self.model], self.random, velodyne_types()
        dual = self._chance(0.4)
        slot_ns = lidar.firings_per_block * lidar.firing_ns
        packets = []
        factory = 0x99 if "model" in self.rig["lidar"] else lidar.factory
        turned = random.uniform(0, 36000)
        for number in range(12):  # four groups of three within 0.1 s
            at = number // 3 * 25 * MS + number % 3 * (6 if dual else 12) * slot_ns
            data = b""
            for slot in range(6 if dual else 12):
                azimuth = int(turned + (at + slot * slot_ns) * 36e-5) % 36000
                returns = random.randint(0, 12000, (2, 32)), random.randint(0, 256, (2, 32))
                returns[0][0][random.rand(32) < 0.1] = 0
                same = random.rand(2, 32) < 0.7
                for array, equal in zip(returns, same):
                    array[1] = np.where(equal, array[0], array[1])
                for which in range(2 if dual else 1):
                    data += struct.pack("<HH", 0xEEFF, azimuth)
                    for d, i in zip(returns[0][which], returns[1][which]):
                        data += struct.pack("<HB", int(d), int(i))
            mode = 0x39 if dual else self._pick(0x37, 0x38)
            packets.append((raw_begin + at, data + struct.pack("<IBB", 0, mode, factory)))
        message = types["velodyne_msgs/VelodyneScan"]()
        message.header.frame_id = self._pick("velodyne", "/velodyne")
        message.header.stamp = stamp(begin + 77 * SECOND)  # never used as a time
        order = list(random.permutation(12)) if self._chance(0.5) else list(range(12))
        for number in order + ([3] if self._chance(0.5) else []):
            packet = types["velodyne_msgs/VelodynePacket"]()
            packet.stamp, packet.data = stamp(packets[number][0]), packets[number][1]
            message.packets.append(packet)
        self.messages.append((begin + 100 * MS, "/velodyne_packets", message))
        return decode_packets(packets, self.model, self.rig["lidar"])

    def _point_times(
        self, kind: str, header: int, after: np.ndarray
    ) -> Tuple[np.ndarray, np.ndarray]:
        """Values of the time field and the raw times that they mean."""
        if kind == "u4":
            return after.astype("<u4"), header + after
        if kind.startswith("f4"):
            per = {"s": 1e-9, "ms": 1e-6, "us": 1e-3, "back": 1e-9}[kind[3:]]
            shown = after - 100 * MS if kind == "f4 back" else after
            values = (shown * per).astype("<f4")
            return values, header + np.round(values.astype(float) / per).astype(np.int64)
        if kind == "f8 s":
            values = header * 1e-9 + after * 1e-9
            whole = np.floor(values)
            rest = np.round((values - whole) * 1e9).astype(np.int64)
            return values, whole.astype(np.int64) * SECOND + rest
        if kind == "f8 after":
            return after * 1e-9, header + after
        if kind == "f8 ns":
            values = (header + after).astype(float)
            return values, values.astype(np.int64)
        return ((header if kind == "u8" else 0) + after).astype("<u8"), header + after

    def _points(self, header: int) -> Scan:
        random, count = self.random, 1500
        directions = random.normal(0, 1, (count, 3)) * [1, 1, 0.3]
        directions /= np.linalg.norm(directions, axis=1)[:, None]
        xyz = (directions * random.uniform(2, 25, (count, 1))).astype(np.float32)
        after = random.randint(0, 100 * MS, count)
        if self._chance(0.7):
            after = np.sort(after)
        values, raw = self._point_times(self._pick(*TIME_KINDS), header, after)
        columns = {"x": xyz[:, 0].copy(), "y": xyz[:, 1], "z": xyz[:, 2]}
        columns[self._pick("t", "time", "timestamp", "time_stamp", "offset_time")] = values
        intensity, ring = np.zeros(count), np.full(count, 65535)
        if self._chance(0.8):
            intensity = random.randint(0, 256, count)
            columns["intensity"] = intensity.astype(self._pick("<f4", "<u1", "<u2"))
        if self._chance(0.8):
            ring = random.randint(0, 16, count)
            columns["ring"] = ring.astype(self._pick("<u2", "<u1"))
        lost = random.rand(count) < 0.03
        columns["x"][lost] = np.nan

        codes = {"f4": 7, "f8": 8, "u4": 6, "u2": 4, "u1": 2, "u8": 6}  # u8: a pair of u4
        message = PointCloud2(height=self._pick(1, 2, 3), is_dense=False)
        message.width = count // message.height
        message.header.stamp, message.header.frame_id = stamp(header), "velodyne"
        for name in random.permutation(sorted(columns)):
            kind, size = columns[name].dtype.str[1:], columns[name].dtype.itemsize
            offset = message.point_step + random.randint(3)
            message.fields.append(PointField(str(name), offset, codes[kind], 1 + (kind == "u8")))
            message.point_step = offset + size
        padding = self._pick(0, 5)
        message.row_step = message.width * message.point_step + padding
        data = np.zeros((message.height, message.row_step), np.uint8)
        body = (
            data[:, : message.width * message.point_step].reshape(count, message.point_step).copy()
        )
        for field in message.fields:
            array = np.ascontiguousarray(columns[field.name])
            end = field.offset + array.dtype.itemsize
            body[:, field.offset : end] = array.view(np.uint8).reshape(count, -1)
        data[:, : message.width * message.point_step] = body.reshape(message.height, -1)
        message.data = data.tobytes()
        self.messages.append((header + 100 * MS, "/points", message))

        true = raw + round(self.rig["lidar"]["time_offset"] * 1e9)
        ranges = np.linalg.norm(xyz.astype(float), axis=1)
        kept = [i for i in np.flatnonzero(~lost) if within_limits(ranges[i], self.rig["lidar"])]
        xyz64 = xyz[kept].astype(float)
        begins = {int(t): int(t) for t in true[kept]}
        return Scan(xyz64, intensity[kept], ring[kept], true[kept], true[kept], true[kept], begins)
