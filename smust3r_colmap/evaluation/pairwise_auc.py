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
from dataclasses import dataclass

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
    areas = [_Area(threshold_deg=threshold, flat_deg=accuracy) for threshold in thresholds_deg]
    num_pairs = num_reference * (num_reference - 1) - num_joined
    for estimated, reference, num_unknown in models:
        n = len(estimated)
        num_pairs += n * (n - 1) + num_unknown * (num_unknown + 2 * n - 1)
        pairs = _Pairs.of(estimated, reference)
        for k in range(n):
            errors_deg = _errors_from(k, pairs, accuracy)
            for area in areas:
                area.add(errors_deg)
    return tuple(100 * area.share(num_pairs) for area in areas)


def auc_vggt(estimated: FloatArray, reference: FloatArray, thresholds_deg: Sequence[int]) -> tuple[float, ...]:
    """Percent for each threshold, by VGGT's definition, of poses (N, 3, 4), N at least 2.

    Source: VGGT, ``evaluation/test_co3d.py`` (``se3_to_relative_pose_error``, ``calculate_auc_np``).
    """
    n, pairs = len(estimated), _Pairs.of(estimated, reference)
    counts = {threshold: np.zeros(threshold, dtype=np.int64) for threshold in thresholds_deg}
    for k in range(n - 1):
        rows = np.arange(k + 1, n)
        rotation_deg, direction_deg = pairs.errors_deg(k, rows)
        errors_deg = np.maximum(rotation_deg, np.minimum(direction_deg, 180 - direction_deg))
        for threshold in counts:  # the last bin has its end
            counts[threshold] += np.histogram(errors_deg, bins=np.arange(threshold + 1))[0]
    num_pairs = n * (n - 1) / 2
    return tuple(100 * float(np.cumsum(count).mean() / num_pairs) for count in counts.values())


def _errors_from(k: int, pairs: _Pairs, accuracy: float) -> FloatArray:
    """(N - 1,) of the ordered pairs that begin at row k."""
    rows = np.delete(np.arange(len(pairs.turns)), k)
    rotation_deg, direction_deg = pairs.errors_deg(k, rows)
    is_short = np.linalg.norm(pairs.reference[rows] - pairs.reference[k], axis=1) < accuracy
    return np.maximum(rotation_deg, np.where(is_short, 0.0, direction_deg))


@dataclass(frozen=True, kw_only=True, eq=False)
class _Pairs:
    """What the errors of all pairs are made of.

    With D = R_estimate R_reference^T of a camera, the relative rotations of a pair differ by D_k^T D_j, turned; and a
    direction of the reference, seen by camera k, is D_k times it in the world of the estimate.

    Args:
        turns: (N, 3, 3) D. estimate, reference: (N, 3) centres.
    """

    turns: FloatArray
    estimate: FloatArray
    reference: FloatArray

    @classmethod
    def of(cls, estimated: FloatArray, reference: FloatArray) -> _Pairs:
        """Of poses (N, 3, 4)."""
        turns = estimated[:, :, :3] @ np.swapaxes(reference[:, :, :3], 1, 2)
        return cls(turns=turns, estimate=estimated[:, :, 3], reference=reference[:, :, 3])

    def errors_deg(self, k: int, rows: IntArray) -> tuple[FloatArray, FloatArray]:
        """Angles between the rotations, and between the translations, of ``cam_k_from_cam_row``."""
        directions_est = _directions(self.estimate[rows] - self.estimate[k])
        directions_ref = _directions(self.reference[rows] - self.reference[k]) @ self.turns[k].T
        cosines = (directions_est * directions_ref).sum(axis=1)
        return (
            np.rad2deg(angles_between(self.turns[rows], self.turns[k])),
            np.rad2deg(np.arccos(cosines.clip(-1, 1))),
        )


def _directions(vectors: FloatArray) -> FloatArray:
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    directions: FloatArray = vectors / np.maximum(lengths, _MIN_LENGTH)
    return directions


@dataclass(kw_only=True)
class _Area:
    """The area under the recall up to a threshold, from errors in any order.

    The recall rises by one pair at each error e_i, linearly from the error before, and stays at the last value. With m
    errors up to the threshold t the trapezoids add up to ``t m - sum(e_i) + e_m / 2``. Below ``flat_deg`` the recall is
    that of all errors up to it: they count as 0, and the first line begins there, which takes ``flat_deg / 2`` away.
    """

    threshold_deg: float
    flat_deg: float
    num_flat: int = 0
    num_below: int = 0
    sum_deg: float = 0.0
    last_deg: float = 0.0

    def add(self, errors_deg: FloatArray) -> None:
        """More pairs."""
        if self.flat_deg > 0:
            self.num_flat += int((errors_deg <= self.flat_deg).sum())
        below = errors_deg[errors_deg <= self.threshold_deg]
        rising = below[below > self.flat_deg] if self.flat_deg > 0 else below
        self.num_below += len(below)
        self.sum_deg += float(rising.sum())
        self.last_deg = max(self.last_deg, float(rising.max(initial=0.0)))

    def share(self, num_pairs: int) -> float:
        """Over the threshold and all pairs, those without an error too."""
        if self.flat_deg >= self.threshold_deg:
            return self.num_flat / num_pairs
        corner_deg = (max(self.last_deg, self.flat_deg) - self.flat_deg) / 2
        area = self.threshold_deg * self.num_below - self.sum_deg + corner_deg
        return area / (self.threshold_deg * num_pairs)
