"""A walk whose end was bent is straightened; sound models, and those that nothing helps, are left alone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation
from tracked_scenes import (
    World,
    angle_deg,
    arc,
    ball,
    make_collection,
    make_world,
    pairs_within,
    true_matches,
    write_features,
)

from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.products import FloatArray
from smust3r_colmap.refinement import replacement
from smust3r_colmap.refinement.adjustment import Tolerance, triangulate
from smust3r_colmap.refinement.bench import TIGHT_PART, Bench, poses_of, views_of
from smust3r_colmap.refinement.feature_matches import MatchedFeatures, ask_consent, read_matched_features
from smust3r_colmap.refinement.replacement import Replacement, bent_images, place_bent_images_again

NUM_IMAGES, LAST_SOUND = 14, 9
TOLERANCE = Tolerance(pixels=TIGHT_PART * 640, angle_deg=2.0)


@pytest.fixture(autouse=True, scope="module")
def _quiet() -> Iterator[None]:
    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = 3
    yield
    pycolmap.logging.minloglevel = level


@pytest.fixture(scope="module")
def world() -> World:
    rng = np.random.default_rng(4)
    return make_world(arc(NUM_IMAGES), ball(260, rng), rng)


def bent_after(world: World, last: int, turn_deg: float) -> FloatArray:
    """(N, 3, 4) the truth, with all cameras after ``last`` turned as one body around that one's centre."""
    world_from_cam = invert_rigid(world.cam_from_world)
    hinge = world_from_cam[last, :, 3]
    turn = Rotation.from_euler("y", turn_deg, degrees=True).as_matrix()
    tail = world_from_cam[last + 1 :]
    tail[:, :, :3] = turn @ tail[:, :, :3]
    tail[:, :, 3] = (tail[:, :, 3] - hinge) @ turn.T + hinge
    return invert_rigid(world_from_cam)


def bench_with(world: World, cam_from_world: FloatArray, folder: Path) -> tuple[Bench, MatchedFeatures]:
    """A model with tracks at the given poses, as the first adjustment leaves it."""
    collection = make_collection(folder, len(world))
    pairs = pairs_within(range(len(world)), 4)
    write_features(folder / "run.db", collection, world, verified={pair: true_matches(world, pair) for pair in pairs})
    features = read_matched_features(folder / "run.db", range(len(world)))
    poses = dict(enumerate(cam_from_world))
    consent = ask_consent(features, views_of(poses, collection.cameras, collection), tolerance=TIGHT_PART)
    bench = Bench(collection, collection.cameras, consent, poses, scratch=folder, threads=1)
    triangulate(bench.mapper, TOLERANCE)
    return bench, features


def off_by(world: World, poses: Mapping[int, FloatArray]) -> tuple[float, float]:
    """The worst camera: how far from its true place, in parts of the extent, and by how many degrees turned."""
    places = invert_rigid(np.stack([poses[i] for i in range(len(world))]))[:, :, 3]
    turns = [angle_deg(poses[i], world.cam_from_world[i]) for i in range(len(world))]
    return float(np.linalg.norm(places - world.centres, axis=1).max() / world.extent), max(turns)


@pytest.fixture(scope="module")
def straightened(world: World, tmp_path_factory: pytest.TempPathFactory) -> Replacement:
    bench, features = bench_with(world, bent_after(world, LAST_SOUND, 12.0), tmp_path_factory.mktemp("bent"))
    distance, turn = off_by(world, poses_of(bench.model))
    assert distance > 0.05, "the walk is bent before"
    assert turn == pytest.approx(12.0, abs=1e-3)
    return place_bent_images_again(bench, features, TOLERANCE)


def test_images_beyond_the_bend_come_back_to_the_truth(world: World, straightened: Replacement) -> None:
    assert straightened.bent == straightened.placed == tuple(range(LAST_SOUND + 1, NUM_IMAGES))
    distance, turn = off_by(world, poses_of(straightened.bench.model))
    assert distance < 0.01
    assert turn < 0.5
    assert straightened.share_before < 0.9
    assert straightened.share_after > 0.97


def test_the_others_stay_to_the_last_bit(world: World, straightened: Replacement) -> None:
    poses = poses_of(straightened.bench.model)
    for index in range(LAST_SOUND + 1):
        np.testing.assert_allclose(poses[index], world.cam_from_world[index], rtol=0, atol=1e-12)


def test_tracks_run_across_the_former_bend(straightened: Replacement) -> None:
    tracks = [{e.image_id - 1 for e in point.track.elements} for point in straightened.bench.model.points3D.values()]
    across = [images for images in tracks if min(images) <= LAST_SOUND < max(images)]
    assert len(across) > 60
    first_new = sum(LAST_SOUND + 1 in images for images in tracks)
    assert first_new > 100


def test_a_sound_model_is_left_alone(world: World, tmp_path: Path) -> None:
    bench, features = bench_with(world, world.cam_from_world, tmp_path)
    result = place_bent_images_again(bench, features, TOLERANCE)
    assert result.bench is bench
    assert (result.bent, result.placed) == ((), ())


def test_new_places_that_agree_less_are_not_taken(
    world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bent = bent_after(world, LAST_SOUND, 12.0)
    worse = bent_after(world, LAST_SOUND, 25.0)
    bench, features = bench_with(world, bent, tmp_path)
    num_points = bench.model.num_points3D()
    anew = {i: worse[i] for i in range(LAST_SOUND + 1, NUM_IMAGES)}
    monkeypatch.setattr(replacement, "_mapped_anew", lambda *_: anew)
    result = place_bent_images_again(bench, features, TOLERANCE)
    assert result.bench is bench
    assert result.bent
    assert result.placed == ()
    assert result.share_after < result.share_before
    assert "4 images were bent" in result.summary
    np.testing.assert_allclose(poses_of(bench.model)[NUM_IMAGES - 1], bent[-1], rtol=0, atol=1e-12)
    assert bench.model.num_points3D() == num_points


def test_bent_images_stay_where_the_mapper_finds_nothing(
    world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(replacement, "_map_globally", _no_model)
    bench, features = bench_with(world, bent_after(world, LAST_SOUND, 12.0), tmp_path)
    result = place_bent_images_again(bench, features, TOLERANCE)
    assert result.bench is bench
    assert len(result.bent) == NUM_IMAGES - LAST_SOUND - 1
    assert result.placed == ()


def _no_model(_: object) -> bool:
    return False


def test_too_many_bent_images_are_another_matter(world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(replacement, "MAX_BENT", 3)
    bench, features = bench_with(world, bent_after(world, LAST_SOUND, 12.0), tmp_path)
    result = place_bent_images_again(bench, features, TOLERANCE)
    assert len(result.bent) == 4
    assert result.placed == ()


def test_the_bulk_is_what_sound_pairs_tie_together() -> None:
    shares = {(0, 1): 0.9, (1, 2): 0.86, (2, 3): 0.84, (3, 4): 1.0, (0, 2): 0.2}
    assert bent_images(shares, range(5)) == (3, 4)


def test_an_image_of_which_no_pair_speaks_is_not_called_bent() -> None:
    assert bent_images({(0, 1): 0.9, (1, 2): 0.9, (2, 3): 0.1}, range(5)) == (3,)


def test_without_a_bulk_nothing_can_be_told() -> None:
    assert bent_images({(0, 1): 0.9, (2, 3): 0.9, (1, 2): 0.1}, range(4)) == ()
    assert bent_images({}, range(4)) == ()


def test_indices_of_the_collection_need_not_begin_at_zero() -> None:
    assert bent_images({(10, 12): 0.9, (12, 17): 0.9, (17, 30): 0.5}, [10, 12, 17, 30]) == (30,)
