"""The closed-form similarity: exact on exact points, weighted, and symmetric in scale where asked."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.room_overlap import SIMILARITY

from smust3r_colmap.estimators.similarity import CentredPairs, fit_similarity

POINTS = np.random.default_rng(0).normal(size=(40, 3)) * [3.0, 2.0, 1.0] + [10.0, -5.0, 2.0]


def test_exact_points_give_the_similarity_to_rounding() -> None:
    found = fit_similarity(POINTS, SIMILARITY.apply(POINTS))
    np.testing.assert_allclose(found.matrix, SIMILARITY.matrix, atol=1e-12)


def test_points_of_weight_zero_have_no_influence() -> None:
    moved = SIMILARITY.apply(POINTS)
    moved[:10] += 100.0
    found = fit_similarity(POINTS, moved, np.repeat([0.0, 2.0], [10, 30]))
    np.testing.assert_allclose(found.matrix, SIMILARITY.matrix, atol=1e-12)


def test_no_other_similarity_has_a_smaller_weighted_error() -> None:
    rng = np.random.default_rng(1)
    moved, weights = SIMILARITY.apply(POINTS) + rng.normal(size=POINTS.shape), rng.uniform(0.1, 1, len(POINTS))
    found = fit_similarity(POINTS, moved, weights)
    error = weights @ ((found.apply(POINTS) - moved) ** 2).sum(axis=1)
    for step in (*(1e-3 * np.eye(7)), *(-1e-3 * np.eye(7))):
        other = found @ type(found).exp(step)
        assert weights @ ((other.apply(POINTS) - moved) ** 2).sum(axis=1) > error


def test_symmetric_scale_is_the_inverse_for_swapped_sides_and_umeyamas_shrinks_with_noise() -> None:
    rng = np.random.default_rng(2)
    a, b = (POINTS + rng.normal(size=POINTS.shape) for _ in range(2))
    forward, backward, ones = CentredPairs.of(a, b), CentredPairs.of(b, a), np.ones(len(a))
    assert forward.symmetric_scale(ones) * backward.symmetric_scale(ones) == pytest.approx(1, abs=1e-12)
    least_squares = [float(fit_similarity(*sides).scale) for sides in ((a, b), (b, a))]
    assert np.prod(least_squares) < 0.9
