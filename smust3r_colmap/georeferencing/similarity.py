"""The similarity between model and ground: by consensus, then by weighted least squares that outliers lose weight in.

Rows are camera centres with their positions, or points with their coordinates; a coordinate that does not count has an
infinite standard deviation. What the rows leave open, the eigenvalues of the normal equations say: with positions on a
line it is the turn about it, which then takes a direction of up. The next module to read is ``positions``.

Source: Umeyama 1991 for the closed form of three points; Rousseeuw 1984 for the consensus (least median of squares, as
nothing is known of the errors before).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from smust3r_colmap.errors import DegenerateAlignmentError
from smust3r_colmap.estimators.robust import CAUCHY_TUNING, mad_sigma
from smust3r_colmap.estimators.similarity import fit_similarity
from smust3r_colmap.geometry.arrays import BoolArray, FloatArray
from smust3r_colmap.geometry.sim3 import Sim3
from smust3r_colmap.geometry.so3 import skew

MAX_TILT_SIGMA_DEG = 2.0
"""A turn that is known less well than this is taken from a direction of up, where there is one. (Chosen on simulated
flights: plain GPS over a block of 36 images leaves about one degree, over a line it leaves the turn open.)"""
MAX_SCALE_SIGMA = 0.1
"""Relative; a scale that is known less well is none."""
_TRIALS = 500
"""Of the consensus: with 40 % of wrong rows, one trial of three is right with probability 0.22, all fail with 1e-54."""
_MIN_TRIANGLE = 1e-3
"""Smallest height over base of three points that a trial is made from."""
_ROUNDS = 60
_CONVERGED = 1e-10


@dataclass(frozen=True, kw_only=True, eq=False)
class Correspondences:
    """Points of the model and where they are on the ground.

    Args:
        model: (N, 3). local: (N, 3) metres east, north, up; NaN where ``sigma`` is infinite.
        sigma: (N, 3) standard deviations in metres; infinite: the coordinate does not count.
        shifted: (N,) rows whose local coordinates have an offset in common that is to be found, as those of GPS beside
            control points have.
    """

    model: FloatArray
    local: FloatArray
    sigma: FloatArray
    shifted: BoolArray

    def __len__(self) -> int:
        return len(self.model)

    @property
    def complete(self) -> BoolArray:
        """(N,) all three coordinates count."""
        return np.asarray(np.isfinite(self.sigma).all(axis=1), np.bool_)

    def take(self, rows: BoolArray) -> Correspondences:
        """Some of the rows."""
        return Correspondences(
            model=self.model[rows], local=self.local[rows], sigma=self.sigma[rows], shifted=self.shifted[rows]
        )

    def scaled(self, horizontal: float, vertical: float) -> Correspondences:
        """With larger standard deviations."""
        return replace(self, sigma=self.sigma * np.array([horizontal, horizontal, vertical]))

    def joined(self, other: Correspondences) -> Correspondences:
        """The rows of both."""
        return Correspondences(
            model=np.vstack([self.model, other.model]),
            local=np.vstack([self.local, other.local]),
            sigma=np.vstack([self.sigma, other.sigma]),
            shifted=np.concatenate([self.shifted, other.shifted]),
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Fit:
    """A similarity with what is known of it.

    Args:
        local_from_model: the similarity. offset_m: (3,) of the shifted rows; zero where there are none.
        information: (7, 7) of (translation, rotation vector, log scale) about ``centre_local``, the offset eliminated,
            for standard deviations that are true.
        centre_local: (3,).
    """

    local_from_model: Sim3
    offset_m: FloatArray
    information: FloatArray
    centre_local: FloatArray

    def residuals(self, rows: Correspondences) -> FloatArray:
        """(N, 3) metres, measured less predicted; NaN where nothing was measured."""
        predicted = self.local_from_model.apply(rows.model) + np.where(rows.shifted[:, None], self.offset_m, 0.0)
        residuals: FloatArray = rows.local - predicted
        return residuals

    @property
    def tilt_sigma_deg(self) -> float:
        """Standard deviation of the turn that is known least; infinite where nothing decides it."""
        return float(np.degrees(_largest_sigma(self.information, [3, 4, 5])))

    @property
    def weakest_axis(self) -> FloatArray:
        """(3,) of the turn that is known least, in the local frame."""
        _, vectors = np.linalg.eigh(_marginal(self.information, [3, 4, 5]))
        axis: FloatArray = vectors[:, 0]
        return axis

    @property
    def scale_sigma(self) -> float:
        """Relative standard deviation of the scale."""
        return _largest_sigma(self.information, [6])

    def covariance_of(self, model: FloatArray) -> FloatArray:
        """(N, 3, 3) of where points (N, 3) of the model come to lie."""
        jacobian = _jacobian(self.local_from_model.apply(model), self.centre_local)
        return np.asarray(jacobian @ np.linalg.pinv(self.information) @ jacobian.transpose(0, 2, 1))


def _marginal(information: FloatArray, kept: list[int]) -> FloatArray:
    """The information of some parameters when the others are free (Schur complement)."""
    others = [k for k in range(len(information)) if k not in kept]
    cross = information[np.ix_(kept, others)]
    inner = np.linalg.pinv(information[np.ix_(others, others)], hermitian=True)
    marginal = information[np.ix_(kept, kept)] - cross @ inner @ cross.T
    return np.asarray((marginal + marginal.T) / 2, np.float64)


def _largest_sigma(information: FloatArray, kept: list[int]) -> float:
    smallest = float(np.linalg.eigvalsh(_marginal(information, kept))[0])
    largest = float(np.trace(information))
    return float("inf") if smallest <= 1e-12 * largest else smallest**-0.5


# ------------------------------------------------------------------------------ consensus
def consensus(rows: Correspondences, rng: np.random.Generator, *, up_model: FloatArray | None = None) -> Sim3:
    """The similarity that most complete rows agree with.

    Trials are three rows each, and, where a direction of up is given, also two rows with it: heights then decide
    nothing, and rows may lie on a line.

    Args:
        rows: at least two complete ones. up_model: (3,) unit vector upwards in the model.

    Raises:
        DegenerateAlignmentError: no trial gives a similarity.
    """
    usable = rows.take(rows.complete)
    best, best_score = None, np.inf
    for trial in range(_TRIALS * (1 if up_model is None else 2)):
        with_up = up_model is not None and trial % 2 == 1
        count = 2 if with_up else 3
        if len(usable) < count:
            continue
        chosen = rng.choice(len(usable), count, replace=False)
        a, b = usable.model[chosen], usable.local[chosen]
        candidate = of_two(a, b, up_model) if with_up and up_model is not None else _of_three(a, b)
        if candidate is not None:
            score = _spread(usable.local - candidate.apply(usable.model), usable.sigma)
            if score < best_score:
                best, best_score = candidate, score
    if best is None:
        raise DegenerateAlignmentError(
            f"{len(usable)} positions in three dimensions do not determine where the model is: they coincide or lie on "
            "a line, and no direction of up is known"
        )
    return best


def _spread(residuals: FloatArray, sigma: FloatArray) -> float:
    """Log of the volume that most residuals lie in: heights and plane each by their own scale."""
    scaled = np.abs(residuals / sigma)
    horizontal = np.median(np.hypot(scaled[:, 0], scaled[:, 1]))
    return float(2 * np.log(horizontal + 1e-6) + np.log(np.median(scaled[:, 2]) + 1e-6))


def _of_three(a: FloatArray, b: FloatArray) -> Sim3 | None:
    for points in (a, b):
        lengths = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        if not lengths[1] > _MIN_TRIANGLE * lengths[0]:
            return None
    fitted = fit_similarity(a, b)
    return fitted if fitted.scale > 0 else None


def of_two(a: FloatArray, b: FloatArray, up_model: FloatArray) -> Sim3 | None:
    """By the horizontal direction and distance between two points, with up (3,) as given.

    Args:
        a, b: (2, 3) in the model and on the ground.

    Returns:
        None where one lies above the other.
    """
    across_a = a[1] - a[0] - up_model * (up_model @ (a[1] - a[0]))
    across_b = (b[1] - b[0]) * np.array([1.0, 1.0, 0.0])
    length_a, length_b = np.linalg.norm(across_a), np.linalg.norm(across_b)
    if not (length_a > 0 and length_b > 0):
        return None
    e_a, e_b, z_b = across_a / length_a, across_b / length_b, np.array([0.0, 0.0, 1.0])
    rotation = np.column_stack([e_b, np.cross(z_b, e_b), z_b]) @ np.vstack([e_a, np.cross(up_model, e_a), up_model])
    scale = length_b / length_a
    translation = b.mean(axis=0) - scale * rotation @ a.mean(axis=0)
    return Sim3(scale=np.asarray(scale), rotation=rotation, translation=translation)


# -------------------------------------------------------------------------- least squares
def fit(
    rows: Correspondences,
    start: Sim3,
    *,
    up_model: FloatArray | None = None,
    up_sigma_deg: float = 1.0,
    robust: bool = True,
) -> Fit:
    """Weighted least squares from a start, by Gauss and Newton; with ``robust`` under Cauchy's loss.

    Args:
        rows: with standard deviations that are about true.
        start: near the solution.
        up_model: (3,) unit vector upwards in the model, an observation with ``up_sigma_deg``; None: there is none.

    Source: the Jacobian of ``(1 + lambda) exp(w) (y - c) + c + t`` at zero.
    """
    counts = np.isfinite(rows.sigma) & np.isfinite(rows.local)
    weights = np.where(counts, 1 / rows.sigma, 0.0)
    measured = np.where(counts, rows.local, 0.0)
    has_offset = bool(rows.shifted.any()) and not rows.shifted.all()
    similarity, offset = start, np.zeros(3)
    last = np.inf
    for _ in range(_ROUNDS):
        y = similarity.apply(rows.model)
        centre = y.mean(axis=0)
        residuals = (measured - y - np.where(rows.shifted[:, None], offset, 0.0)) * weights  # (N, 3)
        loss = _cauchy(residuals, counts) if robust else np.ones(len(rows))
        jacobian = _jacobian(y, centre) * weights[:, :, None]
        if has_offset:
            jacobian = np.concatenate([jacobian, (rows.shifted[:, None, None] * np.eye(3)) * weights[:, :, None]], 2)
        information = np.einsum("nki,n,nkj->ij", jacobian, loss, jacobian)
        gradient = np.einsum("nki,n,nk->i", jacobian, loss, residuals)
        if up_model is not None:
            turn, missing = _up_rows(similarity.rotation @ up_model, up_sigma_deg)
            information[3:6, 3:6] += turn.T @ turn
            gradient[3:6] += turn.T @ missing
        step = np.linalg.pinv(information, rcond=1e-13, hermitian=True) @ gradient
        similarity, offset = _moved(similarity, step[:7], centre), offset + (step[7:] if has_offset else 0.0)
        change = float(step @ information @ step)
        if change < _CONVERGED or not change < 1e3 * last:
            break
        last = change
    marginal = _marginal(information, list(range(7))) if has_offset else information
    return Fit(local_from_model=similarity, offset_m=offset, information=marginal, centre_local=centre)


def _jacobian(y: FloatArray, centre: FloatArray) -> FloatArray:
    """(N, 3, 7) of points by (translation, rotation vector, log scale) about the centre."""
    arm = y - centre
    identity = np.broadcast_to(np.eye(3), (len(y), 3, 3))
    return np.concatenate([identity, -skew(arm), arm[:, :, None]], axis=2)


def _cauchy(residuals: FloatArray, counts: BoolArray) -> FloatArray:
    """(N,) weights; a row has as many squares to its norm as coordinates that count."""
    mean_square = (residuals**2).sum(axis=1) / np.maximum(counts.sum(axis=1), 1)
    weights: FloatArray = 1 / (1 + mean_square / CAUCHY_TUNING**2)
    return weights


def _up_rows(up_local: FloatArray, sigma_deg: float) -> tuple[FloatArray, FloatArray]:
    """(2, 3) Jacobian by the rotation vector and (2,) residual of the horizontal part of up, which shall be zero."""
    sigma = np.radians(sigma_deg)
    return -skew(up_local)[:2] / sigma, -up_local[:2] / sigma


def _moved(similarity: Sim3, step: FloatArray, centre: FloatArray) -> Sim3:
    """``(1 + lambda) exp(w) (y - c) + c + t`` after the similarity; steps are kept short, so that none overshoots."""
    w = step[3:6] * min(1.0, 0.5 / max(float(np.linalg.norm(step[3:6])), 1e-12))
    growth = float(np.exp(np.clip(step[6], -0.5, 0.5)))
    turn = Rotation.from_rotvec(w).as_matrix()
    rotation = turn @ similarity.rotation
    translation = growth * turn @ (similarity.translation - centre) + centre + step[:3]
    return Sim3(scale=similarity.scale * growth, rotation=rotation, translation=translation)


def factors(residuals: FloatArray, sigma: FloatArray) -> tuple[float, float]:
    """By how much residuals (N, 3) are larger than their standard deviations: in the plane, and upwards.

    Robust: 1.4826 times the median deviation from zero, of each axis in the plane. 1 where there are none.
    """
    scaled = residuals / sigma
    counts = np.isfinite(scaled) & (sigma < np.inf)
    plane, height = scaled[:, :2][counts[:, :2]], scaled[:, 2][counts[:, 2]]
    return tuple(  # type: ignore[return-value]
        mad_sigma(np.concatenate([values, -values])) if len(values) else 1.0 for values in (plane, height)
    )
