"""Projective maps of space that keep its orientation, the group SL(4) (15 degrees of freedom).

The next module to read is ``groups``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from smust3r_colmap.geometry.affine3 import Affine3
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.transform import Transform


@dataclass(frozen=True, kw_only=True, eq=False)
class SL4(Transform):
    """``b_from_a``: (h x_b, h) = homogeneous @ (x_a, 1), with any leading batch axes.

    Points with h <= 0 lie on or behind the plane that the map sends to infinity. They have no image
    that joins on to that of the points before it and become NaN. The matrices M and -M, though the
    same map of projective space, are two elements, which differ in the side that counts as before.

    A tangent vector is (translation 3, linear part L 3x3 row by row, projective row 3), see ``hat``.
    Not every element has a logarithm: see ``log_exists``.

    Args:
        homogeneous: (..., 4, 4) of positive determinant; kept divided by its fourth root.

    Raises:
        ValueError: a shape does not fit, an entry is not finite, or a determinant is not positive.
    """

    DOF: ClassVar[int] = 15

    homogeneous: FloatArray

    def __post_init__(self) -> None:
        given = np.asarray(self.homogeneous, dtype=np.float64)
        if given.shape[-2:] != (4, 4):
            raise ValueError(f"SL4: the shape {given.shape} does not fit (..., 4, 4)")
        if not np.isfinite(given).all():
            raise ValueError("SL4: an entry is not finite")
        sign, log_determinant = np.linalg.slogdet(given)
        if not (sign > 0).all():
            smallest = np.linalg.det(given).min()
            raise ValueError(f"SL4: the determinant must be positive, found {smallest:.3g}")
        # What is normalised already stays as it is to the last bit, when stored or indexed.
        factor = np.where(np.abs(log_determinant) < 1e-12, 1.0, np.exp(-log_determinant / 4.0))
        object.__setattr__(self, "homogeneous", given * factor[..., None, None])

    @classmethod
    def identity(cls, batch: tuple[int, ...] = ()) -> SL4:
        """The identity, with leading batch axes ``batch``."""
        return cls(homogeneous=np.broadcast_to(np.eye(4), (*batch, 4, 4)))

    @classmethod
    def from_matrix(cls, matrix: npt.ArrayLike) -> SL4:
        """From (..., 4, 4) up to a positive factor, those of the smaller groups among them.

        Raises:
            ValueError: a determinant is not positive. No factor mends that: the map mirrors space.
        """
        return cls(homogeneous=np.asarray(matrix, dtype=np.float64))

    @property
    def batch(self) -> tuple[int, ...]:
        """The leading axes."""
        return self.homogeneous.shape[:-2]

    @property
    def matrix(self) -> FloatArray:
        """(..., 4, 4) homogeneous matrix of determinant +1."""
        return np.array(self.homogeneous)

    @classmethod
    def hat(cls, tangent: npt.ArrayLike) -> FloatArray:
        """(..., 4, 4) ``[[L - tr(L)/4 I, translation], [projective row, -tr(L)/4]]``, of trace zero.

        Of all 4x4 matrices with this effect on points, taking a multiple of the identity off makes it
        one of trace zero and leaves L what it is in Affine(3).
        """
        values = np.asarray(tangent, dtype=np.float64)
        out = np.zeros((*values.shape[:-1], 4, 4))
        out[..., :3, 3] = values[..., :3]
        out[..., :3, :3] = values[..., 3:12].reshape(*values.shape[:-1], 3, 3)
        out[..., 3, :3] = values[..., 12:]
        trace = np.trace(out, axis1=-2, axis2=-1)
        return np.asarray(out - trace[..., None, None] / 4.0 * np.eye(4))

    @classmethod
    def vee(cls, algebra: npt.ArrayLike) -> FloatArray:
        """(..., 15) of (..., 4, 4); a multiple of the identity is dropped."""
        matrix = np.asarray(algebra, dtype=np.float64)
        linear = matrix[..., :3, :3] - matrix[..., 3:, 3:] * np.eye(3)
        rows = linear.reshape(*matrix.shape[:-2], 9)
        return np.concatenate([matrix[..., :3, 3], rows, matrix[..., 3, :3]], axis=-1)

    def apply(self, points_a: npt.ArrayLike) -> FloatArray:
        """Points (..., N, 3) in frame a to frame b; NaN on and behind the plane sent to infinity."""
        points_b, _ = self._divided(points_a)
        return points_b

    def jacobian(self, points_a: npt.ArrayLike) -> FloatArray:
        """(..., N, 3, 3) ``(L - x_b p) / h`` with the projective row p; NaN where ``apply`` is."""
        points_b, h = self._divided(points_a)
        linear, row = self.homogeneous[..., None, :3, :3], self.homogeneous[..., None, 3:, :3]
        return (linear - points_b[..., :, None] * row) / h[..., None]

    def _divided(self, points_a: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Points (..., N, 3) in frame b and their homogeneous coordinates (..., N, 1), NaN where not positive."""
        points = np.asarray(points_a, dtype=np.float64)
        columns = np.swapaxes(self.homogeneous, -1, -2)
        h = points @ columns[..., :3, 3:] + columns[..., 3:, 3:]
        h = np.where(h > 0, h, np.nan)
        return (points @ columns[..., :3, :3] + columns[..., 3:, :3]) / h, h

    def inverse(self) -> SL4:
        """``a_from_b``."""
        return SL4(homogeneous=np.asarray(np.linalg.inv(self.homogeneous), dtype=np.float64))

    def compose(self, b_from_a: SL4) -> SL4:
        """``c_from_a`` of ``c_from_b`` and ``b_from_a``; batches broadcast.

        It acts as one after the other on the points that stay before both planes.
        """
        return SL4(homogeneous=self.homogeneous @ b_from_a.homogeneous)

    def affine_part(self, centre_a: npt.ArrayLike = (0.0, 0.0, 0.0)) -> Affine3:
        """The affine map that touches it at ``centre_a`` (..., 3): same value, same derivative.

        Raises:
            ValueError: the centre lies on or behind the plane sent to infinity.
        """
        centre = np.asarray(centre_a, dtype=np.float64)
        linear = self.jacobian(centre[..., None, :])[..., 0, :, :]
        translation = self.apply(centre[..., None, :])[..., 0, :] - (linear @ centre[..., None])[..., 0]
        if not np.isfinite(linear).all():
            raise ValueError("SL4: the centre lies on or behind the plane that is sent to infinity")
        return Affine3(linear=linear, translation=translation)
