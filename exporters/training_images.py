"""The pixels of a training dataset: undistorted images and masks, and smaller copies of them.

A file that trainers can use as it is (a JPEG or PNG of a centred pinhole, 8-bit RGB, upright) is copied byte by byte.
All others are decoded, resampled once and encoded again. JPEG stays JPEG and all other formats become PNG. Grey images
become RGB: gsplat and the original 3D Gaussian Splatting expect three channels. The next module to read is
``inverse_depth``.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from pathlib import Path, PurePosixPath

import cv2
import numpy as np
import numpy.typing as npt

from smust3r_colmap.errors import ImageError, InputError
from smust3r_colmap.execution.task_pool import usable_cores
from smust3r_colmap.exporters.centred_pinhole import CentredPinhole, resampled
from smust3r_colmap.geometry.arrays import UInt8Array
from smust3r_colmap.importers.images import TURNED_SIDEWAYS, load_alpha, load_rgb, look_at_head
from smust3r_colmap.importers.masks import find_mask, load_mask
from smust3r_colmap.products import SourceImage

JPEG_PARAMS = (
    *(cv2.IMWRITE_JPEG_QUALITY, 97),
    *(cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444),
)
"""Little more is lost than the original JPEG has lost already, and colour keeps its full resolution."""
PNG_PARAMS = (cv2.IMWRITE_PNG_COMPRESSION, 3)
"""Twice as fast as the usual 6, for files some percent larger."""
MAX_THREADS = 8
"""Every thread holds an image, its lookup and the result: 0.4 GB at 24 megapixels."""
IMAGES_PER_LOOKUP = 16
"""Images that one thread takes at a time; they share the lookup of their camera."""

_Lookup = npt.NDArray[np.float32] | None


@dataclass(frozen=True, kw_only=True)
class TrainingImage:
    """One image on its way into the folder.

    Args:
        source: the file; its size is the camera's.
        suffix: of the new file, ``.jpg`` or ``.png``.
        camera: of the file, and the pinhole that replaces it.
        verbatim: the file is copied as it is.
        transparent: some of its pixels are.
    """

    source: SourceImage
    suffix: str
    camera: CentredPinhole
    verbatim: bool
    transparent: bool = False


# ----------------------------------------------------------------------------- looking
def look_at_image(images: Path, name: str, camera: CentredPinhole, *, bits: int | None = None) -> TrainingImage:
    """Read the head of an image file and compare it with its camera.

    Args:
        bits: as in ``SourceImage``.

    Raises:
        ImageError: there is no such file, it is no image, or it has another size than the camera.
    """
    path = images / name
    width, height = camera.original.width, camera.original.height
    try:
        head = look_at_head(path.read_bytes())
    except FileNotFoundError as error:
        raise ImageError(f"{name}: there is no such file in {images}; give the folder the model was made of") from error
    except OSError as error:
        raise ImageError(f"{name}: cannot be read ({error.strerror})") from error
    except ImageError as error:
        raise ImageError(f"{name}: cannot be read as JPEG, PNG, WebP or TIFF ({error})") from error
    size, sideways = head.size, head.orientation in TURNED_SIDEWAYS
    upright = size if size == (width, height) or not sideways else size[::-1]
    if upright != (width, height):
        turned = f" (stored as {size[0]}x{size[1]}, turned by its EXIF orientation)" if sideways else ""
        raise ImageError(
            f"{name}: the file is {upright[0]}x{upright[1]} px{turned} and its camera {width}x{height};"
            " give the images that the model was made of"
        )
    source = SourceImage(name=name, path=path, width=width, height=height, camera=0, digest="", bits=bits)
    plain = head.kind in ("JPEG", "PNG") and head.mode == "RGB" and not head.deep and head.orientation == 1
    alpha = load_alpha(source) if head.has_alpha else None
    return TrainingImage(
        source=source,
        suffix=".jpg" if head.kind in ("JPEG", "MPO") else ".png",
        camera=camera,
        verbatim=plain and camera.is_identity,
        transparent=alpha is not None and bool((alpha == 0).any()),
    )


# ----------------------------------------------------------------------------- writing
def write_images(images: Sequence[tuple[TrainingImage, str]], folder: Path, scales: Sequence[int]) -> None:
    """Write ``images/<new name>`` and, for each scale, ``images_<scale>/<new name>`` below ``folder``.

    Smaller copies are means over areas; width and height are divided and rounded down, as nerfstudio expects.

    Args:
        images: each with its new name.
        folder: exists.
        scales: such as (2, 4).

    Raises:
        ImageError: a file no longer decodes.
        OSError: the disk refused.
    """
    _make_folders(folder, "images", scales)
    _each_camera_at_once(images, partial(_write_image, folder, scales))


def write_masks(
    images: Sequence[tuple[TrainingImage, str]], masks: Path | None, folder: Path, scales: Sequence[int]
) -> tuple[str, ...]:
    """Write the masks below ``folder`` in both naming rules, for nerfstudio and Brush, and for COLMAP.

    ``masks/<new stem>.png`` and ``masks/<new name>.png`` are the same; white is kept. What is not black in the
    original is kept, as in COLMAP. An image without a mask file gets that of its alpha, else a white one:
    nerfstudio wants all or none.

    Returns:
        Names in the model of the images without a mask.

    Raises:
        ImageError: a mask does not decode, or has another size than its image.
        OSError: the disk refused.
    """
    _make_folders(folder, "masks", scales)
    _each_camera_at_once(images, partial(_write_mask, masks, folder, scales))
    whole = [image for image, _ in images if not image.transparent and _mask_file(masks, image) is None]
    return tuple(image.source.name for image in whole)


def encoded(suffix: str, pixels: npt.NDArray[np.uint8] | npt.NDArray[np.uint16]) -> bytes:
    """The content of an image file; in memory, because OpenCV does not tell when a disk is full."""
    _, data = cv2.imencode(suffix, pixels, JPEG_PARAMS if suffix == ".jpg" else PNG_PARAMS)
    return data.tobytes()


def _make_folders(folder: Path, kind: str, scales: Sequence[int]) -> None:
    for name in (kind, *(f"{kind}_{scale}" for scale in scales)):
        (folder / name).mkdir()


def _each_camera_at_once(
    images: Sequence[tuple[TrainingImage, str]], write: Callable[[TrainingImage, str, _Lookup], None]
) -> None:
    """Call ``write`` on every image from several threads; images of one camera share its lookup."""
    chunks = []
    by_camera = sorted(images, key=lambda entry: id(entry[0].camera))
    for _, group in groupby(by_camera, key=lambda entry: id(entry[0].camera)):
        of_camera = list(group)
        chunks += [of_camera[k : k + IMAGES_PER_LOOKUP] for k in range(0, len(of_camera), IMAGES_PER_LOOKUP)]

    def work(chunk: list[tuple[TrainingImage, str]]) -> None:
        camera = chunk[0][0].camera
        lookup = None if camera.is_identity else camera.lookup()
        for image, name in chunk:
            write(image, name, lookup)

    with ThreadPoolExecutor(min(usable_cores(), MAX_THREADS)) as pool:
        for _ in pool.map(work, chunks):
            pass


def _write_image(folder: Path, scales: Sequence[int], image: TrainingImage, name: str, lookup: _Lookup) -> None:
    if image.verbatim:
        shutil.copyfile(image.source.path, folder / "images" / name)
    if not image.verbatim or scales:
        rgb = load_rgb(image.source)
        bgr = np.ascontiguousarray((rgb if lookup is None else resampled(rgb, lookup))[:, :, ::-1])
        if not image.verbatim:
            (folder / "images" / name).write_bytes(encoded(image.suffix, bgr))
        for scale in scales:
            smaller = _smaller(bgr, scale, cv2.INTER_AREA)
            (folder / f"images_{scale}" / name).write_bytes(encoded(image.suffix, smaller))


def _write_mask(
    masks: Path | None,
    folder: Path,
    scales: Sequence[int],
    image: TrainingImage,
    name: str,
    lookup: _Lookup,
) -> None:
    mask = _kept(masks, image)
    kept = mask if lookup is None else resampled(mask, lookup, nearest=True)
    names = (PurePosixPath(name).with_suffix(".png").name, f"{name}.png")
    for below, pixels in (
        ("masks", kept),
        *((f"masks_{scale}", _smaller(kept, scale, cv2.INTER_NEAREST)) for scale in scales),
    ):
        content = encoded(".png", pixels)
        for mask_name in names:
            (folder / below / mask_name).write_bytes(content)


def _kept(masks: Path | None, image: TrainingImage) -> UInt8Array:
    """(H, W) of the original image, 255 where it is kept."""
    path = _mask_file(masks, image)
    if path is not None:
        return load_mask(path, image.source)
    alpha = load_alpha(image.source) if image.transparent else None
    return np.full((image.source.height, image.source.width), 255, np.uint8) if alpha is None else alpha


def _mask_file(masks: Path | None, image: TrainingImage) -> Path | None:
    return None if masks is None else find_mask(masks, image.source.name)


def _smaller(pixels: UInt8Array, scale: int, how: int) -> UInt8Array:
    height, width = pixels.shape[:2]
    return np.asarray(cv2.resize(pixels, (width // scale, height // scale), interpolation=how), np.uint8)


def check_scales(scales: Sequence[int], images: Sequence[TrainingImage]) -> None:
    """Refuse scales that are no whole numbers from 2 on, repeat, or leave nothing of the smallest image.

    Raises:
        InputError: naming the scale.
    """
    shortest = min(min(image.camera.size) for image in images)
    for scale in scales:
        if scale < 2 or scale > shortest or scales.count(scale) > 1:
            raise InputError(
                f"trainer scale {scale}: needed are different whole numbers from 2 to {shortest}, such as 2, 4, 8"
            )
