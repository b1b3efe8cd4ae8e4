"""Choosing loops among the images that look alike, and cutting their segments (paper section III-F).

Every pair of segments with images that look alike is a candidate and gets a decision with a reason. Whether
a chosen loop is true is not decided here: its segment is reconstructed and verified first, and the pose
graph may still reject it.

How similar is similar enough:

- A given similarity (the paper's sigma) is compared with the cosines of single images, as in the paper.
- Automatic: images are compared together with their neighbours (``similarity``), and the threshold is
  four robust standard deviations above the median of far pairs. Where the camera comes back often, or
  images are few, the loops themselves widen that scatter (a castle in 30 photographs: its one true loop
  stands at 2.7). So the best few loops may lie below the threshold, down to two standard deviations.
- Both ask for a quarter of the way from far images to neighbours at least, because on a straight drive
  the scatter is small and four times it means little. With VLAD, on five sets with loops, every true
  one taken lay at 0.34 of that way or higher and the one false at 0.28; without loops, none passed 0.25.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from smust3r_colmap.products import Segment
from smust3r_colmap.segmentation.similarity import (
    AlikeSegments,
    Descriptors,
    SimilarityStatistics,
    alike_segments,
    check_descriptors,
    far_apart,
    home_segments,
    neighbours_alike,
    similarity_statistics,
    with_neighbours,
)
from smust3r_colmap.segmentation.view_graph import NO_WAY, ViewGraph

# The thresholds: see the module docstring.
_STRONG_SIGMAS = 4.0
_WEAK_SIGMAS = 2.0
_LEAST_PART_OF_CONTRAST = 0.25
# In long sequences as many as one for every four segments, which adds a sixth to the reconstruction.
_WEAK_LOOPS = 5
_SEGMENTS_PER_WEAK_LOOP = 4
# Neighbours of a moving camera stand out from far images: by 2.4 standard deviations on the hardest set
# (50 frames of an orbit with gaps), by 0.1 on unordered photographs. A standing camera gives about 0.
_MIN_CONTRAST = 1.0
# A segment tied to three other places is held; every further loop costs a reconstruction and adds little.
_LOOPS_PER_SEGMENT = 3
# Of a camera that keeps coming back, the record keeps this many candidates for each segment.
_CANDIDATES_PER_SEGMENT = 20
# Enough to see whether the camera left, when two visits are thousands of images apart.
_SAMPLED_IN_BETWEEN = 256


@dataclass(frozen=True, kw_only=True)
class LoopCandidate:
    """Two segments with images that look alike, and the decision.

    Args:
        image_a, image_b: the most similar images of the two, ``image_a`` at home in ``segment_a``.
        similarity: their cosine.
        segment_a, segment_b: indices of the windows, ``segment_a < segment_b``.
        num_pairs: image pairs of the two segments that look alike.
        taken: a loop segment was planned.
        reason: the decision, for people.
    """

    image_a: int
    image_b: int
    similarity: float
    segment_a: int
    segment_b: int
    num_pairs: int
    taken: bool
    reason: str


@dataclass(frozen=True, kw_only=True)
class PlannedLoop:
    """A loop to be tried.

    Args:
        segment: the images around its two ends, of kind ``"loop"``.
        image_a, image_b: the two ends.
        segment_a, segment_b: the windows in which they are at home.
        similarity: cosine of the ends.
    """

    segment: Segment
    image_a: int
    image_b: int
    segment_a: int
    segment_b: int
    similarity: float


@dataclass(frozen=True, kw_only=True)
class LoopPlan:
    """All loops of a run and all that was considered.

    Args:
        threshold: cosine from which two images look alike; None where none could be found.
        weak_threshold: cosine from which the best few loops and the supporting pairs count; at most ``threshold``.
        neighbours: images on each side that were compared together with each image; 0 for single images.
        statistics: of the cosines compared; None where the collection is too small to have any.
        candidates: most similar first.
        num_left_out: further candidates, less similar, that were not looked at.
        loops: most similar first; their segments are numbered on from the windows.
        note: why there was nothing to choose from, or empty.
    """

    threshold: float | None
    weak_threshold: float | None
    neighbours: int
    statistics: SimilarityStatistics | None
    candidates: tuple[LoopCandidate, ...] = ()
    num_left_out: int = 0
    loops: tuple[PlannedLoop, ...] = ()
    note: str = ""

    def __post_init__(self) -> None:
        taken = {(one.segment_a, one.segment_b) for one in self.candidates if one.taken}
        if taken != {(loop.segment_a, loop.segment_b) for loop in self.loops} or len(taken) != len(self.loops):
            raise ValueError(f"LoopPlan: {len(taken)} candidates were taken for {len(self.loops)} loops")


def plan_loops(
    descriptors: npt.NDArray[np.float32],
    graph: ViewGraph,
    windows: Sequence[Segment],
    *,
    similarity: float | Literal["auto"],
    min_candidates: int,
    min_distance: int,
    half_width: int,
) -> LoopPlan:
    """Find where the sequence came back to, and plan a segment for each loop.

    Args:
        descriptors: (N, D) one unit vector per image; zero rows take no part.
        graph: the order of the N images.
        windows: segments of the sequence, ``windows[k].index == k``.
        similarity: cosine from which two images look alike; auto takes it from the collection.
        min_candidates: image pairs that two segments need.
        min_distance: segments closer than this in order are no loop.
        half_width: images before and after each end in the loop segment.

    Raises:
        InputError: descriptors that do not fit the collection, are not finite or not of unit length.
    """
    num_images = graph.num_images
    check_descriptors(descriptors, num_images)
    statistics = similarity_statistics(descriptors, graph)
    if similarity != "auto":
        compared, threshold, weak, reach = descriptors, similarity, similarity, 0
    elif statistics is None:
        return _nothing_planned(statistics, "too few images have descriptors to tell far from near")
    elif statistics.contrast < _MIN_CONTRAST:
        return _nothing_planned(
            statistics,
            f"neighbouring images (median similarity {statistics.neighbour_median:.3f}) are no more alike than "
            f"far ones ({statistics.far_median:.3f}): the camera stood still, or the images are in no order",
        )
    else:
        reach = neighbours_alike(descriptors, graph, statistics, at_most=min(half_width, far_apart(num_images) // 3))
        compared = with_neighbours(descriptors, graph, reach)
        statistics = similarity_statistics(compared, graph)
        assert statistics is not None
        threshold, weak = _automatic_thresholds(statistics)
    alike = alike_segments(compared, home_segments([w.images for w in windows], num_images), at_least=weak)
    apart = [pair for pair in alike if set(windows[pair.segment_a].images).isdisjoint(windows[pair.segment_b].images)]
    apart.sort(key=lambda pair: (-pair.similarity, pair.image_a, pair.image_b))
    rules = _Rules(
        graph=graph,
        threshold=threshold,
        weak_threshold=weak,
        min_candidates=min_candidates,
        min_distance=min_distance,
        half_width=half_width,
        weak_loops=max(_WEAK_LOOPS, len(windows) // _SEGMENTS_PER_WEAK_LOOP),
        # Half a segment: loops along a second lap then follow each other once per segment.
        radius=max(half_width, len(windows[0].images) // 2),
    )
    looked_at = apart[: _CANDIDATES_PER_SEGMENT * len(windows)]
    candidates, loops = _choose(looked_at, compared, windows, rules)
    return LoopPlan(
        threshold=threshold,
        weak_threshold=weak,
        neighbours=reach,
        statistics=statistics,
        candidates=candidates,
        num_left_out=len(apart) - len(looked_at),
        loops=loops,
    )


def images_around(images: Sequence[int], end: int, half_width: int) -> tuple[int, ...]:
    """One side of a loop segment: ``half_width`` images before and after one end of the loop.

    Near the border of its segment the run is shifted inwards rather than shortened; a segment with
    fewer images gives all it has. Runs take every image, as in the paper: in a video neighbours are nearly
    alike, but a strided run of the same number leaves less in common with the images next to it,
    while every image here ties the loop to its segment.

    Args:
        images: of the segment, ascending; ``end`` is one of them.
    """
    length = 2 * half_width + 1
    start = min(max(images.index(end) - half_width, 0), max(len(images) - length, 0))
    return tuple(images[start : start + length])


# --------------------------------------------------------------------------- thresholds
def _nothing_planned(statistics: SimilarityStatistics | None, note: str) -> LoopPlan:
    return LoopPlan(threshold=None, weak_threshold=None, neighbours=0, statistics=statistics, note=note)


def _automatic_thresholds(statistics: SimilarityStatistics) -> tuple[float, float]:
    """The threshold, and the lower one of the best few loops; see the module docstring."""
    part = _LEAST_PART_OF_CONTRAST * (statistics.neighbour_median - statistics.far_median)
    strong, weak = (max(sigmas * statistics.far_sigma, part) for sigmas in (_STRONG_SIGMAS, _WEAK_SIGMAS))
    return statistics.far_median + strong, statistics.far_median + weak


# ----------------------------------------------------------------------------- choosing
@dataclass(frozen=True, kw_only=True)
class _Rules:
    """The arguments of ``plan_loops``, and limits derived from them for this collection.

    Args:
        graph: the order of the images.
        weak_loops: loops below the threshold are taken only while there are fewer loops than this.
        radius: images, in both directions of time, within which two pairs show one revisit.
    """

    graph: ViewGraph
    threshold: float
    weak_threshold: float
    min_candidates: int
    min_distance: int
    half_width: int
    weak_loops: int
    radius: int


def _choose(
    pairs: Sequence[AlikeSegments], compared: Descriptors, windows: Sequence[Segment], rules: _Rules
) -> tuple[tuple[LoopCandidate, ...], tuple[PlannedLoop, ...]]:
    """Go through the pairs, the best first, and take those without a rejection reason."""
    candidates: list[LoopCandidate] = []
    loops: list[PlannedLoop] = []
    for pair in pairs:
        run_a = images_around(windows[pair.segment_a].images, pair.image_a, rules.half_width)
        run_b = images_around(windows[pair.segment_b].images, pair.image_b, rules.half_width)
        rejection = _pair_rejection(pair, rules) or _rejection_beside(pair, loops, rules)
        if not rejection and len(rules.graph.runs(run_a + run_b)) == 1:
            rejection = "the images around the two ends touch"
        if not rejection and not _left_in_between(pair, compared, rules):
            rejection = "the camera did not leave the place in between"
        if not rejection:
            segment = Segment(index=len(windows) + len(loops), images=run_a + run_b, kind="loop")
            loops.append(
                PlannedLoop(
                    segment=segment,
                    image_a=pair.image_a,
                    image_b=pair.image_b,
                    segment_a=pair.segment_a,
                    segment_b=pair.segment_b,
                    similarity=pair.similarity,
                )
            )
        candidates.append(
            LoopCandidate(**asdict(pair), taken=not rejection, reason=rejection or _acceptance(pair, rules))
        )
    return tuple(candidates), tuple(loops)


def _acceptance(pair: AlikeSegments, rules: _Rules) -> str:
    if pair.similarity >= rules.threshold:
        return f"taken: at or above the threshold {rules.threshold:.3f}"
    return f"taken: one of the best {rules.weak_loops}, though below the threshold {rules.threshold:.3f}"


def _pair_rejection(pair: AlikeSegments, rules: _Rules) -> str:
    """The rejection reason of the pair itself, or empty."""
    distance = pair.segment_b - pair.segment_a
    if distance < rules.min_distance:
        return f"too near in order: {distance} segments apart, needed {rules.min_distance}"
    if pair.num_pairs < rules.min_candidates:
        return f"only {pair.num_pairs} image pairs look alike, needed {rules.min_candidates}"
    return ""


def _rejection_beside(pair: AlikeSegments, loops: Sequence[PlannedLoop], rules: _Rules) -> str:
    """The rejection reason beside the better loops that were taken, or empty."""
    ends = np.array([(loop.image_a, loop.image_b) for loop in loops], dtype=np.int64).reshape(-1, 2)
    # A box in both directions of time: the second visit may run along the first or against it.
    near = (rules.graph.steps_between(ends, (pair.image_a, pair.image_b)) <= rules.radius).all(axis=1)
    if near.any():
        image_a, image_b = ends[near.argmax()]
        return f"suppressed by the better pair ({image_a}, {image_b}) within {rules.radius} images"
    for segment in (pair.segment_a, pair.segment_b):
        if sum(segment in (loop.segment_a, loop.segment_b) for loop in loops) >= _LOOPS_PER_SEGMENT:
            return f"segment {segment} has {_LOOPS_PER_SEGMENT} better loops already"
    if pair.similarity < rules.threshold and len(loops) >= rules.weak_loops:
        return f"below the threshold {rules.threshold:.3f}, and {len(loops)} better loops were taken"
    return ""


def _left_in_between(pair: AlikeSegments, compared: Descriptors, rules: _Rules) -> bool:
    """A return needs a departure: enough images between the two ends look like neither.

    While a camera stands still, images any time apart look alike, and nothing is closed by saying so.
    Another sequence is no return.
    """
    apart = int(rules.graph.steps_between(pair.image_a, pair.image_b))
    if apart == NO_WAY:
        return True
    step = 1 + apart // _SAMPLED_IN_BETWEEN
    between = compared[rules.graph.between(pair.image_a, pair.image_b)[::step]]
    between = between[between.any(axis=1)]
    nearest = (between @ compared[[pair.image_a, pair.image_b]].T).max(axis=1, initial=-1.0)
    return bool((nearest < rules.weak_threshold).sum() * step >= rules.half_width)
