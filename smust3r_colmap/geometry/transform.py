"""What every group of transforms of space has in common: Sim(3), SE(3), Affine(3) and SL(4).

A transform is an immutable value with any leading batch axes. Its tangent vectors belong to the
right perturbation ``b_from_a @ exp(delta)`` and begin with the translation. The groups are in
``sim3``, ``se3``, ``affine3`` and ``sl4``, by name in ``groups``. Here exp, log and adjoint are those of
any matrix group; Sim(3) and SE(3) replace them by closed forms. The next module to read is ``so3``.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cache
from types import EllipsisType
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
from typing_extensions import Self

from smust3r_colmap.geometry.arrays import BoolArray, FloatArray
from smust3r_colmap.geometry.matrix_functions import log_exists, matrix_exp, matrix_log
from smust3r_colmap.geometry.so3 import nearest_rotation

IndexPart = int | slice | EllipsisType | npt.NDArray[np.bool_] | npt.NDArray[np.integer[Any]] | Sequence[int] | None
Index = IndexPart | tuple[IndexPart, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class Transform(ABC):
    """``b_from_a`` in a matrix Lie group acting on points of space.

    Every field of a subclass is an array whose leading axes are the batch.
    """

    DOF: ClassVar[int]
    """Length of a tangent vector."""

    @classmethod
    @abstractmethod
    def identity(cls, batch: tuple[int, ...] = ()) -> Self:
        """The identity, with leading batch axes ``batch``."""

    @classmethod
    @abstractmethod
    def from_matrix(cls, matrix: npt.ArrayLike) -> Self:
        """From homogeneous matrices (..., 4, 4) of this group or of a subgroup; others are refused."""

    @property
    @abstractmethod
    def matrix(self) -> FloatArray:
        """(..., 4, 4) homogeneous matrix."""

    @property
    @abstractmethod
    def batch(self) -> tuple[int, ...]:
        """The leading axes."""

    @classmethod
    @abstractmethod
    def hat(cls, tangent: npt.ArrayLike) -> FloatArray:
        """(..., 4, 4) element of the Lie algebra of a tangent vector (..., DOF)."""

    @classmethod
    @abstractmethod
    def vee(cls, algebra: npt.ArrayLike) -> FloatArray:
        """(..., DOF) of (..., 4, 4), the inverse of ``hat``; what lies outside the algebra is projected away."""

    @classmethod
    def exp(cls, tangent: npt.ArrayLike) -> Self:
        """The group element of tangent vectors (..., DOF).

        Raises:
            ValueError: a tangent vector is not finite, or so large that the element is not.
        """
        return cls.from_matrix(matrix_exp(cls.hat(tangent)))

    def log(self) -> FloatArray:
        """(..., DOF) principal logarithm.

        Raises:
            ValueError: an element has none, by ``log_exists``.
        """
        return self.vee(matrix_log(self.matrix))

    def log_exists(self) -> BoolArray:
        """(...,) whether there is a real principal logarithm: no eigenvalue within 1e-7 rad of the negative axis.

        A rotation by pi is such a case, and so is every map near it that also stretches the plane it turns.
        """
        return log_exists(self.matrix)

    @abstractmethod
    def apply(self, points_a: npt.ArrayLike) -> FloatArray:
        """Points (..., N, 3) in frame a to frame b; rows that are not finite stay so."""

    @abstractmethod
    def jacobian(self, points_a: npt.ArrayLike) -> FloatArray:
        """(..., N, 3, 3) derivative of ``apply`` at points (..., N, 3) in frame a; it turns directions there."""

    @abstractmethod
    def inverse(self) -> Self:
        """``a_from_b``."""

    @abstractmethod
    def compose(self, b_from_a: Self) -> Self:
        """``c_from_a`` of ``c_from_b`` and ``b_from_a``; batches broadcast."""

    def adjoint(self) -> FloatArray:
        """(..., DOF, DOF) with ``T @ exp(xi) == exp(T.adjoint() @ xi) @ T``."""
        basis = self.hat(np.eye(self.DOF))
        moved = self.matrix[..., None, :, :] @ basis @ self.inverse().matrix[..., None, :, :]
        return np.swapaxes(self.vee(moved), -1, -2)

    @classmethod
    def small_adjoint(cls, tangent: npt.ArrayLike) -> FloatArray:
        """(..., DOF, DOF) matrix of the Lie bracket: ``small_adjoint(x) @ y = vee([hat(x), hat(y)])``."""
        values = np.asarray(tangent, dtype=np.float64)
        flat = values @ _structure_constants(cls).reshape(cls.DOF, -1)  # linear in x: one product for a batch
        return np.reshape(flat, (*values.shape, cls.DOF))

    def move_cameras(self, a_from_cam: npt.ArrayLike) -> FloatArray:
        """Rigid camera poses ``a_from_cam`` (..., N, 3, 4) to ``b_from_cam`` (..., N, 3, 4).

        A camera has no size: the centre moves like a point, the axes turn by the rotation nearest to
        the derivative there. That is exact for similarities; what a wider group does beyond it is lost,
        and a camera whose centre has no image becomes NaN.
        """
        poses = np.asarray(a_from_cam, dtype=np.float64)
        out = np.empty_like(poses)
        out[..., 3] = self.apply(poses[..., 3])
        out[..., :3] = nearest_rotation(self.jacobian(poses[..., 3]) @ poses[..., :3])
        return out

    def __matmul__(self, b_from_a: Self) -> Self:
        """``c_from_a = c_from_b @ b_from_a``.

        Raises:
            TypeError: the two are of different groups; ``from_matrix`` of the larger one takes both.
        """
        if type(b_from_a) is not type(self):
            raise TypeError(f"{type(self).__name__} @ {type(b_from_a).__name__}: not of one group")
        return self.compose(b_from_a)

    def __getitem__(self, index: Index) -> Self:
        """Some of a batch, indexed as an array over the batch axes."""
        depth = len(self.batch)
        rows = np.arange(np.prod(self.batch, dtype=int)).reshape(self.batch)[index]
        parts = {name: part.reshape(-1, *part.shape[depth:])[rows] for name, part in self._fields().items()}
        return replace(self, **parts)

    @classmethod
    def stack(cls, transforms: Sequence[Self]) -> Self:
        """A batch (N, ...) of N transforms of the same batch."""
        if not transforms:
            return cls.identity((0,))
        columns = [one._fields() for one in transforms]
        return replace(transforms[0], **{name: np.stack([one[name] for one in columns]) for name in columns[0]})

    def _fields(self) -> dict[str, FloatArray]:
        return {field.name: getattr(self, field.name) for field in fields(self)}


@dataclass(frozen=True, kw_only=True, eq=False)
class AffineTransform(Transform):
    """A transform that is a linear part and a translation: Sim(3), SE(3) and Affine(3)."""

    translation: FloatArray

    @abstractmethod
    def linear_part(self) -> FloatArray:
        """(..., 3, 3)."""

    @property
    def batch(self) -> tuple[int, ...]:
        """The leading axes."""
        return self.translation.shape[:-1]

    @property
    def matrix(self) -> FloatArray:
        """(..., 4, 4) homogeneous matrix."""
        out = np.zeros((*self.batch, 4, 4))
        out[..., :3, :3] = self.linear_part()
        out[..., :3, 3] = self.translation
        out[..., 3, 3] = 1.0
        return out

    def apply(self, points_a: npt.ArrayLike) -> FloatArray:
        """Points (..., N, 3) in frame a to frame b; rows that are not finite stay so."""
        points = np.asarray(points_a, dtype=np.float64)
        return points @ np.swapaxes(self.linear_part(), -1, -2) + self.translation[..., None, :]

    def jacobian(self, points_a: npt.ArrayLike) -> FloatArray:
        """(..., N, 3, 3) the linear part, which is the same at all points (..., N, 3)."""
        linear, points = self.linear_part(), np.asarray(points_a, dtype=np.float64)
        batch = np.broadcast_shapes(linear.shape[:-2], points.shape[:-2])
        return np.tile(np.broadcast_to(linear[..., None, :, :], (*batch, 1, 3, 3)), (points.shape[-2], 1, 1))


@cache
def _structure_constants(group: type[Transform]) -> FloatArray:
    """(DOF, DOF, DOF) small adjoints of the unit tangent vectors."""
    basis = group.hat(np.eye(group.DOF))
    products = basis[:, None] @ basis[None, :]
    brackets = group.vee(products - np.swapaxes(products, 0, 1))  # [k, j] holds [e_k, e_j]
    return np.ascontiguousarray(np.swapaxes(brackets, 1, 2))


def affine_parts(matrix: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Linear parts (..., 3, 3) and translations (..., 3) of (..., 4, 4) or (..., 3, 4) matrices.

    Raises:
        ValueError: the shape is another, or a last row is not (0, 0, 0, 1) to 1e-9.
    """
    b_from_a = np.asarray(matrix, dtype=np.float64)
    if b_from_a.shape[-2:] not in {(4, 4), (3, 4)}:
        raise ValueError(f"a transform is (..., 4, 4) or (..., 3, 4), found {b_from_a.shape}")
    off = np.abs(b_from_a[..., 3:, :] - np.array([0.0, 0.0, 0.0, 1.0])).max(initial=0.0)
    if not off <= 1e-9:
        raise ValueError(f"the last row is not (0, 0, 0, 1) but {off:.2g} off: the transform is projective")
    return b_from_a[..., :3, :3], b_from_a[..., :3, 3]
