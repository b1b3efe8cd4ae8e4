"""From photographs through a trained network to a COLMAP model, with the truth known.

The network is the stand-in of `test_must3r_stand_in.py`: tiny, trained on other views of the demo's room, and run
at 64 x 48 pixels. Bounds are about twice what was measured (position 1.5 % of the extent, rotation 1.6 deg, focal
length 0.3 %, scale 2.5 %).
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
import trimesh

from smust3r_colmap.cli.main import main
from smust3r_colmap.evaluation.trajectory import Evaluation, compare_trajectories
from smust3r_colmap.importers.model_poses import read_model_poses
from smust3r_colmap.importers.poses_txt import read_poses_txt
from smust3r_colmap.synthetic.room import write_demo

pytestmark = pytest.mark.slow

STAND_IN = Path(__file__).parents[2] / "data" / "must3r_stand_in.safetensors"
NUM_IMAGES = 60


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("room")
    write_demo(folder, num_images=NUM_IMAGES, width=320, height=240)
    return folder


@pytest.fixture(scope="module")
def finished(room: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, int]:
    """The output and the exit code. One thread: for a network this small more of them only wait for each other."""
    output = tmp_path_factory.mktemp("run") / "out"
    command = ["reconstruct", str(room / "images"), "--output", str(output), "--quiet", "--workers", "1"]
    command += ["--no-trainer", "--no-dense"]
    network = ["--backbone", "must3r", "--weights", str(STAND_IN), "--network-size", "64"]
    return output, main([*command, *network, "--segment-length", "16", "--overlap", "8"])


@pytest.fixture(scope="module")
def summary(finished: tuple[Path, int]) -> dict[str, Any]:
    facts: dict[str, Any] = json.loads((finished[0] / "summary.json").read_text())
    return facts


@pytest.fixture(scope="module")
def found(finished: tuple[Path, int], room: Path) -> Evaluation:
    return compare_trajectories(read_model_poses(finished[0] / "sparse/0"), read_poses_txt(room / "poses.txt"))


def test_the_network_places_every_image_and_nothing_is_doubted(
    finished: tuple[Path, int], summary: dict[str, Any]
) -> None:
    assert finished[1] == 0
    assert summary["weak_reasons"] == []
    assert summary["num_registered"] == NUM_IMAGES
    assert len(summary["models"]) == 1
    assert summary["scale"] == "metres"
    assert {edge["evidence"] for edge in summary["edges"]} == {"pointmaps", "poses"}


def test_cameras_are_where_they_were(found: Evaluation) -> None:
    assert found.num_compared == NUM_IMAGES
    assert 0.1 < found.position_rmse_percent < 3
    assert 0.1 < found.rotation_median_deg < 3.2


def test_lengths_are_metres(found: Evaluation) -> None:
    assert float(found.reference_from_estimated.scale) == pytest.approx(1, abs=0.06)


def test_the_focal_length_is_that_of_the_photographs(finished: tuple[Path, int], room: Path) -> None:
    (camera,) = pycolmap.Reconstruction(finished[0] / "sparse/0").cameras.values()
    width, height, focal = (float(word) for word in (room / "intrinsics.txt").read_text().split("\n")[1].split()[:3])
    assert (camera.width, camera.height) == (width, height)
    assert camera.mean_focal_length() == pytest.approx(focal, rel=0.02)


def test_the_loop_is_found_by_the_networks_descriptors_and_closed(summary: dict[str, Any]) -> None:
    """The demo ends where it began."""
    (ends,) = [loop for loop in summary["loops"] if (loop["image_a"], loop["image_b"]) == ("000000.jpg", "000059.jpg")]
    assert ends["accepted"], ends["reason"]
    assert ends["gap_after_percent"] < ends["gap_before_percent"]


def test_the_cloud_lies_on_the_walls(finished: tuple[Path, int], found: Evaluation) -> None:
    """The room spans x -3..3 and y -2..2 m, with boxes before the walls; the cameras look level."""
    cloud = trimesh.load(finished[0] / "points.ply", process=False)
    assert isinstance(cloud, trimesh.PointCloud)
    points = found.reference_from_estimated.apply(np.asarray(cloud.vertices))
    assert len(points) > 5_000
    beyond = np.maximum(np.array([-3.0, -2.0]) - points[:, :2], points[:, :2] - [3.0, 2.0]).max(axis=1)
    to_wall = np.abs(np.abs(points[:, :2]) - [3.0, 2.0]).min(axis=1)
    assert np.mean(beyond > 0.3) < 0.05
    assert np.mean(to_wall < 0.15) > 0.4


def test_the_lines_of_the_page_run_and_give_the_cameras(room: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """docs/using_must3r.md, "The network by itself"."""
    page = (Path(__file__).resolve().parents[3] / "docs/using_must3r.md").read_text(encoding="utf-8")
    section = page.partition("## The network by itself")[2]
    lines = re.search(r"```python\n(.*?)```", section, re.DOTALL)
    assert lines, "the page has no such lines"
    photos = sorted((room / "images").iterdir())[:12:3]
    names: dict[str, Any] = {"WEIGHTS": STAND_IN, "PHOTOS": photos}

    exec(lines[1], names)

    printed = capsys.readouterr().out
    assert printed.count("NetworkWindow") == len(photos)
    truth = read_poses_txt(room / "poses.txt")
    moved = np.linalg.norm(truth[photos[-1].name][:3, 3] - truth[photos[0].name][:3, 3])
    assert np.linalg.norm(names["world_from_cam"][:3, 3]) == pytest.approx(moved, rel=0.3), (
        "of the last image, from the first"
    )
