"""Coordinate reference systems: what a text means, whether it fits, and coordinates of one in another.

All by pyproj (the extra ``geo``), with x east before y north whatever the axis order of the CRS. A transformation
that PROJ would only guess ("ballpark") is refused: without a geoid grid it hands ellipsoidal heights on as heights
above the sea, in silence. The next module to read is ``frame``.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from smust3r_colmap.errors import InputError, MissingDependencyError
from smust3r_colmap.geometry.arrays import BoolArray, FloatArray

if TYPE_CHECKING:
    import pyproj

ACCEPTED = "EPSG:25832, EPSG:25832+7837 (with heights), WGS84 UTM 32N, a PROJ string, or WKT"

_UTM = re.compile(r"WGS\s*84[\s/_]*UTM[\s_]*(?:zone)?\s*(\d{1,2})\s*([NS])", re.IGNORECASE)
"""The header that OpenDroneMap documents; other letters after the zone are bands of latitude, and refused."""
_AREA_MARGIN_DEG = 3.0
"""Beyond the area of use, which ends at borders and meridians, a CRS is still good: half a zone of UTM."""
_EGM96 = "EPSG:5773"


@dataclass(frozen=True, kw_only=True, eq=False)
class Crs:
    """A CRS that can be worked with: degrees, or a projection in metres.

    Args:
        horizontal: two axes. vertical: of the heights; None where nobody says what they refer to.
        ellipsoidal: heights are those above the ellipsoid.
        origin: where it was named.
    """

    horizontal: pyproj.CRS
    vertical: pyproj.CRS | None = None
    ellipsoidal: bool = False
    origin: str

    @property
    def name(self) -> str:
        """``EPSG:n`` where it has a code, else its own name."""
        authority = self.horizontal.to_authority()
        return ":".join(authority) if authority else str(self.horizontal.name)

    @property
    def vertical_name(self) -> str:
        """``unknown`` where nobody says it."""
        if self.vertical is not None:
            return str(self.vertical.name)
        return f"height above the ellipsoid of {self.horizontal.datum}" if self.ellipsoidal else "unknown"

    @property
    def has_vertical(self) -> bool:
        """Whether it is known what heights refer to."""
        return self.ellipsoidal or self.vertical is not None

    @property
    def title(self) -> str:
        """The short name, and the long one where there is one."""
        long = str(self.horizontal.name)
        return self.name if long in ("unknown", self.name) else f"{self.name} ({long})"

    @property
    def in_degrees(self) -> bool:
        """Longitude and latitude."""
        return bool(self.horizontal.is_geographic)

    def spatial(self) -> pyproj.CRS:
        """With three axes."""
        if self.vertical is None:
            return self.horizontal.to_3d()
        name = f"{self.name} + {self.vertical_name}"
        compound: pyproj.CRS = load_pyproj().crs.CompoundCRS(name, [self.horizontal, self.vertical])
        return compound

    def with_vertical_of(self, other: Crs) -> Crs:
        """The same with the heights of another."""
        return Crs(
            horizontal=self.horizontal, vertical=other.vertical, ellipsoidal=other.ellipsoidal, origin=self.origin
        )


def load_pyproj() -> Any:
    """The package.

    Raises:
        MissingDependencyError: it is not installed.
    """
    try:
        import pyproj  # noqa: PLC0415  (optional)
        import pyproj.crs  # noqa: PLC0415
    except ImportError as error:
        raise MissingDependencyError(
            "georeferencing needs the package pyproj: pip install 'smust3r-colmap[geo]'"
        ) from error
    return pyproj


def add_grids(folder: Path) -> None:
    """Let PROJ look for geoid grids in a folder.

    Raises:
        InputError: there is no such folder. MissingDependencyError: pyproj is not installed.
    """
    if not folder.is_dir():
        raise InputError(f"--proj-data {folder}: there is no such folder")
    load_pyproj().datadir.append_data_dir(str(folder))


def versions() -> dict[str, str]:
    """Of pyproj and PROJ."""
    pyproj = load_pyproj()
    return {"pyproj": str(pyproj.__version__), "proj": str(pyproj.proj_version_str)}


def parse_crs(text: str, origin: str) -> Crs:
    """The CRS that a text names.

    Args:
        text: ``EPSG:n``, ``EPSG:n+v``, ``WGS84 UTM 32N``, a PROJ string, or WKT. origin: for messages.

    Raises:
        InputError: it is none of these, does not exist, or is in feet, in three Cartesian axes or the like.
        MissingDependencyError: pyproj is not installed.
    """
    pyproj = load_pyproj()
    utm = _UTM.fullmatch(text.strip())
    wanted = text.strip()
    if utm and 1 <= int(utm[1]) <= 60:
        wanted = f"EPSG:{32600 if utm[2].upper() == 'N' else 32700}"[:-2] + f"{int(utm[1]):02}"
    try:
        parsed = pyproj.CRS.from_user_input(wanted)
    except pyproj.exceptions.CRSError:
        exists = " does not exist" if re.fullmatch(r"EPSG:\d+(\+\d+)?", wanted, re.I) else " is no CRS that is known"
        raise InputError(f"{origin}: {text!r}{exists}; write {ACCEPTED}") from None
    parts = parsed.sub_crs_list if parsed.is_compound else [parsed]
    horizontal, vertical = parts[0], parts[1] if len(parts) > 1 else None
    ellipsoidal = len(horizontal.axis_info) == 3
    _refuse_units(horizontal, vertical, text, origin)
    return Crs(
        horizontal=horizontal.to_2d() if ellipsoidal else horizontal,
        vertical=vertical,
        ellipsoidal=ellipsoidal,
        origin=origin,
    )


def egm96() -> pyproj.CRS:
    """Heights above the geoid EGM96."""
    crs: pyproj.CRS = load_pyproj().CRS.from_user_input(_EGM96)
    return crs


def utm_zone(lon_deg: float, lat_deg: float) -> Crs:
    """The zone of UTM on WGS 84 that a place lies in."""
    zone = min(int((lon_deg + 180) // 6) + 1, 60)
    return parse_crs(f"EPSG:{(32600 if lat_deg >= 0 else 32700) + zone}", "chosen by the place")


def _refuse_units(horizontal: pyproj.CRS, vertical: pyproj.CRS | None, text: str, origin: str) -> None:
    """Feet: PROJ converts x and y and leaves z, and nobody can tell what the heights of a list are in."""
    if not (horizontal.is_projected or horizontal.is_geographic):
        raise InputError(f"{origin}: {text!r} ({horizontal.type_name}) is neither a projection nor in degrees")
    wanted = "metre" if horizontal.is_projected else "degree"
    units = [axis.unit_name for axis in horizontal.axis_info[:2]]
    units += [axis.unit_name for axis in (vertical.axis_info if vertical is not None else ())]
    foreign = [unit for unit in units if unit not in (wanted, "metre")]
    if foreign:
        raise InputError(
            f"{origin}: {text!r} is in {foreign[0]}, and it is not clear whether the heights are as well; "
            "convert the coordinates to a CRS in metres, heights too"
        )


# --------------------------------------------------------------------------- transformations
def transform(xyz: FloatArray, source: Crs, target: Crs) -> FloatArray:
    """(N, 3) coordinates of ``source`` in ``target``; heights change where both say what they refer to.

    Args:
        xyz: (N, 3) east, north, up; NaN heights stay NaN.

    Returns:
        (N, 3); x and y are infinite where the point cannot be expressed.

    Raises:
        InputError: there is no exact transformation, in most cases because a geoid grid is missing.
    """
    with_heights = source.has_vertical and target.has_vertical
    if with_heights and not np.isnan(xyz[:, 2]).all():
        moved = np.column_stack(_transformer(source.spatial(), target.spatial(), source, target).transform(*xyz.T))
        flat = np.isnan(xyz[:, 2])
        if flat.any():  # PROJ makes the whole point infinite
            moved[flat] = _transform_flat(xyz[flat], source, target)
        return moved
    return _transform_flat(xyz, source, target)


def _transform_flat(xyz: FloatArray, source: Crs, target: Crs) -> FloatArray:
    transformer = _transformer(source.horizontal, target.horizontal, source, target)
    return np.column_stack([*transformer.transform(xyz[:, 0], xyz[:, 1]), xyz[:, 2]])


def _transformer(a: pyproj.CRS, b: pyproj.CRS, source: Crs, target: Crs) -> Any:
    pyproj = load_pyproj()
    try:
        return pyproj.Transformer.from_crs(a, b, always_xy=True, allow_ballpark=False)
    except pyproj.exceptions.ProjError:
        raise InputError(
            f"there is no exact way from {source.name} with {source.vertical_name} ({source.origin}) to {target.name} "
            f"with {target.vertical_name} ({target.origin}): the grid is missing. Give the folder with the grid "
            "(from cdn.proj.org) with --proj-data, or leave the vertical datum out"
        ) from None


def lon_lat(xy: FloatArray, crs: Crs) -> FloatArray:
    """(N, 2) degrees in the geographic CRS that the projection stands on; infinite where there is none."""
    if crs.in_degrees:
        return np.asarray(xy[:, :2], np.float64)
    pyproj = load_pyproj()
    transformer = pyproj.Transformer.from_crs(crs.horizontal, crs.horizontal.geodetic_crs, always_xy=True)
    return np.column_stack(transformer.transform(xy[:, 0], xy[:, 1]))


def is_in_area(xy: FloatArray, crs: Crs) -> BoolArray:
    """(N,) whether points (N, 2) lie in the area that the CRS is made for, give or take half a zone of UTM."""
    degrees = lon_lat(xy, crs)
    inside = np.isfinite(degrees).all(axis=1) & (np.abs(degrees[:, 1]) <= 90) & (np.abs(degrees[:, 0]) <= 180)
    area = crs.horizontal.area_of_use
    if area is None:
        code = crs.horizontal.to_epsg()
        area = None if code is None else load_pyproj().CRS.from_epsg(code).area_of_use
    if area is not None and area.west <= area.east:
        low = np.array([area.west, area.south]) - _AREA_MARGIN_DEG
        high = np.array([area.east, area.north]) + _AREA_MARGIN_DEG
        inside &= ((degrees >= low) & (degrees <= high)).all(axis=1)
    return np.asarray(inside, np.bool_)


def why_outside(x: float, y: float, crs: Crs) -> str:
    """Of a point that is not in the area of its CRS: what is wrong, as far as can be seen."""
    swapped = bool(is_in_area(np.array([[y, x]]), crs)[0])
    degrees = not crs.in_degrees and abs(x) <= 180 and abs(y) <= 90
    hint = "; x and y are swapped: east comes first" if swapped else ""
    hint = "; these are degrees, and the CRS is a projection" if degrees else hint
    hint = "; these are metres, and the CRS is in degrees" if crs.in_degrees and max(abs(x), abs(y)) > 360 else hint
    return f"({x:.10g}, {y:.10g}) lies outside of {crs.title}, from {crs.origin}{hint}"
