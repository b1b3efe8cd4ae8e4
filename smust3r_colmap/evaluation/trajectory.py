"""How far an estimated trajectory is from a reference one, by image name.

Two trajectories are dictionaries from image name to ``world_from_cam`` (3, 4), as readers in ``importers``
make them of files. ``compare_trajectories`` brings the estimate
into the reference's frame by one similarity transform and measures what is left.

The similarity is the least-squares fit of the camera centres, each image counting the same, as
other tools make it (evo, the TUM benchmark). Centres on a straight line leave the roll about that
line free, and centres nearly on one leave it to the noise: then the roll, and nothing else, comes
from the orientations. ``Evaluation.alignment`` says which of the two it was. The module ``evaluate`` has all figures.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from smust3r_colmap.errors import DegenerateAlignmentError
from smust3r_colmap.estimators.similarity import fit_camera_similarity
from smust3r_colmap.evaluation.absolute_error import Statistics, position_errors, rotation_errors_deg
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.sim3 import Sim3

Trajectory = Mapping[str, FloatArray]


@dataclass(frozen=True, kw_only=True, eq=False)
class Evaluation:
    """What is left between two trajectories after the similarity; lengths in the reference's unit.

    Args:
        reference_from_estimated: the similarity that was applied.
        alignment: ``"centres"``, or ``"centres, roll from orientations"`` for nearly straight paths.
        num_compared: images in both trajectories.
        num_reference: images in the reference.
        largest_gap_images: longest run of reference images, in order of name, that the estimate lacks.
        extent: diagonal of the bounding box of the compared reference centres.
        position_rmse, position_median, position_max: distance between centres.
        rotation_mean_deg, rotation_median_deg, rotation_max_deg: angle between orientations.
    """

    reference_from_estimated: Sim3
    alignment: str
    num_compared: int
    num_reference: int
    largest_gap_images: int
    extent: float
    position_rmse: float
    position_median: float
    position_max: float
    rotation_mean_deg: float
    rotation_median_deg: float
    rotation_max_deg: float

    @property
    def position_rmse_percent(self) -> float:
        """The root mean square position error in percent of the extent."""
        return 100 * self.position_rmse / self.extent

    def render_text(self, unit: str = "units") -> str:
        """One line for people; ``unit`` is the name of the reference's unit of length."""
        return (
            f"{self.num_compared} of {self.num_reference} images: position {self.position_rmse:.4g} {unit} rms "
            f"({self.position_rmse_percent:.2g} % of {self.extent:.4g}), {self.position_max:.4g} {unit} at worst; "
            f"rotation {self.rotation_median_deg:.2g} deg median, {self.rotation_max_deg:.2g} deg at worst"
        )


def compare_trajectories(
    world_from_cam_estimated: Trajectory, world_from_cam_reference: Trajectory, *, min_compared: int = 3
) -> Evaluation:
    """Compare the images that both trajectories have, joined by name.

    Args:
        world_from_cam_estimated, world_from_cam_reference: (3, 4) rigid poses by image name, each
            trajectory in a world and a unit of its own.
        min_compared: the least number of common images; two camera centres fit any other two, so 3 or more.

    Raises:
        ValueError: ``min_compared`` is below 3, or a pose is not (3, 4), finite and rigid.
        DegenerateAlignmentError: too few common images, or in one of the trajectories all their
            centres coincide.
    """
    if min_compared < 3:
        raise ValueError(f"min_compared is {min_compared}, needed at least 3")
    names = sorted(world_from_cam_estimated.keys() & world_from_cam_reference.keys())
    if len(names) < min_compared:
        raise DegenerateAlignmentError(
            f"{len(names)} images have a pose in both the estimate ({len(world_from_cam_estimated)} images) "
            f"and the reference ({len(world_from_cam_reference)}); needed {min_compared}; are the names the same?"
        )
    estimated = _stacked(world_from_cam_estimated, names, "estimate")
    reference = _stacked(world_from_cam_reference, names, "reference")
    reference_from_estimated, alignment = fit_camera_similarity(estimated, reference)
    moved = reference_from_estimated.move_cameras(estimated)
    positions = Statistics.of(position_errors(moved, reference))
    rotations_deg = Statistics.of(rotation_errors_deg(moved, reference))
    return Evaluation(
        reference_from_estimated=reference_from_estimated,
        alignment=alignment,
        num_compared=len(names),
        num_reference=len(world_from_cam_reference),
        largest_gap_images=_largest_gap(world_from_cam_estimated, world_from_cam_reference),
        extent=float(np.linalg.norm(np.ptp(reference[:, :, 3], axis=0))),
        position_rmse=positions.rmse,
        position_median=positions.median,
        position_max=positions.max,
        rotation_mean_deg=rotations_deg.mean,
        rotation_median_deg=rotations_deg.median,
        rotation_max_deg=rotations_deg.max,
    )


def _stacked(trajectory: Trajectory, names: list[str], which: str) -> FloatArray:
    """(N, 3, 4) poses of the named images, each checked to be rigid."""
    poses = np.empty((len(names), 3, 4))
    for k, name in enumerate(names):
        pose = np.asarray(trajectory[name], dtype=np.float64)
        if pose.shape != (3, 4) or not np.isfinite(pose).all():
            raise ValueError(f"{which}, {name}: a pose is 3 x 4 finite numbers, found {pose.shape}")
        off = np.abs(pose[:, :3] @ pose[:, :3].T - np.eye(3)).max()
        if off > 1e-3 or np.linalg.det(pose[:, :3]) < 0:
            raise ValueError(f"{which}, {name}: not a rotation (orthonormality error {off:.2g})")
        poses[k] = pose
    return poses


def _largest_gap(estimated: Trajectory, reference: Trajectory) -> int:
    """The longest run of reference images, in order of name, without an estimate."""
    runs = groupby(sorted(reference), key=lambda name: name in estimated)
    return max((len(list(run)) for has_estimate, run in runs if not has_estimate), default=0)
