"""Estimating the principal points where the model determines them.

COLMAP keeps the principal point at the image centre, because a few images do not determine it. Many images from many
sides do, and then a wrong one bends the whole model: refining it took the cameras of a courtyard from 0.19 m to 0.03 m.
So two halves of the points estimate it separately, each with its own copy of the cameras. The estimate is used if the
halves agree and the cost is clearly lower. Without the second condition both halves fit what the camera model lacks: on
a straight street a shift of 18 px lowered the cost by 0.4 % and turned every camera by a degree. The position priors,
which the halves share, are loosened before: cameras that never turn, such as of a drone that flies sideways, leave a
shear of the whole world free, tight priors would fix it by their own errors, and both halves would agree on these.
The next module to read is ``registration``.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pycolmap

from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.refinement.bundle_adjustment import Priors, adjust, robust_cost
from smust3r_colmap.refinement.subset_adjustment import subset_of_points

logger = logging.getLogger(__name__)

MIN_IMAGES = 8
"""Of each camera; fewer do not determine a principal point."""
TARGET_OBSERVATIONS, MIN_OBSERVATIONS_PER_IMAGE = 20_000, 100
"""Of each half: a number that is quick to adjust, spread over the images, and a minimum for each image."""
MAX_SHIFT_FRACTION = 0.025
"""Of the longer image side; real cameras stay within a percent or two."""
MAX_DIFFERENCE_FRACTION = 0.5
"""Of the shift, by which the two halves may differ: four standard deviations of their mean."""
MIN_COST_REDUCTION = 0.006
"""Fraction of the cost that the shift must save in each half; less can come from what the camera model lacks."""
PRIOR_SIGMA_FACTOR = 100.0
"""On the standard deviation of the priors: they hold frame and scale, and do not constrain the principal point."""
MAX_ITERATIONS = 30


@dataclass(frozen=True, kw_only=True, eq=False)
class PrincipalPointEstimate:
    """The estimate of the two halves.

    Args:
        xy_img: by camera id, the mean of the halves; of the first only, if it saves too little.
        reason: why the estimate is not used, or empty.
    """

    xy_img: dict[int, FloatArray]
    reason: str = ""


def estimate_principal_points(
    model: pycolmap.Reconstruction, priors: Priors, *, threads: int
) -> PrincipalPointEstimate:
    """Estimate the principal points from two halves of the points.

    Args:
        model: adjusted, with tracks; it is not changed.
        priors: of the camera centres; only frame and scale are taken from them.
        threads: of Ceres; with one the estimate is the same in every run.
    """
    counts = dict.fromkeys(sorted(model.cameras), 0)
    for image_id in model.reg_image_ids():
        counts[model.image(image_id).camera_id] += 1
    used = [camera_id for camera_id, count in counts.items() if count]
    poor = [camera_id for camera_id in used if counts[camera_id] < MIN_IMAGES]
    if poor:
        reason = f"camera {poor[0]} has {counts[poor[0]]} of {MIN_IMAGES} images"
        return PrincipalPointEstimate(xy_img={}, reason=reason)
    loose = replace(priors, sigma=PRIOR_SIGMA_FACTOR * priors.sigma)
    per_image = max(TARGET_OBSERVATIONS // model.num_reg_images(), MIN_OBSERVATIONS_PER_IMAGE)
    halves = []
    for half in (0, 1):
        subset = subset_of_points(model, observations_per_image=per_image, first=half, step=2)
        costs = []
        for free in (False, True):
            if not adjust(
                subset, loose, calibrated=False, principal_point=free, max_iterations=MAX_ITERATIONS, threads=threads
            ):
                return PrincipalPointEstimate(xy_img={}, reason="no usable solution for half of the points")
            costs.append(robust_cost(subset))
        halves.append({camera_id: _principal_point(subset.camera(camera_id)) for camera_id in used})
        saved = 1 - costs[1] / costs[0] if costs[0] > 0 else 0.0
        logger.info("half %d: another principal point saves %.2f %% of the cost", half, 100 * saved)
        if not saved >= MIN_COST_REDUCTION:  # also if it is NaN
            reason = f"another principal point saves only {max(100 * saved, 0):.2f} % of the cost"
            return PrincipalPointEstimate(xy_img=_mean(halves), reason=reason)
    reasons = (_rejection_reason(model.camera(i), halves[0][i], halves[1][i]) for i in used)
    return PrincipalPointEstimate(xy_img=_mean(halves), reason=next(filter(None, reasons), ""))


def _mean(halves: Sequence[Mapping[int, FloatArray]]) -> dict[int, FloatArray]:
    return {camera_id: np.mean([half[camera_id] for half in halves], axis=0) for camera_id in halves[0]}


def _rejection_reason(camera: pycolmap.Camera, first: FloatArray, second: FloatArray) -> str:
    shift = float(np.linalg.norm((first + second) / 2 - _principal_point(camera)))
    difference = float(np.linalg.norm(first - second))
    logger.info("camera %d: principal point %s and %s", camera.camera_id, first.round(2), second.round(2))
    if not np.isfinite(shift + difference) or shift > MAX_SHIFT_FRACTION * max(camera.width, camera.height):
        return f"the principal point of camera {camera.camera_id} would move by {shift:.1f} px"
    if difference > MAX_DIFFERENCE_FRACTION * shift:
        return f"two halves of the points differ by {difference:.1f} px, for a shift of {shift:.1f} px"
    return ""


def _principal_point(camera: pycolmap.Camera) -> FloatArray:
    return np.array([camera.principal_point_x, camera.principal_point_y])
