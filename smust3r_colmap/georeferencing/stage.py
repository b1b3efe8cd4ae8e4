"""Georeferencing of a model on disk: reads the model and the survey, and hands them to ``georeference``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from smust3r_colmap.errors import ConfigError, InputError
from smust3r_colmap.georeferencing.crs import add_grids, load_pyproj
from smust3r_colmap.georeferencing.georeference import Georeference, ModelGeometry, georeference
from smust3r_colmap.georeferencing.survey_in_crs import Altitude
from smust3r_colmap.importers.colmap_model import ExternalModel, read_colmap_model
from smust3r_colmap.importers.gps_tags import read_image_positions
from smust3r_colmap.importers.survey import (
    ImagePositions,
    SurveyPoints,
    with_every_kth_as_check,
)
from smust3r_colmap.importers.survey_files import read_points_files, read_positions_file
from smust3r_colmap.storage.run_directory import read_json

_FINISHED = Path("work") / "finished.json"
_SEED = 0
"""Of the consensus."""


@dataclass(frozen=True, kw_only=True)
class GeoreferenceSettings:
    """What the command is told; its page has the meaning of each."""

    gcp: tuple[Path, ...] = ()
    geo: str = "auto"
    crs: str = "auto"
    check_every: int | None = None
    altitude: Altitude = "auto"
    height_offset: float = 0.0
    proj_data: Path | None = None


def georeference_model(folder: Path, images: Path | None, settings: GeoreferenceSettings) -> Georeference:
    """Find where the model in a folder is.

    Args:
        folder: of a finished run, or of a COLMAP model. images: of the image files, for their tags; None: those that
            the run names.

    Raises:
        InputError: a file or a CRS cannot be used, or nothing is left of the survey.
        ReconstructionError: what is left determines no similarity.
        MissingDependencyError: pyproj is not installed.
    """
    load_pyproj()
    if settings.proj_data is not None:
        add_grids(settings.proj_data)
    if settings.check_every is not None and not settings.gcp:
        raise ConfigError("--check-every needs control points; name their list with --gcp")
    model = read_colmap_model(folder)
    positions = _positions(folder, images, model, settings)
    points = _points(settings)
    if positions is None and points is None:
        raise InputError("--geo off leaves nothing to go by; name control points with --gcp")
    return georeference(
        geometry_of(model),
        positions,
        points,
        crs=settings.crs,
        altitude=settings.altitude,
        height_offset_m=settings.height_offset,
        rng=np.random.default_rng(_SEED),
    )


def geometry_of(model: ExternalModel) -> ModelGeometry:
    """Poses, cameras and points; the size of a pixel on the surface is the median of depth by focal length."""
    cloud, surface = model.surface.cloud.xyz.astype(np.float64), model.surface
    images = surface.image_of_observation
    poses = model.cam_from_world[images]
    depth = np.einsum("nj,nj->n", poses[:, 2, :3], cloud[surface.point_of_observation]) + poses[:, 2, 3]
    focal = np.array([model.cameras[camera].focal_px for camera in model.camera_ids])[images]
    return ModelGeometry(
        names=model.names,
        cam_from_model=model.cam_from_world,
        cameras=tuple(model.cameras[camera] for camera in model.camera_ids),
        points_model=cloud,
        pixel_size_model=float(np.median(depth / focal)) if len(depth) else None,
    )


def _positions(
    folder: Path, images: Path | None, model: ExternalModel, settings: GeoreferenceSettings
) -> ImagePositions | None:
    if settings.geo == "off":
        return None
    if settings.geo != "auto":
        return read_positions_file(Path(settings.geo))
    where = images if images is not None else _images_of_run(folder)
    if where is None or not where.is_dir():
        if settings.gcp:
            return None
        known = f"{where}: there is no such folder" if where is not None else f"{folder}: names no images"
        raise InputError(f"{known}; say with --images where they are, or name positions with --geo or --gcp")
    found = read_image_positions(where, model.names)
    if found.positions or settings.gcp:
        return found if found.positions else None
    faults = f": {found.faults[0]}" if found.faults else ""
    raise InputError(f"{where}: no image has a position in its EXIF or XMP{faults}; name positions with --geo or --gcp")


def _images_of_run(folder: Path) -> Path | None:
    """As the run wrote it down; None for a model that no run made."""
    if not (folder / _FINISHED).is_file():
        return None
    facts = read_json(folder / _FINISHED)
    named = facts.get("images") if isinstance(facts, dict) else None
    return Path(named) if isinstance(named, str) else None


def _points(settings: GeoreferenceSettings) -> SurveyPoints | None:
    if not settings.gcp:
        return None
    read = read_points_files(settings.gcp)
    if settings.check_every is None:
        return read
    return SurveyPoints(
        crs=read.crs,
        crs_origin=read.crs_origin,
        points=with_every_kth_as_check(read.points, settings.check_every),
        faults=read.faults,
    )
