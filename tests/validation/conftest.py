"""A scene without fault, and a small model in both forms."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from helpers.described_models import (
    HEIGHT,
    NUM_IMAGES,
    NUM_POINTS,
    WIDTH,
    transforms_of,
    write_image,
    write_map,
    write_ply,
)

from smust3r_colmap.validation.description import Subject
from smust3r_colmap.validation.layout import find_layout
from smust3r_colmap.validation.validate import describe


@pytest.fixture(scope="session")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """SCENE with everything that can lie in it, and all of it right."""
    folder = tmp_path_factory.mktemp("scene")
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=NUM_IMAGES)
    options.num_points3D = NUM_POINTS
    options.camera_width, options.camera_height = WIDTH, HEIGHT
    options.camera_model_id = pycolmap.CameraModelId.PINHOLE
    options.camera_params = [300.0, 300.0, WIDTH / 2, HEIGHT / 2]
    with pycolmap.Database.open(folder / "database.db") as database:
        model = pycolmap.synthesize_dataset(options, database)
    for point in model.points3D.values():
        point.color = np.array([10, 20, 30], np.uint8)
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True)
    model.write_binary(sparse)
    names = [image.name for image in model.images.values()]
    for name in names:
        write_image(folder / "images" / name, WIDTH, HEIGHT)
        write_image(folder / "images_2" / name, WIDTH // 2, HEIGHT // 2)
        write_image(folder / "masks" / f"{name}.png", WIDTH, HEIGHT)
        write_image(folder / "masks" / f"{Path(name).stem}.png", WIDTH, HEIGHT)
        write_image(folder / "depths" / f"{Path(name).stem}.png", 8, 6)
        write_map(folder / "stereo" / "depth_maps" / f"{name}.geometric.bin", WIDTH, HEIGHT, 1)
        write_map(folder / "stereo" / "normal_maps" / f"{name}.geometric.bin", WIDTH, HEIGHT, 3)
    (folder / "stereo" / "fusion.cfg").write_text("\n".join(names) + "\n")
    params = {Path(name).stem: {"scale": 1.0 + number / 10, "offset": 0} for number, name in enumerate(names)}
    (sparse / "depth_params.json").write_text(json.dumps(params))
    write_ply(sparse / "points3D.ply", np.array([point.xyz for point in model.points3D.values()]))
    shutil.copy(sparse / "points3D.ply", folder / "sparse_pc.ply")
    (folder / "transforms.json").write_text(json.dumps(transforms_of(model)))
    return folder


@pytest.fixture(scope="session")
def good(scene: Path) -> Subject:
    return describe(find_layout(scene, images=None, database=None), ask_colmap=False)


@pytest.fixture(scope="session")
def bare(good: Subject) -> Subject:
    """The model alone, so that renaming an image does not lose its file."""
    return Subject(model=good.model, projection=good.projection)


@pytest.fixture
def model(tmp_path: Path) -> pycolmap.Reconstruction:
    """A small model, written as text and as binary into the folders txt and bin."""
    pycolmap.set_random_seed(1)
    options = pycolmap.SyntheticDatasetOptions(num_rigs=2, num_cameras_per_rig=2, num_frames_per_rig=2, num_points3D=9)
    reconstruction = pycolmap.synthesize_dataset(options)
    for form in ("txt", "bin"):
        (tmp_path / form).mkdir()
    reconstruction.write_text(tmp_path / "txt")
    reconstruction.write_binary(tmp_path / "bin")
    return reconstruction
