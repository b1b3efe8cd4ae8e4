"""The script that draws a run's cloud: which cloud it draws, where, and what it refuses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
import pytest
import render_cloud as script
from PIL import Image

from smust3r_colmap.exporters.ply import write_ply
from smust3r_colmap.products import PointCloud

RED, BLUE = (200, 10, 20), (10, 20, 200)


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A model with points in the middle of its cameras, drawn red in ``points.ply`` and blue in ``dense/fused.ply``."""
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_frames_per_rig=5, num_points3D=100)
    model = pycolmap.synthesize_dataset(options)
    (tmp_path / "sparse/0").mkdir(parents=True)
    (tmp_path / "dense").mkdir()
    model.write_binary(tmp_path / "sparse/0")
    xyz = np.array([point.xyz for point in model.points3D.values()])
    for file, colour in (("points.ply", RED), ("dense/fused.ply", BLUE)):
        write_ply(PointCloud(xyz=xyz, rgb=np.tile(np.array(colour, np.uint8), (len(xyz), 1))), tmp_path / file)
    return tmp_path


def pixels_of(picture: Path, colour: tuple[int, int, int]) -> list[int]:
    """How many pixels of each of the three views have exactly this colour."""
    views = np.split(np.asarray(Image.open(picture)), 3, axis=1)
    return [int((view == colour).all(axis=2).sum()) for view in views]


@pytest.mark.slow
def test_the_cloud_of_the_run_is_drawn_unless_another_is_named(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own, fused = tmp_path / "own.png", tmp_path / "fused.png"
    assert script.main([str(run), str(own)]) == 0
    assert script.main([str(run), str(fused), "--cloud", str(run / "dense/fused.ply")]) == 0
    assert capsys.readouterr().out.count("; 100 points") == 2
    assert pixels_of(own, BLUE) == pixels_of(fused, RED) == [0, 0, 0]
    above, side, seen = pixels_of(own, RED)
    assert 50 < above <= 100 and 50 < side <= 100 and 200 < seen <= 400  # squares of 2 x 2 pixels in the camera's view
    assert pixels_of(fused, BLUE) == [above, side, seen]


@pytest.mark.slow
def test_the_overview_shows_cameras_and_what_faces_the_viewer(run: Path, tmp_path: Path) -> None:
    """A floor that is red towards the sky and blue towards the ground, seen from above."""
    model = pycolmap.Reconstruction(run / "sparse/0")
    level_from_world = script.level_frame([model.image(i) for i in sorted(model.reg_image_ids())])
    rng = np.random.default_rng(0)
    floor = rng.uniform([-9, -0.01, -9], [9, 0.01, 9], (200_000, 3)) @ level_from_world
    is_red = np.arange(len(floor)) % 2 == 0
    rgb = np.where(is_red[:, None], RED, BLUE).astype(np.uint8)
    normals = np.where(is_red[:, None], -level_from_world[1], level_from_world[1])  # the level frame has y down
    write_ply(PointCloud(xyz=floor, rgb=rgb, normals=normals), tmp_path / "floor.ply")
    picture = tmp_path / "overview.png"
    assert script.main([str(run), str(picture), "--overview", "--cloud", str(tmp_path / "floor.ply")]) == 0
    drawn = np.asarray(Image.open(picture).convert("RGB")).astype(int)
    assert drawn.shape == (*script.OVERVIEW_PX[::-1], 3)
    red, blue = ((np.abs(drawn - colour).max(axis=2) < 20).mean() for colour in (RED, BLUE))
    assert red > 0.2
    assert blue == 0
    assert all((np.abs(drawn - colour).max(axis=2) < 40).any() for colour in (script.FIRST_RGB, script.LAST_RGB))
    assert picture.stat().st_size < 200_000


def test_strays_have_no_company() -> None:
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(0, 0.1, (50_000, 3)), [[1.0, 1.0, 1.0]]])
    kept = script.has_company(points)
    assert kept[:-1].mean() > 0.8
    assert not kept[-1]


def test_a_cloud_that_cannot_be_drawn_is_refused_by_name(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    picture = tmp_path / "picture.png"
    xyz = "property float x\nproperty float y\nproperty float z"
    (tmp_path / "bare.ply").write_text(f"ply\nformat ascii 1.0\nelement vertex 1\n{xyz}\nend_header\n1 2 3\n")
    (tmp_path / "empty.ply").write_text(f"ply\nformat ascii 1.0\nelement vertex 0\n{xyz}\nend_header\n")
    (tmp_path / "text.ply").write_text("hello")
    for name, message in (
        ("gone.ply", "cannot be read as a cloud"),
        ("text.ply", "cannot be read as a cloud"),
        ("empty.ply", "has faces, or no points"),
        ("bare.ply", "0 colours of 1 points"),
    ):
        assert script.main([str(run), str(picture), "--cloud", str(tmp_path / name)]) == 2
        assert f"{name}: {message}" in capsys.readouterr().err
    assert not picture.exists()


def test_a_folder_without_a_model_is_refused(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (run / "sparse/0/cameras.bin").unlink()
    assert script.main([str(run), str(tmp_path / "picture.png")]) == 2
    assert "sparse/0: no COLMAP model; is this the output of a finished run?" in capsys.readouterr().err


@pytest.mark.parametrize("looks_down", [False, True])
def test_the_level_frame_knows_what_is_down(looks_down: bool) -> None:
    """Cameras that all look ahead and turn about the vertical, or that look down and turn about their own axis."""
    down_of_cam = np.array([0.0, 0.0, 1.0] if looks_down else [0.0, 1.0, 0.0])
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(pycolmap.Camera.create_from_model_name(1, "PINHOLE", 50.0, 64, 48))
    for turn_deg in (0.0, 175.0, 5.0, 180.0):
        rotation = pycolmap.Rotation3d(np.deg2rad(turn_deg) * down_of_cam)
        image = pycolmap.Image(name=f"{turn_deg}", camera_id=1, image_id=int(turn_deg) + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(rotation, np.zeros(3)))
    level_from_world = script.level_frame([model.image(i) for i in sorted(model.reg_image_ids())])
    np.testing.assert_allclose(level_from_world @ level_from_world.T, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(level_from_world[1], down_of_cam, atol=1e-9)
    np.testing.assert_allclose(level_from_world[0], [1, 0, 0], atol=1e-9)
