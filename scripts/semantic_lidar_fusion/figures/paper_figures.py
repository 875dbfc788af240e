# SPDX-License-Identifier: MIT
"""The paper's figures of one scan: fig. 2 (superpixels and share), fig. 3 (score maps before and
after), fig. 5 (points in the images, without and with the mask), fig. 6 (panorama and top views).
"""

import os
from typing import Any, Callable, Dict, List, NamedTuple, Optional, Tuple, TypeVar

import numpy as np

from semantic_lidar_fusion import cli
from semantic_lidar_fusion.figures import plotting
from semantic_lidar_fusion.bags.bag_io import BagReader, to_ns
from semantic_lidar_fusion.cameras import Camera
from semantic_lidar_fusion.bags.cloud_io import FUSED, OCCLUDED, SemanticCloud
from semantic_lidar_fusion.errors import ConfigError, DataError
from semantic_lidar_fusion.evaluation.scoring import CLOUD_TOPIC
from semantic_lidar_fusion.labels import LabelSet
from semantic_lidar_fusion.pictures import decoded
from semantic_lidar_fusion.figures.plotting import title_of
from semantic_lidar_fusion.bags.poses import TransformTree, invert, transform_points
from semantic_lidar_fusion.rig import CameraConfig, Rig
from semantic_lidar_fusion.texts import plain_text

_TOP_VIEW_M = 40.0
# Behind points whose colour says how sure a class is: what is not of the class hardly stands out.
_DARK = "#2a0a36"
_PANORAMA_IN = 3.2  # at most
_LEGEND_COLUMNS = 6
T = TypeVar("T")


class View(NamedTuple):
    """What one camera adds to a scan; None where the bags lack it.

    image: (H, W, 3) uint8 RGB; superpixels: (h, w) int; share: (h, w); scores, probabilities:
    (h, w, C) float32; camera: its model; to_camera: T (4, 4) from the lidar at t_ref to the camera
    at the time of its image; to_vehicle: T (4, 4) of the camera."""

    name: str
    bit: int
    image: Optional[np.ndarray]
    superpixels: Optional[np.ndarray]
    share: Optional[np.ndarray]
    scores: Optional[np.ndarray]
    probabilities: Optional[np.ndarray]
    camera: Optional[Camera]
    to_camera: Optional[np.ndarray]
    to_vehicle: Optional[np.ndarray]

    def labels(self) -> Optional[np.ndarray]:
        """(h, w) most likely class."""
        values = self.probabilities if self.probabilities is not None else self.scores
        return None if values is None else values.argmax(axis=-1)

    @property
    def has_uncertainty(self) -> bool:
        """What figure 2 needs."""
        needed = (self.image, self.superpixels, self.share, self.labels())
        return all(value is not None for value in needed)

    @property
    def has_score_maps(self) -> bool:
        """What figure 3 needs."""
        return self.scores is not None and self.probabilities is not None

    @property
    def has_projection(self) -> bool:
        """What figure 5 needs."""
        return self.image is not None and self.camera is not None and self.to_camera is not None

    @property
    def has_directions(self) -> bool:
        """What the panorama of figure 6 needs."""
        return not (self.camera is None or self.to_vehicle is None or self.labels() is None)


def _given(value: Optional[T]) -> T:
    """A part of a view that its caller has checked to be there."""
    if value is None:
        raise DataError("a view lacks what its figure needs")
    return value


class Scene(NamedTuple):
    """A semantic cloud with the views that made it."""

    cloud: SemanticCloud
    labels: LabelSet
    views: List[View]


# -- reading


def image_array(message: Any) -> np.ndarray:
    """The pixels of an Image: (H, W) or (H, W, channels), in the encoding's own type and order."""
    kinds = {
        "8U": "u1",
        "8S": "i1",
        "16U": "u2",
        "16S": "i2",
        "32S": "i4",
        "32F": "f4",
        "64F": "f8",
    }
    names = {"mono8": ("u1", 1), "bgr8": ("u1", 3), "rgb8": ("u1", 3), "mono16": ("u2", 1)}
    names.update({"bgra8": ("u1", 4), "rgba8": ("u1", 4)})
    encoding = message.encoding
    if encoding in names:
        code, channels = names[encoding]
    else:
        kind, _, count = encoding.partition("C")
        if kind not in kinds or not (count or "1").isdigit():
            raise DataError("image: the encoding %s cannot be drawn" % encoding)
        code, channels = kinds[kind], int(count or 1)
    dtype = np.dtype((">" if message.is_bigendian else "<") + code)
    width = message.width * channels * dtype.itemsize
    if message.step < width or len(message.data) < message.step * message.height:
        raise DataError("image: %d bytes are too few" % len(message.data))
    rows = np.frombuffer(message.data, np.uint8, message.step * message.height)
    rows = np.ascontiguousarray(rows.reshape(message.height, message.step)[:, :width])
    shape = (message.height, message.width) + ((channels,) if channels > 1 else ())
    return rows.view(dtype).reshape(shape)


def rgb_of(message: Any) -> np.ndarray:
    """(H, W, 3) uint8 RGB of an Image or CompressedImage."""
    import cv2

    if hasattr(message, "format"):
        what = "a compressed image of format '%s'" % plain_text(message.format)
        return decoded(message.data, "color", what)[..., ::-1]
    encoding = message.encoding
    bayer = {"rggb": "BG", "bggr": "RG", "gbrg": "GR", "grbg": "GB"}
    if encoding.startswith("bayer_") and encoding.endswith("8"):
        rows = np.frombuffer(message.data, np.uint8).reshape(message.height, message.step)
        code = getattr(cv2, "COLOR_Bayer%s2RGB" % bayer[encoding[6:10]])
        return cv2.cvtColor(np.ascontiguousarray(rows[:, : message.width]), code)
    pixels = image_array(message)
    if pixels.ndim == 2:
        pixels = pixels[..., None].repeat(3, axis=2)
    if pixels.dtype == np.uint16:
        pixels = (pixels >> 8).astype(np.uint8)
    return pixels[..., 2::-1] if encoding.startswith("bgr") else pixels[..., :3]


def _last_at(bags: List[BagReader], topics: List[str], stamp_ns: int) -> Any:
    """The message of the first such topic whose header stamp is this; None if there is none."""
    margin = 3 * 10**9
    for topic in topics:
        for bag in bags:
            windows: List[Tuple[Optional[int], Optional[int]]] = [
                (max(0, stamp_ns - margin), stamp_ns + margin),
                (None, None),
            ]
            for start_ns, end_ns in windows:
                for item in bag.read([topic], start_ns=start_ns, end_ns=end_ns):
                    if to_ns(item.message.header.stamp) == stamp_ns:
                        return item.message
    return None


def _info(bags: List[BagReader], topic: str, stamp_ns: int) -> Any:
    """The last camera_info at or before a time, else the first."""
    found = None
    for bag in bags:
        for item in bag.read([topic]):
            if found is not None and item.stamp_ns > stamp_ns:
                break
            found = item.message
    return found


def load_scene(
    fused_path: str, source_path: Optional[str], rig: Optional[Rig], scan: Optional[int] = None
) -> Scene:
    """Reads a scan (default: the one in the middle) of a bag that fuse_bag --all has written.

    Images, camera_info and tf come from `source_path`, the bag that was fused; the rig from the
    fused bag itself if `rig` is None."""
    bags = [BagReader(fused_path)] + ([BagReader(source_path)] if source_path else [])
    try:
        fused = bags[0]
        rig = rig or Rig.from_bag(fused)
        if rig is None:
            raise DataError("%s: does not tell its rig; name the file with --rig" % fused_path)
        fused.require_topic(CLOUD_TOPIC, "sensor_msgs/PointCloud2")
        count = fused.count([CLOUD_TOPIC])
        number = count // 2 if scan is None else scan
        if not 0 <= number < count:
            raise ConfigError("--scan %d: %s has %d scans" % (number, fused_path, count))
        for index, item in enumerate(fused.read([CLOUD_TOPIC])):
            if index == number:
                break
        cloud = SemanticCloud.from_message(item.message)
        if cloud.class_names != rig.labels.names:
            raise DataError("%s: its classes are not those of %s" % (fused_path, rig.path))
        first_ns = cloud.stamp_ns
        for item in fused.read(["/scan_reference"]):
            if to_ns(item.message.time_ref) == cloud.stamp_ns:
                first_ns = to_ns(item.message.header.stamp)
        tree = TransformTree()
        for bag in bags:
            if len(tree) == 0:
                tree = TransformTree.from_bag(bag)
        views = [
            _load_view(bags, tree, rig, bit, entry, cloud, first_ns)
            for bit, entry in enumerate(rig.cameras)
        ]
    finally:
        for bag in bags:
            bag.close()
    return Scene(cloud, rig.labels, views)


def _load_view(
    bags: List[BagReader],
    tree: TransformTree,
    rig: Rig,
    bit: int,
    entry: CameraConfig,
    cloud: SemanticCloud,
    first_ns: int,
) -> View:
    name = entry.name
    stamp_ns = 0
    for item in bags[0].read(["/%s/selection" % name]):
        if to_ns(item.message.header.stamp) == first_ns:
            stamp_ns = to_ns(item.message.time_ref)
    got: Dict[str, Any] = {}
    if stamp_ns:
        for key in ("superpixels", "share", "probabilities"):
            message = _last_at(bags, ["/%s/%s" % (name, key)], stamp_ns)
            got[key] = None if message is None else image_array(message)
        message = _last_at(bags, ["/%s/scores" % name, entry.scores], stamp_ns)
        if message is not None:
            got["scores"] = image_array(message).astype(np.float32)
        order = [entry.image, entry.image + "/compressed"]
        message = _last_at(bags, order, stamp_ns)
        got["image"] = None if message is None else rgb_of(message)
    from sensor_msgs.msg import CameraInfo

    camera, to_camera, to_vehicle = None, None, None
    info = _info(bags, entry.camera_info, stamp_ns)
    if info is None and entry.lens.get("frame"):  # needs no camera_info
        info = CameraInfo()
    if info is not None and stamp_ns:
        camera = Camera(info, entry.rectified, entry.lens)
        to_camera = _to_camera(tree, rig, camera.frame_id, cloud, stamp_ns)
        to_vehicle = _static(tree, rig.text("vehicle_frame"), camera.frame_id)
    return View(
        name,
        bit,
        got.get("image"),
        got.get("superpixels"),
        got.get("share"),
        got.get("scores"),
        got.get("probabilities"),
        camera,
        to_camera,
        to_vehicle,
    )


def _static(tree: TransformTree, target: str, source: str) -> Optional[np.ndarray]:
    try:
        poses, known = tree.lookup(target, source, np.array([0], dtype=np.int64))
    except DataError:
        return None
    return poses[0] if known[0] else None


def _to_camera(
    tree: TransformTree, rig: Rig, frame: str, cloud: SemanticCloud, stamp_ns: int
) -> Optional[np.ndarray]:
    """From the lidar at t_ref to the camera at its image, by the vehicle's motion where tf has it
    and the rig file uses it; else the rigid transform."""
    fixed = rig.text("fixed_frame")
    if rig.flag("motion.enabled"):
        try:
            lidar, known = tree.lookup(fixed, cloud.frame_id, np.array([cloud.stamp_ns]))
            camera, covered = tree.lookup(fixed, frame, np.array([stamp_ns]))
            if known[0] and covered[0]:
                return invert(camera[0]) @ lidar[0]
        except DataError:
            pass
    return _static(tree, frame, cloud.frame_id)


# -- drawing


def _resized(values: np.ndarray, size: Tuple[int, int]) -> np.ndarray:
    """Map (h, w, ...) at every pixel of an image of size (width, height), by the package's rule."""
    rows = ((np.arange(size[1]) + 0.5) * values.shape[0] / size[1]).astype(int)
    columns = ((np.arange(size[0]) + 0.5) * values.shape[1] / size[0]).astype(int)
    return values[rows[:, None], columns]


def boundaries(superpixels: np.ndarray) -> np.ndarray:
    """(h, w) bool: the pixel right or below belongs to another superpixel."""
    edge = np.zeros(superpixels.shape, dtype=bool)
    edge[:, :-1] |= superpixels[:, :-1] != superpixels[:, 1:]
    edge[:-1] |= superpixels[:-1] != superpixels[1:]
    return edge


def _bare(axis: Any) -> None:
    axis.set_xticks([])
    axis.set_yticks([])


def draw_uncertainty(path: str, view: View, labels: LabelSet) -> None:
    """Figure 2: image, superpixels, labels with superpixels, share."""
    plt = plotting.pyplot()
    image, label = _given(view.image), _given(view.labels())
    size = (image.shape[1], image.shape[0])
    superpixels = _resized(_given(view.superpixels), size)
    edge = boundaries(superpixels)
    colors = labels.colors_rgb[_resized(label, size)].astype(float)
    clustered = image.astype(float).copy()
    clustered[edge] = (255, 230, 0)
    labelled = 0.75 * colors + 0.25 * image
    labelled[edge] = 0.35 * labelled[edge]
    share = _resized(_given(view.share), size)
    aspect = size[1] / size[0]
    width = 3.5
    figure, axes = plt.subplots(2, 2, figsize=(2 * width, 2 * width * aspect + 0.75))
    pictures: List[np.ndarray] = [image, clustered, labelled]
    names = ["(a) image", "(b) superpixels", "(c) labels and superpixels", "(d) share"]
    for axis, picture, name in zip(axes.flat, pictures, names):
        axis.imshow(np.clip(picture, 0, 255).astype(np.uint8), interpolation="antialiased")
        axis.set_xlabel(name)
        _bare(axis)
    last = axes.flat[3]
    low = min(0.9, float(np.floor(float(share.min()) * 10) / 10))
    drawn = last.imshow(share, cmap=plotting.SURENESS, vmin=low, vmax=1.0)
    last.set_xlabel(names[3])
    _bare(last)
    figure.subplots_adjust(left=0.01, right=0.93, wspace=0.03, hspace=0.16, bottom=0.14, top=0.99)
    box = last.get_position()
    scale = figure.add_axes([box.x1 + 0.01, box.y0, 0.012, box.height])
    figure.colorbar(drawn, cax=scale)
    present = np.unique(label)
    figure.legend(
        plotting.class_handles(labels.colors_rgb[present]),
        [title_of(labels[i].name) for i in present],
        loc="upper center",
        bbox_to_anchor=(0.47, 0.085),
        ncol=min(len(present), 7),
        handlelength=1,
        handleheight=0.9,
        columnspacing=1.1,
    )
    plotting.save(figure, path)


def draw_score_maps(path: str, view: View, labels: LabelSet) -> None:
    """Figure 3: the network's scores of each class (upper half), and P after it (lower half)."""
    plt = plotting.pyplot()
    count = len(labels)
    columns = min(count, 6 if count <= 12 else 7 if count <= 14 else 5)
    rows = -(-count // columns)
    scores, probabilities = _given(view.scores), _given(view.probabilities)
    source = view.image.shape if view.image is not None else probabilities.shape
    aspect = source[0] / source[1]
    width = 7.2 / columns
    # One row of headings between and above the halves.
    height = (width * aspect + 0.2) * rows * 2 + 0.9
    figure = plt.figure(figsize=(7.2, height))
    half_height = (width * aspect + 0.2) * rows
    halves = figure.add_gridspec(
        2, 1, hspace=0.5 / half_height, left=0.01, right=0.94, top=1 - 0.4 / height, bottom=0.0
    )
    low, high = np.percentile(scores, (0.5, 99.9))
    for half, (values, name, limits) in enumerate(
        (
            (scores, "(a) scores of the network", (low, high)),
            (probabilities, "(b) probabilities after superpixel softmax", (0.0, 1.0)),
        )
    ):
        grid = halves[half].subgridspec(rows, columns, wspace=0.04, hspace=0.2 / (width * aspect))
        axes = []
        for index in range(count):
            axis = figure.add_subplot(grid[index // columns, index % columns])
            drawn = axis.imshow(
                values[..., index],
                cmap=plotting.SURENESS,
                vmin=limits[0],
                vmax=limits[1],
                aspect="auto",
                interpolation="nearest",
            )
            axis.set_title(title_of(labels[index].name), fontsize=7, pad=2)
            _bare(axis)
            axes.append(axis)
        top, bottom = axes[0].get_position(), axes[-1].get_position()
        scale = figure.add_axes([0.95, bottom.y0, 0.012, top.y1 - bottom.y0])
        bar = figure.colorbar(drawn, cax=scale)
        bar.ax.tick_params(labelsize=7)
        figure.text(0.475, top.y1 + 0.19 / height, name, ha="center", va="bottom", fontsize=9)
    plotting.save(figure, path)


class Projected(NamedTuple):
    """Points of the cloud in an image: pixel (M, 2); depth (M,) m; removed (M,) bool."""

    pixel: np.ndarray
    depth: np.ndarray
    removed: np.ndarray


def project_cloud(cloud: SemanticCloud, view: View) -> Projected:
    """Points of the view that are fused or occluded; removed = the mask took this camera away."""
    points = transform_points(_given(view.to_camera), cloud.xyz)
    pixel, inside = _given(view.camera).project(points)
    inside &= np.isin(cloud.status, (FUSED, OCCLUDED))
    bits = cloud.optional("cameras")
    if bits is None:
        removed = cloud.status == OCCLUDED
    else:
        removed = (bits >> np.uint16(view.bit)) & 1 == 0
    depth = np.linalg.norm(points, axis=1)
    return Projected(pixel[inside], depth[inside], removed[inside])


def draw_projection(path: str, scene: Scene) -> None:
    """Figure 5: a row per camera; direct projection left, with the mask right."""
    plt = plotting.pyplot()
    from matplotlib.colors import LogNorm

    views = [view for view in scene.views if view.has_projection]
    images = [_given(view.image) for view in views]
    width = 3.55
    heights = [width * image.shape[0] / image.shape[1] for image in images]
    figure, axes = plt.subplots(
        len(views),
        2,
        figsize=(2 * width, sum(heights) + 0.25 * len(views) + 0.55),
        squeeze=False,
        gridspec_kw={"height_ratios": heights, "wspace": 0.02, "hspace": 0.24 / np.mean(heights)},
    )
    norm = LogNorm(2.0, 60.0)
    for row, view, image in zip(axes, views, images):
        got = project_cloud(scene.cloud, view)
        gray = image.mean(axis=2)[..., None].repeat(3, axis=2)
        backdrop = (0.55 * image + 0.25 * gray + 20).astype(np.uint8)
        dense = len(got.depth) / (image.shape[0] * image.shape[1])
        size = float(np.clip(0.004 / max(dense, 1e-6), 0.35, 3.0))
        far_first = np.argsort(-got.depth)
        for axis, masked in zip(row, (False, True)):
            axis.imshow(backdrop)
            order = far_first[~got.removed[far_first]] if masked else far_first
            axis.scatter(
                got.pixel[order, 0],
                got.pixel[order, 1],
                c=got.depth[order],
                cmap="jet_r",
                norm=norm,
                s=size,
                linewidths=0,
            )
            if masked:
                axis.scatter(
                    got.pixel[got.removed, 0],
                    got.pixel[got.removed, 1],
                    c="magenta",
                    s=size,  # no larger than a point: what it hides stays to be seen
                    linewidths=0,
                )
                text = "%s, masked: %d of %d removed" % (
                    view.name,
                    got.removed.sum(),
                    len(got.depth),
                )
            else:
                text = "%s, direct" % view.name
            axis.set_xlim(-0.5, image.shape[1] - 0.5)
            axis.set_ylim(image.shape[0] - 0.5, -0.5)
            axis.set_xlabel(text, labelpad=2, fontsize=8)
            _bare(axis)
    scalar = plt.cm.ScalarMappable(norm=norm, cmap="jet_r")
    total = figure.get_size_inches()[1]
    bottom = axes[-1, 0].get_position().y0
    scale = figure.add_axes([0.2, bottom - 0.42 / total, 0.4, 0.07 / total])
    bar = figure.colorbar(scalar, cax=scale, orientation="horizontal")
    bar.set_ticks([2, 5, 10, 20, 50])
    bar.set_ticklabels(["2", "5", "10", "20", "50"])
    bar.ax.minorticks_off()
    bar.ax.text(1.03, 0.5, "distance, m", transform=bar.ax.transAxes, va="center", fontsize=8)
    scale.scatter(
        [1.42],
        [0.5],
        transform=scale.transAxes,
        c="magenta",
        s=8,
        linewidths=0,
        clip_on=False,
    )
    scale.text(1.46, 0.5, "removed", transform=scale.transAxes, va="center", fontsize=8)
    plotting.save(figure, path)


def panorama(
    scene: Scene, columns: int = 2000, elevation_deg: Tuple[float, float] = (-35.0, 30.0)
) -> Optional[Tuple[np.ndarray, np.ndarray, List[float]]]:
    """The segmented images on a cylinder of 10 m around the vehicle's cameras.

    About `columns` pixels wide. Returns the picture (h, w, 3) uint8, whether a camera sees each pixel (h, w) bool, and the extent
    [left, right, bottom, top] in deg (azimuth to the left is positive), cut to what is seen. Of
    several cameras the one that sees a direction nearest to its axis gives the pixel."""
    views = [view for view in scene.views if view.has_directions]
    if not views:
        return None
    coarse = _panorama(scene, views, 720, elevation_deg)
    if coarse is None:
        return None
    left, right = coarse[2][:2]
    return _panorama(scene, views, int(columns * 360.0 / (left - right)), elevation_deg)


def _panorama(
    scene: Scene, views: List[View], width: int, elevation_deg: Tuple[float, float]
) -> Optional[Tuple[np.ndarray, np.ndarray, List[float]]]:
    """`width`: pixels of 360 deg."""
    middle = np.mean([_given(v.to_vehicle)[:3, 3] for v in views], axis=0)
    step = 360.0 / width
    azimuth = np.deg2rad(180.0 - (np.arange(width) + 0.5) * step)
    height = int((elevation_deg[1] - elevation_deg[0]) / step)
    elevation = np.deg2rad(elevation_deg[1] - (np.arange(height) + 0.5) * step)
    a, e = np.meshgrid(azimuth, elevation)
    points = 10.0 * np.stack([np.cos(a), np.sin(a), np.tan(e)], axis=-1).reshape(-1, 3) + middle
    picture = np.full((height * width, 3), 255.0)
    best = np.full(height * width, np.inf)
    for view in views:
        camera = _given(view.camera)
        local = transform_points(invert(_given(view.to_vehicle)), points)
        pixel, inside = camera.project(local)
        theta = camera.theta(local)
        chosen = np.flatnonzero(inside & (theta < best))
        best[chosen] = theta[chosen]
        u, v = (np.floor(pixel[chosen] + 0.5)).astype(int).T
        size = camera.size
        label = _given(view.labels())
        rows, columns = v * label.shape[0] // size[1], u * label.shape[1] // size[0]
        color = scene.labels.colors_rgb[label[rows, columns]].astype(float)
        if view.image is not None:
            image = view.image[
                v * view.image.shape[0] // size[1], u * view.image.shape[1] // size[0]
            ]
            color = 0.6 * color + 0.4 * image
        picture[chosen] = color
    seen = np.isfinite(best).reshape(height, width)
    if not seen.any():
        return None
    rows, columns = (np.flatnonzero(seen.any(axis=axis)) for axis in (1, 0))
    top, bottom, left, right = rows[0], rows[-1] + 1, columns[0], columns[-1] + 1
    extent = [
        180.0 - left * step,
        180.0 - right * step,
        elevation_deg[1] - bottom * step,
        elevation_deg[1] - top * step,
    ]
    image = picture.reshape(height, width, 3)[top:bottom, left:right].astype(np.uint8)
    return image, seen[top:bottom, left:right], extent


class _Ground(NamedTuple):
    """The part of the ground that is drawn. x, y: limits in m; across: x of the lidar to the right,
    not up; ratio: height over width of the picture."""

    x: Tuple[float, float]
    y: Tuple[float, float]
    across: bool
    ratio: float


def _ground(xy: np.ndarray) -> _Ground:
    """What holds nearly all points (N, 2), without the empty side of a rig that looks one way only."""
    reach = np.percentile(np.abs(xy).max(axis=1), 92) if len(xy) else 20.0
    reach = float(np.clip(np.ceil(reach / 5) * 5, 10.0, _TOP_VIEW_M))
    bounds = []
    for values in xy.T:
        low, high = np.percentile(values, (4, 96)) if len(values) else (-reach, reach)
        bounds.append((max(-reach, min(low, -3.0) - 2.0), min(reach, max(high, 3.0) + 2.0)))
    (low_x, high_x), (low_y, high_y) = bounds
    # Wider than high fills the page: lay the longer side across it.
    across = (high_x - low_x) > (high_y - low_y)
    ratio = (high_y - low_y) / (high_x - low_x)
    return _Ground(bounds[0], bounds[1], across, ratio if across else 1.0 / ratio)


def _draw_panorama(figure: Any, scene: Scene, height_in: float, panorama_of_scene: Any) -> None:
    """The panorama at the top of a figure, and the classes of its colours below it."""
    picture, seen, extent = panorama_of_scene
    width, total = figure.get_size_inches()
    axis = figure.add_axes([0.0, 1 - height_in / total, 1.0, height_in / total])
    aspect = "equal" if height_in == _PANORAMA_IN else "auto"
    axis.imshow(np.where(seen[..., None], picture, 255), extent=extent, aspect=aspect)
    axis.set_xlabel("segmented images, %.0f° of azimuth" % (extent[0] - extent[1]), labelpad=3)
    _bare(axis)
    for side in axis.spines.values():
        side.set_visible(False)
    maps = [_given(view.labels()) for view in scene.views if view.has_directions]
    present = np.unique(np.concatenate([np.unique(labels) for labels in maps]))
    figure.legend(
        plotting.class_handles(scene.labels.colors_rgb[present]),
        [title_of(scene.labels[i].name) for i in present],
        loc="upper center",
        bbox_to_anchor=(0.5, 1 - (height_in + 0.22) / total),
        ncol=_LEGEND_COLUMNS,
        handlelength=1,
        handleheight=0.9,
        columnspacing=1.1,
    )


def _draw_top_view(axis: Any, xy: np.ndarray, value: np.ndarray, ground: _Ground) -> None:
    """Points (N, 2) by the probability of one class, the likeliest on top."""
    order = np.argsort(value)
    x, y = xy.T
    first, second = (x, y) if ground.across else (-y, x)
    axis.set_facecolor(_DARK)
    axis.scatter(
        first[order],
        second[order],
        c=value[order],
        cmap=plotting.SURENESS,
        vmin=0,
        vmax=1,
        s=float(np.clip(6000.0 / max(1, len(value)), 0.25, 3.0)),
        linewidths=0,
    )
    axis.plot([0], [0], marker=">" if ground.across else "^", color="white", markersize=4)
    if ground.across:
        axis.set(xlim=ground.x, ylim=ground.y)
    else:
        axis.set(xlim=(-ground.y[1], -ground.y[0]), ylim=ground.x)
    axis.set_aspect("equal")
    _bare(axis)
    for side in axis.spines.values():
        side.set_edgecolor("#bbbbbb")


def draw_top_views(path: str, scene: Scene) -> None:
    """Figure 6: the panorama, and each merged class's probability from above (x of the lidar up)."""
    plt = plotting.pyplot()
    rows_of = scene.labels.evaluation_classes()
    got = panorama(scene)
    columns = 3 if len(rows_of) in (3, 5, 6, 9) else min(len(rows_of), 4)
    rows = -(-len(rows_of) // columns)
    fused = scene.cloud.fused
    xy = scene.cloud.xyz[fused, :2]
    merged = scene.cloud.probabilities[fused].astype(np.float64) @ scene.labels.merge_matrix()
    ground = _ground(xy)
    width = 7.2
    cell = width / columns
    view_height = (cell * ground.ratio + 0.24) * rows
    top, pano_height = 0.0, 0.0
    if got is not None:
        pano_height = min(_PANORAMA_IN, width * got[0].shape[0] / got[0].shape[1])
        top = pano_height + 0.3 + 0.2 * -(-len(scene.labels) // _LEGEND_COLUMNS) + 0.1
    total = top + view_height + 0.45
    figure = plt.figure(figsize=(width, total))
    if got is not None:
        _draw_panorama(figure, scene, pano_height, got)
    base = view_height + 0.45
    for index, row in enumerate(rows_of):
        upper = base - (index // columns) * view_height / rows
        left, low = (index % columns) / columns, (upper - cell * ground.ratio) / total
        axis = figure.add_axes([left + 0.005, low, 1 / columns - 0.01, cell * ground.ratio / total])
        _draw_top_view(axis, xy, merged[:, index], ground)
        axis.set_xlabel(title_of(row.name), labelpad=2)
        if index == 0:
            _scale_bar(axis)
    scalar = plt.cm.ScalarMappable(cmap=plotting.SURENESS)
    scalar.set_clim(0, 1)
    scale = figure.add_axes([0.25, 0.2 / total, 0.5, 0.09 / total])
    bar = figure.colorbar(scalar, cax=scale, orientation="horizontal")
    bar.set_label("probability of the class", labelpad=1)
    plotting.save(figure, path)


def _scale_bar(axis: Any) -> None:
    """10 m in the upper left corner, readable over points too."""
    (left, right), (bottom, top) = axis.get_xlim(), axis.get_ylim()
    x, y = left + 0.05 * (right - left), bottom + 0.84 * (top - bottom)
    axis.plot([x, x + 10], [y, y], color="white", linewidth=1.2, zorder=4)
    axis.text(
        x + 5,
        y + 0.04 * (top - bottom),
        "10 m",
        ha="center",
        va="bottom",
        fontsize=7,
        color="white",
        bbox={"facecolor": _DARK, "edgecolor": "none", "alpha": 0.85, "pad": 1},
        zorder=5,
    )


class _Request(NamedTuple):
    """What a figure is drawn from. views: those that were asked for; each: a figure of each of
    them, not of the first alone."""

    scene: Scene
    folder: str
    views: List[View]
    each: bool

    def path(self, name: str) -> str:
        return os.path.join(self.folder, name)

    def pick(self, ready: List[View]) -> List[View]:
        return ready if self.each else ready[:1]


def _make_2(request: _Request) -> List[str]:
    drawn = []
    for view in request.pick([view for view in request.views if view.has_uncertainty]):
        drawn.append(request.path("figure2_%s.png" % view.name))
        draw_uncertainty(drawn[-1], view, request.scene.labels)
    return drawn


def _make_3(request: _Request) -> List[str]:
    drawn = []
    for view in request.pick([view for view in request.views if view.has_score_maps]):
        drawn.append(request.path("figure3_%s.png" % view.name))
        draw_score_maps(drawn[-1], view, request.scene.labels)
    return drawn


def _make_5(request: _Request) -> List[str]:
    if not any(view.has_projection for view in request.scene.views):
        return []
    draw_projection(request.path("figure5.png"), request.scene)
    return [request.path("figure5.png")]


def _make_6(request: _Request) -> List[str]:
    draw_top_views(request.path("figure6.png"), request.scene)
    return [request.path("figure6.png")]


# Number of the figure -> what draws it (paths; none if it lacks something), and what it needs.
_MAKERS: Dict[str, Tuple[Callable[[_Request], List[str]], str]] = {
    "2": (_make_2, "fuse_bag --all, and --source with the images"),
    "3": (_make_3, "fuse_bag --all, and the scores (--source)"),
    "5": (_make_5, "--source with images, camera_info and tf"),
    "6": (_make_6, "a scan"),
}
FIGURES = tuple(_MAKERS)


def make(scene: Scene, folder: str, chosen: Tuple[str, ...], camera: Optional[str]) -> List[str]:
    """Draws the figures into a folder; returns their paths. Warns of those that lack something;
    DataError if none can be drawn."""
    plotting.make_folder(folder)
    names = [view.name for view in scene.views]
    if camera is not None and camera not in names:
        raise ConfigError("--camera %s: the rig has %s" % (camera, ", ".join(names) or "none"))
    views = [view for view in scene.views if camera in (None, view.name)]
    request = _Request(scene, folder, views, camera is not None)
    drawn: List[str] = []
    for number in FIGURES:
        if number not in chosen:
            continue
        draw, needs = _MAKERS[number]
        paths = draw(request)
        if not paths:
            cli.warn("figure %s is left out: it needs %s" % (number, needs))
        drawn += paths
    if not drawn:
        raise DataError("no figure could be drawn")
    return drawn
