"""Covers of simulated view graphs: every image, sizes, shared images, components, the same twice."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import pytest

from smust3r_colmap.segmentation.cover import MIN_IMAGES_GIVEN, Cover, plan_cover
from smust3r_colmap.segmentation.view_graph import ViewGraph

LENGTH, OVERLAP = 60, 20


def graph_of(num_images: int, pairs: np.ndarray, weights: np.ndarray) -> ViewGraph:
    return ViewGraph.without_pairs(num_images).with_pairs(pairs, "retrieval", weights=weights)


def walk(num_images: int, *, reach: int = 8, closed: bool = False, seed: int = 0) -> tuple[ViewGraph, np.ndarray]:
    """Images along a line or round a ring whose names are in no order, and the place of each along it."""
    place = np.random.default_rng(seed).permutation(num_images)
    image_at = np.argsort(place)
    first = np.concatenate([np.arange(num_images - (0 if closed else step)) for step in range(1, reach + 1)])
    steps = np.concatenate([np.full(num_images - (0 if closed else step), step) for step in range(1, reach + 1)])
    pairs = np.column_stack([image_at[first], image_at[(first + steps) % num_images]])
    return graph_of(num_images, pairs, 300.0 / steps), place


def sets(cover: Cover) -> list[set[int]]:
    return [set(segment.images) for segment in cover.segments]


def plan(graph: ViewGraph) -> Cover:
    return plan_cover(graph, segment_length=LENGTH, overlap=OVERLAP)


def test_a_walk_in_no_order_is_cut_into_stretches_of_it() -> None:
    graph, place = walk(400)
    cover = plan(graph)
    clusters = sets(cover)
    assert set().union(*clusters) == set(range(400))
    assert len(clusters) == 10, "windows of 60 that share 20 are as many"
    for segment in cover.segments:
        assert list(segment.images) == sorted(segment.images)
        assert segment.kind == "cluster"
        where = np.sort(place[list(segment.images)])
        assert np.diff(where).max() == 1, "a stretch without gaps"
        assert len(segment.images) <= LENGTH + 2
    in_order = sorted(clusters, key=lambda cluster: np.mean(place[list(cluster)]))
    for one, after in itertools.pairwise(in_order):
        assert len(one & after) == 16, "the eight images on either side that match across"


def test_a_ring_is_closed_by_shared_images() -> None:
    graph, _ = walk(300, closed=True)
    clusters = sets(plan(graph))
    num_neighbours = [
        sum(len(one & other) >= OVERLAP // 2 for other in clusters if other is not one) for one in clusters
    ]
    assert num_neighbours == [2] * len(clusters)


def test_parts_without_pairs_between_them_share_nothing_and_the_largest_comes_first() -> None:
    small, _ = walk(70, seed=1)
    large, _ = walk(200, seed=2)
    pairs = np.concatenate([small.pairs, large.pairs + 70, [[270, 271]]])
    graph = graph_of(273, pairs, np.concatenate([small.weights, large.weights, [50.0]]))
    cover = plan(graph)
    owner = [{image < 70 for image in segment.images} for segment in cover.segments]
    assert all(len(one) == 1 for one in owner)
    assert owner[0] == {False}, "the larger part"
    assert owner[-1] == {True}
    assert cover.left_out == (270, 271, 272), "a pair and a single image are no scene"


def test_a_component_of_one_segment_is_not_cut() -> None:
    graph, _ = walk(LENGTH)
    assert sets(plan(graph)) == [set(range(LENGTH))]


def test_clusters_follow_strong_matches_rather_than_weak_ones() -> None:
    """Two walks that look alike here and there: a few matches join them at one place only."""
    graph, _ = walk(80)
    pairs = np.concatenate([graph.pairs, graph.pairs + 80, [[3, 90], [50, 120], [20, 100]]])
    both = graph_of(160, pairs, np.concatenate([graph.weights, graph.weights, [16.0] * 3]))
    mixed = [min(sum(image < 80 for image in one), sum(image >= 80 for image in one)) for one in sets(plan(both))]
    assert max(mixed) <= OVERLAP // 2, "only the images that were given"


@pytest.mark.parametrize("seed", [0, 1])
def test_the_same_cover_twice(seed: int) -> None:
    graph, _ = walk(500, seed=seed)
    assert plan(graph) == plan(graph)


def test_neighbours_of_a_star_still_share_images() -> None:
    """Many arms meet in one place."""
    arm = 60
    pairs, weights = [], []
    for number in range(9):
        images = 40 + number * arm + np.arange(arm)
        for step in range(1, 5):
            pairs.append(np.column_stack([images[:-step], images[step:]]))
            weights.append(np.full(arm - step, 200.0 / step))
        pairs.append(np.column_stack([4 * number + np.arange(4), images[:4]]))
        weights.append(np.full(4, 200.0))
    centre = np.array([(i, j) for i in range(40) for j in range(i + 1, 40)])
    graph = graph_of(
        40 + 9 * arm, np.concatenate([*pairs, centre]), np.concatenate([*weights, np.full(len(centre), 100.0)])
    )
    clusters = sets(plan(graph))
    assert set().union(*clusters) == set(range(graph.num_images))
    assert _is_connected(clusters, at_least=2 * MIN_IMAGES_GIVEN - 2)


def _is_connected(clusters: Sequence[set[int]], *, at_least: int) -> bool:
    reached, todo = {0}, [0]
    while todo:
        one = todo.pop()
        for k, other in enumerate(clusters):
            if k not in reached and len(clusters[one] & other) >= at_least:
                reached.add(k)
                todo.append(k)
    return len(reached) == len(clusters)


@pytest.mark.slow
def test_100000_images_are_covered_in_flat_memory() -> None:
    graph, _ = walk(100_000)
    cover = plan(graph)
    sizes = [len(segment.images) for segment in cover.segments]
    assert len(np.unique(np.concatenate([segment.images for segment in cover.segments]))) == 100_000
    assert max(sizes) <= LENGTH + 3
    assert len(sizes) <= 1.1 * (100_000 - OVERLAP) / (LENGTH - OVERLAP)


def test_no_images_and_no_pairs() -> None:
    assert plan(ViewGraph.without_pairs(0)) == Cover(segments=(), left_out=())
    assert plan(ViewGraph.without_pairs(3)) == Cover(segments=(), left_out=(0, 1, 2))
