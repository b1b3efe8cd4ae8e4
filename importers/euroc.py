"""Ground truth of the EuRoC MAV data set: ``mav0/state_groundtruth_estimate0/data.csv``.

A line is a time in nanoseconds, the position, the quaternion with the scalar first, and more that is not read. The
poses are those of the body; ``mav0/cam0/sensor.yaml`` has the pose of the camera on it (``T_BS``).
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from smust3r_colmap.errors import InputError
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.importers.pose_set import (
    PoseSet,
    data_lines,
    numbers_of,
    pose_from_matrix,
    pose_from_quaternion,
    text_of,
)

TRUTH = "state_groundtruth_estimate0/data.csv"
_NEEDED = "timestamp_ns px py pz qw qx qy qz"
_NS = 1e-9


def read_euroc(path: Path) -> PoseSet:
    """The truth of a sequence (the folder with ``mav0``, or ``mav0``), or of a file alone.

    Raises:
        InputError: a line is not as above, a time comes twice, or ``T_BS`` is not a pose.
    """
    mav = path / "mav0" if (path / "mav0").is_dir() else path
    file = mav / TRUTH if mav.is_dir() else path
    rows = [
        (place, words[0].strip(), numbers_of(words[:8], place, _NEEDED))
        for place, words in data_lines(file, separator=",")
    ]
    rows.sort(key=lambda row: row[2][0])
    seen: dict[str, str] = {}
    for place, stamp, _ in rows:
        if stamp in seen:
            raise InputError(f"{place}: the time {stamp} was there before ({seen[stamp]})")
        seen[stamp] = place
    world_from_body = np.array(
        [pose_from_quaternion(n[4:8], n[1:4], place) for place, _, n in rows], dtype=np.float64
    ).reshape(-1, 3, 4)
    sensor = mav / "cam0/sensor.yaml" if mav.is_dir() else file.parents[1] / "cam0/sensor.yaml"
    return PoseSet(
        layout="EuRoC",
        place=file,
        world_from_cam=_on_body(world_from_body, sensor) if sensor.is_file() else world_from_body,
        stamps_s=np.array([seconds_of(stamp) for stamp in seen]),
        image_stamps=_image_stamps(mav / "cam0/data.csv") if mav.is_dir() else {},
        unit="m",
        notes=()
        if sensor.is_file()
        else (f"the poses of {file} are those of the body: no cam0/sensor.yaml was found",),
    )


def seconds_of(stamp_ns: str) -> float:
    """Seconds of a whole number of nanoseconds, or of a number in the notation of floats."""
    return int(stamp_ns) * _NS if stamp_ns.isdigit() else float(stamp_ns) * _NS


def _on_body(world_from_body: FloatArray, sensor: Path) -> FloatArray:
    """(N, 3, 4) ``world_from_cam``."""
    found = re.search(r"T_BS:.*?data:\s*\[(.*?)\]", text_of(sensor), re.S)
    words = found[1].replace(",", " ").split() if found else []
    if len(words) != 16:
        raise InputError(f"{sensor}: T_BS has {len(words)} numbers; needed 16")
    body_from_cam = pose_from_matrix(numbers_of(words[:12], str(sensor), " ".join(["t"] * 12)), str(sensor))
    square = np.vstack([body_from_cam, [0, 0, 0, 1]])
    moved: FloatArray = world_from_body @ square
    return moved


def _image_stamps(path: Path) -> dict[str, float]:
    """Seconds by name, from lines ``time,file``; empty without the list."""
    if not path.is_file():
        return {}
    return {
        words[-1].strip(): seconds_of(words[0].strip())
        for _, words in data_lines(path, separator=",")
        if len(words) == 2
    }
