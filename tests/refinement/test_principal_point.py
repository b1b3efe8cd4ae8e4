"""The principal point is refined where the model determines it, and only there."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pycolmap
import pytest
from helpers.runs import quiet_run
from helpers.tracked_scenes import (
    CAMERA,
    World,
    angle_deg,
    ball,
    cam_from_world_towards,
    centres_of,
    disturbed,
    fitted,
    make_collection,
    make_world,
    model_with_true_tracks,
    pairs_within,
    poses_of,
    rig_from_world,
    rms,
    stitched_scene,
    true_matches,
    write_features,
)

from smust3r_colmap.config import FeatureConfig, RefinementConfig
from smust3r_colmap.execution.task_pool import TaskFailure
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.products import RunFeatures
from smust3r_colmap.refinement import global_refinement as task
from smust3r_colmap.refinement import principal_point
from smust3r_colmap.refinement import stage as refine
from smust3r_colmap.refinement.bundle_adjustment import Priors, adjust, priors_of
from smust3r_colmap.refinement.global_refinement import RefineTask, refine_scenes
from smust3r_colmap.refinement.principal_point import (
    MAX_DIFFERENCE_FRACTION,
    MAX_SHIFT_FRACTION,
    MIN_COST_REDUCTION,
    MIN_IMAGES,
    PrincipalPointEstimate,
    estimate_principal_points,
)
from smust3r_colmap.refinement.stage import InitialScenes
from smust3r_colmap.refinement.statistics import SceneRefinement
from smust3r_colmap.segmentation.view_graph import ViewGraph
from smust3r_colmap.storage.run_directory import StageFolder

pytestmark = pytest.mark.usefixtures("quiet_pycolmap")

MIDDLE = np.array([320.0, 240.0])
SHIFT = np.array([5.12, -3.84])
"""One percent of the width: 6.4 px."""
NUM_IMAGES = 20
NO_GAIN = r"another principal point saves only 0\.0\d % of the cost"


def off_centre(shift: FloatArray, *, distortion: float = CAMERA.params[3]) -> Intrinsics:
    return replace(CAMERA, params=(CAMERA.params[0], *(MIDDLE + shift).tolist(), distortion))


def around(num_images: int) -> FloatArray:
    """(N, 3, 4) cameras on all sides of the origin, from below and from above."""
    phi = np.pi * (3 - np.sqrt(5)) * np.arange(num_images)
    centres = np.column_stack([4 * np.sin(phi), np.linspace(-2, 2, num_images), -4 * np.cos(phi)])
    return cam_from_world_towards(centres, np.zeros(3))


def forward(num_images: int, *, sway: FloatArray | None = None) -> FloatArray:
    """(N, 3, 4) cameras that drive along z and look ahead; ``sway`` (N, 2) shifts them, and none turns."""
    centres = np.column_stack([np.zeros((num_images, 2)), 0.25 * np.arange(num_images)])
    if sway is not None:
        centres[:, :2] = sway
    return cam_from_world_towards(centres, centres + np.array([0.0, 0.0, 1.0]))


def corridor(num_points: int, rng: np.random.Generator) -> FloatArray:
    """(P, 3) on the walls, the floor and the ceiling around ``forward``."""
    along = rng.uniform(-1, 1, num_points)
    upright = rng.uniform(size=num_points) < 0.5
    side = rng.choice([-1.0, 1.0], num_points)
    x, y = np.where(upright, 1.5 * side, 1.5 * along), np.where(upright, along, side)
    return np.column_stack([x, y, rng.uniform(1, 12, num_points)]) + rng.normal(scale=0.2, size=(num_points, 3))


@dataclass(frozen=True, kw_only=True, eq=False)
class Adjusted:
    """A model that was adjusted with the principal point in the middle, and where it came from."""

    world: World
    priors: Priors
    model: pycolmap.Reconstruction

    def estimate(self) -> PrincipalPointEstimate:
        return estimate_principal_points(self.model, self.priors, threads=1)

    def errors(self, model: pycolmap.Reconstruction) -> tuple[float, float]:
        """Rms of the centres, as a part of the extent, and mean of the angles in degrees, of a model's cameras."""
        found = np.stack(list(poses_of(model).values()))
        _, aligned = fitted(centres_of(found), self.world.centres)
        angles = [angle_deg(a, b) for a, b in zip(found, self.world.cam_from_world, strict=True)]
        return rms(aligned, self.world.centres) / self.world.extent, float(np.mean(angles))


def adjusted(world: World, rng: np.random.Generator, *, distortion: float = CAMERA.params[3]) -> Adjusted:
    """From stitched poses, true tracks, and the principal point in the middle."""
    stitched = disturbed(world.cam_from_world, rng, position=0.005 * world.extent, rotation_deg=0.3)
    camera = off_centre(np.zeros(2), distortion=distortion)
    model = model_with_true_tracks(world, stitched, rng, camera=camera, noise=1e-3)
    priors = priors_of(model)
    assert adjust(model, priors, calibrated=False, max_iterations=30, threads=1)
    return Adjusted(world=world, priors=priors, model=model)


def from_many_sides(
    shift: FloatArray, *, seed: int = 1, num_images: int = NUM_IMAGES, num_points: int = 300
) -> Adjusted:
    rng = np.random.default_rng(seed)
    return adjusted(make_world(around(num_images), 2 * ball(num_points, rng), rng, camera=off_centre(shift)), rng)


@pytest.fixture(scope="module")
def courtyard() -> Adjusted:
    """Off centre by 1 % of the width."""
    return from_many_sides(SHIFT)


def everything(model: pycolmap.Reconstruction) -> dict[str, bytes | int]:
    """Bit by bit."""
    state: dict[str, bytes | int] = {}
    for i in model.reg_frame_ids():
        state[f"pose {i}"] = np.array(rig_from_world(model, i).params).tobytes()
    for i, camera in model.cameras.items():
        state[f"camera {i}"] = np.array(camera.params).tobytes()
    for i, point in model.points3D.items():
        state[f"point {i}"] = point.xyz.tobytes()
        state[f"track {i}"] = point.track.length()
    return state


# --------------------------------------------------------------------------- the answer
def test_one_percent_off_is_found_and_the_poses_get_better(courtyard: Adjusted) -> None:
    answer = courtyard.estimate()
    assert answer.reason == ""
    assert set(answer.xy_img) == {1}
    assert 0.01 < np.linalg.norm(answer.xy_img[1] - MIDDLE - SHIFT) < 0.6

    freed = pycolmap.Reconstruction(courtyard.model)
    assert adjust(freed, courtyard.priors, calibrated=False, max_iterations=30, threads=1, principal_point=True)
    assert 0.01 < np.linalg.norm(np.array(freed.camera(1).params)[1:3] - MIDDLE - SHIFT) < 0.6
    centres_before, turned_before = courtyard.errors(courtyard.model)
    centres, turned = courtyard.errors(freed)
    assert 1.15 < centres_before / centres < 3
    assert 4 < turned_before / turned < 20
    assert 0.3 < turned_before < 0.6


def test_model_is_not_changed(courtyard: Adjusted) -> None:
    before = everything(courtyard.model)
    assert len(before) > 600
    assert courtyard.estimate().xy_img
    assert everything(courtyard.model) == before


def test_one_thread_gives_the_same_estimate_twice(courtyard: Adjusted) -> None:
    np.testing.assert_array_equal(courtyard.estimate().xy_img[1], courtyard.estimate().xy_img[1])


@pytest.mark.parametrize("seed", [2, 3, 4])
def test_image_centre_stays_where_it_is_right(seed: int) -> None:
    """Noise saves next to nothing by moving it."""
    answer = from_many_sides(np.zeros(2), seed=seed, num_points=500).estimate()
    assert np.linalg.norm(answer.xy_img[1] - MIDDLE) < 2e-3 * CAMERA.width
    left_at = MIDDLE if answer.reason else answer.xy_img[1]
    assert np.linalg.norm(left_at - MIDDLE) < 1e-3 * CAMERA.width


# ------------------------------------------------------------------------------ refusals
@pytest.mark.parametrize("shift", [np.zeros(2), SHIFT])
def test_straight_drive_is_refused_because_nothing_is_saved(shift: FloatArray) -> None:
    """Without distortion nothing tells a camera that looks aside from a principal point that is off."""
    rng = np.random.default_rng(1)
    camera = off_centre(shift, distortion=0.0)
    drive = adjusted(make_world(forward(NUM_IMAGES), corridor(300, rng), rng, camera=camera), rng, distortion=0.0)
    answer = drive.estimate()
    assert pytest.approx(MIDDLE, abs=1) == answer.xy_img[1]
    assert re.fullmatch(NO_GAIN, answer.reason), answer.reason


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_errors_of_the_priors_do_not_count_as_agreement(seed: int) -> None:
    """Cameras that sway and never turn leave a shear of the world open, which priors close by their own errors."""
    rng = np.random.default_rng(seed)
    poses = forward(NUM_IMAGES, sway=rng.normal(scale=0.3, size=(NUM_IMAGES, 2)))
    camera = off_centre(np.zeros(2), distortion=0.0)
    drive = adjusted(make_world(poses, corridor(300, rng), rng, camera=camera), rng, distortion=0.0)
    answer = drive.estimate()
    assert re.fullmatch(NO_GAIN, answer.reason), answer.reason


def decentred(keypoints: npt.NDArray[np.floating], p1: float) -> FloatArray:
    """(K, 2) image positions as a lens draws them that is tilted: Brown's tangential term, which our cameras lack."""
    x, y = ((keypoints - MIDDLE) / CAMERA.params[0]).T
    return keypoints + CAMERA.params[0] * p1 * np.column_stack([2 * x * y, x * x + 3 * y * y])


@pytest.mark.parametrize("seed", [2, 4, 6])
def test_what_the_camera_model_lacks_does_not_move_the_principal_point(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Cameras that turn little on their way: both halves agree on a shift that makes up for a tilted lens."""
    rng = np.random.default_rng(seed)
    centres = np.column_stack([rng.normal(scale=0.3, size=(NUM_IMAGES, 2)), 0.25 * np.arange(NUM_IMAGES)])
    ahead = np.column_stack([np.tan(np.radians(rng.normal(scale=3, size=(NUM_IMAGES, 2)))), np.ones(NUM_IMAGES)])
    camera = off_centre(np.zeros(2), distortion=0.0)
    world = make_world(cam_from_world_towards(centres, centres + ahead), corridor(500, rng), rng, camera=camera)
    tilted = tuple(decentred(keypoints, 1e-3).astype(np.float32) for keypoints in world.keypoints)
    street = adjusted(replace(world, keypoints=tilted), rng, distortion=0.0)
    answer = street.estimate()
    assert re.fullmatch(r"another principal point saves only 0\.[0-5]\d % of the cost", answer.reason), answer.reason

    monkeypatch.setattr(principal_point, "MIN_COST_REDUCTION", -1.0)
    fallen_for = street.estimate()
    assert np.linalg.norm(fallen_for.xy_img[1] - MIDDLE) > 0.8
    assert fallen_for.reason == ""


@pytest.mark.parametrize("num_images", [MIN_IMAGES - 1, MIN_IMAGES])
def test_fewer_than_eight_images_give_no_estimate(num_images: int) -> None:
    answer = from_many_sides(SHIFT, num_images=num_images).estimate()
    assert (answer.reason == f"camera 1 has {num_images} of 8 images") == (num_images < MIN_IMAGES)
    assert (not answer.xy_img) == (num_images < MIN_IMAGES)


def test_eight_images_are_needed_of_every_camera(courtyard: Adjusted) -> None:
    model = pycolmap.Reconstruction(courtyard.model)
    second = off_centre(np.zeros(2)).colmap_camera(2)
    model.add_camera_with_trivial_rig(second)
    for image_id in range(NUM_IMAGES + 1, NUM_IMAGES + MIN_IMAGES):
        twin = model.image(image_id - NUM_IMAGES)
        image = pycolmap.Image(name=f"{image_id}.png", keypoints=np.zeros((0, 2)), camera_id=2, image_id=image_id)
        model.add_image_with_trivial_frame(image, twin.cam_from_world())
    answer = estimate_principal_points(model, courtyard.priors, threads=1)
    assert answer.reason == "camera 2 has 7 of 8 images"
    assert answer.xy_img == {}


@pytest.mark.parametrize(("part", "accepted"), [(0.023, True), (0.027, False)])
def test_shift_beyond_two_and_a_half_percent_is_refused(part: float, accepted: bool) -> None:
    shift = part * CAMERA.width * SHIFT / np.linalg.norm(SHIFT)
    answer = from_many_sides(shift).estimate()
    found = float(np.linalg.norm(answer.xy_img[1] - MIDDLE))
    assert part - 0.001 < found / CAMERA.width < part + 0.001
    assert (found < MAX_SHIFT_FRACTION * CAMERA.width) == accepted
    assert answer.reason == ("" if accepted else f"the principal point of camera 1 would move by {found:.1f} px")


def test_half_without_points_gives_no_estimate(courtyard: Adjusted) -> None:
    model = pycolmap.Reconstruction(courtyard.model)
    for point_id in sorted(model.point3D_ids()):
        model.delete_point3D(point_id)
    answer = estimate_principal_points(model, courtyard.priors, threads=1)
    assert (answer.reason, answer.xy_img) == ("no usable solution for half of the points", {})


def test_single_point_gives_no_estimate(courtyard: Adjusted) -> None:
    model = pycolmap.Reconstruction(courtyard.model)
    for point_id in sorted(model.point3D_ids())[1:]:
        model.delete_point3D(point_id)
    assert estimate_principal_points(model, courtyard.priors, threads=1).reason


def test_halves_share_no_point_and_every_image_has_enough(courtyard: Adjusted, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of ever so many observations, the long tracks are taken until each image has its share."""
    monkeypatch.setattr(principal_point, "TARGET_OBSERVATIONS", 0)
    monkeypatch.setattr(principal_point, "MIN_OBSERVATIONS_PER_IMAGE", 40)
    halves = []

    def keep(part: pycolmap.Reconstruction, *_: Any, principal_point: bool, **__: Any) -> bool:
        if principal_point:
            halves.append(part)
        return True

    monkeypatch.setattr(principal_point, "adjust", keep)
    monkeypatch.setattr(principal_point, "MIN_COST_REDUCTION", 0.0)
    courtyard.estimate()
    first, second = (half.point3D_ids() for half in halves)
    assert not first & second
    assert 0.2 < len(first | second) / courtyard.model.num_points3D() < 0.8
    for half in halves:
        counts = [half.image(i).num_points3D for i in half.reg_image_ids()]
        assert 40 <= min(counts) <= max(counts) < 80
        assert half.compute_mean_track_length() > courtyard.model.compute_mean_track_length() + 0.5


@pytest.mark.parametrize(("first", "second", "accepted"), [(5.0, 8.0, True), (5.0, 8.6, False), (5.0, np.nan, False)])
def test_halves_may_differ_by_half_of_the_shift(
    courtyard: Adjusted, monkeypatch: pytest.MonkeyPatch, first: float, second: float, accepted: bool
) -> None:
    assert MAX_DIFFERENCE_FRACTION == 0.5
    answers, costs = iter([first, second]), iter([100.0, 98.0, 100.0, 98.0])

    def move(part: pycolmap.Reconstruction, *_: Any, principal_point: bool, **__: Any) -> bool:
        if principal_point:
            params = list(part.camera(1).params)
            part.camera(1).params = [params[0], MIDDLE[0] + next(answers), *params[2:]]
        return True

    monkeypatch.setattr(principal_point, "adjust", move)
    monkeypatch.setattr(principal_point, "robust_cost", lambda _: next(costs))
    answer = courtyard.estimate()
    assert (answer.reason == "") == accepted
    if np.isfinite(second):
        np.testing.assert_allclose(answer.xy_img[1] - MIDDLE, [(first + second) / 2, 0], atol=1e-9)


@pytest.mark.parametrize(("second", "accepted"), [(99.3, True), (99.5, False), (np.nan, False)])
def test_each_half_must_save_something(
    courtyard: Adjusted, monkeypatch: pytest.MonkeyPatch, second: float, accepted: bool
) -> None:
    assert 0.005 < MIN_COST_REDUCTION < 0.007
    costs = iter([100.0, 98.0, 100.0, second])
    monkeypatch.setattr(principal_point, "robust_cost", lambda _: next(costs))
    assert (courtyard.estimate().reason == "") == accepted


# ----------------------------------------------------------------------- in refinement
@pytest.fixture(scope="module")
def seen() -> tuple[World, FloatArray]:
    """Off centre by 1 % of the width, and as stitched."""
    rng = np.random.default_rng(6)
    world = make_world(around(12), 2 * ball(200, rng), rng, camera=off_centre(SHIFT), clutter=0)
    return world, disturbed(world.cam_from_world, rng, position=0.005 * world.extent, rotation_deg=0.3)


def refine_task(folder: Path, seen: tuple[World, FloatArray], *, calibrated: bool = False) -> RefineTask:
    world, stitched = seen
    collection = make_collection(folder, len(world), calibrated=calibrated)
    pairs = pairs_within(range(len(world)), 5)
    write_features(folder / "features.db", collection, world, verified={p: true_matches(world, p) for p in pairs})
    return RefineTask(
        stored=StageFolder(path=folder / "refined", key="a test"),
        collection=collection,
        scenes=(stitched_scene(collection, stitched),),
        features=folder / "features.db",
        maps=None,
        map_pairs=(),
        segments=(),
        calibrated=calibrated,
        threads=1,
    )


def refined(one: RefineTask) -> tuple[SceneRefinement, FloatArray]:
    """The result, and the parameters of the camera."""
    (result,) = refine_scenes(one)
    assert result.succeeded
    return result, np.array(pycolmap.Reconstruction(one.stored.path / "0" / "model").camera(1).params)


def test_refinement_finds_it(tmp_path: Path, seen: tuple[World, FloatArray]) -> None:
    result, params = refined(refine_task(tmp_path, seen))
    assert "principal point" in [step.name for step in result.steps], result.principal_point
    assert 0.01 < np.linalg.norm(params[1:3] - MIDDLE - SHIFT) < 1.2


def test_refinement_leaves_it_in_the_middle_where_it_is_told_to(tmp_path: Path, seen: tuple[World, FloatArray]) -> None:
    result, params = refined(replace(refine_task(tmp_path, seen), principal_point=False))
    assert "principal point" not in [step.name for step in result.steps]
    assert params[1:3].tolist() == MIDDLE.tolist()
    assert params[0] != CAMERA.params[0]


def test_principal_points_of_calibrated_cameras_are_not_estimated(
    tmp_path: Path, seen: tuple[World, FloatArray], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: Any, **__: Any) -> None:
        raise AssertionError("the intrinsics are given")

    monkeypatch.setattr(task, "estimate_principal_points", refuse)
    _, params = refined(refine_task(tmp_path, seen, calibrated=True))
    assert tuple(params) == CAMERA.params


@pytest.mark.parametrize("wanted", [True, False])
def test_setting_of_the_run_reaches_the_task(
    tmp_path: Path, seen: tuple[World, FloatArray], monkeypatch: pytest.MonkeyPatch, wanted: bool
) -> None:
    handed: list[RefineTask] = []

    def keep(_: Any, task: RefineTask, **__: Any) -> TaskFailure:
        handed.append(task)
        return TaskFailure(reason="a test", crashed=False)

    monkeypatch.setattr(refine, "in_child", keep)
    one = refine_task(tmp_path, seen)
    features = RunFeatures(
        database=tmp_path / "features.db", key="a test", usable=(True,) * len(one.collection), rejected=()
    )
    initial = InitialScenes(scenes=one.scenes, subsets=(), view_graph=ViewGraph.chain(len(one.collection)), surfaces={})
    with quiet_run(tmp_path / "out") as run:
        options = RefinementConfig(principal_point=wanted)
        refine.refine(run, initial, one.collection, features, options, FeatureConfig())
    assert [each.principal_point for each in handed] == [wanted]
    assert RefinementConfig().principal_point, "refined by default"
