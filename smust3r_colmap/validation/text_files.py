"""COLMAP's text files as arrays; a line that is not as it should be is named, the rest is read.

COLMAP's own reader stops at the first such line and says which of its checks failed. Other people's
files break in a few ways again and again: the empty line of an image without observations is left out,
so that every second line is taken for what it is not; names hold blanks; lines are cut short.
The next module to read is ``surroundings``.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from smust3r_colmap.validation.description import (
    CAMERA_MODELS,
    NO_POINT,
    Camera,
    Defect,
    FloatArray,
    Frame,
    Images,
    Points,
    Rig,
)

RecordT = TypeVar("RecordT")

_SENSOR_KINDS = {"CAMERA": 0, "IMU": 1}
_POINT_HEAD = 8
"""Numbers before the track of a point: id, xyz, rgb, error."""

_SHOWN_LETTERS = 60
_NO_NUMBERS = np.empty(0)


@dataclass(frozen=True, kw_only=True)
class _ImageLine:
    image_id: int
    pose: tuple[float, ...]
    camera_id: int
    name: str


def read_cameras(path: Path) -> tuple[tuple[Camera, ...], list[Defect]]:
    """All cameras whose lines can be read, and what is wrong with the file."""
    cameras, defects = _read_lines(path, _camera)
    return tuple(cameras), defects


def read_rigs(path: Path) -> tuple[tuple[Rig, ...], list[Defect]]:
    """All rigs whose lines can be read, and what is wrong with the file."""
    rigs, defects = _read_lines(path, _rig)
    return tuple(rigs), defects


def read_frames(path: Path) -> tuple[tuple[Frame, ...], list[Defect]]:
    """All frames whose lines can be read, and what is wrong with the file."""
    frames, defects = _read_lines(path, _frame)
    return tuple(frames), defects


def read_images(path: Path) -> tuple[Images, list[Defect]]:
    """All images whose lines can be read, and what is wrong with the file.

    An image line that is followed by another image line has lost its line of observations; it is read
    as an image without any.
    """
    lines = _lines(path)
    heads: list[_ImageLine] = []
    observations: list[FloatArray] = []
    defects: list[Defect] = []
    at = 0
    while at < len(lines):
        line = lines[at].strip()
        at += 1
        if not line or line.startswith("#"):
            continue
        head = _image_line(line)
        if head is None:
            defects.append(_bad_line(path, at, line, "is neither an image nor the observations of one"))
            continue
        heads.append(head)
        following = lines[at] if at < len(lines) else None
        if following is None or _image_line(following) is not None:
            text = f"image {head.name!r} is not followed by its line of observations"
            defects.append(Defect(rule="text-observations-missing", where=f"{path.name}, line {at}", text=text))
            observations.append(_NO_NUMBERS)
            continue
        at += 1
        numbers = _numbers(following)
        if numbers is None or len(numbers) % 3:
            defects.append(_bad_line(path, at, following, "is no list of x, y, point id"))
            numbers = _NO_NUMBERS
        observations.append(numbers)
        if at == len(lines) and not following.strip():
            text = f"the last line, the observations of {head.name!r}, is empty"
            defects.append(Defect(rule="text-last-line-empty", where=f"{path.name}, line {at}", text=text))
    return _images(heads, observations), defects


def _images(heads: list[_ImageLine], observations: list[FloatArray]) -> Images:
    rows = np.concatenate([_NO_NUMBERS, *observations]).reshape(-1, 3)
    poses = np.array([head.pose for head in heads], np.float64).reshape(-1, 7)
    return Images(
        ids=np.array([head.image_id for head in heads], np.int64),
        camera_ids=np.array([head.camera_id for head in heads], np.int64),
        names=tuple(head.name for head in heads),
        quat_wxyz=poses[:, :4],
        translation=poses[:, 4:],
        starts=np.cumsum([0, *(len(numbers) // 3 for numbers in observations)], dtype=np.int64),
        xy_img=rows[:, :2].copy(),
        # Some programs write COLMAP's "no point" as the largest unsigned number instead of -1.
        point_ids=np.where((rows[:, 2] >= 0) & (rows[:, 2] < 2.0**63), rows[:, 2], NO_POINT).astype(np.int64),
    )


def _image_line(line: str) -> _ImageLine | None:
    """An image's id, pose, camera and name; None for a line that is something else.

    Observations come in threes, so a line of ten numbers is an image whose name is a number.
    """
    fields = line.split(None, 9)
    if len(fields) < 10:
        return None
    name = fields[9].strip()
    if " " in name and _numbers(name) is not None:
        return None
    try:
        return _ImageLine(
            image_id=int(fields[0]), pose=tuple(map(float, fields[1:8])), camera_id=int(fields[8]), name=name
        )
    except ValueError:
        return None


def read_points(path: Path) -> tuple[Points, list[Defect]]:
    """All points whose lines can be read, and what is wrong with the file."""
    numbered = [
        (number, line) for number, line in enumerate(_lines(path), 1) if line.strip() and not line.startswith("#")
    ]
    defects: list[Defect] = []
    counts = np.array([line.strip().count(" ") + 1 for _, line in numbered], np.int64)
    flat = _numbers(" ".join(line for _, line in numbered))
    if flat is None or len(flat) != counts.sum() or (counts < _POINT_HEAD).any() or (counts % 2).any():
        rows = []
        for number, line in numbered:
            row = _numbers(line)
            if row is None or len(row) < _POINT_HEAD or len(row) % 2:
                defects.append(
                    _bad_line(path, number, line, "is no point: id, x, y, z, r, g, b, error, track in pairs")
                )
            else:
                rows.append(row)
        counts = np.array([len(row) for row in rows], np.int64)
        flat = np.concatenate([_NO_NUMBERS, *rows])
    return _points(flat, counts), defects


def _points(flat: FloatArray, counts: np.ndarray[tuple[int], np.dtype[np.int64]]) -> Points:
    """From the numbers of all lines, one after the other, and how many each line has."""
    first = np.concatenate([[0], np.cumsum(counts)])[:-1].astype(np.int64)
    heads = flat[first[:, None] + np.arange(_POINT_HEAD)]
    in_track = np.ones(len(flat), np.bool_)
    in_track[(first[:, None] + np.arange(_POINT_HEAD)).ravel()] = False
    elements = flat[in_track].reshape(-1, 2).astype(np.int64)
    return Points(
        ids=heads[:, 0].astype(np.int64),
        xyz=heads[:, 1:4].copy(),
        rgb=np.clip(np.nan_to_num(heads[:, 4:7]), 0, 255).astype(np.uint8),
        starts=np.concatenate([[0], np.cumsum((counts - _POINT_HEAD) // 2)]).astype(np.int64),
        track_images=elements[:, 0].copy(),
        track_rows=elements[:, 1].copy(),
    )


def _read_lines(path: Path, read_one: Callable[[list[str]], RecordT]) -> tuple[list[RecordT], list[Defect]]:
    """One record per line; ``read_one`` raises ValueError with what is wrong."""
    records: list[RecordT] = []
    defects: list[Defect] = []
    for number, line in enumerate(_lines(path), 1):
        fields = line.split()
        if not fields or line.startswith("#"):
            continue
        try:
            records.append(read_one(fields))
        except ValueError as error:
            defects.append(_bad_line(path, number, line, f"cannot be read ({error})"))
    return records, defects


def _camera(fields: list[str]) -> Camera:
    if len(fields) < 4:
        raise ValueError("a camera has an id, a model, a width and a height")
    model, params = fields[1], tuple(map(float, fields[4:]))
    known = CAMERA_MODELS.get(model)
    if known is not None and len(params) != known.num_params:
        raise ValueError(f"{model} has {known.num_params} parameters, not {len(params)}")
    return Camera(camera_id=int(fields[0]), model=model, width=int(fields[2]), height=int(fields[3]), params=params)


def _rig(fields: list[str]) -> Rig:
    rest = iter(fields[2:])
    sensors = []
    for number in range(int(fields[1])):
        sensors.append((_sensor_kind(_next(rest)), int(_next(rest))))
        if number > 0 and int(_next(rest)):  # the reference sensor has no pose, others may have one
            for _ in range(7):
                float(_next(rest))
    return Rig(rig_id=int(fields[0]), sensors=tuple(sensors))


def _frame(fields: list[str]) -> Frame:
    rest = iter(fields)
    frame_id, rig_id = int(_next(rest)), int(_next(rest))
    pose = tuple(float(_next(rest)) for _ in range(7))
    data = tuple((_sensor_kind(_next(rest)), int(_next(rest)), int(_next(rest))) for _ in range(int(_next(rest))))
    return Frame(frame_id=frame_id, rig_id=rig_id, quat_wxyz=pose[:4], translation=pose[4:], data=data)


def _next(fields: Iterator[str]) -> str:
    field = next(fields, None)
    if field is None:
        raise ValueError("the line ends early")
    return field


def _sensor_kind(name: str) -> int:
    if name not in _SENSOR_KINDS:
        raise ValueError(f"sensor type {name!r}")
    return _SENSOR_KINDS[name]


def _lines(path: Path) -> list[str]:
    """Lines without their ends; the end of the last line begins no further one, as in COLMAP."""
    text = path.read_bytes().decode("utf-8", "backslashreplace").replace("\r\n", "\n")
    return text.removesuffix("\n").split("\n") if text else []


def _numbers(line: str) -> FloatArray | None:
    """All numbers of the line; None where something else is in it.

    ``np.fromstring`` is ten times as fast as ``split`` and ``float``, which a million points need.
    """
    if not line.strip():
        return _NO_NUMBERS
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)  # numpy's way of saying that a number was none
        try:
            return np.fromstring(line, sep=" ")
        except (ValueError, DeprecationWarning):
            return None


def _bad_line(path: Path, number: int, line: str, why: str) -> Defect:
    start = line.strip()[:_SHOWN_LETTERS]
    return Defect(rule="text-bad-line", where=f"{path.name}, line {number}", text=f"{start!r} {why}")
