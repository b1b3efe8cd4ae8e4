"""Pixels: the single place where an image file is decoded.

Whatever lies on disk (grey, palette, alpha, CMYK, 16 bit, turned by EXIF) comes out upright with 8 bits:

- Alpha is dropped from the pixels, as COLMAP does; ``load_alpha`` gives it as a mask. Of files with several pages or
  frames the first is taken.
- 16-bit data is scaled by the number of bits in use (8, 10, 12, 14 or 16), so that 12-bit data in a 16-bit file does
  not come out black. ``inspect`` finds it from the brightest pixel; all images of a camera are scaled by the largest
  number among them, for else neighbours would differ in brightness. There is no stretching beyond that.
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
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
from PIL import ExifTags
from PIL.AvifImagePlugin import AvifImageFile
from PIL.BmpImagePlugin import BmpImageFile
from PIL.GifImagePlugin import GifImageFile
from PIL.Image import DecompressionBombError, Image
from PIL.ImageFile import ImageFile
from PIL.Jpeg2KImagePlugin import Jpeg2KImageFile
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile
from PIL.TiffImagePlugin import TiffImageFile
from PIL.WebPImagePlugin import WebPImageFile

from smust3r_colmap.errors import ImageError
from smust3r_colmap.geometry.arrays import UInt8Array
from smust3r_colmap.importers.camera_prior import CameraTags, read_camera_tags
from smust3r_colmap.products import SourceImage

logger = logging.getLogger(__name__)


SUFFIXES = (
    *(".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff"),
    *(".jpe", ".jfif", ".bmp", ".gif", ".jp2", ".j2k", ".avif", ".heic", ".heif"),
)
"""Of files taken for images, in any case; what is inside is told by the content."""

UNREAD_SUFFIXES = frozenset(
    {
        *(
            ".dng",
            ".cr2",
            ".cr3",
            ".nef",
            ".nrw",
            ".arw",
            ".srf",
            ".sr2",
            ".raf",
            ".orf",
            ".rw2",
            ".pef",
            ".raw",
            ".x3f",
        ),
        *(
            ".exr",
            ".hdr",
            ".pfm",
            ".psd",
            ".psb",
            ".xcf",
            ".jxl",
            ".jxr",
            ".tga",
            ".pgm",
            ".ppm",
            ".pnm",
            ".ico",
            ".svg",
        ),
    }
)
"""Of images that are not read: raw data of cameras, floating-point images, projects of programs."""

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
    (b"BM", BmpImageFile),
    (b"GIF8", GifImageFile),
    (b"\0\0\0\x0cjP  \r\n\x87\n", Jpeg2KImageFile),
    (b"\xff\x4f\xff\x51", Jpeg2KImageFile),
)
"""By the first bytes. Opening the classes directly, not through ``Image.open``, keeps Pillow's other fifty
formats away from files of unknown origin, and its process-wide pixel limit untouched."""

_DECODE_ERRORS = (
    *(OSError, EOFError, SyntaxError, ValueError, TypeError, KeyError, IndexError, AttributeError),
    *(ArithmeticError, RuntimeError, MemoryError, struct.error, zlib.error, cv2.error, DecompressionBombError),
)
"""What Pillow's parsers and OpenCV have been seen to raise on damaged files."""

_AVIF_BRANDS = frozenset({b"avif", b"avis"})
"""In bytes 8 to 11 of an ISO base media file; the others that are images are HEIF."""
_END_OF_JPEG = b"\xff\xd9"
_NO_END = "cannot be decoded: damaged, cut off (the JPEG has no end marker)"
_FILLER = b"\0" * 4096
"""Behind complete pixels of a JPEG it changes nothing; behind pixels that were cut off it is taken for their rest."""
MIN_ALPHA = 128
"""Of 255; what is less opaque is left out."""

_MODES_8_BIT = frozenset({"1", "L", "LA", "La", "P", "PA", "RGB", "RGBA", "RGBX", "RGBa", "CMYK", "YCbCr"})


@dataclass(frozen=True, kw_only=True)
class Photo:
    """What is known of a file that decodes.

    Args:
        width, height: in pixels, upright.
        tags: the camera according to EXIF.
        deep: there are more than 8 bits a channel. bits: of them in use, 8 to 16.
        transparent: part of the pixels that alpha leaves out.
        exif_unreadable: there is EXIF, and it cannot be read.
        orientation: EXIF orientation 1 to 8 that was applied; 1 is upright.
    """

    width: int
    height: int
    tags: CameraTags
    deep: bool = False
    bits: int = 8
    transparent: float = 0.0
    exif_unreadable: bool = False
    orientation: int = 1

    @property
    def stored_size(self) -> tuple[int, int]:
        """Width and height of the pixels as they lie in the file."""
        return (self.height, self.width) if self.orientation in TURNED_SIDEWAYS else (self.width, self.height)


def load_rgb(image: SourceImage) -> UInt8Array:
    """(H, W, 3) upright pixels of one image, or as stored where only that is of the image's size.

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


def load_small(path: Path, side_px: int) -> UInt8Array:
    """(H, W, 3) upright pixels for people, of a JPEG at an eighth of the size at least; the longer side is not shorter
    than ``side_px`` unless that of the file is. More than 8 bits are scaled by those in use in this file.

    Raises:
        ImageError: the file cannot be read; the message is the reason alone.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ImageError(f"cannot be read: {error.strerror}") from error
    with _damage_refused():
        image = open_image(data)
        width, height = image.size
        _check_size(width, height)
        if isinstance(image, JpegImageFile):
            factor = min(1.0, side_px / max(width, height))
            image.draft("RGB", (round(width * factor), round(height * factor)))
        with _LARGE_IMAGE_TURN if width * height > _LARGE_MEGAPIXELS * 1e6 else nullcontext():
            return _decode(image, data, grey=False, orientation=orientation_to_apply(image), bits=None)


def load_alpha(image: SourceImage) -> UInt8Array | None:
    """(H, W), 255 where the image is opaque and 0 where it is not; None where it has no alpha.

    Raises:
        ImageError: as ``load_rgb``.
    """
    data = _read(image)
    with _named(image), _damage_refused():
        opened = open_image(data)
        orientation = _orientation_for(opened, image)
        alpha = _alpha(opened)
        if alpha is None:
            return None
        kept = np.where(alpha >= MIN_ALPHA, 255, 0).astype(np.uint8)
        return _of_size(np.ascontiguousarray(_UPRIGHT[orientation](kept)), image)


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
        image = open_image(data)
        width, height = upright_size(image)
        _check_size(width, height)
        tags = _camera_tags(image)
        orientation = orientation_to_apply(image)
        with _LARGE_IMAGE_TURN if width * height > _LARGE_MEGAPIXELS * 1e6 else nullcontext():
            deep, bits = _is_deep(image, data), _check_decodes(image, data)
            alpha = _alpha(image)
    return Photo(
        width=width,
        height=height,
        tags=tags or CameraTags(),
        deep=deep,
        bits=bits,
        transparent=0.0 if alpha is None else float((alpha < MIN_ALPHA).mean()),
        exif_unreadable=tags is None,
        orientation=orientation,
    )


@dataclass(frozen=True, kw_only=True)
class ImageHead:
    """What the head of a file says.

    Args:
        kind: Pillow's name of the format; MPO for a JPEG of phones with a second image behind.
        mode: Pillow's name of the kind of its pixels.
        size: width and height as stored.
        orientation: by EXIF, 1 to 8.
        deep: more than 8 bits a channel.
        has_alpha: pixels may be transparent.
    """

    kind: str
    mode: str
    size: tuple[int, int]
    orientation: int
    deep: bool
    has_alpha: bool


def look_at_head(data: bytes) -> ImageHead:
    """No pixel is decoded.

    Args:
        data: content of the file.

    Raises:
        ImageError: no image that is read; the message is the reason alone.
    """
    with _damage_refused():
        image = open_image(data)
        return ImageHead(
            kind="MPO" if "mp" in image.info else image.format or "",
            mode=image.mode,
            size=image.size,
            orientation=orientation_to_apply(image),
            deep=_is_deep(image, data),
            has_alpha=image.has_transparency_data,
        )


def stored_size(data: bytes) -> tuple[int, int]:
    """Width and height as stored, whatever EXIF says of turning.

    No pixel is decoded, but the sums over the data of a PNG are compared.

    Args:
        data: content of the file.

    Raises:
        ImageError: no image, or one that is cut off; the message is the reason alone, as that of ``inspect``.
    """
    with _damage_refused():
        image = open_image(data)
        size = image.size
        image.verify()
    return size


def _load(source: SourceImage, *, grey: bool) -> UInt8Array:
    data = _read(source)
    with _named(source), _damage_refused():
        image = open_image(data)
        orientation = _orientation_for(image, source)
        pixels = _decode(image, data, grey=grey, orientation=orientation, bits=source.bits)
    return _of_size(pixels, source)


def _read(source: SourceImage) -> bytes:
    try:
        return source.path.read_bytes()
    except OSError as error:
        raise ImageError(f"{source.name}: cannot be read: {error.strerror}") from error


@contextmanager
def _named(source: SourceImage) -> Iterator[None]:
    """Put the name of the image before the reason."""
    try:
        yield
    except ImageError as error:
        raise ImageError(f"{source.name}: {error}") from error


def _orientation_for(image: ImageFile, source: SourceImage) -> int:
    """That of EXIF, but 1 where only the pixels as stored have the size of the source: its model is of these."""
    wanted = (source.width, source.height)
    return 1 if image.size == wanted != upright_size(image) else orientation_to_apply(image)


def _of_size(pixels: UInt8Array, source: SourceImage) -> UInt8Array:
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
def open_image(data: bytes) -> ImageFile:
    """Read the header only.

    Raises:
        ImageError: no image of a kind that is read; other errors where the header is damaged.
    """
    if not data:
        raise ImageError("the file is empty")
    for signature, plugin in _PLUGINS:
        if data.startswith(signature):
            return plugin(io.BytesIO(data + _END_OF_JPEG if plugin is JpegImageFile else data))
    if data[4:8] == b"ftyp":
        return AvifImageFile(io.BytesIO(data)) if data[8:12] in _AVIF_BRANDS else _open_heif(data)
    raise ImageError(
        f"no JPEG, PNG, WebP or TIFF image (starts with {data[:8]!r}), nor BMP, GIF, JPEG 2000, AVIF, HEIC"
    )


def _open_heif(data: bytes) -> ImageFile:
    try:
        from pillow_heif import HeifImageFile  # noqa: PLC0415  (optional)
    except ImportError as error:
        raise ImageError(
            "HEIC needs the package pillow-heif: pip install 'smust3r-colmap[heic]', or convert it to JPEG"
        ) from error
    opened: ImageFile = HeifImageFile(io.BytesIO(data))
    return opened


def upright_size(image: Image) -> tuple[int, int]:
    """Width and height once it is turned."""
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


def _camera_tags(image: ImageFile) -> CameraTags | None:
    """The tags; None where EXIF is broken, which says nothing about the pixels."""
    try:
        exif = image.getexif()
        # Pillow warns about a broken head, and returns nothing.
        return None if image.info.get("exif") and not len(exif) else read_camera_tags(exif)
    except _DECODE_ERRORS as error:
        logger.debug("unreadable EXIF: %s", error)
        return None


# ------------------------------------------------------------------------------ decoding
def _check_decodes(image: ImageFile, data: bytes) -> int:
    """Decode all; the number of bits in use."""
    if _is_deep(image, data):
        image.load()  # Pillow raises where data is missing; OpenCV fills with black.
        return _bits_in_use(_deep_values(data))
    _check_mode(image)
    if isinstance(image, JpegImageFile):
        _check_end(image, data)
        image.draft(image.mode, (image.width // 8, image.height // 8))
    image.load()
    return 8


def _check_end(image: JpegImageFile, data: bytes) -> None:
    """Refuse a JPEG without an end marker, unless all its pixels are there.

    They decode without an error also where the rest was filled with zeros, or never written; of progressive ones, whole
    scans may be missing without a trace.
    """
    pixels_start = image.fp.tell() if image.fp else 0  # The thumbnail in the header has an end of its own.
    if data.find(_END_OF_JPEG, pixels_start) >= 0:
        return
    if image.info.get("progressive"):
        raise ImageError(_NO_END)
    zeros = len(data) - len(data.rstrip(b"\0"))
    ended, filled = (_eighth(data + rest + _END_OF_JPEG) for rest in (b"", _FILLER))
    if zeros > 1 or not np.array_equal(ended, filled):
        raise ImageError(_NO_END)


def _eighth(data: bytes) -> UInt8Array:
    """The pixels of a JPEG at an eighth of the size."""
    image = JpegImageFile(io.BytesIO(data))
    image.draft("L", (image.width // 8, image.height // 8))
    return np.asarray(image.convert("L"))


def _alpha(image: ImageFile) -> UInt8Array | None:
    """(H, W) opacity of the stored pixels; None where the file has none."""
    if not image.has_transparency_data or image.mode not in _MODES_8_BIT:
        return None
    return np.asarray(image.convert("RGBA").getchannel("A"))


def _decode(image: ImageFile, data: bytes, *, grey: bool, orientation: int, bits: int | None) -> UInt8Array:
    """(H, W) or (H, W, 3) upright, contiguous and writeable."""
    if _is_deep(image, data):
        image.load()  # Pillow raises where data is missing; OpenCV fills with black.
        pixels = _decode_deep(data, grey=grey, bits=bits)
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


def _deep_values(data: bytes) -> npt.NDArray[np.uint16]:
    """(H, W) or (H, W, C) of a file with more than 8 bits a channel."""
    values = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if values is None:
        raise ImageError("OpenCV does not read this kind of 16-bit image; convert to 8 bit or to PNG")
    channels = 1 if values.ndim == 2 else values.shape[2]
    if values.dtype != np.uint16 or channels not in _GREY_FROM:
        raise ImageError(f"{channels} channels of {values.dtype} are not read; convert to 8 or 16 bit grey or RGB")
    return np.asarray(values, np.uint16)


def _decode_deep(data: bytes, *, grey: bool, bits: int | None) -> UInt8Array:
    """(H, W) or (H, W, 3), ``bits`` scaled to 0..255, rounding; of 16 bits, 65535 becomes 255, a division by 257."""
    values = _deep_values(data)
    channels = 1 if values.ndim == 2 else values.shape[2]
    conversion = (_GREY_FROM if grey else _RGB_FROM)[channels]
    converted = values if conversion is None else cv2.cvtColor(values, conversion)
    largest = (1 << (_bits_in_use(values) if bits is None else bits)) - 1
    return np.asarray(cv2.convertScaleAbs(converted, alpha=255 / largest), np.uint8)


_RGB_FROM = {1: cv2.COLOR_GRAY2RGB, 3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGB}
_GREY_FROM = {1: None, 3: cv2.COLOR_BGR2GRAY, 4: cv2.COLOR_BGRA2GRAY}
"""OpenCV's conversions by number of channels."""


def _bits_in_use(values: npt.NDArray[np.uint16]) -> int:
    """8, 10, 12, 14 or 16, from the brightest channel of a pixel; alpha, which is full, does not count."""
    colour = values[:, :, :3] if values.ndim == 3 and values.shape[2] == 4 else values
    peak = int(colour.max())
    return next(bits for bits in (8, 10, 12, 14, 16) if peak < 1 << bits)


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
