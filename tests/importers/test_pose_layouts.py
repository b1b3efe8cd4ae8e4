from __future__ import annotations

from pathlib import Path

import pytest

from smust3r_colmap.errors import InputError
from smust3r_colmap.importers.pose_layouts import find_layout, read_pose_sets

TUM = "1.5 1 2 3 0 0 0 1\n"
KITTI = "1 0 0 0 0 1 0 0 0 0 1 0\n"
NAMED = "a.jpg 1 0 0 0 1 2 3\n"


@pytest.mark.parametrize(
    ("files", "named", "layout"),
    [
        ({"t.txt": TUM}, "t.txt", "tum"),
        ({"t.txt": "# comment\n" + KITTI}, "t.txt", "kitti"),
        ({"t.txt": NAMED}, "t.txt", "poses-txt"),
        ({"data.csv": ""}, "data.csv", "euroc"),
        ({"transforms.json": ""}, "transforms.json", "transforms"),
        ({"groundtruth.txt": TUM, "rgb.txt": ""}, ".", "tum"),
        ({"groundtruth.txt": TUM, "calibration.txt": ""}, ".", "eth3d-slam"),
        ({"frame-000000.pose.txt": ""}, ".", "7-scenes"),
        ({"poses.txt": NAMED, "intrinsics.txt": ""}, ".", "poses-txt"),
        ({"poses.txt": KITTI, "calib.txt": "", "times.txt": ""}, ".", "kitti"),
        ({"calib.txt": "", "times.txt": ""}, ".", "kitti"),
        ({"mav0/cam0/data.csv": ""}, ".", "euroc"),
        ({"state_groundtruth_estimate0/data.csv": ""}, ".", "euroc"),
        ({"transforms.json": "", "reference_sparse/images.txt": ""}, ".", "transforms"),
        ({"transforms.json": "", "sparse/0/images.bin": ""}, ".", "colmap"),
        ({"images.bin": "", "cameras.bin": ""}, ".", "colmap"),
    ],
)
def test_layouts_are_told_from_files(tmp_path: Path, files: dict[str, str], named: str, layout: str) -> None:
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    assert find_layout(tmp_path / named) == layout


@pytest.mark.parametrize(
    ("text", "message"),
    [("", "has no pose"), ("# a\n1 2 3\n", r"line 2: 3 words; needed 8 .* or 12 .*: tum, eth3d-slam, 7-scenes")],
)
def test_what_has_no_layout_is_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "t.txt").write_text(text)
    with pytest.raises(InputError, match=f"t.txt.*{message}"):
        read_pose_sets(tmp_path / "t.txt")


def test_what_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="gone: there is no such file or folder"):
        read_pose_sets(tmp_path / "gone")


def test_a_named_layout_is_not_questioned(tmp_path: Path) -> None:
    """A name that is a number looks like a time."""
    (tmp_path / "poses.txt").write_text("000001 1 0 0 0 1 2 3\n")
    assert find_layout(tmp_path / "poses.txt") == "tum"
    (poses,) = read_pose_sets(tmp_path / "poses.txt", "poses-txt")
    assert poses.names == ("000001",)
