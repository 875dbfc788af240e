# SPDX-License-Identifier: MIT
"""Scores of labelled points: confusion matrices and the calibration of distributions.

`row` is a class of the evaluation's tables (labels.LabelSet.evaluation_classes), R of them;
labels.NO_LABEL marks what has none. All classes add up scan by scan, so that a drive of any length
needs the memory of one scan. A quotient without a denominator is NaN.
"""

from typing import Any, List, Optional, Union

import numpy as np

from semantic_lidar_fusion.labels import NO_LABEL

ECE_BINS = 15
Values = Union[np.ndarray, float]
MIN_PROBABILITY = 1e-12  # where the NLL is clipped


def ratio(numerator: Values, denominator: Values) -> np.ndarray:
    """numerator / denominator in float64, NaN where the denominator is 0."""
    numerator, denominator = np.broadcast_arrays(
        np.asarray(numerator, dtype=np.float64), np.asarray(denominator, dtype=np.float64)
    )
    result = np.full(numerator.shape, np.nan)
    np.divide(numerator, denominator, out=result, where=denominator != 0)
    return result


class Confusion:
    """Counts of points by true and predicted row.

    matrix: (R, R + 1) int64; [i, j] = points of row i taken for row j; the last column counts
    predictions of a discarded class, which are misses of the true row and hits on no other.
    """

    def __init__(self, rows: int):
        self.matrix: np.ndarray = np.zeros((rows, rows + 1), dtype=np.int64)

    def add(self, truth: np.ndarray, predicted: np.ndarray) -> None:
        """truth, predicted: (N,) rows. Points without a true row are left out."""
        rows = len(self.matrix)
        kept = truth != NO_LABEL
        first = truth[kept].astype(np.int64)
        second = np.where(predicted[kept] == NO_LABEL, rows, predicted[kept]).astype(np.int64)
        cells = np.bincount(first * (rows + 1) + second, minlength=rows * (rows + 1))
        self.matrix += cells.reshape(rows, rows + 1)

    def merge(self, other: "Confusion") -> None:
        self.matrix += other.matrix

    @property
    def support(self) -> np.ndarray:
        """(R,) points of each true row."""
        return self.matrix.sum(axis=1)

    @property
    def hits(self) -> np.ndarray:
        """(R,) points of each row that were taken for it."""
        return np.diagonal(self.matrix)

    @property
    def recall(self) -> np.ndarray:
        """(R,) hits / points of the true row."""
        return ratio(self.hits, self.support)

    @property
    def precision(self) -> np.ndarray:
        """(R,) hits / points taken for the row."""
        return ratio(self.hits, self.matrix[:, :-1].sum(axis=0))

    @property
    def f1(self) -> np.ndarray:
        """(R,) 2 hits / (points of the row + points taken for it); NaN without points of it."""
        both = self.support + self.matrix[:, :-1].sum(axis=0)
        return np.where(self.support > 0, ratio(2 * self.hits, both), np.nan)

    @property
    def total(self) -> int:
        return int(self.matrix.sum())

    @property
    def accuracy(self) -> float:
        return float(ratio(self.hits.sum(), self.total))


class VisibleConfusion:
    """Counts for F1*: the truth is every point that a camera really sees.

    confusion: as Confusion, of the seen points; one without a label, or with that of a discarded
    class, is a miss. intruders: (R,) int64, hidden points by the row that they were wrongly taken
    for; a hidden point that has the right label counts for nothing. F1 of fused points alone rises
    when a mask throws hard points away; F1* falls.
    """

    def __init__(self, rows: int):
        self.confusion = Confusion(rows)
        self.intruders: np.ndarray = np.zeros(rows, dtype=np.int64)

    def add(self, truth: np.ndarray, predicted: np.ndarray, seen: np.ndarray) -> None:
        """truth, predicted: (N,) rows, NO_LABEL without one; seen: (N,) bool. Points without a true
        row are left out."""
        self.confusion.add(truth[seen], predicted[seen])
        wrong = ~seen & (truth != NO_LABEL) & (predicted != NO_LABEL) & (predicted != truth)
        self.intruders += np.bincount(predicted[wrong], minlength=len(self.intruders))

    def merge(self, other: "VisibleConfusion") -> None:
        self.confusion.merge(other.confusion)
        self.intruders += other.intruders

    @property
    def f1(self) -> np.ndarray:
        """(R,) 2 hits / (seen points of the row + points taken for it); NaN without seen points."""
        taken = self.confusion.matrix[:, :-1].sum(axis=0) + self.intruders
        both = self.confusion.support + taken
        return np.where(self.confusion.support > 0, ratio(2 * self.confusion.hits, both), np.nan)


def mean_over_rows(values: np.ndarray) -> float:
    """The mean of the rows that have a value; NaN if none has."""
    known = values[~np.isnan(values)]
    return float(known.mean()) if len(known) else float("nan")


class Reliability:
    """How far distributions over the rows can be believed.

    NLL: mean of -ln P(true row), P clipped at 1e-12, nats. Brier: mean of sum_r (P(r) - [r true])^2.
    ECE: sum over 15 equal bins (lower, upper] of confidence of (points in it / all points) * |mean
    confidence - share that is right|. The confidence is the probability of the predicted row, or of
    the class where that is a discarded one (which is never right). Probability on discarded classes
    belongs to no row, so that rows may add up to less than 1.
    """

    def __init__(self, bins: int = ECE_BINS):
        self.count = np.zeros(bins, dtype=np.int64)
        self.confidence_sum = np.zeros(bins)
        self.right_count = np.zeros(bins, dtype=np.int64)
        self._log_loss = 0.0
        self._brier = 0.0

    def add(
        self,
        probabilities: np.ndarray,
        truth: np.ndarray,
        predicted: np.ndarray,
        confidence: np.ndarray,
    ) -> None:
        """probabilities: (N, R) of the rows; truth, predicted: (N,) rows; confidence: (N,). Points
        without a true row are left out."""
        kept = truth != NO_LABEL
        truth, predicted, confidence = truth[kept], predicted[kept], confidence[kept]
        values = probabilities[kept].astype(np.float64)
        index = np.arange(len(truth))
        of_truth = values[index, truth]
        self._log_loss -= float(np.log(np.clip(of_truth, MIN_PROBABILITY, None)).sum())
        values[index, truth] -= 1.0
        self._brier += float(np.square(values).sum())
        bins = len(self.count)
        place = np.clip(np.ceil(confidence.astype(np.float64) * bins) - 1, 0, bins - 1).astype(int)
        self.count += np.bincount(place, minlength=bins)
        self.confidence_sum += np.bincount(place, weights=confidence, minlength=bins)
        self.right_count += np.bincount(place[predicted == truth], minlength=bins)

    def merge(self, other: "Reliability") -> None:
        self.count += other.count
        self.confidence_sum += other.confidence_sum
        self.right_count += other.right_count
        self._log_loss += other._log_loss
        self._brier += other._brier

    @property
    def total(self) -> int:
        return int(self.count.sum())

    @property
    def nll(self) -> float:
        return float(ratio(self._log_loss, self.total))

    @property
    def brier(self) -> float:
        return float(ratio(self._brier, self.total))

    @property
    def mean_confidence(self) -> np.ndarray:
        """(bins,)."""
        return ratio(self.confidence_sum, self.count)

    @property
    def accuracy(self) -> np.ndarray:
        """(bins,) share of points that are right."""
        return ratio(self.right_count, self.count)

    @property
    def ece(self) -> float:
        gap = np.abs(self.confidence_sum - self.right_count).sum()
        return float(ratio(gap, self.total))


class Visibility:
    """What an occlusion mask does to the pairs of a point and a camera in whose image it lies.

    Bit i of each (N,) integer array stands for camera i. Of a truth that is not given there is no
    row.
    """

    def __init__(self) -> None:
        self.hidden = self.hidden_caught = 0
        self.seen = self.seen_lost = 0
        self.catchable = self.catchable_caught = 0
        self.has_catchable = False
        self.apart = self.apart_caught = 0
        self.has_apart = False
        self.beside = self.beside_lost = 0
        self.has_silhouette = False

    def merge(self, other: "Visibility") -> None:
        """Adds what another drive has shown."""
        for name, value in vars(other).items():
            mine = getattr(self, name)
            setattr(self, name, mine or value if isinstance(value, bool) else mine + value)

    def add(
        self,
        unmasked: np.ndarray,
        masked: np.ndarray,
        visible: np.ndarray,
        catchable: Optional[np.ndarray] = None,
        silhouette: Optional[np.ndarray] = None,
        apart: Optional[np.ndarray] = None,
    ) -> None:
        """unmasked, masked: cameras that contributed without and with the mask; visible: cameras
        that really see the point; catchable: hidden from the camera by something that the lidar
        has measured beside the line of sight; silhouette: something stands before the point within
        one ring and one azimuth step of the line of sight; apart: farther behind what hides it than
        the default depth margin, so that a mask may hide it (counts where catchable is given)."""
        lost = unmasked & ~masked
        hidden = unmasked & ~visible
        seen = unmasked & visible
        self.hidden += _bits(hidden)
        self.hidden_caught += _bits(hidden & lost)
        self.seen += _bits(seen)
        self.seen_lost += _bits(seen & lost)
        if catchable is not None:
            self.has_catchable = True
            self.catchable += _bits(hidden & catchable)
            self.catchable_caught += _bits(hidden & catchable & lost)
            if apart is not None:
                self.has_apart = True
                self.apart += _bits(hidden & catchable & apart)
                self.apart_caught += _bits(hidden & catchable & apart & lost)
        if silhouette is not None:
            self.has_silhouette = True
            self.beside += _bits(seen & silhouette)
            self.beside_lost += _bits(seen & silhouette & lost)

    def rows(self) -> List[List[Any]]:
        """[what, points, share] for a table."""
        result = [
            ["hidden points caught", self.hidden, float(ratio(self.hidden_caught, self.hidden))]
        ]
        if self.has_catchable:
            share = float(ratio(self.catchable_caught, self.catchable))
            result.append(["catchable hidden points caught", self.catchable, share])
        if self.has_apart:
            share = float(ratio(self.apart_caught, self.apart))
            result.append(["of these, beyond the depth margin", self.apart, share])
        result.append(["visible points lost", self.seen, float(ratio(self.seen_lost, self.seen))])
        if self.has_silhouette:
            for name, count, gone in (
                ("beside", self.beside, self.beside_lost),
                ("off", self.seen - self.beside, self.seen_lost - self.beside_lost),
            ):
                share = float(ratio(gone, count))
                result.append(["visible points lost %s silhouettes" % name, count, share])
        return result


def _bits(values: np.ndarray) -> int:
    """Number of set bits of a (N,) array of 16-bit flags."""
    flags = np.ascontiguousarray(values.astype("<u2"))
    return int(np.unpackbits(flags.view(np.uint8)).sum())
