"""SIFT features and verified matches, once per image and once per pair in the whole run.

Everything lies in one COLMAP database whose ids we assign before anything is extracted
(image id = index + 1), because COLMAP itself numbers images in the order in which its threads
finish. What is in the database is done: a second start extracts and matches only what is missing.
The next module to read is ``mapping``.
"""

from __future__ import annotations

import logging
import tempfile
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pycolmap

from smust3r_colmap.errors import StorageError
from smust3r_colmap.execution.task_pool import TaskFailure, map_tasks
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.importers.images import load_grey
from smust3r_colmap.importers.masks import load_mask
from smust3r_colmap.products import ImageCollection, RejectedImage, Segment, SourceImage, consecutive_runs
from smust3r_colmap.execution.progress import Stage

logger = logging.getLogger(__name__)

Pair = tuple[int, int]

_PAIRS_PER_THREAD = 100
_PATIENCE_S = 30.0
_PAUSE_S = 0.02
_SPARSE_PEAK_THRESHOLD = 0.002
"""Second try for images that gave fewer than a quarter of the features allowed (COLMAP's own is 0.0067)."""


@dataclass(frozen=True, kw_only=True)
class _ExtractionTask:
    image: SourceImage
    max_image_size: int
    max_features: int


@dataclass(frozen=True, kw_only=True, eq=False)
class _Features:
    keypoints: npt.NDArray[np.float32]  # (K, 4) x, y, scale, orientation
    descriptors: npt.NDArray[np.uint8]  # (K, 128)


@dataclass(frozen=True, kw_only=True)
class _MatchingTask:
    database: Path
    pairs: tuple[Pair, ...]
    threads: int
    seed: int


def open_database(path: Path) -> pycolmap.Database:
    """The run's database, which several processes may open at the same moment.

    pycolmap writes when it opens and does not wait for a lock: with two processes one opening in sixty
    fails with "database is locked". So it is tried again.

    Raises:
        StorageError: it cannot be opened for ``_PATIENCE_S`` seconds, or is no database.
    """
    give_up_s = time.monotonic() + _PATIENCE_S
    while True:
        try:
            return pycolmap.Database.open(path)
        except RuntimeError as error:
            if time.monotonic() > give_up_s:
                raise StorageError(
                    f"{path}: cannot be opened for {_PATIENCE_S:.0f} s ({error}); is it held by another process, or "
                    f"damaged? Delete {path.parent} or start with --fresh"
                ) from error
            time.sleep(_PAUSE_S)


def create_database(path: Path, collection: ImageCollection) -> None:
    """Write cameras, rigs, frames and images with our ids, unless the database has them already."""
    with open_database(path) as database:
        if database.num_frames() == len(collection):  # an image's frame is written last
            return
        database.clear_all_tables()
        with pycolmap.DatabaseTransaction(database):
            write_images(database, collection.cameras, [(i, image.camera) for i, image in enumerate(collection.images)])


def write_images(database: pycolmap.Database, cameras: Sequence[Intrinsics], images: Iterable[tuple[int, int]]) -> None:
    """Write all ``cameras`` and the images given as (index, camera index), one rig and frame each.

    Inside the run an image goes by its number: pycolmap's lists of pairs are text and would cut
    names at the first blank.
    """
    for index, intrinsics in enumerate(cameras):
        camera = intrinsics.colmap_camera(index + 1)
        database.write_camera(camera, use_camera_id=True)
        rig = pycolmap.Rig(rig_id=index + 1)
        rig.add_ref_sensor(camera.sensor_id)
        database.write_rig(rig, use_rig_id=True)
    for index, camera_index in images:
        image = pycolmap.Image(name=internal_name(index), camera_id=camera_index + 1, image_id=index + 1)
        database.write_image(image, use_image_id=True)
        frame = pycolmap.Frame(frame_id=index + 1, rig_id=camera_index + 1)
        frame.add_data_id(image.data_id)
        database.write_frame(frame, use_frame_id=True)


def internal_name(index: int) -> str:
    """The name of an image in the databases of a run."""
    return f"{index:08d}"


def extract_features(
    path: Path,
    collection: ImageCollection,
    *,
    max_image_size: int,
    max_features: int,
    workers: int,
    log_file: Path | None,
    stage: Stage,
) -> tuple[RejectedImage, ...]:
    """Extract SIFT for every image that has no keypoints yet; returns the images that failed.

    Keypoints are in pixels of the original image (first pixel centre at 0.5), whatever
    ``max_image_size`` they were found at, and none lies on a pixel that the image's mask leaves out.
    An image that fails gets none and is tried again at the next start.
    """
    failed = []
    with open_database(path) as database:
        missing = [i for i in range(len(collection)) if not database.exists_keypoints(i + 1)]
        stage.skip(len(collection) - len(missing))
        tasks = [
            _ExtractionTask(image=collection.images[i], max_image_size=max_image_size, max_features=max_features)
            for i in missing
        ]
        for result in map_tasks(_extract, tasks, workers=workers, log_file=log_file):
            index = missing[result.index]
            features = result.value
            if isinstance(features, TaskFailure):
                failed.append(RejectedImage(name=collection.images[index].name, reason=f"SIFT: {features.reason}"))
            else:
                _write_features(database, index, features)
            stage.advance()
    return tuple(failed)


def _write_features(database: pycolmap.Database, index: int, features: _Features) -> None:
    """Descriptors, then keypoints, which say that the image is done.

    pycolmap commits a transaction that Ctrl-C leaves, so the descriptors may be there already.
    """
    with pycolmap.DatabaseTransaction(database):
        if not database.exists_descriptors(index + 1):
            database.write_descriptors(
                index + 1, pycolmap.FeatureDescriptors(pycolmap.FeatureExtractorType.SIFT, features.descriptors)
            )
        database.write_keypoints(index + 1, features.keypoints)


def _extract(task: _ExtractionTask) -> _Features:
    grey = load_grey(task.image)
    scale = min(1.0, task.max_image_size / max(grey.shape))
    if scale < 1.0:
        size = (max(1, round(grey.shape[1] * scale)), max(1, round(grey.shape[0] * scale)))
        small = np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    else:
        small = grey
    kept = None if task.image.mask is None else load_mask(task.image.mask.path, task.image) > 0
    shrunk = (grey.shape[1] / small.shape[1], grey.shape[0] / small.shape[0])
    features = _unmasked(_enlarged(_sift(small, task.max_features, peak_threshold=None), *shrunk), kept)
    if len(features.keypoints) < task.max_features // 4:
        more = _sift(small, task.max_features, peak_threshold=_SPARSE_PEAK_THRESHOLD)
        features = _unmasked(_enlarged(more, *shrunk), kept)
    return features


def _enlarged(features: _Features, times_x: float, times_y: float) -> _Features:
    """From the pixels of a smaller image to those of the original."""
    x, y, scale, orientation = features.keypoints.T
    keypoints = np.column_stack([x * times_x, y * times_y, scale * times_x, orientation]).astype(np.float32)
    return _Features(keypoints=keypoints, descriptors=features.descriptors)


def _unmasked(features: _Features, kept: npt.NDArray[np.bool_] | None) -> _Features:
    """Features whose centre lies on a pixel that is kept, as in COLMAP: SIFT has seen the masked pixels beside it."""
    if kept is None:
        return features
    height, width = kept.shape
    column, row = np.floor(features.keypoints[:, :2]).astype(np.int64).T
    there = kept[row.clip(0, height - 1), column.clip(0, width - 1)]
    return _Features(keypoints=features.keypoints[there], descriptors=features.descriptors[there])


def _sift(grey: npt.NDArray[np.uint8], max_features: int, *, peak_threshold: float | None) -> _Features:
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads = 1
    options.use_gpu = False
    options.sift.max_num_features = max_features
    if peak_threshold is not None:
        options.sift.peak_threshold = peak_threshold
    extractor = pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)
    keypoints, descriptors = extractor.extract_from_uint8_array(np.ascontiguousarray(grey))
    matrix = np.asarray(pycolmap.keypoints_to_matrix(keypoints), dtype=np.float32).reshape(-1, 4).copy()
    return _Features(keypoints=matrix, descriptors=np.asarray(descriptors.data).reshape(-1, 128).copy())


def plan_pairs(segment: Segment, *, neighbours: int, exhaustive_below: int) -> tuple[Pair, ...]:
    """Pairs (i < j) of a window worth matching: all in a small one, else neighbours and doubling steps.

    Only inside the segment: a longer reach finds look-alike places and folds the model.
    """
    images = sorted(segment.images)
    if len(images) <= exhaustive_below:
        return _near_pairs(images, len(images) - 1)
    return _near_pairs(images, neighbours)


def plan_loop_pairs(segment: Segment, descriptors: npt.NDArray[np.float32], *, neighbours: int) -> tuple[Pair, ...]:
    """Pairs (i < j) of a loop segment: each end like a window, and across the most alike.

    Across, each image is paired with the ``neighbours`` images of the other end whose descriptors are
    most like its own: half of all pairs, and nine tenths of the verified matches (six loops of two walks).

    Args:
        segment: of kind ``"loop"``. descriptors: (N, D) unit vectors of all images of the collection.
    """
    runs = consecutive_runs(segment.images)
    pairs = [pair for run in runs for pair in _near_pairs(run, neighbours)]
    for first, second in combinations(runs, 2):
        similarity = descriptors[list(first)] @ descriptors[list(second)].T
        wanted = np.zeros(similarity.shape, dtype=bool)
        for axis in (0, 1):
            most_alike = np.argsort(-similarity, axis=axis, kind="stable")
            few = range(min(neighbours, similarity.shape[axis]))
            np.put_along_axis(wanted, np.take(most_alike, few, axis=axis), values=True, axis=axis)
        pairs += [(first[a], second[b]) for a, b in np.argwhere(wanted)]
    return tuple(pairs)


def _near_pairs(images: Sequence[int], neighbours: int) -> tuple[Pair, ...]:
    """Each image with its next ``neighbours`` and with those at doubling steps."""
    n = len(images)
    doubling = [2**k for k in range(1, n.bit_length()) if neighbours < 2**k < n]
    offsets = [*range(1, min(neighbours + 1, n)), *doubling]
    return tuple((images[a], images[a + offset]) for offset in offsets for a in range(n - offset))


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

    pycolmap writes a pair when it is finished, also one without a match, so what is there is done.

    Returns:
        The pairs that are done; the others failed and are tried again at the next start.
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
    for result in map_tasks(_match, tasks, workers=1, log_file=log_file):
        if isinstance(result.value, TaskFailure):
            logger.warning("up to %d pairs not matched: %s", len(tasks[result.index].pairs), result.value.reason)
        stage.advance(len(tasks[result.index].pairs))
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
