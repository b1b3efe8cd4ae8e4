"""``smust3r-colmap export``: results of a finished run in any format, without computing anything anew.

A part of the command line, so it prints. The formats are in ``exports``, which is imported when the command runs,
so that ``--help`` answers at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, get_args

import tyro

from smust3r_colmap.cli.console import reporting
from smust3r_colmap.config import OutputConfig
from smust3r_colmap.errors import ConfigError, InputError
from smust3r_colmap.report.summary import EXIT_GOOD

if TYPE_CHECKING:
    from smust3r_colmap.exporters.finished_run import FinishedRun
    from smust3r_colmap.exporters.registry import FormatSettings
    from smust3r_colmap.storage.run_directory import RunDirectory

FormatName = Literal["sparse", "database", "ply", "glb", "tum", "trainer", "dense", "mesh", "list"]

_LIST = "list"


@dataclass(frozen=True, kw_only=True)
class Export:
    """Write results of a finished run again, in any format, without computing anything anew.

    Formats: sparse (COLMAP models), database (that goes with them), ply (cloud), glb (cloud and cameras for viewers),
    tum (trajectory), trainer (for splats and NeRFs), dense (COLMAP's dense workspace), mesh (of the dense workspace);
    list says it line by line.
    """

    run: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]
    """Output folder of a finished reconstruct or refine; `--format list` needs none."""
    format: tuple[FormatName, ...]
    """What to write; several names are several formats."""
    output: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Write here instead of into RUN; what lies there already is not replaced."""
    images: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Where the images of the run are now, if the folder has moved."""
    text: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """sparse: write the COLMAP models as .txt beside the .bin files."""
    trainer_scales: tuple[int, ...] | None = None
    """trainer: smaller copies of the images, such as 2,4,8 for images_2, images_4 and images_8."""
    masks: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """trainer: masks named IMAGE.png after the image, or by its stem; black is ignored. By default those of the run."""
    keep_outliers: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """trainer: keep cameras and points that lie far from all others."""
    mesh: Literal["poisson", "tsdf"] = "poisson"
    """mesh: poisson closes holes, tsdf keeps to what was seen."""
    quiet: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print warnings and errors only."""
    verbose: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print what the stages log, and the traceback of an unexpected error."""


def run_export(command: Export) -> int:
    """Write the formats, print what was written, and return the exit code.

    Raises:
        InputError: RUN is no finished run, its images are gone or have changed, a setting makes no sense, or
            this run cannot be written in one of the formats; the formats before it are written.
        MissingDependencyError, ReconstructionError, RunDirectoryError: as the format says.
    """
    from smust3r_colmap.exporters.finished_run import check_is_finished, open_finished  # noqa: PLC0415
    from smust3r_colmap.exporters.registry import FORMATS  # noqa: PLC0415  (heavy: --help shall not pay for it)
    from smust3r_colmap.storage.run_directory import RunDirectory  # noqa: PLC0415

    taken_for_run = _format_taken_for_run(command)
    if _LIST in (*command.format, taken_for_run):
        width = max(map(len, FORMATS))
        print("\n".join(f"{name:{width}}  {one.about}" for name, one in FORMATS.items()))
        return EXIT_GOOD
    if taken_for_run:
        raise ConfigError(
            f"RUN is missing: {taken_for_run!r} is a format and no folder; "
            f"name the run first, as in `export RUN --format {' '.join((*command.format, taken_for_run))}`"
        )
    settings = _settings(command)
    names = [name for name in FORMATS if name in command.format]
    check_is_finished(command.run)
    with (
        reporting(quiet=command.quiet, verbose=command.verbose) as reporter,
        RunDirectory(command.run) as run,
    ):
        finished = open_finished(run, images=command.images, output=command.output)
        _check_before(run, finished, names, settings)
        for name in names:
            with reporter.stage(name, total=1) as stage:
                written = FORMATS[name].write(finished, settings)
                stage.advance()
            if not command.quiet:
                print(finished.output / written.name)
                for note in written.notes:
                    print(f"  {note}")
    return EXIT_GOOD


def _format_taken_for_run(command: Export) -> str:
    """The last name after ``--format``, which the parser takes for RUN where there is no other; or nothing."""
    name = str(command.run)
    return name if name in get_args(FormatName) and not command.run.is_dir() else ""


def _settings(command: Export) -> FormatSettings:
    from smust3r_colmap.exporters.registry import FormatSettings  # noqa: PLC0415  (as above)

    if not command.format:
        raise ConfigError("--format: name at least one format; --format list says which there are")
    return FormatSettings(
        text=command.text,
        trainer_scales=OutputConfig(trainer_scales=command.trainer_scales).trainer_scales or (),
        masks=command.masks,
        keep_outliers=command.keep_outliers,
        mesh=command.mesh,
    )


def _check_before(run: RunDirectory, finished: FinishedRun, names: Sequence[str], settings: FormatSettings) -> None:
    """Whatever can be refused before the first format is written."""
    from smust3r_colmap.exporters.finished_run import check_images, check_masks_of_run  # noqa: PLC0415
    from smust3r_colmap.exporters.registry import FORMATS  # noqa: PLC0415  (as above)
    from smust3r_colmap.importers.image_folder import check_output_not_inside  # noqa: PLC0415

    if any(FORMATS[name].reads_images for name in names):
        check_images(run, finished)
        check_output_not_inside(finished.images, finished.output)
    if settings.masks is None and any(FORMATS[name].reads_masks for name in names):
        check_masks_of_run(finished)
    if finished.output.resolve() == run.root.resolve():
        return
    if finished.output.exists() and not finished.output.is_dir():
        raise ConfigError(f"--output {finished.output}: is a file; name a folder")
    for name in names:
        result = finished.output / FORMATS[name].result
        if name != "mesh" and result.exists():  # a mesh is added to the workspace that is there
            raise InputError(f"{result}: is there already; delete it or name another folder")
