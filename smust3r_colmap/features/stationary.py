"""Matches on what never moves in the image: a car's bonnet, a logo, dirt on the lens.

Two-view verification finds a geometry for them, that of a camera that stands still, and where they are many it wins.
But a distant hill in front of a camera that does not turn stays in its place, too, and so does what a camera that
circles looks at. The difference is in the rest of the image: a hill agrees with the motion that the moving matches
have, an overlay does not. So the moving matches of some pairs are asked first, and where they contradict the
stationary ones again and again, that part of the image is static. There, stationary matches are dropped in all pairs.
The next module to read is ``guided_verification``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
import pycolmap
from scipy import ndimage

from smust3r_colmap.geometry.arrays import BoolArray, FloatArray, IntArray, Pair

CELLS_ALONG_LONGER_SIDE = 32
"""Static parts are known in cells of this size: finer than a logo, coarse enough to collect matches in each."""
STATIONARY_PX = 1.0
STATIONARY_FRACTION = 0.001
"""A match is stationary whose two places differ by at most so many pixels, or by this part of the longer side: SIFT
places the same pattern again to half a pixel of an image of 1600."""
MOVING = 5.0
"""In units of that distance: further apart than this, a match moves."""
MIN_STATIONARY, MIN_MOVING = 5, 30
"""Of a pair that is asked. Fewer moving matches may agree on a geometry by chance."""
MAX_PAIRS_ASKED, MAX_MOVING_ASKED, MAX_TRIALS_ASKED = 60, 300, 1000
"""Pairs cost some 20 ms each with so many moving matches and trials of RANSAC."""
MIN_PAIRS, MIN_FRACTION = 3, 0.5
"""A cell is static if the moving matches of so many pairs, and of this part of those that have stationary matches
there, contradict them."""
MAX_SAMPSON_ERROR_PX = 4.0
"""COLMAP's own tolerance of two-view verification, at 1600 px."""

Size: TypeAlias = tuple[int, int]
"""Width and height of an image."""


@dataclass(frozen=True, kw_only=True)
class StaticRegions:
    """Parts of the images in which something never moves.

    Args:
        cells: by image size as ``WxH``, ascending numbers of cells, row by row.
        share: of the matches that were looked at, those that lie there and do not move.
    """

    cells: Mapping[str, tuple[int, ...]]
    share: float = 0.0

    def __bool__(self) -> bool:
        return any(self.cells.values())

    def joined(self, other: StaticRegions) -> StaticRegions:
        """The cells of both; the larger share."""
        sizes = sorted({*self.cells, *other.cells})
        cells = {key: tuple(sorted({*self.cells.get(key, ()), *other.cells.get(key, ())})) for key in sizes}
        return StaticRegions(cells=cells, share=max(self.share, other.share))

    def holds(self, xy: FloatArray, size: Size) -> BoolArray:
        """(M,) whether places (M, 2) in an image of ``size`` lie in a static cell."""
        return np.isin(_cell_of(xy, size), self.cells.get(_key(size), ()))

    def rectangles(self, key: str, *, at_most: int) -> list[tuple[int, int, int, int]]:
        """x from, x to, y from, y to in pixels around the largest connected parts of images of size ``key``."""
        width, height = map(int, key.split("x"))
        columns, rows = _grid((width, height))
        flat = np.zeros(columns * rows, np.bool_)
        flat[list(self.cells[key])] = True
        # Cells at a corner of each other are one part.
        labels, _ = ndimage.label(flat.reshape(rows, columns), structure=np.ones((3, 3)))
        found = sorted(ndimage.find_objects(labels), key=lambda part: -_area(part))
        edge = max(width, height) / CELLS_ALONG_LONGER_SIDE
        return [
            (
                int(x.start * edge),
                min(width, round(x.stop * edge)),
                int(y.start * edge),
                min(height, round(y.stop * edge)),
            )
            for y, x in found[:at_most]
        ]


NO_REGIONS = StaticRegions(cells={})


def _area(part: tuple[slice, ...]) -> int:
    y, x = part
    return int((y.stop - y.start) * (x.stop - x.start))


@dataclass(frozen=True, kw_only=True, eq=False)
class PairMatches:
    """The matches of two images of one size.

    Args:
        xy_a, xy_b: (M, 2) places of the matched keypoints, in pixels.
        camera_a, camera_b: of the images, both of the same size.
    """

    xy_a: FloatArray
    xy_b: FloatArray
    camera_a: pycolmap.Camera
    camera_b: pycolmap.Camera

    @property
    def size(self) -> Size:
        """Of both images."""
        return self.camera_a.width, self.camera_a.height

    def stationary(self) -> BoolArray:
        """(M,) the matches whose place is the same in both images."""
        return self._distance() <= _tolerance_px(self.size)

    def moving(self) -> BoolArray:
        """(M,) the matches whose place clearly differs."""
        return self._distance() > MOVING * _tolerance_px(self.size)

    def _distance(self) -> FloatArray:
        distance: FloatArray = np.linalg.norm(self.xy_a - self.xy_b, axis=1)
        return distance


def find_static_regions(
    pairs: Sequence[Pair], matches_of: Callable[[Pair], PairMatches], *, seed: int
) -> StaticRegions:
    """Where the moving matches contradict the stationary ones.

    Args:
        pairs: of images of one size.
        matches_of: the unverified matches of such a pair.
        seed: of the robust estimates.
    """
    able = [pair for pair in pairs if _can_tell(matches_of(pair))]
    chosen = [able[k] for k in np.unique(np.linspace(0, len(able) - 1, min(len(able), MAX_PAIRS_ASKED)).astype(int))]
    stationary: dict[Size, IntArray] = {}
    contradicted: dict[Size, IntArray] = {}
    for matches in map(matches_of, chosen):
        refuted = contradicted_matches(matches, seed=seed)
        if refuted is None:
            continue
        for counts, rows in ((stationary, matches.stationary()), (contradicted, refuted)):
            cells = np.unique(_cell_of(matches.xy_a[rows], matches.size))
            columns_rows = _grid(matches.size)
            found = np.bincount(cells, minlength=columns_rows[0] * columns_rows[1])
            counts[matches.size] = counts.get(matches.size, 0) + found
    static = {
        size: np.flatnonzero((against >= MIN_PAIRS) & (against >= MIN_FRACTION * stationary[size]))
        for size, against in sorted(contradicted.items())
    }
    regions = StaticRegions(cells={_key(size): tuple(cells.tolist()) for size, cells in static.items() if len(cells)})
    looked_at = [static_matches(matches_of(pair), regions) for pair in chosen]
    share = float(np.concatenate(looked_at).mean()) if looked_at else 0.0
    return replace(regions, share=share)


def static_matches(pair: PairMatches, regions: StaticRegions) -> BoolArray:
    """(M,) the stationary matches in static parts of the image."""
    return pair.stationary() & regions.holds(pair.xy_a, pair.size)


def contradicted_matches(pair: PairMatches, *, seed: int) -> BoolArray | None:
    """(M,) the stationary matches off the epipolar lines of the geometry that the moving matches have.

    None where the moving matches have no geometry with epipolar lines.
    """
    rows = np.flatnonzero(pair.moving())
    used = np.zeros(len(pair.xy_a), np.bool_)
    used[rows[:: -(-len(rows) // MAX_MOVING_ASKED)]] = True
    geometry = verified(pair, used, seed=seed, max_trials=MAX_TRIALS_ASKED)
    if geometry.F is None or len(geometry.inlier_matches) < MIN_MOVING // 2:
        return None
    error = pycolmap.compute_squared_sampson_error(pair.xy_a, pair.xy_b, geometry.F)
    limit = max(1.0, max(pair.size) / 1600) * MAX_SAMPSON_ERROR_PX
    return pair.stationary() & (np.asarray(error) > limit**2)


def verified(
    pair: PairMatches, used: BoolArray, *, seed: int, max_trials: int | None = None, detect_watermark: bool = True
) -> pycolmap.TwoViewGeometry:
    """COLMAP's two-view geometry of the matches that are ``used``; its inliers are rows of the pair.

    Args:
        max_trials: of RANSAC; None takes COLMAP's own number.
        detect_watermark: whether matches that all move alike can be a watermark.
    """
    options = pycolmap.TwoViewGeometryOptions()
    options.detect_watermark = detect_watermark
    if max_trials is not None:
        options.ransac.max_num_trials = max_trials
    options.ransac.random_seed = seed
    rows = np.flatnonzero(used).astype(np.uint32)
    return pycolmap.estimate_two_view_geometry(
        pair.camera_a, pair.xy_a, pair.camera_b, pair.xy_b, np.column_stack([rows, rows]), options
    )


def describe(regions: StaticRegions) -> str:
    """Where the largest static parts lie, in pixels."""
    texts = []
    for key in regions.cells:
        parts = [f"x {x0}-{x1}, y {y0}-{y1}" for x0, x1, y0, y1 in regions.rectangles(key, at_most=3)]
        texts.append(f"{'; '.join(parts)} of {key} px")
    return ", and ".join(texts)


def _can_tell(pair: PairMatches) -> bool:
    return bool(pair.stationary().sum() >= MIN_STATIONARY and pair.moving().sum() >= MIN_MOVING)


def _tolerance_px(size: Size) -> float:
    return max(STATIONARY_PX, STATIONARY_FRACTION * max(size))


def _key(size: Size) -> str:
    return f"{size[0]}x{size[1]}"


def _grid(size: Size) -> tuple[int, int]:
    """Columns and rows of square cells."""
    edge = max(size) / CELLS_ALONG_LONGER_SIDE
    return int(np.ceil(size[0] / edge)), int(np.ceil(size[1] / edge))


def _cell_of(xy: FloatArray, size: Size) -> npt.NDArray[np.int64]:
    columns, rows = _grid(size)
    edge = max(size) / CELLS_ALONG_LONGER_SIDE
    column, row = np.floor(xy / edge).astype(np.int64).clip(0, (columns - 1, rows - 1)).T
    return np.asarray(row * columns + column)
