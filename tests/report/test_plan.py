"""The path from above: which way is up, and earlier paths beside the final one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.scenes import some_sim3

from smust3r_colmap.report.plan import earlier_path, plan_axes, points_from_above, read_centres

WALK = np.array([[0.0, 0, 0], [4, 0, 0.2], [4, 0.1, 3], [1, 0, 3]])
"""To the right, then forward, then back to the left, for cameras whose y axis points down."""
DOWN = np.tile([0.0, 1, 0], (4, 1))


def signed_area(xy: np.ndarray) -> float:
    x, y = xy.T
    return float(0.5 * (x @ np.roll(y, -1) - y @ np.roll(x, -1)))


def test_seen_from_above_forward_is_up_and_nothing_is_mirrored() -> None:
    axes = plan_axes(WALK, DOWN)
    assert axes @ axes.T == pytest.approx(np.eye(2))
    assert np.cross(axes[0], axes[1]) == pytest.approx([0, -1, 0])
    xy = WALK @ axes.T
    assert signed_area(xy) > 0  # counter-clockwise: x to the right, z away, seen from -y
    assert xy[0, 0] < xy[:, 0].mean()


def test_of_cameras_that_look_down_the_path_is_seen_along_its_narrowest_direction() -> None:
    turned = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 0, 1], [0, 0, -1]])
    assert np.abs(np.cross(*plan_axes(WALK, turned))) == pytest.approx([0, 1, 0], abs=0.05)


def test_a_single_place_has_axes() -> None:
    axes = plan_axes(np.zeros((3, 3)), DOWN[:3])
    assert axes @ axes.T == pytest.approx(np.eye(2))


def test_an_earlier_path_in_another_frame_lies_on_the_final_one() -> None:
    moved = some_sim3(np.random.default_rng(3)).apply(WALK)
    final = {str(k): centre for k, centre in enumerate(WALK)}
    earlier = {str(k): moved[k] for k in (0, 1, 3)} | {"9": np.ones(3)}
    axes = plan_axes(WALK, DOWN)
    path = earlier_path("before", earlier, final, axes)
    assert path.rows == (0, 1, 3)
    assert path.xy == pytest.approx((WALK @ axes.T)[[0, 1, 3]], abs=1e-6)


def test_centres_go_by_the_text_of_their_times(tmp_path: Path) -> None:
    path = tmp_path / "t.txt"
    path.write_text("# timestamp tx ty tz qx qy qz qw\n0.500000000 1 2 3 0 0 0 1\n2.000000000 4 5 6 0 0 0 1\n")
    found = read_centres(path)
    assert list(found) == ["0.500000000", "2.000000000"]
    assert found["2.000000000"] == pytest.approx([4, 5, 6])


def test_points_lie_in_the_picture_where_they_are() -> None:
    axes = np.array([[1.0, 0, 0], [0, 0, 1.0]])
    picture = points_from_above(np.array([[0.1, 5, 0.1], [9, 9, 9]]), axes, np.zeros(2), np.ones(2))
    assert picture.shape == (300, 300, 4)
    assert np.argwhere(picture[..., 3]).tolist() == [[269, 30]]
