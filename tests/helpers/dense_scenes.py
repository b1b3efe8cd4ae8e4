"""A ball before a slanted wall, seen by distorted cameras: exact depth, real tracks, and pictures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pycolmap
from PIL import Image
from scipy.spatial.transform import Rotation

from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.camera import Intrinsics, pixel_centres
from smust3r_colmap.geometry.sim3 import invert_rigid

FloatMap = npt.NDArray[np.float32]

CAMERA = Intrinsics(model="SIMPLE_RADIAL", width=160, height=120, params=(140.0, 82.0, 59.0, -0.1))
BALL_CENTRE, BALL_RADIUS = np.array([0.0, 0.0, 3.5]), 0.6
WALL_NORMAL, WALL_OFFSET = np.array([0.3, 0.1, 1.0]), 5.0  # n . x = offset
NAMES = ("a.jpg", "b.jpg", "left/c d.jpg", "left/e.webp", "f.png", "g.jpg")


@dataclass(frozen=True, eq=False)
class MapsInMemory:
    """``DepthMaps`` of arrays."""

    depths: Mapping[str, FloatMap]
    confidences: Mapping[str, FloatMap]

    def __contains__(self, name: object) -> bool:
        return name in self.depths

    def depth(self, name: str) -> FloatMap:
        return self.depths[name]

    def confidence(self, name: str) -> FloatMap:
        return self.confidences[name]


def maps_of(depths: Mapping[str, FloatMap]) -> MapsInMemory:
    """With confidence everywhere."""
    return MapsInMemory(depths, {name: np.full(depth.shape, 5, np.float32) for name, depth in depths.items()})


def cameras_from_world(count: int = len(NAMES)) -> FloatArray:
    """(N, 3, 4) side by side, 0.25 apart, turned towards the ball."""
    x = 0.25 * (np.arange(count) - (count - 1) / 2)
    rotations = Rotation.from_rotvec(np.outer(-np.arctan2(x, 3.5), [0, 1, 0])).as_matrix()
    centres = np.column_stack([x, 0.05 * np.cos(5 * x), 0 * x])
    return invert_rigid(np.concatenate([rotations, centres[:, :, None]], axis=2))


def surface_depths(camera: Intrinsics, cam_from_world: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(H, W) depth of the ball, inf beside it, and (H, W) of the wall."""
    rotation, translation = cam_from_world[:, :3], cam_from_world[:, 3]
    rays = camera.rays_cam(pixel_centres(camera.width, camera.height))
    centre_cam = rotation @ BALL_CENTRE + translation
    a, b = (rays**2).sum(axis=1), rays @ centre_cam
    under_root = b**2 - a * (centre_cam @ centre_cam - BALL_RADIUS**2)
    ball = np.where(under_root > 0, (b - np.sqrt(np.maximum(under_root, 0))) / a, np.inf)
    normal_cam = rotation @ WALL_NORMAL
    wall = (WALL_OFFSET + normal_cam @ translation) / (rays @ normal_cam)
    return ball.reshape(camera.height, camera.width), wall.reshape(camera.height, camera.width)


def exact_depth(camera: Intrinsics, cam_from_world: FloatArray) -> FloatMap:
    """(H, W) z-depth of what is nearer."""
    return np.minimum(*surface_depths(camera, cam_from_world)).astype(np.float32)


def distance_to_surface(points: FloatArray) -> FloatArray:
    """(N,) from points (N, 3) to the nearer of ball and wall."""
    to_ball = np.abs(np.linalg.norm(points - BALL_CENTRE, axis=1) - BALL_RADIUS)
    to_wall = np.abs(points @ WALL_NORMAL - WALL_OFFSET) / np.linalg.norm(WALL_NORMAL)
    distance: FloatArray = np.minimum(to_ball, to_wall)
    return distance


def paint(points: FloatArray) -> npt.NDArray[np.uint8]:
    """(..., 3) a colour that changes slowly with the place."""
    return np.rint(127.5 * (1 + np.sin(2 * points + [0, 1, 2]))).astype(np.uint8)


def picture(camera: Intrinsics, cam_from_world: FloatArray) -> npt.NDArray[np.uint8]:
    """(H, W, 3) what the camera sees."""
    depth = exact_depth(camera, cam_from_world).astype(np.float64)
    points_cam = camera.rays_cam(pixel_centres(camera.width, camera.height)) * depth.reshape(-1, 1)
    points = (points_cam - cam_from_world[:, 3]) @ cam_from_world[:, :3]
    return paint(points).reshape(camera.height, camera.width, 3)


def exact_maps(width: int = 80, height: int = 60) -> dict[str, FloatMap]:
    """Depth of the distorted images by name, in the unit of the model."""
    return {
        name: exact_depth(CAMERA.resized(width, height), pose)
        for name, pose in zip(NAMES, cameras_from_world(), strict=True)
    }


def exact_model(num_points: int = 400) -> pycolmap.Reconstruction:
    """All images, ids from 1, with points on ball and wall that every camera observes which sees them."""
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(CAMERA.colmap_camera(1))
    poses = cameras_from_world()
    rng = np.random.default_rng(4)
    middle = exact_depth(CAMERA, poses[2])
    xy = rng.uniform(1, [CAMERA.width - 1, CAMERA.height - 1], (num_points, 2))
    z = middle[xy[:, 1].astype(int), xy[:, 0].astype(int)].astype(np.float64)
    rays = CAMERA.rays_cam(np.floor(xy) + 0.5)
    points = (rays * z[:, None] - poses[2, :, 3]) @ poses[2, :, :3]
    seen: list[list[pycolmap.TrackElement]] = [[] for _ in points]
    for i, (name, pose) in enumerate(zip(NAMES, poses, strict=True), start=1):
        xy_img, rows = _visible(points, pose)
        image = pycolmap.Image(name=name, camera_id=1, image_id=i)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(place) for place in xy_img])
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
        for index, row in enumerate(rows):
            seen[row].append(pycolmap.TrackElement(i, index))
    for point, elements in zip(points, seen, strict=True):
        if len(elements) >= 2:
            model.add_point3D(point, pycolmap.Track(elements), paint(point))
    return model


def _visible(points: FloatArray, cam_from_world: FloatArray) -> tuple[FloatArray, npt.NDArray[np.intp]]:
    """Places (M, 2) in the image and rows (M,) of the points that nothing hides."""
    points_cam = points @ cam_from_world[:, :3].T + cam_from_world[:, 3]
    xy = CAMERA.xy_img(points_cam)
    inside = np.all((xy >= 0) & (xy < (CAMERA.width, CAMERA.height)), axis=1)
    column, row = np.where(np.isfinite(xy) & inside[:, None], xy, 0).astype(int).T
    in_front = np.abs(exact_depth(CAMERA, cam_from_world)[row, column] / points_cam[:, 2] - 1) < 0.02
    rows = np.flatnonzero(np.logical_and(inside, in_front))
    return xy[rows], rows


def write_pictures(folder: Path) -> None:
    """The original images under their names; ``g.jpg`` is stored on its side and turned back by EXIF."""
    for name, pose in zip(NAMES, cameras_from_world(), strict=True):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        upright = Image.fromarray(picture(CAMERA, pose))
        if name != "g.jpg":
            upright.save(path, quality=95)
            continue
        exif = Image.Exif()
        exif[0x0112] = 6  # to be turned by 90 degrees clockwise
        upright.transpose(Image.Transpose.ROTATE_90).save(path, quality=95, exif=exif)


def undistorted(model: pycolmap.Reconstruction, max_image_size: int = -1) -> pycolmap.Reconstruction:
    """The same model with the pinhole cameras that COLMAP would give it; observations stay where they were."""
    options = pycolmap.UndistortCameraOptions()
    options.max_image_size = max_image_size
    copy = pycolmap.Reconstruction()
    for camera_id in model.cameras:
        pinhole = pycolmap.undistort_camera(options, model.camera(camera_id))
        pinhole.camera_id = camera_id
        copy.add_camera_with_trivial_rig(pinhole)
    for i in model.reg_image_ids():
        old = model.image(i)
        image = pycolmap.Image(name=old.name, camera_id=old.camera_id, image_id=i)
        copy.add_image_with_trivial_frame(image, old.cam_from_world())
    return copy


def camera_and_pose(model: pycolmap.Reconstruction, name: str) -> tuple[Intrinsics, FloatArray]:
    """Camera and (3, 4) cam_from_world of an image."""
    image = model.find_image_with_name(name)
    return Intrinsics.from_colmap(model.camera(image.camera_id)), np.asarray(image.cam_from_world().matrix())
