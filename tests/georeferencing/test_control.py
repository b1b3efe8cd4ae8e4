"""Fits to control points: flat lists, wrong points, roles."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest

from smust3r_colmap.errors import DegenerateAlignmentError
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.sim3 import Sim3
from smust3r_colmap.georeferencing.control import fit_control
from smust3r_colmap.georeferencing.similarity import Correspondences

TRUTH = Sim3(
    scale=np.asarray(4.4),
    rotation=pycolmap.Rotation3d(np.array([0.3, 2.9, 0.2])).matrix(),
    translation=np.array([-35.0, 7.0, 20.0]),
)


def rows(local: FloatArray, *, sigma: tuple[float, float, float] = (0.02, 0.02, 0.03)) -> Correspondences:
    return Correspondences(
        model=TRUTH.inverse().apply(local),
        local=local,
        sigma=np.tile(sigma, (len(local), 1)),
        shifted=np.zeros(len(local), np.bool_),
    )


def field(rng: np.random.Generator, count: int, *, relief: float = 4.0) -> FloatArray:
    return np.column_stack([rng.uniform(-40, 40, (count, 2)), rng.uniform(-relief, relief, count)])


def with_errors(exact: Correspondences, errors: FloatArray) -> Correspondences:
    return Correspondences(model=exact.model, local=exact.local + errors, sigma=exact.sigma, shifted=exact.shifted)


def test_exact_points_give_the_similarity_back() -> None:
    found = fit_control(rows(field(np.random.default_rng(0), 6)))
    np.testing.assert_allclose(found.fit.local_from_model.matrix, TRUTH.matrix, atol=1e-8)
    np.testing.assert_allclose(found.leave_one_out, 0, atol=1e-8)
    assert (found.left_out, found.factor_h, found.factor_v) == ({}, 1, 1)


@pytest.mark.parametrize("height", [0.0, 5.0])
def test_flat_lists_are_fitted(height: float) -> None:
    """pycolmap's ``estimate_sim3d`` returns None where one coordinate of all targets is exactly 0."""
    local = field(np.random.default_rng(1), 5) * [1, 1, 0] + [0, 0, height]
    if height == 0.0:
        assert pycolmap.estimate_sim3d(TRUTH.inverse().apply(local), local) is None
    found = fit_control(rows(local))
    np.testing.assert_allclose(found.fit.local_from_model.matrix, TRUTH.matrix, atol=1e-8)


def test_a_wrong_point_is_found_by_leaving_each_out() -> None:
    """Errors of a metre in a list that says nothing of it, and one point 8 m off."""
    rng = np.random.default_rng(2)
    exact = rows(field(rng, 9))
    errors = rng.normal(size=(9, 3)) * [0.8, 0.8, 0.02]
    errors[4] += [7, 4, 0]
    found = fit_control(with_errors(exact, errors))
    assert list(found.left_out) == [4]
    assert found.left_out[4].endswith("m from where the other points put it")
    assert 6 < float(found.left_out[4].split()[0]) < 11
    assert found.factor_h == pytest.approx(0.8 / 0.02, rel=0.5)


@pytest.mark.slow
def test_two_wrong_points_do_not_hide_each_other() -> None:
    rng = np.random.default_rng(3)
    exact = rows(field(rng, 10))
    errors = rng.normal(size=(10, 3)) * 0.02
    errors[[1, 6], 0] = 5.0
    assert sorted(fit_control(with_errors(exact, errors)).left_out) == [1, 6]


@pytest.mark.slow
@pytest.mark.parametrize("size_m", [0.02, 1.0])
def test_right_points_are_rarely_left_out(size_m: float) -> None:
    """5 % of sets may have one, whether or not the list knows its errors."""
    rng = np.random.default_rng(4)
    alarms = 0
    for _ in range(20):
        exact = rows(field(rng, 7))
        alarms += bool(fit_control(with_errors(exact, rng.normal(size=(7, 3)) * size_m)).left_out)
    assert alarms <= 3


def test_leave_one_out_residuals_are_larger_than_fitted_ones() -> None:
    rng = np.random.default_rng(5)
    noisy = with_errors(rows(field(rng, 6)), rng.normal(size=(6, 3)) * 0.02)
    found = fit_control(noisy)
    fitted = found.fit.residuals(noisy)
    assert np.linalg.norm(found.leave_one_out) > 1.3 * np.linalg.norm(fitted)


def test_points_by_plane_or_height_only_hold_what_they_say() -> None:
    """Their other coordinates are wrong by ten metres and do not count."""
    exact = rows(field(np.random.default_rng(6), 8))
    sigma, local = exact.sigma.copy(), exact.local.copy()
    sigma[0, 2], local[0, 2] = np.inf, np.nan
    sigma[1, :2] = np.inf
    local[1, :2] += 10
    mixed = Correspondences(model=exact.model, local=local, sigma=sigma, shifted=exact.shifted)
    found = fit_control(mixed)
    np.testing.assert_allclose(found.fit.local_from_model.matrix, TRUTH.matrix, atol=1e-7)
    assert np.isnan(found.leave_one_out[0, 2])
    assert np.isnan(found.leave_one_out[1, :2]).all()


def test_points_on_a_line_leave_the_turn_open() -> None:
    local = np.column_stack([np.linspace(-40, 40, 6), np.zeros(6), np.zeros(6)])
    assert fit_control(rows(local)).fit.tilt_sigma_deg > 1000
    assert abs(fit_control(rows(local)).fit.weakest_axis[0]) == pytest.approx(1, abs=1e-6)


def test_the_one_point_beside_a_line_is_not_taken_for_wrong() -> None:
    """Without it the turn about the line is open, so the others cannot say where it belongs."""
    rng = np.random.default_rng(8)
    on_line = np.column_stack([np.linspace(-40, 40, 6), np.zeros(6), np.zeros(6)])
    exact = rows(np.vstack([on_line, [[0, 25, 1]]]))
    found = fit_control(with_errors(exact, rng.normal(size=(7, 3)) * 0.02))
    assert found.left_out == {}
    assert np.isnan(found.leave_one_out[6]).all()
    assert found.fit.tilt_sigma_deg < 1


def test_two_points_are_too_few() -> None:
    with pytest.raises(DegenerateAlignmentError, match="2 control points with three coordinates are in the model; at"):
        fit_control(rows(field(np.random.default_rng(7), 2)))
