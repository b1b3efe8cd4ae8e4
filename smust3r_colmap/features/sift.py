"""SIFT features and verified matches, once per image and once per pair in the whole run.

Everything lies in one COLMAP database whose ids we assign before anything is extracted
(image id = index + 1), because COLMAP itself numbers images in the order in which its threads
finish. What is in the database is done: a second start extracts and matches only what is missing.
The next module to read is ``matching``.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pycolmap

from smust3r_colmap.colmap.database import check_room, open_database
from smust3r_colmap.execution.progress import Stage
from smust3r_colmap.execution.task_pool import Executor, TaskFailure
from smust3r_colmap.importers.images import load_grey
from smust3r_colmap.importers.masks import load_mask
from smust3r_colmap.products import ImageCollection, RejectedImage, SourceImage

logger = logging.getLogger(__name__)


_SPARSE_PEAK_THRESHOLD = 0.002
"""Second try for images that gave fewer than a quarter of the features allowed (COLMAP's own is 0.0067)."""

MIN_FEATURES_BETWEEN_KEYFRAMES, MAX_FEATURES_BETWEEN_KEYFRAMES = 500, 2000
"""Of images that are no keyframes and only need a pose: found at full size and below, a fifth of the time. Where there
are too few, they get as many as a keyframe."""
METHOD_BETWEEN_KEYFRAMES = 1
"""To be raised when the features of these images change."""


@dataclass(frozen=True, kw_only=True)
class _ExtractionTask:
    image: SourceImage
    max_image_size: int
    max_features: int


@dataclass(frozen=True, kw_only=True, eq=False)
class _Features:
    keypoints: npt.NDArray[np.float32]  # (K, 4) x, y, scale, orientation
    descriptors: npt.NDArray[np.uint8]  # (K, 128)


def extract_features(
    path: Path,
    collection: ImageCollection,
    *,
    max_image_size: int,
    max_features: int,
    executor: Executor,
    stage: Stage,
) -> tuple[RejectedImage, ...]:
    """Extract SIFT for every image that has no keypoints yet; returns the images that failed.

    Keypoints are in pixels of the original image (first pixel centre at 0.5), whatever
    ``max_image_size`` they were found at, and none lies on a pixel that the image's mask leaves out.
    An image that fails gets none and is tried again at the next start.

    Raises:
        StorageError: the disk is full.
    """
    failed = []
    with open_database(path) as database:
        missing = [i for i in range(len(collection)) if not database.exists_keypoints(i + 1)]
        stage.skip(len(collection) - len(missing))
        tasks = [
            _ExtractionTask(image=collection.images[i], max_image_size=max_image_size, max_features=max_features)
            for i in missing
        ]
        for result in executor.map(_extract, tasks):
            index = missing[result.index]
            features = result.value
            if isinstance(features, TaskFailure):
                failed.append(RejectedImage(name=collection.images[index].name, reason=f"SIFT: {features.reason}"))
            else:
                check_room(path, features.keypoints.nbytes + features.descriptors.nbytes)
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
    if not task.image.is_keyframe:
        few = _unmasked(_enlarged(_sift(small, MAX_FEATURES_BETWEEN_KEYFRAMES, first_octave=0), *shrunk), kept)
        if len(few.keypoints) >= MIN_FEATURES_BETWEEN_KEYFRAMES:
            return few
    features = _unmasked(_enlarged(_sift(small, task.max_features), *shrunk), kept)
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


def _sift(
    grey: npt.NDArray[np.uint8],
    max_features: int,
    *,
    peak_threshold: float | None = None,
    first_octave: int | None = None,
) -> _Features:
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads = 1
    options.use_gpu = False
    options.sift.max_num_features = max_features
    if peak_threshold is not None:
        options.sift.peak_threshold = peak_threshold
    if first_octave is not None:
        options.sift.first_octave = first_octave
    extractor = pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)
    keypoints, descriptors = extractor.extract_from_uint8_array(np.ascontiguousarray(grey))
    matrix = np.asarray(pycolmap.keypoints_to_matrix(keypoints), dtype=np.float32).reshape(-1, 4).copy()
    return _Features(keypoints=matrix, descriptors=np.asarray(descriptors.data).reshape(-1, 128).copy())
