"""The input of a run: an image folder, videos, or the model of another program and its images.

No product in the run's folder changes here: until the input is known to be of use, it may hold a finished run. The next
module to read is ``image_folder``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from smust3r_colmap.colmap.model_files import refuse_names_text_cannot_hold
from smust3r_colmap.config import RefineConfig, RunConfig, VideoConfig
from smust3r_colmap.errors import CollectionError, ConfigError, MissingDependencyError, VideoError
from smust3r_colmap.execution.run_context import Run
from smust3r_colmap.execution.task_pool import num_workers
from smust3r_colmap.importers.colmap_model import ExternalModel
from smust3r_colmap.importers.fitted_model import FittedModel, fit_to_images
from smust3r_colmap.importers.image_folder import (
    MIN_IMAGES,
    FolderScan,
    check_image_folder,
    check_masks_not_inside,
    check_output_not_inside,
    collection_from_scan,
)
from smust3r_colmap.importers.image_scan import scan_changed_files
from smust3r_colmap.importers.masks import left_out_shares, names_without_mask, with_alpha, with_masks
from smust3r_colmap.importers.video import open_video
from smust3r_colmap.importers.video_frames import (
    VideoFile,
    VideoReport,
    find_files,
    is_video,
    link_images,
    write_frames,
)
from smust3r_colmap.products import ImageCollection, RejectedImage
from smust3r_colmap.storage.codec import Codec
from smust3r_colmap.storage.run_directory import FRAMES_STAGE, StageFolder, key_of, storage_errors

MANY_PIXELS = 0.5
"""Masks that leave out more than that on average are often inverted."""
VIDEO_REPORT: Codec[VideoReport] = Codec(VideoReport, "video")
"""In the folder of the frames of a video."""


@dataclass(frozen=True, kw_only=True)
class ImageSource:
    """Where the images of a run lie.

    Args:
        folder: the folder that was given, or one in the run's folder with the frames of the videos.
        left_out: videos, or parts of them, that could not be used.
    """

    folder: Path
    left_out: tuple[RejectedImage, ...] = ()


def check_folders(images: Path, output: Path, masks: Path | None) -> None:
    """Refuse folders that cannot be used, before anything is made or changed.

    Raises:
        InputError: there is neither an image folder nor a video, or output or masks lie where the next run would read
            them as images.
    """
    check_output_not_inside(images, output)
    check_masks_not_inside(images, masks)
    if not (images.is_file() and is_video(images)):
        check_image_folder(images)


def check_model_is_kept(model: Path, output: Path) -> None:
    """Refuse to overwrite the input with results.

    Raises:
        ConfigError: the model lies in the output folder, or is it.
    """
    if output.resolve() in (model.resolve(), *model.resolve().parents):
        raise ConfigError(f"--output {output}: the model {model} lies there and would be lost; name another folder")


def take_frames(run: Run, source: Path, config: RunConfig, *, overwrite: bool) -> ImageSource:
    """The frames of a video, or of the videos in a folder, as images in the run's folder; other images are linked.

    Frames that an earlier start has finished are used again, as long as the videos and the settings are the same.

    Args:
        source: a video, or a folder; where it has no videos, it is the source of the images as it is.

    Raises:
        VideoError: no video can be used, and there is nothing else.
        MissingDependencyError: the same, because PyAV is not installed.
        CollectionError: all videos together give fewer than two frames, and there is nothing else.
    """
    found = find_files(source)
    if not found.videos:
        return ImageSource(folder=source, left_out=found.left_out)
    keys = [_key_of_frames(video, config.video) for video in found.videos]
    root = run.folder.work / FRAMES_STAGE / key_of(*keys)
    reports, left_out = list[VideoReport](), list(found.left_out)
    for video, key in zip(found.videos, keys, strict=True):
        stored = StageFolder(path=root / video.frames_folder, key=key)
        try:
            report = _frames_of(run, video, stored, config, overwrite=overwrite)
        except (VideoError, MissingDependencyError) as error:
            if len(found.videos) == 1 and not found.images:
                raise
            left_out.append(RejectedImage(name=video.name, reason=str(error)))
            continue
        run.clock.note(f"{video.name}: {report} into {stored.path}")
        reports.append(report)
        if report.faults:
            left_out.append(RejectedImage(name=video.name, reason=report.faults))
    if not found.images and sum(report.num_taken for report in reports) < MIN_IMAGES:
        raise CollectionError(_too_few(source, reports, left_out, config.video))
    with storage_errors(root):
        link_images(source, found.images, root)
    return ImageSource(folder=root, left_out=tuple(left_out))


def _key_of_frames(video: VideoFile, config: VideoConfig) -> str:
    status = video.path.stat()
    return key_of(FRAMES_STAGE, video.name, video.frames_folder, status.st_size, status.st_mtime_ns, config)


def _frames_of(run: Run, video: VideoFile, stored: StageFolder, config: RunConfig, *, overwrite: bool) -> VideoReport:
    threads = num_workers(config.workers)
    with open_video(video.path, name=video.name, threads=threads) as opened:
        total = opened.whole_seconds
    with run.clock.stage(f"frames of {video.name}", total=total) as progress:
        if stored.is_done and not overwrite:
            progress.skip(total)
        else:
            with stored.write() as folder:
                report = write_frames(
                    video,
                    folder,
                    fps=config.video.fps,
                    max_frames=config.video.max_frames,
                    threads=threads,
                    advance=progress.advance,
                )
                VIDEO_REPORT.write(folder, report)
    return VIDEO_REPORT.read(stored.path)


def _too_few(
    source: Path, reports: Sequence[VideoReport], left_out: Sequence[RejectedImage], config: VideoConfig
) -> str:
    """Why a run on these videos cannot begin."""
    taken, decoded = (sum(getattr(one, name) for one in reports) for name in ("num_taken", "num_decoded"))
    message = f"{source}: {taken} of {decoded} video frames taken, at least {MIN_IMAGES} are needed"
    if decoded >= MIN_IMAGES and config == VideoConfig():
        message += "; the camera hardly moves: --fps takes frames by time"
    return "; ".join([message, *(f"{one.name}: {one.reason}" for one in left_out[:5])])


def read_images(
    run: Run, source: ImageSource, config: RunConfig, *, overwrite: bool
) -> tuple[FolderScan, ImageCollection]:
    """The images of a folder; files that did not change since an earlier start are not decoded again.

    Raises:
        InputError: the images or the settings cannot be used.
    """
    with run.clock.stage("import", total=1) as progress:
        scan = scan_changed_files(source.folder, run.folder, overwrite=overwrite, workers=num_workers(config.workers))
        scan = replace(scan, unreadable=(*scan.unreadable, *source.left_out))
        collection = _checked(run, collection_from_scan(scan, config.cameras), scan, config)
        progress.advance()
    _tell_rejected(run, collection)
    _tell_passed_over(run, scan)
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
        fitted = replace(fitted, collection=_checked(run, fitted.collection, scan, config))
        progress.advance()
    for note in fitted.notes:
        run.clock.note(note)
    _tell_rejected(run, fitted.collection)
    return scan, fitted


def _checked(
    run: Run, collection: ImageCollection, scan: FolderScan, config: RunConfig | RefineConfig
) -> ImageCollection:
    """With the masks of the folder, where one is named, and of alpha."""
    if config.output.text:
        refuse_names_text_cannot_hold(image.name for image in collection.images)
    if config.masks is not None:
        collection = with_masks(collection, config.masks)
        if whole := names_without_mask(collection.images):
            run.clock.warn(
                f"{len(whole)} of {len(collection)} images have no mask and are used as a whole, such as {whole[0]}"
            )
    photos = {record.name: record.photo for record in scan.records if record.photo is not None}
    masked = with_alpha(collection, {name: photo.transparent for name, photo in photos.items()})
    _tell_masks(run, masked)
    if unreadable := [image.name for image in masked.images if photos[image.name].exif_unreadable]:
        run.clock.note(
            f"the EXIF of {len(unreadable)} images cannot be read and is not used, such as that of {unreadable[0]}"
        )
    return masked


def _tell_masks(run: Run, collection: ImageCollection) -> None:
    """What share of the pixels the masks leave out: an inverted or empty mask looks like any other."""
    if of_alpha := [image.name for image in collection.images if image.mask is not None and image.mask.of_alpha]:
        run.clock.note(
            f"alpha is the mask of {len(of_alpha)} images, such as {of_alpha[0]}: their transparent pixels are not used"
        )
    shares = left_out_shares(collection.images)
    if not shares:
        return
    mean = sum(shares.values()) / len(shares)
    text = f"the masks leave out {mean:.1%} of the pixels of their images"
    if mean in (0.0, 1.0):
        run.clock.warn(
            f"{text}; what is black or transparent in a mask is left out, and everything else is kept: are they "
            f"{'empty' if mean else 'labels whose background is not 0'}, or inverted?"
        )
        return
    run.clock.note(text)
    if whole := [name for name, share in shares.items() if share == 1.0]:
        run.clock.warn(f"the masks of {len(whole)} images leave out all of their pixels, such as that of {whole[0]}")
    if mean > MANY_PIXELS:
        run.clock.warn("that is more than half; what is black or transparent in a mask is left out: are they inverted?")


def _tell_passed_over(run: Run, scan: FolderScan) -> None:
    if scan.other_suffixes:
        kinds = ", ".join(
            f"{count} {suffix or 'without suffix'}" for suffix, count in sorted(scan.other_suffixes.items())
        )
        run.clock.note(f"passed over, for they are no images: {kinds}")


def _tell_rejected(run: Run, collection: ImageCollection) -> None:
    for rejected in collection.rejected:
        run.clock.warn(f"left out: {rejected.name} ({rejected.reason})")
