"""Pinhole cameras with the principal point in the middle of the image, and pixels resampled for them.

Splat trainers read PINHOLE cameras only, and most of them ignore the principal point. COLMAP's undistortion keeps it
where the calibration has it, so the view is cropped evenly round it. Both steps are one lookup: resampling twice would
blur twice, and cropping by whole pixels would leave the point half a pixel off. The next module to read is
``training_selection``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, cast

import cv2
import numpy as np
import numpy.typing as npt
import pycolmap

from smust3r_colmap.errors import InputError
from smust3r_colmap.geometry.arrays import FloatArray, UInt8Array
from smust3r_colmap.geometry.camera import Intrinsics, pixel_centres

_STRIP_PIXELS = 1 << 20
"""Pixels looked up at once: 24 MB of rays, whatever the size of the image."""
_ROUNDING_PX = 1e-6
"""Errors of rounding by which a size may miss a whole number and is not cut by one pixel more."""


@dataclass(frozen=True, kw_only=True, eq=False)
class CentredPinhole:
    """A camera and the pinhole that replaces it.

    Args:
        original: the camera of the image file.
        pinhole: PINHOLE with the principal point at exactly (width / 2, height / 2), of the same focal length;
            every pixel of its image lies in the original image.
    """

    original: Intrinsics
    pinhole: Intrinsics

    @classmethod
    def of(cls, camera: pycolmap.Camera) -> CentredPinhole:
        """The pinhole of a camera: undistorted without blank pixels by COLMAP's rule, then cut evenly.

        Raises:
            InputError: the camera sees all round, or its principal point lies outside its image.
        """
        if camera.is_spherical():
            raise InputError(f"camera {camera.camera_id} is {camera.model_name}: no pinhole holds what it sees")
        full = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), camera)
        width = _even_cut(full.principal_point_x, full.width)
        height = _even_cut(full.principal_point_y, full.height)
        if width < 1 or height < 1:
            at = (full.principal_point_x, full.principal_point_y)
            raise InputError(
                f"camera {camera.camera_id}: its principal point ({at[0]:.1f}, {at[1]:.1f}) lies outside"
                f" the {full.width}x{full.height} px image, which cannot be cut to lie round it"
            )
        params = (full.focal_length_x, full.focal_length_y, width / 2, height / 2)
        return cls(
            original=Intrinsics.from_colmap(camera),
            pinhole=Intrinsics(model="PINHOLE", width=width, height=height, params=params),
        )

    @cached_property
    def is_identity(self) -> bool:
        """The original is a centred pinhole already."""
        camera = self.original.colmap_camera()
        f = (camera.focal_length_x, camera.focal_length_y, camera.principal_point_x, camera.principal_point_y)
        size = (self.original.width, self.original.height)
        return camera.is_undistorted() and f == self.pinhole.params and size == self.size

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the pinhole's image in pixels."""
        return self.pinhole.width, self.pinhole.height

    def xy_pinhole(self, xy_original: npt.ArrayLike) -> FloatArray:
        """(N, 2) points of the original image in the pinhole's image, which they may lie outside of; NaN if none."""
        return self.pinhole.xy_img(self.original.rays_cam(xy_original))

    def lookup(self) -> npt.NDArray[np.float32]:
        """(H, W, 2) where the pixels of the pinhole's image lie in the original, for ``resampled``."""
        width, height = self.size
        rows = max(1, _STRIP_PIXELS // width)
        places = np.empty((height, width, 2), np.float32)
        for top in range(0, height, rows):
            strip = places[top : top + rows]
            xy_pinhole = pixel_centres(width, len(strip)) + np.array([0, top])
            # OpenCV counts from the centre of the first pixel, which is (0.5, 0.5) here.
            strip[:] = (self.original.xy_img(self.pinhole.rays_cam(xy_pinhole)) - 0.5).reshape(strip.shape)
        return places


def resampled(pixels: UInt8Array, lookup: npt.NDArray[np.float32], *, nearest: bool = False) -> UInt8Array:
    """An image of the original camera as the pinhole sees it: bilinear, as COLMAP does, or the nearest pixel."""
    how = cv2.INTER_NEAREST if nearest else cv2.INTER_LINEAR
    # Half a pixel at the border has no neighbour outside; it takes the last one again.
    return np.asarray(cv2.remap(pixels, lookup, cast(Any, None), how, borderMode=cv2.BORDER_REPLICATE), np.uint8)


def _even_cut(principal_point: float, length: int) -> int:
    """The longest side, in whole pixels, that lies evenly round the principal point and inside the image."""
    return int(2 * min(principal_point, length - principal_point) + _ROUNDING_PX)
