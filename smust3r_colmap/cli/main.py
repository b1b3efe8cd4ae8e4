"""The command line: ``reconstruct``, ``demo`` and ``doctor``; the other commands are in ``*_command``.

Flags, exit codes and printing live in these modules and nowhere else; the set-up of logging lives here.
Settings come from the defaults, then the TOML file, then the flags. What a command needs is
imported when the command runs, so that ``--help`` answers at once.

Exit codes: 0 good, 1 failed, 2 wrong use, 3 finished but the result is weak, 130 interrupted.
"""

from __future__ import annotations

import argparse
import json
import sys
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from smust3r_colmap import __version__
from smust3r_colmap.cli.console import EXIT_FAILED, EXIT_INTERRUPTED, EXIT_WRONG_USE, fail, reporting, tell
from smust3r_colmap.cli.demo import Demo, run_demo
from smust3r_colmap.cli.export import Export, run_export
from smust3r_colmap.cli.reconstruct import Reconstruct, run_reconstruct
from smust3r_colmap.cli.refine import Refine, run_refine
from smust3r_colmap.cli.validate import Validate, run_validate
from smust3r_colmap.cli.weights import WeightsAction, WeightsCommand, run_weights
from smust3r_colmap.errors import ConfigError, InputError, SmustrError
from smust3r_colmap.report.summary import EXIT_GOOD
from smust3r_colmap.storage.config_file import flags_from_settings, read_settings

_DESCRIPTION = """Offline structure from motion for COLMAP workflows, segment by segment.

Exit codes: 0 good, 1 failed, 2 wrong use, 3 finished but the result is weak, 130 interrupted.
--version prints the version."""


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
        return fail(str(error), EXIT_WRONG_USE)
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
        return fail(str(error), EXIT_WRONG_USE)
    except SmustrError as error:
        return fail(str(error), EXIT_FAILED)
    except KeyboardInterrupt:
        return fail("interrupted; the same command goes on where it stopped", EXIT_INTERRUPTED)
    except Exception as error:  # the outermost border: an unknown error is a message too
        if command.verbose:
            traceback.print_exc()
        return fail(f"unexpected {type(error).__name__}: {error}. This is a defect; --verbose shows where", EXIT_FAILED)


def _run(command: Command) -> int:
    match command:
        case Reconstruct():
            exit_code = run_reconstruct(command)
        case Refine():
            exit_code = _run_refine(command)
        case Export():
            with reporting(quiet=command.quiet, verbose=command.verbose) as reporter:
                exit_code = run_export(command, reporter)
        case Validate():
            exit_code = run_validate(command)
        case Demo():
            exit_code = run_demo(command)
        case Doctor():
            exit_code = _run_doctor(command)
        case _:
            exit_code = _run_weights(command)
    return exit_code


def _run_refine(command: Refine) -> int:
    with reporting(quiet=command.quiet, verbose=command.verbose) as reporter:
        summary = run_refine(command, reporter)
        tell(summary, reporter, quiet=command.quiet)
        return summary.exit_code


def _run_weights(action: WeightsAction) -> int:
    with reporting(quiet=action.quiet, verbose=action.verbose) as reporter:
        return run_weights(action, reporter)


def _run_doctor(command: Doctor) -> int:
    from smust3r_colmap.cli.doctor import examine  # noqa: PLC0415  (needed by this command only)

    diagnosis = examine()
    print(json.dumps(diagnosis.to_json_dict(), indent=1) if command.json else diagnosis.render_text())
    return EXIT_GOOD if diagnosis.healthy else EXIT_FAILED
