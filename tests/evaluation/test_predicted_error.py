from __future__ import annotations

import numpy as np
import pytest

from smust3r_colmap.evaluation.predicted_error import PredictedErrors


def test_shares_within_one_two_and_three_sigma() -> None:
    """Errors of 0.5, 1.5, 2.5 and 9 sigma, with sigmas of different sizes."""
    sigmas = np.array([1.0, 2.0, 4.0, 1.0])
    found = PredictedErrors.of(np.array([0.5, 1.5, 2.5, 9]) * sigmas, sigmas)
    assert found.within == pytest.approx((25, 50, 75))
    assert found.true_rmse == pytest.approx(np.sqrt((0.25 + 9 + 100 + 81) / 4))
    assert found.predicted_rmse == pytest.approx(np.sqrt((1 + 4 + 16 + 1) / 4))


def test_an_error_of_exactly_sigma_is_within_it() -> None:
    assert PredictedErrors.of(np.array([2.0]), np.array([2.0])).within == pytest.approx((100, 100, 100))
