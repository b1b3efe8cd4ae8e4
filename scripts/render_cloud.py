"""Pictures of a finished run's cloud, to look for double walls: from above, from the side, and a camera's own view.

    python scripts/render_cloud.py OUT picture.png [--image 10] [--cloud OUT/dense/fused.ply]

The floor plan is seen along the mean up direction of the cameras. Nearer points cover farther ones.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pycolmap
import trimesh
from PIL import Image

from smust3r_colmap.errors import InputError
from smust3r_colmap.geometry.arrays import FloatArray, UInt8Array

SIDE_PX = 900
BACKGROUND = 255
CAMERA_RGB = (220, 30, 30)


def main(words: Sequence[str] | None = None) -> int:
    """Read the run, draw three views beside each other, write the picture; the exit code is 2 when it cannot be."""
    arguments = parse_arguments(words)
    try:
        xyz, rgb = read_cloud(arguments.cloud or arguments.run / "points.ply")
        model = read_model(arguments.run / "sparse/0")
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    images = [model.image(i) for i in sorted(model.reg_image_ids())]
    centres = np.array([image.projection_center() for image in images])
    level_from_world = level_frame(images)

    points, cameras = xyz @ level_from_world.T, centres @ level_from_world.T
    near = within_bulk(points)
    above = orthographic(points[near], rgb[near], cameras, axes=(0, 2), away=1)
    side = orthographic(points[near], rgb[near], cameras, axes=(0, 1), away=2)
    image = images[min(arguments.image, len(images) - 1)]
    seen = perspective(xyz, rgb, image, model.camera(image.camera_id))
    Image.fromarray(np.concatenate([above, side, seen], axis=1)).save(arguments.picture)
    print(f"{arguments.picture}: from above, from the side, and the view of {image.name}; {len(xyz)} points")
    return 0


def parse_arguments(words: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("run", type=Path, help="output folder of smust3r-colmap reconstruct")
    parser.add_argument("picture", type=Path, help="PNG to write")
    parser.add_argument("--image", type=int, default=0, help="which registered image's view to draw (0 is the first)")
    parser.add_argument(
        "--cloud",
        type=Path,
        metavar="FILE",
        help="coloured PLY in the model's world, such as dense/fused.ply (OUT/points.ply)",
    )
    return parser.parse_args(words)


def read_cloud(path: Path) -> tuple[FloatArray, UInt8Array]:
    """(P, 3) points and their (P, 3) colours.

    Raises:
        InputError: there is no such file, or it is no cloud of points with colours.
    """
    try:
        cloud = trimesh.load(path, process=False)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read as a cloud: {error}") from error
    if not isinstance(cloud, trimesh.PointCloud):
        raise InputError(f"{path}: has faces, or no points; needed a cloud")
    xyz, rgba = np.asarray(cloud.vertices, dtype=np.float64), np.asarray(cloud.colors, dtype=np.uint8)
    if len(rgba) != len(xyz):
        raise InputError(f"{path}: {len(rgba)} colours of {len(xyz)} points, needed one for each")
    return xyz, rgba[:, :3]


def read_model(folder: Path) -> pycolmap.Reconstruction:
    """The largest model of a run.

    Raises:
        InputError: there is none.
    """
    try:
        return pycolmap.Reconstruction(folder)
    except (ValueError, RuntimeError, OSError) as error:
        raise InputError(f"{folder}: no COLMAP model; is this the output of a finished run? ({error})") from error


def level_frame(images: list[pycolmap.Image]) -> FloatArray:
    """(3, 3) rotation whose second row is the cameras' mean down direction."""
    world_from_cam = np.array([image.cam_from_world().inverse().rotation.matrix() for image in images])
    down = world_from_cam[:, :, 1].mean(axis=0)
    down /= np.linalg.norm(down)
    right = np.cross(down, world_from_cam[0, :, 2])
    right /= np.linalg.norm(right)
    return np.array([right, down, np.cross(right, down)])


def within_bulk(points: FloatArray) -> npt.NDArray[np.bool_]:
    """(P,) points within the middle nine tenths and a margin, so that strays do not set the scale."""
    low, high = np.percentile(points, [5, 95], axis=0)
    margin = 0.3 * (high - low)
    inside: npt.NDArray[np.bool_] = ((points > low - margin) & (points < high + margin)).all(axis=1)
    return inside


def orthographic(
    points: FloatArray, rgb: UInt8Array, cameras: FloatArray, *, axes: tuple[int, int], away: int
) -> UInt8Array:
    """A parallel view on two axes; ``away`` is the axis that points away from the viewer."""
    canvas = np.full((SIDE_PX, SIDE_PX, 3), BACKGROUND, np.uint8)
    flat = points[:, axes]
    low = flat.min(axis=0)
    px_per_unit = (SIDE_PX - 1) / float(np.ptp(flat, axis=0).max())
    order = np.argsort(-points[:, away], kind="stable")
    column, row = ((flat[order] - low) * px_per_unit).astype(int).T
    canvas[row, column] = rgb[order]
    column, row = ((cameras[:, axes] - low) * px_per_unit).astype(int).T
    visible = (column >= 1) & (column < SIDE_PX - 1) & (row >= 1) & (row < SIDE_PX - 1)
    for c, r in zip(column[visible], row[visible], strict=True):
        canvas[r - 1 : r + 2, c - 1 : c + 2] = CAMERA_RGB
    return canvas


def perspective(xyz: FloatArray, rgb: UInt8Array, image: pycolmap.Image, camera: pycolmap.Camera) -> UInt8Array:
    """What the camera would see of the cloud, each point a small square."""
    scale = SIDE_PX / max(camera.width, camera.height)
    cam_from_world = image.cam_from_world()
    points_cam = xyz @ cam_from_world.rotation.matrix().T + cam_from_world.translation
    front = points_cam[:, 2] > 0
    xy = np.asarray(camera.img_from_cam(points_cam[front])) * scale
    inside = np.isfinite(xy).all(axis=1) & (xy >= 0).all(axis=1) & (xy < SIDE_PX - 2).all(axis=1)
    order = np.argsort(-points_cam[front][inside, 2], kind="stable")
    column, row = xy[inside][order].astype(int).T
    colours = rgb[front][inside][order]
    canvas = np.full((SIDE_PX, SIDE_PX, 3), BACKGROUND, np.uint8)
    for dr in (0, 1):
        for dc in (0, 1):
            canvas[row + dr, column + dc] = colours
    return canvas


if __name__ == "__main__":
    sys.exit(main())
