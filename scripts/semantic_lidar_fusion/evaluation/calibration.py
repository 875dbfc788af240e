# SPDX-License-Identifier: MIT
"""One constant temperature for distributions that come out too sure or too unsure.

P = softmax(S / tau) with tau = temperature / share^exponent. Whatever the share, a distribution of
temperature 1 gives that of temperature T without its scores: softmax(S / (T tau)) is P^(1 / T),
normalised. That holds for points that one camera saw; means over cameras are only close to it.
"""

import math
from typing import List, NamedTuple, Tuple

import numpy as np
from scipy.optimize import minimize_scalar

from semantic_lidar_fusion.errors import DataError
from semantic_lidar_fusion.labels import NO_LABEL
from semantic_lidar_fusion.evaluation.metrics import MIN_PROBABILITY

MIN_TEMPERATURE, MAX_TEMPERATURE = 0.05, 50.0
MAX_SAMPLES = 60000


class Variant(NamedTuple):
    """A way to the temperature: tau = temperature / share^exponent."""

    name: str
    temperature: float
    exponent: float


def at_temperature(probabilities: np.ndarray, temperature: float) -> np.ndarray:
    """(N, C) distributions of temperature 1 -> float64 distributions of another one."""
    smallest = np.finfo(np.float32).tiny
    scores = np.log(np.clip(probabilities.astype(np.float64), smallest, None)) / temperature
    scores -= scores.max(axis=1, keepdims=True)
    weights = np.exp(scores)
    return weights / weights.sum(axis=1, keepdims=True)


def log_loss(
    probabilities: np.ndarray, truth: np.ndarray, merge: np.ndarray, temperature: float
) -> float:
    """Mean NLL (nats) of the merged rows at a temperature.

    probabilities: (N, C) of temperature 1; truth: (N,) rows; merge: (C, R)."""
    merged = at_temperature(probabilities, temperature) @ merge
    of_truth = merged[np.arange(len(truth)), truth]
    return float(-np.log(np.clip(of_truth, MIN_PROBABILITY, None)).mean())


def fit_temperature(probabilities: np.ndarray, truth: np.ndarray, merge: np.ndarray) -> float:
    """The temperature of least NLL, from 0.05 to 50, to 0.1 %.

    Arguments as for log_loss, all with a true row. Brent's method in ln T, bounded to the
    neighbours of the best place of a coarse grid, for there may be several minima.
    """
    if not len(truth):
        raise DataError("no labelled points with truth to fit a temperature to")

    def loss(log_temperature: float) -> float:
        return log_loss(probabilities, truth, merge, math.exp(log_temperature))

    grid = np.linspace(math.log(MIN_TEMPERATURE), math.log(MAX_TEMPERATURE), 25)
    best = int(np.argmin([loss(value) for value in grid]))
    bounds = (grid[max(0, best - 1)], grid[min(len(grid) - 1, best + 1)])
    found = minimize_scalar(loss, bounds=bounds, method="bounded", options={"xatol": 1e-3})
    return math.exp(found.x)


class Samples:
    """A bounded, evenly drawn part of the points of a drive, to fit to.

    Scans are added whole; above the limit every second kept point goes, and from then on only every
    second new one comes in, so that all scans weigh the same."""

    def __init__(self, limit: int = MAX_SAMPLES):
        self._limit = limit
        self._step = 1
        self._probabilities: List[np.ndarray] = []
        self._truth: List[np.ndarray] = []
        self._count = 0

    def add(self, probabilities: np.ndarray, truth: np.ndarray) -> None:
        """probabilities: (N, C); truth: (N,) rows; points without a true row are left out."""
        kept = np.flatnonzero(truth != NO_LABEL)[:: self._step]
        self._probabilities.append(probabilities[kept].astype(np.float32))
        self._truth.append(truth[kept])
        self._count += len(kept)
        while self._count > self._limit:
            self._step *= 2
            self._probabilities = [part[::2] for part in self._probabilities]
            self._truth = [part[::2] for part in self._truth]
            self._count = sum(len(part) for part in self._truth)

    def arrays(self) -> Tuple[np.ndarray, np.ndarray]:
        """(N, C) distributions and (N,) rows."""
        if not self._truth:
            return np.zeros((0, 1), np.float32), np.zeros(0, np.uint8)
        return np.concatenate(self._probabilities), np.concatenate(self._truth)
