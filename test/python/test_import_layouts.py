# SPDX-License-Identifier: MIT
"""import_dataset.py kitti360, nuscenes and acfr_calibration on made-up folders in their public
layouts, with all numbers known; the calibration folder also on real data."""

import json
import os
import subprocess

import numpy as np
import pytest
import yaml

pytest.importorskip("rosbag")
pytest.importorskip("cv2")
import dataset_factory as made  # noqa: E402
from command_line import assert_one_line  # noqa: E402
from test_import_dataset import Imported  # noqa: E402

from semantic_lidar_fusion.bags import bag_io, cloud_io, poses  # noqa: E402
from semantic_lidar_fusion.datasets import acfr_calibration, pcd  # noqa: E402
from semantic_lidar_fusion.errors import DataError  # noqa: E402
from semantic_lidar_fusion.labels import LabelSet, package_file  # noqa: E402

SCRIPT = "import_dataset.py"
DRIVE = "2013_05_28_drive_0000_sync"
MEI = """%YAML:1.0
---
model_type: MEI
camera_name: image_02
image_width: 64
image_height: 48
mirror_parameters:
   xi: 2.2134047507854890e+00
distortion_parameters:
   k1: 1.6798235660113681e-02
   k2: 1.6548773243373522e+00
   p1: 4.2223943394772046e-04
   p2: 4.2462134260997584e-04
projection_parameters:
   gamma1: 6.1e+01
   gamma2: 6.1e+01
   u0: 3.2e+01
   v0: 2.4e+01
"""
T_POSE_CAM0 = poses.make_transform(
    np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), [0.83, 0.12, 0.66]
)
T_VELO_CAM0 = np.linalg.inv(made.T_CAM0_VELO)
TIMES_MS = (100, 204, 307)


def imported(run_command, tmp_path, *arguments, wanted=("drive.bag", "drive.yaml")):
    folder = tmp_path / "out"
    folder.mkdir()
    code, out, err = run_command(SCRIPT, *arguments, folder / "drive.bag")
    assert code == 0, err
    assert sorted(os.listdir(folder)) == sorted(wanted)
    return Imported(str(folder / "drive.bag"), str(folder / "drive.yaml")), out, err


def kitti360(root, labels=False):
    root = str(root)
    calibration = os.path.join(root, "calibration")
    names = ("image_00", "image_01", "image_02", "image_03")
    made.write(
        os.path.join(calibration, "calib_cam_to_pose.txt"),
        "".join("%s: %s\n" % (name, made.numbers(T_POSE_CAM0[:3])) for name in names),
    )
    made.write(
        os.path.join(calibration, "calib_cam_to_velo.txt"), made.numbers(T_VELO_CAM0[:3]) + "\n"
    )
    made.write(
        os.path.join(calibration, "perspective.txt"),
        "calib_time: 28-May-2013\n"
        + "".join(
            "S_rect_{0}: 64 48\nR_rect_{0}: {1}\nP_rect_{0}: {2}\n".format(
                n, made.numbers(made.R_RECT), made.numbers(made.P_RECT * [1, 1, 1, 0])
            )
            for n in ("00", "01")
        ),
    )
    made.write(os.path.join(calibration, "image_02.yaml"), MEI)
    for name, data in (("image_00", "data_rect"), ("image_02", "data_rgb")):
        folder = os.path.join(root, "data_2d_raw", DRIVE, name)
        for n in range(3):
            made.write_image(os.path.join(folder, data, "%010d.png" % n))
        made.write(os.path.join(folder, "timestamps.txt"), made.stamps(TIMES_MS))
    velo = os.path.join(root, "data_3d_raw", DRIVE, "velodyne_points")
    for n in range(3):
        made.write_bytes(os.path.join(velo, "data", "%010d.bin" % n), made.POINTS.tobytes())
    made.write(os.path.join(velo, "timestamps.txt"), made.stamps(TIMES_MS))
    lines = []
    for n in range(3):
        pose = poses.make_transform(np.eye(3), [100.0 + n, 200.0, 10.0])
        lines.append("%d %s\n" % (n, made.numbers(pose[:3])))
    made.write(os.path.join(root, "data_poses", DRIVE, "poses.txt"), "".join(lines))
    if labels:
        ids = np.full((made.HEIGHT, made.WIDTH), 7, np.uint8)
        semantic = os.path.join(root, "data_2d_semantics", "train", DRIVE, "image_00", "semantic")
        made.write_image(os.path.join(semantic, "%010d.png" % 1), ids)
        t_pose_velo = T_POSE_CAM0 @ np.linalg.inv(T_VELO_CAM0)
        # The point straight ahead, measured when the scanner looks ahead, in frame 1.
        place = (
            poses.make_transform(np.eye(3), [101.0, 200.0, 10.0])
            @ t_pose_velo
            @ np.append(made.POINTS[0, :3], 1.0)
        )[:3]
        fields = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("semantic", "<i4")]
        vertex = np.zeros(1, dtype=fields)
        vertex["x"], vertex["y"], vertex["z"] = place
        vertex["semantic"] = 11
        header = "ply\nformat binary_little_endian 1.0\nelement vertex 1\n"
        header += "".join("property float %s\n" % axis for axis in "xyz")
        header += "property int semantic\nend_header\n"
        path = os.path.join(root, "data_3d_semantics", "train", DRIVE, "static")
        made.write_bytes(
            os.path.join(path, "0000000000_0000000250.ply"), header.encode() + vertex.tobytes()
        )
    return root


def test_kitti360_places_sensors_and_names_the_lens(run_command, tmp_path):
    root = kitti360(tmp_path / "KITTI-360", labels=True)
    drive, out, _ = imported(run_command, tmp_path, "kitti360", root)
    assert "3 scans" in out and "1 labelled points" in out
    names = [camera["name"] for camera in drive.rig["cameras"]]
    assert names == ["image_00", "image_02"]
    perspective, fisheye = drive.rig["cameras"]
    assert perspective["rectified"] and "lens" not in perspective
    assert os.path.basename(fisheye["lens"]["file"]) == "image_02.yaml"
    # The perspective pixel by the data set's own formula: P R_rect T_cam0_velo x.
    points = made.POINTS[:1, :3].astype(float)
    seen = drive.in_camera("/image_00/camera_info", "/velodyne_points", points)[0]
    rect = np.eye(4)
    rect[:3, :3] = made.R_RECT
    wanted = (rect @ made.T_CAM0_VELO @ np.append(points[0], 1.0))[:3]
    assert seen == pytest.approx(wanted, abs=1e-9)
    # The fisheye's frame is not rectified.
    seen = drive.in_camera("/image_02/camera_info", "/velodyne_points", points)[0]
    assert seen == pytest.approx((made.T_CAM0_VELO @ np.append(points[0], 1.0))[:3], abs=1e-9)
    truth = drive.cloud("/points_truth", 1)
    labels = LabelSet.from_file(package_file("config/classes_cityscapes.yaml"))
    assert truth["label"].tolist() == [labels.id_of("building")] + [255] * 7
    times = drive.cloud("/velodyne_points")["t"]
    # Straight ahead at the stamp of the data set, half a sweep after the scan's own.
    assert int(times[0]) == pytest.approx(103_600_000 // 2, abs=10_000)
    pose, valid = drive.tree.lookup(
        "odom", "base_link", np.array(drive.stamps("/image_00/camera_info"))
    )
    assert valid.all() and pose[:, 0, 3] == pytest.approx([100.0, 101.0, 102.0])


def test_kitti360_leaves_gaps_out(run_command, tmp_path):
    root = kitti360(tmp_path / "KITTI-360")
    os.remove(os.path.join(root, "data_3d_raw", DRIVE, "velodyne_points", "data", "%010d.bin" % 1))
    drive, out, err = imported(run_command, tmp_path, "kitti360", root)
    assert "2 scans" in out
    assert "1 frames are left out" in err and "number 1" in err


@pytest.mark.parametrize(
    "arguments, text",
    [
        (("--drive", "0009"), "no drive 0009"),
        (("--cameras", "image_07"), "image_07: must be of"),
        (("--first", "5"), "no scan among the chosen frames"),
    ],
)
def test_kitti360_refuses_in_one_line(run_command, tmp_path, arguments, text):
    root = kitti360(tmp_path / "KITTI-360")
    code, _, err = run_command(SCRIPT, "kitti360", root, tmp_path / "a.bag", *arguments)
    assert_one_line(code, err, text)


def nuscenes(root):
    """Two keyframes and a sweep, two cameras; the ego moves 1 m along x in 50 ms and turns."""
    root = str(root)
    start = 1532402927647951  # us
    sensors = {"LIDAR_TOP": "lidar", "CAM_FRONT": "camera", "CAM_BACK": "camera"}
    quaternions = {  # w x y z
        "LIDAR_TOP": [0.70710678, 0, 0, -0.70710678],
        "CAM_FRONT": [0.5, -0.5, 0.5, -0.5],
        "CAM_BACK": [0.5, -0.5, -0.5, 0.5],
    }
    tables = {
        "scene": [{"token": "s1", "name": "scene-0061"}, {"token": "s2", "name": "scene-0103"}],
        "sample": [
            {"token": "k1", "scene_token": "s1"},
            {"token": "k2", "scene_token": "s1"},
            {"token": "other", "scene_token": "s2"},
        ],
        "sensor": [{"token": "S" + c, "channel": c, "modality": m} for c, m in sensors.items()],
        "calibrated_sensor": [
            {
                "token": "C" + c,
                "sensor_token": "S" + c,
                "translation": [0.9, 0.1, 1.8] if m == "lidar" else [1.7, 0.0, 1.5],
                "rotation": quaternions[c],
                "camera_intrinsic": []
                if m == "lidar"
                else [[60.0, 0, 32.0], [0, 60.0, 24.0], [0, 0, 1]],
            }
            for c, m in sensors.items()
        ],
        "sample_data": [],
        "ego_pose": [],
        "category": [{"token": "a", "name": "vehicle.car", "index": 17}],
        "lidarseg": [],
    }
    for k, (sample, key) in enumerate((("k1", True), ("k1", False), ("k2", True))):
        for channel, kind in sensors.items():
            if kind == "camera" and not key:
                continue
            token = "%s%d" % (channel, k)
            folder = "samples" if key else "sweeps"
            ending = ".pcd.bin" if kind == "lidar" else ".jpg"
            name = "%s/%s/%s%s" % (folder, channel, token, ending)
            us = start + 50000 * k + (0 if kind == "lidar" else 12000)
            tables["sample_data"].append(
                {
                    "token": token,
                    "sample_token": sample,
                    "ego_pose_token": "E" + token,
                    "calibrated_sensor_token": "C" + channel,
                    "timestamp": us,
                    "filename": name,
                    "is_key_frame": key,
                }
            )
            tables["ego_pose"].append(
                {
                    "token": "E" + token,
                    "timestamp": us,
                    "translation": [400.0 + (us - start) / 50000.0, 1100.0, 0.0],
                    "rotation": [1.0, 0.0, 0.0, 0.0],
                }
            )
            path = os.path.join(root, name)
            if kind == "camera":
                made.write_image(path)
                continue
            values = np.array(
                [[0, 10, -1, 7, 3], [5, 0, 0, 9, 20], [0, 0, 0, 0, 0]], dtype="<f4"
            )  # the last one: no return
            made.write_bytes(path, values.tobytes())
            if key:
                seg = "lidarseg/v1.0-mini/%s_lidarseg.bin" % token
                made.write_bytes(os.path.join(root, seg), bytes([17, 0, 0]))
                tables["lidarseg"].append({"sample_data_token": token, "filename": seg})
    for name, rows in tables.items():
        made.write(os.path.join(root, "v1.0-mini", name + ".json"), json.dumps(rows))
    return root, start


def test_nuscenes_scene(run_command, tmp_path):
    root, start = nuscenes(tmp_path / "nuscenes")
    drive, out, _ = imported(run_command, tmp_path, "nuscenes", root)
    assert "3 scans (6 points), 4 images" in out and "2 labelled points" in out
    assert [c["name"] for c in drive.rig["cameras"]] == ["cam_front", "cam_back"]
    assert drive.rig["motion"]["enabled"]
    assert drive.stamps("/lidar_top/points")[0] == start * 1000
    cloud = drive.cloud("/lidar_top/points")
    assert cloud["ring"].tolist() == [3, 20] and cloud["intensity"].tolist() == [7.0, 9.0]
    assert "t" not in cloud.dtype.names
    # The lidar's y looks ahead: 10 m ahead of it lies 10 + 0.9 - 1.7 m before the front camera.
    seen = drive.in_camera("/cam_front/camera_info", "/lidar_top/points", np.array([[0.0, 10, -1]]))
    assert seen[0] == pytest.approx([-0.1, 0.7, 9.2], abs=1e-6)
    pose, valid = drive.tree.lookup("odom", "base_link", np.array([start * 1000 + 25_000_000]))
    assert valid.all() and pose[0, :2, 3] == pytest.approx([400.5, 1100.0], abs=1e-6)
    labels = LabelSet.from_file(package_file("config/classes_cityscapes.yaml"))
    assert drive.cloud("/points_truth")["label"].tolist() == [labels.id_of("car"), 255]


def test_nuscenes_partial_download_and_other_scene(run_command, tmp_path):
    root, _ = nuscenes(tmp_path / "nuscenes")
    os.remove(os.path.join(root, "sweeps", "LIDAR_TOP", "LIDAR_TOP1.pcd.bin"))
    drive, out, err = imported(run_command, tmp_path, "nuscenes", root)
    assert "2 scans" in out and "1 frames are left out" in err and "LIDAR_TOP1" in err
    code, _, err = run_command(SCRIPT, "nuscenes", root, tmp_path / "b.bag", "--scene", "scene-9")
    assert_one_line(code, err, "no scene scene-9", "scene-0061")
    code, _, err = run_command(
        SCRIPT, "nuscenes", root, tmp_path / "b.bag", "--scene", "scene-0103"
    )
    assert_one_line(code, err)


@pytest.mark.parametrize(
    "table, text, words",
    [
        ("sensor", "{", "not JSON"),
        ("sample_data", "{}", "must be a list of mappings"),
        ("ego_pose", "[]", "no row with token"),
    ],
)
def test_nuscenes_damaged_tables(run_command, tmp_path, table, text, words):
    root, _ = nuscenes(tmp_path / "nuscenes")
    made.write(os.path.join(root, "v1.0-mini", table + ".json"), text)
    code, _, err = run_command(SCRIPT, "nuscenes", root, tmp_path / "b.bag")
    assert_one_line(code, err, words)


RUNS = "roll,pitch,yaw,x,y,z\n-1.57,0.0,-1.58,0.06,-0.02,-0.20\n-1.57,0.0,-1.56,0.04,0.0,-0.22\n"


def calibration(root, data="ascii"):
    root = str(root)
    for n in (1, 2):
        made.write_image(os.path.join(root, "images", "pose%d.png" % n))
        header = (
            "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z intensity ring\nSIZE 4 4 4 4 2\n"
            "TYPE F F F F U\nCOUNT 1 1 1 1 1\nWIDTH 3\nHEIGHT 1\nPOINTS 3\nDATA %s\n" % data
        )
        points = [(2.0, 0.1, 0.0, 5.0, 3), (4.0, -1.0, 0.5, 6.0, 9), (0.0, 0.0, 0.0, 0.0, 0)]
        if data == "ascii":
            body = "".join(" ".join(map(str, point)) + "\n" for point in points).encode()
        else:
            kinds = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("i", "<f4"), ("r", "<u2")]
            body = np.array(points, dtype=kinds).tobytes()
        path = os.path.join(root, "pcd", "pose%d_full.pcd" % n)
        made.write_bytes(path, header.encode() + body)
    made.write(os.path.join(root, "calibration_quickstart.csv"), RUNS)
    made.write(
        os.path.join(root, "camera_info.yaml"),
        'distortion_model: "fisheye"\nwidth: 64\nheight: 48\nD: [-0.05,-0.08,0.09,-0.05]\n'
        "K: [40.0,0.0,32.0,0.0,40.0,24.0,0.0,0.0,1]\n",
    )
    return root


@pytest.mark.parametrize("data", ["ascii", "binary"])
def test_calibration_folder(run_command, tmp_path, data):
    root = calibration(tmp_path / "vlp", data)
    drive, out, _ = imported(run_command, tmp_path, "acfr_calibration", root)
    assert "2 scans (4 points), 2 images" in out
    assert not drive.rig["motion"]["enabled"]
    info = drive.messages["/camera/camera_info"][0]
    assert info.distortion_model == "equidistant" and list(info.D) == [-0.05, -0.08, 0.09, -0.05]
    assert drive.cloud("/velodyne_points")["ring"].tolist() == [3, 9]
    # The mean run: the camera looks along the lidar's x, at (0.05, -0.01, -0.21).
    seen = drive.in_camera("/camera/camera_info", "/velodyne_points", np.array([[2.0, 0.1, 0.0]]))
    assert seen[0] == pytest.approx([-0.11, -0.21, 1.95], abs=0.01)
    assert drive.stamps("/velodyne_points") == drive.stamps("/camera/camera_info")


@pytest.mark.parametrize(
    "path, text, words",
    [
        ("camera_info.yaml", "distortion_model: tangential\n", "must be one of"),
        ("calibration_quickstart.csv", "roll,pitch,yaw,x,y,z\n", "no calibration run"),
        ("pcd/pose1_full.pcd", "hello", "not a PCD file"),
    ],
)
def test_calibration_folder_refuses_in_one_line(run_command, tmp_path, path, text, words):
    root = calibration(tmp_path / "vlp")
    made.write(os.path.join(root, path), text)
    code, _, err = run_command(SCRIPT, "acfr_calibration", root, tmp_path / "a.bag")
    assert_one_line(code, err, words)
    assert not (tmp_path / "a.bag").exists()


def test_compressed_clouds_are_refused_with_the_cure(tmp_path):
    path = str(tmp_path / "a.pcd")
    header = "FIELDS x\nSIZE 4\nTYPE F\nCOUNT 1\nPOINTS 1\nDATA binary_compressed\n"
    made.write_bytes(path, header.encode() + b"\0" * 16)
    with pytest.raises(DataError, match="pcl_convert_pcd_ascii_binary"):
        pcd.read(path)


def test_real_calibration_poses(run_command, tmp_path, optional_data):
    folder = optional_data("data/acfr_a0_vlp16")
    drive, out, _ = imported(run_command, tmp_path, "acfr_calibration", folder)
    assert "8 scans" in out and "8 images" in out
    runs = acfr_calibration.read_runs(os.path.join(folder, "extrinsic_runs.csv"))
    assert runs.shape == (50, 6)
    assert yaml.safe_dump(drive.rig)
    with np.load(os.path.join(folder, "pose10.npz")) as pose:
        centre_lidar, centre_camera = pose["board_centre_lidar_m"], pose["board_centre_camera_m"]
    seen = drive.in_camera("/camera/camera_info", "/velodyne_points", centre_lidar[None])[0]
    # Within three of the calibration's own standard deviations of 4 to 30 mm.
    assert np.linalg.norm(seen - centre_camera) < 0.09


def test_real_board_through_fuse_bag(run_command, tmp_path, optional_data):
    """The paper's camera and lidar: the board's labels, drawn from its corners, on its points."""
    folder = optional_data("data/acfr_a0_vlp16")
    drive, out, _ = imported(
        run_command, tmp_path, "acfr_calibration", folder, "--scores", "onehot", "--score-stride", 4
    )
    assert "8 score images" in out and "193601 labelled points" in out
    board = [c["name"] for c in drive.rig["classes"]["classes"]].index("sign")
    truth = np.concatenate(
        [m["label"] for m in map(cloud_io.to_array, drive.messages["/points_truth"])]
    )
    f1 = {}
    for mode in ("off", "adaptive"):
        fused = tmp_path / (mode + ".bag")
        program = os.path.join(os.environ["SLF_BIN_DIR"], "fuse_bag")
        command = [program, tmp_path / "out" / "drive.bag", fused, "--quiet"]
        command += ["--rig", tmp_path / "out" / "drive.yaml", "--set", "occlusion.mode=" + mode]
        subprocess.run([str(part) for part in command], check=True, timeout=100)
        with bag_io.BagReader(str(fused)) as bag:
            messages = [entry.message for entry in bag.read(["/points_semantic"])]
        cloud = np.concatenate([cloud_io.to_array(m) for m in messages])
        assert len(cloud) == len(truth)
        labelled = cloud["status"] == 0
        # No pixel beyond the fold-over at 68.44 deg: without the guard a quarter are ghosts.
        p = drive.in_camera("/camera/camera_info", "/velodyne_points", cloud_io.xyz(cloud))
        theta = np.degrees(np.arctan2(np.hypot(p[:, 0], p[:, 1]), p[:, 2]))
        assert theta[labelled].max() < 68.44
        hits = (labelled & (truth == board) & (cloud["label"] == board)).sum()
        taken = (labelled & (cloud["label"] == board)).sum()
        # Board points that the mask removed are misses, too.
        f1[mode] = 2 * hits / (taken + ((truth == board) & (cloud["status"] <= 1)).sum())
    # The data's README gives 0.851 and 0.952.
    assert f1["off"] == pytest.approx(0.851, abs=0.01)
    assert f1["adaptive"] > 0.945
