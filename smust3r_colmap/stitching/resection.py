"""Placing the cameras of a submodel in the world when the world is not a mere similarity of the submodel.

Under Sim(3) and SE(3) a camera moves with its submodel. Affine(3) and SL(4) bend the submodel, and no rigid
camera sees the bent points quite as the submodel's own camera saw the straight ones: it is found anew,
image by image, and what remains is reported in pixels. The next module to read is ``camera_fusion``.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from smust3r_colmap.errors import DegenerateAlignmentError
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.se3 import SE3
from smust3r_colmap.geometry.sim3 import Sim3, invert_rigid
from smust3r_colmap.geometry.so3 import skew
from smust3r_colmap.geometry.transform import Transform
from smust3r_colmap.products import DenseMaps, Submodel

logger = logging.getLogger(__name__)

POINTS_PER_IMAGE = 400
"""Points that place one camera; its six parameters are smooth functions of all of them."""
MIN_POINTS = 6
"""Fewer points than this place no camera; three do in theory, with four solutions."""
MAX_ITERATIONS = 20
"""Of Levenberg-Marquardt; 3 to 6 are usual."""
FIRST_DAMPING = 1e-6
"""Part of the diagonal added to the normal matrix: almost Gauss-Newton, for the start is near."""
CONVERGED_STEP = 1e-9
"""Stop when no camera turns by more radians, or moves by a larger part of its points' depth."""


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
    the submodel's own camera projects it, so the residual is what the bending adds and nothing else, and
    a transform that happens to be a similarity gives zero. Levenberg-Marquardt over all images at once, from
    the centre moved by the transform and the rotation nearest to its Jacobian there.

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
        cam_from_world, residual_px = _resected(
            invert_rigid(world_from_cam), _seen_points(submodel, maps, world_from_seg)
        )
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
@dataclass(frozen=True, kw_only=True, eq=False)
class _SeenPoints:
    """What each of N cameras saw, filled up to P points of weight zero.

    Args:
        points_world: (N, P, 3), moved. xy: (N, P, 2) where they were seen, at z = 1 of the camera.
        weights: (N, P) 1 or 0. focal_px: (N,) at the original image size.
    """

    points_world: FloatArray
    xy: FloatArray
    weights: FloatArray
    focal_px: FloatArray


def _seen_points(submodel: Submodel, maps: DenseMaps, world_from_seg: Transform) -> _SeenPoints:
    n, p = len(submodel.images), POINTS_PER_IMAGE
    points_world, xy, weights = np.zeros((n, p, 3)), np.zeros((n, p, 2)), np.zeros((n, p))
    cam_from_seg = invert_rigid(submodel.seg_from_cam)
    for k in range(n):
        points_seg = _points_of_image(submodel, maps, k)
        with np.errstate(invalid="ignore", divide="ignore"):
            points_cam = points_seg @ cam_from_seg[k, :, :3].T + cam_from_seg[k, :, 3]
            moved = world_from_seg.apply(points_seg)
            usable = np.isfinite(moved).all(axis=1) & (points_cam[:, 2] > 0)
        rows = np.flatnonzero(usable)
        rows = rows[np.arange(min(p, len(rows))) * len(rows) // max(min(p, len(rows)), 1)]
        points_world[k, : len(rows)] = moved[rows]
        xy[k, : len(rows)] = points_cam[rows, :2] / points_cam[rows, 2:]
        weights[k, : len(rows)] = 1.0
    focal_px = np.array([intrinsics.focal_px for intrinsics in submodel.intrinsics])
    return _SeenPoints(points_world=points_world, xy=xy, weights=weights, focal_px=focal_px)


def _points_of_image(submodel: Submodel, maps: DenseMaps, k: int) -> FloatArray:
    """(P, 3) in the segment frame: the track points image k observes, or pixels of its map."""
    if submodel.tracks is not None:
        seen = submodel.tracks.image_of_observation == submodel.images[k]
        observed: FloatArray = submodel.tracks.points_seg[np.unique(submodel.tracks.point_of_observation[seen])]
        return observed
    confident: FloatArray = maps.pointmap_seg(k)[maps.confidence(k) > 1].astype(np.float64)
    return confident


# ------------------------------------------------------------------------------ resection
def _resected(cam_from_world: FloatArray, seen: _SeenPoints) -> tuple[FloatArray, FloatArray]:
    """Rigid cameras (N, 3, 4) with the least squared distance in the image, and their residuals (N,) in px.

    Points behind a camera at the start have no part in it. A camera with too few points stays.
    """
    poses = cam_from_world.copy()
    in_front = _points_cam(poses, seen)[:, :, 2] > 0
    seen = replace(seen, weights=seen.weights * in_front)
    enough = seen.weights.sum(axis=1) >= MIN_POINTS
    error, damping = _squared_errors(poses, seen), np.full(len(poses), FIRST_DAMPING)
    for _ in range(MAX_ITERATIONS):
        steps, sizes = _steps(poses, seen, damping)
        trial = _stepped(poses, steps)
        trial_error = _squared_errors(trial, seen)
        better = enough & (trial_error < error)
        poses[better], error[better] = trial[better], trial_error[better]
        damping = np.where(better, damping / 10, damping * 10)
        if not (sizes[enough] > CONVERGED_STEP).any():
            break
    residual_px = seen.focal_px * np.sqrt(error / np.maximum(seen.weights.sum(axis=1), 1))
    return poses, np.where(enough, residual_px, np.nan)


def _points_cam(cam_from_world: FloatArray, seen: _SeenPoints) -> FloatArray:
    """(N, P, 3) the moved points in each camera."""
    points: FloatArray = seen.points_world @ np.swapaxes(cam_from_world[:, :, :3], 1, 2) + cam_from_world[:, None, :, 3]
    return points


def _squared_errors(cam_from_world: FloatArray, seen: _SeenPoints) -> FloatArray:
    """(N,) sum of squared distances at z = 1; infinite where a point went behind its camera."""
    points = _points_cam(cam_from_world, seen)
    used = seen.weights > 0
    depth = np.where(used, points[:, :, 2], 1.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        squared = ((points[:, :, :2] / depth[:, :, None] - seen.xy) ** 2).sum(axis=2)
    behind = (used & (depth <= 0)).any(axis=1)
    return np.where(behind, np.inf, np.where(used, squared, 0.0).sum(axis=1))


def _steps(cam_from_world: FloatArray, seen: _SeenPoints, damping: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(N, 6) damped Gauss-Newton steps (shift, turn) in the axes of each camera, and their sizes (N,).

    A camera point X moves by shift + turn x X, its image by the derivative of (X / Z, Y / Z).
    """
    points = _points_cam(cam_from_world, seen)
    inverse_depth = seen.weights / np.where(seen.weights > 0, points[:, :, 2], 1.0)
    xy = points[:, :, :2] * inverse_depth[:, :, None]
    by_point = np.zeros((*xy.shape, 3))
    by_point[:, :, 0, 0] = by_point[:, :, 1, 1] = inverse_depth
    by_point[:, :, :, 2] = -xy * inverse_depth[:, :, None]
    jacobian = np.concatenate([by_point, -by_point @ skew(points)], axis=3)  # (N, P, 2, 6)
    normal = np.einsum("npia,npib->nab", jacobian, jacobian)
    gradient = np.einsum("npia,npi->na", jacobian, (seen.xy - xy) * seen.weights[:, :, None])
    diagonal = np.einsum("naa->na", normal)
    # A camera without points has a normal matrix of zeros and takes no step.
    normal = normal + np.where(diagonal > 0, damping[:, None] * diagonal, 1.0)[:, :, None] * np.eye(6)
    steps = np.linalg.solve(normal, gradient[:, :, None])[:, :, 0]
    closeness = inverse_depth.sum(axis=1) / np.maximum(seen.weights.sum(axis=1), 1)
    sizes = np.linalg.norm(steps * np.where(np.arange(6) < 3, closeness[:, None], 1.0), axis=1)
    return steps, sizes


def _stepped(cam_from_world: FloatArray, steps: FloatArray) -> FloatArray:
    """Poses (N, 3, 4) after steps (N, 6) in the camera's axes."""
    turns = Rotation.from_rotvec(steps[:, 3:]).as_matrix()
    moved: FloatArray = turns @ cam_from_world
    moved[:, :, 3] += steps[:, :3]
    return moved
