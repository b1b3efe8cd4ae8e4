"""Similarity transforms of space, the group Sim(3), as immutable values.

A variable is named ``b_from_a`` when it takes coordinates in frame a to coordinates in frame b, so
that neighbours cancel: ``c_from_a = c_from_b @ b_from_a``. The next module to read is ``camera``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Sim3:
    """``b_from_a``: x_b = scale * rotation @ x_a + translation, with any leading batch axes.

    Args:
        scale: (...,) float64, positive.
        rotation: (..., 3, 3) float64, orthonormal with determinant +1 (checked to 1e-6).
        translation: (..., 3) float64, in units of frame b.

    Raises:
        ValueError: a shape, a scale or a rotation is not as above.
    """

    scale: FloatArray
    rotation: FloatArray
    translation: FloatArray

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
        gram = rotation @ np.swapaxes(rotation, -1, -2)
        off = np.abs(gram - np.eye(3)).max(initial=0.0)
        if not off < 1e-6 or (np.linalg.det(rotation) < 0).any():
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
        """From (..., 4, 4) or (..., 3, 4); the scale is the cube root of the determinant."""
        b_from_a = np.asarray(matrix, dtype=np.float64)
        scale = np.cbrt(np.linalg.det(b_from_a[..., :3, :3]))
        return cls(
            scale=scale,
            rotation=b_from_a[..., :3, :3] / scale[..., None, None],
            translation=b_from_a[..., :3, 3],
        )

    @property
    def matrix(self) -> FloatArray:
        """(..., 4, 4) homogeneous matrix."""
        out = np.zeros((*self.scale.shape, 4, 4))
        out[..., :3, :3] = self.scale[..., None, None] * self.rotation
        out[..., :3, 3] = self.translation
        out[..., 3, 3] = 1.0
        return out

    def apply(self, points_a: npt.ArrayLike) -> FloatArray:
        """Points (..., N, 3) in frame a to frame b; rows that are not finite stay so."""
        points = np.asarray(points_a, dtype=np.float64)
        linear = self.scale[..., None, None] * self.rotation
        return points @ np.swapaxes(linear, -1, -2) + self.translation[..., None, :]

    def inverse(self) -> Sim3:
        """``a_from_b``."""
        scale = 1.0 / self.scale
        rotation = np.swapaxes(self.rotation, -1, -2)
        translation = -scale[..., None] * (rotation @ self.translation[..., None])[..., 0]
        return Sim3(scale=scale, rotation=rotation, translation=translation)

    def __matmul__(self, b_from_a: Sim3) -> Sim3:
        """``c_from_a = c_from_b @ b_from_a``."""
        rotated = (self.rotation @ b_from_a.translation[..., None])[..., 0]
        return Sim3(
            scale=self.scale * b_from_a.scale,
            rotation=_reorthonormalised(self.rotation @ b_from_a.rotation),
            translation=self.scale[..., None] * rotated + self.translation,
        )

    def move_cameras(self, a_from_cam: npt.ArrayLike) -> FloatArray:
        """Rigid camera poses ``a_from_cam`` (..., N, 3, 4) to ``b_from_cam`` (..., N, 3, 4).

        A camera has no size, so the scale moves its centre and leaves its axes orthonormal.
        """
        poses = np.asarray(a_from_cam, dtype=np.float64)
        out = np.empty_like(poses)
        out[..., :3] = self.rotation[..., None, :, :] @ poses[..., :3]
        out[..., 3] = self.apply(poses[..., 3])
        return out


def _reorthonormalised(rotation: FloatArray) -> FloatArray:
    """The nearest rotation, so that long products do not drift off the group."""
    u, _, vt = np.linalg.svd(rotation)
    nearest: FloatArray = u @ vt
    return nearest


def invert_rigid(b_from_a: npt.ArrayLike) -> FloatArray:
    """``a_from_b`` of rigid transforms (..., 3, 4)."""
    pose = np.asarray(b_from_a, dtype=np.float64)
    out = np.empty_like(pose)
    out[..., :3] = np.swapaxes(pose[..., :3], -1, -2)
    out[..., 3] = -(out[..., :3] @ pose[..., 3:])[..., 0]
    return out
