"""COLMAP's binary files as arrays; a file that ends early or late is named with the byte.

Only the public layout is used, with numpy where there are many records and ``struct`` where there are
few, so that a million points take about a second and a broken file cannot end the process. What is
whole before the break is kept: the other checks can still look at it.
Source: https://colmap.github.io/format.html; rigs and frames as COLMAP 4 writes them.
The next module to read is ``text_files``.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from smust3r_colmap.validation.description import (
    CAMERA_MODELS,
    MODEL_NAMES,
    Camera,
    Defect,
    Frame,
    Images,
    Points,
    Rig,
)

RecordT = TypeVar("RecordT")

_OBSERVATION = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
_POINT_HEAD = np.dtype([("id", "<i8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("length", "<u8")])
_LENGTH_AT = _POINT_HEAD.itemsize - 8
_ELEMENT_BYTES = 8
_POINTS_AT_ONCE = 65536
"""Gathering takes eight bytes of index for every byte."""


class _EndsEarlyError(Exception):
    """The record at the cursor is not whole."""


class _UnknownModelError(Exception):
    """A camera model of which the number of parameters is not known; what follows cannot be read."""


class _Cursor:
    """A place in a file that was read as a whole."""

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.at = 0

    def take(self, layout: str) -> tuple[Any, ...]:
        """The values of a little-endian ``struct`` layout."""
        return struct.unpack("<" + layout, self.skip(struct.calcsize("<" + layout)))

    def skip(self, num_bytes: int) -> bytes:
        """The next bytes."""
        if num_bytes > len(self.data) - self.at:
            raise _EndsEarlyError
        self.at += num_bytes
        return self.data[self.at - num_bytes : self.at]

    def take_name(self) -> str:
        """Bytes up to a zero; those that are no UTF-8 come out as \\x escapes."""
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise _EndsEarlyError
        name = self.data[self.at : end].decode("utf-8", "backslashreplace")
        self.at = end + 1
        return name


def read_cameras(path: Path) -> tuple[tuple[Camera, ...], list[Defect]]:
    """All cameras, and what is wrong with the file."""
    cameras, defects = _read_records(path, _camera)
    return tuple(cameras), defects


def read_images(path: Path) -> tuple[Images, list[Defect]]:
    """All images, and what is wrong with the file."""
    records, defects = _read_records(path, _image)
    observations = np.concatenate([np.empty(0, _OBSERVATION), *(rows for *_, rows in records)])
    poses = np.array([pose for _, pose, *_ in records], np.float64).reshape(-1, 7)
    images = Images(
        ids=np.array([image_id for image_id, *_ in records], np.int64),
        camera_ids=np.array([camera_id for _, _, camera_id, *_ in records], np.int64),
        names=tuple(name for *_, name, _ in records),
        quat_wxyz=poses[:, :4],
        translation=poses[:, 4:],
        starts=np.cumsum([0, *(len(rows) for *_, rows in records)], dtype=np.int64),
        xy_img=np.ascontiguousarray(observations["xy"], np.float64),
        point_ids=np.ascontiguousarray(observations["point"], np.int64),
    )
    return images, defects


def read_points(path: Path) -> tuple[Points, list[Defect]]:
    """All points with their tracks, and what is wrong with the file."""
    data = path.read_bytes()
    count = struct.unpack_from("<Q", data)[0] if len(data) >= 8 else 0
    places = np.array(_point_places(data, count))
    everything = np.frombuffer(data, np.uint8)
    in_track = np.zeros(len(data), np.bool_)
    in_track[8 : places[-1]] = True
    heads = np.empty(len(places) - 1, _POINT_HEAD)
    for first in range(0, len(heads), _POINTS_AT_ONCE):
        some = slice(first, min(first + _POINTS_AT_ONCE, len(heads)))
        at = places[some, None] + np.arange(_POINT_HEAD.itemsize)
        heads[some] = everything[at].view(_POINT_HEAD)[:, 0]
        in_track[at] = False
    elements = everything[in_track].view("<u4").reshape(-1, 2)
    points = Points(
        ids=heads["id"].astype(np.int64),
        xyz=heads["xyz"].astype(np.float64),
        rgb=heads["rgb"].copy(),
        starts=np.concatenate([[0], np.cumsum(heads["length"].astype(np.int64))]),
        track_images=elements[:, 0].astype(np.int64),
        track_rows=elements[:, 1].astype(np.int64),
    )
    return points, _end_defects(path, num_found=len(heads), count=count, at=int(places[-1]), size=len(data))


def _point_places(data: bytes, count: int) -> list[int]:
    """Where each whole record begins, and behind the last where it ends; each says its own length."""
    unpack_length = struct.Struct("<Q").unpack_from
    size, at = len(data), 8
    places = [min(at, size)]
    for _ in range(count):
        if at + _POINT_HEAD.itemsize > size:
            break
        at += _POINT_HEAD.itemsize + _ELEMENT_BYTES * unpack_length(data, at + _LENGTH_AT)[0]
        if at > size:
            break
        places.append(at)
    return places


def read_rigs(path: Path) -> tuple[tuple[Rig, ...], list[Defect]]:
    """All rigs, and what is wrong with the file."""
    rigs, defects = _read_records(path, _rig)
    return tuple(rigs), defects


def read_frames(path: Path) -> tuple[tuple[Frame, ...], list[Defect]]:
    """All frames, and what is wrong with the file."""
    frames, defects = _read_records(path, _frame)
    return tuple(frames), defects


def _read_records(path: Path, read_one: Callable[[_Cursor], RecordT]) -> tuple[list[RecordT], list[Defect]]:
    """Records up to the end or to the first that is not whole."""
    cursor = _Cursor(path.read_bytes())
    records: list[RecordT] = []
    count = whole_until = 0
    try:
        (count,) = cursor.take("Q")
        whole_until = cursor.at
        for _ in range(count):
            records.append(read_one(cursor))
            whole_until = cursor.at
    except _EndsEarlyError:
        pass
    except _UnknownModelError as error:
        text = f"record {len(records) + 1} of {count} has {error}, so the rest cannot be read"
        return records, [Defect(rule="file-truncated", where=f"{path.name}, byte {whole_until}", text=text)]
    defects = _end_defects(path, num_found=len(records), count=count, at=whole_until, size=len(cursor.data))
    return records, defects


def _end_defects(path: Path, *, num_found: int, count: int, at: int, size: int) -> list[Defect]:
    """What is wrong with the end of the file, where the last whole record ends at byte ``at``."""
    if size < 8:
        return [
            Defect(rule="file-truncated", where=path.name, text=f"{size} bytes are no COLMAP file, which has 8 or more")
        ]
    if num_found < count:
        text = f"ends inside record {num_found + 1:,} of {count:,}: {size:,} bytes are too few"
        return [Defect(rule="file-truncated", where=f"{path.name}, byte {at}", text=text)]
    if at < size:
        text = f"{size - at:,} bytes follow the last of {count:,} records"
        return [Defect(rule="file-trailing-bytes", where=f"{path.name}, byte {at}", text=text)]
    return []


def _camera(cursor: _Cursor) -> Camera:
    camera_id, number, width, height = cursor.take("IiQQ")
    if number not in MODEL_NAMES:
        raise _UnknownModelError(f"camera model number {number}, which COLMAP 4.2 does not know")
    model = MODEL_NAMES[number]
    params = cursor.take(f"{CAMERA_MODELS[model].num_params}d")
    return Camera(camera_id=camera_id, model=model, width=width, height=height, params=params)


def _image(cursor: _Cursor) -> tuple[int, tuple[float, ...], int, str, Any]:
    """Image id, quaternion and translation, camera id, name, observations."""
    image_id, *pose, camera_id = cursor.take("I7dI")
    name = cursor.take_name()
    (num_rows,) = cursor.take("Q")
    rows = np.frombuffer(cursor.skip(num_rows * _OBSERVATION.itemsize), _OBSERVATION)
    return image_id, tuple(pose), camera_id, name, rows


def _rig(cursor: _Cursor) -> Rig:
    rig_id, num_sensors = cursor.take("II")
    sensors = [cursor.take("iI")] if num_sensors else []
    poses = {}
    for _ in range(1, num_sensors):
        kind, sensor_id, has_pose = cursor.take("iIB")
        sensors.append((kind, sensor_id))
        if has_pose:
            poses[kind, sensor_id] = cursor.take("7d")
    named = tuple((kind, sensor_id) for kind, sensor_id in sensors)
    return Rig(rig_id=rig_id, sensors=named, sensor_from_rig=poses)


def _frame(cursor: _Cursor) -> Frame:
    frame_id, rig_id, *pose, count = cursor.take("II7dI")
    data = tuple(cursor.take("iIQ") for _ in range(count))
    return Frame(
        frame_id=frame_id,
        rig_id=rig_id,
        quat_wxyz=tuple(pose[:4]),
        translation=tuple(pose[4:]),
        data=tuple((kind, sensor_id, data_id) for kind, sensor_id, data_id in data),
    )
