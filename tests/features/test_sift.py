"""SIFT of images that an interrupted run left behind."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from helpers.scenes import CAMERA
from PIL import Image

from smust3r_colmap.colmap.database import create_database
from smust3r_colmap.execution.progress import QuietReporter
from smust3r_colmap.execution.task_pool import TaskPool
from smust3r_colmap.features.sift import extract_features
from smust3r_colmap.products import ImageCollection, SourceImage


@pytest.mark.slow
def test_an_image_interrupted_between_its_two_writes_is_finished_later(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (30, 40), np.uint8)
    Image.fromarray(noise).resize((640, 480)).save(tmp_path / "0.png")
    image = SourceImage(name="0.png", path=tmp_path / "0.png", width=640, height=480, camera=0, digest="0")
    collection = ImageCollection(images=(image,), cameras=(CAMERA,))
    create_database(tmp_path / "d.db", collection)
    for _ in range(2):
        with TaskPool(workers=1) as pool, QuietReporter(sys.stderr).stage("features", total=1) as stage:
            rejected = extract_features(
                tmp_path / "d.db", collection, max_image_size=640, max_features=100, executor=pool, stage=stage
            )
        assert rejected == ()
        with pycolmap.Database.open(tmp_path / "d.db") as database:
            assert database.num_keypoints_for_image(1) == database.num_descriptors_for_image(1) > 0
            database.clear_keypoints()
            assert not database.exists_keypoints(1)
