"""Dense maps of one submodel on disk, read one image at a time."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from smust3r_colmap.geometry.camera import pointmap_from_depth
from smust3r_colmap.products import Submodel
from smust3r_colmap.storage.run_directory import read_array, write_arrays

_FILE = "maps.safetensors"


@dataclass(frozen=True, kw_only=True, eq=False)
class ImageMaps:
    """Depth (H, W) float32 (0 = none), confidence (H, W) float32 >= 1 and rgb (H, W, 3) uint8 of one image."""

    depth: npt.NDArray[np.float32]
    confidence: npt.NDArray[np.float32]
    rgb: npt.NDArray[np.uint8]


def write_maps(folder: Path, maps: Iterable[ImageMaps]) -> None:
    """Write the maps of a submodel, in the order of its images. Confidence is kept to three digits."""
    arrays: dict[str, npt.NDArray[np.generic]] = {}
    for k, one in enumerate(maps):
        arrays[f"depth.{k}"] = one.depth.astype(np.float32)
        arrays[f"confidence.{k}"] = one.confidence.astype(np.float16)
        arrays[f"rgb.{k}"] = one.rgb
    write_arrays(folder / _FILE, arrays)


class StoredMaps:
    """``DenseMaps`` of a submodel whose pointmaps are its depth maps seen by its cameras.

    Args:
        folder: written by ``write_maps``.
        submodel: gives the pose and the intrinsics of each image.
    """

    def __init__(self, folder: Path, submodel: Submodel) -> None:
        self._path = folder / _FILE
        self._submodel = submodel

    def __len__(self) -> int:
        return len(self._submodel.images)

    def depth(self, k: int) -> npt.NDArray[np.float32]:
        """(H, W) z-depth in segment units, 0 where there is none."""
        return read_array(self._path, f"depth.{k}")

    def confidence(self, k: int) -> npt.NDArray[np.float32]:
        """(H, W), at least 1."""
        return read_array(self._path, f"confidence.{k}").astype(np.float32)

    def rgb(self, k: int) -> npt.NDArray[np.uint8]:
        """(H, W, 3)."""
        return read_array(self._path, f"rgb.{k}")

    def pointmap_seg(self, k: int) -> npt.NDArray[np.float32]:
        """(H, W, 3) in the segment frame, NaN where there is no depth."""
        depth = self.depth(k)
        height, width = depth.shape
        intrinsics = self._submodel.intrinsics[k].resized(width, height)
        return pointmap_from_depth(depth, intrinsics, self._submodel.seg_from_cam[k])


class EmptyMaps:
    """``DenseMaps`` without a single pixel of depth, for a submodel whose maps nobody needs or that got none.

    Args:
        submodel: gives the number and the shape of the images.
        longer_side: of each map, in pixels; smaller images keep their size.
    """

    def __init__(self, submodel: Submodel, *, longer_side: int) -> None:
        self._shapes = []
        for intrinsics in submodel.intrinsics:
            shrink = min(1.0, longer_side / max(intrinsics.width, intrinsics.height))
            self._shapes.append((max(1, round(intrinsics.height * shrink)), max(1, round(intrinsics.width * shrink))))

    def __len__(self) -> int:
        return len(self._shapes)

    def depth(self, k: int) -> npt.NDArray[np.float32]:
        """(H, W) zeros."""
        return np.zeros(self._shapes[k], np.float32)

    def confidence(self, k: int) -> npt.NDArray[np.float32]:
        """(H, W) ones."""
        return np.ones(self._shapes[k], np.float32)

    def rgb(self, k: int) -> npt.NDArray[np.uint8]:
        """(H, W, 3) black."""
        return np.zeros((*self._shapes[k], 3), np.uint8)

    def pointmap_seg(self, k: int) -> npt.NDArray[np.float32]:
        """(H, W, 3) NaN."""
        return np.full((*self._shapes[k], 3), np.nan, np.float32)
