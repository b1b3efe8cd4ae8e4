"""The command ``frames``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from smust3r_colmap.cli.console import reporting
from smust3r_colmap.config import VideoConfig
from smust3r_colmap.errors import InputError
from smust3r_colmap.report.summary import EXIT_DEGRADED, EXIT_GOOD


@dataclass(frozen=True, kw_only=True)
class Frames:
    """Take the frames of videos that are worth an image, and write them as JPEG.

    Frames of DIR/VIDEO/ are named by their time in seconds; after each cut of the video a subfolder begins. A table
    frames.csv beside them has times and sharpness.
    """

    videos: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="VIDEO")]
    """One or several videos."""
    output: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    """Folder that gets a folder for each video; what lies there already is not replaced."""
    quiet: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print warnings and errors only."""
    verbose: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print what the stages log, and the traceback of an unexpected error."""
    settings: Annotated[VideoConfig, tyro.conf.OmitArgPrefixes, tyro.conf.arg(name="")] = field(
        default_factory=VideoConfig
    )


def run_frames(command: Frames) -> int:
    """Write the frames of each video; the exit code.

    Raises:
        InputError: a video cannot be used, has a name that another has, or its frames are there already. The videos
            before it are written.
        MissingDependencyError: PyAV is not installed.
        StorageError: the disk refused.
    """
    from smust3r_colmap.execution.task_pool import usable_cores  # noqa: PLC0415  (heavy: --help shall not pay for it)
    from smust3r_colmap.importers.video import open_video  # noqa: PLC0415
    from smust3r_colmap.importers.video_frames import name_folders, write_frames  # noqa: PLC0415
    from smust3r_colmap.storage.atomic_write import atomic_folder  # noqa: PLC0415

    _check_are_files(command.videos)
    videos = name_folders(command.videos)
    for video in videos:
        if (command.output / video.frames_folder).exists():
            raise InputError(f"{command.output / video.frames_folder}: is there already; delete it or name another")
    exit_code = EXIT_GOOD
    with reporting(quiet=command.quiet, verbose=command.verbose) as reporter:
        for video in videos:
            folder = command.output / video.frames_folder
            with open_video(video.path, name=video.name, threads=1) as opened:
                total = opened.whole_seconds
            with reporter.stage(video.name, total=total) as progress, atomic_folder(folder, may_hold=()) as partial:
                report = write_frames(
                    video,
                    partial,
                    fps=command.settings.fps,
                    max_frames=command.settings.max_frames,
                    threads=usable_cores(),
                    advance=progress.advance,
                )
            if not command.quiet:
                print(f"{folder}: {report}")
            if report.faults:
                reporter.warn(f"{video.name}: {report.faults}")
                exit_code = EXIT_DEGRADED
    return exit_code


def _check_are_files(videos: Sequence[Path]) -> None:
    if not videos:
        raise InputError("name at least one video")
    for video in videos:
        if not video.is_file():
            raise InputError(
                f"{video}: {'is a folder; name the videos' if video.exists() else 'there is no such file'}"
            )
