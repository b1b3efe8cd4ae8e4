"""How far an estimated trajectory is from a reference one, by image name.

Two trajectories are dictionaries from image name to ``world_from_cam`` (3, 4); the readers below
make them from the files in which references come. ``compare_trajectories`` brings the estimate
into the reference's frame by one similarity transform and measures what is left.

The similarity is the least-squares fit of the camera centres, each image counting the same, as
other tools make it (evo, the TUM benchmark). Centres on a straight line leave the roll about that
line free, and centres nearly on one leave it to the noise: then the roll, and nothing else, comes
from the orientations. ``Evaluation.alignment`` says which of the two it was.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path, PurePosixPath

import numpy as np
import numpy.typing as npt
import pycolmap
from scipy.spatial.transform import Rotation

from smust3r_colmap.errors import DegenerateAlignmentError, InputError
from smust3r_colmap.geometry.sim3 import Sim3
from smust3r_colmap.geometry.so3 import nearest_rotation

FloatArray = npt.NDArray[np.float64]
Trajectory = Mapping[str, FloatArray]

# Centres spread less than this across their main direction, relative to along it, do not determine
# the roll: an error of 0.1 % of the length would turn it by more than a degree.
_MIN_RELATIVE_WIDTH = 0.05
# Below this the spread is rounding.
_MIN_RELATIVE_EXTENT = 1e-9


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
    reference_from_estimated, alignment = _align(estimated, reference)
    moved = reference_from_estimated.move_cameras(estimated)
    distances = np.linalg.norm(moved[:, :, 3] - reference[:, :, 3], axis=1)
    angles_deg = np.rad2deg(Rotation.from_matrix(_transposed(reference[:, :, :3]) @ moved[:, :, :3]).magnitude())
    return Evaluation(
        reference_from_estimated=reference_from_estimated,
        alignment=alignment,
        num_compared=len(names),
        num_reference=len(world_from_cam_reference),
        largest_gap_images=_largest_gap(world_from_cam_estimated, world_from_cam_reference),
        extent=float(np.linalg.norm(np.ptp(reference[:, :, 3], axis=0))),
        position_rmse=float(np.sqrt(np.mean(distances**2))),
        position_median=float(np.median(distances)),
        position_max=float(distances.max()),
        rotation_mean_deg=float(angles_deg.mean()),
        rotation_median_deg=float(np.median(angles_deg)),
        rotation_max_deg=float(angles_deg.max()),
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


# -------------------------------------------------------------------------- alignment
def _align(estimated: FloatArray, reference: FloatArray) -> tuple[Sim3, str]:
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


def _transposed(rotations: FloatArray) -> FloatArray:
    return np.swapaxes(rotations, -1, -2)


# ---------------------------------------------------------------------------- readers
def read_poses_txt(path: Path) -> dict[str, FloatArray]:
    """``world_from_cam`` by name from lines ``image qw qx qy qz tx ty tz``; ``#`` begins a comment.

    The quaternion and the centre are camera to world, OpenCV axes; quaternions are normalised.

    Raises:
        InputError: the file cannot be read, or a line is not as above, or a name comes twice.
    """
    needed = "needed image qw qx qy qz tx ty tz, all finite"
    world_from_cams: dict[str, FloatArray] = {}
    for number, line in enumerate(_text(path).splitlines(), start=1):
        if not line.strip() or line.startswith("#"):
            continue
        name, *words = line.split()
        try:
            numbers = np.array([float(word) for word in words])
        except ValueError as error:
            raise InputError(f"{path}, line {number}: {error}; {needed}") from error
        if len(numbers) != 7 or not np.isfinite(numbers).all():
            raise InputError(f"{path}, line {number}: {len(numbers)} numbers after the name; {needed}")
        norm = np.linalg.norm(numbers[:4])
        if abs(norm - 1) > 1e-3:
            raise InputError(f"{path}, line {number}: the quaternion has length {norm:.4g}; needed 1")
        if name in world_from_cams:
            raise InputError(f"{path}, line {number}: {name} has a pose already")
        qw, qx, qy, qz = numbers[:4]
        world_from_cams[name] = np.column_stack([Rotation.from_quat([qx, qy, qz, qw]).as_matrix(), numbers[4:]])
    return world_from_cams


def read_reference_sparse(folder: Path) -> dict[str, FloatArray]:
    """``world_from_cam`` by name of the registered images of a COLMAP model, binary or text.

    Raises:
        InputError: there is no readable model in the folder.
    """
    try:
        model = pycolmap.Reconstruction(folder)
    except (ValueError, RuntimeError, OSError) as error:
        raise InputError(f"{folder}: not a COLMAP model: {str(error).splitlines()[0]}") from error
    return {
        image.name: np.asarray(image.cam_from_world().inverse().matrix(), dtype=np.float64)
        for image in model.images.values()
        if image.has_pose
    }


def read_transforms_json(path: Path) -> dict[str, FloatArray]:
    """``world_from_cam`` by name from a nerfstudio or instant-ngp ``transforms.json``.

    Its cameras have OpenGL axes (y up, z backward), which are turned to OpenCV's. A leading
    ``images/`` is no part of the name.

    Raises:
        InputError: the file cannot be read, or a frame has no name or no rigid 4 x 4 matrix.
    """
    try:
        frames = json.loads(_text(path))["frames"]
        matrices = {_image_name(frame["file_path"]): frame["transform_matrix"] for frame in frames}
    except (json.JSONDecodeError, KeyError, TypeError) as error:
        raise InputError(f"{path}: not a transforms.json: {type(error).__name__} {error}") from error
    return {name: _opencv_pose(path, name, matrix) for name, matrix in matrices.items()}


def _image_name(file_path: str) -> str:
    """The name below the image folder; ``./images/a/1.jpg`` is ``a/1.jpg``."""
    parts = PurePosixPath(file_path).parts
    return str(PurePosixPath(*(parts[1:] if parts[:1] == ("images",) else parts)))


def _opencv_pose(path: Path, name: str, matrix: object) -> FloatArray:
    """(3, 4) pose with OpenCV axes from a 4 x 4 list with OpenGL axes."""
    try:
        pose = np.asarray(matrix, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{path}, {name}: transform_matrix is not numbers") from error
    if pose.shape != (4, 4) or not np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-3):
        raise InputError(f"{path}, {name}: transform_matrix is not a rigid 4 x 4 matrix")
    turned: FloatArray = pose[:3] * [1.0, -1.0, -1.0, 1.0]
    return turned


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read: {error}") from error
