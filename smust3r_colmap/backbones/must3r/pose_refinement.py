"""The pose of one image from its rays, its depth and its points in the segment, each trusted by its own scatter.

A network knows far better where a pixel looks than how deep it sees. Distances between the two pointmaps mix both, and
reprojections do without the depth. Here a pixel has three residuals, two across its ray and one along it, and
two robust standard deviations that are taken from the data. Next: ``cameras``, which asks for it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from smust3r_colmap.errors import DegenerateAlignmentError
from smust3r_colmap.estimators.robust import CAUCHY_TUNING, robust_scale
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.se3 import SE3
from smust3r_colmap.geometry.so3 import skew

MAX_ITERATIONS = 30
"""Of each of the two rounds; 5 to 15 are usual."""
CONVERGED_STEP = 1e-5
"""Angle in radians, and motion over the depth; a thousandth of a network's error."""
SMALLEST_SIGMA = 1e-9
"""Of either residual, so that exact data divides by no zero."""
NEAREST_DEPTH = 1e-3
"""Of a point in front, as a share of its predicted depth."""
INLIER_SIGMAS = 3.0
"""Standard deviations up to which a pixel has a say in the second round."""
DEPTH_CAUTION = 3.0
"""Factor on the standard deviation of depth in the second round: its errors are smooth over the image, so that
thousands of pixels are a few opinions. On simulated pointmaps 2 to 5 give errors a third smaller than 1."""
SINGULAR = 1e-12
"""Reciprocal condition of the normal matrix below which the points leave a motion free."""


def refine_pose(
    rays_cam: FloatArray, depths: FloatArray, points_seg: FloatArray, weights: FloatArray, start: SE3
) -> SE3:
    """``cam_from_seg`` under which the points lie on their rays at their depths.

    With p = (x, y, z) a point in the camera, its residuals are (x/z, y/z) - ray and log(z / depth), each over its
    standard deviation. The first round is IRLS with a Cauchy kernel that sees all three together, and tells which
    pixels to believe; the second is least squares over those, with depth trusted less.

    Args:
        rays_cam: (N, 3) known directions with z = 1.
        depths: (N,) predicted, positive.
        points_seg: (N, 3) predicted.
        weights: (N,) non-negative.
        start: rough ``cam_from_seg``; most points must lie in front of it.

    Raises:
        DegenerateAlignmentError: fewer than half of the points lie in front of the camera, or they leave a motion
            free.
    """
    pixels = _Pixels(rays_cam=rays_cam, depths=depths, points_seg=points_seg, weights=weights)

    def cauchy(residuals: FloatArray) -> _Trust:
        sigmas = _sigmas(residuals)
        squared = ((residuals / sigmas) ** 2).sum(axis=1)
        return _Trust(sigmas=sigmas, weights=weights / (1 + squared / CAUCHY_TUNING**2))

    robust = _descended(pixels, start, cauchy)
    residuals = pixels.residuals(robust.apply(points_seg))
    sigmas = _sigmas(residuals)
    believed = ((residuals / sigmas) ** 2).sum(axis=1) <= INLIER_SIGMAS**2
    fixed = _Trust(sigmas=sigmas * [1.0, 1.0, DEPTH_CAUTION], weights=np.where(believed, weights, 0.0))
    return _descended(pixels, robust, lambda _: fixed)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Pixels:
    """What `refine_pose` is given."""

    rays_cam: FloatArray
    depths: FloatArray
    points_seg: FloatArray
    weights: FloatArray

    def residuals(self, points_cam: FloatArray) -> FloatArray:
        """(N, 3) two across the ray and one along it, without unit; infinite for points that are not in front.

        Raises:
            DegenerateAlignmentError: these are most of them.
        """
        front = points_cam[:, 2] > NEAREST_DEPTH * self.depths
        if 2 * front.sum() < len(front):
            raise DegenerateAlignmentError(f"{int(front.sum())} of {len(front)} points lie in front of the camera")
        z = points_cam[front, 2]
        residuals = np.full((len(front), 3), np.inf)
        residuals[front, :2] = points_cam[front, :2] / z[:, None] - self.rays_cam[front, :2]
        residuals[front, 2] = np.log(z / self.depths[front])
        return residuals


@dataclass(frozen=True, kw_only=True, eq=False)
class _Trust:
    """Standard deviations (3,) of the residuals, and weights (N,) of the pixels, 0 where a residual is infinite."""

    sigmas: FloatArray
    weights: FloatArray


def _descended(pixels: _Pixels, start: SE3, trust: Callable[[FloatArray], _Trust]) -> SE3:
    """Gauss-Newton steps ``exp(step) @ cam_from_seg`` under a trust that may follow the residuals, until they rest."""
    cam_from_seg = start
    # Translations are counted in units of the depth, so that the normal matrix is as well conditioned in any unit.
    unit = float(np.median(pixels.depths))
    for _ in range(MAX_ITERATIONS):
        points_cam = cam_from_seg.apply(pixels.points_seg)
        residuals = pixels.residuals(points_cam)
        now = trust(residuals)
        used = (now.weights > 0) & np.isfinite(residuals[:, 0])
        jacobians = _jacobians(points_cam[used], unit) / now.sigmas[:, None]  # (n, 3, 6)
        step = _step(jacobians, residuals[used] / now.sigmas, now.weights[used])
        cam_from_seg = SE3.exp(step * np.repeat([unit, 1.0], 3)) @ cam_from_seg
        if np.abs(step).max() < CONVERGED_STEP:
            break
    return cam_from_seg


def _jacobians(points_cam: FloatArray, unit: float) -> FloatArray:
    """(N, 3, 6) derivatives of the residuals by (translation in ``unit``, rotation vector)."""
    z = points_cam[:, 2, None, None]
    moved = np.empty((len(points_cam), 3, 6))
    moved[:, :, :3] = unit * np.eye(3)
    moved[:, :, 3:] = -skew(points_cam)
    in_depth = moved[:, 2:] / z
    return np.concatenate([moved[:, :2] / z - points_cam[:, :2, None] / z * in_depth, in_depth], axis=1)


def _step(jacobians: FloatArray, residuals: FloatArray, weights: FloatArray) -> FloatArray:
    """(6,) of Gauss-Newton."""
    rows = jacobians.reshape(-1, 6)
    weighted = rows * np.repeat(weights, 3)[:, None]
    normal = weighted.T @ rows
    eigenvalues = np.linalg.eigvalsh(normal)
    if not eigenvalues[0] > SINGULAR * eigenvalues[-1]:
        raise DegenerateAlignmentError(f"{len(weights)} points leave a motion of the camera free")
    return np.linalg.solve(normal, -(weighted.T @ residuals.ravel()))


def _sigmas(residuals: FloatArray) -> FloatArray:
    """(3,) robust standard deviations of the residuals (N, 3), the two across the ray counted as one length."""
    finite = residuals[np.isfinite(residuals[:, 0])]
    across = robust_scale(np.linalg.norm(finite[:, :2], axis=1), floor=SMALLEST_SIGMA)
    return np.array([across, across, robust_scale(np.abs(finite[:, 2]), floor=SMALLEST_SIGMA)])
