"""A walk whose end was bent is straightened; sound models, and those that nothing helps, are left alone."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from helpers.tracked_scenes import (
    Matches,
    World,
    angle_deg,
    arc,
    ball,
    make_collection,
    make_world,
    pairs_within,
    stitched_scene,
    true_matches,
    write_features,
)
from scipy.spatial.transform import Rotation

from smust3r_colmap.colmap.reconstruction import poses_of
from smust3r_colmap.features.guided_verification import MatchedFeatures, ask_consent, read_matched_features
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.refinement import reregistration as replacement
from smust3r_colmap.refinement.bundle_adjustment import Tolerance, triangulate
from smust3r_colmap.refinement.global_refinement import RefineTask, refine_scenes
from smust3r_colmap.refinement.mapper import TIGHT_PART, Bench, views_of
from smust3r_colmap.refinement.reregistration import Replacement, place_bent_images_again
from smust3r_colmap.storage.run_directory import StageFolder

pytestmark = pytest.mark.usefixtures("quiet_pycolmap")

NUM_IMAGES, LAST_SOUND = 14, 9
BENT = range(LAST_SOUND + 1, NUM_IMAGES)
TOLERANCE = Tolerance(pixels=TIGHT_PART * 640, angle_deg=2.0)


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
    pairs = pairs_within(range(len(world)), 4)
    return bench_of(world, cam_from_world, folder, {pair: true_matches(world, pair) for pair in pairs})


def bench_of(
    world: World, cam_from_world: FloatArray, folder: Path, verified: Matches
) -> tuple[Bench, MatchedFeatures]:
    collection = make_collection(folder, len(world))
    write_features(folder / "run.db", collection, world, verified=verified)
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


@pytest.mark.slow
def test_images_beyond_the_bend_come_back_to_the_truth(world: World, straightened: Replacement) -> None:
    assert sorted(straightened.cam_from_world) == list(BENT)
    distance, turn = off_by(world, poses_of(straightened.bench.model))
    assert distance < 0.01
    assert turn < 0.5


def test_the_step_is_reported(straightened: Replacement) -> None:
    report = straightened.report
    assert report is not None
    assert report.kept
    assert report.name == "images placed again"
    assert 5 < report.max_moved_percent < 50
    assert report.moved_percent == pytest.approx(0, abs=1e-6), "most cameras stay"
    assert report.after.num_observations > report.before.num_observations
    assert report.after.num_images == report.before.num_images == NUM_IMAGES


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
    assert result.report is None
    assert result.cam_from_world == {}


def refused(result: Replacement, bench: Bench, reason: str) -> None:
    """Nothing was changed, and the report says why."""
    assert result.bench is bench
    assert result.cam_from_world == {}
    assert result.report is not None
    assert not result.report.kept
    assert re.fullmatch(reason, result.report.reason), result.report.reason
    assert result.report.max_moved_percent < 1e-9
    assert result.report.after == result.report.before


def test_new_places_that_fewer_matches_agree_with_are_not_taken(
    world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    worse = bent_after(world, LAST_SOUND, 25.0)
    bench, features = bench_with(world, bent_after(world, LAST_SOUND, 12.0), tmp_path)
    monkeypatch.setattr(replacement, "_mapped_anew", lambda *_: {i: worse[i] for i in BENT})
    result = place_bent_images_again(bench, features, TOLERANCE)
    refused(result, bench, r"4 images are bent, and of their matches \d+ agree with new places, \d+ with the old")


def test_images_that_are_bent_in_new_places_too_stay_in_the_old_ones(
    world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench, features = bench_with(world, bent_after(world, LAST_SOUND, 25.0), tmp_path)
    less = bent_after(world, LAST_SOUND, 12.0)
    monkeypatch.setattr(replacement, "_mapped_anew", lambda *_: {i: less[i] for i in BENT})
    result = place_bent_images_again(bench, features, TOLERANCE)
    refused(result, bench, r"4 images are bent, and \d of them also in new places")


@pytest.mark.slow
def test_bent_images_stay_where_the_mapper_finds_nothing(
    world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(replacement, "_map_globally", _no_model)
    bench, features = bench_with(world, bent_after(world, LAST_SOUND, 12.0), tmp_path)
    result = place_bent_images_again(bench, features, TOLERANCE)
    refused(result, bench, "4 images are bent, and the global mapper does not tie them to their neighbours")


def _no_model(_: object) -> bool:
    return False


def test_too_many_bent_images_are_another_matter(world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(replacement, "MAX_BENT", 3)
    bench, features = bench_with(world, bent_after(world, LAST_SOUND, 12.0), tmp_path)
    result = place_bent_images_again(bench, features, TOLERANCE)
    refused(result, bench, "4 images are bent, and more than 3 are not placed again")


@pytest.mark.slow
@pytest.mark.parametrize("num_true", [12, 25])
def test_look_alikes_do_not_move_an_image_that_stands_right(world: World, tmp_path: Path, num_true: int) -> None:
    """The last image also shows what the third sees: many matches with images there, few with its neighbours."""
    last, rng = NUM_IMAGES - 1, np.random.default_rng(1)
    twin = make_world(world.cam_from_world[[2]], world.points, rng, clutter=0)
    first_ghost = len(world.keypoints[last])
    ghosts = np.full(len(twin.keypoints[0]), -1)
    seen = replace(
        world,
        keypoints=(*world.keypoints[:last], np.concatenate([world.keypoints[last], twin.keypoints[0]])),
        point_of=(*world.point_of[:last], np.concatenate([world.point_of[last], ghosts])),
    )
    verified = {pair: true_matches(seen, pair) for pair in pairs_within(range(NUM_IMAGES), 4)}
    verified |= {pair: rows[:num_true] for pair, rows in verified.items() if last in pair}
    for image in (0, 1, 2, 3):
        alike = replace(twin, point_of=(world.point_of[image], twin.point_of[0]))
        verified[image, last] = true_matches(alike, (0, 1))[:60] + np.array([0, first_ghost], np.uint32)
    bench, features = bench_of(seen, world.cam_from_world, tmp_path, verified)
    assert min(len(verified[image, last]) for image in (0, 1, 2, 3)) > 2 * num_true
    result = place_bent_images_again(bench, features, TOLERANCE)
    assert result.bench is bench
    distance, _ = off_by(world, poses_of(bench.model))
    assert distance < 1e-9


@pytest.mark.slow
def test_refinement_straightens_a_bend_and_keeps_the_scale(world: World, tmp_path: Path) -> None:
    collection = make_collection(tmp_path, NUM_IMAGES, calibrated=True)
    pairs = pairs_within(range(NUM_IMAGES), 4)
    write_features(tmp_path / "run.db", collection, world, verified={pair: true_matches(world, pair) for pair in pairs})
    task = RefineTask(
        stored=StageFolder(path=tmp_path / "refined", key="a test"),
        collection=collection,
        scenes=(stitched_scene(collection, bent_after(world, LAST_SOUND, 20.0)),),
        features=tmp_path / "run.db",
        maps=None,
        map_pairs=(),
        parts=(),
        calibrated=True,
        threads=1,
    )
    (figures,) = refine_scenes(task)
    assert "images placed again" in [step.name for step in figures.steps if step.kept]
    assert figures.warnings == ()
    model = pycolmap.Reconstruction(tmp_path / "refined/0/model")
    distance, turn = off_by(world, poses_of(model))
    assert distance < 0.004
    assert turn < 0.4
    with pycolmap.Database.open(tmp_path / "refined/database.db") as database:
        priors = {prior.corr_data_id.id: prior.position for prior in database.read_all_pose_priors()}
    off = [np.linalg.norm(priors[i + 1] - world.centres[i]) / world.extent for i in range(NUM_IMAGES)]
    assert max(off) < 0.01, "the places of before do not stay as priors"
