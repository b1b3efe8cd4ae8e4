"""Scenes with known truth for the tests of refinement: cameras, points, and the features and matches of a run."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pycolmap
from PIL import Image
from scipy.spatial.transform import Rotation

from smust3r_colmap.colmap.database import write_images
from smust3r_colmap.geometry.arrays import FloatArray, IntArray, Pair
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.geometry.world_frame import WorldFrame
from smust3r_colmap.products import EMPTY_CLOUD, ImageCollection, Scene, SourceImage

CAMERA = Intrinsics(model="SIMPLE_RADIAL", width=640, height=480, params=(560.0, 320.0, 240.0, -0.04))
COLOUR = (200, 120, 40)
"""Of every pixel of every image."""

Matches = Mapping[Pair, npt.NDArray[np.uint32]]


@dataclass(frozen=True, kw_only=True, eq=False)
class World:
    """What really is there, and what the images see of it.

    Args:
        cam_from_world: (N, 3, 4) true poses.
        points: (P, 3) true points.
        keypoints: per image (K, 2), with noise.
        point_of: per image (K,) which point each keypoint shows, -1 for none.
    """

    cam_from_world: FloatArray
    points: FloatArray
    keypoints: tuple[npt.NDArray[np.float32], ...]
    point_of: tuple[IntArray, ...]

    def __len__(self) -> int:
        return len(self.cam_from_world)

    @property
    def centres(self) -> FloatArray:
        """(N, 3) of the true cameras."""
        return centres_of(self.cam_from_world)

    @property
    def extent(self) -> float:
        """Of the path of the cameras."""
        return float(np.linalg.norm(np.ptp(self.centres, axis=0)))


def centres_of(cam_from_world: FloatArray) -> FloatArray:
    """(N, 3) in the world."""
    return invert_rigid(cam_from_world)[:, :, 3]


def cam_from_world_towards(centres: FloatArray, target: FloatArray) -> FloatArray:
    """(N, 3, 4) of upright cameras at ``centres`` that look at ``target`` (3,) or (N, 3); y points down."""
    forward = target - centres
    forward = forward / np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(np.array([0.0, 1.0, 0.0]), forward)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    cam_from_world_rotation = np.stack([right, np.cross(forward, right), forward], axis=1)
    translation = -np.einsum("nij,nj->ni", cam_from_world_rotation, centres)
    return np.concatenate([cam_from_world_rotation, translation[:, :, None]], axis=2)


def arc(num_images: int, *, angle: float = 0.6 * np.pi) -> FloatArray:
    """(N, 3, 4) cameras on an arc of radius 4 around the origin, at changing height."""
    phi = np.linspace(0, angle, num_images)
    centres = np.column_stack([4 * np.sin(phi), 0.5 * np.sin(5 * phi), -4 * np.cos(phi)])
    return cam_from_world_towards(centres, np.zeros(3))


def straight(num_images: int, *, step: float = 0.25) -> FloatArray:
    """(N, 3, 4) cameras on a line along x that all look along z."""
    centres = np.column_stack([step * np.arange(num_images), np.zeros((num_images, 2))])
    return cam_from_world_towards(centres, centres + np.array([0.0, 0.0, 1.0]))


def turning(num_images: int) -> FloatArray:
    """(N, 3, 4) cameras in one place that turn."""
    phi = np.linspace(0, 0.5, num_images)
    return cam_from_world_towards(np.zeros((num_images, 3)), np.column_stack([np.sin(phi), 0 * phi, np.cos(phi)]))


def ball(num_points: int, rng: np.random.Generator) -> FloatArray:
    """(P, 3) points in the unit ball around the origin."""
    directions = rng.normal(size=(num_points, 3))
    unit: FloatArray = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    return unit * rng.uniform(0.3, 1, (num_points, 1))


def make_world(
    cam_from_world: FloatArray,
    points: FloatArray,
    rng: np.random.Generator,
    *,
    noise_px: float = 0.3,
    seen_part: float = 0.7,
    clutter: int = 20,
    camera: Intrinsics = CAMERA,
) -> World:
    """Project the points into all images; each image misses some of them and has ``clutter`` features of nothing."""
    keypoints, point_of = [], []
    for pose in cam_from_world:
        xy = camera.xy_img(points @ pose[:, :3].T + pose[:, 3])
        inside = np.isfinite(xy).all(axis=1) & (xy >= 0).all(axis=1) & (xy < (camera.width, camera.height)).all(axis=1)
        seen = np.flatnonzero(inside & (rng.uniform(size=len(points)) < seen_part))
        nothing = rng.uniform((0, 0), (camera.width, camera.height), (clutter, 2))
        place = np.concatenate([xy[seen] + rng.normal(scale=noise_px, size=(len(seen), 2)), nothing])
        order = rng.permutation(len(place))
        keypoints.append(place[order].astype(np.float32))
        point_of.append(np.concatenate([seen, np.full(clutter, -1)])[order])
    return World(cam_from_world=cam_from_world, points=points, keypoints=tuple(keypoints), point_of=tuple(point_of))


def true_matches(world: World, pair: Pair) -> npt.NDArray[np.uint32]:
    """(M, 2) rows of the keypoints that show the same point."""
    a, b = (world.point_of[image] for image in pair)
    _, rows_a, rows_b = np.intersect1d(np.where(a < 0, -1, a), np.where(b < 0, -2, b), return_indices=True)
    return np.column_stack([rows_a, rows_b]).astype(np.uint32)


def wrong_matches(world: World, pair: Pair, num_matches: int, rng: np.random.Generator) -> npt.NDArray[np.uint32]:
    """(M, 2) rows that have nothing to do with each other; no keypoint twice."""
    sides = [rng.permutation(len(world.keypoints[image]))[:num_matches] for image in pair]
    return np.column_stack(sides).astype(np.uint32)


def pairs_within(images: Iterable[int], reach: int) -> list[Pair]:
    """All pairs (i < j) at most ``reach`` apart in order."""
    return [(i, j) for i, j in combinations(sorted(images), 2) if j - i <= reach]


def make_collection(
    folder: Path,
    num_images: int,
    *,
    names: Mapping[int, str] | None = None,
    cameras: tuple[Intrinsics, ...] = (CAMERA,),
    camera_of: Mapping[int, int] | None = None,
    calibrated: bool = False,
) -> ImageCollection:
    """Images of one colour; all of one size are the same file."""
    paths = []
    for number, camera in enumerate(cameras):
        paths.append(folder / f"colour_{number}.png")
        Image.new("RGB", (camera.width, camera.height), COLOUR).save(paths[-1], compress_level=1)
    which = [(camera_of or {}).get(i, 0) for i in range(num_images)]
    return ImageCollection(
        images=tuple(
            SourceImage(
                name=(names or {}).get(i, f"{i:04d}.png"),
                path=paths[camera],
                width=cameras[camera].width,
                height=cameras[camera].height,
                camera=camera,
                digest=str(i),
            )
            for i, camera in enumerate(which)
        ),
        cameras=cameras,
        calibrated=calibrated,
    )


def write_features(
    path: Path,
    collection: ImageCollection,
    world: World,
    *,
    verified: Matches,
    raw: Matches | None = None,
    without_features: Collection[int] = (),
) -> None:
    """A run's database as extraction and matching leave it; ``raw`` are matches of further, unverified pairs."""
    with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
        cameras = [(i, image.camera) for i, image in enumerate(collection.images)]
        write_images(database, collection.cameras, cameras)
        for i, xy in enumerate(world.keypoints):
            if i not in without_features:
                database.write_keypoints(i + 1, np.column_stack([xy, np.ones(len(xy)), np.zeros(len(xy))]))
        everything = {**verified, **(raw or {})}
        for (i, j), rows in everything.items():
            database.write_matches(i + 1, j + 1, rows)
            inliers = rows if (i, j) in verified else np.empty((0, 2), np.uint32)
            config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
            if not len(inliers):
                config = pycolmap.TwoViewGeometryConfiguration.DEGENERATE
            geometry = pycolmap.TwoViewGeometry(config=int(config), inlier_matches=inliers)
            database.write_two_view_geometry(i + 1, j + 1, geometry)


def disturbed(
    cam_from_world: FloatArray, rng: np.random.Generator, *, position: float, rotation_deg: float
) -> FloatArray:
    """(N, 3, 4) each camera moved by a normal error of ``position`` in each axis, and turned."""
    world_from_cam = invert_rigid(cam_from_world)
    turns = Rotation.from_rotvec(np.deg2rad(rotation_deg) / np.sqrt(3) * rng.normal(size=(len(cam_from_world), 3)))
    rotations = world_from_cam[:, :, :3] @ turns.as_matrix()
    moved = world_from_cam[:, :, 3] + rng.normal(scale=position, size=(len(cam_from_world), 3))
    return invert_rigid(np.concatenate([rotations, moved[:, :, None]], axis=2))


def disturbed_around_the_truth(world: World, rng: np.random.Generator) -> FloatArray:
    """By 1 % of the extent in each axis and half a degree; a best fit to the truth finds the centres in its frame."""
    off = invert_rigid(disturbed(world.cam_from_world, rng, position=0.01 * world.extent, rotation_deg=0.5))
    fit = similarity(world.centres, off[:, :, 3]).inverse()
    off[:, :, 3] = off[:, :, 3] @ (fit.scale * fit.rotation.matrix()).T + fit.translation
    return invert_rigid(off)


def model_with_true_tracks(
    world: World, cam_from_world: FloatArray, rng: np.random.Generator, *, camera: Intrinsics = CAMERA, noise: float
) -> pycolmap.Reconstruction:
    """The images at (N, 3, 4) poses and every point that two of them see, off by ``noise`` in each axis."""
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera.colmap_camera())
    for i, (keypoints, pose) in enumerate(zip(world.keypoints, cam_from_world, strict=True)):
        image = pycolmap.Image(name=f"{i:04d}.png", keypoints=keypoints.astype(np.float64), camera_id=1, image_id=i + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
    tracks: dict[int, pycolmap.Track] = {}
    for i, of in enumerate(world.point_of):
        for row in np.flatnonzero(of >= 0).tolist():
            tracks.setdefault(int(of[row]), pycolmap.Track()).add_element(i + 1, row)
    for point, track in sorted(tracks.items()):
        if track.length() > 1:
            model.add_point3D(world.points[point] + rng.normal(scale=noise, size=3), track)
    return model


def similarity(points_a: FloatArray, points_b: FloatArray) -> pycolmap.Sim3d:
    """``b_from_a`` that fits best."""
    fit = pycolmap.estimate_sim3d(points_a, points_b)
    assert fit is not None, "points in one plane, to the last digit, have none for pycolmap"
    return fit


def fitted(points: FloatArray, like: FloatArray) -> tuple[float, FloatArray]:
    """The scale of the best similarity that takes ``points`` to ``like``, and where it takes them."""
    fit = similarity(points, like)
    return float(fit.scale), points @ (float(fit.scale) * fit.rotation.matrix()).T + fit.translation


def rms(points_a: FloatArray, points_b: FloatArray) -> float:
    """Distance of equal rows."""
    return float(np.sqrt(((points_a - points_b) ** 2).sum(axis=1).mean()))


def stitched_scene(
    collection: ImageCollection,
    cam_from_world: FloatArray,
    images: Iterable[int] | None = None,
    cameras: Mapping[int, Intrinsics] | None = None,
) -> Scene:
    """The given images of all, with their poses; ``cam_from_world`` is of all images."""
    indices = tuple(range(len(collection)) if images is None else images)
    of = [collection.images[i] for i in indices]
    return Scene(
        image_indices=indices,
        image_names=tuple(image.name for image in of),
        camera_indices=tuple(image.camera for image in of),
        cameras=dict(cameras or enumerate(collection.cameras)),
        cam_from_world=cam_from_world[list(indices)],
        points=EMPTY_CLOUD,
        frame=WorldFrame(metric=True),
        segments=("0",),
    )


def poses_of(model: pycolmap.Reconstruction) -> dict[int, FloatArray]:
    """(3, 4) ``cam_from_world`` by image index."""
    return {i - 1: model.image(i).cam_from_world().matrix() for i in sorted(model.reg_image_ids())}


def rig_from_world(model: pycolmap.Reconstruction, frame_id: int) -> pycolmap.Rigid3d:
    """Of a frame that has a pose."""
    pose = model.frame(frame_id).rig_from_world
    assert pose is not None
    return pose


def angle_deg(pose_a: FloatArray, pose_b: FloatArray) -> float:
    """Between two rotations."""
    return float(np.rad2deg(Rotation.from_matrix(pose_a[:, :3] @ pose_b[:, :3].T).magnitude()))
