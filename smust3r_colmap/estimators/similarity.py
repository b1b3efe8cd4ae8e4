"""Similarities between corresponding points in closed form (Umeyama 1991), also along a straight path.

``CentredPairs`` has the parts: means, rotation, the two scales, translation. ``fit_similarity`` is the weighted fit of
points, ``fit_camera_similarity`` that of cameras, whose orientations give the roll that centres on a line leave free.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from smust3r_colmap.errors import DegenerateAlignmentError
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.sim3 import Sim3
from smust3r_colmap.geometry.so3 import nearest_rotation

# Centres spread less than this across their main direction, relative to along it, do not determine
# the roll: an error of 0.1 % of the length would turn it by more than a degree.
MIN_RELATIVE_WIDTH = 0.05
# Below this the spread is rounding.
_MIN_RELATIVE_EXTENT = 1e-9


@dataclass(frozen=True, kw_only=True, eq=False)
class CentredPairs:
    """Corresponding points about their weighted means.

    Args:
        a, b: (N, 3) about the means. mean_a, mean_b: (3,).
    """

    a: FloatArray
    b: FloatArray
    mean_a: FloatArray
    mean_b: FloatArray

    @classmethod
    def of(cls, points_a: FloatArray, points_b: FloatArray, shares: FloatArray | None = None) -> CentredPairs:
        """Of points (N, 3) with weights (N,) that add up to 1; equal ones where none are given."""
        mean_a, mean_b = (points.mean(axis=0) if shares is None else shares @ points for points in (points_a, points_b))
        return cls(a=points_a - mean_a, b=points_b - mean_b, mean_a=mean_a, mean_b=mean_b)

    def correlation(self, weights: FloatArray | None = None) -> FloatArray:
        """(3, 3) weighted sum of ``b a^T``; the closest rotation to it takes a to b (Umeyama, eqs. 38 to 40).

        Weighted sums of ``R_b R_a^T`` of orientations may be added to it.
        """
        correlation: FloatArray = (_rows(weights) * self.b).T @ self.a
        return correlation

    def symmetric_scale(self, weights: FloatArray) -> float:
        """Ratio of the weighted RMS radii (Horn 1987): the inverse for swapped sides."""
        return _radius(self.b, weights) / _radius(self.a, weights)

    def least_squares_scale(self, rotation: FloatArray, weights: FloatArray | None = None) -> float:
        """The best scale for a rotation; for Umeyama's rotation it is his eq. 42."""
        return float(np.sum(_rows(weights) * self.b * (self.a @ rotation.T)) / np.sum(_rows(weights) * self.a**2))

    def similarity(self, rotation: FloatArray, scale: float = 1.0) -> Sim3:
        """``b_from_a`` that takes the mean of a to the mean of b (eq. 41)."""
        translation = self.mean_b - scale * rotation @ self.mean_a
        return Sim3(scale=np.asarray(scale), rotation=rotation, translation=translation)


def _rows(weights: FloatArray | None) -> FloatArray:
    """(N, 1) or (1, 1) factors of rows."""
    return np.ones((1, 1)) if weights is None else weights[:, None]


def _radius(centred: FloatArray, weights: FloatArray) -> float:
    """Root of the weighted sum of squared distances from the mean."""
    return float(np.sqrt(weights @ (centred**2).sum(axis=1)))


def fit_similarity(points_a: FloatArray, points_b: FloatArray, weights: FloatArray | None = None) -> Sim3:
    """``b_from_a`` between points (N, 3) with the least weighted squared distances.

    The points must not lie on a line; weights are equal where none are given.

    Source: Umeyama 1991, "Least-squares estimation of transformation parameters between two point
    patterns", eqs. 34-43.
    """
    pairs = CentredPairs.of(points_a, points_b, None if weights is None else weights / weights.sum())
    rotation = nearest_rotation(pairs.correlation(weights))
    return pairs.similarity(rotation, pairs.least_squares_scale(rotation, weights))


def fit_centres(estimated: FloatArray, reference: FloatArray, *, with_scale: bool) -> Sim3:
    """``reference_from_estimated`` of centres (N, 3) with the least squared distances.

    The scale is 1 unless ``with_scale``.

    Centres on a line leave the rotation about it free; ``relative_width`` says how near they are to that.

    Raises:
        DegenerateAlignmentError: all centres of a side coincide, or the best scale is not positive.
    """
    pairs = CentredPairs.of(estimated, reference)
    _spread(pairs.a, pairs.mean_a, "estimate")
    _spread(pairs.b, pairs.mean_b, "reference")
    rotation = nearest_rotation(pairs.correlation())
    return pairs.similarity(rotation, _positive(pairs.least_squares_scale(rotation)) if with_scale else 1.0)


def relative_width(centres: FloatArray) -> float:
    """Spread of centres (N, 3) across their main direction, over that along it; 0 where they are on a line."""
    lengths = np.linalg.svd(centres - centres.mean(axis=0), compute_uv=False)
    return float(lengths[1] / lengths[0]) if lengths[0] > 0 else 0.0


def fit_camera_similarity(estimated: FloatArray, reference: FloatArray) -> tuple[Sim3, str]:
    """``reference_from_estimated`` of poses (N, 3, 4) by their centres, and how it was found.

    The roll about centres on a line comes from the orientations, as ``fit_similarity`` otherwise.

    Raises:
        DegenerateAlignmentError: all centres of a side coincide, or the best scale is not positive.
    """
    pairs = CentredPairs.of(estimated[:, :, 3], reference[:, :, 3])
    width_est, _ = _spread(pairs.a, pairs.mean_a, "estimate")
    width_ref, line_ref = _spread(pairs.b, pairs.mean_b, "reference")

    rotation = nearest_rotation(pairs.correlation())
    alignment = "centres"
    if min(width_est, width_ref) < MIN_RELATIVE_WIDTH:
        rotation = _roll_from_orientations(rotation, line_ref, estimated[:, :, :3], reference[:, :, :3])
        alignment = "centres, roll from orientations"

    return pairs.similarity(rotation, _positive(pairs.least_squares_scale(rotation))), alignment


def _positive(scale: float) -> float:
    if scale <= 0:
        raise DegenerateAlignmentError(f"the camera centres fit best at scale {scale:.2g}: they have nothing in common")
    return scale


def _spread(centred: FloatArray, mean: FloatArray, which: str) -> tuple[float, FloatArray]:
    """Width of the centres relative to their length, and the direction (3,) of the length."""
    _, lengths, directions = np.linalg.svd(centred, full_matrices=False)
    if lengths[0] <= _MIN_RELATIVE_EXTENT * np.sqrt(len(centred)) * (1 + np.linalg.norm(mean)):
        raise DegenerateAlignmentError(f"{which}: all {len(centred)} camera centres coincide")
    return float(lengths[1] / lengths[0]), directions[0]


def _roll_from_orientations(
    rotation: FloatArray, line_ref: FloatArray, rotations_est: FloatArray, rotations_ref: FloatArray
) -> FloatArray:
    """``rotation`` turned about the unit vector ``line_ref`` until the orientations agree best.

    The angle maximises sum_k tr(Rref_k^T Roll(angle) rotation Rest_k), the chordal mean restricted
    to one axis. With Rodrigues' formula that is cos(angle) (tr M - a.M a) + sin(angle) (a.w) plus a
    constant, where M = sum_k rotation Rest_k Rref_k^T and w is the axial vector of M^T - M.
    """
    m = np.einsum("ij,njk,nlk->il", rotation, rotations_est, rotations_ref)
    w = np.array([m[1, 2] - m[2, 1], m[2, 0] - m[0, 2], m[0, 1] - m[1, 0]])
    angle = np.arctan2(line_ref @ w, np.trace(m) - line_ref @ m @ line_ref)
    rolled: FloatArray = Rotation.from_rotvec(angle * line_ref).as_matrix() @ rotation
    return rolled
