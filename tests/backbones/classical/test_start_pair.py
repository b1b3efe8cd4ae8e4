"""The mapper starts from a pair that sees around things, not from the one with most matches."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from helpers.tracked_scenes import (
    CAMERA,
    World,
    arc,
    ball,
    cam_from_world_towards,
    centres_of,
    make_collection,
    make_world,
    pairs_within,
    straight,
    true_matches,
    turning,
)

from smust3r_colmap.backbones.classical.start_pair import (
    ENOUGH_ANGLE_DEG,
    MAX_STARTS,
    MIN_INLIERS,
    StartPair,
    choose_start_pairs,
)
from smust3r_colmap.colmap.database import write_colmap_database
from smust3r_colmap.geometry.arrays import FloatArray, Pair

pytestmark = pytest.mark.usefixtures("quiet_pycolmap")


@pytest.fixture
def chosen(tmp_path: Path) -> Callable[[World, Sequence[Pair]], tuple[StartPair, ...]]:
    def choose(world: World, pairs: Sequence[Pair]) -> tuple[StartPair, ...]:
        path = tmp_path / f"{len(pairs)}.db"
        write_colmap_database(
            path,
            make_collection(tmp_path, len(world)),
            [CAMERA],
            keypoints=dict(enumerate(world.keypoints)),
            matches={pair: matches for pair in pairs if len(matches := true_matches(world, pair))},
            j_from_i={},
            priors=(),
        )
        cameras = dict.fromkeys(range(len(world)), CAMERA)
        with pycolmap.Database.open(path) as database:
            return choose_start_pairs(database, pairs, cameras, seed=0)

    return choose


Choose = Callable[[World, Sequence[Pair]], tuple[StartPair, ...]]


def in_front(num_points: int, rng: np.random.Generator) -> FloatArray:
    return rng.uniform([-3, -2, 4], [5, 2, 9], (num_points, 3))


def median_angle_deg(world: World, pair: Pair) -> float:
    """Between the true rays to the points that both images show."""
    seen = world.point_of[pair[0]][true_matches(world, pair)[:, 0]]
    rays = [world.points[seen] - centre for centre in centres_of(world.cam_from_world)[list(pair)]]
    unit = [ray / np.linalg.norm(ray, axis=1, keepdims=True) for ray in rays]
    return float(np.degrees(np.median(np.arccos(np.einsum("ij,ij->i", *unit)))))


def test_pair_sees_around_things_and_its_angle_is_the_true_one(chosen: Choose) -> None:
    rng = np.random.default_rng(1)
    world = make_world(straight(12), in_front(400, rng), rng)
    best, *others = chosen(world, pairs_within(range(12), 11))
    assert best.second - best.first > 4, "neighbours share more matches and see next to nothing"
    assert best.angle_deg == pytest.approx(median_angle_deg(world, (best.first, best.second)), rel=0.1)
    assert not best.forward
    assert len(others) < MAX_STARTS


def test_search_ends_at_an_angle_that_is_enough(chosen: Choose) -> None:
    rng = np.random.default_rng(2)
    world = make_world(arc(10), ball(300, rng), rng)
    best, *_ = chosen(world, pairs_within(range(10), 9))
    assert best.angle_deg >= ENOUGH_ANGLE_DEG


def test_driving_ahead_is_told_and_worth_less_than_a_step_aside(chosen: Choose) -> None:
    rng = np.random.default_rng(3)
    ahead = np.column_stack([np.zeros((6, 2)), 0.3 * np.arange(6)])
    centres = np.concatenate([ahead, ahead[-1] + [[0.25, 0.0, 0.0]]])
    world = make_world(cam_from_world_towards(centres, centres + np.array([0.0, 0.0, 1.0])), in_front(400, rng), rng)
    driving = chosen(world, pairs_within(range(6), 5))
    assert driving
    assert all(pair.forward for pair in driving)
    best, *_ = chosen(world, [(4, 5), (5, 6)])
    assert (best.first, best.second, best.forward) == (5, 6, False)


def test_a_camera_that_only_turns_gives_no_angle(chosen: Choose) -> None:
    rng = np.random.default_rng(4)
    world = make_world(turning(5), in_front(400, rng), rng)
    assert all(pair.angle_deg < 2 for pair in chosen(world, pairs_within(range(5), 4)))


def test_pairs_with_too_few_matches_are_no_start(chosen: Choose) -> None:
    rng = np.random.default_rng(5)
    world = make_world(straight(4), in_front(MIN_INLIERS // 2, rng), rng)
    assert chosen(world, pairs_within(range(4), 3)) == ()
