"""geo.json and the two GeoJSON files: what they say, by other means."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.surveys import make_survey
from scipy.spatial.transform import Rotation

from smust3r_colmap.errors import RunDirectoryError
from smust3r_colmap.exporters.geo_files import write_georeference
from smust3r_colmap.georeferencing.georeference import Georeference, georeference
from smust3r_colmap.importers.survey import Role

pyproj = pytest.importorskip("pyproj")

SURVEY = make_survey(np.random.default_rng(0))


@pytest.fixture(scope="module")
def found() -> Georeference:
    rng = np.random.default_rng(1)
    roles: tuple[Role, ...] = ("control", "control", "control", "control", "check", "check")
    points = SURVEY.points(rng, 6, tag_px=0.1, roles=roles)
    positions = SURVEY.positions(rng, sigma_h=1, sigma_v=2)
    return georeference(
        SURVEY.model(), positions, points, crs="auto", altitude="auto", height_offset_m=0, rng=np.random.default_rng(0)
    )


def test_the_matrices_take_the_model_to_the_crs(found: Georeference, tmp_path: Path) -> None:
    write_georeference(found, tmp_path / "geo")
    facts = json.loads((tmp_path / "geo/geo.json").read_text())
    matrix, offset = np.array(facts["crs_from_model"]), np.array(facts["offset_m"])
    centres = SURVEY.model().centres_model
    truth = SURVEY.frame.crs_from_local(SURVEY.centres_local)
    linear = centres @ matrix[:3, :3].T + matrix[:3, 3] + offset
    assert np.abs(linear - truth).max() < 0.2
    assert np.linalg.norm(linear - found.to_crs(centres), axis=1).max() <= facts["crs_from_model_error_m"] + 1e-9
    assert facts["crs_from_model_error_m"] < 0.002  # the flight is 70 m long
    assert facts["metres_per_unit"] == pytest.approx(7.3, rel=1e-3)
    assert facts["pixel_size_m"] == pytest.approx(0.05, rel=1e-3)
    local = np.array(facts["local_from_model"])
    np.testing.assert_allclose(local[:3, :3] @ local[:3, :3].T, np.eye(3) * facts["metres_per_unit"] ** 2, atol=1e-9)


def test_crs_datum_and_accuracies_are_named(found: Georeference, tmp_path: Path) -> None:
    write_georeference(found, tmp_path / "geo")
    facts = json.loads((tmp_path / "geo/geo.json").read_text())
    assert (facts["crs"]["epsg"], facts["crs"]["vertical"], facts["basis"]) == (25832, "unknown", "control points")
    assert pyproj.CRS.from_wkt(facts["crs"]["wkt2"]).to_epsg() == 25832
    assert {name: one["count"] for name, one in facts["accuracy_m"].items()} == {
        "gps": 36,
        "control": 4,
        "control_leave_one_out": 4,
        "check": 2,
    }
    check = [one for one in facts["points"] if one["role"] == "check"]
    rms = np.sqrt(np.mean([np.sum(np.square(one["residual_m"])) for one in check]))
    assert facts["accuracy_m"]["check"]["spatial"] == pytest.approx(rms)
    assert set(facts["versions"]) == {"smust3r_colmap", "pyproj", "proj"}


def test_geojson_is_in_degrees_and_says_where_cameras_look(found: Georeference, tmp_path: Path) -> None:
    write_georeference(found, tmp_path / "geo")
    cameras = json.loads((tmp_path / "geo/cameras.geojson").read_text())
    back = pyproj.Transformer.from_crs(4326, 25832, always_xy=True)
    for feature, name, centre, pose in zip(
        cameras["features"],
        SURVEY.names,
        SURVEY.frame.crs_from_local(SURVEY.centres_local),
        SURVEY.cam_from_local,
        strict=True,
    ):
        lon, lat, height = feature["geometry"]["coordinates"]
        assert feature["properties"]["filename"] == name
        assert (*back.transform(lon, lat), height) == pytest.approx(tuple(centre), abs=0.2)
        turn = Rotation.from_rotvec(feature["properties"]["rotation"]).as_matrix()
        assert np.degrees(np.arccos((np.trace(turn @ pose[:, :3].T) - 1) / 2)) < 0.3
    points = json.loads((tmp_path / "geo/gcps.geojson").read_text())
    assert [one["properties"]["id"] for one in points["features"]] == [f"p{k}" for k in range(6)]
    assert back.transform(*points["features"][0]["geometry"]["coordinates"][:2]) == pytest.approx(
        tuple(found.points[0].crs_xyz[:2]), abs=1e-3
    )


def test_everything_left_out_has_its_reason(found: Georeference, tmp_path: Path) -> None:
    fixes = (replace(found.fixes[0], left_out="the position is 90 m off"), *found.fixes[1:])
    write_georeference(replace(found, fixes=fixes), tmp_path / "geo")
    facts = json.loads((tmp_path / "geo/geo.json").read_text())
    assert facts["left_out"] == [
        {"kind": "position", "name": SURVEY.names[0], "origin": "geo.txt:2", "reason": "the position is 90 m off"}
    ]


def test_the_files_are_replaced_and_nothing_else(found: Georeference, tmp_path: Path) -> None:
    write_georeference(found, tmp_path / "geo")
    write_georeference(found, tmp_path / "geo")
    (tmp_path / "geo/mine.txt").write_text("mine")
    with pytest.raises(RunDirectoryError, match=r"holds 'mine\.txt', which is not ours to replace"):
        write_georeference(found, tmp_path / "geo")
    assert (tmp_path / "geo/mine.txt").read_text() == "mine"


def test_a_site_without_crs_has_no_geojson(found: Georeference, tmp_path: Path) -> None:
    write_georeference(replace(found, frame=replace(found.frame, crs=None)), tmp_path / "geo")
    assert [path.name for path in (tmp_path / "geo").iterdir()] == ["geo.json"]
    assert json.loads((tmp_path / "geo/geo.json").read_text())["crs"] is None
