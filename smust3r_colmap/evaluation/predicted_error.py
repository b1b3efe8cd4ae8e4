"""Predicted against true errors of camera positions: how large, and how often within a multiple of sigma.

The next module to read is ``evaluate``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from smust3r_colmap.geometry.arrays import FloatArray

MULTIPLES = (1, 2, 3)


@dataclass(frozen=True, kw_only=True)
class PredictedErrors:
    """Of K images.

    Args:
        true_rmse, predicted_rmse: root mean square of the errors, and of the standard deviations.
        within: for one, two and three standard deviations, the percentage of images with an error not above that.
    """

    true_rmse: float
    predicted_rmse: float
    within: tuple[float, float, float]

    @classmethod
    def of(cls, errors: FloatArray, sigmas: FloatArray) -> PredictedErrors:
        """Of errors (K,) and their predicted standard deviations (K,) in one unit, K at least 1."""
        one, two, three = (float(100 * np.mean(errors <= multiple * sigmas)) for multiple in MULTIPLES)
        return cls(
            true_rmse=float(np.sqrt(np.mean(errors**2))),
            predicted_rmse=float(np.sqrt(np.mean(sigmas**2))),
            within=(one, two, three),
        )
