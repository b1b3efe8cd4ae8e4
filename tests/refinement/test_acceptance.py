"""A step that makes a model worse is undone to the last bit, and every step is measured."""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np
import pycolmap
import pytest
from helpers.tracked_scenes import rig_from_world

from smust3r_colmap.refinement import acceptance as steps
from smust3r_colmap.refinement.acceptance import (
    FOCAL_RANGE,
    MAX_LOST,
    MAX_PRINCIPAL_POINT_SHIFT,
    movement,
    num_good_observations,
    take_snapshot,
    tried_step,
)
from smust3r_colmap.refinement.bundle_adjustment import extent_of, figures_of


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
    camera.params = [camera.params[0] * 1.01 * FOCAL_RANGE[1], *camera.params[1:]]
    return True


def look_aside(model: pycolmap.Reconstruction) -> bool:
    camera = model.camera(1)
    shift = 1.01 * MAX_PRINCIPAL_POINT_SHIFT * max(camera.width, camera.height)
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
        (scatter, r"only \d+ of \d+ good observations stayed good"),
        (lose_a_camera, r"only \d+ of \d+ good observations stayed good"),
        (run_away, r"the cameras moved by 25 % of the path's extent in the median"),
        (zoom, r"the focal length of camera 1 went to 2 times what it was"),
        (look_aside, r"the principal point of camera 1 went \d+ px away"),
        (bend, r"the distortion of camera 1 went beyond 1"),
        (break_a_pose, "the adjustment diverged"),
        (break_a_point, "the adjustment diverged"),
        (give_up, "the adjustment diverged"),
    ],
)
def test_step_that_makes_it_worse_is_undone_to_the_last_bit_and_reported(
    model: pycolmap.Reconstruction, step: Callable[[pycolmap.Reconstruction], bool], reason: str
) -> None:
    before, figures = everything(model), figures_of(model)
    report = tried_step("a test", model, lambda: step(model))
    assert everything(model) == before
    assert not report.kept
    assert re.fullmatch(reason, report.reason), report.reason
    assert (report.name, report.before) == ("a test", figures)
    numbers = (report.moved_percent, report.max_moved_percent, report.turned_deg, report.after.reprojection_error_px)
    assert np.isfinite(numbers).all(), "the report is written as JSON, which knows no NaN"
    assert figures_of(model) == figures


def test_step_that_makes_it_better_is_kept_with_its_figures(model: pycolmap.Reconstruction) -> None:
    truth = everything(model)
    rng = np.random.default_rng(2)
    exact = {i: model.point3D(i).xyz.copy() for i in model.points3D}
    for i in model.points3D:
        model.point3D(i).xyz += rng.normal(scale=0.02, size=3)

    def back() -> bool:
        for i, xyz in exact.items():
            model.point3D(i).xyz = xyz
        return True

    report = tried_step("back", model, back)
    assert report.kept
    assert report.reason == ""
    assert everything(model) == truth
    assert report.before.reprojection_error_px > 2 * report.after.reprojection_error_px > 0.5
    assert report.before.num_observations == report.after.num_observations == model.compute_num_observations()


def test_a_few_lost_observations_are_borne(model: pycolmap.Reconstruction) -> None:
    good = num_good_observations(model)
    lost_points = int(MAX_LOST * len(model.points3D))
    assert lost_points >= 1

    def lose_points(count: int) -> bool:
        for point_id in sorted(model.points3D)[:count]:
            model.point3D(point_id).xyz *= 1.5
        return True

    report = tried_step("one point", model, lambda: lose_points(lost_points))
    assert report.kept, report.reason
    assert good * (1 - MAX_LOST) <= num_good_observations(model) < good
    assert not tried_step("more", model, lambda: lose_points(4 * lost_points)).kept


def test_strong_distortion_that_was_there_before_is_no_fault_of_the_step(model: pycolmap.Reconstruction) -> None:
    """Rational models have coefficients above 1; only a step that goes further is to blame."""
    camera = model.camera(1)
    camera.params = [*camera.params[:3], -1.2]
    assert "distortion" not in tried_step("nothing", model, lambda: True).reason

    def worse() -> bool:
        camera.params = [*camera.params[:3], -1.3]
        return True

    assert "distortion of camera 1" in tried_step("worse", model, worse).reason


def test_movement_is_in_percent_of_the_path_and_in_degrees(model: pycolmap.Reconstruction) -> None:
    snapshot = take_snapshot(model)
    extent = extent_of(np.stack([image.projection_center() for image in model.images.values()]))
    move_everything(model, 0.03 * extent)
    moved, turned = movement(model, snapshot.rig_from_world)
    np.testing.assert_allclose(moved, 3.0, rtol=1e-9)
    np.testing.assert_allclose(turned, 0.0, atol=1e-5)
    frame_id = min(model.reg_frame_ids())
    half_degree = pycolmap.Rigid3d(pycolmap.Rotation3d(np.deg2rad([0.0, 0.5, 0.0])), np.zeros(3))
    model.frame(frame_id).rig_from_world = half_degree * rig_from_world(model, frame_id)
    moved, turned = movement(model, snapshot.rig_from_world)
    np.testing.assert_allclose(turned, [0.5, *np.zeros(7)], atol=1e-5)
    np.testing.assert_allclose(moved, 3.0, rtol=1e-9)


def test_a_frame_that_came_later_did_not_move(model: pycolmap.Reconstruction) -> None:
    snapshot = take_snapshot(model)
    others = {i: pose for i, pose in snapshot.rig_from_world.items() if i > 2}
    assert len(movement(model, others)[0]) == 6
    assert [len(values) for values in movement(model, {})] == [0, 0]


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
    assert steps.MAX_ERROR_PX == 4.0


def test_points_behind_a_camera_do_not_drown_the_mean_error(model: pycolmap.Reconstruction) -> None:
    """COLMAP calls the error of such a point 1e154, and so the mean of all points."""
    error = figures_of(model).reprojection_error_px
    assert 0.4 < error < 0.8
    point = model.point3D(min(model.points3D))
    point.xyz = 3 * np.stack([image.projection_center() for image in model.images.values()])[0]
    assert figures_of(model).reprojection_error_px == pytest.approx(error, rel=0.05)
