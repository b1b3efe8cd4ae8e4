"""Aligning two submodels by the pixels of the images they share (paper sections III-C and III-E).

The same pixel of the same image is the same scene point, so dense maps need no matching. A spread
selection of confident pixels is as exact as all of them: 8,000 instead of 5.9 million for 30
images. The solver is behind ``seen_points``; ``from_tracks`` does the same for submodels with feature tracks.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from smust3r_colmap.alignment.seen_points import SubmodelFit, align_seen_points
from smust3r_colmap.errors import DegenerateAlignmentError, ReconstructionError
from smust3r_colmap.estimators.confidence import ConfidenceWeighting, reweighted
from smust3r_colmap.estimators.robust import CAUCHY, RobustLoss, evenly_chosen
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.groups import TransformGroup
from smust3r_colmap.products import DenseMaps, Submodel

NUM_PIXELS = 8_000
"""Correspondences per pair of submodels; 5,000 to 20,000 measured alike, and the cost is 0.08 CPU s."""
CANDIDATES_PER_PIXEL = 2
"""Pixels looked at for each one wanted; half of them may lack depth or confidence."""
MIN_CONFIDENCE_RATIO = 0.5
"""Of the median confidence of a submodel, which a pixel must exceed on both sides. It drops the low tail
and, by construction, never more than half of a side; VGGT-Long's tenth of the median drops nothing
where confidences start at 1."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Side:
    """Some pixels of one submodel.

    Args:
        points_seg: (N, 3) float64. depth: (N,) float64. confidence: (N,) float64.
    """

    points_seg: FloatArray
    depth: FloatArray
    confidence: FloatArray

    @property
    def valid(self) -> npt.NDArray[np.bool_]:
        """(N,) pixels with a point, a depth and some confidence."""
        finite = np.isfinite(self.points_seg).all(axis=1) & np.isfinite(self.depth) & np.isfinite(self.confidence)
        return finite & (self.depth > 0) & (self.confidence > 1)

    def rows(self, selection: npt.NDArray[np.bool_] | npt.NDArray[np.int64]) -> _Side:
        """These pixels only."""
        return _Side(
            points_seg=self.points_seg[selection], depth=self.depth[selection], confidence=self.confidence[selection]
        )


def align_pointmaps(
    target: Submodel,
    source: Submodel,
    target_maps: DenseMaps,
    source_maps: DenseMaps,
    *,
    loss: RobustLoss = CAUCHY,
    group: TransformGroup = "sim3",
    weighting: ConfidenceWeighting = "relative",
    num_pixels: int = NUM_PIXELS,
    seed: int = 0,
) -> SubmodelFit:
    """Robust ``target_from_source`` from the pixels that both submodels reconstructed with confidence.

    A pixel takes part when it has a point and a depth on both sides and its confidence exceeds, on
    each side, both 1 (none) and half of that side's median. Candidates lie on a regular grid over
    every shared image and are thinned evenly, so that every run takes the same. A pixel weighs
    sqrt(c'_i c'_j), the confidences after paper eq. 1.

    Args:
        target, source: submodels that share images.
        target_maps, source_maps: of their images, in the same order; read one image at a time.
        loss, group: as for `align_seen_points`.
        weighting: of the confidences, see `reweighted`.
        num_pixels: at most this many correspondences.
        seed: of the search for a robust start.

    Raises:
        DegenerateAlignmentError: no image is shared, or the pixels do not determine the transform.
        ReconstructionError: the maps of an image differ in size.
        ValueError: a submodel and its maps differ in length.
    """
    for submodel, maps in ((target, target_maps), (source, source_maps)):
        if len(maps) != len(submodel.images):
            raise ValueError(f"submodel {submodel.name}: {len(submodel.images)} images, {len(maps)} dense maps")
    between = f"submodels {target.name} and {source.name}"
    shared = sorted(set(target.images) & set(source.images))
    if not shared:
        raise DegenerateAlignmentError(f"{between} share no image")
    candidates_per_image = math.ceil(CANDIDATES_PER_PIXEL * num_pixels / len(shared))
    sides = list(
        _shared_pixels(
            target, source, target_maps, source_maps, shared=shared, candidates_per_image=candidates_per_image
        )
    )
    weights = np.concatenate([_weights(t, s, weighting) for t, s in sides])
    on_target, on_source = _concatenated([t for t, _ in sides]), _concatenated([s for _, s in sides])
    confident = np.flatnonzero(_confident(on_target) & _confident(on_source))
    chosen = confident[evenly_chosen(len(confident), num_pixels)]
    on_target, on_source = on_target.rows(chosen), on_source.rows(chosen)
    try:
        return align_seen_points(
            on_source.points_seg,
            on_target.points_seg,
            weights[chosen],
            depth_source=on_source.depth,
            depth_target=on_target.depth,
            loss=loss,
            group=group,
            seed=seed,
        )
    except DegenerateAlignmentError as error:
        raise DegenerateAlignmentError(f"{between}, confident pixels of {len(shared)} images: {error}") from error


def _shared_pixels(
    target: Submodel,
    source: Submodel,
    target_maps: DenseMaps,
    source_maps: DenseMaps,
    *,
    shared: Sequence[int],
    candidates_per_image: int,
) -> Iterator[tuple[_Side, _Side]]:
    """Grid pixels of each shared image that are valid on both sides: (target, source)."""
    for image in shared:
        k_target, k_source = target.images.index(image), source.images.index(image)
        size_target, size_source = target_maps.depth(k_target).shape, source_maps.depth(k_source).shape
        if size_target != size_source:
            raise ReconstructionError(
                f"image {image}: the maps are {size_target} in submodel {target.name} and {size_source} in submodel "
                f"{source.name} (rows, columns); reconstruct both at one size"
            )
        height, width = size_target
        pitch = max(1, math.isqrt(height * width // candidates_per_image))
        on_target, on_source = _read(target_maps, k_target, pitch), _read(source_maps, k_source, pitch)
        valid = on_target.valid & on_source.valid
        yield on_target.rows(valid), on_source.rows(valid)


def _read(maps: DenseMaps, k: int, pitch: int) -> _Side:
    """Every ``pitch``-th pixel of every ``pitch``-th row, starting half a pitch inside."""
    grid = (slice(pitch // 2, None, pitch), slice(pitch // 2, None, pitch))
    return _Side(
        points_seg=maps.pointmap_seg(k)[grid].reshape(-1, 3).astype(np.float64),
        depth=maps.depth(k)[grid].ravel().astype(np.float64),
        confidence=maps.confidence(k)[grid].ravel().astype(np.float64),
    )


def _weights(on_target: _Side, on_source: _Side, mode: ConfidenceWeighting) -> FloatArray:
    """(N,) of the pixels of one image."""
    target, source = reweighted(on_target.confidence, on_source.confidence, on_target.depth, on_source.depth, mode=mode)
    weights: FloatArray = np.sqrt(target * source)
    return weights


def _concatenated(sides: Sequence[_Side]) -> _Side:
    """The pixels of all images, in order."""
    return _Side(
        points_seg=np.concatenate([side.points_seg for side in sides]),
        depth=np.concatenate([side.depth for side in sides]),
        confidence=np.concatenate([side.confidence for side in sides]),
    )


def _confident(side: _Side) -> npt.NDArray[np.bool_]:
    """(N,) pixels above the share of the median; none of none."""
    if len(side.confidence) == 0:
        return np.zeros(0, dtype=bool)
    above: npt.NDArray[np.bool_] = side.confidence > MIN_CONFIDENCE_RATIO * np.median(side.confidence)
    return above
