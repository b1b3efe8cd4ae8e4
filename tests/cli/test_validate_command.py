"""``smust3r-colmap validate``: exit codes, text for people, JSON for programs."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
import tyro

from smust3r_colmap.cli.validate import Validate, run_validate
from smust3r_colmap.errors import ConfigError, InputError
from smust3r_colmap.validation import validate as validation


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A pinhole model that no reader minds."""
    folder = tmp_path_factory.mktemp("model") / "sparse" / "0"
    folder.mkdir(parents=True)
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=4, num_points3D=40)
    options.camera_model_id = pycolmap.CameraModelId.PINHOLE
    options.camera_params = [900.0, 900.0, options.camera_width / 2, options.camera_height / 2]
    model = pycolmap.synthesize_dataset(options)
    for point in model.points3D.values():
        point.color = np.array([200, 100, 50], np.uint8)
    model.write_binary(folder)
    return folder


@pytest.fixture
def model(written: Path, tmp_path: Path) -> Path:
    """A copy that a test may break."""
    return shutil.copytree(written, tmp_path / "scene" / "sparse" / "0")


@pytest.fixture
def no_child(monkeypatch: pytest.MonkeyPatch) -> None:
    """The question to pycolmap takes a second; a test of its own asks it."""
    monkeypatch.setattr(validation, "_ask_colmap", lambda folder: "")


def run(*arguments: str) -> int:
    return run_validate(tyro.cli(Validate, args=arguments))


def run_json(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, Any]:
    code = run(*arguments, "--json")
    return code, json.loads(capsys.readouterr().out)


def verdict_of(result: Any, name: str) -> Any:
    return next(reader for reader in result["readers"] if reader["name"] == name)


@pytest.mark.usefixtures("no_child")
def test_a_good_model_ends_with_zero_and_says_so(model: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(str(model)) == 0
    text = capsys.readouterr().out

    assert "4 images, 1 camera (PINHOLE 1024 x 768), 40 points, 160 observations (4.0 a point" in text
    assert "images: none found beside the model" in text
    assert text.splitlines()[-1] == "None of 13 readers refuses the model."


@pytest.mark.usefixtures("no_child")
def test_a_reader_that_refuses_gives_three_unless_it_was_not_asked_for(
    model: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    reconstruction = pycolmap.Reconstruction(model)
    reconstruction.image(1).name = "left/a.png"
    reconstruction.write_binary(model)

    assert run(str(model)) == 3
    text = capsys.readouterr().out
    assert run(str(model), "--readers", "COLMAP", "gsplat") == 0

    (line,) = [line for line in text.splitlines() if line.startswith("refused")]
    assert "names with subfolders: 1 of 4 images, namely 'left/a.png'." in line
    assert "Refused by 3DGS-2023 (drops the folder from the name and finds no file)." in line
    assert "Do: rename the images" in line
    assert text.splitlines()[-1] == "Refused by 1 of 13 readers: 3DGS-2023."


@pytest.mark.usefixtures("no_child")
def test_json_has_findings_readers_and_figures(model: Path, capsys: pytest.CaptureFixture[str]) -> None:
    reconstruction = pycolmap.Reconstruction(model)
    reconstruction.image(1).name = "my image.png"
    reconstruction.write_binary(model)
    code, result = run_json(capsys, str(model))

    assert (code, result["exit_code"], result["readable"]) == (3, 3, True)
    (finding,) = result["findings"]
    assert (finding["rule"], finding["severity"], finding["count"], finding["of"]) == ("name-blank", "refused", 1, 4)
    assert set(finding["refused_by"]) == {"kapture", "instant-ngp"}
    assert set(finding["warned_by"]) == {"COLMAP"}
    assert verdict_of(result, "kapture")["verdict"] == "refuses"
    assert verdict_of(result, "kapture")["rules"] == ["name-blank"]
    assert verdict_of(result, "COLMAP")["verdict"] == "warns"
    assert verdict_of(result, "gsplat")["verdict"] == "ok"
    assert result["figures"]["mean_track_length"] == pytest.approx(4.0)
    assert 0 <= result["figures"]["mean_error_px"] < 1e-6


@pytest.mark.usefixtures("no_child")
def test_a_model_without_observations_has_null_for_its_error(model: Path, capsys: pytest.CaptureFixture[str]) -> None:
    reconstruction = pycolmap.Reconstruction(model)
    for point_id in list(reconstruction.points3D):
        reconstruction.delete_point3D(point_id)
    reconstruction.write_binary(model)
    _, result = run_json(capsys, str(model))

    assert result["figures"]["mean_error_px"] is None
    assert {finding["rule"] for finding in result["findings"]} == {"points-none", "image-unobserved"}


@pytest.mark.usefixtures("no_child")
def test_a_file_cut_short_ends_with_one_and_everything_else_is_still_looked_at(
    model: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    points = model / "points3D.bin"
    points.write_bytes(points.read_bytes()[:-10])
    code, result = run_json(capsys, str(model))

    assert (code, result["readable"]) == (1, False)
    assert result["findings"][0]["rule"] == "file-truncated"
    assert "points3D.bin, byte" in result["findings"][0]["example"]
    assert result["figures"]["num_points"] == 39
    assert {reader["verdict"] for reader in result["readers"]} == {"refuses"}


def test_text_that_cannot_be_read_ends_with_one_and_says_only_that(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("cameras.txt", "images.txt"):
        (tmp_path / name).write_text("garbage\n")
    code, result = run_json(capsys, str(tmp_path))
    run(str(tmp_path))
    text = capsys.readouterr().out

    assert (code, result["readable"]) == (1, False)
    assert [finding["rule"] for finding in result["findings"]] == ["file-unreadable", "text-bad-line"]
    assert "0 readable images, 0 readable cameras, 0 readable points\n" in text
    assert "cameras.txt, images.txt" in text
    assert "Do: copy or write the model again; is it a model of COLMAP at all? [file-unreadable]" in text


def test_no_model_ends_with_one_and_says_why(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(str(tmp_path)) == 1
    assert "no COLMAP model here" in capsys.readouterr().err
    code, result = run_json(capsys, str(tmp_path))

    assert (code, result["readable"]) == (1, False)
    assert "no COLMAP model here" in result["reason"]


def test_wrong_use_is_an_error_of_the_caller(model: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        run(str(tmp_path / "nothing"))
    with pytest.raises(ConfigError, match="--readers metashape: no such reader"):
        run(str(model), "--readers", "Metashape")


@pytest.mark.slow
def test_pycolmap_is_asked_in_a_process_of_its_own(model: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What it says alone would help nobody; beside it stands what is missing."""
    (model / "rigs.bin").unlink()
    code, result = run_json(capsys, str(model))
    findings = {finding["rule"]: finding for finding in result["findings"]}

    assert code == 3
    assert "Rig with ID 1 does not exist" in findings["colmap-cannot-read"]["text"]
    assert findings["rigs-incomplete"]["text"] == "rigs is missing"
    assert verdict_of(result, "COLMAP")["verdict"] == "refuses"
    assert verdict_of(result, "nerfstudio")["verdict"] == "ok"


@pytest.mark.usefixtures("no_child")
def test_findings_are_wrapped_for_a_terminal_only(
    model: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (model / "points3D.bin").unlink()
    run(str(model))
    piped = capsys.readouterr().out
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    monkeypatch.setattr(shutil, "get_terminal_size", lambda: os.terminal_size((80, 24)))
    run(str(model))
    wrapped = capsys.readouterr().out

    def findings(text: str) -> str:
        return text.split("\n\n")[1]

    assert all(line[:8].strip() for line in findings(piped).splitlines())
    assert max(len(line) for line in findings(wrapped).splitlines()) <= 80
    assert findings(wrapped).split() == findings(piped).split()


def test_the_command_is_imported_without_anything_heavy() -> None:
    program = (
        "import sys, smust3r_colmap.cli.validate\n"
        "print(sorted({'numpy', 'pycolmap', 'scipy', 'PIL', 'cv2'} & set(sys.modules)))"
    )
    child = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)

    assert child.stdout.strip() == "[]"
