"""Trajectories of the TUM RGB-D benchmark, and its folders; those of ETH3D-SLAM have the same form.

A line is ``timestamp tx ty tz qx qy qz qw``, camera to world. A folder has the truth in ``groundtruth.txt``, and lists
its images in ``rgb.txt`` and ``depth.txt``, a time and a file on each line.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np

from smust3r_colmap.errors import InputError
from smust3r_colmap.geometry.arrays import FloatArray, IntArray
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.importers.pose_set import (
    DepthFiles,
    PoseSet,
    data_lines,
    numbers_of,
    pose_from_quaternion,
    text_of,
)

_NEEDED = "timestamp tx ty tz qx qy qz qw"
_DEPTH_PER_METRE = 5000.0
"""Of both benchmarks."""
_KINECT = Intrinsics(model="PINHOLE", width=640, height=480, params=(525.0, 525.0, 320.0, 240.0))
"""The page of TUM RGB-D advises this calibration for depth, which is registered to the colour images. Its principal
point (319.5, 239.5) has the centre of the first pixel at (0, 0)."""
_DEPTH_WITHIN_S = 0.02
"""An image has the depth that was measured at most so long before or after, as in TUM's own ``associate.py``."""
_MAX_FRAME_NUMBER = 1e7
"""Whole numbers below this are frame numbers and not seconds, of which there are more than 1e9 since 1970."""


def read_tum(path: Path) -> PoseSet:
    """A trajectory file, rows sorted by time.

    Raises:
        InputError: it cannot be read, a line is not as above, or a time comes twice.
    """
    _refuse_scalar_first(path)
    rows = [(place, numbers_of(words, place, _NEEDED)) for place, words in data_lines(path)]
    rows.sort(key=lambda row: row[1][0])
    for (_, earlier), (place, later) in pairwise(rows):
        if earlier[0] == later[0]:
            raise InputError(f"{path}: the time {later[0]:.6f} comes twice ({place} is one of them)")
    stamps_s = np.array([numbers[0] for _, numbers in rows])
    return PoseSet(
        layout="TUM trajectory",
        place=path,
        world_from_cam=np.array([pose_from_quaternion([n[7], *n[4:7]], n[1:4], place) for place, n in rows]).reshape(
            -1, 3, 4
        ),
        stamps_s=stamps_s,
        numbers=_as_frame_numbers(stamps_s),
    )


def read_tum_folder(folder: Path) -> PoseSet:
    """``groundtruth.txt`` of a sequence, with the times of its images and their depth.

    Raises:
        InputError: as ``read_tum``.
    """
    truth = read_tum(folder / "groundtruth.txt")
    images, depth = _listed(folder / "rgb.txt"), _listed(folder / "depth.txt")
    is_eth3d = (folder / "calibration.txt").is_file()
    return PoseSet(
        layout="ETH3D-SLAM" if is_eth3d else "TUM RGB-D",
        place=truth.place,
        world_from_cam=truth.world_from_cam,
        stamps_s=truth.stamps_s,
        image_stamps=images,
        depth=_depth_of(folder, images, depth, None if is_eth3d else _KINECT) if images and depth else None,
        unit="m",
    )


def _refuse_scalar_first(path: Path) -> None:
    """A comment that names the columns in another order than the benchmark's."""
    for number, line in enumerate(text_of(path).splitlines(), start=1):
        words = line.lower().replace(",", " ").lstrip("# ").split()
        if line.startswith("#") and {"qw", "qx"} <= set(words) and words.index("qw") < words.index("qx"):
            raise InputError(f"{path}, line {number}: says that qw comes before qx; needed {_NEEDED}")


def _as_frame_numbers(stamps_s: FloatArray) -> IntArray | None:
    is_whole = len(stamps_s) and (stamps_s == np.round(stamps_s)).all() and (stamps_s < _MAX_FRAME_NUMBER).all()
    return stamps_s.astype(np.int64) if is_whole else None


def _listed(path: Path) -> dict[str, float]:
    """Seconds by name of the file, empty without a list."""
    if not path.is_file():
        return {}
    listed = {}
    for place, words in data_lines(path):
        if len(words) != 2:
            raise InputError(f"{place}: {len(words)} words; needed a time and a file")
        listed[words[1]] = numbers_of(words[:1], place, "timestamp")[0]
    return listed


def _depth_of(
    folder: Path, images: dict[str, float], depth: dict[str, float], intrinsics: Intrinsics | None
) -> DepthFiles:
    names, stamps_s = list(depth), np.array(list(depth.values()))
    nearest = {name: int(np.argmin(np.abs(stamps_s - stamp_s))) for name, stamp_s in images.items()}
    return DepthFiles(
        files={
            name: folder / names[k] for name, k in nearest.items() if abs(stamps_s[k] - images[name]) <= _DEPTH_WITHIN_S
        },
        per_unit=_DEPTH_PER_METRE,
        intrinsics=intrinsics,
    )
