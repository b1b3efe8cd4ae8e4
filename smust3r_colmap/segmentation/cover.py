"""A cover of a view graph by overlapping, connected clusters of bounded size: segments of images in no order.

Every connected component is cut by METIS into balanced parts with few verified matches between them, as COLMAP's
hierarchical mapper cuts a scene. Then every part is enlarged by those images of its neighbours that match it best,
so that neighbours share images and their submodels can be aligned. The windows of a sequence are the special case of
a chain. The next module to read is ``windows``.

Karypis and Kumar, "A fast and high quality multilevel scheme for partitioning irregular graphs", SIAM Journal on
Scientific Computing 20(1), 1998.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pymetis
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree

from smust3r_colmap.geometry.arrays import FloatArray, IntArray
from smust3r_colmap.products import Segment
from smust3r_colmap.segmentation.view_graph import ViewGraph

MIN_COMPONENT_IMAGES = 3
"""Of a connected component, for it to become a segment: two images alone confirm nothing."""
MAX_WEIGHT = 300
"""Matches of a pair that count; more do not tie two images more firmly."""
MIN_NEIGHBOUR_RATIO = 0.2
"""Matches between two parts, over those of their best neighbours, from which they share images beyond the tree that
connects all parts."""
MIN_IMAGES_GIVEN = 3
"""Images that two neighbouring parts give each other at least, whatever the number of neighbours."""


@dataclass(frozen=True, kw_only=True)
class Cover:
    """Segments of a view graph.

    Args:
        segments: the largest component first, ``segments[k].index == k``; the images of each ascend.
        left_out: images of components that are too small, ascending.
    """

    segments: tuple[Segment, ...]
    left_out: tuple[int, ...]


def plan_cover(graph: ViewGraph, *, segment_length: int, overlap: int) -> Cover:
    """Overlapping clusters of at most about l images, which hold every image of a large enough component.

    Args:
        graph: pairs weighted by verified matches; the others have been left out.
        segment_length: l, at least 2.
        overlap: p, images that a cluster takes from its neighbours, from 1 to l - 1. Two neighbours in a chain so share
            p images. Where a cluster has more than p / ``MIN_IMAGES_GIVEN`` neighbours it takes more.
    """
    affinity = _affinity(graph)
    _, label = connected_components(affinity, directed=False)
    sizes = np.bincount(label, minlength=1)
    clusters: list[IntArray] = []
    for component in np.argsort(-sizes, kind="stable"):
        if sizes[component] >= MIN_COMPONENT_IMAGES:
            images = np.flatnonzero(label == component)
            own = affinity[images][:, images]
            clusters += [images[cluster] for cluster in _clusters(own, segment_length, overlap)]
    segments = tuple(
        Segment(index=k, images=tuple(cluster.tolist()), kind="cluster") for k, cluster in enumerate(clusters)
    )
    left_out = np.flatnonzero(sizes[label] < MIN_COMPONENT_IMAGES) if graph.num_images else label
    return Cover(segments=segments, left_out=tuple(left_out.tolist()))


def _affinity(graph: ViewGraph) -> csr_array:
    """(N, N) symmetric, verified matches of every pair, at most ``MAX_WEIGHT``."""
    weights = np.clip(np.rint(graph.weights), 1, MAX_WEIGHT).astype(np.int64)
    first, second = graph.pairs.T
    shape = (graph.num_images, graph.num_images)
    one_way = csr_array((weights, (first, second)), shape=shape)
    return csr_array(one_way + one_way.T)


def _clusters(affinity: csr_array, length: int, overlap: int) -> Iterator[IntArray]:
    """Overlapping clusters of a connected graph, each ascending."""
    n = affinity.shape[0]
    if n <= length:
        yield np.arange(n)
        return
    part = _partition(affinity, math.ceil((n - overlap) / (length - overlap)))
    strength = _strength_to_parts(affinity, part)
    given = _images_given(strength, part, overlap)
    for k in range(int(part.max()) + 1):
        yield np.unique(np.concatenate([np.flatnonzero(part == k), *given[k]]))


def _partition(affinity: csr_array, num_parts: int) -> IntArray:
    """(N,) part of every image; every part is connected and not empty."""
    if num_parts == 1:
        return np.zeros(affinity.shape[0], dtype=np.int64)
    _, part = pymetis.part_graph(
        num_parts,
        adjacency=pymetis.CSRAdjacency(affinity.indptr, affinity.indices),
        eweights=affinity.data.tolist(),
        options=pymetis.Options(contig=True),
    )
    inside = affinity.tocoo()
    same = np.asarray(part)[inside.row] == np.asarray(part)[inside.col]
    within = csr_array((inside.data[same], (inside.row[same], inside.col[same])), shape=affinity.shape)
    # METIS asks for connected parts, and gives them up where balance forbids them.
    _, connected = connected_components(within, directed=False)
    return np.asarray(connected, dtype=np.int64)


def _strength_to_parts(affinity: csr_array, part: IntArray) -> csr_array:
    """(N, K) matches between every image and every part."""
    n = len(part)
    member = csr_array((np.ones(n, dtype=np.int64), (np.arange(n), part)), shape=(n, int(part.max()) + 1))
    return csr_array(affinity @ member)


def _images_given(strength: csr_array, part: IntArray, overlap: int) -> dict[int, list[IntArray]]:
    """By part, the images that it takes from each of its neighbours."""
    neighbours = _neighbouring_parts(strength, part)
    by_part = strength.tocsc()
    given: dict[int, list[IntArray]] = {}
    for k, others in neighbours.items():
        rows, values = (array[by_part.indptr[k] : by_part.indptr[k + 1]] for array in (by_part.indices, by_part.data))
        best_first = np.argsort(-values, kind="stable")
        rows = rows[best_first]
        count = max(overlap // len(others), MIN_IMAGES_GIVEN)
        given[k] = [rows[part[rows] == other][:count] for other in sorted(others)]
    return defaultdict(list, given)


def _neighbouring_parts(strength: csr_array, part: IntArray) -> dict[int, set[int]]:
    """By part, the parts it shares images with: along the tree of most matches, and others with nearly as many."""
    num_parts = strength.shape[1]
    n = len(part)
    member = csr_array((np.ones(n, dtype=np.int64), (part, np.arange(n))), shape=(num_parts, n))
    between = csr_array(member @ strength).tocoo()
    across = between.row < between.col
    first, second, matches = between.row[across], between.col[across], between.data[across].astype(np.float64)
    best: FloatArray = np.zeros(num_parts)
    np.maximum.at(best, first, matches)
    np.maximum.at(best, second, matches)
    cost = csr_array((1.0 / matches, (first, second)), shape=(num_parts, num_parts))
    tree = minimum_spanning_tree(cost).tocoo()
    pairs = set(zip(tree.row.tolist(), tree.col.tolist(), strict=True))
    strong = matches >= MIN_NEIGHBOUR_RATIO * np.maximum(best[first], best[second])
    pairs |= set(zip(first[strong].tolist(), second[strong].tolist(), strict=True))
    neighbours: dict[int, set[int]] = defaultdict(set)
    for a, b in pairs:
        neighbours[a].add(b)
        neighbours[b].add(a)
    return neighbours
