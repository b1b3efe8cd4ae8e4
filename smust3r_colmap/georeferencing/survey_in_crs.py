"""Records of a survey, brought into one CRS; those that do not fit are named and left out.

The next module to read is ``georeference``.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, TypeVar

import numpy as np

from smust3r_colmap.errors import InputError
from smust3r_colmap.geometry.arrays import BoolArray, FloatArray
from smust3r_colmap.georeferencing.crs import (
    Crs,
    egm96,
    is_in_area,
    lon_lat,
    parse_crs,
    transform,
    utm_zone,
    why_outside,
)
from smust3r_colmap.importers.survey import ImagePosition, ImagePositions, SurveyPoint, SurveyPoints

Altitude = Literal["auto", "ellipsoid", "egm96", "relative", "none"]

LOCAL = "local"
"""The header of lists in the coordinates of a site, which are in no CRS."""
FAR_M = 50_000.0
"""From the median of all positions; no job is as large."""
_MANY = 3
"""Records of images without pose that are named one by one."""

Record = TypeVar("Record", ImagePosition, SurveyPoint)


class ImageNames:
    """Names of images as lists write them: exactly, or by what is unique below the folders, in any case.

    Args:
        names: of the model, in the order of its images.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self._exact = {name: k for k, name in enumerate(names)}
        self._base: dict[str, int | None] = {}
        for k, name in enumerate(names):
            key = _base(name)
            self._base[key] = None if key in self._base else k

    def find(self, name: str) -> int | None:
        """The index of an image; None where it is not there, or several are."""
        found = self._exact.get(name)
        return self._base.get(_base(name)) if found is None else found


def _base(name: str) -> str:
    return name.replace("\\", "/").rsplit("/", 1)[-1].casefold()


@dataclass(frozen=True, kw_only=True, eq=False)
class Placed:
    """Records in the CRS of the result.

    Args:
        records: those that are left, as they were read. xyz: (N, 3) in the CRS, NaN where there is no height.
    """

    records: tuple[ImagePosition | SurveyPoint, ...]
    xyz: FloatArray


def crs_of_positions(positions: ImagePositions, altitude: Altitude) -> Crs | None:
    """With what heights refer to, where the user says so; None for coordinates of a site."""
    if is_local(positions.crs):
        return None
    crs = parse_crs(positions.crs, positions.crs_origin)
    if crs.has_vertical or altitude not in ("ellipsoid", "egm96"):
        return crs
    return Crs(
        horizontal=crs.horizontal,
        vertical=egm96() if altitude == "egm96" else None,
        ellipsoidal=altitude == "ellipsoid",
        origin=crs.origin,
    )


def crs_of_points(points: SurveyPoints) -> Crs | None:
    """None for coordinates of a site."""
    return None if is_local(points.crs) else parse_crs(points.crs, points.crs_origin)


def is_local(text: str) -> bool:
    """Whether a header says that coordinates are in no CRS."""
    return text.strip().casefold() == LOCAL


def target_crs(wanted: str, sources: Sequence[tuple[Crs, FloatArray]], faults: list[str]) -> Crs:
    """The projection in metres of the result, with the vertical datum of the first source that has one.

    Args:
        wanted: a CRS, or auto: that of the first source, or the zone of UTM where that is in degrees.
        sources: CRS and coordinates (N, 3), control points before positions.
        faults: gets a message where heights of unknown datum are taken as those of the result.

    Raises:
        InputError: the CRS is none, is in degrees, or is not made for the place.
    """
    first, xyz = sources[0]
    if wanted != "auto":
        crs = parse_crs(wanted, "--crs")
    elif first.in_degrees:
        crs = utm_zone(*np.median(lon_lat(xyz, first), axis=0).tolist())
    else:
        crs = first
    if crs.in_degrees:
        raise InputError(f"{crs.origin}: {wanted} is in degrees; name a projection in metres, such as EPSG:25832")
    if not is_in_area(transform(xyz, _flat(first), _flat(crs)), crs).any():
        lon, lat = np.median(lon_lat(xyz, first), axis=0)
        raise InputError(
            f"{crs.origin}: {crs.title} is not made for the place, longitude {lon:.4f}, "
            f"latitude {lat:.4f} (by {first.name}, {first.origin})"
        )
    if crs.has_vertical and not first.has_vertical and np.isfinite(xyz[:, 2]).any():
        faults.append(
            f"{first.origin}: it is not said what the heights refer to; they are taken as {crs.vertical_name}, of --crs"
        )
    known = next((source for source, _ in sources if source.has_vertical), None)
    return crs.with_vertical_of(known) if known is not None and not crs.has_vertical else crs


def _flat(crs: Crs) -> Crs:
    """Without what heights refer to."""
    return Crs(horizontal=crs.horizontal, origin=crs.origin)


def coordinates(records: Iterable[ImagePosition | SurveyPoint]) -> FloatArray:
    """(N, 3) as read; NaN where there is no height."""
    rows = [(one.x, one.y, np.nan if one.z is None else one.z) for one in records]
    return np.array(rows, dtype=np.float64).reshape(-1, 3)


def in_area(records: Sequence[Record], crs: Crs | None, faults: list[str]) -> list[Record]:
    """Those that lie where their CRS is made for; the others are named."""
    if crs is None or not records:
        return list(records)
    inside = is_in_area(coordinates(records), crs)
    for record, ok in zip(records, inside, strict=True):
        if not ok:
            faults.append(f"{record.origin}: left out: {why_outside(record.x, record.y, crs)}")
    return [record for record, ok in zip(records, inside, strict=True) if ok]


def near_the_others(xyz: FloatArray) -> BoolArray:
    """(N,) positions in metres that are not in another part of the world than most."""
    off = xyz[:, :2] - np.median(xyz[:, :2], axis=0) if len(xyz) else xyz[:, :2]
    return np.asarray(np.hypot(off[:, 0], off[:, 1]) < FAR_M, np.bool_)


def tell_unknown(unknown: Mapping[str, str], what: str, faults: list[str]) -> None:
    """Records of images that the model does not have.

    Args:
        unknown: name of the image by the origin of the record. what: the records, in the plural.
    """
    if len(unknown) <= _MANY:
        faults.extend(f"{origin}: left out: no image {image} is in the model" for origin, image in unknown.items())
        return
    origin, image = next(iter(unknown.items()))
    faults.append(f"{len(unknown)} {what} are of images that are not in the model, such as {image} ({origin})")
