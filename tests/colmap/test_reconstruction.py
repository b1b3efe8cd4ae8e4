"""A pycolmap model as arrays: poses, cameras, points and observations by the ids of the collection."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest

from smust3r_colmap.colmap.reconstruction import SparseObservations, cameras_of, poses_of
from smust3r_colmap.geometry.camera import Intrinsics


@pytest.fixture
def model() -> pycolmap.Reconstruction:
    """Five images that see 40 points, of which one image is not registered."""
    pycolmap.set_random_seed(1)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=5, num_points3D=40, num_points2D_without_point3D=3
    )
    made = pycolmap.synthesize_dataset(options)
    made.deregister_frame(made.image(3).frame_id)
    return made


def test_poses_are_those_of_registered_images_by_index(model: pycolmap.Reconstruction) -> None:
    poses = poses_of(model)
    assert list(poses) == [0, 1, 3, 4]
    for index, pose in poses.items():
        np.testing.assert_array_equal(pose, model.image(index + 1).cam_from_world().matrix())


def test_cameras_that_the_model_lacks_are_the_priors(model: pycolmap.Reconstruction) -> None:
    prior = Intrinsics(model="SIMPLE_PINHOLE", width=10, height=10, params=(9.0, 5.0, 5.0))
    first, second = cameras_of(model, [prior, prior])
    assert first == Intrinsics.from_colmap(model.camera(1))
    assert second == prior


def test_observations_project_to_their_points(model: pycolmap.Reconstruction) -> None:
    observations = SparseObservations.of(model, [1, 2])
    assert observations.xyz.shape == observations.rgb.shape == (len(model.points3D), 3)
    assert observations.track_lengths.sum() == model.compute_num_observations()
    assert set(observations.points) == {1, 2}
    for image_id, points in observations.points.items():
        image = model.image(image_id)
        assert len(points) == image.num_points3D > 30
        projected = [image.project_point(xyz) for xyz in observations.xyz[points]]
        np.testing.assert_allclose(np.array(projected), observations.xy[image_id], atol=1e-6)


def test_an_image_without_points_has_empty_arrays(model: pycolmap.Reconstruction) -> None:
    observations = SparseObservations.of(model, [3])
    assert observations.points[3].shape == (0,)
    assert observations.xy[3].shape == (0, 2)
    empty = SparseObservations.of(pycolmap.Reconstruction(), [])
    assert empty.xyz.shape == empty.rgb.shape == (0, 3)
