"""Aligning points that cameras saw, in the group that was asked for (paper sections III-C and III-D).

Here the submodels of the solver come together: the residual over the depth, the consensus to start
from, the estimator of the group, and the tests that send an overlap which does not determine an
affine or projective transform back to Sim(3). ``from_tracks`` and ``from_pointmaps`` call it.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np

from smust3r_colmap.errors import DegenerateAlignmentError
from smust3r_colmap.estimators.affine3 import estimate_affine3
from smust3r_colmap.estimators.robust import CAUCHY, RobustLoss, evenly_chosen
from smust3r_colmap.estimators.sim3 import consensus_sim3, estimate_sim3, homogeneous, point_distances
from smust3r_colmap.estimators.sl4 import estimate_sl4
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.depth_noise import SUBMODEL_AGREEMENT
from smust3r_colmap.geometry.groups import TransformGroup
from smust3r_colmap.geometry.sim3 import Sim3
from smust3r_colmap.geometry.transform import Transform
from smust3r_colmap.products import TransformEstimate

logger = logging.getLogger(__name__)


MIN_THICKNESS_SIGMAS = 5.0
"""Thickness of the points over the noise in its direction, both root mean squares, for more than Sim(3).
A stretch along it is known to noise / (thickness sqrt(n)) from n independent points; neighbouring
pixels have correlated errors, so n counts places rather than pixels, and with 16 of them five times
the noise leaves 5 %, as much as the fit is asked to correct. A wall has 0.7: its thickness is its noise,
and the residual has the noise of both sides."""
PLANE_RATIO = 1e-4
"""Thickness over length of the points that is a plane even without noise: single precision has 1e-7."""
MAX_ANISOTROPY = 2.0
"""Largest over smallest stretch at any point. Backbones distort by some per cent, a wrong focal length
by its error; fits to a single wall have 4 to 8 (VGGT-SLAM, measured)."""
MIN_INFINITY_DISTANCE = 0.2
"""Distance of any point from the plane at infinity over that of the centre: images grow by its inverse."""
WARP_POINTS = 1000
"""Points at which a warp is looked at; a projective one is smooth."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _SeenPoints:
    """The input of `align_seen_points` and the arguments of the solver.

    Args:
        source, target: (N, 3). weights: (N,). depth: (N,) in units of the target.
        loss, seed: as there.
    """

    source: FloatArray
    target: FloatArray
    weights: FloatArray
    depth: FloatArray
    loss: RobustLoss
    seed: int

    @property
    def residual_scale(self) -> FloatArray | None:
        """The depth, except for Huber's loss, whose constant is a length."""
        return self.depth if self.loss.redescends else None

    def inliers(self, estimate: TransformEstimate) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Source (M, 3), target (M, 3) and squared-residual weights (M,) of the rows that fit."""
        scale = np.ones_like(self.weights) if self.residual_scale is None else self.residual_scale
        residuals = point_distances(estimate.b_from_a, self.source, self.target) / scale
        fits = (residuals <= 3 * estimate.residual_sigma) & (self.weights > 0)
        return self.source[fits], self.target[fits], (self.weights / scale**2)[fits]

    def estimate(self, group: TransformGroup, start: Transform | None) -> TransformEstimate:
        """The fit in one group."""
        arguments = (self.source, self.target, self.weights)
        if group == "affine3":
            return estimate_affine3(
                *arguments,
                loss=self.loss,
                residual_scale=self.residual_scale,
                start=start,
            )
        if group == "sl4":
            return estimate_sl4(
                *arguments,
                max_error=SUBMODEL_AGREEMENT * (1.0 if self.loss.redescends else float(np.median(self.depth))),
                seed=self.seed,
                loss=self.loss,
                residual_scale=self.residual_scale,
                start=start,
            )
        return estimate_sim3(
            *arguments,
            loss=self.loss,
            residual_scale=self.residual_scale,
            fixed_scale=group == "se3",
            start=start,
        )


def align_seen_points(
    points_source: FloatArray,
    points_target: FloatArray,
    weights: FloatArray,
    *,
    depth_source: FloatArray,
    depth_target: FloatArray,
    loss: RobustLoss = CAUCHY,
    group: TransformGroup = "sim3",
    max_start_error: float = np.inf,
    seed: int = 0,
) -> SubmodelFit:
    """Robust ``target_from_source`` of points that cameras saw at known depths.

    ``cauchy`` and ``tukey`` divide the residual by the depth, since the error of a point grows with
    it, and start from a consensus: from the plain start they fail at 40 % coherent wrong pairs. The
    depth is the geometric mean of both sides: the depth of one side would give more weight to points
    that this side has too near, and bias the scale. ``huber`` is the method of the paper: plain
    residuals, plain start.

    ``affine3`` and ``sl4`` fall back to Sim(3), with a warning, where the points lie too close to a
    plane for their noise or the fit is implausible; ``SubmodelFit.fallback`` says which and by how much.

    Args:
        points_source, points_target: (N, 3); equal rows are the same scene point.
        weights: (N,) non-negative.
        depth_source, depth_target: (N,) each in units of its own frame.
        loss: as for `estimate_sim3`.
        group: of the transform.
        max_start_error: pairs further apart at the consensus, divided by the depth, are left out.
        seed: of the consensus, and of the samples of ``sl4``.

    Returns:
        The fit. Rows that are not finite, whose depths are not positive or that weigh nothing are left
        out of everything; only ``num_correspondences`` counts them.

    Raises:
        DegenerateAlignmentError: the points do not determine the transform, or agree on none.
    """
    values = np.column_stack([points_source, points_target, weights, depth_source, depth_target])
    usable = np.isfinite(values).all(axis=1) & (depth_source > 0) & (depth_target > 0) & (weights != 0)
    if usable.sum() < 3:
        raise DegenerateAlignmentError(f"{int(usable.sum())} point pairs; 3 are needed")
    points = points_source[usable], points_target[usable]
    unit = np.median(depth_target[usable] / depth_source[usable])
    depth = np.sqrt(depth_target[usable] * depth_source[usable] * unit)
    start, start_weights = None, weights[usable]
    if loss.redescends:
        start = consensus_sim3(*points, max_error=SUBMODEL_AGREEMENT * float(np.median(depth)), seed=seed)
        start_weights = start_weights * (point_distances(start, *points) <= max_start_error * depth)
    seen = _SeenPoints(
        source=points[0],
        target=points[1],
        weights=start_weights,
        depth=depth,
        loss=loss,
        seed=seed,
    )
    estimate, fallback = _estimate_or_fall_back(seen, group, start)
    relative = point_distances(estimate.b_from_a, *points) / depth
    return SubmodelFit(
        estimate=estimate,
        num_correspondences=len(weights),
        relative_residual=float(np.median(relative)),
        fallback=fallback,
    )


def _estimate_or_fall_back(
    seen: _SeenPoints, group: TransformGroup, start: Sim3 | None
) -> tuple[TransformEstimate, str]:
    """The fit in the group, or that in Sim(3) and why."""
    if group in ("sim3", "se3"):
        return seen.estimate(group, start), ""
    try:
        estimate = seen.estimate(group, start)
    except DegenerateAlignmentError as error:
        similar = seen.estimate("sim3", start)
        reason = _plane(seen, similar) or str(error)  # where it is a plane, that explains the error
    else:
        reason = _plane(seen, estimate) or implausibility(estimate.b_from_a, seen.inliers(estimate)[0])
        if not reason:
            return estimate, ""
        similar = seen.estimate("sim3", start)
    logger.warning("no %s transform, Sim(3) instead: %s", group, reason)
    return similar, reason


# ---------------------------------------------------------------- degenerate and implausible fits
def _plane(seen: _SeenPoints, estimate: TransformEstimate) -> str:
    """Why the inliers do not determine more than a similarity, with the numbers, or empty."""
    source, target, weights = seen.inliers(estimate)
    share = weights / weights.sum()
    centred = target - share @ target
    variances, axes = np.linalg.eigh((share[:, None] * centred).T @ centred)
    thickness, length = np.sqrt(np.maximum(variances[[0, 2]], 0.0))
    residuals = target - estimate.b_from_a.apply(source)
    noise = float(np.sqrt(share @ (residuals @ axes[:, 0]) ** 2))
    if thickness >= max(MIN_THICKNESS_SIGMAS * noise, PLANE_RATIO * length):
        return ""
    return (
        f"the common points are {thickness:.3g} thick at a length of {length:.3g}, with a noise of {noise:.3g} "
        f"across; needed {MIN_THICKNESS_SIGMAS:.0f} times the noise and {PLANE_RATIO:.0e} of the length"
    )


def implausibility(b_from_a: Transform, points_a: FloatArray) -> str:
    """Why the fit cannot be the distortion of a backbone, with the numbers, or empty.

    Args:
        b_from_a: whose group keeps the orientation of space.
        points_a: (N, 3) points that it was fitted to; `WARP_POINTS` of them are looked at.
    """
    points = points_a[evenly_chosen(len(points_a), WARP_POINTS)]
    towards_infinity = b_from_a.matrix[3]
    distance = homogeneous(points) @ towards_infinity / (homogeneous(points.mean(axis=0)) @ towards_infinity)
    if not distance.min() >= MIN_INFINITY_DISTANCE:
        return (
            f"a point is at {distance.min():.2f} of the centre's distance from the plane at infinity, "
            f"needed {MIN_INFINITY_DISTANCE}"
        )
    singular = np.linalg.svd(b_from_a.jacobian(points), compute_uv=False)
    anisotropy = float((singular[:, 0] / singular[:, 2]).max())
    if not anisotropy <= MAX_ANISOTROPY:
        return f"it stretches {anisotropy:.2f} times more one way than another, at most {MAX_ANISOTROPY:.0f}"
    return ""


@dataclass(frozen=True, kw_only=True, eq=False)
class SubmodelFit:
    """``target_from_source`` between two submodels, with the figures by which it is accepted or rejected.

    Args:
        estimate: the transform and the evidence of the solver.
        num_correspondences: pairs of points found, before any was left out as wrong.
        relative_residual: median over all of them of the residual divided by the depth.
        fallback: why the transform is of Sim(3) although a larger group was asked for, or empty.
    """

    estimate: TransformEstimate
    num_correspondences: int
    relative_residual: float
    fallback: str = ""

    @property
    def inlier_share(self) -> float:
        """Share of the pairs found that lie within three robust standard deviations."""
        return self.estimate.num_inliers / self.num_correspondences
