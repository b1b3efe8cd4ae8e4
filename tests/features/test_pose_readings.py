"""Which reading of stored poses the matches agree with, in a world with known cameras."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from helpers.tracked_scenes import CAMERA, World, arc, ball, disturbed, make_world, pairs_within, true_matches
from scipy.spatial.transform import Rotation

from smust3r_colmap.features.guided_verification import MatchedFeatures
from smust3r_colmap.features.pose_readings import AS_COLMAP, agreement, best_reading, readings
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.sim3 import invert_rigid

NUM_IMAGES = 8
OPENGL = np.diag([1.0, -1, -1])


@pytest.fixture(scope="module")
def world() -> World:
    rng = np.random.default_rng(0)
    # Held by hand: on a level orbit of upright cameras, some readings are nearly the same.
    upright = disturbed(arc(NUM_IMAGES), rng, position=0.4, rotation_deg=15)
    # The world of a real model is turned anyhow: with its axes those of the cameras, some readings are the same.
    turn = Rotation.from_euler("xyz", (20, 50, 70), degrees=True).as_matrix()
    poses = np.concatenate([upright[:, :, :3] @ turn, upright[:, :, 3:] + [[0.3], [0.1], [0.5]]], axis=2)
    points = (ball(300, rng) - [0.3, 0.1, 0.5]) @ turn
    return make_world(poses, points, rng)


def features_of(world: World) -> MatchedFeatures:
    matches = {pair: true_matches(world, pair) for pair in pairs_within(range(NUM_IMAGES), 3)}
    return MatchedFeatures(keypoints=dict(enumerate(world.keypoints)), raw=matches, verified=matches)


def with_w_first_for_last(poses: FloatArray) -> FloatArray:
    """As the file is read whose quaternions are written x y z w."""
    x, y, z, w = Rotation.from_matrix(poses[:, :, :3]).as_quat().T
    turned = Rotation.from_quat(np.column_stack([y, z, w, x])).as_matrix()
    return np.concatenate([turned, poses[:, :, 3:]], axis=2)


def centres_for_translations(poses: FloatArray) -> FloatArray:
    return np.concatenate([poses[:, :, :3], invert_rigid(poses)[:, :, 3:]], axis=2)


STORED: dict[str, Callable[[FloatArray], FloatArray]] = {
    AS_COLMAP: lambda poses: poses,
    "poses from camera to world": invert_rigid,
    "camera centres in place of translations": centres_for_translations,
    "OpenGL's camera axes (y up, z backward)": lambda poses: OPENGL @ poses,
    "poses from camera to world and OpenGL's camera axes (y up, z backward)": lambda poses: invert_rigid(
        OPENGL @ poses
    ),
    "quaternions with w last": with_w_first_for_last,
    "poses from camera to world and quaternions with w last": lambda poses: with_w_first_for_last(invert_rigid(poses)),
    "camera centres in place of translations and quaternions with w last": lambda poses: with_w_first_for_last(
        centres_for_translations(poses)
    ),
}


@pytest.mark.parametrize("meant", STORED)
def test_the_reading_that_was_meant_is_named(world: World, meant: str) -> None:
    """With poses as far off as those of a network."""
    rough = disturbed(world.cam_from_world, np.random.default_rng(1), position=0.003 * world.extent, rotation_deg=0.3)
    stored = STORED[meant](rough)
    assert readings(stored)[meant] == pytest.approx(rough)
    cameras = dict.fromkeys(range(NUM_IMAGES), CAMERA)
    agreeing = agreement(features_of(world), dict(enumerate(stored)), cameras, tolerance=0.03)
    assert best_reading(agreeing) == meant
    assert agreeing[meant] > 0.9


def test_poses_that_mean_nothing_have_no_reading(world: World) -> None:
    stored = disturbed(world.cam_from_world, np.random.default_rng(1), position=3, rotation_deg=120)
    cameras = dict.fromkeys(range(NUM_IMAGES), CAMERA)
    agreeing = agreement(features_of(world), dict(enumerate(stored)), cameras, tolerance=0.03)
    assert len(agreeing) == 12
    assert best_reading(agreeing) is None


def test_without_matches_nothing_is_said(world: World) -> None:
    nothing = MatchedFeatures(keypoints=dict(enumerate(world.keypoints)), raw={}, verified={})
    cameras = dict.fromkeys(range(NUM_IMAGES), CAMERA)
    agreeing = agreement(nothing, dict(enumerate(world.cam_from_world)), cameras, tolerance=0.03)
    assert agreeing == {}
    assert best_reading(agreeing) is None
