"""Depth as 3D Gaussian Splatting's depth regulariser reads it: 16-bit inverse depth and one scale per image.

The rule of its reader: ``value / 65536 * scale + offset`` is the inverse of z, in the unit of the model, and an image
whose scale is not within 0.2 to 5 times the median of all is ignored. All images have one scale here. A value of 0 is
*infinitely far* to the reader, which is right for the sky and wrong for a hole in a wall: small holes are filled. The
next module to read is ``transforms_json``.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from smust3r_colmap.geometry.arrays import UInt16Array

INVERSE_DEPTH_STEPS = 65536
NEAREST_QUANTILE = 0.01
NEAREST_DEPTH_RATIO = 4.0
"""The scale reaches to a quarter of the depth that one in a hundred observed points is nearer than. What is nearer
still is given that depth. A scene 100 times as deep as its near points is then told in steps of 0.6 percent."""
CLOSED_HOLE_PER_SIDE = 0.02
"""Width of the holes that are closed, over the longer side of the map."""


def common_scale(observed_depths: npt.ArrayLike) -> float:
    """The scale for all images of a model, from the depths (M,) at which they observe their points."""
    near = float(np.quantile(np.asarray(observed_depths, dtype=np.float64), NEAREST_QUANTILE)) / NEAREST_DEPTH_RATIO
    return 1.0 / near


def inverse_depth_values(depth: npt.NDArray[np.float32], scale: float) -> UInt16Array:
    """(H, W) ``INVERSE_DEPTH_STEPS / (scale * z)``, rounded; 0 where there is no depth and the hole is not small."""
    inverse = np.divide(1.0, depth, out=np.zeros(depth.shape), where=depth > 0)
    values = np.rint(_with_small_holes_closed(inverse) / scale * INVERSE_DEPTH_STEPS)
    return np.clip(values, 0, INVERSE_DEPTH_STEPS - 1).astype(np.uint16)


def _with_small_holes_closed(inverse: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Pixels without depth that lie in narrow gaps take the value of the nearest pixel that has one."""
    known = (inverse > 0).astype(np.uint8)
    width = 2 * round(CLOSED_HOLE_PER_SIDE * max(inverse.shape) / 2) + 1
    closed = cv2.morphologyEx(known, cv2.MORPH_CLOSE, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (width, width)))
    gaps = (closed > 0) & (known == 0)
    if not gaps.any():
        return inverse
    _, label = cv2.distanceTransformWithLabels(1 - known, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    value_of_label = np.zeros(int(label.max()) + 1)
    value_of_label[label[known > 0]] = inverse[known > 0]
    return np.where(gaps, value_of_label[label], inverse)
