"""Robust SL(4) between matched points: RANSAC on a normalised DLT, then reweighted Gauss-Newton steps.

A projective transform of space has fifteen parameters and can bend almost anything into anything,
so most of this module tests for degeneracy: samples in a plane, samples turned inside out, the error
of five noisy points, the bias of the algebraic error. What becomes of an overlap that does
not determine it is decided in ``seen_points``, the next module to read.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from smust3r_colmap.errors import DegenerateAlignmentError
from smust3r_colmap.estimators.affine3 import refuse_plane
from smust3r_colmap.estimators.robust import CAUCHY, RobustLoss, evenly_chosen
from smust3r_colmap.estimators.sim3 import (
    CONSENSUS_SAMPLE,
    Pairs,
    fit_robustly,
    homogeneous,
    right_jacobians,
    shift,
    transformed,
    usable_pairs,
)
from smust3r_colmap.geometry.arrays import BoolArray, FloatArray
from smust3r_colmap.geometry.sl4 import SL4
from smust3r_colmap.geometry.transform import Transform
from smust3r_colmap.products import TransformEstimate

MAX_PAIRS = 10_000
"""Rows that take part, however many are offered; with more, the error of the model exceeds that of the noise."""
SAMPLE_SIZE = 5
"""Points that determine a projective transform of space: three equations each, fifteen unknowns."""
DRAWS_PER_ROUND = 200
"""Samples drawn between two looks at the consensus; 15 to 100 of them pass the tests of `_hypotheses`."""
MAX_ROUNDS = 30
"""6,000 draws: `RIGHT_SAMPLES` come among them down to 35 % right pairs, and it takes half a second."""
RIGHT_SAMPLES = 30
"""Samples without a wrong pair that are wanted: five noisy points give a poor transform, the best of
thirty a fair start."""
MIN_VOLUME = 0.05
"""Six times the volume of each tetrahedron of a sample, where the root mean square radius of all points
is sqrt(3); four points of a wide room have 1, four points of one noisy wall 0.02."""
REFINED_PER_ROUND = 3
"""Hypotheses of a round that are fitted again to their inliers."""
REFINEMENTS = 8
"""Such fits in a row; each gathers inliers that the one before could not see."""
MIN_AGREEING = 8
"""Pairs of the sample that must agree; five agree with any transform that they made."""
HYPOTHESES_AT_ONCE = 32
"""Scored together; 2,000 points then take 8 MiB."""
SINGULAR = 1e-12
"""Relative eigenvalue of the scaled normal matrix below which a direction is left as it was."""

MAX_STEP = 1.0
"""Frobenius norm of a Gauss-Newton step at data of radius 1. From a consensus they are below 0.1; where
they are larger the normal equations do not determine them."""


def estimate_sl4(
    points_a: npt.ArrayLike,
    points_b: npt.ArrayLike,
    weights: npt.ArrayLike,
    *,
    max_error: float,
    seed: int = 0,
    loss: RobustLoss = CAUCHY,
    max_iterations: int | None = None,
    residual_scale: npt.ArrayLike | None = None,
    start: Transform | None = None,
) -> TransformEstimate:
    """Robust ``b_from_a`` in SL(4) between matched points.

    RANSAC finds a start: normalised DLT on five points, scored on 2,000 by the transfer error, the
    best fitted again to their inliers with rows weighted so that the algebraic error is the transfer
    error. The iteration of ``sim3`` then takes Gauss-Newton steps of the transfer error itself.

    The determinant is positive by construction: a sample passes only if each of its five tetrahedra
    keeps its orientation, which makes the determinant of its transform positive and puts all five in
    front of the plane at infinity; a fit to more points that loses this is rejected; and the
    Gauss-Newton steps multiply by exponentials of trace-free matrices, whose determinant is 1.

    Args:
        points_a, points_b, weights, loss, max_iterations, residual_scale: as for
            `sim3.estimate_sim3`. At most `MAX_PAIRS` usable rows are taken, evenly, so that time and
            memory do not grow with their number.
        max_error: divided residual up to which a pair agrees in the RANSAC.
        seed: of the samples; the same seed gives the same result.
        start: one more hypothesis, such as a similarity.

    Returns:
        As for `sim3.estimate_sim3`; ``num_points`` counts the rows taken and ``information`` is (15, 15).

    Raises:
        DegenerateAlignmentError: fewer than 8 usable rows, no transform on which 8 agree (as when all
            lie in a plane), or steps that run away.
        ValueError: shapes differ, a weight is negative, or a limit is not positive.

    Source: Hartley and Zisserman 2004, sections 4.1 and 4.4 (DLT, normalisation); Chum, Matas and
    Kittler 2003 (local optimisation); Chum, Werner and Matas 2004 (oriented constraints).
    """
    if not max_error > 0:
        raise ValueError(f"max_error {max_error} must be positive")
    pairs = usable_pairs(points_a, points_b, weights, residual_scale, needed=MIN_AGREEING, limit=MAX_PAIRS)
    hypothesis = None if start is None else pairs.centred(start.matrix)
    return fit_robustly(
        pairs,
        _consensus(pairs, max_error, hypothesis, np.random.default_rng(seed)),
        _gauss_newton_step,
        group=SL4,
        loss=replace(loss, squared=True),
        max_iterations=max_iterations,
    )


def _gauss_newton_step(pairs: Pairs, kernel_weights: FloatArray, before: FloatArray) -> FloatArray:
    """One step of the transfer error, as `sim3.Refit`, on the right perturbation of SL(4).

    The Jacobian is taken midway between a and the pre-image of b. At a it would follow the noise of a
    and bias the transform towards a smaller one; midway the normal equations are those of the
    inverse, and for an affine transform those of ``affine3``.
    """
    pre_image = transformed(_inverse(before), pairs.points_b)
    used = (kernel_weights > 0) & np.isfinite(pre_image).all(axis=1)
    residuals = pairs.points_b[used] - transformed(before, pairs.points_a[used])
    midway = (pairs.points_a[used] + pre_image[used]) / 2
    share = (pairs.precision * kernel_weights)[used]
    normal, gradient = np.zeros((SL4.DOF, SL4.DOF)), np.zeros(SL4.DOF)
    for jacobian, rows in right_jacobians(SL4, before, midway):
        weighted = share[rows, None, None] * jacobian
        normal += np.tensordot(weighted, jacobian, axes=((0, 1), (0, 1)))
        gradient += np.tensordot(weighted, residuals[rows], axes=((0, 1), (0, 1)))
    # Translation, linear part and projective row have different units; scaled, all are alike.
    unit = 1 / np.sqrt(np.maximum(np.diag(normal), np.finfo(np.float64).tiny))
    step, *_ = np.linalg.lstsq(unit[:, None] * normal * unit, unit * gradient, rcond=SINGULAR)
    tangent = unit * step
    radius = float(np.sqrt(np.mean(pairs.points_a**2)))
    size = np.linalg.norm(_diagonal(1 / radius) @ SL4.hat(tangent) @ _diagonal(radius))
    if not size <= MAX_STEP:
        raise DegenerateAlignmentError(
            f"a step of {size:.3g} radii, at most {MAX_STEP:.0f}: {int(used.sum())} point pairs near a plane or too "
            "noisy for a projective transform"
        )
    fit: FloatArray = before @ SL4.exp(tangent).matrix
    return fit


def _inverse(matrix: FloatArray) -> FloatArray:
    """(4, 4)."""
    return np.asarray(np.linalg.inv(matrix), dtype=np.float64)


def _diagonal(scale: float) -> FloatArray:
    """(4, 4) scaling of space."""
    scaling = np.eye(4)
    scaling[:3, :3] *= scale
    return scaling


# -------------------------------------------------------------------------------- RANSAC
@dataclass(frozen=True, kw_only=True, eq=False)
class _Sample:
    """The pairs among which a consensus is sought, in normalised coordinates.

    Args:
        points_a: (M, 4) homogeneous. points_b: (M, 3). tolerance: (M,) distance up to which a pair agrees.
    """

    points_a: FloatArray
    points_b: FloatArray
    tolerance: FloatArray

    def relative_errors(self, matrices: FloatArray) -> FloatArray:
        """(K, M) squared transfer errors of (K, 4, 4) over the squared tolerance; infinite without image."""
        image = matrices @ self.points_a.T  # (K, 4, M)
        front = image[:, 3] > 0
        depth = np.where(front, image[:, 3], 1.0)
        squared = ((image[:, :3] / depth[:, None] - self.points_b.T) ** 2).sum(axis=1)
        return np.where(front, squared / self.tolerance**2, np.inf)

    def costs(self, matrices: FloatArray) -> FloatArray:
        """(K,) mean of the relative errors, each at most 1 (MSAC)."""
        costs = np.empty(len(matrices))
        for first in range(0, len(matrices), HYPOTHESES_AT_ONCE):
            block = slice(first, first + HYPOTHESES_AT_ONCE)
            costs[block] = np.minimum(self.relative_errors(matrices[block]), 1).mean(axis=1)
        return costs

    def agreeing(self, matrix: FloatArray) -> BoolArray:
        """(M,) pairs within the tolerance."""
        agreeing: BoolArray = self.relative_errors(matrix[None])[0] <= 1
        return agreeing


def _consensus(pairs: Pairs, max_error: float, hypothesis: FloatArray | None, rng: np.random.Generator) -> FloatArray:
    """(4, 4) between the centred frames on which most pairs agree, refitted to them.

    Raises:
        DegenerateAlignmentError: fewer than `MIN_AGREEING` agree, or those lie in a plane.
    """
    chosen = evenly_chosen(len(pairs.points_a), CONSENSUS_SAMPLE)
    points_a, points_b = pairs.points_a[chosen], pairs.points_b[chosen]
    normal_from_a, normal_from_b = _normalisation(points_a), _normalisation(points_b)
    sample = _Sample(
        points_a=homogeneous(transformed(normal_from_a, points_a)),
        points_b=transformed(normal_from_b, points_b),
        tolerance=max_error * pairs.residual_scale[chosen] * normal_from_b[0, 0],
    )
    # Without a hypothesis, the identity between normalised frames is as good a beginning as any.
    first = np.eye(4) if hypothesis is None else normal_from_b @ hypothesis @ _inverse(normal_from_a)
    best, cost = _refined(first, sample)
    for drawn in range(1, MAX_ROUNDS + 1):
        found = _hypotheses(sample, rng)
        for candidate in found[np.argsort(sample.costs(found))[:REFINED_PER_ROUND]]:
            best, cost = min((best, cost), _refined(candidate, sample), key=lambda fitted: fitted[1])
        right_share = float(sample.agreeing(best).mean()) ** SAMPLE_SIZE
        if drawn * DRAWS_PER_ROUND * right_share >= RIGHT_SAMPLES:
            break
    agreeing = sample.agreeing(best)
    if agreeing.sum() < MIN_AGREEING:
        raise DegenerateAlignmentError(
            f"no projective transform puts {MIN_AGREEING} of {len(agreeing)} point pairs within {max_error:.3g} "
            f"(best {int(agreeing.sum())}), or they lie in a plane"
        )
    share = np.full(int(agreeing.sum()), 1 / agreeing.sum())
    refuse_plane(points_a[agreeing] - points_a[agreeing].mean(axis=0), share, "first")
    refuse_plane(points_b[agreeing] - points_b[agreeing].mean(axis=0), share, "second")
    fit: FloatArray = _inverse(normal_from_b) @ best @ normal_from_a
    return fit


def _normalisation(points: FloatArray) -> FloatArray:
    """(4, 4) similarity to centre 0 and root mean square radius sqrt(3) (Hartley)."""
    centre = points.mean(axis=0)
    scale = float(1 / np.sqrt(np.mean((points - centre) ** 2)))
    normal_from: FloatArray = _diagonal(scale) @ shift(-centre)
    return normal_from


def _hypotheses(sample: _Sample, rng: np.random.Generator) -> FloatArray:
    """(K, 4, 4) transforms of one round of draws, of samples that determine one and keep their orientation."""
    rows = rng.integers(len(sample.points_b), size=(DRAWS_PER_ROUND, SAMPLE_SIZE))
    a, b = sample.points_a[rows], homogeneous(sample.points_b[rows])
    volumes_a, volumes_b = _volumes(a), _volumes(b)
    sound = (np.minimum(np.abs(volumes_a), np.abs(volumes_b)) > MIN_VOLUME) & (volumes_a * volumes_b > 0)
    rows = rows[sound.all(axis=1)]
    return dlt(sample.points_a[rows], sample.points_b[rows], np.ones(rows.shape))


def _volumes(points: FloatArray) -> FloatArray:
    """(K, 5) signed, sixfold volumes of the tetrahedra of five homogeneous points (K, 5, 4)."""
    others = [[k for k in range(SAMPLE_SIZE) if k != left_out] for left_out in range(SAMPLE_SIZE)]
    volumes: FloatArray = np.linalg.det(points[:, others])
    return volumes


def _refined(matrix: FloatArray, sample: _Sample) -> tuple[FloatArray, float]:
    """The transform fitted again to its inliers as long as that lowers its cost, and the cost."""
    best, cost = matrix, float(sample.costs(matrix[None])[0])
    for _ in range(REFINEMENTS):
        agreeing = sample.agreeing(best)
        if agreeing.sum() < MIN_AGREEING:
            break
        # The algebraic error of a row is the transfer error times the depth.
        depth = sample.points_a[agreeing] @ best[3]
        row_weights = 1 / (sample.tolerance[agreeing] * depth) ** 2
        fitted = dlt(sample.points_a[agreeing], sample.points_b[agreeing], row_weights / row_weights.mean())
        fitted_cost = float(sample.costs(fitted[None])[0])
        if np.linalg.det(fitted) <= 0 or fitted_cost >= cost:
            break
        best, cost = fitted, fitted_cost
    return best, cost


def dlt(points_a: FloatArray, points_b: FloatArray, row_weights: FloatArray) -> FloatArray:
    """(..., 4, 4) of unit norm with ``points_b ~ H points_a``, least squares of the algebraic error.

    Every pair gives three rows, b_i (h_4 . a) - h_i . a = 0; their normal matrix (16, 16) is made of
    the moments of a weighted by 1, b_i and |b|^2, and H is its last eigenvector. The sign puts the
    points in front of the plane at infinity.

    Args:
        points_a: (..., N, 4) homogeneous, normalised. points_b: (..., N, 3). row_weights: (..., N).
    """
    weighted = row_weights[..., None] * points_a
    moments = np.swapaxes(weighted, -1, -2) @ points_a
    normal = np.zeros((*moments.shape[:-2], 4, 4, 4, 4))
    for i in range(3):
        mixed = np.swapaxes(points_b[..., i, None] * weighted, -1, -2) @ points_a
        normal[..., i, :, i, :] = moments
        normal[..., i, :, 3, :] = normal[..., 3, :, i, :] = -mixed
    distance = (points_b**2).sum(axis=-1)[..., None]
    normal[..., 3, :, 3, :] = np.swapaxes(distance * weighted, -1, -2) @ points_a
    _, vectors = np.linalg.eigh(normal.reshape(*moments.shape[:-2], 16, 16))
    matrix = vectors[..., 0].reshape(moments.shape)
    depth = (points_a * matrix[..., 3, None, :]).sum(axis=-1)
    sign = np.where((row_weights * depth).sum(axis=-1) < 0, -1.0, 1.0)
    oriented: FloatArray = sign[..., None, None] * matrix
    return oriented
