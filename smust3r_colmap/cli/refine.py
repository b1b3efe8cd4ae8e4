"""``smust3r-colmap refine``: tracks and bundle adjustment for a model that another program made.

``refine_model`` does the work and is imported when the command runs, so that ``--help`` answers at once.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from smust3r_colmap.cli.console import reporting, tell
from smust3r_colmap.config import RefineConfig


@dataclass(frozen=True, kw_only=True)
class Refine:
    """Give a COLMAP model that another program made real tracks, and adjust it to them (VGGT, MASt3R and the like).

    Poses must be as COLMAP has them, camera from world: camera centres in place of translations, or rotations
    the other way round, cannot be told from the numbers, and no track will agree with them. Start the same
    command again to go on after an interruption.
    """

    model: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="MODEL")]
    """Folder with cameras and images, .bin or .txt, or one with sparse/0 in it; points help, but may be missing."""
    images: Annotated[Path, tyro.conf.arg(metavar="IMAGES")]
    """Folder of the images at full size; files are found by name, base name or name without suffix."""
    output: Annotated[Path, tyro.conf.arg(metavar="OUT")] = Path("refined_out")
    """Folder of the result; made when missing."""
    config: Annotated[Path | None, tyro.conf.arg(metavar="FILE.toml")] = None
    """Settings, such as pose_tolerance = 0.02; flags override them."""
    overwrite: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Throw away what an earlier run left in OUT."""
    quiet: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print warnings and errors only."""
    verbose: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print what the stages log, and the traceback of an unexpected error."""
    settings: Annotated[RefineConfig, tyro.conf.OmitArgPrefixes, tyro.conf.arg(name="")] = field(
        default_factory=RefineConfig
    )


def run_refine(command: Refine) -> int:
    """Refine the model; the exit code. Errors leave as they are, see ``refine_model``."""
    from smust3r_colmap.refine_model import refine_model  # noqa: PLC0415  (heavy: --help shall not pay for it)

    with reporting(quiet=command.quiet, verbose=command.verbose) as reporter:
        summary = refine_model(
            command.model,
            command.images,
            command.output,
            command.settings,
            overwrite=command.overwrite,
            reporter=reporter,
        )
        tell(summary, reporter, quiet=command.quiet)
        return summary.exit_code
