"""From a photo to what the network sees, and back to the pixels of the photo.

The network takes few, fixed shapes: a centre crop of the photo, resized. `preprocess` gives the input of the
published network bit by bit, with one difference outside of this module: there, the EXIF orientation is ignored and
a portrait may lie on its side; here, images come from our importer, which has rotated them already. The map back is
a value of its own, `NetworkWindow`. The next module to read is ``encoder``.

Source: the network specification, section 8.1.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from smust3r_colmap.geometry.arrays import FloatArray, UInt8Array

Resolution = tuple[int, int]
"""Longer and shorter side of a shape, in pixels."""

RESOLUTIONS: Mapping[int, tuple[Resolution, ...]] = MappingProxyType(
    {
        224: ((224, 224),),
        336: ((336, 336),),
        384: ((384, 288), (384, 256), (384, 192), (384, 128)),
        448: ((448, 448),),
        512: ((512, 384), (512, 336), (512, 288), (512, 256), (512, 160)),
        768: ((768, 576), (768, 512), (768, 432), (768, 384), (768, 240)),
    }
)
"""The published shapes by network size; earlier ones win a tie (the network specification, section 8.1)."""
PATCH_SIZE = 16
"""Sides are multiples of it."""
ROWS_AT_A_TIME = 256
"""Of a photo as floats in memory: 24 MiB for one of 8,000 pixels across, where all of 40 megapixels take 480."""


@dataclass(frozen=True, kw_only=True)
class NetworkWindow:
    """Which part of the original image the network sees, and at what size.

    Both ends use COLMAP's pixels, whose centres lie at +0.5, so that a resize is a mere scaling.

    Args:
        width_orig, height_orig: of the original image.
        left, top, crop_width, crop_height: of what is seen, in original pixels.
        width, height: of the network's image.
    """

    width_orig: int
    height_orig: int
    left: int
    top: int
    crop_width: int
    crop_height: int
    width: int
    height: int

    @property
    def orig_px_per_net_px(self) -> tuple[float, float]:
        """Scale in x and in y; they differ by the rounding of the crop, by less than 1 % for photos of 200 pixels."""
        return self.crop_width / self.width, self.crop_height / self.height

    @property
    def seen_share(self) -> float:
        """Share of the original image that the network sees; a panorama loses most of itself."""
        return self.crop_width * self.crop_height / (self.width_orig * self.height_orig)

    @property
    def orig_from_net(self) -> FloatArray:
        """(3, 3) exact, between pixels whose centres lie at +0.5."""
        scale_x, scale_y = self.orig_px_per_net_px
        return np.array([[scale_x, 0.0, self.left], [0.0, scale_y, self.top], [0.0, 0.0, 1.0]])


@dataclass(frozen=True, kw_only=True, eq=False)
class NetworkImage:
    """An image as the network wants it.

    Args:
        pixels: (3, height, width) float32 RGB, in [-1, 1] up to what resizing overshoots.
        window: where they lie in the original image.
    """

    pixels: Tensor
    window: NetworkWindow

    def __post_init__(self) -> None:
        expected = (3, self.window.height, self.window.width)
        if tuple(self.pixels.shape) != expected:
            raise ValueError(f"NetworkImage: pixels {tuple(self.pixels.shape)}, window {expected}")


def preprocess(
    image: UInt8Array | Image.Image, size: int, *, resolutions: Sequence[Resolution] | None = None
) -> NetworkImage:
    """Centre crop to the nearest of the network's shapes, then resize.

    Photos of any size and shape come out; one of 10:1 loses two thirds at its ends, a tiny one is enlarged, and of
    a side that the crop would leave empty one pixel stays. A square comes out as landscape.

    Args:
        image: (H, W, 3) RGB, or a Pillow image, whose EXIF orientation is ignored.
        size: longer side of the network's images; see `resolutions_of`.
        resolutions: shapes to choose from instead of those of ``size``, longer side first.

    Raises:
        ValueError: the array is not (H, W, 3) uint8 or is empty, or ``size`` is no multiple of 16.

    Source: the network specification, section 8.1.
    """
    photo = _rgb(image)
    window = choose_window(photo.shape[1], photo.shape[0], resolutions or resolutions_of(size))
    cropped = photo[window.top : window.top + window.crop_height, window.left : window.left + window.crop_width]
    return NetworkImage(pixels=_resized(cropped, window.height, window.width), window=window)


def resolutions_of(size: int) -> tuple[Resolution, ...]:
    """The shapes at one network size, longer side first.

    Sizes that were never published get the aspect ratios of 512, with the shorter side rounded to whole patches
    (halves to even): 256 gives 192, 160, 144, 128 and 80.

    Raises:
        ValueError: ``size`` is no positive multiple of 16.
    """
    if size in RESOLUTIONS:
        return RESOLUTIONS[size]
    if size < PATCH_SIZE or size % PATCH_SIZE:
        raise ValueError(f"network size {size}: a multiple of {PATCH_SIZE} is needed")
    patches = (max(1, round(size * shorter / longer / PATCH_SIZE)) for longer, shorter in RESOLUTIONS[512])
    return tuple((size, PATCH_SIZE * n) for n in dict.fromkeys(patches))


def choose_window(width: int, height: int, resolutions: Sequence[Resolution]) -> NetworkWindow:
    """The nearest shape in the orientation of the image, and the largest centred crop of that shape.

    What `preprocess` does, without its pixels: a plan needs no more.

    Args:
        width, height: of the original image.
        resolutions: to choose from, longer side first; see `resolutions_of`.
    """
    longer, shorter = _nearest_resolution(width, height, resolutions)
    out_width, out_height = (longer, shorter) if width >= height else (shorter, longer)
    ratio = out_width / out_height
    crop_width, crop_height = width, height
    if abs(width / height - ratio) > np.finfo(np.float32).eps:
        if width / height < ratio:
            crop_height = max(1, int(width / ratio))
        else:
            crop_width = max(1, int(height * ratio))
    return NetworkWindow(
        width_orig=width,
        height_orig=height,
        left=round((width - crop_width) / 2),  # halves to even, as published
        top=round((height - crop_height) / 2),
        crop_width=crop_width,
        crop_height=crop_height,
        width=out_width,
        height=out_height,
    )


def _nearest_resolution(width: int, height: int, resolutions: Sequence[Resolution]) -> Resolution:
    if (max(width, height), min(width, height)) in resolutions:
        return max(width, height), min(width, height)
    if width >= height:
        return min(resolutions, key=lambda sides: abs(width / height - sides[0] / sides[1]))
    return min(resolutions, key=lambda sides: abs(width / height - sides[1] / sides[0]))


def _resized(photo: UInt8Array, height: int, width: int) -> Tensor:
    """(H, W, 3) uint8 -> (3, height, width) in [-1, 1], bilinear with antialiasing, half-pixel centres.

    The filter is separable and goes along the rows first, so that a few rows at a time give the same bits as all.
    """
    if photo.shape[:2] == (height, width):
        return _normalised(photo)
    narrow = [
        _interpolated(_normalised(photo[row : row + ROWS_AT_A_TIME]), width=width)
        for row in range(0, photo.shape[0], ROWS_AT_A_TIME)
    ]
    return _interpolated(torch.cat(narrow, dim=1), height=height)


def _interpolated(pixels: Tensor, *, height: int | None = None, width: int | None = None) -> Tensor:
    """(3, H, W) -> (3, height, width); a side that is not given stays."""
    size = (height or pixels.shape[1], width or pixels.shape[2])
    return torch.nn.functional.interpolate(pixels[None], size=size, mode="bilinear", antialias=True)[0]


def _normalised(photo: UInt8Array) -> Tensor:
    """(H, W, 3) uint8 -> (3, H, W) float32 in [-1, 1]."""
    channels = np.ascontiguousarray(photo.transpose(2, 0, 1))
    return torch.from_numpy(channels).float().div_(255).sub_(0.5).div_(0.5)


def _rgb(image: UInt8Array | Image.Image) -> UInt8Array:
    """(H, W, 3) uint8."""
    photo = np.asarray(image.convert("RGB") if isinstance(image, Image.Image) else image)
    if photo.ndim != 3 or photo.shape[2] != 3 or photo.dtype != np.uint8 or photo.size == 0:
        raise ValueError(f"image of shape {photo.shape} and type {photo.dtype}; (H, W, 3) uint8 is needed")
    return photo
