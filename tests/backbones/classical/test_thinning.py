"""Rich images bring fewer matches into the mapping of a segment, and no weak link is lost."""

from __future__ import annotations

import numpy as np
import pytest

from smust3r_colmap.backbones.classical.thinning import (
    ENOUGH_FEATURES,
    ENOUGH_IN_SEGMENT,
    WEAK_PAIR_MATCHES,
    Matches,
    thin_matches,
)
from smust3r_colmap.geometry.arrays import Pair

NUM_IMAGES = 50
NUM_FEATURES = 3000
LONG = 400
"""Features that all images see; the others are seen by two neighbours only."""


def rows(first: int, last: int) -> Matches:
    """Feature k of one image is feature k of the other."""
    return np.column_stack([np.arange(first, last)] * 2).astype(np.uint32)


@pytest.fixture
def segment() -> dict[Pair, Matches]:
    """Feature k < LONG matches everywhere; each pair of neighbours has 1,000 more of its own."""
    matches = {(a, b): rows(0, LONG) for a in range(NUM_IMAGES) for b in range(a + 1, min(a + 4, NUM_IMAGES))}
    for a in range(NUM_IMAGES - 1):
        start = LONG + 1000 * (a % 2)
        matches[a, a + 1] = np.concatenate([rows(0, LONG), rows(start, start + 1000)])
    return matches


def test_what_most_images_see_stays_and_each_image_keeps_enough(segment: dict[Pair, Matches]) -> None:
    thinned = thin_matches(segment, dict.fromkeys(range(NUM_IMAGES), NUM_FEATURES))
    assert thinned.keys() == segment.keys()
    for pair, kept in thinned.items():
        assert set(range(LONG)) <= set(kept[:, 0].tolist()), pair
    seen: dict[int, set[int]] = {}
    for pair, kept in thinned.items():
        for side, image in enumerate(pair):
            seen.setdefault(image, set()).update(kept[:, side].tolist())
    assert max(map(len, seen.values())) == ENOUGH_FEATURES
    assert sum(map(len, thinned.values())) < 0.6 * sum(map(len, segment.values()))


def test_short_segment_keeps_more_of_each_image(segment: dict[Pair, Matches]) -> None:
    few = {pair: kept for pair, kept in segment.items() if max(pair) < ENOUGH_IN_SEGMENT // NUM_FEATURES}
    thinned = thin_matches(few, dict.fromkeys(range(ENOUGH_IN_SEGMENT // NUM_FEATURES), NUM_FEATURES))
    assert all(np.array_equal(thinned[pair], few[pair]) for pair in few)


def test_weak_pair_keeps_all_its_matches(segment: dict[Pair, Matches]) -> None:
    weak = rows(NUM_FEATURES - WEAK_PAIR_MATCHES + 1, NUM_FEATURES)
    segment[0, NUM_IMAGES - 1] = weak
    thinned = thin_matches(segment, dict.fromkeys(range(NUM_IMAGES), NUM_FEATURES))
    np.testing.assert_array_equal(thinned[0, NUM_IMAGES - 1], weak)


def test_pairs_without_matches_are_left_out() -> None:
    empty = np.zeros((0, 2), dtype=np.uint32)
    assert thin_matches({(0, 1): empty, (1, 2): rows(0, 5)}, {0: 10, 1: 10, 2: 10}).keys() == {(1, 2)}
    assert thin_matches({(0, 1): empty}, {}) == {}
