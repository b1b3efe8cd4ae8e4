"""Which images, points and observations of an adjusted model a trainer can use, and which are left out.

Trainers fail on, or are misled by, points seen once, images without points, points behind a camera, and cameras or
points so far away that a reader that scales the scene to its extent sees nothing else. Distances are measured in
median distances of a point from the nearest camera that sees it. On nine image sets mapped by COLMAP the neighbouring
cameras of sound models lay at most 2 such distances apart and points at most 25 away; misplaced cameras were 9 to 7000
away. The next module to read is ``training_dataset``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import pycolmap
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from smust3r_colmap.colmap.reconstruction import SparseObservations
from smust3r_colmap.errors import InputError
from smust3r_colmap.exporters.centred_pinhole import CentredPinhole
from smust3r_colmap.geometry.arrays import BoolArray, FloatArray, IntArray

FAR_CAMERA_DISTANCES = 5.0
"""Gap between a camera, or a group of them, and all others from which on it is left out, in median point distances.
Cameras that see a common point are within the sum of their distances to it."""
FAR_POINT_DISTANCES = 30.0
"""Distance of a point to the nearest camera that sees it from which on it is left out, in median distances. COLMAP
keeps points with 1.5 degrees of parallax: then the cameras are 30 / 38 of a median distance apart."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Observations:
    """Who sees which point where.

    Args:
        point: (M,) row of the points. image: (M,) row of the images.
        xy: (M, 2) in the pinhole's image, NaN where it could not be undistorted.
        depth: (M,) z of the point in the camera.
    """

    point: IntArray
    image: IntArray
    xy: FloatArray
    depth: FloatArray

    def __len__(self) -> int:
        return len(self.point)

    def where(self, kept: BoolArray) -> Observations:
        """Those of the given rows."""
        return Observations(point=self.point[kept], image=self.image[kept], xy=self.xy[kept], depth=self.depth[kept])


@dataclass(frozen=True, kw_only=True)
class LeftOut:
    """What was left out.

    Args:
        far_images, unobserved_images: names in the model.
        far_points: points farther than ``FAR_POINT_DISTANCES``, or with a coordinate that is not finite.
        points_of_few_views: points that fewer than two of the images that are left observe.
        observations_behind: of points that are not in front of the camera.
        observations_outside: beyond the border of the undistorted image.
    """

    far_images: tuple[str, ...]
    unobserved_images: tuple[str, ...]
    far_points: int
    points_of_few_views: int
    observations_behind: int
    observations_outside: int


@dataclass(frozen=True, kw_only=True, eq=False)
class Selection:
    """The part of a model that goes to trainers.

    Args:
        image_ids: (N,) ascending; every one observes a point.
        xyz: (P, 3) points in the world, each seen by at least two of the images.
        rgb: (P, 3) their colours.
        observations: rows of ``xyz`` and of ``image_ids``.
        left_out: the rest.
    """

    image_ids: tuple[int, ...]
    xyz: FloatArray
    rgb: npt.NDArray[np.uint8]
    observations: Observations
    left_out: LeftOut


def select_for_training(
    model: pycolmap.Reconstruction, cameras: Mapping[int, CentredPinhole], *, keep_outliers: bool
) -> Selection:
    """The usable part of ``model``, its observations moved into the pinholes' images.

    Args:
        model: with tracks; images without a pose are passed over.
        cameras: by camera id.
        keep_outliers: keep cameras and points however far they are.

    Raises:
        InputError: no point is seen by two images.
    """
    image_ids = np.array(sorted(model.reg_image_ids()), dtype=np.int64)
    centres = np.array([model.image(int(i)).projection_center() for i in image_ids]).reshape(-1, 3)
    tracks = SparseObservations.of(model, image_ids.tolist())
    xyz = tracks.xyz

    far_point = np.asarray(~np.isfinite(xyz).all(axis=1))
    observations = _observations(model, cameras, image_ids, tracks)
    observations = observations.where(~far_point[observations.point])
    in_front: BoolArray = observations.depth > 0
    inside = _inside_image(model, cameras, image_ids, observations)
    observations = observations.where(in_front & inside)

    far_camera: BoolArray = np.zeros(len(centres), np.bool_)
    if not keep_outliers:
        usual = _median_distance(centres, xyz, observations)
        far_camera = _far_from_the_others(centres, FAR_CAMERA_DISTANCES * usual)
        observations = observations.where(~far_camera[observations.image])
        far_point |= nearest_camera_distance(centres, xyz, observations) > FAR_POINT_DISTANCES * usual
        observations = observations.where(~far_point[observations.point])
    usable_point: BoolArray = _num_views(observations, len(xyz)) >= 2
    observations = observations.where(usable_point[observations.point])
    observes: BoolArray = np.bincount(observations.image, minlength=len(centres)) > 0
    if not len(observations):
        raise InputError(_no_points_message(model))

    names = np.array([model.image(int(i)).name for i in image_ids], dtype=object)
    return Selection(
        image_ids=tuple(int(i) for i in image_ids[observes]),
        xyz=xyz[usable_point],
        rgb=tracks.rgb[usable_point],
        observations=replace(
            observations,
            point=_renumbered(usable_point)[observations.point],
            image=_renumbered(observes)[observations.image],
        ),
        left_out=LeftOut(
            far_images=tuple(names[far_camera]),
            unobserved_images=tuple(names[~observes & ~far_camera]),
            far_points=int(np.count_nonzero(far_point)),
            points_of_few_views=int(np.count_nonzero(~usable_point & ~far_point)),
            observations_behind=int(np.count_nonzero(~in_front)),
            observations_outside=int(np.count_nonzero(in_front & ~inside)),
        ),
    )


def _no_points_message(model: pycolmap.Reconstruction) -> str:
    held = f"none of its {model.num_points3D()} points is" if model.num_points3D() else "it has no points, none"
    return f"the model cannot be trained on: {held} seen by two images; find tracks first, with `smust3r-colmap refine`"


# ------------------------------------------------------------------------- observations
def _observations(
    model: pycolmap.Reconstruction,
    cameras: Mapping[int, CentredPinhole],
    image_ids: IntArray,
    tracks: SparseObservations,
) -> Observations:
    """All observations of the images."""
    rows, xy_pinhole, depths = [np.empty(0, np.int64)], [np.empty((0, 2))], [np.empty(0)]
    for image in (model.image(int(i)) for i in image_ids):
        points = tracks.points[image.image_id]
        cam_from_world = image.cam_from_world().matrix()
        rows.append(points)
        xy_pinhole.append(cameras[image.camera_id].xy_pinhole(tracks.xy[image.image_id]))
        depths.append(tracks.xyz[points] @ cam_from_world[2, :3] + cam_from_world[2, 3])
    images = np.repeat(np.arange(len(image_ids)), [len(points) for points in rows[1:]])
    return Observations(
        point=np.concatenate(rows), image=images, xy=np.concatenate(xy_pinhole), depth=np.concatenate(depths)
    )


def _inside_image(
    model: pycolmap.Reconstruction,
    cameras: Mapping[int, CentredPinhole],
    image_ids: IntArray,
    observations: Observations,
) -> BoolArray:
    """(M,) bool."""
    sizes = np.array([cameras[model.image(int(i)).camera_id].size for i in image_ids]).reshape(-1, 2)
    with np.errstate(invalid="ignore"):
        inside = (observations.xy >= 0) & (observations.xy < sizes[observations.image])
    return np.asarray(inside.all(axis=1))


def _num_views(observations: Observations, num_points: int) -> IntArray:
    """(P,) how many images observe each point; one that observes it twice counts once."""
    num_images = int(observations.image.max(initial=0)) + 1
    pairs = np.unique(observations.point * num_images + observations.image)
    return np.bincount(pairs // num_images, minlength=num_points)


def _renumbered(kept: BoolArray) -> IntArray:
    """New row of each kept one."""
    return np.cumsum(kept) - 1


# ----------------------------------------------------------------------------- outliers
def nearest_camera_distance(centres: FloatArray, xyz: FloatArray, observations: Observations) -> FloatArray:
    """(P,) from each point to the nearest camera that sees it; 0 where none does."""
    distance = np.linalg.norm(xyz[observations.point] - centres[observations.image], axis=1)
    nearest = np.full(len(xyz), np.inf)
    np.minimum.at(nearest, observations.point, distance)
    return np.where(np.isfinite(nearest), nearest, 0.0)


def _median_distance(centres: FloatArray, xyz: FloatArray, observations: Observations) -> float:
    """The median distance of the points of at least two views from their nearest camera; infinite without any."""
    seen_twice = _num_views(observations, len(xyz)) >= 2
    nearest = nearest_camera_distance(centres, xyz, observations)
    return float(np.median(nearest[seen_twice])) if seen_twice.any() else np.inf


def _far_from_the_others(centres: FloatArray, largest_gap: float) -> BoolArray:
    """(N,) cameras that no chain of steps below ``largest_gap`` joins to the largest group.

    Cameras within a tenth of the gap of each other are looked at as one, which keeps the number of pairs small.
    """
    if not np.isfinite(largest_gap) or largest_gap <= 0:
        return np.zeros(len(centres), np.bool_)
    cells = np.floor(centres / (largest_gap / 10))
    _, first, cell_of = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    pairs = cKDTree(centres[first]).query_pairs(largest_gap, output_type="ndarray")
    shape = (len(first), len(first))
    links = sparse.coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=shape)
    _, group_of_cell = connected_components(links, directed=False)
    group = group_of_cell[np.ravel(cell_of)]
    return np.asarray(group != np.bincount(group).argmax())
