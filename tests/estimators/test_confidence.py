"""Paper eq. 1 and its unit-free form."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest

from smust3r_colmap.estimators.confidence import ConfidenceWeighting, reweighted

MODES: tuple[ConfidenceWeighting, ...] = get_args(ConfidenceWeighting)


def test_paper_mode_is_equation_1() -> None:
    new_i, new_j = reweighted([2.0, 5.0], [3.0, 1.0], [4.0, 1.0], [4.5, 4.0], mode="paper")
    # w = 2 * 3 / (1 + 0.5) = 4 and 5 * 1 / (1 + 3) = 1.25
    np.testing.assert_allclose(new_i, [8.0, 6.25], rtol=1e-15)
    np.testing.assert_allclose(new_j, [12.0, 1.25], rtol=1e-15)


def test_paper_mode_depends_on_the_unit_and_relative_mode_does_not() -> None:
    rng = np.random.default_rng(0)
    c_i, c_j = rng.uniform(1, 5, (2, 300))
    d_i = rng.uniform(1, 5, 300)
    d_j = d_i * np.exp(rng.normal(0, 0.1, 300))
    for unit_i, unit_j in ((100.0, 100.0), (1.0, 1.7)):
        relative = reweighted(c_i, c_j, d_i, d_j, mode="relative")
        scaled = reweighted(c_i, c_j, unit_i * d_i, unit_j * d_j, mode="relative")
        np.testing.assert_allclose(scaled, relative, rtol=1e-9)
        paper = reweighted(c_i, c_j, d_i, d_j, mode="paper")
        scaled = reweighted(c_i, c_j, unit_i * d_i, unit_j * d_j, mode="paper")
        assert np.abs(np.array(scaled) / paper - 1).max() > 0.3


def test_relative_mode_keeps_agreement_and_halves_at_five_percent() -> None:
    depth_i = np.full(11, 2.0)
    depth_j = np.full(11, 6.0)  # another gauge
    depth_j[3] *= 1.05
    new_i, new_j = reweighted(np.full(11, 4.0), np.full(11, 3.0), depth_i, depth_j, mode="relative")
    agree = np.arange(11) != 3
    np.testing.assert_allclose(new_i[agree], 4.0, rtol=1e-12)
    np.testing.assert_allclose(new_j[agree], 3.0, rtol=1e-12)
    assert 1 + 0.49 * 3 < new_i[3] < 1 + 0.52 * 3
    assert 1 + 0.49 * 2 < new_j[3] < 1 + 0.52 * 2


def test_relative_mode_stays_between_none_and_the_old_confidence() -> None:
    rng = np.random.default_rng(1)
    c_i, c_j = 1 + rng.exponential(20, (2, 1000))
    d_i, d_j = rng.uniform(0.1, 50, (2, 1000))
    for new, old in zip(reweighted(c_i, c_j, d_i, d_j, mode="relative"), (c_i, c_j), strict=True):
        assert (new >= 1).all()
        assert (new <= old).all()
        assert np.median(new) < 0.5 * np.median(old)


def test_common_scale_is_not_moved_by_one_sided_blobs() -> None:
    rng = np.random.default_rng(2)
    d_i = rng.uniform(1, 5, 20_000)
    noise = rng.normal(0, 0.01, d_i.shape)
    d_j = 1.7 * d_i * np.exp(noise)
    d_i = np.where(rng.random(d_i.shape) < 0.3, 1.5 * d_i, d_i)
    new, _ = reweighted(np.full_like(d_i, 3.0), np.full_like(d_i, 3.0), d_i, d_j, mode="relative")
    near, far = (noise < -0.01) & (new > 1.5), (noise > 0.01) & (new > 1.5)
    # errors of both signs lose alike; with the plain median the two differ by 0.2
    assert abs(new[near].mean() - new[far].mean()) < 0.02


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("bad", [np.nan, 0.0, -2.0, np.inf])
def test_pixels_without_depth_keep_their_confidence_and_have_no_say(mode: ConfidenceWeighting, bad: float) -> None:
    rng = np.random.default_rng(3)
    c_i, c_j = rng.uniform(2, 5, (2, 40))
    d_i, d_j = rng.uniform(1, 5, (2, 40))
    full = reweighted(c_i, c_j, d_i, d_j, mode=mode)
    padding = np.full(60, bad)
    padded = reweighted(
        np.append(c_i, np.full(60, 3.0)),
        np.append(c_j, np.full(60, 4.0)),
        np.append(d_i, padding),
        np.append(d_j, np.ones(60)),
        mode=mode,
    )
    np.testing.assert_array_equal(np.array(padded)[:, :40], full)
    np.testing.assert_array_equal(padded[0][40:], 3.0)
    np.testing.assert_array_equal(padded[1][40:], 4.0)


@pytest.mark.parametrize("mode", MODES)
def test_image_without_any_depth_is_left_alone(mode: ConfidenceWeighting) -> None:
    new_i, new_j = reweighted(np.full((2, 3), 2.0), np.full((2, 3), 4.0), np.zeros((2, 3)), np.ones((2, 3)), mode=mode)
    np.testing.assert_array_equal(new_i, 2.0)
    np.testing.assert_array_equal(new_j, 4.0)


def test_off_changes_nothing_and_returns_copies() -> None:
    confidence = np.array([1.0, 7.0])
    new_i, _ = reweighted(confidence, confidence, [1.0, 1.0], [9.0, 1.0], mode="off")
    np.testing.assert_array_equal(new_i, confidence)
    assert not np.shares_memory(new_i, confidence)


def test_maps_of_different_shape_are_refused() -> None:
    with pytest.raises(ValueError, match="differ in shape"):
        reweighted(np.ones((2, 3)), np.ones((2, 3)), np.ones((3, 2)), np.ones((2, 3)), mode="relative")
