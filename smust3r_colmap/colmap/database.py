"""The database that goes with a model: COLMAP continues from both as if it had made them.

Ids of cameras, rigs, frames and images are those of the model (index + 1), names are the real ones, and
the keypoints of an image are the points2D of the model, row by row: the mapper refuses anything else.
Images without a pose are in it, too, so that a continuation may register them. Descriptors are left out: they
are ten times as large as all the rest, and every pair worth matching has been matched.
The next module to read is ``training_dataset``.
"""

from __future__ import annotations

import os
import sqlite3
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pycolmap

from smust3r_colmap.errors import StorageError
from smust3r_colmap.geometry.arrays import FloatArray, Pair
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.products import ImageCollection

PATIENCE_S = 30.0
"""How long a database that is locked is waited for."""
PAUSE_S = 0.02
"""Between two attempts to open it."""
MAX_PATH_BYTES = 500
"""SQLite takes 512, with what it appends for its journal."""
_JOURNAL_BYTES = 8 << 20
"""SQLite writes changes twice: first into a journal, which is moved into the database every 4 MiB."""
_BYTES_PER_IMAGE = 1024
"""Of an image without its features."""


def write_colmap_database(
    path: Path,
    collection: ImageCollection,
    cameras: Sequence[Intrinsics],
    *,
    keypoints: Mapping[int, npt.NDArray[np.float32]],
    matches: Mapping[Pair, npt.NDArray[np.uint32]],
    j_from_i: Mapping[Pair, FloatArray],
    priors: Iterable[pycolmap.PosePrior],
) -> None:
    """Write a new database.

    Args:
        path: nothing must be there yet.
        collection: all images, with a pose or without.
        cameras: by camera index, as the model has them.
        keypoints: by image index, (K, 2) in pixels of the original image; images may be left out.
        matches: verified, by pair (i, j) of image indices.
        j_from_i: (3, 4) relative poses of the pairs that have one, written with their essential matrices.
        priors: of camera positions, with ids of the model.
    """
    with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
        indices = [(index, image.camera) for index, image in enumerate(collection.images)]
        write_images(database, cameras, indices, name_of=lambda index: collection.images[index].name)
        for index, _ in indices:
            points = keypoints.get(index, np.empty((0, 2), np.float32))
            database.write_keypoints(index + 1, np.ascontiguousarray(points))
        for (i, j), rows in matches.items():
            database.write_matches(i + 1, j + 1, rows)
            database.write_two_view_geometry(i + 1, j + 1, _two_view_geometry(rows, j_from_i.get((i, j))))
        for prior in priors:
            database.write_pose_prior(prior, use_pose_prior_id=True)


def _two_view_geometry(matches: npt.NDArray[np.uint32], j_from_i: FloatArray | None) -> pycolmap.TwoViewGeometry:
    geometry = pycolmap.TwoViewGeometry(
        config=int(pycolmap.TwoViewGeometryConfiguration.CALIBRATED), inlier_matches=matches
    )
    if j_from_i is not None:
        geometry.cam2_from_cam1 = pycolmap.Rigid3d(j_from_i)
        geometry.E = pycolmap.essential_matrix_from_pose(geometry.cam2_from_cam1)
    return geometry


def open_database(path: Path, *, patience_s: float = PATIENCE_S) -> pycolmap.Database:
    """The run's database, which several processes may open at the same moment.

    pycolmap writes when it opens and does not wait for a lock: with two processes one opening in sixty
    fails with "database is locked". So it is tried again; whatever else is wrong does not pass.

    Raises:
        StorageError: it is locked for ``patience_s``, is no database, or the disk refuses it.
    """
    give_up_s = time.monotonic() + patience_s
    while True:
        try:
            return pycolmap.Database.open(path)
        except RuntimeError as error:
            _refuse_what_does_not_pass(path)
            if time.monotonic() > give_up_s:
                raise StorageError(
                    f"{path}: cannot be opened for {patience_s:.0f} s ({error}); another process holds it, wait for it"
                ) from error
            time.sleep(PAUSE_S)


def _refuse_what_does_not_pass(path: Path) -> None:
    """Say why a database cannot be opened, which pycolmap does not tell, unless it is only locked."""
    try:
        with closing(sqlite3.connect(path, timeout=0)) as connection:
            connection.execute("SELECT COUNT(*) FROM sqlite_master")
    except sqlite3.OperationalError as error:
        if "locked" in str(error):
            return
        length = len(os.fsencode(path.resolve()))
        if length > MAX_PATH_BYTES:
            reason = f"its path has {length} bytes, and SQLite takes {MAX_PATH_BYTES}; name a shorter output folder"
            raise StorageError(f"{path}: cannot be opened: {reason}") from error
        raise StorageError(f"{path}: cannot be opened ({error}); finished stages are kept") from error
    except sqlite3.DatabaseError as error:
        raise StorageError(
            f"{path}: cannot be opened (it is damaged: {error}); delete {path.parent} or start with --overwrite"
        ) from error
    check_room(path, 0)


def check_room(path: Path, num_bytes: int) -> None:
    """Refuse to go on where the disk would refuse ``num_bytes`` more of a database: pycolmap ends the process then.

    Raises:
        StorageError: with the words of the system, which also knows of limits of users and of file sizes.
    """
    needed = 2 * num_bytes + _JOURNAL_BYTES
    size = path.stat().st_size if path.exists() else 0
    try:
        with tempfile.TemporaryFile(dir=path.parent) as probe:
            os.ftruncate(probe.fileno(), size + needed)
            os.ftruncate(probe.fileno(), 0)
            os.posix_fallocate(probe.fileno(), 0, needed)
    except OSError as error:
        raise StorageError(
            f"{path}: {error.strerror}, {needed / 2**20:.0f} MiB more are needed; finished stages are kept, and with "
            "more room the same command goes on"
        ) from error


def create_database(path: Path, collection: ImageCollection) -> None:
    """Write cameras, rigs, frames and images with our ids, unless the database has them already."""
    check_room(path, len(collection) * _BYTES_PER_IMAGE)
    with open_database(path) as database:
        if database.num_frames() == len(collection):  # an image's frame is written last
            return
        database.clear_all_tables()
        with pycolmap.DatabaseTransaction(database):
            write_images(database, collection.cameras, [(i, image.camera) for i, image in enumerate(collection.images)])


def internal_name(index: int) -> str:
    """The name of an image in the databases inside a run.

    It is a number, because pycolmap's lists of pairs are text and would cut a name at the first blank.
    """
    return f"{index:08d}"


def write_images(
    database: pycolmap.Database,
    cameras: Sequence[Intrinsics],
    images: Iterable[tuple[int, int]],
    *,
    name_of: Callable[[int], str] = internal_name,
) -> None:
    """Write all cameras and some images; each camera is a rig, each image a frame, ids are index + 1.

    Args:
        cameras: by camera index.
        images: as (index, camera index).
        name_of: the name of an image by its index.

    Source: order of the calls as COLMAP 4 wants it (frames after images, images without a frame id).
    """
    for index, intrinsics in enumerate(cameras):
        camera = intrinsics.colmap_camera(index + 1)
        database.write_camera(camera, use_camera_id=True)
        rig = pycolmap.Rig(rig_id=index + 1)
        rig.add_ref_sensor(camera.sensor_id)
        database.write_rig(rig, use_rig_id=True)
    for index, camera_index in images:
        image = pycolmap.Image(name=name_of(index), camera_id=camera_index + 1, image_id=index + 1)
        database.write_image(image, use_image_id=True)
        frame = pycolmap.Frame(frame_id=index + 1, rig_id=camera_index + 1)
        frame.add_data_id(image.data_id)
        database.write_frame(frame, use_frame_id=True)
