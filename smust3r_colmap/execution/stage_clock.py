"""What each stage cost, measured while the reporter shows it."""

from __future__ import annotations

import os
import resource
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from smust3r_colmap.execution.progress import Reporter, Stage
from smust3r_colmap.execution.task_pool import living_children_cpu_s


class StageClock:
    """A ``Reporter`` that passes everything on and keeps the cost of each stage.

    Processor time is that of this process and of its children.
    """

    def __init__(self, reporter: Reporter) -> None:
        self._reporter = reporter
        self.stages: list[StageSummary] = []

    @contextmanager
    def stage(self, name: str, *, total: int) -> Iterator[Stage]:
        """As the reporter's, and measured."""
        wall_s, cpu_s = time.monotonic(), _cpu_s()
        with self._reporter.stage(name, total=total) as shown:
            counted = _CountedStage(shown)
            yield counted
        self.stages.append(
            StageSummary(
                name=name,
                wall_s=time.monotonic() - wall_s,
                cpu_s=_cpu_s() - cpu_s,
                reused=counted.skipped > 0 and counted.advanced == 0,
            )
        )

    def note(self, text: str) -> None:
        """Passed on."""
        self._reporter.note(text)

    def warn(self, text: str) -> None:
        """Passed on."""
        self._reporter.warn(text)


class _CountedStage:
    def __init__(self, stage: Stage) -> None:
        self._stage = stage
        self.advanced = 0
        self.skipped = 0

    def advance(self, count: int = 1) -> None:
        self.advanced += count
        self._stage.advance(count)

    def skip(self, count: int) -> None:
        self.skipped += count
        self._stage.skip(count)


def peak_memory_bytes() -> int:
    """Largest resident size that this process or one of its ended children had."""
    unit = 1 if sys.platform == "darwin" else 1024
    peaks = [resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return max(peaks) * unit


def _cpu_s() -> float:
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system + living_children_cpu_s()


@dataclass(frozen=True, kw_only=True)
class StageSummary:
    """What a stage cost.

    Args:
        name: as in the progress report.
        wall_s: time that went by.
        cpu_s: processor time, child processes included.
        reused: everything was found finished by an earlier run.
    """

    name: str
    wall_s: float
    cpu_s: float
    reused: bool
