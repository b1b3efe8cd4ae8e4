"""Small synthetic submodels and models that several test modules use."""

from __future__ import annotations

import numpy as np

from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.geometry.sim3 import Sim3
from smust3r_colmap.products import Submodel, Tracks

CAMERA = Intrinsics(model="PINHOLE", width=640, height=480, params=(500.0, 500.0, 320.0, 240.0))


def rotation_about_y(angle_deg: float) -> FloatArray:
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def walk(num_images: int, *, step: float = 0.3, turn_deg: float = 1.0) -> FloatArray:
    """(N, 3, 4) world_from_cam of a walk to the right, turning a little at each step."""
    poses = [
        np.column_stack([rotation_about_y(turn_deg * k), [step * k, 0.05 * np.sin(k), 0.1 * np.cos(2 * k)]])
        for k in range(num_images)
    ]
    return np.array(poses)


def points_ahead(num_points: int, rng: np.random.Generator) -> FloatArray:
    """(P, 3) points in front of the whole walk."""
    return rng.uniform([-4.0, -2.0, 4.0], [10.0, 2.0, 12.0], size=(num_points, 3))


def make_submodel(
    world_from_cam: FloatArray,
    images: tuple[int, ...],
    points_world: FloatArray,
    seg_from_world: Sim3,
    *,
    segment: int = 0,
    submodel: int = 0,
    with_tracks: bool = True,
) -> Submodel:
    """A submodel that sees every point in every image; point p is feature p of each image."""
    p = len(points_world)
    tracks = Tracks(
        points_seg=seg_from_world.apply(points_world),
        point_of_observation=np.tile(np.arange(p), len(images)),
        image_of_observation=np.repeat(np.array(images, dtype=np.int64), p),
        feature_of_observation=np.tile(np.arange(p), len(images)),
    )
    return Submodel(
        segment=segment,
        submodel=submodel,
        images=images,
        seg_from_cam=seg_from_world.move_cameras(world_from_cam[list(images)]),
        intrinsics=(CAMERA,) * len(images),
        method="synthetic",
        reprojection_error_px=0.3,
        tracks=tracks if with_tracks else None,
    )


def some_sim3(rng: np.random.Generator) -> Sim3:
    """A similarity with a scale between 0.3 and 3 and any rotation."""
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    rotation = q * np.sign(np.diag(r))
    if np.linalg.det(rotation) < 0:
        rotation[:, 0] *= -1
    return Sim3(scale=np.exp(rng.uniform(-1, 1)), rotation=rotation, translation=rng.normal(scale=5, size=3))
