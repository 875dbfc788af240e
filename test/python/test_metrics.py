# SPDX-License-Identifier: MIT
"""Scores against cases worked out by hand, plain loops, and scikit-learn."""
import math

import numpy as np
import pytest

from semantic_lidar_fusion.evaluation import calibration
from semantic_lidar_fusion.errors import DataError
from semantic_lidar_fusion.labels import NO_LABEL
from semantic_lidar_fusion.evaluation.metrics import Confusion, Reliability, Visibility


def random_case(seed, points=4000, rows=5):
    """Truth and predictions in which every row occurs, some without truth, some discarded."""
    random = np.random.RandomState(seed)
    truth = random.randint(0, rows, points).astype(np.uint8)
    predicted = np.where(random.rand(points) < 0.6, truth, random.randint(0, rows, points))
    predicted = predicted.astype(np.uint8)
    truth[random.rand(points) < 0.1] = NO_LABEL
    predicted[random.rand(points) < 0.1] = NO_LABEL
    return truth, predicted


def test_confusion_by_hand():
    #                  hit hit miss  discarded  no truth  third row never true
    truth = np.array([0, 1, 0, 1, NO_LABEL, 1], dtype=np.uint8)
    predicted = np.array([0, 1, 1, NO_LABEL, 0, 2], dtype=np.uint8)
    confusion = Confusion(3)
    confusion.add(truth[:2], predicted[:2])
    confusion.add(truth[2:], predicted[2:])
    assert confusion.matrix.tolist() == [[1, 1, 0, 0], [0, 1, 1, 1], [0, 0, 0, 0]]
    np.testing.assert_allclose(confusion.recall, [1 / 2, 1 / 3, np.nan])
    # A discarded prediction is on nobody's account; the point without truth neither.
    np.testing.assert_allclose(confusion.precision, [1.0, 1 / 2, 0.0])
    np.testing.assert_allclose(confusion.f1, [2 / 3, 2 / 5, np.nan])
    assert confusion.support.tolist() == [2, 3, 0]
    assert confusion.accuracy == pytest.approx(2 / 5)


def test_an_empty_confusion_has_no_scores():
    confusion = Confusion(2)
    confusion.add(np.zeros(0, np.uint8), np.zeros(0, np.uint8))
    assert np.isnan(confusion.recall).all() and np.isnan(confusion.f1).all()
    assert math.isnan(confusion.accuracy)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_confusion_agrees_with_scikit_learn(seed):
    sklearn = pytest.importorskip("sklearn.metrics", reason="scikit-learn is not installed")
    rows = 5
    truth, predicted = random_case(seed, rows=rows)
    confusion = Confusion(rows)
    for part in np.array_split(np.arange(len(truth)), 7):
        confusion.add(truth[part], predicted[part])
    kept = truth != NO_LABEL
    other = np.where(predicted == NO_LABEL, rows, predicted)
    expected = sklearn.confusion_matrix(truth[kept], other[kept], labels=range(rows + 1))
    np.testing.assert_array_equal(confusion.matrix, expected[:rows])
    precision, recall, f1, support = sklearn.precision_recall_fscore_support(
        truth[kept], other[kept], labels=range(rows)
    )
    np.testing.assert_allclose(confusion.precision, precision, rtol=1e-12)
    np.testing.assert_allclose(confusion.recall, recall, rtol=1e-12)
    np.testing.assert_allclose(confusion.f1, f1, rtol=1e-12)
    np.testing.assert_array_equal(confusion.support, support)
    assert confusion.accuracy == pytest.approx(sklearn.accuracy_score(truth[kept], other[kept]))


def distributions(seed, points=3000, rows=5):
    random = np.random.RandomState(seed)
    values = random.gamma(0.5, size=(points, rows)) + 1e-6
    return values / values.sum(axis=1, keepdims=True), random


def reliability_of(probabilities, truth, parts=1, predicted=None, confidence=None):
    predicted = probabilities.argmax(axis=1) if predicted is None else predicted
    confidence = probabilities.max(axis=1) if confidence is None else confidence
    result = Reliability()
    for part in np.array_split(np.arange(len(truth)), parts):
        result.add(probabilities[part], truth[part], predicted[part], confidence[part])
    return result


def test_reliability_by_hand():
    probabilities = np.array([[0.7, 0.3], [0.2, 0.8], [0.65, 0.35], [0.0, 1.0]])
    truth = np.array([0, 0, 1, 0], dtype=np.uint8)
    got = reliability_of(probabilities, truth)
    # The last point gives its truth no chance: clipped at 1e-12.
    expected = -(math.log(0.7) + math.log(0.2) + math.log(0.35) + math.log(1e-12)) / 4
    assert got.nll == pytest.approx(expected, rel=1e-12)
    assert got.brier == pytest.approx((0.18 + 1.28 + 0.845 + 2.0) / 4, rel=1e-12)
    # Bins of 1/15: 0.65 in (9/15, 10/15] is wrong; 0.7 in (10/15, 11/15] is right; 0.8 = 12/15
    # belongs to the bin that ends there and is wrong; 1 is wrong.
    assert np.flatnonzero(got.count).tolist() == [9, 10, 11, 14]
    assert got.ece == pytest.approx((0.65 + 0.3 + 0.8 + 1.0) / 4, rel=1e-12)


def test_discarded_predictions_are_never_right():
    probabilities = np.array([[0.3, 0.1]])  # 0.6 on a discarded class
    truth = np.array([0], dtype=np.uint8)
    predicted = np.array([NO_LABEL], dtype=np.uint8)
    got = reliability_of(probabilities, truth, 1, predicted, np.array([0.6]))
    assert got.nll == pytest.approx(-math.log(0.3))
    assert got.ece == pytest.approx(0.6)


def test_points_without_truth_do_not_count():
    probabilities, random = distributions(4, 50)
    truth = random.randint(0, 5, 50).astype(np.uint8)
    with_holes = np.concatenate([truth, np.full(50, NO_LABEL, np.uint8)])
    both = reliability_of(np.concatenate([probabilities, probabilities]), with_holes, 3)
    alone = reliability_of(probabilities, truth)
    assert both.total == 50
    assert (both.nll, both.brier, both.ece) == pytest.approx((alone.nll, alone.brier, alone.ece))


@pytest.mark.parametrize("seed", [5, 6])
def test_losses_agree_with_scikit_learn(seed):
    sklearn = pytest.importorskip("sklearn.metrics", reason="scikit-learn is not installed")
    probabilities, random = distributions(seed)
    truth = random.randint(0, 5, len(probabilities)).astype(np.uint8)
    got = reliability_of(probabilities, truth, 4)
    expected = sklearn.log_loss(truth, probabilities, labels=range(5))
    assert got.nll == pytest.approx(expected, rel=1e-9)
    # One against the rest, as scikit-learn knows the Brier score for two classes only.
    brier = sum(
        sklearn.brier_score_loss((truth == row).astype(int), probabilities[:, row])
        for row in range(5)
    )
    assert got.brier == pytest.approx(brier, rel=1e-9)


@pytest.mark.parametrize("seed", [7, 8])
def test_expected_calibration_error_agrees_with_a_plain_loop(seed):
    probabilities, random = distributions(seed)
    truth = random.randint(0, 5, len(probabilities)).astype(np.uint8)
    confidence, right = probabilities.max(axis=1), probabilities.argmax(axis=1) == truth
    expected = 0.0
    for number in range(15):
        inside = (confidence > number / 15) & (confidence <= (number + 1) / 15)
        if inside.any():
            gap = abs(confidence[inside].mean() - right[inside].mean())
            expected += inside.mean() * gap
    assert reliability_of(probabilities, truth, 3).ece == pytest.approx(expected, rel=1e-9)


def test_well_calibrated_distributions_have_a_small_error():
    probabilities, random = distributions(9, 60000)
    drawn = (random.rand(60000, 1) > probabilities.cumsum(axis=1)).sum(axis=1)
    truth = np.minimum(drawn, 4).astype(np.uint8)
    # Each bin's share deviates by about sqrt(p (1 - p) / n); over 15 bins that adds up to less
    # than 0.5 * sqrt(15 / 60000) = 0.008.
    assert reliability_of(probabilities, truth).ece < 0.008
    sharpened = calibration.at_temperature(probabilities, 0.5)
    assert reliability_of(sharpened, truth).ece > 0.05


def softmax(scores):
    weights = np.exp(scores - scores.max(axis=1, keepdims=True))
    return weights / weights.sum(axis=1, keepdims=True)


@pytest.mark.parametrize("temperature", [0.3, 1.0, 2.5])
def test_temperature_of_a_softmax_needs_no_scores(temperature):
    random = np.random.RandomState(10)
    scores = random.randn(200, 6) * 4
    share = random.uniform(0.3, 1.0, (200, 1))
    # Whatever the share: tau = 1 / share^2 becomes temperature / share^2.
    got = calibration.at_temperature(softmax(scores * share**2), temperature)
    np.testing.assert_allclose(got, softmax(scores * share**2 / temperature), rtol=1e-9)


def test_scores_beyond_float_do_not_break_the_temperature():
    probabilities = np.array([[1.0, 0.0, 0.0]], dtype=np.float32)
    got = calibration.at_temperature(probabilities, 2.0)
    assert np.isfinite(got).all() and got[0, 0] > 0.99999


@pytest.mark.parametrize("true_temperature", [0.5, 1.0, 3.0])
def test_fit_finds_the_temperature_that_made_the_truth(true_temperature):
    random = np.random.RandomState(11)
    scores = random.randn(40000, 4) * 3
    drawn = random.rand(40000, 1) > softmax(scores / true_temperature).cumsum(axis=1)
    truth = np.minimum(drawn.sum(axis=1), 3).astype(np.uint8)
    got = calibration.fit_temperature(softmax(scores), truth, np.eye(4))
    assert got == pytest.approx(true_temperature, rel=0.03)
    best = calibration.log_loss(softmax(scores), truth, np.eye(4), got)
    for factor in (0.97, 1.03):
        assert calibration.log_loss(softmax(scores), truth, np.eye(4), got * factor) > best


def test_fit_looks_at_merged_rows():
    # Two classes of one row share its probability: only the row matters for the loss.
    probabilities = np.array([[0.4, 0.4, 0.2], [0.1, 0.2, 0.7]])
    merge = np.array([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    truth = np.array([0, 1], dtype=np.uint8)
    loss = calibration.log_loss(probabilities, truth, merge, 1.0)
    assert loss == pytest.approx(-(math.log(0.8) + math.log(0.7)) / 2)


def test_fit_needs_points():
    with pytest.raises(DataError, match="no labelled points"):
        calibration.fit_temperature(np.zeros((0, 3)), np.zeros(0, np.uint8), np.eye(3))


def test_samples_are_bounded_and_even():
    samples = calibration.Samples(limit=1000)
    for scan in range(20):
        probabilities = np.full((400, 2), float(scan), np.float32)
        truth = np.where(np.arange(400) % 4 == 0, NO_LABEL, 1).astype(np.uint8)
        samples.add(probabilities, truth)
    values, truth = samples.arrays()
    assert 500 < len(values) <= 1000 and len(values) == len(truth)
    assert (truth == 1).all()
    counts = np.bincount(values[:, 0].astype(int), minlength=20)
    assert counts.min() > 0.7 * counts.max()


def test_visibility_by_hand():
    visibility = Visibility()
    #           bit 0 hidden, caught; bit 0 hidden, kept; bits 0 and 3 seen, 3 lost; not in view
    unmasked = np.array([0b0001, 0b0001, 0b1001, 0b0000], dtype=np.uint16)
    masked = np.array([0b0000, 0b0001, 0b0001, 0b0000], dtype=np.uint16)
    visible = np.array([0b0000, 0b0010, 0b1001, 0b1111], dtype=np.uint16)
    catchable = np.array([0b0001, 0b0000, 0b1111, 0b0001], dtype=np.uint16)
    visibility.add(unmasked, masked, visible)
    assert visibility.rows() == [
        ["hidden points caught", 2, 0.5],
        ["visible points lost", 2, 0.5],
    ]
    visibility.add(unmasked, masked, visible, catchable)
    assert visibility.rows()[1] == ["catchable hidden points caught", 1, 1.0]
    assert visibility.hidden == 4 and visibility.seen_lost == 2
    near = Visibility()
    near.add(unmasked, masked, visible, catchable, apart=np.zeros(4, dtype=np.uint16))
    near.add(unmasked, masked, visible, catchable, apart=np.full(4, 0b0001, dtype=np.uint16))
    assert near.rows()[2] == ["of these, beyond the depth margin", 1, 1.0]
    # The point whose bit 3 is lost stands beside a silhouette of camera 3, and another not in view.
    silhouette = np.array([0b0000, 0b0000, 0b1000, 0b0001], dtype=np.uint16)
    beside = Visibility()
    beside.add(unmasked, masked, visible, silhouette=silhouette)
    assert beside.rows()[1:] == [
        ["visible points lost", 2, 0.5],
        ["visible points lost beside silhouettes", 1, 1.0],
        ["visible points lost off silhouettes", 1, 0.0],
    ]


def test_visibility_counts_the_highest_camera():
    visibility = Visibility()
    ones = np.full(3, 0xFFFF, dtype=np.uint16)
    visibility.add(ones, ones, ones)
    assert (visibility.seen, visibility.seen_lost) == (48, 0)
    assert math.isnan(visibility.rows()[0][2])
