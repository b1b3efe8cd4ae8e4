"""A model whose focal length the image pairs contradict is named; where they cannot tell, nothing is said."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from helpers.pairs_of_one_camera import (
    GUESS,
    NUM_IMAGES,
    TRUTH,
    pairs_on_an_arc,
    pairs_straight_ahead,
)

from smust3r_colmap.features.view_graph_calibration import VerifiedPairs
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.products import ImageCollection, SourceImage
from smust3r_colmap.refinement.focal_lengths import MIN_IMAGES, contradicted_focal_lengths


@pytest.fixture(scope="module")
def on_an_arc(tmp_path_factory: pytest.TempPathFactory) -> VerifiedPairs:
    return pairs_on_an_arc(tmp_path_factory.mktemp("arc"))


def model_with(camera: Intrinsics, num_images: int = NUM_IMAGES) -> pycolmap.Reconstruction:
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera.colmap_camera(1))
    for k in range(num_images):
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([float(k), 0, 0]))
        image = pycolmap.Image(name=f"{k}.png", camera_id=1, image_id=k + 1)
        model.add_image_with_trivial_frame(image, pose)
    return model


def collection_with(camera: Intrinsics) -> ImageCollection:
    images = tuple(
        SourceImage(name=f"{k}.png", path=Path(f"{k}.png"), width=640, height=480, camera=0, digest=str(k))
        for k in range(NUM_IMAGES)
    )
    return ImageCollection(images=images, cameras=(camera,))


def test_a_focal_length_that_is_twice_too_long_is_named(on_an_arc: VerifiedPairs) -> None:
    (text,) = contradicted_focal_lengths(model_with(TRUTH.zoomed(2.2)), on_an_arc.database, collection_with(GUESS))
    assert "camera 1 has a focal length of 1056 px, but its image pairs agree on 4" in text


def test_a_focal_length_that_the_pairs_agree_with_is_not(on_an_arc: VerifiedPairs) -> None:
    for factor in (0.85, 1.0, 1.2):
        model = model_with(TRUTH.zoomed(factor))
        assert contradicted_focal_lengths(model, on_an_arc.database, collection_with(GUESS)) == ()


def test_what_another_program_said_does_not_count(tmp_path: Path) -> None:
    """Its camera is the guess of nothing, and pairs verified with it have no fundamental matrix."""
    wrong = replace(TRUTH.zoomed(2.2), has_prior_focal=True)
    pairs = pairs_on_an_arc(tmp_path, camera=wrong)
    (text,) = contradicted_focal_lengths(model_with(wrong), pairs.database, collection_with(wrong))
    assert "camera 1 has a focal length of 1056 px, but its image pairs agree on 4" in text
    right = replace(TRUTH, has_prior_focal=True)
    assert contradicted_focal_lengths(model_with(right), pairs.database, collection_with(right)) == ()


def test_neither_few_images_nor_a_fisheye_are_asked_about(on_an_arc: VerifiedPairs) -> None:
    wrong = TRUTH.zoomed(2.2)
    few = model_with(wrong, MIN_IMAGES - 1)
    assert contradicted_focal_lengths(few, on_an_arc.database, collection_with(GUESS)) == ()
    fisheye = Intrinsics(model="SIMPLE_RADIAL_FISHEYE", width=640, height=480, params=wrong.params)
    assert contradicted_focal_lengths(model_with(fisheye), on_an_arc.database, collection_with(fisheye)) == ()


def test_pairs_that_cannot_tell_contradict_nothing(tmp_path: Path) -> None:
    straight = pairs_straight_ahead(tmp_path)
    assert contradicted_focal_lengths(model_with(TRUTH.zoomed(3)), straight.database, collection_with(GUESS)) == ()
