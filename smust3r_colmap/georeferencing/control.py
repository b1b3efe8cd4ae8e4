"""Control points against the model: the fit, and which points are wrong, by leaving each out of it.

The next module to read is ``accuracy``.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy import stats

from smust3r_colmap.errors import DegenerateAlignmentError
from smust3r_colmap.estimators.similarity import fit_similarity
from smust3r_colmap.geometry.arrays import BoolArray, FloatArray
from smust3r_colmap.geometry.sim3 import Sim3
from smust3r_colmap.georeferencing.similarity import Correspondences, Fit, fit

DEFAULT_SIGMA_H_M, DEFAULT_SIGMA_V_M = 0.02, 0.03
"""Of a surveyed point whose list says nothing: those of a satellite receiver with corrections."""
FALSE_ALARMS = 0.05
"""Probability that a set of right points has one that is left out, with Gaussian errors of a size not known before.
(Chosen on copr_gcp, whose wrong point has 0.04: nine points of a hand-held receiver prove no more.)"""
MAX_OPEN_DEG = 30.0
"""Of a turn; points that leave more open, as those on a line do, cannot say whether one beside them is wrong."""
MIN_CONTROL = 3
"""Points with three coordinates that a fit to control points needs."""
_MOST_FOR_PAIRS = 12
"""Control points of which every two are tried; the time grows with the square."""
_IN_PLANE, _IN_HEIGHT = 4, 3
"""Parameters of a similarity that coordinates in the plane and heights determine, for points that are about level."""
_ROUNDS = 3


@dataclass(frozen=True, kw_only=True, eq=False)
class ControlFit:
    """The model on its control points.

    Args:
        fit: of the points that count. rows: what it was fitted to, with standard deviations in the size of the errors.
        left_out: by row, why the point does not count.
        leave_one_out: (N, 3) metres, coordinates of each point less those predicted by a fit to the others; NaN
            where the others determine none, or the coordinate does not count.
        factor_h, factor_v: errors by given standard deviations, at least 1.
    """

    fit: Fit
    rows: Correspondences
    left_out: dict[int, str]
    leave_one_out: FloatArray
    factor_h: float
    factor_v: float


def fit_control(rows: Correspondences) -> ControlFit:
    """The similarity from points of the model to surveyed coordinates, without the wrong points.

    The most conspicuous point is left out, then the next one, as long as one is significant; where none is, two at a
    time are tried, for two wrong points hide each other.

    Args:
        rows: with the standard deviations of the survey; at least three complete ones.

    Raises:
        DegenerateAlignmentError: fewer than three complete points.
    """
    complete = rows.take(rows.complete)
    if len(complete) < MIN_CONTROL:
        raise DegenerateAlignmentError(
            f"{len(complete)} control points with three coordinates are in the model; at least {MIN_CONTROL} are needed"
        )
    start = fit_similarity(complete.model, complete.local)
    left_out: dict[int, str] = {}
    while True:
        kept = np.array([k not in left_out for k in range(len(rows))])
        fitted, factor_h, factor_v = scaled_fit(rows.take(kept), start)
        start = fitted.local_from_model
        wrong = _most_conspicuous(rows, kept, start)
        if not wrong:
            break
        for k, residual in wrong.items():
            left_out[k] = f"{np.linalg.norm(np.nan_to_num(residual)):.3g} m from where the other points put it"
    leave_one_out = np.full((len(rows), 3), np.nan)
    for k in np.flatnonzero(kept).tolist():
        leave_one_out[k] = _Left.out(rows, kept, (k,), start).residuals[0]
    return ControlFit(
        fit=fitted,
        rows=rows.scaled(factor_h, factor_v),
        left_out=left_out,
        leave_one_out=leave_one_out,
        factor_h=factor_h,
        factor_v=factor_v,
    )


def scaled_fit(rows: Correspondences, start: Sim3) -> tuple[Fit, float, float]:
    """Least squares, and errors by standard deviations; those of the survey are the least that is believed."""
    factor_h = factor_v = 1.0
    for _ in range(_ROUNDS):
        fitted = fit(rows.scaled(factor_h, factor_v), start, robust=False)
        start = fitted.local_from_model
        scaled = fitted.residuals(rows) / rows.sigma
        factor_h = _rms(scaled[:, :2], _IN_PLANE)
        factor_v = _rms(scaled[:, 2:], _IN_HEIGHT)
    return fitted, factor_h, factor_v


def _rms(scaled: FloatArray, parameters: int) -> float:
    """At least 1; infinite standard deviations have made zeros of what does not count."""
    counted = scaled[np.isfinite(scaled) & (scaled != 0)]
    freedom = len(counted) - parameters
    return max(1.0, float(np.sqrt((counted**2).sum() / freedom))) if freedom > 0 else 1.0


def _most_conspicuous(rows: Correspondences, kept: BoolArray, start: Sim3) -> dict[int, FloatArray]:
    """The one or two points that are least probable by chance, with their residuals; none where none is significant."""
    candidates = np.flatnonzero(kept).tolist()
    for size in (1, 2) if len(candidates) <= _MOST_FOR_PAIRS else (1,):
        subsets = list(combinations(candidates, size))
        tried = [_Left.out(rows, kept, subset, start) for subset in subsets]
        best = min(range(len(tried)), key=lambda k: tried[k].probability)
        if tried[best].probability < FALSE_ALARMS / len(subsets):
            return dict(zip(subsets[best], tried[best].residuals, strict=True))
    return {}


@dataclass(frozen=True, kw_only=True, eq=False)
class _Left:
    """Points left out of the fit.

    Args:
        residuals: (m, 3) by the fit to the others; NaN where they determine none, or the coordinate does not count.
        probability: of the least conspicuous of them, that its residual comes by chance.
    """

    residuals: FloatArray
    probability: float

    @classmethod
    def out(cls, rows: Correspondences, kept: BoolArray, subset: tuple[int, ...], start: Sim3) -> _Left:
        others = kept.copy()
        others[list(subset)] = False
        used, own = rows.take(others), rows.take(np.isin(np.arange(len(rows)), subset))
        if used.complete.sum() < MIN_CONTROL:
            return cls(residuals=np.full((len(subset), 3), np.nan), probability=1.0)
        fitted, factor_h, factor_v = scaled_fit(used, start)
        if not fitted.tilt_sigma_deg < MAX_OPEN_DEG:
            return cls(residuals=np.full((len(subset), 3), np.nan), probability=1.0)
        residuals = np.where(np.isfinite(own.sigma), fitted.residuals(own), np.nan)
        covariances = fitted.covariance_of(own.model) + np.einsum(
            "ni,ij->nij", own.scaled(factor_h, factor_v).sigma ** 2, np.eye(3)
        )
        freedom = np.isfinite(used.sigma).sum(axis=0)
        probability = max(
            min(
                1.0,
                2 * _chance(residual, covariance, [0, 1], int(freedom[:2].sum()) - _IN_PLANE),
                2 * _chance(residual, covariance, [2], int(freedom[2]) - _IN_HEIGHT),
            )
            for residual, covariance in zip(residuals, covariances, strict=True)
        )
        return cls(residuals=residuals, probability=probability)


def _chance(residual: FloatArray, covariance: FloatArray, axes: list[int], freedom: int) -> float:
    """Probability of so large a residual along these axes, by the F distribution; 1 where it does not count."""
    counted = [k for k in axes if np.isfinite(residual[k])]
    if not counted or freedom <= 0:
        return 1.0
    part = residual[counted]
    distance = float(part @ np.linalg.solve(covariance[np.ix_(counted, counted)], part))
    return float(stats.f.sf(distance / len(counted), len(counted), freedom))
