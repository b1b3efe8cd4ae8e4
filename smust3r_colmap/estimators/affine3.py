"""Robust Affine(3) between matched points: the closed form that ``sim3`` iterates (paper section III-D).

A similarity with stretch and shear has twelve parameters and needs points in all three dimensions;
what becomes of a wall is decided in ``seen_points``. The next module to read is ``sl4``.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from smust3r_colmap.errors import DegenerateAlignmentError
from smust3r_colmap.estimators.robust import CAUCHY, RobustLoss
from smust3r_colmap.estimators.sim3 import Pairs, affine_matrix, fit_robustly, usable_pairs
from smust3r_colmap.estimators.similarity import CentredPairs
from smust3r_colmap.geometry.affine3 import Affine3
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.so3 import nearest_rotation
from smust3r_colmap.geometry.transform import Transform
from smust3r_colmap.products import TransformEstimate

COPLANAR_RATIO = 1e-6
"""Third over first singular value of the centred points below which they are a plane to rounding."""


def estimate_affine3(
    points_a: npt.ArrayLike,
    points_b: npt.ArrayLike,
    weights: npt.ArrayLike,
    *,
    loss: RobustLoss = CAUCHY,
    max_iterations: int | None = None,
    residual_scale: npt.ArrayLike | None = None,
    start: Transform | None = None,
) -> TransformEstimate:
    """Robust ``b_from_a`` in Affine(3) between matched points, by IRLS.

    The fit is symmetric: swapping the sides gives the inverse. Ordinary least squares takes all noise
    to be in b, and shrinks by the noise of a along every direction in which the points are thin.
    Because second moments of either side enter, a redescending kernel's weights are squared, as those
    in the scale of `estimate_sim3`.

    Args:
        points_a, points_b, weights, loss, max_iterations, residual_scale, start: as
            for `estimate_sim3`.

    Returns:
        As for `estimate_sim3`; ``information`` is (12, 12). The determinant is positive.

    Raises:
        DegenerateAlignmentError: fewer than 4 rows of positive weight, or these lie in a plane.
        ValueError: shapes differ, a weight is negative, or a limit is not positive.
    """
    pairs = usable_pairs(points_a, points_b, weights, residual_scale, needed=4)
    return fit_robustly(
        pairs,
        _symmetric_fit(pairs, np.ones(len(pairs.weights)), np.eye(4)) if start is None else pairs.centred(start.matrix),
        _symmetric_fit,
        group=Affine3,
        loss=replace(loss, squared=True),
        max_iterations=max_iterations,
    )


def _symmetric_fit(pairs: Pairs, kernel_weights: FloatArray, before: FloatArray) -> FloatArray:
    """Total least squares by moments, as `sim3.Refit`.

    With S_a, S_b the second moments about the means and C = sum of w a b^T, the linear part A fulfils
    A S_a A^T = S_b and makes A C symmetric: nine equations that are the same for the inverse, and
    that equal noise on both sides leaves unbiased, whatever its shape. A = S_b^1/2 Q S_a^-1/2 solves
    the first for every rotation Q; the second makes Q the Procrustes rotation of the whitened points,
    so that the determinant is positive by construction.
    """
    share = pairs.precision * kernel_weights
    share = share / share.sum()
    centred = CentredPairs.of(pairs.points_a, pairs.points_b, share)
    a, b = centred.a, centred.b
    refuse_plane(a, share, "first")
    refuse_plane(b, share, "second")
    _, whitener_a = _roots((share[:, None] * a).T @ a)
    root_b, whitener_b = _roots((share[:, None] * b).T @ b)
    linear = root_b @ nearest_rotation(whitener_b @ centred.correlation(share) @ whitener_a) @ whitener_a
    return affine_matrix(linear, centred.mean_b - linear @ centred.mean_a)


def refuse_plane(centred: FloatArray, share: FloatArray, side: str) -> None:
    """Raise where points (N, 3) about their mean, of weights (N,) that sum to 1, have no thickness at all.

    Raises:
        DegenerateAlignmentError: naming the side.
    """
    variances = np.linalg.eigvalsh((share[:, None] * centred).T @ centred)
    ratio = float(np.sqrt(max(variances[0], 0.0) / variances[2]))
    if not ratio >= COPLANAR_RATIO:
        raise DegenerateAlignmentError(
            f"{len(centred)} points of the {side} side lie in a plane "
            f"(thickness {ratio:.1e} of their length, needed {COPLANAR_RATIO:.0e})"
        )


def _roots(moments: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Symmetric square root (3, 3) of second moments, and its inverse."""
    variances, axes = np.linalg.eigh(moments)
    roots = np.sqrt(variances)
    return axes * roots @ axes.T, axes / roots @ axes.T
