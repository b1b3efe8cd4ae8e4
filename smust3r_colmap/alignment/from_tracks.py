"""Aligning two submodels by feature tracks: points that both saw as the same feature of the same image.

`align_tracks` needs shared images. `align_matches` joins submodels that share none, or too few, by
verified two-view matches.
The solver is behind ``seen_points``; ``from_pointmaps`` does the same for dense maps.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from smust3r_colmap.alignment.seen_points import SubmodelFit, align_seen_points
from smust3r_colmap.errors import DegenerateAlignmentError
from smust3r_colmap.estimators.robust import CAUCHY, RobustLoss
from smust3r_colmap.geometry.arrays import FloatArray, IntArray
from smust3r_colmap.geometry.groups import TransformGroup
from smust3r_colmap.products import Submodel, Tracks

MAX_SHARED_OBSERVATIONS = 5
"""Shared observations of a point pair that add to its weight."""
MAX_MATCH_RELATIVE_ERROR = 0.25
"""Residual over depth at the robust start beyond which a match counts as wrong: five times the agreement
that the start asks for. Most matches between submodels may be wrong."""
_KEY_SHIFT = np.int64(2**32)


def align_tracks(
    target: Submodel, source: Submodel, *, loss: RobustLoss = CAUCHY, group: TransformGroup = "sim3", seed: int = 0
) -> SubmodelFit:
    """Robust ``target_from_source`` from points that share an (image, feature) observation.

    Every pair of points counts once and weighs as many shared observations as it has, up to 5. With
    the redescending kernels residuals are divided by the depth (see ``seen_points``).

    Args:
        target, source: submodels with tracks.
        loss, group: as for `align_seen_points`.
        seed: of the search for a robust start.

    Raises:
        DegenerateAlignmentError: too few points are shared, or they do not determine the transform.
        ValueError: a submodel has no tracks, or its tracks name an image that is not of the submodel.
    """
    on_target, on_source = _tracks(target), _tracks(source)
    _, row_target, row_source = np.intersect1d(_keys(on_target), _keys(on_source), return_indices=True)
    return _align_point_pairs(
        target,
        source,
        on_target.point_of_observation[row_target],
        on_source.point_of_observation[row_source],
        loss=loss,
        group=group,
        evidence="shared track points",
        max_start_error=np.inf,
        seed=seed,
    )


def align_matches(
    target: Submodel,
    source: Submodel,
    *,
    image_a: npt.ArrayLike,
    feature_a: npt.ArrayLike,
    image_b: npt.ArrayLike,
    feature_b: npt.ArrayLike,
    loss: RobustLoss = CAUCHY,
    group: TransformGroup = "sim3",
    seed: int = 0,
) -> SubmodelFit:
    """Robust ``target_from_source`` from two-view matches between images of the two submodels.

    A match pairs the target's point behind (image_a, feature_a) to the source's point behind
    (image_b, feature_b); matches with a feature of no point are ignored. With the
    redescending kernels matches further than a quarter of their depth from the robust start are left
    out; they still count in ``num_correspondences`` and ``relative_residual``.

    Args:
        target, source: submodels with tracks; they need not share an image.
        image_a, feature_a: (M,) in images of the target. image_b, feature_b: (M,) in images of the source.
        loss, group: as for `align_seen_points`.
        seed: of the search for a robust start.

    Raises:
        DegenerateAlignmentError: too few points are matched, or they do not determine the transform.
        ValueError: the arrays differ in length, or a submodel has no or external tracks.
    """
    arrays = [np.asarray(values, dtype=np.int64) for values in (image_a, feature_a, image_b, feature_b)]
    if len({values.shape for values in arrays}) != 1 or arrays[0].ndim != 1:
        raise ValueError(f"matches: arrays of shapes {[values.shape for values in arrays]}, needed (M,) each")
    point_target = _points_behind(_tracks(target), arrays[0], arrays[1])
    point_source = _points_behind(_tracks(source), arrays[2], arrays[3])
    matched = (point_target >= 0) & (point_source >= 0)
    return _align_point_pairs(
        target,
        source,
        point_target[matched],
        point_source[matched],
        loss=loss,
        group=group,
        evidence="matched points",
        max_start_error=MAX_MATCH_RELATIVE_ERROR,
        seed=seed,
    )


def _align_point_pairs(
    target: Submodel,
    source: Submodel,
    point_target: IntArray,
    point_source: IntArray,
    *,
    loss: RobustLoss,
    group: TransformGroup,
    evidence: str,
    max_start_error: float,
    seed: int,
) -> SubmodelFit:
    """The fit to pairs of points, each repeated once per shared observation."""
    pairs, counts = np.unique(np.column_stack([point_target, point_source]), axis=0, return_counts=True)
    depth_target, depth_source = point_depths(target)[pairs[:, 0]], point_depths(source)[pairs[:, 1]]
    points_target, points_source = _tracks(target).points_seg[pairs[:, 0]], _tracks(source).points_seg[pairs[:, 1]]
    usable = np.isfinite(np.column_stack([depth_target, depth_source, points_target, points_source])).all(axis=1)
    try:
        return align_seen_points(
            points_source[usable],
            points_target[usable],
            np.minimum(counts, MAX_SHARED_OBSERVATIONS)[usable].astype(np.float64),
            depth_source=depth_source[usable],
            depth_target=depth_target[usable],
            loss=loss,
            group=group,
            max_start_error=max_start_error,
            seed=seed,
        )
    except DegenerateAlignmentError as error:
        raise DegenerateAlignmentError(f"submodels {target.name} and {source.name}, {evidence}: {error}") from error


def point_depths(submodel: Submodel) -> FloatArray:
    """(P,) geometric mean over its observations of each track point's z-depth, in segment units.

    Observations with the point behind the camera are ignored; NaN where none is left.

    Raises:
        ValueError: the submodel has no tracks, or they name an image that is not of the submodel.
    """
    tracks = _tracks(submodel)
    images = np.asarray(submodel.images)
    position = np.searchsorted(images, tracks.image_of_observation).clip(max=len(images) - 1)
    if (images[position] != tracks.image_of_observation).any():
        external = sorted(set(tracks.image_of_observation.tolist()) - set(submodel.images))
        raise ValueError(f"submodel {submodel.name}: tracks name images {external[:5]}, which are not of the submodel")
    pose = submodel.seg_from_cam[position]
    offset = tracks.points_seg[tracks.point_of_observation] - pose[:, :, 3]
    depth = np.einsum("ni,ni->n", pose[:, :, 2], offset)
    front = depth > 0
    point = tracks.point_of_observation[front]
    num_points = len(tracks.points_seg)
    total = np.bincount(point, weights=np.log(depth[front]), minlength=num_points)
    count = np.bincount(point, minlength=num_points)
    mean_log = np.divide(total, count, out=np.full(num_points, np.nan), where=count > 0)
    depths: FloatArray = np.exp(mean_log)
    return depths


def _tracks(submodel: Submodel) -> Tracks:
    """The tracks of a submodel that must have them."""
    if submodel.tracks is None:
        raise ValueError(f"submodel {submodel.name} has no tracks; align its pointmaps instead")
    return submodel.tracks


def _keys(tracks: Tracks) -> IntArray:
    """(M,) one number per (image, feature)."""
    return _key(tracks.image_of_observation, tracks.feature_of_observation)


def _key(image: IntArray, feature: IntArray) -> IntArray:
    """One number for image and feature; a feature is a row of a keypoint array, far below 2^32."""
    keys: IntArray = image * _KEY_SHIFT + feature
    return keys


def _points_behind(tracks: Tracks, image: IntArray, feature: IntArray) -> IntArray:
    """(N,) point of each (image, feature), -1 where it is part of none."""
    if len(tracks.point_of_observation) == 0:
        return np.full(len(image), -1, dtype=np.int64)
    keys, first = np.unique(_keys(tracks), return_index=True)
    wanted = _key(image, feature)
    row = np.searchsorted(keys, wanted).clip(max=len(keys) - 1)
    points: IntArray = np.where(keys[row] == wanted, tracks.point_of_observation[first[row]], -1)
    return points
