"""Residuals, angles and cameras of a COLMAP model, as arrays to be drawn. The next module to read is ``plan``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pycolmap

from smust3r_colmap.colmap.reconstruction import SparseObservations
from smust3r_colmap.geometry.arrays import FloatArray, IntArray
from smust3r_colmap.geometry.triangulation import triangulation_angle_deg
from smust3r_colmap.refinement.covariance import parameter_covariance
from smust3r_colmap.refinement.linearised_model import LinearisedModel

GRID_CELLS = 16
"""Of the residual grid along the longer image side."""
MIN_IN_CELL = 20
"""Observations of a cell whose mean residual is shown: the mean of fewer is noise."""
MAX_ANGLE_POINTS = 20_000
MAX_ANGLE_VIEWS = 24
"""Points whose triangulation angle is measured, and views of each; more are thinned evenly."""
MAX_UNCERTAIN_IMAGES, MAX_UNCERTAIN_PARAMETERS = 1000, 1200
"""Images of a model, and parameters of all its cameras, up to which these get standard deviations: beyond, it takes
longer and more memory than a report may."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Observed:
    """The M observations of a model with P points and N registered images, by row in the order of their ids.

    Args:
        centres: (N, 3) camera centres. down: (N, 3) unit vectors, the y axes of the cameras, in the world.
        image_of: (M,) rows. xy, residuals_px: (M, 2); a residual is projection minus observation.
        xyz: (P, 3). track_lengths: (P,). angles_deg: the largest angle between two rays, of at most
            ``MAX_ANGLE_POINTS`` points.
    """

    image_ids: tuple[int, ...]
    centres: FloatArray
    down: FloatArray
    image_of: IntArray
    xy: FloatArray
    residuals_px: FloatArray
    xyz: FloatArray
    track_lengths: FloatArray
    angles_deg: FloatArray

    @property
    def errors_px(self) -> FloatArray:
        """(M,) lengths of the residuals."""
        errors: FloatArray = np.linalg.norm(self.residuals_px, axis=1)
        return errors

    @property
    def num_observations(self) -> IntArray:
        """(N,) of each image."""
        return np.bincount(self.image_of, minlength=len(self.image_ids))

    @property
    def mean_errors_px(self) -> FloatArray:
        """(N,) of each image; NaN without observations."""
        sums = np.bincount(self.image_of, self.errors_px, minlength=len(self.image_ids))
        with np.errstate(invalid="ignore"):
            means: FloatArray = sums / self.num_observations
        return means


def observe(model: pycolmap.Reconstruction) -> Observed:
    """Measure a model; observations behind their camera have no residual and are left out."""
    image_ids = sorted(model.reg_image_ids())
    found = SparseObservations.of(model, image_ids)
    centres = np.array([model.image(i).projection_center() for i in image_ids]).reshape(-1, 3)
    poses = [model.image(i).cam_from_world().matrix() for i in image_ids]
    rows, points, xy, residuals = [], [], [], []
    for row, image_id in enumerate(image_ids):
        of_image = found.points[image_id]
        if not len(of_image):
            continue
        in_camera = found.xyz[of_image] @ poses[row][:, :3].T + poses[row][:, 3]
        camera = model.camera(model.image(image_id).camera_id)
        residual = np.asarray(camera.img_from_cam(in_camera)).reshape(-1, 2) - found.xy[image_id]
        kept = (in_camera[:, 2] > 0) & np.isfinite(residual).all(axis=1)
        rows.append(np.full(int(kept.sum()), row))
        points.append(of_image[kept])
        xy.append(found.xy[image_id][kept])
        residuals.append(residual[kept])
    image_of = np.concatenate([np.zeros(0, np.int64), *rows])
    point_of = np.concatenate([np.zeros(0, np.int64), *points])
    return Observed(
        image_ids=tuple(image_ids),
        centres=centres,
        down=np.array([pose[1, :3] for pose in poses]).reshape(-1, 3),
        image_of=image_of,
        xy=np.concatenate([np.zeros((0, 2)), *xy]),
        residuals_px=np.concatenate([np.zeros((0, 2)), *residuals]),
        xyz=found.xyz,
        track_lengths=found.track_lengths[found.track_lengths > 0],
        angles_deg=triangulation_angles_deg(found.xyz, centres, image_of, point_of),
    )


def triangulation_angles_deg(
    xyz: FloatArray, centres: FloatArray, image_of: IntArray, point_of: IntArray
) -> FloatArray:
    """Largest angle between two rays of each point that two images see, see ``MAX_ANGLE_POINTS``.

    Args:
        xyz: (P, 3) points. centres: (N, 3) of the cameras. image_of, point_of: (M,) rows of the observations.
    """
    order = np.argsort(point_of, kind="stable")
    ids, starts, counts = np.unique(point_of[order], return_index=True, return_counts=True)
    seen = np.flatnonzero(counts >= 2)
    angles = []
    for k in seen[:: max(1, -(-len(seen) // MAX_ANGLE_POINTS))].tolist():
        views = image_of[order[starts[k] : starts[k] + counts[k]]]
        of_point = centres[views[:: max(1, -(-len(views) // MAX_ANGLE_VIEWS))]]
        angles.append(triangulation_angle_deg(xyz[ids[k]], of_point))
    return np.array(angles, dtype=np.float64)


# --------------------------------------------------------------------------- cameras
@dataclass(frozen=True, kw_only=True, eq=False)
class CameraFacts:
    """One camera of a model.

    Args:
        names, values: of its parameters. free: positions of those that were adjusted.
        sigmas: standard deviations of all parameters, NaN where they are fixed or not known.
        correlation: (F, F) between those that were adjusted; empty where it is not known.
        mean_residuals_px: (R, C, 2) by cell of the image, NaN for few observations. num_in_cell: (R, C).
    """

    camera_id: int
    model: str
    width: int
    height: int
    num_images: int
    names: tuple[str, ...]
    values: FloatArray
    sigmas: FloatArray
    free: tuple[int, ...]
    correlation: FloatArray
    mean_residuals_px: FloatArray
    num_in_cell: IntArray


def camera_facts(
    model: pycolmap.Reconstruction, observed: Observed, *, calibrated: bool, at_most: int
) -> tuple[CameraFacts, ...]:
    """The cameras with the most observations, the first the one with most.

    Args:
        calibrated: all parameters were fixed; else those but a principal point in the very middle of the image, where
            no adjustment leaves one.
    """
    camera_of_row = np.array([model.image(i).camera_id for i in observed.image_ids], dtype=np.int64)
    camera_ids = sorted(set(camera_of_row.tolist()))
    camera_of = camera_of_row[observed.image_of] if len(observed.image_of) else np.zeros(0, np.int64)
    shown = sorted(camera_ids, key=lambda one: (-int((camera_of == one).sum()), one))[:at_most]
    free = {one: () if calibrated else _free(model.camera(one)) for one in camera_ids}
    covariances = _intrinsics_covariances(model, camera_ids, free) if len(observed.image_of) else {}
    facts = []
    for one in shown:
        camera, chosen = model.camera(one), camera_of == one
        mean_residuals, num_in_cell = residual_grid(
            observed.xy[chosen], observed.residuals_px[chosen], camera.width, camera.height
        )
        sigmas = np.full(len(camera.params), np.nan)
        covariance = covariances.get(one, np.zeros((0, 0)))
        variances = np.diag(covariance)
        scale = np.sqrt(np.where(variances > 0, variances, np.nan))  # not determined at all, but for rounding
        if len(scale):
            sigmas[list(free[one])] = scale
        facts.append(
            CameraFacts(
                camera_id=one,
                model=camera.model_name,
                width=camera.width,
                height=camera.height,
                num_images=int((camera_of_row == one).sum()),
                names=tuple(name.strip() for name in camera.params_info.split(",")),
                values=np.array(camera.params, dtype=np.float64),
                sigmas=sigmas,
                free=free[one],
                correlation=covariance / np.outer(scale, scale),
                mean_residuals_px=mean_residuals,
                num_in_cell=num_in_cell,
            )
        )
    return tuple(facts)


def residual_grid(xy: FloatArray, residuals_px: FloatArray, width: int, height: int) -> tuple[FloatArray, IntArray]:
    """(R, C, 2) mean residual of each cell, NaN below ``MIN_IN_CELL`` observations, and (R, C) their number.

    Cells are squares, ``GRID_CELLS`` along the longer side; the last ones may be cut off by the border.
    """
    side = max(width, height) / GRID_CELLS
    columns, rows = int(np.ceil(width / side)), int(np.ceil(height / side))
    at = np.clip((xy / side).astype(np.int64), 0, [columns - 1, rows - 1])
    cell = at[:, 1] * columns + at[:, 0]
    counts = np.bincount(cell, minlength=rows * columns)
    sums = np.stack([np.bincount(cell, residuals_px[:, k], minlength=rows * columns) for k in range(2)], axis=1)
    means = np.where(counts[:, None] >= MIN_IN_CELL, sums / np.maximum(counts, 1)[:, None], np.nan)
    return means.reshape(rows, columns, 2), counts.reshape(rows, columns)


def _free(camera: pycolmap.Camera) -> tuple[int, ...]:
    """Positions of the parameters that adjustment changed."""
    principal = list(camera.principal_point_idxs())
    is_middle = np.array_equal(np.array(camera.params)[principal], [camera.width / 2, camera.height / 2])
    return tuple(k for k in range(len(camera.params)) if not (is_middle and k in principal))


def _intrinsics_covariances(
    model: pycolmap.Reconstruction, camera_ids: Sequence[int], free: dict[int, tuple[int, ...]]
) -> dict[int, FloatArray]:
    """(F, F) covariance of the free parameters by camera id, all poses and points being unknown, too."""
    width = max((len(one) for one in free.values()), default=0)
    is_large = len(model.reg_image_ids()) > MAX_UNCERTAIN_IMAGES
    if not width or is_large or width * len(camera_ids) > MAX_UNCERTAIN_PARAMETERS:
        return {}
    linear = LinearisedModel.of(model)
    by_parameter = np.zeros((len(linear.image_of), 2, width))
    ends = np.searchsorted(linear.image_of, np.arange(len(linear) + 1))
    for row, image_id in enumerate(linear.image_ids.tolist()):
        image, rows = model.image(image_id), slice(ends[row], ends[row + 1])
        pose = image.cam_from_world().matrix()
        in_camera = (linear.points[linear.point_of[rows]] * linear.extent + linear.middle) @ pose[:, :3].T + pose[:, 3]
        camera = model.camera(image.camera_id)
        for k, parameter in enumerate(free[image.camera_id]):
            by_parameter[rows, :, k] = _by_parameter(camera, in_camera, parameter)
    covariance = parameter_covariance(replace(linear, by_distortion=by_parameter))
    at = {one: slice(k * width, k * width + len(free[one])) for k, one in enumerate(camera_ids)}
    return {one: covariance[at[one], at[one]] for one in camera_ids}


def _by_parameter(camera: pycolmap.Camera, in_camera: FloatArray, parameter: int) -> FloatArray:
    """(m, 2) by central differences, because camera models are pycolmap's."""
    values = np.array(camera.params, dtype=np.float64)
    step = 1e-6 * max(abs(values[parameter]), 1.0)
    sides = []
    for sign in (1, -1):
        moved = values.copy()
        moved[parameter] += sign * step
        there = pycolmap.Camera(model=camera.model_name, width=camera.width, height=camera.height, params=moved)
        sides.append(np.asarray(there.img_from_cam(in_camera)).reshape(-1, 2))
    difference: FloatArray = (sides[0] - sides[1]) / (2 * step)
    return np.nan_to_num(difference)
