"""The transforms.json of a scene as a value; what it names is looked up on disk, and of images the headers are read.

Nothing in it is trusted: a number may be a text, a matrix a list of two. The format has no specification but its
readers, nerfstudio's data parser and instant-ngp's loader. The next module to read is ``layout``.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from smust3r_colmap.validation.description import FloatArray, ImageFile, TransformsFile, TransformsFrame
from smust3r_colmap.validation.surroundings import read_image_file

INTRINSICS = ("w", "h", "fl_x", "fl_y", "cx", "cy")
"""What a frame, or the whole file, says of its camera, in pixels."""


def read_transforms(path: Path) -> TransformsFile:
    """What the file says, and which of the files that it names are there."""
    try:
        document = json.loads(path.read_bytes())
        if not isinstance(document, dict) or not isinstance(document.get("frames"), list):
            raise ValueError("it has no list of frames")
        frames = tuple(_frame(document, entry, number) for number, entry in enumerate(document["frames"], start=1))
    except (OSError, ValueError, RecursionError) as error:
        return _unreadable(path, str(error))
    ply = _text(document.get("ply_file_path"))
    named = {name for frame in frames for name in (frame.file_path, frame.mask_path) if name}
    return TransformsFile(
        path=path,
        camera_model=_text(document.get("camera_model")),
        ply_file_path=ply,
        frames=frames,
        images={name: file for name in sorted(named) if (file := _image_file(path, name)) is not None},
        ply_is_there=bool(ply) and (path.parent / ply).is_file(),
    )


def _unreadable(path: Path, problem: str) -> TransformsFile:
    return TransformsFile(
        path=path, camera_model="", ply_file_path="", frames=(), images={}, ply_is_there=False, problem=problem
    )


def _frame(document: dict[str, Any], entry: object, number: int) -> TransformsFrame:
    if not isinstance(entry, dict) or not _text(entry.get("file_path")):
        raise ValueError(f"frame {number} has no file_path")
    together = {**document, **entry}
    return TransformsFrame(
        file_path=_text(entry["file_path"]),
        mask_path=_text(entry.get("mask_path")),
        numbers={name: _number(together[name]) for name in INTRINSICS if name in together},
        world_from_opengl=_matrix(entry.get("transform_matrix")),
    )


def _image_file(path: Path, name: str) -> ImageFile | None:
    file = path.parent / name
    return read_image_file(file, name) if file.is_file() else None


def _text(value: object) -> str:
    return value if isinstance(value, str) else ""


def _number(value: object) -> float:
    return float(value) if isinstance(value, (int, float)) and not isinstance(value, bool) else math.nan


def _matrix(value: object) -> FloatArray:
    """(4, 4), or NaN where something else stands."""
    rows = value if isinstance(value, list) else []
    numbers = [[_number(number) for number in row] if isinstance(row, list) else [] for row in rows]
    if [len(row) for row in numbers] != [4] * 4:
        return np.full((4, 4), math.nan)
    return np.array(numbers)
