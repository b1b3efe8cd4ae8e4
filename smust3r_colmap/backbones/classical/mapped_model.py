"""One connected model of a segment as arrays, before it becomes a submodel of the run.

The next module to read is ``model_checks``.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import pycolmap

from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.products import Tracks

MIN_SHARED_IMAGES = 4
"""Common images that can join two models by a similarity with something left over to check it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MappedModel:
    """One connected model of a segment, as arrays (see ``Submodel`` for shapes)."""

    images: tuple[int, ...]
    seg_from_cam: npt.NDArray[np.float64]
    intrinsics: tuple[Intrinsics, ...]
    tracks: Tracks
    reprojection_error_px: float
    method: str


def model_from_reconstruction(reconstruction: pycolmap.Reconstruction, method: str) -> MappedModel:
    """Arrays of a pycolmap model whose image ids are index + 1; images ascend."""
    ids = sorted(reconstruction.reg_image_ids())
    poses = [reconstruction.image(i).cam_from_world().inverse().matrix() for i in ids]
    intrinsics = [Intrinsics.from_colmap(reconstruction.camera(reconstruction.image(i).camera_id)) for i in ids]
    points, owner, image, feature = [], [], [], []
    for row, point_id in enumerate(sorted(reconstruction.points3D)):
        point = reconstruction.points3D[point_id]
        points.append(point.xyz)
        for element in point.track.elements:
            owner.append(row)
            image.append(element.image_id - 1)
            feature.append(element.point2D_idx)
    return MappedModel(
        images=tuple(i - 1 for i in ids),
        seg_from_cam=np.array(poses, dtype=np.float64).reshape(-1, 3, 4),
        intrinsics=tuple(intrinsics),
        tracks=Tracks(
            points_seg=np.array(points, dtype=np.float64).reshape(-1, 3),
            point_of_observation=np.array(owner, dtype=np.int64),
            image_of_observation=np.array(image, dtype=np.int64),
            feature_of_observation=np.array(feature, dtype=np.int64),
        ),
        reprojection_error_px=float(reconstruction.compute_mean_reprojection_error()),
        method=method,
    )


def restrict_model(model: MappedModel, positions: Sequence[int]) -> MappedModel:
    """The same model with only some of its images, and the points they still see at least twice."""
    images = tuple(model.images[k] for k in positions)
    tracks = model.tracks
    kept = np.isin(tracks.image_of_observation, images)
    points, compact, counts = np.unique(tracks.point_of_observation[kept], return_inverse=True, return_counts=True)
    seen_twice = counts[compact] >= 2
    renumber = np.cumsum(counts >= 2) - 1
    return replace(
        model,
        images=images,
        seg_from_cam=model.seg_from_cam[list(positions)],
        intrinsics=tuple(model.intrinsics[k] for k in positions),
        tracks=Tracks(
            points_seg=tracks.points_seg[points[counts >= 2]],
            point_of_observation=renumber[compact][seen_twice],
            image_of_observation=tracks.image_of_observation[kept][seen_twice],
            feature_of_observation=tracks.feature_of_observation[kept][seen_twice],
        ),
        method=f"{model.method}, cut",
    )


def connected_groups(models: Sequence[MappedModel]) -> list[list[MappedModel]]:
    """Models that are linked by MIN_SHARED_IMAGES common images, directly or through others."""
    groups: list[list[MappedModel]] = []
    for model in models:
        linked = [group for group in groups if share_images(model, group)]
        groups = [group for group in groups if group not in linked]
        groups.append([model, *[other for group in linked for other in group]])
    return groups


def share_images(model: MappedModel, group: Iterable[MappedModel]) -> bool:
    """Whether the model has MIN_SHARED_IMAGES in common with one of the group."""
    return any(len(set(model.images) & set(other.images)) >= MIN_SHARED_IMAGES for other in group)


def placed_images(models: Iterable[MappedModel]) -> set[int]:
    """Images that stand in at least one of the models."""
    return {image for model in models for image in model.images}
