"""Depth maps of a run made to fit an adjusted model: in its undistorted views, its unit, and only where views agree.

A backbone's maps cover the distorted originals and are in the unit of the stitched world. Bundle adjustment
has moved that world a little, here more and there less. So every map is warped into the undistorted view,
multiplied by the factor that puts it on the sparse points which its image observes, and compared with the
maps of images that see the same points; depth that none of them confirms is dropped.
The next modules to read are ``exporters.dense_workspace`` and ``exporters.training_dataset``.
"""

from __future__ import annotations

import logging
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pycolmap
from scipy import sparse

from smust3r_colmap.colmap.reconstruction import SparseObservations
from smust3r_colmap.errors import InputError
from smust3r_colmap.estimators.robust import weighted_median
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.camera import Intrinsics, pixel_centres
from smust3r_colmap.geometry.depth_noise import ADJACENT_PIXELS, VIEW_AGREEMENT
from smust3r_colmap.products import DepthMaps

logger = logging.getLogger(__name__)

FloatMap = npt.NDArray[np.float32]
AnyFloats = npt.NDArray[np.floating[Any]]

MIN_SCALE_POINTS = 12
"""Sparse points on an image's map from which on it has a scale of its own; the median of fewer is too uncertain."""
MAX_SCALE_RATIO = 1.5
"""An image whose factor differs from the model's by more is rejected: the adjustment moves cameras by percents."""
CHECK_NEIGHBOURS = 8
"""Views that may confirm a depth."""
MIN_CONFIRMATIONS = 2
"""Views that must confirm it, or all where there are fewer. On an indoor sequence with a depth sensor, pixels
within 5 % of it were 80 % without the test (75 % of the sensor's pixels covered), 85 % of those that one view
confirms (66 %), and 88 % of those that two confirm (57 %)."""
FULL_PARALLAX_DEG = 5.0
"""Median angle at the shared points from which on neighbours count in full; views from nearly the same place
have the same errors and confirm anything."""
CANDIDATES_PER_NEIGHBOUR = 3
"""Views with most shared points whose parallax is looked at, for each neighbour wanted."""
CACHE_BYTES = 256 << 20
"""Of warped maps and their lookups in memory: two hundred maps of typical size, and never fewer than
two."""
MIN_VIEW_COSINE = 0.5
"""Cosine between viewing directions above which two cameras without common points may see the same surface."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ModelDepth:
    """The depth of one image of an adjusted model.

    Args:
        name: of the original image, as in the maps.
        depth: (H, W) float32 z-depth in the undistorted view, in the unit of the model, 0 where there is none.
        scale: factor from the map's unit to the model's.
        num_points: sparse points that gave the scale; 0 where it is that of the whole model.
    """

    name: str
    depth: FloatMap
    scale: float
    num_points: int


def depth_of_model(
    original: pycolmap.Reconstruction,
    undistorted: pycolmap.Reconstruction,
    maps: DepthMaps,
    *,
    consistent: bool = True,
) -> Iterator[ModelDepth]:
    """Depth of every undistorted image that has a map, by rising image id.

    Every map is read twice, and again as a neighbour where the cache has lost it.

    Args:
        original: the adjusted model, with the cameras of the original images.
        undistorted: the same images by id with pinhole cameras; their sizes are those of the result.
        maps: by the names in ``original``; each covers its whole original image.
        consistent: set to 0 what fewer than ``MIN_CONFIRMATIONS`` of the ``CHECK_NEIGHBOURS`` views that share
            most points found within ``VIEW_AGREEMENT``.

    Raises:
        InputError: an undistorted image is not in the original model, or its camera is no pinhole.
    """
    names = _names_with_maps(original, undistorted, maps)
    observations = SparseObservations.of(original, names)
    scales = _scales(original, names, observations, maps)
    views = {i: _View.of(undistorted, i) for i in names}
    warped = _warped_maps(original, undistorted, maps, scales)
    neighbours = _neighbours(observations, views) if consistent else None
    return _iterate(names, scales, views, warped, neighbours)


def depth_scales(model: pycolmap.Reconstruction, maps: DepthMaps) -> dict[int, float]:
    """By image id, what the depth map of each image of the model must be multiplied with to fit its points."""
    names = {i: model.image(i).name for i in sorted(model.reg_image_ids()) if model.image(i).name in maps}
    return {i: scale.factor for i, scale in _scales(model, names, SparseObservations.of(model, names), maps).items()}


def _iterate(
    names: Mapping[int, str],
    scales: Mapping[int, _Scale],
    views: Mapping[int, _View],
    warped: Callable[[int], _DepthLookup],
    neighbours: Mapping[int, Sequence[int]] | None,
) -> Iterator[ModelDepth]:
    for i, name in names.items():
        depth = warped(i).depth
        if neighbours is not None:
            depth = _confirmed(depth, views[i], [(views[j], warped(j)) for j in neighbours[i]])
        yield ModelDepth(name=name, depth=depth, scale=scales[i].factor, num_points=scales[i].num_points)


def _names_with_maps(
    original: pycolmap.Reconstruction, undistorted: pycolmap.Reconstruction, maps: DepthMaps
) -> dict[int, str]:
    """Original names by image id, ascending, of the undistorted images that have a map."""
    names = {}
    for i in sorted(undistorted.reg_image_ids()):
        if not original.exists_image(i) or not original.image(i).has_pose:
            raise InputError(f"{undistorted.image(i).name}: image {i} has no pose in the original model; use its own")
        camera = undistorted.camera(undistorted.image(i).camera_id)
        if camera.model.name not in ("PINHOLE", "SIMPLE_PINHOLE"):
            raise InputError(
                f"{undistorted.image(i).name}: camera is {camera.model.name}, needed PINHOLE; undistort it"
            )
        if original.image(i).name in maps:
            names[i] = original.image(i).name
    return names


# ---------------------------------------------------------------------------- sampling
def sample_depth(depth: FloatMap, columns: FloatArray, rows: FloatArray) -> FloatMap:
    """Depth at places of a map, never blended across an edge; see ``_DepthLookup``.

    Args:
        depth: (H, W), 0 where there is none.
        columns, rows: (N,) with the centre of the first pixel at (0.5, 0.5); NaN is outside.

    Returns:
        (N,) float32, 0 outside the map and where there is no depth.
    """
    inverse = _DepthLookup.of(depth).inverse_depth(columns, rows)
    return np.divide(1, inverse, out=inverse, where=inverse > 0)


@dataclass(frozen=True, kw_only=True, eq=False)
class _DepthLookup:
    """A depth map made ready to be asked at any place.

    Inverse depth is interpolated, which on a plane is exact; where the four pixels round the place are not one
    surface (``ADJACENT_PIXELS``, or one has no depth) the nearest is taken.

    Args:
        depth: (H, W), 0 where there is none.
        inverse: (H + 1, W + 1) float32 inverse depth, 0 where there is none; the last row and column stand there
            twice, so that every pixel has one to the right and one below.
        smooth: (H + 1, W + 1) whether a pixel, the next to the right, and the two below them are one surface.
    """

    depth: FloatMap
    inverse: FloatMap
    smooth: npt.NDArray[np.bool_]

    @classmethod
    def of(cls, depth: FloatMap) -> _DepthLookup:
        """Of a map that is not changed any more."""
        rim = ((0, 1), (0, 1))
        inverse = np.divide(1, depth, out=np.zeros_like(depth), where=depth > 0)
        return cls(depth=depth, inverse=np.pad(inverse, rim, mode="edge"), smooth=np.pad(_one_surface(depth), rim))

    @property
    def nbytes(self) -> int:
        return self.depth.nbytes + self.inverse.nbytes + self.smooth.nbytes

    def inverse_depth(self, x: AnyFloats, y: AnyFloats) -> FloatMap:
        """(N,) float32 at places (N,) with the centre of the first pixel at (0.5, 0.5); 0 outside and without depth."""
        height, width = self.depth.shape
        with np.errstate(invalid="ignore"):
            inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        x, y = x[inside], y[inside]
        # The pixel whose centre is to the left and above; the outermost half pixel has no other side.
        left, top = np.maximum(x - 0.5, 0), np.maximum(y - 0.5, 0)
        j, i = left.astype(np.intp), top.astype(np.intp)
        right, down = (left - j).astype(np.float32), (top - i).astype(np.float32)
        inverse, stride = self.inverse.ravel(), width + 1
        corner = i * stride + j
        upper, lower = (_blended(inverse.take(row), inverse.take(row + 1), right) for row in (corner, corner + stride))
        found = _blended(upper, lower, down)
        rough = np.flatnonzero(~self.smooth.ravel().take(corner))
        found[rough] = inverse[y[rough].astype(np.intp) * stride + x[rough].astype(np.intp)]
        everywhere = np.zeros(len(inside), np.float32)
        everywhere[inside] = found
        return everywhere


def _blended(first: FloatMap, second: FloatMap, part: FloatMap) -> FloatMap:
    """``first`` where ``part`` is 0, ``second`` where it is 1."""
    return first + part * (second - first)


def _one_surface(depth: FloatMap) -> npt.NDArray[np.bool_]:
    """(H, W) whether a pixel, the next to the right, and the two below them are one surface."""
    right_and_below = np.ones((2, 2), np.uint8)
    low = cv2.erode(depth, right_and_below, anchor=(0, 0), borderType=cv2.BORDER_REPLICATE)
    high = cv2.dilate(depth, right_and_below, anchor=(0, 0), borderType=cv2.BORDER_REPLICATE)
    smooth: npt.NDArray[np.bool_] = (low > 0) & (high <= low * (1 + ADJACENT_PIXELS))
    return smooth


def _evident_depth(maps: DepthMaps, name: str) -> FloatMap:
    """(H, W) depth where there is any confidence, 0 elsewhere: a confidence of 1 is none."""
    depth, confidence = maps.depth(name), maps.confidence(name)
    evident: FloatMap = np.where(np.isfinite(depth) & (depth > 0) & (confidence > 1), depth, 0).astype(np.float32)
    return evident


def _warped_maps(
    original: pycolmap.Reconstruction,
    undistorted: pycolmap.Reconstruction,
    maps: DepthMaps,
    scales: Mapping[int, _Scale],
) -> Callable[[int], _DepthLookup]:
    """A function from image id to its rescaled depth in the undistorted view, which keeps the last results."""

    @lru_cache(maxsize=4)  # images of one camera follow each other; a lookup takes 16 bytes per pixel
    def places(from_camera: int, to_camera: int) -> FloatArray:
        """(H * W, 2) where the pixels of the undistorted view lie in the original, each axis from 0 to 1."""
        distorted, pinhole = original.camera(from_camera), undistorted.camera(to_camera)
        rays = Intrinsics.from_colmap(pinhole).rays_cam(pixel_centres(pinhole.width, pinhole.height))
        xy = Intrinsics.from_colmap(distorted).xy_img(rays)
        return xy / (distorted.width, distorted.height)

    def warp(i: int) -> _DepthLookup:
        pinhole = undistorted.camera(undistorted.image(i).camera_id)
        depth = _evident_depth(maps, original.image(i).name)
        columns, rows = (places(original.image(i).camera_id, pinhole.camera_id) * depth.shape[::-1]).T
        sampled: FloatMap = sample_depth(depth, columns, rows) * np.float32(scales[i].factor)
        return _DepthLookup.of(sampled.reshape(pinhole.height, pinhole.width))

    return _with_bounded_memory(warp)


def _with_bounded_memory(warp: Callable[[int], _DepthLookup]) -> Callable[[int], _DepthLookup]:
    """The same function, which remembers the last results up to ``CACHE_BYTES``."""
    cache: OrderedDict[int, _DepthLookup] = OrderedDict()

    def remembered(i: int) -> _DepthLookup:
        if i not in cache:
            cache[i] = warp(i)
            while len(cache) > 2 and sum(lookup.nbytes for lookup in cache.values()) > CACHE_BYTES:
                cache.popitem(last=False)
        cache.move_to_end(i)
        return cache[i]

    return remembered


# ------------------------------------------------------------------------------- scale
@dataclass(frozen=True, kw_only=True)
class _Scale:
    """Factor from a map's unit to the model's, and the sparse points it rests on."""

    factor: float
    num_points: int


def _scales(
    model: pycolmap.Reconstruction, images: Mapping[int, str], observations: SparseObservations, maps: DepthMaps
) -> dict[int, _Scale]:
    """One factor per image: the weighted median of z over map depth at the points it observes.

    A point counts by the length of its track. The factor of the whole model, the median of those of its images,
    stands in for images with fewer than ``MIN_SCALE_POINTS`` and for those beyond ``MAX_SCALE_RATIO`` of it.
    """
    log_ratios, weights = {}, {}
    for i, name in images.items():
        points = observations.points[i]
        depth = _evident_depth(maps, name)
        camera = model.camera(model.image(i).camera_id)
        columns, rows = (observations.xy[i] / (camera.width, camera.height) * depth.shape[::-1]).T
        on_map = sample_depth(depth, columns, rows)
        cam_from_world = model.image(i).cam_from_world().matrix()
        z = observations.xyz[points] @ cam_from_world[2, :3] + cam_from_world[2, 3]
        usable = (on_map > 0) & (z > 0)
        log_ratios[i] = np.log(z[usable] / on_map[usable])
        weights[i] = observations.track_lengths[points[usable]]
    own = {i: weighted_median(log_ratios[i], weights[i]) for i in images if len(log_ratios[i]) >= MIN_SCALE_POINTS}
    everywhere = _log_scale_of_model(own, log_ratios)
    scales = {}
    for i in images:
        accepted = i in own and abs(own[i] - everywhere) <= np.log(MAX_SCALE_RATIO)
        scales[i] = _Scale(
            factor=float(np.exp(own[i] if accepted else everywhere)), num_points=len(log_ratios[i]) if accepted else 0
        )
    num_borrowed = sum(scale.num_points == 0 for scale in scales.values())
    if num_borrowed:
        logger.warning("%d of %d depth maps take the scale of the whole model", num_borrowed, len(images))
    return scales


def _log_scale_of_model(own: Mapping[int, float], log_ratios: Mapping[int, FloatArray]) -> float:
    """The median over the images, else over all points; without any the model is taken to be in the maps' unit."""
    if own:
        return float(np.median(list(own.values())))
    pooled = np.concatenate([*log_ratios.values(), np.empty(0)])
    return float(np.median(pooled)) if len(pooled) else 0.0


# ------------------------------------------------------------------------- consistency
@dataclass(frozen=True, kw_only=True, eq=False)
class _View:
    """An undistorted image's camera and pose.

    Args:
        img_from_cam: (3, 3) calibration matrix. cam_from_world: (3, 4).
    """

    img_from_cam: FloatArray
    cam_from_world: FloatArray

    @classmethod
    def of(cls, model: pycolmap.Reconstruction, image_id: int) -> _View:
        image = model.image(image_id)
        return cls(
            img_from_cam=np.asarray(model.camera(image.camera_id).calibration_matrix(), dtype=np.float64),
            cam_from_world=np.asarray(image.cam_from_world().matrix(), dtype=np.float64),
        )

    @property
    def centre(self) -> FloatArray:
        centre: FloatArray = -self.cam_from_world[:, :3].T @ self.cam_from_world[:, 3]
        return centre

    def transfer_to(self, other: _View) -> tuple[FloatArray, FloatArray]:
        """(3, 3) and (3,): pixel (x, y) at depth z lies in the other at ``z * matrix @ (x, y, 1) + offset``."""
        rotation = other.cam_from_world[:, :3] @ self.cam_from_world[:, :3].T
        translation = other.cam_from_world[:, 3] - rotation @ self.cam_from_world[:, 3]
        return other.img_from_cam @ rotation @ np.linalg.inv(self.img_from_cam), other.img_from_cam @ translation


def _confirmed(depth: FloatMap, view: _View, others: Sequence[tuple[_View, _DepthLookup]]) -> FloatMap:
    """The depth that enough of the other views confirm, 0 elsewhere; pixels are left alone once they have enough.

    Without another view all depth stays. In single precision, which is exact to a thousandth of
    a pixel.
    """
    if not others:
        return depth
    unsure = np.flatnonzero(depth)
    rows, columns = np.divmod(unsure, depth.shape[1])
    xy1 = np.stack([columns + 0.5, rows + 0.5, np.ones(len(unsure))]).astype(np.float32)
    z = depth.ravel()[unsure]
    missing = np.full(len(unsure), min(MIN_CONFIRMATIONS, len(others)), np.int8)
    for other_view, other in others:
        matrix, offset = (array.astype(np.float32) for array in view.transfer_to(other_view))
        x, y, z_other = z * (matrix @ xy1) + offset[:, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            found = z_other * other.inverse_depth(x / z_other, y / z_other)  # 1 where it is as deep there
        missing -= (found >= 1 / (1 + VIEW_AGREEMENT)) & (found <= 1 / (1 - VIEW_AGREEMENT))
        left = missing > 0
        unsure, xy1, z, missing = unsure[left], xy1[:, left], z[left], missing[left]
    kept: FloatMap = depth.copy()
    kept.ravel()[unsure] = 0
    return kept


def _neighbours(observations: SparseObservations, views: Mapping[int, _View]) -> dict[int, list[int]]:
    """By image id, at most ``CHECK_NEIGHBOURS`` others with most points in common, seen from elsewhere.

    Images that share points with fewer take the nearest cameras that look the same way as well.
    """
    ids = list(views)
    shared = _shared_points(observations, ids)
    centres = np.array([views[i].centre for i in ids]).reshape(-1, 3)
    forward = np.array([views[i].cam_from_world[2, :3] for i in ids]).reshape(-1, 3)
    chosen = {}
    for k, i in enumerate(ids):
        counts = shared[[k]].toarray()[0]
        counts[k] = 0
        ranked = np.argsort(-counts, kind="stable")[: CANDIDATES_PER_NEIGHBOUR * CHECK_NEIGHBOURS]
        candidates = ranked[counts[ranked] > 0]
        scores = counts[candidates] * _parallax_weights(observations, ids, centres, k, candidates)
        best = list(candidates[np.argsort(-scores, kind="stable")[:CHECK_NEIGHBOURS]])
        if len(best) < CHECK_NEIGHBOURS:
            distance = np.linalg.norm(centres - centres[k], axis=1)
            nearby = [j for j in np.argsort(distance, kind="stable") if forward[j] @ forward[k] >= MIN_VIEW_COSINE]
            best += [j for j in nearby if j != k and j not in best][: CHECK_NEIGHBOURS - len(best)]
        chosen[i] = [ids[j] for j in best]
    return chosen


def _shared_points(observations: SparseObservations, ids: Sequence[int]) -> sparse.csr_matrix:
    """(N, N) number of sparse points that two images both observe."""
    rows = np.concatenate([np.full(len(observations.points[i]), k) for k, i in enumerate(ids)] or [np.empty(0, int)])
    columns = np.concatenate([observations.points[i] for i in ids] or [np.empty(0, int)])
    shape = (len(ids), max(len(observations.xyz), 1))
    observes = sparse.csr_matrix((np.ones(len(rows)), (rows, columns)), shape=shape)
    return sparse.csr_matrix(observes @ observes.T)


def _parallax_weights(
    observations: SparseObservations, ids: Sequence[int], centres: FloatArray, k: int, candidates: npt.NDArray[np.intp]
) -> FloatArray:
    """(C,) from 0 to 1 by the median angle between the rays from two centres to the points that both see."""
    seen_here = np.zeros(len(observations.xyz), np.bool_)
    seen_here[observations.points[ids[k]]] = True
    weights = np.empty(len(candidates))
    for row, j in enumerate(candidates):
        points = observations.points[ids[j]]
        xyz = observations.xyz[points[seen_here[points]]]
        to_here, to_there = centres[k] - xyz, centres[j] - xyz
        lengths = np.linalg.norm(to_here, axis=1) * np.linalg.norm(to_there, axis=1)
        cosines = np.einsum("ni,ni->n", to_here, to_there) / np.maximum(lengths, np.finfo(np.float64).tiny)
        angle_deg = np.degrees(np.arccos(np.clip(np.median(cosines), -1, 1)))
        weights[row] = min(angle_deg / FULL_PARALLAX_DEG, 1.0)
    return weights
