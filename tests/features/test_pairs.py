"""The pairs of images that are matched."""

from __future__ import annotations

import numpy as np

from smust3r_colmap.features.pairs import plan_loop_pairs, plan_pairs
from smust3r_colmap.products import Segment


def test_small_segments_are_matched_exhaustively() -> None:
    pairs = plan_pairs(Segment(index=0, images=(4, 5, 6, 7)), neighbours=2, exhaustive_below=4)
    assert sorted(pairs) == [(4, 5), (4, 6), (4, 7), (5, 6), (5, 7), (6, 7)]


def test_long_segments_match_neighbours_and_doubling_steps() -> None:
    pairs = plan_pairs(Segment(index=0, images=tuple(range(100, 140))), neighbours=3, exhaustive_below=10)
    from_first = sorted(b - 100 for a, b in pairs if a == 100)
    assert from_first == [1, 2, 3, 4, 8, 16, 32]
    assert len(set(pairs)) == len(pairs)
    assert all(100 <= a < b < 140 for a, b in pairs)


def test_a_loop_pairs_each_end_like_a_window_and_across_the_most_alike() -> None:
    ends = (*range(10, 31), *range(70, 91))
    descriptors = np.zeros((100, 64), np.float32)
    for k in range(21):  # image 10 + k shows what image 70 + k shows, and a little of the next ones
        descriptors[10 + k, 2 * k : 2 * k + 4] = descriptors[70 + k, 2 * k : 2 * k + 4] = 0.5
    pairs = plan_loop_pairs((ends[:21], ends[21:]), descriptors, neighbours=3)
    window = set(plan_pairs(Segment(index=0, images=tuple(range(60))), neighbours=3, exhaustive_below=25))
    across = {pair for pair in pairs if pair[0] < 60 <= pair[1]}
    inside = set(pairs) - across
    assert len(pairs) == len(set(pairs))
    assert {pair for pair in inside if pair[1] < 60} <= window
    assert len(inside) == 2 * (20 + 19 + 18 + 17 + 13 + 5)
    assert {(10 + k, 70 + k + step) for k in range(1, 20) for step in (-1, 0, 1)} <= across
    assert all(first < second for first, second in pairs)
    assert len(across) < 90
