"""Cameras as ``transforms.json``, the format of nerfstudio and instant-ngp, and the points that go with it.

Camera axes are OpenGL's (x right, y up, z backward) and ``transform_matrix`` is camera to world. The world is
turned as nerfstudio turns COLMAP's: (x, y, z) becomes (x, z, -y), because the first camera's y is down and z is up
in nerfstudio. ``applied_transform`` says so in the file, and ``sparse_pc.ply`` is in the turned world too.
instant-ngp works in a cube of side 1: ``scale`` and ``offset`` put the scene there, nerfstudio ignores them.
The next module to read is ``training_dataset``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pycolmap

from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.products import PointCloud

SAVED_FROM_WORLD = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0]])
"""(3, 4) nerfstudio's ``applied_transform``: from COLMAP's world to that of the file."""
OPENGL_AXES = np.diag([1.0, -1.0, -1.0])

AABB_SCALE = 16
"""How far beyond its cube instant-ngp looks, a power of two: enough for what surrounds the cameras."""
CORE_PERCENT = (5.0, 95.0)
"""Points outside these percentiles, axis by axis, may lie outside instant-ngp's cube."""


def transforms_json(model: pycolmap.Reconstruction, *, mask_of: Mapping[str, str] | None = None) -> dict[str, Any]:
    """The document for a model of PINHOLE cameras whose images lie in ``images/``.

    Args:
        model: names are those below ``images/``. One camera stands at the top level, several in the frames.
        mask_of: by image name, the mask's path beside the file; for all images, as nerfstudio asks, or None.
    """
    cameras = {camera_id: _camera(camera) for camera_id, camera in model.cameras.items()}
    shared = next(iter(cameras.values())) if len(cameras) == 1 else None
    frames = []
    for image_id in sorted(model.reg_image_ids()):
        image = model.image(image_id)
        frames.append(
            {"file_path": f"images/{image.name}"}
            | ({} if mask_of is None else {"mask_path": mask_of[image.name]})
            | ({} if shared else cameras[image.camera_id])
            | {"transform_matrix": _saved_from_opengl(image).tolist(), "colmap_im_id": image_id}
        )
    return {
        "camera_model": "PINHOLE",
        **(shared or {}),
        "applied_transform": SAVED_FROM_WORLD.tolist(),
        "ply_file_path": "sparse_pc.ply",
        **_unit_cube(model),
        "frames": frames,
    }


def points_saved(points: PointCloud) -> PointCloud:
    """The cloud in the world of ``transforms.json``."""
    turn = SAVED_FROM_WORLD[:, :3]
    normals = None if points.normals is None else (points.normals @ turn.T).astype(np.float32)
    return PointCloud(xyz=points.xyz @ turn.T + SAVED_FROM_WORLD[:, 3], rgb=points.rgb, normals=normals)


def _camera(camera: pycolmap.Camera) -> dict[str, float]:
    return {
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.focal_length_x,
        "fl_y": camera.focal_length_y,
        "cx": camera.principal_point_x,
        "cy": camera.principal_point_y,
        **dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0),
    }


def _saved_from_opengl(image: pycolmap.Image) -> FloatArray:
    """(4, 4) from the camera with OpenGL's axes to the world of the file."""
    world_from_cam = np.eye(4)
    world_from_cam[:3] = invert_rigid(image.cam_from_world().matrix())
    saved_from_opengl = np.eye(4)
    saved_from_opengl[:3] = SAVED_FROM_WORLD @ world_from_cam
    saved_from_opengl[:3, :3] = saved_from_opengl[:3, :3] @ OPENGL_AXES
    return saved_from_opengl


def _unit_cube(model: pycolmap.Reconstruction) -> dict[str, Any]:
    """instant-ngp: ``scale * position + offset`` puts all cameras and the core of the points into the unit cube."""
    centres = np.array([model.image(i).projection_center() for i in model.reg_image_ids()])
    core = np.percentile([point.xyz for point in model.points3D.values()], CORE_PERCENT, axis=0)
    box = np.concatenate([centres, core]) @ SAVED_FROM_WORLD[:, :3].T
    lower, upper = box.min(axis=0), box.max(axis=0)
    scale = 1.0 / float((upper - lower).max())
    offset = 0.5 - scale * (lower + upper) / 2
    return {"aabb_scale": AABB_SCALE, "scale": scale, "offset": offset.tolist()}
