"""Matches of SIFT features that the stitched geometry consents to.

Verification of two views by themselves accepts a pair of look-alike places, and some fifty such pairs
suffice to fold a walk round a symmetric building. Here a match must lie on the epipolar line of the
stitched cameras, within a tolerance that covers how far they may be off, and a pair most of whose
matches do not is refused as a whole. In exchange, pairs with too few matches to be verified alone are of use.
The next module to read is ``adjustment``.
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
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.geometry.so3 import skew

MIN_CONSENT = 0.4
"""Part of a pair's verified matches that must agree with the geometry; of look-alike places few do by chance."""
MIN_MATCHES = 8
"""A pair needs this many; the geometry is known, so they need not prove it."""

MIN_VERIFIED = 15
"""Matches of a pair whose geometry is not known; COLMAP's own limit."""


@dataclass(frozen=True, kw_only=True, eq=False)
class View:
    """A camera of the model: (3, 4) ``cam_from_world`` and its intrinsics at the original image size."""

    cam_from_world: FloatArray
    intrinsics: Intrinsics


@dataclass(frozen=True, kw_only=True, eq=False)
class MatchedFeatures:
    """What the run's database holds: by image index keypoints (K, 2), by pair all and the verified matches."""

    keypoints: Mapping[int, npt.NDArray[np.float32]]
    raw: Mapping[Pair, npt.NDArray[np.uint32]]
    verified: Mapping[Pair, npt.NDArray[np.uint32]]


@dataclass(frozen=True, kw_only=True, eq=False)
class Consent:
    """Matches that agree with the geometry.

    Args:
        correspondences: those that are kept.
        refused: pairs with verified matches most of which contradict the geometry, with the part that agrees.
        num_dropped: matches left out of the pairs that are kept.
    """

    correspondences: Correspondences
    refused: Mapping[Pair, float]
    num_dropped: int


def read_matched_features(database: Path, images: Collection[int]) -> MatchedFeatures:
    """Keypoints and matches of the given images (indices into the collection) in the run's database."""
    wanted = set(images)
    with open_database(database) as opened:
        keypoints = {i: _keypoints(opened, i) for i in sorted(wanted)}
        raw = _by_pair(*opened.read_all_matches(), wanted)
        pair_ids, geometries = opened.read_two_view_geometries()
        verified = _by_pair(pair_ids, [one.inlier_matches for one in geometries], wanted)
    return MatchedFeatures(keypoints=keypoints, raw=raw, verified=verified)


def _keypoints(database: pycolmap.Database, image: int) -> npt.NDArray[np.float32]:
    """(K, 2) places; an image that failed has no row in the database, and (0, 0) comes back."""
    keypoints = np.asarray(database.read_keypoints(image + 1), dtype=np.float32)
    return keypoints[:, :2] if len(keypoints) else np.empty((0, 2), np.float32)


def _by_pair(
    pair_ids: Sequence[int], matches: Sequence[npt.NDArray[np.uint32]], wanted: Collection[int]
) -> dict[Pair, npt.NDArray[np.uint32]]:
    pairs = {}
    for pair_id, rows in zip(pair_ids, matches, strict=True):
        a, b = pycolmap.pair_id_to_image_pair(pair_id)
        if a - 1 in wanted and b - 1 in wanted and len(rows):
            pairs[a - 1, b - 1] = np.asarray(rows, dtype=np.uint32).reshape(-1, 2)
    return pairs


def ask_consent(features: MatchedFeatures, views: Mapping[int, View], *, tolerance: float) -> Consent:
    """The matches that lie on the epipolar lines of ``views``.

    Verified matches with an image that has no view are kept as they are: they may place it.

    Args:
        features: of the run.
        views: by image index.
        tolerance: Sampson distance allowed, as a part of the longer image side.
    """
    seen = {i: _SeenRays.of(view, features.keypoints[i]) for i, view in views.items()}
    kept: dict[Pair, npt.NDArray[np.uint32]] = {}
    refused: dict[Pair, float] = {}
    num_dropped = 0
    for pair, raw in features.raw.items():
        verified = features.verified.get(pair)
        if pair[0] not in views or pair[1] not in views:
            if verified is not None and len(verified) >= MIN_VERIFIED:
                kept[pair] = verified
            continue
        # What verification left out of a pair is mostly wrong by little, and bends the model.
        matches = raw if verified is None else verified
        good = _on_epipolar_lines(pair, matches, seen, tolerance)
        if verified is not None and good.mean() < MIN_CONSENT:
            refused[pair] = float(good.mean())
            continue
        # Without verification, chance puts a few matches on their lines, but not so many of all.
        if good.sum() >= MIN_MATCHES and good.mean() >= MIN_CONSENT:
            kept[pair] = matches[good]
            num_dropped += int((~good).sum())
    return Consent(
        correspondences=Correspondences(keypoints=features.keypoints, matches=kept),
        refused=refused,
        num_dropped=num_dropped,
    )


def consent_shares(
    features: MatchedFeatures, views: Mapping[int, View], *, tolerance: float, min_matches: int
) -> dict[Pair, float]:
    """Which part of a pair's verified matches lies on the epipolar lines of ``views``.

    Args:
        features: of the run.
        views: by image index; pairs of which one is missing are left out.
        tolerance: as in ``ask_consent``.
        min_matches: pairs with fewer verified matches are left out.
    """
    seen = {i: _SeenRays.of(view, features.keypoints[i]) for i, view in views.items()}
    return {
        pair: float(_on_epipolar_lines(pair, rows, seen, tolerance).mean())
        for pair, rows in features.verified.items()
        if len(rows) >= min_matches and pair[0] in views and pair[1] in views
    }


@dataclass(frozen=True, kw_only=True, eq=False)
class _SeenRays:
    """What an image contributes to all of its pairs.

    Args:
        cam_from_world: (3, 4). rays: (K, 3) of its keypoints at depth 1.
        longer_side: of the image, in focal lengths.
    """

    cam_from_world: FloatArray
    rays: FloatArray
    longer_side: float

    @classmethod
    def of(cls, view: View, keypoints: npt.NDArray[np.float32]) -> _SeenRays:
        intrinsics = view.intrinsics
        return cls(
            cam_from_world=view.cam_from_world,
            rays=intrinsics.rays_cam(keypoints),
            longer_side=max(intrinsics.width, intrinsics.height) / intrinsics.focal_px,
        )


def _on_epipolar_lines(
    pair: Pair,
    matches: npt.NDArray[np.uint32],
    seen: Mapping[int, _SeenRays],
    tolerance: float,
) -> npt.NDArray[np.bool_]:
    """(M,) Sampson distance within the tolerance; for a camera that only turned every direction is a line."""
    seen_a, seen_b = (seen[index] for index in pair)
    b_from_world, world_from_a = seen_b.cam_from_world, invert_rigid(seen_a.cam_from_world)
    rotation = b_from_world[:, :3] @ world_from_a[:, :3]
    translation = b_from_world[:, :3] @ world_from_a[:, 3] + b_from_world[:, 3]
    length = np.linalg.norm(translation)
    direction = translation / length if length > 0 else np.array([1.0, 0.0, 0.0])
    essential = skew(direction) @ rotation
    a, b = seen_a.rays[matches[:, 0]], seen_b.rays[matches[:, 1]]
    line_b, line_a = a @ essential.T, b @ essential
    residual = np.abs(np.einsum("ij,ij->i", b, line_b))
    slope = np.sqrt((line_b[:, :2] ** 2).sum(axis=1) + (line_a[:, :2] ** 2).sum(axis=1))
    # Both images count alike, whichever comes first: one may be a wide angle, the other a tele lens.
    limit = tolerance * (seen_a.longer_side + seen_b.longer_side) / 2
    good: npt.NDArray[np.bool_] = residual <= limit * slope  # NaN rays, where undistortion fails, are not good
    return good
