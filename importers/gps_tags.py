"""Where an image was taken, by what the camera wrote into it: EXIF, and XMP of DJI and of Pix4D's namespace.

XMP overrides EXIF, for it has more digits and signs. Its values stand in attributes, or in elements where a tool has
written the file again; both are read. Only the head of a file is read, and a broken one is a message, not an error.
EXIF does not say what its heights refer to, so nothing here does. EXIF's orientation is not a direction of gravity.

Source: EXIF 2.3, section 4.6.6; DJI's XMP as found in files; OpenDroneMap's ``opendm/photo.py`` for what is read.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median

from PIL import ExifTags
from PIL.ImageFile import ImageFile

from smust3r_colmap.errors import ImageError
from smust3r_colmap.importers.images import open_image
from smust3r_colmap.importers.survey import WGS84, ImagePosition, ImagePositions

_HEAD_BYTES = 1 << 20
"""Of a JPEG; its tags stand before its pixels. Other formats may have them at the end."""
_JPEG_START = b"\xff\xd8\xff"
_METRES_PER_DOP = 3.0
"""Horizontal error of a receiver without corrections, by dilution of precision; a usual value for the open sky."""
_NULL_ISLAND_DEG = 1e-6
"""A receiver without a fix writes latitude 0 and longitude 0."""
_NO_HEIGHT_M = 1.0
"""If most heights are larger than this, one of exactly 0 is a missing one."""

_BROKEN = (OSError, SyntaxError, ValueError, TypeError, KeyError, IndexError, AttributeError, ArithmeticError, EOFError)


@dataclass(frozen=True, kw_only=True)
class GpsTags:
    """The position in one image.

    Args:
        lat_deg, lon_deg: WGS 84; unsigned where ``assumed_sign``.
        height_m: as written, of unknown datum; None where there is none.
        relative_height_m: above take-off.
        sigma_h_m, sigma_v_m: as the receiver states them.
        up_cam: from gimbal angles.
        assumed_sign: EXIF does not say which hemisphere.
    """

    lat_deg: float
    lon_deg: float
    height_m: float | None = None
    relative_height_m: float | None = None
    sigma_h_m: float | None = None
    sigma_v_m: float | None = None
    up_cam: tuple[float, float, float] | None = None
    assumed_sign: bool = False


def read_image_positions(folder: Path, names: Iterable[str]) -> ImagePositions:
    """The positions in the tags of all images that have one.

    Images without GPS tags are left out in silence, broken ones with a message. One without hemisphere takes that of
    the others. A height of exactly 0 among others is a missing one.

    Args:
        folder: of the images. names: below it.
    """
    found: dict[str, GpsTags] = {}
    faults: list[str] = []
    for name in names:
        try:
            tags = read_gps_tags(_head(folder / name))
        except ImageError as error:
            faults.append(f"{name}: {error}; taken as without GPS")
            continue
        if tags is not None:
            found[name] = tags
    found, more = _completed(found)
    positions = tuple(_position(name, tags) for name, tags in found.items())
    return ImagePositions(crs=WGS84, crs_origin="EXIF", positions=positions, faults=(*faults, *more))


def read_gps_tags(data: bytes) -> GpsTags | None:
    """The position in an image file; None where it has none.

    Args:
        data: content of the file, or its head.

    Raises:
        ImageError: no image, broken tags, latitude and longitude 0 (no fix), or a position that is none; the message
            is the reason alone.
    """
    try:
        image = open_image(data)
        gps = image.getexif().get_ifd(ExifTags.IFD.GPSInfo)
        xmp = _xmp_values(image)
        tags = _merged(gps, xmp)
    except _BROKEN as error:
        raise ImageError(f"the GPS tags cannot be read ({error or type(error).__name__})") from error
    if tags is None:
        return None
    if not (abs(tags.lat_deg) <= 90 and abs(tags.lon_deg) <= 180):
        raise ImageError(f"latitude {tags.lat_deg:g}, longitude {tags.lon_deg:g} is no position")
    if abs(tags.lat_deg) < _NULL_ISLAND_DEG and abs(tags.lon_deg) < _NULL_ISLAND_DEG:
        raise ImageError("latitude 0 and longitude 0: the receiver had no fix")
    return tags


def _head(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD_BYTES)
            return head if head.startswith(_JPEG_START) else head + file.read()
    except OSError as error:
        raise ImageError(f"cannot be read: {error.strerror}") from error


def _position(name: str, tags: GpsTags) -> ImagePosition:
    return ImagePosition(
        image=name,
        x=tags.lon_deg,
        y=tags.lat_deg,
        z=tags.height_m,
        sigma_h_m=tags.sigma_h_m,
        sigma_v_m=tags.sigma_v_m,
        relative_z_m=tags.relative_height_m,
        up_cam=tags.up_cam,
        origin=name,
    )


def _completed(found: Mapping[str, GpsTags]) -> tuple[dict[str, GpsTags], list[str]]:
    """Signs and heights, by what the other images say."""
    known = [tags for tags in found.values() if not tags.assumed_sign]
    south = median(tags.lat_deg for tags in known) < 0 if known else False
    west = median(tags.lon_deg for tags in known) < 0 if known else False
    hemisphere = f"{'south' if south else 'north'} and {'west' if west else 'east'}"
    with_height = [tags.height_m for tags in found.values() if tags.height_m is not None]
    zero_is_missing = bool(with_height) and abs(median(with_height)) > _NO_HEIGHT_M
    completed, faults = {}, []
    for name, tags in found.items():
        changed = tags
        if tags.assumed_sign:
            lat, lon = abs(tags.lat_deg), abs(tags.lon_deg)
            changed = replace(changed, lat_deg=-lat if south else lat, lon_deg=-lon if west else lon)
            why = "as the other images" if known else "by assumption"
            faults.append(f"{name}: EXIF does not name the hemisphere; {hemisphere} is taken, {why}")
        if tags.height_m == 0 and zero_is_missing:
            changed = replace(changed, height_m=None)
            faults.append(f"{name}: a height of 0 among others is taken as missing")
        completed[name] = changed
    return completed, faults


# ---------------------------------------------------------------------------------- EXIF
def _merged(gps: Mapping[int, object], xmp: Mapping[str, str]) -> GpsTags | None:
    """XMP where it has a position, else EXIF."""
    exif = _exif_position(gps)
    written = _xmp_position(xmp)
    if written is not None:
        lat, lon, assumed = *written, False
    elif exif is not None:
        lat, lon, assumed = exif
    else:
        return None
    height = _number(xmp.get("drone-dji:AbsoluteAltitude"))
    sigma_h, sigma_v = _sigmas(gps, xmp)
    return GpsTags(
        lat_deg=lat,
        lon_deg=lon,
        height_m=_exif_height(gps) if height is None else height,
        relative_height_m=_number(xmp.get("drone-dji:RelativeAltitude")),
        sigma_h_m=sigma_h,
        sigma_v_m=sigma_v,
        up_cam=_up_of_xmp(xmp),
        assumed_sign=assumed,
    )


def _exif_position(gps: Mapping[int, object]) -> tuple[float, float, bool] | None:
    """Latitude, longitude, and whether a sign is missing."""
    latitude, longitude = gps.get(ExifTags.GPS.GPSLatitude), gps.get(ExifTags.GPS.GPSLongitude)
    if latitude is None or longitude is None:
        return None
    south, west = (
        _reference(gps.get(tag), negative, positive)
        for tag, negative, positive in (
            (ExifTags.GPS.GPSLatitudeRef, "S", "N"),
            (ExifTags.GPS.GPSLongitudeRef, "W", "E"),
        )
    )
    lat, lon = _degrees(latitude), _degrees(longitude)
    return (-lat if south else lat), (-lon if west else lon), south is None or west is None


def _reference(value: object, negative: str, positive: str) -> bool | None:
    """Whether it is the negative hemisphere; None where it is not said."""
    text = value.decode("ascii", "replace") if isinstance(value, bytes) else str(value or "")
    letter = text.strip("\0 ").upper()[:1]
    return letter == negative if letter in (negative, positive) else None


def _degrees(value: object) -> float:
    """Of degrees, minutes and seconds, each a fraction; fewer than three are enough."""
    parts = [float(part) for part in (value if isinstance(value, Sequence) else (value,))]  # type: ignore[arg-type]
    degrees = sum(part / unit for part, unit in zip(parts, (1, 60, 3600), strict=False))
    if not parts or not math.isfinite(degrees):
        raise ValueError(f"latitude or longitude {value!r}")
    return degrees


def _exif_height(gps: Mapping[int, object]) -> float | None:
    height = _number(gps.get(ExifTags.GPS.GPSAltitude))
    if height is None:
        return None
    reference = gps.get(ExifTags.GPS.GPSAltitudeRef)
    code = reference[0] if isinstance(reference, bytes) and reference else reference
    # EXIF 2.3: 1 is below sea level; EXIF 3.0: 1 and 3 are below.
    return -abs(height) if code in (1, 3) else height


def _sigmas(gps: Mapping[int, object], xmp: Mapping[str, str]) -> tuple[float | None, float | None]:
    """Horizontal and vertical, from the most exact statement that there is."""
    east, north, up = (_positive(xmp.get(f"drone-dji:RtkStd{axis}")) for axis in ("Lon", "Lat", "Hgt"))
    if east and north and _number(xmp.get("drone-dji:RtkFlag")) != 0:
        return max(east, north), up
    horizontal = _positive(xmp.get("Camera:GPSXYAccuracy"))
    if horizontal:
        return horizontal, _positive(xmp.get("Camera:GPSZAccuracy"))
    error = _positive(gps.get(ExifTags.GPS.GPSHPositioningError))
    if error:
        return error, None
    dilution = _positive(gps.get(ExifTags.GPS.GPSDOP))
    return (_METRES_PER_DOP * dilution if dilution else None), None


def _number(value: object) -> float | None:
    """A finite number, also as a fraction ``5/2`` or with a plus; None for anything else."""
    try:
        if isinstance(value, str) and "/" in value:
            above, below = value.split("/", 1)
            number = float(above) / float(below)
        else:
            number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) else None


def _positive(value: object) -> float | None:
    number = _number(value)
    return number if number is not None and number > 0 else None


# ----------------------------------------------------------------------------------- XMP
_ATTRIBUTE = re.compile(r"\b((?:drone-dji|Camera):\w+)\s*=\s*[\"']([^\"']*)[\"']")
_ELEMENT = re.compile(r"<((?:drone-dji|Camera):\w+)[^>]*>\s*([^<]*?)\s*</\1>")


def _xmp_values(image: ImageFile) -> dict[str, str]:
    """``prefix:Name`` to text, of both forms; the prefixes are those that cameras and tools write."""
    packet = image.info.get("xmp") or b""
    text = packet.decode("utf-8", "replace") if isinstance(packet, bytes) else str(packet)
    return {name: value.strip() for pattern in (_ELEMENT, _ATTRIBUTE) for name, value in pattern.findall(text)}


def _xmp_position(xmp: Mapping[str, str]) -> tuple[float, float] | None:
    """Latitude and longitude by DJI, with signs; names differ with the model, one with a misspelling of its own."""
    lat = _first(xmp, "GpsLatitude", "Latitude")
    lon = _first(xmp, "GpsLongitude", "GpsLongtitude", "Longitude")
    if lat is None or lon is None or (lat == 0 and lon == 0):
        return None
    return lat, lon


def _first(xmp: Mapping[str, str], *names: str) -> float | None:
    return next((one for name in names if (one := _number(xmp.get(f"drone-dji:{name}"))) is not None), None)


def _up_of_xmp(xmp: Mapping[str, str]) -> tuple[float, float, float] | None:
    """DJI counts pitch from the horizon (looking down is -90), Pix4D's namespace from looking down."""
    pitch, roll = (_number(xmp.get(f"drone-dji:Gimbal{axis}Degree")) for axis in ("Pitch", "Roll"))
    if pitch is not None:
        return up_in_camera(pitch, roll or 0.0)
    pitch, roll = (_number(xmp.get(f"Camera:{axis}")) for axis in ("Pitch", "Roll"))
    return None if pitch is None else up_in_camera(pitch - 90, roll or 0.0)


def up_in_camera(pitch_deg: float, roll_deg: float) -> tuple[float, float, float]:
    """Unit vector upwards in the frame of a camera (x right, y down, z forward).

    Args:
        pitch_deg: of the optical axis above the horizon. roll_deg: about it, clockwise as the camera sees it.
    """
    pitch, roll = math.radians(pitch_deg), math.radians(roll_deg)
    return -math.sin(roll) * math.cos(pitch), -math.cos(roll) * math.cos(pitch), math.sin(pitch)
