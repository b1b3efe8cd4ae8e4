"""The covariance of poses: against repeated adjustments, in its gauge, and with bodies in place of images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.tracked_scenes import arc, ball, centres_of, make_world, model_with_true_tracks, poses_of, straight

from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.refinement.bundle_adjustment import Priors, adjust
from smust3r_colmap.refinement.covariance import UNBOUNDED, parameter_covariance, pose_covariance
from smust3r_colmap.refinement.linearised_model import LinearisedModel, similarity_generators

pytestmark = pytest.mark.usefixtures("quiet_pycolmap")


def linear_arc(num_images: int = 8, num_points: int = 80, *, noise_px: float = 0.3) -> LinearisedModel:
    rng = np.random.default_rng(5)
    world = make_world(arc(num_images), ball(num_points, rng), rng, noise_px=noise_px)
    return LinearisedModel.of(model_with_true_tracks(world, world.cam_from_world, rng, noise=0))


def aligned(centres: FloatArray, true: FloatArray) -> FloatArray:
    """(N, 3) what is left of the differences after the similarity that fits them best, to first order."""
    generators = similarity_generators(true - true.mean(axis=0), np.zeros(3))[:, :3].reshape(-1, 7)
    off = (centres - true).ravel()
    return (off - generators @ np.linalg.lstsq(generators, off, rcond=None)[0]).reshape(-1, 3)


@pytest.mark.slow
def test_predicted_errors_are_those_of_repeated_adjustments() -> None:
    # few points, so that hardly any share a cell: then nothing makes the prediction larger than the noise does
    errors, predicted = [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        world = make_world(arc(6), ball(40, rng), rng, noise_px=0.3, seen_part=0.9)
        model = model_with_true_tracks(world, world.cam_from_world, rng, noise=0)
        assert adjust(model, Priors(centres={}, sigma=1), calibrated=True, max_iterations=50, threads=1)
        linear = LinearisedModel.of(model)
        predicted.append(pose_covariance(linear, calibrated=True).position_sigma)
        true = centres_of(world.cam_from_world)
        errors.append(np.linalg.norm(aligned(centres_of(np.stack(list(poses_of(model).values()))), true), axis=1))
    ratio = np.sqrt(np.mean(np.square(errors))) / (np.sqrt(np.mean(np.square(predicted))) * linear.extent)
    assert 0.4 < ratio < 1.3


def test_sigmas_grow_with_the_noise() -> None:
    small, large = (pose_covariance(linear_arc(noise_px=px), calibrated=True).position_sigma for px in (0.1, 0.4))
    assert 2 < np.median(large / small) < 5


def test_adjusted_intrinsics_make_poses_less_certain() -> None:
    linear = linear_arc()
    given, adjusted = (pose_covariance(linear, calibrated=calibrated) for calibrated in (True, False))
    assert (adjusted.position_sigma > given.position_sigma).all()
    assert (adjusted.rotation_sigma_rad > given.rotation_sigma_rad).all()


def test_bodies_of_images_have_nearly_the_same_sigmas() -> None:
    linear = linear_arc(24, 120)
    exact, bodies = (pose_covariance(linear, calibrated=True, max_nodes=nodes).position_sigma for nodes in (24, 12))
    assert 0.5 < np.median(bodies / exact) < 2


def test_the_similarity_of_the_world_has_no_part_in_the_sigmas() -> None:
    linear = linear_arc()
    found = pose_covariance(linear, calibrated=True)
    # of the prior alone they would be UNBOUNDED
    assert found.position_sigma.max() < 0.02 * UNBOUNDED
    assert found.rotation_sigma_rad.max() < 0.02 * UNBOUNDED


def test_roll_about_a_straight_path_comes_from_the_orientations() -> None:
    rng = np.random.default_rng(6)
    points = rng.uniform((-1, -2, 4), (5, 2, 8), (200, 3))
    world = make_world(straight(12), points, rng)
    linear = LinearisedModel.of(model_with_true_tracks(world, world.cam_from_world, rng, noise=0))
    assert np.rad2deg(pose_covariance(linear, calibrated=True).rotation_sigma_rad.max()) < 1


def by_focal_length(linear: LinearisedModel, focal_px: float) -> FloatArray:
    """(M, 2, 1) of the tests' camera; displacements of ``by_distortion`` are a pixel at half the longer side."""
    jacobian: FloatArray = linear.by_distortion[:, :, 2:3] * linear.longer_side_px[0] / 2 / focal_px
    return jacobian


@pytest.mark.slow
def test_the_sigma_of_the_focal_length_is_that_of_repeated_adjustments() -> None:
    found, predicted = [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        world = make_world(arc(6), ball(40, rng), rng, noise_px=0.3, seen_part=0.9)
        model = model_with_true_tracks(world, world.cam_from_world, rng, noise=0)
        loose = Priors(centres=dict(enumerate(world.centres, start=1)), sigma=100 * world.extent)
        assert adjust(model, loose, calibrated=False, max_iterations=100, threads=1)
        linear = LinearisedModel.of(model)
        focal_px = float(model.camera(1).params[0])
        radial = linear.by_distortion[:, :, 3:4]  # it was adjusted, too
        both = np.concatenate([by_focal_length(linear, focal_px), radial], axis=2)
        predicted.append(np.sqrt(parameter_covariance(replace(linear, by_distortion=both))[0, 0]))
        found.append(focal_px)
    spread = np.sqrt(np.mean((np.array(found) - 560.0) ** 2))
    assert 0.4 < spread / np.mean(predicted) < 1.5


def test_parameters_that_a_camera_lacks_change_nothing() -> None:
    linear = linear_arc()
    focal = by_focal_length(linear, 560.0)
    alone = parameter_covariance(replace(linear, by_distortion=focal))
    padded = parameter_covariance(replace(linear, by_distortion=np.concatenate([focal, 0 * focal], axis=2)))
    assert padded[0, 0] == pytest.approx(alone[0, 0], rel=1e-6)
    assert padded[0, 1] == pytest.approx(0, abs=1e-9)


def test_parameters_are_less_certain_with_fewer_points() -> None:
    few, many = (linear_arc(num_points=number) for number in (40, 160))
    variances = [
        parameter_covariance(replace(one, by_distortion=by_focal_length(one, 560.0)))[0, 0] for one in (few, many)
    ]
    assert 1.5 < variances[0] / variances[1] < 16
