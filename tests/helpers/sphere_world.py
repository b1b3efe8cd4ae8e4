"""Cameras inside a painted sphere, and submodels of them that are exact or moved on purpose."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from smust3r_colmap.dense.point_cloud import FusedPoints, fuse_points
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.camera import Intrinsics, pixel_centres, pointmap_from_depth
from smust3r_colmap.geometry.sim3 import Sim3, invert_rigid
from smust3r_colmap.geometry.transform import Transform
from smust3r_colmap.products import DenseMaps, Submodel
from smust3r_colmap.segmentation.view_graph import ViewGraph
from smust3r_colmap.stitching.camera_fusion import FusedCameras, fuse_cameras
from smust3r_colmap.stitching.resection import PlacedSubmodel, place_submodel

CAMERA = Intrinsics(model="SIMPLE_RADIAL", width=640, height=480, params=(600, 320, 240, -0.05))
NUM_IMAGES = 14
ORDER = ViewGraph.chain(100)
WINDOWS = (range(0, 7), range(3, 10), range(7, 14))
MAP_SIZES = ((48, 36), (64, 48))  # maps of different images may differ in size


def sphere_cameras() -> FloatArray:
    """``world_from_cam`` on an arc of radius 3, looking at the origin."""
    angles = np.linspace(0, 0.6 * np.pi, NUM_IMAGES)
    rotations = Rotation.from_rotvec(np.column_stack([0.2 * np.sin(3 * angles), angles, 0 * angles])).as_matrix()
    centres = np.einsum("nij,j->ni", rotations, [0.0, 0.0, -3.0])
    return np.concatenate([rotations, centres[:, :, None]], axis=2)


def sphere_depth(camera: Intrinsics, world_from_cam: FloatArray) -> npt.NDArray[np.float32]:
    """(H, W) z-depth of the unit sphere at the origin, 0 beside it."""
    rays = camera.rays_cam(pixel_centres(camera.width, camera.height))
    centre_cam = invert_rigid(world_from_cam)[:, 3]
    a, b, c = (rays**2).sum(axis=1), rays @ centre_cam, centre_cam @ centre_cam - 1
    discriminant = b**2 - a * c
    with np.errstate(invalid="ignore"):
        depth = np.where(discriminant > 0, (b - np.sqrt(discriminant)) / a, 0)
    return depth.reshape(camera.height, camera.width).astype(np.float32)


def paint(points_world: FloatArray) -> npt.NDArray[np.uint8]:
    """A colour that changes slowly with the place."""
    return np.rint(np.clip(127.5 * (1 + np.nan_to_num(points_world)), 0, 255)).astype(np.uint8)


@dataclass
class MapsInMemory:
    """``DenseMaps`` as lists."""

    pointmaps: list[npt.NDArray[np.float32]]
    confidences: list[npt.NDArray[np.float32]]
    colours: list[npt.NDArray[np.uint8]]

    def __len__(self) -> int:
        return len(self.pointmaps)

    def pointmap_seg(self, k: int) -> npt.NDArray[np.float32]:
        return self.pointmaps[k]

    def depth(self, k: int) -> npt.NDArray[np.float32]:
        raise AssertionError("fusion goes by the pointmap, which may carry more than depth")

    def confidence(self, k: int) -> npt.NDArray[np.float32]:
        return self.confidences[k]

    def rgb(self, k: int) -> npt.NDArray[np.uint8]:
        return self.colours[k]


@dataclass
class World:
    world_from_cam: FloatArray
    submodels: list[Submodel]
    world_from_seg: Sequence[Transform]
    dense: list[MapsInMemory]

    def placed(self, loops: Collection[int] = ()) -> list[PlacedSubmodel]:
        """The submodels in the world; those at the positions ``loops`` are of loop segments."""
        parts = zip(self.submodels, self.dense, self.world_from_seg, strict=True)
        return [place_submodel(*part, is_loop=position in loops) for position, part in enumerate(parts)]

    def cameras(self) -> FusedCameras:
        return fuse_cameras(self.placed(), ORDER)

    def points(self, *, max_points: int = 20_000, min_confidence: float = 2.0) -> FusedPoints:
        maps: Sequence[DenseMaps] = self.dense
        return fuse_points(
            self.placed(),
            maps,
            self.cameras(),
            max_points=max_points,
            min_confidence=min_confidence,
        )


def gauges(count: int) -> list[Sim3]:
    """``world_from_seg``, the first the identity."""
    rng = np.random.default_rng(11)
    others = [
        Sim3(
            scale=np.array(rng.uniform(0.3, 3)),
            rotation=Rotation.random(rng=rng).as_matrix(),
            translation=rng.normal(size=3),
        )
        for _ in range(count - 1)
    ]
    return [Sim3.identity(), *others]


def make_submodel(segment: int, images: Sequence[int], seg_from_cam: FloatArray) -> Submodel:
    return Submodel(
        segment=segment,
        submodel=0,
        images=tuple(images),
        seg_from_cam=seg_from_cam,
        intrinsics=(CAMERA,) * len(images),
        method="made up",
        reprojection_error_px=float("nan"),
        tracks=None,
    )


def make_world(windows: Sequence[Sequence[int]] = WINDOWS) -> World:
    world_from_cam = sphere_cameras()
    world_from_seg = gauges(len(windows))
    submodels, dense = [], []
    for segment, (images, world_from) in enumerate(zip(windows, world_from_seg, strict=True)):
        seg_from_cam = world_from.inverse().move_cameras(world_from_cam[list(images)])
        submodels.append(make_submodel(segment, images, seg_from_cam))
        maps = MapsInMemory([], [], [])
        for image, pose in zip(images, seg_from_cam, strict=True):
            camera = CAMERA.resized(*MAP_SIZES[image % 2])
            depth = sphere_depth(camera, world_from_cam[image])
            maps.pointmaps.append(pointmap_from_depth(depth / float(world_from.scale), camera, pose))
            maps.confidences.append(np.where(depth > 0, 5, 1).astype(np.float32))
            maps.colours.append(paint(pointmap_from_depth(depth, camera, world_from_cam[image]).astype(np.float64)))
        dense.append(maps)
    return World(world_from_cam, submodels, world_from_seg, dense)


def moved(world: World, submodel: int, image: int, shift: Sequence[float], turn_deg: float = 0.0) -> World:
    """The same world, where one submodel has one camera wrong by a shift and a turn in world units."""
    k = world.submodels[submodel].images.index(image)
    world_from_cam = world.world_from_seg[submodel].move_cameras(world.submodels[submodel].seg_from_cam)
    world_from_cam[k, :, 3] += shift
    world_from_cam[k, :, :3] @= Rotation.from_euler("y", turn_deg, degrees=True).as_matrix()
    seg_from_cam = world.world_from_seg[submodel].inverse().move_cameras(world_from_cam)
    submodels = list(world.submodels)
    submodels[submodel] = replace(submodels[submodel], seg_from_cam=seg_from_cam)
    return replace(world, submodels=submodels)


def shifted_by(world_from_seg: Transform, shift: FloatArray) -> Sim3:
    matrix = world_from_seg.matrix
    matrix[:3, 3] += shift
    return Sim3.from_matrix(matrix)


def shifted(world: World, submodel: int, shift: Sequence[float]) -> World:
    """The same world, where the whole of one submodel is off by a shift in world units."""
    world_from_seg = list(world.world_from_seg)
    world_from_seg[submodel] = shifted_by(world_from_seg[submodel], np.asarray(shift))
    return replace(world, world_from_seg=world_from_seg)
