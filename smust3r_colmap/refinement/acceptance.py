"""Accepting or rejecting a step of the refinement by what it did to the model.

A step that makes the model worse is rejected: the model is restored, and the report gives the reason.
The next module to read is ``mapper``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import dataclass

import numpy as np
import pycolmap

from smust3r_colmap.colmap.reconstruction import poses_of
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.geometry.so3 import angles_between
from smust3r_colmap.refinement.bundle_adjustment import MIN_ANGLE_DEG, extent_of
from smust3r_colmap.refinement.statistics import Statistics, StepReport

MAX_ERROR_PX = 4.0
"""Observations with a larger reprojection error are discarded; COLMAP's own limit."""
MAX_LOST_FRACTION = 0.02
"""Of the good observations, that a step may turn into bad ones."""
MAX_MEDIAN_MOVE_FRACTION = 0.2
"""Of the path's extent, by which the median camera may move."""
FOCAL_RATIO_RANGE = (0.5, 2.0)
"""Of an adjusted focal length to the one before; outside, the adjustment has diverged."""
MAX_PRINCIPAL_POINT_SHIFT_FRACTION = 0.05
"""Of the longer image side; real principal points lie within a percent or two of the image centre."""
MAX_DISTORTION = 1.0
"""COLMAP's own limit of a distortion parameter."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Snapshot:
    """What adjustment changes in a model, to restore it.

    Args:
        rig_from_world: by frame id.
        cam_from_world: (3, 4) of the registered images, by image index.
        camera_params: by camera id. xyz: by point id.
        num_good: good observations, see ``num_good_observations``.
    """

    rig_from_world: Mapping[int, pycolmap.Rigid3d]
    cam_from_world: Mapping[int, FloatArray]
    camera_params: Mapping[int, FloatArray]
    xyz: Mapping[int, FloatArray]
    num_good: int


def take_snapshot(model: pycolmap.Reconstruction) -> Snapshot:
    """Copies, because pycolmap returns references."""
    return Snapshot(
        rig_from_world=_rigs(model),
        cam_from_world=poses_of(model),
        camera_params={i: np.array(camera.params) for i, camera in model.cameras.items()},
        xyz={i: np.array(point.xyz) for i, point in model.points3D.items()},
        num_good=num_good_observations(model),
    )


def _rigs(model: pycolmap.Reconstruction) -> dict[int, pycolmap.Rigid3d]:
    rigs = {i: model.frame(i).rig_from_world for i in model.reg_frame_ids()}
    return {i: copy(rig_from_world) for i, rig_from_world in rigs.items() if rig_from_world is not None}


def restore(model: pycolmap.Reconstruction, snapshot: Snapshot) -> None:
    """Restore the snapshot exactly; points must not have been added or removed since."""
    for frame_id, rig_from_world in snapshot.rig_from_world.items():
        model.frame(frame_id).rig_from_world = rig_from_world
    for camera_id, params in snapshot.camera_params.items():
        model.camera(camera_id).params = params.tolist()
    for point_id, xyz in snapshot.xyz.items():
        model.point3D(point_id).xyz = xyz


def num_good_observations(model: pycolmap.Reconstruction) -> int:
    """Observations within ``MAX_ERROR_PX``, in front of the camera, of points with a sufficient triangulation angle."""
    filtered = pycolmap.Reconstruction(model)
    pycolmap.ObservationManager(filtered).filter_all_points3D(MAX_ERROR_PX, MIN_ANGLE_DEG)
    return int(filtered.compute_num_observations())


def try_step(name: str, model: pycolmap.Reconstruction, step: Callable[[], bool]) -> StepReport:
    """Run an adjustment, and restore the model if it became worse.

    Args:
        name: for the report.
        model: changed in place.
        step: changes poses, intrinsics and coordinates only; returns whether the solution is usable.
    """
    before, snapshot = Statistics.of(model), take_snapshot(model)
    usable = step() and _all_finite(model)
    after = Statistics.of(model) if usable else before
    reason = rejection_reason(model, snapshot, usable=usable)
    moved, turned = movement(snapshot.cam_from_world, poses_of(model)) if usable else (np.zeros(0), np.zeros(0))
    if reason:
        restore(model, snapshot)
    return report_of(name, before, after, moved, turned, reason)


def report_of(
    name: str, before: Statistics, after: Statistics, moved: FloatArray, turned: FloatArray, reason: str = ""
) -> StepReport:
    """The report of a step with the given ``movement``; both arrays are empty if cameras cannot move."""
    return StepReport(
        name=name,
        before=before,
        after=after,
        moved_percent=float(np.median(moved)) if len(moved) else 0.0,
        max_moved_percent=float(moved.max()) if len(moved) else 0.0,
        turned_deg=float(np.median(turned)) if len(turned) else 0.0,
        accepted=not reason,
        reason=reason,
    )


def rejection_reason(model: pycolmap.Reconstruction, before: Snapshot, *, usable: bool) -> str:
    """Why the step that led to ``model`` is rejected; empty if it is accepted."""
    if not usable:
        return "the adjustment diverged"
    for camera_id, params in before.camera_params.items():
        if reason := _camera_rejection_reason(model.camera(camera_id), params):
            return reason
    moved, _ = movement(before.cam_from_world, poses_of(model))
    if len(moved) and np.median(moved) > 100 * MAX_MEDIAN_MOVE_FRACTION:
        return f"the median camera moved by {np.median(moved):.0f} % of the path's extent"
    return lost_observations_reason(before.num_good, num_good_observations(model))


def lost_observations_reason(before: int, after: int) -> str:
    """Why a step with so many good observations before and after it is rejected; empty if it is accepted."""
    if after < (1 - MAX_LOST_FRACTION) * before:
        return f"only {after} of {before} good observations remain"
    return ""


def _camera_rejection_reason(camera: pycolmap.Camera, before: FloatArray) -> str:
    """Which parameter left its range; empty if none did."""
    params = np.asarray(camera.params)
    focal, centre, extra = (
        list(indices)
        for indices in (camera.focal_length_idxs(), camera.principal_point_idxs(), camera.extra_params_idxs())
    )
    ratio = float(np.mean(params[focal]) / np.mean(before[focal]))
    if not FOCAL_RATIO_RANGE[0] <= ratio <= FOCAL_RATIO_RANGE[1]:
        return f"the focal length of camera {camera.camera_id} changed by a factor of {ratio:.2g}"
    shift = float(np.linalg.norm(params[centre] - before[centre]))
    if shift > MAX_PRINCIPAL_POINT_SHIFT_FRACTION * max(camera.width, camera.height):
        return f"the principal point of camera {camera.camera_id} moved by {shift:.0f} px"
    if (np.abs(params[extra]) > np.maximum(np.abs(before[extra]), MAX_DISTORTION)).any():
        return f"a distortion parameter of camera {camera.camera_id} exceeds {MAX_DISTORTION:g}"
    return ""


def movement(before: Mapping[int, FloatArray], after: Mapping[int, FloatArray]) -> tuple[FloatArray, FloatArray]:
    """How far the cameras that both have moved and turned.

    Args:
        before, after: (3, 4) ``cam_from_world`` by image.

    Returns:
        (N,) movement of the centres in percent of the path's extent, and (N,) rotation in degrees.
    """
    images = sorted(before.keys() & after.keys())
    if not images:
        return np.zeros(0), np.zeros(0)
    old, new = (invert_rigid(np.stack([poses[i] for i in images])) for poses in (before, after))
    distance = np.linalg.norm(new[:, :, 3] - old[:, :, 3], axis=1)
    turned = np.rad2deg(angles_between(old[:, :, :3], new[:, :, :3]))
    return 100 * distance / extent_of(old[:, :, 3]), turned


def _all_finite(model: pycolmap.Reconstruction) -> bool:
    numbers = [pose.ravel() for pose in poses_of(model).values()]
    numbers += [np.asarray(camera.params, dtype=np.float64) for camera in model.cameras.values()]
    numbers.append(np.array([point.xyz for point in model.points3D.values()]).ravel())
    return bool(np.isfinite(np.concatenate(numbers)).all())
