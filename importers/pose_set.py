"""Poses by image name, frame number or time: what the reader of every layout returns.

A reader checks what it reads: each pose is finite and rigid, and no image and no time comes twice. The next module to
read is ``pose_layouts``, which finds the reader of a file or folder.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from smust3r_colmap.errors import InputError
from smust3r_colmap.geometry.arrays import FloatArray, IntArray
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.geometry.so3 import nearest_rotation, orthonormality_error

MAX_ROUNDING = 1e-3
"""How far the length of a quaternion may be from 1, or ``R @ R.T`` from the identity: numbers with three digits."""


@dataclass(frozen=True, kw_only=True)
class DepthFiles:
    """Depth images of a data set: 16 bits, 0 for none, z-depth.

    Args:
        files: by image name.
        per_unit: numbers in a file per unit of length.
        intrinsics: of the depth images; None where the layout does not say.
    """

    files: Mapping[str, Path]
    per_unit: float
    intrinsics: Intrinsics | None


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseSet:
    """Poses in one world, in the order of the source.

    Args:
        layout: name of the layout that was read, for people.
        place: file or folder.
        world_from_cam: (N, 3, 4) rigid; camera axes x right, y down, z forward.
        names: of the N images, or empty where the layout has none.
        stamps_s: (N,) seconds, or None.
        numbers: (N,) frame numbers, from 0, where the layout has them, or None.
        image_stamps: seconds of the images that the layout lists, by name.
        depth: where the layout has it.
        unit: of lengths; ``m`` where the layout says so.
        is_model: poses that another program reconstructed; they have errors of their own.
        notes: what was found on reading, one sentence each.
    """

    layout: str
    place: Path
    world_from_cam: FloatArray
    names: tuple[str, ...] = ()
    stamps_s: FloatArray | None = None
    numbers: IntArray | None = None
    image_stamps: Mapping[str, float] = field(default_factory=dict)
    depth: DepthFiles | None = None
    unit: str = "units"
    is_model: bool = False
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        n = len(self.world_from_cam)
        if not n:
            raise InputError(f"{self.place}: has no pose")
        if self.world_from_cam.shape != (n, 3, 4) or (self.names and len(self.names) != n):
            raise ValueError(f"PoseSet: {self.world_from_cam.shape} and {len(self.names)} names")
        for values in (self.stamps_s, self.numbers):
            if values is not None and values.shape != (n,):
                raise ValueError(f"PoseSet: {n} poses and {values.shape} stamps or numbers")

    def __len__(self) -> int:
        return len(self.world_from_cam)


def text_of(path: Path) -> str:
    """The text of a file.

    Raises:
        InputError: it cannot be read.
    """
    try:
        return path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read: {error}") from error


def data_lines(path: Path, *, separator: str | None = None) -> Iterator[tuple[str, list[str]]]:
    """Place and words of the lines that are neither empty nor a comment; words are parted by blanks by default."""
    for number, line in enumerate(text_of(path).splitlines(), start=1):
        words = line.strip().split(separator) if line.strip() else []
        if words and not words[0].startswith("#"):
            yield f"{path}, line {number}", words


def numbers_of(words: list[str], place: str, needed: str) -> list[float]:
    """Finite numbers, as many as ``needed`` has words.

    Raises:
        InputError: there are more or fewer, or one is no number or not finite.
    """
    count = len(needed.split())
    try:
        numbers = [float(word) for word in words]
    except ValueError as error:
        raise InputError(f"{place}: {error}; needed {needed}") from error
    if len(numbers) != count:
        raise InputError(f"{place}: {len(numbers)} numbers; needed {count}: {needed}")
    if not np.isfinite(numbers).all():
        raise InputError(f"{place}: a number is not finite; needed {needed}")
    return numbers


def pose_from_quaternion(quat_wxyz: list[float], centre: list[float], place: str) -> FloatArray:
    """(3, 4) ``world_from_cam``; the quaternion is brought to length 1.

    Raises:
        InputError: its length is not 1.
    """
    length = float(np.linalg.norm(quat_wxyz))
    if abs(length - 1) > MAX_ROUNDING:
        raise InputError(f"{place}: the quaternion has length {length:.4g}; needed 1")
    qw, qx, qy, qz = quat_wxyz
    return np.column_stack([Rotation.from_quat([qx, qy, qz, qw]).as_matrix(), centre])


def pose_from_matrix(numbers: list[float], place: str) -> FloatArray:
    """(3, 4) from its 12 numbers row by row; the rotation is the nearest to what stands there.

    Raises:
        InputError: it is no rotation.
    """
    pose = np.asarray(numbers, dtype=np.float64).reshape(3, 4)
    off = orthonormality_error(pose[:, :3])
    if not off < MAX_ROUNDING:
        raise InputError(f"{place}: not a rotation (orthonormality error {off:.2g})")
    return np.column_stack([nearest_rotation(pose[:, :3]), pose[:, 3]])
