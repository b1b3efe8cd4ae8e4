"""A reader of COLMAP models that shares no code with the writer: struct and the public format only.

Follows https://colmap.github.io/format.html (cameras, images, points3D) and, for rigs and frames, the
comment lines of COLMAP's own text files.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

NUM_PARAMS = {0: 3, 1: 4, 2: 4, 3: 5, 4: 8, 5: 8, 6: 12, 7: 5, 8: 4, 9: 5, 10: 12}
MODEL_NAMES = {
    0: "SIMPLE_PINHOLE",
    1: "PINHOLE",
    2: "SIMPLE_RADIAL",
    3: "RADIAL",
    4: "OPENCV",
    5: "OPENCV_FISHEYE",
    6: "FULL_OPENCV",
    7: "FOV",
    8: "SIMPLE_RADIAL_FISHEYE",
    9: "RADIAL_FISHEYE",
    10: "THIN_PRISM_FISHEYE",
}
NO_POINT = 2**64 - 1
T = TypeVar("T")


@dataclass(frozen=True)
class ReadCamera:
    model: str
    width: int
    height: int
    params: tuple[float, ...]


@dataclass(frozen=True)
class ReadImage:
    quat_wxyz: tuple[float, ...]
    translation: tuple[float, ...]
    camera_id: int
    name: str
    points2d: tuple[tuple[float, float, int], ...]


@dataclass(frozen=True)
class ReadPoint:
    xyz: tuple[float, ...]
    rgb: tuple[int, ...]
    error: float
    track: tuple[tuple[int, int], ...]


@dataclass(frozen=True)
class ReadFrame:
    rig_id: int
    quat_wxyz: tuple[float, ...]
    translation: tuple[float, ...]
    data_ids: tuple[tuple[int, int, int], ...]
    """sensor type (0 is a camera), sensor id, image id"""


@dataclass(frozen=True)
class ReadModel:
    cameras: dict[int, ReadCamera]
    images: dict[int, ReadImage]
    points: dict[int, ReadPoint]
    rigs: dict[int, tuple[tuple[int, int], ...]]
    """sensors as (type, id), the reference first; rigs with further sensors are not read"""
    frames: dict[int, ReadFrame]


def read_binary(folder: Path) -> ReadModel:
    return ReadModel(
        cameras=_read_all(folder / "cameras.bin", _binary_camera),
        images=_read_all(folder / "images.bin", _binary_image),
        points=_read_all(folder / "points3D.bin", _binary_point),
        rigs=_read_all(folder / "rigs.bin", _binary_rig),
        frames=_read_all(folder / "frames.bin", _binary_frame),
    )


def _take(file: BinaryIO, layout: str) -> tuple[Any, ...]:
    return struct.unpack("<" + layout, file.read(struct.calcsize("<" + layout)))


def _read_all(path: Path, read_one: Callable[[BinaryIO], tuple[int, T]]) -> dict[int, T]:
    with path.open("rb") as file:
        (count,) = _take(file, "Q")
        found = dict(read_one(file) for _ in range(count))
        assert len(found) == count, f"{path.name}: an id occurs twice"
        assert not file.read(), f"{path.name}: bytes after the last record"
    return found


def _binary_camera(file: BinaryIO) -> tuple[int, ReadCamera]:
    camera_id, model, width, height = _take(file, "iiQQ")
    return camera_id, ReadCamera(MODEL_NAMES[model], width, height, _take(file, f"{NUM_PARAMS[model]}d"))


def _binary_image(file: BinaryIO) -> tuple[int, ReadImage]:
    image_id, *pose, camera_id = _take(file, "i7di")
    name = bytearray()
    while (letter := file.read(1)) != b"\x00":
        assert letter, "name without end"
        name += letter
    (count,) = _take(file, "Q")
    points = tuple(_take(file, "ddQ") for _ in range(count))
    return image_id, ReadImage(tuple(pose[:4]), tuple(pose[4:]), camera_id, name.decode(), points)


def _binary_point(file: BinaryIO) -> tuple[int, ReadPoint]:
    point_id, x, y, z, red, green, blue, error, length = _take(file, "Q3d3BdQ")
    track = tuple(_take(file, "ii") for _ in range(length))
    return point_id, ReadPoint((x, y, z), (red, green, blue), error, track)


def _binary_rig(file: BinaryIO) -> tuple[int, tuple[tuple[int, int], ...]]:
    rig_id, num_sensors = _take(file, "II")
    assert num_sensors == 1, "only rigs of one sensor are read"
    kind, sensor_id = _take(file, "iI")
    return rig_id, ((kind, sensor_id),)


def _binary_frame(file: BinaryIO) -> tuple[int, ReadFrame]:
    frame_id, rig_id, *pose, count = _take(file, "II7dI")
    data_ids = tuple(_take(file, "iIQ") for _ in range(count))
    return frame_id, ReadFrame(rig_id, tuple(pose[:4]), tuple(pose[4:]), data_ids)


def read_text(folder: Path) -> ReadModel:
    images = {}
    lines = _data_lines(folder / "images.txt")
    for head, observations in zip(lines[::2], lines[1::2], strict=True):
        image_id, *pose, camera_id, name = head.split()
        values = observations.split()
        points = tuple(
            (float(x), float(y), int(point) % (NO_POINT + 1))
            for x, y, point in zip(values[::3], values[1::3], values[2::3], strict=True)
        )
        numbers = tuple(map(float, pose))
        images[int(image_id)] = ReadImage(numbers[:4], numbers[4:], int(camera_id), name, points)
    cameras = {}
    for camera_id, model, width, height, *params in map(str.split, _data_lines(folder / "cameras.txt")):
        cameras[int(camera_id)] = ReadCamera(model, int(width), int(height), tuple(map(float, params)))
    points3d = {}
    for point_id, x, y, z, red, green, blue, error, *track in map(str.split, _data_lines(folder / "points3D.txt")):
        elements = tuple(zip(map(int, track[::2]), map(int, track[1::2]), strict=True))
        points3d[int(point_id)] = ReadPoint(
            (float(x), float(y), float(z)), (int(red), int(green), int(blue)), float(error), elements
        )
    rigs: dict[int, tuple[tuple[int, int], ...]] = {}
    for rig_id, num_sensors, kind, sensor in map(str.split, _data_lines(folder / "rigs.txt")):
        assert (num_sensors, kind) == ("1", "CAMERA"), "only rigs of one camera are read"
        rigs[int(rig_id)] = ((0, int(sensor)),)
    frames = {}
    for frame_id, rig_id, *rest in map(str.split, _data_lines(folder / "frames.txt")):
        numbers, data = tuple(map(float, rest[:7])), rest[8:]
        data_ids = tuple((0, int(s), int(d)) for _, s, d in zip(data[::3], data[1::3], data[2::3], strict=True))
        assert len(data_ids) == int(rest[7])
        frames[int(frame_id)] = ReadFrame(int(rig_id), numbers[:4], numbers[4:], data_ids)
    return ReadModel(cameras=cameras, images=images, points=points3d, rigs=rigs, frames=frames)


def _data_lines(path: Path) -> list[str]:
    """Lines that are no comment; empty ones stay, images.txt has them for images without points."""
    return [line for line in path.read_text(encoding="utf-8").split("\n")[:-1] if not line.startswith("#")]
