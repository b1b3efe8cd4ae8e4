"""``smust3r-colmap report``: a page that shows what a run or a COLMAP model is worth.

A part of the command line, so it prints. The work is done in the package ``report``, which is imported when the command
runs, so that ``--help`` answers at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from smust3r_colmap.errors import ConfigError, InputError
from smust3r_colmap.report.summary import EXIT_GOOD

_HEAD_BYTES = 2000


@dataclass(frozen=True, kw_only=True)
class Report:
    """Write report.html: verdict, images, path, verification matrix, weak links, cameras, cost. One file, no network.

    Of a run it is what reconstruct and refine write. Of a COLMAP model of another program it has what can be told from
    the model and its database.
    """

    result: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN|MODEL")]
    """Output folder of a finished reconstruct or refine; or a COLMAP model, or a folder with sparse/0 in it."""
    images: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Folder of the images, for thumbnails; by default that of the run, or the folder images beside the model."""
    database: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Of a model: the COLMAP database that it was made from; by default the database.db of its scene."""
    output: Annotated[Path | None, tyro.conf.arg(metavar="FILE.html")] = None
    """Write here; by default RUN/report.html, and report.html in this folder for a model."""
    verbose: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print the traceback of an unexpected error."""


def run_report(command: Report) -> int:
    """Write the page, print where it is, and return the exit code.

    Raises:
        InputError: the folder holds no finished run and no model, or a path that was named does not exist.
        RunLockedError: the run is still going on.
        RunDirectoryError, StorageError: a file of the run cannot be read, or the report cannot be written.
    """
    from smust3r_colmap.report.html import GENERATOR, REPORT_FILE  # noqa: PLC0415  (heavy: --help shall not pay for it)

    if command.images is not None and not command.images.is_dir():
        raise InputError(f"--images {command.images}: no such folder")
    root = command.result
    has_lock = (root / "work" / "lock").is_file()
    is_run = has_lock or (root / "summary.json").is_file()
    target = command.output or (root / REPORT_FILE if is_run else Path(REPORT_FILE))
    if target.is_dir():
        raise ConfigError(f"--output {target}: is a folder; name a file, such as {target / REPORT_FILE}")
    if target.is_file() and GENERATOR not in target.read_bytes()[:_HEAD_BYTES]:
        raise InputError(f"{target}: is there already, and no report of ours; name another file with --output")
    if not is_run:
        _report_model(command, target)
    elif command.database is not None:
        raise ConfigError(f"--database {command.database}: is for models; {root} is a run and has its own")
    else:
        _report_run(command, target, has_work=has_lock)
    print(target)
    return EXIT_GOOD


def _report_run(command: Report, target: Path, *, has_work: bool) -> None:
    from smust3r_colmap.exporters.finished_run import check_is_finished, image_folder_of  # noqa: PLC0415  (as above)
    from smust3r_colmap.report.html import RunToReport, report_run  # noqa: PLC0415
    from smust3r_colmap.storage.run_directory import RunDirectory  # noqa: PLC0415

    if not has_work:  # work/ may be deleted when a run is done
        report_run(RunToReport(root=command.result, images=command.images, target=target))
        return
    with RunDirectory(command.result) as run:  # a run that is still going on holds it
        check_is_finished(command.result)
        images = command.images or image_folder_of(run)
        report_run(RunToReport(root=command.result, images=images, target=target))


def _report_model(command: Report, target: Path) -> None:
    from smust3r_colmap.report.html import report_model  # noqa: PLC0415  (as above)
    from smust3r_colmap.validation.layout import find_layout  # noqa: PLC0415

    layout = find_layout(command.result, images=command.images, database=command.database)
    report_model(layout.model, layout.images, layout.database, target)
