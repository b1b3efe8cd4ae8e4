"""Frames as files: names, table, cuts, folders of several videos, videos beside images, and the stage of a run."""

from __future__ import annotations

import csv
import os
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.videos import view, write_sound, write_video
from PIL import Image

from smust3r_colmap.config import CameraConfig, RunConfig, VideoConfig
from smust3r_colmap.errors import CollectionError, MissingDependencyError, VideoError
from smust3r_colmap.execution.progress import QuietReporter
from smust3r_colmap.execution.run_context import Run
from smust3r_colmap.exporters.finished_run import begin_stages
from smust3r_colmap.importers.image_folder import import_image_folder, natural_key
from smust3r_colmap.importers.stage import ImageSource, check_folders, read_images, take_frames
from smust3r_colmap.importers.video_frames import VideoFile, VideoReport, find_files, name_folders, write_frames

EVERY = VideoConfig(fps=10)
"""Every frame of the videos below."""


def clip(path: Path, count: int = 6, *, start: int = 0, times_s: list[float] | None = None) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    return write_video(path, [view(3.0 * (start + k)) for k in range(count)], times_s=times_s)


def frames_of(path: Path, folder: Path, *, fps: float | None = 10, max_frames: int | None = None) -> VideoReport:
    folder.mkdir()
    video = VideoFile(path=path, name=path.name, frames_folder="clip")
    return write_frames(video, folder, fps=fps, max_frames=max_frames, threads=1, advance=lambda seconds: None)


def files(folder: Path) -> list[str]:
    """Images below a folder, in the order in which they are processed."""
    found = (path.relative_to(folder).as_posix() for path in folder.rglob("*.jpg"))
    return sorted(found, key=natural_key)


def photograph(path: Path, at: float) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(view(at)).save(path)


# ----------------------------------------------------------------------------------- files
def test_names_are_times_and_their_order_is_that_of_time(tmp_path: Path) -> None:
    times_s = [0.0, 0.5, 9.999, 10.0, 100.25, 3600.125]
    report = frames_of(clip(tmp_path / "clip.mkv", times_s=times_s), tmp_path / "out")
    assert files(tmp_path / "out") == [f"{time:010.3f}.jpg" for time in times_s]
    assert (report.num_decoded, report.num_taken, report.num_shots, report.faults) == (6, 6, 1, "")


def test_the_table_has_the_name_the_video_the_time_and_the_sharpness(tmp_path: Path) -> None:
    frames_of(clip(tmp_path / "clip.mkv", count=3, times_s=[0.0, 0.141, 2.0]), tmp_path / "out")
    with (tmp_path / "out/frames.csv").open(newline="") as table:
        rows = list(csv.DictReader(table))
    assert [row["name"] for row in rows] == files(tmp_path / "out")
    assert {row["video"] for row in rows} == {"clip.mkv"}
    assert [float(row["timestamp_s"]) for row in rows] == [0.0, 0.141, 2.0]
    assert all(float(row["sharpness"]) > 1 for row in rows)


def test_the_collection_has_the_times_of_the_table(tmp_path: Path) -> None:
    frames_of(clip(tmp_path / "clip.mkv", count=3, times_s=[0.0, 0.141, 2.0]), tmp_path / "out")
    photograph(tmp_path / "out/photo.png", 5.0)
    collection = import_image_folder(tmp_path / "out", CameraConfig())
    assert [image.timestamp_s for image in collection.images] == [0.0, 0.141, 2.0, None]


def test_a_table_of_somebody_else_is_passed_over_and_a_broken_one_refused(tmp_path: Path) -> None:
    for at in range(2):
        photograph(tmp_path / f"{at}.png", at)
    (tmp_path / "frames.csv").write_text("frame,time\n0.png,now\n")
    assert import_image_folder(tmp_path, CameraConfig()).images[0].timestamp_s is None
    (tmp_path / "frames.csv").write_text("name,video,timestamp_s,sharpness\n0.png,clip.mp4,now,1\n")
    with pytest.raises(CollectionError, match=r"frames\.csv, line 2: needed are a name and a time"):
        import_image_folder(tmp_path, CameraConfig())


def test_a_cut_begins_a_subfolder_that_comes_after(tmp_path: Path) -> None:
    images = [view(3.0 * k) for k in range(8)] + [(view(3.0 * k, seed=1) // 3).astype(np.uint8) for k in range(8)]
    report = frames_of(write_video(tmp_path / "film.mp4", images), tmp_path / "out")
    assert report.num_shots == 2
    assert [name.partition("/")[0] for name in files(tmp_path / "out")][8:] == ["cut_002"] * 8
    assert files(tmp_path / "out")[8] == "cut_002/000000.800.jpg"
    assert str(report) == "16 of 16 frames taken, 1 cuts"


@pytest.mark.parametrize(("fps", "max_frames", "count"), [(None, 5, 5), (10, 5, 5), (2, 5, 3), (None, 100, 15)])
def test_at_most_so_many_frames_are_taken_evenly(
    tmp_path: Path, fps: float | None, max_frames: int, count: int
) -> None:
    report = frames_of(clip(tmp_path / "clip.mp4", count=15), tmp_path / "out", fps=fps, max_frames=max_frames)
    assert report.num_taken == len(files(tmp_path / "out")) == count
    times_s = np.array([float(name.removesuffix(".jpg")) for name in files(tmp_path / "out")])
    assert np.diff(times_s).max() <= 1.5 * 1.5 / count


def test_a_video_of_one_frame_gives_one(tmp_path: Path) -> None:
    report = frames_of(clip(tmp_path / "clip.mp4", count=1), tmp_path / "out", fps=None)
    assert (report.num_decoded, report.num_taken) == (1, 1)


def test_what_is_lost_is_said() -> None:
    whole = VideoReport(num_decoded=9, num_taken=3, num_shots=1, num_out_of_order=0, duration_s=9.0, lost_s=0.0)
    assert whole.faults == ""
    broken = replace(whole, lost_s=1.25, num_out_of_order=4)
    assert broken.faults == "1.2 of 9.0 s cannot be decoded, 4 frames whose time goes back"


# --------------------------------------------------------------------------------- folders
def test_folders_are_named_after_the_videos(tmp_path: Path) -> None:
    for name in ("b/walk.mp4", "b/walk.mov", "walk10.mp4", "walk2.MKV", "house.mp4", ".hidden.mp4"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    photograph(tmp_path / "House/1.png", 0)
    found = find_files(tmp_path)
    assert {video.name: video.frames_folder for video in found.videos} == {
        "b/walk.mp4": "b/walk.mp4",
        "b/walk.mov": "b/walk.mov",
        "walk10.mp4": "walk10",
        "walk2.MKV": "walk2",
        "house.mp4": "house.mp4",
    }
    assert [video.name for video in found.videos][-2:] == ["walk2.MKV", "walk10.mp4"]
    assert found.images == ("House/1.png",)


def test_films_of_live_photos_are_left_out(tmp_path: Path) -> None:
    photograph(tmp_path / "IMG_1.jpg", 0)
    for name in ("IMG_1.MOV", "IMG_2.MOV"):
        (tmp_path / name).touch()
    found = find_files(tmp_path)
    assert [video.name for video in found.videos] == ["IMG_2.MOV"]
    assert [one.name for one in found.left_out] == ["IMG_1.MOV"]
    assert "Live Photo" in found.left_out[0].reason


def test_names_that_cannot_be_used_are_left_out_or_refused(tmp_path: Path) -> None:
    name = os.fsdecode(b"caf\xe9.mp4")
    (tmp_path / name).touch()
    (tmp_path / "gone.mp4").symlink_to(tmp_path / "nowhere.mp4")
    found = find_files(tmp_path)
    assert found.videos == ()
    assert {one.name: one.reason.partition(";")[0] for one in found.left_out} == {
        "caf\\xe9.mp4": "the file name is not valid UTF-8 or has control characters",
        "gone.mp4": "no regular file, or a link to nothing",
    }
    with pytest.raises(CollectionError, match=r"caf\\xe9\.mp4: the file name is not valid UTF-8"):
        find_files(tmp_path / name)


def test_videos_of_one_name_are_refused(tmp_path: Path) -> None:
    with pytest.raises(CollectionError, match=r"clip\.mp4: 2 videos have this name"):
        name_folders([clip(tmp_path / "a/clip.mp4", 1), clip(tmp_path / "b/clip.mp4", 1)])


# ----------------------------------------------------------------------------------- stage
@pytest.fixture
def take(tmp_path: Path) -> Callable[..., ImageSource]:
    """Takes the frames of a source into a run below ``tmp_path``."""

    def frames(source: Path, video: VideoConfig = EVERY, *, overwrite: bool = False) -> ImageSource:
        config = RunConfig(video=video, workers=1)
        with Run.open(tmp_path / "run", workers=1, seed=0, reporter=QuietReporter(sys.stderr)) as run:
            taken = take_frames(run, source, config, overwrite=overwrite)
            scan, _ = read_images(run, taken, config, overwrite=overwrite)
            begin_stages(run, scan, overwrite=overwrite)
            return taken

    return frames


def test_videos_beside_folders_of_images_become_one_folder(tmp_path: Path, take: Callable[..., ImageSource]) -> None:
    source = tmp_path / "source"
    clip(source / "one.mp4", 3)
    clip(source / "more/two.mov", 2, start=9)
    for k in range(2):
        photograph(source / f"more/photos/{k}.jpg", 40 + 5 * k)
    taken = take(source)
    expected = [f"more/photos/{k}.jpg" for k in range(2)] + [f"more/two/000000.{k}00.jpg" for k in range(2)]
    assert files(taken.folder) == expected + [f"one/000000.{k}00.jpg" for k in range(3)]
    assert os.path.samefile(taken.folder / "more/photos/1.jpg", source / "more/photos/1.jpg")
    assert taken.left_out == ()


def test_frames_are_taken_once(tmp_path: Path, take: Callable[..., ImageSource]) -> None:
    source = clip(tmp_path / "clip.mp4")
    first = take(source).folder
    before = (first / "clip/000000.100.jpg").stat().st_mtime_ns
    assert take(source).folder == first
    assert (first / "clip/000000.100.jpg").stat().st_mtime_ns == before
    take(source, overwrite=True)
    assert (first / "clip/000000.100.jpg").stat().st_mtime_ns != before


def test_other_settings_take_other_frames_and_remove_those_of_before(
    tmp_path: Path, take: Callable[..., ImageSource]
) -> None:
    source = clip(tmp_path / "clip.mp4")
    first = take(source).folder
    second = take(source, VideoConfig(max_frames=2)).folder
    assert len(files(second)) == 2
    assert not first.exists()


def test_photographs_that_came_and_went_are_followed(tmp_path: Path, take: Callable[..., ImageSource]) -> None:
    source = tmp_path / "source"
    clip(source / "clip.mp4", 2)
    photograph(source / "a.jpg", 0)
    assert files(take(source).folder) == ["a.jpg", "clip/000000.000.jpg", "clip/000000.100.jpg"]
    (source / "a.jpg").rename(source / "b.jpg")
    assert files(take(source).folder) == ["b.jpg", "clip/000000.000.jpg", "clip/000000.100.jpg"]


def test_a_folder_without_videos_is_used_as_it_is(tmp_path: Path, take: Callable[..., ImageSource]) -> None:
    for k in range(2):
        photograph(tmp_path / f"photos/{k}.jpg", 5 * k)
    assert take(tmp_path / "photos") == ImageSource(folder=tmp_path / "photos")


def test_a_video_that_cannot_be_used_is_left_out_of_a_folder(
    tmp_path: Path, take: Callable[..., ImageSource], capsys: pytest.CaptureFixture[str]
) -> None:
    source = tmp_path / "source"
    clip(source / "good.mp4")
    write_sound(source / "sound.mp4")
    taken = take(source)
    assert [(one.name, one.reason) for one in taken.left_out] == [
        ("sound.mp4", "sound.mp4: has no video stream, but audio")
    ]
    assert "left out: sound.mp4" in capsys.readouterr().err


def test_what_a_broken_tail_lost_is_told(tmp_path: Path, take: Callable[..., ImageSource]) -> None:
    whole = clip(tmp_path / "whole.mkv", 60)
    source = tmp_path / "broken.mkv"
    source.write_bytes(whole.read_bytes()[: round(0.6 * whole.stat().st_size)])
    (lost,) = take(source).left_out
    assert lost.name == "broken.mkv"
    assert lost.reason.endswith("of 6.0 s cannot be decoded")
    assert take(source).left_out == (lost,)  # as told by the first start


def test_a_video_alone_that_cannot_be_used_is_refused(
    tmp_path: Path, take: Callable[..., ImageSource], monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(VideoError, match="no video stream"):
        take(write_sound(tmp_path / "sound.mp4"))
    source = clip(tmp_path / "good.mp4")
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(MissingDependencyError, match=r"smust3r-colmap\[video\]"):
        take(source)


def test_photographs_are_used_without_the_package_for_videos(
    tmp_path: Path, take: Callable[..., ImageSource], monkeypatch: pytest.MonkeyPatch
) -> None:
    source = tmp_path / "source"
    clip(source / "clip.mp4")
    for k in range(2):
        photograph(source / f"{k}.jpg", 5 * k)
    monkeypatch.setitem(sys.modules, "av", None)
    taken = take(source)
    assert files(taken.folder) == ["0.jpg", "1.jpg"]
    assert "smust3r-colmap[video]" in taken.left_out[0].reason


def test_too_few_frames_are_refused_with_the_way_out(tmp_path: Path, take: Callable[..., ImageSource]) -> None:
    with pytest.raises(CollectionError, match=r"one\.mp4: 1 of 1 video frames taken, at least 2 are needed$"):
        take(clip(tmp_path / "one.mp4", 1), VideoConfig())
    still = write_video(tmp_path / "still.mp4", [view(0)] * 20)
    with pytest.raises(CollectionError, match=r"still\.mp4: 1 of 20 video frames .*the camera hardly moves: --fps"):
        take(still, VideoConfig())


def test_a_file_that_is_no_video_is_refused_by_its_name(tmp_path: Path) -> None:
    photograph(tmp_path / "photo.jpg", 0)
    with pytest.raises(CollectionError, match=r"photo\.jpg: is a file; give the folder"):
        check_folders(tmp_path / "photo.jpg", tmp_path / "out", None)
    clip(tmp_path / "clip.mp4", 1)
    check_folders(tmp_path / "clip.mp4", tmp_path / "out", None)


def test_an_earlier_run_keeps_its_frames_until_the_new_input_is_known_to_be_of_use(
    tmp_path: Path, take: Callable[..., ImageSource]
) -> None:
    kept = take(clip(tmp_path / "good.mp4")).folder
    with pytest.raises(CollectionError):
        take(clip(tmp_path / "one.mp4", 1))
    assert len(files(kept)) == 6


@pytest.mark.data
def test_a_walk_is_cut_nowhere_and_its_turns_are_dense(data_dir: Callable[[str], Path], tmp_path: Path) -> None:
    """``office_loop`` has 237 images with few to spare; every image shown four times, three of four are none."""
    images = sorted((data_dir("office_loop") / "images").iterdir())[60:120]
    small = [np.asarray(Image.open(path).reduce(2)) for path in images]
    small = [image[: image.shape[0] // 2 * 2, : image.shape[1] // 2 * 2] for image in small]
    source = write_video(tmp_path / "walk.mp4", (image for image in small for _ in range(4)), rate=40)
    report = frames_of(source, tmp_path / "out", fps=None)
    times_s = np.array([float(name.removesuffix(".jpg")) for name in files(tmp_path / "out")])
    assert (report.num_decoded, report.num_shots) == (240, 1)
    assert 30 <= report.num_taken <= 60
    assert len({int(time * 10 + 1e-6) for time in times_s}) == report.num_taken  # no image twice
    assert np.diff(times_s).max() < 0.35  # and never more than two in a row left out
