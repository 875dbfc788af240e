# SPDX-License-Identifier: MIT
"""Real sensors through import_dataset.py and fuse_bag; skipped, saying so, without the data."""
import json
import os
import subprocess

import numpy as np
import pytest

from semantic_lidar_fusion.bags.bag_io import BagReader, BagWriter, message_class, to_stamp
from semantic_lidar_fusion.bags.cloud_io import SemanticCloud, to_array

SOURCE_DIR = os.path.abspath(os.path.join(os.path.dirname(__file__), "..", ".."))


def fuse(source, target, rig, *overrides):
    """Runs fuse_bag of this build; returns what it prints."""
    arguments = [str(source), str(target), "--rig", str(rig), "--quiet"]
    for override in overrides:
        arguments += ["--set", override]
    program = os.path.join(os.environ["SLF_BIN_DIR"], "fuse_bag")
    result = subprocess.run(
        [program] + arguments,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        universal_newlines=True,
        timeout=250,
    )
    assert result.returncode == 0, result.stdout
    return result.stdout


def messages(path, topic):
    with BagReader(str(path)) as bag:
        return [item.message for item in bag.read([topic])]


def semantic_clouds(path):
    return [SemanticCloud.from_message(message) for message in messages(path, "/points_semantic")]


def test_rellis_labels_agree_with_the_labels_of_the_points(optional_data, run_command, tmp_path):
    folder = optional_data("data/rellis3d_000104")
    bag, rig = tmp_path / "in.bag", tmp_path / "in.yaml"
    code, _, err = run_command(
        "import_dataset.py", "rellis", folder, bag, "--scores", "onehot", "--score-stride", 1
    )
    assert code in (0, None), err
    truth = to_array(messages(bag, "/points_truth")[0])["label"]
    agreement, fused = {}, {}
    for mode in ("off", "paper", "adaptive"):
        out = tmp_path / (mode + ".bag")
        fuse(bag, out, rig, "occlusion.mode=" + mode)
        (cloud,) = semantic_clouds(out)
        assert len(cloud) == len(truth) == 77708
        fused[mode] = int(cloud.fused.sum())
        agreement[mode] = float(np.mean(cloud.label[cloud.fused] == truth[cloud.fused]))
        np.testing.assert_allclose(cloud.probabilities[cloud.fused].sum(axis=1), 1.0, atol=1e-5)
    print("RELLIS agreement", agreement, "of", fused)
    # Direct transfer of the human image labels agrees on 77.3 % of the 7429 points in the image.
    assert fused["off"] == 7429
    assert agreement["off"] == pytest.approx(0.773, abs=0.001)
    for mode in ("paper", "adaptive"):
        assert 0.94 * fused["off"] < fused[mode] < fused["off"]
        assert agreement[mode] > agreement["off"] - 0.001


def test_packet_capture_becomes_compensated_clouds(optional_data, tmp_path):
    path = optional_data("data/vlp16_packets/nebula_vlp16_scans.npz")
    capture = np.load(path)
    scan_type = message_class("velodyne_msgs/VelodyneScan")
    packet_type = message_class("velodyne_msgs/VelodynePacket")
    bag, rig = tmp_path / "in.bag", tmp_path / "rig.yaml"
    with BagWriter(str(bag)) as writer:
        for number, scan_stamp in enumerate(capture["scan_stamp"]):
            scan = scan_type()
            scan.header.frame_id = "velodyne"
            scan.header.stamp = to_stamp(int(scan_stamp * 1e9))
            for index in np.nonzero(capture["scan"] == number)[0]:
                packet = packet_type()
                packet.stamp = to_stamp(int(capture["packet_stamp"][index] * 1e9))
                packet.data = capture["packets"][index].tobytes()
                scan.packets.append(packet)
            writer.write("/velodyne_packets", scan, int(scan_stamp * 1e9))
    rig.write_text(
        "classes: {classes: [{name: thing, color: [1, 2, 3]}]}\n"
        "lidar: {input: packets, topic: /velodyne_packets}\n"
        "motion: {enabled: false}\n"
    )
    fuse(bag, tmp_path / "out.bag", rig)
    clouds = [
        to_array(message) for message in messages(tmp_path / "out.bag", "/points_compensated")
    ]
    assert len(clouds) == 4
    for cloud in clouds:
        assert len(cloud) > 10000
        distance = np.linalg.norm([cloud["x"], cloud["y"], cloud["z"]], axis=0)
        # The sensor's rings: -15 to 15 degrees in steps of two, 0 = lowest.
        elevation = np.degrees(np.arcsin(cloud["z"] / distance))
        np.testing.assert_allclose(elevation, 2.0 * cloud["ring"] - 15.0, atol=0.01)
        assert np.all(np.diff(cloud["dt"].reshape(-1)[:: len(cloud) // 50]) >= 0)
        assert np.ptp(cloud["dt"]) < 0.11


def test_kitti_drive_with_a_network(optional_data, run_command, tmp_path):
    folder = optional_data("data/kitti_drive")
    network = optional_data("models/espnetv2_city20_1024x512.onnx")
    description = os.path.join(SOURCE_DIR, "config", "models", "espnetv2_city20.yaml")
    with open(description) as file:
        text = file.read()
    name = os.path.basename(network)
    assert "file: " + name in text
    model = tmp_path / "model.yaml"
    model.write_text(text.replace("file: " + name, "file: " + os.path.abspath(network)))
    bag, rig = tmp_path / "in.bag", tmp_path / "in.yaml"
    code, _, err = run_command(
        "import_dataset.py", "kitti", folder, bag, "--model", model, "--first", 9, "--last", 11
    )
    assert code in (0, None), err
    fuse(bag, tmp_path / "out.bag", rig)
    names = [
        entry["name"]
        for entry in json.loads(messages(tmp_path / "out.bag", "/class_info")[0].data)["classes"]
    ]
    clouds = semantic_clouds(tmp_path / "out.bag")
    assert len(clouds) == 3
    cloud = clouds[1]  # the others lack odometry at one end
    assert np.mean(cloud.status == 4) < 0.01
    assert cloud.fused.sum() > 12000
    label, height = cloud.label, cloud.xyz[:, 2]
    road = cloud.fused & (label == names.index("road"))
    vehicle = cloud.fused & np.isin(label, [names.index(n) for n in ("car", "truck", "bus")])
    assert road.sum() > 3000 and vehicle.sum() > 5000
    # The lidar stands 1.73 m above the road; vehicles reach up from there.
    assert abs(np.median(height[road]) + 1.73) < 0.15
    assert np.median(height[vehicle]) > np.median(height[road]) + 0.5
    assert np.percentile(height[road], 90) < -1.3


@pytest.mark.parametrize(
    "dataset, path, options",
    [
        ("kitti", "data/kitti_drive", ()),
        ("rellis", "data/rellis3d_000104", ("--scores", "onehot")),
        ("acfr_calibration", "data/acfr_a0_vlp16", ("--scores", "onehot")),
    ],
)
def test_check_rig_finds_nothing_wrong(
    dataset, path, options, optional_data, run_command, tmp_path
):
    """Their calibrations are right: a false alarm costs trust."""
    folder = optional_data(path)
    bag = tmp_path / "drive.bag"
    code, _, err = run_command("import_dataset.py", dataset, folder, bag, *options)
    assert code in (0, None), err
    code, out, _ = run_command(
        "check_rig.py", bag, "--rig", tmp_path / "drive.yaml", "--out", tmp_path / "check"
    )
    assert code == 0, out
    findings = json.loads((tmp_path / "check" / "findings.json").read_text())
    assert {f["verdict"] for f in findings} <= {"ok", "not observable"}, out
    camera = {f["check"]: f for f in findings if f["sensor"] not in ("bag", "lidar", "odometry")}
    assert camera["axes"]["verdict"] == "ok"
    if dataset != "rellis":  # one scan has too few edges
        assert camera["yaw"]["verdict"] == "ok" and camera["time"]["verdict"] == "not observable"
