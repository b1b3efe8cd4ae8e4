from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smust3r_colmap.errors import DegenerateAlignmentError
from smust3r_colmap.evaluation.absolute_error import (
    Statistics,
    align_centres,
    align_rotations,
    position_errors,
    rotation_errors_deg,
)
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.sim3 import Sim3

SQUARE = np.array([[0.0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]])


def poses(centres: FloatArray, rotvecs_deg: FloatArray | None = None) -> FloatArray:
    rotvecs = np.zeros_like(centres) if rotvecs_deg is None else np.deg2rad(rotvecs_deg)
    return np.concatenate([Rotation.from_rotvec(rotvecs).as_matrix(), centres[:, :, None]], axis=2)


def test_statistics_of_three_and_four() -> None:
    found = Statistics.of(np.array([3.0, 4.0, 8.0]))
    assert found.rmse == pytest.approx(np.sqrt(89 / 3))
    assert (found.mean, found.median, found.min, found.max) == (5, 4, 3, 8)
    assert found.std == pytest.approx(np.sqrt(14 / 3))  # of the population: (4 + 1 + 9) / 3


def test_errors_without_alignment_are_plain_distances_and_angles() -> None:
    moved = poses(SQUARE + np.array([0, 3, 4]), np.tile([0.0, 0, 30], (4, 1)))
    aligned = align_centres(moved, poses(SQUARE), "none").move_cameras(moved)
    np.testing.assert_allclose(position_errors(aligned, poses(SQUARE)), 5)
    np.testing.assert_allclose(rotation_errors_deg(aligned, poses(SQUARE)), 30)


def test_sim3_takes_scale_away_and_se3_leaves_it() -> None:
    """A square of half side 1 about its middle, of half side 1.5 in the estimate: corners are off by sqrt(2) / 2."""
    turn = Sim3(
        scale=np.asarray(1.5),
        rotation=Rotation.from_rotvec([0.3, 1, -2]).as_matrix(),
        translation=np.array([7.0, 8, 9]),
    )
    reference = poses(SQUARE, np.array([[1.0, 2, 3], [4, 5, 6], [7, 8, 9], [1, 1, 1]]))
    estimate = turn.move_cameras(reference)
    by_sim3 = align_centres(estimate, reference, "sim3")
    assert float(by_sim3.scale) == pytest.approx(1 / 1.5)
    np.testing.assert_allclose(position_errors(by_sim3.move_cameras(estimate), reference), 0, atol=1e-12)
    by_se3 = align_centres(estimate, reference, "se3")
    assert float(by_se3.scale) == 1
    np.testing.assert_allclose(position_errors(by_se3.move_cameras(estimate), reference), np.sqrt(0.5), atol=1e-12)
    np.testing.assert_allclose(rotation_errors_deg(by_se3.move_cameras(estimate), reference), 0, atol=1e-6)


def test_the_average_angle_counts_a_camera_that_is_askew_and_the_aligned_one_does_not() -> None:
    """All cameras are mounted 20 degrees askew in the world: the centres do not show it."""
    askew = np.tile([0.0, 0, 20], (4, 1))
    estimate, reference = poses(SQUARE, askew), poses(SQUARE)
    aligned = align_centres(estimate, reference, "sim3").move_cameras(estimate)
    np.testing.assert_allclose(rotation_errors_deg(aligned, reference), 20, atol=1e-6)
    np.testing.assert_allclose(rotation_errors_deg(align_rotations(estimate, reference), reference), 0, atol=1e-6)


def test_the_mean_rotation_is_the_chordal_one() -> None:
    """Turns of 0, 0, 0 and 40 degrees about one axis: tan of the mean is sin 40 / (3 + cos 40)."""
    estimate = poses(SQUARE, np.array([[0.0, 0, 0], [0, 0, 0], [0, 0, 0], [0, 0, 40]]))
    mean_deg = np.rad2deg(np.arctan2(np.sin(np.deg2rad(40)), 3 + np.cos(np.deg2rad(40))))
    errors_deg = rotation_errors_deg(align_rotations(estimate, poses(SQUARE)), poses(SQUARE))
    np.testing.assert_allclose(errors_deg, [mean_deg, mean_deg, mean_deg, 40 - mean_deg], atol=1e-6)


def test_orientations_without_a_mean_are_refused() -> None:
    """Half turns about x, y and z, and none: their sum is zero."""
    estimate = poses(SQUARE, np.array([[0.0, 0, 0], [180, 0, 0], [0, 180, 0], [0, 0, 180]]))
    with pytest.raises(DegenerateAlignmentError, match="orientations do not determine"):
        align_rotations(estimate, poses(SQUARE))


@pytest.mark.parametrize("kind", ["sim3", "se3"])
def test_centres_in_one_place_are_refused(kind: str) -> None:
    one_place = poses(np.ones((4, 3)))
    with pytest.raises(DegenerateAlignmentError, match="estimate: all 4 camera centres coincide"):
        align_centres(one_place, poses(SQUARE), kind)  # type: ignore[arg-type]
    with pytest.raises(DegenerateAlignmentError, match="reference: all 4 camera centres coincide"):
        align_centres(poses(SQUARE), one_place, kind)  # type: ignore[arg-type]


def test_centres_on_a_line_have_an_error_whatever_the_roll() -> None:
    line = poses(np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [4, 0, 0]]))
    estimate = poses(np.array([[0.0, 0, 0], [0, 2, 0], [0, 4, 0], [0, 8, 0]]))
    fit = align_centres(estimate, line, "sim3")
    np.testing.assert_allclose(position_errors(fit.move_cameras(estimate), line), 0, atol=1e-12)
    assert float(fit.scale) == pytest.approx(0.5)
