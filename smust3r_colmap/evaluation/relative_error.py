"""Errors of the motion between two poses: RPE over a step in frames or length, and KITTI's over segments of a path.

The next module to read is ``pairwise_auc``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from smust3r_colmap.config import DeltaUnit
from smust3r_colmap.geometry.arrays import FloatArray, IntArray
from smust3r_colmap.geometry.so3 import angles_between

SEGMENT_LENGTHS_M = (100, 200, 300, 400, 500, 600, 700, 800)
SEGMENT_STEP = 10
"""KITTI's: every tenth frame begins a segment of each length."""
_LENGTH_TOLERANCE = 0.1
"""Of the step in length, as in evo: how far a pair's path may be from it."""


def path_lengths(poses: FloatArray) -> FloatArray:
    """(N,) length of the path from the first of poses (N, 3, 4) to each."""
    steps = np.linalg.norm(np.diff(poses[:, :, 3], axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def pairs_at(reference: FloatArray, delta: float, unit: DeltaUnit, *, all_pairs: bool) -> IntArray:
    """(K, 2) rows of poses (N, 3, 4) that are a step apart, by the reference.

    Args:
        delta: the step, in poses or in the unit of length.
        all_pairs: from every pose; otherwise each pair begins where the one before ended. Along the path, pairs from
            every pose are within a tenth of the step, and others are the first that reach it.
    """
    if unit == "frames":
        step = round(delta)
        first = np.arange(0, len(reference) - step, 1 if all_pairs else step)
        return np.column_stack([first, first + step])
    lengths = path_lengths(reference)
    pairs = _all_pairs_along(lengths, delta) if all_pairs else _next_pairs_along(lengths, delta)
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def _all_pairs_along(lengths: FloatArray, delta: float) -> list[tuple[int, int]]:
    found = []
    for i in range(len(lengths) - 1):
        off = np.abs(lengths[i + 1 :] - lengths[i] - delta)
        j = int(np.argmin(off))
        if off[j] <= _LENGTH_TOLERANCE * delta:
            found.append((i, i + 1 + j))
    return found


def _next_pairs_along(lengths: FloatArray, delta: float) -> list[tuple[int, int]]:
    found, i = [], 0
    for j in range(1, len(lengths)):
        if lengths[j] - lengths[i] >= delta:
            found.append((i, j))
            i = j
    return found


def relative_errors(estimated: FloatArray, reference: FloatArray, pairs: IntArray) -> tuple[FloatArray, FloatArray]:
    """(K,) length and (K,) angle in degrees of ``(Q_i^-1 Q_j)^-1 (P_i^-1 P_j)``, P the estimate and Q the reference.

    Args:
        estimated, reference: (N, 3, 4) ``world_from_cam``; of different worlds, but in one unit of length.
        pairs: (K, 2) rows i and j.

    Source: Sturm et al. 2012, "A benchmark for the evaluation of RGB-D SLAM systems", eq. 2.
    """
    (rotation_est, shift_est), (rotation_ref, shift_ref) = (_motions(one, pairs) for one in (estimated, reference))
    lengths: FloatArray = np.linalg.norm(shift_est - shift_ref, axis=1)
    return lengths, np.rad2deg(angles_between(rotation_est, rotation_ref))


def _motions(poses: FloatArray, pairs: IntArray) -> tuple[FloatArray, FloatArray]:
    """Rotation (K, 3, 3) and translation (K, 3) of ``i_from_j``."""
    i, j = poses[pairs[:, 0]], poses[pairs[:, 1]]
    i_from_world = np.swapaxes(i[:, :, :3], 1, 2)
    return i_from_world @ j[:, :, :3], (i_from_world @ (j[:, :, 3:] - i[:, :, 3:]))[:, :, 0]


@dataclass(frozen=True, kw_only=True)
class SegmentErrors:
    """KITTI's errors of the segments of one length, or of all.

    Args:
        length_m: of the segments; 0 for all lengths together.
        num_segments: how many.
        translation_percent: mean error of the end, in percent of the length.
        rotation_deg_per_m: mean error of the direction at the end, over the length.
    """

    length_m: int
    num_segments: int
    translation_percent: float
    rotation_deg_per_m: float


def segment_errors(estimated: FloatArray, reference: FloatArray) -> tuple[SegmentErrors, ...]:
    """All lengths together, then each length that the path of the reference has; empty for paths below 100 m.

    Args:
        estimated, reference: (N, 3, 4) ``world_from_cam`` of consecutive frames, in metres.

    Source: Geiger et al. 2012; the development kit of the benchmark (``evaluate_odometry``): a segment ends at the
    first frame whose path from the start is longer than its length, and errors are divided by the length.
    """
    path = path_lengths(reference)
    found: dict[int, tuple[FloatArray, FloatArray]] = {}
    for length in SEGMENT_LENGTHS_M:
        first = np.arange(0, len(path), SEGMENT_STEP)
        last = np.searchsorted(path, path[first] + length, side="right")
        pairs = np.column_stack([first, last])[last < len(path)]
        if len(pairs):
            shifts, angles_deg = relative_errors(estimated, reference, pairs)
            found[length] = (100 * shifts / length, angles_deg / length)
    if not found:
        return ()
    pooled = tuple(np.concatenate([errors[k] for errors in found.values()]) for k in (0, 1))
    return tuple(
        SegmentErrors(
            length_m=length,
            num_segments=len(percents),
            translation_percent=float(percents.mean()),
            rotation_deg_per_m=float(rates.mean()),
        )
        for length, (percents, rates) in {0: pooled, **found}.items()
    )
