"""Figures of residuals, as surveyors state them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from smust3r_colmap.geometry.arrays import FloatArray


@dataclass(frozen=True, kw_only=True)
class Accuracy:
    """Of residuals, measured less computed, in metres; NaN where no residual has the coordinate.

    Args:
        count: residuals. mean, rmse: (x, y, z). horizontal, spatial: RMSE of the lengths, of two and three coordinates.
        ce90, le90: horizontal and vertical error that 90 % of the residuals do not exceed.
    """

    count: int
    mean: tuple[float, float, float]
    rmse: tuple[float, float, float]
    horizontal: float
    spatial: float
    ce90: float
    le90: float

    @classmethod
    def of(cls, residuals: FloatArray) -> Accuracy | None:
        """Of (N, 3), NaN where a coordinate was not measured; None where there is nothing."""
        rows = residuals[np.isfinite(residuals).any(axis=1)]
        if not len(rows):
            return None
        columns = [column[np.isfinite(column)] for column in rows.T]
        x, y, z = (float(column.mean()) if len(column) else float("nan") for column in columns)
        rmse_x, rmse_y, rmse_z = (_rms(column) for column in columns)
        across = np.hypot(rows[:, 0], rows[:, 1])
        return cls(
            count=len(rows),
            mean=(x, y, z),
            rmse=(rmse_x, rmse_y, rmse_z),
            horizontal=float(np.hypot(rmse_x, rmse_y)),
            spatial=_rms(np.linalg.norm(rows[np.isfinite(rows).all(axis=1)], axis=1)),
            ce90=_quantile(across[np.isfinite(across)]),
            le90=_quantile(np.abs(columns[2])),
        )


def _rms(values: FloatArray) -> float:
    return float(np.sqrt((values**2).mean())) if len(values) else float("nan")


def _quantile(values: FloatArray) -> float:
    """The smallest of the values that 90 % do not exceed."""
    return float(np.quantile(values, 0.9, method="higher")) if len(values) else float("nan")
