"""The transforms.json of a scene as a value; what it names is looked up on disk, and of images the headers are read.

Nothing in it is trusted: a number may be a text, a matrix a list of two. The format has no specification but its
readers, nerfstudio's data parser and instant-ngp's loader. The next module to read is ``layout``.
"""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Callable, Iterable
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.validation.description import ImageFile, TransformsFile, TransformsFrame
from smust3r_colmap.validation.surroundings import read_image_file

INTRINSICS = ("w", "h", "fl_x", "fl_y", "cx", "cy")
"""What a frame, or the whole file, says of its camera, in pixels."""

ADDED_ENDINGS = (".png", ".jpg", ".jpeg", ".bmp", ".gif", ".tga", ".pic", ".pnm", ".psd", ".exr")
"""What instant-ngp tries in turn for a path that has no ending and is not there."""

_TEXT_OR_COMMENT = re.compile(r'"(?:\\.|[^"\\])*"|//[^\n]*|/\*.*?\*/', re.DOTALL)


def read_transforms(path: Path) -> TransformsFile:
    """What the file says, and which of the files that it names are there."""
    try:
        document, has_comments = _parsed(path.read_bytes())
        if not isinstance(document, dict) or not isinstance(document.get("frames"), list):
            raise ValueError("it has no list of frames")
        if not document["frames"]:
            raise ValueError("its list of frames is empty")
        frames = tuple(_frame(document, entry, number) for number, entry in enumerate(document["frames"], start=1))
    except (OSError, ValueError, RecursionError) as error:
        return _unreadable(path, str(error))
    ply = _text(document.get("ply_file_path"))
    named = {name for frame in frames for name in (frame.file_path, frame.mask_path) if name}
    first = min(document["frames"], key=lambda frame: str(frame["file_path"]))
    return TransformsFile(
        path=path,
        camera_model=_text(document.get("camera_model")),
        ply_file_path=ply,
        frames=frames,
        images=_found(named, lambda name: _image_file(path, name)),
        ply_is_there=bool(ply) and os.path.isfile(path.parent / ply),
        images_by_ending=_found(named, lambda name: _image_file_by_ending(path, name)),
        has_sharpness="sharpness" in first,
        has_comments=has_comments,
    )


def _parsed(data: bytes) -> tuple[Any, bool]:
    """The document, and whether it had comments."""
    try:
        return json.loads(data), False
    except ValueError:
        text = data.decode("utf-8-sig")
        bare = _TEXT_OR_COMMENT.sub(lambda found: found[0] if found[0].startswith('"') else " ", text)
        if bare == text:
            raise
        return json.loads(bare), True


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


def _found(names: Iterable[str], look: Callable[[str], ImageFile | None]) -> dict[str, ImageFile]:
    return {name: file for name in sorted(names) if (file := look(name)) is not None}


def _image_file(path: Path, name: str) -> ImageFile | None:
    """``os.path.isfile`` says no to what can be no path, such as a name of 400 characters."""
    file = path.parent / name
    return read_image_file(file, name) if os.path.isfile(file) else None


def _image_file_by_ending(path: Path, name: str) -> ImageFile | None:
    if PurePosixPath(name).suffix or os.path.isfile(path.parent / name):
        return None
    return next((file for ending in ADDED_ENDINGS if (file := _image_file(path, name + ending)) is not None), None)


def _text(value: object) -> str:
    return value if isinstance(value, str) else ""


def _number(value: object) -> float:
    """NaN for what is none; infinite where it is beyond all that a float can be."""
    if not isinstance(value, (int, float)) or isinstance(value, bool):
        return math.nan
    try:
        return float(value)
    except OverflowError:
        return math.inf if value > 0 else -math.inf


def _matrix(value: object) -> FloatArray:
    """(4, 4), or NaN where something else stands."""
    rows = value if isinstance(value, list) else []
    numbers = [[_number(number) for number in row] if isinstance(row, list) else [] for row in rows]
    if [len(row) for row in numbers] != [4] * 4:
        return np.full((4, 4), math.nan)
    return np.array(numbers)
