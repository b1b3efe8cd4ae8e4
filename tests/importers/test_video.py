"""Video files: true times, upright pixels, what is broken is left out and counted, what is no video is refused."""

from __future__ import annotations

import sys
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from helpers.videos import SIZE, view, write_sound, write_video

from smust3r_colmap.errors import MissingDependencyError, VideoError
from smust3r_colmap.geometry.arrays import UInt8Array
from smust3r_colmap.importers.video import open_video


def read(path: Path, *, threads: int = 1) -> tuple[list[float], list[UInt8Array], float]:
    """Times, pixels, and seconds lost."""
    with open_video(path, name=path.name, threads=threads) as video:
        frames = [(frame.time_s, frame.rgb()) for frame in video]
        return [time for time, _ in frames], [pixels for _, pixels in frames], video.lost_s


def walk(count: int) -> list[UInt8Array]:
    return [view(3.0 * k) for k in range(count)]


# -------------------------------------------------------------------------------- times
@pytest.mark.parametrize("name", ["clip.mp4", "clip.mov", "clip.mkv", "CLIP.MP4"])
def test_containers_give_all_frames_at_their_times(tmp_path: Path, name: str) -> None:
    images = walk(25)
    times, pixels, lost_s = read(write_video(tmp_path / name, images))
    assert times == pytest.approx([k / 10 for k in range(25)], abs=1e-3)
    assert lost_s == 0
    for there, here in zip(images, pixels, strict=True):
        assert np.abs(there.astype(int) - here).mean() < 5
        assert np.corrcoef(there[..., 0].ravel(), here[..., 0].ravel())[0, 1] > 0.99


def test_a_variable_frame_rate_is_in_the_times(tmp_path: Path) -> None:
    wanted = [0.0, 0.04, 0.4, 0.433, 1.9, 2.0, 5.25]
    times, _, lost_s = read(write_video(tmp_path / "vfr.mkv", walk(7), times_s=wanted))
    assert times == pytest.approx(wanted, abs=1e-3)
    assert lost_s == 0


def test_a_video_that_begins_later_keeps_its_times(tmp_path: Path) -> None:
    times, _, _ = read(write_video(tmp_path / "late.mkv", walk(3), times_s=[1.5, 1.6, 1.8]))
    assert times == pytest.approx([1.5, 1.6, 1.8], abs=1e-3)


def test_the_length_is_known_before_anything_is_decoded(tmp_path: Path) -> None:
    path = write_video(tmp_path / "clip.mp4", walk(25))
    with open_video(path, name="clip", threads=1) as video:
        assert video.length_s() == pytest.approx(2.5, abs=0.01)
        assert video.whole_seconds == 3


# ------------------------------------------------------------------------------- upright
MARKED = np.full((48, 80, 3), 120, np.uint8)
MARKED[:16, :16], MARKED[:16, -16:], MARKED[-16:, :16] = (250, 20, 20), (20, 250, 20), (20, 20, 250)


@pytest.mark.parametrize("quarters", [0, 1, 2, 3])
@pytest.mark.parametrize("mirrored", [False, True])
def test_the_display_matrix_is_applied(tmp_path: Path, quarters: int, mirrored: bool) -> None:
    path = write_video(
        tmp_path / "turned.mp4", [MARKED] * 3, rotation_deg=90 * quarters, mirrored=mirrored, codec="libx264"
    )
    _, pixels, _ = read(path)
    shown = np.rot90(MARKED, quarters)  # counter-clockwise, as PyAV says
    if mirrored:
        shown = shown[:, ::-1]  # after the rotation, as PyAV says
    assert pixels[0].shape == shown.shape
    assert np.abs(pixels[0].astype(int) - shown).mean() < 12


def test_pixels_that_are_not_square_are_made_so(tmp_path: Path) -> None:
    path = write_video(tmp_path / "wide.mp4", walk(2), pixel_aspect=Fraction(4, 3))
    _, pixels, _ = read(path)
    assert pixels[0].shape == (SIZE[1], round(SIZE[0] * 4 / 3), 3)


# -------------------------------------------------------------------------------- damage
def cut_off(path: Path, share: float) -> Path:
    data = path.read_bytes()
    short = path.with_name(f"short_{path.name}")
    short.write_bytes(data[: round(share * len(data))])
    return short


@pytest.mark.parametrize(("name", "options"), [("clip.mp4", {"movflags": "faststart"}), ("clip.mkv", {})])
def test_a_broken_tail_is_decoded_up_to_the_fault(tmp_path: Path, name: str, options: dict[str, str]) -> None:
    whole = write_video(tmp_path / name, walk(60), container_options=options)
    all_times, all_pixels, _ = read(whole)
    times, pixels, lost_s = read(cut_off(whole, 0.6))
    assert 20 < len(times) < 45
    assert times == all_times[: len(times)]
    assert all((a == b).all() for a, b in zip(pixels, all_pixels, strict=False))
    assert lost_s == pytest.approx(6 - len(times) / 10, abs=0.06)


@pytest.mark.parametrize("threads", [1, 4])
def test_after_a_fault_nothing_is_shown_before_the_next_key_frame(tmp_path: Path, threads: int) -> None:
    whole = write_video(tmp_path / "clip.mp4", walk(60), container_options={"movflags": "faststart"})
    all_times, all_pixels, _ = read(whole)
    data = bytearray(whole.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 3000] = np.random.default_rng(0).bytes(3000)
    whole.write_bytes(data)
    times, pixels, lost_s = read(whole, threads=threads)
    assert 30 < len(times) < 58
    assert times[-1] == pytest.approx(5.9, abs=1e-3)
    assert lost_s == pytest.approx(6 - len(times) / 10, abs=0.06)
    right = dict(zip(all_times, all_pixels, strict=True))
    assert all((right[time] == image).all() for time, image in zip(times, pixels, strict=True))


def test_frames_whose_time_goes_back_are_left_out_and_counted(tmp_path: Path) -> None:
    first = write_video(tmp_path / "a.ts", walk(10), key_frame_every=1)
    again = tmp_path / "twice.mts"
    again.write_bytes(first.read_bytes() * 2)
    with open_video(again, name="twice", threads=1) as video:
        times = [frame.time_s for frame in video]
    assert (np.diff(times) > 0).all()
    assert video.num_decoded == len(times) >= 10
    assert video.num_decoded + video.num_out_of_order == 20


# ------------------------------------------------------------------------------- refusals
def test_what_is_no_video_is_refused(tmp_path: Path) -> None:
    (tmp_path / "empty.mp4").touch()
    (tmp_path / "text.mp4").write_text("no video " * 100)
    good = write_video(tmp_path / "good.mp4", walk(5))
    (tmp_path / "unknown.mp4").write_bytes(good.read_bytes().replace(b"avc1", b"zzzz"))
    cut = cut_off(good, 0.7)  # the index is at the end
    refusals = {
        "empty.mp4": r"empty\.mp4: the file is empty",
        "text.mp4": r"text\.mp4: is no video, or one that was cut off before its index",
        "unknown.mp4": r"unknown\.mp4: its codec is not known to PyAV",
        cut.name: r"short_good\.mp4: is no video, or one that was cut off before its index",
        write_sound(tmp_path / "sound.mp4").name: r"sound\.mp4: has no video stream, but audio",
        "absent.mp4": r"absent\.mp4: cannot be read \(No such file",
    }
    for name, message in refusals.items():
        with pytest.raises(VideoError, match=message), open_video(tmp_path / name, name=name, threads=1):
            pass


def test_a_missing_package_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_video(tmp_path / "good.mp4", walk(2))
    monkeypatch.setitem(sys.modules, "av", None)
    with (
        pytest.raises(MissingDependencyError, match=r"pip install smust3r-colmap\[video\]"),
        open_video(path, name="good", threads=1),
    ):
        pass
