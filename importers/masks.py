"""Masks of images: pixels that features, depth and trainers do not use.

Names are COLMAP's: the mask of an image is ``<name>.png`` below the folder of masks, else ``<name without
suffix>.png``; what is black or transparent in it is left out, everything else is kept. An image without a mask is used
as a whole (COLMAP's feature extraction passes over it), but for what its own alpha leaves out. A mask has the size of
the upright image; its own EXIF orientation is ignored. The next module to read is ``masked_maps``, which applies masks
to depth.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import cv2
import numpy as np

from smust3r_colmap.errors import ImageError, InputError
from smust3r_colmap.execution.task_pool import usable_cores
from smust3r_colmap.geometry.arrays import UInt8Array
from smust3r_colmap.importers.images import load_alpha, stored_size
from smust3r_colmap.products import ImageCollection, ImageMask, SourceImage
from smust3r_colmap.storage.digest import digest_of

MAX_THREADS = 4
"""Each holds a mask in memory."""


@dataclass(frozen=True, kw_only=True)
class MaskSet:
    """The masks that a run was made with.

    Args:
        folder: where they lie.
        digest_of: hash of the content of each mask, by the name of its image.
    """

    folder: Path
    digest_of: Mapping[str, str]


def with_masks(collection: ImageCollection, folder: Path) -> ImageCollection:
    """The collection with the mask of every image that has one in ``folder``.

    Only the heads of the masks are decoded and the sums of their data compared; their content becomes part of the
    keys of the stages.

    Raises:
        InputError: there is no such folder, or no image has a mask in it.
        ImageError: a mask cannot be read, has another size than its image, or is itself one of the images.
    """
    if not folder.is_dir():
        raise InputError(f"--masks {folder}: there is no such folder of masks")
    images = tuple(_with_mask(image, folder) for image in collection.images)
    if not any(image.mask for image in images):
        name = images[0].name
        raise InputError(
            f"--masks {folder}: none of the {len(images)} images has a mask there; the mask of {name} is {name}.png "
            f"or {PurePosixPath(name).with_suffix('.png')}"
        )
    _refuse_photographs(images)
    return replace(collection, images=images)


def with_alpha(collection: ImageCollection, transparent: Mapping[str, float]) -> ImageCollection:
    """The collection with alpha as the mask of every image that has transparent pixels and no other mask.

    Args:
        transparent: part of the pixels by the name of the image.
    """

    def of(image: SourceImage) -> SourceImage:
        if image.mask is not None or not transparent.get(image.name):
            return image
        return replace(image, mask=ImageMask(path=image.path, digest=image.digest, of_alpha=True))

    return replace(collection, images=tuple(map(of, collection.images)))


def left_out_shares(images: Sequence[SourceImage]) -> dict[str, float]:
    """Part of the pixels that the mask leaves out, by the name of each image that has one.

    Raises:
        ImageError: a mask cannot be read, or has another size than its image.
    """
    masked = [image for image in images if image.mask is not None]
    with ThreadPoolExecutor(min(usable_cores(), MAX_THREADS)) as pool:
        return dict(zip((image.name for image in masked), pool.map(_left_out, masked), strict=True))


def _left_out(image: SourceImage) -> float:
    assert image.mask is not None
    return float((load_mask(image.mask.path, image) == 0).mean())


def masks_of(collection: ImageCollection, folder: Path | None) -> MaskSet | None:
    """What ``with_masks`` found in ``folder``, to be kept with the results; None where no folder is named."""
    if folder is None:
        return None
    masks = {image.name: image.mask for image in collection.images}
    digests = {name: mask.digest for name, mask in masks.items() if mask is not None and not mask.of_alpha}
    return MaskSet(folder=folder, digest_of=digests)


def check_masks(masks: MaskSet, names: Iterable[str]) -> None:
    """Refuse masks other than those of the run: they would silently change the result.

    Args:
        names: of the images whose masks are needed.

    Raises:
        InputError: the folder is gone.
        ImageError: a mask is gone, is another one now, or was not there before.
    """
    way_out = "put the old masks back, or name a folder with --masks, whose masks are then taken as they are"
    if not masks.folder.is_dir():
        raise InputError(f"{masks.folder}: the masks of the run are not there any more; {way_out}")
    for name in names:
        path = find_mask(masks.folder, name)
        then, now = masks.digest_of.get(name, ""), "" if path is None else digest_of(_read(path))
        if then != now:
            what = "has changed" if then and now else "is gone" if then else "is new"
            raise ImageError(f"{path or masks.folder}: the mask of {name} {what} since the run; {way_out}")


def names_without_mask(images: Iterable[SourceImage]) -> tuple[str, ...]:
    """Images that are used as a whole."""
    return tuple(image.name for image in images if image.mask is None)


def find_mask(folder: Path, name: str) -> Path | None:
    """COLMAP's rule: ``<name>.png``, else ``<name without suffix>.png``, below the folder of masks."""
    path = PurePosixPath(name)
    return next((p for p in (folder / f"{path}.png", folder / path.with_suffix(".png")) if p.is_file()), None)


def load_mask(path: Path, image: SourceImage) -> UInt8Array:
    """(H, W) of the upright image, 255 where it is kept and 0 where it is not.

    Raises:
        ImageError: the file is gone, does not decode, has another size than the image, or is the image itself.
    """
    if image.mask is not None and image.mask.of_alpha:
        alpha = load_alpha(image)
        return np.full((image.height, image.width), 255, np.uint8) if alpha is None else alpha
    if path.resolve() == image.path.resolve():
        raise _is_photograph(path, image.name)
    # As stored: in 8 bits of grey, small numbers of 16-bit labels and dark colours of labels would become black.
    mask = cv2.imdecode(np.frombuffer(_read(path) or b"\0", np.uint8), cv2.IMREAD_UNCHANGED)
    if mask is None:
        raise _no_image(path)
    _check_size(path, (mask.shape[1], mask.shape[0]), image)
    channels = mask.reshape(*mask.shape[:2], -1)
    kept = (channels[:, :, :3] > 0).any(axis=2)
    if channels.shape[2] == 4:
        kept &= channels[:, :, 3] > 0
    return np.where(kept, 255, 0).astype(np.uint8)


def _with_mask(image: SourceImage, folder: Path) -> SourceImage:
    path = find_mask(folder, image.name)
    if path is None:
        return image
    data = _read(path)
    try:
        size = stored_size(data)
    except ImageError as error:
        raise _no_image(path) from error
    _check_size(path, size, image)
    return replace(image, mask=ImageMask(path=path, digest=digest_of(data)))


def _refuse_photographs(images: Sequence[SourceImage]) -> None:
    """By content, so that links and copies of the image folder are found, too."""
    name_of = {image.digest: image.name for image in images}
    for image in images:
        if image.mask is not None and image.mask.digest in name_of:
            raise _is_photograph(image.mask.path, name_of[image.mask.digest])


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise ImageError(f"{path}: cannot be read ({error.strerror})") from error


def _check_size(path: Path, size: tuple[int, int], image: SourceImage) -> None:
    if size != (image.width, image.height):
        raise ImageError(
            f"{path}: the mask is {size[0]}x{size[1]} px and its image {image.width}x{image.height};"
            " masks have the size of the original image, upright"
        )


def _is_photograph(path: Path, name: str) -> ImageError:
    return ImageError(
        f"{path}: would be a mask and is the photograph {name}, too; keep masks in a folder of their own, beside the "
        "images"
    )


def _no_image(path: Path) -> ImageError:
    return ImageError(f"{path}: no image that can be read; masks are PNG files, black where nothing is used")
