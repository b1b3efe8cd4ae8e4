"""The command line: what was typed becomes a command with its settings, and the command is run.

Settings come from the defaults, then the preset, then the TOML file, then the flags. There is one file per command
beside this one; ``fields`` says how their dataclasses become flags. What a command needs is imported when it runs,
so that ``--help`` answers at once.

Exit codes: 0 good, 1 failed, 2 wrong use, 3 finished with warnings, 130 interrupted.
"""

from __future__ import annotations

import argparse
import difflib
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path

import tyro

from smust3r_colmap import __version__
from smust3r_colmap.cli.console import EXIT_FAILED, EXIT_INTERRUPTED, EXIT_WRONG_USE, fail
from smust3r_colmap.cli.demo import Demo, run_demo
from smust3r_colmap.cli.doctor import Doctor, run_doctor
from smust3r_colmap.cli.evaluate import Evaluate, run_evaluate
from smust3r_colmap.cli.export import Export, run_export
from smust3r_colmap.cli.fields import REGISTRY
from smust3r_colmap.cli.frames import Frames, run_frames
from smust3r_colmap.cli.georeference import Georeference, run_georeference
from smust3r_colmap.cli.presets import PRESETS
from smust3r_colmap.cli.reconstruct import Reconstruct, run_reconstruct
from smust3r_colmap.cli.refine import Refine, run_refine
from smust3r_colmap.cli.report import Report, run_report
from smust3r_colmap.cli.validate import Validate, run_validate
from smust3r_colmap.cli.weights import WeightsCommand, run_weights
from smust3r_colmap.config import RefineConfig, RunConfig
from smust3r_colmap.errors import ConfigError, InputError, SmustrError
from smust3r_colmap.report.summary import EXIT_GOOD
from smust3r_colmap.storage.config_file import flags_from_settings, read_settings

_DESCRIPTION = """Offline structure from motion for COLMAP workflows, segment by segment.

Exit codes: 0 good, 1 failed, 2 wrong use, 3 finished with warnings, 130 interrupted.
--version prints the version."""

Command = (
    Reconstruct
    | Refine
    | Frames
    | Export
    | Georeference
    | Report
    | Validate
    | Evaluate
    | Demo
    | Doctor
    | WeightsCommand
)

COMMANDS = (
    *("reconstruct", "refine", "frames", "export", "georeference", "report", "validate", "evaluate"),
    *("demo", "doctor", "weights"),
)
SETTINGS = {"reconstruct": RunConfig, "refine": RefineConfig}
"""The commands that take a settings file, and what it may hold."""


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
    """The command with all its settings: defaults, then the preset, then the file after ``--config``, then flags.

    Raises:
        ConfigError: there is no such command, or the file or a setting is not as it should be.
        SystemExit: the flags are wrong (2), or help was asked for (0).
    """
    if arguments and not arguments[0].startswith("-") and arguments[0] not in COMMANDS:
        near = difflib.get_close_matches(arguments[0], COMMANDS, n=1)
        meant = f" (did you mean {near[0]}?)" if near else ""
        raise ConfigError(f"there is no command {arguments[0]!r}{meant}; the commands are {', '.join(COMMANDS)}")
    command: Command = tyro.cli(
        Command,
        prog="smust3r-colmap",
        description=_DESCRIPTION,
        args=_with_preset_and_file(arguments),
        registry=REGISTRY,
    )
    return command


def _with_preset_and_file(arguments: Sequence[str]) -> list[str]:
    """Their settings as flags before those that were typed: of two equal flags the last counts."""
    name = arguments[0] if arguments else ""
    if name not in SETTINGS:
        return list(arguments)
    finder = argparse.ArgumentParser(prog=f"smust3r-colmap {name}", add_help=False, allow_abbrev=False)
    finder.add_argument("--config", type=Path)
    finder.add_argument("--preset")
    found = finder.parse_known_args(arguments)[0]
    of_preset = flags_from_settings(PRESETS.get(found.preset, {})) if name == "reconstruct" else []
    of_file = [] if found.config is None else flags_from_settings(read_settings(found.config, SETTINGS[name]))
    return [name, *of_preset, *of_file, *arguments[1:]]


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
    except OSError as error:  # what the system refuses outside of the run's folder
        if command.verbose:
            traceback.print_exc()
        where = f"{error.filename}: " if error.filename else ""
        return fail(f"{where}{error.strerror or error}", EXIT_FAILED)
    except Exception as error:  # the outermost border: an unknown error is a message too
        if command.verbose:
            traceback.print_exc()
        return fail(f"unexpected {type(error).__name__}: {error}. This is a defect; --verbose shows where", EXIT_FAILED)


def _run(command: Command) -> int:  # noqa: PLR0911  (one return per command)
    match command:
        case Reconstruct():
            return run_reconstruct(command)
        case Refine():
            return run_refine(command)
        case Frames():
            return run_frames(command)
        case Export():
            return run_export(command)
        case Georeference():
            return run_georeference(command)
        case Report():
            return run_report(command)
        case Validate():
            return run_validate(command)
        case Evaluate():
            return run_evaluate(command)
        case Demo():
            return run_demo(command)
        case Doctor():
            return run_doctor(command)
        case _:
            return run_weights(command)
