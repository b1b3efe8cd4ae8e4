"""How a run tells a person where it stands.

The pipeline sees only ``Reporter`` and ``Stage``. Three reporters exist: bars with the time that is
left on a terminal, plain lines in a log file, and one that only lets warnings through. They write
to the stream they are given and nowhere else. The module that chooses between them is ``cli``.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Protocol, TextIO

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

# A log file gets a line after this share of a stage, but never more often than the interval.
_LINE_EVERY_SHARE = 0.1
_LINE_INTERVAL_S = 5.0

Clock = Callable[[], float]


class Stage(Protocol):
    """One running stage of ``total`` units."""

    def advance(self, count: int = 1) -> None:
        """``count`` more units were done now."""

    def skip(self, count: int) -> None:
        """``count`` more units were found finished by an earlier run."""


class Reporter(Protocol):
    """What the pipeline may say while it runs."""

    def stage(self, name: str, *, total: int) -> AbstractContextManager[Stage]:
        """Open a stage of ``total`` units; a total of 0 means that there is nothing to do."""

    def note(self, text: str) -> None:
        """Something worth knowing."""

    def warn(self, text: str) -> None:
        """Something that makes the result worse."""


class StageTally:
    """Counts of one stage; implements ``Stage`` and tells ``on_change`` after each change.

    Args:
        name: what the stage is called in front of people.
        total: units in all; 0 when there is nothing to do.
        clock: seconds since any fixed moment.
        on_change: called with the tally itself.
    """

    def __init__(self, name: str, total: int, clock: Clock, on_change: Callable[[StageTally], None]) -> None:
        self.name = name
        self.total = total
        self.done = 0
        self.skipped = 0
        self._clock = clock
        self._started_s = clock()
        self._on_change = on_change

    def advance(self, count: int = 1) -> None:
        """``count`` more units were done now."""
        self.done += count
        self._on_change(self)

    def skip(self, count: int) -> None:
        """``count`` more units were found finished by an earlier run."""
        self.skipped += count
        self._on_change(self)

    @property
    def finished(self) -> int:
        """Units that are finished, whoever did them."""
        return self.done + self.skipped

    @property
    def elapsed_s(self) -> float:
        """Seconds since the stage began."""
        return self._clock() - self._started_s

    def closing_line(self) -> str:
        """What to say when the stage is over."""
        if self.total == 0:
            return f"{self.name}: nothing to do"
        if self.skipped >= self.total:
            return f"{self.name}: already done"
        reused = f", {self.skipped} of them already done" if self.skipped else ""
        return f"{self.name}: {self.finished}/{self.total} in {format_seconds(self.elapsed_s)}{reused}"

    def broken_line(self) -> str:
        """What to say when the stage was left by an exception."""
        return f"{self.name}: stopped at {self.finished}/{self.total} after {format_seconds(self.elapsed_s)}"


class TerminalReporter:
    """A bar per stage with the time that is left, then one line that stays.

    Args:
        stream: a terminal.
        clock: seconds since any fixed moment.
    """

    def __init__(self, stream: TextIO, *, clock: Clock = time.monotonic) -> None:
        self._console = Console(file=stream, highlight=False)
        self._clock = clock

    @contextmanager
    def stage(self, name: str, *, total: int) -> Iterator[Stage]:
        """See ``Reporter``."""
        progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
            console=self._console,
            transient=True,
        )
        with progress:
            task = progress.add_task(escape(name), total=total)
            tally = StageTally(name, total, self._clock, lambda tally: _move_bar(progress, task, tally))
            line = tally.broken_line
            try:
                yield tally
                line = tally.closing_line
            finally:
                self.note(line())

    def note(self, text: str) -> None:
        """See ``Reporter``."""
        self._console.print(text, markup=False, soft_wrap=True)

    def warn(self, text: str) -> None:
        """See ``Reporter``."""
        self._console.print(f"warning: {text}", markup=False, style="yellow", soft_wrap=True)


class PlainReporter:
    """Lines without control characters: the start, about every tenth, and the end of a stage.

    Args:
        stream: any text stream.
        clock: seconds since any fixed moment.
    """

    def __init__(self, stream: TextIO, *, clock: Clock = time.monotonic) -> None:
        self._stream = stream
        self._clock = clock

    @contextmanager
    def stage(self, name: str, *, total: int) -> Iterator[Stage]:
        """See ``Reporter``."""
        if total:
            self.note(f"{name}: {total} to do")
        tally = StageTally(name, total, self._clock, _SparseLines(self.note))
        line = tally.broken_line
        try:
            yield tally
            line = tally.closing_line
        finally:
            self.note(line())

    def note(self, text: str) -> None:
        """See ``Reporter``."""
        print(text, file=self._stream, flush=True)

    def warn(self, text: str) -> None:
        """See ``Reporter``."""
        self.note(f"warning: {text}")


class QuietReporter:
    """Only warnings.

    Args:
        stream: any text stream.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    @contextmanager
    def stage(self, name: str, *, total: int) -> Iterator[Stage]:
        """See ``Reporter``."""
        yield StageTally(name, total, time.monotonic, lambda tally: None)

    def note(self, text: str) -> None:
        """See ``Reporter``."""

    def warn(self, text: str) -> None:
        """See ``Reporter``."""
        print(f"warning: {text}", file=self._stream, flush=True)


def reporter_for(stream: TextIO, *, quiet: bool) -> Reporter:
    """The reporter that suits the stream: bars on a terminal, lines elsewhere, warnings if quiet."""
    if quiet:
        return QuietReporter(stream)
    return TerminalReporter(stream) if stream.isatty() else PlainReporter(stream)


def format_seconds(seconds: float) -> str:
    """``0.4 s``, ``12 s``, ``3 min 05 s`` or ``2 h 07 min``."""
    if seconds < 9.95:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


class _SparseLines:
    """Says how far a stage is, but seldom; the reasons stand beside the two constants above."""

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say = say
        self._said_units = 0
        self._said_s = 0.0

    def __call__(self, tally: StageTally) -> None:
        units = tally.finished - self._said_units
        elapsed_s = tally.elapsed_s
        if tally.finished >= tally.total or units < _LINE_EVERY_SHARE * tally.total:
            return
        if elapsed_s - self._said_s < _LINE_INTERVAL_S:
            return
        self._said_units, self._said_s = tally.finished, elapsed_s
        self._say(f"{tally.name}: {tally.finished}/{tally.total}{_remaining(tally)}")


def _remaining(tally: StageTally) -> str:
    """The time that is left, from the units done now; units of an earlier run tell nothing."""
    if not tally.done:
        return ""
    left_s = tally.elapsed_s / tally.done * (tally.total - tally.finished)
    return f", about {format_seconds(left_s)} left"


def _move_bar(progress: Progress, task: TaskID, tally: StageTally) -> None:
    """Show the tally; units of an earlier run leave the total, so that they do not count as speed."""
    progress.update(task, total=tally.total - tally.skipped, completed=tally.done)
