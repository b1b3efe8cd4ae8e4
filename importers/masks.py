"""Masks of images: which pixels no feature, no depth and no trainer shall use.

The rule is COLMAP's: the mask of an image is ``<name>.png`` below the folder of masks, else ``<name without
suffix>.png``; what is black in it is left out, everything else is kept. A mask has the size of the upright image. An
image without a mask is used as a whole. The next module to read is ``masked_maps``, which applies masks to depth.
"""

from __future__ import annotations

import hashlib
import io
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path, PurePosixPath

import cv2
import numpy as np
import numpy.typing as npt
from PIL import Image, UnidentifiedImageError

from smust3r_colmap.errors import ImageError, InputError
from smust3r_colmap.products import ImageCollection, ImageMask, SourceImage

UInt8Array = npt.NDArray[np.uint8]

_DAMAGE = (OSError, SyntaxError, ValueError, UnidentifiedImageError, Image.DecompressionBombError)
"""What Pillow raises on files that are no image, or half of one."""


def with_masks(collection: ImageCollection, folder: Path) -> ImageCollection:
    """The collection with the mask of every image that has one in ``folder``.

    Only the heads of the masks are decoded and the sums of their data compared; their content becomes part of the
    keys of the stages.

    Raises:
        InputError: there is no such folder, or no image has a mask in it.
        ImageError: a mask cannot be read, or has another size than its image.
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
    return replace(collection, images=images)


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
        ImageError: the file is gone, does not decode, or has another size than the image.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ImageError(f"{path}: cannot be read ({error.strerror})") from error
    # Grey with the depth of the file: at 8 bits the small numbers of 16-bit labels would become black.
    mask = cv2.imdecode(np.frombuffer(data or b"\0", np.uint8), cv2.IMREAD_ANYDEPTH)
    if mask is None:
        raise _no_image(path)
    _check_size(path, (mask.shape[1], mask.shape[0]), image)
    return np.where(mask > 0, 255, 0).astype(np.uint8)


def _with_mask(image: SourceImage, folder: Path) -> SourceImage:
    path = find_mask(folder, image.name)
    if path is None:
        return image
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ImageError(f"{path}: cannot be read ({error.strerror})") from error
    try:
        with Image.open(io.BytesIO(data)) as head:
            size = head.size
            head.verify()
    except _DAMAGE as error:
        raise _no_image(path) from error
    _check_size(path, size, image)
    return replace(image, mask=ImageMask(path=path, digest=hashlib.blake2b(data, digest_size=20).hexdigest()))


def _check_size(path: Path, size: tuple[int, int], image: SourceImage) -> None:
    if size != (image.width, image.height):
        raise ImageError(
            f"{path}: the mask is {size[0]}x{size[1]} px and its image {image.width}x{image.height};"
            " masks have the size of the original image, upright"
        )


def _no_image(path: Path) -> ImageError:
    return ImageError(f"{path}: no image that can be read; masks are PNG files, black where nothing is used")
