"""Track elements projected into their images: whether they exist, their depth and their reprojection error.

Points whose tracks name images or observations that do not exist stay in the arrays as NaN, so that the rules can
count them. pycolmap projects (its camera models are the standard) one image at a time. The next module to read is
``rules``.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import numpy.typing as npt
import pycolmap

from smust3r_colmap.geometry.arrays import FloatArray, IntArray
from smust3r_colmap.validation.description import CAMERA_MODELS, Camera, ModelDescription, Points, Projection

_SAMPLED_POINTS = 2000
"""Of all points, evenly over the file, to see whether an image looks at the scene at all."""

_TABLE_FACTOR, _TABLE_LEAST = 20, 1000
"""Ids up to so many times their number are looked up in a table, five times as fast as by searching."""


def project(model: ModelDescription) -> Projection:
    """Project the tracks of a model into its images; a million points with five views take some seconds."""
    images, points = model.images, model.points or _NO_POINTS
    image_index = index_of(images.ids, points.track_images)
    starts, num_rows = images.starts[:-1], images.num_rows
    exists = image_index >= 0
    exists[exists] = points.track_rows[exists] < num_rows[image_index[exists]]
    exists &= points.track_rows >= 0
    row = np.full(len(image_index), -1)
    row[exists] = starts[image_index[exists]] + points.track_rows[exists]

    depth = np.full(len(row), np.nan)
    error_px = np.full(len(row), np.nan)
    perspective = np.ones(len(row), np.bool_)
    num_in_view = np.full(len(images), -1)
    elements_by_image = _groups(image_index, len(images))
    finite = np.isfinite(points.xyz).all(axis=1)
    sample = points.xyz[finite][:: max(1, int(finite.sum()) // _SAMPLED_POINTS)]
    for index in np.flatnonzero(images.finite):
        camera = _usable_camera(model.camera_by_id.get(int(images.camera_ids[index])))
        if camera is None:
            continue
        rotation, translation = images.rotation[index], images.translation[index]
        is_perspective = CAMERA_MODELS[camera.model_name].perspective
        elements = elements_by_image[index]
        points_cam = points.xyz[points.point_of_element[elements]] @ rotation.T + translation
        depth[elements] = np.where(np.isfinite(points_cam).all(axis=1), points_cam[:, 2], np.nan)
        perspective[elements] = is_perspective
        measurable = elements[row[elements] >= 0]
        projected = _img_from_cam(camera, points_cam[row[elements] >= 0], is_perspective)
        error_px[measurable] = np.linalg.norm(projected - images.xy_img[row[measurable]], axis=1)
        num_in_view[index] = _count_in_view(camera, sample @ rotation.T + translation, is_perspective)
    return Projection(
        image_index=image_index,
        row=row,
        depth=depth,
        error_px=error_px,
        perspective=perspective,
        num_in_view=num_in_view,
        num_sampled=len(sample),
    )


_NO_POINTS = Points(
    ids=np.empty(0, np.int64),
    xyz=np.empty((0, 3)),
    rgb=np.empty((0, 3), np.uint8),
    starts=np.zeros(1, np.int64),
    track_images=np.empty(0, np.int64),
    track_rows=np.empty(0, np.int64),
)


def index_of(ids: IntArray, wanted: IntArray) -> IntArray:
    """Index in ``ids`` of each wanted id, -1 where it is not there; of equal ids any."""
    if len(ids) == 0:
        return np.full(len(wanted), -1)
    if ids.min() >= 0 and ids.max() < _TABLE_FACTOR * len(ids) + _TABLE_LEAST:
        table = np.full(int(ids.max()) + 2, -1)  # the last entry stands for everything outside
        table[ids] = np.arange(len(ids))
        return table[np.where((wanted >= 0) & (wanted <= ids.max()), wanted, len(table) - 1)]
    order = np.argsort(ids, kind="stable")
    place = np.minimum(np.searchsorted(ids[order], wanted), len(ids) - 1)
    index = order[place]
    return np.where(ids[index] == wanted, index, -1)


def _groups(image_index: IntArray, num_images: int) -> list[IntArray]:
    """For every image the elements that name it."""
    order = np.argsort(image_index, kind="stable")
    bounds = np.searchsorted(image_index[order], np.arange(num_images + 1))
    return [order[start:end] for start, end in pairwise(bounds)]


def _usable_camera(camera: Camera | None) -> pycolmap.Camera | None:
    """None for a camera that is missing, unknown, or not made of finite numbers and a size."""
    if camera is None or camera.model not in CAMERA_MODELS or not np.isfinite(camera.params).all():
        return None
    if camera.width <= 0 or camera.height <= 0:
        return None
    return pycolmap.Camera(model=camera.model, width=camera.width, height=camera.height, params=list(camera.params))


def _img_from_cam(camera: pycolmap.Camera, points_cam: FloatArray, perspective: bool) -> FloatArray:
    """(M, 2) image coordinates; NaN behind a perspective camera and for points that are not finite."""
    xy_img = np.full((len(points_cam), 2), np.nan)
    usable = np.isfinite(points_cam).all(axis=1) & ((points_cam[:, 2] > 0) | (not perspective))
    if usable.any():
        xy_img[usable] = camera.img_from_cam(np.ascontiguousarray(points_cam[usable]))
    return xy_img


def _count_in_view(camera: pycolmap.Camera, points_cam: npt.NDArray[np.float64], perspective: bool) -> int:
    xy_img = _img_from_cam(camera, points_cam, perspective)
    with np.errstate(invalid="ignore"):
        inside = (xy_img >= 0).all(axis=1) & (xy_img <= (camera.width, camera.height)).all(axis=1)
    return int(inside.sum())
