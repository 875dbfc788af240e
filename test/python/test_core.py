# SPDX-License-Identifier: MIT
"""The core called from Python: the same bytes as fuse_bag, and what arrays it takes and gives."""

import ast
import io
import os
import re
import sys

import numpy as np
import pytest

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
bag_factory = pytest.importorskip("bag_factory")
core = pytest.importorskip("semantic_lidar_fusion.core", reason="built with pybind11 only")
tf2_py = pytest.importorskip("tf2_py")
import genpy  # noqa: E402

from bag_factory import Drive  # noqa: E402
from geometry_msgs.msg import TransformStamped  # noqa: E402
from semantic_lidar_fusion import open_clouds  # noqa: E402
from semantic_lidar_fusion.bags.bag_io import BagReader, to_ns  # noqa: E402
from semantic_lidar_fusion.bags.cloud_io import to_array  # noqa: E402
from semantic_lidar_fusion.errors import ConfigError, DataError  # noqa: E402
from test_fuse_bag import Made  # noqa: E402

SOURCE_DIR = os.path.abspath(os.path.join(os.path.dirname(__file__), "..", ".."))
PACKAGE = os.path.join(SOURCE_DIR, "scripts", "semantic_lidar_fusion")


def pixels_of(message):
    """The pixels of an Image message of 8-bit or float channels, a view."""
    kind = np.float32 if message.encoding.startswith("32F") else np.uint8
    return np.frombuffer(message.data, kind).reshape(message.height, message.width, -1)


def serialized(message):
    buffer = io.BytesIO()
    message.serialize(buffer)
    return buffer.getvalue()


def quaternion_of(m):
    """x y z w of a rotation (3, 3), operation by operation as Eigen does."""
    trace = m[0, 0] + m[1, 1] + m[2, 2]
    q = [0.0] * 4
    if trace > 0.0:
        t = np.sqrt(trace + 1.0)
        q[3] = 0.5 * t
        t = 0.5 / t
        q[:3] = (m[2, 1] - m[1, 2]) * t, (m[0, 2] - m[2, 0]) * t, (m[1, 0] - m[0, 1]) * t
        return q
    i = int(np.argmax(np.diag(m)))
    j, k = (i + 1) % 3, (i + 2) % 3
    t = np.sqrt(m[i, i] - m[j, j] - m[k, k] + 1.0)
    q[i] = 0.5 * t
    t = 0.5 / t
    q[3] = (m[k, j] - m[j, k]) * t
    q[j], q[k] = (m[j, i] + m[i, j]) * t, (m[k, i] + m[i, k]) * t
    return q


class Frames:
    """The transforms of a bag as the C++ tools keep them: cleaned once, then in tf2's own tree. So
    they agree to the last bit, and the clouds can."""

    def __init__(self, reader):
        self.buffer = tf2_py.BufferCore()
        self.stamps, self.poses = [], []
        for item in reader.read(["/tf", "/tf_static"]):
            for stamped in item.message.transforms:
                self.add(stamped, item.topic == "/tf_static")

    def add(self, recorded, static):
        stamped = TransformStamped()  # tf2_py wants the installed type
        stamped.deserialize(serialized(recorded))
        t, r = stamped.transform.translation, stamped.transform.rotation
        clean = core.transform([t.x, t.y, t.z], [r.x, r.y, r.z, r.w])
        r.x, r.y, r.z, r.w = quaternion_of(clean[:3, :3])
        if static:
            self.buffer.set_transform_static(stamped, "test")
        else:
            self.stamps.append(to_ns(stamped.header.stamp))
            self.poses.append(core.transform([t.x, t.y, t.z], [r.x, r.y, r.z, r.w]))

    def static(self, target, source):
        found = self.buffer.lookup_transform_core(target, source, genpy.Time()).transform
        t, r = found.translation, found.rotation
        return core.transform([t.x, t.y, t.z], [r.x, r.y, r.z, r.w])


class DriveInMemory:
    """A bag of bag_factory as arrays."""

    def __init__(self, path, drive):
        self.images, self.scores, self.infos = {}, {}, {}
        self.scans = []
        with BagReader(path) as reader:
            self.tree = Frames(reader)
            for item in reader.read():
                name = item.topic.split("/")[1]
                if item.topic.endswith("/image"):
                    stamp = to_ns(item.message.header.stamp)
                    self.images.setdefault(name, {})[stamp] = pixels_of(item.message)
                elif item.topic.endswith("/scores"):
                    stamp = to_ns(item.message.header.stamp)
                    self.scores.setdefault(name, {})[stamp] = pixels_of(item.message)
                elif item.topic.endswith("/camera_info"):
                    self.infos[name] = item.message
                elif item.topic in ("/points", "/velodyne_packets"):
                    self.scans.append(item.message)
        self.odometry = core.PoseBuffer(self.tree.stamps, self.tree.poses, fastest_mps=100.0)
        self.cameras = {
            name: (
                core.CameraModel(
                    size=(info.width, info.height),
                    distortion_model=info.distortion_model,
                    d=info.D,
                    k=info.K,
                    r=info.R,
                    p=info.P,
                ),
                self.tree.static(name, "velodyne"),
            )
            for name, info in self.infos.items()
        }

    def decode(self, decoder, message):
        if hasattr(message, "packets"):
            data = np.array([np.frombuffer(p.data, np.uint8) for p in message.packets])
            stamps = [to_ns(p.stamp) for p in message.packets]
            return decoder.decode_packets(data, stamps, to_ns(message.header.stamp), "velodyne")
        return decoder.decode_points(
            to_array(message), to_ns(message.header.stamp), message.header.frame_id
        )

    def fuse(self, rig):
        """The compensated and the semantic points of every scan, step by step."""
        pipeline, decoder = core.ScanPipeline(rig), core.LidarDecoder(rig)
        T_vehicle_lidar = self.tree.static("base_link", "velodyne")
        segmented = {}
        for message in self.scans:
            scan = self.decode(decoder, message)
            stamps = {name: list(images) for name, images in self.images.items()}
            reference_ns, chosen = pipeline.choose_images(scan, stamps, self.cameras)
            views = []
            for name in rig.camera_names:
                stamp = chosen[name]
                if stamp is not None and (name, stamp) not in segmented:
                    segmented[name, stamp] = pipeline.segment(
                        name, stamp, self.images[name][stamp], self.scores[name][stamp]
                    )
                image = segmented.get((name, stamp))
                model, T_camera_lidar = self.cameras[name]
                views.append(
                    pipeline.view(
                        name,
                        model,
                        T_camera_lidar,
                        image,
                        reference_ns,
                        self.odometry,
                        T_vehicle_lidar,
                    )
                )
            cloud = pipeline.compensate(scan, reference_ns, self.odometry, T_vehicle_lidar)
            yield cloud.points(), pipeline.fuse(cloud, views).points()


@pytest.mark.parametrize(
    "lidar, settings",
    [
        ("points", []),
        ("packets", ["smoothing.iterations=5", "image_choice=closest_to_sweep"]),
        ("points", ["occlusion.mode=paper", "overlap=most_central", "superpixels.scale=0.4"]),
    ],
)
def test_the_same_bytes_as_fuse_bag(tmp_path, lidar, settings):
    drive = Drive(scans=2, lidar=lidar, points_per_scan=3200)
    made = Made(tmp_path, drive)
    options = [part for setting in settings for part in ("--set", setting)]
    fused = made.fuse(*options)
    expected = zip(fused.of("/points_compensated"), fused.of("/points_semantic"))
    memory = DriveInMemory(str(made.bag), drive)
    rig = core.Rig.load(str(made.rig), settings)
    count = 0
    for (compensated, semantic), (first, second) in zip(expected, memory.fuse(rig)):
        assert first.tobytes() == bytes(compensated.data)
        assert second.tobytes() == bytes(semantic.data)
        assert list(second.dtype.names) == [field.name for field in semantic.fields]
        assert (second["status"] == 0).sum() > 400
        count += 1
    assert count == len(memory.scans) == 2


def test_open_clouds_gives_the_scans_of_a_fused_bag(tmp_path):
    # The last two scans share the last image, and so t_ref.
    made = Made(tmp_path, Drive(scans=3, points_per_scan=1600, images_until_s=0.32))
    fused = made.fuse()
    with open_clouds(str(fused.path)) as clouds:
        assert len(clouds) == 3 and clouds.labels.names == list(bag_factory.CLASS_NAMES)
        for cloud, message in zip(clouds, fused.of("/points_semantic")):
            assert cloud.points.tobytes() == bytes(message.data)
            assert cloud.stamp_ns == to_ns(message.header.stamp)
        assert clouds[-1].points.tobytes() == bytes(fused.of("/points_semantic")[-1].data)
        assert [len(c) for c in clouds[:2]] == [len(c) for c in fused.clouds()[:2]]
        with pytest.raises(IndexError):
            clouds[3]
        pandas = pytest.importorskip("pandas")
        frame = clouds[0].to_pandas()
        assert isinstance(frame, pandas.DataFrame) and len(frame) == len(clouds[0])
        assert frame["p_road"].sum() == pytest.approx(clouds[0].points["p_road"].sum(), rel=1e-6)
    with pytest.raises(DataError, match="no clouds on /points_semantic"):
        open_clouds(str(made.bag))


CAMERA = {
    "size": (200, 100),
    "distortion_model": "equidistant",
    "d": [0.0] * 4,
    "k": np.array([[80.0, 0, 99.5], [0, 80.0, 49.5], [0, 0, 1]]),
    "r": np.eye(3),
}


def test_project_and_unproject():
    camera = core.CameraModel(**CAMERA)
    theta = 0.7
    point = [np.sin(theta), 0.0, np.cos(theta)]
    pixel = camera.project([point, [0.0, 0.0, 4.0]])
    np.testing.assert_allclose(pixel, [[99.5 + 80 * theta, 49.5], [99.5, 49.5]], atol=1e-9)
    np.testing.assert_allclose(camera.rays(pixel), [point, [0, 0, 1]], atol=1e-9)
    assert camera.size == (200, 100)
    with pytest.raises(ValueError, match="N x 3"):
        camera.project(np.zeros((2, 2)))
    with pytest.raises(ValueError, match="k: 9 numbers"):
        core.CameraModel(**dict(CAMERA, k=[1.0, 2.0]))
    with pytest.raises(DataError, match="distortion_model"):
        core.CameraModel(**dict(CAMERA, distortion_model="bulgy"))


def test_a_transform_is_made_of_what_messages_hold():
    turn = core.transform([1, 2, 3], [0, 0, np.sin(0.3), np.cos(0.3)])
    c, s = np.cos(0.6), np.sin(0.6)
    np.testing.assert_allclose(turn, [[c, -s, 0, 1], [s, c, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])
    with pytest.raises(DataError, match="norm 2"):
        core.transform([0, 0, 0], [0, 0, 0, 2])


def test_softmax_is_tempered_by_the_share():
    scores = np.array([[2.0, 0.0, -1.0], [2.0, 0.0, np.nan], [2.0, 0.0, -1.0]], np.float32)
    share = [0.5, 1.0, 1.5]
    got = core.tempered_softmax(scores, share, temperature=2.0, exponent=2.0)
    wanted = np.exp(scores[0].astype(float) / (2.0 / 0.25))
    np.testing.assert_allclose(got[0], wanted / wanted.sum(), rtol=1e-12)
    np.testing.assert_array_equal(got[1:], np.full((2, 3), 1 / 3))
    with pytest.raises(ConfigError, match="temperature = 0"):
        core.tempered_softmax(scores, share, temperature=0.0)


def test_superpixels_and_share():
    image = np.zeros((60, 80, 3), np.uint8)
    image[:, 40:] = (20, 200, 90)
    ids = core.superpixels(image, count=12)
    assert ids.shape == (60, 80) and ids.dtype == np.int32
    assert set(np.unique(ids)) == set(range(ids.max() + 1))
    assert not set(np.unique(ids[:, :40])) & set(np.unique(ids[:, 40:]))
    scores = np.zeros((60, 80, 2), np.float32)
    scores[..., 0] = 1.0
    scores[30:, :, 1] = 3.0
    share = core.share(ids, scores)
    votes = scores.argmax(axis=-1)
    for superpixel in range(ids.max() + 1):
        own = ids == superpixel
        most = np.bincount(votes[own]).max() / own.sum()
        np.testing.assert_allclose(share[own], most, rtol=1e-6)
    # A crop is no block of memory: it is copied, and gives the same.
    wide = np.zeros((60, 100, 3), np.uint8)
    wide[:, 10:90] = image
    np.testing.assert_array_equal(core.superpixels(wide[:, 10:90], count=12), ids)
    with pytest.raises(ValueError, match="int32"):
        core.share(ids.astype(np.float32), scores)
    with pytest.raises(ValueError, match="not used"):
        core.share(ids + 1, scores)


def wall_behind_post():
    """A wall at 10 m and a post at 4 m before it, of 16 rings of 0.2 deg steps, lidar frame."""
    azimuth = np.deg2rad(np.arange(-20, 20, 0.2))
    ring = np.repeat(np.arange(16), len(azimuth))
    elevation, azimuth = np.deg2rad(-15.0 + 2.0 * ring), np.tile(azimuth, 16)
    depth = np.where(np.abs(azimuth) < np.deg2rad(2.0), 4.0, 10.0)
    xyz = np.stack([np.ones_like(depth), np.tan(azimuth), np.tan(elevation) / np.cos(azimuth)], -1)
    return xyz * depth[:, None], ring, depth


def test_a_mask_hides_what_is_behind_and_smoothing_follows_surfaces():
    xyz, ring, depth = wall_behind_post()
    cloud = core.Cloud(xyz, ring=ring, intensity=np.full(len(xyz), 9.0), stamp_ns=5)
    camera = core.CameraModel(
        **dict(CAMERA, size=(400, 300), k=[300, 0, 199.5, 0, 300, 149.5, 0, 0, 1])
    )
    T_camera_lidar = np.array([[0, -1.0, 0, 0.6], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    # The camera is 0.6 m to the right of the lidar, so that the post hides other wall for it.
    seen = core.visible(cloud, camera, T_camera_lidar)
    index, hidden = seen["index"], ~seen["visible"]
    assert hidden.sum() > 20 and (depth[index[hidden]] == 10.0).all()
    u = camera.project((xyz @ T_camera_lidar[:3, :3].T + T_camera_lidar[:3, 3])[index])[:, 0]
    np.testing.assert_allclose(seen["u"], u, atol=1e-3)
    post = u[depth[index] == 4.0]
    step = 300 * np.tan(np.deg2rad(0.2)) * 2
    assert u[hidden].min() > post.min() - step and u[hidden].max() < post.max() + step
    assert core.visible(cloud, camera, T_camera_lidar, mode="off")["visible"].all()
    with pytest.raises(ConfigError, match="mode = fog: must be one of"):
        core.visible(cloud, camera, T_camera_lidar, mode="fog")

    is_post = depth == 4.0
    probabilities = np.where(is_post[:, None], [0.9, 0.1], [0.2, 0.8]).astype(np.float32)
    wrong = np.flatnonzero(~is_post)[7::50]
    probabilities[wrong] = [0.6, 0.4]
    fused = np.ones(len(xyz), bool)
    fused[wrong[0]] = False
    smoothed = core.smooth(cloud, probabilities, fused, iterations=4)
    np.testing.assert_array_equal(smoothed[wrong[0]], probabilities[wrong[0]])
    assert (smoothed[wrong[1:], 1] > 0.5).all() and (smoothed[is_post, 0] > 0.85).all()


def test_arrays_are_views_that_keep_their_owner():
    cloud = core.Cloud(np.arange(30.0).reshape(10, 3))
    x = cloud.x
    assert x.base is not None and not x.flags.owndata
    del cloud
    np.testing.assert_array_equal(x, np.arange(0.0, 30.0, 3.0))
    assert core.Cloud(np.zeros((0, 3))).points().shape == (0,)


def test_errors_are_the_packages_own(tmp_path):
    rig = tmp_path / "rig.yaml"
    rig.write_text(bag_factory.rig_text(Drive()))
    with pytest.raises(ConfigError, match="(?s)overlap.*threads"):
        core.Rig.load(str(rig), ["threads=-1", "overlap=never"])
    loaded = core.Rig.load(str(rig), ["threads=2"])
    assert core.Rig.parse(loaded.yaml).yaml == loaded.yaml
    assert loaded.class_names == list(bag_factory.CLASS_NAMES)
    assert loaded.class_colors.tolist() == [list(c) for c in bag_factory.CLASS_COLORS]
    with pytest.raises(ConfigError, match="no YAML"):
        core.Rig.parse("a: [")
    pipeline = core.ScanPipeline(loaded)
    with pytest.raises(DataError, match="no camera rear"):
        pipeline.segment("rear", 1, np.zeros((4, 4, 3), np.uint8))
    with pytest.raises(ValueError, match="float64"):
        pipeline.segment("front", 1, np.zeros((4, 4, 3)))
    with pytest.raises(DataError):
        core.LidarDecoder(loaded).decode_points(np.zeros(3, [("x", "f4"), ("y", "f4")]), 1, "v")
    with pytest.raises(ValueError, match="structured"):
        core.LidarDecoder(loaded).decode_points(np.zeros((3, 3)), 1, "v")
    with pytest.raises(ValueError, match=re.escape("(P, 1206)")):
        core.LidarDecoder(loaded).decode_packets(np.zeros((2, 1206), np.uint8), [1], 1, "v")
    with pytest.raises(DataError, match="quaternion of norm"):
        core.PoseBuffer([1], [[0, 0, 0, 0, 0, 0, 2.0]])


def test_poses_are_interpolated():
    poses = np.array([[0, 0, 0, 0, 0, 0, 1.0], [2, 0, 0, 0, 0, np.sin(0.2), np.cos(0.2)]])
    buffer = core.PoseBuffer([0, 1000], poses)
    half = buffer.lookup(500)
    np.testing.assert_allclose(half[:3, 3], [1, 0, 0])
    np.testing.assert_allclose(np.arctan2(half[1, 0], half[0, 0]), 0.2)
    assert buffer.lookup(1001) is None and not buffer.covers(-1) and len(buffer) == 2


def names_in(path):
    """Top-level names of a stub, and those of its classes as Class.name."""
    with open(path, encoding="utf-8") as file:
        tree = ast.parse(file.read())
    found = set()
    for node in tree.body:
        if isinstance(node, (ast.ClassDef, ast.FunctionDef)):
            found.add(node.name)
        if isinstance(node, ast.ClassDef):
            found.update("%s.%s" % (node.name, n.name) for n in node.body if hasattr(n, "name"))
    return found


def test_the_stub_names_what_there_is():
    from semantic_lidar_fusion import _core

    there = set()
    for name, value in vars(_core).items():
        if name.startswith("__") or name in ("ConfigError", "DataError", "has_octomap"):
            continue
        there.add(name)
        if isinstance(value, type):
            members = [
                n for n in vars(value) if not n.startswith("_") or n in ("__init__", "__len__")
            ]
            there.update("%s.%s" % (name, n) for n in members)
    stub = names_in(os.path.join(PACKAGE, "_core.pyi"))
    # Objects that only functions make have no constructor of their own to tell of.
    there -= {name for name in there - stub if name.endswith(".__init__")}
    assert stub == there


def test_the_notebook_runs(tmp_path, monkeypatch):
    import json

    import matplotlib

    matplotlib.use("Agg")
    monkeypatch.chdir(tmp_path)
    with open(os.path.join(SOURCE_DIR, "docs", "fuse_a_scan.ipynb"), encoding="utf-8") as file:
        notebook = json.load(file)
    space = {"__name__": "__main__"}
    cells = [c for c in notebook["cells"] if c["cell_type"] == "code"]
    for cell in cells:
        assert cell["outputs"] == [] and cell["execution_count"] is None
        exec(compile("".join(cell["source"]), "docs/fuse_a_scan.ipynb", "exec"), space)
    fused = space["fused"]
    assert (fused.status == 0).mean() > 0.15
    agree = space["true_label"][fused.status == 0] == fused.label[fused.status == 0]
    assert agree.mean() > 0.97
