"""The whole of a validation: every rule is asked, models are read from both forms, reports say what was found."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from helpers.described_models import ALWAYS, edit_lines, found_in

from smust3r_colmap.errors import StorageError
from smust3r_colmap.validation.description import Subject
from smust3r_colmap.validation.report import EXIT_REFUSED, EXIT_UNREADABLE
from smust3r_colmap.validation.validate import read_model, validate


def test_the_good_scene_has_everything_and_breaks_no_rule(good: Subject) -> None:
    parts = (good.images, good.masks, good.database, good.ply, good.depth, good.dense, good.transforms)

    assert all(part is not None for part in parts)
    assert set(good.downscaled) == {2}
    assert found_in(good) == ALWAYS


def test_text_and_binary_give_what_pycolmap_has(model: pycolmap.Reconstruction, tmp_path: Path) -> None:
    for form in ("txt", "bin"):
        read = read_model(tmp_path / form)
        assert read.points is not None
        assert read.defects == ()
        assert {camera.camera_id: camera.params for camera in read.cameras} == {
            camera_id: tuple(camera.params) for camera_id, camera in model.cameras.items()
        }
        for index, (image_id, name) in enumerate(zip(read.images.ids, read.images.names, strict=True)):
            image = model.images[image_id]
            rows = slice(read.images.starts[index], read.images.starts[index + 1])
            assert name == image.name
            np.testing.assert_allclose(
                read.images.rotation[index], image.cam_from_world().rotation.matrix(), atol=1e-12
            )
            np.testing.assert_allclose(read.images.centre_world[index], image.projection_center(), atol=1e-12)
            np.testing.assert_array_equal(read.images.xy_img[rows], [point.xy for point in image.points2D])
            assert read.images.num_observed[index] == image.num_points3D
        for index, point_id in enumerate(read.points.ids.tolist()):
            point = model.points3D[point_id]
            rows = slice(read.points.starts[index], read.points.starts[index + 1])
            np.testing.assert_array_equal(read.points.xyz[index], point.xyz)
            elements = zip(read.points.track_images[rows].tolist(), read.points.track_rows[rows].tolist(), strict=True)
            assert list(elements) == [(element.image_id, element.point2D_idx) for element in point.track.elements]
        assert {rig.rig_id: len(rig.sensors) for rig in read.rigs or ()} == {1: 2, 2: 2}
        assert {frame.frame_id: sorted(frame.image_ids) for frame in read.frames or ()} == {
            frame_id: sorted(data.id for data in frame.data_ids) for frame_id, frame in model.frames.items()
        }


def test_two_forms_of_one_model_must_agree(model: pycolmap.Reconstruction, tmp_path: Path) -> None:
    for path in (tmp_path / "bin").iterdir():
        path.rename(tmp_path / "txt" / path.name)
    agreeing = read_model(tmp_path / "txt")
    edit_lines(tmp_path / "txt" / "points3D.txt", lambda lines: lines[1:])
    (fewer,) = read_model(tmp_path / "txt").defects
    edit_lines(tmp_path / "txt" / "images.txt", lambda lines: lines[2:])
    (missing,) = read_model(tmp_path / "txt").defects

    assert (agreeing.form, agreeing.defects) == ("binary", ())
    assert fewer.text == "9 points in .bin, 8 in .txt"
    assert "is in one form only (8 images in .bin, 7 in .txt)" in missing.text


def test_lines_that_cannot_be_read_are_told_instead_of_a_difference_to_the_other_form(
    model: pycolmap.Reconstruction, tmp_path: Path
) -> None:
    for path in (tmp_path / "bin").iterdir():
        path.rename(tmp_path / "txt" / path.name)
    (tmp_path / "txt" / "images.txt").write_text("no images\n")
    bad_text = read_model(tmp_path / "txt")
    (tmp_path / "txt" / "images.bin").write_bytes(b"no images")
    bad_both = read_model(tmp_path / "txt")

    assert [(defect.rule, defect.where) for defect in bad_text.defects] == [("text-bad-line", "images.txt, line 1")]
    assert (bad_text.unread, bad_both.unread) == ((), ("images.bin",))
    assert [defect.rule for defect in bad_both.defects] == ["file-truncated", "text-bad-line"]


@pytest.mark.parametrize("form", ["txt", "bin"])
@pytest.mark.parametrize("part", ["cameras", "images", "points3D"])
def test_a_file_in_which_nothing_can_be_read_has_no_other_findings_than_that(
    model: pycolmap.Reconstruction, tmp_path: Path, part: str, form: str
) -> None:
    (tmp_path / form / f"{part}.{form}").write_text("garbage is no model\nand never was\n")
    report = validate(tmp_path / form, ask_colmap=True)
    noted = "text-bad-line" if form == "txt" else "file-truncated"

    assert report.exit_code == EXIT_UNREADABLE
    assert [finding.rule.name for finding in report.findings] == ["file-unreadable", noted]
    assert report.findings[0].evidence.text == f"{part}.{form}"
    assert report.findings[1].evidence.text.startswith(f"{part}.{form}, ")


def test_a_model_with_nothing_in_it_can_be_read(tmp_path: Path) -> None:
    for part in ("cameras", "images", "points3D"):
        (tmp_path / f"{part}.txt").write_text("# nothing\n")
    report = validate(tmp_path, ask_colmap=False)

    assert report.exit_code == EXIT_REFUSED
    assert {"images-none", "points-none"} <= {finding.rule.name for finding in report.findings}
    assert "camera-id-not-one" not in {finding.rule.name for finding in report.findings}
    assert "text, 0 images, 0 cameras, 0 points" in report.render_text()


def test_a_file_that_cannot_be_opened_is_named(
    model: pycolmap.Reconstruction, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(path: Path) -> bytes:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "read_bytes", refuse)
    with pytest.raises(StorageError, match=r"cameras.bin: cannot be read \(Permission denied\)"):
        read_model(tmp_path / "bin")


@pytest.mark.data
def test_a_real_model_gives_no_false_alarm(data_dir: Callable[[str], Path]) -> None:
    folder = data_dir("lund_street")
    report = validate(folder / "reference_sparse", images=folder / "images", ask_colmap=False)

    assert [finding.rule.name for finding in report.findings] == ["camera-model-SIMPLE_RADIAL"]
    assert 0.5 < report.figures.mean_error_px < 1.0
