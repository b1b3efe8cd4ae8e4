"""SIFT of all images of a run, extracted once, for the classical backbone and for the tracks of every backbone.

The next module to read is ``correspondences``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TypeVar

import numpy as np

from smust3r_colmap.colmap.database import create_database, open_database
from smust3r_colmap.config import FeatureConfig
from smust3r_colmap.errors import ReconstructionError
from smust3r_colmap.execution.progress import Stage
from smust3r_colmap.execution.run_context import Run
from smust3r_colmap.execution.task_pool import TaskFailure, in_child
from smust3r_colmap.features.guided_verification import count_verified
from smust3r_colmap.features.matching import drop_matches_without_evidence, find_static_parts, match_pairs
from smust3r_colmap.features.pairs import alike_pairs, neighbouring_pairs
from smust3r_colmap.features.rotation_consistency import METHOD_VERSION, look_alikes
from smust3r_colmap.features.sift import METHOD_BETWEEN_KEYFRAMES, extract_features
from smust3r_colmap.features.stationary import NO_REGIONS, StaticRegions, describe
from smust3r_colmap.features.view_graph_calibration import (
    CALIBRATION_VERSION,
    VerifiedPairs,
    cross_validated_cameras,
)
from smust3r_colmap.features.vlad import FEATURES_PER_IMAGE, vlad_descriptors
from smust3r_colmap.geometry.arrays import Float32Array, Pair
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.products import ImageCollection, RunFeatures, Scene
from smust3r_colmap.storage.codec import Codec
from smust3r_colmap.storage.run_directory import key_of

T = TypeVar("T")

_STATIC_REGIONS: Codec[StaticRegions] = Codec(StaticRegions, "static_regions")
"""Beside the database of the features."""
_PAIRS: Codec[tuple[Pair, ...]] = Codec(tuple[Pair, ...], "pairs")
_BYTES_PER_FEATURE = 72
"""Half of a descriptor and a keypoint: images have fewer features than are allowed."""
_CAMERAS: Codec[tuple[Intrinsics, ...]] = Codec(tuple[Intrinsics, ...], "cameras")
_DESCRIPTORS: Codec[Float32Array] = Codec(Float32Array, "descriptors")


def feature_database_of_run(run: Run, collection: ImageCollection, options: FeatureConfig) -> tuple[Path, str]:
    """The database that the features of the run go to, with cameras and images, and the key of its stage.

    What is in it is not made again.
    """
    images = [(image.digest, image.width, image.height, image.camera) for image in collection.images]
    settings = (options.max_image_size, options.max_features, run.seed)
    masks = (collection.mask_digests,) if collection.mask_digests else ()
    between = (METHOD_BETWEEN_KEYFRAMES, collection.others) if collection.others else ()
    stored = run.folder.stage(
        "features", key=key_of("features", images, collection.cameras, *settings, *masks, *between)
    )
    database = stored.open_in_place() / "database.db"
    there = database.stat().st_size if database.exists() else 0
    run.folder.check_space("the features", len(collection) * options.max_features * _BYTES_PER_FEATURE - there)
    create_database(database, collection)
    return database, stored.key


def features_of_run(run: Run, collection: ImageCollection, options: FeatureConfig) -> RunFeatures:
    """Extract what no earlier start extracted; a second call finds everything done."""
    database, key = feature_database_of_run(run, collection, options)
    with run.clock.stage("features", total=len(collection)) as stage:
        rejected = extract_features(
            database,
            collection,
            max_image_size=options.max_image_size,
            max_features=options.max_features,
            executor=run.executor,
            stage=stage,
        )
    for image in rejected:
        run.clock.warn(f"no features: {image.name} ({image.reason})")
    lost = {image.name for image in rejected}
    usable = tuple(image.name not in lost for image in collection.images)
    return RunFeatures(database=database, key=key, usable=usable, rejected=rejected)


def match_pairs_of_run(
    run: Run, features: RunFeatures, pairs: Iterable[Pair], *, title: str = "matching"
) -> frozenset[Pair]:
    """Match and verify the pairs whose images have features; see ``match_pairs``.

    Matches on what never moves in the image are dropped, with a warning that names the place.
    """
    wanted = [(a, b) for a, b in pairs if features.usable[a] and features.usable[b]]
    with run.clock.stage(title, total=len(wanted)) as stage:
        matched = match_pairs(
            features.database,
            wanted,
            workers=run.executor.workers,
            seed=run.seed,
            log_file=run.folder.native_log,
            stage=stage,
        )
        # Stored before anything is dropped, because afterwards it cannot be found again.
        folder = features.database.parent
        found = find_static_parts(features.database, matched, seed=run.seed)
        known = _STATIC_REGIONS.read(folder) if _STATIC_REGIONS.is_in(folder) else NO_REGIONS
        regions = known.joined(found)
        if regions != known:
            _STATIC_REGIONS.write(folder, regions)
        drop_matches_without_evidence(features.database, matched, regions, executor=run.executor, seed=run.seed)
    if regions:
        run.clock.warn(
            f"part of the image never moves ({describe(regions)}); {regions.share:.0%} of the matches lie there and "
            "are not used. If it is a part of the camera's mount or an overlay, --masks leaves it out of depth and "
            "training images, too"
        )
    return matched


def verified_pairs(run: Run, features: RunFeatures, pairs: Iterable[Pair], *, title: str) -> dict[Pair, int]:
    """Match and verify pairs; the number of verified matches of those that have ``MIN_VERIFIED``, by ascending pair."""
    matched = match_pairs_of_run(run, features, pairs, title=title)
    return {pair: count for pair, count in count_verified(features.database).items() if pair in matched}


def cross_validated_cameras_of_run(
    run: Run, features: RunFeatures, collection: ImageCollection, pairs: Iterable[Pair]
) -> tuple[Intrinsics, ...]:
    """The collection's cameras with the focal lengths that verified pairs agree on, by camera index.

    See ``view_graph_calibration``.
    """
    verified = VerifiedPairs.of(features.database, pairs, collection, seed=run.seed)
    inputs = (CALIBRATION_VERSION, features.key, verified.pairs, run.seed)
    try:
        return _cached_from_child(
            run, "view_graph_calibration", inputs, cross_validated_cameras, verified, _CAMERAS, title="focal lengths"
        )
    except ReconstructionError as error:
        run.clock.warn(f"mapping begins with guessed focal lengths: {error}")
        return collection.cameras


def look_alike_pairs(
    run: Run, features: RunFeatures, collection: ImageCollection, pairs: Iterable[Pair]
) -> tuple[Pair, ...]:
    """Verified pairs whose relative rotation the others contradict, ascending; see ``rotation_consistency``."""
    verified = VerifiedPairs.of(features.database, pairs, collection, seed=run.seed)
    inputs = (METHOD_VERSION, features.key, verified.pairs, run.seed)
    try:
        found = _cached_from_child(run, "look_alikes", inputs, look_alikes, verified, _PAIRS, title="look-alikes")
    except ReconstructionError as error:
        run.clock.warn(f"look-alike places were not looked for: {error}")
        return ()
    if found:
        one, other = (collection.images[k].name for k in found[0])
        run.clock.note(
            f"{len(found)} of {len(verified.pairs)} pairs are left out as look-alikes, such as {one} and {other}: the "
            "rotations of all other pairs contradict theirs"
        )
    return found


def _cached_from_child(
    run: Run,
    name: str,
    inputs: object,
    function: Callable[[VerifiedPairs], T],
    verified: VerifiedPairs,
    codec: Codec[T],
    *,
    title: str,
) -> T:
    """As ``Run.cached``, computed by native code in a child process.

    Raises:
        ReconstructionError: it failed. Nothing is stored, so that the next start tries again.
    """

    def compute(progress: Stage) -> T:
        found = in_child(function, verified, log_file=run.folder.native_log)
        progress.advance()
        if isinstance(found, TaskFailure):
            raise ReconstructionError(found.reason)
        return found

    return run.cached(name, inputs, compute, codec, title=title)


def describe_images(run: Run, features: RunFeatures) -> Float32Array:
    """(N, D) VLAD of the SIFT features of every image, of unit length; zero where an image has none."""

    def compute(progress: Stage) -> Float32Array:
        with open_database(features.database) as opened:
            numbers = range(1, len(features.usable) + 1)
            sift = [  # copies, for a slice would hold on to all features of the image
                np.asarray(opened.read_descriptors(number).data).reshape(-1, 128)[:FEATURES_PER_IMAGE].copy()
                for number in numbers
            ]
        vlad = vlad_descriptors(sift, rng=np.random.default_rng(run.seed))
        progress.advance()
        return vlad

    return run.cached("descriptors", (features.key, features.usable, run.seed), compute, _DESCRIPTORS)


def match_external(
    run: Run, collection: ImageCollection, scene: Scene, options: FeatureConfig, *, per_image: int
) -> RunFeatures:
    """SIFT of all images, and the matches that no surface chooses, for a model of another program.

    Those are of neighbours where the model has no points, and of images without a pose with those that look alike.

    Args:
        scene: of the model; its images are the first of the collection.
        per_image: images that each of these is matched with.
    """
    features = features_of_run(run, collection, options)
    pairs: set[Pair] = set()
    if not len(scene.points):
        pairs |= set(
            neighbouring_pairs(scene.cam_from_world, per_image=per_image, exhaustive_below=options.exhaustive_below)
        )
    if len(scene) < len(collection):
        descriptors = describe_images(run, features)
        pairs |= set(
            alike_pairs(descriptors, len(scene), per_image=per_image, exhaustive_below=options.exhaustive_below)
        )
    if pairs:
        match_pairs_of_run(run, features, sorted(pairs))
    return features
