"""Cameras adjusted on a part of the points stand as well, and the other points follow them."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest
from helpers.tracked_scenes import (
    CAMERA,
    World,
    arc,
    ball,
    centres_of,
    disturbed_around_the_truth,
    fitted,
    make_world,
    model_with_true_tracks,
    poses_of,
    rms,
)

from smust3r_colmap.refinement import subset_adjustment as part_adjustment
from smust3r_colmap.refinement.bundle_adjustment import adjust, figures_of, priors_of
from smust3r_colmap.refinement.subset_adjustment import adjust_on_part, part_of

pytestmark = pytest.mark.usefixtures("quiet_pycolmap")

NUM_IMAGES, NUM_POINTS = 14, 600
ENOUGH = 100


@pytest.fixture(scope="module")
def world() -> World:
    rng = np.random.default_rng(1)
    return make_world(arc(NUM_IMAGES), ball(NUM_POINTS, rng), rng)


@pytest.fixture
def model(world: World) -> pycolmap.Reconstruction:
    """Disturbed cameras, points near where they belong, true tracks."""
    rng = np.random.default_rng(2)
    return model_with_true_tracks(world, disturbed_around_the_truth(world, rng), rng, noise=0.02)


@pytest.fixture
def few_are_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(part_adjustment, "OBSERVATIONS", 0)
    monkeypatch.setattr(part_adjustment, "MIN_OBSERVATIONS_PER_IMAGE", ENOUGH)


def error(model: pycolmap.Reconstruction, world: World) -> float:
    """Rms of the camera centres after the best similarity, as a part of the extent."""
    poses = poses_of(model)
    _, aligned = fitted(centres_of(np.stack([poses[i] for i in sorted(poses)])), world.centres)
    return rms(aligned, world.centres) / world.extent


def test_part_has_enough_of_every_image_and_the_longest_tracks(model: pycolmap.Reconstruction) -> None:
    part = part_of(model, observations_per_image=ENOUGH)
    counts = [part.image(i).num_points3D for i in part.reg_image_ids()]
    assert min(counts) >= ENOUGH
    assert part.compute_num_observations() < 0.6 * model.compute_num_observations()
    assert part.compute_mean_track_length() > model.compute_mean_track_length()
    assert all(part.point3D(i).xyz.tolist() == model.point3D(i).xyz.tolist() for i in part.point3D_ids())
    halves = [part_of(model, observations_per_image=10**6, first=half, step=2).point3D_ids() for half in (0, 1)]
    assert not set(halves[0]) & set(halves[1])
    assert set(halves[0]) | set(halves[1]) == set(model.point3D_ids())


@pytest.mark.usefixtures("few_are_enough")
def test_cameras_come_back_and_all_points_with_them(model: pycolmap.Reconstruction, world: World) -> None:
    whole = pycolmap.Reconstruction(model)
    assert adjust(whole, priors_of(whole), calibrated=False, max_iterations=30, threads=1)
    before, observations = error(model, world), model.compute_num_observations()
    assert adjust_on_part(model, priors_of(model), calibrated=False, max_iterations=30, threads=1)
    assert before > 0.01
    assert error(whole, world) < error(model, world) < 1e-3, "0.3 px of noise, and a quarter of the observations"
    assert model.compute_num_observations() == observations
    assert figures_of(model).reprojection_error_px < 1.1 * figures_of(whole).reprojection_error_px
    assert model.camera(1).params.tolist() != list(CAMERA.params)


@pytest.mark.usefixtures("few_are_enough")
def test_given_intrinsics_stay(model: pycolmap.Reconstruction) -> None:
    assert adjust_on_part(model, priors_of(model), calibrated=True, max_iterations=30, threads=1)
    assert model.camera(1).params.tolist() == list(CAMERA.params)


def test_where_nothing_can_be_left_out_it_is_the_whole_adjustment(model: pycolmap.Reconstruction) -> None:
    whole = pycolmap.Reconstruction(model)
    assert adjust(whole, priors_of(whole), calibrated=False, max_iterations=5, threads=1)
    assert adjust_on_part(model, priors_of(model), calibrated=False, max_iterations=5, threads=1)
    assert all(model.point3D(i).xyz.tolist() == whole.point3D(i).xyz.tolist() for i in whole.point3D_ids())
