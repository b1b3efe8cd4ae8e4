"""Sim(3) and SE(3) between submodels from the cameras of their shared images."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
from helpers.scenes import make_submodel, rotation_about_y, some_sim3, walk
from scipy.spatial.transform import Rotation

from smust3r_colmap.alignment.from_poses import align_poses
from smust3r_colmap.errors import DegenerateAlignmentError
from smust3r_colmap.estimators.robust import RobustKernel
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.se3 import SE3
from smust3r_colmap.geometry.sim3 import Sim3
from smust3r_colmap.products import Submodel

DEPTH = 8.0
"""Of the scene before the cameras, in world units."""


def submodel_of(world_from_cam: FloatArray, seg_from_world: Sim3, *, segment: int = 0) -> Submodel:
    images = tuple(range(len(world_from_cam)))
    return make_submodel(world_from_cam, images, np.zeros((0, 3)), seg_from_world, segment=segment, with_tracks=False)


def disturbed(poses: FloatArray, rng: np.random.Generator, *, centre: float = 0.0, turn_deg: float = 0.0) -> FloatArray:
    """Poses with Gaussian errors in every coordinate and about every axis."""
    out: FloatArray = poses.copy()
    out[:, :, 3] += rng.normal(scale=centre, size=(len(poses), 3))
    out[:, :, :3] @= Rotation.from_rotvec(rng.normal(scale=np.radians(turn_deg), size=(len(poses), 3))).as_matrix()
    return out


def straight_walk(num_images: int) -> FloatArray:
    """(N, 3, 4) along x, looking along z."""
    poses: FloatArray = np.array([np.column_stack([np.eye(3), [0.3 * k, 0, 0]]) for k in range(num_images)])
    return poses


def errors(found: Sim3 | SE3, true: Sim3) -> tuple[float, float]:
    """Degrees and percent of scale."""
    matrix = found.matrix
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    turn = Rotation.from_matrix(matrix[:3, :3] / scale @ true.rotation.T).magnitude()
    return float(np.degrees(turn)), 100 * abs(np.log(scale / float(true.scale)))


def aligned(
    target_poses: FloatArray,
    source_poses: FloatArray,
    target_from_source: Sim3,
    *,
    kernel: RobustKernel = "cauchy",
) -> tuple[float, float]:
    """Degrees and percent of scale that the estimate is off."""
    target = submodel_of(target_poses, Sim3.identity())
    source = submodel_of(source_poses, target_from_source.inverse(), segment=1)
    found = align_poses(target, source, depth_target=DEPTH, kernel=kernel).estimate.b_from_a
    assert isinstance(found, Sim3)
    return errors(found, target_from_source)


# -------------------------------------------------------------------------------- exact
@pytest.mark.parametrize("kernel", ["cauchy", "tukey", "huber"])
@pytest.mark.parametrize("num_images", [2, 3, 30, 90])
@pytest.mark.parametrize("path", ["walk", "straight"])
def test_exact_cameras_give_the_exact_similarity(kernel: RobustKernel, num_images: int, path: str) -> None:
    rng = np.random.default_rng(num_images)
    poses = walk(num_images) if path == "walk" else straight_walk(num_images)
    target_from_world, source_from_world = some_sim3(rng), some_sim3(rng)
    depth = DEPTH * float(target_from_world.scale)
    fit = align_poses(
        submodel_of(poses, target_from_world), submodel_of(poses, source_from_world), depth_target=depth, kernel=kernel
    )
    true = target_from_world @ source_from_world.inverse()
    np.testing.assert_allclose(fit.estimate.b_from_a.matrix, true.matrix, rtol=1e-9, atol=1e-9)
    assert fit.relative_residual < 1e-12
    assert (fit.num_correspondences, fit.estimate.num_points, fit.estimate.num_inliers) == (num_images,) * 3
    assert fit.estimate.stop_reason == "converged"


@pytest.mark.parametrize("num_images", [1, 2, 30])
def test_exact_cameras_give_the_exact_rigid_motion(num_images: int) -> None:
    rng = np.random.default_rng(3)
    true = replace(some_sim3(rng), scale=np.array(1.0))
    poses = walk(num_images)
    fit = align_poses(submodel_of(poses, true), submodel_of(poses, Sim3.identity()), depth_target=DEPTH, group="se3")
    assert isinstance(fit.estimate.b_from_a, SE3)
    np.testing.assert_allclose(fit.estimate.b_from_a.matrix, true.matrix, atol=1e-12)
    assert fit.estimate.information.shape == (6, 6)
    assert np.linalg.eigvalsh(fit.estimate.information).min() > 0


def test_only_shared_images_count() -> None:
    rng = np.random.default_rng(5)
    poses, true = walk(20), some_sim3(rng)
    target = make_submodel(poses, tuple(range(12)), np.zeros((0, 3)), Sim3.identity(), with_tracks=False)
    source = make_submodel(poses, tuple(range(7, 20)), np.zeros((0, 3)), true.inverse(), with_tracks=False)
    fit = align_poses(target, source, depth_target=DEPTH)
    assert fit.num_correspondences == 5
    np.testing.assert_allclose(fit.estimate.b_from_a.matrix, true.matrix, atol=1e-10)


# --------------------------------------------------------------------------------- noise
def test_orientations_fix_the_roll_about_a_straight_path() -> None:
    """Centres with an error of 5 mm on a straight line would leave the roll to chance."""
    turns = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        poses = straight_walk(30)
        target = disturbed(poses, rng, centre=0.005, turn_deg=0.1)
        turns.append(aligned(target, disturbed(poses, rng, centre=0.005, turn_deg=0.1), some_sim3(rng))[0])
    # Two sides of 0.1 degrees about three axes, thirty cameras: 0.1 sqrt(2 * 3 / 30) about one axis at worst.
    assert 0.005 < np.median(turns) < 0.05
    assert max(turns) < 0.1


def test_centres_sharpen_a_rotation_that_poor_orientations_give() -> None:
    """Both kinds of evidence are used, each for what it is worth."""
    turns = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        poses = walk(30, turn_deg=3.0)
        target = disturbed(poses, rng, centre=0.002, turn_deg=2.0)
        turns.append(aligned(target, disturbed(poses, rng, centre=0.002, turn_deg=2.0), some_sim3(rng))[0])
    # The orientations alone leave 2 sqrt(2 * 3 / 30) = 0.9 degrees.
    assert 0.005 < np.median(turns) < 0.3


def test_scale_has_no_bias_in_either_direction() -> None:
    """A regression shrinks with the noise of its source, a bias that adds up along a chain of segments."""
    logs = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        poses = straight_walk(12)  # spread 1.04
        target = submodel_of(disturbed(poses, rng, centre=0.12, turn_deg=0.1), Sim3.identity())
        source = submodel_of(disturbed(poses, rng, centre=0.12, turn_deg=0.1), Sim3.identity())
        found = align_poses(target, source, depth_target=DEPTH).estimate.b_from_a
        assert isinstance(found, Sim3)
        logs.append(np.log(float(found.scale)))
    deviation = float(np.std(logs))
    assert 0.02 < deviation < 0.1
    assert abs(np.mean(logs)) < 0.018, "a regression shrinks by 3 * 0.12^2 / 1.04^2 = 0.04"


def test_information_matches_the_scatter_of_the_estimates() -> None:
    true = Sim3(scale=np.array(2.0), rotation=rotation_about_y(40), translation=np.array([1.0, 2.0, 3.0]))
    squared = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        poses = walk(30)
        target = submodel_of(disturbed(poses, rng, centre=0.02, turn_deg=0.2), true)
        source = submodel_of(disturbed(poses, rng, centre=0.02, turn_deg=0.2), Sim3.identity())
        estimate = align_poses(target, source, depth_target=2 * DEPTH).estimate
        assert isinstance(estimate.b_from_a, Sim3)
        delta = (estimate.b_from_a.inverse() @ true).log()
        squared.append(delta @ estimate.information @ delta / 7)
    assert 0.5 < np.mean(squared) < 1.5


# ---------------------------------------------------------------------------- wrong cameras
@pytest.mark.parametrize("kernel", ["cauchy", "tukey"])
@pytest.mark.parametrize("num_wrong", [1, 6, 12])
def test_alignment_survives_40_percent_wrong_cameras_that_agree_with_each_other(
    kernel: RobustKernel, num_wrong: int
) -> None:
    for seed in range(5):
        rng = np.random.default_rng(seed)
        poses = walk(30)
        target = disturbed(poses, rng, centre=0.004, turn_deg=0.05)
        source = disturbed(poses, rng, centre=0.004, turn_deg=0.05)
        wrong = np.arange(num_wrong) if seed == 0 else rng.choice(30, num_wrong, replace=False)
        elsewhere = Sim3(scale=np.array(1.5), rotation=rotation_about_y(70), translation=np.array([3.0, 0.0, 1.0]))
        source[wrong] = elsewhere.move_cameras(source[wrong])
        turn_deg, percent = aligned(target, source, some_sim3(rng), kernel=kernel)
        assert turn_deg < 0.1
        assert percent < 0.5


@pytest.mark.parametrize("turn_deg", [30.0, 90.0, 150.0])
def test_barest_majority_of_the_cameras_wins(turn_deg: float) -> None:
    """The first 15 of 31 agree on another, exact answer."""
    rng = np.random.default_rng(7)
    poses = walk(31)
    source = disturbed(poses, rng, centre=0.004, turn_deg=0.05)
    elsewhere = Sim3(scale=np.array(1.3), rotation=rotation_about_y(turn_deg), translation=np.array([2.0, 1.0, 0.0]))
    source[:15] = elsewhere.move_cameras(poses[:15])
    turn_deg, percent = aligned(poses, source, some_sim3(rng))
    assert turn_deg < 0.1
    assert percent < 0.5


def test_wrong_cameras_are_no_inliers() -> None:
    rng = np.random.default_rng(8)
    poses = walk(30)
    source = disturbed(poses, rng, centre=0.004, turn_deg=0.05)
    source[[3, 4], :, 3] += [0.0, 1.0, 0.0]
    source[[17], :, :3] @= rotation_about_y(8)
    fit = align_poses(submodel_of(poses, Sim3.identity()), submodel_of(source, Sim3.identity()), depth_target=DEPTH)
    assert 24 <= fit.estimate.num_inliers <= 27
    assert 0.0001 < fit.relative_residual < 0.002
    assert 0.0001 < fit.estimate.rms < 0.002, "of the inliers"


@pytest.mark.parametrize(("num_images", "num_wrong"), [(5, 2), (7, 3)])
def test_few_wrong_cameras_of_few_are_outvoted(num_images: int, num_wrong: int) -> None:
    """The first ones, each wrong in its own way, by 150 degrees and a metre."""
    for seed in range(15):
        rng = np.random.default_rng(seed)
        poses = walk(num_images)
        source = disturbed(poses, rng, centre=0.004, turn_deg=0.05)
        source[:num_wrong] = disturbed(source[:num_wrong], rng, centre=1.0, turn_deg=150)
        turn_deg, percent = aligned(poses, source, some_sim3(rng))
        assert turn_deg < 0.5
        assert percent < 2


# ---------------------------------------------------------------------------------- units
@pytest.mark.parametrize("factor", [1e-4, 1e5])
def test_nothing_has_a_unit(factor: float) -> None:
    rng = np.random.default_rng(4)
    poses = walk(20)
    target, source = disturbed(poses, rng, centre=0.01, turn_deg=0.3), disturbed(poses, rng, centre=0.01, turn_deg=0.3)
    zoom = Sim3(scale=np.array(factor), rotation=np.eye(3), translation=np.array([5.0, 6.0, 7.0]) * factor)
    plain = align_poses(submodel_of(target, Sim3.identity()), submodel_of(source, Sim3.identity()), depth_target=DEPTH)
    one = align_poses(submodel_of(target, zoom), submodel_of(source, Sim3.identity()), depth_target=DEPTH * factor)
    other = align_poses(submodel_of(target, Sim3.identity()), submodel_of(source, zoom), depth_target=DEPTH)
    assert isinstance(plain.estimate.b_from_a, Sim3)
    np.testing.assert_allclose(one.estimate.b_from_a.matrix, (zoom @ plain.estimate.b_from_a).matrix, rtol=1e-6)
    np.testing.assert_allclose(
        other.estimate.b_from_a.matrix, (plain.estimate.b_from_a @ zoom.inverse()).matrix, rtol=1e-6, atol=1e-8
    )
    for fit in (one, other):
        assert fit.relative_residual == pytest.approx(plain.relative_residual, rel=1e-6)
        assert fit.estimate.residual_sigma == pytest.approx(plain.estimate.residual_sigma, rel=1e-6)
        assert fit.estimate.num_inliers == plain.estimate.num_inliers


# ------------------------------------------------------------------------------- refusals
def refused(target: FloatArray, source: FloatArray, match: str, *, group: Literal["sim3", "se3"] = "sim3") -> None:
    with pytest.raises(DegenerateAlignmentError, match=match):
        align_poses(
            submodel_of(target, Sim3.identity()),
            submodel_of(source, Sim3.identity(), segment=1),
            depth_target=DEPTH,
            group=group,
        )


def test_one_common_camera_leaves_the_scale_free_and_is_named() -> None:
    poses = walk(9)
    target = make_submodel(poses, (1, 2, 5), np.zeros((0, 3)), Sim3.identity(), with_tracks=False)
    source = make_submodel(poses, (5, 7, 8), np.zeros((0, 3)), Sim3.identity(), segment=1, with_tracks=False)
    with pytest.raises(DegenerateAlignmentError, match=r"submodels 0 and 1 share one camera \(image 5\).*scale"):
        align_poses(target, source, depth_target=DEPTH)


@pytest.mark.parametrize("group", ["sim3", "se3"])
def test_submodels_without_a_common_image_are_refused(group: Literal["sim3", "se3"]) -> None:
    poses = walk(4)
    target = make_submodel(poses, (0, 1), np.zeros((0, 3)), Sim3.identity(), with_tracks=False)
    source = make_submodel(poses, (2, 3), np.zeros((0, 3)), Sim3.identity(), segment=1, with_tracks=False)
    with pytest.raises(DegenerateAlignmentError, match="submodels 0 and 1 share no image"):
        align_poses(target, source, depth_target=DEPTH, group=group)


def test_two_cameras_in_one_place_leave_the_scale_free() -> None:
    poses = walk(2)
    poses[:, :, 3] = [1.0, 2.0, 3.0]
    refused(poses, poses, "2 shared cameras: all centres of a side are one point, which leaves the scale free")
    apart = poses.copy()
    apart[1, 0, 3] += 0.01
    refused(apart, apart, r"the centres spread by 0\.0006.* of the scene's depth")


@pytest.mark.parametrize("num_images", [3, 30, 300])
@pytest.mark.parametrize("noise", [1e-4, 0.01, 0.3])
def test_standing_camera_leaves_the_scale_free(num_images: int, noise: float) -> None:
    """However many images: their noise agrees on no scale."""
    for seed in range(2):
        rng = np.random.default_rng([num_images, seed])
        poses = walk(num_images)
        poses[:, :, 3] = 0
        target, source = (disturbed(poses, rng, centre=noise, turn_deg=0.1) for _ in range(2))
        refused(target, source, r"(\d+) shared cameras: the centres spread by .* stands still leaves the scale free")


def test_standing_camera_of_a_metric_backbone_is_aligned() -> None:
    rng = np.random.default_rng(0)
    poses = walk(30)
    poses[:, :, 3] = 0
    target, source = (disturbed(poses, rng, centre=0.01, turn_deg=0.1) for _ in range(2))
    fit = align_poses(
        submodel_of(target, Sim3.identity()), submodel_of(source, Sim3.identity()), depth_target=DEPTH, group="se3"
    )
    moved = fit.estimate.b_from_a.log()
    assert 1e-4 < np.linalg.norm(moved[:3]) < 0.02
    assert np.degrees(np.linalg.norm(moved[3:])) < 0.15


def test_a_slow_walk_well_above_its_noise_is_not_refused() -> None:
    rng = np.random.default_rng(1)
    poses = straight_walk(30)
    poses[:, :, 3] *= 0.03  # spread 0.08 of a depth of 8
    target, source = (disturbed(poses, rng, centre=0.004, turn_deg=0.05) for _ in range(2))
    turn_deg, percent = aligned(target, source, some_sim3(rng))
    assert turn_deg < 0.1
    assert 0.01 < percent < 5


@pytest.mark.parametrize("depth", [0.0, -1.0, np.nan, np.inf])
def test_a_depth_must_be_positive(depth: float) -> None:
    submodel = submodel_of(walk(3), Sim3.identity())
    with pytest.raises(ValueError, match=re.escape(f"submodel 0: median depth {depth}, needed a positive number")):
        align_poses(submodel, submodel, depth_target=depth)
