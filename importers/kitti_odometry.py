"""Poses of the KITTI odometry benchmark: 12 numbers a line, the (3, 4) matrix row by row, left camera to world.

A line is a frame; its number is the name of its image, ``000000``. Times are in ``times.txt`` of the sequence.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from smust3r_colmap.errors import InputError
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.importers.pose_set import PoseSet, data_lines, numbers_of, pose_from_matrix

_NEEDED = "r11 r12 r13 tx r21 r22 r23 ty r31 r32 r33 tz"


def read_kitti(path: Path) -> PoseSet:
    """A file such as ``poses/00.txt``, or the folder of a sequence that has ``poses.txt``, or whose poses are in the
    folder ``poses`` of the benchmark.

    Raises:
        InputError: there are no poses, a line is not as above, or there are as many times as poses not.
    """
    file, sequence = _files_of(path)
    rows = [pose_from_matrix(numbers_of(words, place, _NEEDED), place) for place, words in data_lines(file)]
    return PoseSet(
        layout="KITTI odometry",
        place=file,
        world_from_cam=np.array(rows).reshape(-1, 3, 4),
        names=tuple(f"{number:06d}" for number in range(len(rows))),
        numbers=np.arange(len(rows)),
        stamps_s=_times(sequence / "times.txt", len(rows)),
        unit="m",
    )


def _files_of(path: Path) -> tuple[Path, Path]:
    """The file of poses, and the folder of the sequence."""
    if path.is_file():
        return path, path.parents[1] / "sequences" / path.stem if path.parent.name == "poses" else path.parent
    beside = path.parents[1] / "poses" / f"{path.name}.txt" if len(path.parts) > 2 else path
    for file in (path / "poses.txt", beside):
        if file.is_file():
            return file, path
    raise InputError(f"{path}: neither {path / 'poses.txt'} nor {beside} is there; name the file with the poses")


def _times(path: Path, count: int) -> FloatArray | None:
    if not path.is_file():
        return None
    stamps_s = [numbers_of(words, place, "time")[0] for place, words in data_lines(path)]
    if len(stamps_s) != count:
        raise InputError(f"{path}: {len(stamps_s)} times for {count} poses")
    return np.array(stamps_s)
