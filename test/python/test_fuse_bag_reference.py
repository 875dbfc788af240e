# SPDX-License-Identifier: MIT
"""fuse_bag against the chain written once more (reference_fusion), on random drives and rigs."""
import os
import subprocess

import numpy as np
import pytest

pytest.importorskip("rosbag")
pytest.importorskip("scipy")
import rosbag  # noqa: E402

import reference_fusion as reference  # noqa: E402
from bag_factory import read_cloud  # noqa: E402
from random_drives import CLASSES, RandomDrive  # noqa: E402

SEEDS = range(8)
# Of f32 coordinates up to 25 m and f32 times: what both sides may differ by.
XYZ_M, DT_S = 1e-4, 2e-8
# Points nearer than this to the border of a pixel may fall into the next one.
BORDER_PX = 0.003
COMMON = ["x", "y", "z", "intensity", "ring", "dt"]


def fused(drive, *options):
    """Messages by topic of what fuse_bag makes of a drive; record times equal header stamps."""
    bag, rig = drive.write()
    out = os.path.join(drive.folder, "out.bag")
    program = os.path.join(os.environ.get("SLF_BIN_DIR", ""), "fuse_bag")
    command = [program, bag, out, "--rig", rig, "--all", "--quiet"] + list(options)
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, timeout=120)
    assert done.returncode == 0, done.stderr.decode()
    messages = {}
    with rosbag.Bag(out) as opened:
        for topic, message, time in opened.read_messages():
            if topic not in ("/class_info", "/configuration", "/tf", "/tf_static"):
                assert time == message.header.stamp
            messages.setdefault(topic, []).append(message)
    return messages


def by_stamp(messages):
    return {m.header.stamp.to_nsec(): m for m in messages}


def stamped(messages, stamp):
    return [m for m in messages if m.header.stamp.to_nsec() == stamp]


def pixels_of(message, dtype):
    return np.frombuffer(message.data, dtype).reshape(message.height, message.width, -1)


def check_layout(message, names):
    assert [field.name for field in message.fields] == names
    size = {2: 1, 4: 2, 7: 4}
    assert all(field.offset % size[field.datatype] == 0 for field in message.fields)
    assert message.point_step % 4 == 0
    assert (message.height, message.header.frame_id) == (1, "velodyne")


def closest(stamps, target):
    """Of two the earlier; None of none."""
    return min(stamps, key=lambda s: (abs(s - target), s)) if stamps else None


def reference_time(drive, scan):
    middle = scan.first_ns + (scan.last_ns - scan.first_ns) // 2
    choose = drive.rig["reference"]["choose"]
    if choose != "closest_image":
        return {"scan_start": scan.first_ns, "scan_end": scan.last_ns}.get(choose, middle)
    name = drive.rig["reference"].get("camera", drive.cameras[0].name)
    camera = [c for c in drive.cameras if c.name == name][0]
    image = closest([s + camera.offset_ns for s in camera.semantics], middle)
    in_time = image is not None and abs(image - middle) <= 200_000_000  # reference.timeout
    return image if in_time else middle


def selected(drive, camera, scan, t_ref):
    """Raw stamp of a camera's image for a scan, 0 = none."""
    target = t_ref
    if drive.rig["image_choice"] == "closest_to_sweep" and camera.has_info:
        T = np.linalg.inv(camera.T_vehicle_camera) @ drive.T_vehicle_lidar
        xyz = reference.moved(T, scan.xyz)
        inside = reference.project(camera.info, camera.config, xyz).inside()
        if inside.any():
            after = scan.time_ns[inside] - scan.first_ns
            target = scan.first_ns + int(after.sum()) // int(inside.sum())
    image = closest([s + camera.offset_ns for s in camera.semantics], target)
    limit = round(camera.config["max_time_difference"] * 1e9)
    if image is None or abs(image - target) > limit:
        return 0
    return image - camera.offset_ns


def distribution(drive, camera, stamp, size, messages):
    """P of each superpixel pixel of an image; superpixels are fuse_bag's own, all else is not."""
    given, config = camera.semantics[stamp], camera.config
    if config["input"] == "probabilities":
        p = given.astype(float)
        return p / p.sum(axis=-1, keepdims=True)
    ids = pixels_of(by_stamp(messages["/%s/superpixels" % camera.name])[stamp], np.int32)[..., 0]
    scale = drive.rig["superpixels"].get("scale")
    rows, columns = given.shape[:2]
    if scale:
        columns, rows = int(size[0] * scale), int(size[1] * scale)
    assert ids.shape == (rows, columns)
    under = reference.resampled(given, columns, rows)
    if config["input"] == "labels":
        return reference.label_distribution(ids, under.astype(int), len(CLASSES))
    scores = under.astype(float)
    if given.dtype != np.float32:
        scores = scores * config["score_scale"] + config["score_offset"]
        scores = scores.astype(np.float32).astype(float)
    share = reference.shares(ids, scores)
    written = pixels_of(by_stamp(messages["/%s/share" % camera.name])[stamp], np.float32)[..., 0]
    assert np.abs(written - share).max() < 1e-6
    return reference.tempered(scores, share, drive.rig["uncertainty"])


class Expected:
    """Status, votes and doubt of each point of a compensated cloud, camera by camera."""

    def __init__(self, drive, cloud, t_ref, images, messages):
        self.drive, self.t_ref, self.messages = drive, t_ref, messages
        self.xyz = np.stack([cloud[axis] for axis in "xyz"], axis=-1).astype(float)
        self.times = t_ref + np.round(cloud["dt"].astype(float) * 1e9).astype(np.int64)
        self.unmoved = cloud["status"] == reference.NO_ODOMETRY
        self.status = np.full(len(cloud), reference.OUTSIDE)
        self.doubt = np.zeros(len(cloud), bool)
        self.votes = [[] for _ in cloud]
        for bit, camera in sorted(enumerate(drive.cameras), key=lambda c: c[1].name):
            if camera.has_info:
                self.add(bit, camera, images[camera.name])
        self.status[self.unmoved] = reference.NO_ODOMETRY

    def improve(self, which, status):
        rank = reference.PRECEDENCE
        for i in np.flatnonzero(which):
            if rank[status] < rank[self.status[i]]:
                self.status[i] = status

    def add(self, bit, camera, stamp):
        drive, odometry = self.drive, self.drive.odometry
        T_camera_vehicle = np.linalg.inv(camera.T_vehicle_camera)
        T, t_image = T_camera_vehicle @ drive.T_vehicle_lidar, stamp + camera.offset_ns
        has_image = stamp != 0
        if has_image and drive.rig["motion"]["enabled"] and t_image != self.t_ref:
            on_missing = drive.rig["odometry"]["on_missing"]
            at_image = odometry.pose(t_image, on_missing)
            at_reference = odometry.pose(self.t_ref, on_missing)
            has_image = at_image is not None and at_reference is not None
            if has_image:
                ego = reference.between(at_image, at_reference)
                T = T_camera_vehicle @ ego @ drive.T_vehicle_lidar
        seen = reference.project(camera.info, camera.config, reference.moved(T, self.xyz))
        seen.valid &= ~self.unmoved
        inside, pixels = seen.inside(), seen.pixels()
        with np.errstate(invalid="ignore"):
            fraction = np.abs(seen.uv - np.floor(seen.uv) - 0.5).min(axis=1)
        self.doubt |= seen.valid & (fraction < BORDER_PX)
        width, height = seen.size
        masked = np.zeros(len(inside), bool)
        if camera.mask is not None:
            free = reference.resampled(camera.mask, width, height) > 0
            masked = ~free[pixels[:, 1], pixels[:, 0]]
        if not has_image:
            self.improve(inside & ~masked, reference.NO_IMAGE)
            return
        visible = np.ones(len(inside), bool)
        if drive.rig["occlusion"]["mode"] == "paper":
            config = drive.rig["occlusion"]
            visible = reference.visible_paper(seen, config, (0.0, 0.0))
            for shift in ((0.01, 0.0), (-0.01, 0.0), (0.0, 0.01), (0.0, -0.01)):
                self.doubt |= visible != reference.visible_paper(seen, config, shift)
        p = distribution(drive, camera, stamp, seen.size, self.messages)
        topic = "/%s/probabilities" % camera.name
        dense = pixels_of(by_stamp(self.messages[topic])[stamp], np.float32)
        assert dense.shape == p.shape and np.abs(dense - p).max() < 1e-3
        p = reference.resampled(p, width, height)
        used = inside & ~masked & visible
        self.improve(inside & ~masked & ~visible, reference.OCCLUDED)
        self.improve(used, reference.FUSED)
        for i in np.flatnonzero(used):
            column, row = pixels[i]
            difference = abs(int(self.times[i]) - t_image)
            vote = reference.Vote(bit, p[row, column], difference, seen.theta[i])
            self.votes[i].append(vote)


def check_compensated(drive, scan, t_ref, message):
    check_layout(message, COMMON + ["status"])
    assert message.header.stamp.to_nsec() == t_ref
    cloud = read_cloud(message)
    xyz, status, comes_out = reference.compensate(
        scan, t_ref, drive.odometry, drive.T_vehicle_lidar, drive.rig
    )
    assert len(cloud) == comes_out.sum()
    ours = np.stack([cloud[axis] for axis in "xyz"], axis=-1)
    if len(cloud):
        assert np.abs(ours - xyz[comes_out]).max() < XYZ_M
        assert np.abs(cloud["dt"] - (scan.time_ns[comes_out] - t_ref) * 1e-9).max() < DT_S
    assert np.array_equal(cloud["ring"], scan.ring[comes_out])
    assert np.array_equal(cloud["intensity"], scan.intensity[comes_out].astype(np.float32))
    assert np.array_equal(cloud["status"], status[comes_out])
    return cloud


def check_semantic(drive, cloud, expected, message):
    check_layout(
        message,
        COMMON
        + ["rgb", "label", "confidence", "entropy", "cameras", "status"]
        + ["p_" + name for name in CLASSES],
    )
    semantic = read_cloud(message)
    p = np.stack([semantic["p_" + name] for name in CLASSES], axis=-1)
    none = semantic["status"] != reference.FUSED
    assert (semantic["label"][none] == 255).all() and (semantic["cameras"][none] == 0).all()
    assert (p[none] == 0).all() and (semantic["confidence"][none] == 0).all()
    assert (semantic["entropy"][none] == 1).all()
    assert np.array_equal(semantic["label"][~none], p[~none].argmax(axis=-1))
    assert np.array_equal(semantic["confidence"][~none], p[~none].max(axis=-1))
    colors = np.array([c["color"] for c in drive.rig["classes"]["classes"]])
    packed = colors[:, 0] << 16 | colors[:, 1] << 8 | colors[:, 2]
    rgb = np.ascontiguousarray(semantic["rgb"]).view(np.uint32)
    assert np.array_equal(rgb[~none], packed[semantic["label"][~none]])
    assert (rgb >> 24 == 0).all()

    rows = np.arange(len(cloud))
    if not drive.rig["keep_unlabelled"]:
        if expected.doubt.any():
            return 0  # nothing tells which points came out
        rows = np.flatnonzero(expected.status == reference.FUSED)
    assert len(semantic) == len(rows)
    for name in COMMON:
        assert np.array_equal(semantic[name], cloud[name][rows])
    sure = ~expected.doubt[rows]
    assert np.array_equal(semantic["status"][sure], expected.status[rows][sure])
    checked = 0
    for k in np.flatnonzero(sure & ~none):
        wanted, bits = reference.merged(expected.votes[rows[k]], drive.rig["overlap"])
        assert semantic["cameras"][k] == bits
        # A share is published as f32; with scores of +-5000 that is felt.
        assert np.abs(p[k] - wanted).max() < 2e-3
        logs = np.log(np.where(wanted > 0, wanted, 1))
        assert abs(semantic["entropy"][k] + (wanted * logs).sum() / np.log(len(CLASSES))) < 5e-3
        checked += 1
    return checked


@pytest.fixture(scope="module")
def points_checked():
    """Fused points of all seeds, for the last test."""
    return []


@pytest.mark.parametrize("seed", SEEDS)
def test_random_drives_come_out_as_the_equations_say(tmp_path, points_checked, seed):
    drive = RandomDrive(seed, str(tmp_path))
    messages = fused(drive)
    assert len(messages["/scan_reference"]) == len(drive.scans)
    references = by_stamp(messages["/scan_reference"])
    selections = {c.name: by_stamp(messages["/%s/selection" % c.name]) for c in drive.cameras}
    taken = {}
    for scan in drive.scans:
        t_ref = reference_time(drive, scan)
        assert references[scan.first_ns].time_ref.to_nsec() == t_ref
        images = {}
        for camera in drive.cameras:
            images[camera.name] = selected(drive, camera, scan, t_ref)
            chosen = selections[camera.name][scan.first_ns].time_ref.to_nsec()
            assert chosen == images[camera.name]
        # Two scans may share a t_ref; they come out in the order of the input.
        number = len(taken.setdefault(t_ref, []))
        taken[t_ref].append(scan)
        compensated = stamped(messages["/points_compensated"], t_ref)[number]
        cloud = check_compensated(drive, scan, t_ref, compensated)
        expected = Expected(drive, cloud, t_ref, images, messages)
        assert expected.doubt.mean() < 0.1
        semantic = stamped(messages["/points_semantic"], t_ref)[number]
        points_checked.append(check_semantic(drive, cloud, expected, semantic))


def test_the_random_drives_fuse_points(points_checked):
    if points_checked:
        assert sum(points_checked) > 100 * len(points_checked)
