"""Affine maps of space that keep its orientation, the group Affine(3) (12 degrees of freedom).

The next module to read is ``sl4``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.sim3 import Sim3
from smust3r_colmap.geometry.so3 import determinant, nearest_rotation
from smust3r_colmap.geometry.transform import AffineTransform, affine_parts


@dataclass(frozen=True, kw_only=True, eq=False)
class Affine3(AffineTransform):
    """``b_from_a``: x_b = linear @ x_a + translation, with any leading batch axes.

    A tangent vector is (translation 3, linear part 3x3 row by row). Not every element has a
    logarithm: see ``log_exists``.

    Args:
        linear: (..., 3, 3) float64 of positive determinant.
        translation: (..., 3) float64, in units of frame b.

    Raises:
        ValueError: a shape does not fit, an entry is not finite, or a determinant is not positive.
    """

    DOF: ClassVar[int] = 12

    linear: FloatArray

    def __post_init__(self) -> None:
        linear = np.asarray(self.linear, dtype=np.float64)
        translation = np.asarray(self.translation, dtype=np.float64)
        if linear.shape[-2:] != (3, 3) or translation.shape != linear.shape[:-1]:
            raise ValueError(f"Affine3: shapes {linear.shape}, {translation.shape} do not fit (..., 3, 3), (..., 3)")
        if not (np.isfinite(linear).all() and np.isfinite(translation).all()):
            raise ValueError("Affine3: an entry is not finite")
        smallest = determinant(linear).min(initial=np.inf)
        if not smallest > 0:
            raise ValueError(f"Affine3: the determinant must be positive, found {smallest:.3g}")
        object.__setattr__(self, "linear", linear)
        object.__setattr__(self, "translation", translation)

    @classmethod
    def identity(cls, batch: tuple[int, ...] = ()) -> Affine3:
        """The identity, with leading batch axes ``batch``."""
        return cls(
            linear=np.broadcast_to(np.eye(3), (*batch, 3, 3)).copy(),
            translation=np.zeros((*batch, 3)),
        )

    @classmethod
    def from_matrix(cls, matrix: npt.ArrayLike) -> Affine3:
        """From (..., 4, 4) or (..., 3, 4).

        Raises:
            ValueError: the determinant is not positive, or the last row is not (0, 0, 0, 1).
        """
        linear, translation = affine_parts(matrix)
        return cls(linear=linear, translation=translation)

    def linear_part(self) -> FloatArray:
        """(..., 3, 3)."""
        return self.linear

    @classmethod
    def hat(cls, tangent: npt.ArrayLike) -> FloatArray:
        """(..., 4, 4) ``[[L, translation], [0, 0]]``."""
        values = np.asarray(tangent, dtype=np.float64)
        out = np.zeros((*values.shape[:-1], 4, 4))
        out[..., :3, :3] = values[..., 3:].reshape(*values.shape[:-1], 3, 3)
        out[..., :3, 3] = values[..., :3]
        return out

    @classmethod
    def vee(cls, algebra: npt.ArrayLike) -> FloatArray:
        """(..., 12) of (..., 4, 4); the last row is dropped."""
        matrix = np.asarray(algebra, dtype=np.float64)
        rows = matrix[..., :3, :3].reshape(*matrix.shape[:-2], 9)
        return np.concatenate([matrix[..., :3, 3], rows], axis=-1)

    def inverse(self) -> Affine3:
        """``a_from_b``."""
        linear = np.asarray(np.linalg.inv(self.linear), dtype=np.float64)
        return Affine3(linear=linear, translation=-(linear @ self.translation[..., None])[..., 0])

    def compose(self, b_from_a: Affine3) -> Affine3:
        """``c_from_a`` of ``c_from_b`` and ``b_from_a``; batches broadcast."""
        return Affine3(
            linear=self.linear @ b_from_a.linear,
            translation=(self.linear @ b_from_a.translation[..., None])[..., 0] + self.translation,
        )

    def similarity_part(self, centre_a: npt.ArrayLike = (0.0, 0.0, 0.0)) -> Sim3:
        """The similarity of the same volume and nearest rotation that agrees with it at ``centre_a`` (..., 3).

        The rotation is the polar factor of the linear part, the scale the cube root of its determinant;
        ``anisotropy`` measures what is lost.
        """
        centre = np.asarray(centre_a, dtype=np.float64)
        scale, rotation = np.cbrt(determinant(self.linear)), nearest_rotation(self.linear)
        lost = self.linear - scale[..., None, None] * rotation
        translation = self.translation + (lost @ centre[..., None])[..., 0]
        batch = translation.shape[:-1]
        return Sim3(
            scale=np.broadcast_to(scale, batch),
            rotation=np.broadcast_to(rotation, (*batch, 3, 3)),
            translation=translation,
        )

    @property
    def anisotropy(self) -> FloatArray:
        """(...,) largest by smallest singular value of the linear part; 1 for a similarity."""
        singular = np.linalg.svd(self.linear, compute_uv=False)
        return np.asarray(singular[..., 0] / singular[..., 2])
