"""The command line: ``reconstruct``, ``demo`` and ``doctor``; the other commands are in ``*_command``.

Flags, exit codes and printing live in these modules and nowhere else; the set-up of logging lives here.
Settings come from the defaults, then the TOML file, then the flags. What a command needs is
imported when the command runs, so that ``--help`` answers at once.

Exit codes: 0 good, 1 failed, 2 wrong use, 3 finished but the result is weak, 130 interrupted.
"""

from __future__ import annotations

import argparse
import json
import logging
import sys
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from smust3r_colmap import __version__
from smust3r_colmap.config import ClassicalConfig, RunConfig, SegmentationConfig
from smust3r_colmap.storage.config_file import flags_from_settings, read_settings
from smust3r_colmap.errors import ConfigError, InputError, SmustrError
from smust3r_colmap.cli.export import Export, run_export
from smust3r_colmap.execution.progress import Reporter, reporter_for
from smust3r_colmap.cli.refine import Refine, run_refine
from smust3r_colmap.report.summary import EXIT_GOOD, EXIT_WEAK, RunSummary
from smust3r_colmap.cli.validate import Validate, run_validate
from smust3r_colmap.cli.weights import WeightsAction, WeightsCommand, run_weights

EXIT_FAILED = 1
EXIT_WRONG_USE = 2
EXIT_INTERRUPTED = 130

# Position error of the demo, in percent of the path's extent, above which something is broken; a
# tenth of a percent is usual.
_DEMO_WEAK_PERCENT = 5.0

# The demo's walls are covered with texture; a quarter of the features does, in a third of the time.
_DEMO_SETTINGS = RunConfig(
    classical=ClassicalConfig(max_features=1500),
    segmentation=SegmentationConfig(segment_length=20, overlap=10),  # enough segments for a loop
)

_DESCRIPTION = """Offline structure from motion for COLMAP workflows, segment by segment.

Exit codes: 0 good, 1 failed, 2 wrong use, 3 finished but the result is weak, 130 interrupted.
--version prints the version."""


@dataclass(frozen=True, kw_only=True)
class Reconstruct:
    """Reconstruct a folder of images; start the same command again to go on after an interruption."""

    images: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="IMAGES")]
    """Folder of images, in the order of their names."""
    output: Annotated[Path, tyro.conf.arg(metavar="OUT")]
    """Folder of the result; made when missing."""
    config: Annotated[Path | None, tyro.conf.arg(metavar="FILE.toml")] = None
    """Settings, such as segment_length = 40; flags override them."""
    fresh: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Throw away what an earlier run left in OUT."""
    quiet: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print warnings and errors only."""
    verbose: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print what the stages log, and the traceback of an unexpected error."""
    settings: Annotated[RunConfig, tyro.conf.OmitArgPrefixes, tyro.conf.arg(name="")] = field(default_factory=RunConfig)


@dataclass(frozen=True, kw_only=True)
class Demo:
    """Render a made-up room, reconstruct it and say how far the result is from the truth."""

    output: Annotated[Path, tyro.conf.arg(metavar="OUT")] = Path("demo_out")
    """Folder for the images, the truth and the result."""
    num_images: int = 80
    """Images on the way round the room."""
    quiet: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print the figures, warnings and errors only."""
    verbose: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print what the stages log, and the traceback of an unexpected error."""


@dataclass(frozen=True, kw_only=True)
class Doctor:
    """Say what this machine has, what works on it and what is missing."""

    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print JSON."""
    verbose: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print the traceback of an unexpected error."""


Command = Reconstruct | Refine | Export | Validate | Demo | Doctor | WeightsCommand


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code; bad flags and ``--help`` leave by SystemExit."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if arguments == ["--version"]:
        print(f"smust3r-colmap {__version__}")
        return EXIT_GOOD
    try:
        command = parse(arguments)
    except ConfigError as error:
        return _fail(str(error), EXIT_WRONG_USE)
    return _run_guarded(command)


def parse(arguments: Sequence[str]) -> Command:
    """The command with all its settings: defaults, then the file after ``--config``, then flags.

    Raises:
        ConfigError: the file or a setting is not as it should be.
        SystemExit: the flags are wrong (2), or help was asked for (0).
    """
    command: Command = tyro.cli(
        Command,
        prog="smust3r-colmap",
        description=_DESCRIPTION,
        args=_with_settings_of_file(arguments),
    )
    return command


def _with_settings_of_file(arguments: Sequence[str]) -> list[str]:
    """The settings of the file as flags before those that were typed: of two equal flags the last counts."""
    if arguments[:1] != ["reconstruct"]:
        return list(arguments)
    finder = argparse.ArgumentParser(prog="smust3r-colmap reconstruct", add_help=False, allow_abbrev=False)
    finder.add_argument("--config", type=Path)
    path = finder.parse_known_args(arguments)[0].config
    from_file = [] if path is None else flags_from_settings(read_settings(path))
    return ["reconstruct", *from_file, *arguments[1:]]


def _run_guarded(command: Command) -> int:
    """Run the command; every way in which it may end has its exit code and its message."""
    try:
        return _run(command)
    except InputError as error:
        return _fail(str(error), EXIT_WRONG_USE)
    except SmustrError as error:
        return _fail(str(error), EXIT_FAILED)
    except KeyboardInterrupt:
        return _fail("interrupted; the same command goes on where it stopped", EXIT_INTERRUPTED)
    except Exception as error:  # the outermost border: an unknown error is a message too
        if command.verbose:
            traceback.print_exc()
        return _fail(
            f"unexpected {type(error).__name__}: {error}. This is a defect; --verbose shows where", EXIT_FAILED
        )


def _run(command: Command) -> int:
    match command:
        case Reconstruct():
            exit_code = _run_reconstruct(command)
        case Refine():
            exit_code = _run_refine(command)
        case Export():
            with _reporting(quiet=command.quiet, verbose=command.verbose) as reporter:
                exit_code = run_export(command, reporter)
        case Validate():
            exit_code = run_validate(command)
        case Demo():
            exit_code = _run_demo(command)
        case Doctor():
            exit_code = _run_doctor(command)
        case _:
            exit_code = _run_weights(command)
    return exit_code


def _run_reconstruct(command: Reconstruct) -> int:
    from smust3r_colmap.pipeline import reconstruct  # noqa: PLC0415  (heavy: --help shall not pay for it)

    with _reporting(quiet=command.quiet, verbose=command.verbose) as reporter:
        summary = reconstruct(command.images, command.output, command.settings, fresh=command.fresh, reporter=reporter)
        _tell(summary, reporter, quiet=command.quiet)
        return summary.exit_code


def _run_refine(command: Refine) -> int:
    with _reporting(quiet=command.quiet, verbose=command.verbose) as reporter:
        summary = run_refine(command, reporter)
        _tell(summary, reporter, quiet=command.quiet)
        return summary.exit_code


def _run_demo(command: Demo) -> int:
    with _reporting(quiet=command.quiet, verbose=command.verbose) as reporter:
        return _demo(command, reporter)


def _demo(command: Demo, reporter: Reporter) -> int:
    from smust3r_colmap.synthetic.room import write_demo  # noqa: PLC0415  (heavy: --help shall not pay for it)
    from smust3r_colmap.evaluation.trajectory import (  # noqa: PLC0415
        compare_trajectories,
        read_poses_txt,
        read_reference_sparse,
    )
    from smust3r_colmap.pipeline import reconstruct  # noqa: PLC0415

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
    _tell(summary, reporter, quiet=command.quiet)
    model = result / summary.models[0].folder
    distance = compare_trajectories(read_reference_sparse(model), truth)
    print(f"Cameras of {model} against the truth in {truth_file}:\n  {distance.render_text('m')}")
    if distance.position_rmse_percent > _DEMO_WEAK_PERCENT:
        reporter.warn(f"that is more than {_DEMO_WEAK_PERCENT:.0f} %: the result is wrong")
        return EXIT_WEAK
    return summary.exit_code


def _tell(summary: RunSummary, reporter: Reporter, *, quiet: bool) -> None:
    """The whole summary on standard output, or no more than why it is weak."""
    if not quiet:
        print(summary.render_text())
        return
    for reason in summary.weak_reasons:
        reporter.warn(reason)


def _run_weights(action: WeightsAction) -> int:
    with _reporting(quiet=action.quiet, verbose=action.verbose) as reporter:
        return run_weights(action, reporter)


def _run_doctor(command: Doctor) -> int:
    from smust3r_colmap.cli.doctor import examine  # noqa: PLC0415  (needed by this command only)

    diagnosis = examine()
    print(json.dumps(diagnosis.to_json_dict(), indent=1) if command.json else diagnosis.render_text())
    return EXIT_GOOD if diagnosis.healthy else EXIT_FAILED


@contextmanager
def _reporting(*, quiet: bool, verbose: bool) -> Iterator[Reporter]:
    """Progress and log messages go to standard error; results alone go to standard output."""
    reporter = reporter_for(sys.stderr, quiet=quiet)
    handler = _ReporterHandler(reporter)
    package_logger = logging.getLogger("smust3r_colmap")
    level_before = package_logger.level
    package_logger.addHandler(handler)
    package_logger.setLevel(logging.DEBUG if verbose else logging.WARNING)
    package_logger.propagate = False
    try:
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


def _fail(text: str, exit_code: int) -> int:
    print(f"smust3r-colmap: {text}", file=sys.stderr)
    return exit_code
