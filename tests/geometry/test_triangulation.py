"""The angle that decides how well rays determine a point."""

from __future__ import annotations

import numpy as np
import pytest

from smust3r_colmap.geometry.triangulation import triangulation_angle_deg


def test_the_angle_is_the_largest_of_any_two_rays() -> None:
    point = np.array([0.0, 0.0, 2.0])
    centres = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 2.0], [1.0, 0.0, 1.0]])
    assert triangulation_angle_deg(point, centres) == pytest.approx(90)
    assert triangulation_angle_deg(point, centres[:1]) == pytest.approx(0, abs=1e-6)
