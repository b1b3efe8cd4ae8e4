from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from smust3r_colmap.errors import InputError
from smust3r_colmap.importers.tum_rgbd import read_tum, read_tum_folder

HEADER = "# ground truth trajectory\n# timestamp tx ty tz qx qy qz qw\n"
TURNED = "0 0 0.70710678 0.70710678"
"""A quarter turn about z, the scalar last."""


def test_a_line_is_time_centre_and_quaternion_with_the_scalar_last(tmp_path: Path) -> None:
    path = tmp_path / "trajectory.txt"
    path.write_text(f"{HEADER}1305031102.25 1 2 3 {TURNED}\n1305031102.0 4 5 6 0 0 0 1\n")
    poses = read_tum(path)
    assert poses.stamps_s is not None
    np.testing.assert_array_equal(poses.stamps_s, [1305031102.0, 1305031102.25])
    np.testing.assert_allclose(poses.world_from_cam[0], np.column_stack([np.eye(3), [4, 5, 6]]))
    np.testing.assert_allclose(poses.world_from_cam[1], [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3]], atol=1e-8)
    assert (poses.unit, poses.names, poses.numbers) == ("units", (), None)


def test_whole_times_are_numbers_of_frames(tmp_path: Path) -> None:
    path = tmp_path / "trajectory.txt"
    path.write_text("0.000 1 2 3 0 0 0 1\n7.000 1 2 3 0 0 0 1\n")
    numbers = read_tum(path).numbers
    assert numbers is not None
    assert numbers.tolist() == [0, 7]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1.5 1 2 3 0 0 0\n", "line 1: 7 numbers; needed 8: timestamp"),
        ("1.5 1 2 3 0 0 0 x\n", "line 1: could not convert string to float: 'x'"),
        ("1.5 1 2 nan 0 0 0 1\n", "line 1: a number is not finite"),
        ("1.5 1 2 3 0 0 0 1\n\n2.5 1 2 3 0 0 0 0.9\n", "line 3: the quaternion has length 0.9; needed 1"),
        ("1.5 1 2 3 0 0 0 1\n2 1 2 3 0 0 0 1\n1.5 1 2 3 0 0 0 1\n", r"the time 1.500000 comes twice \(.*line 3"),
        ("# timestamp tx ty tz qw qx qy qz\n1.5 1 2 3 1 0 0 0\n", "line 1: says that qw comes before qx"),
        ("# nothing\n", "has no pose"),
        ("", "has no pose"),
    ],
)
def test_broken_trajectories_are_refused_with_file_and_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "trajectory.txt"
    path.write_text(text)
    with pytest.raises(InputError, match=f"trajectory.txt.*{message}"):
        read_tum(path)


def test_a_folder_has_truth_times_of_images_and_the_depth_nearest_in_time(tmp_path: Path) -> None:
    (tmp_path / "groundtruth.txt").write_text(f"{HEADER}10.1 1 2 3 0 0 0 1\n")
    (tmp_path / "rgb.txt").write_text("# color images\n10.11 rgb/10.11.png\n11.0 rgb/11.0.png\n")
    (tmp_path / "depth.txt").write_text("# depth maps\n10.10 depth/a.png\n10.115 depth/b.png\n11.03 depth/c.png\n")
    poses = read_tum_folder(tmp_path)
    assert (poses.layout, poses.unit) == ("TUM RGB-D", "m")
    assert poses.image_stamps == {"rgb/10.11.png": 10.11, "rgb/11.0.png": 11.0}
    assert poses.depth is not None
    # c is 0.03 s after the other image, which has none.
    assert poses.depth.files == {"rgb/10.11.png": tmp_path / "depth/b.png"}
    assert poses.depth.per_unit == 5000
    (tmp_path / "calibration.txt").write_text("500 500 320 240\n")
    assert read_tum_folder(tmp_path).layout == "ETH3D-SLAM"


def test_a_broken_list_of_images_is_refused(tmp_path: Path) -> None:
    (tmp_path / "groundtruth.txt").write_text("10.1 1 2 3 0 0 0 1\n")
    (tmp_path / "rgb.txt").write_text("10.11\n")
    with pytest.raises(InputError, match=r"rgb.txt, line 1: 1 words; needed a time and a file"):
        read_tum_folder(tmp_path)
