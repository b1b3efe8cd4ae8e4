"""A direction of up in the model, from what is not positions: gimbal angles, a ground plane, photographs held upright.

EXIF's orientation tag is none of them: it says how to turn a picture, and nadir photographs have one as well.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from smust3r_colmap.geometry.arrays import FloatArray

MAX_DISAGREEMENT_DEG = 10.0
"""Between gimbal angles of different images, at the median; more, and they do not mean what is thought."""
MAX_THICKNESS = 0.25
"""Of ground by its width, as ratios of spread; hills and houses of a survey stay below, a street does not."""
MAX_ANGLE_TO_GROUND_DEG = 45.0
"""Between optical axes and the plumb line, at the median; beyond, the plane may be a wall."""
MAX_TURN_DEG = 20.0
"""Between the upper sides of photographs held upright, at the median."""
MIN_DEPTH_RATIO = 2.7
"""Depth of the farthest by that of the nearest tenth of the points in an image, at the median; photographs that look
down have all of them at about one distance. (8 on lund_street, 4 on kitti_a; 1.2 on copr_gcp and caliterra_drone.)"""
MAX_ANGLE_TO_AXES_DEG = 15.0
"""Between the plumb line of the ground and the middle of the optical axes, for the two to confirm each other."""
MAX_SLOPE_DEG = 45.0
"""Between gimbal angles and the plumb line of the ground; programs count angles from the horizon or from the nadir."""
GIMBAL_SIGMA_DEG, NADIR_SIGMA_DEG, GROUND_SIGMA_DEG, UPRIGHT_SIGMA_DEG = 2.0, 3.0, 5.0, 5.0
"""Ground slopes, and nobody holds a camera exactly; nadir: ground and optical axes agree."""
_MIN_POINTS = 10
_PLANE_ROUNDS = 20


@dataclass(frozen=True, kw_only=True, eq=False)
class UpDirection:
    """A direction upwards.

    Args:
        up_model: (3,) unit vector in the model. source: what it was taken from. sigma_deg: standard deviation.
        confirmed: by two things that do not know of each other; then it is trusted more than heights of a receiver.
    """

    up_model: FloatArray
    source: str
    sigma_deg: float
    confirmed: bool = False


def find_up(cam_from_model: FloatArray, up_cam: FloatArray, points_model: FloatArray) -> UpDirection | None:
    """From the first of gimbal angles, ground plane, upright photographs that is to be trusted; None: none is.

    Args:
        cam_from_model: (N, 3, 4) poses. up_cam: (N, 3) by gimbal angles; NaN where there are none.
        points_model: (P, 3) of the sparse model.
    """
    gimbals, ground = _from_gimbals(cam_from_model[:, :, :3], up_cam), _from_ground(cam_from_model, points_model)
    if gimbals is not None and ground is not None and _angle_deg(gimbals.up_model, ground.up_model) > MAX_SLOPE_DEG:
        gimbals = None
    return gimbals or ground or _from_upright_photographs(cam_from_model, points_model)


def _from_gimbals(rotations: FloatArray, up_cam: FloatArray) -> UpDirection | None:
    known = np.isfinite(up_cam).all(axis=1)
    if not known.any():
        return None
    each = np.einsum("nji,nj->ni", rotations[known], up_cam[known])
    middle, disagreement = _middle(each)
    if disagreement > MAX_DISAGREEMENT_DEG:
        return None
    source = f"the gimbal angles of {len(each)} images"
    return UpDirection(up_model=middle, source=source, sigma_deg=GIMBAL_SIGMA_DEG, confirmed=True)


def _from_ground(cam_from_model: FloatArray, points: FloatArray) -> UpDirection | None:
    if len(points) < _MIN_POINTS:
        return None
    rotations = cam_from_model[:, :, :3]
    centres = -np.einsum("nji,nj->ni", rotations, cam_from_model[:, :, 3])
    centre, normal, thickness = _plane(points)
    heights = (centres - centre) @ normal
    normal = normal if np.median(heights) > 0 else -normal
    steepness = np.degrees(np.arccos(np.clip(-rotations[:, 2] @ normal, -1, 1)))
    if thickness > MAX_THICKNESS or np.median(steepness) > MAX_ANGLE_TO_GROUND_DEG:
        return None
    axis, _ = _middle(-rotations[:, 2])
    nadir = _angle_deg(axis, normal) < MAX_ANGLE_TO_AXES_DEG
    source = "the plane of the ground, on which the images look down" if nadir else "the plane of the ground"
    sigma_deg = NADIR_SIGMA_DEG if nadir else GROUND_SIGMA_DEG
    return UpDirection(up_model=normal, source=source, sigma_deg=sigma_deg, confirmed=nadir)


def _plane(points: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """A point of it, its normal, and how thick it is by its width; trees and wrong points lose their weight."""
    weights = np.ones(len(points))
    for _ in range(_PLANE_ROUNDS):
        centre = weights @ points / weights.sum()
        centred = points - centre
        spread, axes = np.linalg.eigh((weights[:, None] * centred).T @ centred / weights.sum())
        distances = np.abs(centred @ axes[:, 0])
        scale = 1.4826 * np.median(distances) + 1e-12
        across = np.linalg.norm(centred @ axes[:, 1:], axis=1)
        width = 1.4826 * np.median(across) + 1e-12
        weights = 1 / (1 + (distances / (2 * scale)) ** 2) / (1 + (across / (4 * width)) ** 2)
    return centre, axes[:, 0], float(np.sqrt(max(spread[0], 0.0) / max(spread[1], 1e-300)))


def _from_upright_photographs(cam_from_model: FloatArray, points: FloatArray) -> UpDirection | None:
    middle, disagreement = _middle(-cam_from_model[:, 1, :3])
    if disagreement > MAX_TURN_DEG or _depth_ratio(cam_from_model, points) < MIN_DEPTH_RATIO:
        return None
    return UpDirection(up_model=middle, source="the photographs, taken as held upright", sigma_deg=UPRIGHT_SIGMA_DEG)


def _depth_ratio(cam_from_model: FloatArray, points: FloatArray) -> float:
    """Of the farthest to the nearest tenth of the points before an image, at the median; 1 with too few points."""
    ratios = []
    for pose in cam_from_model:
        in_camera = points @ pose[:, :3].T + pose[:, 3]
        depth = in_camera[in_camera[:, 2] > np.abs(in_camera[:, :2]).max(axis=1), 2]
        if len(depth) >= _MIN_POINTS:
            near, far = np.quantile(depth, (0.1, 0.9))
            ratios.append(float(far / near))
    return float(np.median(ratios)) if ratios else 1.0


def _angle_deg(a: FloatArray, b: FloatArray) -> float:
    return float(np.degrees(np.arccos(np.clip(a @ b, -1, 1))))


def _middle(directions: FloatArray) -> tuple[FloatArray, float]:
    """The direction (3,) in the middle of unit vectors (N, 3), and the median angle to it in degrees."""
    middle = directions.sum(axis=0)
    for _ in range(10):
        middle = middle / max(float(np.linalg.norm(middle)), 1e-12)
        distances = np.linalg.norm(directions - middle, axis=1)
        middle = (directions / np.maximum(distances, 1e-3)[:, None]).sum(axis=0)
    middle = middle / max(float(np.linalg.norm(middle)), 1e-12)
    angles = np.degrees(np.arccos(np.clip(directions @ middle, -1, 1)))
    return middle, float(np.median(angles))
