"""Absolute errors of poses: distance between centres and angle between orientations, after an alignment.

The alignment is the least-squares fit of the camera centres, each pose counting the same, as evo and the TUM benchmark
make it. The next module to read is ``relative_error``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from smust3r_colmap.config import PoseAlignment
from smust3r_colmap.errors import DegenerateAlignmentError
from smust3r_colmap.estimators.similarity import fit_centres
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.sim3 import Sim3
from smust3r_colmap.geometry.so3 import angles_between, nearest_rotation


@dataclass(frozen=True, kw_only=True)
class Statistics:
    """Of the errors (N,) of N poses or pairs; ``std`` is that of the population, as in evo."""

    rmse: float
    mean: float
    median: float
    std: float
    min: float
    max: float

    @classmethod
    def of(cls, errors: FloatArray) -> Statistics:
        """Of one error or more."""
        return cls(
            rmse=float(np.sqrt(np.mean(errors**2))),
            mean=float(errors.mean()),
            median=float(np.median(errors)),
            std=float(errors.std()),
            min=float(errors.min()),
            max=float(errors.max()),
        )


def align_centres(estimated: FloatArray, reference: FloatArray, kind: PoseAlignment) -> Sim3:
    """``reference_from_estimated`` of poses (N, 3, 4) by their centres alone.

    Raises:
        DegenerateAlignmentError: all centres of a side coincide, or the best scale is not positive.
    """
    if kind == "none":
        return Sim3.identity()
    return fit_centres(estimated[:, :, 3], reference[:, :, 3], with_scale=kind == "sim3")


def position_errors(estimated: FloatArray, reference: FloatArray) -> FloatArray:
    """(N,) distances between the centres of poses (N, 3, 4) in one world: the absolute pose error (APE, ATE)."""
    distances: FloatArray = np.linalg.norm(estimated[:, :, 3] - reference[:, :, 3], axis=1)
    return distances


def rotation_errors_deg(estimated: FloatArray, reference: FloatArray) -> FloatArray:
    """(N,) angles between the orientations of poses (N, 3, 4) in one world."""
    return np.rad2deg(angles_between(estimated[:, :, :3], reference[:, :, :3]))


def align_rotations(estimated: FloatArray, reference: FloatArray) -> FloatArray:
    """Poses (N, 3, 4) of the estimate, turned by one rotation to where all orientations agree best (chordal mean).

    Raises:
        DegenerateAlignmentError: the orientations of the two have nothing in common.
    """
    correlation = np.einsum("nij,nkj->ik", reference[:, :, :3], estimated[:, :, :3])
    if np.linalg.svd(correlation, compute_uv=False)[1] < 1e-9 * len(estimated):
        raise DegenerateAlignmentError("the orientations do not determine a rotation between the two worlds")
    turned: FloatArray = nearest_rotation(correlation) @ estimated
    return turned
