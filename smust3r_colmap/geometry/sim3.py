"""Similarity transforms of space, the group Sim(3), as immutable values.

A variable is named ``b_from_a`` when it takes coordinates in frame a to coordinates in frame b, so
that neighbours cancel: ``c_from_a = c_from_b @ b_from_a``. The next module to read is ``se3``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from smust3r_colmap.geometry.arrays import BoolArray, FloatArray
from smust3r_colmap.geometry.so3 import (
    ORTHONORMALITY_TOLERANCE,
    angle_and_axis,
    around_axis,
    determinant,
    mean_exp,
    orthonormality_error,
    reorthonormalised,
    rotation_log,
    skew,
    unskew,
)
from smust3r_colmap.geometry.transform import AffineTransform, affine_parts


@dataclass(frozen=True, kw_only=True, eq=False)
class Sim3(AffineTransform):
    """``b_from_a``: x_b = scale * rotation @ x_a + translation, with any leading batch axes.

    A tangent vector is (translation 3, rotation vector 3, log scale 1).

    Args:
        scale: (...,) float64, positive.
        rotation: (..., 3, 3) float64, orthonormal with determinant +1 (checked to 1e-6).
        translation: (..., 3) float64, in units of frame b.

    Raises:
        ValueError: a shape, a scale or a rotation is not as above.
    """

    DOF: ClassVar[int] = 7

    scale: FloatArray
    rotation: FloatArray

    def __post_init__(self) -> None:
        scale = np.asarray(self.scale, dtype=np.float64)
        rotation = np.asarray(self.rotation, dtype=np.float64)
        translation = np.asarray(self.translation, dtype=np.float64)
        if rotation.shape != (*scale.shape, 3, 3) or translation.shape != (*scale.shape, 3):
            raise ValueError(
                f"Sim3: shapes {scale.shape}, {rotation.shape}, {translation.shape} do not fit "
                "(...,), (..., 3, 3), (..., 3)"
            )
        if not (np.isfinite(scale).all() and (scale > 0).all()):
            raise ValueError(f"Sim3: scale must be positive and finite, found {scale}")
        if not np.isfinite(translation).all():
            raise ValueError("Sim3: translation is not finite")
        off = orthonormality_error(rotation)
        if not off < ORTHONORMALITY_TOLERANCE:
            raise ValueError(f"Sim3: not a rotation (orthonormality error {off:.2g})")
        object.__setattr__(self, "scale", scale)
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(self, "translation", translation)

    @classmethod
    def identity(cls, batch: tuple[int, ...] = ()) -> Sim3:
        """The identity, with leading batch axes ``batch``."""
        return cls(
            scale=np.ones(batch),
            rotation=np.broadcast_to(np.eye(3), (*batch, 3, 3)).copy(),
            translation=np.zeros((*batch, 3)),
        )

    @classmethod
    def from_matrix(cls, matrix: npt.ArrayLike) -> Sim3:
        """From (..., 4, 4) or (..., 3, 4); the scale is the cube root of the determinant.

        Raises:
            ValueError: the linear part is no multiple of a rotation, or the last row is not (0, 0, 0, 1).
        """
        linear, translation = affine_parts(matrix)
        scale = np.cbrt(determinant(linear))
        with np.errstate(divide="ignore", invalid="ignore"):  # a singular matrix is refused by its scale
            rotation = linear / scale[..., None, None]
        return cls(scale=scale, rotation=rotation, translation=translation)

    def linear_part(self) -> FloatArray:
        """(..., 3, 3)."""
        return self.scale[..., None, None] * self.rotation

    @classmethod
    def hat(cls, tangent: npt.ArrayLike) -> FloatArray:
        """(..., 4, 4) ``[[log_scale I + skew(rotvec), translation], [0, 0]]``."""
        translation, rotvec, log_scale = _parts(tangent)
        out = np.zeros((*log_scale.shape, 4, 4))
        out[..., :3, :3] = skew(rotvec) + log_scale[..., None, None] * np.eye(3)
        out[..., :3, 3] = translation
        return out

    @classmethod
    def vee(cls, algebra: npt.ArrayLike) -> FloatArray:
        """(..., 7) of (..., 4, 4); the skew part and the mean of the diagonal are taken, the rest is dropped."""
        matrix = np.asarray(algebra, dtype=np.float64)
        linear = matrix[..., :3, :3]
        log_scale = np.trace(linear, axis1=-2, axis2=-1)[..., None] / 3.0
        return np.concatenate([matrix[..., :3, 3], unskew(linear), log_scale], axis=-1)

    @classmethod
    def exp(cls, tangent: npt.ArrayLike) -> Sim3:
        """In closed form: ``scale * rotation`` acts as exp(z) across the axis, z = log_scale + i angle.

        The translation is the mean of ``exp(u hat)`` over u from 0 to 1, which acts as (exp(z) - 1) / z.
        """
        translation, rotvec, log_scale = _parts(tangent)
        angle, axis = angle_and_axis(rotvec)
        mean = around_axis(axis, mean_exp(log_scale).real, mean_exp(log_scale + 1j * angle))
        return cls(
            scale=np.exp(log_scale),
            rotation=around_axis(axis, np.ones_like(angle), np.exp(1j * angle)),
            translation=(mean @ translation[..., None])[..., 0],
        )

    def log(self) -> FloatArray:
        """(..., 7) with a rotation vector of at most pi; at exactly pi either of the two opposite axes."""
        log_scale, rotvec = np.log(self.scale), rotation_log(self.rotation)
        angle, axis = angle_and_axis(rotvec)
        unmean = around_axis(axis, 1.0 / mean_exp(log_scale).real, 1.0 / mean_exp(log_scale + 1j * angle))
        translation = (unmean @ self.translation[..., None])[..., 0]
        return np.concatenate([translation, rotvec, log_scale[..., None]], axis=-1)

    def log_exists(self) -> BoolArray:
        """(...,) true: every similarity has a logarithm, a rotation of pi has two."""
        return np.ones(self.batch, dtype=bool)

    def inverse(self) -> Sim3:
        """``a_from_b``."""
        scale = 1.0 / self.scale
        rotation = np.swapaxes(self.rotation, -1, -2)
        translation = -scale[..., None] * (rotation @ self.translation[..., None])[..., 0]
        return Sim3(scale=scale, rotation=rotation, translation=translation)

    def compose(self, b_from_a: Sim3) -> Sim3:
        """``c_from_a`` of ``c_from_b`` and ``b_from_a``; batches broadcast."""
        rotated = (self.rotation @ b_from_a.translation[..., None])[..., 0]
        return Sim3(
            scale=self.scale * b_from_a.scale,
            rotation=reorthonormalised(self.rotation @ b_from_a.rotation),
            translation=self.scale[..., None] * rotated + self.translation,
        )

    def adjoint(self) -> FloatArray:
        """(..., 7, 7) ``[[s R, skew(t) R, -t], [0, R, 0], [0, 0, 1]]``."""
        out = np.zeros((*self.batch, 7, 7))
        out[..., :3, :3] = self.scale[..., None, None] * self.rotation
        out[..., :3, 3:6] = skew(self.translation) @ self.rotation
        out[..., :3, 6] = -self.translation
        out[..., 3:6, 3:6] = self.rotation
        out[..., 6, 6] = 1.0
        return out


def _parts(tangent: npt.ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Translation (..., 3), rotation vector (..., 3) and log scale (...,) of tangent vectors (..., 7)."""
    values = np.asarray(tangent, dtype=np.float64)
    return values[..., :3], values[..., 3:6], values[..., 6]


def invert_rigid(b_from_a: npt.ArrayLike) -> FloatArray:
    """``a_from_b`` of rigid transforms (..., 3, 4)."""
    pose = np.asarray(b_from_a, dtype=np.float64)
    out = np.empty_like(pose)
    out[..., :3] = np.swapaxes(pose[..., :3], -1, -2)
    out[..., 3] = -(out[..., :3] @ pose[..., 3:])[..., 0]
    return out
