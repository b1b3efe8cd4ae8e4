from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from smust3r_colmap.errors import InputError
from smust3r_colmap.importers.kitti_odometry import read_kitti

LINES = "1 0 0 0 0 1 0 0 0 0 1 0\n0 -1 0 1 1 0 0 2 0 0 1 3\n"


@pytest.fixture
def benchmark(tmp_path: Path) -> Path:
    for folder in ("poses", "sequences/00"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "poses/00.txt").write_text(LINES)
    (tmp_path / "sequences/00/times.txt").write_text("0.0\n1.036e-01\n")
    return tmp_path


@pytest.mark.parametrize("named", ["poses/00.txt", "sequences/00"])
def test_a_line_is_a_frame_with_the_matrix_row_by_row(benchmark: Path, named: str) -> None:
    poses = read_kitti(benchmark / named)
    assert poses.names == ("000000", "000001")
    np.testing.assert_array_equal(poses.world_from_cam[1], [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3]])
    assert poses.stamps_s is not None
    assert poses.stamps_s.tolist() == [0.0, 0.1036]
    assert poses.unit == "m"


def test_a_file_alone_has_no_times(tmp_path: Path) -> None:
    (tmp_path / "estimate.txt").write_text(LINES)
    assert read_kitti(tmp_path / "estimate.txt").stamps_s is None


def test_as_many_times_as_poses_are_needed(benchmark: Path) -> None:
    (benchmark / "sequences/00/times.txt").write_text("0.0\n")
    with pytest.raises(InputError, match=r"times.txt: 1 times for 2 poses"):
        read_kitti(benchmark / "poses/00.txt")


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("1 0 0 0 0 1 0 0 0 0 1", "line 2: 11 numbers; needed 12"),
        ("1 0 0 0 0 1 0 0 0 0 -1 0", "line 2: not a rotation"),
        ("1 0 0 nan 0 1 0 0 0 0 1 0", "line 2: a number is not finite"),
    ],
)
def test_broken_lines_are_refused(tmp_path: Path, line: str, message: str) -> None:
    (tmp_path / "00.txt").write_text(LINES.splitlines()[0] + "\n" + line + "\n")
    with pytest.raises(InputError, match=message):
        read_kitti(tmp_path / "00.txt")


def test_a_sequence_without_poses_is_refused(tmp_path: Path) -> None:
    (tmp_path / "sequences/11").mkdir(parents=True)
    with pytest.raises(InputError, match=r"neither .*poses.txt nor .*11.txt is there"):
        read_kitti(tmp_path / "sequences/11")
