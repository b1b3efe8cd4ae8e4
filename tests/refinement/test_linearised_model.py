"""The linearised bundle adjustment: Jacobians against differences, the gauge, and the weights of cells."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest
from helpers.tracked_scenes import CAMERA, arc, ball, make_world, model_with_true_tracks
from scipy.spatial.transform import Rotation

from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.refinement.linearised_model import (
    CELLS,
    TARGET_OBSERVATIONS,
    LinearisedModel,
    similarity_generators,
)

NOISE_PX = 0.3


def round_a_ball(num_points: int = 60, *, noise_px: float = NOISE_PX) -> pycolmap.Reconstruction:
    rng = np.random.default_rng(3)
    world = make_world(arc(6), ball(num_points, rng), rng, noise_px=noise_px)
    return model_with_true_tracks(world, world.cam_from_world, rng, noise=0)


def projected(model: pycolmap.Reconstruction, centre: FloatArray, turn: FloatArray, point: FloatArray) -> FloatArray:
    """Of the first image, whose centre and orientation are changed, in pixels."""
    world_from_cam = invert_rigid(model.image(1).cam_from_world().matrix()[None])[0]
    rotation = Rotation.from_rotvec(turn).as_matrix() @ world_from_cam[:, :3]
    in_camera = (point - world_from_cam[:, 3] - centre) @ rotation
    (xy,) = CAMERA.xy_img(in_camera[None])
    return np.asarray(xy, dtype=np.float64)


def test_jacobians_are_those_of_differences() -> None:
    model = round_a_ball()
    linear = LinearisedModel.of(model)
    first = int(np.flatnonzero(linear.image_of == 0)[0])
    point = linear.points[linear.point_of[first]] * linear.extent + linear.middle
    zero, step = np.zeros(3), 1e-5
    for axis, unit in enumerate(np.eye(3)):
        by_centre = projected(model, unit * step, zero, point) - projected(model, -unit * step, zero, point)
        by_turn = projected(model, zero, unit * step, point) - projected(model, zero, -unit * step, point)
        by_point = projected(model, zero, zero, point + unit * step) - projected(model, zero, zero, point - unit * step)
        expected = by_centre / (2 * step) * linear.extent
        np.testing.assert_allclose(linear.by_pose[first, :, axis], expected, rtol=1e-4, atol=1e-2)
        np.testing.assert_allclose(linear.by_pose[first, :, 3 + axis], by_turn / (2 * step), rtol=1e-4, atol=1e-2)
        expected = by_point / (2 * step) * linear.extent
        np.testing.assert_allclose(linear.by_point[first, :, axis], expected, rtol=1e-4, atol=1e-2)


def test_a_similarity_of_the_world_changes_no_residual() -> None:
    linear = LinearisedModel.of(round_a_ball())
    origin = np.array([0.3, -0.2, 0.1])
    of_cameras = similarity_generators(linear.centres, origin)[linear.image_of]
    of_points = similarity_generators(linear.points, origin)[:, :3][linear.point_of]
    change = linear.by_pose @ of_cameras + linear.by_point @ of_points
    assert np.abs(change).max() < 1e-6 * np.abs(linear.by_pose).max()


def test_observations_of_one_cell_weigh_as_one() -> None:
    linear = LinearisedModel.of(round_a_ball(400, noise_px=0.0))
    in_first = linear.weights[linear.image_of == 0]
    assert len(in_first) > 100
    xy = np.array([p.xy for p in round_a_ball(400, noise_px=0.0).image(1).get_observation_points2D()])
    cells = {tuple(cell) for cell in np.floor(xy * CELLS / 640).astype(int)}
    assert in_first.sum() <= len(cells)
    assert in_first.sum() > 0.8 * len(cells)


def test_noise_is_that_of_the_observations() -> None:
    # the Cauchy loss takes a part of it
    assert LinearisedModel.of(round_a_ball(300)).noise_px == pytest.approx(NOISE_PX, rel=0.25)


def test_images_with_many_observations_are_thinned_and_those_with_few_are_not() -> None:
    few, many = LinearisedModel.of(round_a_ball(100)), LinearisedModel.of(round_a_ball(1500))
    assert len(few.points) == round_a_ball(100).num_points3D()
    counts = np.bincount(many.image_of)
    assert counts.max() < 2 * TARGET_OBSERVATIONS
    assert counts.min() > 0.8 * TARGET_OBSERVATIONS
