"""A georeference in the terminal: where, by what, and how far everything is off."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.georeferencing.accuracy import Accuracy
from smust3r_colmap.georeferencing.georeference import Georeference, PointResult

_NAMES = {
    "gps": "GPS",
    "control": "control",
    "control_leave_one_out": "control, each left out of the fit",
    "check": "check",
}
_HEAD = ("", "n", "mean x", "y", "z", "RMSE x", "y", "z", "horizontal", "3D", "CE90", "LE90")
_POINT_HEAD = ("point", "role", "x", "y", "z", "tags", "worst px", "")


def render_georeference(found: Georeference) -> str:
    """Lines without the last line end; residuals are surveyed less computed, in metres."""
    crs = found.frame.crs
    where = "in the coordinates of the site" if crs is None else crs.title
    heights = "as given" if crs is None else crs.vertical_name
    x, y, z = (f"{value:.0f}" for value in found.frame.offset_m)
    lines = [
        f"Georeferenced by {found.basis}: {where}; vertical datum: {heights}; offset {x}, {y}, {z}",
        f"  one unit of the model is {float(found.local_from_model.scale):.6g} m"
        + (f"; a pixel on the ground is {_length(found.pixel_size_m)}" if found.pixel_size_m is not None else ""),
    ]
    if found.up is not None:
        lines.append(f"  up was taken from {found.up.source}")
    if found.gps_offset_m is not None:
        lines.append(f"  offset of all positions of images: {_three(found.gps_offset_m)} m")
    accuracies = found.accuracies()
    lines += _table([_HEAD, *(_row(_NAMES[name], one) for name, one in accuracies.items())])
    if found.pixel_size_m and (best := accuracies.get("check") or accuracies.get("control_leave_one_out")):
        pixel = found.pixel_size_m
        lines.append(
            f"  {'check points' if 'check' in accuracies else 'control points left out'}: horizontal "
            f"{best.horizontal / pixel:.3g}, height {best.rmse[2] / pixel:.3g} pixels on the ground"
        )
    if found.points:
        lines += _table([_POINT_HEAD, *map(_point_row, found.points)])
    return "\n".join(lines)


def _row(name: str, one: Accuracy) -> tuple[str, ...]:
    figures = (*one.mean, *one.rmse, one.horizontal, one.spatial, one.ce90, one.le90)
    return (name, str(one.count), *map(_metres, figures))


def _point_row(one: PointResult) -> tuple[str, ...]:
    counted = [tag.error_px for tag in one.tags if tag.left_out is None and tag.error_px is not None]
    used = sum(tag.left_out is None for tag in one.tags)
    return (
        one.point.label,
        one.role,
        *map(_metres, one.residual_m),
        str(used) if used == len(one.tags) else f"{used} of {len(one.tags)}",
        f"{max(counted):.2f}" if counted else "-",
        "left out" if one.left_out else "",
    )


def _table(rows: Sequence[Sequence[str]]) -> list[str]:
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    return [
        "  "
        + "  ".join(
            cell.ljust(width) if k == 0 else cell.rjust(width)
            for k, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]


def _metres(value: float) -> str:
    return f"{value:.3f}" if np.isfinite(value) else "-"


def _three(values: FloatArray) -> str:
    return ", ".join(map(_metres, values))


def _length(metres: float) -> str:
    return f"{100 * metres:.3g} cm"
