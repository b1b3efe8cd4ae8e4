"""SIFT of all images of a run, once, in a database of ours: what the classical backbone maps, and what the tracks of
any backbone are made of. The next module to read is ``mapping``."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from smust3r_colmap.colmap.database import create_database, open_database
from smust3r_colmap.config import ClassicalConfig
from smust3r_colmap.execution.progress import Reporter
from smust3r_colmap.features.sift import extract_features
from smust3r_colmap.features.vlad import FEATURES_PER_IMAGE, vlad_descriptors
from smust3r_colmap.products import ImageCollection, RunFeatures
from smust3r_colmap.storage.run_directory import RunDirectory, key_of, read_arrays, write_arrays


def features_of_run(
    collection: ImageCollection,
    config: ClassicalConfig,
    run: RunDirectory,
    reporter: Reporter,
    *,
    workers: int,
    seed: int,
) -> RunFeatures:
    """Extract what no earlier start extracted; a second call finds everything done."""
    images = [(image.digest, image.width, image.height, image.camera) for image in collection.images]
    settings = (config.max_image_size, config.max_features, seed)
    masks = (collection.mask_digests,) if collection.mask_digests else ()
    stored = run.stage("features", key=key_of("features", images, collection.cameras, *settings, *masks))
    database = stored.open_in_place() / "database.db"
    create_database(database, collection)
    with reporter.stage("features", total=len(collection)) as stage:
        rejected = extract_features(
            database,
            collection,
            max_image_size=config.max_image_size,
            max_features=config.max_features,
            workers=workers,
            log_file=run.native_log,
            stage=stage,
        )
    for image in rejected:
        reporter.warn(f"no features: {image.name} ({image.reason})")
    lost = {image.name for image in rejected}
    usable = tuple(image.name not in lost for image in collection.images)
    return RunFeatures(database=database, key=stored.key, usable=usable, rejected=rejected)


def describe_images(features: RunFeatures, run: RunDirectory, *, seed: int) -> npt.NDArray[np.float32]:
    """(N, D) VLAD of the SIFT features of every image, of unit length; zero where an image has none."""
    stage = run.stage("descriptors", key=key_of("descriptors", features.key, features.usable, seed))
    if not stage.is_done:
        with open_database(features.database) as opened:
            numbers = range(1, len(features.usable) + 1)
            sift = [  # copies, for a slice would hold on to all features of the image
                np.asarray(opened.read_descriptors(number).data).reshape(-1, 128)[:FEATURES_PER_IMAGE].copy()
                for number in numbers
            ]
        made = vlad_descriptors(sift, rng=np.random.default_rng(seed))
        with stage.write() as folder:
            write_arrays(folder / "descriptors.safetensors", {"vlad": made})
    vlad: npt.NDArray[np.float32] = read_arrays(stage.path / "descriptors.safetensors")["vlad"]
    return vlad
