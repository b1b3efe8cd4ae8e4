"""Depth maps of the whole image from those of the centre crop that the network saw.

Other stages want maps that cover the whole image, uniformly resized (see ``products.DenseMaps``); the network
saw a centre crop at a scale that differs a little between the axes. `to_full_image` carries depth and confidence
over, at about one map pixel per network pixel. The next module to read is ``network``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from smust3r_colmap.backbones.must3r.preprocessing import NetworkWindow
from smust3r_colmap.geometry.arrays import Float32Array, FloatArray, IntArray
from smust3r_colmap.geometry.depth_noise import ADJACENT_PIXELS

LARGEST_CONFIDENCE = float(np.finfo(np.float16).max)
"""Confidences are stored as half floats; an exponential of a network may be infinite."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FullImageMaps:
    """Depth (H, W) float32, 0 where there is none, and confidence (H, W) float32, 1 there and more elsewhere."""

    depth: Float32Array
    confidence: Float32Array


def full_size(window: NetworkWindow) -> tuple[int, int]:
    """(H, W) of the whole image, resized so that a pixel is as large as one of the network, up to rounding."""
    scale = float(np.sqrt(np.prod(window.orig_px_per_net_px)))
    return max(1, round(window.height_orig / scale)), max(1, round(window.width_orig / scale))


def to_full_image(depth: npt.ArrayLike, confidence: npt.ArrayLike, window: NetworkWindow) -> FullImageMaps:
    """The network's maps of one image on the grid of the whole image.

    Inverse depth is interpolated between four neighbours of one surface, which is exact on planes; between
    surfaces the nearest pixel is taken, so that no point flies in between. Confidence is that of the nearest pixel.

    Args:
        depth: (h, w) z-depth, the third coordinate of the network's points in the camera times the depth factor of the
            fitted camera; not positive or not finite means none.
        confidence: (h, w), at least 1; of a pixel where it is not a number, the depth counts as none.
        window: of the image.

    Raises:
        ValueError: a map has another size than the window.
    """
    z, certain = np.asarray(depth, dtype=np.float64), np.asarray(confidence, dtype=np.float64)
    if z.shape != (window.height, window.width) or certain.shape != z.shape:
        raise ValueError(f"maps {z.shape} and {certain.shape}, needed {(window.height, window.width)} for the window")
    height, width = full_size(window)
    scale_x, scale_y = window.orig_px_per_net_px
    # Centres of the map's pixels, in network pixels whose centres are whole numbers.
    x_net = ((np.arange(width) + 0.5) * window.width_orig / width - window.left) / scale_x - 0.5
    y_net = ((np.arange(height) + 0.5) * window.height_orig / height - window.top) / scale_y - 0.5
    rows, columns = _within(y_net, window.height), _within(x_net, window.width)
    inner = _interpolated(z, certain, y_net[rows], x_net[columns])
    whole = FullImageMaps(depth=np.zeros((height, width), np.float32), confidence=np.ones((height, width), np.float32))
    whole.depth[rows, columns], whole.confidence[rows, columns] = inner.depth, inner.confidence
    return whole


def _within(positions: FloatArray, count: int) -> slice:
    """The positions, ascending, that lie on one of so many pixels."""
    return slice(int(np.searchsorted(positions, -0.5)), int(np.searchsorted(positions, count - 0.5, side="right")))


def _interpolated(z: FloatArray, confidence: FloatArray, y: FloatArray, x: FloatArray) -> FullImageMaps:
    """Maps at rows y and columns x (pixel centres being whole numbers), at most half a pixel beyond the border."""
    valid = np.isfinite(z) & (z > 0) & ~np.isnan(confidence)
    inverse = np.divide(1.0, z, out=np.zeros_like(z), where=valid)
    nearest = np.ix_(_nearest(y, z.shape[0]), _nearest(x, z.shape[1]))
    top, left = _first_of_two(y, z.shape[0]), _first_of_two(x, z.shape[1])
    corners = np.array([inverse[np.ix_(top + i, left + j)] for i in (0, 1) for j in (0, 1)])  # (4, H, W)
    down, right = (y - top)[:, None], x - left  # beyond 0 to 1 at the border, where the surface is continued
    blended = (1 - down) * ((1 - right) * corners[0] + right * corners[1]) + down * (
        (1 - right) * corners[2] + right * corners[3]
    )
    one_surface = (corners.min(axis=0) > 0) & (corners.max(axis=0) <= (1 + ADJACENT_PIXELS) * corners.min(axis=0))
    inverse_out = np.where(one_surface, blended, inverse[nearest])
    seen = inverse_out > 0
    depth = np.divide(1.0, inverse_out, out=np.zeros_like(inverse_out), where=seen)
    certain = np.where(seen, np.clip(confidence[nearest], 1.0, LARGEST_CONFIDENCE), 1.0)
    return FullImageMaps(depth=depth.astype(np.float32), confidence=certain.astype(np.float32))


def _nearest(positions: FloatArray, count: int) -> IntArray:
    return np.clip(np.rint(positions).astype(np.int64), 0, count - 1)


def _first_of_two(positions: FloatArray, count: int) -> IntArray:
    """The first of the two neighbours; at the border the last two inside."""
    return np.clip(np.floor(positions).astype(np.int64), 0, count - 2)
