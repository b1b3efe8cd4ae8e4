"""Which images of a segment the network remembers: its keyframes (network specification, section 9).

A memory of every image costs time and room, and the network was trained with 20 images. Four ways to
choose, one value for each: ``EvenlySpread`` and ``UnlikeEachOther`` know the keyframes from the start,
``EveryKth`` and ``WhereNew`` go through the images in order. ``drivers`` runs the network accordingly.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

Array = npt.NDArray[np.floating[Any]]
Novelty = Literal["distance", "relative-distance", "mean-confidence", "median-confidence"]

_SHORTEST_RAY = 1e-5
_SECTOR_MARGIN = 1e-5
_SMALLEST_DEPTH = 1e-9
INITIAL_KEYFRAMES = 2
"""Images that create the memory together: the smallest number that can look at each other."""


# ------------------------------------------------------------------------------------- choices
@dataclass(frozen=True, kw_only=True)
class EvenlySpread:
    """Keyframes at equal steps through the images, the first and the last among them.

    Args:
        most: keyframes, where there are as many images.
    """

    most: int

    def keyframes(self, num_images: int) -> tuple[int, ...]:
        """Indices in the order in which the network is to see them (section 9.4, ``linseq``)."""
        steps = np.linspace(0, num_images - 1, min(self.most, num_images))
        return tuple(int(step) for step in steps)  # cut off, not rounded


@dataclass(frozen=True, kw_only=True, eq=False)
class UnlikeEachOther:
    """Keyframes that cover what descriptors tell apart, in an order that keeps look-alikes together.

    Args:
        most: keyframes, where there are as many images.
        similarity: (N, N) of the images, 1 for the same place.
        first: index from which the farthest point sampling starts; upstream takes a random one.
    """

    most: int
    similarity: Array
    first: int = 0

    def keyframes(self, num_images: int) -> tuple[int, ...]:
        """Indices in the order in which the network is to see them (section 9.4, ``retrieval``).

        Raises:
            ValueError: the similarities are of another number of images.
        """
        if self.similarity.shape != (num_images, num_images):
            raise ValueError(f"similarities {self.similarity.shape} of {num_images} images")
        chosen, _ = farthest_points(1 - self.similarity, min(self.most, num_images), first=self.first)
        return tuple(chosen[place] for place in order_by_similarity(self.similarity[np.ix_(chosen, chosen)]))


@dataclass(frozen=True, kw_only=True)
class EveryKth:
    """Images 0, 1 and every k-th, in order.

    Args:
        interval: k; made longer where it would give more than ``most``.
        most: keyframes.
        local_context: images last seen that are looked at too, whether they are kept or not.
    """

    interval: int
    most: int
    local_context: int = 0

    def keyframes(self, num_images: int) -> tuple[int, ...]:
        """Indices in order (section 9.4, ``vidseq``)."""
        initial = range(min(INITIAL_KEYFRAMES, self.most, num_images))
        interval = self.interval
        while len(kept := {*initial, *range(0, num_images, interval)}) > self.most:
            interval += 1  # ends where only those that create the memory are left
        return tuple(sorted(kept))


@dataclass(frozen=True, kw_only=True)
class NoveltyRule:
    """When an image shows what no keyframe before it has shown (section 9.6).

    Args:
        threshold: score above which an image is new; below, for the confidence scores.
        subsample: every k-th pixel in both directions is looked at.
        min_confidence: pixels that are no surer than this are left out.
        percentile: of the pixels' distances; that many percent are nearer than the score.
        novelty: distance to the nearest point of a keyframe, divided by depth or not; or the confidence of
            all pixels, which is low where the network has nothing to compare with.
        sectors_per_half_turn: points seen from directions further apart are not compared. Two give 8 sectors.
    """

    threshold: float = 0.05
    subsample: int = 2
    min_confidence: float = 1.5
    percentile: float = 85.0
    novelty: Novelty = "relative-distance"
    sectors_per_half_turn: int = 2


@dataclass(frozen=True, kw_only=True)
class WhereNew:
    """Images that show something new, in order (section 9.4, ``vidslam``).

    Args:
        most: keyframes; once there are as many, a new one takes the place of one that is close to its neighbours.
        rule: what is new.
        local_context: images last seen that are looked at too, whether they are kept or not.
    """

    most: int
    rule: NoveltyRule = field(default_factory=NoveltyRule)
    local_context: int = 0


KeyframeChoice = EvenlySpread | UnlikeEachOther | EveryKth | WhereNew


def farthest_points(distances: Array, num_points: int, *, first: int) -> tuple[tuple[int, ...], tuple[float, ...]]:
    """Points far from each other: always the one that is farthest from those chosen before it.

    Args:
        distances: (N, N).
        num_points: N or less.
        first: index of the first point.

    Returns:
        Indices as chosen, and how far each was from the nearest before it (0 for the first).

    Source: network specification, section 9.5; of equals the first is taken.
    """
    chosen, gaps = [first], [0.0]
    nearest = distances[first].astype(np.float64)
    while len(chosen) < num_points:
        nearest[chosen] = -np.inf
        chosen.append(int(nearest.argmax()))
        gaps.append(float(nearest[chosen[-1]]))
        nearest = np.minimum(nearest, distances[chosen[-1]])
    return tuple(chosen), tuple(gaps)


def order_by_similarity(similarity: Array) -> tuple[int, ...]:
    """An order in which every image is similar to one before it, from the one that is most similar to all.

    Args:
        similarity: (N, N); the diagonal does not count.

    Source: network specification, section 9.5. Where upstream sets a taken column to zero, here it is out of
    the question, so that negative similarities cannot bring an image back.
    """
    left = similarity.astype(np.float64)
    np.fill_diagonal(left, 0.0)
    order = [int(left.sum(axis=1).argmax())]
    left[:, order[0]] = -np.inf
    while len(order) < len(left):
        rows = left[sorted(order)]
        order.append(int(rows.argmax() % rows.shape[1]))
        left[:, order[-1]] = -np.inf
    return tuple(order)


# ----------------------------------------------------------------------------- what is new in an image
@dataclass(frozen=True, kw_only=True, eq=False)
class View:
    """What an image shows, as the network says.

    Args:
        points_world: (H, W, 3).
        depth: (H, W) z in the camera's own frame.
        confidence: (H, W).
        centre_world: (3,) of the camera.
    """

    points_world: Array
    depth: Array
    confidence: Array
    centre_world: Array


class Discovery:
    """The space that the keyframes so far have shown; it tells whether an image shows more."""

    def __init__(self, rule: NoveltyRule) -> None:
        self._rule = rule
        self._seen = SectorTrees(rule.sectors_per_half_turn)

    def score(self, view: View) -> float:
        """How much of the view is new; see ``NoveltyRule.novelty``. 0 where no pixel is good enough to tell."""
        match self._rule.novelty:
            case "mean-confidence":
                return float(view.confidence.mean())
            case "median-confidence":
                return float(np.quantile(view.confidence, 0.5, method="lower"))
            case _:
                return self._distance_score(view)

    def _distance_score(self, view: View) -> float:
        points_world, depth = self._good_pixels(view)
        if not len(points_world):
            return 0.0
        distances = self._seen.distances(points_world, view.centre_world)
        if self._rule.novelty == "relative-distance":
            distances = distances / (depth + _SMALLEST_DEPTH)
        # Nothing was ever seen in a direction: percentiles need a number, larger than any. Behind the camera: none.
        return float(np.percentile(np.nan_to_num(distances, neginf=0.0), self._rule.percentile))

    def is_new(self, view: View) -> bool:
        """Whether the image ought to become a keyframe."""
        if self._rule.novelty.endswith("confidence"):
            return self.score(view) < self._rule.threshold
        return self.score(view) > self._rule.threshold

    def add(self, view: View) -> None:
        """The image has become a keyframe."""
        points_world, _ = self._good_pixels(view)
        self._seen.add(points_world, view.centre_world)

    def _good_pixels(self, view: View) -> tuple[Array, Array]:
        """(N, 3) points and (N,) depths of some confident pixels; those that are not finite are left out."""
        step = self._rule.subsample
        points_world = view.points_world[::step, ::step].reshape(-1, 3)
        depth = view.depth[::step, ::step].reshape(-1)
        good = view.confidence[::step, ::step].reshape(-1) > self._rule.min_confidence
        good &= np.isfinite(points_world).all(axis=1) & np.isfinite(depth) & np.isfinite(view.centre_world).all()
        return points_world[good], depth[good]


class SectorTrees:
    """Points by the direction from which they were seen, for nearest neighbours in the same sector alone.

    A wall seen from the other side is new, however close its points are. There is one tree per sector, made anew
    when points come: with 50 keyframes of 512 x 384 pixels that is a tenth of what many small trees lose in searching.
    """

    def __init__(self, sectors_per_half_turn: int = 2) -> None:
        self._per_half_turn = sectors_per_half_turn
        self._trees: list[cKDTree | None] = [None] * (2 * sectors_per_half_turn**2)

    def add(self, points_world: Array, centre_world: Array) -> None:
        """Remember (N, 3) finite points seen from a place."""
        for sector, rows in self._by_sector(points_world, centre_world):
            tree, points = self._trees[sector], points_world[rows]
            before = points[:0] if tree is None else tree.data
            self._trees[sector] = cKDTree(np.concatenate((before, points)), balanced_tree=False)

    def distances(self, points_world: Array, centre_world: Array) -> Array:
        """(N,) from finite points seen from a place to the nearest one remembered; inf where there is none."""
        nearest = np.full(len(points_world), np.inf)
        for sector, rows in self._by_sector(points_world, centre_world):
            tree = self._trees[sector]
            if tree is not None:
                nearest[rows], _ = tree.query(points_world[rows])
        return nearest

    def _by_sector(self, points_world: Array, centre_world: Array) -> Iterator[tuple[int, npt.NDArray[np.intp]]]:
        rays = points_world - centre_world.astype(points_world.dtype)  # the sector of a float32 point is upstream's
        sectors = sectors_of(rays, self._per_half_turn)
        for sector in np.unique(sectors):
            yield int(sector), np.flatnonzero(sectors == sector)


def sectors_of(rays: Array, per_half_turn: int) -> npt.NDArray[np.int64]:
    """(N,) number of the sector, below 2 * per_half_turn**2, of (N, 3) directions of any length (section 9.6)."""
    q = per_half_turn
    lengths = np.maximum(np.linalg.norm(rays, axis=1), _SHORTEST_RAY)
    x, y, z = (rays / lengths[:, None]).T
    inclination = np.arccos(z) / np.pi  # [0, 1]
    azimuth = np.arctan2(y, x) / np.pi  # [-1, 1]
    inclination = np.clip(inclination, _SECTOR_MARGIN, 1 - _SECTOR_MARGIN)
    azimuth = np.clip(azimuth, -1 + _SECTOR_MARGIN, 1 - _SECTOR_MARGIN)
    sectors: Array = np.floor(inclination * q) + (np.floor(azimuth * q) + q) * q
    return sectors.astype(np.int64)


def place_to_give_up(places: Sequence[int]) -> int | None:
    """Of ascending places, the one whose neighbours are closest together; the ends stay. None if there are but ends."""
    widths = [after - before for before, after in zip(places, places[2:], strict=False)]
    return places[1 + widths.index(min(widths))] if widths else None
