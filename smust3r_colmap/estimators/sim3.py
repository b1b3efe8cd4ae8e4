"""Robust transforms between matched points by iteratively reweighted least squares (paper eq. 2).

A fit, residuals, new weights, again: `fit_robustly` is the iteration for every group of transforms,
and a `Refit` is the part that differs. This module has the one of Sim(3) and SE(3), ``affine3`` that
of Affine(3), ``sl4`` that of SL(4). Everything is computed in float64 about the centre of the
data, and the default kernels take their scale from the residuals, so neither the unit of the scene
nor its place matters. The next module to read is ``seen_points``, which chooses among the groups.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
import pycolmap

from smust3r_colmap.errors import DegenerateAlignmentError
from smust3r_colmap.estimators.robust import CAUCHY, RobustLoss, evenly_chosen, robust_scale
from smust3r_colmap.estimators.similarity import CentredPairs
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.se3 import SE3
from smust3r_colmap.geometry.sim3 import Sim3
from smust3r_colmap.geometry.so3 import nearest_rotation
from smust3r_colmap.geometry.transform import Transform
from smust3r_colmap.products import TransformEstimate

HUBER_ITERATIONS = 5
"""As in VGGT-Long, whose Huber IRLS the paper takes over."""
REDESCENDING_ITERATIONS = 100
"""Of each kernel; a bound, not a budget: 5 to 40 are usual."""
CONVERGED_MOTION = 1e-4
"""Stop when the points move by less than this share of the residuals' standard deviation; the
standard error is 1e-2 of it even with 10,000 points."""
SCALE_FLOOR = 1e-10
"""Smallest kernel scale, relative to the extent of the data, so that exact data divides by no zero."""
COLLINEAR_RATIO = 1e-6
"""Second over first singular value of the centred points below which they are a line."""
BLOCK_ROWS = 65_536
"""Rows whose Jacobians are in memory at a time: 24 MiB, however many points there are."""
CONSENSUS_SAMPLE = 2000
"""Pairs among which the robust start is sought: 100 hypotheses then cost 2 ms, 1,000 cost 20 ms."""
CONSENSUS_TRIALS = (100, 10_000)
"""Least and most hypotheses: 100 when nearly all pairs are right; 10,000 find one with 1 right pair in 10
(three right ones come once in 1,000 draws)."""


def estimate_sim3(
    points_a: npt.ArrayLike,
    points_b: npt.ArrayLike,
    weights: npt.ArrayLike,
    *,
    loss: RobustLoss = CAUCHY,
    max_iterations: int | None = None,
    residual_scale: npt.ArrayLike | None = None,
    fixed_scale: bool = False,
    start: Transform | None = None,
) -> TransformEstimate:
    """Robust ``b_from_a`` between matched points, by IRLS.

    ``cauchy`` and ``tukey`` redescend (an outlier loses its weight) with a scale from the
    median residual, taken anew in every iteration; ``tukey`` starts where ``cauchy`` ends, since its
    weight is zero beyond its cut. ``huber`` is the paper's and VGGT-Long's: ``huber_delta`` in units of b
    and 5 iterations.

    All kernels take VGGT-Long's scale of the transform, the ratio of the weighted RMS radii. It is
    symmetric in a and b, where Umeyama's shrinks with the noise of a, a bias that adds up along a
    chain of segments. The redescending kernels enter that ratio squared: under the plain Cauchy
    weight, about 1/r^2, a wrong pair adds as much to the second moments however wrong it is.

    Args:
        points_a, points_b: (N, 3); equal rows are the same scene point.
        weights: (N,) non-negative, of any common unit; rows of weight zero have no influence.
        loss: of the divided residuals.
        max_iterations: of each kernel; None means 5 for huber and 100 otherwise.
        residual_scale: (N,) positive; residuals are divided by it (such as the depth). None: ones.
        fixed_scale: keep the scale at 1: the estimate and its information are of SE(3).
        start: first guess; None is the closed form over all pairs.

    Returns:
        The estimate. Rows that are not finite, or whose residual scale is not positive, are dropped:
        they are missing in ``num_points``. ``rms`` and ``residual_sigma`` are of the divided
        residuals. ``information`` takes rows as independent.

    Raises:
        DegenerateAlignmentError: fewer than 3 rows of positive weight, or these lie on a line or point.
        ValueError: shapes differ, a weight is negative, or a limit is not positive.

    Source: Horn 1987 (closed form, symmetric scale); Holland and Welsch 1977 (IRLS).
    """
    pairs = usable_pairs(points_a, points_b, weights, residual_scale, needed=3)
    refit = _SimilarityRefit(fixed_scale=fixed_scale, squares_in_scale=loss.redescends)
    equal = np.ones(len(pairs.weights))
    return fit_robustly(
        pairs,
        refit(pairs, equal, np.eye(4)) if start is None else pairs.centred(start.matrix),
        refit,
        group=SE3 if fixed_scale else Sim3,
        loss=loss,
        max_iterations=max_iterations,
    )


# ------------------------------------------------------------------------------ the data
@dataclass(frozen=True, kw_only=True, eq=False)
class Pairs:
    """Usable rows about the centre of each side, where float64 has digits to spare.

    Args:
        points_a, points_b: (N, 3) centred.
        centre_a, centre_b: (3,) what was taken off.
        weights: (N,) positive, of mean 1.
        residual_scale: (N,) positive, in units of b.
    """

    points_a: FloatArray
    points_b: FloatArray
    centre_a: FloatArray
    centre_b: FloatArray
    weights: FloatArray
    residual_scale: FloatArray

    def centred(self, b_from_a: FloatArray) -> FloatArray:
        """(4, 4) the same transform between the centred frames, signed so that the centre has an image."""
        fit: FloatArray = shift(-self.centre_b) @ b_from_a @ shift(self.centre_a)
        return fit if fit[3, 3] > 0 else -fit

    def uncentred(self, fit: FloatArray) -> FloatArray:
        """(4, 4) the same transform between the frames of the caller."""
        b_from_a: FloatArray = shift(self.centre_b) @ fit @ shift(-self.centre_a)
        return b_from_a

    @property
    def precision(self) -> FloatArray:
        """(N,) weights of the undivided squared residuals."""
        precision: FloatArray = self.weights / self.residual_scale**2
        return precision

    def residuals(self, fit: FloatArray) -> FloatArray:
        """(N,) distances in frame b, divided; infinite where the fit has no image."""
        residuals: FloatArray = np.linalg.norm(self.points_b - transformed(fit, self.points_a), axis=1)
        return residuals / self.residual_scale

    def sigma(self, residuals: FloatArray) -> float:
        """Robust standard deviation of the residuals, at least the floor of the data.

        Raises:
            DegenerateAlignmentError: most residuals are infinite.
        """
        sigma = robust_scale(residuals, self.weights, floor=self.floor)
        if not np.isfinite(sigma):
            raise DegenerateAlignmentError(f"the fit sends most of {len(residuals)} points to infinity or beyond")
        return sigma

    @property
    def floor(self) -> float:
        """A divided residual that is rounding error."""
        extent = np.sqrt(np.mean(self.points_b**2)) / np.median(self.residual_scale)
        return SCALE_FLOOR * float(extent)


def usable_pairs(
    points_a: npt.ArrayLike,
    points_b: npt.ArrayLike,
    weights: npt.ArrayLike,
    residual_scale: npt.ArrayLike | None,
    *,
    needed: int,
    limit: int | None = None,
) -> Pairs:
    """Checked, filtered and centred input of an estimator.

    Args:
        points_a, points_b, weights, residual_scale: as for `estimate_sim3`.
        needed: pairs that determine the transform.
        limit: take at most so many of the usable rows, evenly; None takes all.

    Raises:
        DegenerateAlignmentError: fewer than that are usable, or the points of a side are one.
        ValueError: shapes differ or a weight is negative.
    """
    a, b, w = (np.asarray(values) for values in (points_a, points_b, weights))
    scale = np.broadcast_to(1.0, w.shape) if residual_scale is None else np.asarray(residual_scale)
    if a.ndim != 2 or a.shape[1] != 3 or a.shape != b.shape or w.shape != a.shape[:1] or scale.shape != w.shape:
        raise ValueError(f"points {a.shape} and {b.shape}, weights {w.shape}, residual_scale {scale.shape} do not fit")
    if (w < 0).any():
        raise ValueError(f"{int((w < 0).sum())} weights are negative")
    finite = np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1) & np.isfinite(w) & np.isfinite(scale) & (scale > 0)
    use = np.flatnonzero(finite & (w > 0))
    if len(use) < needed:
        raise DegenerateAlignmentError(
            f"{len(use)} of {len(w)} point pairs are usable ({int((~finite).sum())} are not finite); "
            f"{needed} are needed"
        )
    if limit is not None:
        use = use[evenly_chosen(len(use), limit)]
    a, b, w, scale = (values[use].astype(np.float64) for values in (a, b, w, scale))
    for side, points in (("first", a), ("second", b)):
        extent = float(np.ptp(points, axis=0).max())
        if extent <= SCALE_FLOOR * np.abs(points).max():
            raise DegenerateAlignmentError(f"all {len(points)} points of the {side} side are one (extent {extent:.1e})")
    centre_a, centre_b = a.mean(axis=0), b.mean(axis=0)
    return Pairs(
        points_a=a - centre_a,
        points_b=b - centre_b,
        centre_a=centre_a,
        centre_b=centre_b,
        weights=w / w.mean(),
        residual_scale=scale,
    )


def shift(offset: FloatArray) -> FloatArray:
    """(4, 4) translation by (3,)."""
    out = np.eye(4)
    out[:3, 3] = offset
    return out


def homogeneous(points: FloatArray) -> FloatArray:
    """(..., 4) with a last coordinate of one."""
    return np.concatenate([points, np.ones((*points.shape[:-1], 1))], axis=-1)


def transformed(b_from_a: FloatArray, points_a: FloatArray) -> FloatArray:
    """(N, 3) images under a (4, 4) matrix; infinite for points on or behind its plane at infinity."""
    images: FloatArray = points_a @ b_from_a[:3, :3].T + b_from_a[:3, 3]
    if (b_from_a[3] == [0.0, 0.0, 0.0, 1.0]).all():
        return images
    depth = points_a @ b_from_a[3, :3] + b_from_a[3, 3]
    front = depth > 0
    images[front] /= depth[front, None]
    images[~front] = np.inf
    return images


# ------------------------------------------------------------------------- the iteration


class Refit(Protocol):
    """The part of the iteration that belongs to a group of transforms."""

    def __call__(self, pairs: Pairs, kernel_weights: FloatArray, before: FloatArray) -> FloatArray:
        """(4, 4) the fit between centred frames under the weights (N,) of the kernel.

        Args:
            pairs: the data. kernel_weights: (N,) in [0, 1].
            before: (4, 4) the fit that the weights were taken from.

        Raises:
            DegenerateAlignmentError: the weighted points do not determine it.
        """


def fit_robustly(
    pairs: Pairs,
    start: FloatArray,
    refit: Refit,
    *,
    group: type[Transform],
    loss: RobustLoss,
    max_iterations: int | None,
) -> TransformEstimate:
    """Iterate ``refit`` under the weights of ``loss``, and collect the evidence.

    Args:
        pairs: the data. start: (4, 4) between the centred frames. refit: see there.
        group: of the result and of its information.
        loss: the kernel.
        max_iterations: of each kernel; None means 5 for huber and 100 otherwise.

    Raises:
        DegenerateAlignmentError: from ``refit``.
        ValueError: ``max_iterations`` is not positive.
    """
    if max_iterations is None:
        max_iterations = REDESCENDING_ITERATIONS if loss.redescends else HUBER_ITERATIONS
    if max_iterations < 1:
        raise ValueError(f"max_iterations {max_iterations} must be at least 1")
    fit, iterations = start, 0
    for stage in loss.stages:
        fit, done, stop_reason = _reweighted_fits(pairs, fit, refit, stage, max_iterations=max_iterations)
        iterations += done
    residuals = pairs.residuals(fit)
    sigma = pairs.sigma(residuals)
    inliers = residuals <= 3 * sigma
    return TransformEstimate(
        b_from_a=group.from_matrix(pairs.uncentred(fit)),
        num_points=len(residuals),
        num_inliers=int(inliers.sum()),
        rms=float(np.sqrt(np.mean(residuals[inliers] ** 2))),
        residual_sigma=sigma,
        iterations=iterations,
        stop_reason=stop_reason,
        information=_information(group, pairs, fit, residuals, loss.weights(residuals, sigma)),
    )


def _reweighted_fits(
    pairs: Pairs, fit: FloatArray, refit: Refit, loss: RobustLoss, *, max_iterations: int
) -> tuple[FloatArray, int, str]:
    """Fit again with the kernel's weights until the points rest: fit, iterations, why it stopped."""
    for iteration in range(1, max_iterations + 1):
        residuals = pairs.residuals(fit)
        sigma = pairs.sigma(residuals)
        weights = loss.weights(residuals, sigma)
        before, fit = fit, refit(pairs, weights, fit)
        # Points that the kernel has dropped may lie at infinity.
        kept = weights > 0
        moved = transformed(fit, pairs.points_a[kept]) - transformed(before, pairs.points_a[kept])
        motion = (moved**2).sum(axis=1) / pairs.residual_scale[kept] ** 2
        if np.sqrt(np.mean(motion)) <= CONVERGED_MOTION * sigma:
            return fit, iteration, "converged"
    return fit, max_iterations, "iteration limit"


# --------------------------------------------------------------------- its uncertainty
def _information(
    group: type[Transform], pairs: Pairs, fit: FloatArray, residuals: FloatArray, kernel_weights: FloatArray
) -> FloatArray:
    """(d, d) Gauss-Newton normal matrix over the variance of one component of a residual of weight 1."""
    weights = pairs.weights * kernel_weights
    used = weights > 0
    normal = np.zeros((group.DOF, group.DOF))
    for jacobian, rows in right_jacobians(group, pairs.uncentred(fit), pairs.points_a[used] + pairs.centre_a):
        share = (weights[used][rows] / pairs.residual_scale[used][rows] ** 2)[:, None, None]
        normal += np.tensordot(share * jacobian, jacobian, axes=((0, 1), (0, 1)))
    degrees_of_freedom = max(3 * float(kernel_weights.sum()) - group.DOF, 1.0)
    variance = float(weights[used] @ residuals[used] ** 2) / degrees_of_freedom
    information: FloatArray = normal / max(variance, pairs.floor**2)
    return information


def right_jacobians(
    group: type[Transform], b_from_a: FloatArray, points_a: FloatArray
) -> Iterator[tuple[FloatArray, slice]]:
    """Derivative (n, 3, d) of ``(b_from_a @ exp(delta)).apply(points_a)`` at 0, by blocks, with their rows.

    With h the homogeneous point, b_from_a h = (y, w) and p = y / w, the image of M = b_from_a hat(delta) h
    is (M_123 - p M_4) / w. It is linear in the products of a row of b_from_a, reduced so, with h.

    Args:
        group: whose tangent delta is. b_from_a: (4, 4). points_a: (N, 3) with an image.
    """
    generators = group.hat(np.eye(group.DOF)).reshape(group.DOF, 16).T
    for first in range(0, len(points_a), BLOCK_ROWS):
        rows = slice(first, min(first + BLOCK_ROWS, len(points_a)))
        points = homogeneous(points_a[rows])
        image = points @ b_from_a.T
        depth = image[:, 3, None, None]
        reduced = (b_from_a[:3] - (image[:, :3] / image[:, 3:])[:, :, None] * b_from_a[3]) / depth  # (n, 3, 4)
        products = (reduced[:, :, :, None] * points[:, None, None, :]).reshape(-1, 16)
        yield (products @ generators).reshape(-1, 3, group.DOF), rows


# --------------------------------------------------------------------- Sim(3) and SE(3)
@dataclass(frozen=True, kw_only=True)
class _SimilarityRefit:
    """Weighted least squares of the divided residuals, with the symmetric scale.

    Args:
        fixed_scale: keep the scale at 1.
        squares_in_scale: the kernel's weights enter the RMS radii squared.
    """

    fixed_scale: bool
    squares_in_scale: bool

    def __call__(self, pairs: Pairs, kernel_weights: FloatArray, before: FloatArray) -> FloatArray:
        """As `Refit`; refuses weighted points of a side that lie on a line or in a point."""
        precision = pairs.precision
        share = precision * kernel_weights
        share = share / share.sum()
        centred = CentredPairs.of(pairs.points_a, pairs.points_b, share)
        _check_spread(centred.a, share, "first")
        _check_spread(centred.b, share, "second")
        rotation = nearest_rotation(centred.correlation(share))
        in_scale = precision * kernel_weights ** (2 if self.squares_in_scale else 1)
        return centred.similarity(rotation, 1.0 if self.fixed_scale else centred.symmetric_scale(in_scale)).matrix


def affine_matrix(linear: FloatArray, translation: FloatArray) -> FloatArray:
    """(4, 4) of (3, 3) and (3,)."""
    out = shift(translation)
    out[:3, :3] = linear
    return out


def _check_spread(centred: FloatArray, share: FloatArray, side: str) -> None:
    """Refuse points that leave a rotation free."""
    variances = np.linalg.eigvalsh((share[:, None] * centred).T @ centred)
    ratio = float(np.sqrt(max(variances[1], 0.0) / variances[2]))
    if ratio < COLLINEAR_RATIO:
        raise DegenerateAlignmentError(
            f"{len(centred)} points of the {side} side lie on a line "
            f"(width {ratio:.1e} of their length, needed {COLLINEAR_RATIO:.0e})"
        )


def consensus_sim3(points_a: FloatArray, points_b: FloatArray, *, max_error: float, seed: int = 0) -> Sim3:
    """``b_from_a`` on which most pairs agree, by LO-RANSAC; a start that wrong pairs do not spoil.

    Args:
        points_a, points_b: (N, 3) finite; an even selection of at most `CONSENSUS_SAMPLE` is used.
        max_error: distance in frame b up to which a pair agrees.
        seed: of the hypotheses; the same seed gives the same result.

    Raises:
        DegenerateAlignmentError: fewer than 3 pairs, or no transform on which 3 agree.
    """
    if len(points_a) < 3:
        raise DegenerateAlignmentError(f"{len(points_a)} point pairs; 3 are needed")
    chosen = evenly_chosen(len(points_a), CONSENSUS_SAMPLE)
    origin_a, origin_b = _off_plane(points_a), _off_plane(points_b)
    options = pycolmap.RANSACOptions(max_error=max_error, random_seed=seed)
    options.min_num_trials, options.max_num_trials = CONSENSUS_TRIALS
    # pycolmap's own type stub names another return type than the dict it gives.
    found: dict[str, Any] | None = pycolmap.estimate_sim3d_robust(  # type: ignore[assignment]
        points_a[chosen] - origin_a, points_b[chosen] - origin_b, options
    )
    if found is None or found["num_inliers"] < 3:
        raise DegenerateAlignmentError(
            f"no transform puts 3 of {len(points_a)} point pairs within {max_error:.3g}, or they lie on a line"
        )
    near_origin = Sim3.from_matrix(found["tgt_from_src"].matrix()).matrix
    return Sim3.from_matrix(shift(origin_b) @ near_origin @ shift(-origin_a))


def _off_plane(points: FloatArray) -> FloatArray:
    """(3,) an origin near the points but outside their plane: pycolmap takes a plane through the origin for a line."""
    centre = points.mean(axis=0)
    variances, axes = np.linalg.eigh(np.cov(points - centre, rowvar=False))
    origin: FloatArray = centre - np.sqrt(max(variances[2], 0.0)) * axes[:, 0]
    return origin


# ------------------------------------------------------------------------ for the callers
def point_distances(b_from_a: Transform, points_a: FloatArray, points_b: FloatArray) -> FloatArray:
    """(N,) distances in frame b between transformed and given points; infinite where there is no image."""
    distances = np.linalg.norm(points_b - b_from_a.apply(points_a), axis=1)
    return np.where(np.isnan(distances), np.inf, distances)
