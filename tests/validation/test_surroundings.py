"""What lies beside a model: PLY, image headers, depth, databases."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import numpy as np
import pytest
from helpers.described_models import PLY_COLUMNS, write_image, write_map, write_ply

from smust3r_colmap.validation.surroundings import read_database, read_dense, read_depth, read_image_folder, read_ply


def test_every_form_of_ply_gives_the_same_points(tmp_path: Path) -> None:
    xyz = np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32)
    path = tmp_path / "points3D.ply"
    columns = {**PLY_COLUMNS, "quality": "double"}
    for form in ("binary_little_endian", "binary_big_endian", "ascii"):
        write_ply(path, xyz, columns, form)
        cloud = read_ply(path)
        assert (cloud.problem, cloud.properties) == ("", frozenset(columns))
        np.testing.assert_allclose(cloud.xyz, xyz, rtol=1e-6)


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (b"solid", "no PLY header"),
        (b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nend_header\n", "no vertices with x, y and z"),
        (b"ply\nformat ascii 1.0\nelement face 2\nend_header\n", "first element is 'face'"),
        (
            b"ply\nformat binary_little_endian 1.0\nelement vertex 9\nproperty float x\nproperty float y\n"
            b"property float z\nend_header\n" + bytes(30),
            "ends after 2 of 9 vertices",
        ),
        (
            b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\n"
            b"property float z\nend_header\n1 2 3\n4 5\n",
            "5 numbers for 2 vertices of 3 columns",
        ),
    ],
)
def test_a_ply_that_cannot_be_read_says_why(tmp_path: Path, content: bytes, problem: str) -> None:
    path = tmp_path / "points3D.ply"
    path.write_bytes(content)

    assert problem in read_ply(path).problem


def test_image_headers_tell_size_turn_and_damage(tmp_path: Path) -> None:
    write_image(tmp_path / "a.jpg", 40, 30, orientation=6)
    write_image(tmp_path / "sub" / "b.png", 20, 10)
    (tmp_path / "c.jpg").write_bytes(b"no image")
    (tmp_path / "notes.txt").write_text("no image")
    write_image(tmp_path / ".hidden.jpg", 4, 4)
    turned, broken, flat = read_image_folder(tmp_path).files

    assert (turned.name, turned.width, turned.height, turned.turned) == ("a.jpg", 40, 30, True)
    assert turned.fits(30, 40)
    assert (broken.name, broken.readable) == ("c.jpg", False)
    assert (flat.name, flat.width, flat.turned) == ("sub/b.png", 20, False)


def test_depth_parameters_without_a_scale_are_unreadable(tmp_path: Path) -> None:
    (tmp_path / "depth_params.json").write_text('{"a": {"offset": 0}}')
    depth = read_depth(tmp_path / "depth_params.json", tmp_path / "depths")

    assert depth is not None
    assert "scale" in depth.problem
    assert read_depth(tmp_path / "none.json", tmp_path / "depths") is None


def test_a_depth_map_cut_short_has_no_size(tmp_path: Path) -> None:
    path = tmp_path / "stereo" / "depth_maps" / "a.png.geometric.bin"
    write_map(path, 8, 6, 1)
    path.write_bytes(path.read_bytes()[:-1])
    dense = read_dense(tmp_path)

    assert dense is not None
    assert dense.depth_sizes == {"a.png.geometric.bin": (0, 0)}


def test_what_is_no_database_is_told(tmp_path: Path) -> None:
    (tmp_path / "text.db").write_text("not a database at all, but long enough to be looked at")
    with sqlite3.connect(tmp_path / "other.db") as connection:
        connection.execute("CREATE TABLE notes (line TEXT)")

    assert "not a database" in read_database(tmp_path / "text.db").problem
    assert "no such table" in read_database(tmp_path / "other.db").problem
