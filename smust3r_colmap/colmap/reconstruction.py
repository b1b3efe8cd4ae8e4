"""A pycolmap Reconstruction as arrays."""

from __future__ import annotations

from collections.abc import Sequence

import pycolmap

from smust3r_colmap.geometry.arrays import FloatArray
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
