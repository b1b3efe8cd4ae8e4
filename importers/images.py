"""Pixels: the single place where an image file is decoded.

Whatever lies on disk (grey, palette, alpha, CMYK, 16 bit, turned by EXIF) comes out upright with 8 bits:

- Alpha is dropped, as COLMAP does. Of files with several pages or frames the first is taken.
- 16-bit data is scaled by the number of bits in use (8, 10, 12, 14 or 16, from the brightest pixel), so
  that 12-bit data in a 16-bit file does not come out black. There is no stretching beyond that.
- Floating-point pixels are refused, because their range is unknown.

Pillow decodes 8 bits, because it refuses files that end early; OpenCV decodes 16 bits, of which Pillow
keeps only the upper byte of colour images. Files are read into memory first: cv2 cannot open every path,
and the digest needs the bytes anyway. Next: ``image_folder``, which makes a collection of many files.
"""

from __future__ import annotations

import io
import logging
import struct
import threading
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from PIL import ExifTags
from PIL.Image import DecompressionBombError, Image
from PIL.ImageFile import ImageFile
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile
from PIL.TiffImagePlugin import TiffImageFile
from PIL.WebPImagePlugin import WebPImageFile

from smust3r_colmap.errors import ImageError
from smust3r_colmap.geometry.arrays import UInt8Array
from smust3r_colmap.importers.camera_prior import CameraTags, read_camera_tags
from smust3r_colmap.products import SourceImage

logger = logging.getLogger(__name__)


SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff")
"""Of files taken for images, in any case; what is inside is told by the content."""

TURNED_SIDEWAYS = frozenset({5, 6, 7, 8})
"""EXIF orientations that swap width and height (EXIF 2.3, 4.6.4 A)."""

MIN_SIDE_PX = 32
"""Smaller images hold no features; icons and tracking pixels lie in many folders."""

MAX_MEGAPIXELS = 500
"""Above any camera (phones reach 200); at 10 bytes a pixel, loading one takes 5 GB.
TIFF and WebP end at Pillow's own limit of 178."""

MAX_FILE_BYTES = 4 << 30
"""What 500 megapixels of 16-bit RGBA take without compression, and the limit of plain TIFF."""

_LARGE_MEGAPIXELS = 50
_LARGE_IMAGE_TURN = threading.Lock()
"""Only one image above ``_LARGE_MEGAPIXELS`` is checked at a time, whatever the number of threads."""

_PLUGINS: tuple[tuple[bytes, type[ImageFile]], ...] = (
    (b"\xff\xd8\xff", JpegImageFile),
    (b"\x89PNG\r\n\x1a\n", PngImageFile),
    (b"RIFF", WebPImageFile),
    (b"II*\0", TiffImageFile),
    (b"MM\0*", TiffImageFile),
)
"""By the first bytes. Opening the classes directly, not through ``Image.open``, keeps Pillow's other fifty
formats away from files of unknown origin, and its process-wide pixel limit untouched."""

_DECODE_ERRORS = (
    *(OSError, EOFError, SyntaxError, ValueError, TypeError, KeyError, IndexError, AttributeError),
    *(ArithmeticError, RuntimeError, MemoryError, struct.error, zlib.error, cv2.error, DecompressionBombError),
)
"""What Pillow's parsers and OpenCV have been seen to raise on damaged files."""

_MODES_8_BIT = frozenset({"1", "L", "LA", "La", "P", "PA", "RGB", "RGBA", "RGBX", "RGBa", "CMYK", "YCbCr"})


@dataclass(frozen=True, kw_only=True)
class Photo:
    """What is known of a file that decodes.

    Args:
        width, height: in pixels, upright.
        tags: the camera according to EXIF.
    """

    width: int
    height: int
    tags: CameraTags


def load_rgb(image: SourceImage) -> UInt8Array:
    """(H, W, 3) upright pixels of one image.

    Raises:
        ImageError: the file is gone, changed its size since the import, or no longer decodes.
    """
    return _load(image, grey=False)


def load_grey(image: SourceImage) -> UInt8Array:
    """(H, W) upright luma (ITU-R BT.601) of one image; from JPEG several times faster than colour.

    Raises:
        ImageError: as ``load_rgb``.
    """
    return _load(image, grey=True)


def inspect(data: bytes) -> Photo:
    """Decode all of an image file and say what it is.

    The pixels of a JPEG are made at an eighth of the size: all its data is still read, so a file cut off in
    the middle is found, in a fraction of the time and memory.

    Args:
        data: content of the file.

    Raises:
        ImageError: no image, damaged, cut off, too small, too large, or of a kind that is not read. The
            message is the reason alone; the caller knows the file.
    """
    with _damage_refused():
        image = _open(data)
        width, height = _upright_size(image)
        _check_size(width, height)
        tags = _camera_tags(image)
        with _LARGE_IMAGE_TURN if width * height > _LARGE_MEGAPIXELS * 1e6 else nullcontext():
            _check_decodes(image, data)
    return Photo(width=width, height=height, tags=tags)


def stored_size(data: bytes) -> tuple[int, int]:
    """Width and height as stored, whatever EXIF says of turning.

    No pixel is decoded, but the sums over the data of a PNG are compared.

    Args:
        data: content of the file.

    Raises:
        ImageError: no image, or one that is cut off; the message is the reason alone, as that of ``inspect``.
    """
    with _damage_refused():
        image = _open(data)
        size = image.size
        image.verify()
    return size


def _load(source: SourceImage, *, grey: bool) -> UInt8Array:
    try:
        data = source.path.read_bytes()
    except OSError as error:
        raise ImageError(f"{source.name}: cannot be read: {error.strerror}") from error
    try:
        with _damage_refused():
            pixels = _decode(_open(data), data, grey=grey)
    except ImageError as error:
        raise ImageError(f"{source.name}: {error}") from error
    height, width = pixels.shape[:2]
    if (width, height) != (source.width, source.height):
        raise ImageError(
            f"{source.name}: is {width}x{height} px now and was {source.width}x{source.height} at the import;"
            " run the import again"
        )
    return pixels


@contextmanager
def _damage_refused() -> Iterator[None]:
    """Turn what the decoders raise on damaged files into an ImageError."""
    try:
        yield
    except _DECODE_ERRORS as error:
        detail = str(error) or type(error).__name__
        raise ImageError(f"cannot be decoded: damaged, cut off or of an unusual kind ({detail})") from error


# ------------------------------------------------------------------------------ opening
def _open(data: bytes) -> ImageFile:
    """Read the header only."""
    if not data:
        raise ImageError("the file is empty")
    for signature, plugin in _PLUGINS:
        if data.startswith(signature):
            return plugin(io.BytesIO(data))
    raise ImageError(f"no JPEG, PNG, WebP or TIFF image (starts with {data[:8]!r})")


def _upright_size(image: ImageFile) -> tuple[int, int]:
    width, height = image.size
    return (height, width) if orientation_to_apply(image) in TURNED_SIDEWAYS else (width, height)


def _check_size(width: int, height: int) -> None:
    if min(width, height) < MIN_SIDE_PX:
        raise ImageError(f"{width}x{height} px; the shorter side must be at least {MIN_SIDE_PX}")
    megapixels = width * height / 1e6
    if megapixels > MAX_MEGAPIXELS:
        raise ImageError(f"{width}x{height} px are {megapixels:.0f} megapixels; at most {MAX_MEGAPIXELS} are read")


def orientation_to_apply(image: Image) -> int:
    """EXIF orientation 1 to 8 of the pixels as Pillow gives them; 1 is upright."""
    if isinstance(image, TiffImageFile):
        return 1  # Pillow and OpenCV turn TIFF themselves, in every mode.
    return stored_orientation(image)


def stored_orientation(image: Image) -> int:
    """EXIF orientation 1 to 8 of the pixels in the file; 1 where there is none or it is nonsense."""
    try:
        orientation = image.getexif().get(ExifTags.Base.Orientation, 1)
    except _DECODE_ERRORS as error:
        logger.debug("unreadable EXIF: %s", error)
        return 1
    return orientation if orientation in _UPRIGHT else 1


def _camera_tags(image: ImageFile) -> CameraTags:
    """The tags; none where EXIF is broken, which says nothing about the pixels."""
    try:
        return read_camera_tags(image.getexif())
    except _DECODE_ERRORS as error:
        logger.debug("unreadable EXIF: %s", error)
        return CameraTags()


# ------------------------------------------------------------------------------ decoding
def _check_decodes(image: ImageFile, data: bytes) -> None:
    if _is_deep(image, data):
        _decode(image, data, grey=True)
        return
    _check_mode(image)
    if isinstance(image, JpegImageFile):
        _check_end(image, data)
        image.draft(image.mode, (image.width // 8, image.height // 8))
    image.load()


def _check_end(image: JpegImageFile, data: bytes) -> None:
    """Refuse a JPEG whose rest was never written, but filled with zeros: they decode without an error."""
    end_of_image = b"\xff\xd9"
    pixels_start = image.fp.tell() if image.fp else 0  # The thumbnail in the header has an end of its own.
    if data.find(end_of_image, pixels_start) < 0:
        raise ImageError("cannot be decoded: damaged, cut off (the JPEG has no end marker)")


def _decode(image: ImageFile, data: bytes, *, grey: bool) -> UInt8Array:
    """(H, W) or (H, W, 3) upright, contiguous and writeable."""
    orientation = orientation_to_apply(image)
    if _is_deep(image, data):
        image.load()  # Pillow raises where data is missing; OpenCV fills with black.
        pixels = _decode_deep(data, grey=grey)
    else:
        _check_mode(image)
        mode = "L" if grey else "RGB"
        if isinstance(image, JpegImageFile):
            image.draft(mode, image.size)
        image.load()
        pixels = np.array(image if image.mode == mode else image.convert(mode))  # convert() would copy.
    return np.ascontiguousarray(_UPRIGHT[orientation](pixels))


def _check_mode(image: ImageFile) -> None:
    if image.mode not in _MODES_8_BIT:
        raise ImageError(f"pixels of kind {image.mode!r} are not read; convert to 8 or 16 bit grey or RGB")


def _is_deep(image: ImageFile, data: bytes) -> bool:
    """More than 8 bits a channel."""
    if isinstance(image, PngImageFile):
        return data[24] > 8  # PNG 11.2.1: signature 8, chunk head 8, width 4, height 4, bit depth.
    if isinstance(image, TiffImageFile):
        return bool(max(image.tag_v2.get(ExifTags.Base.BitsPerSample, (1,))) > 8)
    return False


def _decode_deep(data: bytes, *, grey: bool) -> UInt8Array:
    """(H, W) or (H, W, 3) of a file with more than 8 bits a channel."""
    values = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if values is None:
        raise ImageError("OpenCV does not read this kind of 16-bit image; convert to 8 bit or to PNG")
    channels = 1 if values.ndim == 2 else values.shape[2]
    if values.dtype != np.uint16 or channels not in _GREY_FROM:
        raise ImageError(f"{channels} channels of {values.dtype} are not read; convert to 8 or 16 bit grey or RGB")
    conversion = (_GREY_FROM if grey else _RGB_FROM)[channels]
    return _eight_bits(values if conversion is None else cv2.cvtColor(values, conversion))


_RGB_FROM = {1: cv2.COLOR_GRAY2RGB, 3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGB}
_GREY_FROM = {1: None, 3: cv2.COLOR_BGR2GRAY, 4: cv2.COLOR_BGRA2GRAY}
"""OpenCV's conversions by number of channels."""


def _eight_bits(values: npt.NDArray[Any]) -> UInt8Array:
    """Scale the bits in use to 0..255, rounding; of 16 bits, 65535 becomes 255, a division by 257."""
    peak = int(values.max())
    bits = next(bits for bits in (8, 10, 12, 14, 16) if peak < 1 << bits)
    return np.asarray(cv2.convertScaleAbs(values, alpha=255 / ((1 << bits) - 1)), np.uint8)


_UPRIGHT: Mapping[int, Callable[[UInt8Array], UInt8Array]] = {
    1: lambda stored: stored,
    2: lambda stored: stored[:, ::-1],
    3: lambda stored: stored[::-1, ::-1],
    4: lambda stored: stored[::-1],
    5: lambda stored: stored.swapaxes(0, 1),
    6: lambda stored: np.rot90(stored, -1),
    7: lambda stored: stored[::-1, ::-1].swapaxes(0, 1),
    8: np.rot90,
}
"""Upright from stored pixels by EXIF orientation (EXIF 2.3, 4.6.4 A)."""
