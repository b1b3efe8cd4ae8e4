"""Cameras from pointmaps: as published, and better than published where the pointmaps are worse than hoped."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import numpy.typing as npt
import pytest
import torch
from helpers.reference_vectors import needs_vectors, vectors

from smust3r_colmap.backbones.must3r.cameras import (
    FittedCamera,
    NoCamera,
    estimate_focal,
    fit_cameras,
    register_camera,
    sight,
)
from smust3r_colmap.backbones.must3r.full_image import LARGEST_CONFIDENCE, full_size, to_full_image
from smust3r_colmap.backbones.must3r.head import Pointmaps
from smust3r_colmap.backbones.must3r.pose_refinement import refine_pose
from smust3r_colmap.backbones.must3r.preprocessing import NetworkWindow, choose_window
from smust3r_colmap.config import CameraFit
from smust3r_colmap.errors import DegenerateAlignmentError
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.camera import Intrinsics, pixel_centres
from smust3r_colmap.geometry.se3 import SE3
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.geometry.so3 import angles_between
from smust3r_colmap.synthetic.distortion import confidence_of, smooth_basis
from smust3r_colmap.synthetic.truth import TrueScene

CAMERA_FITS: tuple[CameraFit, ...] = ("upstream", "robust", "pnp")


# ------------------------------------------------------------------------------- vectors
@needs_vectors
@pytest.mark.parametrize("case", range(3))
def test_focals_are_the_published_ones(case: int) -> None:
    stored = vectors("postprocess.npz")
    points_cam = stored[f"c{case}_pts3d_local"][0]
    assert estimate_focal(points_cam) == pytest.approx(float(stored[f"c{case}_focal"][0]), rel=2e-6)
    in_float64 = estimate_focal(torch.from_numpy(points_cam), dtype=np.float64)
    assert in_float64 == pytest.approx(float(stored[f"c{case}_slam_focal"][0]), rel=2e-6)


@needs_vectors
@pytest.mark.parametrize("case", range(3))
def test_poses_are_the_published_ones(case: int) -> None:
    stored = vectors("postprocess.npz")
    cam, world, conf = (stored[f"c{case}_{name}"][0] for name in ("pts3d_local", "pts3d", "conf"))
    pose = register_camera(cam, torch.from_numpy(world), conf)
    np.testing.assert_allclose(pose, stored[f"c{case}_c2w"][0], atol=2e-5)
    np.testing.assert_allclose(pose, stored[f"c{case}_slam_nofocal_c2w"][0], atol=2e-5)
    # The video route brings the depth to the focal length of the sequence before (section 12).
    factor = 1.1 * float(stored[f"c{case}_true_focal"]) / estimate_focal(cam, dtype=np.float64)
    scaled = register_camera(cam * np.array([1, 1, factor], np.float32), world, conf)
    np.testing.assert_allclose(scaled, stored[f"c{case}_slam_seqfocal110_c2w"][0], atol=2e-5)


@needs_vectors
def test_published_focals_of_random_pointmaps_are_met_too() -> None:
    stored = vectors("decoder_causal.npz")
    for k in range(4):
        focal = estimate_focal(stored["render_pts3d_local"][k])
        assert focal == pytest.approx(float(stored["render_focal"][k]), rel=1e-4)
        pose = register_camera(*(stored[f"render_{name}"][k] for name in ("pts3d_local", "pts3d", "conf")))
        np.testing.assert_allclose(pose, stored["render_c2w"][k], atol=1e-4)


def test_focal_of_points_behind_the_camera_is_zero_and_of_no_points_undefined() -> None:
    x, y = np.meshgrid(np.arange(64) - 32.0, np.arange(48) - 24.0)
    behind = np.dstack([x / 50, y / 50, np.full_like(x, -1.0)])
    assert estimate_focal(behind) == 0.0
    assert np.isnan(estimate_focal(np.zeros((48, 64, 3))))


def test_registration_refuses_a_point_that_is_not_finite_and_weights_of_zero() -> None:
    points = np.random.default_rng(0).normal(size=(4, 4, 3))
    broken = points.copy()
    broken[1, 2, 0] = np.nan
    with pytest.raises(DegenerateAlignmentError, match="1 of 16 pixels are not finite"):
        register_camera(broken, points, np.full((4, 4), 2.0))
    with pytest.raises(DegenerateAlignmentError, match="weights add up to 0"):
        register_camera(points, points, np.ones((4, 4)))


def test_pointmaps_of_many_images_and_of_different_shapes_are_refused() -> None:
    points = np.ones((4, 6, 3))
    with pytest.raises(ValueError, match=r"points \(1, 4, 6, 3\); \(H, W, 3\) of one image"):
        estimate_focal(points[None])
    for cam, world, confidence in (
        (points[None], points[None], np.ones((1, 4, 6))),
        (points[:2], points, np.ones((4, 6))),
        (points, points, np.ones((6, 4))),
    ):
        with pytest.raises(ValueError, match=r"\(H, W\) of one image are needed"):
            register_camera(cam, world, confidence)


# --------------------------------------------------------------------- simulated network
NET = (96, 128)
ORIGINAL = (600, 800)
IMAGES = (0, 3, 6, 9, 12)


@dataclass(frozen=True, kw_only=True)
class Errors:
    """What is wrong with the simulated pointmaps.

    Args:
        noise: of each coordinate of a point, relative to depth.
        bend: smooth error of the depth alone, so that the rays bend as well.
        outliers, outlier_confidence: share of the pixels in patches that are wrong in both maps.
        broken: share in patches where a point is NaN, another infinite.
        behind: share in patches whose points lie behind the camera.
    """

    noise: float = 0.0
    bend: float = 0.0
    outliers: float = 0.0
    outlier_confidence: float = 10.0
    broken: float = 0.0
    behind: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Rig:
    """Images of the demo room with true poses in the frame of the first."""

    depths: tuple[FloatArray, ...]
    seg_from_cam: FloatArray
    intrinsics: Intrinsics
    typical_depth: float


@cache
def rig() -> Rig:
    truth = TrueScene.from_demo(60, *NET)
    cameras = np.array([truth.world_from_cam[k] for k in IMAGES])
    first = invert_rigid(cameras[0])
    seg_from_cam = np.array([SE3.from_matrix(first).compose(SE3.from_matrix(one)).matrix[:3] for one in cameras])
    depths = tuple(truth.depth(k).astype(np.float64) for k in IMAGES)
    return Rig(
        depths=depths,
        seg_from_cam=seg_from_cam,
        intrinsics=truth.intrinsics.resized(ORIGINAL[1], ORIGINAL[0]),
        typical_depth=float(np.median(depths)),
    )


def window() -> NetworkWindow:
    made = choose_window(ORIGINAL[1], ORIGINAL[0], [(NET[1], NET[0])])
    assert (made.crop_width, made.crop_height) == (800, 600)
    return made


def guess() -> Intrinsics:
    """What an importer says of a camera that nobody knows."""
    return Intrinsics(model="SIMPLE_RADIAL", width=800, height=600, params=(960, 400, 300, 0))


def patches(share: float, side: int, rng: np.random.Generator) -> npt.NDArray[np.bool_]:
    grid = rng.random((NET[0] // side + 1, NET[1] // side + 1)) < share
    return np.kron(grid, np.ones((side, side), dtype=bool))[: NET[0], : NET[1]]


def simulated(k: int, errors: Errors, rng: np.random.Generator) -> Pointmaps:
    """What a network with such errors would say of image k of the rig."""
    depth, pose = rig().depths[k], rig().seg_from_cam[k]
    rays = rig().intrinsics.resized(NET[1], NET[0]).rays_cam(pixel_centres(NET[1], NET[0])).reshape(*NET, 3)
    maps, known = [], np.full(NET, errors.noise**2)
    wrong = patches(errors.outliers, 8, rng)
    for _ in range(2):  # the camera's and the segment's
        bend = np.tensordot(rng.normal(size=9) / 3, smooth_basis(*NET), axes=1) * errors.bend
        points = rays * depth[..., None]
        points[..., 2] *= np.exp(bend)
        points += errors.noise * depth[..., None] * rng.normal(size=points.shape)
        points[wrong] *= rng.uniform([0.5, 0.5, 1.3], [1.0, 1.0, 2.0], size=(int(wrong.sum()), 3))
        points[wrong] += 0.2 * rig().typical_depth * rng.normal(size=3)
        maps.append(points)
        known += bend**2
    local, world = maps[0], maps[1] @ pose[:, :3].T + pose[:, 3]
    local[patches(errors.behind, 8, rng)] *= -1
    local[patches(errors.broken, 4, rng)] = np.nan
    world[patches(errors.broken, 4, rng)] = np.inf
    confidence = confidence_of(np.sqrt(known), 0.2, rng)
    confidence[wrong] = errors.outlier_confidence
    confidence[depth <= 0] = 1.0
    as_tensor = [torch.from_numpy(values.astype(np.float32)) for values in (world, local, confidence)]
    return Pointmaps(points_world=as_tensor[0], points_cam=as_tensor[1], confidence=as_tensor[2])


@cache
def segment(errors: Errors, seed: int) -> tuple[Pointmaps, ...]:
    """All images of the rig."""
    rng = np.random.default_rng(seed)
    return tuple(simulated(k, errors, rng) for k in range(len(IMAGES)))


@dataclass(frozen=True, kw_only=True)
class Score:
    """Means over the images: focal length in percent, rotation in degrees, centre in percent of the typical depth."""

    focal: float
    rotation: float
    centre: float
    missing: int


def score(camera_fit: CameraFit, errors: Errors, seeds: Sequence[int] = (0, 1)) -> Score:
    rows: list[tuple[float, float, float]] = []
    missing = 0
    for seed in seeds:
        seen = [sight(one, window(), camera_fit=camera_fit) for one in segment(errors, seed)]
        fitted = fit_cameras(seen, [0] * len(seen), [guess()], camera_fit=camera_fit)
        for camera, true_pose in zip(fitted, rig().seg_from_cam, strict=True):
            if isinstance(camera, NoCamera):
                missing += 1
                continue
            rows.append(
                (
                    100 * abs(camera.intrinsics.focal_px / rig().intrinsics.focal_px - 1),
                    float(np.rad2deg(angles_between(camera.seg_from_cam[:, :3], true_pose[:, :3]))),
                    100 * float(np.linalg.norm(camera.seg_from_cam[:, 3] - true_pose[:, 3])) / rig().typical_depth,
                )
            )
    focal, rotation, centre = np.mean(rows, axis=0) if rows else (np.nan, np.nan, np.nan)
    return Score(focal=float(focal), rotation=float(rotation), centre=float(centre), missing=missing)


# ------------------------------------------------------------------- one against another
@pytest.mark.slow
@pytest.mark.parametrize("camera_fit", CAMERA_FITS)
def test_perfect_pointmaps_give_the_true_cameras(camera_fit: CameraFit) -> None:
    found = score(camera_fit, Errors(), seeds=[0])
    assert found.missing == 0
    # Whole-number pixels about W/2 and centres at +0.5 about W/2 differ by half a pixel of 128: the published
    # focal length does not mind on the average.
    assert found.focal < (0.01 if camera_fit == "upstream" else 0.001)
    assert found.rotation < 0.001
    assert found.centre < 0.01


@pytest.mark.slow
def test_robust_is_twice_as_good_as_upstream_where_depth_bends_and_no_pixel_lies() -> None:
    plain = Errors(noise=0.005, bend=0.02)
    upstream, robust, pnp = (score(fit, plain) for fit in CAMERA_FITS)
    assert 1.0 < upstream.centre < 5.0  # the task is a task
    for found in (robust, pnp):
        assert found.focal < 0.5 * upstream.focal
        assert found.rotation < 0.5 * upstream.rotation
        assert found.centre < 0.5 * upstream.centre


@pytest.mark.slow
def test_robust_is_as_good_as_upstream_where_all_is_noise() -> None:
    upstream, robust, _ = (score(fit, Errors(noise=0.01)) for fit in CAMERA_FITS)
    assert 0.005 < upstream.rotation < 0.2
    # A quarter of the pixels alone would make it twice as uncertain.
    assert robust.rotation < 2 * upstream.rotation
    assert robust.centre < 2.5 * upstream.centre
    assert robust.focal < 1.2 * upstream.focal + 0.02


@pytest.mark.slow
def test_wrong_pixels_of_high_confidence_spoil_upstream_and_not_robust() -> None:
    lying = Errors(noise=0.005, outliers=0.2, outlier_confidence=10.0)
    upstream, robust, pnp = (score(fit, lying) for fit in CAMERA_FITS)
    assert upstream.rotation > 3.0
    assert upstream.centre > 5.0
    for found, most in ((robust, 0.1), (pnp, 0.2)):
        assert found.focal < 0.06
        assert found.rotation < most
        assert found.centre < 2 * most


@pytest.mark.slow
def test_wrong_pixels_of_low_confidence_spoil_upstream_a_little_and_robust_not_at_all() -> None:
    honest = Errors(noise=0.005, outliers=0.3, outlier_confidence=1.05)
    upstream, robust, _ = (score(fit, honest) for fit in CAMERA_FITS)
    assert upstream.focal > 0.25
    assert upstream.rotation > 0.2
    assert robust.focal < 0.06
    assert robust.rotation < 0.1
    assert robust.centre < 0.2


@pytest.mark.slow
def test_robust_survives_two_wrong_pixels_in_five_whatever_their_confidence() -> None:
    for confidence in (10.0, 1.02):
        robust = score("robust", Errors(noise=0.005, bend=0.01, outliers=0.4, outlier_confidence=confidence))
        assert robust.missing == 0
        assert robust.focal < 0.2
        assert robust.rotation < 0.5
        assert robust.centre < 1.0


@pytest.mark.parametrize("camera_fit", ["robust", "pnp"])
def test_a_sky_that_the_network_is_not_sure_of_has_no_say(camera_fit: CameraFit) -> None:
    pose = some_poses(1)[0]
    maps = plane_maps(guess(), window(), pose)
    sky = slice(0, int(0.45 * NET[0]))
    maps.points_cam[sky, :, :2] *= 1.15
    maps.points_world[sky] += torch.tensor([1.0, 0.5, 2.0])
    maps.confidence[sky] = 1.02
    (found,) = fitted_cameras(
        fit_cameras([sight(maps, window(), camera_fit=camera_fit)], [0], [guess()], camera_fit=camera_fit)
    )
    assert found.intrinsics.focal_px == pytest.approx(960, rel=1e-4)
    np.testing.assert_allclose(found.seg_from_cam, pose, atol=1e-3)
    assert found.inlier_share == 1.0


@pytest.mark.slow
def test_broken_pixels_leave_upstream_without_pose_and_robust_as_it_was() -> None:
    broken = Errors(noise=0.005, broken=0.1, behind=0.1)
    upstream, robust, pnp = (score(fit, broken) for fit in CAMERA_FITS)
    assert upstream.missing == 2 * len(IMAGES)
    for found, most in ((robust, 0.1), (pnp, 0.2)):
        assert found.missing == 0
        assert found.rotation < most
        assert found.centre < 2 * most


# ------------------------------------------------------------------------------- cameras
def plane_maps(
    intrinsics: Intrinsics, seen: NetworkWindow, seg_from_cam: FloatArray, *, wide: float = 1.0
) -> Pointmaps:
    """Exact pointmaps of a wavy wall seen by a camera; ``wide`` makes the network believe in wider rays."""
    centres = pixel_centres(seen.width, seen.height)
    to_orig = seen.orig_from_net
    rays = intrinsics.rays_cam(centres @ to_orig[:2, :2].T + to_orig[:2, 2])
    depth = 3 + 0.5 * np.sin(5 * rays[:, 0]) + 0.4 * np.cos(7 * rays[:, 1]) + rays[:, 0]
    points_cam = rays * depth[:, None]
    points_seg = points_cam @ seg_from_cam[:, :3].T + seg_from_cam[:, 3]
    points_cam[:, 2] /= wide  # sizes across the view are kept, as for a network that knows how large things are
    shape = (seen.height, seen.width)
    return Pointmaps(
        points_world=torch.from_numpy(points_seg.reshape(*shape, 3)).float(),
        points_cam=torch.from_numpy(points_cam.reshape(*shape, 3)).float(),
        confidence=torch.full(shape, 5.0),
    )


def some_poses(count: int) -> FloatArray:
    tangents = np.random.default_rng(5).normal(size=(count, 6)) * [1, 1, 1, 0.3, 0.3, 0.3]
    return SE3.exp(tangents).matrix[:, :3]


def fitted_cameras(found: Sequence[FittedCamera | NoCamera]) -> list[FittedCamera]:
    cameras = [one for one in found if isinstance(one, FittedCamera)]
    assert len(cameras) == len(found), found
    return cameras


@pytest.mark.parametrize("camera_fit", ["robust", "pnp"])
def test_each_physical_camera_gets_one_focal_length_in_original_pixels_whatever_its_crop(camera_fit: CameraFit) -> None:
    tall = Intrinsics(model="SIMPLE_PINHOLE", width=307, height=411, params=(350, 153.5, 205.5))
    broad = Intrinsics(model="PINHOLE", width=1001, height=400, params=(700, 700, 500.5, 200))
    priors = [replace(tall, params=(500, 153.5, 205.5)), replace(broad, params=(1200, 1200, 500.5, 200))]
    poses = some_poses(4)
    owners = [0, 1, 0, 1]
    seen = []
    for owner, pose in zip(owners, poses, strict=True):
        camera = (tall, broad)[owner]
        crop = choose_window(camera.width, camera.height, [(128, 96), (128, 64)])
        seen.append(sight(plane_maps(camera, crop, pose), crop, camera_fit=camera_fit))
    found = fitted_cameras(fit_cameras(seen, owners, priors, camera_fit=camera_fit))
    for one, owner, pose in zip(found, owners, poses, strict=True):
        np.testing.assert_allclose(one.intrinsics.params, (tall, broad)[owner].params, rtol=1e-5)
        np.testing.assert_allclose(one.seg_from_cam, pose, atol=1e-4)
        assert one.depth_factor == 1.0
        assert one.inlier_share == 1.0
        assert one.relative_residual < 1e-4
        assert one.median_confidence == 5.0


@pytest.mark.parametrize("camera_fit", ["robust", "pnp"])
def test_calibration_is_kept_and_used_with_its_distortion_and_principal_point(camera_fit: CameraFit) -> None:
    known = Intrinsics(
        model="OPENCV",
        width=800,
        height=600,
        params=(620, 630, 430, 280, -0.12, 0.03, 0.001, -0.002),
        has_prior_focal=True,
    )
    poses = some_poses(3)
    seen = [sight(plane_maps(known, window(), pose), window(), camera_fit=camera_fit) for pose in poses]
    found = fitted_cameras(fit_cameras(seen, [0] * 3, [known], camera_fit=camera_fit, calibrated=True))
    for one, pose in zip(found, poses, strict=True):
        assert one.intrinsics == known
        assert one.depth_factor == pytest.approx(1.0, abs=1e-6)
        np.testing.assert_allclose(one.seg_from_cam, pose, atol=1e-4)


@pytest.mark.parametrize("camera_fit", CAMERA_FITS)
def test_depth_of_a_network_that_sees_too_wide_is_brought_to_the_calibration(camera_fit: CameraFit) -> None:
    known = Intrinsics(model="SIMPLE_PINHOLE", width=800, height=600, params=(640, 400, 300), has_prior_focal=True)
    poses = some_poses(3)
    maps = [plane_maps(known, window(), pose, wide=1.1) for pose in poses]
    seen = [sight(one, window(), camera_fit=camera_fit) for one in maps]
    found = fitted_cameras(fit_cameras(seen, [0] * 3, [known], camera_fit=camera_fit, calibrated=True))
    for one, pose in zip(found, poses, strict=True):
        assert one.intrinsics == known
        assert one.depth_factor == pytest.approx(1.1, rel=1e-3)
        if camera_fit != "upstream":  # which knows nothing of calibrations
            np.testing.assert_allclose(one.seg_from_cam, pose, atol=1e-3)


def test_upstream_gives_every_image_its_own_focal_length() -> None:
    camera = Intrinsics(model="SIMPLE_PINHOLE", width=800, height=600, params=(640, 400, 300))
    poses = some_poses(2)
    maps = [plane_maps(camera, window(), pose, wide=wide) for pose, wide in zip(poses, (1.0, 1.1), strict=True)]
    seen = [sight(one, window(), camera_fit="upstream") for one in maps]
    first, second = fitted_cameras(fit_cameras(seen, [0, 0], [guess()], camera_fit="upstream"))
    assert first.intrinsics.focal_px == pytest.approx(640, rel=2e-3)
    assert second.intrinsics.focal_px == pytest.approx(640 / 1.1, rel=2e-3)
    assert (first.depth_factor, second.depth_factor) == (1.0, 1.0)


@pytest.mark.slow
@pytest.mark.parametrize("camera_fit", CAMERA_FITS)
def test_cameras_do_not_depend_on_unit_or_place_of_the_segment(camera_fit: CameraFit) -> None:
    rng = np.random.default_rng(3)
    one = simulated(1, Errors(noise=0.005, bend=0.01, outliers=0.1), rng)
    move = SE3.exp(np.array([2.0, -1.0, 3.0, 0.5, -0.7, 0.2]))
    world = move.apply(one.points_world.numpy().reshape(-1, 3).astype(np.float64)).reshape(*NET, 3)
    other = Pointmaps(
        points_world=torch.from_numpy(1000 * world).float(), points_cam=1000 * one.points_cam, confidence=one.confidence
    )
    seen = [sight(maps, window(), camera_fit=camera_fit) for maps in (one, other)]
    first, second = fitted_cameras(fit_cameras(seen, [0, 0], [guess()], camera_fit=camera_fit))
    expected = move.compose(SE3.from_matrix(first.seg_from_cam)).matrix[:3]
    np.testing.assert_allclose(second.seg_from_cam[:, :3], expected[:, :3], atol=2e-3)
    np.testing.assert_allclose(second.seg_from_cam[:, 3] / 1000, expected[:, 3], atol=5e-3)


def test_a_sighting_keeps_few_pixels_of_a_large_image() -> None:
    shape = (384, 512)
    large = choose_window(2048, 1536, [(512, 384)])
    maps = Pointmaps(
        points_world=torch.ones(*shape, 3), points_cam=torch.ones(*shape, 3), confidence=torch.full(shape, 2.0)
    )
    seen = sight(maps, large)
    assert 1500 < len(seen.confidence) == seen.num_pixels < 2600
    centre = seen.xy_img.mean(axis=0)
    np.testing.assert_allclose(centre, [1024, 768], atol=12)  # the grid is centred up to half its step


# ------------------------------------------------------------------------- no usable camera
def broken_maps(change: Callable[[FloatArray, FloatArray, FloatArray], None]) -> Pointmaps:
    good = plane_maps(guess(), window(), some_poses(1)[0])
    world, cam, confidence = (
        one.numpy().astype(np.float64) for one in (good.points_world, good.points_cam, good.confidence)
    )
    change(world, cam, confidence)
    tensors = [torch.from_numpy(one).float() for one in (world, cam, confidence)]
    return Pointmaps(points_world=tensors[0], points_cam=tensors[1], confidence=tensors[2])


def all_nan(world: FloatArray, cam: FloatArray, confidence: FloatArray) -> None:
    world[:] = cam[:] = confidence[:] = np.nan


def all_infinite(world: FloatArray, cam: FloatArray, confidence: FloatArray) -> None:
    world[:] = cam[:] = confidence[:] = np.inf


def behind(world: FloatArray, cam: FloatArray, confidence: FloatArray) -> None:
    cam[..., 2] *= -1


def mirrored(world: FloatArray, cam: FloatArray, confidence: FloatArray) -> None:
    cam[..., :2] *= -1  # the focal length comes out negative


def without_width(world: FloatArray, cam: FloatArray, confidence: FloatArray) -> None:
    cam[..., :2] = 0


def hair_thin(world: FloatArray, cam: FloatArray, confidence: FloatArray) -> None:
    cam[..., :2] *= 1e-6


def unsure(world: FloatArray, cam: FloatArray, confidence: FloatArray) -> None:
    confidence[:] = 1.0


def few(world: FloatArray, cam: FloatArray, confidence: FloatArray) -> None:
    cam[8:] = np.nan
    cam[:, 4:] = np.nan


def one_point(world: FloatArray, cam: FloatArray, confidence: FloatArray) -> None:
    world[:] = [1, 2, 3]


def line(world: FloatArray, cam: FloatArray, confidence: FloatArray) -> None:
    world[:] = np.linspace(0, 1, world.shape[0] * world.shape[1]).reshape(*world.shape[:2], 1)


Damage = Callable[[FloatArray, FloatArray, FloatArray], None]
BROKEN: dict[Damage, str] = {
    all_nan: "0 of [0-9]+ pixels",
    all_infinite: "0 of [0-9]+ pixels",
    behind: "0 of [0-9]+ pixels",
    mirrored: "focal length 0 px|times as wide",
    without_width: "focal length (0|nan) px|times as wide",
    hair_thin: "focal length .* plausible|times as wide",
    unsure: "0 of [0-9]+ pixels",
    few: "pixels are finite, in front of the camera and confident; 50 are needed",
    one_point: "3 of [0-9]+ point pairs|0 of 2000 pixels agree on a pose",
    line: "3 of [0-9]+ point pairs|0 of 2000 pixels agree on a pose",
}


@pytest.mark.slow
@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("camera_fit", CAMERA_FITS)
@pytest.mark.parametrize("alone", [True, False])
@pytest.mark.parametrize("change", BROKEN, ids=lambda change: change.__name__)
def test_bad_geometry_gives_a_reason_and_leaves_the_other_images_alone(
    change: Damage, alone: bool, camera_fit: CameraFit
) -> None:
    poses = some_poses(2)
    maps = [broken_maps(change)] + ([] if alone else [plane_maps(guess(), window(), pose) for pose in poses])
    seen = [sight(one, window(), camera_fit=camera_fit) for one in maps]
    bad, *good = fit_cameras(seen, [0] * len(seen), [guess()], camera_fit=camera_fit)
    if camera_fit == "upstream" and isinstance(bad, FittedCamera):
        # A pose from flat points is arbitrary; the evidence tells.
        assert np.isfinite(bad.seg_from_cam).all()
        assert bad.inlier_share < 0.2
    else:
        assert isinstance(bad, NoCamera)
        assert bad.reason
        if camera_fit != "upstream":
            assert re.search(BROKEN[change], bad.reason), bad.reason
    for camera, pose in zip(fitted_cameras(good), poses, strict=False):
        np.testing.assert_allclose(camera.seg_from_cam, pose, atol=1e-3)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("camera_fit", CAMERA_FITS)
@pytest.mark.parametrize("size", [1e-3, 1.0, 1e4, 1e30])
def test_noise_of_any_size_ends_in_finite_cameras_or_reasons(camera_fit: CameraFit, size: float) -> None:
    rng = np.random.default_rng(0)
    maps = [
        Pointmaps(
            points_world=torch.from_numpy(size * rng.normal(size=(*NET, 3))).float(),
            points_cam=torch.from_numpy(size * rng.normal([0, 0, 1], 1, size=(*NET, 3))).float(),
            confidence=torch.from_numpy(1 + np.exp(rng.normal(size=NET))).float(),
        )
        for _ in range(3)
    ]
    seen = [sight(one, window(), camera_fit=camera_fit) for one in maps]
    for one in fit_cameras(seen, [0] * 3, [guess()], camera_fit=camera_fit):
        if isinstance(one, FittedCamera):
            assert np.isfinite(one.seg_from_cam).all()
            assert one.inlier_share < 0.2
            assert one.relative_residual > 0.1
        else:
            assert one.reason


def test_one_image_of_another_focal_length_does_not_move_the_cameras_of_the_rest() -> None:
    poses = some_poses(4)
    maps = [plane_maps(guess(), window(), pose, wide=wide) for pose, wide in zip(poses, (1, 1, 1, 3), strict=True)]
    found = fit_cameras([sight(one, window()) for one in maps], [0] * 4, [guess()])
    assert [isinstance(one, FittedCamera) for one in found] == [True, True, True, False]
    assert isinstance(found[3], NoCamera)
    assert "3 times as wide" in found[3].reason
    assert isinstance(found[0], FittedCamera)
    assert found[0].intrinsics.focal_px == pytest.approx(960, rel=1e-4)


def test_misuse_is_refused() -> None:
    seen = [sight(plane_maps(guess(), window(), some_poses(1)[0]), window())]
    with pytest.raises(ValueError, match="made for another camera fit"):
        fit_cameras(seen, [0], [guess()], camera_fit="upstream")
    with pytest.raises(ValueError, match="1 sightings, cameras of 2"):
        fit_cameras(seen, [0, 0], [guess()])


# --------------------------------------------------------------------------- the refinement
def test_refinement_comes_back_from_a_rough_start_to_rounding() -> None:
    rng = np.random.default_rng(1)
    rays = np.column_stack([rng.uniform(-0.6, 0.6, size=(300, 2)), np.ones(300)])
    depths = rng.uniform(1, 5, size=300)
    truth = SE3.exp(np.array([0.3, -0.2, 0.5, 0.2, 0.1, -0.3]))
    points_seg = truth.inverse().apply(rays * depths[:, None])
    for _ in range(5):
        start = SE3.exp(0.1 * rng.normal(size=6)) @ truth
        found = refine_pose(rays, depths, points_seg, np.ones(300), start)
        np.testing.assert_allclose(found.matrix, truth.matrix, atol=1e-7)


def test_refinement_stays_with_the_majority_when_a_confident_part_of_the_image_moves_by_itself() -> None:
    rng = np.random.default_rng(4)
    rays = np.column_stack([rng.uniform(-0.6, 0.6, size=(1000, 2)), np.ones(1000)])
    depths = rng.uniform(1, 5, size=1000)
    points_seg = (rays + 0.002 * rng.normal(size=rays.shape)) * depths[:, None]
    moving = rays[:, 0] > 0.15
    assert 0.35 < moving.mean() < 0.4
    points_seg[moving] += [0.3, 0.1, 0.2]
    found = refine_pose(rays, depths, points_seg, np.where(moving, 9.0, 3.0), SE3.identity())
    np.testing.assert_allclose(found.matrix, np.eye(4), atol=0.003)


def test_refinement_trusts_depth_as_far_as_it_scatters() -> None:
    rng = np.random.default_rng(2)
    rays = np.column_stack([rng.uniform(-0.6, 0.6, size=(2000, 2)), np.ones(2000)])
    true_depths = rng.uniform(1, 5, size=2000)
    truth = SE3.identity()
    # Depth is 4 % off all over; the rays know better.
    noisy = 1.04 * true_depths * np.exp(0.02 * rng.normal(size=2000))
    points_seg = rays * true_depths[:, None]
    points_seg[:, :2] += 0.001 * true_depths[:, None] * rng.normal(size=(2000, 2))
    found = refine_pose(rays, noisy, points_seg, np.ones(2000), truth)
    assert 0 < np.linalg.norm(found.translation) < 0.01  # a registration of the points would be off by 0.1


def test_refinement_uses_depth_where_perspective_tells_little() -> None:
    rng = np.random.default_rng(3)
    rays = np.column_stack([rng.uniform(-0.1, 0.1, size=(2000, 2)), np.ones(2000)])
    true_depths = rng.uniform(9.9, 10.1, size=2000)  # a far wall through a long lens
    points_seg = rays * true_depths[:, None]
    points_seg[:, :2] += 0.003 * 10 * rng.normal(size=(2000, 2))
    noisy = true_depths * np.exp(0.01 * rng.normal(size=2000))
    found = refine_pose(rays, noisy, points_seg, np.ones(2000), SE3.identity())
    assert abs(found.translation[2]) < 0.015  # the rays alone leave 0.02 to 0.04


def test_refinement_refuses_points_behind_and_points_that_leave_it_free() -> None:
    rays = np.column_stack([np.linspace(-0.5, 0.5, 60), np.zeros(60), np.ones(60)])
    depths = np.full(60, 2.0)
    with pytest.raises(DegenerateAlignmentError, match="0 of 60 points lie in front"):
        refine_pose(rays, depths, -2 * rays, np.ones(60), SE3.identity())
    same = np.tile([0.0, 0.0, 1.0], (60, 1))
    with pytest.raises(DegenerateAlignmentError, match="60 points leave a motion"):
        refine_pose(same, depths, 2 * same, np.ones(60), SE3.identity())


# -------------------------------------------------------------------------- the full image
@pytest.mark.parametrize(("height", "width"), [(600, 800), (187, 250), (411, 307), (100, 371), (90, 61)])
def test_slanted_plane_is_right_at_every_pixel_of_the_full_image(height: int, width: int) -> None:
    seen = choose_window(width, height, [(128, 96), (128, 64)])
    focal = 0.9 * max(height, width)

    def depth_at(xy_img: FloatArray) -> FloatArray:
        rays = (xy_img - [width / 2, height / 2]) / focal
        return np.asarray(2 / (1 - 0.6 * rays[:, 0] + 0.5 * rays[:, 1]))  # z of the plane n . p = 2

    to_orig = seen.orig_from_net
    xy_seen = pixel_centres(seen.width, seen.height) @ to_orig[:2, :2].T + to_orig[:2, 2]
    depth_net = depth_at(xy_seen).reshape(seen.height, seen.width)
    whole = to_full_image(depth_net, np.full(depth_net.shape, 3.0), seen)

    rows, columns = full_size(seen)
    assert whole.depth.shape == whole.confidence.shape == (rows, columns)
    xy_orig = pixel_centres(columns, rows) * [width / columns, height / rows]
    inside = (xy_orig >= [seen.left, seen.top]) & (
        xy_orig <= [seen.left + seen.crop_width, seen.top + seen.crop_height]
    )
    expected = np.where(inside.all(axis=1), depth_at(xy_orig), 0).reshape(rows, columns)
    np.testing.assert_array_equal(whole.depth > 0, expected > 0)
    np.testing.assert_allclose(whole.depth, expected, rtol=1e-6)
    np.testing.assert_array_equal(whole.confidence, np.where(expected > 0, 3.0, 1.0))


def test_map_pixels_are_as_large_as_network_pixels() -> None:
    seen = choose_window(2000, 1000, [(128, 96)])
    assert full_size(seen) == (96, 192)
    whole = to_full_image(np.ones((96, 128)), np.full((96, 128), 2.0), seen)
    assert (whole.depth[:, :31] == 0).all()
    assert (whole.depth[:, 33:-33] == 1).all()


def test_no_point_flies_between_two_surfaces() -> None:
    seen = choose_window(330, 229, [(128, 96)])
    depth = np.where(np.arange(128) < 61, 2.0, 4.0) + 0.1 * np.linspace(0, 1, 96)[:, None]
    depth[40:60, 30:50] = 0.0
    depth[10, 10] = np.nan
    whole = to_full_image(depth, np.full(depth.shape, 2.0), seen)
    in_between = (whole.depth > 0.01) & (np.abs(whole.depth - 2.05) > 0.06) & (np.abs(whole.depth - 4.05) > 0.06)
    assert not in_between.any()
    assert 300 < (whole.depth[30:70, 25:65] == 0).sum() < 500  # the hole of 20 x 20 keeps its size
    np.testing.assert_array_equal(whole.confidence == 1, whole.depth == 0)


def test_confidence_stays_storable_and_at_least_one() -> None:
    seen = choose_window(128, 96, [(128, 96)])
    confidence = np.full((96, 128), 2.0)
    confidence[0, :3] = [np.inf, 0.5, np.nan]
    whole = to_full_image(np.ones((96, 128)), confidence, seen)
    np.testing.assert_array_equal(whole.confidence[0, :3], np.array([LARGEST_CONFIDENCE, 1, 1], np.float32))
    assert whole.depth[0, 2] == 0
    assert np.isfinite(whole.confidence.astype(np.float16)).all()


def test_maps_of_another_size_than_the_window_are_refused() -> None:
    with pytest.raises(ValueError, match=r"needed \(96, 128\) for the window"):
        to_full_image(np.ones((128, 96)), np.ones((128, 96)), window())
