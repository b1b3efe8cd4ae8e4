"""Statistics of a model, on a synthetic one whose numbers are known."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest

from smust3r_colmap.refinement.statistics import MIN_OBSERVATIONS, SceneRefinement, Statistics, weak_images

NUM_IMAGES = 8


@pytest.fixture
def model() -> pycolmap.Reconstruction:
    """Eight images that see 60 points, with half a pixel of noise."""
    pycolmap.set_random_seed(3)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1,
        num_cameras_per_rig=1,
        num_frames_per_rig=NUM_IMAGES,
        num_points3D=60,
        num_points2D_without_point3D=5,
    )
    made = pycolmap.synthesize_dataset(options)
    pycolmap.synthesize_noise(pycolmap.SyntheticNoiseOptions(point2D_stddev=0.5), made)
    return made


def test_statistics_are_those_of_the_model(model: pycolmap.Reconstruction) -> None:
    statistics = Statistics.of(model)
    lengths = [point.track.length() for point in model.points3D.values()]
    assert statistics.num_images == NUM_IMAGES
    assert statistics.num_points == len(lengths) == 60
    assert statistics.num_observations == sum(lengths)
    assert statistics.mean_track_length == pytest.approx(np.mean(lengths))
    assert statistics.reprojection_error_px == pytest.approx(model.compute_mean_reprojection_error())
    assert statistics.num_weak == 0


def test_statistics_of_an_empty_model_are_zero() -> None:
    empty = Statistics.of(pycolmap.Reconstruction())
    assert (empty.num_images, empty.num_points, empty.num_observations, empty.num_weak) == (0, 0, 0, 0)
    assert (empty.mean_track_length, empty.reprojection_error_px) == (0.0, 0.0)


def test_images_with_too_few_observations_are_weak(model: pycolmap.Reconstruction) -> None:
    few = min(model.reg_image_ids())
    for index, point2d in list(enumerate(model.image(few).points2D)):
        if point2d.has_point3D() and model.image(few).num_points3D >= MIN_OBSERVATIONS:
            model.delete_observation(few, index)
    assert weak_images(model) == [few]
    assert Statistics.of(model).num_weak == 1


def test_points_behind_a_camera_do_not_count_in_the_mean_error(model: pycolmap.Reconstruction) -> None:
    """COLMAP's error of such a point is 1e154, and so is the mean of all points."""
    error = Statistics.of(model).reprojection_error_px
    assert 0.4 < error < 0.8
    point = model.point3D(min(model.points3D))
    point.xyz = 3 * np.stack([image.projection_center() for image in model.images.values()])[0]
    assert Statistics.of(model).reprojection_error_px == pytest.approx(error, rel=0.05)


def test_a_failed_scene_keeps_its_images_and_has_no_tracks() -> None:
    result = SceneRefinement.failed(["a.jpg", "b.jpg"], "the process died")
    assert (result.succeeded, result.reason) == (False, "the process died")
    assert (result.statistics.num_images, result.statistics.num_weak, result.statistics.num_points) == (2, 2, 0)
