"""The command ``georeference``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from smust3r_colmap.cli.console import reporting
from smust3r_colmap.report.summary import EXIT_DEGRADED, EXIT_GOOD


@dataclass(frozen=True, kw_only=True)
class Georeference:
    """Say where on earth a model is, by GPS of its images and by control points.

    Writes DIR/geo.json, cameras.geojson and gcps.geojson, and nothing else: the model stays as it is. Exit code 3:
    something was left out or is weak; it is named.
    """

    run: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]
    """Output folder of a finished reconstruct or refine, or a COLMAP model."""
    output: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Write here instead of into RUN/geo."""
    images: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Where the images are, for their GPS; by default where the run found them."""
    gcp: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="FILE ...")] = ()
    """Control and check points with their pixels: gcp_list.txt of OpenDroneMap, or CSV tables."""
    geo: Annotated[str, tyro.conf.arg(metavar="auto|off|FILE")] = "auto"
    """Positions of images: auto takes EXIF and XMP; FILE is geo.txt of OpenDroneMap, or a CSV table."""
    crs: Annotated[str, tyro.conf.arg(metavar="auto|CRS")] = "auto"
    """CRS of the result, such as EPSG:25832 or EPSG:25832+7837; auto takes that of the control points, else of the
    positions, else the zone of UTM."""
    check_every: int | None = None
    """Every k-th control point becomes a check point: it is compared and never fitted."""
    altitude: Literal["auto", "ellipsoid", "egm96", "relative", "none"] = "auto"
    """What heights of images refer to; auto: nobody knows. relative takes those above take-off, none takes none."""
    height_offset: float = 0.0
    """Metres added to the heights of images."""
    proj_data: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Folder with the grids of PROJ, for heights above a geoid."""
    quiet: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print warnings and errors only."""
    verbose: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print what the stages log, and the traceback of an unexpected error."""


def run_georeference(command: Georeference) -> int:
    """Write the files, print the residuals, and return the exit code.

    Raises:
        InputError: a file or a CRS cannot be used, or nothing is left of the survey.
        ReconstructionError: what is left determines no similarity.
        MissingDependencyError: pyproj is not installed.
        RunDirectoryError: the output folder cannot be used.
    """
    from smust3r_colmap.exporters.geo_files import write_georeference  # noqa: PLC0415  (heavy: --help needs none)
    from smust3r_colmap.georeferencing.stage import GeoreferenceSettings, georeference_model  # noqa: PLC0415
    from smust3r_colmap.report.georeference_table import render_georeference  # noqa: PLC0415

    settings = GeoreferenceSettings(
        gcp=command.gcp,
        geo=command.geo,
        crs=command.crs,
        check_every=command.check_every,
        altitude=command.altitude,
        height_offset=command.height_offset,
        proj_data=command.proj_data,
    )
    with reporting(quiet=command.quiet, verbose=command.verbose) as reporter:
        found = georeference_model(command.run, command.images, settings)
        folder = command.run / "geo" if command.output is None else command.output
        write_georeference(found, folder)
        if not command.quiet:
            print(render_georeference(found))
            print(folder)
        for text in (*found.faults, *found.warnings):
            reporter.warn(text)
    return EXIT_DEGRADED if found.faults or found.warnings else EXIT_GOOD
