"""Robust losses and scales."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from smust3r_colmap.config import RobustKernel
from smust3r_colmap.geometry.arrays import FloatArray

MAD_TO_SIGMA = 1.4826
"""Standard deviation of a Gaussian over its median absolute deviation."""
TRIMMING_ROUNDS = 6
"""Of the median residual; each takes off what the one before no longer hides, and 6 rest within 1 %."""
CAUCHY_TUNING = 2.385
"""Where the Cauchy weight is 1/2, in robust standard deviations: 95 % efficient on Gaussian noise."""
TUKEY_TUNING = 4.685
"""Where Tukey's weight reaches 0, in robust standard deviations: 95 % efficient on Gaussian noise."""


@dataclass(frozen=True, kw_only=True)
class Loss:
    """A kernel with its constant; what `estimate_sim3` says of both.

    Args:
        kernel, huber_delta: as there.
        squared: take the square of a redescending kernel's weight, for refits that see nothing but
            products of two residuals (see ``affine``).
    """

    kernel: RobustKernel
    huber_delta: float = 0.1
    squared: bool = False

    def __post_init__(self) -> None:
        if self.kernel == "huber" and not self.huber_delta > 0:
            raise ValueError(f"huber_delta {self.huber_delta} must be positive")

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
    def stages(self) -> tuple[Loss, ...]:
        """Itself, and what has to converge before it."""
        return (Loss(kernel="cauchy", squared=self.squared), self) if self.kernel == "tukey" else (self,)


def evenly_chosen(count: int, limit: int) -> npt.NDArray[np.int64]:
    """At most ``limit`` of the rows 0 .. count - 1, evenly spread, ascending, without repeats."""
    return np.arange(count) if count <= limit else np.arange(limit) * count // limit
