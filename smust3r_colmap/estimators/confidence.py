"""Confidence corrected by comparison: the same image reconstructed in two segments (paper eq. 1).

Two neighbouring segments reconstruct their common images independently; where their depths differ,
at least one is wrong, and neither should be trusted. The module ``alignment.from_pointmaps`` uses
the corrected confidences as weights.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
import numpy.typing as npt

from smust3r_colmap.estimators.robust import trimmed_median
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.depth_noise import SUBMODEL_AGREEMENT

ConfidenceWeighting = Literal["relative", "paper", "off"]


def reweighted(
    confidence_i: npt.ArrayLike,
    confidence_j: npt.ArrayLike,
    depth_i: npt.ArrayLike,
    depth_j: npt.ArrayLike,
    *,
    mode: ConfidenceWeighting,
) -> tuple[FloatArray, FloatArray]:
    """Confidences of one image in segments i and j after comparing its depths there.

    ``"paper"``: w = c_i c_j / (1 + |d_i - d_j|), c' = w c, as printed. The result lies in (0, c^3], no
    longer has 1 as "none", and depends on the unit and on the relative scale of the segments, so it
    serves as a weight but not for a fixed threshold.

    ``"relative"``: the difference is divided by the depth after both maps were brought to one scale,
    and the product of the confidences is left out: c' = 1 + w (c - 1), w = 1 / (1 + |d_i - d_j| / (0.05 d)),
    so that half of the confidence is left at ``SUBMODEL_AGREEMENT``. (The 1 of the paper's formula is 1 m, at
    depths of 2 to 4 m indoors a disagreement of 0.25 to 0.5.)
    Pixels that agree keep their confidence, pixels that do not fall towards 1, so that c' lies in
    [1, c] and thresholds on a confidence keep their meaning.

    ``"off"``: unchanged.

    Args:
        confidence_i, confidence_j: of one shape, at least 1.
        depth_i, depth_j: of the same shape, each in the unit of its own segment; zero, negative or
            non-finite means none. A pixel without depth on either side keeps its
            confidences and takes no part in the common scale.

    Returns:
        Both new confidences, float64, of the same shape.

    Raises:
        ValueError: the shapes differ.
    """
    c_i, c_j, d_i, d_j = (
        np.asarray(values, dtype=np.float64) for values in (confidence_i, confidence_j, depth_i, depth_j)
    )
    if not c_i.shape == c_j.shape == d_i.shape == d_j.shape:
        raise ValueError(f"confidences {c_i.shape}, {c_j.shape} and depths {d_i.shape}, {d_j.shape} differ in shape")
    if mode == "off":
        return c_i.copy(), c_j.copy()
    both = np.isfinite(d_i) & np.isfinite(d_j) & (d_i > 0) & (d_j > 0)
    if mode == "paper":
        w = np.divide(c_i * c_j, 1 + np.abs(d_i - d_j), out=np.ones_like(c_i), where=both)  # eq. 1
        return w * c_i, w * c_j
    w = np.ones_like(c_i)
    w[both] = 1 / (1 + _relative_difference(c_i[both], c_j[both], d_i[both], d_j[both]) / SUBMODEL_AGREEMENT)
    return 1 + w * (c_i - 1), 1 + w * (c_j - 1)


def _relative_difference(c_i: FloatArray, c_j: FloatArray, d_i: FloatArray, d_j: FloatArray) -> FloatArray:
    """(N,) depth difference over mean depth, both at the scale on which most confident pixels agree."""
    confident = (c_i > 1) & (c_j > 1)
    log_ratio = np.log(d_i / d_j)
    i_from_j = np.exp(trimmed_median(log_ratio[confident] if confident.any() else log_ratio))
    difference: FloatArray = np.abs(d_i - i_from_j * d_j) / (0.5 * (d_i + i_from_j * d_j))
    return difference
