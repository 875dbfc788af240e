# SPDX-License-Identifier: MIT
"""The parts of evaluate.py --map by hand."""

import numpy as np

from semantic_lidar_fusion.labels import ClassInfo, LabelSet
from semantic_lidar_fusion.evaluation.map_scoring import (
    TrueVoxels,
    VoxelIndex,
    compare_weights,
    iou,
)
from semantic_lidar_fusion.evaluation.metrics import Confusion
from semantic_lidar_fusion.maps.semantic_map import MapConfig, VoxelMap

LABELS = LabelSet([ClassInfo("road", (1, 2, 3), False), ClassInfo("wall", (4, 5, 6), False)])


def test_voxels_are_found_by_their_indices():
    indices = np.array([[5, -3, 0], [31250000, 2, 1], [5, -3, 1], [-7, 0, 0]])
    index = VoxelIndex(indices)
    asked = np.array([[5, -3, 1], [5, -2, 0], [-7, 0, 0], [31250000, 2, 1], [10**9, 0, 0]])
    assert index.find(asked).tolist() == [2, -1, 3, 1, -1]
    assert VoxelIndex(np.zeros((0, 3), dtype=np.int64)).find(asked).tolist() == [-1] * 5


def test_iou_by_hand():
    confusion = Confusion(3)
    confusion.add(np.array([0, 0, 0, 1, 1]), np.array([0, 0, 1, 1, 255]))
    values = iou(confusion)
    assert values[0] == 2 / 3 and values[1] == 1 / 3 and np.isnan(values[2])


def test_the_least_nll_is_at_the_weight_that_is_right():
    """Voxels seen four times by the same, whole error of one frame: a quarter is the right weight."""
    random = np.random.default_rng(2)
    count, repeats = 4000, 4
    truth = random.integers(0, 2, count)
    confidence = random.uniform(0.55, 0.95, count)
    right = random.uniform(size=count) < confidence
    seen = np.where(right, truth, 1 - truth)
    p = np.empty((count, 2), dtype=np.float32)
    p[np.arange(count), seen], p[np.arange(count), 1 - seen] = confidence, 1 - confidence
    xyz = np.zeros((count, 3), dtype=np.float32)
    xyz[:, 0] = np.arange(count) + 0.5
    voxels = VoxelMap(
        MapConfig(
            voxel_size_m=1.0, weight=1.0, floor=1e-3, clamp=50.0, max_range_m=0, ray_range_m=0
        ),
        LABELS,
    )
    for _ in range(repeats):
        zeros = np.zeros(count)
        voxels.integrate_columns(list(xyz.T), zeros, zeros, p, np.eye(4), 0)
    indices = np.zeros((count, 3), dtype=np.int64)
    indices[:, 0] = np.arange(count)
    scores = compare_weights(
        voxels,
        LABELS,
        TrueVoxels(VoxelIndex(indices), *[truth.astype(np.uint8)] * 2, indices, np.ones(count)),
    )
    assert min(scores, key=lambda score: score.nll).weight == 0.25
