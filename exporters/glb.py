"""A scene as one binary glTF file: the coloured cloud and the cameras, for any web or desktop viewer.

COLMAP's axes are y down and z forward, glTF's are y up and z backward: the root node turns by 180
degrees about x, the geometry below it stays in the world frame of the scene. The next module to read
is ``tum_trajectory``.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import trimesh

from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.products import PointCloud, Scene
from smust3r_colmap.storage.atomic_write import write_atomically

FRUSTUM_PER_STEP = 0.6
"""Depth of a frustum over the usual distance of consecutive cameras: neighbours do not interleave."""
FRUSTUM_PER_EXTENT = 0.01
"""Smallest depth over the extent of all cameras, or video frames would be too small to see."""
WIRE_PER_FRUSTUM = 0.03
"""Thickness of the wires over the depth of the frustum; glTF lines are one pixel wide, too thin."""
FIRST_RGB, LAST_RGB = (40, 90, 255), (255, 80, 40)
"""Colours of the first and the last camera; those between are blended, so that the order shows."""

_EDGES = np.array([(0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1)])
_Y_UP_FROM_Y_DOWN = np.diag([1.0, -1.0, -1.0, 1.0])


def write_glb(scene: Scene, path: Path, *, max_points: int = 1_000_000) -> None:
    """Write cloud and cameras of ``scene`` to ``path``.

    Args:
        scene: one connected model.
        path: of the file; replaced where it exists.
        max_points: larger clouds are thinned evenly, which is all that browsers ask for.

    Raises:
        ValueError: ``max_points`` is not positive.
        StorageError: the disk refused.
    """
    if max_points < 1:
        raise ValueError(f"max_points is {max_points}, needed at least 1")
    # Single precision is all that glTF has, so the geometry is written about a point in its middle.
    world_from_cam = invert_rigid(scene.cam_from_world)
    origin = np.median(world_from_cam[:, :, 3], axis=0) if len(scene) else np.zeros(3)
    world_from_cam[:, :, 3] -= origin
    gltf_from_geometry = _Y_UP_FROM_Y_DOWN.copy()
    gltf_from_geometry[:3, 3] = _Y_UP_FROM_Y_DOWN[:3, :3] @ origin
    document = trimesh.Scene()
    if len(scene.points):
        cloud = _thinned_cloud(scene.points, origin, max_points)
        document.add_geometry(cloud, geom_name="points", transform=gltf_from_geometry)
    if len(scene):
        cameras = _wire_cameras(scene, world_from_cam)
        document.add_geometry(cameras, geom_name="cameras", transform=gltf_from_geometry)
    write_atomically(path, document.export(file_type="glb"))  # type: ignore[no-untyped-call]


def frustum_depth(centres: FloatArray) -> float:
    """Depth at which frusta of cameras at ``centres`` (N, 3) are seen but do not cover each other."""
    if len(centres) < 2:
        return 1.0
    step = float(np.median(np.linalg.norm(np.diff(centres, axis=0), axis=1)))
    extent = float(np.linalg.norm(np.ptp(centres, axis=0)))
    return max(FRUSTUM_PER_STEP * step, FRUSTUM_PER_EXTENT * extent) or 1.0


def _thinned_cloud(points: PointCloud, origin: FloatArray, max_points: int) -> trimesh.PointCloud:
    """At most ``max_points`` of the cloud, evenly spread over its rows."""
    count = min(len(points), max_points)
    rows = np.arange(count) * len(points) // count
    return trimesh.PointCloud(points.xyz[rows] - origin, colors=points.rgb[rows])  # type: ignore[no-untyped-call]


def _wire_cameras(scene: Scene, world_from_cam: FloatArray) -> trimesh.Trimesh:
    """All frusta as one mesh of thin wires, coloured from the first to the last camera."""
    depth = frustum_depth(world_from_cam[:, :, 3])
    corners_cam = np.stack([_frustum_corners_cam(scene.cameras[camera], depth) for camera in scene.camera_indices])
    corners = np.einsum("nij,nkj->nki", world_from_cam[:, :, :3], corners_cam) + world_from_cam[:, None, :, 3]
    ends = corners[:, _EDGES]  # (N, 8, 2, 3)
    vertices, faces = _wires(ends[:, :, 0].reshape(-1, 3), ends[:, :, 1].reshape(-1, 3), WIRE_PER_FRUSTUM * depth)
    progress = np.linspace(0, 1, len(scene))[:, None]
    rgb = np.rint((1 - progress) * FIRST_RGB + progress * LAST_RGB).astype(np.uint8)
    per_vertex = np.repeat(rgb, len(vertices) // len(scene), axis=0)
    return trimesh.Trimesh(vertices=vertices, faces=faces, vertex_colors=per_vertex, process=False)


def _frustum_corners_cam(camera: Intrinsics, depth: float) -> FloatArray:
    """(5, 3) centre and image corners of a pinhole of the camera's size and focal length.

    Distortion is left out: a corner may lie where it cannot be undone, and a symbol needs no more.
    """
    half_width, half_height = np.array([camera.width, camera.height]) / (2 * camera.focal_px)
    return depth * np.array(
        [
            (0, 0, 0),
            (-half_width, -half_height, 1),
            (half_width, -half_height, 1),
            (half_width, half_height, 1),
            (-half_width, half_height, 1),
        ]
    )


def _wires(starts: FloatArray, ends: FloatArray, thickness: float) -> tuple[FloatArray, npt.NDArray[np.int64]]:
    """Prisms of three sides from ``starts`` to ``ends`` (E, 3): (6 E, 3) vertices, (6 E, 3) faces."""
    direction = (ends - starts) / np.linalg.norm(ends - starts, axis=1, keepdims=True)
    # Any axis that is not along the wire gives two directions across it.
    axis = np.eye(3)[np.abs(direction).argmin(axis=1)]
    across = np.cross(direction, axis)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    upward = np.cross(direction, across)
    angles = np.deg2rad([0.0, 120.0, 240.0])[None, :, None]
    ring = thickness / 2 * (np.cos(angles) * across[:, None] + np.sin(angles) * upward[:, None])
    vertices = np.concatenate([starts[:, None] + ring, ends[:, None] + ring], axis=1).reshape(-1, 3)
    sides = np.array([(0, 1, 4), (0, 4, 3), (1, 2, 5), (1, 5, 4), (2, 0, 3), (2, 3, 5)])
    faces = (sides[None] + 6 * np.arange(len(starts))[:, None, None]).reshape(-1, 3)
    return vertices, faces
