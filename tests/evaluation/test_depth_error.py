"""Depth of a sensor in another view, and the measures of depth."""

from __future__ import annotations

import math

import numpy as np
import pytest
from helpers.dense_scenes import cameras_from_world, exact_depth
from helpers.sensor_depth import SENSOR, VIEW, compose
from scipy.spatial.transform import Rotation

from smust3r_colmap.evaluation.depth_error import DepthErrors, depth_in_view, map_ratios
from smust3r_colmap.geometry.arrays import Float32Array
from smust3r_colmap.geometry.camera import Intrinsics


def steps(sensor: Intrinsics) -> Float32Array:
    """A near plane on the left half and a far one on the right."""
    depth = np.full((sensor.height, sensor.width), 4.0, np.float32)
    depth[:, : sensor.width // 2] = 2.0
    return depth


# ------------------------------------------------------------------------- registration
def test_a_sensor_in_the_place_of_the_camera_is_seen_pixel_by_pixel() -> None:
    depth = np.random.default_rng(0).uniform(1, 5, (90, 120)).astype(np.float32)
    depth[10:20, 30:50] = 0
    np.testing.assert_array_equal(depth_in_view(depth, VIEW, np.eye(3, 4), VIEW), depth)


def test_a_sensor_beside_the_camera_sees_the_scene_as_the_camera_does() -> None:
    """Both look at a ball before a wall; away from edges and within what both see, drawn and true depth agree."""
    view_from_sensor = np.column_stack([Rotation.from_rotvec([0.01, -0.02, 0.005]).as_matrix(), [-0.03, 0.01, 0.02]])
    sensor_from_world = cameras_from_world()[2]
    view_from_world = compose(view_from_sensor, sensor_from_world)
    measured = exact_depth(SENSOR, sensor_from_world)
    seen = depth_in_view(measured, SENSOR, view_from_sensor, VIEW)
    truth = exact_depth(VIEW, view_from_world)
    read = seen > 0
    assert 0.85 < read.mean() <= 1
    error = np.abs(seen[read] / truth[read] - 1)
    assert np.quantile(error, 0.95) < 0.01
    # Half a pixel of the view, or the registration left out, would show.
    shifted = depth_in_view(measured, SENSOR, np.eye(3, 4), VIEW)
    both = read & (shifted > 0)
    assert np.median(np.abs(shifted[both] / truth[both] - 1)) > 5 * np.median(np.abs(seen[both] / truth[both] - 1))


def test_of_two_surfaces_in_a_pixel_the_nearer_is_taken() -> None:
    moved = np.column_stack([np.eye(3), [0.4, 0.0, 0.0]])  # the near plane slides over the far one
    seen = depth_in_view(steps(VIEW), VIEW, moved, VIEW)
    edge_near = 60 + 100 * 0.4 / 2.0
    edge_far = 60 + 100 * 0.4 / 4.0
    assert (seen[:, 25 : int(edge_near)] == 2).all()
    assert edge_far < edge_near
    assert (seen[:, int(edge_near) + 1 :] == 4).all()


@pytest.mark.parametrize("size", [(160, 120), (400, 300)])
def test_a_view_larger_than_the_sensor_has_no_holes(size: tuple[int, int]) -> None:
    view = SENSOR.resized(*size).zoomed(1.05)
    seen = depth_in_view(steps(SENSOR), SENSOR, np.eye(3, 4), view)
    assert (seen > 0).all()


# ----------------------------------------------------------------------------- measures
def test_measures_are_those_of_the_ratios() -> None:
    ratios = np.array([1.0, 1.04, 1 / 1.04, 1.06, 1 / 1.06, 1.3])
    found = DepthErrors.of("", ratios, 12)
    assert found.abs_rel == pytest.approx((0.04 + 1 - 1 / 1.04 + 0.06 + 1 - 1 / 1.06 + 0.3) / 6)
    assert found.median_rel == pytest.approx((0.04 + 1 - 1 / 1.06) / 2)
    assert (found.delta_105, found.delta_125, found.coverage) == (3 / 6, 5 / 6, 6 / 12)


def test_what_cannot_be_compared_has_no_figures() -> None:
    nothing = DepthErrors.of("", np.empty(0), 7)
    assert nothing.coverage == 0
    assert math.isnan(nothing.abs_rel) and math.isnan(nothing.median_rel) and math.isnan(nothing.delta_105)


def test_ratios_are_of_pixels_that_both_have() -> None:
    depth = np.array([[2, 0], [3, 4]], np.float32)
    truth = np.array([[1, 1], [0, 5]], np.float32)
    assert map_ratios(depth, truth).tolist() == pytest.approx([2, 0.8])
