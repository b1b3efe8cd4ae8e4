"""``poses.txt``: one pose per image name, as the data sets of the tests have it, with depth beside it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from smust3r_colmap.errors import InputError
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.importers.pose_set import DepthFiles, PoseSet, data_lines, numbers_of, pose_from_quaternion

_NEEDED = "qw qx qy qz tx ty tz"


def read_poses_txt(path: Path) -> dict[str, FloatArray]:
    """``world_from_cam`` by name from lines ``image qw qx qy qz tx ty tz``; ``#`` begins a comment.

    The quaternion and the centre are camera to world, OpenCV axes; quaternions are normalised.

    Raises:
        InputError: the file cannot be read, or a line is not as above, or a name comes twice.
    """
    world_from_cams: dict[str, FloatArray] = {}
    for place, (name, *words) in data_lines(path):
        numbers = numbers_of(words, f"{place}, after the name", _NEEDED)
        if name in world_from_cams:
            raise InputError(f"{place}: {name} has a pose already")
        world_from_cams[name] = pose_from_quaternion(numbers[:4], numbers[4:], place)
    return world_from_cams


def read_named_poses(path: Path) -> PoseSet:
    """The poses of the file, or of the ``poses.txt`` in the folder, with the depth images beside it.

    Raises:
        InputError: as ``read_poses_txt``, or there is no pose.
    """
    file = path / "poses.txt" if path.is_dir() else path
    poses = read_poses_txt(file)
    return PoseSet(
        layout="poses.txt",
        place=file,
        world_from_cam=np.array(list(poses.values())),
        names=tuple(poses),
        depth=_depth_beside(file.parent, poses),
    )


def _depth_beside(folder: Path, names: dict[str, FloatArray]) -> DepthFiles | None:
    """Images ``depth/STEM.png`` in millimetres, their camera in ``intrinsics.txt``."""
    found = {name: folder / "depth" / f"{Path(name).stem}.png" for name in names}
    files = {name: path for name, path in found.items() if path.is_file()}
    return DepthFiles(files=files, per_unit=1000.0, intrinsics=_intrinsics(folder)) if files else None


def _intrinsics(folder: Path) -> Intrinsics | None:
    path = folder / "intrinsics.txt"
    if not path.is_file():
        return None
    needed = "width height fx fy cx cy"
    (place, words), *_ = [*data_lines(path), (str(path), [])]
    width, height, *params = numbers_of(words, place, needed)
    return Intrinsics(model="PINHOLE", width=int(width), height=int(height), params=tuple(params))
