"""Pixels, rays and depth.

Image coordinates are continuous and follow COLMAP: the centre of the top-left pixel is (0.5, 0.5).
Arrays are indexed by row and column, so the centre of ``array[i, j]`` is ``xy_img = (j + 0.5, i + 0.5)``.
Camera axes: x right, y down, z forward.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import numpy.typing as npt
import pycolmap

from smust3r_colmap.geometry.arrays import Float32Array, FloatArray


@dataclass(frozen=True, kw_only=True)
class Intrinsics:
    """One camera at one image size, in COLMAP's camera models and parameter order.

    Args:
        model: COLMAP's name of the model, such as ``"SIMPLE_RADIAL"`` or ``"PINHOLE"``.
        width, height: image size in pixels.
        params: as many floats as the model has, in pixels and COLMAP's order.
        has_prior_focal: the focal length comes from EXIF or a calibration, not from a guess.

    Raises:
        ValueError: the model is unknown, or it takes another number of parameters, or one is not finite.
    """

    model: str
    width: int
    height: int
    params: tuple[float, ...]
    has_prior_focal: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "params", tuple(float(value) for value in self.params))
        if self.width < 1 or self.height < 1:
            raise ValueError(f"Intrinsics: image size {self.width}x{self.height} is empty")
        if not np.isfinite(self.params).all():
            raise ValueError(f"Intrinsics: parameters {self.params} are not finite")
        if self.model not in pycolmap.CameraModelId.__members__:
            raise ValueError(f"Intrinsics: unknown camera model {self.model!r}")
        if not self.colmap_camera().verify_params():
            raise ValueError(f"Intrinsics: {self.model} does not take {len(self.params)} parameters")

    def colmap_camera(self, camera_id: int = 1) -> pycolmap.Camera:
        """The same camera as a pycolmap object with the given id."""
        return pycolmap.Camera(
            camera_id=camera_id,
            model=self.model,
            width=self.width,
            height=self.height,
            params=list(self.params),
            has_prior_focal_length=self.has_prior_focal,
        )

    @classmethod
    def from_colmap(cls, camera: pycolmap.Camera) -> Intrinsics:
        """From a pycolmap camera; its id is dropped."""
        return cls(
            model=camera.model.name,
            width=camera.width,
            height=camera.height,
            params=tuple(camera.params),
            has_prior_focal=camera.has_prior_focal_length,
        )

    @property
    def focal_px(self) -> float:
        """Mean focal length in pixels."""
        return float(self.colmap_camera().mean_focal_length())

    def resized(self, width: int, height: int) -> Intrinsics:
        """The same camera for the image resized to ``width`` x ``height`` (axes scale separately)."""
        camera = self.colmap_camera()
        camera.rescale(width, height)
        return Intrinsics.from_colmap(camera)

    def zoomed(self, factor: float) -> Intrinsics:
        """The same camera with its focal lengths multiplied."""
        focal = set(self.colmap_camera().focal_length_idxs())
        params = tuple(value * factor if k in focal else value for k, value in enumerate(self.params))
        return replace(self, params=params)

    def rays_cam(self, xy_img: npt.ArrayLike) -> FloatArray:
        """Directions (N, 3) with z = 1 of image points (N, 2); NaN where undistortion fails."""
        xy = np.asarray(xy_img, dtype=np.float64)
        uv = np.asarray(self.colmap_camera().cam_from_img(xy), dtype=np.float64)
        return np.column_stack([uv, np.ones(len(uv))])

    def xy_img(self, points_cam: npt.ArrayLike) -> FloatArray:
        """Image points (N, 2) of camera points (N, 3); NaN for points that are not in front."""
        points = np.asarray(points_cam, dtype=np.float64)
        out = np.asarray(self.colmap_camera().img_from_cam(points), dtype=np.float64)
        return np.where(points[:, 2:] > 0, out, np.nan)


def pixel_centres(width: int, height: int) -> FloatArray:
    """(height * width, 2) centres of all pixels in row-major order, the first at (0.5, 0.5)."""
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return np.column_stack([x.ravel(), y.ravel()])


def pointmap_from_depth(
    depth: npt.ArrayLike, intrinsics: Intrinsics, frame_from_cam: npt.ArrayLike
) -> npt.NDArray[np.float32]:
    """Pointmap (H, W, 3) in ``frame`` of a z-depth map (H, W); NaN where depth is not positive.

    Args:
        depth: (H, W) z-depth in the unit of ``frame``; 0, negative or non-finite means none.
        intrinsics: of an image of exactly W x H pixels.
        frame_from_cam: (3, 4) rigid.

    Raises:
        ValueError: the intrinsics are for another image size.
    """
    z = np.asarray(depth, dtype=np.float64)
    if z.shape != (intrinsics.height, intrinsics.width):
        raise ValueError(f"depth is {z.shape}, intrinsics are for {(intrinsics.height, intrinsics.width)}")
    pose = np.asarray(frame_from_cam, dtype=np.float64)
    rays = _pixel_rays_cam(intrinsics)
    z = np.where(np.isfinite(z) & (z > 0), z, np.nan)
    points_cam = rays * z.reshape(-1, 1)
    points = points_cam @ pose[:, :3].T + pose[:, 3]
    pointmap: npt.NDArray[np.float32] = points.reshape(*z.shape, 3).astype(np.float32)
    return pointmap


@lru_cache(maxsize=2)  # undistortion iterates, and images of one camera follow each other
def _pixel_rays_cam(intrinsics: Intrinsics) -> FloatArray:
    """(height * width, 3) directions with z = 1 of all pixels, read-only."""
    rays = intrinsics.rays_cam(pixel_centres(intrinsics.width, intrinsics.height))
    rays.flags.writeable = False
    return rays


def z_buffer(points_cam: FloatArray, intrinsics: Intrinsics) -> Float32Array:
    """(H, W) depth of the nearest of the points (P, 3) that fall into each pixel, 0 where none does."""
    xy_img = intrinsics.xy_img(points_cam)
    inside = ((xy_img >= 0) & (xy_img < (intrinsics.width, intrinsics.height))).all(axis=1)
    columns, rows = xy_img[inside].astype(int).T
    nearest = np.full((intrinsics.height, intrinsics.width), np.inf, dtype=np.float32)
    np.minimum.at(nearest, (rows, columns), points_cam[inside, 2].astype(np.float32))
    return np.where(np.isfinite(nearest), nearest, np.float32(0))
