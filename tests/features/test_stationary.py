"""Matches on what never moves in the image, in worlds with known cameras."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from helpers.tracked_scenes import (
    CAMERA,
    World,
    arc,
    ball,
    make_collection,
    make_world,
    pairs_within,
    straight,
    true_matches,
    write_features,
)

from smust3r_colmap.execution.task_pool import TaskPool
from smust3r_colmap.features.guided_verification import read_matched_features
from smust3r_colmap.features.matching import drop_matches_without_evidence, find_static_parts
from smust3r_colmap.features.stationary import (
    NO_REGIONS,
    PairMatches,
    StaticRegions,
    describe,
    find_static_regions,
    static_matches,
)
from smust3r_colmap.geometry.arrays import FloatArray, Pair

NUM_IMAGES = 6
BONNET = np.random.default_rng(3).uniform((0, 400), (640, 480), (500, 2))
"""Features that every image has at the same place, below y = 400."""


def with_overlay(world: World, overlay: FloatArray, rng: np.random.Generator) -> World:
    """The world, and features that keep their place to 0.2 px in every image; they show points of their own."""
    first = len(world.points)
    keypoints = tuple(
        np.concatenate([xy, overlay + rng.normal(scale=0.2, size=overlay.shape)]).astype(np.float32)
        for xy in world.keypoints
    )
    point_of = tuple(np.concatenate([of, np.arange(first, first + len(overlay))]) for of in world.point_of)
    return World(cam_from_world=world.cam_from_world, points=world.points, keypoints=keypoints, point_of=point_of)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.fixture
def drive(rng: np.random.Generator) -> World:
    """A turning camera with more features on its own bonnet than on the world."""
    return with_overlay(make_world(arc(NUM_IMAGES), ball(400, rng), rng), BONNET, rng)


def matches_of(world: World) -> Callable[[Pair], PairMatches]:
    camera = CAMERA.colmap_camera(1)

    def of(pair: Pair) -> PairMatches:
        rows = true_matches(world, pair)
        xy_a, xy_b = (world.keypoints[image][rows[:, k]].astype(np.float64) for k, image in enumerate(pair))
        return PairMatches(xy_a=xy_a, xy_b=xy_b, camera_a=camera, camera_b=camera)

    return of


def test_the_bonnet_of_a_turning_car_is_found_and_nothing_else(drive: World) -> None:
    regions = find_static_regions(pairs_within(range(NUM_IMAGES), 5), matches_of(drive), seed=0)
    assert list(regions.cells) == ["640x480"]
    held = regions.holds(BONNET, (640, 480))
    assert held.mean() > 0.95
    above = np.random.default_rng(1).uniform((0, 0), (640, 380), (500, 2))
    assert regions.holds(above, (640, 480)).sum() == 0
    assert describe(regions) == "x 0-640, y 400-480 of 640x480 px"
    assert 0.6 < regions.share < 0.8


def test_far_points_of_a_camera_that_does_not_turn_are_kept(rng: np.random.Generator) -> None:
    """They keep their place, too, and without them nothing tells the rotation."""
    near = np.array([0.6, 0.0, 4.0]) + ball(200, rng) * [2.0, 1.0, 1.0]
    far = rng.uniform((-3000, -2000, 8000), (3000, 500, 9000), (200, 3))
    world = make_world(straight(NUM_IMAGES), np.concatenate([near, far]), rng, noise_px=0.1)
    of = matches_of(world)
    assert of((0, 5)).stationary().sum() > 50, "else nothing is tested"
    assert not find_static_regions(pairs_within(range(NUM_IMAGES), 5), of, seed=0)


def test_what_a_circling_camera_looks_at_is_kept(rng: np.random.Generator) -> None:
    middle = ball(80, rng) * 0.004
    world = make_world(arc(NUM_IMAGES), np.concatenate([middle, ball(200, rng)]), rng, noise_px=0.1)
    of = matches_of(world)
    assert of((0, 1)).stationary().sum() > 20, "else nothing is tested"
    assert not find_static_regions(pairs_within(range(NUM_IMAGES), 5), of, seed=0)


def test_a_camera_that_stands_still_shows_no_static_part(rng: np.random.Generator) -> None:
    world = with_overlay(make_world(np.repeat(arc(1), 4, axis=0), ball(200, rng), rng, noise_px=0.1), BONNET, rng)
    assert not find_static_regions(pairs_within(range(4), 3), matches_of(world), seed=0)


def test_regions_of_two_searches_are_joined() -> None:
    one = StaticRegions(cells={"64x48": (1, 5)}, share=0.2)
    assert one.joined(StaticRegions(cells={"64x48": (0, 5), "10x10": (7,)}, share=0.1)) == StaticRegions(
        cells={"10x10": (7,), "64x48": (0, 1, 5)}, share=0.2
    )
    assert not NO_REGIONS
    assert one


def test_images_of_another_size_have_no_cells_of_these() -> None:
    regions = StaticRegions(cells={"640x480": (0,)})
    xy = np.array([[3.0, 3.0], [30.0, 3.0]])
    assert regions.holds(xy, (640, 480)).tolist() == [True, False]
    assert regions.holds(xy, (641, 480)).tolist() == [False, False]


@pytest.mark.slow
def test_the_database_keeps_only_evidence(drive: World, tmp_path: Path) -> None:
    """The pairs are verified again, and their relative rotation is the true one, not that of the bonnet."""
    path = tmp_path / "database.db"
    pairs = pairs_within(range(NUM_IMAGES), 5)
    matches = {pair: true_matches(drive, pair) for pair in pairs}
    write_features(path, make_collection(tmp_path, NUM_IMAGES), drive, verified=matches)
    regions = find_static_parts(path, pairs, seed=0)
    with TaskPool(workers=1) as pool:
        drop_matches_without_evidence(path, pairs, regions, executor=pool, seed=0)
        left = read_matched_features(path, range(NUM_IMAGES))
        drop_matches_without_evidence(path, pairs, regions, executor=pool, seed=0)
    again = read_matched_features(path, range(NUM_IMAGES))
    assert left.raw.keys() == set(pairs)
    first_of_bonnet = len(drive.points)
    for pair, rows in left.raw.items():
        bonnet = drive.point_of[pair[0]][rows[:, 0]] >= first_of_bonnet
        assert bonnet.mean() < 0.1, "a few whose noise is more than a pixel are left"
        assert np.array_equal(again.raw[pair], rows)
    camera = CAMERA.colmap_camera(1)
    for a, b in [(0, 1), (2, 4)]:
        rows = left.verified[a, b]
        xy_a, xy_b = (drive.keypoints[image][rows[:, k]].astype(float) for k, image in enumerate((a, b)))
        same = np.column_stack([np.arange(len(rows))] * 2).astype(np.uint32)
        options = pycolmap.TwoViewGeometryOptions(compute_relative_pose=True)
        found = pycolmap.estimate_calibrated_two_view_geometry(camera, xy_a, camera, xy_b, same, options)
        assert found.cam2_from_cam1 is not None
        truth = drive.cam_from_world[b][:, :3] @ drive.cam_from_world[a][:, :3].T
        off = np.trace(found.cam2_from_cam1.rotation.matrix() @ truth.T)
        assert np.rad2deg(np.arccos(np.clip((off - 1) / 2, -1, 1))) < 1.0


@pytest.mark.parametrize("moves", [False, True])
def test_a_pair_that_colmap_calls_a_watermark_is_emptied_if_it_does_not_move(
    drive: World, tmp_path: Path, moves: bool
) -> None:
    path = tmp_path / "database.db"
    bonnet = len(drive.points)
    matches = {pair: true_matches(drive, pair) for pair in ((0, 1), (0, 2))}
    on_bonnet = drive.point_of[0][matches[0, 1][:, 0]] >= bonnet
    matches[0, 1] = matches[0, 1][~on_bonnet if moves else on_bonnet]
    write_features(path, make_collection(tmp_path, NUM_IMAGES), drive, verified=matches)
    watermark = int(pycolmap.TwoViewGeometryConfiguration.WATERMARK)
    with pycolmap.Database.open(path) as database:
        database.update_two_view_geometry(
            1, 2, pycolmap.TwoViewGeometry(config=watermark, inlier_matches=matches[0, 1])
        )
    with TaskPool(workers=1) as pool:
        drop_matches_without_evidence(path, matches, NO_REGIONS, executor=pool, seed=0)
    found = read_matched_features(path, range(NUM_IMAGES))
    assert list(found.raw) == list(found.verified) == ([(0, 1), (0, 2)] if moves else [(0, 2)])
    with pycolmap.Database.open(path) as database:
        assert database.exists_matches(1, 2), "matched; it is not tried again"
        assert database.read_two_view_geometry(1, 2).config != watermark


def test_static_matches_are_those_that_do_not_move() -> None:
    camera = CAMERA.colmap_camera(1)
    pair = PairMatches(
        xy_a=np.array([[10.0, 10.0], [10.0, 10.0], [300.0, 300.0]]),
        xy_b=np.array([[10.6, 10.0], [12.0, 10.0], [300.0, 300.0]]),
        camera_a=camera,
        camera_b=camera,
    )
    assert static_matches(pair, StaticRegions(cells={"640x480": (0,)})).tolist() == [True, False, False]
