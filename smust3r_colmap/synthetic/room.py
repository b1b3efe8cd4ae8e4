"""A made-up room to try the program on: photographs with exactly known cameras and depth.

The room is closed, 6 m long, 4 m wide and 3 m high, with furniture made of boxes and a different
texture on every face. The camera is carried round it once, looking outwards and a little ahead,
and comes back to where it started, so that every part of the pipeline has something to do, loop
closing included. ``write_demo`` writes what ``evaluation.read_poses_txt`` reads.

Frames: ``world`` has its origin in the middle of the floor, x along the room, y across it and z up,
in metres; cameras are x right, y down, z forward.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
from PIL import Image
from scipy.spatial.transform import Rotation

from smust3r_colmap.errors import ConfigError, StorageError
from smust3r_colmap.geometry.arrays import Float32Array, FloatArray, UInt8Array
from smust3r_colmap.geometry.camera import Intrinsics

IntArray = npt.NDArray[np.intp]

# Corners (lower, upper) in metres. The first box is the room, seen from inside; furniture keeps
# half a metre clear of the camera's path.
_BOXES = np.array(
    [
        [[-3.00, -2.00, 0.00], [3.00, 2.00, 3.00]],  # the room
        [[-3.00, -2.00, 0.00], [-2.40, -0.90, 2.10]],  # cupboard
        [[0.60, -2.00, 0.72], [2.20, -1.35, 0.76]],  # desk: top and two sides
        [[0.60, -2.00, 0.00], [0.64, -1.35, 0.72]],
        [[2.16, -2.00, 0.00], [2.20, -1.35, 0.72]],
        [[1.10, -1.75, 0.86], [1.70, -1.70, 1.25]],  # screen and its foot
        [[1.35, -1.77, 0.76], [1.45, -1.68, 0.86]],
        [[2.10, 1.10, 0.00], [2.40, 1.40, 3.00]],  # two pillars
        [[-1.00, -1.70, 0.00], [-0.75, -1.45, 3.00]],
        [[-1.60, 1.30, 0.00], [0.40, 2.00, 0.42]],  # sofa: seat, back, arm
        [[-1.60, 1.80, 0.42], [0.40, 2.00, 0.85]],
        [[-1.60, 1.30, 0.42], [-1.45, 1.80, 0.62]],
        [[2.60, -0.80, 0.00], [3.00, 0.60, 1.00]],  # sideboard with two boxes
        [[2.65, -0.60, 1.00], [2.95, -0.25, 1.35]],
        [[2.70, 0.10, 1.00], [2.90, 0.40, 1.60]],
        [[-2.90, 1.20, 0.00], [-2.30, 1.80, 0.55]],  # small table with a lamp
        [[-2.70, 1.40, 0.55], [-2.50, 1.60, 1.05]],
        [[0.90, 1.65, 1.50], [2.00, 2.00, 2.10]],  # hanging cabinet
        [[-3.00, -0.15, 2.75], [3.00, 0.15, 3.00]],  # beam
        [[-2.20, 0.50, 0.00], [-1.85, 0.85, 1.20]],  # stand with a box on it
        [[-2.15, 0.55, 1.20], [-1.90, 0.80, 1.75]],
        [[-3.00, -0.70, 1.35], [-2.70, 0.30, 1.40]],  # shelf with two boxes
        [[-3.00, -0.60, 1.40], [-2.78, -0.20, 1.68]],
        [[-2.95, 0.00, 1.40], [-2.75, 0.20, 1.60]],
        [[-1.50, 1.15, 1.75], [-1.20, 1.45, 2.10]],  # hanging lamp
        [[-0.40, -2.00, 0.00], [0.40, -1.60, 1.90]],  # bookcase
        [[2.25, -1.50, 0.00], [2.45, -1.30, 1.70]],  # standing lamp
        [[-0.60, 1.75, 1.20], [0.30, 2.00, 1.65]],  # box above the sofa
    ]
)
_CORNERS = np.array([list(product(*box.T)) for box in _BOXES])  # (boxes, 8, 3)
_NORMAL_AXIS = np.tile([0, 0, 1, 1, 2, 2], len(_BOXES))  # of the faces of all boxes

_TEXEL_M = 0.004  # a pixel of a 640x480 photograph covers 4 mm at 1.7 m, the usual distance
_LEVELS = 5  # of prefiltering, the coarsest texel being 64 mm
_PADDING = 2 ** (_LEVELS - 1)  # texels round a face that keep its neighbours out of its coarsest level
_ATLAS_WIDTH = 4096
_SUPERSAMPLING = 2  # rays per pixel and axis; smooths the outlines, the texture is prefiltered
_STRIP_ROWS = 48  # half a megabyte per array
_FOCAL_PER_WIDTH = 0.75  # 67 degrees across, as a telephone sees

_PATH_RADII_M = (1.1, 0.6)
_EYE_HEIGHT_M = 1.45
_AHEAD_DEG = 25.0  # how far the view turns from outwards to the direction of travel
_TILT_DEG = -5.0
_SWAY_M = 0.025  # hand-held wandering, largest amplitude of each coordinate
_SWAY_DEG = (1.0, 2.5, 2.0)  # of yaw, pitch and roll
_SWAY_FREQUENCIES = (2, 3, 5)  # whole periods per round, so that the path closes

_PHOTOGRAPH_QUALITY = 92


def demo_intrinsics(width: int, height: int) -> Intrinsics:
    """The camera of the demo for images of ``width`` x ``height`` pixels: square pixels, 67 degrees across."""
    focal_px = _FOCAL_PER_WIDTH * width
    return Intrinsics(
        model="PINHOLE",
        width=width,
        height=height,
        params=(focal_px, focal_px, width / 2, height / 2),
        has_prior_focal=True,
    )


@dataclass(frozen=True, eq=False)
class DemoScene:
    """The furnished room; the seed decides its textures and the camera's sway, not its shape.

    Args:
        seed: equal seeds give equal scenes.
    """

    seed: int = 0
    _atlas: _Atlas = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_atlas", _paint_atlas(np.random.default_rng((self.seed, 0))))

    def render(self, world_from_cam: npt.ArrayLike, intrinsics: Intrinsics) -> tuple[UInt8Array, Float32Array]:
        """One photograph and its depth.

        Args:
            world_from_cam: (3, 4) rigid, the camera inside the room and outside the furniture.
            intrinsics: a PINHOLE camera.

        Returns:
            rgb (H, W, 3), averaged over each pixel, and the z-depth (H, W) in metres along the ray
            through the centre of each pixel; positive everywhere because the room is closed.

        Raises:
            ValueError: another camera model, or the camera is not in the free space of the room.
        """
        pose = np.asarray(world_from_cam, dtype=np.float64)
        _check_view(pose, intrinsics)
        strips = [self._render_strip(pose, strip) for strip in _strips(intrinsics)]
        return np.concatenate([rgb for rgb, _ in strips]), np.concatenate([depth for _, depth in strips])

    def _render_strip(self, world_from_cam: FloatArray, intrinsics: Intrinsics) -> tuple[UInt8Array, Float32Array]:
        fine = intrinsics.resized(intrinsics.width * _SUPERSAMPLING, intrinsics.height * _SUPERSAMPLING)
        rgb = self._atlas.colours(_trace(world_from_cam, fine), pixels_per_unit=fine.focal_px)
        small = cv2.resize(rgb, (intrinsics.width, intrinsics.height), interpolation=cv2.INTER_AREA)
        return np.asarray(small, dtype=np.uint8), _trace(world_from_cam, intrinsics).depth

    def camera_path(self, num_images: int) -> FloatArray:
        """``world_from_cam`` (num_images, 3, 4), evenly spaced over one round; one step after the last is the first.

        Raises:
            ConfigError: fewer than two images.
        """
        _check_size(num_images)
        round_trip = np.arange(num_images) / num_images
        angle = 2 * np.pi * round_trip
        sway = _sway(np.random.default_rng((self.seed, 1)), round_trip)
        radius_x, radius_y = _PATH_RADII_M
        loop = np.stack([radius_x * np.cos(angle), radius_y * np.sin(angle), np.full(num_images, _EYE_HEIGHT_M)], 1)
        yaw, pitch, roll = np.deg2rad(np.array(_SWAY_DEG)[:, None] * sway[3:])
        world_from_cam = np.empty((num_images, 3, 4))
        world_from_cam[:, :, :3] = _view_rotations(
            angle + np.deg2rad(_AHEAD_DEG) + yaw, np.deg2rad(_TILT_DEG) + pitch, roll
        )
        world_from_cam[:, :, 3] = loop + _SWAY_M * sway[:3].T
        return world_from_cam


def write_demo(folder: Path, *, num_images: int = 120, width: int = 640, height: int = 480, seed: int = 0) -> None:
    """Write ``images/000000.jpg`` and on, ``poses.txt`` and ``intrinsics.txt`` into ``folder``.

    ``poses.txt`` has one line ``image qw qx qy qz tx ty tz`` per image, camera to world, in metres;
    ``intrinsics.txt`` has ``width height fx fy cx cy``, the centre of the first pixel at (0.5, 0.5).

    Raises:
        ConfigError: fewer than two images, or an image without pixels.
        StorageError: the folder cannot be written.
    """
    _check_size(num_images, width, height)
    intrinsics = demo_intrinsics(width, height)
    names = [f"{k:06d}.jpg" for k in range(num_images)]
    try:
        (folder / "images").mkdir(parents=True, exist_ok=True)
        scene = DemoScene(seed)
        world_from_cams = scene.camera_path(num_images)
        for name, world_from_cam in zip(names, world_from_cams, strict=True):
            rgb, _ = scene.render(world_from_cam, intrinsics)
            Image.fromarray(rgb).save(folder / "images" / name, quality=_PHOTOGRAPH_QUALITY)
        (folder / "poses.txt").write_text(_poses_text(names, world_from_cams), encoding="utf-8")
        (folder / "intrinsics.txt").write_text(_intrinsics_text(intrinsics), encoding="utf-8")
    except OSError as error:
        raise StorageError(f"{folder}: cannot write the demo: {error}") from error


def _check_size(num_images: int, width: int = 1, height: int = 1) -> None:
    if num_images < 2:
        raise ConfigError(f"a demo of {num_images} images: needs at least 2")
    if width < 1 or height < 1:
        raise ConfigError(f"a demo of {width}x{height} pixels: needs at least 1x1")


def _poses_text(names: list[str], world_from_cams: FloatArray) -> str:
    """The lines of ``poses.txt``."""
    lines = ["# image qw qx qy qz tx ty tz  (camera to world, metres; OpenCV axes, world z up)"]
    quats_xyzw = Rotation.from_matrix(world_from_cams[:, :, :3]).as_quat()
    for name, (qx, qy, qz, qw), centre in zip(names, quats_xyzw, world_from_cams[:, :, 3], strict=True):
        lines.append(" ".join([name, *(f"{value:.12g}" for value in (qw, qx, qy, qz, *centre))]))
    return "\n".join(lines) + "\n"


def _intrinsics_text(intrinsics: Intrinsics) -> str:
    """The lines of ``intrinsics.txt``."""
    numbers = " ".join(f"{value:.12g}" for value in (intrinsics.width, intrinsics.height, *intrinsics.params))
    return f"# width height fx fy cx cy (the centre of the first pixel is (0.5, 0.5))\n{numbers}\n"


# ----------------------------------------------------------------------------- camera
def _sway(rng: np.random.Generator, round_trip: FloatArray) -> FloatArray:
    """(6, N) smooth periodic wandering of position and angles, each within [-1, 1]."""
    phases = rng.uniform(0, 1, (6, len(_SWAY_FREQUENCIES), 1))
    waves = np.sin(2 * np.pi * (np.array(_SWAY_FREQUENCIES)[:, None] * round_trip + phases))
    mean: FloatArray = waves.mean(axis=1)
    return mean


def _view_rotations(yaw: FloatArray, pitch: FloatArray, roll: FloatArray) -> FloatArray:
    """``world_from_cam`` rotations (N, 3, 3) looking at ``yaw`` about z up, ``pitch`` upwards, in radians."""
    forward = np.stack([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)], axis=-1)
    right = np.stack([np.sin(yaw), -np.cos(yaw), np.zeros_like(yaw)], axis=-1)
    level = np.stack([right, np.cross(forward, right), forward], axis=-1)
    rolled: FloatArray = level @ Rotation.from_rotvec(roll[:, None] * np.array([0.0, 0.0, 1.0])).as_matrix()
    return rolled


# ------------------------------------------------------------------------ ray casting
@dataclass(frozen=True, kw_only=True, eq=False)
class _Hits:
    """Where the ray of each pixel ends.

    Args:
        points_world: (3, H, W) float32.
        depth: (H, W) float32 z-depth in metres.
        face: (H, W) number of the face, ``6 * box + 2 * axis + side``.
        slope: (H, W) float32; metres along the face's normal per metre of depth.
    """

    points_world: Float32Array
    depth: Float32Array
    face: IntArray
    slope: Float32Array


def _check_view(world_from_cam: FloatArray, intrinsics: Intrinsics) -> None:
    if intrinsics.model != "PINHOLE":
        raise ValueError(f"DemoScene: camera model {intrinsics.model}, needed PINHOLE")
    if world_from_cam.shape != (3, 4):
        raise ValueError(f"DemoScene: pose is {world_from_cam.shape}, needed (3, 4)")
    centre = world_from_cam[:, 3]
    in_room, *in_furniture = np.all((centre > _BOXES[:, 0]) & (centre < _BOXES[:, 1]), axis=1).tolist()
    if not in_room or any(in_furniture):
        raise ValueError(f"DemoScene: camera at {centre} is not in the free space of the room")


def _strips(intrinsics: Intrinsics) -> list[Intrinsics]:
    """The camera cut into strips of some rows, because what fits the processor's cache is traced in half the time."""
    fx, fy, cx, cy = intrinsics.params
    return [
        replace(intrinsics, height=min(_STRIP_ROWS, intrinsics.height - top), params=(fx, fy, cx, cy - top))
        for top in range(0, intrinsics.height, _STRIP_ROWS)
    ]


def _trace(world_from_cam: FloatArray, intrinsics: Intrinsics) -> _Hits:
    """The first surface behind every pixel of a PINHOLE camera, by slab tests against all boxes.

    Source: Kay and Kajiya 1986, "Ray tracing complex scenes"; a step along a ray is a step in
    z-depth because directions have z = 1 in the camera.
    """
    fx, fy, cx, cy = intrinsics.params
    rotation = world_from_cam[:, :3].astype(np.float32)
    centre = world_from_cam[:, 3].astype(np.float32)
    x = ((np.arange(intrinsics.width) + 0.5 - cx) / fx).astype(np.float32)
    y = ((np.arange(intrinsics.height) + 0.5 - cy) / fy).astype(np.float32)
    directions = rotation[:, 0, None, None] * x + (rotation[:, 1, None] * y + rotation[:, 2, None])[:, :, None]
    directions[directions == 0] = 1e-9  # a ray parallel to a wall meets it a thousand million metres away
    inverse: Float32Array = np.reciprocal(directions)

    exits: Float32Array = np.where(directions > 0, _bound(0, 1, centre), _bound(0, 0, centre)) * inverse
    depth: Float32Array = np.minimum(np.minimum(exits[0], exits[1]), exits[2])
    axis = np.where(exits[2] == depth, 2, exits[1] == depth)
    face: IntArray = 2 * axis + (_component(directions, axis) > 0)
    for box, (rows, columns) in _windows(world_from_cam, intrinsics):
        _hit_box(box, centre, inverse[:, rows, columns], depth[rows, columns], face[rows, columns])

    return _Hits(
        points_world=centre[:, None, None] + depth * directions,
        depth=depth,
        face=face,
        slope=np.abs(_component(directions, _NORMAL_AXIS[face])),
    )


def _bound(box: int, side: int, centre: Float32Array) -> Float32Array:
    """(3, 1, 1) from the camera to the lower (0) or upper (1) corner of a box."""
    corner: Float32Array = (_BOXES[box, side].astype(np.float32) - centre)[:, None, None]
    return corner


def _hit_box(box: int, centre: Float32Array, inverse: Float32Array, depth: Float32Array, face: IntArray) -> None:
    """Lower ``depth`` and set ``face``, both in place, where a box seen from outside comes first."""
    first, second = _bound(box, 0, centre) * inverse, _bound(box, 1, centre) * inverse
    near = np.minimum(first, second)
    far = np.maximum(first, second, out=first)
    entry = np.maximum(np.maximum(near[0], near[1]), near[2])
    leave = np.minimum(np.minimum(far[0], far[1]), far[2])
    rows, columns = np.nonzero((entry < leave) & (entry > 0) & (entry < depth))
    depth[rows, columns] = entry[rows, columns]
    axis = near[:, rows, columns].argmax(axis=0)
    face[rows, columns] = 6 * box + 2 * axis + (inverse[axis, rows, columns] < 0)


def _windows(world_from_cam: FloatArray, intrinsics: Intrinsics) -> Iterator[tuple[int, tuple[slice, slice]]]:
    """Each submodel of furniture in view, with the rows and columns that it can cover."""
    fx, fy, cx, cy = intrinsics.params
    size = (intrinsics.width, intrinsics.height)
    corners_cam = (_CORNERS - world_from_cam[:, 3]) @ world_from_cam[:, :3]
    for box in range(1, len(_BOXES)):
        x, y, z = corners_cam[box].T
        left, top, right, bottom = 0, 0, *size
        if z.min() > 0.01:  # otherwise it is partly behind the camera and may cover anything
            xy = np.array([x / z * fx + cx, y / z * fy + cy])
            left, top = np.clip(np.floor(xy.min(axis=1)).astype(int), 0, size).tolist()
            right, bottom = np.clip(np.ceil(xy.max(axis=1)).astype(int), 0, size).tolist()
        if z.max() > 0 and left < right and top < bottom:
            yield box, (slice(top, bottom), slice(left, right))


def _component(vectors: Float32Array, axis: IntArray) -> Float32Array:
    """(H, W) the component of vectors (3, H, W) that is named for each pixel."""
    component: Float32Array = np.where(axis == 0, vectors[0], np.where(axis == 1, vectors[1], vectors[2]))
    return component


# --------------------------------------------------------------------------- textures
@dataclass(frozen=True, kw_only=True, eq=False)
class _Atlas:
    """The textures of all faces in one image, with coarser copies of it to the right.

    Args:
        rgb: level 0 on the left, level k reduced by 2**k on the right, one above the other.
        level_xy: (levels, 2) texel where each level begins.
        uv_axes: (faces, 2) world axes along a texture's columns and rows.
        texels_per_m: (faces, 2) with sign, so that the rows of a wall run downwards.
        origin_xy: (faces, 2) level-0 texel at the world's zero.
    """

    rgb: UInt8Array
    level_xy: IntArray
    uv_axes: IntArray
    texels_per_m: Float32Array
    origin_xy: Float32Array

    def colours(self, hits: _Hits, *, pixels_per_unit: float) -> UInt8Array:
        """(H, W, 3) colours, trilinear between the two levels nearest to the size of a pixel.

        A pixel covers depth^2 / (focal^2 * slope) of the surface: the area of its ray's cross
        section over the cosine of incidence.
        """
        side_m = hits.depth / (pixels_per_unit * np.sqrt(hits.slope))
        level = np.clip(np.log2(side_m / _TEXEL_M), 0, _LEVELS - 1.001)
        finer = level.astype(np.intp)
        xy = [self._texels(hits, column) for column in (0, 1)]
        fraction = (level - finer).astype(np.float32)[:, :, None]
        mixed = self._sample(xy, finer) * (1 - fraction) + self._sample(xy, finer + 1) * fraction
        rounded: UInt8Array = (mixed + 0.5).astype(np.uint8)
        return rounded

    def _texels(self, hits: _Hits, column: int) -> Float32Array:
        """(H, W) level-0 coordinate of each hit along a texture's columns (0) or rows (1)."""
        metres = _component(hits.points_world, self.uv_axes[:, column][hits.face])
        texels: Float32Array = metres * self.texels_per_m[:, column][hits.face] + self.origin_xy[:, column][hits.face]
        return texels

    def _sample(self, xy: list[Float32Array], level: IntArray) -> Float32Array:
        """(H, W, 3) bilinear colours at level-0 coordinates, looked up in the given levels."""
        reduction = np.exp2(-np.arange(_LEVELS)).astype(np.float32)[level]
        x, y = (xy[k] * reduction + (self.level_xy[:, k].astype(np.float32) - 0.5)[level] for k in (0, 1))
        return np.asarray(cv2.remap(self.rgb, x, y, cv2.INTER_LINEAR), dtype=np.float32)


def _paint_atlas(rng: np.random.Generator) -> _Atlas:
    """Paint every face of every box and pack the pictures on shelves, tallest first."""
    uv_axes = np.tile([[1, 2], [1, 2], [0, 2], [0, 2], [0, 1], [0, 1]], (len(_BOXES), 1))
    box_of_face = np.repeat(np.arange(len(_BOXES)), 6)
    lower = np.take_along_axis(_BOXES[box_of_face, 0], uv_axes, axis=1)
    upper = np.take_along_axis(_BOXES[box_of_face, 1], uv_axes, axis=1)
    size_xy = np.ceil((upper - lower) / _TEXEL_M).astype(int)
    corner_xy, height = _shelves(size_xy + 2 * _PADDING)

    level0 = np.zeros((height, _ATLAS_WIDTH, 3), dtype=np.uint8)
    for face, ((x, y), (columns, rows)) in enumerate(zip(corner_xy, size_xy, strict=True)):
        picture = _paint_face(rng, face, rows, columns)
        padded = np.pad(picture, ((_PADDING, _PADDING), (_PADDING, _PADDING), (0, 0)), mode="edge")
        level0[y : y + padded.shape[0], x : x + padded.shape[1]] = padded

    # Rows of a wall run downwards (from its upper edge), everything else along the world's axis.
    downwards = uv_axes == 2
    texels_per_m = np.where(downwards, -1, 1) / _TEXEL_M
    first_m = np.where(downwards, upper, lower)
    rgb, level_xy = _with_coarser_levels(level0)
    return _Atlas(
        rgb=rgb,
        level_xy=level_xy,
        uv_axes=uv_axes,
        texels_per_m=texels_per_m.astype(np.float32),
        origin_xy=(corner_xy + _PADDING - first_m * texels_per_m).astype(np.float32),
    )


def _shelves(size_xy: IntArray) -> tuple[IntArray, int]:
    """Corners (faces, 2) of rectangles laid out in rows, on multiples of the padding, and the height used."""
    cell_xy = -(-size_xy // _PADDING) * _PADDING
    corner_xy = np.zeros_like(cell_xy)
    x = y = shelf = 0
    for face in np.argsort(-cell_xy[:, 1], kind="stable"):
        columns, rows = cell_xy[face]
        if x + columns > _ATLAS_WIDTH:
            x, y, shelf = 0, y + shelf, 0
        corner_xy[face] = x, y
        x, shelf = x + columns, max(shelf, rows)
    return corner_xy, y + shelf


def _with_coarser_levels(level0: UInt8Array) -> tuple[UInt8Array, IntArray]:
    """The atlas with its coarser copies, and where each level begins."""
    height = len(level0)
    rgb = np.zeros((height, _ATLAS_WIDTH * 3 // 2, 3), dtype=np.uint8)
    level_xy = np.zeros((_LEVELS, 2), dtype=np.intp)
    level, top = level0, 0
    rgb[:, :_ATLAS_WIDTH] = level0
    for k in range(1, _LEVELS):
        level = np.asarray(cv2.resize(level, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        level_xy[k] = _ATLAS_WIDTH, top
        rgb[top : top + len(level), _ATLAS_WIDTH : _ATLAS_WIDTH + level.shape[1]] = level
        top += len(level)
    return rgb, level_xy


def _paint_face(rng: np.random.Generator, face: int, rows: int, columns: int) -> UInt8Array:
    """(rows, columns, 3) of one face: pattern, then grain of all sizes, then things stuck on it."""
    picture = np.empty((rows, columns, 3), dtype=np.float32)
    picture[:] = rng.uniform(95, 185, 3)
    is_brick_wall, is_floor = face in (0, 3), face == 4
    if is_brick_wall:
        _lay_bricks(rng, picture, rows=18, columns=55, joint=3)
    elif is_floor:
        _lay_bricks(rng, picture, rows=40, columns=260, joint=1)
    picture += _grain(rng, rows, columns)
    for _ in range(round(rows * columns * _TEXEL_M**2 * 3)):
        _stick_poster(rng, picture)
    for _ in range(round(rows * columns * _TEXEL_M**2 * 8)):
        _write_words(rng, picture)
    finished: UInt8Array = np.clip(picture, 0, 255).astype(np.uint8)
    return finished


def _grain(rng: np.random.Generator, rows: int, columns: int) -> Float32Array:
    """(rows, columns, 1) noise of equal strength in every octave, so that features exist at every distance."""
    total = np.zeros((rows, columns), dtype=np.float32)
    for cell in (2, 4, 8, 16, 32, 64, 128):
        coarse_rows, coarse_columns = rows // cell + 2, columns // cell + 2
        coarse = rng.normal(0, 9, (coarse_rows, coarse_columns)).astype(np.float32)
        wide = cv2.resize(coarse, (coarse_columns * cell, coarse_rows * cell), interpolation=cv2.INTER_CUBIC)
        total += wide[:rows, :columns]
    return total[:, :, None]


def _lay_bricks(rng: np.random.Generator, picture: Float32Array, *, rows: int, columns: int, joint: int) -> None:
    """Courses of bricks of ``rows`` x ``columns`` texels, each of its own tone, so that no two places are alike."""
    for course, y in enumerate(range(0, picture.shape[0], rows)):
        shift = course % 2 * columns // 2
        for x in range(-shift, picture.shape[1], columns):
            brick = picture[y : y + rows - joint, max(x, 0) : x + columns - joint]
            brick += rng.normal(0, 16) + rng.normal(0, 6, 3)
        picture[y + rows - joint : y + rows] -= 25


def _stick_poster(rng: np.random.Generator, picture: Float32Array) -> None:
    """A rectangle of 8 to 60 cm with discs, bars and triangles of random colours on it."""
    rows, columns = picture.shape[:2]
    size = np.exp(rng.uniform(np.log(20), np.log(150), 2)).astype(int)
    width, height = int(min(size[0], columns)), int(min(size[1], rows))
    x, y = int(rng.integers(0, columns - width + 1)), int(rng.integers(0, rows - height + 1))
    poster = np.ascontiguousarray(picture[y : y + height, x : x + width])
    poster[:] = 0.3 * poster + 0.7 * rng.uniform(40, 230, 3)
    for _ in range(int(rng.integers(4, 12))):
        corners = (rng.uniform(0, 1, (3, 2)) * (width, height)).astype(np.int32)
        colour = rng.uniform(20, 240, 3).tolist()
        match rng.integers(3):
            case 0:
                cv2.circle(poster, corners[0].tolist(), int(rng.integers(2, 5 + height // 4)), colour, -1)
            case 1:
                cv2.rectangle(poster, corners[0].tolist(), corners[1].tolist(), colour, -1)
            case _:
                cv2.fillPoly(poster, [corners], colour)
    picture[y : y + height, x : x + width] = poster


def _write_words(rng: np.random.Generator, picture: Float32Array) -> None:
    """A line of made-up letters, each a pattern of 5 x 3 dots of 4 to 20 mm, cut off at the edge of the face."""
    rows, columns = picture.shape[:2]
    dot = int(rng.integers(1, 6))
    letters = rng.random((5, int(rng.integers(2, 8)), 4)) < 0.6
    letters[:, :, 3] = False  # the gap between two letters
    ink = np.kron(letters.reshape(5, -1), np.ones((dot, dot), dtype=bool))
    x, y = int(rng.integers(0, columns)), int(rng.integers(0, rows))
    place = picture[y : y + ink.shape[0], x : x + ink.shape[1]]
    place[ink[: place.shape[0], : place.shape[1]]] = rng.uniform(10, 245, 3)
