"""The similarity between two trajectories (Umeyama 1991), also along a straight path."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from smust3r_colmap.errors import DegenerateAlignmentError
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.sim3 import Sim3
from smust3r_colmap.geometry.so3 import nearest_rotation

# Centres spread less than this across their main direction, relative to along it, do not determine
# the roll: an error of 0.1 % of the length would turn it by more than a degree.
_MIN_RELATIVE_WIDTH = 0.05
# Below this the spread is rounding.
_MIN_RELATIVE_EXTENT = 1e-9


def fit_similarity(estimated: FloatArray, reference: FloatArray) -> tuple[Sim3, str]:
    """``reference_from_estimated`` of poses (N, 3, 4) and how it was found.

    Source: Umeyama 1991, "Least-squares estimation of transformation parameters between two point
    patterns", eqs. 34-43.
    """
    mean_est, mean_ref = estimated[:, :, 3].mean(axis=0), reference[:, :, 3].mean(axis=0)
    centred_est, centred_ref = estimated[:, :, 3] - mean_est, reference[:, :, 3] - mean_ref
    width_est, _ = _spread(centred_est, mean_est, "estimate")
    width_ref, line_ref = _spread(centred_ref, mean_ref, "reference")

    rotation = nearest_rotation(centred_ref.T @ centred_est)  # of eq. 38, transposed roles
    alignment = "centres"
    if min(width_est, width_ref) < _MIN_RELATIVE_WIDTH:
        rotation = _roll_from_orientations(rotation, line_ref, estimated[:, :, :3], reference[:, :, :3])
        alignment = "centres, roll from orientations"

    # The best scale for this rotation; for Umeyama's it is eq. 42.
    scale = np.sum(centred_ref * (centred_est @ rotation.T)) / np.sum(centred_est**2)
    if scale <= 0:
        raise DegenerateAlignmentError(f"the camera centres fit best at scale {scale:.2g}: they have nothing in common")
    translation = mean_ref - scale * rotation @ mean_est  # eq. 41
    return Sim3(scale=np.asarray(scale), rotation=rotation, translation=translation), alignment


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


def transposed(rotations: FloatArray) -> FloatArray:
    """(N, 3, 3), each rotation inverted."""
    return np.swapaxes(rotations, -1, -2)
