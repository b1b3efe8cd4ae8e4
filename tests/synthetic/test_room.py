from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pycolmap
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from smust3r_colmap.errors import ConfigError, StorageError
from smust3r_colmap.evaluation.trajectory import compare_trajectories
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.camera import Intrinsics, pixel_centres, pointmap_from_depth
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.importers.model_poses import read_model_poses
from smust3r_colmap.importers.poses_txt import read_poses_txt
from smust3r_colmap.synthetic.room import _BOXES, DemoScene, demo_intrinsics, write_demo

SMALL = demo_intrinsics(160, 120)


@pytest.fixture(scope="module")
def scene() -> DemoScene:
    return DemoScene(0)


@pytest.fixture(scope="module")
def other_scene() -> DemoScene:
    return DemoScene(1)


def looking(direction: list[float], centre: list[float]) -> FloatArray:
    """``world_from_cam`` looking along a world axis; which way is up does not matter."""
    rotation, _ = Rotation.align_vectors([direction], [[0.0, 0.0, 1.0]])
    return np.column_stack([rotation.as_matrix(), centre])


def turns_deg(world_from_cams: FloatArray) -> FloatArray:
    """(N,) angle from each camera to the next, the last one's next being the first."""
    steps = np.swapaxes(world_from_cams[:, :, :3], 1, 2) @ np.roll(world_from_cams[:, :, :3], -1, axis=0)
    return np.asarray(np.rad2deg(Rotation.from_matrix(steps).magnitude()))


def seen_from(
    world_from_first: FloatArray, depth: npt.NDArray[np.float32], world_from_second: FloatArray, intrinsics: Intrinsics
) -> tuple[FloatArray, FloatArray, npt.NDArray[np.bool_]]:
    """Pixels of the first camera seen by the second: where, how deep, and whether inside its image."""
    points_world = pointmap_from_depth(depth, intrinsics, world_from_first).reshape(-1, 3)
    second_from_world = invert_rigid(world_from_second)
    points_second = points_world @ second_from_world[:, :3].T + second_from_world[:, 3]
    xy_img = intrinsics.xy_img(points_second)
    with np.errstate(invalid="ignore"):
        inside = np.logical_and(xy_img > 0.5, xy_img < [intrinsics.width - 0.5, intrinsics.height - 0.5])
    return xy_img, points_second[:, 2], np.asarray(inside[:, 0] & inside[:, 1])


# -------------------------------------------------------------------------- rendering
@pytest.mark.slow
@pytest.mark.parametrize(
    ("direction", "centre", "distance_m"),
    [
        ([0, 0, 1], [0.0, 0.9, 1.45], 1.55),  # the ceiling is 3 m high
        ([0, 0, -1], [0.0, 0.0, 1.45], 1.45),  # the floor
        ([0, 0, -1], [-0.5, 1.55, 1.0], 0.58),  # the seat of the sofa, 0.42 m high
        ([0, 1, 0], [0.9, 0.0, 2.5], 2.0),  # a bare submodel of wall
        ([0, -1, 0], [0.0, 0.0, 1.0], 1.6),  # the bookcase, 0.4 m deep
        ([1, 0, 0], [0.0, -0.1, 0.5], 2.6),  # the sideboard, 0.4 m deep
    ],
)
def test_depth_of_a_face_seen_squarely_is_its_distance(
    scene: DemoScene, direction: list[float], centre: list[float], distance_m: float
) -> None:
    narrow = Intrinsics(model="PINHOLE", width=64, height=48, params=(640.0, 640.0, 32.0, 24.0))
    _, depth = scene.render(looking(direction, centre), narrow)
    assert depth.shape == (48, 64) and depth.dtype == np.float32
    np.testing.assert_allclose(depth, distance_m, atol=2e-6)


def nearest_face_depth(world_from_cam: FloatArray, intrinsics: Intrinsics) -> FloatArray:
    """(H, W) z-depth by trying every face of every box with every ray."""
    centre = world_from_cam[:, 3]
    rays = intrinsics.rays_cam(pixel_centres(intrinsics.width, intrinsics.height)) @ world_from_cam[:, :3].T
    nearest = np.full(len(rays), np.inf)
    for box in _BOXES:
        for axis, plane in ((axis, box[side, axis]) for axis in range(3) for side in range(2)):
            depth = (plane - centre[axis]) / rays[:, axis]
            others = [k for k in range(3) if k != axis]
            points = (centre + depth[:, None] * rays)[:, others]
            on_face = ((points >= box[0, others]) & (points <= box[1, others])).all(axis=1)
            nearest = np.where(on_face & (depth > 0), np.minimum(nearest, depth), nearest)
    return nearest.reshape(intrinsics.height, intrinsics.width)


@pytest.mark.parametrize("k", range(0, 24, 3))
def test_depth_is_that_of_the_nearest_face(scene: DemoScene, k: int) -> None:
    pose = scene.camera_path(24)[k]
    expected = nearest_face_depth(pose, SMALL)
    _, depth = scene.render(pose, SMALL)
    off = np.abs(depth - expected) > 1e-5
    assert off.mean() < 1e-3  # a ray along an edge may fall on either side


def test_two_views_agree_in_depth_and_colour_where_both_see(scene: DemoScene) -> None:
    path = scene.camera_path(120)
    colour_differences = []
    for first, second in ((0, 4), (37, 41), (80, 76)):
        rgb_first, depth_first = scene.render(path[first], SMALL)
        rgb_second, depth_second = scene.render(path[second], SMALL)
        xy_img, z, inside = seen_from(path[first], depth_first, path[second], SMALL)
        rows, columns = (xy_img[inside, 1]).astype(int), (xy_img[inside, 0]).astype(int)
        # In front of what the second view sees there would be empty space for it: never, but at outlines.
        off = z[inside] / depth_second[rows, columns] - 1
        assert (off < -0.03).mean() < 0.03
        visible = np.abs(off) < 0.03
        assert 0.8 < visible.mean() <= 1
        map_x, map_y = (np.asarray(xy_img[inside][visible][:, k] - 0.5, dtype=np.float32) for k in (0, 1))
        warped = cv2.remap(rgb_second, map_x, map_y, cv2.INTER_LINEAR).reshape(-1, 3)
        seen = rgb_first.reshape(-1, 3)[inside][visible]
        colour_differences.append(np.median(np.abs(warped.astype(float) - seen)))
    assert max(colour_differences) < 8  # a quarter of what two arbitrary pixels differ by


@pytest.mark.parametrize("shrinking", [2, 8])
def test_outlines_and_textures_are_smooth_enough_to_shrink(scene: DemoScene, shrinking: int) -> None:
    """A small photograph is the large one shrunk: neither its outlines nor its textures are aliased."""
    pose = scene.camera_path(120)[15]
    large, _ = scene.render(pose, demo_intrinsics(320, 240))
    small, _ = scene.render(pose, demo_intrinsics(320 // shrinking, 240 // shrinking))
    shrunk = cv2.resize(large, None, fx=1 / shrinking, fy=1 / shrinking, interpolation=cv2.INTER_AREA)
    assert 0.1 < np.abs(small.astype(float) - shrunk).mean() < 3.5
    assert shrunk.astype(float).std() > 25


def test_every_view_has_features_all_over(scene: DemoScene) -> None:
    intrinsics = demo_intrinsics(320, 240)
    for pose in scene.camera_path(4):
        rgb, _ = scene.render(pose, intrinsics)
        keypoints = cv2.SIFT.create(contrastThreshold=0.02).detect(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY))
        cells = [(int(point.pt[0]) // 80, int(point.pt[1]) // 80) for point in keypoints]
        assert min(cells.count(cell) for cell in np.ndindex(4, 3)) >= 10
        assert sum(point.size > 12 for point in keypoints) >= 10  # seen from further away, too


@pytest.mark.slow
def test_equal_seeds_give_equal_pictures_and_others_do_not(scene: DemoScene, other_scene: DemoScene) -> None:
    pose = scene.camera_path(4)[1]
    rgb, depth = scene.render(pose, SMALL)
    same_rgb, same_depth = DemoScene(0).render(pose, SMALL)
    other_rgb, other_depth = other_scene.render(pose, SMALL)
    np.testing.assert_array_equal(rgb, same_rgb)
    np.testing.assert_array_equal(depth, same_depth)
    np.testing.assert_array_equal(depth, other_depth)
    assert np.abs(rgb.astype(float) - other_rgb).mean() > 20


# ------------------------------------------------------------------------ camera path
@pytest.mark.parametrize(("num_images", "most_deg", "least_overlap"), [(120, 3.5, 0.8), (24, 17.0, 0.5)])
def test_the_path_is_a_smooth_round_trip_with_overlap(
    scene: DemoScene, num_images: int, most_deg: float, least_overlap: float
) -> None:
    path = scene.camera_path(num_images)
    turns = turns_deg(path)
    assert 0.7 * 360 / num_images < turns.min() <= turns.max() < most_deg
    steps_m = np.linalg.norm(np.roll(path[:, :, 3], -1, axis=0) - path[:, :, 3], axis=1)
    assert 4.5 < steps_m.sum() < 7  # once round, back at the start
    assert 0.3 < steps_m.min() / steps_m.max() <= 1
    bends_m = np.linalg.norm(np.diff(path[:, :, 3], n=2, axis=0, append=path[:2, :, 3]), axis=1)
    assert bends_m.max() < 2.2 * (2 * np.pi / num_images) ** 2  # twice that of a circle; the seam is no corner
    for k in range(0, num_images, num_images // 8):
        _, depth = scene.render(path[k], SMALL)
        *_, inside = seen_from(path[k], depth, path[(k + 1) % num_images], SMALL)
        assert inside.mean() > least_overlap
        assert steps_m[k] / np.median(depth) > 0.3 / num_images * 4  # parallax


def test_the_path_keeps_clear_of_the_furniture(scene: DemoScene, other_scene: DemoScene) -> None:
    everywhere = Intrinsics(model="PINHOLE", width=16, height=16, params=(4.0, 4.0, 8.0, 8.0))  # 127 degrees
    for demo in (scene, other_scene):
        for pose in demo.camera_path(16):
            _, depth = demo.render(pose, everywhere)
            assert 0.35 < depth.min() <= depth.max() < 8


@pytest.mark.slow
def test_colmap_recovers_the_cameras(scene: DemoScene, tmp_path: Path) -> None:
    """Eight neighbouring views of a short demo, calibrated: all registered, within a centimetre."""
    intrinsics = demo_intrinsics(320, 240)
    path = scene.camera_path(24)[3:11]
    truth = {f"{k}.png": pose for k, pose in enumerate(path)}
    (tmp_path / "images").mkdir()
    for name, pose in truth.items():
        Image.fromarray(scene.render(pose, intrinsics)[0]).save(tmp_path / "images" / name)
    _map_with_colmap(tmp_path, intrinsics)
    result = compare_trajectories(read_model_poses(tmp_path / "sparse" / "0"), truth)
    assert result.num_compared == 8
    assert 1e-5 < result.position_rmse < 0.01
    assert 1e-4 < result.rotation_max_deg < 1


def _map_with_colmap(folder: Path, intrinsics: Intrinsics) -> None:
    extraction = pycolmap.FeatureExtractionOptions(num_threads=1)
    extraction.sift.max_num_features = 1000
    reader = pycolmap.ImageReaderOptions(
        camera_model=intrinsics.model, camera_params=",".join(str(value) for value in intrinsics.params)
    )
    pycolmap.extract_features(
        folder / "db.db",
        folder / "images",
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=reader,
        extraction_options=extraction,
    )
    pycolmap.match_exhaustive(folder / "db.db", matching_options=pycolmap.FeatureMatchingOptions(num_threads=1))
    options = pycolmap.IncrementalPipelineOptions(
        num_threads=1, random_seed=0, multiple_models=False, ba_refine_focal_length=False
    )
    (folder / "sparse").mkdir()
    pycolmap.incremental_mapping(folder / "db.db", folder / "images", folder / "sparse", options)


# ---------------------------------------------------------------------------- writing
@pytest.mark.slow
def test_write_demo_writes_what_the_readers_read(scene: DemoScene, tmp_path: Path) -> None:
    write_demo(tmp_path / "new" / "demo", num_images=3, width=160, height=120, seed=0)
    folder = tmp_path / "new" / "demo"
    names = ["000000.jpg", "000001.jpg", "000002.jpg"]
    assert sorted(path.name for path in (folder / "images").iterdir()) == names
    poses = read_poses_txt(folder / "poses.txt")
    assert list(poses) == names
    np.testing.assert_allclose(np.stack(list(poses.values())), scene.camera_path(3), atol=1e-11)
    comment, numbers = (folder / "intrinsics.txt").read_text().splitlines()
    assert comment.startswith("#")
    assert [float(word) for word in numbers.split()] == [160, 120, *demo_intrinsics(160, 120).params]
    rgb, _ = scene.render(scene.camera_path(3)[1], SMALL)
    with Image.open(folder / "images" / "000001.jpg") as photograph:
        assert photograph.size == (160, 120)
        assert np.abs(np.asarray(photograph).astype(float) - rgb).mean() < 12  # what JPEG changes in colours


def test_pixels_are_rays_through_their_centres(scene: DemoScene) -> None:
    """Points made from the intrinsics and the depth of an oblique view lie in the plane of the ceiling."""
    narrow = Intrinsics(model="PINHOLE", width=64, height=48, params=(640.0, 600.0, 30.0, 26.0))
    pose = looking([0.3, 0.3, 1.0], [0.3, 0.9, 1.45])
    _, depth = scene.render(pose, narrow)
    points = (narrow.rays_cam(pixel_centres(64, 48)) * depth.reshape(-1, 1)) @ pose[:, :3].T + pose[:, 3]
    assert np.ptp(depth) > 0.03
    np.testing.assert_allclose(points[:, 2], 3.0, atol=2e-6)


# --------------------------------------------------------------------------- refusals
def test_demos_without_images_or_pixels_are_refused(scene: DemoScene, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="a demo of 1 images: needs at least 2"):
        scene.camera_path(1)
    with pytest.raises(ConfigError, match="a demo of 0x48 pixels"):
        write_demo(tmp_path, width=0, height=48)


def test_a_folder_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("a file")
    with pytest.raises(StorageError, match="taken: cannot write the demo"):
        write_demo(tmp_path / "taken", num_images=2, width=16, height=12)


@pytest.mark.parametrize("centre", [[0.0, 0.0, 3.1], [-2.7, -1.5, 1.0]])
def test_cameras_in_walls_and_furniture_are_refused(scene: DemoScene, centre: list[float]) -> None:
    with pytest.raises(ValueError, match="not in the free space of the room"):
        scene.render(looking([1, 0, 0], centre), SMALL)


def test_other_cameras_and_shapes_are_refused(scene: DemoScene) -> None:
    radial = Intrinsics(model="SIMPLE_RADIAL", width=8, height=6, params=(8.0, 4.0, 3.0, 0.1))
    with pytest.raises(ValueError, match="camera model SIMPLE_RADIAL, needed PINHOLE"):
        scene.render(scene.camera_path(2)[0], radial)
    with pytest.raises(ValueError, match=r"pose is \(4, 4\), needed \(3, 4\)"):
        scene.render(np.eye(4), SMALL)
