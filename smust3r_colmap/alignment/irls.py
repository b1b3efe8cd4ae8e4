"""Robust Sim(3) between matched points: the one solver behind every kind of overlap (paper eq. 2).

Iteratively reweighted least squares: a closed-form similarity, residuals, new weights, again.
Everything is computed in float64 about the centre of the data, and the default kernels take their
scale from the residuals, so neither the unit of the scene nor its place matters.
The modules ``from_tracks`` and ``from_pointmaps`` find the matched points.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import pycolmap

from smust3r_colmap.config import RobustKernel
from smust3r_colmap.errors import DegenerateAlignmentError
from smust3r_colmap.geometry.sim3 import Sim3
from smust3r_colmap.products import Sim3Estimate

FloatArray = npt.NDArray[np.float64]

MAD_TO_SIGMA = 1.4826
"""Standard deviation of a Gaussian over its median absolute deviation."""
TRIMMING_ROUNDS = 6
"""Of the median residual; each takes off what the one before no longer hides, and 6 rest within 1 %."""
CAUCHY_TUNING = 2.385
"""Where the Cauchy weight is 1/2, in robust standard deviations: 95 % efficient on Gaussian noise."""
TUKEY_TUNING = 4.685
"""Where Tukey's weight reaches 0, in robust standard deviations: 95 % efficient on Gaussian noise."""
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
CONSENSUS_SAMPLE = 2000
"""Pairs among which the robust start is sought: 100 hypotheses then cost 2 ms, 1,000 cost 20 ms."""
CONSENSUS_TRIALS = (100, 10_000)
"""Least and most hypotheses: 100 when nearly all pairs are right; 10,000 find one with 1 right pair in 10
(three right ones come once in 1,000 draws)."""
CONSENSUS_ERROR = 0.05
"""Residual over depth that counts as agreement at the start: sound overlaps have medians up to 0.046,
broken ones from 0.15 (six real image sets)."""


def estimate_sim3(
    points_a: npt.ArrayLike,
    points_b: npt.ArrayLike,
    weights: npt.ArrayLike,
    *,
    kernel: RobustKernel = "cauchy",
    huber_delta: float = 0.1,
    max_iterations: int | None = None,
    residual_scale: npt.ArrayLike | None = None,
    fixed_scale: bool = False,
    start: Sim3 | None = None,
) -> Sim3Estimate:
    """Robust ``b_from_a`` between matched points, by IRLS.

    ``cauchy`` and ``tukey`` redescend (a wrong pair loses its pull entirely) with a scale from the
    median residual, taken anew in every iteration; ``tukey`` starts where ``cauchy`` ends, since it
    is blind beyond its cut. ``huber`` is the paper's and VGGT-Long's: ``huber_delta`` in units of b
    and 5 iterations.

    All kernels take VGGT-Long's scale of the transform, the ratio of the weighted RMS radii. It is
    symmetric in a and b, where Umeyama's shrinks with the noise of a, a bias that adds up along a
    chain of segments. The redescending kernels enter that ratio squared: under the plain Cauchy
    weight, about 1/r^2, a wrong pair adds as much to the second moments however wrong it is.

    Args:
        points_a, points_b: (N, 3); equal rows are the same scene point.
        weights: (N,) non-negative, of any common unit; rows of weight zero have no influence.
        kernel: ``"cauchy"``, ``"tukey"`` or ``"huber"``.
        huber_delta: residual where Huber's loss turns linear, in units of b (after the division).
        max_iterations: of each kernel; None means 5 for huber and 100 otherwise.
        residual_scale: (N,) positive; residuals are divided by it (such as the depth). None: ones.
        fixed_scale: keep the scale at 1 (SE(3)).
        start: first guess; None is the closed form over all pairs.

    Returns:
        The estimate. Rows that are not finite, or whose residual scale is not positive, are dropped:
        they are missing in ``num_points``. ``rms`` and ``residual_sigma`` are of the divided
        residuals. ``information`` takes rows as independent and is always of all seven parameters.

    Raises:
        DegenerateAlignmentError: fewer than 3 rows of positive weight, or these lie on a line or point.
        ValueError: shapes differ, a weight is negative, or a limit is not positive.

    Source: Horn 1987 (closed form, symmetric scale); Holland and Welsch 1977 (IRLS).
    """
    if kernel == "huber" and not huber_delta > 0:
        raise ValueError(f"huber_delta {huber_delta} must be positive")
    if max_iterations is None:
        max_iterations = HUBER_ITERATIONS if kernel == "huber" else REDESCENDING_ITERATIONS
    if max_iterations < 1:
        raise ValueError(f"max_iterations {max_iterations} must be at least 1")
    pairs = _usable_pairs(points_a, points_b, weights, residual_scale)
    equal = np.ones(len(pairs.weights))
    fit = pairs.centred(start) if start is not None else _closed_form(pairs, equal, equal, fixed_scale=fixed_scale)
    loss = _Loss(kernel=kernel, huber_delta=huber_delta)
    iterations = 0
    for stage in [_Loss(kernel="cauchy"), loss] if kernel == "tukey" else [loss]:
        fit, done, stop_reason = _reweighted_fits(
            pairs, fit, stage, max_iterations=max_iterations, fixed_scale=fixed_scale
        )
        iterations += done
    residuals = pairs.residuals(fit)
    sigma = pairs.sigma(residuals)
    inliers = residuals <= 3 * sigma
    return Sim3Estimate(
        b_from_a=pairs.uncentred(fit),
        num_points=len(residuals),
        num_inliers=int(inliers.sum()),
        rms=float(np.sqrt(np.mean(residuals[inliers] ** 2))),
        residual_sigma=sigma,
        iterations=iterations,
        stop_reason=stop_reason,
        information=_information(pairs, fit, residuals, loss.weights(residuals, sigma)),
    )


# ------------------------------------------------------------------------- the iteration
@dataclass(frozen=True, kw_only=True, eq=False)
class _Pairs:
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

    def centred(self, b_from_a: Sim3) -> Sim3:
        """The same transform between the centred frames."""
        translation = b_from_a.apply(self.centre_a[None])[0] - self.centre_b
        return Sim3(scale=b_from_a.scale, rotation=b_from_a.rotation, translation=translation)

    def uncentred(self, fit: Sim3) -> Sim3:
        """The same transform between the frames of the caller."""
        return _moved_origins(fit, self.centre_a, self.centre_b)

    def residuals(self, fit: Sim3) -> FloatArray:
        """(N,) distances in frame b, divided."""
        return point_distances(fit, self.points_a, self.points_b) / self.residual_scale

    def sigma(self, residuals: FloatArray) -> float:
        """Robust standard deviation of the residuals, at least the floor of the data.

        The median of all residuals, inflated by wrong pairs, would let them pull, move the fit and
        so inflate it further; a median of those within three standard deviations is not moved.
        """
        order = np.argsort(residuals)
        rising, mass = residuals[order], np.cumsum(self.weights[order])
        num_near = len(rising)
        for _ in range(TRIMMING_ROUNDS):
            median = rising[np.searchsorted(mass, 0.5 * mass[num_near - 1])]
            sigma = max(MAD_TO_SIGMA * float(median), self.floor)
            num_near = int(np.searchsorted(rising, 3 * sigma, side="right"))
        return sigma

    @property
    def floor(self) -> float:
        """A divided residual that is rounding error."""
        extent = np.sqrt(np.mean(self.points_b**2)) / np.median(self.residual_scale)
        return SCALE_FLOOR * float(extent)


def _usable_pairs(
    points_a: npt.ArrayLike, points_b: npt.ArrayLike, weights: npt.ArrayLike, residual_scale: npt.ArrayLike | None
) -> _Pairs:
    """Checked, filtered and centred input of `estimate_sim3`."""
    a, b, w = (np.asarray(values, dtype=np.float64) for values in (points_a, points_b, weights))
    scale = np.ones_like(w) if residual_scale is None else np.asarray(residual_scale, dtype=np.float64)
    if a.ndim != 2 or a.shape[1] != 3 or a.shape != b.shape or w.shape != a.shape[:1] or scale.shape != w.shape:
        raise ValueError(f"points {a.shape} and {b.shape}, weights {w.shape}, residual_scale {scale.shape} do not fit")
    if (w < 0).any():
        raise ValueError(f"{int((w < 0).sum())} weights are negative")
    finite = np.isfinite(np.column_stack([a, b, w, scale])).all(axis=1) & (scale > 0)
    use = finite & (w > 0)
    if use.sum() < 3:
        raise DegenerateAlignmentError(
            f"{int(use.sum())} of {len(w)} point pairs are usable ({int((~finite).sum())} are not finite); 3 are needed"
        )
    a, b, w, scale = a[use], b[use], w[use], scale[use]
    for side, points in (("first", a), ("second", b)):
        extent = float(np.ptp(points, axis=0).max())
        if extent <= SCALE_FLOOR * np.abs(points).max():
            raise DegenerateAlignmentError(f"all {len(points)} points of the {side} side are one (extent {extent:.1e})")
    centre_a, centre_b = a.mean(axis=0), b.mean(axis=0)
    return _Pairs(
        points_a=a - centre_a,
        points_b=b - centre_b,
        centre_a=centre_a,
        centre_b=centre_b,
        weights=w / w.mean(),
        residual_scale=scale,
    )


def _moved_origins(centred: Sim3, centre_a: FloatArray, centre_b: FloatArray) -> Sim3:
    """The transform between frames whose origins are not at these centres."""
    translation = centred.translation + centre_b - centred.scale * centred.rotation @ centre_a
    return Sim3(scale=centred.scale, rotation=centred.rotation, translation=translation)


@dataclass(frozen=True, kw_only=True)
class _Loss:
    """A kernel with its constant; what `estimate_sim3` says of both."""

    kernel: RobustKernel
    huber_delta: float = np.nan

    def weights(self, residuals: FloatArray, sigma: float) -> FloatArray:
        """(N,) in [0, 1]: the derivative of the loss over the residual."""
        weights: FloatArray
        if self.kernel == "huber":
            weights = self.huber_delta / np.maximum(residuals, self.huber_delta)
        elif self.kernel == "tukey":
            weights = np.maximum(1 - (residuals / (TUKEY_TUNING * sigma)) ** 2, 0.0) ** 2
        else:
            weights = 1 / (1 + (residuals / (CAUCHY_TUNING * sigma)) ** 2)
        return weights

    def scale_weights(self, weights: FloatArray) -> FloatArray:
        """(N,) the same weights as they enter the RMS radii."""
        return weights if self.kernel == "huber" else weights**2


def _reweighted_fits(
    pairs: _Pairs, fit: Sim3, loss: _Loss, *, max_iterations: int, fixed_scale: bool
) -> tuple[Sim3, int, str]:
    """Fit again with the kernel's weights until the points rest: fit, iterations, why it stopped."""
    for iteration in range(1, max_iterations + 1):
        residuals = pairs.residuals(fit)
        sigma = pairs.sigma(residuals)
        weights = loss.weights(residuals, sigma)
        before, fit = fit, _closed_form(pairs, weights, loss.scale_weights(weights), fixed_scale=fixed_scale)
        moved = point_distances(fit, pairs.points_a, before.apply(pairs.points_a)) / pairs.residual_scale
        if np.sqrt(np.mean(moved**2)) <= CONVERGED_MOTION * sigma:
            return fit, iteration, "converged"
    return fit, max_iterations, "iteration limit"


def _closed_form(pairs: _Pairs, kernel_weights: FloatArray, scale_weights: FloatArray, *, fixed_scale: bool) -> Sim3:
    """Weighted least squares of the divided residuals, with the symmetric scale.

    Raises:
        DegenerateAlignmentError: the weighted points of a side lie on a line or in a point.
    """
    precision = pairs.weights / pairs.residual_scale**2
    share = precision * kernel_weights
    share = share / share.sum()
    mean_a, mean_b = share @ pairs.points_a, share @ pairs.points_b
    a, b = pairs.points_a - mean_a, pairs.points_b - mean_b
    _check_spread(a, share, "first")
    _check_spread(b, share, "second")
    u, _, vt = np.linalg.svd((share[:, None] * b).T @ a)
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    scale = 1.0
    if not fixed_scale:
        in_scale = precision * scale_weights
        scale = float(np.sqrt(in_scale @ (b**2).sum(axis=1)) / np.sqrt(in_scale @ (a**2).sum(axis=1)))
    return Sim3(scale=np.array(scale), rotation=rotation, translation=mean_b - scale * rotation @ mean_a)


def _check_spread(centred: FloatArray, share: FloatArray, side: str) -> None:
    """Refuse points that leave a rotation free."""
    variances = np.linalg.eigvalsh((share[:, None] * centred).T @ centred)
    ratio = float(np.sqrt(max(variances[1], 0.0) / variances[2]))
    if ratio < COLLINEAR_RATIO:
        raise DegenerateAlignmentError(
            f"{len(centred)} points of the {side} side lie on a line "
            f"(width {ratio:.1e} of their length, needed {COLLINEAR_RATIO:.0e})"
        )


def _information(pairs: _Pairs, fit: Sim3, residuals: FloatArray, kernel_weights: FloatArray) -> FloatArray:
    """(7, 7) Gauss-Newton normal matrix over the variance of one component of a residual of weight 1.

    With x in frame a, ``b_from_a @ exp(delta)`` moves its image by s R (u + omega x x + lambda x) for
    delta = (u, omega, lambda), so the normal matrix is a matter of the moments of x; R cancels.
    """
    points_a = pairs.points_a + pairs.centre_a
    weights = pairs.weights * kernel_weights
    share = weights / pairs.residual_scale**2
    mass = float(share.sum())
    first = share @ points_a
    second = (share[:, None] * points_a).T @ points_a
    normal = np.zeros((7, 7))
    normal[:3, :3] = mass * np.eye(3)
    normal[:3, 3:6] = _cross_matrix(-first)
    normal[3:6, :3] = _cross_matrix(first)
    normal[:3, 6] = normal[6, :3] = first
    normal[3:6, 3:6] = np.trace(second) * np.eye(3) - second
    normal[6, 6] = np.trace(second)
    degrees_of_freedom = max(3 * float(kernel_weights.sum()) - 7, 1.0)
    variance = float(weights @ residuals**2) / degrees_of_freedom
    information: FloatArray = float(fit.scale) ** 2 * normal / max(variance, pairs.floor**2)
    return information


def _cross_matrix(vector: FloatArray) -> FloatArray:
    """(3, 3) with ``_cross_matrix(v) @ x == cross(v, x)``."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def point_distances(b_from_a: Sim3, points_a: FloatArray, points_b: FloatArray) -> FloatArray:
    """(N,) distances in frame b between transformed and given points."""
    distances: FloatArray = np.linalg.norm(points_b - b_from_a.apply(points_a), axis=1)
    return distances


# ------------------------------------------------------------ correspondences with depths
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
    return _moved_origins(Sim3.from_matrix(found["tgt_from_src"].matrix()), origin_a, origin_b)


def _off_plane(points: FloatArray) -> FloatArray:
    """(3,) an origin near the points but outside their plane: pycolmap takes a plane through the origin for a line."""
    centre = points.mean(axis=0)
    variances, axes = np.linalg.eigh(np.cov(points - centre, rowvar=False))
    origin: FloatArray = centre - np.sqrt(max(variances[2], 0.0)) * axes[:, 0]
    return origin


def evenly_chosen(count: int, limit: int) -> npt.NDArray[np.int64]:
    """At most ``limit`` of the rows 0 .. count - 1, evenly spread, ascending, without repeats."""
    return np.arange(count) if count <= limit else np.arange(limit) * count // limit


@dataclass(frozen=True, kw_only=True, eq=False)
class PieceFit:
    """``target_from_source`` between two pieces, with what tells a sound fit from a broken one.

    Args:
        estimate: the transform and the evidence of the solver.
        num_correspondences: pairs of points found, before any was left out as wrong.
        relative_residual: median over all of them of the residual divided by the depth.
    """

    estimate: Sim3Estimate
    num_correspondences: int
    relative_residual: float

    @property
    def inlier_share(self) -> float:
        """Share of the pairs found that lie within three robust standard deviations."""
        return self.estimate.num_inliers / self.num_correspondences


def align_seen_points(
    points_source: FloatArray,
    points_target: FloatArray,
    weights: FloatArray,
    *,
    depth_source: FloatArray,
    depth_target: FloatArray,
    kernel: RobustKernel,
    huber_delta: float,
    max_start_error: float = np.inf,
    seed: int = 0,
) -> PieceFit:
    """Robust ``target_from_source`` of points that cameras saw at known depths.

    ``cauchy`` and ``tukey`` divide the residual by the depth, since the error of a point grows with
    it, and start from a consensus: from the plain start they are lost from 40 % coherent wrong pairs
    on. The depth is the geometric mean of both sides, for the depth of one side gives more weight to
    points which that side has too near, and a bias to the scale. ``huber`` is the method of the
    paper: plain residuals, plain start.

    Args:
        points_source, points_target: (N, 3) finite; equal rows are the same scene point.
        weights: (N,) non-negative.
        depth_source, depth_target: (N,) positive, each in units of its own frame.
        kernel, huber_delta: as for `estimate_sim3`.
        max_start_error: pairs further apart at the consensus, divided by the depth, are left out.
        seed: of the consensus.

    Raises:
        DegenerateAlignmentError: the points do not determine the transform, or agree on none.
    """
    if len(weights) < 3:
        raise DegenerateAlignmentError(f"{len(weights)} point pairs; 3 are needed")
    depth = np.sqrt(depth_target * depth_source * np.median(depth_target / depth_source))
    if kernel == "huber":
        estimate = estimate_sim3(points_source, points_target, weights, kernel=kernel, huber_delta=huber_delta)
    else:
        max_error = CONSENSUS_ERROR * float(np.median(depth))
        start = consensus_sim3(points_source, points_target, max_error=max_error, seed=seed)
        plausible = point_distances(start, points_source, points_target) <= max_start_error * depth
        estimate = estimate_sim3(
            points_source, points_target, weights * plausible, kernel=kernel, residual_scale=depth, start=start
        )
    relative = point_distances(estimate.b_from_a, points_source, points_target) / depth
    return PieceFit(estimate=estimate, num_correspondences=len(weights), relative_residual=float(np.median(relative)))
