"""A folder of photos or video frames, with its subfolders, as an ImageCollection.

Two steps, so that a second start decodes nothing again: ``scan_image_folder`` reads every file once and keeps a record
of each; ``collection_from_scan`` decides which images share a camera. Names in the model are the paths below the
folder, exactly as they lie on the disk, so that COLMAP finds the files again; their order is natural (img2 before
img10). A bad image is left out with a reason and never ends the run.
"""

from __future__ import annotations

import logging
import os
import re
import unicodedata
from collections import Counter, deque
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path, PurePosixPath
from statistics import median

import pycolmap

from smust3r_colmap.config import CameraConfig, CameraMode
from smust3r_colmap.errors import CollectionError, ConfigError, ImageError
from smust3r_colmap.execution.task_pool import usable_cores
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.importers.camera_prior import DEFAULT_FOCAL_RATIO, focal_prior_px
from smust3r_colmap.importers.frame_times import frame_times
from smust3r_colmap.importers.images import MAX_FILE_BYTES, SUFFIXES, UNREAD_SUFFIXES, Photo, inspect
from smust3r_colmap.products import ImageCollection, RejectedImage, SourceImage
from smust3r_colmap.storage.digest import digest_of

logger = logging.getLogger(__name__)

IGNORED_FOLDERS = frozenset({"__MACOSX", "@eaDir"})
"""Folders of thumbnails and resource forks that macOS archives and Synology disks leave among photos."""

MIN_IMAGES = 2
MAX_THREADS = 8
"""Beyond that the disk sets the pace, and every thread holds a file in memory."""


@dataclass(frozen=True, kw_only=True)
class ImportRecord:
    """What one reading of a file found; valid as long as its size and time of change stay.

    Args:
        name: path below the image folder, with forward slashes.
        size_bytes, mtime_ns: of the file.
        digest: BLAKE2b of the content, 160 bits in hexadecimal.
        photo: what the image is; None when it was rejected.
        reason: why it was rejected; empty otherwise.
    """

    name: str
    size_bytes: int
    mtime_ns: int
    digest: str
    photo: Photo | None
    reason: str = ""

    def __post_init__(self) -> None:
        if (self.photo is None) != bool(self.reason):
            raise ValueError(f"{self.name}: a record has either a photo or a reason")


@dataclass(frozen=True, kw_only=True)
class FolderScan:
    """All image files of a folder in natural order.

    Args:
        folder: the image folder.
        records: of the files that could be read, whether they are images or not.
        unreadable: files and subfolders that could not be read at all.
        other_suffixes: how many files of other kinds were ignored, by suffix.
    """

    folder: Path
    records: tuple[ImportRecord, ...]
    unreadable: tuple[RejectedImage, ...]
    other_suffixes: Mapping[str, int]


def import_image_folder(
    folder: Path, config: CameraConfig, *, known: Mapping[str, ImportRecord] | None = None, workers: int | None = None
) -> ImageCollection:
    """Scan a folder and make a collection of it.

    Args:
        folder: holds the images, directly or in subfolders.
        config: which images share a camera, and its model.
        known: records of an earlier scan by name; files that did not change are not read again.
        workers: threads; None takes one per core that this process may use.

    Raises:
        ConfigError: the camera model does not exist, or the camera mode does not fit the image sizes.
        CollectionError: there is no such folder, or it holds fewer than two usable images.
    """
    _check_camera_model(config.camera_model)
    return collection_from_scan(scan_image_folder(folder, known=known, workers=workers), config)


def check_image_folder(folder: Path) -> None:
    """Refuse a path that is no folder, before anything is written.

    Raises:
        CollectionError: there is no such folder.
    """
    if not folder.exists():
        raise CollectionError(f"{folder}: there is no such folder")
    if not folder.is_dir():
        raise CollectionError(f"{folder}: is a file; give the folder that holds the images")


def check_output_not_inside(images: Path, output: Path) -> None:
    """Refuse to write results among the images, where the next run would read them.

    Raises:
        ConfigError: the output folder is the image folder or lies in it.
    """
    if _lies_in(images, output):
        raise ConfigError(f"the output folder {output} lies inside the image folder {images}; choose one beside it")


def check_masks_not_inside(images: Path, masks: Path | None) -> None:
    """Refuse masks among the images: they would be read as photographs, or photographs as masks.

    Args:
        masks: the folder, or None.

    Raises:
        ConfigError: the folder of masks is the image folder or lies in it.
    """
    if masks is not None and _lies_in(images, masks):
        raise ConfigError(
            f"--masks {masks}: lies inside the image folder {images}, where masks and photographs are taken for each "
            "other; move the masks beside it"
        )


def _lies_in(outer: Path, inner: Path) -> bool:
    return inner.resolve() == outer.resolve() or outer.resolve() in inner.resolve().parents


# --------------------------------------------------------------------------------- scan
def scan_image_folder(
    folder: Path, *, known: Mapping[str, ImportRecord] | None = None, workers: int | None = None
) -> FolderScan:
    """Read and decode every image file once; arguments as ``import_image_folder``.

    Raises:
        CollectionError: there is no such folder.
    """
    listing = _list_folder(folder)
    look = partial(_record, folder, known or {})
    with ThreadPoolExecutor(min(workers or usable_cores(), MAX_THREADS)) as pool:
        results = list(pool.map(look, listing.names))
    unreadable = [*listing.unreadable, *(result for result in results if isinstance(result, RejectedImage))]
    return FolderScan(
        folder=folder,
        records=tuple(result for result in results if isinstance(result, ImportRecord)),
        unreadable=tuple(unreadable),
        other_suffixes=listing.other_suffixes,
    )


def natural_key(name: str) -> tuple[Hashable, ...]:
    """Sort key of a path with forward slashes: folder by folder, numbers by value, case ignored.

    Composed and decomposed accents sort alike; the name itself breaks ties.
    """
    path = PurePosixPath(unicodedata.normalize("NFC", name))
    parts = (*path.parent.parts, path.stem, path.suffix)
    return tuple(_numbers_by_value(part) for part in parts), name


def _numbers_by_value(text: str) -> tuple[str | int, ...]:
    submodels = re.split("([0-9]+)", text.casefold())
    return tuple(int(submodel) if position % 2 else submodel for position, submodel in enumerate(submodels))


@dataclass(frozen=True, kw_only=True)
class _Listing:
    names: tuple[str, ...]
    unreadable: tuple[RejectedImage, ...]
    other_suffixes: Mapping[str, int]


def _list_folder(folder: Path) -> _Listing:
    """Image files below the folder in natural order."""
    check_image_folder(folder)
    names: list[str] = []
    unreadable: list[RejectedImage] = []
    other_suffixes: Counter[str] = Counter()
    for name, problem in walk(folder):
        suffix = PurePosixPath(name).suffix.lower()
        if not problem and suffix in UNREAD_SUFFIXES:
            reason = f"images of kind {suffix} are not read; convert it to JPEG, PNG or 16-bit TIFF"
            unreadable.append(RejectedImage(name=printable(name), reason=reason))
        elif not problem and suffix not in SUFFIXES:
            other_suffixes[suffix] += 1
        elif reason := problem or unusable_entry(folder, name):
            unreadable.append(RejectedImage(name=printable(name), reason=reason))
        else:
            names.append(name)
    names.sort(key=natural_key)
    return _Listing(names=tuple(names), unreadable=tuple(unreadable), other_suffixes=other_suffixes)


def walk(folder: Path) -> Iterator[tuple[str, str]]:
    """Names of all files below the folder, each with an empty reason, and of unreadable folders with one.

    Hidden files and folders are passed over. Links are followed after all real folders, and no folder is
    entered twice, so that links in a circle end and a file keeps the name of its real place.
    """
    entered: set[tuple[int, int]] = set()
    pending = deque([PurePosixPath()])
    while pending:
        here = pending.popleft()
        try:
            status = os.stat(folder / here)
            if (status.st_dev, status.st_ino) in entered:
                continue
            entered.add((status.st_dev, status.st_ino))
            with os.scandir(folder / here) as found:
                entries = sorted(found, key=lambda entry: entry.name)
        except OSError as error:
            yield f"{here}/", _cannot_read(error)
            continue
        for entry in entries:
            if entry.name.startswith(".") or entry.name in IGNORED_FOLDERS:
                continue
            if not os.path.isdir(entry.path):
                yield str(here / entry.name), ""
            elif entry.is_symlink():
                pending.append(here / entry.name)
            else:
                pending.appendleft(here / entry.name)


def unusable_entry(folder: Path, name: str) -> str:
    """Why a file is not even opened; empty when it may be."""
    if not os.path.isfile(folder / name):
        return "no regular file, or a link to nothing"
    if printable(name) != name:
        return "the file name is not valid UTF-8 or has control characters; rename it"
    return ""


def printable(name: str) -> str:
    """The name with bytes that are no UTF-8, and control characters, written as escapes."""
    text = os.fsencode(name).decode("utf-8", "backslashreplace")
    return "".join(f"\\x{ord(char):02x}" if unicodedata.category(char) == "Cc" else char for char in text)


def _cannot_read(error: OSError) -> str:
    return f"cannot be read: {error.strerror or error}"


def _record(folder: Path, known: Mapping[str, ImportRecord], name: str) -> ImportRecord | RejectedImage:
    path = folder / name
    try:
        status = path.stat()
        before = known.get(name)
        if before is not None and (before.size_bytes, before.mtime_ns) == (status.st_size, status.st_mtime_ns):
            return before
        if status.st_size > MAX_FILE_BYTES:
            return RejectedImage(name=name, reason=f"{status.st_size} bytes; at most {MAX_FILE_BYTES} are read")
        data = path.read_bytes()
    except OSError as error:
        return RejectedImage(name=name, reason=_cannot_read(error))
    photo, reason = None, ""
    try:
        photo = inspect(data)
    except ImageError as error:
        reason = str(error)
    return ImportRecord(
        name=name,
        size_bytes=status.st_size,
        mtime_ns=status.st_mtime_ns,
        digest=digest_of(data),
        photo=photo,
        reason=reason,
    )


# --------------------------------------------------------------------------- collection
@dataclass(frozen=True, kw_only=True)
class _Usable:
    """A record that made it into the collection."""

    name: str
    digest: str
    photo: Photo

    @property
    def folder(self) -> str:
        return str(PurePosixPath(self.name).parent)

    @property
    def size(self) -> str:
        return f"{self.photo.width}x{self.photo.height}"


def collection_from_scan(scan: FolderScan, config: CameraConfig) -> ImageCollection:
    """Leave out what cannot be used and share cameras.

    Of names that differ only in the way accents are composed, the first is kept. Files with the same content
    are kept, as the repeated frames of a video, each to get a pose; but they count as one towards the minimum.

    Raises:
        ConfigError, CollectionError: as ``import_image_folder``.
    """
    _check_camera_model(config.camera_model)
    usable, left_out = _without_name_twins(scan.records)
    rejected = sorted([*left_out, *scan.unreadable], key=lambda image: natural_key(image.name))
    _check_enough(scan, usable, rejected)
    groups = _camera_groups(usable, config.camera_mode)
    cameras = [shared_prior([usable[index].photo for index in members], config.camera_model) for members in groups]
    if config.camera_params is not None:
        cameras = _known_cameras(cameras, config.camera_params, config.camera_model)
    camera_of = {index: camera for camera, members in enumerate(groups) for index in members}
    times = frame_times(scan.folder)
    bits = bits_in_use(scan.records)
    images = tuple(
        SourceImage(
            name=image.name,
            path=scan.folder / image.name,
            width=image.photo.width,
            height=image.photo.height,
            camera=camera_of[index],
            digest=image.digest,
            timestamp_s=times.get(image.name),
            bits=bits.get(image.name),
        )
        for index, image in enumerate(usable)
    )
    logger.info("%s: %d images, %d cameras, %d left out", scan.folder, len(images), len(cameras), len(rejected))
    return ImageCollection(
        images=images, cameras=tuple(cameras), rejected=tuple(rejected), calibrated=config.camera_params is not None
    )


def bits_in_use(records: Iterable[ImportRecord]) -> dict[str, int]:
    """By name, of images with more than 8 bits a channel: the most that images of that folder, size and camera use.

    One number for all of them: with one for each, neighbours would differ in brightness.
    """
    sources: dict[Hashable, int] = {}
    deep = [(r.name, _auto_key(r.name, r.photo), r.photo.bits) for r in records if r.photo is not None and r.photo.deep]
    for _, source, bits in deep:
        sources[source] = max(bits, sources.get(source, 0))
    return {name: sources[source] for name, source, _ in deep}


def _without_name_twins(records: Sequence[ImportRecord]) -> tuple[list[_Usable], list[RejectedImage]]:
    usable: list[_Usable] = []
    left_out: list[RejectedImage] = []
    by_composed_name: dict[str, str] = {}
    for record in records:
        composed = unicodedata.normalize("NFC", record.name)
        if record.photo is None:
            reason = record.reason
        elif composed in by_composed_name:
            reason = f"same name as {by_composed_name[composed]!a} but for the composition of accents; rename it"
        else:
            by_composed_name[composed] = record.name
            usable.append(_Usable(name=record.name, digest=record.digest, photo=record.photo))
            continue
        left_out.append(RejectedImage(name=record.name, reason=reason))
    return usable, left_out


def _check_enough(scan: FolderScan, usable: Sequence[_Usable], rejected: Sequence[RejectedImage]) -> None:
    distinct = {image.digest for image in usable}
    if len(distinct) >= MIN_IMAGES:
        return
    if len(usable) >= MIN_IMAGES:
        found = f"{len(usable)} images of the same content ({usable[0].name}, {usable[1].name}, ...)"
    else:
        found = f"1 usable image ({usable[0].name})" if usable else "no usable image"
    message = f"{scan.folder}: {found}, at least {MIN_IMAGES} are needed; read are {' '.join(SUFFIXES)}"
    if rejected:
        message += f"; left out {len(rejected)}: " + "; ".join(f"{one.name}: {one.reason}" for one in rejected[:5])
    if scan.other_suffixes:
        counts = Counter(scan.other_suffixes)
        kinds = ", ".join(f"{count} {suffix or 'without suffix'}" for suffix, count in counts.most_common(3))
        message += f"; files of other kinds: {kinds}"
    raise CollectionError(message)


# ------------------------------------------------------------------------------ cameras
def _auto_key(name: str, photo: Photo) -> Hashable:
    tags = photo.tags
    folder, size = str(PurePosixPath(name).parent), (photo.width, photo.height)
    return folder, size, tags.make, tags.model, tags.focal_mm, tags.focal_35mm, tags.digital_zoom


_CAMERA_KEYS: Mapping[CameraMode, Callable[[_Usable], Hashable]] = {
    "auto": lambda image: _auto_key(image.name, image.photo),
    "single": lambda image: None,
    "per-folder": lambda image: image.folder,
    "per-image": lambda image: image.name,
}


def _camera_groups(images: Sequence[_Usable], mode: CameraMode) -> list[list[int]]:
    """Positions of the images that share a camera, in the order of their first image.

    Raises:
        ConfigError: images of different size would share a camera.
    """
    groups: dict[Hashable, list[int]] = {}
    for index, image in enumerate(images):
        groups.setdefault(_CAMERA_KEYS[mode](image), []).append(index)
    for members in groups.values():
        _check_one_size([images[index] for index in members], mode)
    return list(groups.values())


def _check_one_size(images: Sequence[_Usable], mode: CameraMode) -> None:
    first_of_size: dict[str, str] = {}
    for image in images:
        first_of_size.setdefault(image.size, image.name)
    if len(first_of_size) == 1:
        return
    counts = Counter(image.size for image in images)
    where = f"in folder {images[0].folder}" if mode == "per-folder" else "here"
    sizes = ", ".join(f"{count} of {size} such as {first_of_size[size]}" for size, count in counts.most_common(4))
    raise ConfigError(
        f"--camera-mode {mode}: {len(images)} images {where} have {len(counts)} sizes ({sizes});"
        " images that share a camera need one size: use --camera-mode auto"
    )


def shared_prior(photos: Sequence[Photo], camera_model: str) -> Intrinsics:
    """One camera for photos of one size: the median of the focal lengths EXIF gives, else COLMAP's guess."""
    width, height = photos[0].width, photos[0].height
    priors = [prior for photo in photos if (prior := focal_prior_px(photo.tags, width, height)) is not None]
    focal = median(priors) if priors else DEFAULT_FOCAL_RATIO * max(width, height)
    camera = pycolmap.Camera.create_from_model_name(1, camera_model, focal, width, height)
    camera.has_prior_focal_length = bool(priors)
    return Intrinsics.from_colmap(camera)


def _known_cameras(cameras: Sequence[Intrinsics], given_params: str, model: str) -> list[Intrinsics]:
    """The calibration that was given, for every camera.

    Raises:
        ConfigError: it is no list of numbers, has the wrong count, or the images have more than one size.
    """
    given = f"--camera-params {given_params}"
    sizes = sorted({(camera.width, camera.height) for camera in cameras})
    if len(sizes) > 1:
        shown = ", ".join(f"{width}x{height}" for width, height in sizes[:4])
        raise ConfigError(f"{given}: holds for one image size, the images have {len(sizes)} ({shown})")
    try:
        params = tuple(float(number) for number in given_params.split(","))
    except ValueError:
        raise ConfigError(f"{given}: needed are numbers separated by commas") from None
    needed = pycolmap.Camera.create_from_model_name(1, model, 1.0, 1, 1).params_info
    try:
        known = replace(cameras[0], model=model, params=params, has_prior_focal=True)
    except ValueError as error:
        raise ConfigError(f"{given}: does not fit --camera-model {model}, which takes {needed} ({error})") from None
    if known.focal_px <= 0:
        raise ConfigError(f"{given}: the focal length is {known.focal_px:g} px")
    return [known] * len(cameras)


def _check_camera_model(name: str) -> None:
    models = [model for model in pycolmap.CameraModelId.__members__ if model != "INVALID"]
    if name not in models:
        raise ConfigError(f"--camera-model {name}: COLMAP does not know it; choose one of {', '.join(models)}")
