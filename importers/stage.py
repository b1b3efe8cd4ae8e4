"""The input of a run: an image folder, or the model of another program and its images.

Nothing in the run's folder changes here: until the input is known to be of use, it may hold a finished run. The next
module to read is ``image_folder``.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from smust3r_colmap.colmap.model_files import refuse_names_text_cannot_hold
from smust3r_colmap.config import RefineConfig, RunConfig
from smust3r_colmap.errors import ConfigError
from smust3r_colmap.execution.run_context import Run
from smust3r_colmap.execution.task_pool import num_workers
from smust3r_colmap.importers.colmap_model import ExternalModel
from smust3r_colmap.importers.fitted_model import FittedModel, fit_to_images
from smust3r_colmap.importers.image_folder import (
    FolderScan,
    check_image_folder,
    check_masks_not_inside,
    check_output_not_inside,
    collection_from_scan,
)
from smust3r_colmap.importers.image_scan import scan_changed_files
from smust3r_colmap.importers.masks import names_without_mask, with_masks
from smust3r_colmap.products import ImageCollection


def check_folders(images: Path, output: Path, masks: Path | None) -> None:
    """Refuse folders that cannot be used, before anything is made or changed.

    Raises:
        InputError: there is no image folder, or output or masks lie where the next run would read them as images.
    """
    check_output_not_inside(images, output)
    check_masks_not_inside(images, masks)
    check_image_folder(images)


def check_model_is_kept(model: Path, output: Path) -> None:
    """Refuse to overwrite the input with results.

    Raises:
        ConfigError: the model lies in the output folder, or is it.
    """
    if output.resolve() in (model.resolve(), *model.resolve().parents):
        raise ConfigError(f"--output {output}: the model {model} lies there and would be lost; name another folder")


def read_images(run: Run, images: Path, config: RunConfig, *, overwrite: bool) -> tuple[FolderScan, ImageCollection]:
    """The images of a folder; files that did not change since an earlier start are not decoded again.

    Raises:
        InputError: the images or the settings cannot be used.
    """
    with run.clock.stage("import", total=1) as progress:
        scan = scan_changed_files(images, run.folder, overwrite=overwrite, workers=num_workers(config.workers))
        collection = _checked(run, collection_from_scan(scan, config.cameras), config)
        progress.advance()
    _tell_rejected(run, collection)
    return scan, collection


def fit_model(
    run: Run, model: ExternalModel, images: Path, config: RefineConfig, *, overwrite: bool
) -> tuple[FolderScan, FittedModel]:
    """An external model, its cameras at the size of the image files.

    Raises:
        InputError: the model, the images or the settings cannot be used.
    """
    with run.clock.stage("import", total=1) as progress:
        scan = scan_changed_files(images, run.folder, overwrite=overwrite, workers=num_workers(config.workers))
        fitted = fit_to_images(
            model,
            scan,
            share_cameras=config.cameras.share_cameras,
            camera_model=config.cameras.camera_model,
            calibrated=config.cameras.calibrated,
            register_missing=config.refinement.register_missing,
        )
        fitted = replace(fitted, collection=_checked(run, fitted.collection, config))
        progress.advance()
    for note in fitted.notes:
        run.clock.note(note)
    _tell_rejected(run, fitted.collection)
    return scan, fitted


def _checked(run: Run, collection: ImageCollection, config: RunConfig | RefineConfig) -> ImageCollection:
    """With the masks of the folder, where one is named."""
    if config.output.text:
        refuse_names_text_cannot_hold(image.name for image in collection.images)
    if config.masks is None:
        return collection
    masked = with_masks(collection, config.masks)
    if whole := names_without_mask(masked.images):
        run.clock.warn(f"{len(whole)} of {len(masked)} images have no mask and are used as a whole, such as {whole[0]}")
    return masked


def _tell_rejected(run: Run, collection: ImageCollection) -> None:
    for rejected in collection.rejected:
        run.clock.warn(f"left out: {rejected.name} ({rejected.reason})")
