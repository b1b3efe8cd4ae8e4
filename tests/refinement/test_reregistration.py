"""Misregistered images at the end of a walk are re-registered; sound models are left alone."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping
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
from smust3r_colmap.features.guided_verification import read_matched_features
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.refinement import reregistration
from smust3r_colmap.refinement.bundle_adjustment import Tolerance
from smust3r_colmap.refinement.global_refinement import RefineTask, refine_scenes
from smust3r_colmap.refinement.mapper import FINE_TOLERANCE_FRACTION, MapperSession
from smust3r_colmap.refinement.reregistration import map_with_neighbours, reregister_images
from smust3r_colmap.storage.run_directory import StageFolder

pytestmark = pytest.mark.usefixtures("quiet_pycolmap")

NUM_IMAGES, LAST_SOUND = 14, 9
MISREGISTERED = range(LAST_SOUND + 1, NUM_IMAGES)
MapImages = Callable[[MapperSession, Collection[int]], dict[int, FloatArray]]
TOLERANCE = Tolerance(pixels=FINE_TOLERANCE_FRACTION * 640, angle_deg=2.0)


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


def session_at(
    world: World, cam_from_world: FloatArray, folder: Path, verified: Matches | None = None
) -> MapperSession:
    """A model with tracks at the given poses, as the first adjustment leaves it; matches of neighbours by default."""
    if verified is None:
        verified = {pair: true_matches(world, pair) for pair in pairs_within(range(len(world)), 4)}
    collection = make_collection(folder, len(world))
    write_features(folder / "run.db", collection, world, verified=verified)
    session = MapperSession(
        collection,
        read_matched_features(folder / "run.db", range(len(world))),
        collection.cameras,
        dict(enumerate(cam_from_world)),
        tolerance=FINE_TOLERANCE_FRACTION,
        calibrated=False,
        scratch=folder,
        threads=1,
    )
    session.triangulate("triangulation", TOLERANCE)
    return session


def off_by(world: World, poses: Mapping[int, FloatArray]) -> tuple[float, float]:
    """The worst camera: how far from its true place, in fractions of the extent, and its rotation error in degrees."""
    places = invert_rigid(np.stack([poses[i] for i in range(len(world))]))[:, :, 3]
    turns = [angle_deg(poses[i], world.cam_from_world[i]) for i in range(len(world))]
    return float(np.linalg.norm(places - world.centres, axis=1).max() / world.extent), max(turns)


@pytest.fixture(scope="module")
def corrected(world: World, tmp_path_factory: pytest.TempPathFactory) -> MapperSession:
    session = session_at(world, bent_after(world, LAST_SOUND, 12.0), tmp_path_factory.mktemp("bent"))
    distance, turn = off_by(world, poses_of(session.model))
    assert distance > 0.05, "wrong before"
    assert turn == pytest.approx(12.0, abs=1e-3)
    assert reregister_images(session, TOLERANCE) is session.steps[-1]
    return session


@pytest.mark.slow
def test_images_beyond_the_bend_return_to_the_truth(world: World, corrected: MapperSession) -> None:
    distance, turn = off_by(world, poses_of(corrected.model))
    assert distance < 0.01
    assert turn < 0.5


def test_priors_and_initial_poses_of_the_images_move_along(world: World, corrected: MapperSession) -> None:
    poses = poses_of(corrected.model)
    for index in MISREGISTERED:
        np.testing.assert_allclose(corrected.initial[index], poses[index], atol=1e-9)
        np.testing.assert_allclose(corrected.priors.centres[index + 1], invert_rigid(poses[index])[:, 3], atol=1e-9)
    assert max(np.linalg.norm(corrected.priors.centres[i + 1] - world.centres[i]) for i in range(NUM_IMAGES)) < 0.1


def test_the_step_is_reported(corrected: MapperSession) -> None:
    report = corrected.steps[-1]
    assert report.accepted
    assert report.name == "re-registration"
    assert 5 < report.max_moved_percent < 50
    assert report.moved_percent == pytest.approx(0, abs=1e-6), "most cameras stay"
    assert report.after.num_observations > report.before.num_observations
    assert report.after.num_images == report.before.num_images == NUM_IMAGES


def test_the_other_images_keep_their_pose(world: World, corrected: MapperSession) -> None:
    poses = poses_of(corrected.model)
    for index in range(LAST_SOUND + 1):
        np.testing.assert_allclose(poses[index], world.cam_from_world[index], rtol=0, atol=1e-12)


def test_tracks_run_across_the_former_bend(corrected: MapperSession) -> None:
    tracks = [{e.image_id - 1 for e in point.track.elements} for point in corrected.model.points3D.values()]
    across = [images for images in tracks if min(images) <= LAST_SOUND < max(images)]
    assert len(across) > 60
    first_new = sum(LAST_SOUND + 1 in images for images in tracks)
    assert first_new > 100


def test_a_sound_model_is_left_alone(world: World, tmp_path: Path) -> None:
    session = session_at(world, world.cam_from_world, tmp_path)
    assert reregister_images(session, TOLERANCE) is None
    assert [step.name for step in session.steps] == ["triangulation"]


def assert_rejected(session: MapperSession, reason: str, **map_images: MapImages) -> None:
    """Nothing is changed, and the report says why."""
    before = poses_of(session.model)
    report = reregister_images(session, TOLERANCE, **map_images)
    assert report is not None
    assert report is session.steps[-1]
    assert not report.accepted
    assert re.fullmatch(rf"4 misregistered images: {reason}; kept the old poses", report.reason), report.reason
    assert report.max_moved_percent < 1e-9
    assert report.after == report.before
    assert all((pose == before[i]).all() for i, pose in poses_of(session.model).items())


def at_poses(cam_from_world: FloatArray) -> MapImages:
    """In place of the global mapper."""
    return lambda *_: {i: cam_from_world[i] for i in MISREGISTERED}


def test_new_poses_that_fewer_matches_fit_are_rejected(world: World, tmp_path: Path) -> None:
    session = session_at(world, bent_after(world, LAST_SOUND, 12.0), tmp_path)
    worse = at_poses(bent_after(world, LAST_SOUND, 25.0))
    assert_rejected(session, r"\d+ matches fit the new poses, \d+ the old", map_images=worse)


def test_new_poses_that_are_misregistered_too_are_rejected(world: World, tmp_path: Path) -> None:
    session = session_at(world, bent_after(world, LAST_SOUND, 25.0), tmp_path)
    better = at_poses(bent_after(world, LAST_SOUND, 12.0))
    assert_rejected(session, r"\d are misregistered at the new poses, too", map_images=better)


@pytest.mark.slow
def test_images_keep_their_poses_if_the_mapper_connects_nothing(world: World, tmp_path: Path) -> None:
    session = session_at(world, bent_after(world, LAST_SOUND, 12.0), tmp_path)

    def without_matches(session: MapperSession, wrong: Collection[int]) -> dict[int, FloatArray]:
        features, session.features = session.features, replace(session.features, verified={})
        found = map_with_neighbours(session, wrong)
        session.features = features
        return found

    reason = "the global mapper does not connect them with their neighbours"
    assert_rejected(session, reason, map_images=without_matches)


def test_more_images_than_the_limit_are_not_mapped(
    world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reregistration, "MAX_MISREGISTERED", 3)
    session = session_at(world, bent_after(world, LAST_SOUND, 12.0), tmp_path)
    assert_rejected(session, "more than 3, the limit of re-registration")


@pytest.mark.slow
@pytest.mark.parametrize("num_true", [12, 25])
def test_look_alike_places_do_not_move_an_image_at_the_right_pose(world: World, tmp_path: Path, num_true: int) -> None:
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
    session = session_at(seen, world.cam_from_world, tmp_path, verified)
    assert min(len(verified[image, last]) for image in (0, 1, 2, 3)) > 2 * num_true
    report = reregister_images(session, TOLERANCE)
    assert report is None or not report.accepted
    distance, _ = off_by(world, poses_of(session.model))
    assert distance < 1e-9


@pytest.mark.slow
def test_refinement_corrects_a_bend_and_keeps_the_scale(world: World, tmp_path: Path) -> None:
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
        segments=(),
        calibrated=True,
        threads=1,
    )
    (result,) = refine_scenes(task)
    assert "re-registration" in [step.name for step in result.steps if step.accepted]
    assert result.warnings == ()
    model = pycolmap.Reconstruction(tmp_path / "refined/0/model")
    distance, turn = off_by(world, poses_of(model))
    assert distance < 0.004
    assert turn < 0.4
    with pycolmap.Database.open(tmp_path / "refined/database.db") as database:
        priors = {prior.corr_data_id.id: prior.position for prior in database.read_all_pose_priors()}
    off = [np.linalg.norm(priors[i + 1] - world.centres[i]) / world.extent for i in range(NUM_IMAGES)]
    assert max(off) < 0.01, "the priors of before are replaced"
