"""The files of a COLMAP model by any program, binary or text, as records that know their place in the file.

Read here and not by pycolmap, because pycolmap refuses, without naming a line, much of what other programs write:
points whose tracks name images that do not exist, ``images.txt`` without its empty lines, a folder without points.
Defects with only one meaning are repaired and counted; others are refused with file, line and number. Observations
(``points2D``) are skipped: refinement finds observations of its own.

Layout: https://colmap.github.io/format.html. The next module to read is ``rig_poses``.
"""

from __future__ import annotations

import codecs
import struct
from array import array
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pycolmap

from smust3r_colmap.errors import InputError
from smust3r_colmap.geometry.arrays import FloatArray, IntArray
from smust3r_colmap.importers.rig_poses import Pose, poses_by_image

_WHERE_MODELS_LIE = ("", "sparse/0", "sparse", "0")
"""Below the folder that a person names; the first that holds cameras and images is taken."""

_NUM_POSE_WORDS = 10
"""IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME; the name may have blanks."""


@dataclass(frozen=True, kw_only=True)
class CameraRecord:
    """One camera as it is written; ``place`` is its file and line, or the number of the record."""

    place: str
    camera_id: int
    model: str
    width: int
    height: int
    params: tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class ImageRecord:
    """One image as it is written; ``numbers`` are QW QX QY QZ TX TY TZ, cam from world."""

    place: str
    image_id: int
    numbers: tuple[float, ...]
    camera_id: int
    name: str


@dataclass(frozen=True, kw_only=True, eq=False)
class PointRecords:
    """All points as they are written.

    Args:
        xyz: (P, 3), possibly not finite. rgb: (P, 3), possibly outside 0..255.
        point_of_element: (M,) row of the points. image_id_of_element: (M,) what the track names.
    """

    xyz: FloatArray
    rgb: FloatArray
    point_of_element: IntArray
    image_id_of_element: IntArray


@dataclass(frozen=True, kw_only=True)
class ModelRecords:
    """What the files of one model say.

    Args:
        folder: where they lie.
        cameras, images: in the order of the files.
        points: None where there is no such file.
        poses_by_frame: by image id, cam from world as rigs and frames have it; empty without these files.
    """

    folder: Path
    cameras: tuple[CameraRecord, ...]
    images: tuple[ImageRecord, ...]
    points: PointRecords | None
    poses_by_frame: Mapping[int, Pose]


class Fixes:
    """Counts repaired defects, and remembers the first place of each kind."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()
        self._first: dict[str, str] = {}

    def note(self, what: str, place: str, count: int = 1) -> None:
        """``what`` is in the plural, such as ``"images without a line of observations"``; a count of 0 is no fix."""
        if count:
            self._counts[what] += count
            self._first.setdefault(what, place)

    def texts(self) -> tuple[str, ...]:
        """One line for each kind, in the order of its first appearance."""
        return tuple(f"{count} {what} (first: {self._first[what]})" for what, count in self._counts.items())


def read_records(folder: Path, fixes: Fixes) -> ModelRecords:
    """The records of the model in ``folder``, or in ``sparse/0``, ``sparse`` or ``0`` below it.

    Where a model lies there both ways the binary files are taken, as by COLMAP.

    Raises:
        InputError: there is no model, or a file cannot be read; names file, line and number.
    """
    place, suffix = _find_model(folder)
    points, cameras = place / f"points3D{suffix}", place / f"cameras{suffix}"
    images, poses_by_frame = _images(place, suffix, fixes)
    if suffix == ".bin":
        read_cameras = tuple(_binary_cameras(_Cursor(cameras, fixes)))
        read_points = _binary_points(_Cursor(points, fixes)) if points.exists() else None
    else:
        read_cameras = tuple(_text_cameras(cameras))
        read_points = _text_points(points, fixes) if points.exists() else None
    return ModelRecords(
        folder=place, cameras=read_cameras, images=images, points=read_points, poses_by_frame=poses_by_frame
    )


def read_image_records(folder: Path, fixes: Fixes) -> tuple[tuple[ImageRecord, ...], Mapping[int, Pose]]:
    """The images alone, and their poses by rigs and frames; the model is looked for as by ``read_records``.

    Raises:
        InputError: as ``read_records``.
    """
    place, suffix = _find_model(folder)
    return _images(place, suffix, fixes)


def _images(place: Path, suffix: str, fixes: Fixes) -> tuple[tuple[ImageRecord, ...], Mapping[int, Pose]]:
    path = place / f"images{suffix}"
    records = _binary_images(_Cursor(path, fixes)) if suffix == ".bin" else _text_images(path, fixes)
    return tuple(records), poses_by_image(place, suffix)


def holds_model(folder: Path) -> bool:
    """Whether cameras and images of a model lie in this very folder."""
    return any(_holds(folder, suffix) for suffix in (".bin", ".txt"))


def _holds(folder: Path, suffix: str) -> bool:
    return all((folder / f"{name}{suffix}").is_file() for name in ("cameras", "images"))


def _find_model(folder: Path) -> tuple[Path, str]:
    if not folder.is_dir():
        raise InputError(f"{folder}: {'is a file' if folder.exists() else 'there is no such folder'}; name a model's")
    for below in _WHERE_MODELS_LIE:
        for suffix in (".bin", ".txt"):
            if _holds(folder / below, suffix):
                return folder / below, suffix
    found = sorted(entry.name for entry in folder.iterdir())[:5]
    raise InputError(
        f"{folder}: holds no COLMAP model (cameras and images, both .bin or both .txt), nor does sparse/0, sparse or 0 "
        f"below it; found {', '.join(found) or 'nothing'}"
    )


# ------------------------------------------------------------------------------ text
def _lines(path: Path) -> Iterator[tuple[int, bytes]]:
    """Lines that are no comment, empty ones too, with their numbers; as bytes, which are numbers to float() too."""
    try:
        with path.open("rb") as file:
            for number, line in enumerate(file, start=1):
                stripped = line.removeprefix(codecs.BOM_UTF8).strip()
                if not stripped.startswith(b"#"):
                    yield number, stripped
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error


def _line(path: Path, number: int) -> str:
    return f"{path}: line {number}"


def _text_cameras(path: Path) -> Iterator[CameraRecord]:
    """CAMERA_ID MODEL WIDTH HEIGHT PARAMS..."""
    for number, line in _lines(path):
        words, place = line.split(), _line(path, number)
        if not words:
            continue
        if len(words) < 5:
            raise InputError(f"{place}: {len(words)} words; a camera has an id, model, width, height and parameters")
        camera_id, width, height = (_integer(words[k], place) for k in (0, 2, 3))
        yield CameraRecord(
            place=place,
            camera_id=camera_id,
            model=_decoded(words[1], place),
            width=width,
            height=height,
            params=tuple(_number(word, place) for word in words[4:]),
        )


def _text_images(path: Path, fixes: Fixes) -> Iterator[ImageRecord]:
    """Every second line should have observations or be empty; as many writers forget that, each line is looked at."""
    missing = "images without a line of observations"
    awaited = ""  # the place of an image whose line of observations is still to come
    for number, line in _lines(path):
        if not line or _are_observations(line):
            awaited = ""
            continue
        fixes.note(missing, awaited, count=bool(awaited))
        awaited = _line(path, number)
        yield _text_image(awaited, line)
    fixes.note(missing, awaited, count=bool(awaited))


def _are_observations(line: bytes) -> bool:
    """Triples X Y POINT3D_ID and nothing else; a name at the end is no number, or makes the count no multiple of 3.

    Lines of observations are the bulk of the file, so only the last word, and the one where the name of a
    pose would begin, are looked at.
    """
    words = line.split()
    return len(words) % 3 == 0 and all(_is_number(word) for word in (words[-1], *words[9:10]))


def _text_image(place: str, line: bytes) -> ImageRecord:
    words = line.split(maxsplit=_NUM_POSE_WORDS - 1)
    if len(words) < _NUM_POSE_WORDS:
        raise InputError(
            f"{place}: {len(words)} words; an image has {_NUM_POSE_WORDS}: IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
        )
    return ImageRecord(
        place=place,
        image_id=_integer(words[0], place),
        numbers=tuple(_number(word, place) for word in words[1:8]),
        camera_id=_integer(words[8], place),
        name=_decoded(words[9], place),
    )


def _text_points(path: Path, fixes: Fixes) -> PointRecords:
    """POINT3D_ID X Y Z R G B ERROR and pairs IMAGE_ID POINT2D_IDX; some writers have no ERROR where no track is."""
    numbers, lengths, images = array("d"), array("q"), array("q")
    for number, line in _lines(path):
        words = line.split()
        if not words:
            continue
        if len(words) < 7:
            raise InputError(
                f"{_line(path, number)}: {len(words)} words; a point has an id, X Y Z, R G B, an error and its track"
            )
        try:
            numbers.extend(map(float, words[1:7]))
            track = [int(word) for word in words[8:-1:2]]
        except (ValueError, OverflowError) as error:
            raise InputError(f"{_line(path, number)}: {error}") from error
        if len(words) > 8 and len(words) % 2:
            fixes.note("tracks that break off after an image id", _line(path, number))
        lengths.append(len(track))
        images.extend(track)
    return _points(np.asarray(numbers).reshape(-1, 6), np.asarray(lengths), np.asarray(images))


def _number(word: bytes, place: str) -> float:
    try:
        return float(word)
    except ValueError as error:
        raise InputError(f"{place}: {word.decode(errors='replace')!r} stands where a number is needed") from error


def _integer(word: bytes, place: str) -> int:
    number = _number(word, place)
    if not number.is_integer():
        raise InputError(f"{place}: {word.decode()} stands where a whole number is needed")
    return int(number)


def _is_number(word: bytes) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _decoded(word: bytes, place: str) -> str:
    try:
        return word.decode()
    except UnicodeDecodeError as error:
        raise InputError(f"{place}: {word.decode(errors='replace')!r} is not UTF-8; save the file as UTF-8") from error


# ---------------------------------------------------------------------------- binary
class _Cursor:
    """Takes little-endian numbers from a file, and knows which record it is in when they end."""

    def __init__(self, path: Path, fixes: Fixes) -> None:
        try:
            self._data = path.read_bytes()
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror})") from error
        self._path = path
        self._fixes = fixes
        self._at = 0
        self._record = self._count = 0

    @property
    def place(self) -> str:
        """File and record, for messages."""
        return f"{self._path}: record {self._record} of {self._count}"

    def records(self) -> Iterator[None]:
        """One step for each record; whoever asks for the next has read the one before."""
        (self._count,) = self.take(_COUNT)
        for number in range(1, self._count + 1):
            self._record = number
            yield
        left = len(self._data) - self._at
        self._fixes.note("bytes after the last record were passed over", str(self._path), count=left)

    def take(self, layout: struct.Struct) -> tuple[Any, ...]:
        """The next numbers."""
        return layout.unpack(self.take_bytes(layout.size))

    def take_bytes(self, count: int) -> bytes:
        """The next ``count`` bytes.

        Raises:
            InputError: the file ends before.
        """
        end = self._at + count
        if end > len(self._data):
            raise InputError(
                f"{self.place}: the file ends after {len(self._data)} bytes, at least {end} are needed; it is cut off, "
                "or no COLMAP file"
            )
        taken = self._data[self._at : end]
        self._at = end
        return taken

    def take_text(self) -> str:
        """The text up to the next zero byte."""
        end = self._data.find(b"\0", self._at)
        until = len(self._data) if end < 0 else end
        return _decoded(self.take_bytes(until + 1 - self._at)[:-1], self.place)


_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")
_IMAGE = struct.Struct("<I7dI")
_POINT = struct.Struct("<Q3d3BdQ")
_OBSERVATION_BYTES = 24
_TRACK_ELEMENT_BYTES = 8

_MODEL_OF_NUMBER = {int(model): name for name, model in pycolmap.CameraModelId.__members__.items() if name != "INVALID"}


def _binary_cameras(cursor: _Cursor) -> Iterator[CameraRecord]:
    for _ in cursor.records():
        camera_id, number, width, height = cursor.take(_CAMERA)
        model = _MODEL_OF_NUMBER.get(number)
        if model is None:
            raise InputError(f"{cursor.place}: camera model {number}; known are 0 to {max(_MODEL_OF_NUMBER)}")
        num_params = len(pycolmap.Camera.create_from_model_name(1, model, 1.0, 1, 1).params)
        params = cursor.take(struct.Struct(f"<{num_params}d"))
        yield CameraRecord(
            place=cursor.place, camera_id=camera_id, model=model, width=width, height=height, params=params
        )


def _binary_images(cursor: _Cursor) -> Iterator[ImageRecord]:
    for _ in cursor.records():
        image_id, *numbers, camera_id = cursor.take(_IMAGE)
        name = cursor.take_text()
        (num_observations,) = cursor.take(_COUNT)
        cursor.take_bytes(_OBSERVATION_BYTES * num_observations)
        yield ImageRecord(place=cursor.place, image_id=image_id, numbers=tuple(numbers), camera_id=camera_id, name=name)


def _binary_points(cursor: _Cursor) -> PointRecords:
    numbers, lengths, elements = array("d"), array("q"), bytearray()
    for _ in cursor.records():
        _, *values, _, length = cursor.take(_POINT)
        numbers.extend(values)
        lengths.append(length)
        elements += cursor.take_bytes(_TRACK_ELEMENT_BYTES * length)
    images = np.frombuffer(bytes(elements), dtype="<u4").reshape(-1, 2)[:, 0]
    return _points(np.asarray(numbers).reshape(-1, 6), np.asarray(lengths), images)


def _points(
    numbers: FloatArray, lengths: npt.NDArray[np.integer[Any]], images: npt.NDArray[np.integer[Any]]
) -> PointRecords:
    """From rows X Y Z R G B and the tracks one after the other."""
    return PointRecords(
        xyz=numbers[:, :3],
        rgb=numbers[:, 3:],
        point_of_element=np.repeat(np.arange(len(lengths)), lengths),
        image_id_of_element=images.astype(np.int64),
    )
