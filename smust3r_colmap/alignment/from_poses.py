"""Aligning two submodels by the cameras of the images they share (paper eq. 3).

Centres alone leave the roll about a straight path free, so orientations take part: every camera of
both submodels is a rotation and a point. It costs milliseconds and needs neither tracks nor maps;
``uncertainty`` has its covariance.
The solver works like that in ``estimators.sim3``; the next module to read is ``pairwise``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from smust3r_colmap.alignment.seen_points import SubmodelFit
from smust3r_colmap.errors import DegenerateAlignmentError
from smust3r_colmap.estimators.robust import MAD_TO_SIGMA, TRIMMING_ROUNDS, RobustKernel, RobustLoss, evenly_chosen
from smust3r_colmap.estimators.sim3 import REDESCENDING_ITERATIONS
from smust3r_colmap.estimators.similarity import CentredPairs
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.se3 import SE3
from smust3r_colmap.geometry.sim3 import Sim3
from smust3r_colmap.geometry.so3 import angles_between, nearest_rotation, skew
from smust3r_colmap.geometry.transform import Transform
from smust3r_colmap.products import Submodel, TransformEstimate

PoseGroup = Literal["sim3", "se3"]

PRIOR_SIGMA = 0.001
"""Prior standard deviation of an orientation about one axis in radians, and of a coordinate of a centre over
the depth: medians of 59 overlaps of six sets are 0.0006 and 0.0004."""
PRIOR_CAMERAS = 1.0
"""Weight of the prior, in cameras."""
HUBER_TUNING = 1.345
"""Where Huber's loss turns linear, in standard deviations: 95 % efficient on Gaussian noise."""
MIN_SPREAD_SIGMAS = 3.0
"""Root mean square distance of the centres from their mean, in standard deviations of one coordinate,
from which they carry a scale. Noise alone has 1.2: both sides' errors are in the residual."""
MAX_START_CAMERAS = 60
"""Cameras among which every pair is tried for the start: 1,770 pairs."""
SCALE_ITERATIONS = 30
"""The sigmas are taken anew this many times; of few cameras the median may alternate between two forever."""
CONVERGED_MOTION = 1e-4
"""Stop when centres move by less than this part of their standard deviation."""
MEDIAN_OF_NORM = 1.5382
"""Median length of a vector of three standard normal coordinates."""


def align_poses(
    target: Submodel,
    source: Submodel,
    *,
    depth_target: float,
    kernel: RobustKernel = "cauchy",
    group: PoseGroup = "sim3",
) -> SubmodelFit:
    """Robust ``target_from_source`` from the cameras of the shared images, centres and orientations.

    With T = (s, R, t) and camera k at centre c_k with axes R_k in either submodel, minimises

        sum_k rho(|c_target,k - T c_source,k| / sigma_c) + rho(angle(R_target,k, R R_source,k) / sigma_r).

    Both sigmas are estimated from the residuals, so no unit enters. A prior of the weight of one camera
    keeps a sigma from vanishing where the residuals are zero (two cameras always fit in their centres):
    for orientations an angle, for centres a fraction of the *depth of the scene*. The spread of the
    centres would be the wrong unit: the error of a centre comes from pixels and grows with the depth,
    whatever the length of the path; and an orientation off by an angle comes with a centre off by that
    angle times the depth, so the two terms are of one kind.

    The start is robust: the median of the rotations of all cameras, then scale and translation of the
    pair of cameras with the least median residual. ``huber`` turns
    linear at 1.345 sigma here: the paper's fixed delta has no meaning for an angle.

    Args:
        target, source: submodels that share images.
        depth_target: median depth of the scene in the target submodel, in its units.
        kernel: of both terms.
        group: ``"se3"`` keeps the scale at 1.

    Returns:
        ``rms``, ``residual_sigma`` and ``relative_residual`` are of the centres, divided by the depth;
        inliers are cameras whose centre and orientation both lie within three standard deviations.
        The information takes the cameras as independent.

    Raises:
        DegenerateAlignmentError: no image is shared; or the scale is free: one shared camera, or
            centres that differ by no more than their noise.
        ValueError: the depth is not positive.

    Source: Horn 1987 (rotation, symmetric scale), Rousseeuw 1984 (least median of squares),
    Hartley, Trumpf, Dai and Li 2013 (median rotation).
    """
    if not (np.isfinite(depth_target) and depth_target > 0):
        raise ValueError(f"submodel {target.name}: median depth {depth_target}, needed a positive number")
    pairs = _shared_cameras(target, source, depth_target)
    between = f"submodels {target.name} and {source.name}"
    if not len(pairs):
        raise DegenerateAlignmentError(f"{between} share no image, hence no camera")
    if len(pairs) == 1 and group == "sim3":
        (image,) = set(target.images) & set(source.images)
        raise DegenerateAlignmentError(
            f"{between} share one camera (image {image}): rotation and translation follow from it, the scale "
            "does not; needed 2 cameras, or a metric backbone (se3)"
        )
    try:
        return _fit(pairs, RobustLoss(kernel=kernel, huber_delta=HUBER_TUNING), fixed_scale=group == "se3")
    except DegenerateAlignmentError as error:
        raise DegenerateAlignmentError(f"{between}, {len(pairs)} shared cameras: {error}") from error


# ------------------------------------------------------------------------------- cameras
@dataclass(frozen=True, kw_only=True, eq=False)
class _Cameras:
    """The same cameras in both frames, about their mean centre and in units of the target's depth.

    Args:
        rotations_a, rotations_b: (N, 3, 3) frame_from_cam. centres_a, centres_b: (N, 3).
        mean_a, mean_b: (3,) what was taken off, in the unit of its own frame.
        depth: of the target, in its own unit.
    """

    rotations_a: FloatArray
    rotations_b: FloatArray
    centres_a: FloatArray
    centres_b: FloatArray
    mean_a: FloatArray
    mean_b: FloatArray
    depth: float

    def __len__(self) -> int:
        return len(self.centres_a)

    def residuals(self, fit: Sim3) -> tuple[FloatArray, FloatArray]:
        """(N,) distances of the centres over the depth and (N,) angles in radians."""
        distances = np.linalg.norm(self.centres_b - fit.apply(self.centres_a), axis=1)
        return distances, angles_between(self.rotations_b, fit.rotation @ self.rotations_a)

    def uncentred(self, fit: Sim3) -> Sim3:
        """The same transform between the frames of the caller."""
        scale = fit.scale * self.depth
        translation = self.depth * fit.translation + self.mean_b - scale * fit.rotation @ self.mean_a
        return Sim3(scale=scale, rotation=fit.rotation, translation=translation)


def _shared_cameras(target: Submodel, source: Submodel, depth: float) -> _Cameras:
    _, in_target, in_source = np.intersect1d(target.images, source.images, return_indices=True)
    poses_a, poses_b = source.seg_from_cam[in_source], target.seg_from_cam[in_target]
    mean_a, mean_b = (poses[:, :, 3].sum(axis=0) / max(len(poses), 1) for poses in (poses_a, poses_b))
    return _Cameras(
        rotations_a=poses_a[:, :, :3],
        rotations_b=poses_b[:, :, :3],
        centres_a=poses_a[:, :, 3] - mean_a,
        centres_b=(poses_b[:, :, 3] - mean_b) / depth,
        mean_a=mean_a,
        mean_b=mean_b,
        depth=depth,
    )


# -------------------------------------------------------------------------------- solver
@dataclass(frozen=True, kw_only=True, eq=False)
class _Terms:
    """Both terms of the objective at one fit.

    Args:
        centre_sigma: of one coordinate, over the depth. rotation_sigma: about one axis, in radians.
        centre_weights, rotation_weights: (N,) in [0, 1], what the kernel leaves of each camera.
    """

    centre_sigma: float
    rotation_sigma: float
    centre_weights: FloatArray
    rotation_weights: FloatArray


def _fit(pairs: _Cameras, loss: RobustLoss, *, fixed_scale: bool) -> SubmodelFit:
    """The estimate and its evidence."""
    fit = _start(pairs, fixed_scale=fixed_scale)
    iterations = 0
    for stage in loss.stages:
        fit, done, stop_reason = _reweighted(pairs, fit, stage, fixed_scale=fixed_scale)
        iterations += done
    terms = _terms(pairs, fit, loss, _sigmas(pairs, fit, fixed_scale=fixed_scale))
    if not fixed_scale:
        _check_spread(pairs, fit, terms)
    distances, angles = pairs.residuals(fit)
    inliers = (distances <= 3 * terms.centre_sigma) & (angles <= 3 * terms.rotation_sigma)
    near = distances[inliers] if inliers.any() else distances
    b_from_a: Transform = pairs.uncentred(fit)
    information = _information(pairs, fit, terms)
    if fixed_scale:
        b_from_a, information = SE3.from_matrix(b_from_a.matrix), information[:6, :6]
    estimate = TransformEstimate(
        b_from_a=b_from_a,
        num_points=len(pairs),
        num_inliers=int(inliers.sum()),
        rms=float(np.sqrt(np.mean(near**2))),
        residual_sigma=MAD_TO_SIGMA * float(np.median(near)),
        iterations=iterations,
        stop_reason=stop_reason,
        information=information,
    )
    return SubmodelFit(estimate=estimate, num_correspondences=len(pairs), relative_residual=float(np.median(distances)))


def _start(pairs: _Cameras, *, fixed_scale: bool) -> Sim3:
    """The median rotation, then the scale and translation on which most cameras agree.

    Rotation first, for every camera gives one. With it two cameras give the rest (one, where the scale
    is known), so every pair can be tried, and the least median residual wins without a threshold.
    """
    rotation = _median_rotation(pairs.rotations_b @ np.swapaxes(pairs.rotations_a, 1, 2))
    turned, given = pairs.centres_a @ rotation.T, pairs.centres_b
    chosen = evenly_chosen(len(pairs), MAX_START_CAMERAS)
    if fixed_scale:
        scales, anchor_a, anchor_b = np.full(len(chosen), 1 / pairs.depth), turned[chosen], given[chosen]
    else:
        first, second = (chosen[rows] for rows in np.triu_indices(len(chosen), k=1))
        length_a = np.linalg.norm(turned[first] - turned[second], axis=1)
        length_b = np.linalg.norm(given[first] - given[second], axis=1)
        apart = (length_a > 0) & (length_b > 0)
        if not apart.any():
            raise DegenerateAlignmentError("all centres of a side are one point, which leaves the scale free")
        first, second, scales = first[apart], second[apart], length_b[apart] / length_a[apart]
        anchor_a, anchor_b = (turned[first] + turned[second]) / 2, (given[first] + given[second]) / 2
    translations = anchor_b - scales[:, None] * anchor_a
    moved = scales[:, None, None] * turned + translations[:, None]  # (H, N, 3)
    best = int(np.argmin(np.median(np.linalg.norm(moved - given, axis=2), axis=1)))
    return Sim3(scale=scales[best], rotation=rotation, translation=translations[best])


def _median_rotation(rotations: FloatArray) -> FloatArray:
    """The one of (N, 3, 3) whose angles to all others have the least sum; half of them may be wrong."""
    total = angles_between(rotations[:, None], rotations[None]).sum(axis=1)
    median: FloatArray = rotations[int(np.argmin(total))]
    return median


def _reweighted(pairs: _Cameras, fit: Sim3, loss: RobustLoss, *, fixed_scale: bool) -> tuple[Sim3, int, str]:
    """Fit again with the kernel's weights until the cameras rest: fit, iterations, why it stopped."""
    for iteration in range(1, REDESCENDING_ITERATIONS + 1):
        if iteration <= SCALE_ITERATIONS:
            sigmas = _sigmas(pairs, fit, fixed_scale=fixed_scale)
        terms = _terms(pairs, fit, loss, sigmas)
        before, fit = fit, _closed_form(pairs, fit, terms, fixed_scale=fixed_scale)
        moved = np.linalg.norm(fit.apply(pairs.centres_a) - before.apply(pairs.centres_a), axis=1).max()
        turned = float(angles_between(fit.rotation, before.rotation))
        if max(moved / terms.centre_sigma, turned / terms.rotation_sigma) <= CONVERGED_MOTION:
            return fit, iteration, "converged"
    return fit, REDESCENDING_ITERATIONS, "iteration limit"


def _terms(pairs: _Cameras, fit: Sim3, loss: RobustLoss, sigmas: tuple[float, float]) -> _Terms:
    """What the kernel leaves of each camera at a fit."""
    distances, angles = pairs.residuals(fit)
    centre_sigma, rotation_sigma = sigmas
    return _Terms(
        centre_sigma=centre_sigma,
        rotation_sigma=rotation_sigma,
        centre_weights=loss.weights(distances / centre_sigma, 1.0),
        rotation_weights=loss.weights(angles / rotation_sigma, 1.0),
    )


def _sigmas(pairs: _Cameras, fit: Sim3, *, fixed_scale: bool) -> tuple[float, float]:
    """Of one coordinate of a centre, and of an orientation about one axis."""
    distances, angles = pairs.residuals(fit)
    num_parameters = 6 if fixed_scale else 7
    return _sigma(distances, num_parameters), _sigma(angles, num_parameters)


def _sigma(norms: FloatArray, num_parameters: int) -> float:
    """Robust standard deviation of one coordinate of the residual vectors that have these norms.

    From their median, of those within three standard deviations as in ``estimators.sim3``, with the
    correction for degrees of freedom, and with `PRIOR_SIGMA` as `PRIOR_CAMERAS` more cameras.
    """
    rising, num_cameras = np.sort(norms), len(norms)
    per_norm = np.sqrt(6 * num_cameras / max(6 * num_cameras - num_parameters, 1)) / MEDIAN_OF_NORM
    num_near = num_cameras
    for _ in range(TRIMMING_ROUNDS):
        own = per_norm * (rising[(num_near - 1) // 2] + rising[num_near // 2]) / 2
        sigma = np.sqrt((num_cameras * own**2 + PRIOR_CAMERAS * PRIOR_SIGMA**2) / (num_cameras + PRIOR_CAMERAS))
        num_near = max(int(np.searchsorted(rising, 3 * sigma, side="right")), 1)
    return float(sigma)


def _closed_form(pairs: _Cameras, fit: Sim3, terms: _Terms, *, fixed_scale: bool) -> Sim3:
    """Weighted least squares with the scale of ``fit`` in the rotation, then a scale for that rotation.

    An angle enters by its chord: |R_b - R R_a|_F^2 = 8 sin^2(angle / 2), about twice its square. So
    both terms are linear in R, and one Procrustes problem holds them.
    """
    share = terms.centre_weights / terms.centre_weights.sum()
    centred = CentredPairs.of(pairs.centres_a, pairs.centres_b, share)
    by_centres = float(fit.scale) * centred.correlation(terms.centre_weights) / terms.centre_sigma**2
    by_rotations = np.einsum("n,nij,nkj->ik", terms.rotation_weights, pairs.rotations_b, pairs.rotations_a)
    rotation = nearest_rotation(by_centres + by_rotations / (2 * terms.rotation_sigma**2))
    if fixed_scale:
        return centred.similarity(rotation, float(fit.scale))
    if not (_radius(centred.a, share**2) > 0 and _radius(centred.b, share**2) > 0):
        raise DegenerateAlignmentError("the cameras that agree stand in one place, which leaves the scale free")
    return centred.similarity(rotation, centred.symmetric_scale(share**2))


def _radius(centred: FloatArray, weights: FloatArray) -> float:
    """Weighted root mean square distance of (N, 3) from the origin."""
    return float(np.sqrt(weights @ (centred**2).sum(axis=1) / weights.sum()))


def _check_spread(pairs: _Cameras, fit: Sim3, terms: _Terms) -> None:
    """Refuse centres whose spread is within their noise."""
    share = terms.centre_weights / terms.centre_weights.sum()
    spread = min(
        float(fit.scale) * _radius(pairs.centres_a - share @ pairs.centres_a, share),
        _radius(pairs.centres_b - share @ pairs.centres_b, share),
    )
    if not spread >= MIN_SPREAD_SIGMAS * terms.centre_sigma:
        raise DegenerateAlignmentError(
            f"the centres spread by {spread:.2g} of the scene's depth and are uncertain by {terms.centre_sigma:.2g}; "
            f"needed {MIN_SPREAD_SIGMAS:g} times that: a camera that stands still leaves the scale free"
        )


def _information(pairs: _Cameras, fit: Sim3, terms: _Terms) -> FloatArray:
    """(7, 7) normal matrix of the right perturbation (u, omega, lambda) in frame a.

    It moves the image of a centre x by s R (u + omega x x + lambda x) and turns the axes by omega.
    """
    x = pairs.centres_a + pairs.mean_a
    jacobian = np.zeros((len(x), 3, 7))
    jacobian[:, :, :3] = np.eye(3)
    jacobian[:, :, 3:6] = -skew(x)
    jacobian[:, :, 6] = x
    weights = terms.centre_weights * (float(fit.scale) / terms.centre_sigma) ** 2
    information: FloatArray = np.einsum("n,nij,nik->jk", weights, jacobian, jacobian)
    information[3:6, 3:6] += terms.rotation_weights.sum() / terms.rotation_sigma**2 * np.eye(3)
    return information
