"""Exit codes, messages and logging of the command line."""

from __future__ import annotations

import logging
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

from smust3r_colmap.execution.progress import Reporter, reporter_for
from smust3r_colmap.report.summary import RunSummary

EXIT_FAILED = 1
EXIT_WRONG_USE = 2
EXIT_INTERRUPTED = 130


def tell(summary: RunSummary, reporter: Reporter, *, quiet: bool) -> None:
    """The whole summary on standard output, or no more than why it is weak."""
    if not quiet:
        print(summary.render_text())
        return
    for reason in summary.weak_reasons:
        reporter.warn(reason)


@contextmanager
def reporting(*, quiet: bool, verbose: bool) -> Iterator[Reporter]:
    """Progress and log messages go to standard error; results alone go to standard output."""
    reporter = reporter_for(sys.stderr, quiet=quiet)
    handler = _ReporterHandler(reporter)
    package_logger = logging.getLogger("smust3r_colmap")
    level_before = package_logger.level
    package_logger.addHandler(handler)
    package_logger.setLevel(logging.DEBUG if verbose else logging.WARNING)
    package_logger.propagate = False
    try:
        with warnings.catch_warnings():
            # Pillow warns three times of every broken EXIF, with paths of its own; the import names such files.
            warnings.filterwarnings("ignore", module=r"PIL\.")
            yield reporter
    finally:
        package_logger.removeHandler(handler)
        package_logger.setLevel(level_before)
        package_logger.propagate = True


class _ReporterHandler(logging.Handler):
    """Hands log messages to the reporter, so that they do not tear the progress bars."""

    def __init__(self, reporter: Reporter) -> None:
        super().__init__()
        self._reporter = reporter

    def emit(self, record: logging.LogRecord) -> None:
        """Warnings and worse as warnings, the rest as notes."""
        say = self._reporter.warn if record.levelno >= logging.WARNING else self._reporter.note
        say(self.format(record))


def fail(text: str, exit_code: int) -> int:
    """Print the message of an error and hand its exit code on."""
    print(f"smust3r-colmap: {text}", file=sys.stderr)
    return exit_code
