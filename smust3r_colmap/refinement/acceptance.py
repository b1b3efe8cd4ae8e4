"""The steps from stitched poses to an adjusted model, each judged before it is kept.

A step that makes the model worse is undone and reported, not argued with. Everything here runs in a
child process, because pycolmap ends the process when one of its threads meets an error.
The next module to read is ``task``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import dataclass

import numpy as np
import pycolmap

from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.geometry.so3 import angles_between
from smust3r_colmap.refinement.bundle_adjustment import (
    MIN_ANGLE_DEG,
    ModelFigures,
    extent_of,
    figures_of,
)

MAX_ERROR_PX = 4.0
"""Observations farther off are no observations of the point; COLMAP's own limit."""
MAX_LOST = 0.02
"""A step may turn so much of the good observations into bad ones; more is worse, not other."""
MAX_MOVE = 0.2
"""Of the path's extent: a median camera that moves farther has left the scene."""
FOCAL_RANGE = (0.5, 2.0)
"""An adjusted focal length outside of this, times the one before, has run away."""
MAX_PRINCIPAL_POINT_SHIFT = 0.05
"""Of the longer image side; real principal points lie within a percent or two of the middle."""
MAX_DISTORTION = 1.0
"""COLMAP's own limit of a distortion parameter."""


@dataclass(frozen=True, kw_only=True)
class StepReport:
    """What one step did.

    Args:
        name: such as ``"adjustment"``.
        before, after: figures of the model; ``after`` is of the tried model, also where it was undone.
        moved_percent: median movement of the camera centres, in percent of the path's extent.
        max_moved_percent: the largest.
        turned_deg: median rotation of the cameras.
        kept: the step stands.
        reason: why it was undone, or empty.
    """

    name: str
    before: ModelFigures
    after: ModelFigures
    moved_percent: float
    max_moved_percent: float
    turned_deg: float
    kept: bool
    reason: str = ""


@dataclass(frozen=True, kw_only=True, eq=False)
class Snapshot:
    """Poses, intrinsics and points of a model at one moment, to go back to."""

    rig_from_world: Mapping[int, pycolmap.Rigid3d]
    camera_params: Mapping[int, FloatArray]
    xyz: Mapping[int, FloatArray]
    num_good: int


def take_snapshot(model: pycolmap.Reconstruction) -> Snapshot:
    """Of everything that adjustment changes."""
    return Snapshot(
        rig_from_world=_poses(model),
        camera_params={i: np.array(camera.params) for i, camera in model.cameras.items()},
        xyz={i: np.array(point.xyz) for i, point in model.points3D.items()},
        num_good=num_good_observations(model),
    )


def restore(model: pycolmap.Reconstruction, snapshot: Snapshot) -> None:
    """Back to the snapshot, to the last bit; no point may have come or gone since."""
    for frame_id, rig_from_world in snapshot.rig_from_world.items():
        model.frame(frame_id).rig_from_world = rig_from_world
    for camera_id, params in snapshot.camera_params.items():
        model.camera(camera_id).params = params.tolist()
    for point_id, xyz in snapshot.xyz.items():
        model.point3D(point_id).xyz = xyz


def num_good_observations(model: pycolmap.Reconstruction) -> int:
    """Observations within ``MAX_ERROR_PX``, in front, of points seen under an angle."""
    tried = pycolmap.Reconstruction(model)
    pycolmap.ObservationManager(tried).filter_all_points3D(MAX_ERROR_PX, MIN_ANGLE_DEG)
    return int(tried.compute_num_observations())


def tried_step(name: str, model: pycolmap.Reconstruction, step: Callable[[], bool]) -> StepReport:
    """Run an adjustment and keep it if the model is no worse.

    Args:
        name: for the report.
        model: changed in place; restored where the step made it worse.
        step: changes poses, intrinsics and coordinates only; whether its solution is usable.
    """
    before, snapshot = figures_of(model), take_snapshot(model)
    usable = step() and _all_finite(model)
    after = figures_of(model) if usable else before
    reason = why_worse(model, snapshot, usable=usable)
    moved, turned = movement(model, snapshot.rig_from_world) if usable else (np.zeros(0), np.zeros(0))
    if reason:
        restore(model, snapshot)
    return report_of(name, before, after, moved, turned, reason)


def report_of(
    name: str, before: ModelFigures, after: ModelFigures, moved: FloatArray, turned: FloatArray, reason: str = ""
) -> StepReport:
    """The report of a step after which ``movement`` says ``moved``, ``turned``; both empty where no camera can move."""
    return StepReport(
        name=name,
        before=before,
        after=after,
        moved_percent=float(np.median(moved)) if len(moved) else 0.0,
        max_moved_percent=float(moved.max()) if len(moved) else 0.0,
        turned_deg=float(np.median(turned)) if len(turned) else 0.0,
        kept=not reason,
        reason=reason,
    )


def why_worse(model: pycolmap.Reconstruction, before: Snapshot, *, usable: bool) -> str:
    """In words, or empty where the model is no worse than it was."""
    if not usable:
        return "the adjustment diverged"
    for camera_id, params in before.camera_params.items():
        if reason := _why_camera_ran_away(model.camera(camera_id), params):
            return f"the {reason}"
    moved, _ = movement(model, before.rig_from_world)
    if len(moved) and np.median(moved) > 100 * MAX_MOVE:
        return f"the cameras moved by {np.median(moved):.0f} % of the path's extent in the median"
    good = num_good_observations(model)
    if good < (1 - MAX_LOST) * before.num_good:
        return f"only {good} of {before.num_good} good observations stayed good"
    return ""


def _why_camera_ran_away(camera: pycolmap.Camera, former: FloatArray) -> str:
    """In words, or empty where its parameters are still those of a camera."""
    params = np.asarray(camera.params)
    focal, middle, extra = (
        list(indices)
        for indices in (camera.focal_length_idxs(), camera.principal_point_idxs(), camera.extra_params_idxs())
    )
    ratio = float(np.mean(params[focal]) / np.mean(former[focal]))
    if not FOCAL_RANGE[0] <= ratio <= FOCAL_RANGE[1]:
        return f"focal length of camera {camera.camera_id} went to {ratio:.2g} times what it was"
    shift = float(np.linalg.norm(params[middle] - former[middle]))
    if shift > MAX_PRINCIPAL_POINT_SHIFT * max(camera.width, camera.height):
        return f"principal point of camera {camera.camera_id} went {shift:.0f} px away"
    if (np.abs(params[extra]) > np.maximum(np.abs(former[extra]), MAX_DISTORTION)).any():
        return f"distortion of camera {camera.camera_id} went beyond {MAX_DISTORTION:g}"
    return ""


def movement(
    model: pycolmap.Reconstruction, rig_from_world: Mapping[int, pycolmap.Rigid3d]
) -> tuple[FloatArray, FloatArray]:
    """(N,) how far each camera went, in percent of the path's extent, and (N,) by how many degrees it turned."""
    poses = _poses(model)
    frames = sorted(rig_from_world.keys() & poses.keys())
    if not frames:
        return np.zeros(0), np.zeros(0)
    before = invert_rigid(np.stack([rig_from_world[i].matrix() for i in frames]))
    after = invert_rigid(np.stack([poses[i].matrix() for i in frames]))
    distance = np.linalg.norm(after[:, :, 3] - before[:, :, 3], axis=1)
    turned = np.rad2deg(angles_between(before[:, :, :3], after[:, :, :3]))
    return 100 * distance / extent_of(before[:, :, 3]), turned


def _poses(model: pycolmap.Reconstruction) -> dict[int, pycolmap.Rigid3d]:
    """``rig_from_world`` by frame id; copies, for pycolmap hands out what it goes on changing."""
    poses = {}
    for frame_id in sorted(model.reg_frame_ids()):
        rig_from_world = model.frame(frame_id).rig_from_world
        assert rig_from_world is not None, "a registered frame has a pose"
        poses[frame_id] = copy(rig_from_world)
    return poses


def _all_finite(model: pycolmap.Reconstruction) -> bool:
    numbers = [pose.params for pose in _poses(model).values()]
    numbers += [np.asarray(camera.params, dtype=np.float64) for camera in model.cameras.values()]
    numbers.append(np.array([point.xyz for point in model.points3D.values()]).ravel())
    return bool(np.isfinite(np.concatenate(numbers)).all())
