"""COLMAP's dense workspace: undistorted cameras and depth maps; and depth images of a sensor."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from PIL import Image

from smust3r_colmap.errors import ImageError, InputError
from smust3r_colmap.geometry.arrays import Float32Array
from smust3r_colmap.geometry.camera import Intrinsics

_NO_READING = 65535
"""In 7-Scenes."""


@dataclass(frozen=True, kw_only=True, eq=False)
class DenseWorkspace:
    """The folder, and its model of the undistorted images."""

    folder: Path
    model: pycolmap.Reconstruction

    @classmethod
    def open(cls, folder: Path) -> DenseWorkspace:
        """Of a folder with ``sparse`` and ``stereo``.

        Raises:
            InputError: there is no readable model in it.
        """
        try:
            return cls(folder=folder, model=pycolmap.Reconstruction(folder / "sparse"))
        except (ValueError, RuntimeError, OSError) as error:
            raise InputError(
                f"{folder}: no dense workspace; of a run, write it with smust3r-colmap export {folder.parent} "
                "--format dense"
            ) from error

    @property
    def names(self) -> tuple[str, ...]:
        """Of the images with a pose, sorted."""
        return tuple(sorted(self.model.image(i).name for i in self.model.reg_image_ids()))

    def camera(self, name: str) -> Intrinsics:
        """Of an undistorted image."""
        image = self.model.find_image_with_name(name)
        assert image is not None
        return Intrinsics.from_colmap(self.model.camera(image.camera_id))

    def depth(self, name: str) -> Float32Array | None:
        """(H, W) z-depth in the unit of the model, 0 for none; None where the image has no map.

        Raises:
            InputError: the map is cut short, or of another size than the camera.
        """
        return _read_depth_map(self.folder / f"stereo/depth_maps/{name}.geometric.bin", self.camera(name))


def _read_depth_map(path: Path, camera: Intrinsics) -> Float32Array | None:
    if not path.is_file():
        return None
    with path.open("rb") as file:
        size = file.read(64).split(b"&")[:3]
    if size != [str(number).encode() for number in (camera.width, camera.height, 1)]:
        found = b" x ".join(size[:2]).decode(errors="replace")
        raise InputError(f"{path}: is a map of {found} pixels, its camera has {camera.width} x {camera.height}")
    needed = sum(len(number) + 1 for number in size) + 4 * camera.width * camera.height
    if path.stat().st_size != needed:
        raise InputError(f"{path}: {path.stat().st_size} bytes, needed {needed}; write the workspace again")
    stored = pycolmap.DepthMap()
    stored.read(path)
    depth: Float32Array = stored.to_array()
    return depth


def read_depth_image(path: Path, per_unit: float) -> Float32Array:
    """(H, W) z-depth of a 16-bit image, 0 for none.

    Raises:
        ImageError: it does not decode, or is no image of one channel.
    """
    try:
        with Image.open(path) as image:
            numbers = np.asarray(image)
    except (OSError, SyntaxError, ValueError) as error:
        raise ImageError(f"{path}: cannot be read: {error}") from error
    if numbers.ndim != 2 or numbers.dtype == np.uint8:
        raise ImageError(f"{path}: {numbers.dtype} of shape {numbers.shape}; needed one channel of 16 bits")
    depth: Float32Array = np.where(numbers == _NO_READING, 0, numbers / per_unit).astype(np.float32)
    return depth
