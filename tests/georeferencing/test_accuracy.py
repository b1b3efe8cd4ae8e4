"""Figures of residuals by hand."""

from __future__ import annotations

import numpy as np
import pytest

from smust3r_colmap.georeferencing.accuracy import Accuracy

NAN = float("nan")


def test_figures_of_two_residuals() -> None:
    found = Accuracy.of(np.array([[3.0, 4.0, 0.0], [-3.0, -4.0, 12.0]]))
    assert found is not None
    assert found.count == 2
    assert found.mean == pytest.approx((0, 0, 6))
    assert found.rmse == pytest.approx((3, 4, np.sqrt(72)))
    assert found.horizontal == pytest.approx(5)
    assert found.spatial == pytest.approx(np.sqrt((25 + 169) / 2))
    assert (found.ce90, found.le90) == (5, 12)


def test_ninety_percent_are_not_larger() -> None:
    residuals = np.column_stack([np.arange(1.0, 11.0), np.zeros(10), -np.arange(1.0, 11.0)])
    found = Accuracy.of(residuals)
    assert found is not None
    assert (found.ce90, found.le90) == (10, 10)
    assert (np.arange(1, 11) <= found.ce90).mean() >= 0.9


def test_missing_coordinates_do_not_count() -> None:
    found = Accuracy.of(np.array([[1.0, 0.0, NAN], [NAN, NAN, 2.0], [NAN, NAN, NAN]]))
    assert found is not None
    assert (found.count, found.rmse, found.horizontal) == (2, (1, 0, 2), 1)
    assert np.isnan(found.spatial)
    assert Accuracy.of(np.full((2, 3), NAN)) is None
    assert Accuracy.of(np.zeros((0, 3))) is None
