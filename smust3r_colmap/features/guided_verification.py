"""Guided verification: matches of SIFT features that agree with known poses.

Two-view verification accepts pairs of look-alike places, and some fifty such pairs fold a walk around a symmetric
building. Here a match must lie on the epipolar line of the given cameras, within a tolerance for their error. A pair of
whose matches fewer than ``MIN_INLIER_FRACTION`` do is rejected as a whole. In return, pairs with too few matches for
two-view verification can be used. The next module to read is ``pointmap_matching``.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pycolmap

from smust3r_colmap.colmap.database import open_database
from smust3r_colmap.features.correspondences import Correspondences
from smust3r_colmap.geometry.arrays import FloatArray, Pair
from smust3r_colmap.geometry.camera import Intrinsics

MIN_INLIER_FRACTION = 0.4
"""Of a pair's verified matches, that must agree with the geometry; of look-alike places few do by chance."""
MIN_MATCHES = 8
"""Of a pair. Its geometry is known, so they need not prove it."""
MIN_VERIFIED = 15
"""Matches of a pair whose geometry is not known; COLMAP's own limit."""


@dataclass(frozen=True, kw_only=True, eq=False)
class View:
    """A camera of the model: (3, 4) ``cam_from_world`` and its intrinsics at the original image size."""

    cam_from_world: FloatArray
    intrinsics: Intrinsics


@dataclass(frozen=True, kw_only=True, eq=False)
class MatchedFeatures:
    """Of a run: keypoints (K, 2) by image index, and by pair all matches and those of two-view verification."""

    keypoints: Mapping[int, npt.NDArray[np.float32]]
    raw: Mapping[Pair, npt.NDArray[np.uint32]]
    verified: Mapping[Pair, npt.NDArray[np.uint32]]


@dataclass(frozen=True, kw_only=True, eq=False)
class VerifiedMatches:
    """Matches that agree with the geometry.

    Args:
        correspondences: these matches, and all keypoints.
        unverified: two-view verified pairs that are rejected, with the fraction of their matches that agree.
        num_outliers: matches discarded from the accepted pairs.
    """

    correspondences: Correspondences
    unverified: Mapping[Pair, float]
    num_outliers: int


def read_matched_features(database: Path, images: Collection[int]) -> MatchedFeatures:
    """Keypoints and matches of the given images (indices into the collection) in the run's database."""
    wanted = set(images)
    with open_database(database) as opened:
        keypoints = {i: _keypoints(opened, i) for i in sorted(wanted)}
        raw = _among(matches_by_pair(*opened.read_all_matches()), wanted)
        pair_ids, geometries = opened.read_two_view_geometries()
        verified = _among(matches_by_pair(pair_ids, [one.inlier_matches for one in geometries]), wanted)
    return MatchedFeatures(keypoints=keypoints, raw=raw, verified=verified)


def count_verified(database: Path) -> dict[Pair, int]:
    """Verified matches of the pairs that have ``MIN_VERIFIED``, ascending, by pair of image indices."""
    with open_database(database) as opened:
        pair_ids, counts = opened.read_two_view_geometry_num_inliers()
    pairs = (pycolmap.pair_id_to_image_pair(pair_id) for pair_id in pair_ids)
    counted = {(a - 1, b - 1): int(count) for (a, b), count in zip(pairs, counts, strict=True)}
    return {pair: counted[pair] for pair in sorted(counted) if counted[pair] >= MIN_VERIFIED}


def _keypoints(database: pycolmap.Database, image: int) -> npt.NDArray[np.float32]:
    """(K, 2) positions; for an image without a row in the database pycolmap returns (0, 0)."""
    keypoints = np.asarray(database.read_keypoints(image + 1), dtype=np.float32)
    return keypoints[:, :2] if len(keypoints) else np.empty((0, 2), np.float32)


def matches_by_pair(
    pair_ids: Sequence[int], matches: Sequence[npt.NDArray[np.uint32]]
) -> dict[Pair, npt.NDArray[np.uint32]]:
    """(M, 2) rows of keypoints by pair of image indices, of the pairs that have matches."""
    pairs = {}
    for pair_id, rows in zip(pair_ids, matches, strict=True):
        a, b = pycolmap.pair_id_to_image_pair(pair_id)
        if len(rows):
            pairs[a - 1, b - 1] = np.asarray(rows, dtype=np.uint32).reshape(-1, 2)
    return pairs


def _among(pairs: Mapping[Pair, npt.NDArray[np.uint32]], wanted: Collection[int]) -> dict[Pair, npt.NDArray[np.uint32]]:
    return {pair: rows for pair, rows in pairs.items() if pair[0] in wanted and pair[1] in wanted}


def verify_guided(features: MatchedFeatures, views: Mapping[int, View], *, tolerance: float) -> VerifiedMatches:
    """The matches that lie on the epipolar lines of ``views``.

    Verified matches with an image that has no view are kept as they are, because they can register it.

    Args:
        features: of the run.
        views: by image index.
        tolerance: of the Sampson distance, as a fraction of the longer image side.
    """
    rays = {i: _ImageRays.of(view, features.keypoints[i]) for i, view in views.items()}
    kept: dict[Pair, npt.NDArray[np.uint32]] = {}
    unverified: dict[Pair, float] = {}
    num_outliers = 0
    for pair, raw in features.raw.items():
        verified = features.verified.get(pair)
        if pair[0] not in views or pair[1] not in views:
            if verified is not None and len(verified) >= MIN_VERIFIED:
                kept[pair] = verified
            continue
        # Matches that two-view verification left out are mostly wrong by little, and bend the model.
        matches = raw if verified is None else verified
        good = _on_epipolar_lines(rays[pair[0]], rays[pair[1]], matches, tolerance)
        if verified is not None and good.mean() < MIN_INLIER_FRACTION:
            unverified[pair] = float(good.mean())
            continue
        # Without two-view verification, a few matches lie on their lines by chance, but a small fraction of all.
        if good.sum() >= MIN_MATCHES and good.mean() >= MIN_INLIER_FRACTION:
            kept[pair] = matches[good]
            num_outliers += int((~good).sum())
    return VerifiedMatches(
        correspondences=Correspondences(keypoints=features.keypoints, matches=kept),
        unverified=unverified,
        num_outliers=num_outliers,
    )


def inlier_fractions(
    features: MatchedFeatures, views: Mapping[int, View], *, tolerance: float, min_matches: int
) -> dict[Pair, float]:
    """The fraction of each pair's verified matches that lie on the epipolar lines of ``views``.

    Args:
        features: of the run.
        views: by image index; pairs with an image that has none are left out.
        tolerance: as in ``verify_guided``.
        min_matches: pairs with fewer verified matches are left out.
    """
    rays = {i: _ImageRays.of(view, features.keypoints[i]) for i, view in views.items()}
    return {
        pair: float(_on_epipolar_lines(rays[pair[0]], rays[pair[1]], rows, tolerance).mean())
        for pair, rows in features.verified.items()
        if len(rows) >= min_matches and pair[0] in views and pair[1] in views
    }


@dataclass(frozen=True, kw_only=True, eq=False)
class _ImageRays:
    """What all pairs of an image need of it.

    Args:
        cam_from_world: (3, 4).
        xy: (K, 2) of its keypoints at depth 1.
        longer_side: of the image, in focal lengths.
    """

    cam_from_world: FloatArray
    xy: FloatArray
    longer_side: float

    @classmethod
    def of(cls, view: View, keypoints: npt.NDArray[np.float32]) -> _ImageRays:
        intrinsics = view.intrinsics
        return cls(
            cam_from_world=view.cam_from_world,
            xy=intrinsics.rays_cam(keypoints)[:, :2],
            longer_side=max(intrinsics.width, intrinsics.height) / intrinsics.focal_px,
        )


def _on_epipolar_lines(
    a: _ImageRays, b: _ImageRays, matches: npt.NDArray[np.uint32], tolerance: float
) -> npt.NDArray[np.bool_]:
    """(M,) whether the Sampson distance is within the tolerance; without a baseline, a direction of it is assumed.

    False for NaN rays, where undistortion fails.
    """
    b_from_a = pycolmap.Rigid3d(b.cam_from_world) * pycolmap.Rigid3d(a.cam_from_world).inverse()
    if not b_from_a.translation.any():
        b_from_a.translation = np.array([1.0, 0.0, 0.0])
    essential = pycolmap.essential_matrix_from_pose(b_from_a)
    squared = pycolmap.compute_squared_sampson_error(a.xy[matches[:, 0]], b.xy[matches[:, 1]], essential)
    # The mean, so that the order of the images does not matter: one may be a wide angle, the other a tele lens.
    limit = tolerance * (a.longer_side + b.longer_side) / 2
    return np.asarray(np.asarray(squared) <= limit**2)
