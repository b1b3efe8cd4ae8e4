"""Links: firm where many points have parallax on both sides, weak where the camera turns on the spot."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.tracked_scenes import cam_from_world_towards, make_world, model_with_true_tracks

from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.refinement.linearised_model import LinearisedModel
from smust3r_colmap.refinement.links import MIN_SIDE, Link, links

WALK, TURN = 8, 12


def room(rng: np.random.Generator) -> FloatArray:
    """(P, 3) points all around."""
    directions = rng.normal(size=(3000, 3))
    points: FloatArray = directions / np.linalg.norm(directions, axis=1, keepdims=True) * rng.uniform(4, 6, (3000, 1))
    return points


def walk_turn_walk(turn_step: float) -> FloatArray:
    """(N, 3, 4) to the right, then ``TURN`` images on the spot with steps of ``turn_step`` radians, then on."""
    turns = np.concatenate([np.zeros(WALK), turn_step * np.arange(1, TURN + 1), np.full(WALK, turn_step * TURN)])
    steps = np.concatenate([np.full(WALK, 0.15), np.zeros(TURN), np.full(WALK, 0.15)])
    forward = np.column_stack([np.sin(turns), 0 * turns, np.cos(turns)])
    sideways = np.column_stack([np.cos(turns), 0 * turns, -np.sin(turns)])
    centres = np.cumsum(steps[:, None] * sideways, axis=0)
    return cam_from_world_towards(centres, centres + forward)


def links_of(turn_step: float) -> tuple[Link, ...]:
    rng = np.random.default_rng(8)
    world = make_world(walk_turn_walk(turn_step), room(rng), rng)
    return links(LinearisedModel.of(model_with_true_tracks(world, world.cam_from_world, rng, noise=0)))


def test_every_cut_with_enough_images_on_both_sides_has_a_link() -> None:
    found = links_of(0.0)
    n = 2 * WALK + TURN
    assert [link.before for link in found] == list(range(MIN_SIDE - 1, n - MIN_SIDE))
    assert all(link.after == link.before + 1 for link in found)
    assert all(link.num_smaller == min(link.after, n - link.after) for link in found)


def test_scale_is_lost_where_the_camera_turns_further_than_it_sees() -> None:
    firm, weak = links_of(0.0), links_of(0.25)
    at_turn = [link for link in weak if WALK <= link.before < WALK + TURN - 1]
    assert max(link.scale_sigma for link in firm) < 0.05
    assert max(link.scale_sigma for link in at_turn) > 0.3
    assert max(link.rotation_sigma_rad for link in at_turn) < np.deg2rad(1)


def test_points_without_parallax_do_not_carry_the_scale() -> None:
    weakest = max(links_of(0.08), key=lambda link: link.scale_sigma)
    assert weakest.num_points > 100
    assert weakest.num_scale_points < 0.5 * weakest.num_points


def test_sides_that_no_point_connects_are_as_uncertain_as_the_prior() -> None:
    rng = np.random.default_rng(9)
    world = make_world(walk_turn_walk(0.0), room(rng), rng)
    half = len(world) // 2
    point_of = tuple(np.where((of % 2 == 0) == (image < half), of, -1) for image, of in enumerate(world.point_of))
    apart = type(world)(
        cam_from_world=world.cam_from_world, points=world.points, keypoints=world.keypoints, point_of=point_of
    )
    found = links(LinearisedModel.of(model_with_true_tracks(apart, world.cam_from_world, rng, noise=0)))
    (cut,) = [link for link in found if link.after == half]
    assert cut.num_points == 0
    assert cut.num_scale_points == 0
    assert cut.scale_sigma == pytest.approx(1.0)
