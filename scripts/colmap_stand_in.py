"""The calls of COLMAP's binary that its reconstruction benchmark makes; the sparse reconstruction is ours.

    scripts/colmap_shim automatic_reconstructor --image_path P --workspace_path W --extraction 1 --matching 0 --sparse 0
    scripts/colmap_shim database_cleaner --database_path W/database.db --type matches
    scripts/colmap_shim model_aligner --input_path A --ref_model_path B --output_path C --alignment_max_error 0.01

Extraction and matching are COLMAP's, by pycolmap with the settings of COLMAP's automatic reconstructor, on the CPU and
with SIFT. Individual images and those of the internet are matched exhaustively, whatever their number; images of a
video as a sequence without loop detection, because that would download a vocabulary tree.

The sparse reconstruction is ``smust3r_colmap.pipeline.reconstruct`` on the keypoints, descriptors and two-view
geometries of ``W/database.db``. A pair that the database has no two-view geometry of is not matched again; guided
matching, which adds matches that the stitched geometry confirms, is a part of our mapper. Cameras follow the database:

- one camera by value with a known calibration is kept as it is; several are refused, run ``evaluate.py --uncalibrated``
- otherwise the images share a camera where the database has one for all, and have one each where it has as many

A calibration is known where the focal length is a prior and the camera is more than its size and a focal length. The
run lies in ``W/smust3r``. If no segment can be reconstructed, ``W/sparse`` is empty, as with COLMAP.
"""

from __future__ import annotations

import argparse
import shutil
import sys
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path

import numpy as np
import pycolmap
from PIL import Image

from smust3r_colmap.cli.console import reporting, tell
from smust3r_colmap.config import CameraConfig, OutputConfig, RunConfig
from smust3r_colmap.errors import InputError, ReconstructionError, SmustrError
from smust3r_colmap.execution.run_context import Run
from smust3r_colmap.execution.task_pool import num_workers
from smust3r_colmap.features.stage import feature_database_of_run
from smust3r_colmap.importers import stage as importers
from smust3r_colmap.pipeline import reconstruct
from smust3r_colmap.products import ImageCollection

SIZE_AND_FEATURES = {"low": (1000, 2048), "medium": (1600, 4096), "high": (2400, 8192), "extreme": (3200, 8192)}
"""Longer side of the image, and most features; COLMAP's ``OptionManager::ModifyForLowQuality`` and so on."""
CAREFUL = ("high", "extreme")
"""Qualities with affine shapes and guided matching."""
_EXIF_ORIENTATION = 0x0112


def main(words: Sequence[str] | None = None) -> int:
    """Do what COLMAP's binary would, or print why not; the exit code."""
    arguments = parse_arguments(words)
    commands = {"database_cleaner": clean_database, "model_aligner": align_model}
    try:
        commands.get(arguments.command, reconstruct_automatically)(arguments)
    except SmustrError as error:
        print(f"colmap_shim: {error}", file=sys.stderr)
        return 1
    return 0


def parse_arguments(words: Sequence[str] | None) -> argparse.Namespace:
    """The command line; a flag of COLMAP that would be ignored is an error."""
    parser = argparse.ArgumentParser(prog="colmap_shim", description=(__doc__ or "").splitlines()[0])
    commands = parser.add_subparsers(dest="command", required=True)
    one = commands.add_parser("automatic_reconstructor", allow_abbrev=False)
    for flag in ("--image_path", "--workspace_path"):
        one.add_argument(flag, type=Path, required=True)
    one.add_argument("--data_type", choices=("individual", "video", "internet"), default="individual")
    one.add_argument("--quality", choices=tuple(SIZE_AND_FEATURES), default="high")
    one.add_argument("--feature", choices=("sift",), default="sift")
    one.add_argument("--mapper", choices=("incremental", "hierarchical", "global"), default="incremental")
    one.add_argument("--camera_model", default="SIMPLE_RADIAL")
    for flag in ("--single_camera", "--single_camera_per_folder"):
        one.add_argument(flag, choices=("0", "1"), default="0")
    for flag in ("--extraction", "--matching", "--sparse", "--dense"):
        one.add_argument(flag, choices=("0", "1"), default="0" if flag == "--dense" else "1")
    one.add_argument("--num_threads", type=int, default=-1)
    one.add_argument("--random_seed", type=int, default=-1)
    one.add_argument("--use_gpu", choices=("0", "1"), default="0", help="the CPU is used whatever it says")
    one.add_argument("--gpu_index", default="-1")
    two = commands.add_parser("database_cleaner", allow_abbrev=False)
    two.add_argument("--database_path", type=Path, required=True)
    two.add_argument("--type", choices=("matches", "two_view_geometries"), required=True)
    three = commands.add_parser("model_aligner", allow_abbrev=False)
    for flag in ("--input_path", "--ref_model_path", "--output_path"):
        three.add_argument(flag, type=Path, required=True)
    three.add_argument("--alignment_max_error", type=float, required=True)
    return parser.parse_args(words)


def reconstruct_automatically(arguments: argparse.Namespace) -> None:
    """The stages that are asked for, each on what the one before left.

    Raises:
        InputError: the dense stage is asked for, or the input cannot be used.
    """
    if arguments.dense == "1":
        raise InputError("--dense 1: the benchmark has no dense stage, and neither has this stand-in; give --dense 0")
    if arguments.extraction == "1":
        extract(arguments)
    if arguments.matching == "1":
        match(arguments)
    if arguments.sparse == "1":
        map_images(arguments)


# ------------------------------------------------------------------------ COLMAP's stages
def extract(arguments: argparse.Namespace) -> None:
    """SIFT of all images into ``database.db``."""
    size, count = SIZE_AND_FEATURES[arguments.quality]
    options = pycolmap.FeatureExtractionOptions(max_image_size=size, num_threads=arguments.num_threads, use_gpu=False)
    options.sift.max_num_features = count
    options.sift.estimate_affine_shape = arguments.quality in CAREFUL
    options.sift.domain_size_pooling = arguments.quality == "extreme"
    mode = pycolmap.CameraMode.AUTO
    if arguments.single_camera == "1":
        mode = pycolmap.CameraMode.SINGLE
    elif arguments.single_camera_per_folder == "1":
        mode = pycolmap.CameraMode.PER_FOLDER
    pycolmap.extract_features(
        arguments.workspace_path / "database.db",
        arguments.image_path,
        camera_mode=mode,
        reader_options=pycolmap.ImageReaderOptions(camera_model=arguments.camera_model),
        extraction_options=options,
        device=pycolmap.Device.cpu,
    )


def match(arguments: argparse.Namespace) -> None:
    """Matches and two-view geometries of the pairs."""
    is_global = arguments.mapper == "global"
    options = pycolmap.FeatureMatchingOptions(num_threads=arguments.num_threads, use_gpu=False)
    options.guided_matching = arguments.quality in CAREFUL and not is_global
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = arguments.random_seed
    if is_global:
        verification.ransac.max_error = 1.0
        verification.min_num_inliers, verification.min_inlier_ratio = 30, 0.25
    run = pycolmap.match_sequential if arguments.data_type == "video" else pycolmap.match_exhaustive
    run(
        arguments.workspace_path / "database.db",
        matching_options=options,
        verification_options=verification,
        device=pycolmap.Device.cpu,
    )


def clean_database(arguments: argparse.Namespace) -> None:
    """Delete all matches with their geometries, or the geometries alone."""
    with _opened(arguments.database_path) as database:
        if arguments.type == "matches":
            database.clear_matches()
        database.clear_two_view_geometries()


def align_model(arguments: argparse.Namespace) -> None:
    """Write the model in the frame of the reference; nothing where they cannot be aligned, as COLMAP does."""
    source, target = (pycolmap.Reconstruction(path) for path in (arguments.input_path, arguments.ref_model_path))
    target_from_source = pycolmap.align_reconstructions_via_proj_centers(source, target, arguments.alignment_max_error)
    if target_from_source is None:
        raise InputError(f"{arguments.input_path}: cannot be aligned to {arguments.ref_model_path}")
    source.transform(target_from_source)
    source.write(arguments.output_path)


# ---------------------------------------------------------------------------- our mapper
def map_images(arguments: argparse.Namespace) -> None:
    """Our reconstruction on the database, its models in ``sparse``.

    Raises:
        InputError: the database or its cameras cannot be used.
    """
    workspace, database = arguments.workspace_path, arguments.workspace_path / "database.db"
    sparse, output = workspace / "sparse", workspace / "smust3r"
    if sparse.is_dir() and any(sparse.iterdir()):
        print(f"{sparse}: is already computed")
        return
    config = RunConfig(
        workers=arguments.num_threads if arguments.num_threads > 0 else "auto",
        seed=max(0, arguments.random_seed),
        cameras=cameras_of(database),
        output=OutputConfig(trainer=False, dense=False, report=False),
    )
    if (output / "work").is_dir():
        shutil.rmtree(output)  # the database may have changed since
    with reporting(quiet=False, verbose=False) as reporter:
        importers.check_folders(arguments.image_path, output, None)
        with Run.open(output, workers=num_workers(config.workers), seed=config.seed, reporter=reporter) as run:
            source = importers.take_frames(run, arguments.image_path, config, overwrite=False)
            _, collection = importers.read_images(run, source, config, overwrite=False)
            ours, _ = feature_database_of_run(run, collection, config.features)
            copy_features_and_matches(database, ours, collection)
        try:
            summary = reconstruct(arguments.image_path, output, config, reporter=reporter)
        except ReconstructionError as error:
            print(f"no model: {error}")
            sparse.mkdir(exist_ok=True)
            return
        tell(summary, reporter, quiet=False)
    aside = workspace / "sparse.partial"
    shutil.rmtree(aside, ignore_errors=True)
    shutil.copytree(output / "sparse", aside)
    shutil.rmtree(sparse, ignore_errors=True)
    aside.rename(sparse)


def cameras_of(path: Path) -> CameraConfig:
    """The cameras that the run shall have, by those of the database.

    Raises:
        InputError: it is no database, has no images, or several known calibrations.
    """
    with _opened(path) as database:
        images = database.read_all_images()
        cameras = {image.camera_id: database.read_camera(image.camera_id) for image in images}
    if not images:
        raise InputError(f"{path}: has no images; run the extraction first")
    known = [camera for camera in cameras.values() if _is_calibrated(camera)]
    by_value = {(camera.model.name, camera.width, camera.height, tuple(camera.params)) for camera in known}
    if by_value and (len(by_value) > 1 or len(known) < len(cameras)):
        raise InputError(
            f"{path}: {len(by_value)} calibrations of {len(known)} of {len(cameras)} cameras are known; the mapper "
            "takes one for all images, or none: run evaluate.py with --uncalibrated"
        )
    if by_value:
        ((model, _, _, params),) = by_value
        return CameraConfig(
            camera_mode="single", camera_model=model, camera_params=",".join(str(float(value)) for value in params)
        )
    model = next(iter(cameras.values())).model.name
    if len(cameras) == 1:
        return CameraConfig(camera_mode="single", camera_model=model)
    return CameraConfig(camera_mode="per-image" if len(cameras) == len(images) else "auto", camera_model=model)


def _is_calibrated(camera: pycolmap.Camera) -> bool:
    """More than a focal length of EXIF and what COLMAP makes of the size."""
    plain = pycolmap.Camera.create_from_model_name(
        1, camera.model.name, camera.mean_focal_length(), camera.width, camera.height
    )
    return bool(camera.has_prior_focal_length and not np.allclose(camera.params, plain.params, rtol=1e-9))


def copy_features_and_matches(source: Path, target: Path, collection: ImageCollection) -> None:
    """What COLMAP's database has, by image name, into the new one of a run, which makes nothing again that is there.

    Every pair gets an entry, an empty one where COLMAP has no two-view geometry; images that COLMAP has no keypoints of
    get none.

    Raises:
        InputError: the source cannot be used, or an image is turned by its EXIF tag, so that its pixels are others.
    """
    with _opened(source) as theirs, _opened(target) as ours, pycolmap.DatabaseTransaction(ours):
        ids = {image.name: image for image in theirs.read_all_images()}
        for number, image in enumerate(collection.images, start=1):
            keypoints, descriptors = np.empty((0, 4), np.float32), _NO_DESCRIPTORS
            found = ids.get(image.name)
            if found is not None and theirs.exists_keypoints(found.image_id):
                _refuse_turned(image.path)
                keypoints = theirs.read_keypoints(found.image_id)
                descriptors = theirs.read_descriptors(found.image_id)
            ours.write_descriptors(number, descriptors)
            ours.write_keypoints(number, keypoints)
        for (a, one), (b, other) in combinations(enumerate(collection.images, start=1), 2):
            pair = [ids[image.name].image_id for image in (one, other) if image.name in ids]
            is_verified = len(pair) == 2 and theirs.exists_two_view_geometry(*pair)
            geometry = theirs.read_two_view_geometry(*pair) if is_verified else pycolmap.TwoViewGeometry()
            ours.write_matches(a, b, theirs.read_matches(*pair) if is_verified else np.empty((0, 2), np.uint32))
            ours.write_two_view_geometry(a, b, geometry)


_NO_DESCRIPTORS = pycolmap.FeatureDescriptors(pycolmap.FeatureExtractorType.SIFT, np.empty((0, 128), np.uint8))


def _refuse_turned(path: Path) -> None:
    with Image.open(path) as image:
        orientation = image.getexif().get(_EXIF_ORIENTATION, 1)
    if orientation != 1:
        raise InputError(
            f"{path}: its EXIF orientation is {orientation}: COLMAP's keypoints are of the pixels as they are stored, "
            "ours of the upright image; store the images upright"
        )


def _opened(path: Path) -> pycolmap.Database:
    if not path.is_file():
        raise InputError(f"{path}: there is no such database; run the extraction first")
    try:
        return pycolmap.Database.open(path)
    except RuntimeError as error:
        raise InputError(f"{path}: cannot be opened as a database: {error}") from error


if __name__ == "__main__":
    sys.exit(main())
