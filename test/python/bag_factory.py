# SPDX-License-Identifier: MIT
"""Small bags of a drive through a room of exactly known truth.

The room is convex (four walls and a ground), so nothing in it hides anything else. A vehicle drives
through it at constant twist; every lidar point is cast from the sensor's pose at the point's own
time, every image from the camera's pose at its stamp. Class of a surface point: `class_of`.

Frames: odom <- base_link (tf, moving), base_link <- velodyne, base_link <- <camera> (tf_static).
Lengths in m, angles in rad, times in s or, where the name says so, integer ns.
"""
import dataclasses
import struct
from typing import Dict, List, Optional, Tuple

import genpy
import genpy.dynamic
import numpy as np
import rosbag
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2, PointField
from tf2_msgs.msg import TFMessage

START_NS = 1546300800 * 10**9
CLASS_NAMES = ("road", "wall", "door", "sky")
CLASS_COLORS = ((128, 64, 128), (70, 70, 70), (220, 20, 60), (70, 130, 180))
ROOM_X, ROOM_Y, GROUND_Z = 20.0, 12.0, -1.7
CEILING_Z = 30.0
DOOR_WIDTH = 6.0

VELODYNE_SCAN = """Header header
VelodynePacket[] packets

================================================================================
MSG: std_msgs/Header
uint32 seq
time stamp
string frame_id

================================================================================
MSG: velodyne_msgs/VelodynePacket
time stamp
uint8[1206] data
"""
VLP16_ELEVATION_DEG = (-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15)
FIRING_NS, LASER_NS, BLOCK_NS, PACKET_NS = 55296, 2304, 110592, 1327104


def matrix(x: float, y: float, z: float, rotation: np.ndarray) -> np.ndarray:
    """4x4 transform."""
    result = np.eye(4)
    result[:3, :3] = rotation
    result[:3, 3] = (x, y, z)
    return result


def yaw(angle: float) -> np.ndarray:
    """3x3 rotation about z."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


# x right, y down, z forward, from x forward, y left, z up
OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


@dataclasses.dataclass
class Camera:
    """An equidistant camera on the vehicle."""

    name: str
    heading: float  # yaw of the optical axis from the vehicle's x
    position: Tuple[float, float, float]
    phase_ns: int = 0  # of its stamps against START_NS
    period_ns: int = 50_000_000
    width: int = 240
    height: int = 180
    focal: float = 82.0
    score_step: int = 2  # image pixels per score cell
    clock_ahead_ns: int = 0  # its stamps are later than the truth by this

    def pose(self) -> np.ndarray:
        """T_vehicle_camera."""
        return matrix(*self.position, yaw(self.heading) @ OPTICAL)

    def project(self, points: np.ndarray) -> Tuple[np.ndarray, np.ndarray]:
        """Pixels (n, 2) and angles from the axis (n,) of points (n, 3) in the camera's frame."""
        radius = np.hypot(points[:, 0], points[:, 1])
        theta = np.arctan2(radius, points[:, 2])
        scale = self.focal * theta / np.maximum(radius, 1e-12)
        centre = ((self.width - 1) / 2.0, (self.height - 1) / 2.0)
        return points[:, :2] * scale[:, None] + centre, theta

    def rays(self) -> np.ndarray:
        """Unit rays (height, width, 3) of the pixel centres."""
        u, v = np.meshgrid(np.arange(self.width), np.arange(self.height))
        x = (u - (self.width - 1) / 2.0) / self.focal
        y = (v - (self.height - 1) / 2.0) / self.focal
        theta = np.hypot(x, y)
        scale = np.sinc(theta / np.pi)  # sin(theta) / theta
        return np.stack([x * scale, y * scale, np.cos(theta)], axis=-1)


def default_cameras() -> List[Camera]:
    """One ahead, one to the left, with stamps of different phase."""
    return [
        Camera("front", 0.0, (1.5, 0.1, 0.2)),
        Camera("left", np.pi / 2, (0.8, 0.6, 0.1), phase_ns=7_000_000),
    ]


@dataclasses.dataclass
class Drive:
    """What is driven and what is recorded. Times of `without_*` lists are indices of scans."""

    scans: int = 3
    lidar: str = "points"  # or "packets"
    cameras: List[Camera] = dataclasses.field(default_factory=default_cameras)
    speed: float = 8.0
    yaw_rate: float = 0.5
    origin: Tuple[float, float] = (0.0, 0.0)  # of the room in the fixed frame
    points_per_scan: int = 4000
    rings: int = 16
    scan_ns: int = 100_000_000
    elevations_deg: Tuple[float, float] = (-15.0, 15.0)  # of the first and the last ring; points
    image_transport: str = "raw"  # or "compressed" (PNG), "jpeg"
    semantics: str = "scores"  # or "labels", "probabilities", "none"
    odometry: str = "tf"  # or "topic", "none"
    odometry_until_s: Optional[float] = None  # no odometry later than this
    with_static_tf: bool = True
    camera_info_for: Optional[List[str]] = None  # names; all if None
    images_for: Optional[List[str]] = None
    images_until_s: Optional[float] = None  # no image later than this
    empty_scans: Tuple[int, ...] = ()
    compression: str = "none"
    seed: int = 1

    @property
    def lidar_pose(self) -> np.ndarray:
        """T_vehicle_lidar."""
        return matrix(1.0, 0.0, 0.5, yaw(0.05))

    def poses(self, t: np.ndarray) -> np.ndarray:
        """T_fixed_vehicle (n, 4, 4) at t (n,) s after START_NS; constant twist, near the middle."""
        w = self.yaw_rate if self.yaw_rate else 1e-12
        result = np.tile(np.eye(4), (len(t), 1, 1))
        c, s = np.cos(w * t), np.sin(w * t)
        result[:, 0, 0], result[:, 0, 1], result[:, 1, 0], result[:, 1, 1] = c, -s, s, c
        result[:, 0, 3] = self.origin[0] - 4.0 + self.speed * s / w
        result[:, 1, 3] = self.origin[1] - 1.0 + self.speed * (1 - c) / w
        return result

    def pose(self, t: float) -> np.ndarray:
        """T_fixed_vehicle at t s after START_NS."""
        return self.poses(np.array([t]))[0]

    def scan_start_ns(self, index: int) -> int:
        """Time of the first point of a scan."""
        return START_NS + 100_000_000 + index * self.scan_ns

    @property
    def end_s(self) -> float:
        return 0.3 + 1e-9 * self.scan_ns * self.scans

    # -- the room

    def cast(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Distance (n,) along unit directions (n, 3) from origins (n, 3) in the fixed frame."""
        o = origins - np.array([self.origin[0], self.origin[1], 0.0])
        with np.errstate(divide="ignore"):
            candidates = [
                (np.where(directions[:, 0] > 0, ROOM_X, -ROOM_X) - o[:, 0]) / directions[:, 0],
                (np.where(directions[:, 1] > 0, ROOM_Y, -ROOM_Y) - o[:, 1]) / directions[:, 1],
                (np.where(directions[:, 2] > 0, CEILING_Z, GROUND_Z) - o[:, 2]) / directions[:, 2],
            ]
        return np.min(candidates, axis=0)

    def class_of(self, points: np.ndarray) -> np.ndarray:
        """Class ids (n,) of surface points (n, 3) in the fixed frame."""
        p = points - np.array([self.origin[0], self.origin[1], 0.0])
        gaps = np.stack(
            [
                np.abs(p[:, 2] - GROUND_Z),
                np.minimum(np.abs(np.abs(p[:, 0]) - ROOM_X), np.abs(np.abs(p[:, 1]) - ROOM_Y)),
                np.abs(p[:, 2] - CEILING_Z),
            ]
        )
        ids = np.array([0, 1, 3])[np.argmin(gaps, axis=0)]
        on_side = np.abs(np.abs(p[:, 1]) - ROOM_Y) < np.abs(np.abs(p[:, 0]) - ROOM_X)
        along = np.where(on_side, p[:, 0], p[:, 1])
        return np.where((ids == 1) & (np.abs(along) < DOOR_WIDTH / 2), 2, ids)

    def surface_gap(self, points: np.ndarray) -> np.ndarray:
        """Distance (n,) of points (n, 3) in the fixed frame to the nearest surface."""
        p = points - np.array([self.origin[0], self.origin[1], 0.0])
        return np.min(
            [
                np.abs(np.abs(p[:, 0]) - ROOM_X),
                np.abs(np.abs(p[:, 1]) - ROOM_Y),
                np.abs(p[:, 2] - GROUND_Z),
                np.abs(p[:, 2] - CEILING_Z),
            ],
            axis=0,
        )

    def label_image(self, camera: Camera, t: float) -> np.ndarray:
        """Class ids (height, width) that the camera sees at time t."""
        T = self.pose(t) @ camera.pose()
        rays = camera.rays().reshape(-1, 3) @ T[:3, :3].T
        origins = np.broadcast_to(T[:3, 3], rays.shape)
        hits = origins + rays * self.cast(origins, rays)[:, None]
        return self.class_of(hits).reshape(camera.height, camera.width).astype(np.uint8)

    def image_stamps_ns(self, camera: Camera) -> List[int]:
        last = int((self.end_s if self.images_until_s is None else self.images_until_s) * 1e9)
        return [START_NS + t for t in range(camera.phase_ns, last, camera.period_ns)]

    # -- lidar

    def cast_lidar(self, directions: np.ndarray, times: np.ndarray) -> np.ndarray:
        """Ranges (n,) of unit directions (n, 3) in the lidar's frame, each at its own time (n,)."""
        poses = self.poses(times) @ self.lidar_pose
        world = np.einsum("nij,nj->ni", poses[:, :3, :3], directions)
        return self.cast(poses[:, :3, 3], world)

    def scan_points(self, index: int) -> Tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Points (n, 3) as measured, ring (n,) and time after the first point in ns (n,)."""
        columns = self.points_per_scan // self.rings
        column = np.repeat(np.arange(columns), self.rings)
        ring = np.tile(np.arange(self.rings), columns)
        time_ns = column * (self.scan_ns // columns)
        azimuth = -2 * np.pi * column / columns
        elevation = np.deg2rad(np.linspace(*self.elevations_deg, self.rings))[ring]
        directions = np.stack(
            [
                np.cos(elevation) * np.cos(azimuth),
                np.cos(elevation) * np.sin(azimuth),
                np.sin(elevation),
            ],
            axis=-1,
        )
        start = (self.scan_start_ns(index) - START_NS) * 1e-9
        ranges = self.cast_lidar(directions, start + time_ns * 1e-9)
        return directions * ranges[:, None], ring, time_ns

    def scan_packets(self, index: int, count: int = 75) -> List[Tuple[int, bytes]]:
        """(stamp in ns, 1206 bytes) of each VLP-16 packet of a scan."""
        result = []
        for k in range(count):
            stamp = self.scan_start_ns(index) + k * PACKET_NS
            block, firing, laser = np.meshgrid(
                np.arange(12), np.arange(2), np.arange(16), indexing="ij"
            )
            offset = block * BLOCK_NS + firing * FIRING_NS + laser * LASER_NS
            after_start = (stamp - self.scan_start_ns(index)) + offset
            # The begin of each block is told in 0.01 deg; between blocks azimuth is linear.
            azimuth_deg = 3600.0 * after_start.ravel() * 1e-9
            azimuth = np.deg2rad(azimuth_deg)
            elevation = np.deg2rad(np.array(VLP16_ELEVATION_DEG))[laser.ravel()]
            directions = np.stack(
                [
                    np.cos(elevation) * np.cos(azimuth),
                    -np.cos(elevation) * np.sin(azimuth),
                    np.sin(elevation),
                ],
                axis=-1,
            )
            times = (stamp - START_NS + offset.ravel()) * 1e-9
            ranges = self.cast_lidar(directions, times)
            raw = np.round(ranges / 0.002).astype(np.int64).reshape(12, 32)
            raw[raw > 65535] = 0
            data = b""
            for b in range(12):
                begin = 3600.0 * ((stamp - self.scan_start_ns(index)) + b * BLOCK_NS) * 1e-9
                data += struct.pack("<HH", 0xEEFF, int(round(begin * 100)) % 36000)
                data += b"".join(struct.pack("<HB", d, 10) for d in raw[b])
            data += struct.pack("<IBB", (stamp // 1000) % 3600000000, 0x37, 0x22)
            result.append((stamp, data))
        return result


def stamp(time_ns: int) -> genpy.Time:
    """ROS time of integer ns."""
    return genpy.Time(time_ns // 10**9, time_ns % 10**9)


def quaternion(rotation: np.ndarray) -> Tuple[float, float, float, float]:
    """(x, y, z, w)."""
    from scipy.spatial.transform import Rotation

    return tuple(Rotation.from_matrix(rotation).as_quat())


def transform_message(parent: str, child: str, time_ns: int, T: np.ndarray) -> TransformStamped:
    message = TransformStamped()
    message.header.frame_id = parent
    message.header.stamp = stamp(time_ns)
    message.child_frame_id = child
    t, q = message.transform.translation, message.transform.rotation
    t.x, t.y, t.z = T[:3, 3]
    q.x, q.y, q.z, q.w = quaternion(T[:3, :3])
    return message


def image_message(pixels: np.ndarray, encoding: str, time_ns: int, frame: str) -> Image:
    message = Image()
    message.header.stamp = stamp(time_ns)
    message.header.frame_id = frame
    message.height, message.width = pixels.shape[:2]
    message.encoding = encoding
    message.step = pixels.nbytes // pixels.shape[0]
    message.data = np.ascontiguousarray(pixels).tobytes()
    return message


def camera_info_message(camera: Camera, time_ns: int) -> CameraInfo:
    message = CameraInfo()
    message.header.stamp = stamp(time_ns)
    message.header.frame_id = camera.name
    message.width, message.height = camera.width, camera.height
    message.distortion_model = "equidistant"
    message.D = [0.0] * 4
    cx, cy = (camera.width - 1) / 2.0, (camera.height - 1) / 2.0
    message.K = [camera.focal, 0, cx, 0, camera.focal, cy, 0, 0, 1]
    message.R = [1, 0, 0, 0, 1, 0, 0, 0, 1]
    message.P = [camera.focal, 0, cx, 0, 0, camera.focal, cy, 0, 0, 0, 1, 0]
    return message


def cloud_message(points: np.ndarray, ring: np.ndarray, time_ns: np.ndarray, at_ns: int):
    """PointCloud2 with x y z intensity f32, ring u16, t u32 (ns after the stamp)."""
    dtype = np.dtype(
        {
            "names": ["x", "y", "z", "intensity", "ring", "t"],
            "formats": ["<f4", "<f4", "<f4", "<f4", "<u2", "<u4"],
            "offsets": [0, 4, 8, 12, 16, 20],
            "itemsize": 24,
        }
    )
    data = np.zeros(len(points), dtype)
    if len(points):
        data["x"], data["y"], data["z"] = points.T
        data["intensity"], data["ring"], data["t"] = 10.0, ring, time_ns
    message = PointCloud2()
    message.header.stamp = stamp(at_ns)
    message.header.frame_id = "velodyne"
    kinds = {"<f4": PointField.FLOAT32, "<u2": PointField.UINT16, "<u4": PointField.UINT32}
    for name in dtype.names:
        field, offset = dtype.fields[name][:2]
        message.fields.append(PointField(name, offset, kinds[field.str], 1))
    message.height, message.width = 1, len(points)
    message.point_step, message.row_step = dtype.itemsize, dtype.itemsize * len(points)
    message.is_dense = True
    message.data = data.tobytes()
    return message


def velodyne_types() -> Dict[str, type]:
    """velodyne_msgs' Python classes without the package."""
    return genpy.dynamic.generate_dynamic("velodyne_msgs/VelodyneScan", VELODYNE_SCAN)


def scores_of(labels: np.ndarray, classes: int = len(CLASS_NAMES)) -> np.ndarray:
    """Unnormalised scores (rows, columns, classes) f32 whose argmax is the label."""
    scores = np.zeros(labels.shape + (classes,), np.float32)
    np.put_along_axis(scores, labels[..., None].astype(np.int64), 4.0, axis=-1)
    return scores


def write_bag(path: str, drive: Drive) -> None:
    """Writes the drive; record times equal stamps. The same drive gives the same messages."""
    random = np.random.RandomState(drive.seed)
    messages = []  # (time in ns, topic, message)
    last_ns = START_NS + int(drive.end_s * 1e9)

    if drive.with_static_tf:
        static = [transform_message("base_link", "velodyne", START_NS, drive.lidar_pose)]
        for camera in drive.cameras:
            static.append(transform_message("base_link", camera.name, START_NS, camera.pose()))
        messages.append((START_NS, "/tf_static", TFMessage(static)))

    if drive.odometry != "none":
        until_s = drive.end_s if drive.odometry_until_s is None else drive.odometry_until_s
        for time_ns in range(START_NS, last_ns, 10_000_000):
            t = (time_ns - START_NS) * 1e-9
            if t > until_s:
                break
            moving = transform_message("odom", "base_link", time_ns, drive.pose(t))
            if drive.odometry == "tf":
                messages.append((time_ns, "/tf", TFMessage([moving])))
            else:
                odometry = Odometry()
                odometry.header, odometry.child_frame_id = moving.header, "base_link"
                position, orientation = moving.transform.translation, moving.transform.rotation
                odometry.pose.pose.position.x = position.x
                odometry.pose.pose.position.y = position.y
                odometry.pose.pose.position.z = position.z
                odometry.pose.pose.orientation = orientation
                messages.append((time_ns, "/odom", odometry))

    for camera in drive.cameras:
        wanted = drive.images_for is None or camera.name in drive.images_for
        for number, time_ns in enumerate(drive.image_stamps_ns(camera)):
            if number == 0 and (
                drive.camera_info_for is None or camera.name in drive.camera_info_for
            ):
                topic = "/%s/camera_info" % camera.name
                messages.append((time_ns, topic, camera_info_message(camera, time_ns)))
            if not wanted:
                continue
            labels = drive.label_image(camera, (time_ns - START_NS) * 1e-9)
            time_ns += camera.clock_ahead_ns
            noise = random.randint(-6, 7, labels.shape + (3,))
            colors = np.array(CLASS_COLORS)[labels][..., ::-1]  # BGR
            pixels = np.clip(colors + noise, 0, 255).astype(np.uint8)
            if drive.image_transport != "raw":
                import cv2

                compressed = CompressedImage()
                compressed.header.stamp = stamp(time_ns)
                compressed.header.frame_id = camera.name
                kind = "jpeg" if drive.image_transport == "jpeg" else "png"
                compressed.format = "bgr8; %s compressed bgr8" % kind
                compressed.data = cv2.imencode("." + kind, pixels)[1].tobytes()
                messages.append((time_ns, "/%s/image/compressed" % camera.name, compressed))
            else:
                image = image_message(pixels, "bgr8", time_ns, camera.name)
                messages.append((time_ns, "/%s/image" % camera.name, image))
            step = camera.score_step
            cells = labels[step // 2 :: step, step // 2 :: step]
            if drive.semantics == "scores":
                encoding = "32FC%d" % len(CLASS_NAMES)
                scores = image_message(scores_of(cells), encoding, time_ns, camera.name)
                messages.append((time_ns, "/%s/scores" % camera.name, scores))
            elif drive.semantics == "labels":
                ids = image_message(cells, "mono8", time_ns, camera.name)
                messages.append((time_ns, "/%s/labels" % camera.name, ids))
            elif drive.semantics == "probabilities":
                p = scores_of(cells) / 4.0
                encoding = "32FC%d" % len(CLASS_NAMES)
                p_message = image_message(p, encoding, time_ns, camera.name)
                messages.append((time_ns, "/%s/probabilities" % camera.name, p_message))

    scan_type = velodyne_types() if drive.lidar == "packets" else {}
    for index in range(drive.scans):
        at_ns = drive.scan_start_ns(index)
        if drive.lidar == "packets":
            scan = scan_type["velodyne_msgs/VelodyneScan"]()
            scan.header.frame_id = "velodyne"
            packets = [] if index in drive.empty_scans else drive.scan_packets(index)
            for time_ns, data in packets:
                packet = scan_type["velodyne_msgs/VelodynePacket"]()
                packet.stamp, packet.data = stamp(time_ns), data
                scan.packets.append(packet)
            # As the driver does: the header tells the last packet.
            scan.header.stamp = stamp(packets[-1][0] if packets else at_ns)
            messages.append((at_ns + drive.scan_ns, "/velodyne_packets", scan))
        else:
            points, ring, time_ns = drive.scan_points(index)
            if index in drive.empty_scans:
                points, ring, time_ns = points[:0], ring[:0], time_ns[:0]
            cloud = cloud_message(points, ring, time_ns, at_ns)
            messages.append((at_ns + drive.scan_ns, "/points", cloud))

    messages.sort(key=lambda m: m[0])
    with rosbag.Bag(path, "w", compression=drive.compression) as bag:
        for time_ns, topic, message in messages:
            header = latching_header(topic, message) if topic == "/tf_static" else None
            bag.write(topic, message, stamp(time_ns), connection_header=header)


def latching_header(topic: str, message) -> Dict[str, str]:
    """Of a connection whose last message comes to late listeners too, as recorders note it."""
    return {
        "topic": topic,
        "type": message._type,
        "md5sum": message._md5sum,
        "message_definition": message._full_text,
        "callerid": "/bag_factory",
        "latching": "1",
    }


def rig_text(drive: Drive, extra: str = "") -> str:
    """The rig file of a drive; `extra` is appended."""
    lines = ["name: room", "classes:", "  classes:"]
    for name, color in zip(CLASS_NAMES, CLASS_COLORS):
        lines.append("    - {name: %s, color: [%d, %d, %d]}" % ((name,) + tuple(color)))
    lines.append("cameras:" if drive.cameras else "cameras: []")
    for camera in drive.cameras:
        lines.append("  - name: %s" % camera.name)
        lines.append("    namespace: /%s" % camera.name)
        if camera.clock_ahead_ns:
            lines.append("    time_offset: %.9f" % (-1e-9 * camera.clock_ahead_ns))
        if drive.image_transport != "raw":
            lines.append("    transport: compressed")
        if drive.semantics in ("labels", "probabilities"):
            lines.append("    input: %s" % drive.semantics)
    lines.append("lidar: {input: %s}" % drive.lidar)
    if drive.odometry == "topic":
        lines.append("odometry: {source: topic}")
    lines.append("superpixels: {count: 200}")
    return "\n".join(lines) + "\n" + extra


def read_cloud(message) -> np.ndarray:
    """Structured array of a PointCloud2 with the message's own offsets."""
    formats = {1: "<i1", 2: "<u1", 3: "<i2", 4: "<u2", 5: "<i4", 6: "<u4", 7: "<f4", 8: "<f8"}
    dtype = np.dtype(
        {
            "names": [f.name for f in message.fields],
            "formats": [formats[f.datatype] for f in message.fields],
            "offsets": [f.offset for f in message.fields],
            "itemsize": message.point_step,
        }
    )
    return np.frombuffer(message.data, dtype, message.width * message.height)
