"""The surface that each image sees, from depth maps or from a cloud without tracks.

The next module to read is ``covisibility``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from smust3r_colmap.features.covisibility import SeenSurface, sample_rows
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.camera import Intrinsics, pointmap_from_depth
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.products import DepthMaps, Scene

CLOUD_POINTS_PER_IMAGE = 500
"""Of a cloud without tracks, that represent what an image sees."""
MAX_CLOUD_POINTS = 50_000
"""Of a whole cloud, because all are projected into every image: 17 s for 1000 images."""
GRID_CELLS = 12
"""Along the longer side of an image, in which its surface is sampled."""
MIN_CONFIDENCE = 1.5
"""Of depth that is sampled; 1 is no confidence."""


def surfaces_of_maps(scenes: Sequence[Scene], maps: DepthMaps) -> dict[int, FloatArray]:
    """(S, 3) world points by image index: a grid over each depth map, where it is confident."""
    surfaces: dict[int, FloatArray] = {}
    for scene in reversed(scenes):
        for index, name, camera, pose in zip(
            scene.image_indices, scene.image_names, scene.camera_indices, scene.cam_from_world, strict=True
        ):
            if name not in maps:
                continue
            depth = np.where(maps.confidence(name) > MIN_CONFIDENCE, maps.depth(name), 0)
            step = max(1, max(depth.shape) // GRID_CELLS)
            coarse = depth[step // 2 :: step, step // 2 :: step]
            intrinsics = scene.cameras[camera].resized(coarse.shape[1], coarse.shape[0])
            points = pointmap_from_depth(coarse, intrinsics, invert_rigid(pose)).reshape(-1, 3)
            surfaces[index] = points[np.isfinite(points).all(axis=1)].astype(np.float64)
    return surfaces


def surfaces_of_clouds(scenes: Sequence[Scene]) -> dict[int, FloatArray]:
    """The same from the points of the scenes: the nearest one in every cell of a grid over the image."""
    surfaces: dict[int, FloatArray] = {}
    for scene in reversed(scenes):
        wanted = min(CLOUD_POINTS_PER_IMAGE * len(scene), MAX_CLOUD_POINTS)
        xyz = scene.points.xyz[sample_rows(len(scene.points), wanted)]
        for index, camera, pose in zip(scene.image_indices, scene.camera_indices, scene.cam_from_world, strict=True):
            surfaces[index] = _nearest_in_cells(xyz, pose, scene.cameras[camera])
    return surfaces


def _nearest_in_cells(xyz: FloatArray, cam_from_world: FloatArray, intrinsics: Intrinsics) -> FloatArray:
    points_cam = xyz @ cam_from_world[:, :3].T + cam_from_world[:, 3]
    front = np.flatnonzero(points_cam[:, 2] > 0)
    if not len(front):
        return np.empty((0, 3))
    xy = np.nan_to_num(intrinsics.xy_img(points_cam[front]), nan=-1.0)
    inside = (xy >= 0).all(axis=1) & (xy[:, 0] < intrinsics.width) & (xy[:, 1] < intrinsics.height)
    front, cell = front[inside], (xy[inside] / (intrinsics.width, intrinsics.height) * GRID_CELLS).astype(np.int64)
    order = np.argsort(points_cam[front, 2], kind="stable")
    _, first = np.unique((cell[:, 1] * GRID_CELLS + cell[:, 0])[order], return_index=True)
    nearest: FloatArray = xyz[front[order[first]]]
    return nearest


def seen_surfaces(scene: Scene, surfaces: Mapping[int, FloatArray]) -> list[SeenSurface]:
    """One per image of the scene; without points if ``surfaces`` has none."""
    return [
        SeenSurface(
            image=index,
            cam_from_world=pose,
            intrinsics=scene.cameras[camera],
            points_world=surfaces.get(index, np.empty((0, 3))),
        )
        for index, camera, pose in zip(scene.image_indices, scene.camera_indices, scene.cam_from_world, strict=True)
    ]
