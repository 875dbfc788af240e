# SPDX-License-Identifier: MIT
"""Classes against geometry that no network mistakes: what lies on the ground is ground, what stands
high above it is not, no lidar point is sky; and borders of classes against edges of the image."""

from typing import Dict, List, Optional, Sequence, Tuple

import numpy as np

from semantic_lidar_fusion.bags.cloud_io import FUSED
from semantic_lidar_fusion.bags.poses import transform_points
from semantic_lidar_fusion.labels import LabelSet
from semantic_lidar_fusion.rigcheck import alignment, scenes
from semantic_lidar_fusion.rigcheck.findings import Finding, Verdict
from semantic_lidar_fusion.rigcheck.sample import CameraSample, Sample

GROUND_WORDS = (
    *("road", "pavement", "sidewalk", "terrain", "grass", "ground", "undrivable", "dirt", "mud"),
    *("lane", "parking", "asphalt", "concrete", "gravel", "puddle", "water", "floor"),
)
GROUND_BAND_M, HIGH_M, NEAR_M = 0.15, 3.0, 15.0
MIN_POINTS = 150
# Labels of one thing and its surroundings (a target, a person) say nothing of the ground: so many
# classes must have this share of the points.
MIN_CLASSES, MIN_CLASS_SHARE = 3, 0.01
# Verges and hedges lie on the ground too: between the two shares nothing can be said.
WRONG_GROUND_SHARE, MIN_GROUND_SHARE = 0.25, 0.5
MAX_HIGH_SHARE, MAX_SKY_SHARE = 0.25, 0.1
FLIP_GAIN = 0.08
# By how much shifted ids must fit better, and how well then; or by how much however well.
SHIFT_GAIN, SHIFT_FIT, SHIFT_FAR_GAIN = 0.15, 0.5, 0.5


def _ids(labels: LabelSet, words: Sequence[str]) -> List[int]:
    return [i for i, name in enumerate(labels.names) if any(word in name for word in words)]


def findings(sample: Sample, labels: LabelSet, misaligned: Sequence[str]) -> List[Finding]:
    """`misaligned`: cameras whose extrinsics are known to be wrong; their classes say nothing."""
    result: List[Finding] = []
    geometry = _classes_by_height(sample)
    for bit, camera in enumerate(sample.cameras):
        orientation = _orientation(camera)
        if orientation is not None:
            result.append(orientation)
        if camera.name in misaligned or bit not in geometry:
            continue
        if orientation is not None and orientation.verdict == Verdict.WRONG:
            continue
        result += _one_camera(camera.name, geometry[bit], labels)
    return result


def _classes_by_height(sample: Sample) -> Dict[int, Tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Of each camera's own points (no other camera sees them): labels on the ground, high above it,
    and all."""
    parts: Dict[int, List[Tuple[np.ndarray, np.ndarray, np.ndarray]]] = {}
    T_vehicle_lidar = sample.T_vehicle_lidar()
    if T_vehicle_lidar is None:
        return {}
    for cloud in sample.fused.values():
        cameras = cloud.optional("cameras")
        points = transform_points(T_vehicle_lidar, cloud.xyz)
        ground = scenes.ground_of(points)
        if cameras is None or ground is None:
            continue
        height = points[:, 2] - ground.height_m
        near = np.hypot(points[:, 0], points[:, 1]) < NEAR_M
        for bit in range(len(sample.cameras)):
            own = (cloud.status == FUSED) & (cameras == (1 << bit))
            parts.setdefault(bit, []).append(
                (
                    cloud.label[own & near & (np.abs(height) < GROUND_BAND_M)],
                    cloud.label[own & (height > HIGH_M)],
                    cloud.label[own],
                )
            )
    return {
        bit: tuple(np.concatenate(column) for column in zip(*entries))  # type: ignore[misc]
        for bit, entries in parts.items()
    }


def _one_camera(
    name: str, labels_by_height: Tuple[np.ndarray, np.ndarray, np.ndarray], labels: LabelSet
) -> List[Finding]:
    on_ground, high, every = labels_by_height
    grounds, skies = _ids(labels, GROUND_WORDS), _ids(labels, ("sky",))
    if not grounds or len(on_ground) < MIN_POINTS:
        figure = "%d points on the ground" % len(on_ground)
        if not grounds:
            figure = "no class of the set is known as ground"
        return [Finding(name, "classes", Verdict.NOT_OBSERVABLE, figure)]
    counts = np.bincount(every)
    used = int((counts >= MIN_CLASS_SHARE * len(every)).sum())
    if used < MIN_CLASSES:
        figure = "only %d of the classes have %.0f %% of the points" % (used, 100 * MIN_CLASS_SHARE)
        return [Finding(name, "classes", Verdict.NOT_OBSERVABLE, figure)]
    share = float(np.isin(on_ground, grounds).mean())
    high_share = float(np.isin(high, grounds).mean()) if len(high) >= MIN_POINTS else 0.0
    sky = float(np.isin(every, skies).mean()) if len(every) else 0.0
    figure = "%.0f %% of the points on the ground are ground, %.0f %% of those %.0f m above it" % (
        100 * share,
        100 * high_share,
        HIGH_M,
    )
    by = _shift(on_ground, high, every, grounds, skies)
    if by:
        cause = "class ids are one too %s (the ground is called %s)" % (
            "high" if by > 0 else "low",
            _commonest(on_ground, labels),
        )
        cure = "use the class set whose order is the network's (with or without background first)"
        return [Finding(name, "classes", Verdict.WRONG, figure, cause, cure)]
    if WRONG_GROUND_SHARE <= share < MIN_GROUND_SHARE:
        return [Finding(name, "classes", Verdict.NOT_OBSERVABLE, figure)]
    if share < WRONG_GROUND_SHARE:
        cause = (
            "the ground is called %s: the score channels have another order than the class set"
            % _commonest(on_ground, labels)
        )
        cure = "put the classes of the rig in the network's order"
        return [Finding(name, "classes", Verdict.WRONG, figure, cause, cure)]
    if high_share > MAX_HIGH_SHARE:
        cause = "ground is seen high above the ground: the labels lie beside their points"
        cure = "see the alignment of this camera"
        return [Finding(name, "classes", Verdict.SUSPECT, figure, cause, cure)]
    result = [Finding(name, "classes", Verdict.OK, figure)]
    figure = "%.1f %% of the fused points are sky" % (100 * sky)
    if sky > MAX_SKY_SHARE:
        cause = "a lidar point cannot be sky: extrinsics, times or the score map are off"
        cure = "see the alignment of this camera"
        result.append(Finding(name, "sky", Verdict.SUSPECT, figure, cause, cure))
    else:
        result.append(Finding(name, "sky", Verdict.OK, figure))
    return result


def _commonest(on_ground: np.ndarray, labels: LabelSet) -> str:
    values, counts = np.unique(on_ground, return_counts=True)
    label = int(values[np.argmax(counts)])
    return labels.names[label] if label < len(labels) else str(label)


def _shift(
    on_ground: np.ndarray,
    high: np.ndarray,
    every: np.ndarray,
    grounds: List[int],
    skies: List[int],
) -> int:
    """1 or -1 if ids that much too high or low fit the geometry clearly better; else 0."""

    def fit(by: int) -> float:
        on, up, all_of = (part.astype(int) - by for part in (on_ground, high, every))
        result = float(np.isin(on, grounds).mean())
        if len(up) >= MIN_POINTS:
            result -= float(np.isin(up, grounds).mean())
        return result - float(np.isin(all_of, skies).mean())

    as_it_is = fit(0)
    best = max((1, -1), key=fit)
    gain = fit(best) - as_it_is
    clear = gain > SHIFT_FAR_GAIN or (gain > SHIFT_GAIN and fit(best) > SHIFT_FIT)
    return best if clear else 0


def class_map(pixels: np.ndarray) -> np.ndarray:
    """(H, W) the most likely class of scores (H, W, C), or a label image itself."""
    return pixels.argmax(axis=2) if pixels.ndim == 3 else pixels


def _orientation(camera: CameraSample) -> Optional[Finding]:
    """Whether the borders of the classes meet the image's edges as they are, or flipped."""
    pairs = [
        (camera.images[stamp], class_map(pixels))
        for stamp, pixels in camera.semantics.items()
        if stamp in camera.images
    ][:8]
    if not pairs:
        return None
    flips = {
        "as it is": lambda m: m,
        "mirrored left to right": lambda m: m[:, ::-1],
        "upside down": lambda m: m[::-1],
        "turned by 180 deg": lambda m: m[::-1, ::-1],
    }
    lifts = {name: 0.0 for name in flips}
    for image, classes in pairs:
        edges = alignment.image_edges(image)
        for name, flip in flips.items():
            lifts[name] += _border_lift(flip(classes), edges) / len(pairs)
    best = max(lifts, key=lambda key: lifts[key])
    figure = "borders of classes meet image edges with %.2f" % lifts["as it is"]
    if best != "as it is" and lifts[best] > lifts["as it is"] + FLIP_GAIN:
        figure += ", with %.2f %s" % (lifts[best], best)
        cause = "the score map is %s against the image" % best
        return Finding(
            camera.name,
            "score map",
            Verdict.WRONG,
            figure,
            cause,
            "flip it in the segmentation node",
        )
    if lifts[best] < 0.03:
        return Finding(camera.name, "score map", Verdict.NOT_OBSERVABLE, figure)
    return Finding(camera.name, "score map", Verdict.OK, figure)


def _border_lift(classes: np.ndarray, edges: alignment.ImageEdges) -> float:
    import cv2

    size = (edges.value.shape[1], edges.value.shape[0])
    large = cv2.resize(
        classes.astype(np.int32).astype(np.float32), size, interpolation=cv2.INTER_NEAREST
    )
    border = np.zeros(large.shape, dtype=bool)
    border[:, 1:] |= large[:, 1:] != large[:, :-1]
    border[1:] |= large[1:] != large[:-1]
    if not border.any():
        return 0.0
    hit, chance = float(edges.value[border].mean()), float(edges.chance[border].mean())
    return (hit - chance) / max(1.0 - chance, 1e-6)
