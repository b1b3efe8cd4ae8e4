"""What refining a scene did to it, as numbers: the statistics of a model, the report of a step, the result of a scene.

These values are stored with the refined models and printed by the summary as they are.
The next module to read is ``acceptance``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap

MIN_OBSERVATIONS = 15
"""Images with fewer are weak: too few observations to adjust a pose. COLMAP's minimum of inliers of an image pair."""
_BEHIND_CAMERA_PX = 1e100
"""COLMAP gives points behind a camera an error far above this."""


@dataclass(frozen=True, kw_only=True)
class Statistics:
    """Statistics of a model.

    Args:
        num_images: registered images.
        num_points: points with a track of two images or more.
        num_observations: of these points.
        mean_track_length: observations per point; 0 without points.
        reprojection_error_px: mean over the points in front of their cameras; 0 without such points.
        num_weak: registered images with fewer than ``MIN_OBSERVATIONS``.
    """

    num_images: int
    num_points: int
    num_observations: int
    mean_track_length: float
    reprojection_error_px: float
    num_weak: int

    @classmethod
    def of(cls, model: pycolmap.Reconstruction) -> Statistics:
        """Measure a model; updates the stored errors of its points."""
        model.update_point_3d_errors()
        errors = np.array([point.error for point in model.points3D.values()])
        errors = errors[errors < _BEHIND_CAMERA_PX]
        return cls(
            num_images=model.num_reg_images(),
            num_points=model.num_points3D(),
            num_observations=model.compute_num_observations(),
            mean_track_length=float(model.compute_mean_track_length()),
            reprojection_error_px=float(errors.mean()) if len(errors) else 0.0,
            num_weak=len(weak_images(model)),
        )


def weak_images(model: pycolmap.Reconstruction) -> list[int]:
    """Ids of the registered images with fewer than ``MIN_OBSERVATIONS``, ascending."""
    return sorted(i for i in model.reg_image_ids() if model.image(i).num_points3D < MIN_OBSERVATIONS)


@dataclass(frozen=True, kw_only=True)
class StepReport:
    """What one step did.

    Args:
        name: such as ``"bundle adjustment"``.
        before, after: statistics of the model; ``after`` also of a rejected step.
        moved_percent: median movement of the camera centres, in percent of the path's extent.
        max_moved_percent: the largest movement.
        turned_deg: median rotation of the cameras.
        accepted: the model is that after the step.
        reason: why the step was rejected, or empty.
    """

    name: str
    before: Statistics
    after: Statistics
    moved_percent: float
    max_moved_percent: float
    turned_deg: float
    accepted: bool
    reason: str = ""


@dataclass(frozen=True, kw_only=True)
class SceneRefinement:
    """The result of refining one scene.

    Args:
        succeeded: the model has tracks and adjusted cameras. Otherwise the scene keeps its initial poses.
        reason: why not, or empty.
        statistics: of the model as it is stored.
        num_pairs, num_matches: verified against the final geometry.
        num_unverified_pairs: two-view verified pairs that contradict the geometry, such as look-alike places.
        weak: names of images with fewer than ``MIN_OBSERVATIONS``, which keep their initial pose relative to the
            nearest other image.
        registered: names of images that had no pose before.
        principal_point: whether it was refined, and if not why, in words.
        warnings: what speaks against the model, in words.
        steps: in order, also the rejected ones.
    """

    succeeded: bool
    reason: str
    statistics: Statistics
    num_pairs: int
    num_matches: int
    num_unverified_pairs: int
    weak: tuple[str, ...]
    registered: tuple[str, ...]
    principal_point: str
    warnings: tuple[str, ...]
    steps: tuple[StepReport, ...]

    @classmethod
    def failed(cls, images: Sequence[str], reason: str) -> SceneRefinement:
        """Of a scene with these images that could not be refined at all."""
        return cls(
            succeeded=False,
            reason=reason,
            statistics=Statistics(
                num_images=len(images),
                num_points=0,
                num_observations=0,
                mean_track_length=0.0,
                reprojection_error_px=0.0,
                num_weak=len(images),
            ),
            num_pairs=0,
            num_matches=0,
            num_unverified_pairs=0,
            weak=(),
            registered=(),
            principal_point="",
            warnings=(),
            steps=(),
        )
