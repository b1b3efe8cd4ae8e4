"""Rigid motions of space, the group SE(3), for backbones whose lengths are metres.

The next module to read is ``affine3``.
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
    mean_exp,
    orthonormality_error,
    reorthonormalised,
    rotation_log,
    skew,
    unskew,
)
from smust3r_colmap.geometry.transform import AffineTransform, affine_parts


@dataclass(frozen=True, kw_only=True, eq=False)
class SE3(AffineTransform):
    """``b_from_a``: x_b = rotation @ x_a + translation, with any leading batch axes.

    A tangent vector is (translation 3, rotation vector 3).

    Args:
        rotation: (..., 3, 3) float64, orthonormal with determinant +1 (checked to 1e-6).
        translation: (..., 3) float64.

    Raises:
        ValueError: a shape or a rotation is not as above, or the translation is not finite.
    """

    DOF: ClassVar[int] = 6

    rotation: FloatArray

    def __post_init__(self) -> None:
        rotation = np.asarray(self.rotation, dtype=np.float64)
        translation = np.asarray(self.translation, dtype=np.float64)
        if rotation.shape[-2:] != (3, 3) or translation.shape != rotation.shape[:-1]:
            raise ValueError(f"SE3: shapes {rotation.shape}, {translation.shape} do not fit (..., 3, 3), (..., 3)")
        if not np.isfinite(translation).all():
            raise ValueError("SE3: translation is not finite")
        off = orthonormality_error(rotation)
        if not off < ORTHONORMALITY_TOLERANCE:
            raise ValueError(f"SE3: not a rotation (orthonormality error {off:.2g})")
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(self, "translation", translation)

    @classmethod
    def identity(cls, batch: tuple[int, ...] = ()) -> SE3:
        """The identity, with leading batch axes ``batch``."""
        return cls(
            rotation=np.broadcast_to(np.eye(3), (*batch, 3, 3)).copy(),
            translation=np.zeros((*batch, 3)),
        )

    @classmethod
    def from_matrix(cls, matrix: npt.ArrayLike) -> SE3:
        """From (..., 4, 4) or (..., 3, 4).

        Raises:
            ValueError: the linear part is no rotation, or the last row is not (0, 0, 0, 1).
        """
        rotation, translation = affine_parts(matrix)
        return cls(rotation=rotation, translation=translation)

    def linear_part(self) -> FloatArray:
        """(..., 3, 3)."""
        return self.rotation

    @classmethod
    def hat(cls, tangent: npt.ArrayLike) -> FloatArray:
        """(..., 4, 4) ``[[skew(rotvec), translation], [0, 0]]``."""
        values = np.asarray(tangent, dtype=np.float64)
        out = np.zeros((*values.shape[:-1], 4, 4))
        out[..., :3, :3] = skew(values[..., 3:])
        out[..., :3, 3] = values[..., :3]
        return out

    @classmethod
    def vee(cls, algebra: npt.ArrayLike) -> FloatArray:
        """(..., 6) of (..., 4, 4); the skew part is taken, the rest is dropped."""
        matrix = np.asarray(algebra, dtype=np.float64)
        return np.concatenate([matrix[..., :3, 3], unskew(matrix[..., :3, :3])], axis=-1)

    @classmethod
    def exp(cls, tangent: npt.ArrayLike) -> SE3:
        """In closed form, see ``Sim3.exp``."""
        values = np.asarray(tangent, dtype=np.float64)
        angle, axis = angle_and_axis(values[..., 3:])
        one = np.ones_like(angle)
        mean = around_axis(axis, one, mean_exp(1j * angle))
        return cls(
            rotation=around_axis(axis, one, np.exp(1j * angle)),
            translation=(mean @ values[..., :3, None])[..., 0],
        )

    def log(self) -> FloatArray:
        """(..., 6) with a rotation vector of at most pi; at exactly pi either of the two opposite axes."""
        rotvec = rotation_log(self.rotation)
        angle, axis = angle_and_axis(rotvec)
        unmean = around_axis(axis, np.ones_like(angle), 1.0 / mean_exp(1j * angle))
        return np.concatenate([(unmean @ self.translation[..., None])[..., 0], rotvec], axis=-1)

    def log_exists(self) -> BoolArray:
        """(...,) true: every rigid motion has a logarithm, a rotation of pi has two."""
        return np.ones(self.batch, dtype=bool)

    def inverse(self) -> SE3:
        """``a_from_b``."""
        rotation = np.swapaxes(self.rotation, -1, -2)
        return SE3(rotation=rotation, translation=-(rotation @ self.translation[..., None])[..., 0])

    def compose(self, b_from_a: SE3) -> SE3:
        """``c_from_a`` of ``c_from_b`` and ``b_from_a``; batches broadcast."""
        return SE3(
            rotation=reorthonormalised(self.rotation @ b_from_a.rotation),
            translation=(self.rotation @ b_from_a.translation[..., None])[..., 0] + self.translation,
        )

    def adjoint(self) -> FloatArray:
        """(..., 6, 6) ``[[R, skew(t) R], [0, R]]``."""
        out = np.zeros((*self.batch, 6, 6))
        out[..., :3, :3] = out[..., 3:, 3:] = self.rotation
        out[..., :3, 3:] = skew(self.translation) @ self.rotation
        return out
