"""Meshes of a dense workspace: the surface is where it was, and the texture shows what the photographs show."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import trimesh
from helpers.dense_scenes import (
    BALL_CENTRE,
    BALL_RADIUS,
    WALL_NORMAL,
    camera_and_pose,
    distance_to_surface,
    exact_depth,
    exact_model,
    paint,
    picture,
    undistorted,
)
from PIL import Image
from scipy.ndimage import map_coordinates

from smust3r_colmap.errors import InputError, MissingDependencyError, ReconstructionError
from smust3r_colmap.execution.task_pool import TaskFailure
from smust3r_colmap.exporters import mesh as mesh_module
from smust3r_colmap.exporters.dense_workspace import write_map
from smust3r_colmap.exporters.mesh import MeshMethod, write_mesh
from smust3r_colmap.exporters.ply import write_ply
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.camera import pixel_centres
from smust3r_colmap.products import PointCloud


@pytest.fixture
def workspace(tmp_path: Path) -> Path:
    """As COLMAP's fusion leaves it, from exact depth; the cloud has a stray point far away."""
    model = undistorted(exact_model(), max_image_size=80)
    (tmp_path / "sparse").mkdir()
    model.write_binary(tmp_path / "sparse")
    points = []
    names = []
    for i in sorted(model.reg_image_ids()):
        image = model.image(i)
        camera, pose = camera_and_pose(model, image.name)
        depth = exact_depth(camera, pose)
        names.append(image.name.rsplit(".", 1)[0] + ".png")
        (tmp_path / "images" / names[-1]).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(picture(camera, pose)).save(tmp_path / "images" / names[-1])
        write_map(tmp_path / f"stereo/depth_maps/{names[-1]}.geometric.bin", depth)
        rays = camera.rays_cam(pixel_centres(camera.width, camera.height))
        points.append((rays * depth.reshape(-1, 1) - pose[:, 3]) @ pose[:, :3])
        image.name = names[-1]
    model.write_binary(tmp_path / "sparse")
    (tmp_path / "stereo/fusion.cfg").write_text("".join(f"{name}\n" for name in names))
    write_ply(cloud_of(np.concatenate([*points, [[900.0, 0.0, 0.0]]])), tmp_path / "fused.ply")
    return tmp_path


def cloud_of(points: FloatArray) -> PointCloud:
    on_ball = np.linalg.norm(points - BALL_CENTRE, axis=1) < 1.05 * BALL_RADIUS
    normals = np.where(on_ball[:, None], points - BALL_CENTRE, -WALL_NORMAL)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return PointCloud(xyz=points, rgb=paint(points), normals=normals.astype(np.float32))


@pytest.fixture
def in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Starting a child and loading Open3D there takes seconds; what it does there can be seen here."""

    def run(function: Callable[[Any], Any], task: Any, **options: object) -> Any:
        try:
            return function(task)
        except ReconstructionError as error:
            return TaskFailure(reason=str(error), crashed=False)

    monkeypatch.setattr(mesh_module, "in_child", run)


@pytest.fixture
def open3d() -> Any:
    try:
        import open3d  # noqa: PLC0415
    except ImportError as error:
        pytest.skip(f"open3d cannot be imported: {error}")
    return open3d


# ----------------------------------------------------------------------------- surface
@pytest.mark.parametrize("method", ["poisson", "tsdf"])
@pytest.mark.usefixtures("open3d", "in_this_process")
def test_the_mesh_lies_on_the_surfaces_and_only_there(workspace: Path, method: MeshMethod) -> None:
    report = write_mesh(workspace, method)
    ply = trimesh.load(report.ply)
    assert isinstance(ply, trimesh.Trimesh)
    assert (len(ply.vertices), len(ply.faces)) == (report.num_vertices, report.num_faces)
    assert 2_000 < len(ply.faces) < 200_000
    distance = distance_to_surface(np.asarray(ply.vertices))
    assert np.median(distance) < 0.01
    assert np.percentile(distance, 95) < 0.08, "the stray point neither made faces nor took the resolution"
    assert isinstance(ply.visual, trimesh.visual.ColorVisuals)
    shades = np.abs(np.asarray(ply.visual.vertex_colors)[:, :3].astype(int) - paint(np.asarray(ply.vertices)))
    assert np.median(shades) < 8
    assert report.textured > 0.7
    assert 1 <= report.num_views <= 6
    assert report.glb == workspace / f"mesh_{method}.glb"
    assert median_shade_error(report.glb) < 6


# ----------------------------------------------------------------------------- texture
def wall_and_ball() -> mesh_module._Mesh:
    """A grid on the wall, and a ball; painted white, so that colour can come from photographs only."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(-1, 1, 40), np.linspace(-0.8, 0.8, 40)))
    wall = np.column_stack([x, y, 5 - 0.3 * x - 0.1 * y])
    corner = (np.arange(39)[:, None] * 40 + np.arange(39)).ravel()
    squares = np.concatenate(
        [np.column_stack([corner, corner + 40, corner + 1]), np.column_stack([corner + 1, corner + 40, corner + 41])]
    )
    ball = trimesh.creation.icosphere(subdivisions=4, radius=BALL_RADIUS)
    return mesh_module._Mesh(
        vertices=np.concatenate([wall, np.asarray(ball.vertices) + BALL_CENTRE]),
        rgb=np.full((len(wall) + len(ball.vertices), 3), 255, np.uint8),
        faces=np.concatenate([squares, np.asarray(ball.faces) + len(wall)]),
    )


def textured_glb(workspace: Path) -> tuple[Path, npt.NDArray[np.int64]]:
    mesh, views = wall_and_ball(), list(mesh_module._views(workspace))
    chosen = mesh_module._chosen_views(mesh, views)
    view_of_face = mesh_module._best_views(mesh, chosen)
    path = workspace / "made.glb"
    path.write_bytes(mesh_module._as_glb(mesh, chosen, view_of_face))
    return path, view_of_face


def median_shade_error(path: Path) -> float:
    """Of the textured faces' middles against the paint of the scene, in grey levels, as a viewer would show them."""
    scene = trimesh.load(path)
    assert isinstance(scene, trimesh.Scene)
    world_from_gltf = np.diag([1.0, -1.0, -1.0, 1.0])
    node = next(node for node in scene.graph.nodes_geometry if scene.graph[node][1] == "textured")
    gltf_from_mesh, name = scene.graph[node]
    mesh = scene.geometry[name]
    middles = trimesh.transform_points(mesh.vertices[mesh.faces].mean(axis=1), world_from_gltf @ gltf_from_mesh)
    texture = np.asarray(mesh.visual.material.baseColorTexture.convert("RGB"))
    uv = mesh.visual.uv[mesh.faces].mean(axis=1)
    assert (uv > 0).all()
    assert (uv < 1).all()
    column, row = (uv * [1, -1] + [0, 1]).T * np.array([[texture.shape[1]], [texture.shape[0]]])
    shown = [map_coordinates(texture[..., k].astype(float), (row - 0.5, column - 0.5), order=1) for k in range(3)]
    return float(np.median(np.abs(np.transpose(shown) - paint(middles))))


def test_texture_shows_at_each_place_what_the_photographs_show_there(workspace: Path) -> None:
    path, view_of_face = textured_glb(workspace)
    assert median_shade_error(path) < 5  # half a pixel beside is 6, JPEG of such small pictures 4
    num_seen = np.count_nonzero(view_of_face >= 0)
    scene = trimesh.load(path)
    assert isinstance(scene, trimesh.Scene)
    assert len(scene.geometry["textured"].faces) == num_seen
    assert len(scene.geometry["coloured"].faces) == len(view_of_face) - num_seen
    assert scene.geometry["textured"].visual.material.baseColorTexture.format == "JPEG"


def test_faces_turned_away_and_hidden_ones_get_no_pixels(workspace: Path) -> None:
    mesh = wall_and_ball()
    _, view_of_face = textured_glb(workspace)
    centres = mesh.vertices[mesh.faces].mean(axis=1)
    on_ball = np.arange(len(mesh.faces)) >= 2 * 39 * 39
    back = on_ball & (centres[:, 2] > BALL_CENTRE[2] + 0.2)
    assert (view_of_face[back] == -1).all()
    front = on_ball & (centres[:, 2] < BALL_CENTRE[2] - 0.3)
    assert np.mean(view_of_face[front] >= 0) > 0.95
    behind_ball = ~on_ball & (np.linalg.norm(centres[:, :2], axis=1) < 0.2)
    assert np.count_nonzero(behind_ball) > 20
    assert (view_of_face[behind_ball] == -1).all(), "no camera sees the wall right behind the ball"
    inside_out = replace(mesh, faces=mesh.faces[:, ::-1])
    assert (mesh_module._best_views(inside_out, list(mesh_module._views(workspace))) == -1).all()


def test_a_texture_of_many_images_is_shrunk_to_what_graphics_hardware_holds(workspace: Path) -> None:
    views = list(mesh_module._views(workspace)) * 3
    tiles = mesh_module._Tiles.of(views)
    assert (tiles.columns * tiles.rows, tiles.shrink) == (20, 1.0)
    limit, mesh_module.MAX_TEXTURE_PX = mesh_module.MAX_TEXTURE_PX, 128
    try:
        small = mesh_module._Tiles.of(views)
        picture_size = small.picture(views).size
    finally:
        mesh_module.MAX_TEXTURE_PX = limit
    assert 100 < max(picture_size) <= 128
    corner, opposite = small.uv(17, np.array([[0.0, 0.0], [views[17].width, views[17].height]]))
    assert corner.min() >= 0
    assert opposite.max() <= 1
    np.testing.assert_allclose((opposite - corner) * picture_size, [32, -23.6])  # 128 px hold four of 80


# ---------------------------------------------------------------------------- refusals
@pytest.mark.usefixtures("in_this_process")
def test_without_open3d_the_message_says_what_to_install(workspace: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(MissingDependencyError, match=r"a mesh needs open3d: "):
        write_mesh(workspace, "tsdf")
    assert not list(workspace.glob("mesh_*"))


@pytest.mark.parametrize("name", ["sparse/images.bin", "stereo/fusion.cfg", "fused.ply"])
def test_an_incomplete_workspace_is_refused(workspace: Path, name: str) -> None:
    (workspace / name).unlink()
    with pytest.raises(InputError, match=rf"there is no {name}; give a dense workspace"):
        write_mesh(workspace, "poisson")


def test_a_cloud_of_few_points_is_refused(workspace: Path) -> None:
    write_ply(cloud_of(np.random.default_rng(0).normal(size=(99, 3))), workspace / "fused.ply")
    with pytest.raises(InputError, match=r"fused.ply: 99 points, a mesh needs at least 100"):
        write_mesh(workspace, "poisson")


@pytest.mark.usefixtures("open3d", "in_this_process")
def test_maps_without_depth_give_no_mesh(workspace: Path) -> None:
    for path in workspace.rglob("*.geometric.bin"):
        width, height, _ = path.read_bytes().split(b"&")[:3]
        write_map(path, np.zeros((int(height), int(width)), np.float32))
    with pytest.raises(ReconstructionError, match=r"the tsdf mesh failed: .*no depth map has a pixel"):
        write_mesh(workspace, "tsdf")


def test_a_list_of_images_that_the_model_does_not_hold_is_refused(workspace: Path) -> None:
    (workspace / "stereo/fusion.cfg").write_text("stranger.jpg\n")
    with pytest.raises(InputError, match=r"fusion.cfg: names stranger.jpg, which the model does not hold"):
        list(mesh_module._views(workspace))
