"""Refinement from start to end on scenes with known truth: accuracy, what is kept, what is reported."""

from __future__ import annotations

import sqlite3
import threading
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from multiprocessing import active_children
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pycolmap
import pytest
from helpers.runs import quiet_run
from helpers.tracked_scenes import (
    CAMERA,
    COLOUR,
    World,
    angle_deg,
    arc,
    ball,
    centres_of,
    disturbed,
    disturbed_around_the_truth,
    fitted,
    make_collection,
    make_world,
    pairs_within,
    poses_of,
    rig_from_world,
    rms,
    stitched_scene,
    true_matches,
    turning,
    write_features,
    wrong_matches,
)

from smust3r_colmap.config import FeatureConfig, RefinementConfig
from smust3r_colmap.errors import ConfigError
from smust3r_colmap.execution.progress import Stage
from smust3r_colmap.features import stage as features_stage
from smust3r_colmap.features.seen_surfaces import GRID_CELLS, surfaces_of_clouds
from smust3r_colmap.geometry.arrays import FloatArray, Pair
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.geometry.world_frame import WorldFrame
from smust3r_colmap.products import ImageCollection, PointCloud, RunFeatures, Scene
from smust3r_colmap.refinement import bundle_adjustment, mapper, statistics
from smust3r_colmap.refinement import stage as refine
from smust3r_colmap.refinement.bundle_adjustment import WELL_CONSTRAINED_OBSERVATIONS
from smust3r_colmap.refinement.global_refinement import RefineTask, refine_scenes
from smust3r_colmap.refinement.mapper import redundant_points
from smust3r_colmap.refinement.stage import InitialScenes, Refinement
from smust3r_colmap.refinement.statistics import MIN_OBSERVATIONS, SceneRefinement, Statistics
from smust3r_colmap.segmentation.keyframes import pairs_with_keyframes
from smust3r_colmap.segmentation.view_graph import ViewGraph
from smust3r_colmap.storage.run_directory import StageFolder, read_json

pytestmark = pytest.mark.usefixtures("quiet_pycolmap")

NUM_IMAGES = 14
REACH = 5
NAMES = {3: "ein Bild 03.png", 5: "Größe/画像 5.png", 12: "Größe/ä ö.png"}
WITHOUT_POSE, UNVERIFIED, BLIND, WEAK = 5, 8, 10, 12
LOOK_ALIKE = (0, 13)
SOUND = [i for i in range(NUM_IMAGES) if i not in (WITHOUT_POSE, BLIND, WEAK)]
Rows = npt.NDArray[np.uint32]


@dataclass(frozen=True, kw_only=True, eq=False)
class Refined:
    """A world, its initial poses, and the results of the refinement."""

    world: World
    collection: ImageCollection
    stitched: FloatArray
    folder: Path
    results: tuple[SceneRefinement, ...]

    def names(self, *images: int) -> tuple[str, ...]:
        return tuple(self.collection.images[i].name for i in images)

    def model(self, number: int = 0) -> pycolmap.Reconstruction:
        return pycolmap.Reconstruction(self.folder / str(number) / "model")

    def matches(self) -> dict[Pair, Rows]:
        """Of the database, by pair of image indices."""
        with pycolmap.Database.open(self.folder / "database.db") as database:
            ids, matches = database.read_all_matches()
        pairs = [pycolmap.pair_id_to_image_pair(pair_id) for pair_id in ids]
        return {(a - 1, b - 1): rows for (a, b), rows in zip(pairs, matches, strict=True)}


def refine_task(folder: Path, collection: ImageCollection, scenes: tuple[Scene, ...]) -> RefineTask:
    return RefineTask(
        stored=StageFolder(path=folder / "refined", key="a test"),
        collection=collection,
        scenes=scenes,
        features=folder / "features.db",
        maps=None,
        map_pairs=(),
        segments=(),
        calibrated=collection.calibrated,
        threads=1,
    )


def refined(
    folder: Path,
    world: World,
    stitched: FloatArray,
    *,
    scenes: Sequence[Iterable[int]] | None = None,
    calibrated: bool = False,
    segments: tuple[tuple[int, ...], ...] = (),
    camera: Intrinsics = CAMERA,
) -> Refined:
    """Of true matches between neighbours."""
    collection = make_collection(folder, len(world), calibrated=calibrated, cameras=(camera,))
    pairs = pairs_within(range(len(world)), REACH)
    write_features(folder / "features.db", collection, world, verified={p: true_matches(world, p) for p in pairs})
    groups = [range(len(world))] if scenes is None else scenes
    made = tuple(stitched_scene(collection, stitched, group) for group in groups)
    results = refine_scenes(replace(refine_task(folder, collection, made), segments=segments))
    return Refined(world=world, collection=collection, stitched=stitched, folder=folder / "refined", results=results)


OTHERS, CONTRADICTED, NUM_WRONG = (3, 4, 8, 11), 8, 150
BLURRED, SHARP = 3, 4


@pytest.fixture(scope="module")
def between_keyframes(tmp_path_factory: pytest.TempPathFactory) -> tuple[Refined, Refined]:
    """Keyframes alone, and with those between them: one matches more of what it does not see, one no keyframe."""
    rng = np.random.default_rng(5)
    world = make_world(arc(NUM_IMAGES), ball(220, rng), rng)
    stitched = disturbed(world.cam_from_world, rng, position=0.006 * world.extent, rotation_deg=0.4)
    keyframes = [i for i in range(NUM_IMAGES) if i not in OTHERS]
    matches = {pair: true_matches(world, pair) for pair in pairs_within(keyframes, REACH)}
    of_others = {pair: true_matches(world, pair) for pair in pairs_with_keyframes(NUM_IMAGES, OTHERS)}
    of_others = {pair: rows for pair, rows in of_others.items() if BLURRED not in pair}
    of_others[BLURRED, SHARP] = true_matches(world, (BLURRED, SHARP))
    after = (CONTRADICTED, CONTRADICTED + 1)
    of_others[CONTRADICTED - 1, CONTRADICTED] = of_others[CONTRADICTED - 1, CONTRADICTED][: NUM_WRONG // 2]
    of_others[after] = wrong_matches(world, after, NUM_WRONG, rng)
    found = []
    for name, others in (("alone", ()), ("all", OTHERS)):
        folder = tmp_path_factory.mktemp(name)
        collection = make_collection(folder, NUM_IMAGES)
        verified = {**matches, **(of_others if others else {})}
        write_features(folder / "features.db", collection, world, verified=verified)
        images = tuple(replace(image, is_keyframe=k not in others) for k, image in enumerate(collection.images))
        collection = replace(collection, images=images)
        results = refine_scenes(refine_task(folder, collection, (stitched_scene(collection, stitched, keyframes),)))
        found.append(
            Refined(world=world, collection=collection, stitched=stitched, folder=folder / "refined", results=results)
        )
    return found[0], found[1]


def num_right(world: World, pair: Pair, rows: Rows) -> int:
    a, b = (world.point_of[image][rows[:, side]] for side, image in enumerate(pair))
    return int(((a == b) & (a >= 0)).sum())


def with_ghosts(world: World, rng: np.random.Generator) -> tuple[World, Rows]:
    """The last image also shows what it would see from where image 1 is; and how this matches with image 0.

    Verified alone, the pair is one of neighbours; the stitched cameras stand on two sides.
    """
    image, last = LOOK_ALIKE
    twin = make_world(world.cam_from_world[[image, 1]], world.points, rng, clutter=0)
    keypoints, point_of = list(world.keypoints), list(world.point_of)
    first_ghost = len(keypoints[last])
    keypoints[last] = np.concatenate([keypoints[last], twin.keypoints[1]])
    point_of[last] = np.concatenate([point_of[last], np.full(len(twin.keypoints[1]), -1)])
    twin = replace(twin, point_of=(world.point_of[image], twin.point_of[1]))
    rows = true_matches(twin, (0, 1)) + np.array([0, first_ghost], np.uint32)
    return replace(world, keypoints=tuple(keypoints), point_of=tuple(point_of)), rows


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Refined:
    """Round a ball, with everything that happens: see the names at the top."""
    folder = tmp_path_factory.mktemp("walk")
    rng = np.random.default_rng(11)
    world, look_alike = with_ghosts(make_world(arc(NUM_IMAGES), ball(220, rng), rng), rng)
    point_of = list(world.point_of)
    matched = np.flatnonzero(point_of[WEAK] >= 0)
    point_of[WEAK] = np.where(
        np.isin(np.arange(len(point_of[WEAK])), matched[: MIN_OBSERVATIONS - 3]), point_of[WEAK], -1
    )
    world = replace(world, point_of=tuple(point_of))
    stitched = disturbed(world.cam_from_world, rng, position=0.006 * world.extent, rotation_deg=0.4)
    collection = make_collection(folder, NUM_IMAGES, names=NAMES)
    pairs = [p for p in pairs_within(range(NUM_IMAGES), REACH) if BLIND not in p]
    verified = {pair: true_matches(world, pair) for pair in pairs if UNVERIFIED not in pair}
    raw = {}
    for pair in pairs:
        if UNVERIFIED in pair:
            true = true_matches(world, pair)
            raw[pair] = np.concatenate([true, wrong_matches(world, pair, len(true) // 4, rng)])
    write_features(
        folder / "features.db",
        collection,
        world,
        verified={**verified, LOOK_ALIKE: look_alike},
        raw=raw,
        without_features={BLIND},
    )
    scene = stitched_scene(collection, stitched, [i for i in range(NUM_IMAGES) if i != WITHOUT_POSE])
    results = refine_scenes(refine_task(folder, collection, (scene,)))
    return Refined(world=world, collection=collection, stitched=stitched, folder=folder / "refined", results=results)


def small_world(seed: int = 5, num_images: int = 7) -> tuple[World, FloatArray]:
    """A world that takes a tenth of a second, and disturbed poses."""
    rng = np.random.default_rng(seed)
    world = make_world(arc(num_images, angle=0.3 * np.pi), ball(120, rng), rng)
    return world, disturbed(world.cam_from_world, rng, position=0.006 * world.extent, rotation_deg=0.3)


# ------------------------------------------------------------------------- one walk
def test_disturbed_poses_come_back_to_the_truth(walk: Refined) -> None:
    poses = poses_of(walk.model())
    centres, truth = centres_of(np.stack([poses[i] for i in SOUND])), walk.world.centres[SOUND]
    scale, aligned = fitted(centres, truth)
    assert rms(centres_of(walk.stitched)[SOUND], truth) / walk.world.extent > 0.008
    assert 1e-5 < rms(aligned, truth) / walk.world.extent < 1e-3
    assert rms(centres, truth) / walk.world.extent < 0.006, "where the stitched frame is"
    turned = [angle_deg(poses[i], walk.world.cam_from_world[i]) for i in SOUND]
    assert 0.001 < np.median(turned) < 0.25
    assert abs(scale - 1) < 0.005, "what the stitched cameras know of it"


def test_statistics_are_those_of_the_stored_model_and_every_step_is_reported(walk: Refined) -> None:
    (result,) = walk.results
    assert result.succeeded
    assert result.reason == ""
    read_back = Statistics.of(walk.model())
    assert read_back.reprojection_error_px == pytest.approx(result.statistics.reprojection_error_px)
    assert replace(read_back, reprojection_error_px=0) == replace(result.statistics, reprojection_error_px=0)
    assert 0.2 < result.statistics.reprojection_error_px < 0.6
    assert result.statistics.mean_track_length > 5
    names = [step.name for step in result.steps]
    assert names[:2] == ["triangulation", "bundle adjustment"]
    assert "second bundle adjustment" in names
    assert names[-1] == "final bundle adjustment"
    by_name = {step.name: step for step in result.steps}
    first = by_name["bundle adjustment"]
    assert first.before.reprojection_error_px > 5 * first.after.reprojection_error_px
    assert 0.3 < first.moved_percent < 3
    assert 0.1 < first.turned_deg < 1
    assert all(step.accepted for step in result.steps)
    stored = read_json(walk.folder / "refinements.json")
    assert [step["name"] for step in stored[0]["steps"]] == names


def test_look_alike_pair_is_rejected_and_leaves_no_track(walk: Refined) -> None:
    (result,) = walk.results
    assert result.num_unverified_pairs == 1
    assert LOOK_ALIKE not in walk.matches()
    first_ghost = len(walk.world.keypoints[13]) - int((walk.world.point_of[13] == -1).sum()) + 20
    points = walk.model().image(14).points2D
    assert not any(point.has_point3D() for point in points[first_ghost:])
    assert sum(point.has_point3D() for point in points) > 60


def test_raw_matches_of_pairs_without_verification_are_used_if_they_agree_with_the_geometry(walk: Refined) -> None:
    matches = walk.matches()
    others = [i for i in SOUND if 0 < abs(i - UNVERIFIED) <= REACH]
    for pair in [(min(i, UNVERIFIED), max(i, UNVERIFIED)) for i in others]:
        true = true_matches(walk.world, pair)
        right = num_right(walk.world, pair, matches[pair])
        assert right > 0.95 * len(true)
        assert len(matches[pair]) - right < 0.1 * len(true), "a quarter was offered"
    assert walk.model().image(UNVERIFIED + 1).num_points3D > WELL_CONSTRAINED_OBSERVATIONS


def test_weak_images_are_listed_and_keep_their_initial_pose_relative_to_their_neighbours(walk: Refined) -> None:
    (result,) = walk.results
    assert result.weak == walk.names(BLIND, WEAK)
    assert result.statistics.num_weak == 2
    poses = poses_of(walk.model())
    centres = invert_rigid(walk.stitched)[:, :, 3]
    for weak in (BLIND, WEAK):
        anchors = [i for i in SOUND if i != WITHOUT_POSE]
        near = anchors[int(np.argmin(np.linalg.norm(centres[anchors] - centres[weak], axis=1)))]
        there, before = (rotation_and_centre_from(p[near], p[weak]) for p in (poses, dict(enumerate(walk.stitched))))
        np.testing.assert_allclose(there, before, atol=1e-9)
    assert walk.model().image(WEAK + 1).num_points3D < MIN_OBSERVATIONS


def rotation_and_centre_from(near_from_world: FloatArray, weak_from_world: FloatArray) -> FloatArray:
    """(3, 4) of the weak camera in the near one."""
    rotation = near_from_world[:, :3] @ weak_from_world[:, :3].T
    return np.column_stack([rotation, near_from_world[:, 3] - rotation @ weak_from_world[:, 3]])


def test_observations_of_a_weak_image_fit_its_pose(walk: Refined) -> None:
    """It was reset; observations that do not fit any more must not stay in the tracks."""
    model = walk.model()
    image = model.image(WEAK + 1)
    for point2d in image.points2D:
        if point2d.has_point3D():
            seen = image.project_point(model.point3D(point2d.point3D_id).xyz)
            assert seen is not None, "in front"
            assert np.linalg.norm(point2d.xy - seen) <= 4.001


def test_image_without_a_pose_is_registered(walk: Refined) -> None:
    (result,) = walk.results
    assert result.registered == walk.names(WITHOUT_POSE)
    assert result.statistics.num_images == NUM_IMAGES
    pose = poses_of(walk.model())[WITHOUT_POSE]
    assert angle_deg(pose, walk.world.cam_from_world[WITHOUT_POSE]) < 0.4
    off = np.linalg.norm(centres_of(pose[None])[0] - walk.world.centres[WITHOUT_POSE])
    assert 1e-5 < off / walk.world.extent < 0.008


def test_tracks_are_of_two_images_or_more_and_of_the_right_points(walk: Refined) -> None:
    model = walk.model()
    pure = 0
    for point in model.points3D.values():
        images = [element.image_id for element in point.track.elements]
        assert len(set(images)) == len(images) >= 2
        seen = {walk.world.point_of[e.image_id - 1][e.point2D_idx] for e in point.track.elements}
        pure += int(len(seen) == 1 and -1 not in seen)
    assert pure >= 0.98 * len(model.points3D)
    assert 0.9 * len(walk.world.points) < len(model.points3D) < 1.15 * len(walk.world.points)


def test_points_of_two_images_are_removed_if_both_have_enough_others(walk: Refined) -> None:
    assert_no_redundant_points(walk.model())


def test_points_that_the_last_filter_leaves_to_two_images_are_removed_too(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    world = make_world(arc(14), ball(300, rng), rng, noise_px=1.4)
    made = refined(
        tmp_path, world, disturbed(world.cam_from_world, rng, position=0.004 * world.extent, rotation_deg=0.3)
    )
    assert made.results[0].weak == ()
    assert_no_redundant_points(made.model())


def assert_no_redundant_points(model: pycolmap.Reconstruction) -> None:
    longer = dict.fromkeys(model.images, 0)
    pairs = []
    for point in model.points3D.values():
        images = [element.image_id for element in point.track.elements]
        if len(images) == 2:
            pairs.append(images)
        else:
            for image_id in images:
                longer[image_id] += 1
    assert sum(count >= WELL_CONSTRAINED_OBSERVATIONS for count in longer.values()) >= 10
    assert all(min(longer[i] for i in pair) < WELL_CONSTRAINED_OBSERVATIONS for pair in pairs)


def test_redundant_points_are_those_of_two_images_with_enough_others() -> None:
    """Images 1 to 3 share 80 points; 1 and 2 share 10 more, and 3 and 4 share 7, all that 4 has."""
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(CAMERA.colmap_camera(1))
    for image_id in range(1, 5):
        image = pycolmap.Image(name=f"{image_id}", camera_id=1, image_id=image_id)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(np.array([k, 1.0])) for k in range(97)])
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    seen_by = [(1, 2, 3)] * 80 + [(1, 2)] * 10 + [(3, 4)] * 7
    for row, images in enumerate(seen_by):
        elements = [pycolmap.TrackElement(image_id, row) for image_id in images]
        model.add_point3D(np.array([0.0, 0, 1 + row]), pycolmap.Track(elements), np.zeros(3, np.uint8))
    tracks = [tuple(e.image_id for e in model.point3D(i).track.elements) for i in redundant_points(model)]
    assert tracks == [(1, 2)] * 10


def test_database_and_model_name_and_number_everything_alike(walk: Refined) -> None:
    model = walk.model()
    with pycolmap.Database.open(walk.folder / "database.db") as database:
        images = {image.image_id: image for image in database.read_all_images()}
        counts = {image_id: len(database.read_keypoints(image_id)) for image_id in images}
        cameras = {camera.camera_id: camera for camera in database.read_all_cameras()}
        frames = {frame.frame_id for frame in database.read_all_frames()}
        priors = {prior.pose_prior_id: prior for prior in database.read_all_pose_priors()}
    assert {i: image.name for i, image in images.items()} == {
        i + 1: image.name for i, image in enumerate(walk.collection.images)
    }
    assert {i: image.name for i, image in model.images.items()} == {i: image.name for i, image in images.items()}
    assert {i: len(image.points2D) for i, image in model.images.items()} == counts
    assert {i: image.frame_id for i, image in model.images.items()} == {i: i for i in images}
    assert {i: image.camera_id for i, image in model.images.items()} == {
        i: image.camera_id for i, image in images.items()
    }
    assert frames == set(images)
    assert list(cameras[1].params) == list(model.camera(1).params)
    assert set(priors) == set(model.reg_image_ids())
    for i, prior in priors.items():
        np.testing.assert_allclose(prior.position, model.image(i).projection_center(), atol=1e-9)
        assert prior.corr_data_id == model.image(i).data_id
        assert np.linalg.eigvalsh(prior.position_covariance).min() > 0
    assert len({np.trace(prior.position_covariance) for prior in priors.values()}) == len(priors)


def test_points_have_the_colour_of_the_images(walk: Refined) -> None:
    assert {tuple(point.color.tolist()) for point in walk.model().points3D.values()} == {COLOUR}


def test_focal_length_and_distortion_are_found(walk: Refined) -> None:
    focal, x, y, k = walk.model().camera(1).params
    assert 1e-6 < abs(focal / CAMERA.params[0] - 1) < 0.02
    assert abs(k - CAMERA.params[3]) < 0.05
    assert np.hypot(x - 320, y - 240) < 12


@pytest.mark.parametrize(
    ("model", "start", "truth"),
    [
        ("PINHOLE", (540.0, 575.0, 320.0, 240.0), (560.0, 555.0, 320.0, 240.0)),
        (
            "OPENCV",
            (575.0, 575.0, 320.0, 240.0, 0.0, 0.0, 0.0, 0.0),
            (560.0, 555.0, 320.0, 240.0, -0.08, 0.02, 0.0, 0.0),
        ),
        (
            "OPENCV_FISHEYE",
            (350.0, 350.0, 320.0, 240.0, 0.0, 0.0, 0.0, 0.0),
            (340.0, 338.0, 320.0, 240.0, 0.02, 0.0, 0.0, 0.0),
        ),
    ],
)
def test_cameras_of_other_models_are_found(
    model: str, start: tuple[float, ...], truth: tuple[float, ...], tmp_path: Path
) -> None:
    true_camera = Intrinsics(model=model, width=640, height=480, params=truth)
    rng = np.random.default_rng(7)
    world = make_world(arc(12), 2.2 * ball(250, rng), rng, camera=true_camera)  # into the corners
    stitched = disturbed(world.cam_from_world, rng, position=0.004 * world.extent, rotation_deg=0.3)
    made = refined(tmp_path, world, stitched, camera=replace(true_camera, params=start))
    camera = made.model().camera(1)
    assert camera.model.name == model
    where_points_are = np.array([(220.0, 170.0), (420.0, 170.0), (320.0, 330.0)])
    found, at_first, true_rays = (
        one.rays_cam(where_points_are)
        for one in (Intrinsics.from_colmap(camera), replace(true_camera, params=start), true_camera)
    )
    assert np.abs(found - true_rays).max() < np.abs(at_first - true_rays).max() / 2
    _, aligned = fitted(centres_of(np.stack(list(poses_of(made.model()).values()))), world.centres)
    assert rms(aligned, world.centres) < rms(centres_of(stitched), world.centres) / 3


def test_distortion_that_diverges_is_fixed_and_everything_else_adjusted(tmp_path: Path) -> None:
    """Near the middle of a fisheye image its four terms make up for each other."""
    params = (350.0, 350.0, 320.0, 240.0, 0.0, 0.0, 0.0, 0.0)
    camera = Intrinsics(model="OPENCV_FISHEYE", width=640, height=480, params=params)
    rng = np.random.default_rng(7)
    world = make_world(arc(12), ball(250, rng), rng, camera=camera)
    stitched = disturbed(world.cam_from_world, rng, position=0.004 * world.extent, rotation_deg=0.3)
    made = refined(tmp_path, world, stitched, camera=camera)
    steps = [(step.name, step.accepted) for step in made.results[0].steps]
    k = steps.index(("bundle adjustment", False))
    assert "distortion parameter of camera 1 exceeds" in made.results[0].steps[k].reason
    assert steps[k + 1] == ("bundle adjustment with fixed intrinsics", True)
    assert tuple(made.model().camera(1).params) == params
    _, aligned = fitted(centres_of(np.stack(list(poses_of(made.model()).values()))), world.centres)
    assert rms(aligned, world.centres) < rms(centres_of(stitched), world.centres) / 3


# ----------------------------------------------------------------------- the frame stays
def test_scale_and_frame_stay_because_of_the_priors(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Stitched centres that a best fit finds exactly in the true frame: 0.2 % with priors, drift without."""
    rng = np.random.default_rng(21)
    world = make_world(arc(12), ball(150, rng), rng)
    stitched = disturbed_around_the_truth(world, rng)
    found = {}
    for name, min_priors in (("with", bundle_adjustment.MIN_PRIORS), ("without", 1000)):
        monkeypatch.setattr(bundle_adjustment, "MIN_PRIORS", min_priors)
        folder = tmp_path / name
        folder.mkdir()
        poses = poses_of(refined(folder, world, stitched).model())
        found[name] = centres_of(np.stack([poses[i] for i in range(12)]))
    scale = {name: fitted(world.centres, centres)[0] for name, centres in found.items()}
    assert abs(scale["with"] - 1) < 0.002
    assert rms(found["with"], world.centres) / world.extent < 0.005
    assert 0.01 < abs(scale["without"] - 1) < 0.3
    assert rms(found["without"], world.centres) / world.extent > 0.01


# ----------------------------------------------------------------------- several scenes
@pytest.fixture(scope="module")
def two_scenes(tmp_path_factory: pytest.TempPathFactory) -> Refined:
    """Images 0 to 6 and 7 to 11, each in a frame of its own, cameras calibrated, matches across, and one alone."""
    rng = np.random.default_rng(31)
    world = make_world(arc(13), ball(150, rng), rng)
    stitched = disturbed(world.cam_from_world, rng, position=0.004 * world.extent, rotation_deg=0.3)
    stitched[7:12] = np.concatenate([stitched[7:12, :, :3], 2.5 * stitched[7:12, :, 3:]], axis=2)
    folder = tmp_path_factory.mktemp("two")
    return refined(folder, world, stitched, scenes=[range(7), range(7, 12), [12]], calibrated=True)


def test_every_scene_is_refined_by_itself(two_scenes: Refined) -> None:
    first, second, alone = two_scenes.results
    assert (first.succeeded, second.succeeded, alone.succeeded) == (True, True, False)
    assert sorted(poses_of(two_scenes.model(0))) == [*range(7)]
    assert sorted(poses_of(two_scenes.model(1))) == [*range(7, 12)]
    for number, images, scale in ((0, range(7), 1.0), (1, range(7, 12), 2.5)):
        poses = poses_of(two_scenes.model(number))
        centres = centres_of(np.stack([poses[i] for i in images]))
        truth = two_scenes.world.centres[list(images)]
        found, aligned = fitted(truth, centres)
        assert found == pytest.approx(scale, rel=0.04)
        assert rms(aligned, centres) / scale / two_scenes.world.extent < 2e-3


def test_single_image_keeps_its_pose_with_a_reason(two_scenes: Refined) -> None:
    alone = two_scenes.results[2]
    assert "no point could be triangulated" in alone.reason
    assert (alone.registered, alone.statistics.num_points) == ((), 0)


def test_calibrated_cameras_stay_to_the_last_digit(two_scenes: Refined) -> None:
    for number in range(2):
        assert tuple(two_scenes.model(number).camera(1).params) == CAMERA.params
    with pycolmap.Database.open(two_scenes.folder / "database.db") as database:
        assert tuple(database.read_camera(1).params) == CAMERA.params


def test_database_joins_the_scenes(two_scenes: Refined) -> None:
    """A continuation may tie them: verified matches across stay, priors are of the largest scene, whose frame it is."""
    matches = two_scenes.matches()
    assert {pair for pair in matches if pair[0] < 7 <= pair[1]} == {
        (i, j) for i, j in pairs_within(range(13), REACH) if i < 7 <= j
    }
    with pycolmap.Database.open(two_scenes.folder / "database.db") as database:
        priors = {prior.pose_prior_id for prior in database.read_all_pose_priors()}
        assert database.num_images() == 13
    assert priors == set(range(1, 8))


# ------------------------------------------------------------------ nothing to work with
def no_matches(world: World) -> World:
    return replace(world, point_of=tuple(np.full(len(rows), -1) for rows in world.point_of))


def no_features(world: World) -> World:
    return replace(
        world,
        keypoints=tuple(np.empty((0, 2), np.float32) for _ in world.keypoints),
        point_of=tuple(np.empty(0, np.int64) for _ in world.point_of),
    )


def first_image(world: World) -> World:
    return replace(
        world, cam_from_world=world.cam_from_world[:1], keypoints=world.keypoints[:1], point_of=world.point_of[:1]
    )


def only_turning(world: World) -> World:
    rng = np.random.default_rng(2)
    return make_world(turning(6), rng.uniform([-3, -2, 4], [5, 2, 9], (200, 3)), rng)


@pytest.mark.parametrize("make", [no_matches, no_features, first_image, only_turning])
def test_if_nothing_can_be_triangulated_the_initial_poses_are_kept_with_a_reason(
    make: Callable[[World], World], tmp_path: Path
) -> None:
    world = make(small_world()[0])
    made = refined(tmp_path, world, world.cam_from_world)
    (result,) = made.results
    assert not result.succeeded
    assert "no point could be triangulated" in result.reason
    assert result.weak == made.names(*range(len(world)))
    poses = poses_of(made.model())
    for i, pose in enumerate(world.cam_from_world):
        np.testing.assert_allclose(poses[i], pose, atol=1e-12)
    with pycolmap.Database.open(made.folder / "database.db") as database:
        assert database.num_images() == len(world)


def test_two_images_are_refined(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    world = make_world(arc(12)[[0, 2]], ball(200, rng), rng)
    stitched = disturbed(world.cam_from_world, rng, position=0.01, rotation_deg=0.3)
    made = refined(tmp_path, world, stitched)
    (result,) = made.results
    assert result.succeeded
    assert result.statistics.num_points > 60
    assert result.statistics.mean_track_length == 2.0
    assert result.statistics.reprojection_error_px < 0.4
    assert tuple(made.model().camera(1).params) == CAMERA.params


def test_if_all_images_are_weak_the_initial_poses_are_kept(tmp_path: Path) -> None:
    rng = np.random.default_rng(6)
    world = make_world(arc(5, angle=0.2 * np.pi), ball(14, rng), rng, clutter=5)
    stitched = disturbed(world.cam_from_world, rng, position=0.01, rotation_deg=0.2)
    made = refined(tmp_path, world, stitched)
    (result,) = made.results
    assert not result.succeeded
    assert result.reason == "no image has enough observations"
    assert result.weak == made.names(*range(5))


def test_image_that_was_registered_and_ends_up_weak_is_deregistered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(8)
    world = make_world(arc(8, angle=0.35 * np.pi), ball(160, rng), rng)
    few = world.point_of[7].copy()
    few[np.flatnonzero(few >= 0)[45:]] = -1
    world = replace(world, point_of=(*world.point_of[:7], few))
    for enough, found in ((MIN_OBSERVATIONS, (7,)), (60, ())):
        monkeypatch.setattr(statistics, "MIN_OBSERVATIONS", enough)
        folder = tmp_path / str(enough)
        folder.mkdir()
        made = refined(folder, world, world.cam_from_world, scenes=[range(7)])
        (result,) = made.results
        assert result.registered == made.names(*found)
        assert result.weak == ()
        assert result.statistics.num_images == 7 + len(found)
        model = made.model()
        assert sorted(model.images) == list(range(1, 8 + len(found)))
        assert all(e.image_id in model.images for point in model.points3D.values() for e in point.track.elements)
        assert all(point.track.length() >= 2 for point in model.points3D.values())


# ----------------------------------------------------------------------- rejected
@pytest.mark.slow
def test_adjustments_that_diverge_are_rejected_and_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def diverge(model: pycolmap.Reconstruction, *_: Any, **__: Any) -> bool:
        rng = np.random.default_rng(0)
        for frame_id in model.reg_frame_ids():
            pose, shift = rig_from_world(model, frame_id), rng.normal(size=3)
            model.frame(frame_id).rig_from_world = pycolmap.Rigid3d(pose.rotation, pose.translation + shift)
        camera = model.camera(1)
        camera.params = [3 * camera.params[0], *camera.params[1:]]
        return True

    world, stitched = small_world()
    monkeypatch.setattr(mapper, "adjust", diverge)
    made = refined(tmp_path, world, stitched)
    (result,) = made.results
    rejected = [step for step in result.steps if "adjustment" in step.name]
    assert len(rejected) >= 6
    assert [step.name for step in rejected[:2]] == ["bundle adjustment", "bundle adjustment with fixed intrinsics"]
    assert not any(step.accepted for step in rejected)
    assert all("focal length of camera 1 changed by a factor of 3" in step.reason for step in rejected)
    assert f"no bundle adjustment was accepted: {rejected[-1].reason}" in result.warnings
    assert tuple(made.model().camera(1).params) == CAMERA.params
    poses = poses_of(made.model())
    for i, pose in enumerate(stitched):
        np.testing.assert_allclose(poses[i], pose, atol=1e-14)


def test_segments_of_a_large_model_are_adjusted_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    world, stitched = small_world(num_images=10)
    monkeypatch.setattr(mapper, "LARGE_SCENE_IMAGES", 9)
    made = refined(tmp_path, world, stitched, segments=((0, 1, 2, 3, 4, 5), (4, 5, 6, 7, 8, 9), (100, 101)))
    (result,) = made.results
    assert [step.name for step in result.steps][:3] == [
        "triangulation",
        "bundle adjustment of segments",
        "bundle adjustment",
    ]
    segments, whole = result.steps[1:3]
    assert segments.accepted
    assert segments.before.reprojection_error_px > 1.5 * segments.after.reprojection_error_px
    assert 0 < whole.after.reprojection_error_px < segments.after.reprojection_error_px
    poses = poses_of(made.model())
    centres = centres_of(np.stack([poses[i] for i in range(10)]))
    _, aligned = fitted(centres, world.centres)
    assert rms(aligned, world.centres) / world.extent < 2e-3


def test_one_thread_gives_the_same_bits_twice(tmp_path: Path) -> None:
    """With an image to place, which takes random choices."""
    world, stitched = small_world()
    files: list[dict[str, bytes]] = []
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
        made = refined(tmp_path / name, world, stitched, scenes=[range(6)])
        assert made.results[0].registered == made.names(6)
        files.append({path.name: path.read_bytes() for path in sorted((made.folder / "0" / "model").iterdir())})
    assert {"images.bin", "points3D.bin", "cameras.bin"} <= files[0].keys()
    assert files[0] == files[1]


# -------------------------------------------------------------------- stages and children
@dataclass(frozen=True, kw_only=True, eq=False)
class Start:
    """What a run hands to refinement."""

    world: World
    collection: ImageCollection
    scenes: tuple[Scene, ...]
    features: RunFeatures
    output: Path

    def refine(self, options: RefinementConfig | None = None, *, with_surfaces: bool = False) -> Refinement:
        """As the pipeline does it; without surfaces no new pairs are looked for."""
        seen = [self.world.points[rows[rows >= 0]] for rows in self.world.point_of]
        initial = InitialScenes(
            scenes=self.scenes,
            subsets=(),
            view_graph=ViewGraph.chain(len(self.world)),
            surfaces=dict(enumerate(seen)) if with_surfaces else {},
        )
        with quiet_run(self.output) as run:
            found = refine.refine(
                run, initial, self.collection, self.features, options or RefinementConfig(), FeatureConfig()
            )
        assert found is not None
        return found


@pytest.fixture
def start(tmp_path: Path) -> Start:
    world, stitched = small_world()
    collection = make_collection(tmp_path, len(world))
    pairs = pairs_within(range(len(world)), 3)
    path = tmp_path / "features.db"
    write_features(path, collection, world, verified={pair: true_matches(world, pair) for pair in pairs})
    features = RunFeatures(database=path, key="features", usable=(True,) * len(world), rejected=())
    scene = stitched_scene(collection, stitched)
    return Start(world=world, collection=collection, scenes=(scene,), features=features, output=tmp_path / "out")


def in_this_process(function: Callable[[Any], Any], task: Any, **_: Any) -> Any:
    return function(task)


@pytest.mark.slow
def test_child_does_the_work_and_a_second_start_reads_what_it_stored(
    start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = start.refine()
    assert first.models == (first.folder / "0" / "model",)
    assert first.database.is_file()
    assert first.results[0].succeeded
    (scene,) = first.scenes
    poses = poses_of(pycolmap.Reconstruction(first.folder / "0" / "model"))
    np.testing.assert_array_equal(scene.cam_from_world, np.stack([poses[i] for i in range(len(scene))]))
    assert scene.image_names == start.scenes[0].image_names
    assert scene.cameras[0].params != CAMERA.params
    assert not np.array_equal(scene.cam_from_world, start.scenes[0].cam_from_world)

    def refuse(*_: Any, **__: Any) -> None:
        raise AssertionError("nothing is left to do")

    monkeypatch.setattr(refine, "in_child", refuse)
    second = start.refine()
    assert second.results == first.results
    np.testing.assert_array_equal(second.scenes[0].cam_from_world, scene.cam_from_world)
    assert second.scenes[0].cameras == scene.cameras


@pytest.mark.slow
def test_other_settings_or_poses_are_another_refinement(start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    runs = []

    def count(function: Callable[[Any], Any], task: Any, **rest: Any) -> Any:
        runs.append(task)
        return in_this_process(function, task, **rest)

    monkeypatch.setattr(refine, "in_child", count)
    start.refine()
    start.refine()
    assert len(runs) == 1
    start.refine(RefinementConfig(track_neighbours=3))
    assert len(runs) == 2
    moved = replace(start.scenes[0], cam_from_world=start.world.cam_from_world)
    replace(start, scenes=(moved,)).refine()
    assert len(runs) == 3


def test_second_start_wants_the_same_pairs_although_they_are_matched_now(
    start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else every start would find and match further ones, and never read what it stored."""
    wanted: list[list[Pair]] = []

    def match(database: Path, pairs: Iterable[Pair], *, stage: Stage, **_: Any) -> frozenset[Pair]:
        wanted.append(sorted(pairs))
        with pycolmap.Database.open(database) as opened:
            for i, j in wanted[-1]:
                if not opened.exists_matches(i + 1, j + 1):
                    opened.write_matches(i + 1, j + 1, true_matches(start.world, (i, j)))
        return frozenset(wanted[-1])

    monkeypatch.setattr(features_stage, "match_pairs", match)
    monkeypatch.setattr(refine, "in_child", in_this_process)
    options = RefinementConfig(track_neighbours=1)
    first = start.refine(options, with_surfaces=True)
    second = start.refine(options, with_surfaces=True)
    assert wanted[0] == wanted[1] != []
    assert not set(wanted[0]) & set(pairs_within(range(len(start.world)), 3))
    assert first.results == second.results
    assert first.folder.joinpath("stage.json").read_bytes() == second.folder.joinpath("stage.json").read_bytes()


def assert_not_refined(made: Refinement, start: Start) -> None:
    assert made.scenes == start.scenes
    assert made.models == (None,)
    (result,) = made.results
    assert not result.succeeded
    assert result.steps == ()


def test_child_that_is_killed_leaves_the_initial_poses_with_a_reason(start: Start) -> None:
    over = threading.Event()

    def kill() -> None:
        while not over.wait(0.05):
            for child in active_children():
                child.kill()

    killer = threading.Thread(target=kill)
    killer.start()
    try:
        made = start.refine()
    finally:
        over.set()
        killer.join()
    assert_not_refined(made, start)
    assert "the process that worked on it died" in made.results[0].reason
    assert not list((start.output / "work").glob("refined*/stage.json"))


@pytest.mark.slow
def test_damaged_database_leaves_the_initial_poses_with_a_reason(start: Start) -> None:
    with sqlite3.connect(start.features.database) as connection:
        connection.execute("UPDATE keypoints SET rows = 5")
    made = start.refine()
    assert_not_refined(made, start)
    assert made.results[0].reason


def test_tracks_of_pointmaps_need_maps(start: Start) -> None:
    with pytest.raises(ConfigError, match="--track-source pointmaps: the model has no depth maps; take features"):
        start.refine(RefinementConfig(track_source="pointmaps"))


# -------------------------------------------------------------------------- surfaces
def test_surface_of_an_image_is_the_nearest_of_the_cloud_in_every_cell() -> None:
    world, _ = small_world()
    rng = np.random.default_rng(1)
    shell = ball(4000, rng)
    shell /= np.linalg.norm(shell, axis=1, keepdims=True)
    cloud = PointCloud(xyz=shell, rgb=np.zeros((len(shell), 3), np.uint8))
    collection_of = Scene(
        image_indices=tuple(range(len(world))),
        image_names=tuple(str(i) for i in range(len(world))),
        camera_indices=(0,) * len(world),
        cameras={0: CAMERA},
        cam_from_world=world.cam_from_world,
        points=cloud,
        frame=WorldFrame(metric=True),
        segments=("0",),
    )
    surfaces = surfaces_of_clouds([collection_of])
    assert set(surfaces) == set(range(len(world)))
    for i, points in surfaces.items():
        towards = world.centres[i] / np.linalg.norm(world.centres[i])
        assert 15 < len(points) <= GRID_CELLS**2
        assert (points @ towards > 0).mean() > 0.9, "the far side of the ball is hidden"


# ------------------------------------------------------------------- between keyframes
def test_images_between_keyframes_are_registered_where_they_are(between_keyframes: tuple[Refined, Refined]) -> None:
    _, complete = between_keyframes
    (result,) = complete.results
    right = [i for i in OTHERS if i != CONTRADICTED]
    assert result.registered == complete.names(*right)
    assert set(complete.model().reg_image_ids()) == {i + 1 for i in range(NUM_IMAGES) if i != CONTRADICTED}
    poses = poses_of(complete.model())
    at = sorted(poses)
    truth = centres_of(complete.world.cam_from_world[at])
    _, placed = fitted(centres_of(np.stack([poses[i] for i in at])), truth)
    distance = np.linalg.norm(placed - truth, axis=1)
    assert distance[[at.index(i) for i in right]].max() < 0.002 * complete.world.extent


def test_keyframes_do_not_move_for_the_images_between_them(between_keyframes: tuple[Refined, Refined]) -> None:
    alone, complete = (one.model() for one in between_keyframes)
    for image_id in alone.reg_image_ids():
        np.testing.assert_array_equal(
            complete.image(image_id).cam_from_world().matrix(), alone.image(image_id).cam_from_world().matrix()
        )
    assert complete.camera(1).params.tolist() == alone.camera(1).params.tolist()
    assert complete.num_points3D() == alone.num_points3D()
    seen = [complete.image(i + 1).num_points3D for i in OTHERS if i != CONTRADICTED]
    assert min(seen) > MIN_OBSERVATIONS
