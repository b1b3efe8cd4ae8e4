"""The command ``demo``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from smust3r_colmap.cli.console import reporting, tell
from smust3r_colmap.config import FeatureConfig, OutputConfig, RunConfig, SegmentationConfig
from smust3r_colmap.errors import InputError
from smust3r_colmap.execution.progress import Reporter
from smust3r_colmap.report.summary import EXIT_DEGRADED

# Position error of the demo, in percent of the path's extent, above which something is broken; a
# tenth of a percent is usual.
_DEMO_MAX_PERCENT = 5.0
# The demo's walls are covered with texture; a quarter of the features does, in a third of the time.
_DEMO_SETTINGS = RunConfig(
    features=FeatureConfig(max_features=1500),
    segmentation=SegmentationConfig(segment_length=20, overlap=10),  # enough segments for a loop
)
# Errors of check points of the survey, in pixels on the ground, above which something is broken; a third of a pixel
# in the plane and half a pixel in height are usual.
_SURVEY_MAX_PIXELS = (1.0, 2.0)
_SURVEY_SETTINGS = RunConfig(output=OutputConfig(trainer=False, dense=False))


@dataclass(frozen=True, kw_only=True)
class Demo:
    """Render a made-up room, reconstruct it and say how far the result is from the truth."""

    output: Annotated[Path, tyro.conf.arg(metavar="OUT")] = Path("demo_out")
    """Folder for the images, the truth and the result."""
    num_images: int = 80
    """Images on the way round the room."""
    survey: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Render a flight over hills instead, and georeference it: 28 images, 8 control and 12 check points. Needs the
    extra geo."""
    quiet: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print the figures, warnings and errors only."""
    verbose: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print what the stages log, and the traceback of an unexpected error."""


def run_demo(command: Demo) -> int:
    """Render, reconstruct, compare; the exit code."""
    with reporting(quiet=command.quiet, verbose=command.verbose) as reporter:
        return _survey(command, reporter) if command.survey else _demo(command, reporter)


def _survey(command: Demo, reporter: Reporter) -> int:
    from smust3r_colmap.exporters.geo_files import write_georeference  # noqa: PLC0415  (heavy: --help needs none)
    from smust3r_colmap.georeferencing.stage import GeoreferenceSettings, georeference_model  # noqa: PLC0415
    from smust3r_colmap.pipeline import reconstruct  # noqa: PLC0415
    from smust3r_colmap.report.georeference_table import render_georeference  # noqa: PLC0415
    from smust3r_colmap.synthetic.survey import GCP_FILE, PIXEL_M, write_survey  # noqa: PLC0415

    images, result, points = (command.output / name for name in ("images", "result", GCP_FILE))
    if images.exists() and not points.exists():
        raise InputError(f"{command.output}: has images that are no survey; name another folder with --output")
    if not points.exists():
        reporter.note(f"rendering a survey into {images}")
        write_survey(command.output)
    summary = reconstruct(images, result, _SURVEY_SETTINGS, reporter=reporter)
    tell(summary, reporter, quiet=command.quiet)
    found = georeference_model(result, images, GeoreferenceSettings(gcp=(points,)))
    write_georeference(found, result / "geo")
    print(render_georeference(found))
    for text in (*found.faults, *found.warnings):
        reporter.note(text)
    check = found.accuracies().get("check")
    horizontal, vertical = _SURVEY_MAX_PIXELS
    if check is None or check.horizontal > horizontal * PIXEL_M or check.rmse[2] > vertical * PIXEL_M:
        reporter.warn(f"the check points are not within {horizontal:g} and {vertical:g} pixels: the result is wrong")
        return EXIT_DEGRADED
    return summary.exit_code


def _demo(command: Demo, reporter: Reporter) -> int:
    from smust3r_colmap.evaluation.trajectory import compare_trajectories  # noqa: PLC0415
    from smust3r_colmap.importers.model_poses import read_model_poses  # noqa: PLC0415
    from smust3r_colmap.importers.poses_txt import read_poses_txt  # noqa: PLC0415
    from smust3r_colmap.pipeline import reconstruct  # noqa: PLC0415
    from smust3r_colmap.synthetic.room import write_demo  # noqa: PLC0415  (heavy: --help shall not pay for it)

    truth_file, images, result = (command.output / name for name in ("poses.txt", "images", "result"))
    if images.exists() and not truth_file.exists():
        raise InputError(f"{command.output}: has images that are no demo; name another folder with --output")
    if not truth_file.exists() or len(read_poses_txt(truth_file)) != command.num_images:
        reporter.note(f"rendering {command.num_images} images into {images}")
        write_demo(command.output, num_images=command.num_images)
    truth = read_poses_txt(truth_file)
    others = {path.name for path in images.iterdir()} - truth.keys()
    if others:
        raise InputError(f"{images}: has {len(others)} images of another demo; delete the folder or name another")

    summary = reconstruct(images, result, _DEMO_SETTINGS, reporter=reporter)
    tell(summary, reporter, quiet=command.quiet)
    model = result / summary.models[0].folder
    distance = compare_trajectories(read_model_poses(model), truth)
    print(f"Cameras of {model} against the truth in {truth_file}:\n  {distance.render_text('m')}")
    if distance.position_rmse_percent > _DEMO_MAX_PERCENT:
        reporter.warn(f"that is more than {_DEMO_MAX_PERCENT:.0f} %: the result is wrong")
        return EXIT_DEGRADED
    return summary.exit_code
