"""Fits to positions of images: outliers, lines, heights that are missing or wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.surveys import Survey, make_survey

from smust3r_colmap.errors import DegenerateAlignmentError
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.georeferencing.positions import PositionsFit, fit_positions, shape_of
from smust3r_colmap.georeferencing.up_direction import UpDirection, find_up

pytest.importorskip("pyproj")


def fit(
    survey: Survey, local: FloatArray, *, up: UpDirection | None = None, sigma: FloatArray | None = None
) -> PositionsFit:
    unknown = np.full((len(local), 2), np.nan)
    return fit_positions(
        survey.model().centres_model,
        local,
        unknown if sigma is None else sigma,
        names=survey.names,
        up=up,
        rng=np.random.default_rng(0),
    )


def tilt_deg(survey: Survey, found: PositionsFit) -> float:
    turn = found.fit.local_from_model.rotation @ survey.local_from_model.rotation.T
    return float(np.degrees(np.arccos(np.clip(turn[2, 2], -1, 1))))


def up_of(survey: Survey) -> UpDirection:
    model = survey.model()
    up = find_up(model.cam_from_model, np.full((len(model.names), 3), np.nan), model.points_model)
    assert up is not None
    return up


def test_exact_positions_give_the_similarity_back() -> None:
    survey = make_survey(np.random.default_rng(0))
    found = fit(survey, survey.centres_local)
    np.testing.assert_allclose(found.fit.local_from_model.matrix, survey.local_from_model.matrix, rtol=1e-6, atol=1e-6)
    assert (found.left_out, found.without_height, found.up, found.shape) == ({}, {}, None, "block")


@pytest.mark.slow
def test_ten_percent_of_positions_200_m_off_are_named_and_change_little() -> None:
    named, wrongly, differences = 0, 0, []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        survey = make_survey(rng)
        local = survey.centres_local + rng.normal(size=(36, 3)) * [2, 2, 4]
        moved = rng.choice(36, 4, replace=False)
        angles = rng.uniform(0, 2 * np.pi, 4)
        wrong = local.copy()
        wrong[moved, :2] += 200 * np.column_stack([np.cos(angles), np.sin(angles)])
        found, clean = fit(survey, wrong, up=up_of(survey)), fit(survey, local, up=up_of(survey))
        named += len(set(found.left_out) & set(moved.tolist()))
        wrongly += len(set(found.left_out) - set(moved.tolist()))
        centres = survey.model().centres_model
        apart = found.fit.local_from_model.apply(centres) - clean.fit.local_from_model.apply(centres)
        differences.append(float(np.linalg.norm(apart, axis=1).mean()))
    assert (named, wrongly) == (12, 0)
    assert np.mean(differences) < 1.0  # four of 36 positions with errors of 4.5 m fewer


@pytest.mark.slow
def test_sizes_of_the_errors_are_found() -> None:
    factors = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        survey = make_survey(rng, rows=8, columns=10)
        found = fit(survey, survey.centres_local + rng.normal(size=(80, 3)) * [2, 2, 5])
        factors.append((found.factor_h, found.factor_v))
    assert np.mean(factors, axis=0) == pytest.approx([2, 5], rel=0.15)


def test_given_accuracies_are_weights() -> None:
    """Half of the positions are exact to 2 cm and say so; the others are 5 m off."""
    rng = np.random.default_rng(3)
    survey = make_survey(rng)
    sigma = np.where(np.arange(36)[:, None] % 2, [0.02, 0.03], [5.0, 8.0])
    found = fit(survey, survey.centres_local + rng.normal(size=(36, 3)) * sigma[:, [0, 0, 1]], sigma=sigma)
    error = found.fit.local_from_model.apply(survey.model().centres_model) - survey.centres_local
    assert np.abs(error).max() < 0.05


def test_one_height_that_is_wrong_is_left_out_and_its_place_is_kept() -> None:
    rng = np.random.default_rng(4)
    survey = make_survey(rng)
    local = survey.centres_local + rng.normal(size=(36, 3)) * [0.5, 0.5, 0.5]
    local[7, 2] += 60
    found = fit(survey, local)
    assert found.left_out == {}
    assert list(found.without_height) == [7]
    assert "m off" in found.without_height[7]


def test_missing_heights_are_judged_image_by_image() -> None:
    """Half of them have none: no tilt, no mirrored model."""
    rng = np.random.default_rng(5)
    survey = make_survey(rng)
    local = survey.centres_local + rng.normal(size=(36, 3)) * 0.02
    local[::2, 2] = np.nan
    found = fit(survey, local)
    assert tilt_deg(survey, found) < 0.2
    assert found.left_out == {}


@pytest.mark.slow
def test_without_any_height_the_model_is_levelled_by_the_ground() -> None:
    rng = np.random.default_rng(6)
    survey = make_survey(rng)
    local = (survey.centres_local + rng.normal(size=(36, 3)) * 0.5) * [1, 1, np.nan]
    found = fit(survey, local, up=up_of(survey))
    assert tilt_deg(survey, found) < 3
    assert float(found.fit.local_from_model.scale) == pytest.approx(7.3, rel=0.02)
    with pytest.raises(DegenerateAlignmentError, match="no position has a height, and no direction of up is known"):
        fit(survey, local)


@pytest.mark.slow
def test_heights_that_drift_do_not_tilt_a_flight_that_looks_down() -> None:
    rng = np.random.default_rng(7)
    survey = make_survey(rng)
    local = survey.centres_local + rng.normal(size=(36, 3)) * [1, 1, 2]
    local[:, 2] += 0.8 * local[:, 0]
    found = fit(survey, local, up=up_of(survey))
    assert found.tilt_by_heights_deg is not None
    assert found.tilt_by_heights_deg > 12
    assert tilt_deg(survey, found) < 5
    assert float(found.fit.local_from_model.scale) == pytest.approx(7.3, rel=0.04)


@pytest.mark.slow
def test_a_slope_is_not_taken_for_level_where_heights_say_otherwise() -> None:
    """The images look down, the ground is a hillside of 25 degrees: the two do not confirm each other."""
    rng = np.random.default_rng(8)
    survey = make_survey(rng)
    slope = survey.ground_local + np.outer(np.tan(np.radians(25)) * survey.ground_local[:, 0], [0, 0, 1])
    survey = replace(survey, ground_local=slope)
    up = up_of(survey)
    assert not up.confirmed
    found = fit(survey, survey.centres_local + rng.normal(size=(36, 3)) * [0.5, 0.5, 0.5], up=up)
    assert tilt_deg(survey, found) < 1.5


# --------------------------------------------------------------------------- lines and places
@pytest.mark.slow
def test_a_line_of_flight_takes_up_from_the_ground_and_says_so() -> None:
    for seed in range(5):
        rng = np.random.default_rng(seed)
        survey = make_survey(rng, rows=1, columns=15)
        found = fit(survey, survey.centres_local + rng.normal(size=(15, 3)) * [1, 1, 1.5], up=up_of(survey))
        assert found.shape == "line"
        assert found.up is not None
        assert found.up.source == "the plane of the ground, on which the images look down"
        assert tilt_deg(survey, found) < 2


def test_a_line_without_any_direction_of_up_is_refused() -> None:
    rng = np.random.default_rng(1)
    survey = make_survey(rng, rows=1, columns=15)
    with pytest.raises(DegenerateAlignmentError, match="lie on a line"):
        fit(survey, survey.centres_local + rng.normal(size=(15, 3)) * 0.5)


@pytest.mark.slow
def test_positions_at_one_place_are_refused() -> None:
    rng = np.random.default_rng(2)
    survey = make_survey(rng)
    with pytest.raises(DegenerateAlignmentError, match=r"too near to one place|coincide"):
        fit(survey, rng.normal(size=(36, 3)) * 3, up=up_of(survey))
    with pytest.raises(DegenerateAlignmentError):
        fit(survey, np.zeros((36, 3)))


def test_a_receiver_that_stands_still_is_named() -> None:
    rng = np.random.default_rng(3)
    survey = make_survey(rng)
    local = survey.centres_local + rng.normal(size=(36, 3)) * 0.5
    local[30:33] = local[2]
    found = fit(survey, local)
    assert sorted(found.left_out) == [30, 31, 32]
    assert "the same position as flight/DJI_0002.JPG: the receiver stood still" in found.left_out[30]


def test_one_position_is_too_few() -> None:
    survey = make_survey(np.random.default_rng(0))
    with pytest.raises(DegenerateAlignmentError, match="1 position of images can be used; at least 2 are needed"):
        fit_positions(
            survey.model().centres_model[:1],
            survey.centres_local[:1],
            np.full((1, 2), np.nan),
            names=survey.names[:1],
            up=None,
            rng=np.random.default_rng(0),
        )


@pytest.mark.parametrize(
    ("spread", "shape"),
    [((50, 40, 10), "block"), ((50, 40, 0), "plane"), ((50, 0, 0), "line"), ((0.1, 0.1, 0), "point")],
)
def test_shapes(spread: tuple[float, float, float], shape: str) -> None:
    assert shape_of(np.random.default_rng(0).normal(size=(40, 3)) * spread, 0.5) == shape
