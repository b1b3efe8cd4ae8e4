"""Pictures of a finished run's cloud.

    python scripts/render_cloud.py OUT picture.png [--image 10] [--cloud OUT/dense/fused.ply]
    python scripts/render_cloud.py OUT picture.png --overview [--azimuth 30] [--elevation 40]

The first form is for finding doubled walls: three views beside each other, from above, from the side and through
one of the cameras. Nearer points cover farther ones.

The second form is for showing the result: one perspective view from outside, with all cameras. Surfaces that are
seen from behind are left out, so that a room opens towards the viewer.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
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
STEADIER = 0.5
"""Length of the cameras' mean y axis over that of their mean viewing direction, below which they look down."""

OVERVIEW_PX = (960, 520)
"""Width and height of the overview."""
OVERVIEW_COLOURS = 256
"""Of the palette of the overview: few enough for a file of 200 kB."""
OVERVIEW_DISTANCE = 2.0
"""Of the eye from the middle of the cloud, over the cloud's diagonal: far enough for walls to stay parallel."""
OVERVIEW_MARGIN = 1.08
VOXELS_PER_SIDE = 100
MIN_COMPANY = 0.15
"""Points of a voxel over the median of all points; below they are strays."""
MIN_FACING_COSINE = 0.2
"""Between a surface's normal and the direction to the eye; normals of surfaces seen edge-on are too noisy to decide."""
SUPERSAMPLING = 3
SPLAT_PX = 7
"""Side of the square of a point, in pixels of the supersampled picture."""
FRUSTA_SHOWN = 24
"""Cameras that are drawn at most, evenly chosen; the path has all of them."""
DARK_RGB = (17, 21, 28)
FIRST_RGB, LAST_RGB = (70, 150, 255), (255, 150, 50)
"""Colours of the first and the last camera, as in ``scene.glb``; those between are blended."""


def main(words: Sequence[str] | None = None) -> int:
    """Read the run, draw it, write the picture; the exit code is 2 when it cannot be."""
    arguments = parse_arguments(words)
    try:
        cloud = read_cloud(arguments.cloud or arguments.run / "points.ply")
        model = read_model(arguments.run / "sparse/0")
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    images = [model.image(i) for i in sorted(model.reg_image_ids())]
    if arguments.overview:
        view = View(azimuth_deg=arguments.azimuth, elevation_deg=arguments.elevation)
        picture = overview(cloud, images, view)
        picture.quantize(OVERVIEW_COLOURS, dither=Image.Dither.NONE).save(arguments.picture, optimize=True)
        print(f"{arguments.picture}: {len(cloud.xyz)} points and {len(images)} cameras")
        return 0
    image = images[min(arguments.image, len(images) - 1)]
    Image.fromarray(three_views(cloud, images, image, model.camera(image.camera_id))).save(arguments.picture)
    print(f"{arguments.picture}: from above, from the side, and the view of {image.name}; {len(cloud.xyz)} points")
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
    parser.add_argument("--overview", action="store_true", help="one perspective view with all cameras")
    parser.add_argument("--azimuth", type=float, default=30.0, help="of the overview, degrees round (%(default)s)")
    parser.add_argument("--elevation", type=float, default=40.0, help="of the overview, degrees up (%(default)s)")
    return parser.parse_args(words)


@dataclass(frozen=True, kw_only=True)
class Cloud:
    """(P, 3) points, their (P, 3) colours, and (P, 3) unit normals where the file has them."""

    xyz: FloatArray
    rgb: UInt8Array
    normals: FloatArray | None


@dataclass(frozen=True, kw_only=True)
class View:
    """Where the overview is seen from: degrees round the vertical and degrees above the horizon."""

    azimuth_deg: float
    elevation_deg: float


def read_cloud(path: Path) -> Cloud:
    """The cloud in a PLY file.

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
    vertex = cloud.metadata["_ply_raw"]["vertex"]  # trimesh keeps normals there and nowhere else
    normals = None
    if {"nx", "ny", "nz"} <= set(vertex["properties"]):
        normals = np.stack([vertex["data"][name] for name in ("nx", "ny", "nz")], axis=1).astype(np.float64)
    return Cloud(xyz=xyz, rgb=rgba[:, :3], normals=normals)


def read_model(folder: Path) -> pycolmap.Reconstruction:
    """The largest model of a run.

    Raises:
        InputError: there is none.
    """
    try:
        return pycolmap.Reconstruction(folder)
    except (ValueError, RuntimeError, OSError) as error:
        raise InputError(f"{folder}: no COLMAP model; is this the output of a finished run? ({error})") from error


def level_frame(images: Sequence[pycolmap.Image]) -> FloatArray:
    """(3, 3) rotation whose second row is down, and whose first is about the first camera's x axis.

    Down is the mean y axis of the cameras, or the mean viewing direction where that is much steadier: from a drone that
    looks down and turns at the end of each strip.
    """
    world_from_cam = np.array([image.cam_from_world().inverse().rotation.matrix() for image in images])
    y, z = world_from_cam[:, :, 1].mean(axis=0), world_from_cam[:, :, 2].mean(axis=0)
    down, forward = y, world_from_cam[0, :, 2]
    if np.linalg.norm(y) < STEADIER * np.linalg.norm(z):
        down, forward = z, -world_from_cam[0, :, 1]
    down = down / np.linalg.norm(down)
    right = np.cross(down, forward)
    right /= np.linalg.norm(right)
    return np.array([right, down, np.cross(right, down)])


def within_bulk(points: FloatArray) -> npt.NDArray[np.bool_]:
    """(P,) points within the middle nine tenths and a margin, so that strays do not set the scale."""
    low, high = np.percentile(points, [5, 95], axis=0)
    margin = 0.3 * (high - low)
    inside: npt.NDArray[np.bool_] = ((points > low - margin) & (points < high + margin)).all(axis=1)
    return inside


# ------------------------------------------------------------------------------- three views
def three_views(
    cloud: Cloud, images: Sequence[pycolmap.Image], image: pycolmap.Image, camera: pycolmap.Camera
) -> UInt8Array:
    """(SIDE_PX, 3 SIDE_PX, 3): from above, from the side, and through the camera of ``image``."""
    level_from_world = level_frame(images)
    points = cloud.xyz @ level_from_world.T
    cameras = np.array([one.projection_center() for one in images]) @ level_from_world.T
    near = within_bulk(points)
    above = orthographic(points[near], cloud.rgb[near], cameras, axes=(0, 2), away=1)
    side = orthographic(points[near], cloud.rgb[near], cameras, axes=(0, 1), away=2)
    return np.concatenate([above, side, perspective(cloud.xyz, cloud.rgb, image, camera)], axis=1)


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


# ---------------------------------------------------------------------------------- overview
def overview(cloud: Cloud, images: Sequence[pycolmap.Image], view: View) -> Image.Image:
    """The cloud and the frusta of its cameras, seen from outside and above."""
    level_from_world = level_frame(images)
    points = cloud.xyz @ level_from_world.T
    keep = within_bulk(points)
    low, high = np.percentile(points[keep], [1, 99], axis=0)
    eye, view_from_level = look_at((low + high) / 2, float(np.linalg.norm(high - low)), view)
    if cloud.normals is not None:
        towards_eye = (eye - points) / np.linalg.norm(eye - points, axis=1, keepdims=True)
        keep &= np.einsum("pi,pi->p", cloud.normals @ level_from_world.T, towards_eye) > MIN_FACING_COSINE

    keep[keep] = has_company(points[keep])
    points_view = (points[keep] - eye) @ view_from_level.T
    frusta_view = (frusta(images) @ level_from_world.T - eye) @ view_from_level.T
    slopes, frusta_slopes = (one[..., :2] / one[..., 2:] for one in (points_view, frusta_view))
    ends = np.concatenate([np.percentile(slopes, [0.2, 99.8], axis=0), frusta_slopes.reshape(-1, 2)])
    first, last = ends.min(axis=0), ends.max(axis=0)
    size = SUPERSAMPLING * np.array(OVERVIEW_PX)
    focal = float((size / (last - first)).min()) / OVERVIEW_MARGIN
    offset = size / 2 - focal * (first + last) / 2
    canvas = np.full((size[1], size[0], 3), DARK_RGB, np.uint8)
    draw_splats(canvas, slopes * focal + offset, points_view[:, 2], cloud.rgb[keep])
    draw_cameras(canvas, frusta_slopes * focal + offset)
    return Image.fromarray(canvas).resize(OVERVIEW_PX, Image.Resampling.BOX)


def has_company(points: FloatArray) -> npt.NDArray[np.bool_]:
    """(P,) points that share a voxel with about as many others as is usual; the rest are strays and edges."""
    voxel = np.ptp(points, axis=0).max() / VOXELS_PER_SIDE
    _, index, counts = np.unique(np.floor(points / voxel), axis=0, return_inverse=True, return_counts=True)
    per_point: npt.NDArray[np.int_] = counts[index.reshape(-1)]
    crowded: npt.NDArray[np.bool_] = per_point >= MIN_COMPANY * np.median(per_point)
    return crowded


def look_at(middle: FloatArray, diagonal: float, view: View) -> tuple[FloatArray, FloatArray]:
    """Eye (3,) and rotation ``view_from_level`` (3, 3) that look at the middle; the level frame has y down."""
    azimuth, elevation = np.deg2rad([view.azimuth_deg, view.elevation_deg])
    forward = np.array([-np.cos(elevation) * np.sin(azimuth), np.sin(elevation), np.cos(elevation) * np.cos(azimuth)])
    right = np.array([np.cos(azimuth), 0.0, np.sin(azimuth)])
    return middle - OVERVIEW_DISTANCE * diagonal * forward, np.stack([right, np.cross(forward, right), forward])


def draw_splats(canvas: UInt8Array, xy: FloatArray, depth: FloatArray, rgb: UInt8Array) -> None:
    """Points as squares, the far ones first."""
    inside = (depth > 0) & (xy >= SPLAT_PX).all(axis=1)
    inside &= (xy[:, 0] < canvas.shape[1] - SPLAT_PX) & (xy[:, 1] < canvas.shape[0] - SPLAT_PX)
    order = np.argsort(-depth[inside], kind="stable")
    column, row = xy[inside][order].astype(int).T
    nearest = np.full(canvas.shape[:2], -1)
    rank = np.arange(len(order))
    for dr in range(-(SPLAT_PX // 2), SPLAT_PX // 2 + 1):
        for dc in range(-(SPLAT_PX // 2), SPLAT_PX // 2 + 1):
            np.maximum.at(nearest, (row + dr, column + dc), rank)
    canvas[nearest >= 0] = rgb[inside][order][nearest[nearest >= 0]]


def frusta(images: Sequence[pycolmap.Image]) -> FloatArray:
    """(N, 5, 3) centre and corners of the image plane of each camera, in the world."""
    world_from_cam = np.array([image.cam_from_world().inverse().matrix() for image in images])
    centres = world_from_cam[:, :, 3]
    extent = float(np.linalg.norm(np.ptp(centres, axis=0))) or 1.0
    corners_cam = 0.12 * extent * np.array([[0, 0, 0], [-0.5, -0.4, 1], [0.5, -0.4, 1], [0.5, 0.4, 1], [-0.5, 0.4, 1]])
    corners: FloatArray = np.einsum("nij,kj->nki", world_from_cam[:, :, :3], corners_cam) + centres[:, None]
    return corners


def draw_cameras(canvas: UInt8Array, xy: FloatArray) -> None:
    """The path and some of the frusta (N, 5, 2), over everything else, coloured by their order."""
    order = np.arange(len(xy)) / max(len(xy) - 1, 1)
    colours = np.array(FIRST_RGB) + order[:, None] * (np.array(LAST_RGB) - FIRST_RGB)
    shown = set(np.linspace(0, len(xy) - 1, min(len(xy), FRUSTA_SHOWN)).round().astype(int).tolist())
    for k, (centre, *corners) in enumerate(xy):
        lines = [(xy[k - 1, 0], centre)] if k else []
        if k in shown:
            lines += [(centre, corner) for corner in corners]
            lines += list(zip(corners, [*corners[1:], corners[0]], strict=True))
        for a, b in lines:
            ends = (a.round().astype(int).tolist(), b.round().astype(int).tolist())
            cv2.line(canvas, *ends, colours[k].tolist(), SUPERSAMPLING + 1, cv2.LINE_AA)


if __name__ == "__main__":
    sys.exit(main())
