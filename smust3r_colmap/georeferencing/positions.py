"""Positions of images against the model: the fit, the errors of the receiver, and which positions are wrong.

Nothing needs to be known of the errors before: the scale of those in the plane and of those in height is taken from
the residuals, each by itself, because the heights of a receiver are often of no use. The next module to read is
``control``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from smust3r_colmap.errors import DegenerateAlignmentError
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.sim3 import Sim3
from smust3r_colmap.georeferencing.similarity import (
    MAX_SCALE_SIGMA,
    MAX_TILT_SIGMA_DEG,
    Correspondences,
    Fit,
    consensus,
    factors,
    fit,
)
from smust3r_colmap.georeferencing.up_direction import UpDirection

OUTLIER_SIGMAS = 4.5
"""A position or a height that is further off is left out. Of 300 right ones with Gaussian errors that is none; on the
simulated flights every one of the positions moved by 200 m was beyond, and at most 1 % of the others."""
SMALLEST_SIGMA_M = 1e-3
"""Exact data shall divide by no zero."""
CONTRADICTION_SIGMAS = 3.0
"""Between a confirmed direction of up and that of the positions; beyond, the heights are wrong. (On caliterra_drone the
heights of a pocket camera drift by 100 m and would tilt the model by 38 degrees.)"""
_UNUSED_HEIGHTS = 100.0
"""Factor on the standard deviations of heights that shall say no more than how high the whole is."""
_ROUNDS = 6

Shape = str
"""point, line, plane or block."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PositionsFit:
    """The model on its positions.

    Args:
        fit: of the positions that count.
        rows: what it was fitted to, with standard deviations in the size of the errors.
        left_out: by row, why its position does not count. without_height: by row, why its height does not.
        factor_h, factor_v: errors by given standard deviations (or metres, where none were given).
        shape: of where the images were taken.
        up: the direction that was needed, or None.
        tilt_by_heights_deg: by which the heights would have tilted the model, where they are therefore not used for
            levelling; else None.
    """

    fit: Fit
    rows: Correspondences
    left_out: dict[int, str]
    without_height: dict[int, str]
    factor_h: float
    factor_v: float
    shape: Shape
    up: UpDirection | None
    tilt_by_heights_deg: float | None = None


def fit_positions(
    model: FloatArray,
    local: FloatArray,
    sigma: FloatArray,
    *,
    names: Sequence[str],
    up: UpDirection | None,
    rng: np.random.Generator,
) -> PositionsFit:
    """The similarity from camera centres to positions, without the wrong ones.

    Args:
        model: (N, 3) centres. local: (N, 3) positions; NaN heights are missing.
        sigma: (N, 2) given standard deviations in the plane and upwards; NaN where none is given.
        names: of the images, for reasons. up: used where the positions leave a turn open.

    Raises:
        DegenerateAlignmentError: too few positions, all at one place, or on a line with no direction of up.
    """
    given = _filled(sigma)
    rows = Correspondences(
        model=model,
        local=local,
        sigma=np.column_stack([given[:, 0], given[:, 0], np.where(np.isfinite(local[:, 2]), given[:, 1], np.inf)]),
        shifted=np.zeros(len(model), np.bool_),
    )
    if len(rows) < 2:
        known = f"{len(rows)} position{'s' if len(rows) != 1 else ''} of images"
        raise DegenerateAlignmentError(f"{known} can be used; at least 2 are needed, better 5")
    usable = rows if rows.complete.sum() >= 2 else _with_level_heights(rows, up)
    start = consensus(usable, rng, up_model=None if up is None else up.up_model)
    tilt = _contradiction_deg(rows, start, up)
    if tilt is not None:
        rows = rows.scaled(1.0, _UNUSED_HEIGHTS)
    fitted, factor_h, factor_v, needed = _fit(rows, start, up, least_v=1.0 if tilt is not None else 0.0)
    left_out, without_height = _wrong(rows.scaled(factor_h, factor_v), fitted, names)
    kept = np.array([k not in left_out for k in range(len(rows))])
    clean = _without_heights(rows, without_height)
    fitted, factor_h, factor_v, needed = _fit(
        clean.take(kept), fitted.local_from_model, up, least_v=1.0 if tilt is not None else 0.0
    )
    scaled = clean.scaled(factor_h, factor_v)
    _refuse_undetermined(fitted, scaled.take(kept))
    return PositionsFit(
        fit=fitted,
        rows=scaled,
        left_out=left_out,
        without_height=without_height,
        factor_h=factor_h,
        factor_v=factor_v,
        shape=shape_of(local[kept], np.median(scaled.sigma[kept, 0])),
        up=needed,
        tilt_by_heights_deg=tilt,
    )


def _contradiction_deg(rows: Correspondences, start: Sim3, up: UpDirection | None) -> float | None:
    """By how much heights tilt the model against a confirmed direction of up; None where they agree."""
    if up is None or not up.confirmed or not rows.complete.any():
        return None
    fitted, _, _, _ = _fit(rows, start, None)
    angle = float(np.degrees(np.arccos(np.clip((fitted.local_from_model.rotation @ up.up_model)[2], -1, 1))))
    uncertain = CONTRADICTION_SIGMAS * float(np.hypot(up.sigma_deg, fitted.tilt_sigma_deg))
    return angle if angle > uncertain else None


def _filled(sigma: FloatArray) -> FloatArray:
    """Where none is given the median of the others; one metre where there are no others."""
    middle = [float(np.median(column[np.isfinite(column)])) if np.isfinite(column).any() else 1.0 for column in sigma.T]
    return np.where(np.isfinite(sigma), sigma, middle)


def _with_level_heights(rows: Correspondences, up: UpDirection | None) -> Correspondences:
    """Without any height, the start takes those of the model along up, which only puts it level."""
    if up is None:
        raise DegenerateAlignmentError(
            "no position has a height, and no direction of up is known: the model cannot be levelled"
        )
    local = rows.local.copy()
    local[:, 2] = 0.0
    return Correspondences(
        model=rows.model - np.outer(rows.model @ up.up_model, up.up_model),
        local=local,
        sigma=np.ones_like(rows.sigma),
        shifted=rows.shifted,
    )


def _fit(
    rows: Correspondences, start: Sim3, up: UpDirection | None, *, least_v: float = 0.0
) -> tuple[Fit, float, float, UpDirection | None]:
    """Fit and scale of the errors in turn; the direction of up joins when the positions leave a turn open."""
    freedom = np.isfinite(rows.sigma).sum()
    correction = float(np.sqrt(freedom / max(freedom - 7, 1)))
    smallest = SMALLEST_SIGMA_M / float(np.min(rows.sigma))
    needed: UpDirection | None = None
    current, factor_h, factor_v = start, 1.0, 1.0
    residuals = rows.local - start.apply(rows.model)
    for _ in range(_ROUNDS):
        factor_h, factor_v = (max(one * correction, smallest) for one in factors(residuals, rows.sigma))
        factor_v = max(factor_v, least_v)
        scaled = rows.scaled(factor_h, factor_v)
        fitted = _fit_with(scaled, current, needed)
        if needed is None and up is not None and fitted.tilt_sigma_deg > MAX_TILT_SIGMA_DEG:
            needed = up
            fitted = _fit_with(scaled, current, up)
        current, residuals = fitted.local_from_model, fitted.residuals(rows)
    return fitted, factor_h, factor_v, needed


def _fit_with(rows: Correspondences, start: Sim3, up: UpDirection | None) -> Fit:
    return fit(rows, start) if up is None else fit(rows, start, up_model=up.up_model, up_sigma_deg=up.sigma_deg)


def _wrong(rows: Correspondences, fitted: Fit, names: Sequence[str]) -> tuple[dict[int, str], dict[int, str]]:
    residuals = fitted.residuals(rows)
    off = np.hypot(residuals[:, 0], residuals[:, 1])
    left_out, without_height = {}, {}
    for k in np.flatnonzero(off > OUTLIER_SIGMAS * rows.sigma[:, 0]):
        same = [j for j in range(len(rows)) if j != k and (rows.local[j, :2] == rows.local[k, :2]).all()]
        stood = f", the same position as {names[same[0]]}: the receiver stood still" if same else ""
        left_out[int(k)] = f"the position is {off[k]:.3g} m off{stood}"
    too_high = np.abs(residuals[:, 2]) > OUTLIER_SIGMAS * rows.sigma[:, 2]
    for k in np.flatnonzero(too_high & np.isfinite(rows.sigma[:, 2])):
        if int(k) not in left_out:
            without_height[int(k)] = f"the height is {residuals[k, 2]:+.3g} m off"
    return left_out, without_height


def _without_heights(rows: Correspondences, without: dict[int, str]) -> Correspondences:
    sigma = rows.sigma.copy()
    sigma[list(without), 2] = np.inf
    return Correspondences(model=rows.model, local=rows.local, sigma=sigma, shifted=rows.shifted)


def _refuse_undetermined(fitted: Fit, rows: Correspondences) -> None:
    extent = float(np.sqrt(np.nanvar(rows.local[:, :2], axis=0).sum()))
    sigma = float(np.median(rows.sigma[:, 0]))
    if not fitted.scale_sigma < MAX_SCALE_SIGMA:
        raise DegenerateAlignmentError(
            f"{len(rows)} positions spread over {extent:.3g} m with errors of {sigma:.2g} m: too near to one place to "
            "give the model a scale and a direction"
        )
    if not fitted.tilt_sigma_deg < 10 * MAX_TILT_SIGMA_DEG:
        raise DegenerateAlignmentError(
            f"{len(rows)} positions lie on a line, and no direction of up is known (no gimbal angles, no ground plane, "
            "no photographs held upright): the turn about the line is open"
        )


def shape_of(points: FloatArray, sigma_m: float) -> Shape:
    """By the spread along the main axes, of points (N, 3) with such errors; missing heights count as level.

    A direction counts when its spread is more than the errors and 2 % of the largest.
    """
    known = np.isfinite(points)
    middle = np.where(known, points, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    spread = np.sqrt(np.linalg.eigvalsh(np.cov(np.where(known, points, middle).T))[::-1].clip(0))
    counted = int((spread > max(2 * sigma_m, 0.02 * spread[0])).sum())
    return ("point", "line", "plane", "block")[counted]
