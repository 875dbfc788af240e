# SPDX-License-Identifier: MIT
"""What records say: distributions, classes, and whether what was seen is still there.

Only reading normalises, clamps and judges; records stay what they are. Arrays are (N, ...) of N
records."""

from typing import NamedTuple, Optional, Tuple

import numpy as np

from semantic_lidar_fusion.labels import NO_LABEL, LabelSet
from semantic_lidar_fusion.maps.records import MAX_PASSES, UNIT, positions
from semantic_lidar_fusion.maps.semantic_map import MapConfig

STATIC, DYNAMIC, GONE = 0, 1, 2  # layers
# So many clouds whose rays cross a voxel after its last return show that nothing is there any more:
# for a voxel of a class that moves by itself; for one without a class or of doubtful class; for one
# whose static class is at least SURE likely. Rays cross leaves, edges and windows, too, so that it
# takes as many crossings as looks besides.
PASSES_DYNAMIC, PASSES_DOUBTFUL, PASSES_SURE = 1, 2, 6
SURE = 0.8


class Reading(NamedTuple):
    """What N records say.

    position: (N, 3) float64, mean of the points; intensity: (N,) float32, mean;
    probabilities: (N, C) float32; label: (N,) uint8, lowest id on ties, 255 = none; confidence:
    (N,) float32, its probability; entropy: (N,) float32, H / ln C. A voxel without a labelled look
    has probabilities and confidence 0 and entropy 1."""

    position: np.ndarray
    intensity: np.ndarray
    probabilities: np.ndarray
    label: np.ndarray
    confidence: np.ndarray
    entropy: np.ndarray


def distributions(records: np.ndarray, config: MapConfig, labels: LabelSet) -> np.ndarray:
    """(N, C) float64 of records with labelled looks; others give the prior."""
    evidence: np.ndarray = records["evidence"] / UNIT
    prior = np.asarray(config.prior, dtype=np.float64)
    returns = labels.returns
    counts: np.ndarray = np.where(returns, np.maximum(evidence, 0.0) + prior, 0.0)
    if config.kind == "log":
        logarithms = np.where(returns, evidence + np.log(prior), -np.inf)
        if len(records):
            logarithms -= logarithms.max(axis=1, keepdims=True)
        counts = np.where(returns, np.exp(np.maximum(logarithms, -config.clamp)), 0.0)
    return counts / counts.sum(axis=1, keepdims=True)


def labels_of(records: np.ndarray, config: MapConfig, labels: LabelSet) -> np.ndarray:
    """(N,) uint8: most likely class, lowest id on ties, 255 = none."""
    # From the whole numbers themselves: rounding cannot decide it.
    prior = np.asarray(config.prior)
    bias = np.log(prior) if config.kind == "log" else prior
    evidence = records["evidence"] + np.rint(bias * UNIT).astype(np.int64)
    evidence[:, ~labels.returns] = np.iinfo(np.int64).min
    label = np.argmax(evidence, axis=1).astype(np.uint8)
    return np.where(records["labelled"] > 0, label, NO_LABEL).astype(np.uint8)


def labels_and_confidences(
    records: np.ndarray, config: MapConfig, labels: LabelSet
) -> Tuple[np.ndarray, np.ndarray]:
    """(N,) uint8 and (N,) float32 of `read`, without the rest (single precision throughout)."""
    label = labels_of(records, config, labels)
    labelled = label != NO_LABEL
    p: np.ndarray = (records["evidence"] * np.float32(1 / UNIT)).astype(np.float32)
    if config.kind == "dirichlet":
        p = np.maximum(p, 0) + np.asarray(config.prior, dtype=np.float32)
    else:
        p += np.log(np.asarray(config.prior)).astype(np.float32)
        p -= p[:, labels.returns].max(axis=1, keepdims=True)
        np.maximum(p, np.float32(-config.clamp), out=p)
        np.exp(np.minimum(p, 0), out=p)
    p[:, ~labels.returns] = 0
    best = p[np.arange(len(p)), np.minimum(label, p.shape[1] - 1)]
    return label, np.where(labelled, best / p.sum(axis=1), np.float32(0)).astype(np.float32)


def layers_of(
    records: np.ndarray,
    label: np.ndarray,
    confidence: np.ndarray,
    config: MapConfig,
    labels: LabelSet,
    is_ground: Optional[np.ndarray] = None,
) -> np.ndarray:
    """(N,) uint8: STATIC, DYNAMIC (its class moves by itself, unless config.dynamic is keep), or GONE
    (rays show that it is no longer there, or it moves and config.dynamic is exclude).

    is_ground: (N,) bool, voxels of the ground, which rays graze and never clear."""
    named = label != NO_LABEL
    moves = named & np.isin(label, labels.dynamic_ids)
    needed = np.full(len(records), PASSES_DOUBTFUL)
    needed[named & ~moves & (confidence >= SURE)] = PASSES_SURE
    needed[moves] = PASSES_DYNAMIC
    passes = records["passes_after"]
    gone = (passes >= needed) & (passes >= np.minimum(records["looks"], MAX_PASSES))
    if is_ground is not None:
        gone &= ~is_ground
    layer = np.full(len(records), STATIC, dtype=np.uint8)
    if config.dynamic != "keep":
        layer[moves] = DYNAMIC if config.dynamic == "apart" else GONE
    layer[gone] = GONE
    return layer


def read(records: np.ndarray, config: MapConfig, labels: LabelSet) -> Reading:
    """Reads records of a map with this (checked) configuration."""
    label = labels_of(records, config, labels)
    labelled = label != NO_LABEL
    p = distributions(records, config, labels)
    confidence = p[np.arange(len(p)), np.minimum(label, p.shape[1] - 1)]
    with np.errstate(divide="ignore", invalid="ignore"):
        entropy = -np.sum(np.where(p > 0, p * np.log(p), 0.0), axis=1)
    entropy = entropy / np.log(p.shape[1]) if p.shape[1] > 1 else np.zeros(len(p))
    count = np.maximum(records["observations"], 1)
    return Reading(
        positions(records, config.voxel_size_m),
        (records["sum_intensity"] / UNIT / count).astype(np.float32),
        np.where(labelled[:, None], p, 0.0).astype(np.float32),
        label,
        np.where(labelled, confidence, 0.0).astype(np.float32),
        np.where(labelled, np.clip(entropy, 0.0, 1.0), 1.0).astype(np.float32),
    )
