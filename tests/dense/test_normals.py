"""Normals of depth maps: exact on exact planes, at every camera, right on noisy ones, none across edges."""

from __future__ import annotations

import numpy as np
import pytest

from smust3r_colmap.dense import normals as module
from smust3r_colmap.dense.normals import surface_normals
from smust3r_colmap.geometry.arrays import Float32Array, FloatArray
from smust3r_colmap.geometry.camera import Intrinsics, pixel_centres
from smust3r_colmap.geometry.depth_noise import WINDOW_PIXELS

PINHOLE = Intrinsics(model="PINHOLE", width=160, height=120, params=(140, 150, 82, 59))
DISTORTED = Intrinsics(model="SIMPLE_RADIAL", width=160, height=120, params=(145, 82, 59, -0.2))
PLANES = ([0, 0, -1], [0.6, 0.2, -1], [-1.2, 0.5, -1], [0, -1, -0.6])


def seen_at(camera: Intrinsics) -> FloatArray:
    """(H, W, 2) at z = 1."""
    return camera.rays_cam(pixel_centres(camera.width, camera.height))[:, :2].reshape(camera.height, camera.width, 2)


def plane(normal: list[float], xy: FloatArray) -> tuple[FloatArray, Float32Array]:
    """Its unit normal and its depth (H, W), 0 where it is too far away."""
    unit = np.array(normal) / np.linalg.norm(normal)
    facing = xy @ unit[:2] + unit[2]
    return unit, np.where(facing < -0.2, -1 / np.minimum(facing, -0.2), 0).astype(np.float32)


def angles_deg(normals: Float32Array, unit: FloatArray) -> FloatArray:
    return np.asarray(np.degrees(np.arccos(np.clip(normals.astype(np.float64) @ unit, -1, 1))))


@pytest.mark.parametrize("camera", [PINHOLE, DISTORTED])
@pytest.mark.parametrize("normal", PLANES)
def test_normals_of_a_plane_are_exact_up_to_the_rim(camera: Intrinsics, normal: list[float]) -> None:
    xy = seen_at(camera)
    unit, depth = plane(normal, xy)
    normals, determined = surface_normals(depth, xy)
    assert determined.mean() > 0.95 * (depth > 0).mean()
    off = angles_deg(normals[determined], unit)
    # Across a window the slopes of x and y of a distorted camera change.
    assert np.percentile(off, 99) < (0.1 if camera is PINHOLE else 2.0)
    np.testing.assert_array_equal(normals[depth == 0], 0)
    np.testing.assert_allclose(np.linalg.norm(normals[depth > 0], axis=-1), 1, atol=1e-6)


@pytest.mark.parametrize("normal", PLANES)
def test_normals_of_noisy_planes_are_right_at_every_slant(normal: list[float]) -> None:
    xy = seen_at(PINHOLE)
    unit, depth = plane(normal, xy)
    noisy = depth * (1 + np.random.default_rng(2).normal(0, 0.004, depth.shape)).astype(np.float32)
    normals, determined = surface_normals(noisy, xy)
    assert 0.1 < np.median(angles_deg(normals[determined], unit)) < 6


def test_a_normal_does_not_mix_two_surfaces() -> None:
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, 40), np.linspace(-0.5, 0.5, 30))
    depth = np.where(x < 0, 2.0, 4.0).astype(np.float32)
    normals, determined = surface_normals(depth, np.stack([x, y], axis=-1))
    assert determined.all()
    np.testing.assert_allclose(normals, np.broadcast_to([0, 0, -1], normals.shape), atol=1e-5)


def test_pixels_without_neighbours_or_places_face_the_camera() -> None:
    xy = seen_at(Intrinsics(model="SIMPLE_PINHOLE", width=9, height=9, params=(10, 4.5, 4.5)))
    depth = np.zeros((9, 9), np.float32)
    depth[4, 7] = 2.0
    normals, determined = surface_normals(depth, xy)
    assert not determined.any()
    np.testing.assert_allclose(normals[4, 7], np.array([-0.3, 0, -1]) / np.hypot(0.3, 1), atol=1e-6)
    assert np.count_nonzero(normals.any(axis=-1)) == 1
    depth[:] = 2.0
    xy[2, 3] = np.nan
    _, determined = surface_normals(np.where(np.isnan(xy[..., 0]), 0, depth), xy)
    np.testing.assert_array_equal(np.argwhere(~determined), [[1, 3], [2, 2], [2, 3], [2, 4], [3, 3]])
    normals, determined = surface_normals(depth[:, :1], xy[:, :1])
    assert not determined.any()
    assert (normals[..., 2] < -0.8).all()


def test_window_sums_are_those_of_every_window_by_itself() -> None:
    rng = np.random.default_rng(4)
    inverse = rng.uniform(0.93, 1.07, (11, 9)).astype(np.float32)
    inverse[rng.random(inverse.shape) < 0.2] = 0
    found = module._window_sums(inverse, inverse > 0)
    expected = np.zeros((9, 11, 9))
    for (i, j), middle in np.ndenumerate(inverse):
        for (k, m), value in np.ndenumerate(inverse):
            dy, dx, change = k - i, m - j, float(value) - float(middle)
            in_window = max(abs(dx), abs(dy)) <= module.NORMAL_RADIUS_PX
            if middle > 0 and in_window and abs(change) <= WINDOW_PIXELS * middle:
                expected[:, i, j] += 1, dx, dy, dx * dx, dx * dy, dy * dy, change, dx * change, dy * change
    assert 5 < expected[0].mean() < 40
    np.testing.assert_allclose(found, expected, atol=1e-5)
