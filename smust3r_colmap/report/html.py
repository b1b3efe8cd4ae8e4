"""``report.html``: what a run or a model is worth, in one file that opens anywhere.

    facts       what is said, read from the run or the model      agreement, measure, plan, thumbnails
    page        how it is said: HTML and SVG, drawn by ourselves  charts, markup, style

The next module to read is ``facts``.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from smust3r_colmap.config import ModelOutputConfig
from smust3r_colmap.errors import ReconstructionError, SmustrError, StorageError
from smust3r_colmap.execution.run_context import Run
from smust3r_colmap.execution.task_pool import TaskFailure, in_child
from smust3r_colmap.products import ImageCollection
from smust3r_colmap.report.facts import FEATURES, facts_of_failure, facts_of_model, facts_of_run
from smust3r_colmap.report.page import render
from smust3r_colmap.storage.atomic_write import write_atomically

REPORT_FILE = "report.html"
GENERATOR = b'<meta name="generator" content="smust3r-colmap">'
"""In the head of every report; a file without it is somebody else's."""


@dataclass(frozen=True, kw_only=True)
class RunToReport:
    """A run whose results are written.

    Args:
        root: its folder. images: the folder of its images, or None. target: the file to be written.
    """

    root: Path
    images: Path | None
    target: Path


def write_report(run: Run, images: Path, options: ModelOutputConfig) -> None:
    """The report of a run that has just been finished, if it is wanted; a report that fails is a warning."""
    if not options.report:
        return
    task = RunToReport(root=run.folder.root, images=images, target=run.folder.root / REPORT_FILE)
    with run.clock.stage("report", total=1) as stage:
        try:
            outcome = in_child(report_run, task, log_file=run.folder.native_log)
        except StorageError as error:
            outcome = TaskFailure(reason=str(error), crashed=False)
        stage.advance()
    if isinstance(outcome, TaskFailure):
        run.clock.warn(f"no {REPORT_FILE}: {outcome.reason}")


@contextmanager
def failure_reported(run: Run, collection: ImageCollection, options: ModelOutputConfig) -> Iterator[None]:
    """Write a report if no model comes out, with what the images have in common; the error goes on."""
    try:
        yield
    except ReconstructionError as error:
        if options.report:
            try:
                page = render(facts_of_failure(collection, run.folder.root / FEATURES, str(error)))
                write_atomically(run.folder.root / REPORT_FILE, page.encode())
            except SmustrError as problem:
                run.clock.warn(f"no {REPORT_FILE}: {problem}")
        raise


def report_run(task: RunToReport) -> None:
    """Write the report of a run.

    Raises:
        InputError, StorageError: as ``facts_of_run``; the disk refused.
    """
    write_atomically(task.target, render(facts_of_run(task.root, task.images)).encode())


def report_model(model: Path, images: Path | None, database: Path | None, target: Path) -> None:
    """Write the report of a model of any program.

    Raises:
        InputError, StorageError: as ``facts_of_model``; the disk refused.
    """
    write_atomically(target, render(facts_of_model(model, images, database)).encode())
