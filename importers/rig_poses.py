"""Poses of images by rigs and frames, which COLMAP 4 believes more than the lines of the images.

An adjustment of rigs may leave the lines of the images as they were before. Layout: rigs are RIG_ID NUM_SENSORS, kind
and id of the reference sensor, and for each other sensor its kind, id, whether it has a pose, and sensor_from_rig;
frames are FRAME_ID RIG_ID, rig_from_world, NUM_DATA, and for each datum the kind and id of the sensor and the id of the
image. The next module to read is ``colmap_model``.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from smust3r_colmap.errors import InputError

Pose: TypeAlias = tuple[float, ...]
"""QW QX QY QZ TX TY TZ."""
_Word: TypeAlias = int | float

POSE_TOLERANCE = 1e-6
"""Relative, between two poses that are written from one number."""
_IDENTITY: Pose = (1.0, 0, 0, 0, 0, 0, 0)
_CAMERA = 0
_SENSOR_KINDS = {"CAMERA": _CAMERA, "IMU": 1}


def poses_by_image(folder: Path, suffix: str) -> dict[int, Pose]:
    """cam_from_world by image id, of the images whose frame and sensor have finite poses.

    Args:
        folder, suffix: of the model; where it has not both rigs and frames the result is empty.

    Raises:
        InputError: a file ends early or has something else than numbers; names file and record.
    """
    rigs, frames = folder / f"rigs{suffix}", folder / f"frames{suffix}"
    if not (rigs.is_file() and frames.is_file()):
        return {}
    read = _text_records if suffix == ".txt" else _binary_records
    sensor_from_rig: dict[tuple[int, int, int], Pose] = {}
    for record in read(rigs):
        rig_id, num_sensors = record.whole(), record.whole()
        for number in range(num_sensors):
            kind, sensor_id = record.kind(), record.whole()
            if number == 0:
                sensor_from_rig[rig_id, kind, sensor_id] = _IDENTITY
            elif record.flag():
                sensor_from_rig[rig_id, kind, sensor_id] = record.pose()
    poses = {}
    for record in read(frames):
        _, rig_id, rig_from_world = record.whole(), record.whole(), record.pose()
        for _ in range(record.whole()):
            kind, sensor_id, image_id = record.kind(), record.whole(), record.long()
            sensor = sensor_from_rig.get((rig_id, kind, sensor_id))
            if kind == _CAMERA and sensor is not None and np.isfinite((*sensor, *rig_from_world)).all():
                poses[image_id] = composed(sensor, rig_from_world)
    return poses


def composed(c_from_b: Pose, b_from_a: Pose) -> Pose:
    """``c_from_a``; quaternions that are none give NaN."""
    with np.errstate(over="ignore"):
        lengths = [float(np.linalg.norm(pose[:4])) for pose in (c_from_b, b_from_a)]
    if not all(1e-6 < length < 1e6 for length in lengths):
        return (float("nan"),) * 7
    turn_cb, turn_ba = (
        Rotation.from_quat(np.array([*pose[1:4], pose[0]]) / length)
        for pose, length in zip((c_from_b, b_from_a), lengths, strict=True)
    )
    x, y, z, w = (turn_cb * turn_ba).as_quat()
    translation = turn_cb.apply(b_from_a[4:]) + c_from_b[4:]
    return tuple(float(value) for value in (w, x, y, z, *translation))


def is_same_pose(pose: Pose, other: Pose) -> bool:
    """The same but for rounding; a quaternion and its negative are one rotation. Nothing is the same as NaN."""
    with np.errstate(over="ignore", invalid="ignore"):
        quats = [np.asarray(one[:4]) / max(float(np.linalg.norm(one[:4])), 1e-12) for one in (pose, other)]
        scale = max(1.0, float(np.abs(other[4:]).max()))
        moved = float(np.abs(np.subtract(pose[4:], other[4:])).max())
        turned = min(float(np.abs(quats[0] - sign * quats[1]).max()) for sign in (1, -1))
    return moved <= POSE_TOLERANCE * scale and turned <= POSE_TOLERANCE


class _Record:
    """Takes the fields of one record, of text or of binary files."""

    def __init__(self, place: str) -> None:
        self.place = place

    def whole(self) -> int:
        raise NotImplementedError

    def long(self) -> int:
        return self.whole()

    def kind(self) -> int:
        return self.whole()

    def flag(self) -> bool:
        return bool(self.whole())

    def pose(self) -> Pose:
        raise NotImplementedError

    def ends_early(self) -> InputError:
        return InputError(f"{self.place}: ends early; write rigs and frames again, or delete both")


class _TextRecord(_Record):
    def __init__(self, place: str, words: Iterator[str]) -> None:
        super().__init__(place)
        self._words = words

    def whole(self) -> int:
        return int(self._number())

    def kind(self) -> int:
        word = next(self._words, "")
        if word not in _SENSOR_KINDS:
            raise InputError(f"{self.place}: {word!r} stands where the kind of a sensor is needed, CAMERA or IMU")
        return _SENSOR_KINDS[word]

    def pose(self) -> Pose:
        return tuple(self._number() for _ in range(7))

    def _number(self) -> float:
        word = next(self._words, None)
        if word is None:
            raise self.ends_early()
        try:
            return float(word)
        except ValueError as error:
            raise InputError(f"{self.place}: {word!r} stands where a number is needed") from error


class _BinaryRecord(_Record):
    def __init__(self, path: Path, data: bytes) -> None:
        super().__init__(str(path))
        self._data = data
        self.at = 0

    def whole(self) -> int:
        return int(self._take("I")[0])

    def long(self) -> int:
        return int(self._take("Q")[0])

    def flag(self) -> bool:
        return bool(self._take("B")[0])

    def pose(self) -> Pose:
        return tuple(map(float, self._take("7d")))

    def _take(self, layout: str) -> tuple[_Word, ...]:
        fields = struct.Struct(f"<{layout}")
        if self.at + fields.size > len(self._data):
            raise self.ends_early()
        taken = fields.unpack_from(self._data, self.at)
        self.at += fields.size
        return taken


def _text_records(path: Path) -> Iterator[_Record]:
    for number, line in enumerate(_read(path).decode("utf-8", "replace").splitlines(), start=1):
        words = line.split()
        if words and not line.lstrip().startswith("#"):
            yield _TextRecord(f"{path}: line {number}", iter(words))


def _binary_records(path: Path) -> Iterator[_Record]:
    record = _BinaryRecord(path, _read(path))
    for number in range(record.long()):
        record.place = f"{path}: record {number + 1}"
        yield record


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
