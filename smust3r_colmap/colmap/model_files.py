"""COLMAP model files: which there are, and binary files that are checked after they are written."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import pycolmap

from smust3r_colmap.errors import InputError, StorageError

MODEL_FILES = frozenset(
    f"{name}.{suffix}" for name in ("rigs", "cameras", "frames", "images", "points3D") for suffix in ("bin", "txt")
)


def refuse_names_text_cannot_hold(names: Iterable[str]) -> None:
    """Names with blanks survive in binary; readers of the text format cut them at the first blank.

    Cheap, so that a run can ask before it starts instead of after hours.

    Raises:
        InputError: naming the first such image.
    """
    for name in names:
        if not name or any(letter.isspace() for letter in name):
            raise InputError(
                f"{name!r}: COLMAP's text format cannot hold a name with blanks; rename the image or leave --text out"
            )


def write_binary_checked(model: pycolmap.Reconstruction, folder: Path, *, to_be: Path | None = None) -> None:
    """Write the ``.bin`` files into a folder that exists, and count what arrived: pycolmap is silent on a full disk.

    Args:
        model: any model.
        folder: where the files are written.
        to_be: where they will be later, for the message.

    Raises:
        StorageError: less arrived than was written.

    Source: the sizes follow from COLMAP's documented layout: a count of 8 bytes each, then per camera id, model, size
    and parameters; per image id, pose, camera, name with its zero, the count of its observations and 24 bytes for
    each; per point id, position, colour, error, the length of its track and 8 bytes for each element.
    """
    model.write_binary(folder)
    registered = [model.image(image_id) for image_id in model.reg_image_ids()]
    expected = {
        "cameras.bin": 8 + sum(24 + 8 * len(camera.params) for camera in model.cameras.values()),
        "images.bin": 8
        + sum(64 + len(image.name.encode()) + 1 + 8 + 24 * image.num_points2D() for image in registered),
        "points3D.bin": 8 + 51 * model.num_points3D() + 8 * model.compute_num_observations(),
    }
    for name, count in expected.items():
        _refuse_less(to_be or folder, name, (folder / name).stat().st_size, count, "bytes")


def write_text_checked(model: pycolmap.Reconstruction, folder: Path, *, to_be: Path | None = None) -> None:
    """Write the ``.txt`` files into a folder that exists, and count what arrived.

    Args:
        model: any model whose names have no blanks.
        folder: where the files are written.
        to_be: where they will be later, for the message.

    Raises:
        StorageError: less arrived than was written.
    """
    model.write_text(folder)
    for name, count in {"images.txt": 2 * model.num_reg_images(), "points3D.txt": model.num_points3D()}.items():
        _refuse_less(to_be or folder, name, _count_lines(folder / name), count, "lines")


def _refuse_less(folder: Path, name: str, found: int, expected: int, unit: str) -> None:
    if found != expected:
        raise StorageError(f"{folder / name}: {found} of {expected} {unit} arrived; is the disk full?")


def _count_lines(path: Path) -> int:
    """Complete lines that are no comment."""
    with path.open("rb") as lines:
        return sum(line.endswith(b"\n") and not line.startswith(b"#") for line in lines)
