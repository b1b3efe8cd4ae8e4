"""``smust3r-colmap validate``: is a COLMAP model sound, and which programs would refuse it?

A part of the command line, so it prints. The work is done in the package ``validation``, which is
imported when the command runs, so that ``--help`` answers at once.
"""

from __future__ import annotations

import json
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

_NARROWEST = 60


@dataclass(frozen=True, kw_only=True)
class Validate:
    """Say what is wrong with a COLMAP model and which programs would refuse it.

    Exit code 0: none of them does; 3: one does; 1: the model cannot be read; 2: wrong use.
    """

    model: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="MODEL")]
    """Folder with the .bin or .txt files, or a scene, training dataset or dense workspace that holds one."""
    images: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Image files of the model; by default the folder images of its scene."""
    database: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """COLMAP database that the model shall be continued with; by default the database.db of its scene."""
    readers: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME ...")] = ()
    """Programs whose verdict counts, such as COLMAP gsplat; by default all in the table."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print JSON."""
    verbose: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print the traceback of an unexpected error."""


def run_validate(command: Validate) -> int:
    """Print the report and return the exit code.

    Raises:
        InputError: a path or a reader that was named does not exist.
        StorageError: a file of the model cannot be opened.
    """
    from smust3r_colmap.validation.layout import UnreadableModelError  # noqa: PLC0415  (--help shall not pay for it)
    from smust3r_colmap.validation.readers import find_readers  # noqa: PLC0415
    from smust3r_colmap.validation.report import EXIT_UNREADABLE  # noqa: PLC0415
    from smust3r_colmap.validation.validate import validate  # noqa: PLC0415

    readers = find_readers(command.readers)
    try:
        report = validate(command.model, images=command.images, database=command.database, readers=readers)
    except UnreadableModelError as error:  # an answer to the question, not wrong use
        if command.json:
            unreadable = {"model": str(command.model), "readable": False, "exit_code": EXIT_UNREADABLE}
            print(json.dumps({**unreadable, "reason": str(error)}, indent=1))
        else:
            print(f"smust3r-colmap: {error}", file=sys.stderr)
        return EXIT_UNREADABLE
    print(json.dumps(report.to_json_dict(), indent=1) if command.json else report.render_text(width=_width()))
    return report.exit_code


def _width() -> int | None:
    """Lines are wrapped for a terminal; in a file or a pipe every finding stays one line."""
    return max(_NARROWEST, shutil.get_terminal_size().columns) if sys.stdout.isatty() else None
