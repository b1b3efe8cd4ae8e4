"""``smust3r-colmap demo --survey`` on poses that are true or bent, without rendering and reconstruction."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from helpers.summaries import GOOD
from helpers.surveys import write_blank_survey

from smust3r_colmap.cli.main import main
from smust3r_colmap.config import RunConfig
from smust3r_colmap.execution.progress import Reporter
from smust3r_colmap.report.summary import RunSummary
from smust3r_colmap.synthetic.survey import SurveyScene, ground_height, survey_camera

pytest.importorskip("pyproj")


def _truth_bent_by(bend_m: float) -> Callable[..., RunSummary]:
    """A pipeline that knows the poses; their heights are bent up by so much at 20 m from the middle."""

    def reconstruct(images: Path, output: Path, _: RunConfig, *, reporter: Reporter) -> RunSummary:
        model = pycolmap.Reconstruction()
        model.add_camera_with_trivial_rig(survey_camera().colmap_camera())
        for image_id, pose in enumerate(SurveyScene().cam_from_local(), start=1):
            centre = -pose[:, :3].T @ pose[:, 3]
            bent = centre.copy()
            bent[2] += bend_m * (centre[:2] @ centre[:2]) / 400
            image = pycolmap.Image(name=f"DJI_{image_id:04}.jpg", camera_id=1, image_id=image_id)
            model.add_image_with_trivial_frame(
                image, pycolmap.Rigid3d(np.column_stack([pose[:, :3], -pose[:, :3] @ bent]))
            )
        flat = np.random.default_rng(0).uniform(-20, 20, (50, 2))
        for xyz in np.column_stack([flat, ground_height(flat)]):
            model.add_point3D(xyz, pycolmap.Track())
        (output / "sparse/0").mkdir(parents=True, exist_ok=True)
        model.write_binary(output / "sparse/0")
        return replace(GOOD, output=output)

    return reconstruct


@pytest.fixture(scope="module")
def surveyed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_blank_survey(tmp_path_factory.mktemp("demo"))


@pytest.mark.slow
def test_true_poses_are_good_and_bent_ones_are_not(
    surveyed: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("smust3r_colmap.pipeline.reconstruct", _truth_bent_by(0.0))
    assert main(["demo", "--survey", "--output", str(surveyed)]) == 0
    printed = capsys.readouterr().out
    assert "Georeferenced by control points: EPSG:25832 (ETRS89 / UTM zone 32N)" in printed
    assert re.search(r"^  check +12 ", printed, re.M)
    facts = json.loads((surveyed / "result/geo/geo.json").read_text())
    assert sum(one["kind"] == "position" for one in facts["left_out"]) == 3

    monkeypatch.setattr("smust3r_colmap.pipeline.reconstruct", _truth_bent_by(1.5))
    assert main(["demo", "--survey", "--output", str(surveyed)]) == 3
    assert "the check points are not within 1 and 2 pixels: the result is wrong" in capsys.readouterr().err


def test_images_that_are_no_survey_are_left_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "images").mkdir()
    assert main(["demo", "--survey", "--output", str(tmp_path)]) == 2
    assert "has images that are no survey; name another folder with --output" in capsys.readouterr().err
