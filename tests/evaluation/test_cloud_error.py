from __future__ import annotations

import numpy as np
import pytest

from smust3r_colmap.evaluation.cloud_error import CloudShares, cloud_errors


def test_distances_and_shares_of_a_handful_of_points() -> None:
    """Estimate at 0, 1 and 5 on a line, reference at 0, 2, 3 and 4: to it 0, 1, 1; from it 0, 1, 2, 1."""
    estimated = np.column_stack([[0.0, 1, 5], np.zeros(3), np.zeros(3)])
    reference = np.column_stack([[0.0, 2, 3, 4], np.zeros(4), np.zeros(4)])
    found = cloud_errors(estimated, reference, (0.5, 1.0))
    assert found.to_reference.mean == pytest.approx(2 / 3)
    assert found.to_reference.rmse == pytest.approx(np.sqrt(2 / 3))
    assert found.from_reference.mean == 1
    assert found.chamfer == pytest.approx((2 / 3 + 1) / 2)
    half, one = found.shares
    assert (half.accuracy, half.completeness) == pytest.approx((100 / 3, 25))
    assert half.f_score == pytest.approx(2 * (100 / 3) * 25 / (100 / 3 + 25))
    assert (one.accuracy, one.completeness) == pytest.approx((100, 75))
    assert one.f_score == pytest.approx(2 * 75 * 100 / 175)


def test_nothing_in_common_has_an_f_score_of_0() -> None:
    assert CloudShares(threshold=1, accuracy=0, completeness=0).f_score == 0
