"""The judge of depth maps by a sensor: its registration, its measures, and whole workspaces with stated errors."""

from __future__ import annotations

import json
import math
from pathlib import Path

import judge_depth_maps as judge
import numpy as np
import numpy.typing as npt
import pycolmap
import pytest
from helpers.sensor_depth import NAMES, UNIT_M, VIEW, write_data, write_run

from smust3r_colmap.errors import InputError
from smust3r_colmap.exporters.dense_workspace import write_map

FloatMap = npt.NDArray[np.float32]


# ----------------------------------------------------------------------------- measures
def test_points_that_are_not_before_their_camera_are_counted_and_not_compared() -> None:
    """A point as far behind the camera as the surface is before it would be off by nothing."""
    model, truth = pycolmap.Reconstruction(), np.full((VIEW.height, VIEW.width), 2, np.float32)
    model.add_camera_with_trivial_rig(VIEW.colmap_camera(1))
    image = pycolmap.Image(name="a", camera_id=1, image_id=1)
    image.points2D = pycolmap.Point2DList([pycolmap.Point2D([30.0, 40.0])] * 4)
    model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    for k, z in enumerate((2.0, 3.0, -2.0, 0.0)):
        model.add_point3D([0, 0, z], pycolmap.Track([pycolmap.TrackElement(1, k)]), np.zeros(3, np.uint8))
    ratios, num_behind = judge.point_ratios(model, model.image(1), truth)
    assert (ratios.tolist(), num_behind) == ([1.0, 1.5], 2)


def test_one_scale_is_taken_of_all_pixels_together() -> None:
    small, large = (
        judge.Comparison(name=name, num_true=count, ratios=np.full(count, ratio), point_ratios=np.empty(0))
        for name, count, ratio in (("a", 10, 0.5), ("b", 30, 0.4))
    )
    assert judge.scale_of_depth([small, large]) == pytest.approx(2.5)
    with pytest.raises(InputError, match=r"no pixel of 1 images .* \(9 have\)"):
        judge.scale_of_depth([judge.Comparison(name="", num_true=9, ratios=np.empty(0), point_ratios=np.empty(0))])


def test_json_has_null_for_what_could_not_be_compared() -> None:
    assert judge.without_nan({"a": [math.nan, 1.0], "b": "x"}) == {"a": [None, 1.0], "b": "x"}


# --------------------------------------------------------------------------- the script
@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_data(tmp_path_factory.mktemp("data"))


def test_exact_maps_are_right_but_for_the_edges(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run, report = write_run(tmp_path / "run", dict.fromkeys(NAMES, 1.0), holes=45), tmp_path / "report.json"
    assert judge.main([str(run), str(data), "--json", str(report)]) == 0
    facts = json.loads(report.read_text())
    assert facts["scale_of_depth"] == pytest.approx(UNIT_M, rel=2e-3)
    assert facts["scale_of_cameras"] == pytest.approx(UNIT_M, rel=1e-4)
    overall, points = facts["overall"], facts["points"]
    assert 1e-5 < overall["median_rel"] < 5e-3
    assert overall["median_rel"] <= overall["abs_rel"] < 0.02
    assert 0.95 < overall["delta_105"] <= overall["delta_125"] <= 1
    # The sensor looks at rows 2 to 86, the map begins at row 45.
    assert overall["coverage"] == pytest.approx(41 / 84, abs=0.02)
    assert points["num_compared"] > 60
    assert points["coverage"] is None
    assert facts["num_behind"] == 0
    assert 0 < points["abs_rel"] < 0.02
    assert [one["what"] for one in facts["images"]] == ["a.jpg", "b.jpg", "c.jpg"]
    table = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in table[1:4]] == ["a.jpg", "b.jpg", "c.jpg"]
    assert len({len(line) for line in table[:-1]}) == 1
    assert table[-1].endswith("registration kinect")


def test_a_map_off_by_a_tenth_against_the_others_shows_as_a_tenth(data: Path, tmp_path: Path) -> None:
    run = write_run(tmp_path, {"a.jpg": 1.0, "b.jpg": 1.0, "c.jpg": 1.1})
    found = judge.judge(run, data, registration="kinect")
    assert found.scale_of_depth == pytest.approx(UNIT_M, rel=5e-3)
    medians = {one.what: one.median_rel for one in found.images}
    assert medians["c.jpg"] == pytest.approx(0.1, abs=0.01)
    assert max(medians["a.jpg"], medians["b.jpg"]) < 0.01
    assert found.overall.delta_105 == pytest.approx(2 / 3, abs=0.03)


def test_a_common_factor_goes_into_the_scale_of_depth_and_not_into_that_of_the_cameras(
    data: Path, tmp_path: Path
) -> None:
    run = write_run(tmp_path, dict.fromkeys(NAMES, 1.2))
    found = judge.judge(run, data, registration="kinect")
    assert found.scale_of_depth == pytest.approx(UNIT_M / 1.2, rel=5e-3)
    assert found.overall.abs_rel < 0.02
    assert found.scale_of_cameras == pytest.approx(UNIT_M, rel=1e-4)
    assert found.at_scale_of_cameras.median_rel == pytest.approx(0.2, abs=0.01)


def test_an_image_without_a_map_covers_nothing(data: Path, tmp_path: Path) -> None:
    run = write_run(tmp_path, {"a.jpg": 1.0, "b.jpg": 1.0})
    found = judge.judge(run, data, registration="kinect")
    assert [one.coverage > 0.99 for one in found.images] == [True, True, False]
    assert found.images[2].num_compared == 0
    assert found.overall.coverage == pytest.approx(2 / 3, abs=0.01)


def test_the_wrong_registration_is_worse(data: Path, tmp_path: Path) -> None:
    run = write_run(tmp_path, dict.fromkeys(NAMES, 1.0))
    right, wrong = (judge.judge(run, data, registration=name).overall for name in ("kinect", "none"))
    assert wrong.abs_rel > 1.3 * right.abs_rel


# ----------------------------------------------------------------------------- refusals
def test_a_run_without_a_workspace_is_refused_with_the_way_out(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert judge.main([str(tmp_path), str(data)]) == 2
    assert f"export {tmp_path} --format dense" in capsys.readouterr().err


def test_another_data_set_is_refused(data: Path, tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", {"d.jpg": 1.0})
    with pytest.raises(InputError, match="has no map of the 3 images"):
        judge.judge(run, data, registration="kinect")
    with pytest.raises(InputError, match="has none of the 4 images"):
        judge.judge(run, tmp_path, registration="kinect")


def test_broken_maps_are_refused_by_name(data: Path, tmp_path: Path) -> None:
    run = write_run(tmp_path, {"b.jpg": 1.0})
    path = run / "dense/stereo/depth_maps/b.jpg.geometric.bin"
    whole = path.read_bytes()
    path.write_bytes(whole[:-4])
    with pytest.raises(InputError, match=rf"b.jpg.* {len(whole) - 4} bytes, needed {len(whole)}"):
        judge.judge(run, data, registration="kinect")
    write_map(path, np.ones((20, 30), np.float32))
    with pytest.raises(InputError, match=r"b.jpg.* of 30 x 20 pixels, its camera has 120 x 90"):
        judge.judge(run, data, registration="kinect")
