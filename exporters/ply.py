"""A point cloud as PLY: binary little endian, colours, normals where they are known.

Written with numpy because trimesh drops the normals of point clouds and stores coordinates in single
precision only. Read by trimesh, COLMAP, Open3D, MeshLab and CloudCompare alike. The next module to
read is ``glb``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from smust3r_colmap.products import PointCloud
from smust3r_colmap.storage.atomic_write import write_atomically

FLOAT32_RELATIVE_STEP = 1e-6
"""Single precision is kept while its step at the farthest point is below this part of the extent."""

_PLY_TYPES = {"<f4": "float", "<f8": "double", "|u1": "uchar"}


def write_ply(points: PointCloud, path: Path) -> None:
    """Write ``points`` to ``path`` in their own frame and unit.

    Coordinates are ``float``, as every reader expects, and ``double`` for clouds that lie so far from
    the origin (projected map coordinates) that single precision would round them visibly.

    Raises:
        StorageError: the disk refused.
    """
    rows = _structured(points)
    properties = "".join(f"property {_PLY_TYPES[rows.dtype[name].str]} {name}\n" for name in rows.dtype.names or ())
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{properties}end_header\n"
    write_atomically(path, header.encode("ascii") + rows.tobytes())


def _structured(points: PointCloud) -> npt.NDArray[Any]:
    """One row per point, packed as in the file."""
    coordinate = "<f8" if _needs_double(points.xyz) else "<f4"
    columns: dict[str, tuple[str, npt.NDArray[Any]]] = {}
    columns |= {name: (coordinate, points.xyz[:, axis]) for axis, name in enumerate(("x", "y", "z"))}
    if points.normals is not None:
        columns |= {name: ("<f4", points.normals[:, axis]) for axis, name in enumerate(("nx", "ny", "nz"))}
    columns |= {name: ("|u1", points.rgb[:, axis]) for axis, name in enumerate(("red", "green", "blue"))}
    rows = np.empty(len(points), dtype=[(name, kind) for name, (kind, _) in columns.items()])
    for name, (_, values) in columns.items():
        rows[name] = values
    return rows


def _needs_double(xyz: npt.NDArray[np.float64]) -> bool:
    """True when rounding to float32 would show at the size of the cloud."""
    if len(xyz) == 0:
        return False
    step = np.abs(xyz).max() * np.finfo(np.float32).eps
    extent = float(np.linalg.norm(np.ptp(xyz, axis=0)))
    return bool(step > FLOAT32_RELATIVE_STEP * extent > 0)
