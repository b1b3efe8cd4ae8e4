"""Robust scales and medians: right on Gaussian noise, and little moved by outliers."""

from __future__ import annotations

import numpy as np
import pytest

from smust3r_colmap.estimators.robust import RobustLoss, mad_sigma, robust_scale, trimmed_median, weighted_median
from smust3r_colmap.geometry.arrays import FloatArray


def with_outliers(share: float, count: int = 20_000) -> FloatArray:
    """Standard normal values, and a share of one-sided outliers between 2 and 12."""
    rng = np.random.default_rng(0)
    num_outliers = round(share * count)
    return np.concatenate([rng.normal(size=count - num_outliers), rng.uniform(2, 12, num_outliers)])


@pytest.mark.parametrize(("share", "bias"), [(0.0, 0.02), (0.2, 0.05), (0.3, 0.09), (0.4, 0.17)])
def test_trimmed_median_and_scale_survive_one_sided_outliers(share: float, bias: float) -> None:
    values = with_outliers(share)
    assert abs(trimmed_median(values)) < bias
    assert robust_scale(np.abs(values)) == pytest.approx(1, abs=max(bias, 0.02))
    if share > 0.2:
        assert np.median(values) > 3 * bias
        assert mad_sigma(values) > 1.4


def test_integer_weights_are_repetitions() -> None:
    rng = np.random.default_rng(1)
    values, times = np.abs(rng.normal(size=50)), rng.integers(1, 4, 50)
    assert robust_scale(values, times.astype(np.float64)) == robust_scale(np.repeat(values, times))


def test_scale_has_a_floor_and_is_infinite_where_most_residuals_are() -> None:
    assert robust_scale(np.zeros(5), floor=1e-9) == 1e-9
    assert robust_scale(np.array([1.0, np.inf, np.inf])) == np.inf
    assert robust_scale(np.array([1.0, 1.0, np.inf])) == pytest.approx(1.4826)


def test_equal_weights_give_the_plain_median() -> None:
    for count in (1, 2, 9, 10):
        values = np.random.default_rng(count).normal(size=count)
        assert weighted_median(values, np.full(count, 0.3)) == pytest.approx(np.median(values), abs=1e-12)


def test_median_of_nothing_is_not_a_number() -> None:
    assert np.isnan(trimmed_median(np.empty(0)))


def test_the_weighted_median_follows_the_weight() -> None:
    values = np.array([1.0, 2.0, 30.0])
    assert weighted_median(values, np.array([1.0, 1.0, 1.0])) == 2.0
    assert weighted_median(values, np.array([1.0, 1.0, 100.0])) == pytest.approx(30.0, abs=1.0)
    assert weighted_median(np.array([5.0]), np.array([0.1])) == 5.0


def test_huber_needs_a_positive_constant() -> None:
    with pytest.raises(ValueError, match=r"huber_delta .* must be positive"):
        RobustLoss(kernel="huber", huber_delta=0.0)
