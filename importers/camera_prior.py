"""What EXIF says about the camera, and the focal length that follows from it.

COLMAP reads a focal length from EXIF too, but takes the focal plane resolution as that of the file at
hand: a photo of 4000 pixels shrunk to 1024 comes out with a focal length four times too long. Here the
resolution is referred to the size that EXIF names, and pycolmap is asked for its sensor sizes only.
Next: ``images``, which decodes the files.
"""

from __future__ import annotations

import math
import tempfile
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pycolmap
from PIL import ExifTags, Image
from PIL.TiffImagePlugin import IFDRational

from smust3r_colmap.errors import StorageError

DEFAULT_FOCAL_RATIO = 1.2
"""Focal length by longer side of an unknown camera; COLMAP's default."""

PLAUSIBLE_FOCAL_RATIO = (0.1, 10.0)
"""Focal length by longer side beyond which a tag is taken for a mistake; COLMAP's own bounds."""

_FILM_DIAGONAL_MM = 43.27
_MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
"""EXIF FocalPlaneResolutionUnit: inch, centimetre, millimetre, micrometre."""


@dataclass(frozen=True, kw_only=True)
class CameraTags:
    """The EXIF of one photo as far as it tells cameras apart; empty or None where EXIF is silent.

    Args:
        make, model: of the camera.
        focal_mm: focal length of the lens.
        focal_35mm: focal length of equal diagonal field of view on 35 mm film.
        sensor_mm: longer side of the sensor, from the focal plane resolution.
        digital_zoom: the image is a crop of the sensor, enlarged by this; focal lengths do not say so.
    """

    make: str = ""
    model: str = ""
    focal_mm: float | None = None
    focal_35mm: float | None = None
    sensor_mm: float | None = None
    digital_zoom: float | None = None


def read_camera_tags(exif: Image.Exif) -> CameraTags:
    """The tags of one photo; a tag that is no positive number counts as absent."""
    details = exif.get_ifd(ExifTags.IFD.Exif)
    return CameraTags(
        make=_text(exif.get(ExifTags.Base.Make)),
        model=_text(exif.get(ExifTags.Base.Model)),
        focal_mm=_positive(details.get(ExifTags.Base.FocalLength)),
        focal_35mm=_positive(details.get(ExifTags.Base.FocalLengthIn35mmFilm)),
        sensor_mm=_sensor_mm(
            width_px=_positive(details.get(ExifTags.Base.ExifImageWidth)),
            height_px=_positive(details.get(ExifTags.Base.ExifImageHeight)),
            px_per_unit=_positive(details.get(ExifTags.Base.FocalPlaneXResolution)),
            # EXIF 2.3, 4.6.5: the unit is inches where the tag is missing.
            unit=details.get(ExifTags.Base.FocalPlaneResolutionUnit, 2),
        ),
        digital_zoom=_positive(details.get(ExifTags.Base.DigitalZoomRatio)),
    )


def focal_prior_px(tags: CameraTags, width: int, height: int) -> float | None:
    """Focal length in pixels of an image of ``width`` x ``height``, or None where EXIF does not tell.

    In this order: the 35 mm equivalent over the diagonal (CIPA DCG-001), the focal length over the
    sensor size of COLMAP's camera database, the same over the focal plane resolution. The latter two are times the
    digital zoom; phones differ in whether the first has it. A result outside ``PLAUSIBLE_FOCAL_RATIO`` is dropped.
    """
    longer = max(width, height)
    if tags.focal_35mm is not None:
        focal = tags.focal_35mm / _FILM_DIAGONAL_MM * math.hypot(width, height)
    elif tags.focal_mm is not None:
        sensor_mm = database_sensor_mm(tags.make, tags.model) or tags.sensor_mm
        if sensor_mm is None:
            return None
        focal = tags.focal_mm / sensor_mm * longer * (tags.digital_zoom or 1.0)
    else:
        return None
    low, high = PLAUSIBLE_FOCAL_RATIO
    return focal if low * longer <= focal <= high * longer else None


@cache
def database_sensor_mm(make: str, model: str) -> float | None:
    """Longer side of the sensor in COLMAP's camera database, or None for a camera it does not have.

    pycolmap shows the database only through an image file, so a blank one of 1000 pixels with a lens
    of 100 mm is written: sensor = 100 mm * 1000 px / focal px.

    Raises:
        StorageError: the temporary folder cannot be written.
    """
    if not make or not model:
        return None
    longer, focal_mm = 1000, 100
    exif = Image.Exif()
    exif[ExifTags.Base.Make], exif[ExifTags.Base.Model] = make, model
    exif[ExifTags.IFD.Exif] = {ExifTags.Base.FocalLength: IFDRational(focal_mm)}
    try:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "probe.jpg"
            Image.new("L", (longer, 16)).save(path, exif=exif)
            camera = pycolmap.infer_camera_from_image(str(path))
    except OSError as error:
        raise StorageError(f"temporary folder: {error}; set TMPDIR to a folder that can be written") from error
    return focal_mm * longer / camera.mean_focal_length() if camera.has_prior_focal_length else None


def _sensor_mm(
    *, width_px: float | None, height_px: float | None, px_per_unit: float | None, unit: object
) -> float | None:
    mm_per_unit = _MM_PER_UNIT.get(unit) if isinstance(unit, int) else None
    if width_px is None or height_px is None or px_per_unit is None or mm_per_unit is None:
        return None
    return max(width_px, height_px) / px_per_unit * mm_per_unit


def _positive(tag: object) -> float | None:
    """The tag as a number; None unless it is finite and positive (0 and 0/0 mean unknown in EXIF)."""
    if not isinstance(tag, (int, float, IFDRational)):
        return None
    value = float(tag)
    return value if math.isfinite(value) and value > 0 else None


def _text(tag: object) -> str:
    return tag.replace("\0", "").strip() if isinstance(tag, str) else ""
