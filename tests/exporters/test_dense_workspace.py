"""COLMAP's dense workspace: what other readers find in it, and what is refused before anything is written."""

from __future__ import annotations

import errno
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pycolmap
import pytest
import trimesh
from helpers.dense_scenes import (
    BALL_CENTRE,
    BALL_RADIUS,
    CAMERA,
    NAMES,
    WALL_NORMAL,
    camera_and_pose,
    distance_to_surface,
    exact_depth,
    exact_maps,
    exact_model,
    maps_of,
    picture,
    surface_depths,
    write_pictures,
)
from helpers.independent_colmap_reader import read_binary
from PIL import Image

from smust3r_colmap.errors import ImageError, InputError, RunDirectoryError, StorageError
from smust3r_colmap.exporters import dense_workspace
from smust3r_colmap.exporters.dense_workspace import DenseReport, write_dense_workspace
from smust3r_colmap.geometry.camera import Intrinsics, pixel_centres

WITHOUT_MAP = "f.png"
WORKSPACE_NAMES = tuple(f"{name}.png" if name.endswith(".webp") else name for name in NAMES)
UNIT = 0.4  # of the maps, in that of the model


@dataclass(frozen=True)
class Written:
    """A workspace with what was said about it."""

    folder: Path
    report: DenseReport


def some_maps() -> Any:
    return maps_of({name: depth / np.float32(UNIT) for name, depth in exact_maps().items() if name != WITHOUT_MAP})


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pictures")
    write_pictures(folder)
    return folder


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory, pictures: Path) -> Written:
    """Written over an older workspace, from a model on disk."""
    root = tmp_path_factory.mktemp("dense")
    (root / "model").mkdir()
    exact_model().write_binary(root / "model")
    (root / "dense/images").mkdir(parents=True)
    (root / "dense/images/old.jpg").write_bytes(b"old")
    report = write_dense_workspace(root / "model", pictures, some_maps(), root / "dense")
    assert {path.name for path in root.iterdir()} == {"model", "dense"}, "nothing is left beside it"
    return Written(root / "dense", report)


def read_map(path: Path) -> npt.NDArray[np.float32]:
    """(H, W, C) by the published format."""
    content = path.read_bytes()
    width, height, channels, values = content.split(b"&", 3)
    shape = (int(channels), int(height), int(width))
    return np.asarray(np.frombuffer(values, "<f4").reshape(shape).transpose(1, 2, 0), dtype=np.float32)


def pinhole(folder: Path, name: str) -> tuple[Intrinsics, npt.NDArray[np.float64]]:
    """Camera and cam_from_world of an undistorted image."""
    return camera_and_pose(pycolmap.Reconstruction(folder / "sparse"), name)


# ------------------------------------------------------------------------------ layout
@pytest.mark.slow
def test_layout_is_that_of_colmap(written: Written) -> None:
    found = {str(path.relative_to(written.folder)) for path in written.folder.rglob("*") if path.is_file()}
    with_map = [name for name in WORKSPACE_NAMES if name != WITHOUT_MAP]
    expected = {f"images/{name}" for name in WORKSPACE_NAMES}
    expected |= {f"stereo/{kind}_maps/{name}.geometric.bin" for kind in ("depth", "normal") for name in with_map}
    expected |= {f"sparse/{name}.bin" for name in ("cameras", "images", "points3D", "rigs", "frames")}
    expected |= {"stereo/fusion.cfg", "stereo/patch-match.cfg", "fused.ply", "fused.ply.vis"}
    assert {name for name in found if not name.endswith(".sh")} == expected
    assert (written.folder / "stereo/consistency_graphs").is_dir()
    assert (written.folder / "stereo/fusion.cfg").read_text().splitlines() == with_map
    patch_match = (written.folder / "stereo/patch-match.cfg").read_text().splitlines()
    assert patch_match == [line for name in WORKSPACE_NAMES for line in (name, "__auto__, 20")]


def test_images_are_undistorted_upright_and_as_large_as_the_maps(written: Written) -> None:
    model = read_binary(written.folder / "sparse")
    assert {camera.model for camera in model.cameras.values()} == {"PINHOLE"}
    assert [image.name for image in model.images.values()] == list(WORKSPACE_NAMES)
    assert len(model.points) > 300
    for name in WORKSPACE_NAMES:
        camera, pose = pinhole(written.folder, name)
        assert max(camera.width, camera.height) == 80
        pixels = np.asarray(Image.open(written.folder / "images" / name).convert("RGB")).astype(int)
        assert pixels.shape == (camera.height, camera.width, 3)
        assert np.median(np.abs(pixels - picture(camera, pose))) < 6, name
        if name != WITHOUT_MAP:
            assert read_map(written.folder / f"stereo/depth_maps/{name}.geometric.bin").shape[:2] == pixels.shape[:2]


# -------------------------------------------------------------------------------- maps
def test_depth_maps_hold_the_depth_of_the_model_for_colmap_and_by_the_format(written: Written) -> None:
    for name in WORKSPACE_NAMES:
        if name == WITHOUT_MAP:
            continue
        path = written.folder / f"stereo/depth_maps/{name}.geometric.bin"
        depth = read_map(path)[..., 0]
        by_colmap = pycolmap.DepthMap()
        by_colmap.read(path)
        np.testing.assert_array_equal(by_colmap.to_array(), depth)
        has = depth > 0
        assert 0.7 < has.mean() < 1
        relative = np.abs(depth[has] / exact_depth(*pinhole(written.folder, name))[has] - 1)
        assert np.median(relative) < 2e-3
        assert np.percentile(relative, 99) < 0.02


def test_normal_maps_are_those_of_the_surfaces_and_face_the_camera(written: Written) -> None:
    for name in ("a.jpg", "left/c d.jpg"):
        normals = read_map(written.folder / f"stereo/normal_maps/{name}.geometric.bin")
        depth = read_map(written.folder / f"stereo/depth_maps/{name}.geometric.bin")[..., 0]
        camera, pose = pinhole(written.folder, name)
        np.testing.assert_allclose(np.linalg.norm(normals[depth > 0], axis=-1), 1, atol=1e-5)
        np.testing.assert_array_equal(normals[depth == 0], 0)
        rays = camera.rays_cam(pixel_centres(camera.width, camera.height)).reshape(*depth.shape, 3)
        assert (np.einsum("hwi,hwi->hw", rays, normals)[depth > 0] < 0).all()
        ball, wall = surface_depths(camera, pose)
        on_wall = (depth > 0) & (wall < ball)
        towards = -pose[:, :3] @ [0.3, 0.1, 1.0] / np.linalg.norm([0.3, 0.1, 1.0])
        angle_deg = np.degrees(np.arccos(np.clip(normals[on_wall] @ towards, -1, 1)))
        assert np.median(angle_deg) < 1
        assert np.percentile(angle_deg, 95) < 10


# ------------------------------------------------------------------------------ fusion
def test_the_fused_cloud_lies_on_the_surfaces(written: Written) -> None:
    cloud = trimesh.load(written.folder / "fused.ply")
    assert isinstance(cloud, trimesh.PointCloud)
    points = np.asarray(cloud.vertices)
    assert written.report.num_points == len(points)
    assert 2_000 < len(points) < 10_000
    distance = distance_to_surface(points)
    assert np.median(distance) < 0.002, "a pixel is 0.05 wide on the wall; half of one would show as 0.013"
    assert np.percentile(distance, 99) < 0.06
    normals = np.asarray(cloud.metadata["_ply_raw"]["vertex"]["data"][["nx", "ny", "nz"]].tolist())
    on_ball = np.linalg.norm(points - BALL_CENTRE, axis=1) < 1.2 * BALL_RADIUS
    truth = np.where(on_ball[:, None], points - BALL_CENTRE, -WALL_NORMAL)
    cosines = np.einsum("ni,ni->n", normals, truth) / np.linalg.norm(truth, axis=1)
    assert np.median(np.degrees(np.arccos(np.clip(cosines, -1, 1)))) < 2, "COLMAP read the normal maps as we meant them"
    assert (written.folder / "fused.ply.vis").stat().st_size > 8 + (4 + 4 * 3) * len(points)


@pytest.mark.slow
def test_names_that_cfg_files_cannot_hold_are_renamed(tmp_path: Path, pictures: Path) -> None:
    """A line of a .cfg file loses blanks at its ends, and is a comment if it begins with #."""
    shutil.copytree(pictures, tmp_path / "pictures")
    model, maps = exact_model(), exact_maps()
    new_name = {NAMES[0]: f" lead{Path(NAMES[0]).suffix}", NAMES[1]: f"#01 wall{Path(NAMES[1]).suffix}"}
    for image in model.images.values():
        if image.name in new_name:
            (tmp_path / "pictures" / image.name).rename(tmp_path / "pictures" / new_name[image.name])
            maps[new_name[image.name]] = maps.pop(image.name)
            image.name = new_name[image.name]
    scaled = maps_of({name: depth / np.float32(UNIT) for name, depth in maps.items()})
    write_dense_workspace(model, tmp_path / "pictures", scaled, tmp_path / "dense")
    lines = (tmp_path / "dense/stereo/fusion.cfg").read_text().splitlines()
    assert len(lines) == len(NAMES)
    assert all(line == line.strip() and not line.startswith("#") for line in lines)
    assert all((tmp_path / "dense/images" / line).is_file() for line in lines)
    cloud = trimesh.load(tmp_path / "dense/fused.ply")
    assert isinstance(cloud, trimesh.PointCloud)
    assert len(cloud.vertices) > 0


def test_the_report_counts_what_is_there(written: Written) -> None:
    report = written.report
    assert (report.num_images, report.without_map, report.borrowed_scale) == (6, (WITHOUT_MAP,), ())
    assert 0.7 < report.coverage < 1


# ---------------------------------------------------------------------------- refusals
Damage = Callable[[Path], object]


def cut_off(path: Path) -> None:
    """Lose the second half of a file; COLMAP would fill the picture with grey."""
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda folder: (folder / "b.jpg").unlink(), r"b.jpg: there is no such file in .*; give the folder"),
        (lambda folder: cut_off(folder / "b.jpg"), r"b.jpg: cannot be decoded: damaged, cut off"),
        (lambda folder: (folder / "b.jpg").write_bytes(b"no image"), r"b.jpg: no JPEG, PNG, WebP or TIFF image"),
        (
            lambda folder: Image.new("RGB", (80, 60)).save(folder / "b.jpg"),
            r"b.jpg: the file is 80x60 px and its camera 160x120; give the images that the model was made of",
        ),
        (
            lambda folder: Image.new("RGB", (120, 160)).save(folder / "left/e.webp"),
            r"left/e.webp: the file is 120x160 px and its camera 160x120",
        ),
    ],
)
def test_bad_images_are_named_and_nothing_is_written(tmp_path: Path, damage: Damage, message: str) -> None:
    write_pictures(tmp_path / "images")
    damage(tmp_path / "images")
    with pytest.raises(ImageError, match=message):
        write_dense_workspace(exact_model(50), tmp_path / "images", some_maps(), tmp_path / "out/dense")
    assert not (tmp_path / "out").exists()


def test_a_model_without_any_map_is_refused(tmp_path: Path, pictures: Path) -> None:
    with pytest.raises(InputError, match="no depth map for any of the 6 images of the model"):
        write_dense_workspace(exact_model(50), pictures, maps_of({}), tmp_path / "dense")
    assert not any(tmp_path.iterdir())


def test_a_folder_that_is_no_model_is_refused(tmp_path: Path, pictures: Path) -> None:
    with pytest.raises(InputError, match=r"nowhere: no COLMAP model that can be read"):
        write_dense_workspace(tmp_path / "nowhere", pictures, some_maps(), tmp_path / "dense")


def test_names_that_leave_the_image_folder_are_refused(tmp_path: Path, pictures: Path) -> None:
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(CAMERA.colmap_camera(1))
    image = pycolmap.Image(name="../a.jpg", camera_id=1, image_id=1)
    model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    with pytest.raises(InputError, match=r"\.\./a\.jpg: the name of an image must be a path below the image folder"):
        write_dense_workspace(model, pictures, maps_of({"../a.jpg": exact_maps()["a.jpg"]}), tmp_path / "dense")


def test_a_folder_with_other_files_is_not_touched(tmp_path: Path, pictures: Path) -> None:
    (tmp_path / "dense").mkdir()
    (tmp_path / "dense/thesis.tex").write_text("years of work")
    with pytest.raises(RunDirectoryError, match=r"holds 'thesis.tex', which is not ours to replace"):
        write_dense_workspace(exact_model(50), pictures, some_maps(), tmp_path / "dense")
    assert (tmp_path / "dense/thesis.tex").read_text() == "years of work"


def test_a_full_disk_leaves_nothing_that_looks_finished(
    tmp_path: Path, pictures: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*arguments: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(dense_workspace, "_undistort", full)
    with pytest.raises(StorageError, match=r"dense: cannot be written \(No space left on device\)"):
        write_dense_workspace(exact_model(50), pictures, some_maps(), tmp_path / "dense")
    assert not any(tmp_path.iterdir())
