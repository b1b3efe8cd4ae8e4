from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers.finished_runs import Example
from helpers.sensor_depth import write_data, write_run

from smust3r_colmap.cli.main import main
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.importers.model_poses import read_model_poses

WALK = np.column_stack([np.arange(8.0), np.sin(np.arange(8)), np.cos(np.arange(8))])


def tum(path: Path, centres: FloatArray, *, first_s: float = 10.5, quaternion: str = "0 0 0 1") -> Path:
    lines = [f"{first_s + k} {x} {y} {z} {quaternion}" for k, (x, y, z) in enumerate(centres)]
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture
def pair(tmp_path: Path) -> list[str]:
    """An estimate that is twice as large as the truth, and 3 units beside it."""
    return [str(tum(tmp_path / "estimate.txt", 2 * WALK + 3)), str(tum(tmp_path / "truth.txt", WALK))]


def test_tables_and_files_have_the_same_figures(
    pair: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = ["--json", str(tmp_path / "rows.json"), "--csv", str(tmp_path / "rows.csv")]
    assert main(["evaluate", *pair, "--align", "se3", *files]) == 0
    printed = capsys.readouterr().out
    rows = {row["metric"]: row for row in json.loads((tmp_path / "rows.json").read_text())["rows"]}
    spread = np.sqrt(((WALK - WALK.mean(axis=0)) ** 2).sum(axis=1).mean())
    assert rows["ape_translation"]["values"]["rmse"] == pytest.approx(spread)
    assert rows["scale"]["values"] == pytest.approx({"scale": 2, "error_percent": 100})
    assert rows["ape_translation"]["unit"] == "units"
    assert rows["ape_translation"]["association"] == "time within 0.01 s"
    assert f"ape_translation       {spread:.4g}" in printed
    table = list(csv.DictReader((tmp_path / "rows.csv").open()))
    assert float(table[0]["value"]) == rows["ape_translation"]["values"]["rmse"]


def test_warnings_end_in_3_and_quiet_prints_no_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = np.column_stack([np.arange(8.0), np.zeros(8), np.zeros(8)])
    pair = [str(tum(tmp_path / "estimate.txt", line)), str(tum(tmp_path / "truth.txt", line))]
    assert main(["evaluate", *pair, "--quiet"]) == 3
    printed = capsys.readouterr()
    assert "on a line" in printed.err
    assert printed.out == ""


@pytest.mark.parametrize(
    ("files", "flags", "code", "message"),
    [
        ({"truth.txt": ""}, [], 2, "truth.txt: has no pose"),
        ({"truth.txt": "10.5 1 2 3 0 0 0\n"}, [], 2, "truth.txt, line 1: 7 words; needed 8"),
        ({"truth.txt": "10.5 1 2 nan 0 0 0 1\n"}, [], 2, "truth.txt, line 1: a number is not finite"),
        ({"truth.txt": "10.5 1 2 3 0 0 0 1\n10.5 1 2 3 0 0 0 1\n"}, [], 2, "the time 10.500000 comes twice"),
        ({"truth.txt": "10.5 1 2 3 0 0 1 1\n"}, [], 2, "truth.txt, line 1: the quaternion has length 1.414"),
        ({"truth.txt": "99.5 1 2 3 0 0 0 1\n"}, [], 2, "no two times are within 0.01 s"),
        ({"truth.txt": "10.5 1 2 3 0 0 0 1\n11.5 1 2 4 0 0 0 1\n"}, [], 1, "2 poses by time within 0.01 s are in both"),
        ({}, ["--associate", "name"], 2, "no name is the same"),
        ({}, ["--rpe-delta", "0.5"], 2, "--rpe-delta 0.5: must be above 0, and a whole number of frames"),
        ({}, ["--max-time-difference", "-1"], 2, "--max-time-difference -1: must be 0 or more"),
        ({}, ["--cloud", "a.ply"], 2, "--cloud and --reference-cloud: give both or neither"),
        ({}, ["--reference-layout", "kitti"], 2, "truth.txt, line 1: 8 numbers; needed 12"),
    ],
)
def test_what_cannot_be_compared_is_refused(
    pair: list[str],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    files: dict[str, str],
    flags: list[str],
    code: int,
    message: str,
) -> None:
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    assert main(["evaluate", *pair, *flags, "--json", str(tmp_path / "rows.json")]) == code
    assert message in capsys.readouterr().err
    assert not (tmp_path / "rows.json").exists()


def test_centres_in_one_place_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pair = [str(tum(tmp_path / "estimate.txt", np.ones((8, 3)))), str(tum(tmp_path / "truth.txt", WALK))]
    assert main(["evaluate", *pair]) == 1
    assert "estimate: all 8 camera centres coincide" in capsys.readouterr().err


def test_without_an_alignment_centres_may_be_in_one_place(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pair = [str(tum(tmp_path / "estimate.txt", np.ones((8, 3)))), str(tum(tmp_path / "truth.txt", WALK))]
    assert main(["evaluate", *pair, "--align", "none"]) == 3
    assert "scale: not determined: estimate: all 8 camera centres coincide" in capsys.readouterr().err


def test_a_run_is_compared_with_its_truth_and_its_predicted_errors(
    finished_example: Example, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The example has noise of 0.2 px; its names have blanks, so that a COLMAP model is the truth."""
    run = tmp_path / "run"
    shutil.copytree(finished_example.root, run)
    names = list(read_model_poses(run / "sparse/0"))
    lines = [f'sparse/0,"{name}",0.01\n' for name in names]
    (run / "poses_uncertainty.csv").write_text("model,image,position_sigma\n" + "".join(lines))
    truth = tmp_path / "truth"
    model = finished_example.model
    for image_id in model.reg_image_ids():
        pose = finished_example.world.cam_from_world[image_id - 1]
        model.frame(model.image(image_id).frame_id).rig_from_world = type(model.image(image_id).cam_from_world())(pose)
    truth.mkdir()
    model.write_binary(truth)
    assert main(["evaluate", str(run), str(truth), "--json", str(tmp_path / "rows.json")]) == 0
    rows = {row["metric"]: row for row in json.loads((tmp_path / "rows.json").read_text())["rows"]}
    centres = invert_rigid(finished_example.world.cam_from_world[: len(names)])[:, :, 3]
    extent = np.linalg.norm(np.ptp(centres, axis=0))
    assert rows["ape_of_extent"]["values"]["extent"] == pytest.approx(extent)
    assert 0 < rows["ape_of_extent"]["values"]["rmse_percent"] < 0.5
    assert (rows["aae"]["compared"], rows["aae"]["in_estimate"], rows["aae"]["in_reference"]) == (9, 9, 9)
    assert rows["predicted_error"]["values"]["within_3_sigma_percent"] == 100
    assert "the reference is a reconstruction" in capsys.readouterr().out


def test_clouds_are_compared(pair: list[str], tmp_path: Path) -> None:
    header = "ply\nformat ascii 1.0\nelement vertex 4\nproperty double x\nproperty double y\nproperty double z\n"
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    for name, cloud in (("estimate.ply", 2 * points + 3), ("truth.ply", points + np.array([0.03, 0, 0]))):
        text = "\n".join(" ".join(map(str, row)) for row in cloud)
        (tmp_path / name).write_text(f"{header}end_header\n{text}\n")
    flags = ["--cloud", str(tmp_path / "estimate.ply"), "--reference-cloud", str(tmp_path / "truth.ply")]
    flags += ["--cloud-thresholds", "0.02", "0.04", "--json", str(tmp_path / "rows.json")]
    assert main(["evaluate", *pair, *flags]) == 0
    rows = {row["metric"]: row["values"] for row in json.loads((tmp_path / "rows.json").read_text())["rows"]}
    assert rows["cloud_chamfer"]["mean"] == pytest.approx(0.03)
    assert rows["cloud_within_0.02_units"] == {"accuracy": 0, "completeness": 0, "f_score": 0}
    assert rows["cloud_within_0.04_units"] == {"accuracy": 100, "completeness": 100, "f_score": 100}


@pytest.mark.slow
def test_depth_maps_of_a_workspace_are_compared_with_the_sensor(tmp_path: Path) -> None:
    """One of three maps is a tenth too deep; the model's unit is a quarter of a metre."""
    data = write_data(tmp_path / "data")
    run = write_run(tmp_path / "run", {"a.jpg": 1.0, "b.jpg": 1.0, "c.jpg": 1.1}, holes=45)
    rows = {}
    for registration in ("kinect", "none"):
        flags = ["--depth-registration", registration, "--json", str(tmp_path / "rows.json"), "--quiet"]
        assert main(["evaluate", str(run / "dense"), str(data), *flags]) == 0
        rows[registration] = {row["metric"]: row for row in json.loads((tmp_path / "rows.json").read_text())["rows"]}
    found = rows["kinect"]["depth"]["values"]
    assert found["abs_rel"] == pytest.approx(0.1 / 3, abs=0.01)
    assert found["delta_1.05"] == pytest.approx(2 / 3, abs=0.03)
    assert found["delta_1.25"] > 0.98
    assert found["coverage"] == pytest.approx(41 / 84, abs=0.02)  # the maps begin at row 45 of 90
    assert "3 images" in rows["kinect"]["depth"]["note"]
    assert "registration kinect" in rows["kinect"]["depth"]["note"]
    assert rows["kinect"]["depth_median_scaled"]["values"]["median_rel"] < 0.01
    assert rows["none"]["depth"]["values"]["abs_rel"] > found["abs_rel"]


def test_depth_that_cannot_be_compared_says_why(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data, run = write_data(tmp_path / "data"), write_run(tmp_path / "run", {"a.jpg": 1.0})
    (data / "intrinsics.txt").unlink()
    assert main(["evaluate", str(run / "dense"), str(data)]) == 0
    assert "depth of the reference is not compared: its layout has no intrinsics" in capsys.readouterr().out


def test_help_names_the_exit_codes(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        main(["evaluate", "--help"])
    assert left.value.code == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "Exit code 0: compared; 3: compared, but a warning" in printed
    assert "--rpe-delta" in printed
