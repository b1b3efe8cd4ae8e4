"""Binary files of a model: cut, followed by bytes, or damaged, they are named and never crash."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
import pytest

from smust3r_colmap.validation.description import Subject
from smust3r_colmap.validation.projection import project
from smust3r_colmap.validation.rules import apply_rules
from smust3r_colmap.validation.validate import RULES, read_model


@pytest.mark.parametrize("file", ["cameras.bin", "images.bin", "points3D.bin", "rigs.bin", "frames.bin"])
def test_a_binary_file_cut_anywhere_is_named_and_never_crashes(
    model: pycolmap.Reconstruction, tmp_path: Path, file: str
) -> None:
    path = tmp_path / "bin" / file
    whole = path.read_bytes()
    for length in (0, 5, 8, 9, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:length])
        read = read_model(tmp_path / "bin")
        if whole[:length] == bytes(8):
            continue
        assert [defect.rule for defect in read.defects] == ["file-truncated"], length
        assert file in read.defects[0].where


def test_the_place_of_a_break_is_told(model: pycolmap.Reconstruction, tmp_path: Path) -> None:
    path = tmp_path / "bin" / "points3D.bin"
    path.write_bytes(path.read_bytes()[:-1])
    size = path.stat().st_size
    read = read_model(tmp_path / "bin")

    (defect,) = read.defects
    assert defect.text == f"ends inside record 9 of 9: {size:,} bytes are too few"
    assert read.points is not None
    assert len(read.points) == 8


@pytest.mark.parametrize("file", ["cameras.bin", "images.bin", "points3D.bin", "rigs.bin", "frames.bin"])
def test_bytes_behind_the_last_record_are_told(model: pycolmap.Reconstruction, tmp_path: Path, file: str) -> None:
    path = tmp_path / "bin" / file
    path.write_bytes(path.read_bytes() + b"abc")

    (defect,) = read_model(tmp_path / "bin").defects
    assert (defect.rule, defect.text.split(" follow")[0]) == ("file-trailing-bytes", "3 bytes")
    assert defect.where.startswith(file)


def test_random_bytes_end_in_findings_and_not_in_errors(model: pycolmap.Reconstruction, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    paths = sorted((tmp_path / "bin").glob("*.bin"))
    whole = {path: path.read_bytes() for path in paths}
    for path in paths * 8:
        damaged = bytearray(whole[path])
        for place in rng.integers(8, len(damaged), 3):
            damaged[place] = rng.integers(256)
        path.write_bytes(damaged)
        with np.errstate(all="ignore"):
            read = read_model(tmp_path / "bin")
            apply_rules(Subject(model=read, projection=project(read)), RULES.values())
        path.write_bytes(whole[path])


def test_an_unknown_camera_number_is_told(model: pycolmap.Reconstruction, tmp_path: Path) -> None:
    path = tmp_path / "bin" / "cameras.bin"
    content = bytearray(path.read_bytes())
    content[12:16] = (99).to_bytes(4, "little")
    path.write_bytes(content)

    (defect,) = read_model(tmp_path / "bin").defects
    assert "camera model number 99" in defect.text
