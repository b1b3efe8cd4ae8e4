from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from smust3r_colmap.errors import InputError
from smust3r_colmap.exporters.ply import write_ply
from smust3r_colmap.importers.ply_points import read_ply_points
from smust3r_colmap.products import PointCloud

HEADER = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n"


def test_points_are_read_from_text_and_binary(tmp_path: Path) -> None:
    (tmp_path / "text.ply").write_text(HEADER + "end_header\n1 2 3\n1 2 3\n")
    np.testing.assert_array_equal(read_ply_points(tmp_path / "text.ply"), [[1, 2, 3], [1, 2, 3]])
    xyz = np.array([[0.5, -1, 4], [2, 2, 2], [0.5, -1, 4]])
    write_ply(PointCloud(xyz=xyz, rgb=np.zeros((3, 3), np.uint8)), tmp_path / "binary.ply")
    np.testing.assert_array_equal(read_ply_points(tmp_path / "binary.ply"), xyz)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (HEADER + "end_header\n1 2 3\n1 2 nan\n", "2 points, 1 of them not finite"),
        (HEADER.replace("vertex 2", "vertex 0") + "end_header\n", "0 points, 0 of them not finite"),
        (HEADER + "end_header\n1 2 3\n", "1 points, its header says 2"),
        ("no", "cannot be read as PLY"),
    ],
)
def test_broken_clouds_are_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "cloud.ply").write_text(text)
    with pytest.raises(InputError, match=f"cloud.ply: {message}"):
        read_ply_points(tmp_path / "cloud.ply")


def test_a_cloud_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"absent.ply: cannot be read"):
        read_ply_points(tmp_path / "absent.ply")
