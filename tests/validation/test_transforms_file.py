"""transforms.json as it is read."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from helpers.described_models import write_image

from smust3r_colmap.validation.transforms_file import read_transforms


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        ("{", "Expecting property name"),
        ("[]", "no list of frames"),
        ('{"frames": [{"file_path": "a"}, {}]}', "frame 2 has no file_path"),
        ('{"frames": []}', "its list of frames is empty"),
        ('{"frames": /* none', "Expecting value"),
    ],
)
def test_a_transforms_file_that_cannot_be_read_says_why(tmp_path: Path, content: str, problem: str) -> None:
    (tmp_path / "transforms.json").write_text(content)

    assert problem in read_transforms(tmp_path / "transforms.json").problem


def test_a_frame_has_numbers_of_its_own_before_those_of_the_file(tmp_path: Path) -> None:
    write_image(tmp_path / "a.png", 40, 30)
    frames = [{"file_path": "a.png", "w": 40, "fl_x": "wide"}, {"file_path": "b", "transform_matrix": [[1, 2], 3]}]
    document = {"w": 80, "h": 30, "frames": frames, "ply_file_path": "nothing.ply"}
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    found = read_transforms(tmp_path / "transforms.json")

    assert (found.frames[0].numbers["w"], found.frames[1].numbers["w"]) == (40, 80)
    assert np.isnan(found.frames[0].numbers["fl_x"])
    assert np.isnan(found.frames[1].world_from_opengl).all()
    assert list(found.images) == ["a.png"]
    assert not found.ply_is_there


def test_numbers_too_large_for_a_float_are_infinite(tmp_path: Path) -> None:
    document = {"fl_x": 10**400, "frames": [{"file_path": "x" * 400, "fl_y": -(10**400)}], "ply_file_path": "y" * 400}
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    found = read_transforms(tmp_path / "transforms.json")

    assert (found.frames[0].numbers, found.ply_is_there) == ({"fl_x": math.inf, "fl_y": -math.inf}, False)


def test_comments_are_told_and_texts_that_look_like_them_stay(tmp_path: Path) -> None:
    write_image(tmp_path / "a//b.png", 40, 30)
    (tmp_path / "transforms.json").write_text(
        '{ // made by hand\n "frames": [/* one */ {"file_path": "a//b.png"}]}', encoding="utf-8-sig"
    )
    found = read_transforms(tmp_path / "transforms.json")

    assert (found.problem, found.has_comments, list(found.images)) == ("", True, ["a//b.png"])


def test_a_path_without_an_ending_is_found_by_those_that_instant_ngp_adds(tmp_path: Path) -> None:
    write_image(tmp_path / "a.jpg", 40, 30)
    write_image(tmp_path / "b.png", 40, 30)
    frames = [{"file_path": name} for name in ("b.png", "a", "b.jpg", "c")]
    frames[1]["sharpness"] = "30"
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": frames}))
    found = read_transforms(tmp_path / "transforms.json")

    assert (list(found.images), list(found.images_by_ending)) == (["b.png"], ["a"])
    assert found.images_by_ending["a"].name == "a.jpg"
    assert found.has_sharpness
