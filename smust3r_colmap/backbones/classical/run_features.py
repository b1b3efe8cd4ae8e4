"""SIFT of all images of a run, once, in a database of ours: what the classical backbone maps, and what the tracks of
any backbone are made of. The next module to read is ``mapping``."""

from __future__ import annotations

from smust3r_colmap.backbones.classical.features import create_database, extract_features
from smust3r_colmap.config import ClassicalConfig
from smust3r_colmap.products import ImageCollection, RunFeatures
from smust3r_colmap.progress import Reporter
from smust3r_colmap.run_directory import RunDirectory, key_of


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
    stored = run.stage("features", key=key_of("features", images, collection.cameras, *settings))
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
