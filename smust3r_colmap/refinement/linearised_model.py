"""Bundle adjustment linearised at a model: residuals, Jacobians and weights of its observations.

Source: Triggs et al. 2000, "Bundle adjustment: a modern synthesis", sections 3 and 4.

A perturbation of a camera is a shift of its centre and a rotation (left, in the world): ``R_wc' = exp(w) R_wc``. Then a
similarity of the world is linear in it, see ``similarity_generators``. Lengths are in units of the extent of the path
and about its middle, so that numbers of all models are alike. The next module to read is ``covariance``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pycolmap

from smust3r_colmap.geometry.arrays import FloatArray, IntArray
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.geometry.so3 import skew
from smust3r_colmap.refinement.bundle_adjustment import LOSS_SCALE_PX, extent_of

CELLS = 12
"""Cells along the longer image side. Observations in one cell have the same errors (distortion that the camera model
lacks, the same moving or wrongly matched surface), so together they weigh as much as one."""
TARGET_OBSERVATIONS = 150
"""Of an image; points whose images all have more are thinned, which changes little because cells weigh as one."""
NUM_DISTORTIONS = 10
_GOLDEN_RATIO = 0.6180339887498949


@dataclass(frozen=True, kw_only=True, eq=False)
class LinearisedModel:
    """The N registered images, P points and M observations of a model, images by row in the order of their ids.

    Args:
        image_ids: (N,) ids in the model. cameras: (N,) row of the camera of each image. num_cameras: C.
        centres: (N, 3) camera centres, in units of ``extent`` about ``middle``; points: (P, 3) likewise.
        middle: (3,) in the world. extent: of the path in the world.
        image_of, point_of: (M,) rows.
        residuals_px: (M, 2) projection minus observation.
        by_pose: (M, 2, 6) Jacobian by centre and rotation. by_point: (M, 2, 3).
        by_distortion: (M, 2, 10) by displacements of the image that a camera model may lack, see ``_distortions``.
        weights: (M,) of the robust loss, divided by the number of observations in the same cell of the image.
        longer_side_px: (C,) of the images.
    """

    image_ids: IntArray
    cameras: IntArray
    num_cameras: int
    centres: FloatArray
    points: FloatArray
    middle: FloatArray
    extent: float
    image_of: IntArray
    point_of: IntArray
    residuals_px: FloatArray
    by_pose: FloatArray
    by_point: FloatArray
    by_distortion: FloatArray
    weights: FloatArray
    longer_side_px: FloatArray

    @classmethod
    def of(cls, model: pycolmap.Reconstruction) -> LinearisedModel:
        """Linearise a model. Observations behind their camera or without a finite derivative are left out."""
        image_ids = sorted(model.reg_image_ids())
        camera_ids = sorted({model.image(i).camera_id for i in image_ids})
        centres = np.array([model.image(i).projection_center() for i in image_ids]).reshape(-1, 3)
        middle = np.median(centres, axis=0) if len(centres) else np.zeros(3)
        extent = extent_of(centres) if len(centres) else 1.0
        seen = [_observed_points(model.image(i)) for i in image_ids]
        point_ids = _thinned(seen)
        xyz = np.array([model.point3D(i).xyz for i in point_ids.tolist()]).reshape(-1, 3)
        parts = [
            _Observations.of(model, row, image_id, ids, point_ids, xyz)
            for row, (image_id, ids) in enumerate(zip(image_ids, seen, strict=True))
        ]
        joined = _Observations.joined(parts)
        return cls(
            image_ids=np.array(image_ids, dtype=np.int64),
            cameras=np.array([camera_ids.index(model.image(i).camera_id) for i in image_ids], dtype=np.int64),
            num_cameras=len(camera_ids),
            centres=(centres - middle) / extent,
            points=(xyz - middle) / extent,
            middle=middle,
            extent=extent,
            image_of=joined.image_of,
            point_of=joined.point_of,
            residuals_px=joined.residuals_px,
            by_pose=joined.by_pose * np.array([extent] * 3 + [1.0] * 3),
            by_point=joined.by_point * extent,
            by_distortion=joined.by_distortion,
            weights=joined.weights,
            longer_side_px=np.array([max(model.camera(i).width, model.camera(i).height) for i in camera_ids], float),
        )

    def __len__(self) -> int:
        return len(self.image_ids)

    @property
    def noise_px(self) -> float:
        """Standard deviation of an observation: the robust loss's weighted residuals over the degrees of freedom.

        The scale of the loss where there are none.
        """
        robust = _robust_weights(self.residuals_px)
        seen = len(np.unique(self.point_of))
        freedom = 2 * len(self.image_of) - 6 * len(self) - 3 * seen
        if freedom <= 0:
            return LOSS_SCALE_PX
        return float(np.sqrt((robust[:, None] * self.residuals_px**2).sum() / freedom))


def similarity_generators(centres: FloatArray, origin: FloatArray) -> FloatArray:
    """(N, 6, 7) how cameras move by translation, rotation about ``origin`` (3,) and log-scale of the world."""
    arms = centres - origin
    generators = np.zeros((len(centres), 6, 7))
    generators[:, :3, :3] = generators[:, 3:, 3:6] = np.eye(3)
    generators[:, :3, 3:6] = -skew(arms)
    generators[:, :3, 6] = arms
    return generators


def _observed_points(image: pycolmap.Image) -> IntArray:
    """Ids of the points that an image observes, in the order of ``get_observation_points2D``."""
    observed = image.get_observation_points2D()
    return np.fromiter((point.point3D_id for point in observed), np.int64, len(observed))


def _thinned(seen: list[IntArray]) -> IntArray:
    """Ids of the points that are used, ascending: all of images with few observations, an even part of the others.

    Args:
        seen: ids of the points that each image observes.
    """
    if not seen:
        return np.zeros(0, dtype=np.int64)
    point_ids, rows = np.unique(np.concatenate(seen), return_inverse=True)
    shares = np.repeat([TARGET_OBSERVATIONS / max(len(ids), 1) for ids in seen], [len(ids) for ids in seen])
    share = np.zeros(len(point_ids))
    np.maximum.at(share, rows, shares)
    chosen: IntArray = point_ids[(np.arange(len(point_ids)) * _GOLDEN_RATIO) % 1 < share]
    return chosen


def _robust_weights(residuals_px: FloatArray) -> FloatArray:
    """(M,) of the Cauchy loss."""
    weights: FloatArray = 1 / (1 + (residuals_px**2).sum(axis=1) / LOSS_SCALE_PX**2)
    return weights


@dataclass(frozen=True, kw_only=True, eq=False)
class _Observations:
    """Of one image, in world units; fields as in ``LinearisedModel``."""

    image_of: IntArray
    point_of: IntArray
    residuals_px: FloatArray
    by_pose: FloatArray
    by_point: FloatArray
    by_distortion: FloatArray
    weights: FloatArray

    @classmethod
    def of(
        cls,
        model: pycolmap.Reconstruction,
        row: int,
        image_id: int,
        observed_ids: IntArray,
        point_ids: IntArray,
        xyz: FloatArray,
    ) -> _Observations:
        """Of the points ``point_ids`` (ascending) at ``xyz``, among the points that the image observes."""
        image = model.image(image_id)
        camera = model.camera(image.camera_id)
        used = np.isin(observed_ids, point_ids)
        observed = [point for point, is_used in zip(image.get_observation_points2D(), used, strict=True) if is_used]
        point_of = np.searchsorted(point_ids, observed_ids[used])
        xy = np.array([(point.x(), point.y()) for point in observed], dtype=np.float64).reshape(-1, 2)
        cam_from_world = image.cam_from_world().matrix()
        rotation, centre = cam_from_world[:, :3], invert_rigid(cam_from_world[None])[0, :, 3]
        arms = xyz[point_of] - centre
        in_camera = arms @ rotation.T
        by_point = _by_camera_point(camera, in_camera) @ rotation
        residuals = _projected(camera, in_camera) - xy
        kept = (in_camera[:, 2] > 0) & np.isfinite(residuals).all(axis=1) & np.isfinite(by_point).all(axis=(1, 2))
        by_pose = np.concatenate([-by_point, by_point @ skew(arms)], axis=2)
        return cls(
            image_of=np.full(int(kept.sum()), row),
            point_of=point_of[kept],
            residuals_px=residuals[kept],
            by_pose=by_pose[kept],
            by_point=by_point[kept],
            by_distortion=_distortions(xy[kept], camera),
            weights=_robust_weights(residuals[kept]) / _num_in_cell(xy[kept], max(camera.width, camera.height)),
        )

    @classmethod
    def joined(cls, parts: list[_Observations]) -> _Observations:
        """Of all images."""
        if not parts:
            empty = np.zeros(0, dtype=np.int64)
            return cls(
                image_of=empty,
                point_of=empty,
                residuals_px=np.zeros((0, 2)),
                by_pose=np.zeros((0, 2, 6)),
                by_point=np.zeros((0, 2, 3)),
                by_distortion=np.zeros((0, 2, NUM_DISTORTIONS)),
                weights=np.zeros(0),
            )
        return cls(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in vars(parts[0])})


def _projected(camera: pycolmap.Camera, in_camera: FloatArray) -> FloatArray:
    return np.asarray(camera.img_from_cam(in_camera), dtype=np.float64).reshape(-1, 2)


def _by_camera_point(camera: pycolmap.Camera, in_camera: FloatArray) -> FloatArray:
    """(m, 2, 3) by central differences, because camera models are pycolmap's; steps are a millionth of the depth."""
    step = 1e-6 * np.abs(in_camera[:, 2:]) + 1e-300
    columns = [
        (_projected(camera, in_camera + step * axis) - _projected(camera, in_camera - step * axis)) / (2 * step)
        for axis in np.eye(3)
    ]
    return np.stack(columns, axis=2)


def _distortions(xy: FloatArray, camera: pycolmap.Camera) -> FloatArray:
    """(m, 2, 10) displacements in pixels of which each is one pixel at half the longer side from the middle.

    In order: principal point (2), focal length, radial of orders 3, 5 and 7, aspect, skew, tangential (2). Camera
    models are made of these (Brown 1971).
    """
    half = max(camera.width, camera.height) / 2
    u, v = ((xy - np.array([camera.width, camera.height]) / 2) / half).T
    r2, zero, one = u**2 + v**2, 0 * u, 0 * u + 1
    x = [one, zero, u, u * r2, u * r2**2, u * r2**3, u, v, r2 + 2 * u**2, 2 * u * v]
    y = [zero, one, v, v * r2, v * r2**2, v * r2**3, -v, u, 2 * u * v, r2 + 2 * v**2]
    return np.stack([np.stack(x, axis=1), np.stack(y, axis=1)], axis=1)


def _num_in_cell(xy: FloatArray, longer_side_px: int) -> FloatArray:
    """(m,) observations in the cell of each."""
    cells = np.floor(xy * (CELLS / longer_side_px)).astype(np.int64)
    _, cell_of, counts = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    shared: FloatArray = counts[cell_of.ravel()].astype(np.float64)
    return shared
