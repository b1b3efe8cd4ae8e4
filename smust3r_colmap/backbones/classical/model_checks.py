"""Checks of a mapped model by its pairs of images: a wrong model may have a small reprojection error.

Each check gives a reason in words, or the positions in the model at which it fails.
The next module to read is ``strategies``.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import pycolmap
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from smust3r_colmap.backbones.classical.mapped_model import MappedModel
from smust3r_colmap.geometry.arrays import Pair
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.segmentation.view_graph import ViewGraph

MAX_TURN_DEG = 60.0
"""Largest rotation between consecutive images that match (correct walks: 52 at most; wrong models: 150)."""
MAX_STEP_RATIO = 10.0
"""Largest step between them, in median steps (correct walks: 1.8; wrong models: 33 to 42) ..."""
MIN_STEP_DEPTH_RATIO = 0.5
"""... unless the step is smaller than this share of the depth of what they see, as after a pause."""
STRONG_PAIR_INLIERS = 30
"""Verified matches of a pair that is checked (COLMAP's own bar for registration)."""
MIN_EPIPOLAR_INLIER_SHARE = 0.5
"""Share of a pair's verified matches that must be inliers of its relative pose (correct models: 0.57 at
least; wrong ones, on a walk round a building: 0 to 0.44)."""
CONFIRMED_TURN_SHARE = 0.8
"""Share of such inliers that confirms a large rotation, as at the end of a drone's strip."""
MAX_EPIPOLAR_ERROR_PX = 4.0
"""COLMAP's own bound for an inlier of two views."""
NEAR_STEPS = 2
"""Largest difference of the indices of a pair that is tested; images farther apart may show two similar places."""
MIN_LINK_POINTS = 12
"""Common points that connect two halves of a model (correct links: 16 at least; a wrong one: 9)."""
MIN_FOCAL_RATIO, MAX_FOCAL_RATIO = 0.2, 8.0
"""Focal length over the longer side, from a 136 degree lens to a 7 degree one; the self-calibration of a few images
with nearly parallel rays may diverge to any value."""
FOCAL_TOLERANCE = 0.15
"""Relative difference from the run's median above which a self-calibration has diverged."""


def implausible_focal(model: MappedModel) -> str:
    """Why the focal lengths of most images are implausible, or nothing."""
    ratios = np.array([one.focal_px / max(one.width, one.height) for one in model.intrinsics])
    implausible = (ratios < MIN_FOCAL_RATIO) | (ratios > MAX_FOCAL_RATIO)
    if implausible.mean() <= 0.5:
        return ""
    k = int(np.argmax(implausible))
    return f"focal length {model.intrinsics[k].focal_px:.0f} px is {ratios[k]:.1f} times the longer side"


def diverged_focal(model: MappedModel, camera_of: Mapping[int, int], known_cameras: Mapping[int, Intrinsics]) -> str:
    """How far the focal lengths of most images are from the run's, or nothing.

    Args:
        camera_of: camera index by image. known_cameras: the run's, by index; some may be missing.
    """
    known_focal = {camera: intrinsics.focal_px for camera, intrinsics in known_cameras.items()}
    known = np.array([known_focal.get(camera_of[image], np.nan) for image in model.images])
    focal = np.array([one.focal_px for one in model.intrinsics])
    diverged = np.abs(np.log(focal / known)) > np.log1p(FOCAL_TOLERANCE)  # False where none is known
    if diverged.mean() <= 0.5:
        return ""
    k = int(np.argmax(diverged))
    return f"focal length {focal[k]:.0f} px, the run's is {known[k]:.0f} px"


def find_inconsistent_poses(model: MappedModel, graph: ViewGraph, inliers: Mapping[Pair, int]) -> list[int]:
    """Positions k where ``model.images[k]`` and the next image of the sequence match but are posed far apart.

    A pair is tested if its images are consecutive and it has STRONG_PAIR_INLIERS verified matches. It is far apart
    with a rotation above MAX_TURN_DEG, or with a step above MAX_STEP_RATIO median steps and above MIN_STEP_DEPTH_RATIO
    of the median depth of what the first image sees.
    """
    lengths = _step_lengths(model, graph, inliers)
    return [k for k in lengths if _turn_deg(model, k) > MAX_TURN_DEG or _is_too_far(model, k, lengths)]


def _step_lengths(model: MappedModel, graph: ViewGraph, inliers: Mapping[Pair, int]) -> dict[int, float]:
    """How far the camera moved after position k, for every k whose image and the next are a tested pair."""
    centres = model.seg_from_cam[:, :, 3]
    return {
        k: float(np.linalg.norm(centres[k + 1] - centres[k]))
        for k, (first, second) in enumerate(pairwise(model.images))
        if graph.steps_between(first, second) == 1 and inliers.get((first, second), 0) >= STRONG_PAIR_INLIERS
    }


def _turn_deg(model: MappedModel, k: int) -> float:
    relative = model.seg_from_cam[k, :, :3].T @ model.seg_from_cam[k + 1, :, :3]
    return float(np.degrees(np.arccos(np.clip((np.trace(relative) - 1) / 2, -1, 1))))


def _is_too_far(model: MappedModel, k: int, lengths: Mapping[int, float]) -> bool:
    median = float(np.median(list(lengths.values())))
    return lengths[k] > MAX_STEP_RATIO * median and lengths[k] > MIN_STEP_DEPTH_RATIO * _median_depth(model, k)


def find_unconfirmed_poses(
    model: MappedModel, graph: ViewGraph, inliers: Mapping[Pair, int], database: pycolmap.Database
) -> list[int]:
    """The inconsistent poses without rotations that CONFIRMED_TURN_SHARE of the verified matches confirm.

    Epipolar errors do not depend on the length of a step, so they cannot confirm a long one.

    Args:
        graph: the order of the images.
        inliers: verified matches by pair. database: with the keypoints and the two-view geometries.
    """
    lengths = _step_lengths(model, graph, inliers)
    return [
        k
        for k in find_inconsistent_poses(model, graph, inliers)
        if _is_too_far(model, k, lengths) or epipolar_inlier_share(model, k, k + 1, database) < CONFIRMED_TURN_SHARE
    ]


def _median_depth(model: MappedModel, k: int) -> float:
    seen = model.tracks.point_of_observation[model.tracks.image_of_observation == model.images[k]]
    if not len(seen):
        return 0.0
    cam_from_seg = invert_rigid(model.seg_from_cam[k])
    return float(np.median(model.tracks.points_seg[seen] @ cam_from_seg[2, :3] + cam_from_seg[2, 3]))


def find_weak_links(model: MappedModel) -> list[int]:
    """Positions k such that fewer than MIN_LINK_POINTS points are seen both up to image k and after it.

    So few points hardly determine the relative rotation and scale of the two sides.
    """
    tracks = model.tracks
    position = np.searchsorted(model.images, tracks.image_of_observation)
    num_points = len(tracks.points_seg)
    first, last = np.full(num_points, len(model.images)), np.full(num_points, -1)
    np.minimum.at(first, tracks.point_of_observation, position)
    np.maximum.at(last, tracks.point_of_observation, position)
    return [k for k in range(len(model.images) - 1) if np.count_nonzero((first <= k) & (last > k)) < MIN_LINK_POINTS]


def strongly_linked_parts(model: MappedModel) -> list[list[int]]:
    """Positions of the images that hang together by pairs with MIN_LINK_POINTS common points, largest part first."""
    tracks = model.tracks
    n = len(model.images)
    position = np.searchsorted(model.images, tracks.image_of_observation)
    seen = csr_array(
        (np.ones(len(position), dtype=np.int64), (position, tracks.point_of_observation)),
        shape=(n, len(tracks.points_seg)),
    )
    common = csr_array(seen @ seen.T)
    common.data[common.data < MIN_LINK_POINTS] = 0
    common.eliminate_zeros()
    _, label = connected_components(common, directed=False)
    parts = [np.flatnonzero(label == k).tolist() for k in range(int(label.max(initial=-1)) + 1)]
    return sorted(parts, key=lambda part: -len(part))


def find_contradicted_images(model: MappedModel, inliers: Mapping[Pair, int], database: pycolmap.Database) -> list[int]:
    """Positions of the images that most of their pairs with STRONG_PAIR_INLIERS contradict, in whatever order they are.

    A pair contradicts a model where less than MIN_EPIPOLAR_INLIER_SHARE of its matches lie near their epipolar lines.

    Args:
        inliers: verified matches by pair. database: with the keypoints and the two-view geometries.
    """
    position = {image: k for k, image in enumerate(model.images)}
    contradicts: dict[int, list[bool]] = defaultdict(list)
    for (first, second), count in inliers.items():
        if count >= STRONG_PAIR_INLIERS and first in position and second in position:
            a, b = position[first], position[second]
            bad = epipolar_inlier_share(model, a, b, database) < MIN_EPIPOLAR_INLIER_SHARE
            contradicts[a].append(bad)
            contradicts[b].append(bad)
    return sorted(k for k, pairs in contradicts.items() if np.mean(pairs) > 0.5)


def find_epipolar_outliers(
    model: MappedModel, graph: ViewGraph, inliers: Mapping[Pair, int], database: pycolmap.Database
) -> list[int]:
    """Positions k such that the poses of image k and the next contradict verified matches.

    Of every pair of near images with STRONG_PAIR_INLIERS, most matches have to lie near their epipolar lines. That
    tells a wrong model from a drone's half turn at the end of a strip, where the rotation is large but the matches
    agree. Images from the two ends of a loop are never near.

    Args:
        graph: the order of the images.
        inliers: verified matches by pair. database: with the keypoints and the two-view geometries.
    """
    outliers = set()
    for a, b in near_positions(model.images, graph):
        strong = inliers.get((model.images[a], model.images[b]), 0) >= STRONG_PAIR_INLIERS
        if strong and epipolar_inlier_share(model, a, b, database) < MIN_EPIPOLAR_INLIER_SHARE:
            outliers.add(b - 1)
    return sorted(outliers)


def near_positions(images: Sequence[int], graph: ViewGraph) -> Iterator[tuple[int, int]]:
    """Positions (a, b) of images that are at most NEAR_STEPS apart in the sequence, a before b."""
    for a in range(len(images)):
        for b in range(a + 1, min(a + 1 + NEAR_STEPS, len(images))):
            if graph.steps_between(images[a], images[b]) <= NEAR_STEPS:
                yield a, b


def epipolar_inlier_share(model: MappedModel, a: int, b: int, database: pycolmap.Database) -> float:
    """Share of the verified matches of the images at positions a and b that are inliers of the relative pose."""
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
