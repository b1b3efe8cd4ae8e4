"""A step that makes a model worse is rejected and undone exactly, and every step is measured."""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np
import pycolmap
import pytest
from helpers.tracked_scenes import rig_from_world

from smust3r_colmap.colmap.reconstruction import poses_of
from smust3r_colmap.refinement.acceptance import (
    FOCAL_RATIO_RANGE,
    MAX_ERROR_PX,
    MAX_LOST_FRACTION,
    MAX_PRINCIPAL_POINT_SHIFT_FRACTION,
    movement,
    num_good_observations,
    try_step,
)
from smust3r_colmap.refinement.bundle_adjustment import extent_of
from smust3r_colmap.refinement.statistics import Statistics


@pytest.fixture
def model() -> pycolmap.Reconstruction:
    """Eight images that see 60 points, with half a pixel of noise."""
    pycolmap.set_random_seed(3)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=8, num_points3D=60, num_points2D_without_point3D=5
    )
    made = pycolmap.synthesize_dataset(options)
    pycolmap.synthesize_noise(pycolmap.SyntheticNoiseOptions(point2D_stddev=0.5), made)
    return made


def everything(model: pycolmap.Reconstruction) -> dict[str, bytes]:
    """All that a step may change, bit by bit."""
    state = {f"pose {i}": np.array(rig_from_world(model, i).params).tobytes() for i in model.reg_frame_ids()}
    state |= {f"camera {i}": np.array(camera.params).tobytes() for i, camera in model.cameras.items()}
    return state | {f"point {i}": point.xyz.tobytes() for i, point in model.points3D.items()}


def move_camera(model: pycolmap.Reconstruction, frame_id: int, shift: float) -> None:
    """Along its own viewing direction."""
    pose = rig_from_world(model, frame_id)
    model.frame(frame_id).rig_from_world = pycolmap.Rigid3d(pose.rotation, pose.translation + np.array([0, 0, shift]))


def move_everything(model: pycolmap.Reconstruction, shift: float) -> None:
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), np.array([shift, 0.0, 0.0])))


# ------------------------------------------------------------------ what makes it worse
def scatter(model: pycolmap.Reconstruction) -> bool:
    rng = np.random.default_rng(1)
    for point_id in list(model.points3D):
        model.point3D(point_id).xyz += rng.normal(scale=0.5, size=3)
    return True


def lose_a_camera(model: pycolmap.Reconstruction) -> bool:
    move_camera(model, min(model.reg_frame_ids()), 100.0)
    return True


def run_away(model: pycolmap.Reconstruction) -> bool:
    """Everything together, so that every observation stays good."""
    move_everything(model, 0.25 * extent_of(np.stack([image.projection_center() for image in model.images.values()])))
    return True


def zoom(model: pycolmap.Reconstruction) -> bool:
    camera = model.camera(1)
    camera.params = [camera.params[0] * 1.01 * FOCAL_RATIO_RANGE[1], *camera.params[1:]]
    return True


def look_aside(model: pycolmap.Reconstruction) -> bool:
    camera = model.camera(1)
    shift = 1.01 * MAX_PRINCIPAL_POINT_SHIFT_FRACTION * max(camera.width, camera.height)
    camera.params = [camera.params[0], camera.params[1] + shift, *camera.params[2:]]
    return True


def bend(model: pycolmap.Reconstruction) -> bool:
    camera = model.camera(1)
    camera.params = [*camera.params[:3], -1.2]
    return True


def break_a_pose(model: pycolmap.Reconstruction) -> bool:
    move_camera(model, min(model.reg_frame_ids()), float("nan"))
    return True


def break_a_point(model: pycolmap.Reconstruction) -> bool:
    model.point3D(min(model.points3D)).xyz = np.array([0.0, np.inf, 0.0])
    return True


def give_up(model: pycolmap.Reconstruction) -> bool:
    scatter(model)
    return False


@pytest.mark.parametrize(
    ("step", "reason"),
    [
        (scatter, r"only \d+ of \d+ good observations remain"),
        (lose_a_camera, r"only \d+ of \d+ good observations remain"),
        (run_away, r"the median camera moved by 25 % of the path's extent"),
        (zoom, r"the focal length of camera 1 changed by a factor of 2"),
        (look_aside, r"the principal point of camera 1 moved by \d+ px"),
        (bend, "a distortion parameter of camera 1 exceeds 1"),
        (break_a_pose, "the adjustment diverged"),
        (break_a_point, "the adjustment diverged"),
        (give_up, "the adjustment diverged"),
    ],
)
def test_step_that_makes_the_model_worse_is_rejected_and_undone_exactly(
    model: pycolmap.Reconstruction, step: Callable[[pycolmap.Reconstruction], bool], reason: str
) -> None:
    before, statistics = everything(model), Statistics.of(model)
    report = try_step("a test", model, lambda: step(model))
    assert everything(model) == before
    assert not report.accepted
    assert re.fullmatch(reason, report.reason), report.reason
    assert (report.name, report.before) == ("a test", statistics)
    numbers = (report.moved_percent, report.max_moved_percent, report.turned_deg, report.after.reprojection_error_px)
    assert np.isfinite(numbers).all(), "the report is written as JSON, which knows no NaN"
    assert Statistics.of(model) == statistics


def test_step_that_makes_the_model_better_is_accepted_with_its_statistics(model: pycolmap.Reconstruction) -> None:
    truth = everything(model)
    rng = np.random.default_rng(2)
    exact = {i: model.point3D(i).xyz.copy() for i in model.points3D}
    for i in model.points3D:
        model.point3D(i).xyz += rng.normal(scale=0.02, size=3)

    def back() -> bool:
        for i, xyz in exact.items():
            model.point3D(i).xyz = xyz
        return True

    report = try_step("back", model, back)
    assert report.accepted
    assert report.reason == ""
    assert everything(model) == truth
    assert report.before.reprojection_error_px > 2 * report.after.reprojection_error_px > 0.5
    assert report.before.num_observations == report.after.num_observations == model.compute_num_observations()


def test_a_few_lost_observations_are_accepted(model: pycolmap.Reconstruction) -> None:
    good = num_good_observations(model)
    lost_points = int(MAX_LOST_FRACTION * len(model.points3D))
    assert lost_points >= 1

    def lose_points(count: int) -> bool:
        for point_id in sorted(model.points3D)[:count]:
            model.point3D(point_id).xyz *= 1.5
        return True

    report = try_step("one point", model, lambda: lose_points(lost_points))
    assert report.accepted, report.reason
    assert good * (1 - MAX_LOST_FRACTION) <= num_good_observations(model) < good
    assert not try_step("more", model, lambda: lose_points(4 * lost_points)).accepted


def test_strong_distortion_of_before_does_not_reject_a_step(model: pycolmap.Reconstruction) -> None:
    """Rational models have coefficients above 1; only a step that increases them is rejected."""
    camera = model.camera(1)
    camera.params = [*camera.params[:3], -1.2]
    assert "distortion" not in try_step("nothing", model, lambda: True).reason

    def worse() -> bool:
        camera.params = [*camera.params[:3], -1.3]
        return True

    assert "distortion parameter of camera 1" in try_step("worse", model, worse).reason


def test_movement_is_in_percent_of_the_path_and_in_degrees(model: pycolmap.Reconstruction) -> None:
    before = poses_of(model)
    extent = extent_of(np.stack([image.projection_center() for image in model.images.values()]))
    move_everything(model, 0.03 * extent)
    moved, turned = movement(before, poses_of(model))
    np.testing.assert_allclose(moved, 3.0, rtol=1e-9)
    np.testing.assert_allclose(turned, 0.0, atol=1e-5)
    frame_id = min(model.reg_frame_ids())
    half_degree = pycolmap.Rigid3d(pycolmap.Rotation3d(np.deg2rad([0.0, 0.5, 0.0])), np.zeros(3))
    model.frame(frame_id).rig_from_world = half_degree * rig_from_world(model, frame_id)
    moved, turned = movement(before, poses_of(model))
    np.testing.assert_allclose(turned, [0.5, *np.zeros(7)], atol=1e-5)
    np.testing.assert_allclose(moved, 3.0, rtol=1e-9)


def test_an_image_that_was_registered_later_did_not_move(model: pycolmap.Reconstruction) -> None:
    poses = poses_of(model)
    others = {i: pose for i, pose in poses.items() if i >= 2}
    assert len(movement(others, poses)[0]) == 6
    assert [len(values) for values in movement({}, poses)] == [0, 0]


def test_good_observations_are_near_in_front_and_of_points_seen_under_an_angle(
    model: pycolmap.Reconstruction,
) -> None:
    total = model.compute_num_observations()
    assert num_good_observations(model) == total, "half a pixel of noise is good"
    assert model.compute_num_observations() == total, "counting changes nothing"
    frame_id = min(model.reg_frame_ids())
    turned_away = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.0, np.pi, 0.0])), np.zeros(3))
    model.frame(frame_id).rig_from_world = turned_away * rig_from_world(model, frame_id)
    assert num_good_observations(model) == total - 60
    assert MAX_ERROR_PX == 4.0
