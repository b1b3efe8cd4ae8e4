"""The pairs of images from which the incremental mapper starts.

COLMAP's own search begins with the pairs that share most matches. In a sequence these are neighbours,
which hardly see around anything, so it estimates hundreds of pairs before one passes, lowers its demands
and begins again: up to half of the cost of a segment. It also starts where it can and not where it is best,
and a model from a weak start, with a guessed focal length, collapses after dozens of images. Here all
pairs are ranked by a parallax that costs little, and only the best are estimated.
The next module to read is ``mapping``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap

from smust3r_colmap.geometry.arrays import FloatArray, Pair
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.geometry.so3 import nearest_rotation

MIN_INLIERS = 50
"""Verified matches of a pair to start from; COLMAP's own 100, halved once as it does where none has them."""
ENOUGH_PARALLAX_DEG = 4.0
"""Median parallax beyond which a pair is not better for having more; its matches only get fewer."""
MAX_ESTIMATED = 12
"""Best-ranked pairs whose relative pose is estimated."""
MAX_STARTS = 3
"""Pairs to try until one gives a model."""
ENOUGH_ANGLE_DEG = 16.0
"""Median angle between the rays to a point at which no further pair is tried (COLMAP's ``init_min_tri_angle``)."""
FORWARD_MOTION = 0.9
"""Share of the motion along the view above which the depth of what lies ahead is badly known ..."""
FORWARD_VALUE = 0.3
"""... and what a degree between such rays is worth beside one from the side."""


@dataclass(frozen=True, kw_only=True)
class StartPair:
    """Two images by index, the median angle in degrees between their rays, and whether they moved straight ahead."""

    first: int
    second: int
    angle_deg: float
    forward: bool


def choose_start_pairs(
    database: pycolmap.Database, pairs: Sequence[Pair], cameras: Mapping[int, Intrinsics], *, seed: int
) -> tuple[StartPair, ...]:
    """At most MAX_STARTS of the pairs, best first; none if none has MIN_INLIERS verified matches and a relative pose.

    Args:
        database: with keypoints and two-view geometries; image ids are index + 1.
        pairs: to choose from. cameras: start values by image index. seed: of the sampler.
    """
    xy_img: dict[int, FloatArray] = {}
    rays: dict[int, FloatArray] = {}
    ranked = []
    for pair in pairs:
        matches = database.read_two_view_geometry(pair[0] + 1, pair[1] + 1).inlier_matches
        if len(matches) < MIN_INLIERS:
            continue
        for image in pair:
            if image not in rays:
                xy_img[image] = np.asarray(database.read_keypoints(image + 1), dtype=np.float64)[:, :2]
                rays[image] = cameras[image].rays_cam(xy_img[image])
        parallax_deg = _parallax_deg(rays[pair[0]][matches[:, 0]], rays[pair[1]][matches[:, 1]])
        ranked.append((len(matches) * min(parallax_deg / ENOUGH_PARALLAX_DEG, 1.0), pair, matches))
    ranked.sort(key=lambda row: (-row[0], row[1]))
    valued: list[tuple[float, StartPair]] = []
    for _, (first, second), matches in ranked[:MAX_ESTIMATED]:
        geometry = pycolmap.estimate_calibrated_two_view_geometry(
            cameras[first].colmap_camera(1),
            xy_img[first],
            cameras[second].colmap_camera(2),
            xy_img[second],
            matches,
            _estimation_options(seed),
        )
        if geometry.cam2_from_cam1 is None or len(geometry.inlier_matches) < MIN_INLIERS:
            continue
        angle_deg = float(np.degrees(geometry.tri_angle))
        forward = abs(geometry.cam2_from_cam1.translation[2]) > FORWARD_MOTION
        value = angle_deg * (FORWARD_VALUE if forward else 1.0)
        valued.append((value, StartPair(first=first, second=second, angle_deg=angle_deg, forward=forward)))
        if value >= ENOUGH_ANGLE_DEG:
            break
    valued.sort(key=lambda row: -row[0])
    return tuple(pair for _, pair in valued[:MAX_STARTS])


def _parallax_deg(rays_first: FloatArray, rays_second: FloatArray) -> float:
    """Median angle that is left between matched rays (M, 3) after the best rotation; 0 without a finite match."""
    finite = np.isfinite(rays_first).all(axis=1) & np.isfinite(rays_second).all(axis=1)
    if np.count_nonzero(finite) < MIN_INLIERS:
        return 0.0
    first, second = (
        rays[finite] / np.linalg.norm(rays[finite], axis=1, keepdims=True) for rays in (rays_first, rays_second)
    )
    second_from_first = nearest_rotation(second.T @ first)
    cosines = np.einsum("ij,ij->i", second, first @ second_from_first.T)
    return float(np.degrees(np.median(np.arccos(np.clip(cosines, -1.0, 1.0)))))


def _estimation_options(seed: int) -> pycolmap.TwoViewGeometryOptions:
    """As COLMAP's mapper estimates its first pair."""
    options = pycolmap.TwoViewGeometryOptions()
    options.compute_relative_pose = True
    options.ransac.min_num_trials = 30
    options.ransac.random_seed = seed
    return options
