# SPDX-License-Identifier: MIT
"""Made-up data sets in the public folder layouts, a few points each, with all numbers known.

Calibration of all KITTI-like ones: the lidar looks along x, the reference camera along z, with a
rectifying rotation of 2 deg about y and a lever arm, so that a wrong order or sign shows.
"""

import os
import struct

import numpy as np

START = "2011-09-26 13:02:25."
START_NS = 1317042145 * 10**9  # of 13:02:25 UTC on that day
# In ms within that second: sweeps that are not symmetric about straight ahead.
SWEEPS_MS = [(100, 140, 200), (200, 240, 300), (300, 340, 400)]
IMAGES_MS = [141, 242, 343]
WIDTH, HEIGHT = 64, 48

T_CAM0_VELO = np.array([[0, -1, 0, 0.01], [0, 0, -1, -0.08], [1, 0, 0, -0.27], [0, 0, 0, 1.0]])
_A = np.radians(2.0)
R_RECT = np.array([[np.cos(_A), 0, np.sin(_A)], [0, 1, 0], [-np.sin(_A), 0, np.cos(_A)]])
P_RECT = np.array([[700.0, 0, 30, 42], [0, 710.0, 20, 0.35], [0, 0, 1, 0.0027]])
K_RAW = np.array([[900.0, 0, 33], [0, 910.0, 25], [0, 0, 1]])
D_RAW = [-0.37, 0.2, 0.001, -0.002, -0.07]
R_RAW = R_RECT.T
T_RAW = np.array([0.06, -0.0003, 0.0027])
_B = np.radians(1.0)
T_VELO_IMU = np.array(
    [
        [np.cos(_B), -np.sin(_B), 0, -0.81],
        [np.sin(_B), np.cos(_B), 0, 0.32],
        [0, 0, 1, -0.8],
        [0, 0, 0, 1],
    ]
)
# Three lasers, the top one first, each once around to the left: ahead, left, behind, right.
POINTS = np.array(
    [
        [10.0, 0.001, 0.5, 0.1],
        [0.0, 10.0, 0.5, 0.2],
        [-10.0, 0.00001, 0.5, 0.3],
        [0.0, -10.0, 0.5, 0.4],
        [-8.0, -0.00001, -0.4, 0.5],
        [20.0, -0.002, -0.4, 0.6],
        [5.0, 5.0, -1.0, 0.7],
        [5.0, -5.0, -1.0, 0.8],
    ],
    dtype=np.float32,
)
RINGS = [2, 2, 2, 2, 1, 1, 0, 0]
# ms after the start of a sweep of 100 ms that looks ahead after 40 ms; clockwise from behind.
TIMES_MS = [40.0, 20.0, 0.0, 70.0, 100.0, 40.0, 30.0, 55.0]
OXTS_REST = " ".join(["0"] * 24)


def numbers(matrix):
    return " ".join("%.12e" % value for value in np.asarray(matrix).reshape(-1))


def write(path, text):
    os.makedirs(os.path.dirname(path), exist_ok=True)
    with open(path, "w") as file:
        file.write(text)


def write_bytes(path, data):
    os.makedirs(os.path.dirname(path), exist_ok=True)
    with open(path, "wb") as file:
        file.write(data)


def write_image(path, pixels=None):
    import cv2

    os.makedirs(os.path.dirname(path), exist_ok=True)
    if pixels is None:
        rows = np.arange(HEIGHT, dtype=np.uint8)[:, None, None]
        pixels = np.broadcast_to(rows * 5, (HEIGHT, WIDTH, 3))
    assert cv2.imwrite(path, pixels)


def stamps(ms):
    return "".join("%s%03d000123\n" % (START, value) for value in ms)


def kitti(root, unrectified=False, oxts_hz=10):
    """DATE/DATE_drive_0007_sync or _extract; returns the drive's folder."""
    date = os.path.join(str(root), "2011_09_26")
    drive = os.path.join(date, "2011_09_26_drive_0007_" + ("extract" if unrectified else "sync"))
    write(
        os.path.join(date, "calib_cam_to_cam.txt"),
        "calib_time: 09-Jan-2012 13:57:47\ncorner_dist: 9.950000e-02\n"
        + "".join(
            "S_{0}: 6.4e+01 4.8e+01\nK_{0}: {1}\nD_{0}: {2}\nR_{0}: {3}\nT_{0}: {4}\n"
            "R_rect_{0}: {5}\nP_rect_{0}: {6}\n".format(
                n,
                numbers(K_RAW),
                numbers(D_RAW),
                numbers(R_RAW),
                numbers(T_RAW * factor),
                numbers(R_RECT),
                numbers(P_RECT * [1, 1, 1, factor]),
            )
            for n, factor in (("00", 0.0), ("02", 1.0), ("03", -8.0))
        ),
    )
    for name, transform in (("velo_to_cam", T_CAM0_VELO), ("imu_to_velo", T_VELO_IMU)):
        write(
            os.path.join(date, "calib_%s.txt" % name),
            "calib_time: 15-Mar-2012 11:37:16\nR: %s\nT: %s\n"
            % (numbers(transform[:3, :3]), numbers(transform[:3, 3])),
        )
    for camera in ("image_02", "image_03"):
        write(os.path.join(drive, camera, "timestamps.txt"), stamps(IMAGES_MS) + "\n")
        for n in range(3):
            write_image(os.path.join(drive, camera, "data", "%010d.png" % n))
    for index, name in enumerate(("timestamps_start", "timestamps", "timestamps_end")):
        text = stamps([sweep[index] for sweep in SWEEPS_MS])
        write(os.path.join(drive, "velodyne_points", name + ".txt"), text)
    for n in range(3):
        path = os.path.join(drive, "velodyne_points", "data", "%010d" % n)
        if unrectified:
            write(path + ".txt", "\n".join(" ".join("%.9g" % v for v in p) for p in POINTS))
        else:
            write_bytes(path + ".bin", POINTS.astype("<f4").tobytes())
    times = range(100, 440, 1000 // oxts_hz)
    write(os.path.join(drive, "oxts", "timestamps.txt"), stamps(times))
    for n, _ in enumerate(times):
        # North at 1e-6 deg a reading, heading north.
        row = "%.10f %.10f %.3f 0.01 -0.02 %.12f %s\n" % (
            49.0 + n * 1e-6,
            8.4,
            112.0 + n,
            np.pi / 2,
            OXTS_REST,
        )
        write(os.path.join(drive, "oxts", "data", "%010d.txt" % n), row)
    return drive


def semantickitti(root):
    """sequences/04 with three scans; returns its folder."""
    folder = os.path.join(str(root), "dataset", "sequences", "04")
    write(
        os.path.join(folder, "calib.txt"),
        "".join("P%d: %s\n" % (i, numbers(P_RECT * [1, 1, 1, i])) for i in range(4))
        + "Tr: %s\n" % numbers(T_CAM0_VELO[:3]),
    )
    write(os.path.join(folder, "times.txt"), "0.000000e+00\n1.036460e-01\n2.073020e-01\n")
    poses = []
    for n in range(3):
        pose = np.eye(4)
        pose[2, 3] = 1.5 * n  # forward for the camera
        poses.append(numbers(pose[:3]))
    write(os.path.join(folder, "poses.txt"), "\n".join(poses) + "\n")
    for n in range(3):
        write_bytes(os.path.join(folder, "velodyne", "%06d.bin" % n), POINTS.tobytes())
        ids = np.array(SEMANTICKITTI_IDS, dtype=np.uint32) | (77 << 16)
        write_bytes(os.path.join(folder, "labels", "%06d.label" % n), ids.astype("<u4").tobytes())
        write_image(os.path.join(folder, "image_2", "%06d.png" % n))
    return folder


SEMANTICKITTI_IDS = [40, 252, 10, 254, 70, 99, 60, 7]
SEMANTICKITTI_NAMES = ["road", "car", "car", "person", "vegetation", "unlabeled", "road", None]

RELLIS_IMAGES_MS = [50, 150, 250]
RELLIS_SCANS_MS = [0, 100, 200]
RELLIS_K = [100.0, 110.0, 31.0, 23.0]
# The camera looks along the lidar's x, 0.2 m ahead of it and 0.1 m below.
RELLIS_T = np.array([[0, 0, 1, 0.2], [-1, 0, 0, 0.0], [0, -1, 0, -0.1], [0, 0, 0, 1.0]])
RELLIS_IDS = [3, 4, 0, 17, 33, 19, 23, 200]
RELLIS_NAMES = ["grass", "tree", "void", "person", "mud", "bush", "concrete", None]


def ply(points, labels):
    header = "ply\nformat binary_little_endian 1.0\ncomment made up\nelement vertex %d\n" % len(
        points
    )
    for kind, name in (
        ("float", "x"),
        ("float", "y"),
        ("float", "z"),
        ("float", "intensity"),
        ("uint", "t"),
        ("ushort", "reflectivity"),
        ("uchar", "ring"),
        ("uchar", "label"),
    ):
        header += "property %s %s\n" % (kind, name)
    data = header.encode() + b"end_header\n"
    for i, (point, label) in enumerate(zip(points, labels)):
        values = [float(value) for value in point]
        data += struct.pack("<ffffIHBB", *values, 1000 * i + 7, 3, RINGS_TOP_DOWN[i], label)
    return data


RINGS_TOP_DOWN = [0, 0, 0, 0, 1, 1, 2, 2, 2]


def rellis(root, with_ply=True):
    """Rellis-3D/00003 with three frames; returns its folder."""
    folder = os.path.join(str(root), "Rellis-3D", "00003")
    write(os.path.join(folder, "camera_info.txt"), " ".join("%f" % v for v in RELLIS_K) + "\n")
    # The rotation of RELLIS_T: (x, y, z, w) = (-1, 1, -1, 1) / 2.
    write(
        os.path.join(folder, "transforms.yaml"),
        "os1_cloud_node-pylon_camera_node:\n  q:\n    w: 0.5\n    x: -0.5\n    y: 0.5\n    z: -0.5\n"
        "  t:\n    x: 0.2\n    y: 0.0\n    z: -0.1\n",
    )
    pose = np.eye(4)
    write(
        os.path.join(folder, "poses.txt"),
        "".join(
            numbers((pose + [[0, 0, 0, n], [0] * 4, [0] * 4, [0] * 4])[:3]) + "\n" for n in range(3)
        ),
    )
    label_image = np.full((HEIGHT, WIDTH), 7, dtype=np.uint8)
    label_image[HEIGHT // 2 :] = 3
    label_image[:, :8] = 200
    points = np.vstack([POINTS, np.zeros((1, 4), dtype=np.float32)])  # and a return that is none
    for n in range(3):
        image = "frame%06d-1581624663_%03d" % (n, RELLIS_IMAGES_MS[n])
        write_image(os.path.join(folder, "pylon_camera_node", image + ".jpg"))
        if n != 1:
            write_image(
                os.path.join(folder, "pylon_camera_node_label_id", image + ".png"), label_image
            )
        if with_ply:
            write_bytes(
                os.path.join(
                    folder,
                    "os1_cloud_node_color_ply",
                    "frame%06d-1581624663_%03d.ply" % (n, RELLIS_SCANS_MS[n]),
                ),
                ply(points, RELLIS_IDS + [4]),
            )
        write_bytes(
            os.path.join(folder, "os1_cloud_node_kitti_bin", "%06d.bin" % n),
            points.astype("<f4").tobytes(),
        )
        write_bytes(
            os.path.join(folder, "os1_cloud_node_semantickitti_label_id", "%06d.label" % n),
            np.array(RELLIS_IDS + [4], dtype="<u4").tobytes(),
        )
    return folder
