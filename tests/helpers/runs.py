"""Quiet runs for the tests of stages."""

from __future__ import annotations

import sys
from contextlib import AbstractContextManager
from pathlib import Path

from smust3r_colmap.execution.progress import QuietReporter, Reporter
from smust3r_colmap.execution.run_context import Run
from smust3r_colmap.execution.stage_clock import StageClock
from smust3r_colmap.execution.task_pool import TaskPool
from smust3r_colmap.storage.run_directory import RunDirectory


def quiet_run(output: Path, reporter: Reporter | None = None) -> AbstractContextManager[Run]:
    """A run of one worker that holds ``output``; it tells ``reporter``, or warnings only."""
    return Run.open(output, workers=1, seed=0, reporter=reporter or QuietReporter(sys.stderr))


def run_in(folder: RunDirectory, reporter: Reporter | None = None) -> Run:
    """A run in a folder that is held already, for stages that map no tasks."""
    clock = StageClock(reporter or QuietReporter(sys.stderr))
    return Run(folder=folder, clock=clock, executor=TaskPool(workers=1), seed=0)
