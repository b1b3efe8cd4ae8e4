from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from smust3r_colmap.errors import InputError
from smust3r_colmap.importers.seven_scenes import read_seven_scenes

TURNED = "0 -1 0 1\n1 0 0 2\n0 0 1 3\n0 0 0 1\n"


def test_a_sequence_is_read_in_order_with_names_of_its_colour_images(tmp_path: Path) -> None:
    for number in (10, 2):
        (tmp_path / f"frame-{number:06d}.pose.txt").write_text(TURNED.replace("3", str(number)))
    (tmp_path / "frame-000002.depth.png").touch()
    poses = read_seven_scenes(tmp_path)
    assert poses.names == ("frame-000002.color.png", "frame-000010.color.png")
    assert poses.numbers is not None
    assert poses.numbers.tolist() == [2, 10]
    np.testing.assert_array_equal(poses.world_from_cam[1], [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 10]])
    assert poses.unit == "m"
    assert poses.depth is not None
    assert poses.depth.files == {"frame-000002.color.png": tmp_path / "frame-000002.depth.png"}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (TURNED.replace("0 0 1 3", "0 0 1"), "line 3: 3 numbers; needed 4"),
        (TURNED.replace("0 0 1 3\n", ""), "3 rows"),
        (TURNED.replace("0 0 1 3", "0 0 inf 3"), "line 3: a number is not finite"),
        (TURNED.replace("0 0 1 3", "0 0 2 3"), "not a rotation"),
        ("", "0 rows"),
    ],
)
def test_a_broken_pose_is_refused_with_its_file(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "frame-000000.pose.txt").write_text(text)
    with pytest.raises(InputError, match=f"frame-000000.pose.txt.*{message}"):
        read_seven_scenes(tmp_path)


def test_a_folder_without_frames_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"has no frame-\*.pose.txt"):
        read_seven_scenes(tmp_path)
