"""Matching image pairs in child processes, with two-view verification by COLMAP.

The next module to read is ``stationary``, which finds what never moves in the image.
"""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pycolmap

from smust3r_colmap.colmap.database import check_room, internal_name, open_database
from smust3r_colmap.execution.progress import Stage
from smust3r_colmap.execution.task_pool import Executor, TaskFailure, TaskPool
from smust3r_colmap.features.guided_verification import matches_by_pair
from smust3r_colmap.features.stationary import (
    PairMatches,
    StaticRegions,
    find_static_regions,
    static_matches,
    verified,
)
from smust3r_colmap.geometry.arrays import BoolArray, Pair

logger = logging.getLogger(__name__)

_PAIRS_PER_THREAD = 100
_PAIRS_VERIFIED_AT_ONCE = 500
"""Their matches are in memory."""
_BYTES_PER_PAIR = 16 << 10
"""A thousand matches, before and after verification."""
MAX_STATIONARY_SHARE = 0.5
"""Of the matches of a pair; with more, what COLMAP calls a watermark is one."""
_WATERMARK = int(pycolmap.TwoViewGeometryConfiguration.WATERMARK)


@dataclass(frozen=True, kw_only=True)
class _MatchingTask:
    database: Path
    pairs: tuple[Pair, ...]
    threads: int
    seed: int


def match_pairs(
    path: Path,
    pairs: Iterable[Pair],
    *,
    workers: int,
    seed: int,
    log_file: Path | None,
    stage: Stage,
) -> frozenset[Pair]:
    """Match and verify every pair that is not in the database yet; each pair once in the run.

    pycolmap writes each finished pair, also one without matches, so pairs in the database are done.

    Returns:
        The finished pairs; the others failed and are tried again at the next start.

    Raises:
        StorageError: the disk is full.
    """
    wanted = sorted(set(pairs))
    with open_database(path) as database:
        missing = [pair for pair in wanted if not database.exists_matches(pair[0] + 1, pair[1] + 1)]
    stage.skip(len(wanted) - len(missing))
    size = _PAIRS_PER_THREAD * workers
    tasks = [
        _MatchingTask(database=path, pairs=tuple(missing[k : k + size]), threads=workers, seed=seed)
        for k in range(0, len(missing), size)
    ]
    # One child with threads, not many children: SQLite takes one writer at a time.
    with TaskPool(workers=1, log_file=log_file) as child:
        for task in tasks:
            check_room(path, len(task.pairs) * _BYTES_PER_PAIR)
            (result,) = child.map(_match, [task])
            if isinstance(result.value, TaskFailure):
                logger.warning("up to %d pairs not matched: %s", len(task.pairs), result.value.reason)
            stage.advance(len(task.pairs))
    with open_database(path) as database:
        return frozenset(pair for pair in wanted if database.exists_matches(pair[0] + 1, pair[1] + 1))


def _match(task: _MatchingTask) -> None:
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = task.threads
    matching.use_gpu = False
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = task.seed
    with tempfile.TemporaryDirectory(prefix="smust3r-match-") as scratch:
        pairing = pycolmap.ImportedPairingOptions()
        pairing.match_list_path = Path(scratch) / "pairs.txt"
        pairing.match_list_path.write_text("".join(f"{internal_name(a)} {internal_name(b)}\n" for a, b in task.pairs))
        pycolmap.match_image_pairs(task.database, matching, pairing, verification, pycolmap.Device.cpu)


# ---------------------------------------------------------------------- static parts
def find_static_parts(path: Path, pairs: Iterable[Pair], *, seed: int) -> StaticRegions:
    """The parts of the images in which something never moves, from the matches of these pairs; see ``stationary``."""
    with open_database(path) as database:
        reader = _PairReader.of(database, pairs)
    return find_static_regions(reader.pairs, reader.matches, seed=seed)


def drop_matches_without_evidence(
    path: Path, pairs: Iterable[Pair], regions: StaticRegions, *, executor: Executor, seed: int
) -> None:
    """Delete stationary matches in static parts and verify those pairs again; empty what COLMAP calls watermarks.

    COLMAP calls matches a watermark that all move alike, as they do, too, where a camera hardly moves. A watermark does
    not move at all. So pairs whose matches do are verified again without looking for one.

    What was deleted is gone, so a second call finds nothing to do.

    Raises:
        StorageError: the database cannot be written.
    """
    wanted = set(pairs)
    with open_database(path) as database:
        reader = _PairReader.of(database, wanted)
        for start in range(0, len(reader.pairs) if regions else 0, _PAIRS_VERIFIED_AT_ONCE):
            tasks = [
                _VerificationTask(pair=pair, matches=matches, used=~static, seed=seed)
                for pair in reader.pairs[start : start + _PAIRS_VERIFIED_AT_ONCE]
                if (static := static_matches(matches := reader.matches(pair), regions)).any()
            ]
            _verify_again(database, path, tasks, reader, executor)
        watermarks = _watermarks(database) & wanted
        of_one_size = sorted(watermarks & reader.rows.keys())
        for start in range(0, len(of_one_size), _PAIRS_VERIFIED_AT_ONCE):
            tasks = [
                _VerificationTask(pair=pair, matches=matches, used=used, seed=seed, detect_watermark=False)
                for pair in of_one_size[start : start + _PAIRS_VERIFIED_AT_ONCE]
                if (matches := reader.matches(pair)).stationary().mean() <= MAX_STATIONARY_SHARE  # False for none
                and (used := ~static_matches(matches, regions)).any()
            ]
            _verify_again(database, path, tasks, reader, executor)
            watermarks -= {task.pair for task in tasks}
        for pair in sorted(watermarks):
            _replace_matches(database, pair, np.empty((0, 2), np.uint32), pycolmap.TwoViewGeometry())


@dataclass(frozen=True, kw_only=True, eq=False)
class _VerificationTask:
    pair: Pair
    matches: PairMatches
    used: BoolArray
    seed: int
    detect_watermark: bool = True


def _verify(task: _VerificationTask) -> pycolmap.TwoViewGeometry:
    return verified(task.matches, task.used, seed=task.seed, detect_watermark=task.detect_watermark)


def _verify_again(
    database: pycolmap.Database,
    path: Path,
    tasks: Sequence[_VerificationTask],
    reader: _PairReader,
    executor: Executor,
) -> None:
    """Keep the used matches of the pairs and the geometry that they have."""
    check_room(path, sum(2 * reader.rows[task.pair].nbytes for task in tasks))
    for result in executor.map(_verify, tasks):
        task, value = tasks[result.index], result.value
        if isinstance(value, TaskFailure):
            logger.warning("images %d and %d have no geometry: %s", *task.pair, value.reason)
            value = pycolmap.TwoViewGeometry()
        rows = reader.rows[task.pair]
        value.inlier_matches = rows[np.asarray(value.inlier_matches, np.int64).reshape(-1, 2)[:, 0]]
        _replace_matches(database, task.pair, rows[task.used], value)


@dataclass(frozen=True, kw_only=True, eq=False)
class _PairReader:
    """The unverified matches of pairs of images of one size."""

    rows: Mapping[Pair, npt.NDArray[np.uint32]]
    keypoints: Mapping[int, npt.NDArray[np.float32]]
    cameras: Mapping[int, pycolmap.Camera]

    @classmethod
    def of(cls, database: pycolmap.Database, pairs: Iterable[Pair]) -> _PairReader:
        camera_by_id = {camera.camera_id: camera for camera in database.read_all_cameras()}
        cameras = {image.image_id - 1: camera_by_id[image.camera_id] for image in database.read_all_images()}
        wanted = {(a, b) for a, b in pairs if _size(cameras[a]) == _size(cameras[b])}
        rows = {pair: rows for pair, rows in matches_by_pair(*database.read_all_matches()).items() if pair in wanted}
        images = sorted({image for pair in rows for image in pair})
        keypoints = {image: np.asarray(database.read_keypoints(image + 1), np.float32)[:, :2] for image in images}
        return cls(rows=rows, keypoints=keypoints, cameras=cameras)

    @property
    def pairs(self) -> list[Pair]:
        return sorted(self.rows)

    def matches(self, pair: Pair) -> PairMatches:
        a, b = pair
        rows = self.rows[pair]
        return PairMatches(
            xy_a=self.keypoints[a][rows[:, 0]].astype(np.float64),
            xy_b=self.keypoints[b][rows[:, 1]].astype(np.float64),
            camera_a=self.cameras[a],
            camera_b=self.cameras[b],
        )


def _size(camera: pycolmap.Camera) -> tuple[int, int]:
    return camera.width, camera.height


def _watermarks(database: pycolmap.Database) -> set[Pair]:
    pair_ids, geometries = database.read_two_view_geometries()
    return {
        (a - 1, b - 1)
        for (a, b), one in zip(map(pycolmap.pair_id_to_image_pair, pair_ids), geometries, strict=True)
        if one.config == _WATERMARK
    }


def _replace_matches(
    database: pycolmap.Database, pair: Pair, rows: npt.NDArray[np.uint32], geometry: pycolmap.TwoViewGeometry
) -> None:
    a, b = pair[0] + 1, pair[1] + 1
    with pycolmap.DatabaseTransaction(database):
        database.delete_matches(a, b)
        database.write_matches(a, b, rows)
        database.delete_two_view_geometry(a, b)
        database.write_two_view_geometry(a, b, geometry)
