"""What else the poses of a model may mean, and which reading the matches agree with.

Programs write poses from camera to world, camera centres in the place of translations, quaternions with w last, or the
axes of OpenGL's cameras. Such numbers are poses like any others, so only matches can tell: of the right reading, most
lie on the epipolar lines. The next module to read is ``refinement.stage``.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from smust3r_colmap.features.guided_verification import MatchedFeatures, View, inlier_fractions
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.geometry.sim3 import invert_rigid

MIN_MATCHES = 30
"""Of a pair that is asked."""
MIN_AGREEING, MIN_ADVANTAGE = 0.5, 0.2
"""Of the matches, that must agree with a reading before it is named, and how many more than with COLMAP's; chance gives
a wrong one a third of them."""

_OPENGL = np.diag([1.0, -1.0, -1.0])
AS_COLMAP = "as COLMAP's"


def readings(stored: FloatArray) -> dict[str, FloatArray]:
    """cam_from_world (N, 3, 4) by what the stored numbers may mean, plainest first.

    Args:
        stored: (N, 3, 4) read as COLMAP's: rotation and translation from world to camera.
    """
    found: dict[str, FloatArray] = {}
    for order, rotation in (("", stored[:, :, :3]), ("quaternions with w last", _with_w_last(stored[:, :, :3]))):
        translation = stored[:, :, 3:]
        world_from_cam = np.concatenate([rotation, translation], axis=2)
        meant = {
            "": world_from_cam,
            "poses from camera to world": invert_rigid(world_from_cam),
            "camera centres in place of translations": np.concatenate([rotation, -rotation @ translation], axis=2),
        }
        for what, pose in meant.items():
            for axes, turned in (("", pose), ("OpenGL's camera axes (y up, z backward)", _OPENGL @ pose)):
                found[" and ".join(part for part in (what, axes, order) if part) or AS_COLMAP] = turned
    return found


def agreement(
    features: MatchedFeatures,
    stored: Mapping[int, FloatArray],
    cameras: Mapping[int, Intrinsics],
    *,
    tolerance: float,
) -> dict[str, float]:
    """Fraction of the matches of a pair that agree with each reading, mean of all pairs; empty where none has enough.

    Args:
        features: of the run.
        stored: by image index, (3, 4) read as COLMAP's.
        cameras: by image index.
        tolerance: as in ``guided_verification.verify_guided``.
    """
    images = sorted(stored)
    agreeing = {}
    for what, poses in readings(np.stack([stored[image] for image in images])).items():
        views = {i: View(cam_from_world=pose, intrinsics=cameras[i]) for i, pose in zip(images, poses, strict=True)}
        fractions = inlier_fractions(features, views, tolerance=tolerance, min_matches=MIN_MATCHES)
        if not fractions:
            return {}
        agreeing[what] = float(np.mean(list(fractions.values())))
    return agreeing


def best_reading(agreeing: Mapping[str, float]) -> str | None:
    """The reading that most matches agree with, or None where too few agree with any."""
    best = max(agreeing, key=lambda what: agreeing[what], default=None)
    if best is None or agreeing[best] < MIN_AGREEING:
        return None
    return best if agreeing[best] >= agreeing[AS_COLMAP] + MIN_ADVANTAGE else AS_COLMAP


def _with_w_last(rotation: FloatArray) -> FloatArray:
    """The rotations (N, 3, 3) that were meant if their quaternions, read as w x y z, are x y z w."""
    x, y, z, w = Rotation.from_matrix(rotation).as_quat().T
    turned: FloatArray = Rotation.from_quat(np.column_stack([w, x, y, z])).as_matrix()
    return turned
