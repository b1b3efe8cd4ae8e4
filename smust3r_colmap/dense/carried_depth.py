"""Depth of images that have no map of their own, carried over from images beside them.

Images between the keyframes of a video see nearly what the keyframes see. So the depth of two keyframes is projected
into them; nearer surfaces hide farther ones, and what neither keyframe saw stays without depth.
The next module to read is ``stage``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.camera import Intrinsics, pixel_centres

FloatMap = npt.NDArray[np.float32]
_NOTHING = np.iinfo(np.uint64).max
"""Of a pixel that no point falls on."""


@dataclass(frozen=True, kw_only=True, eq=False)
class DepthView:
    """A depth map and its camera.

    Args:
        depth: (H, W) z-depth in units of the world, 0 where there is none.
        confidence: (H, W), 1 is none.
        intrinsics: at the original image size; the map covers the whole image.
        cam_from_world: (3, 4).
    """

    depth: FloatMap
    confidence: FloatMap
    intrinsics: Intrinsics
    cam_from_world: FloatArray


def carry_depth(
    views: Sequence[DepthView], intrinsics: Intrinsics, cam_from_world: FloatArray
) -> tuple[FloatMap, FloatMap]:
    """(H, W) depth and confidence in another camera, as large as the first view; 0 and 1 where no view has depth.

    Every pixel covers the four pixels round the place where it falls, so that no gaps open where the camera came
    nearer by less than a half.

    Args:
        views: at least one. intrinsics: of the other camera, at its original image size. cam_from_world: (3, 4).
    """
    height, width = views[0].depth.shape
    own = intrinsics.resized(width, height)
    nearest = np.full(height * width, _NOTHING)
    for view in views:
        points_cam, confidence = _points_in(view, cam_from_world)
        value = _by_depth(points_cam[:, 2], confidence)
        corner = np.floor(own.xy_img(points_cam) - 0.5)
        for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
            x, y = corner[:, 0] + dx, corner[:, 1] + dy
            inside = (x >= 0) & (y >= 0) & (x < width) & (y < height)  # False for NaN
            np.minimum.at(nearest, (y[inside] * width + x[inside]).astype(np.int64), value[inside])
    seen = nearest != _NOTHING
    carried = np.where(seen, (nearest >> np.uint64(32)).astype(np.uint32).view(np.float32), np.float32(0))
    trusted = np.where(seen, nearest.astype(np.uint32).view(np.float32), np.float32(1))
    return carried.reshape(height, width), trusted.reshape(height, width)


def _by_depth(depth: FloatArray, confidence: FloatMap) -> npt.NDArray[np.uint64]:
    """(P,) both numbers in one integer, which is the smaller the nearer the point is; depths are positive.

    Positive floating-point numbers have the order of their bits.
    """
    high, low = (np.ascontiguousarray(one, dtype=np.float32).view(np.uint32) for one in (depth, confidence))
    both: npt.NDArray[np.uint64] = (high.astype(np.uint64) << np.uint64(32)) | low
    return both


def _points_in(view: DepthView, cam_from_world: FloatArray) -> tuple[FloatArray, FloatMap]:
    """(P, 3) the confident pixels of a view in the axes of another camera, and their confidence."""
    height, width = view.depth.shape
    seen = (view.depth > 0) & (view.confidence > 1)
    rays = view.intrinsics.resized(width, height).rays_cam(pixel_centres(width, height)[seen.ravel()])
    points_view = rays * view.depth[seen][:, None]
    rotation, shift = view.cam_from_world[:, :3], view.cam_from_world[:, 3]
    points_world = (points_view - shift) @ rotation
    points: FloatArray = points_world @ cam_from_world[:, :3].T + cam_from_world[:, 3]
    return points, view.confidence[seen]
