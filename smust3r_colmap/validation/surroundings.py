"""What lies around a model: image files, masks, the database, a PLY, depth and a dense workspace.

Of images only the headers are read. Nothing is written, the database is opened for reading only.
The next module to read is ``transforms_file``.
"""

from __future__ import annotations

import json
import os
import sqlite3
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from PIL import Image, UnidentifiedImageError

from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.importers.images import SUFFIXES, TURNED_SIDEWAYS, stored_orientation
from smust3r_colmap.validation.description import (
    Database,
    DatabaseImage,
    DenseFolder,
    DepthFolder,
    FileFolder,
    ImageFile,
    PlyCloud,
)

_PLY_TYPES = {
    **{"char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1"},
    **{"short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2"},
    **{"int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4"},
    **{"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"},
}
_PLY_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
_MAX_PLY_HEADER = 1 << 16
_MAX_MAP_HEADER = 64


def read_image_folder(folder: Path) -> FileFolder:
    """All image files below ``folder`` by their headers; hidden files are left out, as programs do."""
    files = []
    for place, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if not name.startswith(".")]
        for name in names:
            if name.lower().endswith(SUFFIXES) and not name.startswith("."):
                path = Path(place, name)
                files.append(read_image_file(path, path.relative_to(folder).as_posix()))
    return FileFolder(folder=folder, files=tuple(sorted(files, key=lambda file: file.name)))


def read_image_file(path: Path, name: str) -> ImageFile:
    """One image file by its header, to be known as ``name``."""
    try:
        with Image.open(path) as image:
            turned = stored_orientation(image) in TURNED_SIDEWAYS
            return ImageFile(name=name, width=image.width, height=image.height, turned=turned)
    except (OSError, SyntaxError, ValueError, UnidentifiedImageError, Image.DecompressionBombError):
        return ImageFile(name=name, width=0, height=0)


def read_database(path: Path) -> Database:
    """Ids, names and numbers of keypoints; ``problem`` says why where this is no COLMAP database."""
    try:
        # Merely read-only, SQLite would still leave its two helper files beside a database in WAL mode.
        connection = sqlite3.connect(f"{path.absolute().as_uri()}?immutable=1", uri=True)
        try:
            return _database(path, connection)
        finally:
            connection.close()
    except sqlite3.Error as error:
        return Database(path=path, images=(), cameras={}, problem=str(error))


def _database(path: Path, connection: sqlite3.Connection) -> Database:
    tables = {name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    keypoints = dict(connection.execute("SELECT image_id, rows FROM keypoints"))
    frames: dict[int, int] = {}
    if "frame_data" in tables:
        frames = dict(connection.execute("SELECT data_id, frame_id FROM frame_data WHERE sensor_type = 0"))
    images = tuple(
        DatabaseImage(
            image_id=image_id,
            name=name,
            camera_id=camera_id,
            frame_id=frames.get(image_id),
            num_keypoints=keypoints.get(image_id, 0),
        )
        for image_id, name, camera_id in connection.execute("SELECT image_id, name, camera_id FROM images")
    )
    cameras = {
        camera_id: (model, width, height)
        for camera_id, model, width, height in connection.execute("SELECT camera_id, model, width, height FROM cameras")
    }
    return Database(path=path, images=images, cameras=cameras)


def read_ply(path: Path) -> PlyCloud:
    """Column names and positions of the vertices, which must be the first element."""
    try:
        with path.open("rb") as file:
            head, found, _ = file.read(_MAX_PLY_HEADER).partition(b"end_header")
            start = file.seek(len(head) + len(found)) + len(file.readline())
            if not found:
                raise ValueError("it has no PLY header")
            form, count, columns = _ply_header(head.decode("ascii", "replace"))
            file.seek(start)
            xyz = _ply_positions(file.read(), form, count, columns)
    except (OSError, ValueError) as error:
        return PlyCloud(path=path, properties=frozenset(), xyz=np.empty((0, 3)), problem=str(error))
    return PlyCloud(path=path, properties=frozenset(columns), xyz=xyz)


def _ply_header(head: str) -> tuple[str, int, dict[str, str]]:
    """Format, number of vertices, and numpy's letter code of each of their columns."""
    form, count, columns, in_vertex = "", -1, dict[str, str](), False
    for line in head.splitlines():
        match line.split():
            case ["format", form, *_]:
                pass
            case ["element", name, number]:
                in_vertex = name == "vertex"
                if not in_vertex and count < 0:
                    raise ValueError(f"its first element is {name!r}, not the vertices")
                count = int(number) if in_vertex else count
            case ["property", kind, name] if in_vertex:
                if kind not in _PLY_TYPES:
                    raise ValueError(f"its column {name!r} has the type {kind!r}")
                columns[name] = _PLY_TYPES[kind]
            case ["property", *_] if in_vertex:
                raise ValueError("its vertices have lists")
    if count < 0 or not {"x", "y", "z"} <= columns.keys():
        raise ValueError("it has no vertices with x, y and z")
    return form, count, columns


def _ply_positions(body: bytes, form: str, count: int, columns: Mapping[str, str]) -> FloatArray:
    """(N, 3) in the order of the file."""
    if form == "ascii":
        numbers = np.array(b" ".join(body.splitlines()[:count]).split(), np.float64)
        if len(numbers) != count * len(columns):
            raise ValueError(f"it has {len(numbers)} numbers for {count} vertices of {len(columns)} columns")
        rows = numbers.reshape(count, len(columns))
        order = list(columns)
        return rows[:, [order.index(axis) for axis in "xyz"]]
    if form not in _PLY_ORDERS:
        raise ValueError(f"its format is {form!r}")
    layout = np.dtype([(name, _PLY_ORDERS[form] + kind) for name, kind in columns.items()])
    if len(body) < count * layout.itemsize:
        raise ValueError(f"it ends after {len(body) // layout.itemsize} of {count} vertices")
    vertices = np.frombuffer(body, layout, count)
    return np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], axis=1)


def read_depth(params_file: Path, depth_folder: Path) -> DepthFolder | None:
    """Parameters and stems of the PNGs; None where there is neither file nor folder."""
    pngs: frozenset[str] | None = None
    if depth_folder.is_dir():
        pngs = frozenset(
            path.relative_to(depth_folder).with_suffix("").as_posix() for path in depth_folder.rglob("*.png")
        )
    if not params_file.is_file():
        return None if pngs is None else DepthFolder(params=None, pngs=pngs)
    try:
        content = json.loads(params_file.read_bytes())
        params = {stem: (float(entry["scale"]), float(entry["offset"])) for stem, entry in content.items()}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        problem = f"{type(error).__name__}: {error}; every stem needs a scale and an offset"
        return DepthFolder(params={}, pngs=pngs, problem=problem)
    return DepthFolder(params=params, pngs=pngs)


def read_dense(folder: Path) -> DenseFolder | None:
    """The stereo part of a workspace; None where there is none."""
    stereo = folder / "stereo"
    if not stereo.is_dir():
        return None
    depth_maps, config = stereo / "depth_maps", stereo / "fusion.cfg"
    return DenseFolder(
        folder=folder,
        depth_sizes={_below(path, depth_maps): _map_size(path) for path in depth_maps.rglob("*.bin")},
        normal_maps=frozenset(_below(path, stereo / "normal_maps") for path in (stereo / "normal_maps").rglob("*.bin")),
        fusion_names=_config_names(config) if config.is_file() else None,
    )


def _config_names(config: Path) -> tuple[str, ...]:
    lines = config.read_text("utf-8", "replace").splitlines()
    return tuple(line.strip() for line in lines if line.strip() and not line.startswith("#"))


def _below(path: Path, folder: Path) -> str:
    return path.relative_to(folder).as_posix()


def _map_size(path: Path) -> tuple[int, int]:
    """Width and height from ``width&height&channels&``; zeros where file and header disagree."""
    with path.open("rb") as file:
        head = file.read(_MAX_MAP_HEADER).split(b"&")
    try:
        width, height, channels = (int(number) for number in head[:3])
    except ValueError:
        return 0, 0
    expected = sum(len(number) + 1 for number in head[:3]) + 4 * width * height * channels
    return (width, height) if path.stat().st_size == expected else (0, 0)
