"""Guided verification: which matches and pairs agree with the geometry, and what the database gives."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from helpers.tracked_scenes import (
    CAMERA,
    Matches,
    World,
    arc,
    ball,
    disturbed,
    make_collection,
    make_world,
    pairs_within,
    straight,
    true_matches,
    turning,
    write_features,
    wrong_matches,
)

from smust3r_colmap.features.guided_verification import (
    MIN_INLIER_FRACTION,
    MIN_MATCHES,
    MIN_VERIFIED,
    MatchedFeatures,
    View,
    read_matched_features,
    verify_guided,
)
from smust3r_colmap.geometry.arrays import FloatArray, Pair
from smust3r_colmap.geometry.camera import Intrinsics

COARSE, FINE = 0.012, 0.004
Rows = npt.NDArray[np.uint32]


@pytest.fixture(scope="module")
def world() -> World:
    rng = np.random.default_rng(5)
    return make_world(arc(6, angle=0.3 * np.pi), ball(300, rng), rng)


def views(cam_from_world: FloatArray) -> dict[int, View]:
    return {i: View(cam_from_world=pose, intrinsics=CAMERA) for i, pose in enumerate(cam_from_world)}


def features(world: World, *, raw: Matches, verified: Matches) -> MatchedFeatures:
    return MatchedFeatures(keypoints=dict(enumerate(world.keypoints)), raw=raw, verified=verified)


def num_right(world: World, pair: Pair, rows: Rows) -> int:
    a, b = (world.point_of[image][rows[:, side]] for side, image in enumerate(pair))
    return int(((a == b) & (a >= 0)).sum())


def mixed(world: World, pair: Pair, num_wrong: int) -> Rows:
    """The true matches, and wrong ones after them."""
    rng = np.random.default_rng(7)
    return np.concatenate([true_matches(world, pair), wrong_matches(world, pair, num_wrong, rng)])


# ---------------------------------------------------------------------- verification
def test_true_matches_are_verified_and_wrong_ones_are_not(world: World) -> None:
    pair = (0, 2)
    rows = mixed(world, pair, 100)
    num_true = len(true_matches(world, pair))
    result = verify_guided(
        features(world, raw={pair: rows}, verified={pair: rows}), views(world.cam_from_world), tolerance=FINE
    )
    kept = result.correspondences.matches[pair]
    assert num_right(world, pair, kept) >= 0.99 * num_true
    assert len(kept) - num_right(world, pair, kept) <= 8, "by chance 2 or 3 of 100 lie on the line"
    assert result.num_outliers == len(rows) - len(kept) > 80
    assert not result.unverified


def test_coarse_tolerance_covers_the_errors_of_stitched_poses_and_fine_tolerance_does_not(world: World) -> None:
    """Half a degree is 5 px here: within 0.012 of 640, not within 0.004, where a match is not off along its line."""
    pair = (0, 2)
    true = true_matches(world, pair)
    found = features(world, raw={pair: true}, verified={pair: true})
    rng = np.random.default_rng(2)
    off = views(disturbed(world.cam_from_world, rng, position=0.01, rotation_deg=0.7))
    coarse = verify_guided(found, off, tolerance=COARSE).correspondences.num_matches
    fine = verify_guided(found, off, tolerance=FINE).correspondences.num_matches
    assert coarse >= 0.98 * len(true)
    assert 0.5 * len(true) < fine < 0.85 * len(true)


def test_pair_of_look_alike_sides_of_a_building_is_rejected_as_a_whole() -> None:
    """Opposite sides that look the same: verified by itself, the pair is of two images taken side by side."""
    rng = np.random.default_rng(9)
    around = arc(21, angle=2 * np.pi)[[0, 11]]
    side_by_side = arc(21, angle=2 * np.pi)[[0, 1]]
    twin = make_world(side_by_side, ball(300, rng), rng)
    pair = (0, 1)
    rows = true_matches(twin, pair)
    found = features(twin, raw={pair: rows}, verified={pair: rows})
    result = verify_guided(found, views(around), tolerance=COARSE)
    assert not result.correspondences.matches
    assert result.unverified.keys() == {pair}
    assert 0.0 < result.unverified[pair] < MIN_INLIER_FRACTION
    assert result.correspondences.keypoints.keys() == {0, 1}, "keypoints stay, for ids count them"
    assert verify_guided(found, views(side_by_side), tolerance=COARSE).correspondences.num_matches > 0.9 * len(rows)


def test_pair_without_two_view_verification_can_be_used(world: World) -> None:
    pair = (1, 4)
    few = true_matches(world, pair)[:10]
    wrong = wrong_matches(world, pair, 5, np.random.default_rng(1))
    result = verify_guided(
        features(world, raw={pair: np.concatenate([few, wrong])}, verified={}),
        views(world.cam_from_world),
        tolerance=FINE,
    )
    assert num_right(world, pair, result.correspondences.matches[pair]) == 10


@pytest.mark.parametrize(("num_true", "num_wrong"), [(MIN_MATCHES - 1, 0), (20, 60), (0, 100)])
def test_raw_matches_that_chance_can_explain_are_left_out(world: World, num_true: int, num_wrong: int) -> None:
    pair = (1, 4)
    rows = np.concatenate(
        [true_matches(world, pair)[:num_true], wrong_matches(world, pair, num_wrong, np.random.default_rng(3))]
    )
    found = features(world, raw={pair: rows}, verified={})
    result = verify_guided(found, views(world.cam_from_world), tolerance=FINE)
    assert not result.correspondences.matches
    assert not result.unverified, "only two-view verified pairs are listed"


def test_matches_that_two_view_verification_left_out_stay_out(world: World) -> None:
    pair = (1, 2)
    everything = true_matches(world, pair)
    found = features(world, raw={pair: everything}, verified={pair: everything[:30]})
    result = verify_guided(found, views(world.cam_from_world), tolerance=COARSE)
    assert 29 <= len(result.correspondences.matches[pair]) <= 30 < len(everything)


def test_all_true_matches_of_a_camera_that_only_rotated_are_verified() -> None:
    rng = np.random.default_rng(3)
    world = make_world(turning(2), rng.uniform([-3, -2, 4], [3, 2, 9], (300, 3)), rng)
    pair = (0, 1)
    rows = true_matches(world, pair)
    found = features(world, raw={pair: rows}, verified={pair: rows})
    for cam_from_world in (
        world.cam_from_world,
        disturbed(world.cam_from_world, np.random.default_rng(1), position=1e-3, rotation_deg=0.0),
    ):
        result = verify_guided(found, views(cam_from_world), tolerance=FINE)
        assert len(result.correspondences.matches[pair]) >= 0.98 * len(rows)


def test_matches_with_an_image_without_a_view_stay_if_they_are_verified(world: World) -> None:
    known = views(world.cam_from_world)
    del known[3]
    verified = {(2, 3): true_matches(world, (2, 3)), (3, 4): true_matches(world, (3, 4))[: MIN_VERIFIED - 1]}
    raw = {**verified, (1, 3): true_matches(world, (1, 3))}
    result = verify_guided(features(world, raw=raw, verified=verified), known, tolerance=FINE)
    assert result.correspondences.matches.keys() == {(2, 3)}
    np.testing.assert_array_equal(result.correspondences.matches[2, 3], verified[2, 3])


def test_verification_does_not_depend_on_the_order_of_a_wide_and_a_long_lens() -> None:
    """The limit is an angle of both; it once was the first image's."""
    rng = np.random.default_rng(8)
    lenses = [replace(CAMERA, params=(focal, 320.0, 240.0, 0.0)) for focal in (300.0, 1500.0)]
    points = rng.uniform([-0.4, -0.4, 4], [0.8, 0.4, 6], (600, 3))
    poses = straight(2, step=0.3)
    rows = np.column_stack([np.arange(len(points))] * 2).astype(np.uint32)
    counts = []
    for order in ((0, 1), (1, 0)):
        both, keypoints = {}, {}
        for image, k in enumerate(order):
            both[image] = View(cam_from_world=poses[k], intrinsics=lenses[k])
            xy = lenses[k].xy_img(points @ poses[k, :, :3].T + poses[k, :, 3])
            xy[:, 1] += 0.01 * lenses[k].focal_px * np.linspace(-1, 1, len(points)) * (1 if k else -1) / 2
            keypoints[image] = xy.astype(np.float32)
        found = MatchedFeatures(keypoints=keypoints, raw={(0, 1): rows}, verified={(0, 1): rows})
        counts.append(verify_guided(found, both, tolerance=FINE).correspondences.num_matches)
    assert counts[0] == counts[1]
    assert 0.5 * len(points) < counts[0] < 0.95 * len(points), "the limit must cut somewhere for this to say anything"


def test_keypoints_that_cannot_be_undistorted_are_not_verified() -> None:
    barrel = Intrinsics(model="SIMPLE_RADIAL", width=640, height=480, params=(300.0, 320.0, 240.0, -0.9))
    xy = np.column_stack([np.linspace(1, 639, 40), np.full(40, 5.0)]).astype(np.float32)
    assert not np.isfinite(barrel.rays_cam(xy)).all()
    rows = np.column_stack([np.arange(40)] * 2).astype(np.uint32)
    pose = straight(2)
    both = {i: View(cam_from_world=pose[i], intrinsics=barrel) for i in range(2)}
    found = MatchedFeatures(keypoints={0: xy, 1: xy}, raw={(0, 1): rows}, verified={(0, 1): rows})
    kept = verify_guided(found, both, tolerance=COARSE).correspondences.matches.get((0, 1), rows[:0])
    assert np.isfinite(barrel.rays_cam(xy[kept[:, 0]])).all()


# --------------------------------------------------------------------------- database
def test_database_gives_keypoints_raw_and_verified_matches_by_image_index(world: World, tmp_path: Path) -> None:
    collection = make_collection(tmp_path, 6)
    verified = {pair: true_matches(world, pair) for pair in pairs_within(range(6), 1)}
    raw = {(0, 3): true_matches(world, (0, 3)), (1, 5): np.empty((0, 2), np.uint32)}
    write_features(tmp_path / "f.db", collection, world, verified=verified, raw=raw, without_features={5})
    found = read_matched_features(tmp_path / "f.db", range(6))
    assert set(found.keypoints) == set(range(6))
    assert found.keypoints[5].shape == (0, 2)
    for image in range(5):
        np.testing.assert_array_equal(found.keypoints[image], world.keypoints[image])
    assert found.verified.keys() == verified.keys()
    assert found.raw.keys() == verified.keys() | {(0, 3)}, "a pair without a match is none"
    np.testing.assert_array_equal(found.raw[0, 3], raw[0, 3])
    np.testing.assert_array_equal(found.verified[2, 3], verified[2, 3])

    few = read_matched_features(tmp_path / "f.db", {0, 3, 4})
    assert set(few.keypoints) == {0, 3, 4}
    assert few.raw.keys() == {(0, 3), (3, 4)}
    assert few.verified.keys() == {(3, 4)}
