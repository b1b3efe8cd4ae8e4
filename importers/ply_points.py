"""The points of a PLY file of any program."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from smust3r_colmap.errors import InputError
from smust3r_colmap.geometry.arrays import FloatArray

_MAX_HEADER_BYTES = 1 << 16


def read_ply_points(path: Path) -> FloatArray:
    """(N, 3) points of a cloud, or vertices of a mesh.

    Raises:
        InputError: the file cannot be read or is cut short, has no point, or one that is not finite.
    """
    try:
        with path.open("rb") as file:
            header = file.read(_MAX_HEADER_BYTES).partition(b"end_header")[0]
            file.seek(0)
            loaded: Any = trimesh.load(file, file_type="ply", process=False)
    except (OSError, ValueError, KeyError, IndexError) as error:
        raise InputError(f"{path}: cannot be read as PLY: {type(error).__name__} {error}") from error
    points = np.asarray(getattr(loaded, "vertices", ()), dtype=np.float64).reshape(-1, 3)
    said = re.search(rb"element vertex (\d+)", header)
    if said is None or int(said[1]) != len(points):  # trimesh is silent where text ends early
        raise InputError(f"{path}: {len(points)} points, its header says {int(said[1]) if said else 'nothing'}")
    num_broken = int((~np.isfinite(points).all(axis=1)).sum())
    if not len(points) or num_broken:
        raise InputError(f"{path}: {len(points)} points, {num_broken} of them not finite; needed are finite points")
    return points
