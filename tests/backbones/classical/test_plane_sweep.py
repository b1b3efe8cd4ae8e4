"""The plane sweep on a ray-cast scene whose depth is known exactly.

A slanted wall behind a box's front face, both painted with a sum of sine waves in space, so that every
image is exact for any camera, distorted or not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import pytest
from scipy.ndimage import binary_dilation, binary_erosion
from scipy.spatial.transform import Rotation

from smust3r_colmap.backbones.classical.plane_sweep import (
    ImageDepth,
    Rectifier,
    View,
    check_consistency,
    interior_of,
    reconstruct_depth,
    sweep_depth,
)
from smust3r_colmap.backbones.classical.view_selection import (
    PinholeCamera,
    choose_neighbours,
    depths_in_views,
    inverse_depth_range,
)
from smust3r_colmap.errors import ImageError
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.camera import Intrinsics, pixel_centres
from smust3r_colmap.geometry.depth_noise import FULL_VIEW_AGREEMENT
from smust3r_colmap.products import Tracks

WALL_Z, WALL_SLOPE = 4.0, 0.3  # z = 4 + 0.3 x
FACE_Z, FACE_HALF = 2.6, (0.5, 0.35)
PINHOLE = Intrinsics(model="PINHOLE", width=128, height=96, params=(120, 118, 65, 47))
BARREL = Intrinsics(model="SIMPLE_RADIAL", width=128, height=96, params=(110, 64, 48, -0.15))
INVERSE_DEPTHS = (1 / 5.5, 1 / 2.0)


def hit(origin_seg: FloatArray, directions_seg: FloatArray) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """First points (M, 3) that rays meet, and which of them lie on the face."""
    along = (WALL_Z + WALL_SLOPE * origin_seg[0] - origin_seg[2]) / (
        directions_seg[:, 2] - WALL_SLOPE * directions_seg[:, 0]
    )
    to_face = (FACE_Z - origin_seg[2]) / directions_seg[:, 2]
    on_face = (np.abs(origin_seg + to_face[:, None] * directions_seg)[:, :2] < FACE_HALF).all(axis=1)
    return origin_seg + np.where(on_face, to_face, along)[:, None] * directions_seg, on_face


def paint(points_seg: FloatArray) -> npt.NDArray[np.uint8]:
    """Grey value (M,) of scene points: 40 waves of 0.12 to 0.7 m."""
    rng = np.random.default_rng(7)
    waves = rng.normal(size=(40, 3))
    waves *= (2 * np.pi / rng.uniform(0.12, 0.7, 40) / np.linalg.norm(waves, axis=1))[:, None]
    grey = 128 + 14 * np.sin(points_seg @ waves.T + rng.uniform(0, 2 * np.pi, 40)).sum(axis=1)
    return np.asarray(np.clip(grey, 0, 255).round(), dtype=np.uint8)


@dataclass(frozen=True, kw_only=True, eq=False)
class Shot:
    """One image of the scene with everything known about it."""

    intrinsics: Intrinsics
    seg_from_cam: FloatArray
    rgb: npt.NDArray[np.uint8]
    depth: FloatArray
    on_face: npt.NDArray[np.bool_]


def shoot(intrinsics: Intrinsics, centre_seg: Sequence[float], rotvec_deg: Sequence[float] = (0, 0, 0)) -> Shot:
    rotation = Rotation.from_rotvec(rotvec_deg, degrees=True).as_matrix()
    return shoot_from(intrinsics, np.column_stack([rotation, centre_seg]))


def shoot_from(intrinsics: Intrinsics, seg_from_cam: FloatArray) -> Shot:
    rays_cam = intrinsics.rays_cam(pixel_centres(intrinsics.width, intrinsics.height))
    points_seg, on_face = hit(seg_from_cam[:, 3], rays_cam @ seg_from_cam[:, :3].T)
    size = (intrinsics.height, intrinsics.width)
    depth = (points_seg - seg_from_cam[:, 3]) @ seg_from_cam[:, 2]
    return Shot(
        intrinsics=intrinsics,
        seg_from_cam=seg_from_cam,
        rgb=np.repeat(paint(points_seg).reshape(*size, 1), 3, axis=2),
        depth=depth.reshape(size),
        on_face=on_face.reshape(size),
    )


def row_of_shots(intrinsics: Intrinsics, count: int = 5, step: float = 0.2) -> list[Shot]:
    """Side by side, 3 degrees of parallax at the wall, each turned a little."""
    return [
        shoot(intrinsics, ((k - count // 2) * step, 0.04 * (-1) ** k, 0.02 * k), (0.8 * k, 1.0 * (k - 2), 1.5 * k))
        for k in range(count)
    ]


def camera_of(shot: Shot) -> PinholeCamera:
    rotation = shot.seg_from_cam[:, :3].T
    return PinholeCamera(
        img_from_cam=np.asarray(shot.intrinsics.colmap_camera().calibration_matrix()),
        cam_from_seg=np.column_stack([rotation, -rotation @ shot.seg_from_cam[:, 3]]),
        width=shot.intrinsics.width,
        height=shot.intrinsics.height,
    )


def view_of(shot: Shot) -> View:
    grey = shot.rgb[..., 0].astype(np.float32)
    return View(camera=camera_of(shot), grey=grey, interior=interior_of(np.ones(grey.shape, dtype=bool)))


def sparse_points(shots: Sequence[Shot], each: int = 60) -> Tracks:
    """Points on the surface of every image, observed by it and by the next one."""
    rng = np.random.default_rng(3)
    points, observed = [], []
    for k, shot in enumerate(shots):
        chosen = rng.choice(shot.depth.size, each, replace=False)
        rays_cam = shot.intrinsics.rays_cam(pixel_centres(shot.intrinsics.width, shot.intrinsics.height)[chosen])
        points_cam = rays_cam * shot.depth.reshape(-1, 1)[chosen]
        points.append(points_cam @ shot.seg_from_cam[:, :3].T + shot.seg_from_cam[:, 3])
        observed += [(k * each + row, image) for row in range(each) for image in (k, (k + 1) % len(shots))]
    point, image = np.array(observed, dtype=np.int64).T
    return Tracks(
        points_seg=np.concatenate(points),
        point_of_observation=point,
        image_of_observation=image,
        feature_of_observation=np.arange(len(point), dtype=np.int64),
    )


def no_points() -> Tracks:
    none = np.zeros(0, np.int64)
    return Tracks(
        points_seg=np.zeros((0, 3)),
        point_of_observation=none,
        image_of_observation=none,
        feature_of_observation=none,
    )


def reconstruct(shots: Sequence[Shot], tracks: Tracks, dense_size: int = 128) -> list[ImageDepth]:
    return list(
        reconstruct_depth(
            lambda k: shots[k].rgb,
            images=range(len(shots)),
            seg_from_cam=np.stack([shot.seg_from_cam for shot in shots]),
            intrinsics=[shot.intrinsics for shot in shots],
            tracks=tracks,
            dense_size=dense_size,
            planes=64,
        )
    )


def relative_error(found: ImageDepth, truth: FloatArray, least_confidence: float) -> FloatArray:
    kept = (found.depth > 0) & (found.confidence >= least_confidence)
    return np.asarray(np.abs(found.depth[kept] / truth[kept] - 1.0), dtype=np.float64)


@pytest.fixture(scope="module")
def shots() -> list[Shot]:
    return row_of_shots(PINHOLE)


# ------------------------------------------------------------------------------- sweep
def test_sweep_recovers_a_slanted_wall_and_a_box_to_a_fraction_of_a_percent(shots: list[Shot]) -> None:
    neighbours = [view_of(shots[k]) for k in (0, 1, 3, 4)]
    depth, score = sweep_depth(view_of(shots[2]), neighbours, inverse_depths=INVERSE_DEPTHS, planes=64)
    error = np.abs(depth / shots[2].depth - 1.0)
    for surface in (shots[2].on_face, ~shots[2].on_face):
        assert 1e-5 < np.median(error[surface]) < 0.004  # 0.04 px of disparity
        away_from_edges = binary_erosion(surface, iterations=6)
        assert away_from_edges.sum() > 0.3 * surface.sum()
        assert 0.95 < (error[away_from_edges] < 0.02).mean() <= 1.0
    assert 0.95 < np.median(score) <= 1.0


def test_planes_that_are_not_needed_are_not_swept(shots: list[Shot]) -> None:
    views = [view_of(shot) for shot in shots[:3]]
    few, _ = sweep_depth(views[1], [views[0], views[2]], inverse_depths=INVERSE_DEPTHS, planes=64)
    many, _ = sweep_depth(views[1], [views[0], views[2]], inverse_depths=INVERSE_DEPTHS, planes=10_000)
    assert np.array_equal(few, many)


def test_a_flat_patch_on_the_wall_is_bridged_but_its_score_is_low(shots: list[Shot]) -> None:
    """Semi-global matching carries the wall across; the score says that nothing was seen there."""

    def whitewashed(shot: Shot) -> View:
        view = view_of(shot)
        rays_seg = shot.intrinsics.rays_cam(pixel_centres(128, 96)) @ shot.seg_from_cam[:, :3].T
        points_seg, on_face = hit(shot.seg_from_cam[:, 3], rays_seg)
        patch = (np.abs(points_seg[:, 0] + 1.25) < 0.3) & (np.abs(points_seg[:, 1]) < 0.5) & ~on_face
        return replace(view, grey=np.where(patch.reshape(96, 128), np.float32(200.0), view.grey))

    views = [whitewashed(shot) for shot in shots]
    depth, score = sweep_depth(views[2], views[:2] + views[3:], inverse_depths=INVERSE_DEPTHS, planes=64)
    inside = np.zeros((96, 128), dtype=bool)
    inside[40:56, 26:34] = True
    assert (views[2].grey[inside] == 200.0).all()
    assert np.abs(depth / shots[2].depth - 1.0)[inside].max() < 0.15
    assert np.median(score[inside]) < 0.3 < np.median(score)


def test_one_neighbour_is_enough_to_sweep(shots: list[Shot]) -> None:
    depth, _ = sweep_depth(view_of(shots[2]), [view_of(shots[1])], inverse_depths=INVERSE_DEPTHS, planes=64)
    assert 1e-5 < np.median(np.abs(depth / shots[2].depth - 1.0)) < 0.01  # 0.06 px of disparity


def test_sweep_refuses_an_empty_range_and_missing_neighbours(shots: list[Shot]) -> None:
    views = [view_of(shot) for shot in shots[:2]]
    with pytest.raises(ValueError, match="0 neighbours"):
        sweep_depth(views[0], [], inverse_depths=INVERSE_DEPTHS, planes=64)
    with pytest.raises(ValueError, match=r"inverse depths 0\.5 to 0\.2"):
        sweep_depth(views[0], views[1:], inverse_depths=(0.5, 0.2), planes=64)


# ------------------------------------------------------------------------- consistency
def test_agreement_of_exact_depths_counts_the_views_that_see_the_pixel(shots: list[Shot]) -> None:
    others = [shots[k] for k in (0, 1, 3, 4)]
    reference = shots[2]
    rays_seg = PINHOLE.rays_cam(pixel_centres(128, 96)) @ reference.seg_from_cam[:, :3].T
    points_seg, _ = hit(reference.seg_from_cam[:, 3], rays_seg)
    visible = np.zeros(128 * 96)
    for other in others:
        rays = points_seg - other.seg_from_cam[:, 3]
        reached, _ = hit(other.seg_from_cam[:, 3], rays)
        unhidden = np.linalg.norm(reached - points_seg, axis=1) < 1e-6
        visible += unhidden & np.isfinite(depths_in_views([camera_of(other)], points_seg)[0])
    agreement = check_consistency(
        camera_of(reference),
        reference.depth.astype(np.float32),
        [(camera_of(other), other.depth.astype(np.float32)) for other in others],
        tolerance=FULL_VIEW_AGREEMENT,
    )
    assert len(np.unique(visible)) >= 4
    assert (np.abs(agreement.ravel() - visible) < 0.01).mean() > 0.95


def test_agreement_falls_to_nothing_between_one_and_two_tolerances(shots: list[Shot]) -> None:
    camera, truth = camera_of(shots[2]), shots[2].depth.astype(np.float32)
    for wrong_by, expected in ((0.0, 1.0), (0.9, 1.0), (1.5, 0.5), (2.1, 0.0), (-0.9, 1.0), (-2.2, 0.0)):
        shifted = truth * np.float32(1.0 + 0.02 * wrong_by)
        agreement = check_consistency(camera, truth, [(camera, shifted)], tolerance=0.02)
        assert np.median(agreement) == pytest.approx(expected, abs=0.02)


def test_pixels_without_depth_agree_with_nothing(shots: list[Shot]) -> None:
    camera, truth = camera_of(shots[2]), shots[2].depth.astype(np.float32)
    holed = truth.copy()
    holed[:, :50] = 0.0
    assert (check_consistency(camera, holed, [(camera, truth)], tolerance=0.02)[:, :50] == 0).all()
    assert (check_consistency(camera, truth, [(camera, holed)], tolerance=0.02)[:, :50] == 0).all()
    # From one unit behind, depth 0 is the reference's own centre, at depth 1: a map of ones must not confirm it.
    behind = replace(camera, cam_from_seg=camera.cam_from_seg + np.array([0.0, 0.0, 1.0])[:, None] * [0, 0, 0, 1])
    ones = np.ones_like(truth)
    assert (check_consistency(camera, holed, [(behind, ones)], tolerance=0.02)[:, :50] == 0).all()


# ------------------------------------------------------------------------ whole submodels
def test_confident_pixels_are_right_and_wrong_ones_are_not_confident(shots: list[Shot]) -> None:
    for found, shot in zip(reconstruct(shots, sparse_points(shots)), shots, strict=True):
        error = relative_error(found, shot.depth, 2.0)
        assert error.size > 0.6 * shot.depth.size
        assert 1e-5 < np.median(error) < 0.005
        wrong = (found.depth > 0) & (np.abs(found.depth / shot.depth - 1.0) > 0.1)
        assert wrong.mean() < 0.1
        assert found.confidence[wrong].mean() < 2.0 < found.confidence[~wrong].mean() <= 5.0
        assert found.confidence.min() == 1.0
        assert (found.confidence[found.depth == 0] == 1.0).all()


def test_an_image_that_moved_by_itself_is_not_believed(shots: list[Shot]) -> None:
    """One image shows another scene: its depth means nothing and nobody confirms it."""
    odd = replace(shots[2], rgb=np.ascontiguousarray(shots[2].rgb[::-1, ::-1]))
    submodel = [*shots[:2], odd, *shots[3:]]
    found = reconstruct(submodel, sparse_points(shots))
    assert (found[2].confidence > 2.0).mean() < 0.05
    assert (found[1].confidence > 2.0).mean() > 0.5


def test_depth_lies_at_the_right_pixels_of_a_distorted_image() -> None:
    shots = row_of_shots(BARREL)
    outside = np.ones((96, 128), dtype=bool)
    outside[16:-16, 20:-20] = False
    for found, shot in zip(reconstruct(shots, sparse_points(shots)), shots, strict=True):
        error = np.where(found.confidence >= 2.0, np.abs(found.depth / shot.depth - 1.0), np.nan)
        assert 1e-5 < np.nanmedian(error) < 0.005
        assert 1e-5 < np.nanmedian(error[outside]) < 0.006
        assert np.isfinite(error[outside]).mean() > 0.4


@pytest.mark.parametrize(
    ("camera", "grey_bound"),  # random pixels differ by 60; the fisheye cannot resolve the finest waves
    [
        (BARREL, 6.0),
        (Intrinsics(model="SIMPLE_RADIAL", width=90, height=120, params=(100, 45, 60, 0.2)), 6.0),
        (Intrinsics(model="OPENCV_FISHEYE", width=128, height=96, params=(60, 60, 64, 48, 0.02, 0, 0, 0)), 20.0),
    ],
    ids=["barrel", "pincushion", "fisheye"],
)
def test_maps_of_the_pinhole_view_come_back_to_the_distorted_pixels(camera: Intrinsics, grey_bound: float) -> None:
    rectifier = Rectifier.of(camera, max(camera.width, camera.height))
    calibration = rectifier.img_from_cam
    pinhole = Intrinsics(
        model="PINHOLE",
        width=rectifier.view_width,
        height=rectifier.view_height,
        params=(calibration[0, 0], calibration[1, 1], calibration[0, 2], calibration[1, 2]),
    )
    in_view, truth = shoot(pinhole, (0, 0, 0)), shoot(camera, (0, 0, 0))
    surface = in_view.depth.astype(np.float32)
    depth, confidence = rectifier.maps_on_grid(surface, np.full_like(surface, 3.0))
    error = np.abs(depth / truth.depth - 1.0)
    assert np.median(error) < 1e-4
    assert (error < 1e-3).mean() > 0.95
    assert (confidence == 3.0).mean() > 0.98
    around_face = binary_dilation(truth.on_face, iterations=3)
    assert not ((depth > 2.75) & (depth < 3.5))[around_face].any()  # neither the face nor the wall
    view = rectifier.view(truth.rgb, np.eye(4)[:3])
    inside = view.interior > 0
    assert 0.1 < np.median(np.abs(view.grey - in_view.rgb[..., 0])[inside]) < grey_bound
    assert 0.3 < inside.mean() < 1.0


def test_a_view_leaves_out_what_lies_beyond_the_fold_of_the_distortion() -> None:
    """r - 0.4 r^3 turns back at r = 0.913: rays further out would land on the image a second time."""
    rectifier = Rectifier.of(replace(BARREL, params=(110, 64, 48, -0.4)), 128)
    pixels = pixel_centres(rectifier.view_width, rectifier.view_height)
    rays = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(rectifier.img_from_cam).T
    beyond = (np.linalg.norm(rays[:, :2], axis=1) > 0.95).reshape(rectifier.view_height, rectifier.view_width)
    assert rectifier.grid_from_view is not None
    assert beyond.sum() > 100
    assert (rectifier.grid_from_view[:, beyond] < 0).all()
    assert (rectifier.interior[beyond] == 0).all()
    assert rectifier.interior.mean() > 0.3


def test_images_without_distortion_are_not_resampled() -> None:
    assert Rectifier.of(PINHOLE, 128).grid_from_view is None
    assert Rectifier.of(replace(BARREL, params=(110, 64, 48, 0.001)), 128).grid_from_view is None
    assert Rectifier.of(BARREL, 128).grid_from_view is not None


def test_mixed_sizes_portrait_and_cameras_work_together() -> None:
    wide = Intrinsics(model="PINHOLE", width=192, height=144, params=(180, 177, 97, 70))
    tall = Intrinsics(model="SIMPLE_RADIAL", width=90, height=120, params=(110, 45, 60, -0.05))
    cameras = [wide, tall, PINHOLE, tall, wide]
    shots = [shoot(c, ((k - 2) * 0.2, 0.03 * (-1) ** k, 0), (0, 2 * (k - 2), 0)) for k, c in enumerate(cameras)]
    found = reconstruct(shots, sparse_points(shots), dense_size=96)
    assert [one.depth.shape for one in found] == [(72, 96), (96, 72), (72, 96), (96, 72), (72, 96)]
    for one, shot in zip(found, shots, strict=True):
        height, width = one.depth.shape
        truth = shoot_from(shot.intrinsics.resized(width, height), shot.seg_from_cam).depth
        error = relative_error(one, truth, 2.0)
        assert error.size > 0.4 * truth.size
        assert 1e-5 < np.median(error) < 0.008
        assert one.rgb.shape == (height, width, 3)


def test_two_images_reach_confidence_two_and_no_more(shots: list[Shot]) -> None:
    pair = [shots[1], shots[2]]
    for found, shot in zip(reconstruct(pair, sparse_points(pair)), pair, strict=True):
        assert found.confidence.max() == 2.0
        error = relative_error(found, shot.depth, 2.0)
        assert error.size > 0.4 * shot.depth.size
        assert 1e-5 < np.median(error) < 0.006


def test_views_that_are_unlike_confirm_less(shots: list[Shot]) -> None:
    """Under noise many agreeing pixels have an NCC below the sure one and no longer count in full."""
    rng = np.random.default_rng(5)
    clean = shots[1:3]
    noisy = [
        replace(shot, rgb=np.clip(shot.rgb + rng.normal(0, 35, (96, 128, 1)), 0, 255).astype(np.uint8))
        for shot in clean
    ]
    for pair, low, high in ((clean, 0.65, 1.0), (noisy, 0.2, 0.5)):
        for found in reconstruct(pair, sparse_points(pair)):
            confirmed = found.confidence > 1.2
            assert confirmed.mean() > 0.2
            assert low < (found.confidence[confirmed] == 2.0).mean() < high


def test_forward_motion_gives_depth() -> None:
    """Parallax is nothing at the centre and grows outwards; near planes lie behind the views ahead."""
    shots = [shoot(PINHOLE, (0.02 * (-1) ** k, 0.02 * k, 0.35 * k)) for k in range(5)]
    for found, shot in zip(reconstruct(shots, sparse_points(shots)), shots, strict=True):
        error = relative_error(found, shot.depth, 2.0)
        assert error.size > 0.2 * shot.depth.size
        assert 1e-5 < np.median(error) < 0.02


def test_images_that_only_turn_get_empty_maps() -> None:
    turning = [shoot(PINHOLE, (0, 0, 0), (0, 3 * k, 0)) for k in range(4)]
    for found in reconstruct(turning, sparse_points(turning)):
        assert (found.depth == 0).all()
        assert (found.confidence == 1).all()
        assert found.rgb.shape == (96, 128, 3)


def test_a_submodel_of_one_image_or_without_points_gets_empty_maps(shots: list[Shot]) -> None:
    for found in [*reconstruct(shots[:1], sparse_points(shots[:1])), *reconstruct(shots, no_points())]:
        assert (found.depth == 0).all()
        assert (found.confidence == 1).all()


def test_an_image_without_sparse_points_borrows_those_of_the_submodel(shots: list[Shot]) -> None:
    tracks = sparse_points(shots)
    others = tracks.image_of_observation != 2
    fewer = replace(
        tracks,
        point_of_observation=tracks.point_of_observation[others],
        image_of_observation=tracks.image_of_observation[others],
        feature_of_observation=tracks.feature_of_observation[others],
    )
    found = reconstruct(shots, fewer)[2]
    error = relative_error(found, shots[2].depth, 2.0)
    assert error.size > 0.6 * found.depth.size
    assert 1e-5 < np.median(error) < 0.005


def test_grey_images_give_the_same_depth_as_colour(shots: list[Shot]) -> None:
    grey = [replace(shot, rgb=np.ascontiguousarray(shot.rgb[..., 0])) for shot in shots[:3]]
    tracks = sparse_points(shots[:3])
    for one, other in zip(reconstruct(shots[:3], tracks), reconstruct(grey, tracks), strict=True):
        assert np.array_equal(one.depth, other.depth)
        assert np.array_equal(one.rgb, other.rgb)


def test_an_image_of_the_wrong_size_is_named(shots: list[Shot]) -> None:
    wrong = [shots[0], replace(shots[1], rgb=shots[1].rgb[:90])]
    with pytest.raises(ImageError, match="image 1: 128x90 pixels, its camera is for 128x96"):
        reconstruct(wrong, sparse_points(shots[:2]))


# ---------------------------------------------------------------------- view selection
def cameras_at(*centres_seg: tuple[float, float, float]) -> list[PinholeCamera]:
    return [
        PinholeCamera(
            img_from_cam=np.array([[120.0, 0, 64], [0, 120, 48], [0, 0, 1]]),
            cam_from_seg=np.column_stack([np.eye(3), -np.asarray(centre)]),
            width=128,
            height=96,
        )
        for centre in centres_seg
    ]


WALL_POINTS = np.column_stack([*(np.random.default_rng(0).uniform(-0.8, 0.8, (2, 300))), np.full(300, 4.0)])


def test_neighbours_are_chosen_near_four_degrees_and_never_without_parallax() -> None:
    """Parallax of 0.3, 1, 4, 15 degrees, and one camera that sees something else."""
    cameras = cameras_at((0, 0, 0), (0.02, 0, 0), (0.07, 0, 0), (0.28, 0, 0), (1.05, 0, 0), (9, 0, 0))
    assert choose_neighbours(0, cameras, WALL_POINTS, count=8) == (3, 4, 2)
    assert choose_neighbours(0, cameras, WALL_POINTS, count=1) == (3,)
    assert choose_neighbours(0, cameras, np.zeros((0, 3)), count=8) == ()


def test_the_second_neighbour_lies_on_the_other_side() -> None:
    cameras = cameras_at((0, 0, 0), (0.28, 0, 0), (0.3, 0, 0), (-0.4, 0, 0))
    assert choose_neighbours(0, cameras, WALL_POINTS, count=3) == (1, 3, 2)


def test_the_range_encloses_the_points_in_view_and_ignores_a_stray() -> None:
    (camera,) = cameras_at((0, 0, 0))
    depths = np.linspace(2.0, 6.0, 200)
    points = np.column_stack([np.zeros((200, 2)), depths])
    strays = np.array([[0, 0, 500.0], [0, 0, 0.01], [50.0, 0, 3], [0, 0, -4.0]])
    depth_range = inverse_depth_range(camera, np.concatenate([points, strays]))
    assert depth_range is not None
    far, near = depth_range
    assert 1 / 9.0 < far < 1 / 6.0
    assert 1 / 2.0 < near < 1 / 1.2
    assert inverse_depth_range(camera, strays[2:]) is None
