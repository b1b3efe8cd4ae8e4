"""A georeference as files: ``geo.json`` for programs, ``cameras.geojson`` and ``gcps.geojson`` for GIS.

The page ``docs/georeference.md`` has the schema. GeoJSON is in degrees of WGS 84 (RFC 7946), ``geo.json`` in the CRS.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from smust3r_colmap import __version__
from smust3r_colmap.errors import InputError
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.georeferencing.crs import Crs, lon_lat, parse_crs, transform, versions
from smust3r_colmap.georeferencing.georeference import FixResult, Georeference, PointResult
from smust3r_colmap.importers.survey import WGS84
from smust3r_colmap.storage.atomic_write import atomic_folder

GEO_FILE, CAMERAS_FILE, POINTS_FILE = "geo.json", "cameras.geojson", "gcps.geojson"
SCHEMA = 1
_DEGREE_DIGITS = 9
"""A tenth of a millimetre."""


def write_georeference(found: Georeference, folder: Path) -> None:
    """Write the files into ``folder``, which they replace; without a CRS there is no GeoJSON.

    Raises:
        RunDirectoryError: the folder holds something else. StorageError: the disk refused.
    """
    contents: dict[str, Any] = {GEO_FILE: geo_json(found)}
    if found.frame.crs is not None:
        contents[CAMERAS_FILE] = cameras_geojson(found, found.frame.crs)
        contents[POINTS_FILE] = points_geojson(found, found.frame.crs)
    with atomic_folder(folder, may_hold=(GEO_FILE, CAMERAS_FILE, POINTS_FILE)) as partial:
        for name, content in contents.items():
            text = json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False)
            (partial / name).write_text(text + "\n", encoding="utf-8")


def geo_json(found: Georeference) -> dict[str, Any]:
    """All that is known; lengths are metres, NaN is null."""
    return {
        "schema": SCHEMA,
        "versions": {"smust3r_colmap": __version__, **versions()},
        "crs": _crs(found.frame.crs),
        "offset_m": list(found.frame.offset_m),
        "local_from_model": found.local_from_model.matrix.tolist(),
        "crs_from_model": found.crs_from_model.tolist(),
        "crs_from_model_error_m": _linear_error(found),
        "metres_per_unit": float(found.local_from_model.scale),
        "pixel_size_m": found.pixel_size_m,
        "basis": found.basis,
        "up_from": None if found.up is None else found.up.source,
        "tilt_sigma_deg": _number(found.tilt_sigma_deg),
        "scale_sigma": _number(found.scale_sigma),
        "gps_offset_m": None if found.gps_offset_m is None else _numbers(found.gps_offset_m),
        "accuracy_m": {
            name: {key: _plain(value) for key, value in dataclasses.asdict(one).items()}
            for name, one in found.accuracies().items()
        },
        "gps": [_fix(one) for one in found.fixes],
        "points": [_point(one) for one in found.points],
        "left_out": _left_out(found),
        "faults": list(found.faults),
        "warnings": list(found.warnings),
    }


def _crs(crs: Crs | None) -> dict[str, Any] | None:
    if crs is None:
        return None
    vertical = crs.vertical
    return {
        "name": crs.horizontal.name,
        "epsg": crs.horizontal.to_epsg(),
        "wkt2": (crs.spatial() if crs.has_vertical else crs.horizontal).to_wkt("WKT2_2019"),
        "vertical": crs.vertical_name,
        "vertical_epsg": None if vertical is None else vertical.to_epsg(),
    }


def _linear_error(found: Georeference) -> float:
    """Largest distance between the linear form and the CRS, over the cameras and points of the model."""
    points = np.vstack([found.model.centres_model, found.model.points_model])
    matrix = found.crs_from_model
    linear = points @ matrix[:3, :3].T + matrix[:3, 3] + np.array(found.frame.offset_m)
    return float(np.linalg.norm(found.to_crs(points) - linear, axis=1).max())


def _fix(one: FixResult) -> dict[str, Any]:
    return {
        "image": one.image,
        "origin": one.origin,
        "xyz": _numbers(one.crs_xyz),
        "residual_m": _numbers(one.residual_m),
        "sigma_m": _numbers(one.sigma_m),
        "left_out": one.left_out,
        "height_left_out": one.without_height,
    }


def _point(one: PointResult) -> dict[str, Any]:
    return {
        "label": one.point.label,
        "origin": one.point.origin,
        "role": one.role,
        "xyz": _numbers(one.crs_xyz),
        "residual_m": _numbers(one.residual_m),
        "leave_one_out_m": _numbers(one.leave_one_out_m),
        "left_out": one.left_out,
        "tags": [
            {
                "image": tag.tag.image,
                "origin": tag.tag.origin,
                "xy_px": [tag.tag.x_px, tag.tag.y_px],
                "error_px": tag.error_px,
                "left_out": tag.left_out,
            }
            for tag in one.tags
        ],
    }


def _left_out(found: Georeference) -> list[dict[str, str]]:
    """Every record that was not used in the fit, with the reason."""
    rows = [("position", one.image, one.origin, one.left_out) for one in found.fixes]
    rows += [("height", one.image, one.origin, one.without_height) for one in found.fixes]
    rows += [("point", one.point.label, one.point.origin, one.left_out) for one in found.points]
    rows += [
        ("tag", f"{one.point.label} in {tag.tag.image}", tag.tag.origin, tag.left_out)
        for one in found.points
        for tag in one.tags
    ]
    return [{"kind": kind, "name": name, "origin": at, "reason": why} for kind, name, at, why in rows if why]


# --------------------------------------------------------------------------------- GeoJSON
def cameras_geojson(found: Georeference, crs: Crs) -> dict[str, Any]:
    """A point for every image; ``rotation`` is the rotation vector from the local frame to the camera."""
    model = found.model
    places = found.to_crs(model.centres_model)
    turns = Rotation.from_matrix(model.cam_from_model[:, :, :3] @ found.local_from_model.rotation.T).as_rotvec()
    by_image = {one.image: one for one in found.fixes}
    features = []
    for name, camera, place, turn, at in zip(
        model.names, model.cameras, places, turns, _degrees(places, crs), strict=True
    ):
        fix = by_image.get(name)
        properties = {
            "filename": name,
            "camera": camera.model,
            "width": camera.width,
            "height": camera.height,
            "focal": camera.focal_px / max(camera.width, camera.height),
            "translation": _numbers(place),
            "rotation": _numbers(turn),
            "gps_residual_m": None if fix is None else _numbers(fix.residual_m),
            "gps_sigma_m": None if fix is None else _numbers(fix.sigma_m),
            "gps_left_out": None if fix is None else fix.left_out,
        }
        features.append(_feature(at, properties))
    return _collection(features)


def points_geojson(found: Georeference, crs: Crs) -> dict[str, Any]:
    """A point for every surveyed point, at its surveyed coordinates."""
    places = np.array([one.crs_xyz for one in found.points]).reshape(-1, 3)
    features = [
        _feature(at, {"id": one.point.label, "error_m": _numbers(one.residual_m), **_point(one)})
        for one, at in zip(found.points, _degrees(places, crs), strict=True)
    ]
    return _collection(features)


def _degrees(places: FloatArray, crs: Crs) -> FloatArray:
    """(N, 3) longitude and latitude of WGS 84, or of its own datum where PROJ knows no way, and the height as it is."""
    flat = Crs(horizontal=crs.horizontal, origin=crs.origin)
    try:
        return transform(places, flat, parse_crs(WGS84, "GeoJSON"))
    except InputError:
        return np.column_stack([lon_lat(places, crs), places[:, 2]])


def _feature(at: FloatArray, properties: dict[str, Any]) -> dict[str, Any]:
    coordinates = [round(float(at[0]), _DEGREE_DIGITS), round(float(at[1]), _DEGREE_DIGITS)]
    coordinates += [float(at[2])] if math.isfinite(at[2]) else []
    return {"type": "Feature", "geometry": {"type": "Point", "coordinates": coordinates}, "properties": properties}


def _collection(features: Sequence[dict[str, Any]]) -> dict[str, Any]:
    return {"type": "FeatureCollection", "features": list(features)}


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _numbers(values: Iterable[float]) -> list[float | None]:
    return [_number(value) for value in values]


def _plain(value: Any) -> Any:
    if isinstance(value, tuple):
        return _numbers(value)
    return _number(value) if isinstance(value, float) else value
