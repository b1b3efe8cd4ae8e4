"""Aligning image patches to a fraction of a pixel (Lucas and Kanade).

The next module to read is ``smust3r_colmap.refinement.bundle_adjustment``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from smust3r_colmap.geometry.arrays import BoolArray, Float32Array, FloatArray, UInt8Array

PATCH_RADIUS_PX = 6
"""13 x 13 pixels: large enough to locate a corner, small enough to be flat on most surfaces."""
CAPTURE_PX = 4.0
"""Distance from which the alignment converges at one level of the pyramid."""
MAX_STRETCH = 2.5
"""Of a patch between two images, in any direction, and its reciprocal; beyond, one has details that the other lacks."""
MIN_CORRELATION = 0.8
"""Normalised cross-correlation of two patches of the same surface."""
ITERATIONS = 8
"""Of the alignment at each level of the pyramid."""
CONVERGED_PX = 0.02
"""A patch has converged when its step is shorter; a last step five times as long is accepted."""
MIN_TEXTURE = 1e-6
"""Determinant of the gradient matrix of a normalised patch; below it, gradients have one direction at most."""


@dataclass(frozen=True, kw_only=True, eq=False)
class AlignedPatches:
    """Positions of K patches of image a in image b.

    Args:
        xy_b: (K, 2). correlation: (K,) normalised, -1 if the alignment did not converge within its reach.
    """

    xy_b: FloatArray
    correlation: FloatArray


def align_patches(
    pyramid_a: Sequence[UInt8Array],
    xy_a: FloatArray,
    pyramid_b: Sequence[UInt8Array],
    xy_b: FloatArray,
    b_from_a: FloatArray,
    *,
    reach_px: float,
) -> AlignedPatches:
    """Shift the warped patches of image a until they fit image b, invariant to brightness and contrast.

    Gauss-Newton with the gradients of the template, from the coarsest level that the reach requires, and both pyramids
    have, to the finest. A level that ends with a lower correlation is ignored. Patches without texture have correlation
    0.

    Args:
        pyramid_a, pyramid_b: (H, W) uint8 and its halves by ``cv2.pyrDown``.
        xy_a: (K, 2) centres of the patches in image a.
        xy_b: (K, 2) initial positions in image b.
        b_from_a: (K, 2, 2) warps of the patches, invertible.
        reach_px: largest distance from the initial position.

    Source: Baker and Matthews 2004, "Lucas-Kanade 20 Years On", inverse compositional, for a translation.
    """
    xy = xy_b.copy()
    correlation = np.full(len(xy), -1.0)
    converged = np.zeros(len(xy), dtype=bool)
    for level in reversed(range(min(num_levels(reach_px), len(pyramid_a), len(pyramid_b)))):
        # The centre of the first pixel is (0.5, 0.5) at every level.
        template = _Template.cut(pyramid_a[level], (xy_a - 0.5) / 2**level, b_from_a)
        end, correlation, converged = template.align_to(pyramid_b[level], (xy - 0.5) / 2**level)
        xy = end * 2**level + 0.5
    within = converged & (np.linalg.norm(xy - xy_b, axis=1) <= reach_px)
    return AlignedPatches(xy_b=xy, correlation=np.where(within, correlation, -1.0))


def num_levels(reach_px: float) -> int:
    """Of a pyramid whose coarsest level has the reach within ``CAPTURE_PX``; at least 1."""
    return 1 + max(0, int(np.ceil(np.log2(reach_px / CAPTURE_PX))))


@dataclass(frozen=True, kw_only=True, eq=False)
class _Template:
    """K patches of P pixels, and their derivatives by a shift in image b.

    Args:
        values: (K, P) of mean zero and length one; zero for a patch without texture.
        offsets: (K, P, 2) of the pixels in image b.
        descent: (K, 2, P) Gauss-Newton shift by a difference in values.
    """

    values: Float32Array
    offsets: Float32Array
    descent: Float32Array

    @classmethod
    def cut(cls, image: UInt8Array, xy: FloatArray, b_from_a: FloatArray) -> _Template:
        """At (K, 2), where the centre of the first pixel is (0, 0)."""
        side = 2 * PATCH_RADIUS_PX + 1
        wide = _sampled(image, xy, _window(PATCH_RADIUS_PX + 1)[None]).reshape(-1, side + 2, side + 2)
        values, length = _normalised(wide[:, 1:-1, 1:-1].reshape(-1, side**2))
        along_x = (wide[:, 1:-1, 2:] - wide[:, 1:-1, :-2]) / 2
        along_y = (wide[:, 2:, 1:-1] - wide[:, :-2, 1:-1]) / 2
        gradient_a = np.stack([along_x, along_y], axis=1).reshape(-1, 2, side**2) / length[:, None]
        gradient = np.swapaxes(np.linalg.inv(b_from_a), 1, 2).astype(np.float32) @ gradient_a
        # Values are normalised, so changes of their mean or length have no effect.
        gradient -= gradient.mean(axis=2, keepdims=True)
        gradient -= (gradient @ values[:, :, None]) * values[:, None]
        hessian = gradient @ np.swapaxes(gradient, 1, 2)
        textured = np.asarray(np.linalg.det(hessian) > MIN_TEXTURE)
        hessian[~textured] = np.eye(2)
        return cls(
            values=np.where(textured[:, None], values, 0),
            offsets=_window(PATCH_RADIUS_PX) @ np.swapaxes(b_from_a, 1, 2).astype(np.float32),
            descent=(np.linalg.inv(hessian) @ gradient).astype(np.float32),
        )

    def align_to(self, image: UInt8Array, begin: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        """The best positions (K, 2) from (K, 2) on, the correlation (K,) there, and whether it has converged."""
        xy, step = begin.copy(), np.zeros(len(begin))
        correlation = self._correlation(image, begin)
        moving = np.arange(len(begin))
        for _ in range(ITERATIONS):
            values, _ = _normalised(_sampled(image, xy[moving], self.offsets[moving]))
            shift = (self.descent[moving] @ (self.values[moving] - values)[:, :, None])[..., 0]
            xy[moving] += shift
            step[moving] = np.linalg.norm(shift, axis=1)
            moving = moving[step[moving] > CONVERGED_PX]
        end = self._correlation(image, xy)
        better = end >= correlation
        converged = step <= 5 * CONVERGED_PX
        return np.where(better[:, None], xy, begin), np.where(better, end, correlation), converged

    def _correlation(self, image: UInt8Array, xy: FloatArray) -> FloatArray:
        values, _ = _normalised(_sampled(image, xy, self.offsets))
        return np.asarray(np.einsum("kp,kp->k", values, self.values), dtype=np.float64)


def _window(radius: int) -> Float32Array:
    """(P, 2) offsets of a square, row by row."""
    along = np.arange(-radius, radius + 1, dtype=np.float32)
    return np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)


def _sampled(image: UInt8Array, xy: FloatArray, offsets: Float32Array) -> Float32Array:
    """(K, P) grey levels at (K, 2) and offsets (K or 1, P, 2); the border is replicated."""
    if not len(xy):
        return np.empty((0, offsets.shape[1]), np.float32)
    at = xy.astype(np.float32)[:, None] + offsets
    sampled = cv2.remap(image, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(sampled, dtype=np.float32)


def _normalised(patches: Float32Array) -> tuple[Float32Array, Float32Array]:
    """Mean zero and length one; and the length (K, 1) before, at least that of one grey level in one pixel."""
    centred = patches - patches.mean(axis=1, keepdims=True)
    length = np.maximum(np.linalg.norm(centred, axis=1, keepdims=True), 1)
    return centred / length, length
