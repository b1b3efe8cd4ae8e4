"""Robust losses, scales and medians."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from smust3r_colmap.geometry.arrays import FloatArray

RobustKernel = Literal["cauchy", "tukey", "huber"]

MAD_TO_SIGMA = 1.4826
"""Standard deviation of a Gaussian over its median absolute deviation."""
TRIMMING_SIGMAS = 3.0
"""Values further from the median take no part in it."""
TRIMMING_ROUNDS = 6
"""Of the trimmed median; each removes outliers that the larger scale of the round before still admitted. With
30 % one-sided outliers the median is off by 0.07 sigma after 6 rounds (0.10 after 3), with 40 % by 0.14 (0.37); more
rounds change it by 0.02 at most."""
CAUCHY_TUNING = 2.385
"""Where the Cauchy weight is 1/2, in robust standard deviations: 95 % efficient on Gaussian noise."""
TUKEY_TUNING = 4.685
"""Where Tukey's weight reaches 0, in robust standard deviations: 95 % efficient on Gaussian noise."""


@dataclass(frozen=True, kw_only=True)
class RobustLoss:
    """A kernel with its constant.

    ``cauchy`` and ``tukey`` redescend: an outlier loses its weight. Their scale is that of the residuals.
    ``huber`` is the paper's, with a fixed constant.

    Args:
        kernel: ``"cauchy"``, ``"tukey"`` or ``"huber"``.
        huber_delta: residual where Huber's loss turns linear, in the unit of the residuals.
        squared: take the square of a redescending kernel's weight, for estimators whose normal equations
            contain products of two residuals (see ``affine3``).
    """

    kernel: RobustKernel = "cauchy"
    huber_delta: float = 0.1
    squared: bool = False

    def __post_init__(self) -> None:
        if self.kernel == "huber" and not self.huber_delta > 0:
            raise ValueError(f"huber_delta {self.huber_delta} must be positive")

    @property
    def redescends(self) -> bool:
        """Whether the weight of a residual tends to zero, on a scale taken from the residuals."""
        return self.kernel != "huber"

    def weights(self, residuals: FloatArray, sigma: float) -> FloatArray:
        """(N,) in [0, 1]: the derivative of the loss over the residual."""
        weights: FloatArray
        if self.kernel == "huber":
            return self.huber_delta / np.maximum(residuals, self.huber_delta)
        if self.kernel == "tukey":
            weights = np.maximum(1 - (residuals / (TUKEY_TUNING * sigma)) ** 2, 0.0) ** 2
        else:
            weights = 1 / (1 + (residuals / (CAUCHY_TUNING * sigma)) ** 2)
        return weights**2 if self.squared else weights

    @property
    def stages(self) -> tuple[RobustLoss, ...]:
        """Itself, and what has to converge before it: Tukey's weight is zero beyond its cut."""
        return (RobustLoss(kernel="cauchy", squared=self.squared), self) if self.kernel == "tukey" else (self,)


CAUCHY = RobustLoss()


def robust_scale(residuals: FloatArray, weights: FloatArray | None = None, *, floor: float = 0.0) -> float:
    """Robust standard deviation of residuals (N,) >= 0: 1.4826 x the median of those within three of it.

    The plain median grows with the share of outliers, by half a standard deviation at 30 %; the trimmed one does not.

    Args:
        residuals: (N,) magnitudes, N >= 1; infinite ones are outliers.
        weights: (N,) positive, of the median; None: equal.
        floor: smallest scale, so that exact data divides by no zero.

    Returns:
        The scale; infinite or NaN where most residuals are.
    """
    order = np.argsort(residuals)
    rising, mass = residuals[order], np.cumsum(np.ones(len(order)) if weights is None else weights[order])
    num_near = len(rising)
    for _ in range(TRIMMING_ROUNDS):
        middle = np.searchsorted(mass, 0.5 * mass[num_near - 1])
        sigma = MAD_TO_SIGMA * float(rising[middle])
        if not np.isfinite(sigma):
            return sigma
        sigma = max(sigma, floor)
        num_near = int(np.searchsorted(rising, TRIMMING_SIGMAS * sigma, side="right"))
    return sigma


def mad_sigma(values: npt.NDArray[np.floating]) -> float:
    """Robust standard deviation of values (N,) about their median: 1.4826 x their median absolute deviation."""
    return MAD_TO_SIGMA * float(np.median(np.abs(values - np.median(values))))


def weighted_median(values: FloatArray, weights: FloatArray) -> float:
    """The value at which half of the weight is reached, interpolated between neighbours.

    With equal weights this is the plain median, also of an even number of values; numpy's weighted quantiles
    (``inverted_cdf``) do not interpolate.
    """
    order = np.argsort(values, kind="stable")
    cumulative = np.cumsum(weights[order]) - 0.5 * weights[order]
    return float(np.interp(0.5 * weights.sum(), cumulative, values[order]))


def trimmed_median(values: FloatArray, weights: FloatArray | None = None) -> float:
    """Median of the values within three robust standard deviations of it; NaN where there are none.

    Args:
        values: (N,) finite. weights: (N,) non-negative, of the median; None: equal.
    """
    if len(values) == 0:
        return float("nan")
    weights = np.ones(len(values)) if weights is None else weights
    near = np.ones(len(values), dtype=np.bool_)
    for _ in range(TRIMMING_ROUNDS):
        centre = weighted_median(values[near], weights[near])
        distances = np.abs(values - centre)
        sigma = MAD_TO_SIGMA * weighted_median(distances[near], weights[near])
        near = distances <= TRIMMING_SIGMAS * sigma
    return centre


def evenly_chosen(count: int, limit: int) -> npt.NDArray[np.int64]:
    """At most ``limit`` of the rows 0 .. count - 1, evenly spread, ascending, without repeats."""
    return np.arange(count) if count <= limit else np.arange(limit) * count // limit
