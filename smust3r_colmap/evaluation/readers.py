"""Readers of ground-truth poses."""

from __future__ import annotations

import json
from pathlib import Path, PurePosixPath

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from smust3r_colmap.errors import InputError
from smust3r_colmap.geometry.arrays import FloatArray


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
