"""Depth maps on disk, how fusion hands them out, and what becomes of the cloud when they are rescaled."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from helpers.sphere_world import CAMERA, MAP_SIZES, NUM_IMAGES, make_world, sphere_depth

from smust3r_colmap.dense.point_cloud import fuse_points
from smust3r_colmap.errors import StorageError
from smust3r_colmap.stitching.camera_fusion import depth_in_cameras
from smust3r_colmap.storage.depth_maps import DepthMapWriter, StoredDepthMaps

NAMES = ("a/b c.jpg", "Größe 画像.png", "../odd.jpg")


def a_map(seed: int, height: int = 6, width: int = 8) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    rng = np.random.default_rng(seed)
    depth = rng.uniform(1, 5, (height, width)).astype(np.float32)
    depth[0, :3] = 0
    return depth, rng.uniform(1, 20, (height, width)).astype(np.float32)


@pytest.fixture
def stored(tmp_path: Path) -> Path:
    writer = DepthMapWriter(tmp_path)
    for seed, name in enumerate(NAMES):
        writer.write(name, *a_map(seed, height=6 + seed))
    writer.finish()
    return tmp_path


def test_maps_of_any_name_and_size_come_back(stored: Path) -> None:
    maps = StoredDepthMaps(stored)
    for seed, name in enumerate(NAMES):
        depth, confidence = a_map(seed, height=6 + seed)
        assert name in maps
        np.testing.assert_array_equal(maps.depth(name), depth)
        np.testing.assert_allclose(maps.confidence(name), confidence, rtol=1e-3)
        assert maps.depth(name).dtype == maps.confidence(name).dtype == np.float32
        assert maps.confidence(name).min() >= 1, "half precision must not fall below no confidence at all"
    assert "b c.jpg" not in maps
    assert {path.parent for path in stored.iterdir()} == {stored}, "names are no paths"


def test_the_first_map_of_a_name_counts(tmp_path: Path) -> None:
    writer = DepthMapWriter(tmp_path)
    writer.write("one", *a_map(1))
    writer.write("one", *a_map(2))
    writer.write("two", *a_map(3))
    writer.finish()
    maps = StoredDepthMaps(tmp_path)
    np.testing.assert_array_equal(maps.depth("one"), a_map(1)[0])
    np.testing.assert_array_equal(maps.depth("two"), a_map(3)[0])


def test_image_without_a_map_is_said_to_have_none(stored: Path) -> None:
    with pytest.raises(KeyError, match=r"missing\.png"):
        StoredDepthMaps(stored).depth("missing.png")
    with pytest.raises(KeyError, match=r"missing\.png"):
        StoredDepthMaps(stored).confidence("missing.png")


def test_folder_that_was_not_finished_is_refused(tmp_path: Path) -> None:
    DepthMapWriter(tmp_path).write("one", *a_map(1))
    with pytest.raises(StorageError, match=r"depth_names\.json"):
        StoredDepthMaps(tmp_path)


def test_confidence_beyond_half_precision_stays_finite(tmp_path: Path) -> None:
    """Networks give confidences of 1e5 and more, which float16 calls infinite."""
    writer = DepthMapWriter(tmp_path)
    writer.write("one", np.ones((2, 2), np.float32), np.array([[1, 1e3], [6.5e4, 1e6]], np.float32))
    writer.finish()
    confidence = StoredDepthMaps(tmp_path).confidence("one")
    assert np.isfinite(confidence).all()
    np.testing.assert_allclose(confidence, [[1, 1e3], [6.5e4, 65504]], rtol=1e-3)


# --------------------------------------------------------------------------- from fusion
def test_depth_of_every_image_comes_once_in_world_units() -> None:
    world = make_world()
    seen = []
    for image, depth, confidence in depth_in_cameras(world.placed(), world.dense, world.cameras()):
        seen.append(image)
        expected = sphere_depth(CAMERA.resized(*MAP_SIZES[image % 2]), world.world_from_cam[image])
        np.testing.assert_allclose(depth, expected, atol=1e-4, err_msg=f"image {image}")
        assert (depth[expected == 0] == 0).all()
        assert depth.dtype == np.float32
        assert confidence.shape == depth.shape
    assert seen == list(range(NUM_IMAGES))


def test_depth_scale_of_one_changes_nothing() -> None:
    world = make_world()
    clouds = [
        fuse_points(
            world.placed(), world.dense, world.cameras(), max_points=5_000, min_confidence=2.0, depth_scale=scale
        ).cloud.xyz
        for scale in (None, np.ones(NUM_IMAGES))
    ]
    np.testing.assert_array_equal(clouds[0], clouds[1])


def test_depth_scale_is_of_the_images_in_order() -> None:
    world = make_world()
    scale = np.ones(NUM_IMAGES)
    scale[3] = 10.0
    fused = fuse_points(
        world.placed(), world.dense, world.cameras(), max_points=50_000, min_confidence=2.0, depth_scale=scale
    )
    far = fused.cloud.xyz[np.linalg.norm(fused.cloud.xyz, axis=1) > 5]
    assert len(far) > 100
    pose = world.cameras().cam_from_world[3]
    ahead = far @ pose[:, :3].T + pose[:, 3]
    assert (ahead[:, 2] > 15).all(), "all that lies far off is in front of image 3"
    assert (np.abs(ahead[:, :2] / ahead[:, 2:]) < 0.55).all()
