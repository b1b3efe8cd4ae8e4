"""What each exporter writes, read back by readers that are not ours or not the writer's."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pycolmap
import pytest
import trimesh
from helpers.independent_colmap_reader import ReadModel, read_binary, read_text
from scipy.spatial.transform import Rotation

from smust3r_colmap.colmap.model_files import MODEL_FILES
from smust3r_colmap.errors import InputError, RunDirectoryError, StorageError
from smust3r_colmap.exporters.colmap_sparse import write_colmap_sparse
from smust3r_colmap.exporters.glb import frustum_depth, write_glb
from smust3r_colmap.exporters.ply import write_ply
from smust3r_colmap.exporters.tum_trajectory import times_of, write_tum
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.geometry.world_frame import WorldFrame
from smust3r_colmap.products import PointCloud, Scene

NAMES = ("a.jpg", "left/b.jpg", "left/ü.jpg", "right/c.png")


def cloud(count: int, *, normals: bool = True, offset: float = 0.0) -> PointCloud:
    rng = np.random.default_rng(7)
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return PointCloud(
        xyz=rng.uniform(-3, 3, (count, 3)) + offset,
        rgb=rng.integers(0, 256, (count, 3), dtype=np.uint8),
        normals=directions.astype(np.float32) if normals else None,
    )


def scene(names: tuple[str, ...] = NAMES, *, num_points: int = 50) -> Scene:
    """Images 0, 2, 4, ... of a collection, two cameras, random poses."""
    rng = np.random.default_rng(3)
    poses = np.concatenate(
        [Rotation.random(len(names), rng=rng).as_matrix(), rng.normal(size=(len(names), 3, 1))], axis=2
    )
    return Scene(
        image_indices=tuple(2 * i for i in range(len(names))),
        image_names=names,
        camera_indices=tuple(0 if i < 2 else 3 for i in range(len(names))),
        cameras={
            0: Intrinsics(model="SIMPLE_RADIAL", width=640, height=480, params=(500, 320, 240, -0.05)),
            3: Intrinsics(model="OPENCV", width=800, height=600, params=(700, 710, 400, 300, 0.01, -0.02, 1e-4, 2e-4)),
        },
        cam_from_world=poses,
        points=cloud(num_points),
        frame=WorldFrame(metric=False),
        segments=("0", "1"),
    )


# ------------------------------------------------------------------------------ COLMAP
def assert_holds_scene(model: ReadModel, expected: Scene) -> None:
    assert model.cameras.keys() == {camera + 1 for camera in expected.camera_indices}
    for camera, intrinsics in expected.cameras.items():
        read = model.cameras[camera + 1]
        assert (read.model, read.width, read.height) == (intrinsics.model, intrinsics.width, intrinsics.height)
        np.testing.assert_allclose(read.params, intrinsics.params, rtol=1e-15)
    assert list(model.images) == [index + 1 for index in expected.image_indices]
    for row, image in enumerate(model.images.values()):
        assert image.name == expected.image_names[row]
        assert image.camera_id == expected.camera_indices[row] + 1
        assert image.points2d == ()
        rotation = Rotation.from_quat(np.roll(image.quat_wxyz, -1)).as_matrix()
        np.testing.assert_allclose(rotation, expected.cam_from_world[row, :, :3], atol=1e-14)
        np.testing.assert_allclose(image.translation, expected.cam_from_world[row, :, 3], rtol=1e-15)
    points = [model.points[i] for i in sorted(model.points)]
    np.testing.assert_allclose([point.xyz for point in points], expected.points.xyz, rtol=1e-15)
    np.testing.assert_array_equal([point.rgb for point in points], expected.points.rgb)
    assert {point.track for point in points} == {()}, "a track of one observation stops bundle adjustment"


def assert_rigs_and_frames_are_trivial(model: ReadModel) -> None:
    assert model.rigs == {camera_id: ((0, camera_id),) for camera_id in model.cameras}
    assert model.frames.keys() == model.images.keys()
    for image_id, frame in model.frames.items():
        image = model.images[image_id]
        assert frame.rig_id == image.camera_id
        assert frame.data_ids == ((0, image.camera_id, image_id),)
        assert (frame.quat_wxyz, frame.translation) == (image.quat_wxyz, image.translation)


def test_binary_model_holds_the_scene_for_an_independent_reader(tmp_path: Path) -> None:
    write_colmap_sparse(scene(), tmp_path / "sparse" / "0")
    model = read_binary(tmp_path / "sparse" / "0")
    assert_holds_scene(model, scene())
    assert_rigs_and_frames_are_trivial(model)
    assert {path.name for path in (tmp_path / "sparse").iterdir()} == {"0"}
    assert {path.name for path in (tmp_path / "sparse" / "0").iterdir()} == {n for n in MODEL_FILES if "bin" in n}


def test_text_model_stands_beside_the_binary_one_and_says_the_same(tmp_path: Path) -> None:
    write_colmap_sparse(scene(), tmp_path / "0", text=True)
    assert {path.name for path in (tmp_path / "0").iterdir()} == MODEL_FILES
    model = read_text(tmp_path / "0")
    assert_holds_scene(model, scene())
    assert_rigs_and_frames_are_trivial(model)
    assert model == read_binary(tmp_path / "0")


def test_model_of_images_without_points_is_readable(tmp_path: Path) -> None:
    write_colmap_sparse(scene(num_points=0), tmp_path / "0", text=True)
    assert read_binary(tmp_path / "0").points == read_text(tmp_path / "0").points == {}
    assert pycolmap.Reconstruction(tmp_path / "0").num_reg_images() == len(NAMES)


def test_names_with_blanks_survive_in_binary(tmp_path: Path) -> None:
    names = ("my holiday/photo 1.jpg", "b.jpg")
    write_colmap_sparse(scene(names), tmp_path / "0")
    assert [image.name for image in read_binary(tmp_path / "0").images.values()] == list(names)


@pytest.mark.parametrize("name", ["photo 1.jpg", "a\tb.jpg", "a\nb.jpg", "a\u00a0b.jpg", ""])
def test_text_is_refused_for_names_it_cannot_hold_and_nothing_is_written(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match=r"cannot hold a name with blanks; rename the image or leave --text out"):
        write_colmap_sparse(scene(("a.jpg", name)), tmp_path / "0", text=True)
    assert list(tmp_path.iterdir()) == []


def test_older_model_is_replaced_as_a_whole(tmp_path: Path) -> None:
    write_colmap_sparse(scene(), tmp_path / "0", text=True)
    write_colmap_sparse(scene(NAMES[:2], num_points=3), tmp_path / "0")
    assert len(read_binary(tmp_path / "0").images) == 2
    assert not (tmp_path / "0" / "images.txt").exists()
    assert {path.name for path in tmp_path.iterdir()} == {"0"}


def test_folder_with_other_files_is_not_touched(tmp_path: Path) -> None:
    folder = tmp_path / "0"
    folder.mkdir()
    (folder / "thesis.tex").write_text("years of work")
    with pytest.raises(RunDirectoryError, match=r"holds 'thesis.tex', which is not ours to replace"):
        write_colmap_sparse(scene(), folder)
    assert [path.name for path in folder.iterdir()] == ["thesis.tex"]


def test_file_in_the_place_of_the_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "0").write_text("a file")
    with pytest.raises(RunDirectoryError, match=r"0 is a file, a folder is needed"):
        write_colmap_sparse(scene(), tmp_path / "0")


@contextmanager
def files_limited_to(num_bytes: int) -> Iterator[None]:
    """As on a full disk: writing beyond fails."""
    resource = pytest.importorskip("resource")  # not on Windows
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (num_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("text", [False, True])
def test_full_disk_is_noticed_and_the_older_model_stays(tmp_path: Path, text: bool) -> None:
    write_colmap_sparse(scene(), tmp_path / "0")
    # As text a point takes more bytes than in binary, so this limit cuts the text file only.
    limit = 51 * 400 + 100 if text else 9_000
    with files_limited_to(limit), pytest.raises(StorageError, match=r"points3D.* arrived; is the disk full\?"):
        write_colmap_sparse(scene(num_points=400), tmp_path / "0", text=text)
    assert_holds_scene(read_binary(tmp_path / "0"), scene())
    assert {path.name for path in tmp_path.iterdir()} == {"0"}


def test_error_while_writing_leaves_the_older_model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_colmap_sparse(scene(), tmp_path / "0")

    def interrupted(model: pycolmap.Reconstruction, folder: Path) -> None:
        (folder / "cameras.bin").write_bytes(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr(pycolmap.Reconstruction, "write_binary", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_colmap_sparse(scene(NAMES[:1]), tmp_path / "0")
    assert_holds_scene(read_binary(tmp_path / "0"), scene())
    assert {path.name for path in tmp_path.iterdir()} == {"0"}


def test_bundle_adjustment_and_pycolmap_accept_the_model(tmp_path: Path) -> None:
    write_colmap_sparse(scene(), tmp_path / "0")
    model = pycolmap.Reconstruction(tmp_path / "0")
    assert (model.num_reg_images(), model.num_points3D(), model.num_frames(), model.num_rigs()) == (4, 50, 4, 2)
    pycolmap.bundle_adjustment(model)
    np.testing.assert_allclose(model.images[3].cam_from_world().matrix(), scene().cam_from_world[1], atol=1e-12)


# --------------------------------------------------------------------------------- PLY
def trimesh_cloud(path: Path) -> trimesh.PointCloud:
    read = trimesh.load(path)
    assert isinstance(read, trimesh.PointCloud)
    return read


def test_ply_keeps_positions_and_colours_for_trimesh(tmp_path: Path) -> None:
    points = cloud(200)
    write_ply(points, tmp_path / "cloud.ply")
    read = trimesh_cloud(tmp_path / "cloud.ply")
    np.testing.assert_allclose(read.vertices, points.xyz, atol=3 * 2**-24)
    np.testing.assert_array_equal(read.colors[:, :3], points.rgb)
    assert np.abs(read.vertices - points.xyz).max() > 0, "coordinates near the origin are single precision"


def test_ply_keeps_positions_and_colours_for_colmap(tmp_path: Path) -> None:
    points = cloud(40)
    write_ply(points, tmp_path / "cloud.ply")
    model = pycolmap.Reconstruction()
    model.import_PLY(tmp_path / "cloud.ply")
    read = [model.points3D[i] for i in sorted(model.points3D)]
    np.testing.assert_allclose([point.xyz for point in read], points.xyz, atol=3 * 2**-24)
    np.testing.assert_array_equal([point.color for point in read], points.rgb)


def read_ply_vertices(path: Path) -> npt.NDArray[Any]:
    """By the header alone, for what trimesh and COLMAP do not hand out."""
    header, _, body = path.read_bytes().partition(b"end_header\n")
    lines = header.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    kinds = {"float": "<f4", "double": "<f8", "uchar": "u1"}
    fields = [(line.split()[2], kinds[line.split()[1]]) for line in lines if line.startswith("property")]
    rows = np.frombuffer(body, dtype=fields)
    assert lines[2] == f"element vertex {len(rows)}"
    return rows


def test_ply_keeps_normals_where_known(tmp_path: Path) -> None:
    write_ply(cloud(30), tmp_path / "with.ply")
    rows = read_ply_vertices(tmp_path / "with.ply")
    np.testing.assert_array_equal(np.column_stack([rows["nx"], rows["ny"], rows["nz"]]), cloud(30).normals)
    write_ply(cloud(30, normals=False), tmp_path / "without.ply")
    names = read_ply_vertices(tmp_path / "without.ply").dtype.names
    assert names == ("x", "y", "z", "red", "green", "blue")


def test_ply_far_from_the_origin_is_double_and_loses_nothing(tmp_path: Path) -> None:
    points = cloud(30, offset=5e6)
    write_ply(points, tmp_path / "utm.ply")
    np.testing.assert_array_equal(trimesh_cloud(tmp_path / "utm.ply").vertices, points.xyz)
    assert read_ply_vertices(tmp_path / "utm.ply").dtype["x"] == np.float64


def test_ply_without_points_is_well_formed(tmp_path: Path) -> None:
    write_ply(cloud(0), tmp_path / "empty.ply")
    assert len(read_ply_vertices(tmp_path / "empty.ply")) == 0


def test_ply_on_a_full_disk_leaves_the_older_file(tmp_path: Path) -> None:
    write_ply(cloud(10), tmp_path / "cloud.ply")
    with files_limited_to(9_000), pytest.raises(StorageError, match=r"cloud\.ply: cannot be written"):
        write_ply(cloud(5000), tmp_path / "cloud.ply")
    assert len(read_ply_vertices(tmp_path / "cloud.ply")) == 10
    assert {path.name for path in tmp_path.iterdir()} == {"cloud.ply"}


# --------------------------------------------------------------------------------- GLB
def glb_document(path: Path) -> dict[str, Any]:
    """The JSON chunk, by the container's specification."""
    data = path.read_bytes()
    magic, version, length, json_length, kind = struct.unpack("<4sII I4s", data[:20])
    assert (magic, version, length, kind) == (b"glTF", 2, len(data), b"JSON")
    document: dict[str, Any] = json.loads(data[20 : 20 + json_length])
    return document


def test_glb_holds_all_points_and_cameras(tmp_path: Path) -> None:
    write_glb(scene(), tmp_path / "scene.glb")
    document = glb_document(tmp_path / "scene.glb")
    counts = {
        mesh["name"]: document["accessors"][mesh["primitives"][0]["attributes"]["POSITION"]]["count"]
        for mesh in document["meshes"]
    }
    assert counts == {"points": 50, "cameras": 4 * 8 * 6}
    read = trimesh.load_scene(tmp_path / "scene.glb")
    assert len(read.geometry["points"].vertices) == 50
    assert len(read.geometry["cameras"].faces) == 4 * 8 * 6
    np.testing.assert_array_equal(read.geometry["points"].colors[:, :3], scene().points.rgb)


def test_glb_axes_are_y_up_and_z_backward(tmp_path: Path) -> None:
    write_glb(scene(), tmp_path / "scene.glb")
    read = trimesh.load_scene(tmp_path / "scene.glb")
    gltf_from_geometry, name = read.graph[read.graph.geometry_nodes["points"][0]]
    vertices = trimesh.transform_points(read.geometry[name].vertices, gltf_from_geometry)
    np.testing.assert_allclose(vertices, scene().points.xyz * [1, -1, -1], atol=1e-6)


def test_glb_frusta_stand_at_the_cameras_and_look_along_them(tmp_path: Path) -> None:
    write_glb(scene(), tmp_path / "scene.glb")
    read = trimesh.load_scene(tmp_path / "scene.glb")
    gltf_from_geometry, name = read.graph[read.graph.geometry_nodes["cameras"][0]]
    vertices = trimesh.transform_points(read.geometry[name].vertices, gltf_from_geometry) * [1, -1, -1]
    world_from_cam = invert_rigid(scene().cam_from_world)
    depth = frustum_depth(world_from_cam[:, :, 3])
    for pose, frustum in zip(world_from_cam, vertices.reshape(4, 48, 3), strict=True):
        cam_from_world = invert_rigid(pose)
        wires_cam = frustum @ cam_from_world[:, :3].T + cam_from_world[:, 3]
        assert -0.03 * depth < wires_cam[:, 2].min() < 0.03 * depth
        assert depth < wires_cam[:, 2].max() < 1.03 * depth
        assert abs(wires_cam[:, :2].mean()) < 0.03 * depth


def test_glb_far_from_the_origin_keeps_its_detail(tmp_path: Path) -> None:
    far = scene()
    world_from_cam = invert_rigid(far.cam_from_world)
    world_from_cam[:, :, 3] += 5e6
    far = replace(far, cam_from_world=invert_rigid(world_from_cam), points=cloud(50, offset=5e6))
    write_glb(far, tmp_path / "far.glb")
    read = trimesh.load_scene(tmp_path / "far.glb")
    gltf_from_geometry, name = read.graph[read.graph.geometry_nodes["points"][0]]
    vertices = trimesh.transform_points(read.geometry[name].vertices, gltf_from_geometry)
    np.testing.assert_allclose(vertices, far.points.xyz * [1, -1, -1], atol=1e-5)


def test_glb_thins_to_max_points_evenly(tmp_path: Path) -> None:
    write_glb(scene(num_points=1000), tmp_path / "scene.glb", max_points=99)
    rgb = trimesh.load_scene(tmp_path / "scene.glb").geometry["points"].colors[:, :3]
    np.testing.assert_array_equal(rgb, scene(num_points=1000).points.rgb[np.arange(99) * 1000 // 99])


def test_glb_without_points_shows_the_cameras(tmp_path: Path) -> None:
    write_glb(scene(num_points=0), tmp_path / "scene.glb")
    assert set(trimesh.load_scene(tmp_path / "scene.glb").geometry) == {"cameras"}


def test_glb_refuses_zero_points_at_most(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"max_points is 0, needed at least 1"):
        write_glb(scene(), tmp_path / "scene.glb", max_points=0)


@pytest.mark.parametrize(
    ("centres", "expected"),
    [
        ([(0, 0, 0), (1, 0, 0), (2, 0, 0), (30, 0, 0)], 0.6),  # one jump does not count
        ([(0.001 * i, 0, 0) for i in range(1000)], 0.00999),  # video: by the extent
        ([(1, 2, 3)] * 5, 1.0),  # turning on the spot
        ([(1, 2, 3)], 1.0),
    ],
)
def test_frusta_are_sized_by_the_step_between_cameras(centres: list[tuple[float, ...]], expected: float) -> None:
    assert frustum_depth(np.array(centres, dtype=np.float64)) == pytest.approx(expected)


# --------------------------------------------------------------------------------- TUM
def test_tum_rows_are_cameras_in_the_world(tmp_path: Path) -> None:
    times = [1305031102.175304, 1305031102.211214, 1305031102.243211, 1305031102.275326]
    write_tum(scene(), tmp_path / "trajectory.txt", times)
    rows = np.loadtxt(tmp_path / "trajectory.txt")
    np.testing.assert_allclose(rows[:, 0], times, atol=1e-6)
    world_from_cam = invert_rigid(scene().cam_from_world)
    np.testing.assert_allclose(rows[:, 1:4], world_from_cam[:, :, 3], rtol=1e-10)
    np.testing.assert_allclose(Rotation.from_quat(rows[:, 4:]).as_matrix(), world_from_cam[:, :, :3], atol=1e-10)


def test_tum_without_timestamps_numbers_by_the_collection(tmp_path: Path) -> None:
    write_tum(scene(), tmp_path / "trajectory.txt", None)
    assert np.loadtxt(tmp_path / "trajectory.txt")[:, 0].tolist() == [0, 2, 4, 6]


def test_tum_rows_ascend_in_time(tmp_path: Path) -> None:
    write_tum(scene(), tmp_path / "trajectory.txt", [3.0, 1.0, 2.0, 1.0])
    rows = np.loadtxt(tmp_path / "trajectory.txt")
    centres = invert_rigid(scene().cam_from_world)[:, :, 3]
    assert rows[:, 0].tolist() == [1, 1, 2, 3]
    np.testing.assert_allclose(rows[:, 1:4], centres[[1, 3, 2, 0]], rtol=1e-10)


def test_tum_quaternions_keep_their_sign_through_a_full_turn(tmp_path: Path) -> None:
    turn = Rotation.from_rotvec(np.linspace(0, 4 * np.pi, 60)[:, None] * [0.0, 1.0, 0.0]).as_matrix()
    poses = np.concatenate([np.swapaxes(turn, 1, 2), np.zeros((60, 3, 1))], axis=2)
    turning = replace(
        scene(),
        image_indices=tuple(range(60)),
        image_names=tuple(f"{i}.jpg" for i in range(60)),
        camera_indices=(0,) * 60,
        cam_from_world=poses,
    )
    write_tum(turning, tmp_path / "trajectory.txt", None)
    quat_xyzw = np.loadtxt(tmp_path / "trajectory.txt")[:, 4:]
    assert (np.einsum("ij,ij->i", quat_xyzw[1:], quat_xyzw[:-1]) > 0.99).all()
    assert quat_xyzw[0, 3] > 0
    assert quat_xyzw[:, 3].min() < -0.9, "two turns reach the other half sphere"


@pytest.mark.parametrize(
    ("times", "message"),
    [([1.0, 2.0], r"2 timestamps for 4 images"), ([0.0, 1.0, np.nan, 3.0], r"timestamp of left/ü\.jpg is not finite")],
)
def test_tum_refuses_timestamps_that_do_not_fit(tmp_path: Path, times: list[float], message: str) -> None:
    with pytest.raises(InputError, match=message):
        write_tum(scene(), tmp_path / "trajectory.txt", times)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("times", "expected"),
    [
        ([0.0, 0.5, 0.75, 9.0], (0.0, 0.5, 0.75, 9.0)),
        ([0.0, 0.5, 0.0, 0.5], None),  # two videos
        ([0.0, 0.5, 0.75], None),  # an image that is no frame
        ([], None),
    ],
)
def test_times_are_used_where_they_make_one_sequence(times: list[float], expected: tuple[float, ...] | None) -> None:
    named = dict(zip(scene().image_names, times, strict=False))
    assert times_of(scene(), {**named, "of another model.jpg": 3.0}) == expected
