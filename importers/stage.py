"""What a run starts from: the image folder, or the model of another program and its images.

Nothing in the run's folder changes here: until the input is known to be of use, it may hold a finished run. The next
module to read is ``image_folder``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from smust3r_colmap.colmap.model_files import refuse_names_text_cannot_hold
from smust3r_colmap.config import RunConfig
from smust3r_colmap.errors import ConfigError
from smust3r_colmap.execution.run_context import Run
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


@dataclass(frozen=True, kw_only=True)
class CameraChoice:
    """What is to become of the cameras of an external model; see ``fit_to_images``."""

    share: bool = True
    model: str = ""
    calibrated: bool = False


def check_folders(images: Path, output: Path, config: RunConfig) -> None:
    """Refuse folders that cannot be used, before anything is made or changed.

    Raises:
        InputError: there is no image folder, or output or masks lie where the next run would read them as images.
    """
    check_output_not_inside(images, output)
    check_masks_not_inside(images, config.importing.masks)
    check_image_folder(images)


def check_model_is_kept(model: Path, output: Path) -> None:
    """Refuse to put results in the place of what they are made of.

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
        scan = scan_changed_files(images, run.folder, overwrite=overwrite, workers=config.workers)
        collection = _checked(run, collection_from_scan(scan, config.importing), config)
        progress.advance()
    _tell_rejected(run, collection)
    return scan, collection


def fit_model(
    run: Run, model: ExternalModel, images: Path, config: RunConfig, cameras: CameraChoice, *, overwrite: bool
) -> tuple[FolderScan, FittedModel]:
    """An external model, its cameras at the size of the image files.

    Raises:
        InputError: the model, the images or the settings cannot be used.
    """
    with run.clock.stage("import", total=1) as progress:
        scan = scan_changed_files(images, run.folder, overwrite=overwrite, workers=config.workers)
        fitted = fit_to_images(
            model,
            scan,
            share_cameras=cameras.share,
            camera_model=cameras.model,
            calibrated=cameras.calibrated,
            complete=config.refinement.complete,
        )
        fitted = replace(fitted, collection=_checked(run, fitted.collection, config))
        progress.advance()
    for note in fitted.notes:
        run.clock.note(note)
    _tell_rejected(run, fitted.collection)
    return scan, fitted


def _checked(run: Run, collection: ImageCollection, config: RunConfig) -> ImageCollection:
    """With the masks of the folder, where one is named."""
    if config.output.text:
        refuse_names_text_cannot_hold(image.name for image in collection.images)
    if not config.importing.masks:
        return collection
    masked = with_masks(collection, Path(config.importing.masks))
    if whole := names_without_mask(masked.images):
        run.clock.warn(f"{len(whole)} of {len(masked)} images have no mask and are used as a whole, such as {whole[0]}")
    return masked


def _tell_rejected(run: Run, collection: ImageCollection) -> None:
    for rejected in collection.rejected:
        run.clock.warn(f"left out: {rejected.name} ({rejected.reason})")
