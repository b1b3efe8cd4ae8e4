"""``smust3r-colmap georeference`` from files to files."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers.finished_runs import Example, content
from helpers.surveys import Survey, make_survey, write_model
from PIL import ExifTags, Image

from smust3r_colmap.cli.main import main
from smust3r_colmap.importers.survey import SurveyPoints

pyproj = pytest.importorskip("pyproj")


@pytest.fixture(scope="module")
def survey() -> Survey:
    return make_survey(np.random.default_rng(0), rows=3, columns=4)


@pytest.fixture(scope="module")
def model(survey: Survey, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("survey") / "model"
    write_model(survey, folder)
    return folder


def gcp_list(points: SurveyPoints, path: Path) -> Path:
    rows = [
        f"{one.x:.4f}\t{one.y:.4f}\t{one.z:.4f}\t{tag.x_px - 0.5:.3f}\t{tag.y_px - 0.5:.3f}\t{tag.image}\t{one.label}"
        for one in points.points
        for tag in one.tags
    ]
    path.write_text("\r\n".join(["\ufeffEPSG:25832", "# points", *rows]) + "\r\n")
    return path


def images_with_gps(survey: Survey, folder: Path) -> Path:
    rng = np.random.default_rng(2)
    back = pyproj.Transformer.from_crs(25832, 4326, always_xy=True)
    for one in survey.positions(rng, sigma_h=0.3, sigma_v=0.3).positions:
        exif = Image.Exif()
        lon, lat = back.transform(one.x, one.y)
        exif[ExifTags.IFD.GPSInfo] = {1: "N", 2: dms(lat), 3: "E", 4: dms(lon), 5: b"\x00", 6: float(one.z or 0)}
        (folder / one.image).parent.mkdir(parents=True, exist_ok=True)
        Image.new("L", (32, 32)).save(folder / one.image, "JPEG", exif=exif)
    return folder


def dms(degrees: float) -> tuple[float, float, float]:
    minutes = degrees % 1 * 60
    return float(int(degrees)), float(int(minutes)), minutes % 1 * 60


def test_control_points_of_a_model(
    survey: Survey, model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    points = gcp_list(survey.points(np.random.default_rng(1), 9, tag_px=0.2), tmp_path / "gcp_list.txt")
    before = content(model)
    out = tmp_path / "geo"
    assert main(["georeference", str(model), "--gcp", str(points), "--check-every", "3", "--output", str(out)]) == 0
    assert content(model) == before
    facts = json.loads((out / "geo.json").read_text())
    matrix, offset = np.array(facts["crs_from_model"]), np.array(facts["offset_m"])
    centres = survey.model().centres_model @ matrix[:3, :3].T + matrix[:3, 3] + offset
    assert np.abs(centres - survey.frame.crs_from_local(survey.centres_local)).max() < 0.2
    printed = capsys.readouterr().out
    assert printed.startswith(
        "Georeferenced by control points: EPSG:25832 (ETRS89 / UTM zone 32N); vertical datum: unk"
    )
    assert re.search(r"^  control +6 ", printed, re.M)
    assert re.search(r"^  check +3 ", printed, re.M)
    assert re.search(r"^  p2 +check +-?0\.0", printed, re.M)
    assert (
        f"check points: horizontal {facts['accuracy_m']['check']['horizontal'] / facts['pixel_size_m']:.3g}" in printed
    )


def test_gps_of_images_and_warnings_give_exit_code_3(
    survey: Survey, model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    images = images_with_gps(survey, tmp_path / "images")
    (images / survey.names[3]).write_bytes(b"broken")
    words = ["georeference", str(model), "--images", str(images), "--output", str(tmp_path / "geo")]
    assert main(words) == 3
    facts = json.loads((tmp_path / "geo/geo.json").read_text())
    assert (facts["crs"]["epsg"], len(facts["gps"])) == (32632, 11)
    printed = capsys.readouterr()
    assert f"{survey.names[3]}: the GPS tags cannot be read" in printed.err or f"{survey.names[3]}: " in printed.err
    assert re.search(r"^  GPS +11 ", printed.out, re.M)


def test_quiet_prints_warnings_only(
    survey: Survey, model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    points = gcp_list(survey.points(np.random.default_rng(1), 6, tag_px=0.0), tmp_path / "gcp_list.txt")
    with points.open("a") as file:
        file.write("600000 5300000 nonsense\n")
    words = ["georeference", str(model), "--gcp", str(points), "--output", str(tmp_path / "geo"), "--quiet"]
    assert main(words) == 3
    printed = capsys.readouterr()
    assert printed.out == ""
    assert "gcp_list.txt:" in printed.err
    assert "left out: 3 of at least 6 words of `x y z px py image [label]`" in printed.err


def test_what_is_missing_is_named(model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for words, message in (
        ([], "names no images; say with --images where they are, or name positions with --geo or --gcp"),
        (["--geo", "off"], "--geo off leaves nothing to go by; name control points with --gcp"),
        (["--geo", str(tmp_path / "geo.txt")], "geo.txt: cannot be read: No such file or directory"),
        (["--check-every", "3"], "--check-every needs control points; name their list with --gcp"),
        (["--proj-data", str(tmp_path / "none")], "there is no such folder"),
    ):
        assert main(["georeference", str(model), *words]) == 2
        assert message in capsys.readouterr().err
    assert not (model / "geo").exists()


@pytest.mark.slow
def test_a_finished_run_keeps_all_its_other_files(
    finished_example: Example, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its images have no GPS; positions come from a file, one metre for a unit, in any CRS."""
    out = tmp_path / "out"
    shutil.copytree(finished_example.root, out)
    assert main(["georeference", str(out)]) == 2
    assert "no image has a position in its EXIF or XMP" in capsys.readouterr().err
    reconstruction = finished_example.model
    rows = [
        "{},{},{},{}".format(image.name, *(image.projection_center() * [1, 1, 1] + [600000, 5300000, 400]))
        for image in reconstruction.images.values()
        if image.has_pose
    ]
    table = tmp_path / "positions.csv"
    table.write_text("\n".join(["EPSG:25832", "image,x,y,z", *rows]) + "\n")
    before = content(out)
    assert main(["georeference", str(out), "--geo", str(table)]) in (0, 3)
    after = content(out)
    assert {name: after[name] for name in before} == before
    assert set(after) - set(before) == {"geo/geo.json", "geo/cameras.geojson", "geo/gcps.geojson"}
    assert json.loads(after["geo/geo.json"])["metres_per_unit"] == pytest.approx(1, abs=0.01)


# ---------------------------------------------------------------------------------- real sets
@pytest.mark.data
@pytest.mark.slow
def test_a_street_takes_up_from_its_photographs(
    data_dir: Callable[[str], Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The positions lie nearly on a line, and the receiver stood still at the end."""
    data = data_dir("lund_street")
    words = [str(data / "reference_sparse"), "--images", str(data / "images"), "--output", str(tmp_path / "geo")]
    assert main(["georeference", *words]) == 3
    facts = json.loads((tmp_path / "geo/geo.json").read_text())
    assert facts["up_from"] == "the photographs, taken as held upright"
    assert facts["crs"]["epsg"] == 32633
    assert [one["name"] for one in facts["left_out"]] == ["29.jpg"]
    assert facts["accuracy_m"]["gps"]["horizontal"] == pytest.approx(4.2, abs=0.5)
    assert "29.jpg (29.jpg): left out: the position is 13" in capsys.readouterr().err
