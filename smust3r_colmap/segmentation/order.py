"""Whether the order of the images means anything: sequences, or images in no order.

A folder is a sequence where images next to each other look more alike than images far apart. Folders are sequences of
their own, unless the last image of one looks like the first of the next, as in one walk over several folders.
The next module to read is ``view_graph``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import PurePosixPath
from typing import Literal

import numpy as np

from smust3r_colmap.segmentation.similarity import Descriptors, SimilarityStatistics, similarity_statistics
from smust3r_colmap.segmentation.view_graph import ViewGraph

MIN_CONTRAST = 1.0
"""Likeness of neighbours beyond that of far images, in standard deviations, from which the order counts. Neighbours
on eight ordered sets stand out by 2.9 to 12, on the same images shuffled by -0.3 to 0.2 (2.3 of eleven images)."""
MIN_JOINED = 0.25
"""Part of the way from far images to neighbours, in likeness, from which two folders are one sequence."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ImageOrder:
    """The sequences of a collection.

    Args:
        chain: every image and the next of its sequence; no pairs where there is no order.
        reason: what was decided and why, for people.
        is_one_sequence: all of them follow each other.
    """

    chain: ViewGraph
    reason: str
    is_one_sequence: bool


def decide_order(
    names: Sequence[str],
    keyframes: Sequence[int],
    descriptors: Descriptors | None,
    wanted: Literal["auto", "sequence", "unordered"],
) -> ImageOrder:
    """The order as asked for, or as names and likeness say.

    Args:
        names: of all N images, with forward slashes.
        keyframes: those that take part, ascending; the others are in no pair.
        descriptors: (N, D) unit rows, zero where an image takes no part; None where the images are so few that order
            makes no difference.
        wanted: ``"sequence"`` makes one sequence of all folders, as named.
    """
    empty = ViewGraph.without_pairs(len(names))
    chain = empty.with_pairs(list(pairwise(keyframes)), "order")
    if wanted == "unordered":
        return ImageOrder(chain=empty, is_one_sequence=False, reason="images in no order, as asked for")
    if wanted == "sequence":
        return ImageOrder(chain=chain, is_one_sequence=True, reason="one sequence by name, as asked for")
    if descriptors is None:
        return ImageOrder(chain=chain, is_one_sequence=True, reason="few images, all pairs are matched")
    folder = {k: str(PurePosixPath(names[k]).parent) for k in keyframes}
    steps = list(pairwise(keyframes))
    inside = empty.with_pairs([(a, b) for a, b in steps if folder[a] == folder[b]], "order")
    statistics = similarity_statistics(descriptors, inside)
    if statistics is None:
        return ImageOrder(chain=chain, is_one_sequence=True, reason="one sequence: too few descriptors to tell")
    measured = (
        f"neighbours (median similarity {statistics.neighbour_median:.3f}) and images far apart "
        f"({statistics.far_median:.3f}) differ by {statistics.contrast:.1f} standard deviations"
    )
    if statistics.contrast < MIN_CONTRAST:
        return ImageOrder(chain=empty, is_one_sequence=False, reason=f"images in no order: {measured}")
    borders = [(a, b) for a, b in steps if folder[a] != folder[b]]
    joined = [pair for pair in borders if _is_joined(pair, descriptors, statistics)]
    chain = inside.with_pairs(joined, "order")
    count = len(keyframes) - len(chain.pairs)
    found = "one sequence" if count == 1 else f"{count} sequences, from the folders"
    return ImageOrder(chain=chain, is_one_sequence=count == 1, reason=f"{found}: {measured}")


def _is_joined(pair: tuple[int, int], descriptors: Descriptors, statistics: SimilarityStatistics) -> bool:
    cosine = float(np.dot(descriptors[pair[0]], descriptors[pair[1]]))
    least = statistics.far_median + MIN_JOINED * (statistics.neighbour_median - statistics.far_median)
    return cosine >= least
