"""Small statistics that stages share."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt


def weighted_median(values: npt.NDArray[np.float64], weights: npt.NDArray[np.float64]) -> float:
    """The value at which half of the weight is reached, interpolated between neighbours."""
    order = np.argsort(values, kind="stable")
    cumulative = np.cumsum(weights[order]) - 0.5 * weights[order]
    return float(np.interp(0.5 * weights.sum(), cumulative, values[order]))
