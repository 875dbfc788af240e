# SPDX-License-Identifier: MIT
"""make_figures.py on a drive of known truth; its camera models against OpenCV."""
import os
import subprocess

import numpy as np
import pytest

bag_factory = pytest.importorskip("bag_factory")
cv2 = pytest.importorskip("cv2")
pytest.importorskip("semantic_lidar_fusion._core", reason="built with pybind11 only")
from bag_factory import CLASS_NAMES, Drive  # noqa: E402
from semantic_lidar_fusion.rig import Rig  # noqa: E402
from semantic_lidar_fusion.figures import paper_figures, plotting  # noqa: E402
from semantic_lidar_fusion.evaluation.metrics import Reliability  # noqa: E402
from semantic_lidar_fusion.cameras import Camera  # noqa: E402
from semantic_lidar_fusion.bags.cloud_io import FUSED, OCCLUDED  # noqa: E402
from semantic_lidar_fusion.errors import ConfigError, DataError  # noqa: E402


def info(model, coefficients, skew=0.0):
    from sensor_msgs.msg import CameraInfo

    message = CameraInfo(width=640, height=480, distortion_model=model)
    message.K = [400.0, skew, 321.0, 0.0, 390.0, 238.0, 0.0, 0.0, 1.0]
    message.R = list(np.eye(3).ravel())
    message.P = [420.0, 0.0, 310.0, -42.0, 0.0, 420.0, 230.0, 21.0, 0.0, 0.0, 1.0, 0.0]
    message.D = coefficients
    return message


def points_ahead(spread):
    random = np.random.RandomState(3)
    xy = random.uniform(-spread, spread, (400, 2))
    depth = random.uniform(1.0, 30.0, (400, 1))
    return np.hstack([xy * depth, depth])


@pytest.mark.parametrize(
    "model, coefficients",
    [
        ("plumb_bob", [-0.3, 0.1, 0.001, -0.002, -0.01]),
        ("rational_polynomial", [0.4, 0.1, 0.001, -0.0005, 0.01, 0.6, 0.2, 0.02]),
        ("", []),
    ],
)
def test_perspective_models_agree_with_opencv(model, coefficients):
    message = info(model, coefficients)
    points = points_ahead(0.6)
    pixel, inside = Camera(message).project(points)
    matrix = np.array(message.K).reshape(3, 3)
    expected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, np.array(coefficients))
    expected = expected[0].reshape(-1, 2)
    assert inside.sum() > 200
    np.testing.assert_allclose(pixel[inside], expected[inside], atol=1e-9)
    # Nothing behind the camera is in the image.
    assert not Camera(message).project(points * [1, 1, -1])[1].any()


def test_equidistant_model_agrees_with_opencv():
    coefficients = [0.05, -0.01, 0.003, -0.001]
    message = info("equidistant", coefficients, skew=2.0)
    points = points_ahead(0.9)
    pixel, inside = Camera(message).project(points)
    matrix = np.array(message.K).reshape(3, 3)
    expected = cv2.fisheye.projectPoints(
        points.reshape(-1, 1, 3),
        np.zeros((3, 1)),
        np.zeros((3, 1)),
        matrix,
        np.array(coefficients),
        alpha=2.0 / 400.0,
    )[0].reshape(-1, 2)
    assert inside.sum() > 200
    np.testing.assert_allclose(pixel[inside], expected[inside], atol=1e-9)


def test_fisheye_sees_beyond_a_right_angle():
    message = info("equidistant", [0.0] * 4)
    message.K = [150.0, 0.0, 320.0, 0.0, 150.0, 240.0, 0.0, 0.0, 1.0]
    angle = np.deg2rad(100.0)
    pixel, inside = Camera(message).project(np.array([[np.sin(angle), 0.0, np.cos(angle)]]))
    assert inside[0]
    np.testing.assert_allclose(pixel[0], [320.0 + 150.0 * angle, 240.0])


def test_rectified_images_use_p():
    camera = Camera(info("plumb_bob", [-0.3, 0.1, 0.0, 0.0, 0.0]), rectified=True)
    pixel, inside = camera.project(np.array([[0.5, -0.2, 4.0]]))
    assert inside[0]
    np.testing.assert_allclose(pixel[0], [(210 + 1240 - 42) / 4, (-84 + 920 + 21) / 4])
    with pytest.raises(DataError, match="mei"):
        Camera(info("mei", []))


def test_rays_lead_back_through_a_lens_file(tmp_path):
    path = tmp_path / "lens.yaml"
    path.write_text(
        "{model: double_sphere, resolution: [640, 480], focal: [300, 310], "
        "centre: [320, 240], coefficients: [-0.27, 0.57]}"
    )
    camera = Camera(info("whatever", [1.0]), lens={"file": str(path), "frame": "left"})
    assert camera.frame_id == "left" and camera.size == (640, 480)
    points = points_ahead(0.6)
    pixel, inside = camera.project(points)
    assert inside.sum() > 200
    # The paper's equations.
    d1 = np.linalg.norm(points, axis=1)
    z = -0.27 * d1 + points[:, 2]
    d2 = np.sqrt(points[:, 0] ** 2 + points[:, 1] ** 2 + z**2)
    plane = points[:, :2] / (0.57 * d2 + 0.43 * z)[:, None]
    np.testing.assert_allclose(pixel, plane * [300, 310] + [320, 240], atol=1e-9)
    np.testing.assert_allclose(camera.rays(pixel), points / d1[:, None], atol=1e-9)
    assert np.isnan(camera.project(np.array([[0.0, 0.0, -1.0]]))[0]).all()
    path.write_text("{model: ds}")
    with pytest.raises(ConfigError, match="model = ds: must be one of"):
        Camera(info("", []), lens={"file": str(path)})


def test_boundaries_of_superpixels():
    edge = paper_figures.boundaries(np.array([[0, 0, 1], [0, 2, 1]]))
    assert edge.tolist() == [[False, True, False], [True, True, False]]


def test_images_of_all_encodings():
    from sensor_msgs.msg import Image

    values = np.arange(24, dtype=np.float32).reshape(2, 3, 4)
    message = Image(height=2, width=3, encoding="32FC4", step=48, data=values.tobytes())
    np.testing.assert_array_equal(paper_figures.image_array(message), values)
    pixels = np.arange(12, dtype=np.uint8).reshape(2, 2, 3)
    padded = np.concatenate([pixels.reshape(2, 6), np.zeros((2, 2), np.uint8)], axis=1)
    message = Image(height=2, width=2, encoding="bgr8", step=8, data=padded.tobytes())
    np.testing.assert_array_equal(paper_figures.rgb_of(message), pixels[..., ::-1])
    message.encoding = "yuv"
    with pytest.raises(DataError, match="yuv"):
        paper_figures.image_array(message)


@pytest.fixture(scope="module")
def fused(tmp_path_factory):
    """(fused bag, source bag, rig file) of a short drive."""
    program = os.path.join(os.environ.get("SLF_BIN_DIR", ""), "fuse_bag")
    if not os.path.exists(program):
        pytest.skip("fuse_bag is not built (SLF_BIN_DIR)")
    folder = tmp_path_factory.mktemp("figures")
    drive = Drive(scans=3)
    paths = [str(folder / name) for name in ("out.bag", "in.bag", "rig.yaml")]
    bag_factory.write_bag(paths[1], drive)
    with open(paths[2], "w") as file:
        file.write(bag_factory.rig_text(drive))
    command = [program, paths[1], paths[0], "--rig", paths[2], "--all", "--quiet"]
    subprocess.run(command, check=True, timeout=120)
    return paths


def test_projection_agrees_with_the_fused_cloud(fused):
    scene = paper_figures.load_scene(fused[0], fused[1], Rig.load(fused[2]))
    cloud = scene.cloud
    assert len(scene.views) == len(Drive().cameras)
    for view in scene.views:
        assert view.image is not None and view.scores.shape[2] == len(CLASS_NAMES)
        got = paper_figures.project_cloud(cloud, view)
        bits = (cloud.optional("cameras") >> view.bit) & 1
        # Every contribution is a point drawn and kept; only the image's rim may round otherwise.
        assert abs(int((~got.removed).sum()) - int(bits.sum())) <= 2
        # A kept point shows the class that the cloud took from that pixel.
        size = view.image.shape[1::-1]
        label = paper_figures._resized(view.labels(), size)
        points = paper_figures.transform_points(view.to_camera, cloud.xyz)
        pixel, inside = view.camera.project(points)
        inside &= cloud.optional("cameras") == 1 << view.bit
        u, v = np.floor(pixel[inside] + 0.5).astype(int).T
        assert inside.sum() > 50
        assert np.mean(label[v, u] == cloud.label[inside]) > 0.99
    assert np.isin(cloud.status, (FUSED, OCCLUDED)).any()


def test_panorama_shows_the_classes_around(fused):
    scene = paper_figures.load_scene(fused[0], fused[1], Rig.load(fused[2]))
    picture, seen, extent = paper_figures.panorama(scene, columns=600)
    assert picture.shape[:2] == seen.shape and 500 < picture.shape[1] < 720
    left, right, bottom, top = extent
    assert 180 >= left > right >= -180 and top > 0 > bottom
    # Straight below the first camera's axis lies the road: the label image's own colours, blended
    # with the picture as figure 6 does.
    view = scene.views[0]
    axis = np.degrees(np.arctan2(view.to_vehicle[1, 2], view.to_vehicle[0, 2]))
    column = int((left - axis) / (left - right) * picture.shape[1])
    row = np.flatnonzero(seen[:, column])[-1] - 1
    shown = (picture[row, column] - 0.6 * scene.labels.colors_rgb) / 0.4
    possible = ((shown > -5) & (shown < 260)).all(axis=1)
    assert possible[0]


def test_all_figures_are_drawn(fused, run_command, tmp_path):
    out = tmp_path / "figures"
    options = ("--rig", fused[2], "--out", out)
    code, text, err = run_command("make_figures.py", fused[0], "--source", fused[1], *options)
    assert code == 0, err
    names = sorted(os.listdir(str(out)))
    first = Drive().cameras[0].name
    assert names == [
        "figure2_%s.png" % first,
        "figure3_%s.png" % first,
        "figure5.png",
        "figure6.png",
    ]
    assert len(text.split()) == 4
    for name in names:
        picture = cv2.imread(str(out / name))
        assert picture.shape[1] > 1000
        assert len(np.unique(picture[::4, ::4].astype(int) @ [1, 256, 65536])) > 50
    code, _, err = run_command("make_figures.py", fused[0], *options)
    assert code == 1 and "--force" in err


def test_without_the_source_only_what_the_clouds_show(fused, run_command, tmp_path):
    out = tmp_path / "figures"
    code, _, err = run_command("make_figures.py", fused[0], "--rig", fused[2], "--out", out)
    assert code == 0 and "figure 5 is left out" in err
    assert sorted(os.listdir(str(out))) == ["figure6.png"]
    options = ("--rig", fused[2], "--out", out, "--force")
    assert run_command("make_figures.py", fused[0], "--figures", "5", *options)[0] == 1
    code, _, err = run_command("make_figures.py", fused[0], "--scan", "9", *options)
    assert code == 1 and "has 3 scans" in err
    code, _, err = run_command("make_figures.py", fused[0], "--camera", "none", *options)
    assert code == 1 and "--camera none" in err


def test_the_reliability_diagram_is_whole(tmp_path):
    """Nothing of it, the legend above included, is cut off at the border."""
    random = np.random.RandomState(1)
    reliability = Reliability()
    values = random.dirichlet([0.3] * 4, 500)
    reliability.add(values, random.randint(0, 4, 500), values.argmax(axis=1), values.max(axis=1))
    plotting.draw_reliability(str(tmp_path / "plot.png"), [("a", reliability)] * 2)
    picture = cv2.imread(str(tmp_path / "plot.png"))
    for border in (picture[:2], picture[-2:], picture[:, :2], picture[:, -2:]):
        assert (border == 255).all()
    legend = picture[: picture.shape[0] // 12].reshape(-1, 3)
    for color in ([178, 114, 0], [181, 205, 245]):  # of right, and of the gap, as OpenCV reads them
        assert (np.abs(legend.astype(int) - color).max(axis=1) < 25).sum() > 100, color
