"""Cameras adjusted on a subset of the points are as good, and the other points follow them."""

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

from smust3r_colmap.refinement import subset_adjustment
from smust3r_colmap.refinement.bundle_adjustment import adjust, priors_of
from smust3r_colmap.refinement.statistics import Statistics
from smust3r_colmap.refinement.subset_adjustment import adjust_on_subset, subset_of_points

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
    monkeypatch.setattr(subset_adjustment, "TARGET_OBSERVATIONS", 0)
    monkeypatch.setattr(subset_adjustment, "MIN_OBSERVATIONS_PER_IMAGE", ENOUGH)


def error(model: pycolmap.Reconstruction, world: World) -> float:
    """Rms of the camera centres after the best similarity, as a fraction of the extent."""
    poses = poses_of(model)
    _, aligned = fitted(centres_of(np.stack([poses[i] for i in sorted(poses)])), world.centres)
    return rms(aligned, world.centres) / world.extent


def test_subset_has_enough_of_every_image_and_the_longest_tracks(model: pycolmap.Reconstruction) -> None:
    subset = subset_of_points(model, observations_per_image=ENOUGH)
    counts = [subset.image(i).num_points3D for i in subset.reg_image_ids()]
    assert min(counts) >= ENOUGH
    assert subset.compute_num_observations() < 0.6 * model.compute_num_observations()
    assert subset.compute_mean_track_length() > model.compute_mean_track_length()
    assert all(subset.point3D(i).xyz.tolist() == model.point3D(i).xyz.tolist() for i in subset.point3D_ids())
    halves = [
        subset_of_points(model, observations_per_image=10**6, first=half, step=2).point3D_ids() for half in (0, 1)
    ]
    assert not set(halves[0]) & set(halves[1])
    assert set(halves[0]) | set(halves[1]) == set(model.point3D_ids())


@pytest.mark.usefixtures("few_are_enough")
def test_cameras_return_to_the_truth_and_all_points_with_them(model: pycolmap.Reconstruction, world: World) -> None:
    whole = pycolmap.Reconstruction(model)
    assert adjust(whole, priors_of(whole), calibrated=False, max_iterations=30, threads=1)
    before, observations = error(model, world), model.compute_num_observations()
    assert adjust_on_subset(model, priors_of(model), calibrated=False, max_iterations=30, threads=1)
    assert before > 0.01
    assert error(whole, world) < error(model, world) < 1e-3, "0.3 px of noise, and a quarter of the observations"
    assert model.compute_num_observations() == observations
    assert Statistics.of(model).reprojection_error_px < 1.1 * Statistics.of(whole).reprojection_error_px
    assert model.camera(1).params.tolist() != list(CAMERA.params)


@pytest.mark.usefixtures("few_are_enough")
def test_given_intrinsics_stay(model: pycolmap.Reconstruction) -> None:
    assert adjust_on_subset(model, priors_of(model), calibrated=True, max_iterations=30, threads=1)
    assert model.camera(1).params.tolist() == list(CAMERA.params)


def test_where_nothing_can_be_left_out_it_is_the_whole_adjustment(model: pycolmap.Reconstruction) -> None:
    whole = pycolmap.Reconstruction(model)
    assert adjust(whole, priors_of(whole), calibrated=False, max_iterations=5, threads=1)
    assert adjust_on_subset(model, priors_of(model), calibrated=False, max_iterations=5, threads=1)
    assert all(model.point3D(i).xyz.tolist() == whole.point3D(i).xyz.tolist() for i in whole.point3D_ids())
