"""Camera fusion on a known world: cameras round a painted unit sphere, cut into submodels."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.sphere_world import (
    CAMERA,
    NUM_IMAGES,
    ORDER,
    WINDOWS,
    make_submodel,
    make_world,
    moved,
    shifted,
)
from scipy.spatial.transform import Rotation

from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.geometry.world_frame import WorldFrame
from smust3r_colmap.products import ImageCollection, SourceImage, Submodel
from smust3r_colmap.stitching.camera_fusion import build_scene, fuse_cameras, fuse_intrinsics, support_weights


# ----------------------------------------------------------------------------- cameras
def test_exact_submodels_give_back_the_exact_cameras() -> None:
    world = make_world()
    cameras = world.cameras()
    assert cameras.images == tuple(range(NUM_IMAGES))
    np.testing.assert_allclose(invert_rigid(cameras.cam_from_world), world.world_from_cam, atol=1e-12)
    assert cameras.num_submodels.tolist() == [1, 1, 1, 2, 2, 2, 2, 2, 2, 2, 1, 1, 1, 1]
    assert cameras.num_dropped.sum() == 0
    alone = cameras.num_submodels == 1
    assert np.isnan(cameras.position_spread[alone]).all()
    assert np.isnan(cameras.rotation_spread_deg[alone]).all()
    assert cameras.position_spread[~alone].max() < 1e-12
    assert cameras.rotation_spread_deg[~alone].max() < 1e-10
    centres = world.world_from_cam[:, :, 3]
    extent = np.linalg.norm(np.ptp(centres, axis=0))
    assert 0.2 * extent < cameras.scene_radius < 0.5 * extent


def test_weights_fall_to_the_ends_of_a_submodel() -> None:
    np.testing.assert_allclose(support_weights(range(5), ORDER), [1 / 3, 2 / 3, 1, 2 / 3, 1 / 3])
    np.testing.assert_allclose(support_weights(range(7, 11), ORDER), [0.5, 1, 1, 0.5])
    np.testing.assert_allclose(support_weights([3], ORDER), [1])


def test_weights_fall_to_the_ends_of_each_run_but_not_at_a_few_missing_images() -> None:
    two_runs = [10, 11, 12, 90, 91, 92, 93, 94]
    np.testing.assert_allclose(support_weights(two_runs, ORDER), np.array([1, 2, 1, 1, 2, 3, 2, 1]) / 3)
    np.testing.assert_allclose(support_weights([0, 1, 7, 8], ORDER), [0.5, 1, 1, 0.5])
    np.testing.assert_allclose(support_weights([0, 1, 8, 9], ORDER), [1, 1, 1, 1])


def test_drift_is_averaged_steadily_from_one_submodel_to_the_next() -> None:
    exact = make_world()
    cameras = shifted(exact, 1, (0.1, 0, 0)).cameras()
    part = invert_rigid(cameras.cam_from_world)[:, :, 3] - exact.world_from_cam[:, :, 3]
    # Images 3..6 are in windows 0..6 and 3..9: weights 4, 3, 2, 1 against 1, 2, 3, 4.
    np.testing.assert_allclose(part[3:7, 0], [0.02, 0.04, 0.06, 0.08], atol=1e-12)
    np.testing.assert_allclose(part[:3], 0, atol=1e-12)
    assert cameras.num_dropped.sum() == 0


def test_spread_is_the_disagreement_in_parts_of_the_scene_and_degrees() -> None:
    cameras = moved(make_world(), 1, 4, (0.03, 0.04, 0), turn_deg=2.5).cameras()
    assert cameras.position_spread[4] * cameras.scene_radius == pytest.approx(0.05, rel=1e-9)
    assert cameras.rotation_spread_deg[4] == pytest.approx(2.5, rel=1e-9)
    assert np.nanmax(np.delete(cameras.position_spread, 4)) < 1e-9


@pytest.mark.parametrize(("bad_submodel", "image"), [(1, 4), (0, 5)])
@pytest.mark.parametrize(("shift", "turn_deg"), [((0.5, 0, 0), 0.0), ((0, 0, 0), 20.0), ((0.2, -0.1, 0.1), 5.0)])
def test_one_bad_pose_is_dropped_where_the_other_submodel_has_the_larger_weight(
    bad_submodel: int, image: int, shift: tuple[float, ...], turn_deg: float
) -> None:
    exact = make_world()
    world = moved(exact, bad_submodel, image, shift, turn_deg)
    cameras = world.cameras()
    np.testing.assert_allclose(invert_rigid(cameras.cam_from_world), exact.world_from_cam, atol=1e-9)
    assert cameras.num_dropped.tolist() == [int(i == image) for i in range(NUM_IMAGES)]
    assert cameras.best_submodel[image] == 1 - bad_submodel


def test_two_of_three_submodels_outweigh_the_one_of_largest_weight() -> None:
    exact = make_world((range(0, 8), range(2, 10), range(4, 14), range(1, 5)))
    world = moved(exact, 1, 6, (0.5, 0, 0), 10)
    assert support_weights(range(8), ORDER)[4] > support_weights(range(8), ORDER)[1], (
        "the bad submodel holds image 6 more central than the first"
    )
    cameras = world.cameras()
    np.testing.assert_allclose(invert_rigid(cameras.cam_from_world), exact.world_from_cam, atol=1e-9)
    assert cameras.num_dropped[6] == 1
    assert cameras.best_submodel[6] in (0, 2)


def test_noise_is_averaged_down_but_not_out() -> None:
    exact = make_world((range(0, 14),) * 9)
    rng = np.random.default_rng(5)
    submodels = []
    for submodel, world_from in zip(exact.submodels, exact.world_from_seg, strict=True):
        noisy = exact.world_from_cam.copy()
        noisy[:, :, 3] += rng.normal(scale=0.01, size=(NUM_IMAGES, 3))
        noisy[:, :, :3] @= Rotation.from_rotvec(rng.normal(scale=0.01, size=(NUM_IMAGES, 3))).as_matrix()
        submodels.append(replace(submodel, seg_from_cam=world_from.inverse().move_cameras(noisy)))
    fused = invert_rigid(replace(exact, submodels=submodels).cameras().cam_from_world)
    rms = np.sqrt(np.mean((fused[:, :, 3] - exact.world_from_cam[:, :, 3]) ** 2))
    assert 0.01 / 9 < rms < 0.5 * 0.01  # the mean of nine has a third
    turn = Rotation.from_matrix(np.swapaxes(fused[:, :, :3], 1, 2) @ exact.world_from_cam[:, :, :3])
    assert 0.01 / 9 < np.sqrt(np.mean(turn.as_rotvec() ** 2)) < 0.5 * 0.01


def test_rotations_stay_rotations_and_two_equal_weights_meet_half_way() -> None:
    exact = make_world((range(0, 14), range(0, 14)))
    turn = Rotation.from_euler("y", 40, degrees=True).as_matrix()
    poses = exact.world_from_cam.copy()
    poses[:, :, :3] @= turn
    submodels = [exact.submodels[0], make_submodel(1, range(14), exact.world_from_seg[1].inverse().move_cameras(poses))]
    fused = invert_rigid(replace(exact, submodels=submodels).cameras().cam_from_world)
    half = exact.world_from_cam[:, :, :3] @ Rotation.from_euler("y", 20, degrees=True).as_matrix()
    np.testing.assert_allclose(fused[:, :, :3], half, atol=1e-12)


def test_three_opposite_rotations_still_have_a_mean() -> None:
    """Half turns about x, y and z: their mean is a reflection."""
    exact = make_world((range(0, 14),) * 3)
    submodels = []
    for axis, world_from in enumerate(exact.world_from_seg):
        poses = exact.world_from_cam.copy()
        poses[:, :, :3] @= Rotation.from_rotvec(np.pi * np.eye(3)[axis]).as_matrix()
        submodels.append(make_submodel(axis, range(14), world_from.inverse().move_cameras(poses)))
    rotations = replace(exact, submodels=submodels).cameras().cam_from_world[:, :, :3]
    np.testing.assert_allclose(np.linalg.det(rotations), 1, atol=1e-12)
    np.testing.assert_allclose(rotations @ np.swapaxes(rotations, 1, 2), np.tile(np.eye(3), (14, 1, 1)), atol=1e-12)


def test_submodels_that_disagree_everywhere_are_averaged_and_the_spread_shows_it() -> None:
    cameras = shifted(make_world(), 2, (0, 5, 0)).cameras()
    assert cameras.num_dropped.sum() == 0
    np.testing.assert_allclose(cameras.position_spread[7:10] * cameras.scene_radius, 5, rtol=1e-9)


def test_fusing_needs_a_submodel() -> None:
    with pytest.raises(ValueError, match="no submodel, needed at least one"):
        fuse_cameras([], ORDER)


# ------------------------------------------------------------------------------- loops
LOOP = (0, 1, 2, 11, 12, 13)


def test_loop_submodel_has_no_weight_where_a_window_placed_the_image() -> None:
    without = make_world()
    world = shifted(make_world((*WINDOWS, LOOP)), 3, (0.1, 0, 0))
    cameras = fuse_cameras(world.placed(loops=[3]), ORDER)
    np.testing.assert_array_equal(cameras.cam_from_world, without.cameras().cam_from_world)
    np.testing.assert_array_equal(cameras.num_submodels, without.cameras().num_submodels)
    np.testing.assert_array_equal(cameras.best_submodel, without.cameras().best_submodel)
    as_window = fuse_cameras(world.placed(), ORDER)
    assert np.abs(as_window.cam_from_world - cameras.cam_from_world).max() > 0.01


def test_loop_submodel_places_the_images_that_no_window_holds() -> None:
    exact = make_world((range(1, 8), range(4, 13), LOOP))
    world = moved(exact, 2, 13, (0.1, 0, 0))
    cameras = fuse_cameras(world.placed(loops=[2]), ORDER)
    assert cameras.images == tuple(range(14))
    assert cameras.best_submodel[[0, 13]].tolist() == [2, 2]
    assert 2 not in cameras.best_submodel[1:13]
    assert cameras.num_submodels[[0, 1, 13]].tolist() == [1, 1, 1]
    wrong_by = invert_rigid(cameras.cam_from_world)[:, :, 3] - world.world_from_cam[:, :, 3]
    np.testing.assert_allclose(wrong_by[13], [0.1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(wrong_by[:13], 0, atol=1e-12)


def test_loop_submodel_counts_for_the_calibration_with_its_own_images_only() -> None:
    world = make_world((range(1, 4), range(0, 14)))
    submodels = [with_focal(p, f) for p, f in zip(world.submodels, (500.0, 600.0), strict=True)]
    placed = replace(world, submodels=submodels).placed(loops=[1])
    # Of camera 0 the window has all images, of camera 1 none.
    fused = fuse_intrinsics(placed, [0] * 4 + [1] * 10)
    # The loop has image 0 of camera 0: one against three.
    assert (fused[0].params[0], fused[1].params[0]) == (500, 600)


# -------------------------------------------------------------------------- intrinsics
def with_focal(submodel: Submodel, focal: float, **changes: object) -> Submodel:
    intrinsics = replace(CAMERA, params=(focal, 320, 240, -0.05), **changes)  # type: ignore[arg-type]
    return replace(submodel, intrinsics=(intrinsics,) * len(submodel.images))


def test_one_wild_focal_length_does_not_move_the_median() -> None:
    world = make_world()
    submodels = [with_focal(p, f) for p, f in zip(world.submodels, (590.0, 610.0, 9000.0), strict=True)]
    fused = fuse_intrinsics(replace(world, submodels=submodels).placed(), [0] * NUM_IMAGES)
    assert list(fused) == [0]
    assert fused[0].params == pytest.approx((610, 320, 240, -0.05), abs=0)
    assert (fused[0].model, fused[0].width, fused[0].height) == ("SIMPLE_RADIAL", 640, 480)


def test_a_submodel_counts_with_its_registered_images() -> None:
    world = make_world((range(0, 3), range(1, 14), range(2, 4)))
    submodels = [with_focal(p, f) for p, f in zip(world.submodels, (500.0, 600.0, 700.0), strict=True)]
    assert fuse_intrinsics(replace(world, submodels=submodels).placed(), [0] * NUM_IMAGES)[0].params[0] == 600


def test_cameras_are_fused_apart() -> None:
    world = make_world()
    submodels = [with_focal(p, f) for p, f in zip(world.submodels, (500.0, 600.0, 700.0), strict=True)]
    camera_of_image = [2] * 3 + [7] * 7 + [4] * 4
    fused = fuse_intrinsics(replace(world, submodels=submodels).placed(), camera_of_image)
    # Camera 7 has images 3..9: in the first submodel 4, in the second 7, in the third 3 times.
    assert {camera: intrinsics.params[0] for camera, intrinsics in fused.items()} == {2: 500, 4: 700, 7: 600}


def test_the_model_of_most_images_is_taken() -> None:
    world = make_world()
    submodels = list(world.submodels)
    pinhole = Intrinsics(model="PINHOLE", width=640, height=480, params=(1, 1, 2, 2))
    submodels[1] = replace(submodels[1], intrinsics=(pinhole,) * 7)
    fused = fuse_intrinsics(replace(world, submodels=submodels).placed(), [0] * NUM_IMAGES)[0]
    assert (fused.model, fused.params) == (CAMERA.model, CAMERA.params)


def test_a_focal_prior_holds_where_every_submodel_had_it() -> None:
    world = make_world()
    everywhere = [with_focal(submodel, 600.0, has_prior_focal=True) for submodel in world.submodels]
    assert fuse_intrinsics(replace(world, submodels=everywhere).placed(), [0] * NUM_IMAGES)[0].has_prior_focal
    mixed = replace(world, submodels=[*everywhere[:2], world.submodels[2]])
    assert not fuse_intrinsics(mixed.placed(), [0] * NUM_IMAGES)[0].has_prior_focal


def test_one_camera_at_two_sizes_is_refused() -> None:
    world = make_world()
    submodels = list(world.submodels)
    submodels[1] = replace(submodels[1], intrinsics=(CAMERA.resized(320, 240),) * 7)
    with pytest.raises(ValueError, match=r"camera 0: submodels hold it at sizes \[\(320, 240\), \(640, 480\)\]"):
        fuse_intrinsics(replace(world, submodels=submodels).placed(), [0] * NUM_IMAGES)


# ------------------------------------------------------------------------------- scene
def test_scene_holds_the_fused_parts_under_the_names_of_the_collection() -> None:
    world = make_world((range(3, 8), range(6, 12)))
    images = tuple(
        SourceImage(name=f"{i:02}.jpg", path=Path(f"{i:02}.jpg"), width=640, height=480, camera=i % 2, digest=str(i))
        for i in range(NUM_IMAGES)
    )
    collection = ImageCollection(images=images, cameras=(CAMERA, CAMERA))
    cameras = world.cameras()
    intrinsics = fuse_intrinsics(world.placed(), [image.camera for image in images])
    points = world.points(max_points=100).cloud
    scene = build_scene(collection, world.placed(), cameras, intrinsics, points, frame=WorldFrame(metric=True))
    assert scene.image_indices == tuple(range(3, 12))
    assert scene.image_names == tuple(f"{i:02}.jpg" for i in range(3, 12))
    assert scene.camera_indices == tuple(i % 2 for i in range(3, 12))
    np.testing.assert_allclose(invert_rigid(scene.cam_from_world), world.world_from_cam[3:12], atol=1e-12)
    assert scene.points is points
    assert (scene.metric, scene.segments) == (True, ("0", "1"))
