"""Point fusion on a known world: cameras round a painted unit sphere, cut into submodels."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from helpers.sphere_world import (
    NUM_IMAGES,
    ORDER,
    MapsInMemory,
    World,
    make_submodel,
    make_world,
    moved,
    paint,
    shifted_by,
)
from scipy.spatial.transform import Rotation

from smust3r_colmap.dense.point_cloud import fuse_points
from smust3r_colmap.geometry.affine3 import Affine3
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.sim3 import Sim3, invert_rigid
from smust3r_colmap.geometry.sl4 import SL4
from smust3r_colmap.geometry.transform import Transform
from smust3r_colmap.stitching.camera_fusion import fuse_cameras
from smust3r_colmap.stitching.resection import PlacedSubmodel, place_submodel

LOOP = (0, 1, 2, 11, 12, 13)


# ------------------------------------------------------------------------------ points
def test_cloud_lies_on_the_surface_with_its_colours_and_normals() -> None:
    fused = make_world().points()
    cloud = fused.cloud
    radius = np.linalg.norm(cloud.xyz, axis=1)
    assert 1000 < len(cloud) < 10_000
    assert fused.statistics.num_far == 0
    # Averaging over a cell of edge v pulls inward by less than v ** 2.
    assert 1 - fused.statistics.voxel_size**2 < radius.min() < radius.max() < 1 + 1e-5
    difference = np.abs(paint(cloud.xyz).astype(float) - cloud.rgb)
    assert difference.max() < 127.5 * fused.statistics.voxel_size
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
        assert len(fused.cloud) + fused.statistics.num_seen_once >= 0.85 * max_points
    assert fused.statistics.num_samples <= 4 * max_points + NUM_IMAGES
    assert np.isfinite(fused.cloud.xyz).all()


def test_cells_start_at_the_distance_of_pixels() -> None:
    """Not so small that every pixel stays a point of its own."""
    fused = make_world().points(max_points=10**6)
    footprint = 2.1 / (600 * 56 / 640)
    assert 0.7 * footprint < fused.statistics.voxel_size < 1.5 * footprint
    assert fused.statistics.num_samples == fused.statistics.num_pixels
    assert len(fused.cloud) < 0.6 * fused.statistics.num_pixels


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
    assert world.points().statistics.num_pixels == expected


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
    assert 1 - fused.statistics.voxel_size**2 < radius.min() < radius.max() < 1 + 1e-5


def test_pixels_of_a_wrong_pose_follow_the_pose_that_was_kept() -> None:
    """The map was made with the bad pose; carried by the kept one it lies right again."""
    exact = make_world()
    world = moved(exact, 0, 1, (0.3, 0, 0))  # only the first submodel holds image 1
    pointmap = world.dense[0].pointmaps[1]
    world.dense[0].pointmaps[1] = pointmap + np.array([0.3, 0, 0], dtype=np.float32)
    cameras = replace(world.cameras(), cam_from_world=invert_rigid(exact.world_from_cam))
    fused = fuse_points(world.placed(), world.dense, cameras, max_points=20_000, min_confidence=2.0)
    radius = np.linalg.norm(fused.cloud.xyz, axis=1)
    assert 1 - fused.statistics.voxel_size**2 < radius.min() < radius.max() < 1 + 1e-5


def edited(edit: Callable[[World], None]) -> World:
    world = make_world()
    edit(world)
    return world


@pytest.mark.slow
def test_pixels_below_the_confidence_are_left_out() -> None:
    def doubt_the_left_half(world: World) -> None:
        for maps in world.dense:
            for confidence in maps.confidences:
                confidence[:, : confidence.shape[1] // 2] = 1.9

    halved = edited(doubt_the_left_half).points()
    assert 0.4 < halved.statistics.num_pixels / make_world().points().statistics.num_pixels < 0.6
    assert (
        edited(doubt_the_left_half).points(min_confidence=1.5).statistics.num_pixels
        == make_world().points().statistics.num_pixels
    )


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
    assert make_world().points().statistics.num_pixels - spoiled.statistics.num_pixels == lost
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
    assert fused.statistics.num_seen_once > 500
    assert flying.mean() < 0.03
    assert len(fused.cloud) > 2000


def test_points_that_one_image_only_saw_stay_where_little_else_is_there() -> None:
    world = make_world((range(0, 1),))
    fused = world.points()
    assert fused.statistics.num_seen_once == 0
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
    assert (len(fused.cloud), fused.statistics.num_far) == (50, 0)


def test_pixels_at_infinity_do_not_coarsen_the_cloud() -> None:
    def send_one_away(world: World) -> None:
        for submodel, maps in zip(world.submodels, world.dense, strict=True):
            for centre, pointmap in zip(submodel.seg_from_cam[:, :, 3], maps.pointmaps, strict=True):
                pointmap[20, 25] += 1e9 * (pointmap[20, 25] - centre)

    fused = edited(send_one_away).points()
    assert fused.statistics.num_far == NUM_IMAGES
    assert fused.statistics.voxel_size == pytest.approx(make_world().points().statistics.voxel_size, rel=0.05)
    assert np.linalg.norm(fused.cloud.xyz, axis=1).max() < 1 + 1e-5


def test_no_confident_pixel_gives_an_empty_cloud() -> None:
    fused = make_world().points(min_confidence=99)
    assert len(fused.cloud) == 0
    assert (fused.statistics.num_pixels, fused.statistics.num_samples) == (0, 0)
    assert np.isnan(fused.statistics.voxel_size)


def test_far_from_the_origin_the_cloud_keeps_its_detail() -> None:
    world = make_world()
    away = np.array([5e6, -3e6, 100.0])
    world_from_seg = [shifted_by(one, away) for one in world.world_from_seg]
    fused = replace(world, world_from_seg=world_from_seg).points()
    radius = np.linalg.norm(fused.cloud.xyz - away, axis=1)
    assert 1 - fused.statistics.voxel_size**2 < radius.min() < radius.max() < 1 + 1e-5


def test_points_need_sensible_arguments() -> None:
    world = make_world()
    with pytest.raises(ValueError, match=r"max_points is 0, needed at least 1"):
        world.points(max_points=0)
    with pytest.raises(ValueError, match="3 submodels and 2 sets of maps"):
        fuse_points(world.placed(), world.dense[:2], world.cameras(), max_points=9, min_confidence=2.0)


# ------------------------------------------------------------------------------- loops
def test_cloud_takes_pixels_of_a_loop_submodel_only_for_its_own_images() -> None:
    windows, loop = (range(1, 8), range(4, 13)), LOOP
    world = make_world((*windows, loop))
    placed = world.placed(loops=[2])

    def num_pixels(world: World, placed: Sequence[PlacedSubmodel]) -> int:
        cameras = fuse_cameras(placed, ORDER)
        return fuse_points(placed, world.dense, cameras, max_points=20_000, min_confidence=2.0).statistics.num_pixels

    ends = sum(np.count_nonzero(world.dense[2].confidences[k] >= 2) for k in (0, 5))
    alone = make_world(windows)
    assert num_pixels(world, placed) == num_pixels(alone, alone.placed()) + ends


# ------------------------------------------------------------------------ wider groups
@pytest.mark.parametrize("group", [Affine3, SL4])
def test_wider_groups_that_do_not_bend_give_the_same_scene(group: type[Transform]) -> None:
    world = make_world()
    wide = replace(world, world_from_seg=[group.from_matrix(one.matrix) for one in world.world_from_seg])
    np.testing.assert_allclose(wide.cameras().cam_from_world, world.cameras().cam_from_world, atol=1e-5)
    assert 0 <= wide.cameras().residual_px.max() < 0.01
    radius = np.linalg.norm(wide.points().cloud.xyz, axis=1)
    assert 1 - wide.points().statistics.voxel_size ** 2 < radius.min() < radius.max() < 1 + 1e-4


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
