"""``transforms.json`` of nerfstudio and instant-ngp, as poses by image name."""

from __future__ import annotations

import json
from pathlib import Path, PurePosixPath

import numpy as np

from smust3r_colmap.errors import InputError
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.importers.pose_set import MAX_ROUNDING, PoseSet, text_of


def read_transforms_json(path: Path) -> dict[str, FloatArray]:
    """``world_from_cam`` by name from a nerfstudio or instant-ngp ``transforms.json``.

    Its cameras have OpenGL axes (y up, z backward), which are turned to OpenCV's. A leading
    ``images/`` is no part of the name.

    Raises:
        InputError: the file cannot be read, or a frame has no name or no rigid 4 x 4 matrix.
    """
    try:
        frames = json.loads(text_of(path))["frames"]
        matrices = {_image_name(frame["file_path"]): frame["transform_matrix"] for frame in frames}
    except (json.JSONDecodeError, KeyError, TypeError) as error:
        raise InputError(f"{path}: not a transforms.json: {type(error).__name__} {error}") from error
    return {name: _opencv_pose(path, name, matrix) for name, matrix in matrices.items()}


def read_transforms(path: Path) -> PoseSet:
    """The poses of the file, or of the ``transforms.json`` in the folder.

    Raises:
        InputError: as ``read_transforms_json``, or there is no pose.
    """
    file = path / "transforms.json" if path.is_dir() else path
    poses = read_transforms_json(file)
    return PoseSet(
        layout="transforms.json",
        place=file,
        world_from_cam=np.array(list(poses.values())),
        names=tuple(poses),
        is_model=True,
    )


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
    if pose.shape != (4, 4) or not np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=MAX_ROUNDING):
        raise InputError(f"{path}, {name}: transform_matrix is not a rigid 4 x 4 matrix")
    turned: FloatArray = pose[:3] * [1.0, -1.0, -1.0, 1.0]
    return turned
