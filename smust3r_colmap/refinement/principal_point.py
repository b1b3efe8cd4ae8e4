"""Where the optical axis meets the image: asked only where the model can answer.

COLMAP keeps the principal point in the middle of the image, because a few images do not determine it. Many
images from many sides do, and then a wrong one bends the whole model: freeing it took the cameras of a
courtyard from 0.19 m to 0.03 m. So two halves of the points are asked separately, each with cameras of its
own, and the answer counts where they agree and the pixels are clearly better off. Without that second
condition both halves fall for what the camera model leaves out: a straight street traded it for a shift of
18 pixels and turned every camera by a degree, to lower the cost by 0.4 %. The priors of the centres, which both
share, are loosened before: cameras that never turn, such as of a drone that flies sideways, leave a shear of the
whole world open, priors would close it by their own errors, and both halves would agree on them.
The next module to read is ``task``.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pycolmap

from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.refinement.bundle_adjustment import Priors, adjust, robust_cost
from smust3r_colmap.refinement.subset_adjustment import part_of

logger = logging.getLogger(__name__)

MIN_IMAGES = 8
"""Of each camera; fewer do not determine a principal point."""
OBSERVATIONS, MIN_OBSERVATIONS_PER_IMAGE = 20_000, 100
"""Of each half: as many as are quick to adjust, spread over the images, but of each image some."""
MAX_SHIFT = 0.025
"""As a part of the longer image side; real cameras stay within a percent or two."""
AGREEMENT = 0.5
"""Part of the shift by which the two halves may differ: four standard deviations of their mean."""
MIN_GAIN = 0.006
"""Part of the cost that the shift must save in each half: less may make up for what the camera model lacks."""
LOOSE = 100.0
"""Times the standard deviation of the priors: they hold frame and scale, and say nothing of a principal point."""
MAX_ITERATIONS = 30


@dataclass(frozen=True, kw_only=True, eq=False)
class PrincipalPointAnswer:
    """What the two halves said.

    Args:
        xy_img: by camera id, the mean of those that were asked: the second is not where the first saves too little.
        reason: why the answer does not count, or empty.
    """

    xy_img: dict[int, FloatArray]
    reason: str = ""


def ask_for_principal_points(model: pycolmap.Reconstruction, priors: Priors, *, threads: int) -> PrincipalPointAnswer:
    """Let two halves of the points of ``model``, which stays as it is, say where the principal points are.

    Args:
        model: adjusted, with tracks.
        priors: where the cameras were; only frame and scale are taken from them.
        threads: of Ceres; with one the answer is the same in every run.
    """
    counts = dict.fromkeys(sorted(model.cameras), 0)
    for image_id in model.reg_image_ids():
        counts[model.image(image_id).camera_id] += 1
    used = [camera_id for camera_id, count in counts.items() if count]
    poor = [camera_id for camera_id in used if counts[camera_id] < MIN_IMAGES]
    if poor:
        return PrincipalPointAnswer(xy_img={}, reason=f"camera {poor[0]} has {counts[poor[0]]} of {MIN_IMAGES} images")
    loose = replace(priors, sigma=LOOSE * priors.sigma)
    enough = max(OBSERVATIONS // model.num_reg_images(), MIN_OBSERVATIONS_PER_IMAGE)
    halves = []
    for half in (0, 1):
        part = part_of(model, observations_per_image=enough, first=half, step=2)
        costs = []
        for free in (False, True):
            if not adjust(
                part, loose, calibrated=False, principal_point=free, max_iterations=MAX_ITERATIONS, threads=threads
            ):
                return PrincipalPointAnswer(xy_img={}, reason="half of the points gave no solution")
            costs.append(robust_cost(part))
        halves.append({camera_id: _principal_point(part.camera(camera_id)) for camera_id in used})
        gain = 1 - costs[1] / costs[0] if costs[0] > 0 else 0.0
        logger.info("half %d: another principal point saves %.2f %% of the cost", half, 100 * gain)
        if not gain >= MIN_GAIN:  # or no number
            reason = f"another place would save only {max(100 * gain, 0):.2f} % of the cost"
            return PrincipalPointAnswer(xy_img=_mean(halves), reason=reason)
    answer = _mean(halves)
    for camera_id in used:
        reason = _why_not(model.camera(camera_id), halves[0][camera_id], halves[1][camera_id])
        if reason:
            return PrincipalPointAnswer(xy_img=answer, reason=reason)
    return PrincipalPointAnswer(xy_img=answer)


def _mean(halves: Sequence[Mapping[int, FloatArray]]) -> dict[int, FloatArray]:
    return {camera_id: np.mean([half[camera_id] for half in halves], axis=0) for camera_id in halves[0]}


def _why_not(camera: pycolmap.Camera, first: FloatArray, second: FloatArray) -> str:
    longer = max(camera.width, camera.height)
    shift = float(np.linalg.norm((first + second) / 2 - _principal_point(camera)))
    apart = float(np.linalg.norm(first - second))
    logger.info("camera %d: principal point %s and %s", camera.camera_id, first.round(2), second.round(2))
    if not np.isfinite(shift + apart) or shift > MAX_SHIFT * longer:
        return f"the principal point of camera {camera.camera_id} would move by {shift:.1f} px"
    if apart > AGREEMENT * shift:
        return f"two halves of the points put it {apart:.1f} px apart, for a shift of {shift:.1f} px"
    return ""


def _principal_point(camera: pycolmap.Camera) -> FloatArray:
    return np.array([camera.principal_point_x, camera.principal_point_y])
