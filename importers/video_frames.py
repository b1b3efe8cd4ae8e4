"""Frames of videos as image files: ``VIDEO/000012.345.jpg``, named by their time, with a table of them.

The first shot of a video lies in its folder itself, later ones in ``cut_002``, ``cut_003`` ..., so that each is a
sequence of its own. ``frames.csv`` beside them is the table. The next module to read is ``frame_times``, which reads it
again.
"""

from __future__ import annotations

import csv
import math
import os
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from PIL import Image

from smust3r_colmap.errors import CollectionError, VideoError
from smust3r_colmap.importers.frame_selection import choose_frames
from smust3r_colmap.importers.frame_times import COLUMNS, FRAMES_FILE
from smust3r_colmap.importers.image_folder import natural_key, printable, unusable_entry, walk
from smust3r_colmap.importers.images import SUFFIXES
from smust3r_colmap.importers.video import VIDEO_SUFFIXES, open_video
from smust3r_colmap.products import RejectedImage

_JPEG_QUALITY = 95


# ---------------------------------------------------------------------------- what there is
@dataclass(frozen=True, kw_only=True)
class VideoFile:
    """A video in a folder.

    Args:
        path: of the file.
        name: path below the folder, with forward slashes.
        frames_folder: where its frames belong, below the folder of all images.
    """

    path: Path
    name: str
    frames_folder: str


@dataclass(frozen=True, kw_only=True)
class FoundFiles:
    """The files of an input.

    Args:
        videos: in natural order.
        images: names of all other files that an import reads, and of folders that cannot be read.
        left_out: films of Live Photos, and videos with names that cannot be used.
    """

    videos: tuple[VideoFile, ...]
    images: tuple[str, ...]
    left_out: tuple[RejectedImage, ...]


def is_video(path: Path) -> bool:
    """By the suffix."""
    return path.suffix.lower() in VIDEO_SUFFIXES


def find_files(source: Path) -> FoundFiles:
    """The videos and images of a folder, or a video alone.

    Raises:
        CollectionError: a video alone has a name that cannot be used.
    """
    if source.is_file():
        return FoundFiles(videos=name_folders([source]), images=(), left_out=())
    names, images = list[str](), list[str]()
    reasons = dict[str, str]()
    for name, problem in walk(source):
        suffix = PurePosixPath(name).suffix.lower()
        if not problem and suffix in VIDEO_SUFFIXES:
            names.append(name)
        elif problem or suffix in SUFFIXES or PurePosixPath(name).name == FRAMES_FILE:
            images.append(name)
    stems = {_stem(name) for name in images}
    for name in names:
        if reason := unusable_entry(source, name):
            reasons[name] = reason
        elif _stem(name) in stems:
            reasons[name] = "a photograph beside it has its name: the film of a Live Photo"
    taken = {str(parent).casefold() for name in images for parent in PurePosixPath(name).parents}
    return FoundFiles(
        videos=_with_folders([(source / name, name) for name in names if name not in reasons], taken),
        images=tuple(images),
        left_out=tuple(
            RejectedImage(name=printable(name), reason=reasons[name]) for name in sorted(reasons, key=natural_key)
        ),
    )


def name_folders(paths: Iterable[Path]) -> tuple[VideoFile, ...]:
    """Videos of any place, each with a folder for its frames.

    Raises:
        CollectionError: two have the same file name, or one has a name that cannot be used.
    """
    named = [(path, path.name) for path in paths]
    for path, name in named:
        if reason := unusable_entry(path.parent, name):
            raise CollectionError(f"{printable(name)}: {reason}")
    for name, count in Counter(name for _, name in named).items():
        if count > 1:
            raise CollectionError(f"{name}: {count} videos have this name; rename them, for their frames need names")
    return _with_folders(named, set())


def _stem(name: str) -> str:
    return str(PurePosixPath(name).with_suffix("")).casefold()


def _with_folders(named: Iterable[tuple[Path, str]], taken: set[str]) -> tuple[VideoFile, ...]:
    """Folders are named after the videos, without suffix where this is unique among them and the ``taken``."""
    ordered = sorted(named, key=lambda one: natural_key(one[1]))
    stems = Counter(_stem(name) for _, name in ordered)
    videos = []
    for path, name in ordered:
        is_unique = stems[_stem(name)] == 1 and _stem(name) not in taken
        folder = str(PurePosixPath(name).with_suffix("")) if is_unique else name
        videos.append(VideoFile(path=path, name=name, frames_folder=folder))
    return tuple(videos)


def link_images(source: Path, names: Iterable[str], folder: Path) -> None:
    """Links to images of ``source`` at the same names in ``folder``, beside the frames; those of before go.

    Raises:
        OSError: the disk refused.
    """
    for path in [path for path in folder.rglob("*") if path.is_symlink()]:
        path.unlink()
    for name in names:
        link = folder / name
        link.parent.mkdir(parents=True, exist_ok=True)
        os.symlink((source / name).resolve(), link)


# ------------------------------------------------------------------------------------ frames
@dataclass(frozen=True, kw_only=True)
class VideoReport:
    """What became of one video.

    Args:
        num_decoded, num_taken: frames.
        num_shots: parts between cuts, of which frames were taken.
        num_out_of_order: frames that were left out, because their time is not after that of the one before.
        duration_s: as its header says.
        lost_s: seconds that could not be decoded.
    """

    num_decoded: int
    num_taken: int
    num_shots: int
    num_out_of_order: int
    duration_s: float
    lost_s: float

    @property
    def faults(self) -> str:
        """What is missing; empty where nothing is."""
        faults = []
        if self.lost_s:
            faults.append(f"{self.lost_s:.1f} of {self.duration_s:.1f} s cannot be decoded")
        if self.num_out_of_order:
            faults.append(f"{self.num_out_of_order} frames whose time goes back")
        return ", ".join(faults)

    def __str__(self) -> str:
        cuts = f", {self.num_shots - 1} cuts" if self.num_shots > 1 else ""
        return f"{self.num_taken} of {self.num_decoded} frames taken{cuts}"


def write_frames(
    video: VideoFile,
    folder: Path,
    *,
    fps: float | None,
    max_frames: int | None,
    threads: int,
    advance: Callable[[int], None],
) -> VideoReport:
    """Decode a video once and write the frames that are taken.

    Args:
        video: the file.
        folder: an empty one, for the images and their table.
        fps: frames per second of video; None takes them by the motion of the image.
        max_frames: at most, evenly spread in time; None for no limit.
        threads: of the decoder.
        advance: told about seconds of video that were decoded, ``Video.whole_seconds`` in all.

    Raises:
        MissingDependencyError: PyAV is not installed.
        VideoError: the file is no video, or no frame of it can be decoded.
    """
    if max_frames is not None:
        with open_video(video.path, name=video.name, threads=threads) as opened:
            fps = min(max_frames / opened.length_s(), math.inf if fps is None else fps)
    rows, shots, told_s = [COLUMNS], set[int](), 0
    with open_video(video.path, name=video.name, threads=threads) as opened:
        for chosen in choose_frames(opened, fps=fps):
            time_s = chosen.frame.time_s
            name = f"{'' if chosen.shot == 1 else f'cut_{chosen.shot:03d}/'}{time_s:010.3f}.jpg"
            (folder / name).parent.mkdir(exist_ok=True)
            Image.fromarray(chosen.frame.rgb()).save(folder / name, quality=_JPEG_QUALITY)
            rows.append([name, video.name, f"{time_s:.6f}", f"{chosen.sharpness:.1f}"])
            shots.add(chosen.shot)
            seconds = min(math.floor(time_s), opened.whole_seconds)
            advance(seconds - told_s)
            told_s = seconds
        advance(opened.whole_seconds - told_s)
        report = VideoReport(
            num_decoded=opened.num_decoded,
            num_taken=len(rows) - 1,
            num_shots=len(shots),
            num_out_of_order=opened.num_out_of_order,
            duration_s=opened.duration_s,
            lost_s=opened.lost_s,
        )
    if not report.num_taken:
        raise VideoError(f"{video.name}: no frame of it can be decoded")
    with (folder / FRAMES_FILE).open("w", newline="", encoding="utf-8") as table:
        csv.writer(table, lineterminator="\n").writerows(rows)
    return report
