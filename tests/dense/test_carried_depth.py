"""Depth projected into another camera, against the truth of a plane and a step."""

from __future__ import annotations

import numpy as np
import pytest

from smust3r_colmap.dense.carried_depth import DepthView, carry_depth
from smust3r_colmap.geometry.camera import Intrinsics

CAMERA = Intrinsics(model="SIMPLE_RADIAL", width=320, height=240, params=(300.0, 160.0, 120.0, 0.05))
HEIGHT, WIDTH = 60, 80


def pose(x: float = 0.0, z: float = 0.0) -> np.ndarray:
    """(3, 4) of a camera at (x, 0, z) that looks along z."""
    return np.column_stack([np.eye(3), [-x, 0.0, -z]])


def view(depth: np.ndarray, cam_from_world: np.ndarray) -> DepthView:
    confidence = np.where(depth > 0, 3.0, 1.0).astype(np.float32)
    return DepthView(
        depth=depth.astype(np.float32), confidence=confidence, intrinsics=CAMERA, cam_from_world=cam_from_world
    )


def test_a_wall_keeps_its_distance_from_a_camera_that_moved() -> None:
    wall = view(np.full((HEIGHT, WIDTH), 5.0), pose())
    depth, confidence = carry_depth([wall], CAMERA, pose(x=0.2, z=1.0))
    seen = depth > 0
    assert seen[5:-5, 8:-8].all(), "no gaps where the camera came nearer by a fifth"
    assert depth[seen] == pytest.approx(4.0, abs=1e-5)
    assert (confidence[seen] == 3).all() and (confidence[~seen] == 1).all()


def test_what_is_near_hides_what_is_far() -> None:
    depth = np.full((HEIGHT, WIDTH), 8.0)
    depth[:, 40:] = 2.0
    carried, _ = carry_depth([view(depth, pose())], CAMERA, pose(x=0.4))
    # the border at the middle column moves left by 300 * 0.4 / 2 = 60 px, 15 of the map
    row = carried[30]
    assert row[30:60] == pytest.approx(2.0, abs=1e-5)
    assert row[5:15] == pytest.approx(8.0, abs=1e-5)


def test_two_views_fill_each_other_and_no_depth_stays_none() -> None:
    left, right = np.full((2, HEIGHT, WIDTH), 5.0)
    left[:, 50:] = 0
    right[:, :45] = 0
    one, _ = carry_depth([view(left, pose())], CAMERA, pose())
    both, _ = carry_depth([view(left, pose()), view(right, pose())], CAMERA, pose())
    assert (one[:, 52:] == 0).all()
    assert (both[1:-1, 1:-1] > 0).all()


def test_depth_without_confidence_is_not_carried() -> None:
    doubtful = DepthView(
        depth=np.full((HEIGHT, WIDTH), 5.0, np.float32),
        confidence=np.ones((HEIGHT, WIDTH), np.float32),
        intrinsics=CAMERA,
        cam_from_world=pose(),
    )
    depth, confidence = carry_depth([doubtful], CAMERA, pose())
    assert not depth.any()
    assert (confidence == 1).all()
