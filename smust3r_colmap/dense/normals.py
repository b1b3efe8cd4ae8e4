"""Surface normals of a depth map.

The next module to read is ``point_cloud``.
"""

from __future__ import annotations

import numpy as np

from smust3r_colmap.geometry.arrays import BoolArray, Float32Array, FloatArray
from smust3r_colmap.geometry.depth_noise import WINDOW_PIXELS

NORMAL_RADIUS_PX = 3
"""Pixels round a pixel whose depth makes its normal. Depth of neighbouring pixels scatters by about a percent, which
over one pixel's width turns a normal by 45 degrees, and over seven by a few."""
MIN_NORMAL_PIXELS = 8
"""Pixels on the same surface that a normal needs."""


def surface_normals(depth: Float32Array, xy: FloatArray) -> tuple[Float32Array, BoolArray]:
    """Unit normals (H, W, 3) in the camera's axes, facing the camera, and (H, W) where the surface gives them.

    The inverse depth of a plane n . x = 1 is n . (x, y, 1), with (x, y) where its points are seen at z = 1. The
    slopes of inverse depth along rows and columns are fitted by least squares to the window of ``NORMAL_RADIUS_PX``
    round each pixel, to pixels of the same surface only; the slopes of x and y are those between adjacent pixels.
    Together they give n, also for cameras with distortion. Pixels with fewer than ``MIN_NORMAL_PIXELS`` such
    neighbours, with all of them on a line, or without x and y beside them, face the camera.

    Args:
        depth: (H, W) z-depth, 0 where there is none; the normal is zero there.
        xy: (H, W, 2) where the pixels see at z = 1; NaN where unknown.
    """
    known = depth > 0
    inverse = np.divide(1, depth, out=np.zeros_like(depth), where=known)
    slopes, determined = _fitted_slopes(_window_sums(inverse, known))
    plane, has_xy = _planes(inverse, slopes, np.where(known[..., None], xy, np.nan))
    determined &= known & has_xy
    viewing = np.concatenate([np.where(known[..., None], xy, 0), known[..., None]], axis=-1)
    normals = -np.where(determined[..., None], plane, viewing)
    lengths = np.linalg.norm(normals, axis=-1, keepdims=True)
    unit = np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0)
    return unit.astype(np.float32), determined


def _planes(inverse: Float32Array, slopes: FloatArray, xy: FloatArray) -> tuple[FloatArray, BoolArray]:
    """(H, W, 3) n with n . (x, y, 1) the inverse depth of each pixel, and (H, W) where x and y have slopes."""
    if min(inverse.shape) < 2:
        return np.zeros((*inverse.shape, 3)), np.zeros(inverse.shape, dtype=np.bool_)
    by_row, by_column = np.asarray(np.gradient(xy, axis=(0, 1)))
    x_row, y_row, x_column, y_column = by_row[..., 0], by_row[..., 1], by_column[..., 0], by_column[..., 1]
    along_column, along_row = slopes
    determinant = x_column * y_row - y_column * x_row
    usable = np.abs(determinant) > 0
    safe = np.where(usable, determinant, 1)
    a = (along_column * y_row - along_row * y_column) / safe
    b = (along_row * x_column - along_column * x_row) / safe
    # The plane through the pixel itself: only its slopes come from the window.
    return np.stack([a, b, inverse - a * xy[..., 0] - b * xy[..., 1]], axis=-1), usable


def _window_sums(inverse: Float32Array, known: BoolArray) -> Float32Array:
    """(9, H, W) sums over each window of 1, dx, dy, dx dx, dx dy, dy dy, d, dx d, dy d with d the change of 1 / depth.

    Only pixels whose inverse depth differs from the middle's by at most ``WINDOW_PIXELS`` of it count.
    """
    height, width = inverse.shape
    padded = np.pad(inverse, NORMAL_RADIUS_PX)
    tolerance = np.where(known, np.float32(WINDOW_PIXELS) * inverse, np.float32(-1))
    sums = np.zeros((9, height, width), np.float32)
    for dy in range(-NORMAL_RADIUS_PX, NORMAL_RADIUS_PX + 1):
        # Sums over one row of the window, of 1, dx, dx dx and of d, dx d; its counts fit 8 bits.
        counts, changes = np.zeros((3, height, width), np.int8), np.zeros((2, height, width), np.float32)
        for dx in range(-NORMAL_RADIUS_PX, NORMAL_RADIUS_PX + 1):
            top, left = NORMAL_RADIUS_PX + dy, NORMAL_RADIUS_PX + dx
            change = padded[top : top + height, left : left + width] - inverse
            same = np.abs(change) <= tolerance
            change *= same
            for power in range(3):
                counts[power] += np.int8(dx**power) * same
            for power in range(2):
                changes[power] += np.float32(dx**power) * change
        (n, x, xx), (d, xd) = counts, changes
        of_row = ((n, 1), (x, 1), (n, dy), (xx, 1), (x, dy), (n, dy * dy), (d, 1), (xd, 1), (d, dy))
        for number, (along_x, factor) in enumerate(of_row):
            sums[number] += np.float32(factor) * along_x
    return sums


def _fitted_slopes(sums: Float32Array) -> tuple[FloatArray, BoolArray]:
    """(2, H, W) slopes of inverse depth along x and y from the normal equations, and (H, W) where there are any."""
    n, x, y, xx, xy, yy, d, xd, yd = sums.astype(np.float64)
    n = np.maximum(n, 1)
    # Centred on the mean place of the pixels that count, which removes the constant.
    xx, xy, yy, xd, yd = xx - x * x / n, xy - x * y / n, yy - y * y / n, xd - x * d / n, yd - y * d / n
    determinant = xx * yy - xy * xy
    determined = (n >= MIN_NORMAL_PIXELS) & (determinant > 1e-6 * (xx + yy) ** 2)
    safe = np.where(determined, determinant, 1)
    slope_x = np.where(determined, (yy * xd - xy * yd) / safe, 0)
    slope_y = np.where(determined, (xx * yd - xy * xd) / safe, 0)
    return np.stack([slope_x, slope_y]), determined
