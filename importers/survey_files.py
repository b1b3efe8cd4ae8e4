"""Text files of a survey: OpenDroneMap's ``geo.txt`` and ``gcp_list.txt``, and CSV tables with a header.

A record that cannot be read is left out with a message that names file and line; only a file with none left is an
error. A pixel of a file is counted as OpenDroneMap does: whole numbers are the centres of pixels.

Source of the formats: OpenDroneMap, ``opendm/geo.py`` and ``opendm/gcp.py`` (blanks or tabs, ``#`` comments, first line
the CRS, points grouped by their coordinates).
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from smust3r_colmap.errors import InputError
from smust3r_colmap.importers.survey import (
    ROLES,
    WGS84,
    ImagePosition,
    ImagePositions,
    SurveyPoint,
    SurveyPoints,
    Tag,
    role_of_label,
)

_CENTRE = 0.5
"""Added to pixels of files, where whole numbers are centres; in this program the first pixel has its centre at 0.5."""

_COLUMNS = {
    "image": ("image", "filename", "name", "photo"),
    "label": ("label", "point", "gcp", "id"),
    "x": ("x", "lon", "longitude", "easting", "east", "e"),
    "y": ("y", "lat", "latitude", "northing", "north", "n"),
    "z": ("z", "height", "altitude", "alt", "elevation", "h"),
    "sigma_h": ("sigma_h", "sigma_xy", "acc_h", "acch", "horizontal_accuracy"),
    "sigma_v": ("sigma_v", "sigma_z", "acc_v", "accv", "vertical_accuracy"),
    "role": ("role", "type"),
    "px": ("px", "x_px", "pixel_x", "u"),
    "py": ("py", "y_px", "pixel_y", "v"),
}
_DEGREE_COLUMNS = frozenset({"lon", "longitude", "lat", "latitude"})


@dataclass(frozen=True, kw_only=True)
class _Line:
    """A line that is no comment, and where it stands."""

    text: str
    origin: str


@dataclass
class _Faults:
    """Messages about records of one file."""

    messages: list[str] = field(default_factory=list)

    def add(self, origin: str, text: str) -> None:
        self.messages.append(f"{origin}: {text}")


def read_positions_file(path: Path) -> ImagePositions:
    """Positions of images from ``geo.txt`` or, by its suffix, from a CSV table.

    ``geo.txt``: the CRS, then ``image x y [z] [yaw pitch roll] [sigma_h sigma_v]``. The angles are not used: some write
    omega, phi and kappa there, and nothing tells which. The table has the columns image, x (or lon), y (or lat), and
    may have z, sigma_h, sigma_v.

    Raises:
        InputError: the file cannot be read, names no CRS, lacks a column, or has no record that can be used.
    """
    faults = _Faults()
    if path.suffix.lower() == ".csv":
        table = _read_table(path, needed=("image", "x", "y"))
        crs, crs_origin = table.require_crs()
        rows = [_checked_position(row, faults) for row in table.rows]
    else:
        header, lines = _header_and_lines(path)
        crs, crs_origin = header.text, header.origin
        rows = [_position_of_line(line, faults) for line in lines]
    positions = _last_of_each([row for row in rows if row is not None], faults)
    if not positions:
        raise InputError(_nothing_left(path, "position of an image", faults))
    return ImagePositions(crs=crs, crs_origin=crs_origin, positions=positions, faults=tuple(faults.messages))


def read_points_files(paths: Sequence[Path]) -> SurveyPoints:
    """Points and their tags from ``gcp_list.txt``, or from CSV tables that are joined by label.

    ``gcp_list.txt``: the CRS, then ``x y z px py image [label]``. Rows with equal coordinates are one point. A table
    has the column label; x, y, z, sigma_h, sigma_v and role describe the point, image, px and py a tag of it. Points
    and tags may stand in one table or in two.

    Args:
        paths: one list, or any number of tables. Several sets with different CRS are refused.

    Raises:
        InputError: as ``read_positions_file``, or the files name different CRS.
    """
    faults = _Faults()
    tables = [path for path in paths if path.suffix.lower() == ".csv"]
    sets = [_read_gcp_list(path, faults) for path in paths if path not in tables]
    if tables:
        sets.append(_join_tables([_read_table(path, needed=("label",)) for path in tables], faults))
    first = sets[0]
    for other in sets[1:]:
        if other.crs != first.crs:
            raise InputError(
                f"{other.crs_origin}: the CRS {other.crs!r} is another one than {first.crs!r} of {first.crs_origin}; "
                "write all points in one"
            )
    points = [point for one in sets for point in one.points]
    if not points:
        raise InputError(_nothing_left(paths[0], "point", faults))
    return replace(first, points=_with_one_label_each(points, faults), faults=tuple(faults.messages))


# -------------------------------------------------------------------------- lines of a file
def _numbered_lines(path: Path) -> Iterator[_Line]:
    """Lines that are neither empty nor comments, numbered from 1; with or without a BOM, with any line ends."""
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is no UTF-8 text ({error}); save it as UTF-8") from error
    for number, line in enumerate(text.splitlines(), start=1):
        if line.strip() and not line.lstrip().startswith("#"):
            yield _Line(text=line.strip(), origin=f"{path.name}:{number}")


def _header_and_lines(path: Path) -> tuple[_Line, list[_Line]]:
    lines = list(_numbered_lines(path))
    if not lines:
        raise InputError(f"{path}: is empty; its first line names the CRS, such as EPSG:25832")
    header = lines[0]
    if sum(_is_number(word) for word in header.text.replace(",", " ").split()) >= 2 and "+" not in header.text:
        raise InputError(f"{header.origin}: is a record, but the first line names the CRS, such as EPSG:25832")
    return header, lines[1:]


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _words(line: _Line, needed: int, form: str, faults: _Faults) -> list[str] | None:
    words = line.text.split()
    if len(words) >= needed:
        return words
    commas = "; it has commas: separate by blanks or tabs, or name the file .csv" if "," in line.text else ""
    faults.add(line.origin, f"left out: {len(words)} of at least {needed} words of `{form}`{commas}")
    return None


def _coordinate(word: str, name: str) -> float:
    """A finite number.

    Raises:
        ValueError: it is none; the message is for the user.
    """
    try:
        value = float(word)
    except ValueError:
        hint = "; write a decimal point" if "," in word else ""
        raise ValueError(f"{name} {word!r} is no number{hint}") from None
    if not math.isfinite(value):
        raise ValueError(f"{name} is {word}")
    return value


def _height(word: str | None, origin: str, faults: _Faults) -> float | None:
    """None where it is empty or NaN, the latter with a message."""
    if word is None or not word.strip():
        return None
    if word.strip().lower() in ("nan", "na", "none", "null", "-"):
        faults.add(origin, f"the height is {word.strip()}; taken as without height")
        return None
    return _coordinate(word, "z")


def _sigma(word: str | None) -> float | None:
    """A standard deviation; None where it is empty, no number, or not positive."""
    value = float(word) if word and _is_number(word) else 0.0
    return value if math.isfinite(value) and value > 0 else None


def _nothing_left(path: Path, what: str, faults: _Faults) -> str:
    first = f"; the first message: {faults.messages[0]}" if faults.messages else ""
    return f"{path}: holds no usable {what}{first}"


# ------------------------------------------------------------------------ positions of images
def _position_of_line(line: _Line, faults: _Faults) -> ImagePosition | None:
    words = _words(line, 3, "image x y [z] [yaw pitch roll] [sigma_h sigma_v]", faults)
    if words is None:
        return None
    row = {"image": words[0], "x": words[1], "y": words[2], **({"z": words[3]} if len(words) > 3 else {})}
    if len(words) >= 9:
        row |= {"sigma_h": words[7], "sigma_v": words[8]}
    return _checked_position(_Row(values=row, origin=line.origin), faults)


@dataclass(frozen=True, kw_only=True)
class _Row:
    """A record by column, and where it stands."""

    values: Mapping[str, str]
    origin: str

    def get(self, name: str) -> str | None:
        return self.values.get(name) or None


def _checked_position(row: _Row, faults: _Faults) -> ImagePosition | None:
    try:
        if not row.get("image"):
            raise ValueError("no image is named")
        x, y = _coordinate(row.get("x") or "", "x"), _coordinate(row.get("y") or "", "y")
        z = _height(row.get("z"), row.origin, faults)
    except ValueError as error:
        faults.add(row.origin, f"left out: {error}")
        return None
    return ImagePosition(
        image=row.values["image"],
        x=x,
        y=y,
        z=z,
        sigma_h_m=_sigma(row.get("sigma_h")),
        sigma_v_m=_sigma(row.get("sigma_v")),
        origin=row.origin,
    )


def _last_of_each(rows: Iterable[ImagePosition], faults: _Faults) -> tuple[ImagePosition, ...]:
    """Of two positions for one image the last counts, as in OpenDroneMap."""
    by_image: dict[str, ImagePosition] = {}
    for row in rows:
        earlier = by_image.get(row.image)
        if earlier is not None and (earlier.x, earlier.y, earlier.z) != (row.x, row.y, row.z):
            faults.add(row.origin, f"a second position for {row.image}, after {earlier.origin}; the last is taken")
        by_image[row.image] = row
    return tuple(by_image.values())


# --------------------------------------------------------------------------- points and tags
def _read_gcp_list(path: Path, faults: _Faults) -> SurveyPoints:
    header, lines = _header_and_lines(path)
    groups: dict[tuple[float, float, float | None], SurveyPoint] = {}
    for line in lines:
        words = _words(line, 6, "x y z px py image [label]", faults)
        if words is None:
            continue
        try:
            x, y = _coordinate(words[0], "x"), _coordinate(words[1], "y")
            z = _height(words[2], line.origin, faults)
            tag = _tag(words[5], words[3], words[4], line.origin)
        except ValueError as error:
            faults.add(line.origin, f"left out: {error}")
            continue
        label = words[6] if len(words) > 6 else ""
        known = groups.get((x, y, z))
        if known is None:
            label = label or f"point {len(groups) + 1}"
            role = role_of_label(label)
            known = SurveyPoint(label=label, x=x, y=y, z=z, role=role, origin=line.origin)
        groups[x, y, z] = _with_tag(known, tag, faults)
    return SurveyPoints(crs=header.text, crs_origin=header.origin, points=tuple(groups.values()))


def _tag(image: str, px: str, py: str, origin: str) -> Tag:
    return Tag(
        image=image,
        x_px=_coordinate(px, "px") + _CENTRE,
        y_px=_coordinate(py, "py") + _CENTRE,
        origin=origin,
    )


def _with_tag(point: SurveyPoint, tag: Tag, faults: _Faults) -> SurveyPoint:
    earlier = next((one for one in point.tags if one.image == tag.image), None)
    if earlier is None:
        return replace(point, tags=(*point.tags, tag))
    if (earlier.x_px, earlier.y_px) != (tag.x_px, tag.y_px):
        faults.add(tag.origin, f"left out: {point.label} has a tag in {tag.image} already, by {earlier.origin}")
    return point


def _with_one_label_each(points: Iterable[SurveyPoint], faults: _Faults) -> tuple[SurveyPoint, ...]:
    """A label that stands at two places is two points, of which the second gets its line as well."""
    by_label: dict[str, SurveyPoint] = {}
    for point in points:
        earlier = by_label.get(point.label)
        label = point.label
        if earlier is not None:
            label = f"{point.label} ({point.origin})"
            faults.add(point.origin, f"{point.label} has other coordinates than in {earlier.origin}; named {label!r}")
        by_label[label] = replace(point, label=label)
    return tuple(by_label.values())


# ------------------------------------------------------------------------------------ tables
@dataclass(frozen=True, kw_only=True)
class _Table:
    """Rows of a CSV file by our names of its columns.

    Args:
        crs: of the line before the header, or WGS 84 where the columns are lon and lat; empty where neither says.
    """

    path: Path
    crs: str
    crs_origin: str
    rows: tuple[_Row, ...]

    def require_crs(self) -> tuple[str, str]:
        if not self.crs:
            raise InputError(
                f"{self.crs_origin}: the CRS is missing; write it in a line of its own before the header, such as "
                "EPSG:25832, or name the columns lon and lat"
            )
        return self.crs, self.crs_origin


def _read_table(path: Path, *, needed: Sequence[str]) -> _Table:
    lines = list(_numbered_lines(path))
    crs, crs_origin = "", ""
    if lines and not _our_columns(_cells(lines[0].text)):
        crs, crs_origin = lines[0].text.strip(",;\t "), lines[0].origin
        lines = lines[1:]
    if not lines:
        raise InputError(f"{path}: has no line with the names of its columns")
    header = _cells(lines[0].text)
    columns = _our_columns(header)
    missing = [name for name in needed if name not in columns.values()]
    if missing:
        raise InputError(f"{lines[0].origin}: has no column {missing[0]!r}; the columns are {', '.join(header)}")
    if not crs and _DEGREE_COLUMNS & {cell.lower() for cell in header}:
        crs = WGS84
    rows = [
        _Row(values={columns[k]: cell for k, cell in enumerate(_cells(line.text)) if k in columns}, origin=line.origin)
        for line in lines[1:]
    ]
    return _Table(path=path, crs=crs, crs_origin=crs_origin or lines[0].origin, rows=tuple(rows))


def _cells(line: str) -> list[str]:
    """Separated by commas, semicolons or tabs, whichever comes most often."""
    delimiter = max(",;\t", key=line.count)
    return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter))]


def _our_columns(header: Sequence[str]) -> dict[int, str]:
    """Our name of each column that has one."""
    names = {name: ours for ours, theirs in _COLUMNS.items() for name in theirs}
    return {k: names[cell.lower()] for k, cell in enumerate(header) if cell.lower() in names}


def _join_tables(tables: Sequence[_Table], faults: _Faults) -> SurveyPoints:
    points: dict[str, SurveyPoint] = {}
    tags: list[tuple[str, Tag]] = []
    source: _Table | None = None
    for table in tables:
        for row in table.rows:
            try:
                label = row.get("label")
                if label is None:
                    raise ValueError("no label")
                if row.get("x") is not None:
                    source = source or table
                    point = _point_of_row(label, row, faults)
                    if label in points and (points[label].x, points[label].y) != (point.x, point.y):
                        raise ValueError(f"{label} has other coordinates in {points[label].origin}")
                    points.setdefault(label, point)
                if row.get("image") is not None:
                    tag = _tag(row.values["image"], row.get("px") or "", row.get("py") or "", row.origin)
                    tags.append((label, tag))
            except ValueError as error:
                faults.add(row.origin, f"left out: {error}")
    if source is None:
        raise InputError(f"{tables[0].path}: no table has the columns x and y of points")
    for label, tag in tags:
        if label in points:
            points[label] = _with_tag(points[label], tag, faults)
        else:
            faults.add(tag.origin, f"left out: there is no point {label}")
    crs, crs_origin = source.require_crs()
    return SurveyPoints(crs=crs, crs_origin=crs_origin, points=tuple(points.values()))


def _point_of_row(label: str, row: _Row, faults: _Faults) -> SurveyPoint:
    role = (row.get("role") or role_of_label(label)).lower()
    if role not in ROLES:
        raise ValueError(f"role {role!r} is none of {', '.join(ROLES)}")
    return SurveyPoint(
        label=label,
        x=_coordinate(row.get("x") or "", "x"),
        y=_coordinate(row.get("y") or "", "y"),
        z=_height(row.get("z"), row.origin, faults),
        sigma_h_m=_sigma(row.get("sigma_h")),
        sigma_v_m=_sigma(row.get("sigma_v")),
        role=role,
        origin=row.origin,
    )
