"""Placing the cameras of a submodel in the world when the world is not a mere similarity of the submodel.

Under Sim(3) and SE(3) a camera moves with its submodel. Affine(3) and SL(4) deform the submodel, and no rigid
camera sees the deformed points exactly as the submodel's own camera saw the original ones. Its pose is
estimated by resection, image by image, and the residual is reported in pixels.
The next module to read is ``camera_fusion``.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
import pycolmap

from smust3r_colmap.errors import DegenerateAlignmentError
from smust3r_colmap.estimators.robust import evenly_chosen
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.se3 import SE3
from smust3r_colmap.geometry.sim3 import Sim3, invert_rigid
from smust3r_colmap.geometry.transform import Transform
from smust3r_colmap.products import DenseMaps, Submodel

logger = logging.getLogger(__name__)

POINTS_PER_IMAGE = 400
"""Points that place one camera; its six parameters are smooth functions of all of them."""
MIN_POINTS = 6
"""Fewer points than this place no camera; three do in theory, with four solutions."""
LOSS_SCALE_PX = 1000.0
"""Of pycolmap's Cauchy loss, which cannot be turned off: far above any residual, so that all points count alike."""
GRADIENT_TOLERANCE = 1e-12
"""Lets pycolmap iterate until the cost changes by less than a millionth."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PlacedSubmodel:
    """A submodel with its cameras in the world.

    Args:
        submodel: as reconstructed, in its own frame.
        world_from_seg: in any group.
        world_from_cam: (N, 3, 4) rigid, one per image of the submodel.
        residual_px: (N,) root mean square distance, in pixels of the original image, between where the
            camera sees the moved points and where the submodel's own camera saw them; 0 for groups
            that keep angles, NaN where too few points were there and the camera moved by itself.
        is_loop: the submodel is of a loop segment, which ties the graph and places no image that a window
            placed.
    """

    submodel: Submodel
    world_from_seg: Transform
    world_from_cam: FloatArray
    residual_px: FloatArray
    is_loop: bool

    def __post_init__(self) -> None:
        n = len(self.submodel.images)
        if self.world_from_cam.shape != (n, 3, 4) or self.residual_px.shape != (n,):
            raise ValueError(
                f"submodel {self.submodel.name}: {n} images, placed {self.world_from_cam.shape}, "
                f"residuals {self.residual_px.shape}"
            )
        if not np.isfinite(self.world_from_cam).all():
            raise ValueError(f"submodel {self.submodel.name}: a placed camera is not finite")


def place_submodel(
    submodel: Submodel, maps: DenseMaps, world_from_seg: Transform, *, is_loop: bool = False
) -> PlacedSubmodel:
    """The cameras of a submodel in the world, rigid in every group.

    Sim(3) and SE(3) move them exactly. In the wider groups each camera is resected from the points it
    saw: tracks where the submodel has them, else pixels of its pointmap. The pixel of a point is where
    the submodel's own camera projects it, so the residual is that of the deformation alone, and a
    transform that happens to be a similarity gives zero. pycolmap refines each pose from the centre moved
    by the transform and the rotation nearest to its Jacobian there.

    Args:
        submodel: in its own frame.
        maps: of its images; read only where they are needed.
        world_from_seg: of the submodel.
        is_loop: carried into the result.

    Raises:
        DegenerateAlignmentError: a projective transform sends a camera to infinity or beyond.
    """
    world_from_cam = moved_cameras(world_from_seg, submodel.seg_from_cam)
    residual_px = np.zeros(len(submodel.images))
    if not isinstance(world_from_seg, Sim3 | SE3):
        cam_from_world = invert_rigid(world_from_cam)
        for k, intrinsics in enumerate(submodel.intrinsics):
            points_world, xy = _seen_points(submodel, maps, world_from_seg, k)
            cam_from_world[k], residual_px[k] = _resected(cam_from_world[k], points_world, xy, intrinsics.focal_px)
        world_from_cam = invert_rigid(cam_from_world)
        _warn_of_unseen(submodel, residual_px)
    return PlacedSubmodel(
        submodel=submodel,
        world_from_seg=world_from_seg,
        world_from_cam=world_from_cam,
        residual_px=residual_px,
        is_loop=is_loop,
    )


def moved_cameras(b_from_a: Transform, a_from_cam: FloatArray) -> FloatArray:
    """``b_from_cam`` (N, 3, 4): centres by the transform, axes by the rotation nearest to its Jacobian there.

    Exact for Sim(3) and SE(3), a first guess for what bends.

    Raises:
        DegenerateAlignmentError: a projective transform sends a camera to infinity or beyond.
    """
    b_from_cam = b_from_a.move_cameras(a_from_cam)
    num_lost = int(np.count_nonzero(~np.isfinite(b_from_cam).all(axis=(1, 2))))
    if num_lost:
        raise DegenerateAlignmentError(
            f"{num_lost} of {len(b_from_cam)} cameras lie beyond the plane that the transform sends to infinity"
        )
    return b_from_cam


def _warn_of_unseen(submodel: Submodel, residual_px: FloatArray) -> None:
    unseen = int(np.isnan(residual_px).sum())
    if unseen:
        logger.warning(
            "submodel %s: %d of %d cameras see fewer than %d points and are placed without them",
            submodel.name,
            unseen,
            len(residual_px),
            MIN_POINTS,
        )


# ------------------------------------------------------------------------ correspondences
def _seen_points(
    submodel: Submodel, maps: DenseMaps, world_from_seg: Transform, k: int
) -> tuple[FloatArray, FloatArray]:
    """At most `POINTS_PER_IMAGE` moved points (P, 3) that image k sees, and where (P, 2), at z = 1 of its camera."""
    points_seg = _points_of_image(submodel, maps, k)
    cam_from_seg = invert_rigid(submodel.seg_from_cam[k])
    with np.errstate(invalid="ignore", divide="ignore"):
        points_cam = points_seg @ cam_from_seg[:, :3].T + cam_from_seg[:, 3]
        moved = world_from_seg.apply(points_seg)
        usable = np.flatnonzero(np.isfinite(moved).all(axis=1) & (points_cam[:, 2] > 0))
    rows = usable[evenly_chosen(len(usable), POINTS_PER_IMAGE)]
    return moved[rows], points_cam[rows, :2] / points_cam[rows, 2:]


def _points_of_image(submodel: Submodel, maps: DenseMaps, k: int) -> FloatArray:
    """(P, 3) in the segment frame: the track points image k observes, or pixels of its map."""
    if submodel.tracks is not None:
        seen = submodel.tracks.image_of_observation == submodel.images[k]
        observed: FloatArray = submodel.tracks.points_seg[np.unique(submodel.tracks.point_of_observation[seen])]
        return observed
    confident: FloatArray = maps.pointmap_seg(k)[maps.confidence(k) > 1].astype(np.float64)
    return confident


# ------------------------------------------------------------------------------ resection
def _resected(
    cam_from_world: FloatArray, points_world: FloatArray, xy: FloatArray, focal_px: float
) -> tuple[FloatArray, float]:
    """The rigid camera (3, 4) with the least squared distance in the image, and its RMS residual in pixels.

    Points behind the camera at the start are ignored. A camera with too few points stays, with residual NaN.
    """
    in_front = _points_cam(cam_from_world, points_world)[:, 2] > 0
    if np.count_nonzero(in_front) < MIN_POINTS:
        return cam_from_world, np.nan
    points_world, xy = points_world[in_front], xy[in_front]
    options = pycolmap.AbsolutePoseRefinementOptions()
    options.loss_function_scale, options.gradient_tolerance = LOSS_SCALE_PX, GRADIENT_TOLERANCE
    refined = pycolmap.refine_absolute_pose(
        pycolmap.Rigid3d(pycolmap.Rotation3d(cam_from_world[:, :3]), cam_from_world[:, 3]),
        focal_px * xy,
        points_world,
        np.ones(len(xy), dtype=np.bool_),
        pycolmap.Camera(model="SIMPLE_PINHOLE", width=1, height=1, params=[focal_px, 0.0, 0.0]),
        options,
    )
    poses = [cam_from_world] if refined is None else [cam_from_world, refined["cam_from_world"].matrix()]
    residual, best = min((_rms(pose, points_world, xy), k) for k, pose in enumerate(poses))
    return poses[best], focal_px * residual


def _points_cam(cam_from_world: FloatArray, points_world: FloatArray) -> FloatArray:
    """(P, 3) points in the camera."""
    points: FloatArray = points_world @ cam_from_world[:, :3].T + cam_from_world[:, 3]
    return points


def _rms(cam_from_world: FloatArray, points_world: FloatArray, xy: FloatArray) -> float:
    """Root mean square distance at z = 1; infinite where a point lies behind the camera."""
    points = _points_cam(cam_from_world, points_world)
    if (points[:, 2] <= 0).any():
        return np.inf
    return float(np.sqrt(np.mean(((points[:, :2] / points[:, 2:] - xy) ** 2).sum(axis=1))))
