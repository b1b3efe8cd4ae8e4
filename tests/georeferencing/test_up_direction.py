"""Directions of up without positions: what is trusted, and what is not."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.surveys import make_survey

from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.georeferencing.up_direction import UpDirection, find_up
from smust3r_colmap.importers.gps_tags import up_in_camera

pytest.importorskip("pyproj")

SURVEY = make_survey(np.random.default_rng(0), rows=2, columns=6)
TRUE_UP = SURVEY.local_from_model.rotation.T @ np.array([0.0, 0.0, 1.0])
NONE = np.full((12, 3), np.nan)


def find(up_cam: FloatArray = NONE, *, with_points: bool = True) -> UpDirection | None:
    model = SURVEY.model(with_points=with_points)
    return find_up(model.cam_from_model, up_cam, model.points_model)


def angle_deg(found: UpDirection | None) -> float:
    assert found is not None
    return float(np.degrees(np.arccos(np.clip(found.up_model @ TRUE_UP, -1, 1))))


def test_gimbal_angles_come_first() -> None:
    true_up_cam = SURVEY.cam_from_local[:, :, :3] @ np.array([0.0, 0.0, 1.0])
    true_up_cam[3] = np.nan
    found = find(true_up_cam)
    assert angle_deg(found) < 1e-4
    assert found is not None
    assert (found.source, found.confirmed) == ("the gimbal angles of 11 images", True)


def test_gimbal_angles_counted_from_elsewhere_are_not_used() -> None:
    """All 90 degrees wrong, and agreeing with each other: the ground contradicts."""
    found = find(np.tile(up_in_camera(0, 0), (12, 1)))
    assert found is not None
    assert found.source.startswith("the plane of the ground")
    assert angle_deg(found) < 4


def test_gimbal_angles_that_disagree_are_not_used() -> None:
    found = find(np.array([up_in_camera(-90 + 40 * (k % 3), 0) for k in range(12)]))
    assert found is not None
    assert found.source.startswith("the plane of the ground")


def test_ground_that_is_looked_down_on_is_confirmed() -> None:
    found = find()
    assert found is not None
    assert (found.source, found.confirmed) == ("the plane of the ground, on which the images look down", True)
    assert angle_deg(found) < 4


def test_images_that_look_down_are_not_taken_for_upright_photographs() -> None:
    """Without points nothing tells: their upper sides agree as well as those of photographs held upright."""
    assert find(with_points=False) is None


def test_a_street_is_taken_as_held_upright() -> None:
    """Cameras along a street between two walls and over a ground, looking ahead, model and world in one frame."""
    rng = np.random.default_rng(1)
    ahead = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])  # z forward is north, y down is down
    poses = np.array([np.column_stack([ahead, -ahead @ [0, 3.0 * k, 1.6]]) for k in range(8)])
    north, height = rng.uniform(0, 60, 300), rng.uniform(0, 8, 300)
    walls = np.column_stack([np.where(rng.uniform(size=300) < 0.5, -6, 6), north, height])
    ground = np.column_stack([rng.uniform(-6, 6, 150), rng.uniform(0, 60, 150), np.zeros(150)])
    found = find_up(poses, np.full((8, 3), np.nan), np.vstack([walls, ground]))
    assert found is not None
    assert found.source == "the photographs, taken as held upright"
    assert not found.confirmed
    np.testing.assert_allclose(found.up_model, [0, 0, 1], atol=1e-9)
