"""The view graph: what it refuses, its answers on sequences, and its size at 100,000 images."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from smust3r_colmap.products import Segment
from smust3r_colmap.segmentation.loop_segments import LoopCandidate, LoopPlan, PlannedLoop
from smust3r_colmap.segmentation.stage import Segments
from smust3r_colmap.segmentation.view_graph import NO_WAY, REASONS, ViewGraph
from smust3r_colmap.segmentation.windows import plan_windows
from smust3r_colmap.storage.codec import Codec

NOTHING = ViewGraph.chain(0).with_pairs([], "user")
TWO_SEQUENCES = replace(NOTHING, num_images=8).with_pairs([(0, 2), (2, 4), (4, 6), (1, 3), (3, 5)], "order")
"""Images 0 2 4 6 and 1 3 5, and image 7 by itself."""


def reasons(graph: ViewGraph) -> dict[tuple[int, int], str]:
    return {(i, j): REASONS[one] for (i, j), one in zip(graph.pairs.tolist(), graph.reasons.tolist(), strict=True)}


# ------------------------------------------------------------------------------ pairs
def test_a_chain_joins_every_image_and_the_next() -> None:
    graph = ViewGraph.chain(5)
    assert reasons(graph) == {(0, 1): "order", (1, 2): "order", (2, 3): "order", (3, 4): "order"}
    assert graph.weights.tolist() == [1, 1, 1, 1]
    assert [graph.neighbours(k).tolist() for k in range(5)] == [[1], [0, 2], [1, 3], [2, 4], [3]]


def test_a_pair_keeps_its_first_weight_and_reason() -> None:
    graph = ViewGraph.chain(4).with_pairs([(3, 0), (1, 2), (0, 3)], "retrieval", weights=[0.4, 0.5, 0.6])
    assert reasons(graph) == {(0, 1): "order", (0, 3): "retrieval", (1, 2): "order", (2, 3): "order"}
    assert graph.weights.tolist() == [1, 0.4, 1, 1]
    assert reasons(graph.with_pairs([(0, 2)], "user"))[0, 2] == "user"


def test_neighbours_are_symmetric_and_as_the_pairs_say() -> None:
    rng = np.random.default_rng(0)
    pairs = rng.integers(0, 30, size=(90, 2))
    graph = ViewGraph.chain(30).with_pairs(pairs[pairs[:, 0] != pairs[:, 1]], "retrieval")
    wanted = {tuple(sorted(pair)) for pair in pairs.tolist()} | {(k, k + 1) for k in range(29)}
    for i, j in combinations(range(30), 2):
        assert graph.are_neighbours(i, j) == graph.are_neighbours(j, i) == ((i, j) in wanted)
        assert (j in graph.neighbours(i)) == ((i, j) in wanted)


def test_the_order_in_which_pairs_come_does_not_matter() -> None:
    rng = np.random.default_rng(1)
    pairs = rng.permutation(np.array(list(combinations(range(40), 2))))
    one, other = (ViewGraph.chain(40).with_pairs(rows, "user") for rows in (pairs, pairs[::-1, ::-1]))
    assert [one.pairs.tobytes(), one.reasons.tobytes()] == [other.pairs.tobytes(), other.reasons.tobytes()]


def test_it_survives_a_passage_through_files(tmp_path: Path) -> None:
    codec: Codec[ViewGraph] = Codec(ViewGraph, "graph")
    graph = TWO_SEQUENCES.with_pairs([(0, 7)], "retrieval", weights=0.25)
    codec.write(tmp_path, graph)
    again = codec.read(tmp_path)
    assert reasons(again) == reasons(graph)
    assert again.weights.tolist() == graph.weights.tolist()
    assert again.sequences[1].tolist() == [1, 3, 5]


# ------------------------------------------------------------------------------ order
def test_on_a_chain_steps_are_differences_of_indices() -> None:
    graph, images = ViewGraph.chain(20), np.arange(20)
    np.testing.assert_array_equal(
        graph.steps_between(images[:, None], images[None, :]), abs(images[:, None] - images[None, :])
    )
    assert [one.tolist() for one in graph.sequences] == [list(range(20))]
    assert graph.pairs_apart(3).tolist() == [[k, k + 3] for k in range(17)]
    assert graph.pairs_apart(25).shape == (0, 2)
    assert [graph.around(k, 2).tolist() for k in (0, 9, 19)] == [[0, 1, 2], [7, 8, 9, 10, 11], [17, 18, 19]]
    assert graph.between(4, 8).tolist() == [5, 6, 7]


def test_runs_are_cut_where_images_are_missing() -> None:
    graph = ViewGraph.chain(100)
    assert graph.runs((3, 4, 5, 9, 10, 40)) == ((3, 4, 5), (9, 10), (40,))
    assert graph.runs((3, 4, 5, 9, 10, 40), max_steps=4) == ((3, 4, 5, 9, 10), (40,))
    assert graph.runs(range(7, 12)) == ((7, 8, 9, 10, 11),)


def test_retrieval_changes_nothing_about_the_order() -> None:
    chain = ViewGraph.chain(50)
    graph = chain.with_pairs([(2, 40), (3, 41)], "retrieval", weights=0.5)
    assert graph.are_neighbours(40, 2)
    assert graph.steps_between(2, 40) == 38
    assert graph.runs((1, 2, 3, 40, 41)) == ((1, 2, 3), (40, 41))


def test_sequences_may_be_interleaved() -> None:
    assert [one.tolist() for one in TWO_SEQUENCES.sequences] == [[0, 2, 4, 6], [1, 3, 5], [7]]
    assert TWO_SEQUENCES.steps_between(0, [6, 5, 7, 0]).tolist() == [3, NO_WAY, NO_WAY, 0]
    assert TWO_SEQUENCES.pairs_apart(2).tolist() == [[0, 4], [2, 6], [1, 5]]
    assert TWO_SEQUENCES.around(4, 1).tolist() == [2, 4, 6]
    assert TWO_SEQUENCES.around(1, 5).tolist() == [1, 3, 5]
    assert TWO_SEQUENCES.between(0, 6).tolist() == [2, 4]
    assert TWO_SEQUENCES.between(0, 5).tolist() == []
    assert TWO_SEQUENCES.runs(range(8)) == ((0, 2, 4, 6), (1, 3, 5), (7,))
    assert TWO_SEQUENCES.runs((0, 1, 3, 4)) == ((0,), (4,), (1, 3))


# --------------------------------------------------------------------------- refusals
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"pairs": np.zeros((2, 3), np.int64)}, r"pairs \(2, 3\), weights \(2,\)"),
        ({"weights": np.ones(3)}, r"weights \(3,\), reasons \(2,\)"),
        ({"pairs": np.array([[0, 1], [1, 3]])}, "a pair names an image that is not one of 3"),
        ({"pairs": np.array([[-1, 1], [1, 2]])}, "a pair names an image that is not one of 3"),
        ({"pairs": np.array([[1, 2], [0, 1]])}, "must be i < j, ascending and without repeats"),
        ({"pairs": np.array([[0, 1], [0, 1]])}, "must be i < j, ascending and without repeats"),
        ({"pairs": np.array([[0, 1], [2, 1]])}, "must be i < j, ascending and without repeats"),
        ({"weights": np.array([1, np.nan])}, "a weight is not finite"),
        ({"reasons": np.array([0, 9], np.uint8)}, "a reason is not one of 3"),
        ({"pairs": np.array([[0, 1], [0, 2]])}, "at most one predecessor and one successor"),
        ({"pairs": np.array([[0, 2], [1, 2]])}, "at most one predecessor and one successor"),
    ],
)
def test_what_is_no_graph_is_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(ViewGraph.chain(3), **change)


@pytest.mark.parametrize("pair", [(1, 1), (0, 4), (-1, 2)])
def test_pairs_of_other_images_cannot_be_added(pair: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match="ViewGraph"):
        ViewGraph.chain(4).with_pairs([pair], "user")


# --------------------------------------------------------------------------- segments
def test_windows_cover_every_sequence_by_itself() -> None:
    graph = replace(NOTHING, num_images=9).with_pairs([(0, 1), (1, 2), (2, 3), (5, 6), (6, 7), (7, 8), (4, 5)], "order")
    windows = plan_windows(graph, segment_length=3, overlap=1)
    assert [window.images for window in windows] == [(0, 1, 2), (1, 2, 3), (4, 5, 6), (6, 7, 8)]
    assert [window.index for window in windows] == [0, 1, 2, 3]


def test_a_loop_that_is_no_pair_of_the_graph_is_refused() -> None:
    ends = {"image_a": 1, "image_b": 38, "similarity": 0.5, "segment_a": 0, "segment_b": 1}
    loop = PlannedLoop(segment=Segment(index=2, images=(0, 1, 2, 37, 38, 39), kind="loop"), **ends)  # type: ignore[arg-type]
    taken = LoopCandidate(**ends, num_pairs=9, taken=True, reason="taken")  # type: ignore[arg-type]
    plan = LoopPlan(
        threshold=0.3, weak_threshold=0.2, neighbours=3, statistics=None, candidates=(taken,), loops=(loop,)
    )
    chain = ViewGraph.chain(40)
    windows = plan_windows(chain, segment_length=20, overlap=1)
    with pytest.raises(ValueError, match=r"loop \(1, 38\) is no pair of the view graph"):
        Segments(view_graph=chain, windows=windows, loops=plan)
    known = chain.with_pairs([(1, 38)], "retrieval", weights=0.5)
    assert Segments(view_graph=known, windows=windows, loops=plan).loop_indices == {2}


# ------------------------------------------------------------------------------- size
@pytest.mark.slow
def test_100000_images_with_2000000_pairs_fit_in_flat_memory() -> None:
    rng = np.random.default_rng(2)
    pairs = rng.integers(0, 100_000, size=(2_000_000, 2))
    graph = ViewGraph.chain(100_000).with_pairs(pairs[pairs[:, 0] != pairs[:, 1]], "retrieval", weights=0.3)
    assert len(graph.pairs) > 2_000_000
    assert sum(one.nbytes for one in (graph.pairs, graph.weights, graph.reasons)) < 60e6
    assert sum(len(graph.neighbours(k)) for k in range(100_000)) == 2 * len(graph.pairs)
    assert graph.steps_between(17, 99_999) == 99_982
    assert len(plan_windows(graph, segment_length=60, overlap=20)) == 2500
