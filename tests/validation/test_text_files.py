"""Text files of a model: read to the last digit, and whatever cannot be read is named with its line."""

from __future__ import annotations

import random
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from helpers.described_models import edit_lines, found_in

from smust3r_colmap.importers.colmap_records import Fixes, read_records
from smust3r_colmap.validation.description import Subject
from smust3r_colmap.validation.layout import find_layout
from smust3r_colmap.validation.projection import project
from smust3r_colmap.validation.rules import apply_rules
from smust3r_colmap.validation.validate import RULES, describe, read_model, validate


def test_a_lost_line_of_observations_is_told_with_its_line(model: pycolmap.Reconstruction, tmp_path: Path) -> None:
    edit_lines(tmp_path / "txt" / "images.txt", lambda lines: [*lines[:3], *lines[4:]])
    read = read_model(tmp_path / "txt")

    (defect,) = read.defects
    assert defect.rule == "text-observations-missing"
    assert defect.where == "images.txt, line 7"
    assert len(read.images) == len(model.images)
    assert read.images.num_rows[1] == 0
    assert read.images.num_rows[2] > 0


def test_a_lost_last_line_is_told(model: pycolmap.Reconstruction, tmp_path: Path) -> None:
    edit_lines(tmp_path / "txt" / "images.txt", lambda lines: lines[:-1])

    assert [defect.rule for defect in read_model(tmp_path / "txt").defects] == ["text-observations-missing"]


def test_empty_observation_lines_are_right_and_the_last_is_a_fact(
    model: pycolmap.Reconstruction, tmp_path: Path
) -> None:
    path = tmp_path / "txt" / "images.txt"
    edit_lines(path, lambda lines: [line if number % 2 == 0 else "" for number, line in enumerate(lines)])
    read = read_model(tmp_path / "txt")

    assert [defect.rule for defect in read.defects] == ["text-last-line-empty"]
    assert len(read.images) == len(model.images)


@pytest.mark.parametrize(
    ("file", "line", "where", "text"),
    [
        ("cameras.txt", "1 PINHOLE 640 480 500 500 320", "line 4", "PINHOLE has 4 parameters, not 3"),
        ("cameras.txt", "1 PINHOLE", "line 4", "an id, a model, a width and a height"),
        ("images.txt", "1 0 0 0 1 0 0 0", "line 5", "neither an image nor"),
        ("points3D.txt", "1 0 0", "line 4", "is no point"),
        ("points3D.txt", "1 0 0 zero 1 1 1 1", "line 4", "is no point"),
        ("points3D.txt", "1 0 0 0 1 1 1 1 5", "line 4", "is no point"),
        ("rigs.txt", "1 1 SONAR 1", "line 4", "sensor type 'SONAR'"),
        ("frames.txt", "1 1 1 0 0 0 0 0 0 2 CAMERA 1 1", "line 4", "the line ends early"),
    ],
)
def test_a_line_that_cannot_be_read_is_named_and_the_rest_is_kept(
    model: pycolmap.Reconstruction, tmp_path: Path, file: str, line: str, where: str, text: str
) -> None:
    before = read_model(tmp_path / "txt")
    edit_lines(tmp_path / "txt" / file, lambda lines: [line, *lines])
    read = read_model(tmp_path / "txt")

    (defect,) = read.defects
    assert (defect.rule, defect.where) == ("text-bad-line", f"{file}, {where}")
    assert text in defect.text
    assert (len(read.images), len(read.cameras)) == (len(before.images), len(before.cameras))
    assert read.points is not None
    assert len(read.points) == 9


HUGE = 2**63 + 1


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("file", "line", "text"),
    [
        ("cameras.txt", f"{HUGE} PINHOLE 640 480 500 500 320 240", "its id is not from 0 to 4294967294"),
        ("cameras.txt", "4294967295 PINHOLE 640 480 500 500 320 240", "its id is not from 0 to 4294967294"),
        ("cameras.txt", "-1 PINHOLE 640 480 500 500 320 240", "its id is not from 0 to 4294967294"),
        ("cameras.txt", f"9 PINHOLE {2**64} 480 500 500 320 240", "its size has more than 64 bits"),
        ("cameras.txt", f"9 PINHOLE 640 {10**30} 500 500 320 240", "its size has more than 64 bits"),
        ("images.txt", f"{HUGE} 1 0 0 0 0 0 0 1 a.png\n1 2 -1", "an id that is not from 0 to 4294967294"),
        ("images.txt", f"9 1 0 0 0 0 0 0 {10**30} a.png\n", "an id that is not from 0 to 4294967294"),
        ("images.txt", "4294967295 1 0 0 0 0 0 0 1 a.png\n1 2 -1", "an id that is not from 0 to 4294967294"),
        ("points3D.txt", f"{2**64} 0 0 0 1 1 1 1", "id (below 2^64)"),
        ("points3D.txt", f"{2**64 - 1} 0 0 0 1 1 1 1", "id (below 2^64)"),
        ("points3D.txt", "nan 0 0 0 1 1 1 1", "id (below 2^64)"),
        ("points3D.txt", "1e300 0 0 0 1 1 1 1", "id (below 2^64)"),
        ("points3D.txt", "-1 0 0 0 1 1 1 1", "id (below 2^64)"),
        ("points3D.txt", "99 0 0 0 1 1 1 1 nan 0", "track in pairs (below 2^32)"),
        ("points3D.txt", f"99 0 0 0 1 1 1 1 1 {HUGE}", "track in pairs (below 2^32)"),
        ("points3D.txt", "99 0 0 0 1 1 1 1 4294967295 0", "track in pairs (below 2^32)"),
    ],
)
def test_a_line_with_a_number_that_is_no_id_is_named_and_the_rest_is_kept(
    model: pycolmap.Reconstruction, tmp_path: Path, file: str, line: str, text: str
) -> None:
    before = read_model(tmp_path / "txt")
    edit_lines(tmp_path / "txt" / file, lambda lines: [line, *lines])
    subject = describe(find_layout(tmp_path / "txt", images=None, database=None), ask_colmap=False)
    evidence = apply_rules(subject, RULES.values())["text-bad-line"]

    assert evidence.count == 1
    assert evidence.text.startswith(f"{file}, line {5 if file == 'images.txt' else 4}: ")
    assert text in evidence.text
    assert subject.model.cameras == before.cameras
    assert subject.model.images.names == before.images.names
    np.testing.assert_array_equal(subject.model.images.point_ids, before.images.point_ids)
    assert subject.model.points is not None
    assert len(subject.model.points) == 9


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("point_id", ["nan", "1.5", "-2", "1e300", str(2**64)])
def test_an_observation_of_a_point_that_is_no_id_is_named(
    model: pycolmap.Reconstruction, tmp_path: Path, point_id: str
) -> None:
    edit_lines(tmp_path / "txt" / "images.txt", lambda lines: [lines[0], f"{lines[1]} 1 2 {point_id}", *lines[2:]])
    read = read_model(tmp_path / "txt")

    assert [(defect.rule, defect.where) for defect in read.defects] == [("text-bad-line", "images.txt, line 6")]
    assert read.images.num_rows[0] == 0


@pytest.mark.filterwarnings("error")
def test_the_largest_ids_and_sizes_that_colmap_has_are_read_to_the_last_digit(
    model: pycolmap.Reconstruction, tmp_path: Path
) -> None:
    """Above 2^63 as from binary files, where the ids of points are read with a sign."""
    folder = tmp_path / "txt"
    edit_lines(folder / "cameras.txt", lambda _: [f"{2**32 - 2} PINHOLE {2**64 - 1} 480 500 500 320 240"])
    edit_lines(
        folder / "images.txt",
        lambda _: [f"{2**32 - 2} 1 0 0 0 0 0 0 {2**32 - 2} a.png", f"1 2 {2**64 - 2} 3 4 {2**64 - 3} 5 6 -1"],
    )
    points = [f"{2**64 - 2 - index} 0 0 1 1 1 1 1 {2**32 - 2} {index}" for index in range(2)]
    edit_lines(folder / "points3D.txt", lambda _: points)
    (folder / "rigs.txt").unlink()
    (folder / "frames.txt").unlink()
    subject = describe(find_layout(folder, images=None, database=None), ask_colmap=False)
    found = found_in(subject)

    assert subject.model.defects == ()
    assert subject.model.points is not None
    assert subject.model.points.ids.tolist() == [-2, -3]
    assert subject.model.images.point_ids.tolist() == [-2, -3, -1]
    assert {"id-too-large", "point-id-huge"} <= found
    assert not {"id-duplicate", "observation-dangling", "track-dangling", "track-disagrees"} & found


@pytest.mark.slow
@pytest.mark.filterwarnings("error")
def test_nasty_words_in_text_end_in_findings_and_not_in_errors(model: pycolmap.Reconstruction, tmp_path: Path) -> None:
    rng = random.Random(0)
    nasty = ("nan", "-inf", "-1", "0", "1e300", str(2**32 - 1), str(HUGE), str(2**64 - 1), "9" * 5000, "1.5", "x", "")
    for path in sorted((tmp_path / "txt").glob("*.txt")) * 30:
        whole = path.read_text()
        words = whole.split(" ")
        for _ in range(3):
            words[rng.randrange(len(words))] = rng.choice(nasty)
        path.write_text(" ".join(words))
        with np.errstate(all="ignore"):  # places as far away as 1e300
            read = read_model(tmp_path / "txt")
            found = apply_rules(Subject(model=read, projection=project(read)), RULES.values())
        assert all(evidence.text for evidence in found.values())
        path.write_text(whole)


def test_a_bad_line_of_observations_costs_that_image_its_observations(
    model: pycolmap.Reconstruction, tmp_path: Path
) -> None:
    edit_lines(tmp_path / "txt" / "images.txt", lambda lines: [lines[0], lines[1] + " 3.5", *lines[2:]])
    read = read_model(tmp_path / "txt")

    assert [defect.where for defect in read.defects] == ["images.txt, line 6"]
    assert read.images.num_rows[0] == 0
    assert read.images.num_rows[1] > 0


def test_blanks_in_names_and_windows_lines_survive_the_text(model: pycolmap.Reconstruction, tmp_path: Path) -> None:
    path = tmp_path / "txt" / "images.txt"
    name = read_model(tmp_path / "txt").images.names[0]
    path.write_bytes(path.read_bytes().replace(name.encode(), b"my first image.png").replace(b"\n", b"\r\n"))
    read = read_model(tmp_path / "txt")

    assert read.images.names[0] == "my first image.png"
    assert read.defects == ()


def test_no_point_may_be_written_as_minus_one_or_as_the_largest_number(
    model: pycolmap.Reconstruction, tmp_path: Path
) -> None:
    path = tmp_path / "txt" / "images.txt"
    before = read_model(tmp_path / "txt").images.point_ids
    path.write_text(path.read_text().replace(" -1", f" {2**64 - 1}"))

    np.testing.assert_array_equal(read_model(tmp_path / "txt").images.point_ids, before)
    assert (before == -1).sum() > 5


def test_refine_is_advised_for_lost_lines_of_observations_and_reads_them(
    model: pycolmap.Reconstruction, tmp_path: Path
) -> None:
    edit_lines(tmp_path / "txt" / "images.txt", lambda lines: lines[::2])
    report = validate(tmp_path / "txt", ask_colmap=False)
    (line,) = [line for line in report.render_text().splitlines() if "[text-observations-missing]" in line]
    fixes = Fixes()

    assert "Do: `smust3r-colmap refine MODEL --images DIR`" in line
    assert "Nobody can use it" not in line
    assert len(read_records(tmp_path / "txt", fixes).images) == len(model.images)
    assert "8 images without a line of observations" in fixes.texts()[0]
