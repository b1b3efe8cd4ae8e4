"""Image pairs of one camera on an arc or on a straight line, verified without knowing its focal length."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from smust3r_colmap.colmap.database import create_database, open_database
from smust3r_colmap.features.view_graph_calibration import VerifiedPairs
from smust3r_colmap.geometry.arrays import Pair
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.products import ImageCollection, SourceImage

TRUE_FOCAL_PX, GUESSED_FOCAL_PX = 480.0, 768.0
TRUTH = Intrinsics(model="SIMPLE_RADIAL", width=640, height=480, params=(TRUE_FOCAL_PX, 320.0, 240.0, 0.0))
GUESS = replace(TRUTH, params=(GUESSED_FOCAL_PX, 320.0, 240.0, 0.0))
NUM_IMAGES, NUM_POINTS, STEP_DEG, NOISE_PX = 12, 200, 6.0, 0.1


def round_the_points(k: int) -> np.ndarray:
    """(3, 4) camera k of an arc about the origin, looking at it from a little above."""
    angle = np.radians(k * STEP_DEG)
    centre = np.array([4 * np.sin(angle), -1.0, -4 * np.cos(angle)])
    forward = -centre / np.linalg.norm(centre)
    right = np.cross([0, 1.0, 0], forward)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return np.column_stack([rotation, -rotation @ centre])


def straight_ahead(k: int) -> np.ndarray:
    """(3, 4) camera k on a straight line along its own axis."""
    return np.column_stack([np.eye(3), [0, 0, -0.3 * k + 6]])


def verified_pairs(
    folder: Path, poses: list[np.ndarray], points: np.ndarray, *, camera: Intrinsics = GUESS
) -> VerifiedPairs:
    """Pairs up to three steps apart, verified with a camera that is known if it has a prior focal length."""
    rng = np.random.default_rng(0)
    images = tuple(
        SourceImage(name=f"{k}.png", path=folder / f"{k}.png", width=640, height=480, camera=0, digest=str(k))
        for k in range(len(poses))
    )
    database = folder / "features.db"
    create_database(database, ImageCollection(images=images, cameras=(camera,)))
    xy = [
        TRUTH.xy_img(points @ pose[:, :3].T + pose[:, 3]) + rng.normal(0, NOISE_PX, (len(points), 2)) for pose in poses
    ]
    pairs: list[Pair] = [(a, a + step) for a in range(len(poses)) for step in (1, 2, 3) if a + step < len(poses)]
    same = np.column_stack([np.arange(len(points))] * 2).astype(np.uint32)
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = 0
    own_camera = camera.colmap_camera()
    with open_database(database) as opened:
        for k, own in enumerate(xy):
            opened.write_keypoints(k + 1, own.astype(np.float32))
        for a, b in pairs:
            geometry = pycolmap.estimate_two_view_geometry(own_camera, xy[a], own_camera, xy[b], same, options)
            opened.write_matches(a + 1, b + 1, same)
            opened.write_two_view_geometry(a + 1, b + 1, geometry)
    return VerifiedPairs(
        database=database,
        pairs=tuple(sorted(pairs)),
        cameras=(camera,),
        camera_of=dict.fromkeys(range(len(poses)), 0),
        seed=0,
    )


def pairs_on_an_arc(folder: Path, *, camera: Intrinsics = GUESS) -> VerifiedPairs:
    """The cameras look at different places; if all looked at one, nothing could be told."""
    points = np.random.default_rng(1).uniform(-1, 1, (NUM_POINTS, 3))
    turned = Rotation.from_rotvec(np.random.default_rng(2).normal(0, 0.15, (NUM_IMAGES, 3))).as_matrix()
    return verified_pairs(folder, [turned[k] @ round_the_points(k) for k in range(NUM_IMAGES)], points, camera=camera)


def pairs_straight_ahead(folder: Path) -> VerifiedPairs:
    """Every focal length explains them, and the noise decides."""
    points = np.random.default_rng(2).uniform((-3, -2, 0), (3, 2, 6), (NUM_POINTS, 3))
    return verified_pairs(folder, [straight_ahead(k) for k in range(NUM_IMAGES)], points)
