"""Tracks without features: corners are transferred between images by depth and cameras, then located by their pixels.

Depth maps and initial cameras are right to some pixels. A match that only repeats them adds nothing to a bundle
adjustment, so they only give a position and a warp to start from. A corner is transferred where both images' depths
agree on its surface, and its patch is then aligned to the other image. Patches that do not fit are discarded.

A track is one corner. It is exact where it was detected; in all other images it is an aligned position. Keypoints that
were found are transferred to the next images instead of detecting new ones, which makes tracks long.
Coordinates are pixels of the grey image until they are returned. The next module to read is ``patch_alignment``.
"""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
import pycolmap
from scipy.spatial import cKDTree

from smust3r_colmap.estimators.robust import MAD_TO_SIGMA
from smust3r_colmap.features.correspondences import Correspondences
from smust3r_colmap.features.patch_alignment import (
    MAX_STRETCH,
    MIN_CORRELATION,
    PATCH_RADIUS_PX,
    align_patches,
    num_levels,
)
from smust3r_colmap.geometry.arrays import BoolArray, Float32Array, FloatArray, IntArray, Pair, UInt8Array
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.geometry.depth_noise import VIEW_AGREEMENT, WINDOW_PIXELS
from smust3r_colmap.geometry.sim3 import invert_rigid

logger = logging.getLogger(__name__)

CACHED_VIEWS = 32
"""Images in memory at a time, at 4/3 bytes a pixel; more than the partners of most images, so that a sequence reads
each image once."""
CANDIDATES_PER_CORNER = 4
"""Corners that are examined for each one needed, because some lie on no surface."""
MAX_KEYPOINTS_FACTOR = 2
"""On the number of corners of an image: the limit of its keypoints, with those transferred from other images."""
KEYPOINTS_LIMIT = 16_000
"""Of an image; OpenCV's remap takes at most twice as many patches at once."""
MAX_SIDE_PX = 32_766
"""Of a grey image, for the same reason."""
WIDE_SEARCH_FRACTION = 0.04
"""Search radius around the position by the initial cameras, as a fraction of the longer side: 26 px of 640. Cameras
that are off by 5 cm and half a degree move a point at 2 m by 20 px."""
NARROW_SEARCH_FRACTION = 0.01
"""The same once the relative pose of the two images is estimated; the rest is the error of depth."""
SAMPLE_CORNERS = 200
"""From which a relative pose is estimated."""
MIN_POSE_INLIERS = 15
"""Corners that must support it; COLMAP's minimum of a pair."""
MIN_POSE_INLIER_FRACTION = 0.4
"""Of the corners that were found: look-alike surfaces correlate here and there, without a common motion."""
CORNER_WINDOW_PX = 5
"""Side of the window of gradients of a corner."""
MIN_CORNER_DISTANCE_PX = 4
"""Between corners of an image; nearer ones share most of their patch."""
MIN_GRADIENT = 2.0
"""Grey levels per pixel (rms over the window) along the weaker direction of a corner. Noise and JPEG give about 1; from
2 on, a patch is located to a tenth of a pixel."""
MERGE_PX = 0.75
"""Positions nearer than this to a keypoint are this keypoint."""
MAX_SIGMAS = 3.0
"""Robust standard deviations of a pair, within which its depths agree, and its matches agree with its depths."""
MIN_REPROJECTION_TOLERANCE_PX = 1.5
"""Lower limit of the latter: matches of an exact pair are not limited to its rounding errors."""
DEPTH_TOLERANCE_RANGE = (VIEW_AGREEMENT, 5 * VIEW_AGREEMENT)
"""Limits of the former, relative: exact maps still differ by rounding at slanted surfaces, and where most of a pair
disagrees, the deviation says nothing."""
SURFACE_SAMPLES = 5
"""Along each side of a patch, that a plane is fitted to: 25 give a slope that is good enough for a warp."""
MAX_ROUND_TRIP_MAP_PX = 1.5
"""Distance in pixels of the depth map after a transfer there and back; neighbouring pixels differ by as much."""
MIN_SURFACE_FRACTION = 0.6
"""Of the pixels around a corner, that must lie on its surface; with less it is an occluding edge."""


# -------------------------------------------------------------------------------- input
@dataclass(frozen=True, kw_only=True, eq=False)
class MappedView:
    """An image with its camera, and functions that read its pixels and its depth.

    The three arrays cover the whole (distorted) image, each uniformly resized. Corners are located in the grey one, so
    its size is a choice between accuracy and time.

    Args:
        index: of the image in the collection.
        cam_from_world: (3, 4) rigid.
        intrinsics: at the size that keypoints are wanted in, in any camera model.
        depth: reads (h, w) z-depth in units of the world; 0, negative or not finite where there is none.
        confidence: reads (h, w), at least 1.
        grey: reads (H, W) uint8.

    Raises:
        ValueError: the pose is not (3, 4) and finite.
    """

    index: int
    cam_from_world: FloatArray
    intrinsics: Intrinsics
    depth: Callable[[], Float32Array]
    confidence: Callable[[], Float32Array]
    grey: Callable[[], UInt8Array]

    def __post_init__(self) -> None:
        if self.cam_from_world.shape != (3, 4) or not np.isfinite(self.cam_from_world).all():
            raise ValueError(f"MappedView {self.index}: pose {self.cam_from_world.shape}, needed (3, 4), finite")


@dataclass(frozen=True, kw_only=True, eq=False)
class _Camera:
    """Pose and intrinsics of a view, at the size of its grey image."""

    cam_from_world: FloatArray  # (3, 4)
    intrinsics: Intrinsics

    def fraction_px(self, fraction: float) -> float:
        """A fraction of the longer side in pixels."""
        return fraction * max(self.intrinsics.width, self.intrinsics.height)

    def xy_img(self, points_world: FloatArray) -> FloatArray:
        """(K, 2) of points (K, 3); NaN behind the camera."""
        return self.intrinsics.xy_img(points_world @ self.cam_from_world[:, :3].T + self.cam_from_world[:, 3])

    def points_world(self, xy_img: FloatArray, inverse_depth: FloatArray) -> FloatArray:
        """(K, 3) of pixels (K, 2) at the inverse depths (K,); NaN where either is."""
        points_cam = self.intrinsics.rays_cam(xy_img) / inverse_depth[:, None]
        world_from_cam = invert_rigid(self.cam_from_world)
        points: FloatArray = points_cam @ world_from_cam[:, :3].T + world_from_cam[:, 3]
        return points

    def depth(self, points_world: FloatArray) -> FloatArray:
        """(K,) z of points (K, 3)."""
        z: FloatArray = points_world @ self.cam_from_world[2, :3] + self.cam_from_world[2, 3]
        return z

    def sees(self, points_world: FloatArray, xy_img: FloatArray) -> BoolArray:
        """(K,) whether points (K, 3) are seen at (K, 2), within the typical error of these points."""
        return _within_typical_error(
            np.linalg.norm(self.xy_img(points_world) - xy_img, axis=1),
            MIN_REPROJECTION_TOLERANCE_PX,
            self.fraction_px(NARROW_SEARCH_FRACTION),
        )

    def holds(self, xy_img: FloatArray) -> BoolArray:
        """(K,) whether the patch at (K, 2) lies within the image; false where a coordinate is NaN."""
        size = np.array([self.intrinsics.width, self.intrinsics.height])
        margin = PATCH_RADIUS_PX + 1
        inside: BoolArray = np.all((xy_img >= margin) & (xy_img <= size - margin), axis=1)
        return inside


@dataclass(frozen=True, kw_only=True, eq=False)
class _View:
    """A ``MappedView`` in memory.

    Args:
        index: of the image in the collection.
        camera: at the size of the grey image.
        pyramid: the grey image and its halves.
        inverse_depth: (h, w) float32, NaN where there is no confident depth.
    """

    index: int
    camera: _Camera
    pyramid: tuple[UInt8Array, ...]
    inverse_depth: Float32Array

    @property
    def map_px_per_px(self) -> FloatArray:
        """(2,) pixels of the depth map per pixel of the grey image, along x and y."""
        height, width = self.inverse_depth.shape
        return np.array([width / self.camera.intrinsics.width, height / self.camera.intrinsics.height])


def _within_typical_error(errors: FloatArray, least: float, most: float) -> BoolArray:
    """(K,) which errors (K,) are within ``MAX_SIGMAS`` robust standard deviations, from ``least`` to ``most``."""
    finite = errors[np.isfinite(errors)]
    sigma = MAD_TO_SIGMA * np.median(finite) if len(finite) else 0.0
    return np.asarray(errors <= np.clip(MAX_SIGMAS * sigma, least, most))


def _read(view: MappedView, min_confidence: float) -> _View:
    grey, depth, confidence = view.grey(), view.depth(), view.confidence()
    if grey.ndim != 2 or grey.dtype != np.uint8:
        raise ValueError(f"image {view.index}: grey is {grey.shape} {grey.dtype}, needed (H, W) uint8")
    if max(grey.shape) > MAX_SIDE_PX:
        raise ValueError(f"image {view.index}: grey is {grey.shape}, at most {MAX_SIDE_PX} a side; give it resized")
    if depth.ndim != 2 or depth.shape != confidence.shape:
        raise ValueError(
            f"image {view.index}: depth is {depth.shape}, confidence {confidence.shape}, needed one (h, w)"
        )
    usable = np.isfinite(depth) & (depth > 0) & (confidence >= min_confidence)
    height, width = grey.shape
    camera = _Camera(cam_from_world=view.cam_from_world, intrinsics=view.intrinsics.resized(width, height))
    pyramid = [grey]
    while (
        len(pyramid) < num_levels(camera.fraction_px(WIDE_SEARCH_FRACTION))
        and min(pyramid[-1].shape) > 4 * PATCH_RADIUS_PX
    ):
        pyramid.append(np.asarray(cv2.pyrDown(pyramid[-1]), dtype=np.uint8))
    return _View(
        index=view.index,
        camera=camera,
        pyramid=tuple(pyramid),
        inverse_depth=np.where(usable, 1 / np.where(usable, depth, 1), np.nan).astype(np.float32),
    )


# ------------------------------------------------------------------------------ matching
def match_by_pointmaps(
    views: Sequence[MappedView], pairs: Sequence[Pair], *, max_keypoints: int, min_confidence: float = 2.0
) -> Correspondences:
    """Mutual, depth-consistent correspondences between images, located by their pixels.

    Images are visited in order. Each gets corners where it has no keypoint yet. All its keypoints are searched in every
    image that it forms a pair with and that does not have them:

    - The relative pose of the two images is estimated, within ``WIDE_SEARCH_FRACTION`` of the initial cameras
      (``_estimated_camera``); without enough inliers the pair gets no matches.
    - Depth gives the position. The other image must have the same depth there, within ``MAX_SIGMAS`` deviations of the
      pair and ``DEPTH_TOLERANCE_RANGE``, and its own depth must lead back to within ``MAX_ROUND_TRIP_MAP_PX``.
    - The patch, warped by the slope of the surface, is aligned to the other image (``align_patches``). Its correlation
      must reach ``MIN_CORRELATION``, and its position must agree with depth as for most of the pair and within
      ``NARROW_SEARCH_FRACTION``.
    - A position within ``MERGE_PX`` of a keypoint is this keypoint, and two tracks become one.

    In the end a pair is matched wherever both images have a keypoint of one track, and each image's depth gives its
    position in the other; a keypoint is matched once at most. At most ``CACHED_VIEWS`` images are in memory.

    Args:
        views: images by distinct index.
        pairs: (i, j) of image indices with i < j; only these are compared and matched. Repeats count once.
        max_keypoints: corners of an image; as many can be transferred from others.
        min_confidence: of depth that is used; 1 is none.

    Returns:
        Keypoints of all views, without unmatched ones, and matches of the pairs that have any.

    Raises:
        ValueError: two views have one index, a pair is not ascending or names no view, ``max_keypoints`` is not
            within 1 to ``KEYPOINTS_LIMIT``, or an array has another shape or type than stated.
    """
    view_of = _by_index(views, pairs, max_keypoints)
    partners = defaultdict(set)
    for i, j in pairs:
        partners[i].add(j)
        partners[j].add(i)
    read = lru_cache(maxsize=CACHED_VIEWS)(lambda index: _read(view_of[index], min_confidence))
    tracks = _Tracks(MAX_KEYPOINTS_FACTOR * max_keypoints)
    px_per_grey_px = {index: np.ones(2) for index in view_of}
    for i in sorted(partners):
        view = read(i)
        px_per_grey_px[i] = np.divide(_size(view_of[i].intrinsics), _size(view.camera.intrinsics))
        tracks.start(view, _new_corners(view, tracks.of(i).xy, max_keypoints))
        for j in sorted(partners[i]):
            _transfer_tracks(tracks, view, read(j))
    found = _correspondences(tracks, px_per_grey_px, sorted(set(pairs)))
    logger.info("%d matches of %d pairs by pointmaps", found.num_matches, len(found.matches))
    return found


def _by_index(views: Sequence[MappedView], pairs: Sequence[Pair], max_keypoints: int) -> dict[int, MappedView]:
    view_of = {view.index: view for view in views}
    if len(view_of) != len(views):
        raise ValueError(f"match_by_pointmaps: {len(views)} views have {len(view_of)} indices")
    for i, j in pairs:
        if not i < j or i not in view_of or j not in view_of:
            raise ValueError(f"match_by_pointmaps: pair ({i}, {j}) is not ascending or names no view")
    if not 1 <= max_keypoints <= KEYPOINTS_LIMIT:
        raise ValueError(f"match_by_pointmaps: max_keypoints is {max_keypoints}, needed 1 to {KEYPOINTS_LIMIT}")
    return view_of


def _size(intrinsics: Intrinsics) -> tuple[int, int]:
    return intrinsics.width, intrinsics.height


def _correspondences(
    tracks: _Tracks, px_per_grey_px: Mapping[int, FloatArray], pairs: Sequence[Pair]
) -> Correspondences:
    """The matches, and their keypoints at the size of the intrinsics."""
    matches = {(i, j): tracks.matched(i, j) for i, j in pairs}
    matches = {pair: rows for pair, rows in matches.items() if len(rows)}
    used = {index: np.zeros(len(tracks.of(index)), dtype=bool) for index in px_per_grey_px}
    for pair, rows in matches.items():
        for index, column in zip(pair, rows.T, strict=True):
            used[index][column] = True
    new_row = {index: np.cumsum(flags) - 1 for index, flags in used.items()}
    return Correspondences(
        keypoints={
            index: (tracks.of(index).xy[flags] * px_per_grey_px[index]).astype(np.float32)
            for index, flags in used.items()
        },
        matches={
            (i, j): np.stack([new_row[i][rows[:, 0]], new_row[j][rows[:, 1]]], axis=1).astype(np.uint32)
            for (i, j), rows in matches.items()
        },
    )


# ------------------------------------------------------------------------------- corners
def _new_corners(view: _View, known_xy: FloatArray, max_keypoints: int) -> FloatArray:
    """(K, 2) centres of pixels that are corners on a surface, away from the known keypoints (M, 2).

    At most so many that the image has ``max_keypoints``.
    """
    wanted = max(0, max_keypoints - len(known_xy))
    strength = _corner_strength(view.pyramid[0])
    around = np.ones((2 * MIN_CORNER_DISTANCE_PX - 1, 2 * MIN_CORNER_DISTANCE_PX - 1), np.uint8)
    peaks = (strength >= np.maximum(cv2.dilate(strength, around), MIN_GRADIENT**2)).astype(np.uint8)
    for x, y in known_xy:
        cv2.circle(peaks, (int(x), int(y)), MIN_CORNER_DISTANCE_PX, 0, thickness=-1)
    rows, columns = np.nonzero(peaks)
    xy: FloatArray = np.stack([columns, rows], axis=1).astype(np.float64) + 0.5
    map_columns, map_rows = (xy * view.map_px_per_px).astype(np.int64).T
    usable = view.camera.holds(xy) & np.isfinite(view.inverse_depth[map_rows, map_columns])
    xy = xy[usable]

    cell_side = np.sqrt(strength.size / max_keypoints)
    spread = xy[
        _evenly_ordered(xy, strength[rows, columns][usable], known_xy, cell_side)[: CANDIDATES_PER_CORNER * wanted]
    ]
    chosen: FloatArray = spread[np.isfinite(_surface_at(view, spread).inverse_depth)][:wanted]
    return chosen


def _evenly_ordered(xy: FloatArray, strength: Float32Array, known_xy: FloatArray, cell_side: float) -> IntArray:
    """(K,) the order in which to take points: the strongest of each empty square cell, then all second ones, and so on.

    This spreads them evenly without reserving any for cells without corners.

    Args:
        xy: (K, 2). strength: (K,).
        known_xy: (M, 2) points that exist already; each counts as one taken from its cell.
        cell_side: in pixels.
    """
    both = np.concatenate([known_xy, xy])
    is_new = np.arange(len(both)) >= len(known_xy)
    strengths = np.concatenate([np.zeros(len(known_xy)), strength])
    cell = np.unique(both // cell_side, axis=0, return_inverse=True)[1].ravel()
    by_cell = np.lexsort((-strengths, is_new, cell))
    turn = np.empty(len(both), np.int64)
    turn[by_cell] = np.arange(len(both)) - np.searchsorted(cell[by_cell], cell[by_cell])
    return np.lexsort((-strength, turn[is_new]))


def _corner_strength(grey: UInt8Array) -> Float32Array:
    """(H, W) mean squared gradient along the direction where it is smaller, in squared grey levels per pixel.

    Source: Shi and Tomasi 1994, "Good Features to Track".
    """
    # OpenCV sums, not averages, and scales Sobel's derivative (8 per grey level per pixel) by 1 / (4 * block * 255).
    per_unit = (4 * CORNER_WINDOW_PX * 255 / 8) ** 2 / CORNER_WINDOW_PX**2
    return np.asarray(cv2.cornerMinEigenVal(grey, CORNER_WINDOW_PX, ksize=3) * per_unit, dtype=np.float32)


# ------------------------------------------------------------------------------ surfaces
@dataclass(frozen=True, kw_only=True, eq=False)
class _Surface:
    """The plane at each of K pixels; NaN where there is none.

    Args:
        inverse_depth: (K,) at the pixel. slope: (K, 2) its change per pixel of the grey image.
    """

    inverse_depth: FloatArray
    slope: FloatArray


def _surface_at(view: _View, xy: FloatArray) -> _Surface:
    """Planes fitted to the depth map under a patch, by least squares in inverse depth, which is linear on a plane.

    Pixels of another surface are left out. If they are too many, the result is NaN.
    """
    zoom = view.map_px_per_px
    radius = max(2.0, PATCH_RADIUS_PX * zoom.max())
    along = np.round(np.linspace(-radius, radius, SURFACE_SAMPLES)).astype(np.int64)
    window = np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)
    xy_map = np.where(np.isfinite(xy), xy, -1e6) * zoom
    pixels = np.floor(xy_map).astype(np.int64)[:, None] + window  # (K, P, 2)
    height, width = view.inverse_depth.shape
    inside = np.asarray(((pixels >= 0) & (pixels < (width, height))).all(axis=-1))
    columns, rows = np.moveaxis(np.where(inside[..., None], pixels, 0), -1, 0)
    values = np.where(inside, view.inverse_depth[rows, columns], np.nan)
    middle = values[:, len(window) // 2, None]
    same = np.asarray(np.abs(values - middle) < WINDOW_PIXELS * middle)
    enough = np.asarray(same.mean(axis=1) >= MIN_SURFACE_FRACTION)

    terms = np.concatenate([np.ones((*same.shape, 1)), pixels + 0.5 - xy_map[:, None]], axis=-1)[enough]
    weighted = terms * same[enough, :, None]
    normal = np.swapaxes(weighted, 1, 2) @ terms
    right = np.swapaxes(weighted, 1, 2) @ np.where(same, values, 0)[enough, :, None]
    plane = np.full((len(xy), 3), np.nan)
    plane[enough] = np.linalg.solve(normal, right)[..., 0]
    return _Surface(inverse_depth=plane[:, 0], slope=plane[:, 1:] * zoom)


# -------------------------------------------------------------------------------- tracks
@dataclass(frozen=True, kw_only=True, eq=False)
class _Keypoints:
    """Of one image, K of them.

    Args:
        xy: (K, 2) in the grey image.
        points_world: (K, 3) by the image's own depth.
        tangents_world: (K, 2, 3) derivative of the point along the surface, per pixel in x and y.
        track: (K,) number of the track, before unions.
    """

    xy: FloatArray
    points_world: FloatArray
    tangents_world: FloatArray
    track: IntArray

    def __len__(self) -> int:
        return len(self.xy)

    def taken(self, rows: IntArray | BoolArray) -> _Keypoints:
        """Some rows."""
        return _Keypoints(
            xy=self.xy[rows],
            points_world=self.points_world[rows],
            tangents_world=self.tangents_world[rows],
            track=self.track[rows],
        )

    def followed_by(self, more: _Keypoints) -> _Keypoints:
        """These rows, then those."""
        return _Keypoints(
            xy=np.concatenate([self.xy, more.xy]),
            points_world=np.concatenate([self.points_world, more.points_world]),
            tangents_world=np.concatenate([self.tangents_world, more.tangents_world]),
            track=np.concatenate([self.track, more.track]),
        )


_NO_KEYPOINTS = _Keypoints(
    xy=np.empty((0, 2)),
    points_world=np.empty((0, 3)),
    tangents_world=np.empty((0, 2, 3)),
    track=np.empty(0, np.int64),
)


def _keypoints_at(view: _View, xy: FloatArray, track: IntArray) -> _Keypoints:
    """Keypoints on the view's own surface; NaN where it has none."""
    surface = _surface_at(view, xy)
    points = view.camera.points_world(xy, surface.inverse_depth)
    beside = [view.camera.points_world(xy + step, surface.inverse_depth + surface.slope @ step) for step in np.eye(2)]
    return _Keypoints(
        xy=xy, points_world=points, tangents_world=np.stack(beside, axis=1) - points[:, None], track=track
    )


class _Tracks:
    """Keypoints of all images while tracks grow.

    Tracks of the same point are united in a disjoint-set forest, because ``roots`` is needed between two unions;
    ``scipy.sparse.csgraph.connected_components`` takes the complete graph.
    """

    def __init__(self, max_per_image: int) -> None:
        self._max_per_image = max_per_image
        self._keypoints: dict[int, _Keypoints] = {}
        self._cameras: dict[Pair, _Camera] = {}
        self._parent = np.empty(0, np.int64)

    def of(self, image: int) -> _Keypoints:
        """Keypoints of an image so far."""
        return self._keypoints.get(image, _NO_KEYPOINTS)

    def roots(self, image: int) -> IntArray:
        """(K,) the track of each keypoint, unions included."""
        roots = self.of(image).track
        while True:
            above = self._parent[roots]
            if (above == roots).all():
                return roots
            roots = above

    def start(self, view: _View, xy: FloatArray) -> None:
        """New corners (K, 2) of an image, each a track of its own."""
        tracks = len(self._parent) + np.arange(len(xy))
        self._parent = np.concatenate([self._parent, tracks])
        self.add(view, _keypoints_at(view, xy, tracks))

    def add(self, view: _View, keypoints: _Keypoints) -> None:
        """Append to the keypoints of an image those that lie on its surface, as long as there is room."""
        known = self.of(view.index)
        on_surface = np.flatnonzero(np.isfinite(keypoints.tangents_world).all(axis=(1, 2)))
        room = self._max_per_image - len(known)
        self._keypoints[view.index] = known.followed_by(keypoints.taken(on_surface[:room]))

    def unite(self, track_a: IntArray, track_b: IntArray) -> None:
        """Unite the tracks (K,) with the tracks (K,), one by one."""
        for a, b in zip(track_a, track_b, strict=True):
            self._parent[self._root(a)] = self._root(b)

    def _root(self, track: int) -> int:
        while self._parent[track] != track:
            track = int(self._parent[track])
        return track

    def missing(self, a: int, b: int) -> _Keypoints:
        """Keypoints of image a whose track is not in image b."""
        return self.of(a).taken(~np.isin(self.roots(a), self.roots(b)))

    def shared(self, a: int, b: int) -> IntArray:
        """(M, 2) rows of two images on one track, one to one."""
        _, rows_a, rows_b = np.intersect1d(self.roots(a), self.roots(b), return_indices=True)
        return np.stack([rows_a, rows_b], axis=1)

    def store_camera(self, a: int, b: int, camera_b: _Camera) -> None:
        """Store the camera of image b that was estimated from points of image a."""
        self._cameras[a, b] = camera_b

    def matched(self, i: int, j: int) -> IntArray:
        """(M, 2) of the shared rows, those at the position by each image's depth in the other."""
        if (i, j) not in self._cameras or (j, i) not in self._cameras:
            return np.empty((0, 2), np.int64)
        rows = self.shared(i, j)
        in_i, in_j = self.of(i).taken(rows[:, 0]), self.of(j).taken(rows[:, 1])
        near_j = self._cameras[i, j].sees(in_i.points_world, in_j.xy)
        near_i = self._cameras[j, i].sees(in_j.points_world, in_i.xy)
        return rows[near_i & near_j]


# ------------------------------------------------------------------------------ transfer
def _transfer_tracks(tracks: _Tracks, view_a: _View, view_b: _View) -> None:
    """Find in image b the keypoints of image a that b does not have yet, if their relative pose can be estimated."""
    camera_b = _estimated_camera(tracks, view_a, view_b)
    if camera_b is None:
        logger.debug("images %d and %d show no common motion", view_a.index, view_b.index)
        return
    tracks.store_camera(view_a.index, view_b.index, camera_b)
    in_a = tracks.missing(view_a.index, view_b.index)
    transferred = _transferred(in_a, view_a, view_b, camera_b)
    found = _found(in_a, transferred.taken(transferred.is_mutual), view_a, view_b, NARROW_SEARCH_FRACTION)
    found = found.taken(camera_b.sees(in_a.points_world[found.rows], found.xy_b))
    _attach(tracks, view_a, view_b, in_a, found)


def _estimated_camera(tracks: _Tracks, view_a: _View, view_b: _View) -> _Camera | None:
    """The camera of b by the points of a, because initial cameras are right to some pixels only.

    It is estimated from shared tracks. If there are too few, a sample of corners is searched in the wide radius. None
    if too few of them agree: the initial geometry is wrong here, or the images do not overlap.
    """
    if len(tracks.of(view_a.index)) < MIN_POSE_INLIERS:
        return None
    shared = tracks.shared(view_a.index, view_b.index)
    points_world = tracks.of(view_a.index).points_world[shared[:, 0]]
    xy_b = tracks.of(view_b.index).xy[shared[:, 1]]
    if len(shared) < SAMPLE_CORNERS // 2:
        in_a = tracks.missing(view_a.index, view_b.index)
        transferred = _transferred(in_a, view_a, view_b, view_b.camera)
        transferred = transferred.taken(transferred.is_near)
        found = _found(
            in_a,
            transferred.taken(_spread(len(transferred.rows), SAMPLE_CORNERS)),
            view_a,
            view_b,
            WIDE_SEARCH_FRACTION,
        )
        points_world = np.concatenate([points_world, in_a.points_world[found.rows]])
        xy_b = np.concatenate([xy_b, found.xy_b])
    few = _spread(len(xy_b), SAMPLE_CORNERS)
    return _resected(view_b.camera, points_world[few], xy_b[few])


def _spread(length: int, number: int) -> IntArray:
    """At most so many of the positions below a length, evenly spaced."""
    return np.linspace(0, length - 1, min(number, length)).astype(np.int64)


def _resected(camera: _Camera, points_world: FloatArray, xy_img: FloatArray) -> _Camera | None:
    """The camera at the pose that sees points (K, 3) at (K, 2); None if there are too few inliers."""
    if len(xy_img) < MIN_POSE_INLIERS:
        return None
    ransac = {"max_error": camera.fraction_px(NARROW_SEARCH_FRACTION), "max_num_trials": 1000, "random_seed": 0}
    found = pycolmap.estimate_and_refine_absolute_pose(
        xy_img,
        points_world,
        camera.intrinsics.colmap_camera(),
        estimation_options=pycolmap.AbsolutePoseEstimationOptions(ransac=ransac),
    )
    if found is None or found["num_inliers"] < max(MIN_POSE_INLIERS, MIN_POSE_INLIER_FRACTION * len(xy_img)):
        return None
    return replace(camera, cam_from_world=found["cam_from_world"].matrix())


@dataclass(frozen=True, kw_only=True, eq=False)
class _Transferred:
    """K keypoints of image a at their positions by depth in image b.

    Args:
        rows: (K,) of the keypoints of a.
        xy_b: (K, 2) positions in b.
        b_from_a: (K, 2, 2) warp of the patch.
        depth_difference: (K,) between the depths of a and b, relative.
        missed_map_px: (K,) distance after a transfer there and back by b's depth, in pixels of a's depth map.
    """

    rows: IntArray
    xy_b: FloatArray
    b_from_a: FloatArray
    depth_difference: FloatArray
    missed_map_px: FloatArray

    def taken(self, chosen: IntArray | BoolArray) -> _Transferred:
        """Some of them."""
        return _Transferred(
            rows=self.rows[chosen],
            xy_b=self.xy_b[chosen],
            b_from_a=self.b_from_a[chosen],
            depth_difference=self.depth_difference[chosen],
            missed_map_px=self.missed_map_px[chosen],
        )

    @property
    def is_near(self) -> BoolArray:
        """(K,) whether the depths can be of one surface, before the camera is estimated."""
        return self.depth_difference <= DEPTH_TOLERANCE_RANGE[1]

    @property
    def is_mutual(self) -> BoolArray:
        """(K,) whether the depths agree within their typical error in this pair, and lead back."""
        return _within_typical_error(self.depth_difference, *DEPTH_TOLERANCE_RANGE) & (
            self.missed_map_px <= MAX_ROUND_TRIP_MAP_PX
        )


def _transferred(in_a: _Keypoints, view_a: _View, view_b: _View, camera_b: _Camera) -> _Transferred:
    """To image b with the camera ``camera_b``, and back by the depth of b; positions outside of b are left out."""
    xy_b = camera_b.xy_img(in_a.points_world)
    beside = camera_b.xy_img((in_a.points_world[:, None] + in_a.tangents_world).reshape(-1, 3)).reshape(-1, 2, 2)
    b_from_a = np.swapaxes(beside - xy_b[:, None], 1, 2)
    inverse_depth = _surface_at(view_b, xy_b).inverse_depth
    back = view_a.camera.xy_img(camera_b.points_world(xy_b, inverse_depth))
    rows = np.flatnonzero(camera_b.holds(xy_b) & np.isfinite(inverse_depth) & _comparable(b_from_a))
    everything = _Transferred(
        rows=np.arange(len(in_a)),
        xy_b=xy_b,
        b_from_a=b_from_a,
        depth_difference=np.abs(camera_b.depth(in_a.points_world) * inverse_depth - 1),
        missed_map_px=np.linalg.norm((back - in_a.xy) * view_a.map_px_per_px, axis=1),
    )
    return everything.taken(rows)


def _comparable(b_from_a: FloatArray) -> BoolArray:
    """(K,) whether a warp neither mirrors nor stretches beyond ``MAX_STRETCH``; false for NaN."""
    finite = np.asarray(np.isfinite(b_from_a).all(axis=(1, 2)))
    safe = np.where(finite[:, None, None], b_from_a, 0)
    stretch = np.linalg.svd(safe, compute_uv=False)
    alike = (stretch[:, 0] <= MAX_STRETCH) & (stretch[:, 1] >= 1 / MAX_STRETCH) & (np.linalg.det(safe) > 0)
    return np.asarray(alike)


# ------------------------------------------------------------------------------- finding
@dataclass(frozen=True, kw_only=True, eq=False)
class _Found:
    """Keypoints of image a found in image b, best first: (K,) rows and (K, 2) positions in b."""

    rows: IntArray
    xy_b: FloatArray

    def taken(self, chosen: BoolArray) -> _Found:
        """Some of them."""
        return _Found(rows=self.rows[chosen], xy_b=self.xy_b[chosen])


def _found(in_a: _Keypoints, transferred: _Transferred, view_a: _View, view_b: _View, fraction: float) -> _Found:
    """The transferred keypoints whose patch is found in image b within a fraction of its side; each position once."""
    aligned = align_patches(
        view_a.pyramid,
        in_a.xy[transferred.rows],
        view_b.pyramid,
        transferred.xy_b,
        transferred.b_from_a,
        reach_px=view_b.camera.fraction_px(fraction),
    )
    order = np.argsort(-aligned.correlation, kind="stable")
    order = order[(aligned.correlation[order] >= MIN_CORRELATION) & view_b.camera.holds(aligned.xy_b[order])]
    order = order[_first_in_place(aligned.xy_b[order])]
    return _Found(rows=transferred.rows[order], xy_b=aligned.xy_b[order])


def _first_in_place(xy: FloatArray) -> BoolArray:
    """(K,) false for points that have an earlier one within ``MERGE_PX``."""
    first = np.ones(len(xy), dtype=bool)
    if len(xy):
        for a, b in sorted(cKDTree(xy).query_pairs(MERGE_PX)):
            first[b] &= not first[a]
    return first


def _attach(tracks: _Tracks, view_a: _View, view_b: _View, in_a: _Keypoints, found: _Found) -> None:
    """Unite what lies on a keypoint of image b with its track; the others are new keypoints of b."""
    new = _keypoints_at(view_b, found.xy_b, in_a.track[found.rows])
    known = tracks.of(view_b.index)
    if len(known) and len(new):
        distance, row = cKDTree(known.xy).query(new.xy, distance_upper_bound=MERGE_PX)
        on_known = np.isfinite(distance)
        row, first = np.unique(row[on_known], return_index=True)
        track_a, track_b = new.track[on_known][first], tracks.roots(view_b.index)[row]
        # A keypoint of b that has another partner in a keeps it.
        free = ~np.isin(track_b, tracks.roots(view_a.index))
        tracks.unite(track_a[free], track_b[free])
        new = new.taken(~on_known)
    tracks.add(view_b, new)
