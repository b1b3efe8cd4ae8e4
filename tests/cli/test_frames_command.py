"""The command ``frames``: what it writes, prints and refuses."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.videos import view, write_sound, write_video

from smust3r_colmap.cli.main import main


def clip(path: Path, count: int = 30) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    return write_video(path, (view(1.0 * k) for k in range(count)))


def test_each_video_gets_a_folder_with_frames_and_a_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    videos = [clip(tmp_path / "one.mp4"), clip(tmp_path / "two.mkv", 20)]
    assert main(["frames", *map(str, videos), "--output", str(tmp_path / "out"), "--fps", "5"]) == 0
    assert len(list((tmp_path / "out/one").glob("*.jpg"))) == 15
    assert len(list((tmp_path / "out/two").glob("*.jpg"))) == 10
    assert len((tmp_path / "out/two/frames.csv").read_text().splitlines()) == 11
    shown = capsys.readouterr()
    assert f"{tmp_path}/out/one: 15 of 30 frames taken" in shown.out
    assert "one.mp4: 3/3" in shown.err


def test_frames_are_taken_by_motion_unless_told_otherwise(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["frames", str(clip(tmp_path / "one.mp4")), "--output", str(tmp_path), "--quiet"]) == 0
    assert 3 <= len(list((tmp_path / "one").glob("*.jpg"))) <= 8  # 29 pixels at 4 to 8 pixels each
    assert capsys.readouterr().out == ""


def test_a_broken_tail_is_told_by_message_and_exit_code(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole = clip(tmp_path / "whole.mkv", 60)
    broken = tmp_path / "broken.mkv"
    broken.write_bytes(whole.read_bytes()[: round(0.6 * whole.stat().st_size)])
    assert main(["frames", str(broken), "--output", str(tmp_path / "out")]) == 3
    assert "warning: broken.mkv: " in capsys.readouterr().err
    assert list((tmp_path / "out/broken").glob("*.jpg"))


def test_refusals_leave_nothing_behind(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sound, good = write_sound(tmp_path / "sound.mp4"), clip(tmp_path / "good.mp4", 2)
    (tmp_path / "out/good").mkdir(parents=True)
    for words, message in {
        (str(sound),): "sound.mp4: has no video stream, but audio",
        (str(good),): "out/good: is there already; delete it or name another",
        (str(tmp_path / "none.mp4"),): "none.mp4: there is no such file",
        (str(tmp_path),): "is a folder; name the videos",
        (str(good), "--fps", "0"): "--fps 0.0: must be above 0",
        (str(good), "--max-frames", "0"): "--max-frames 0: must be at least 1",
    }.items():
        assert main(["frames", *words, "--output", str(tmp_path / "out")]) == 2, words
        assert message in capsys.readouterr().err
    assert [path.name for path in (tmp_path / "out").rglob("*")] == ["good"]
