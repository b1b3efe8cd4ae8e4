"""A pycolmap Reconstruction as arrays. Images and cameras go by their index in the collection, which is id - 1.

The next module to read is ``smust3r_colmap.execution.task_pool``.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap

from smust3r_colmap.geometry.arrays import FloatArray, IntArray, UInt8Array
from smust3r_colmap.geometry.camera import Intrinsics


def poses_of(model: pycolmap.Reconstruction) -> dict[int, FloatArray]:
    """(3, 4) ``cam_from_world`` of the registered images by image index, ascending."""
    return {i - 1: model.image(i).cam_from_world().matrix() for i in sorted(model.reg_image_ids())}


def cameras_of(model: pycolmap.Reconstruction, priors: Sequence[Intrinsics]) -> tuple[Intrinsics, ...]:
    """The intrinsics by camera index; ``priors`` serve for cameras that the model lacks."""
    return tuple(
        Intrinsics.from_colmap(model.camera(index + 1)) if index + 1 in model.cameras else prior
        for index, prior in enumerate(priors)
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class SparseObservations:
    """The P points of a model, and which of them images observe.

    Args:
        xyz: (P, 3) in the world, in the order of ``points3D``.
        rgb: (P, 3) uint8.
        track_lengths: (P,) observations of each point.
        points: by image id, (n,) rows of the points that the image observes.
        xy: by image id, (n, 2) where it observes them, in pixels of the original image.
    """

    xyz: FloatArray
    rgb: UInt8Array
    track_lengths: FloatArray
    points: Mapping[int, IntArray]
    xy: Mapping[int, FloatArray]

    @classmethod
    def of(cls, model: pycolmap.Reconstruction, image_ids: Iterable[int]) -> SparseObservations:
        """All points, and the observations of the given images."""
        row_of = {point_id: row for row, point_id in enumerate(model.points3D)}
        points, xy = {}, {}
        for i in image_ids:
            observed = [(row_of[point.point3D_id], *point.xy) for point in model.image(i).get_observation_points2D()]
            table = np.array(observed, dtype=np.float64).reshape(-1, 3)
            points[i], xy[i] = table[:, 0].astype(np.int64), table[:, 1:]
        everything = list(model.points3D.values())
        return cls(
            xyz=np.array([point.xyz for point in everything], dtype=np.float64).reshape(-1, 3),
            rgb=np.array([point.color for point in everything], dtype=np.uint8).reshape(-1, 3),
            track_lengths=np.array([point.track.length() for point in everything], dtype=np.float64),
            points=points,
            xy=xy,
        )
