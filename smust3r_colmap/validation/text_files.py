"""COLMAP's text files as arrays; a line that is not as it should be is named, the rest is read.

COLMAP's own reader stops at the first such line and says which of its checks failed. Files of
other programs often have the same few defects: the empty line of an image without observations is left out,
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

from smust3r_colmap.geometry.arrays import BoolArray, FloatArray, IntArray
from smust3r_colmap.validation.description import CAMERA_MODELS, NO_POINT, Camera, Defect, Frame, Images, Points, Rig

RecordT = TypeVar("RecordT")

_SENSOR_KINDS = {"CAMERA": 0, "IMU": 1}
_POINT_HEAD = 8
"""Numbers before the track of a point: id, xyz, rgb, error."""

_NO_ID = 2**32 - 1
"""COLMAP's "none"; ids of cameras and images, and places in a list of observations, are below."""

_IS_NO_ID = f"is not from 0 to {_NO_ID - 1}"
_IS_NO_POINT = "is no point: id (below 2^64), x, y, z, r, g, b, error, track in pairs (below 2^32)"

_SIZE_LIMIT = 2**64
_POINT_ID_LIMIT = 2**64
_EXACT_LIMIT = 2**53
"""Whole numbers below are exact as floats."""

_MAX_SHOWN_LETTERS = 60
_NO_NUMBERS = np.empty(0)


@dataclass(frozen=True, kw_only=True)
class _ImageLine:
    image_id: int
    pose: tuple[float, ...]
    camera_id: int
    name: str


@dataclass(frozen=True, kw_only=True)
class _ObservationLine:
    """``xy_img`` is (M, 2), ``point_ids`` is (M,)."""

    xy_img: FloatArray
    point_ids: IntArray


_NO_OBSERVATIONS = _ObservationLine(xy_img=np.empty((0, 2)), point_ids=np.empty(0, np.int64))


@dataclass(frozen=True, kw_only=True)
class _PointLine:
    """``numbers`` are all of the line; the first is the id, as near as a float comes to it."""

    point_id: int
    numbers: FloatArray


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
    as an image without any. The observations of an image with an id that is none are left out with it.
    """
    lines = _lines(path)
    heads: list[_ImageLine] = []
    observations: list[_ObservationLine] = []
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
        following = lines[at] if at < len(lines) else None
        if following is not None and _image_line(following) is not None:
            following = None
        if not (_is_id(head.image_id) and _is_id(head.camera_id)):
            defects.append(_bad_line(path, at, line, f"is an image with an id that {_IS_NO_ID}"))
            at += following is not None
            continue
        heads.append(head)
        if following is None:
            text = f"image {head.name!r} is not followed by its line of observations"
            defects.append(Defect(rule="text-observations-missing", where=f"{path.name}, line {at}", text=text))
            observations.append(_NO_OBSERVATIONS)
            continue
        at += 1
        observed = _observation_line(following)
        if observed is None:
            defects.append(_bad_line(path, at, following, "is no list of x, y, point id (-1, or below 2^64)"))
            observed = _NO_OBSERVATIONS
        observations.append(observed)
        if at == len(lines) and not following.strip():
            text = f"the last line, the observations of {head.name!r}, is empty"
            defects.append(Defect(rule="text-last-line-empty", where=f"{path.name}, line {at}", text=text))
    return _images(heads, observations), defects


def _images(heads: list[_ImageLine], observations: list[_ObservationLine]) -> Images:
    everything = [_NO_OBSERVATIONS, *observations]
    poses = np.array([head.pose for head in heads], np.float64).reshape(-1, 7)
    return Images(
        ids=np.array([head.image_id for head in heads], np.int64),
        camera_ids=np.array([head.camera_id for head in heads], np.int64),
        names=tuple(head.name for head in heads),
        quat_wxyz=poses[:, :4],
        translation=poses[:, 4:],
        starts=np.cumsum([0, *(len(observed.point_ids) for observed in observations)], dtype=np.int64),
        xy_img=np.concatenate([observed.xy_img for observed in everything]),
        point_ids=np.concatenate([observed.point_ids for observed in everything]),
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


def _observation_line(line: str) -> _ObservationLine | None:
    """None for a line that is something else than threes of x, y and a point's id."""
    numbers = _numbers(line)
    if numbers is None or len(numbers) % 3:
        return None
    point_ids = _point_ids(line, numbers, slice(2, None, 3))
    return None if point_ids is None else _ObservationLine(xy_img=numbers.reshape(-1, 3)[:, :2], point_ids=point_ids)


def _point_ids(line: str, numbers: FloatArray, places: slice) -> IntArray | None:
    """The ids at these places of a line with these numbers; None where one of them is no id.

    ``NO_POINT`` is written as -1, by some programs as the largest number of 64 bits. As from binary files,
    ids of 2^63 and more come out negative.
    """
    rounded = numbers[places]
    if _are_whole(rounded, least=NO_POINT, limit=_EXACT_LIMIT):
        return rounded.astype(np.int64)
    try:
        exact = [int(word) for word in line.split()[places]]
    except ValueError:
        return None
    if not all(NO_POINT <= point_id < _POINT_ID_LIMIT for point_id in exact):
        return None
    return np.array([point_id % _POINT_ID_LIMIT for point_id in exact], np.uint64).view(np.int64)


def _are_whole(numbers: FloatArray, *, least: int = 0, limit: int) -> bool:
    """All are whole numbers from ``least`` to below ``limit``."""
    return bool(((numbers >= least) & (numbers < limit) & (numbers == np.floor(numbers))).all())


def read_points(path: Path) -> tuple[Points, list[Defect]]:
    """All points whose lines can be read, and what is wrong with the file."""
    numbered = [
        (number, line) for number, line in enumerate(_lines(path), 1) if line.strip() and not line.startswith("#")
    ]
    counts = np.array([line.strip().count(" ") + 1 for _, line in numbered], np.int64)
    flat = _numbers(" ".join(line for _, line in numbered))
    if flat is not None and len(flat) == counts.sum() and _are_points(flat, counts):
        return _points(flat[_heads(counts)[:, 0]].astype(np.int64), flat, counts), []
    rows: list[_PointLine] = []
    defects: list[Defect] = []
    for number, line in numbered:
        row = _point_line(line)
        if row is None:
            defects.append(_bad_line(path, number, line, _IS_NO_POINT))
        else:
            rows.append(row)
    point_ids = np.array([row.point_id for row in rows], np.int64)
    counts = np.array([len(row.numbers) for row in rows], np.int64)
    return _points(point_ids, np.concatenate([_NO_NUMBERS, *(row.numbers for row in rows)]), counts), defects


def _are_points(flat: FloatArray, counts: IntArray) -> bool:
    """Each of the lines is a point, with an id that a float holds exactly; arguments as for ``_points``."""
    if (counts < _POINT_HEAD).any() or (counts % 2).any():
        return False
    ids, tracks = flat[_heads(counts)[:, 0]], flat[_in_track(counts)]
    return _are_whole(ids, limit=_EXACT_LIMIT) and _are_whole(tracks, limit=_NO_ID)


def _point_line(line: str) -> _PointLine | None:
    """None for a line that is no point."""
    numbers = _numbers(line)
    if numbers is None or len(numbers) < _POINT_HEAD or len(numbers) % 2:
        return None
    point_ids = _point_ids(line, numbers, slice(1))
    if point_ids is None or point_ids[0] == NO_POINT or not _are_whole(numbers[_POINT_HEAD:], limit=_NO_ID):
        return None
    return _PointLine(point_id=int(point_ids[0]), numbers=numbers)


def _heads(counts: IntArray) -> IntArray:
    """(P, 8) places of the numbers before each track, where each of P lines has so many numbers."""
    first = np.concatenate([[0], np.cumsum(counts)])[:-1].astype(np.int64)
    return np.asarray(first[:, None] + np.arange(_POINT_HEAD), np.int64)


def _in_track(counts: IntArray) -> BoolArray:
    """Which numbers of all lines are elements of tracks."""
    in_track = np.ones(counts.sum(), np.bool_)
    in_track[_heads(counts).ravel()] = False
    return in_track


def _points(point_ids: IntArray, flat: FloatArray, counts: IntArray) -> Points:
    """From the numbers of all lines, one after the other, and how many each line has."""
    heads = flat[_heads(counts)]
    elements = flat[_in_track(counts)].reshape(-1, 2).astype(np.int64)
    return Points(
        ids=point_ids,
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
    camera_id, width, height = int(fields[0]), int(fields[2]), int(fields[3])
    if not _is_id(camera_id):
        raise ValueError(f"its id {_IS_NO_ID}")
    if max(width, height) >= _SIZE_LIMIT:
        raise ValueError("its size has more than 64 bits")
    return Camera(camera_id=camera_id, model=model, width=width, height=height, params=params)


def _is_id(number: int) -> bool:
    return 0 <= number < _NO_ID


def _rig(fields: list[str]) -> Rig:
    rest = iter(fields[2:])
    sensors, poses = [], {}
    for number in range(int(fields[1])):
        sensors.append((_sensor_kind(_next(rest)), int(_next(rest))))
        if number > 0 and int(_next(rest)):  # the reference sensor has no pose, others may have one
            poses[sensors[-1]] = tuple(float(_next(rest)) for _ in range(7))
    return Rig(rig_id=int(fields[0]), sensors=tuple(sensors), sensor_from_rig=poses)


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
    start = line.strip()[:_MAX_SHOWN_LETTERS]
    return Defect(rule="text-bad-line", where=f"{path.name}, line {number}", text=f"{start!r} {why}")
