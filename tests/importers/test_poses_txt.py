from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from smust3r_colmap.errors import InputError
from smust3r_colmap.importers.poses_txt import read_named_poses, read_poses_txt


def test_poses_txt_is_camera_to_world_with_the_real_part_first(tmp_path: Path) -> None:
    path = tmp_path / "poses.txt"
    # A quarter turn about z: the camera's x axis is the world's y axis.
    path.write_text("# image qw qx qy qz tx ty tz\n\na/1.jpg 0.7071067812 0 0 0.7071067812 1 2 3\n")
    poses = read_poses_txt(path)
    assert list(poses) == ["a/1.jpg"]
    np.testing.assert_allclose(poses["a/1.jpg"], [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3]], atol=1e-9)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("a.jpg 1 0 0 0 1 2", "line 2, after the name: 6 numbers; needed 7"),
        ("a.jpg 1 0 0 0 1 2 3 4", "line 2, after the name: 8 numbers; needed 7"),
        ("a.jpg 1 0 0 zero 1 2 3", "line 2, after the name: could not convert string to float: 'zero'"),
        ("a.jpg 1 0 0 0 1 2 nan", "line 2, after the name: a number is not finite"),
        ("a.jpg 1 1 0 0 1 2 3", "line 2: the quaternion has length 1.414"),
        ("a.jpg 1 0 0 0 1 2 3\na.jpg 1 0 0 0 1 2 3", "line 3: a.jpg has a pose already"),
    ],
)
def test_broken_poses_txt_is_refused_with_its_line(tmp_path: Path, line: str, message: str) -> None:
    path = tmp_path / "poses.txt"
    path.write_text(f"# image qw qx qy qz tx ty tz\n{line}\n")
    with pytest.raises(InputError, match=message):
        read_poses_txt(path)
    with pytest.raises(InputError, match=r"absent.txt: cannot be read"):
        read_poses_txt(tmp_path / "absent.txt")


def test_the_depth_beside_the_poses_is_found_with_its_camera(tmp_path: Path) -> None:
    (tmp_path / "poses.txt").write_text("000.jpg 1 0 0 0 1 2 3\n010.jpg 1 0 0 0 1 2 3\n")
    (tmp_path / "intrinsics.txt").write_text("# width height fx fy cx cy\n640 480 585 586 320 240\n")
    (tmp_path / "depth").mkdir()
    (tmp_path / "depth/010.png").touch()
    poses = read_named_poses(tmp_path)
    assert poses.names == ("000.jpg", "010.jpg")
    assert poses.depth is not None
    assert poses.depth.files == {"010.jpg": tmp_path / "depth/010.png"}
    assert poses.depth.intrinsics is not None
    assert poses.depth.intrinsics.params == pytest.approx((585, 586, 320, 240))
    assert poses.depth.per_unit == 1000


def test_a_file_without_a_pose_is_refused(tmp_path: Path) -> None:
    (tmp_path / "poses.txt").write_text("# image qw qx qy qz tx ty tz\n\n")
    with pytest.raises(InputError, match=r"poses.txt: has no pose"):
        read_named_poses(tmp_path)
