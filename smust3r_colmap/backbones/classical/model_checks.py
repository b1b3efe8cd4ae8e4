"""What tells a wrong model from a right one. By its own pixels a wrong one looks perfect.

Each check gives its finding in words, or the positions in the model at which it breaks.
The next module to read is ``mapping``, which climbs from one mapper to the next until the checks pass.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import pycolmap

from smust3r_colmap.backbones.classical.mapped_model import MappedModel
from smust3r_colmap.geometry.arrays import Pair
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.geometry.sim3 import invert_rigid

MAX_TURN_DEG = 60.0
"""Neighbouring images that match cannot have turned by more (honest walks: 52 at most; folds: 150)."""
MAX_STEP_RATIO = 10.0
"""Nor moved by more than this many median steps (honest walks: 1.8; folds: 33 to 42) ..."""
MIN_JUMP_DEPTHS = 0.5
"""... unless the step is small beside the distance of what they see, as after a pause."""
STRONG_PAIR_INLIERS = 30
"""Verified matches that make two images certain neighbours (COLMAP's own bar for registration)."""
MIN_EXPLAINED_SHARE = 0.5
"""A relative pose that fewer of the pair's verified matches agree with is wrong (sound models: 0.57 at
least; wrong ones, on a walk round a building: 0 to 0.44)."""
AFFIRMED_SHARE = 0.8
"""A turn that so many of the pair's verified matches agree with has happened, as at the end of a drone's strip."""
MAX_EPIPOLAR_ERROR_PX = 4.0
"""COLMAP's own bound for an inlier of two views."""
NEAR_STEPS = 2
"""How far apart in the sequence two images may be to deny each other; farther ones may be look-alikes."""
MIN_HINGE_POINTS = 12
"""Common points that hold two halves of a model together (honest links: 16 at least; a wrong one: 9)."""
MIN_FOCAL_RATIO, MAX_FOCAL_RATIO = 0.2, 8.0
"""Focal length over the longer side, from a 136 degree lens to a 7 degree one; a few images in a row
on nearly parallel rays self-calibrate to anything."""
FOCAL_TOLERANCE = 0.15
"""A focal length farther from the run's median belongs to a diverged self-calibration."""


def absurd_focal(model: MappedModel) -> str:
    """What is wrong with the focal lengths of most images, or nothing."""
    ratios = np.array([one.focal_px / max(one.width, one.height) for one in model.intrinsics])
    absurd = (ratios < MIN_FOCAL_RATIO) | (ratios > MAX_FOCAL_RATIO)
    if absurd.mean() <= 0.5:
        return ""
    k = int(np.argmax(absurd))
    return f"focal length {model.intrinsics[k].focal_px:.0f} px is {ratios[k]:.1f} times the longer side"


def diverged_focal(model: MappedModel, camera_of: Mapping[int, int], trusted: Mapping[int, Intrinsics]) -> str:
    """How far the focal lengths of most images are from the run's, or nothing.

    Args:
        camera_of: camera index by image. trusted: the run's cameras, by index; may lack some.
    """
    known_focal = {camera: intrinsics.focal_px for camera, intrinsics in trusted.items()}
    known = np.array([known_focal.get(camera_of[image], np.nan) for image in model.images])
    focal = np.array([one.focal_px for one in model.intrinsics])
    diverged = np.abs(np.log(focal / known)) > np.log1p(FOCAL_TOLERANCE)  # False where the run has none
    if diverged.mean() <= 0.5:
        return ""
    k = int(np.argmax(diverged))
    return f"focal length {focal[k]:.0f} px, the run's is {known[k]:.0f} px"


def find_jumps(model: MappedModel, inliers: Mapping[Pair, int]) -> list[int]:
    """Positions k where ``model.images[k]`` and the next image of the sequence match but stand apart.

    A pair counts when its numbers are consecutive and it has STRONG_PAIR_INLIERS verified matches;
    standing apart is a turn above MAX_TURN_DEG, or a step above MAX_STEP_RATIO median steps and
    above MIN_JUMP_DEPTHS of the distance of what the first image sees.
    """
    lengths = _step_lengths(model, inliers)
    return [k for k in lengths if _turn_deg(model, k) > MAX_TURN_DEG or _is_too_far(model, k, lengths)]


def _step_lengths(model: MappedModel, inliers: Mapping[Pair, int]) -> dict[int, float]:
    """How far the camera moved after position k, for every k whose image and the next are certain neighbours."""
    centres = model.seg_from_cam[:, :, 3]
    return {
        k: float(np.linalg.norm(centres[k + 1] - centres[k]))
        for k, (first, second) in enumerate(pairwise(model.images))
        if second - first == 1 and inliers.get((first, second), 0) >= STRONG_PAIR_INLIERS
    }


def _turn_deg(model: MappedModel, k: int) -> float:
    relative = model.seg_from_cam[k, :, :3].T @ model.seg_from_cam[k + 1, :, :3]
    return float(np.degrees(np.arccos(np.clip((np.trace(relative) - 1) / 2, -1, 1))))


def _is_too_far(model: MappedModel, k: int, lengths: Mapping[int, float]) -> bool:
    median = float(np.median(list(lengths.values())))
    return lengths[k] > MAX_STEP_RATIO * median and lengths[k] > MIN_JUMP_DEPTHS * _median_depth(model, k)


def find_doubtful_jumps(model: MappedModel, inliers: Mapping[Pair, int], database: pycolmap.Database) -> list[int]:
    """The jumps but for turns that AFFIRMED_SHARE of the verified matches agree with.

    Matches say nothing about the length of a step, so one that is too long stays in doubt.

    Args:
        inliers: verified matches by pair. database: with the keypoints and the two-view geometries.
    """
    lengths = _step_lengths(model, inliers)
    return [
        k
        for k in find_jumps(model, inliers)
        if _is_too_far(model, k, lengths) or explained_share(model, k, k + 1, database) < AFFIRMED_SHARE
    ]


def _median_depth(model: MappedModel, k: int) -> float:
    seen = model.tracks.point_of_observation[model.tracks.image_of_observation == model.images[k]]
    if not len(seen):
        return 0.0
    cam_from_seg = invert_rigid(model.seg_from_cam[k])
    return float(np.median(model.tracks.points_seg[seen] @ cam_from_seg[2, :3] + cam_from_seg[2, 3]))


def find_hinges(model: MappedModel) -> list[int]:
    """Positions k such that fewer than MIN_HINGE_POINTS points are seen on both sides of image k and the next.

    The two sides may turn and grow against each other about so few points, however well they fit.
    """
    tracks = model.tracks
    position = np.searchsorted(model.images, tracks.image_of_observation)
    num_points = len(tracks.points_seg)
    first, last = np.full(num_points, len(model.images)), np.full(num_points, -1)
    np.minimum.at(first, tracks.point_of_observation, position)
    np.maximum.at(last, tracks.point_of_observation, position)
    return [k for k in range(len(model.images) - 1) if np.count_nonzero((first <= k) & (last > k)) < MIN_HINGE_POINTS]


def find_denied_steps(model: MappedModel, inliers: Mapping[Pair, int], database: pycolmap.Database) -> list[int]:
    """Positions k such that verified matches deny how the model places image k and the next.

    Every pair of near images with STRONG_PAIR_INLIERS has to find most of its matches on their epipolar
    lines. That tells a fold, or a bad bridge, from a drone's half turn at the end of a strip, where the
    model turns as well but the matches agree. Images from the two ends of a loop are never near.

    Args:
        inliers: verified matches by pair. database: with the keypoints and the two-view geometries.
    """
    denied = set()
    for a, b in near_positions(model.images):
        strong = inliers.get((model.images[a], model.images[b]), 0) >= STRONG_PAIR_INLIERS
        if strong and explained_share(model, a, b, database) < MIN_EXPLAINED_SHARE:
            denied.add(b - 1)
    return sorted(denied)


def near_positions(images: Sequence[int]) -> Iterator[tuple[int, int]]:
    """Positions (a, b) of images that are at most NEAR_STEPS apart in the sequence, a before b."""
    for a in range(len(images)):
        for b in range(a + 1, min(a + 1 + NEAR_STEPS, len(images))):
            if images[b] - images[a] <= NEAR_STEPS:
                yield a, b


def explained_share(model: MappedModel, a: int, b: int, database: pycolmap.Database) -> float:
    """Share of the verified matches of the images at positions a and b that fit the model's relative pose."""
    first, second = model.images[a] + 1, model.images[b] + 1
    matches = database.read_two_view_geometry(first, second).inlier_matches
    xy_first = np.asarray(database.read_keypoints(first), dtype=np.float64)[matches[:, 0], :2]
    xy_second = np.asarray(database.read_keypoints(second), dtype=np.float64)[matches[:, 1], :2]
    return float(np.mean(epipolar_errors_px(model, a, b, xy_first, xy_second) < MAX_EPIPOLAR_ERROR_PX))


def epipolar_errors_px(
    model: MappedModel, a: int, b: int, xy_first: npt.NDArray[np.float64], xy_second: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """(M,) Sampson errors in pixels of points of the images at positions a and b under the model's poses."""
    second_from_first = pycolmap.Rigid3d(model.seg_from_cam[b]).inverse() * pycolmap.Rigid3d(model.seg_from_cam[a])
    squared = pycolmap.compute_squared_sampson_error(
        model.intrinsics[a].rays_cam(xy_first)[:, :2],
        model.intrinsics[b].rays_cam(xy_second)[:, :2],
        pycolmap.essential_matrix_from_pose(second_from_first),
    )
    focal_px = 0.5 * (model.intrinsics[a].focal_px + model.intrinsics[b].focal_px)
    errors: npt.NDArray[np.float64] = focal_px * np.sqrt(squared)
    return errors
