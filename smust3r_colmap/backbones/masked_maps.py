"""Dense maps without the pixels that the masks of the images leave out.

Every backbone gives depth for whole images. The stages after it (alignment by pointmaps, depth consistency, the point
cloud, the dense workspace) get no depth where a mask is black. The next module to read is ``alignment.stage``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from smust3r_colmap.backbones.base import BackboneResult
from smust3r_colmap.importers.masks import load_mask
from smust3r_colmap.products import DenseMaps, ImageCollection, ImageMask, SourceImage
from smust3r_colmap.storage.run_directory import key_of

SMALL_MASKS_KEPT = 1024
"""Masks at the size of the maps that are kept in memory, a bit per pixel: 25 KB each at 512 x 384. A mask of 12
megapixels takes a third of a second to decode, and is needed four times or more."""


def without_masked_depth(result: BackboneResult, collection: ImageCollection) -> BackboneResult:
    """The same result, whose maps are empty where the masks are black; untouched where no image has a mask."""
    if not collection.mask_digests:
        return result
    dense = tuple(
        MaskedMaps(maps=maps, images=tuple(collection.images[index] for index in submodel.images))
        for maps, submodel in zip(result.dense, result.submodels, strict=True)
    )
    return replace(result, dense=dense, dense_key=key_of("masked", result.dense_key, collection.mask_digests))


@dataclass(frozen=True, kw_only=True)
class MaskedMaps:
    """``DenseMaps`` without depth and confidence on masked pixels: those whose centre is black in the mask.

    Args:
        maps: of one submodel.
        images: of the submodel, in the order of the maps.
    """

    maps: DenseMaps
    images: Sequence[SourceImage]

    def __len__(self) -> int:
        return len(self.maps)

    def pointmap_seg(self, k: int) -> npt.NDArray[np.float32]:
        """(H, W, 3) in the segment frame, NaN where there is none or the mask is black.

        Raises:
            ImageError: the mask cannot be read when it is first needed; the other methods raise it, too.
        """
        pointmap_seg = self.maps.pointmap_seg(k)
        kept = self._kept(k, pointmap_seg.shape[:2])
        return np.where(kept[:, :, None], pointmap_seg, np.float32(np.nan))

    def depth(self, k: int) -> npt.NDArray[np.float32]:
        """(H, W) z-depth in segment units, 0 where there is none or the mask is black."""
        depth = self.maps.depth(k)
        return np.where(self._kept(k, depth.shape), depth, np.float32(0))

    def confidence(self, k: int) -> npt.NDArray[np.float32]:
        """(H, W), at least 1, and 1 where the mask is black."""
        confidence = self.maps.confidence(k)
        return np.where(self._kept(k, confidence.shape), confidence, np.float32(1))

    def rgb(self, k: int) -> npt.NDArray[np.uint8]:
        """(H, W, 3) the image, masked pixels too."""
        return self.maps.rgb(k)

    def _kept(self, k: int, shape: tuple[int, ...]) -> npt.NDArray[np.bool_]:
        """(H, W) of the map."""
        image = self.images[k]
        if image.mask is None:
            return np.ones(shape, np.bool_)
        bits = _small_mask(image.mask, image, shape)
        return np.unpackbits(bits, count=shape[0] * shape[1]).reshape(shape).astype(np.bool_)


@lru_cache(maxsize=SMALL_MASKS_KEPT)
def _small_mask(mask: ImageMask, image: SourceImage, shape: tuple[int, ...]) -> npt.NDArray[np.uint8]:
    """Bits of the (H, W) pixels of a map, row by row, 1 where its centre is kept; another content is another mask."""
    kept = load_mask(mask.path, image) > 0
    rows, columns = (
        ((np.arange(n) + 0.5) * full / n).astype(np.int64) for n, full in zip(shape, kept.shape, strict=True)
    )
    return np.packbits(kept[np.ix_(rows, columns)])
