"""Area under the curve of the errors of image pairs, by two definitions that share a name.

The error of a pair is the larger of two angles: between the relative rotations, and between the directions from one
camera to the other. Neither depends on the alignment or the scale.

============  =======================================  ============================================
..            COLMAP (``benchmark/reconstruction``)    VGGT (``evaluation/test_co3d.py``)
============  =======================================  ============================================
pairs         ordered                                  unordered
direction     0 to 180 deg; 0 where the true baseline  0 to 90 deg: opposite directions are equal
              is below the accuracy of the reference
no pose       180 deg, also for pairs that only one    not counted
              side has in one model
area          under the recall, by trapezoids          mean of the recall at whole degrees
============  =======================================  ============================================

The next module to read is ``cloud_error``.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from smust3r_colmap.geometry.arrays import FloatArray, IntArray
from smust3r_colmap.geometry.so3 import angles_between

COLMAP_THRESHOLDS_DEG = (1, 3, 5)
VGGT_THRESHOLDS_DEG = (1, 3, 5, 15, 30)
_MIN_LENGTH = 1e-10
"""Shorter vectors have no direction and make a right angle with all others, as in COLMAP's benchmark."""


def auc_colmap(
    models: Sequence[tuple[FloatArray, FloatArray, int]],
    num_reference: int,
    num_joined: int,
    thresholds_deg: Sequence[float],
    *,
    accuracy: float = 0.0,
) -> tuple[float, ...]:
    """Percent for each threshold, by COLMAP's definition.

    Args:
        models: of each model of the estimate, its poses (N, 3, 4) that the reference has, those of the reference, and
            how many images it has that the reference lacks.
        num_reference: images of the reference.
        num_joined: ordered pairs of images of the reference that at least one model has.
        accuracy: of the positions of the reference, in its unit: baselines shorter than that have no direction. The
            recall is flat up to an error of as many degrees, because the benchmark passes the same number for both.

    Source: COLMAP, ``benchmark/reconstruction/evaluation/utils.py`` (``compute_grouped_rel_errors``, ``compute_auc``).
    """
    limit = max(thresholds_deg)
    num_wrong = num_reference * (num_reference - 1) - num_joined
    kept, num_pairs = [], num_wrong
    for estimated, reference, num_unknown in models:
        n = len(estimated)
        num_pairs += n * (n - 1) + num_unknown * (num_unknown + 2 * n - 1)
        kept += [_below(_errors_from(k, estimated, reference, accuracy), limit) for k in range(n)]
    errors_deg = np.sort(np.concatenate([np.empty(0), *kept]))
    return tuple(100 * _area_below(errors_deg, num_pairs, threshold, accuracy) for threshold in thresholds_deg)


def auc_vggt(estimated: FloatArray, reference: FloatArray, thresholds_deg: Sequence[int]) -> tuple[float, ...]:
    """Percent for each threshold, by VGGT's definition, of poses (N, 3, 4), N at least 2.

    Source: VGGT, ``evaluation/test_co3d.py`` (``se3_to_relative_pose_error``, ``calculate_auc_np``).
    """
    n = len(estimated)
    counts = {threshold: np.zeros(threshold, dtype=np.int64) for threshold in thresholds_deg}
    for k in range(n - 1):
        rows = np.arange(k + 1, n)
        rotation_deg, direction_deg = _pair_errors_deg(k, rows, estimated, reference)
        errors_deg = np.maximum(rotation_deg, np.minimum(direction_deg, 180 - direction_deg))
        for threshold in counts:  # the last bin has its end
            counts[threshold] += np.histogram(errors_deg, bins=np.arange(threshold + 1))[0]
    num_pairs = n * (n - 1) / 2
    return tuple(100 * float(np.cumsum(count).mean() / num_pairs) for count in counts.values())


def _errors_from(k: int, estimated: FloatArray, reference: FloatArray, accuracy: float) -> FloatArray:
    """(N - 1,) of the ordered pairs that begin at row k."""
    rows = np.delete(np.arange(len(estimated)), k)
    rotation_deg, direction_deg = _pair_errors_deg(k, rows, estimated, reference)
    is_short = np.linalg.norm(reference[rows, :, 3] - reference[k, :, 3], axis=1) < accuracy
    return np.maximum(rotation_deg, np.where(is_short, 0.0, direction_deg))


def _pair_errors_deg(
    k: int, rows: IntArray, estimated: FloatArray, reference: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Angles between the rotations, and between the translations, of ``cam_k_from_cam_row``."""
    motions = []
    for poses in (estimated, reference):
        k_from_world = poses[k, :, :3].T
        shift = (poses[rows, :, 3] - poses[k, :, 3]) @ k_from_world.T
        motions.append((k_from_world @ poses[rows, :, :3], shift))
    (rotation_est, shift_est), (rotation_ref, shift_ref) = motions
    cosines = (_directions(shift_est) * _directions(shift_ref)).sum(axis=1)
    return (
        np.rad2deg(angles_between(rotation_est, rotation_ref)),
        np.rad2deg(np.arccos(cosines.clip(-1, 1))),
    )


def _directions(vectors: FloatArray) -> FloatArray:
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    directions: FloatArray = vectors / np.maximum(lengths, _MIN_LENGTH)
    return directions


def _below(errors_deg: FloatArray, limit_deg: float) -> FloatArray:
    return errors_deg[errors_deg <= limit_deg]


def _area_below(errors_deg: FloatArray, num_pairs: int, threshold_deg: float, flat_deg: float) -> float:
    """Area under the recall from 0 to the threshold, over the threshold; the recall is linear between errors (M,)."""
    count = int(np.searchsorted(errors_deg, threshold_deg, side="right"))
    num_flat = int(np.searchsorted(errors_deg, flat_deg, side="right")) if flat_deg > 0 else 0
    start, recall_at_start = ([0.0, flat_deg], [num_flat, num_flat]) if flat_deg > 0 else ([0.0], [0])
    x = np.concatenate([start, errors_deg[num_flat:count], [threshold_deg]])
    y = np.concatenate([recall_at_start, np.arange(num_flat, count) + 1, [count]]) / num_pairs
    return float(np.sum((x[1:] - x[:-1]) * (y[1:] + y[:-1]) / 2) / threshold_deg)
