"""The command ``reconstruct``."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from smust3r_colmap.cli.console import reporting, tell
from smust3r_colmap.cli.presets import Preset
from smust3r_colmap.config import RunConfig


@dataclass(frozen=True, kw_only=True)
class Reconstruct:
    """Reconstruct images or videos; start the same command again to go on after an interruption."""

    images: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="IMAGES")]
    """Folder of images and videos; or a video."""
    output: Annotated[Path, tyro.conf.arg(metavar="OUT")]
    """Folder of the result; made when missing."""
    config: Annotated[Path | None, tyro.conf.arg(metavar="FILE.toml")] = None
    """Settings, such as segment_length = 40; flags override them. OUT/config.toml of a run can be given back."""
    preset: Preset = "default"
    """Settings that go together, for speed (fast) or for as many images as possible (thorough); the file after
    --config and flags override them."""
    overwrite: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Throw away what an earlier run left in OUT."""
    quiet: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print warnings and errors only."""
    verbose: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print what the stages log, and the traceback of an unexpected error."""
    settings: Annotated[RunConfig, tyro.conf.OmitArgPrefixes, tyro.conf.arg(name="")] = field(default_factory=RunConfig)


def run_reconstruct(command: Reconstruct) -> int:
    """Reconstruct the images; the exit code."""
    from smust3r_colmap.pipeline import reconstruct  # noqa: PLC0415  (heavy: --help shall not pay for it)

    with reporting(quiet=command.quiet, verbose=command.verbose) as reporter:
        summary = reconstruct(
            command.images, command.output, command.settings, overwrite=command.overwrite, reporter=reporter
        )
        tell(summary, reporter, quiet=command.quiet)
        return summary.exit_code
