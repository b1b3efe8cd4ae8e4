"""Fusion on a world that is known: cameras round a painted unit sphere, cut into submodels."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.sphere_world import (
    CAMERA,
    NUM_IMAGES,
    WINDOWS,
    MapsInMemory,
    World,
    make_submodel,
    make_world,
    moved,
    paint,
    shifted,
    shifted_by,
)
from scipy.spatial.transform import Rotation

from smust3r_colmap.dense.point_cloud import fuse_points, surface_normals
from smust3r_colmap.geometry.affine3 import Affine3
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.geometry.sim3 import Sim3, invert_rigid
from smust3r_colmap.geometry.sl4 import SL4
from smust3r_colmap.geometry.transform import Transform
from smust3r_colmap.products import ImageCollection, SourceImage, Submodel
from smust3r_colmap.stitching.camera_fusion import build_scene, centrality, fuse_cameras, fuse_intrinsics
from smust3r_colmap.stitching.resection import PlacedSubmodel, place_submodel

# --------------------------------------------------------------------------- the world


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
    np.testing.assert_allclose(centrality(range(5)), [1 / 3, 2 / 3, 1, 2 / 3, 1 / 3])
    np.testing.assert_allclose(centrality(range(7, 11)), [0.5, 1, 1, 0.5])
    np.testing.assert_allclose(centrality([3]), [1])


def test_weights_fall_to_the_ends_of_each_run_but_not_at_a_few_missing_images() -> None:
    two_runs = [10, 11, 12, 90, 91, 92, 93, 94]
    np.testing.assert_allclose(centrality(two_runs), np.array([1, 2, 1, 1, 2, 3, 2, 1]) / 3)
    np.testing.assert_allclose(centrality([0, 1, 7, 8]), [0.5, 1, 1, 0.5])
    np.testing.assert_allclose(centrality([0, 1, 8, 9]), [1, 1, 1, 1])


def test_drift_is_blended_steadily_from_one_submodel_to_the_next() -> None:
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
def test_one_bad_pose_is_dropped_where_the_other_submodel_holds_the_image_more_central(
    bad_submodel: int, image: int, shift: tuple[float, ...], turn_deg: float
) -> None:
    exact = make_world()
    world = moved(exact, bad_submodel, image, shift, turn_deg)
    cameras = world.cameras()
    np.testing.assert_allclose(invert_rigid(cameras.cam_from_world), exact.world_from_cam, atol=1e-9)
    assert cameras.num_dropped.tolist() == [int(i == image) for i in range(NUM_IMAGES)]
    assert cameras.best_submodel[image] == 1 - bad_submodel


def test_two_of_three_submodels_outvote_the_most_central_one() -> None:
    exact = make_world((range(0, 8), range(2, 10), range(4, 14), range(1, 5)))
    world = moved(exact, 1, 6, (0.5, 0, 0), 10)
    assert centrality(range(8))[4] > centrality(range(8))[1], (
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


def test_rotations_stay_rotations_and_two_equal_votes_meet_half_way() -> None:
    exact = make_world((range(0, 14), range(0, 14)))
    turn = Rotation.from_euler("y", 40, degrees=True).as_matrix()
    poses = exact.world_from_cam.copy()
    poses[:, :, :3] @= turn
    submodels = [exact.submodels[0], make_submodel(1, range(14), exact.world_from_seg[1].inverse().move_cameras(poses))]
    fused = invert_rigid(replace(exact, submodels=submodels).cameras().cam_from_world)
    half = exact.world_from_cam[:, :, :3] @ Rotation.from_euler("y", 20, degrees=True).as_matrix()
    np.testing.assert_allclose(fused[:, :, :3], half, atol=1e-12)


def test_three_opposite_votes_still_make_a_rotation() -> None:
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


def test_submodels_that_disagree_everywhere_are_blended_and_the_spread_tells() -> None:
    cameras = shifted(make_world(), 2, (0, 5, 0)).cameras()
    assert cameras.num_dropped.sum() == 0
    np.testing.assert_allclose(cameras.position_spread[7:10] * cameras.scene_radius, 5, rtol=1e-9)


def test_fusing_needs_a_submodel() -> None:
    with pytest.raises(ValueError, match="no submodel, needed at least one"):
        fuse_cameras([])


# ------------------------------------------------------------------------------- loops
LOOP = (0, 1, 2, 11, 12, 13)


def test_loop_submodel_has_no_say_where_a_window_placed_the_image() -> None:
    without = make_world()
    world = shifted(make_world((*WINDOWS, LOOP)), 3, (0.1, 0, 0))
    cameras = fuse_cameras(world.placed(loops=[3]))
    np.testing.assert_array_equal(cameras.cam_from_world, without.cameras().cam_from_world)
    np.testing.assert_array_equal(cameras.num_submodels, without.cameras().num_submodels)
    np.testing.assert_array_equal(cameras.best_submodel, without.cameras().best_submodel)
    as_window = fuse_cameras(world.placed())
    assert np.abs(as_window.cam_from_world - cameras.cam_from_world).max() > 0.01


def test_loop_submodel_places_the_images_that_no_window_holds() -> None:
    exact = make_world((range(1, 8), range(4, 13), LOOP))
    world = moved(exact, 2, 13, (0.1, 0, 0))
    cameras = fuse_cameras(world.placed(loops=[2]))
    assert cameras.images == tuple(range(14))
    assert cameras.best_submodel[[0, 13]].tolist() == [2, 2]
    assert 2 not in cameras.best_submodel[1:13]
    assert cameras.num_submodels[[0, 1, 13]].tolist() == [1, 1, 1]
    wrong_by = invert_rigid(cameras.cam_from_world)[:, :, 3] - world.world_from_cam[:, :, 3]
    np.testing.assert_allclose(wrong_by[13], [0.1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(wrong_by[:13], 0, atol=1e-12)


def test_cloud_takes_pixels_of_a_loop_submodel_only_for_its_own_images() -> None:
    windows, loop = (range(1, 8), range(4, 13)), LOOP
    world = make_world((*windows, loop))
    placed = world.placed(loops=[2])

    def num_pixels(world: World, placed: Sequence[PlacedSubmodel]) -> int:
        cameras = fuse_cameras(placed)
        return fuse_points(placed, world.dense, cameras, max_points=20_000, min_confidence=2.0).num_pixels

    ends = sum(np.count_nonzero(world.dense[2].confidences[k] >= 2) for k in (0, 5))
    alone = make_world(windows)
    assert num_pixels(world, placed) == num_pixels(alone, alone.placed()) + ends


def test_loop_submodel_votes_on_the_calibration_with_its_own_images_only() -> None:
    world = make_world((range(1, 4), range(0, 14)))
    submodels = [with_focal(p, f) for p, f in zip(world.submodels, (500.0, 600.0), strict=True)]
    placed = replace(world, submodels=submodels).placed(loops=[1])
    # Of camera 0 the window has all images, of camera 1 none.
    fused = fuse_intrinsics(placed, [0] * 4 + [1] * 10)
    # The loop has image 0 of camera 0: one vote against three.
    assert (fused[0].params[0], fused[1].params[0]) == (500, 600)


# ------------------------------------------------------------------------ wider groups
@pytest.mark.parametrize("group", [Affine3, SL4])
def test_wider_groups_that_do_not_bend_give_the_same_scene(group: type[Transform]) -> None:
    world = make_world()
    wide = replace(world, world_from_seg=[group.from_matrix(one.matrix) for one in world.world_from_seg])
    np.testing.assert_allclose(wide.cameras().cam_from_world, world.cameras().cam_from_world, atol=1e-5)
    assert 0 <= wide.cameras().residual_px.max() < 0.01
    radius = np.linalg.norm(wide.points().cloud.xyz, axis=1)
    assert 1 - wide.points().voxel_size ** 2 < radius.min() < radius.max() < 1 + 1e-4


@pytest.mark.parametrize("group", [Affine3, SL4])
def test_bent_submodels_are_straightened_with_their_points(group: type[Affine3] | type[SL4]) -> None:
    """A submodel that was reconstructed warped, and the transform that takes the warp back."""
    world = make_world((range(0, 14),))
    tangent = 0.03 * np.random.default_rng(3).normal(size=group.DOF)
    warped_from_world = group.exp(tangent)
    maps = world.dense[0]
    for k, pointmap in enumerate(maps.pointmaps):
        maps.pointmaps[k] = warped_from_world.apply(pointmap.reshape(-1, 3)).reshape(pointmap.shape).astype(np.float32)
    bent_world = replace(world, world_from_seg=[warped_from_world.inverse()])
    # The submodel's own cameras are those that see the warped points best, as a backbone's would.
    own = place_submodel(world.submodels[0], make_world((range(0, 14),)).dense[0], warped_from_world)
    bent_world.submodels[0] = replace(world.submodels[0], seg_from_cam=own.world_from_cam)
    cameras = bent_world.cameras()
    assert 0.1 < cameras.residual_px.max() < 30
    offsets = invert_rigid(cameras.cam_from_world)[:, :, 3] - world.world_from_cam[:, :, 3]
    assert np.linalg.norm(offsets, axis=1).max() < 0.02 * 3
    radius = np.linalg.norm(bent_world.points().cloud.xyz, axis=1)
    assert 0.98 < np.percentile(radius, 5) < np.percentile(radius, 95) < 1.02


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


def test_a_submodel_votes_with_its_registered_images() -> None:
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


# ------------------------------------------------------------------------------ points
def test_cloud_lies_on_the_surface_with_its_colours_and_normals() -> None:
    fused = make_world().points()
    cloud = fused.cloud
    radius = np.linalg.norm(cloud.xyz, axis=1)
    assert 1000 < len(cloud) < 10_000
    assert fused.num_far == 0
    # Averaging over a cell of edge v pulls inward by less than v ** 2.
    assert 1 - fused.voxel_size**2 < radius.min() < radius.max() < 1 + 1e-5
    difference = np.abs(paint(cloud.xyz).astype(float) - cloud.rgb)
    assert difference.max() < 127.5 * fused.voxel_size
    assert cloud.normals is not None
    np.testing.assert_allclose(np.linalg.norm(cloud.normals, axis=1), 1, atol=1e-6)
    cosines = np.einsum("ij,ij->i", cloud.normals, cloud.xyz / radius[:, None])
    assert np.median(cosines) > 0.995
    assert np.percentile(cosines, 5) > 0.99
    assert cosines.min() > 0, "at the rims, seen edge-on, they still face the cameras"


@pytest.mark.parametrize("max_points", [1, 2, 9, 100, 1000, 3000])
def test_max_points_is_a_strict_bound_and_is_used(max_points: int) -> None:
    fused = make_world().points(max_points=max_points)
    assert len(fused.cloud) <= max_points
    if max_points >= 100:
        assert len(fused.cloud) + fused.num_seen_once >= 0.85 * max_points
    assert fused.num_samples <= 4 * max_points + NUM_IMAGES
    assert np.isfinite(fused.cloud.xyz).all()


def test_cells_start_at_the_distance_of_pixels() -> None:
    """Not so small that every pixel stays a point of its own."""
    fused = make_world().points(max_points=10**6)
    footprint = 2.1 / (600 * 56 / 640)
    assert 0.7 * footprint < fused.voxel_size < 1.5 * footprint
    assert fused.num_samples == fused.num_pixels
    assert len(fused.cloud) < 0.6 * fused.num_pixels


def test_result_is_the_same_every_time() -> None:
    first, second = make_world().points(max_points=500), make_world().points(max_points=500)
    np.testing.assert_array_equal(first.cloud.xyz, second.cloud.xyz)
    np.testing.assert_array_equal(first.cloud.rgb, second.cloud.rgb)
    assert first.cloud.normals is not None
    assert second.cloud.normals is not None
    np.testing.assert_array_equal(first.cloud.normals, second.cloud.normals)


def test_every_image_gives_its_pixels_once_from_the_submodel_where_it_is_central() -> None:
    world = make_world()
    used = {0: range(0, 5), 1: range(5, 9), 2: range(9, 14)}
    expected = sum(
        np.count_nonzero(world.dense[submodel].confidences[world.submodels[submodel].images.index(image)] >= 2)
        for submodel, images in used.items()
        for image in images
    )
    assert world.cameras().best_submodel.tolist() == [p for p, images in used.items() for _ in images]
    assert world.points().num_pixels == expected


def test_cloud_moves_with_the_fused_cameras_not_with_the_submodels() -> None:
    world = make_world()
    cameras = world.cameras()
    turn = Rotation.from_euler("xyz", [10, 20, 30], degrees=True).as_matrix()
    shift = np.array([4.0, -2.0, 1.0])
    world_from_cam = invert_rigid(cameras.cam_from_world)
    elsewhere = np.concatenate(
        [turn @ world_from_cam[:, :, :3], (world_from_cam[:, :, 3] @ turn.T + shift)[:, :, None]], axis=2
    )
    fused = fuse_points(
        world.placed(),
        world.dense,
        replace(cameras, cam_from_world=invert_rigid(elsewhere)),
        max_points=20_000,
        min_confidence=2.0,
    )
    radius = np.linalg.norm(fused.cloud.xyz - shift, axis=1)
    assert 1 - fused.voxel_size**2 < radius.min() < radius.max() < 1 + 1e-5


def test_pixels_of_a_wrong_pose_follow_the_pose_that_was_kept() -> None:
    """The map was made with the bad pose; carried by the kept one it lies right again."""
    exact = make_world()
    world = moved(exact, 0, 1, (0.3, 0, 0))  # only the first submodel holds image 1
    pointmap = world.dense[0].pointmaps[1]
    world.dense[0].pointmaps[1] = pointmap + np.array([0.3, 0, 0], dtype=np.float32)
    cameras = replace(world.cameras(), cam_from_world=invert_rigid(exact.world_from_cam))
    fused = fuse_points(world.placed(), world.dense, cameras, max_points=20_000, min_confidence=2.0)
    radius = np.linalg.norm(fused.cloud.xyz, axis=1)
    assert 1 - fused.voxel_size**2 < radius.min() < radius.max() < 1 + 1e-5


def edited(edit: Callable[[World], None]) -> World:
    world = make_world()
    edit(world)
    return world


def test_pixels_below_the_confidence_are_left_out() -> None:
    def doubt_the_left_half(world: World) -> None:
        for maps in world.dense:
            for confidence in maps.confidences:
                confidence[:, : confidence.shape[1] // 2] = 1.9

    halved = edited(doubt_the_left_half).points()
    assert 0.4 < halved.num_pixels / make_world().points().num_pixels < 0.6
    assert edited(doubt_the_left_half).points(min_confidence=1.5).num_pixels == make_world().points().num_pixels


def test_pixels_behind_the_camera_or_without_a_point_are_left_out() -> None:
    def spoil(world: World) -> None:
        k = 2
        cam_from_seg = invert_rigid(world.submodels[0].seg_from_cam[k])
        points_cam = world.dense[0].pointmaps[k] @ cam_from_seg[:, :3].T + cam_from_seg[:, 3]
        points_cam[:, :30] *= -1
        points_cam[:, 30:] = np.nan
        pose = world.submodels[0].seg_from_cam[k]
        world.dense[0].pointmaps[k] = (points_cam @ pose[:, :3].T + pose[:, 3]).astype(np.float32)

    spoiled = edited(spoil).points()
    lost = np.count_nonzero(make_world().dense[0].confidences[2] >= 2)
    assert make_world().points().num_pixels - spoiled.num_pixels == lost
    assert np.linalg.norm(spoiled.cloud.xyz, axis=1).max() < 1 + 1e-5


def test_points_that_one_image_only_saw_are_dropped() -> None:
    def add_flying_pixels(world: World) -> None:
        for submodel, maps in enumerate(world.dense):
            for k, confidence in enumerate(maps.confidences):
                rng = np.random.default_rng([submodel, k])
                confidence[0] = 5
                # Each twice: two pixels of one image are one witness.
                inside_world = np.repeat(rng.uniform(-0.5, 0.5, (maps.pointmaps[k].shape[1] // 2, 3)), 2, axis=0)
                seg_from_world = world.world_from_seg[submodel].inverse()
                maps.pointmaps[k][0] = seg_from_world.apply(inside_world).reshape(-1, 3)

    world = edited(add_flying_pixels)
    fused = world.points()
    flying = np.linalg.norm(fused.cloud.xyz, axis=1) < 0.9
    assert fused.num_seen_once > 500
    assert flying.mean() < 0.03
    assert len(fused.cloud) > 2000


def test_points_that_one_image_only_saw_stay_where_little_else_is_there() -> None:
    world = make_world((range(0, 1),))
    fused = world.points()
    assert fused.num_seen_once == 0
    assert len(fused.cloud) > 300


def facing_cameras(pointmaps_world: Sequence[FloatArray]) -> World:
    """Two cameras at z = -1 and z = 1 that look at each other, with the maps given."""
    ahead, back = np.eye(3, 4), Rotation.from_euler("y", 180, degrees=True).as_matrix() @ np.eye(3, 4)
    ahead[2, 3], back[2, 3] = -1, 1
    world_from_cam = np.stack([ahead, back])[: len(pointmaps_world)]
    maps = MapsInMemory(
        [pointmap.astype(np.float32) for pointmap in pointmaps_world],
        [np.full(pointmap.shape[:2], 5, dtype=np.float32) for pointmap in pointmaps_world],
        [np.zeros(pointmap.shape, dtype=np.uint8) for pointmap in pointmaps_world],
    )
    submodel = make_submodel(0, range(len(pointmaps_world)), world_from_cam)
    return World(world_from_cam, [submodel], [Sim3.identity()], [maps])


@pytest.mark.parametrize("max_points", [300, 700, 1000, 1500])
def test_budget_is_used_also_where_pixels_fill_a_volume(max_points: int) -> None:
    """Occupied cells then fall faster with their size than on a surface."""
    z, y, x = np.mgrid[:0.9:20j, :0.9:20j, :0.9:20j]
    block = np.stack([x, y, z], axis=-1).reshape(400, 20, 3)
    block += np.random.default_rng(2).uniform(-0.015, 0.015, block.shape)
    fused = facing_cameras([block]).points(max_points=max_points)
    assert 0.9 * max_points <= len(fused.cloud) <= max_points


def test_thin_wall_seen_from_both_sides_has_normals() -> None:
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, 21), np.linspace(-0.5, 0.5, 21))
    wall = np.stack([x, y, 0 * x], axis=-1)
    fused = facing_cameras([wall, wall[:, ::-1]]).points()
    assert fused.cloud.normals is not None
    np.testing.assert_allclose(np.abs(fused.cloud.normals) @ [0, 0, 1], 1, atol=1e-6)


def test_maps_of_one_column_are_fused() -> None:
    """They have no neighbouring pixels to take the first cell size from."""
    column = np.zeros((50, 1, 3))
    column[:, 0, 1] = np.linspace(0, 1, 50)
    fused = facing_cameras([column]).points()
    assert (len(fused.cloud), fused.num_far) == (50, 0)


def test_pixels_at_infinity_do_not_coarsen_the_cloud() -> None:
    def send_one_away(world: World) -> None:
        for submodel, maps in zip(world.submodels, world.dense, strict=True):
            for centre, pointmap in zip(submodel.seg_from_cam[:, :, 3], maps.pointmaps, strict=True):
                pointmap[20, 25] += 1e9 * (pointmap[20, 25] - centre)

    fused = edited(send_one_away).points()
    assert fused.num_far == NUM_IMAGES
    assert fused.voxel_size == pytest.approx(make_world().points().voxel_size, rel=0.05)
    assert np.linalg.norm(fused.cloud.xyz, axis=1).max() < 1 + 1e-5


def test_no_confident_pixel_gives_an_empty_cloud() -> None:
    fused = make_world().points(min_confidence=99)
    assert len(fused.cloud) == 0
    assert (fused.num_pixels, fused.num_samples) == (0, 0)
    assert np.isnan(fused.voxel_size)


def test_far_from_the_origin_the_cloud_keeps_its_detail() -> None:
    world = make_world()
    away = np.array([5e6, -3e6, 100.0])
    world_from_seg = [shifted_by(one, away) for one in world.world_from_seg]
    fused = replace(world, world_from_seg=world_from_seg).points()
    radius = np.linalg.norm(fused.cloud.xyz - away, axis=1)
    assert 1 - fused.voxel_size**2 < radius.min() < radius.max() < 1 + 1e-5


def test_points_need_sensible_arguments() -> None:
    world = make_world()
    with pytest.raises(ValueError, match=r"max_points is 0, needed at least 1"):
        world.points(max_points=0)
    with pytest.raises(ValueError, match="3 submodels and 2 sets of maps"):
        fuse_points(world.placed(), world.dense[:2], world.cameras(), max_points=9, min_confidence=2.0)


# ----------------------------------------------------------------------------- normals
def normals_everywhere(points_cam: FloatArray) -> FloatArray:
    rows, columns = np.indices(points_cam.shape[:2]).reshape(2, -1)
    return surface_normals(points_cam, rows, columns).reshape(points_cam.shape)


@pytest.mark.parametrize("slope", [-0.5, 0.0, 0.8])
def test_normals_of_a_plane_are_exact_up_to_the_rim(slope: float) -> None:
    x, y = np.meshgrid(np.linspace(-0.9, 0.9, 41), np.linspace(-0.9, 0.9, 7))
    z = 5 / (1 - slope * x)  # the plane z = 5 + slope * X seen along rays (x, y, 1)
    normals = normals_everywhere(np.stack([x * z, y * z, z], axis=-1))
    expected = np.array([slope, 0, -1]) / np.hypot(slope, 1)
    gentle = np.abs(np.gradient(z, axis=1)) < 0.04 * z  # steeper counts as a jump
    np.testing.assert_allclose(normals[gentle], np.broadcast_to(expected, normals.shape)[gentle], atol=1e-12)
    assert gentle.mean() > 0.5


def test_normals_are_not_invented_across_a_depth_jump_or_a_hole() -> None:
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, 8), np.linspace(-0.5, 0.5, 8))
    z = np.where(x < 0, 2.0, 4.0)
    points = np.stack([x * z, y * z, z], axis=-1)
    points[0, 0] = np.nan
    lengths = np.linalg.norm(normals_everywhere(points), axis=-1)
    np.testing.assert_allclose(lengths[:, 3:5], 1e-3)
    np.testing.assert_allclose(lengths[[0, 1], [1, 0]], 1e-3)
    np.testing.assert_allclose(lengths[2:, [0, 1, 6, 7]], 1)


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
    scene = build_scene(collection, world.placed(), cameras, intrinsics, points, metric=True)
    assert scene.image_indices == tuple(range(3, 12))
    assert scene.image_names == tuple(f"{i:02}.jpg" for i in range(3, 12))
    assert scene.camera_indices == tuple(i % 2 for i in range(3, 12))
    np.testing.assert_allclose(invert_rigid(scene.cam_from_world), world.world_from_cam[3:12], atol=1e-12)
    assert scene.points is points
    assert (scene.metric, scene.segments) == (True, ("0", "1"))
