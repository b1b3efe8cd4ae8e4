"""Residuals, angles and parameters of a model with known truth."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest
from helpers.tracked_scenes import CAMERA, arc, ball, make_world, model_with_true_tracks

from smust3r_colmap.report import measure
from smust3r_colmap.report.measure import camera_facts, observe, residual_grid, triangulation_angles_deg

pytestmark = pytest.mark.usefixtures("quiet_pycolmap")


def model(noise_px: float = 0.3) -> pycolmap.Reconstruction:
    rng = np.random.default_rng(4)
    world = make_world(arc(8), ball(400, rng), rng, noise_px=noise_px)
    return model_with_true_tracks(world, world.cam_from_world, rng, noise=0)


def test_residuals_are_the_noise() -> None:
    found = observe(model(0.3))
    assert found.residuals_px.std() == pytest.approx(0.3, rel=0.05)
    assert found.num_observations.sum() == len(found.image_of) == int(found.track_lengths.sum())
    assert found.mean_errors_px.mean() == pytest.approx(found.errors_px.mean(), rel=0.05)
    assert found.down[:, 1].min() > 0.9  # y points down in the helpers' world, too


def test_a_model_without_points_has_no_residuals() -> None:
    bare = model()
    for point in list(bare.points3D):
        bare.delete_point3D(point)
    found = observe(bare)
    assert (len(found.image_of), len(found.xyz), len(found.angles_deg)) == (0, 0, 0)
    assert np.isnan(found.mean_errors_px).all()
    (camera,) = camera_facts(bare, found, calibrated=False, at_most=4)
    assert np.isnan(camera.sigmas).all()
    assert len(camera.correlation) == 0


def test_angles_are_the_largest_between_two_rays() -> None:
    centres = np.array([[-1.0, 0, 0], [0, 0, 0], [1, 0, 0]])
    xyz = np.array([[0.0, 0, 1], [0, 0, 5]])
    image_of, point_of = np.array([0, 1, 2, 1]), np.array([0, 0, 0, 1])
    assert triangulation_angles_deg(xyz, centres, image_of, point_of) == pytest.approx([90])


def test_cells_have_the_mean_of_their_residuals_and_few_have_none() -> None:
    xy = np.array([[10.0, 10.0]] * 20 + [[310.0, 230.0]] * 19)
    residuals = np.array([[0.5, -0.25]] * 20 + [[1.0, 1.0]] * 19)
    means, counts = residual_grid(xy, residuals, 320, 240)
    assert means.shape == (12, 16, 2)
    assert means[0, 0] == pytest.approx([0.5, -0.25])
    assert np.isnan(means[11, 15]).all()
    assert (counts[0, 0], counts[11, 15], counts.sum()) == (20, 19, 39)


def test_a_principal_point_in_the_middle_is_fixed_and_the_others_have_sigmas() -> None:
    one = model()
    (camera,) = camera_facts(one, observe(one), calibrated=False, at_most=4)
    assert camera.names == ("f", "cx", "cy", "k")
    assert camera.values == pytest.approx(CAMERA.params)
    assert camera.free == (0, 3)
    assert np.isnan(camera.sigmas[1:3]).all()
    assert 0.05 < camera.sigmas[0] < 5
    assert np.diag(camera.correlation) == pytest.approx([1, 1])
    assert camera.num_images == 8


def test_what_images_at_one_place_leave_open_has_no_sigma() -> None:
    rng = np.random.default_rng(4)
    world = make_world(arc(2), ball(200, rng), rng)
    one = model_with_true_tracks(world, np.repeat(world.cam_from_world[:1], 2, axis=0), rng, noise=0)
    (camera,) = camera_facts(one, observe(one), calibrated=False, at_most=4)
    assert not np.isfinite(camera.sigmas[0]) or camera.sigmas[0] > 10


def test_given_cameras_have_no_sigmas() -> None:
    one = model()
    (camera,) = camera_facts(one, observe(one), calibrated=True, at_most=4)
    assert np.isnan(camera.sigmas).all()


def test_of_more_parameters_than_are_solved_for_sigmas_are_not_known(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(measure, "MAX_UNCERTAIN_PARAMETERS", 1)
    one = model()
    (camera,) = camera_facts(one, observe(one), calibrated=False, at_most=4)
    assert np.isnan(camera.sigmas).all()
    assert camera.free == (0, 3)  # adjusted, not fixed


def test_sigmas_grow_with_the_noise() -> None:
    sigmas = []
    for noise_px in (0.1, 0.4):
        one = model(noise_px)
        sigmas.append(camera_facts(one, observe(one), calibrated=False, at_most=1)[0].sigmas[0])
    assert 2 < sigmas[1] / sigmas[0] < 6
