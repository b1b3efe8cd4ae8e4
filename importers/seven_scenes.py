"""A sequence of Microsoft's 7-Scenes: ``frame-000000.color.png``, ``.depth.png`` and ``.pose.txt``.

A pose is a 4 x 4 matrix, camera to world, in metres. It was tracked on the depth camera by KinectFusion.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from smust3r_colmap.errors import InputError
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.importers.pose_set import DepthFiles, PoseSet, data_lines, numbers_of, pose_from_matrix

POSE_FILES = "frame-*.pose.txt"
_ROW = "x y z t"
_NOMINAL = Intrinsics(model="PINHOLE", width=640, height=480, params=(585.0, 585.0, 320.0, 240.0))
"""The depth camera, as the page of the data set gives it."""


def read_seven_scenes(folder: Path) -> PoseSet:
    """All frames of a sequence, in the order of their numbers.

    Raises:
        InputError: there is no frame, or a file is no rigid 4 x 4 matrix.
    """
    files = {int(match[1]): path for path in folder.glob(POSE_FILES) if (match := re.match(r"frame-(\d+)", path.name))}
    if not files:
        raise InputError(f"{folder}: has no {POSE_FILES}")
    numbers = sorted(files)
    stems = {number: files[number].name.removesuffix(".pose.txt") for number in numbers}
    depth = {f"{stems[k]}.color.png": folder / f"{stems[k]}.depth.png" for k in numbers}
    there = {name: path for name, path in depth.items() if path.is_file()}
    return PoseSet(
        layout="7-Scenes",
        place=folder,
        world_from_cam=np.array(
            [pose_from_matrix(_matrix(files[number])[:12], str(files[number])) for number in numbers]
        ),
        names=tuple(depth),
        numbers=np.array(numbers, dtype=np.int64),
        depth=DepthFiles(files=there, per_unit=1000.0, intrinsics=_NOMINAL) if there else None,
        unit="m",
    )


def _matrix(path: Path) -> list[float]:
    """The 16 numbers of a file."""
    rows = [numbers_of(words, place, _ROW) for place, words in data_lines(path)]
    if len(rows) != 4 or rows[3] != [0, 0, 0, 1]:
        raise InputError(f"{path}: {len(rows)} rows, the last {rows[-1] if rows else ''}; needed 4, the last 0 0 0 1")
    return [number for row in rows for number in row]
