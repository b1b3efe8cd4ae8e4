"""Images are clustered by the weights of pairs; clusters that the largest cluster contradicts are misregistered."""

from __future__ import annotations

from collections.abc import Iterable

import pytest

from smust3r_colmap.geometry.arrays import Pair
from smust3r_colmap.refinement.misregistration import (
    MAX_CONTRADICTING_FRACTION,
    MIN_CONTRADICTING_MATCHES,
    MIN_SUPPORTING_FRACTION,
    EpipolarSupport,
    consistent_groups,
    find_misregistered,
)


def support(supporting: Iterable[Pair] = (), contradicting: Iterable[Pair] = ()) -> dict[Pair, EpipolarSupport]:
    """Pairs that support the model, and pairs with enough matches that contradict it."""
    return {
        **dict.fromkeys(supporting, EpipolarSupport(num_matches=MIN_CONTRADICTING_MATCHES, inlier_fraction=1.0)),
        **dict.fromkeys(contradicting, EpipolarSupport(num_matches=MIN_CONTRADICTING_MATCHES, inlier_fraction=0.6)),
    }


def walk(images: Iterable[int], reach: int = 2) -> list[Pair]:
    there = sorted(images)
    return [(i, j) for i in there for j in there if 0 < j - i <= reach]


@pytest.mark.parametrize(
    ("num_matches", "inlier_fraction", "weight"),
    [
        (MIN_CONTRADICTING_MATCHES, MIN_SUPPORTING_FRACTION, 5),
        (8, MIN_SUPPORTING_FRACTION, 2),
        (400, MIN_SUPPORTING_FRACTION, 20),
        (MIN_CONTRADICTING_MATCHES, MIN_SUPPORTING_FRACTION - 0.01, 0),
        (MIN_CONTRADICTING_MATCHES, MAX_CONTRADICTING_FRACTION, 0),
        (MIN_CONTRADICTING_MATCHES, MAX_CONTRADICTING_FRACTION - 0.01, -5),
        (400, 0.0, -20),
        (MIN_CONTRADICTING_MATCHES - 1, 0.0, 0),
    ],
)
def test_few_matches_can_support_the_model_but_not_contradict_it(
    num_matches: int, inlier_fraction: float, weight: int
) -> None:
    assert EpipolarSupport(num_matches=num_matches, inlier_fraction=inlier_fraction).weight == weight


def test_images_beyond_contradicting_pairs_are_misregistered() -> None:
    found = support([*walk(range(6)), *walk(range(6, 9))], [(4, 6), (5, 6), (5, 7)])
    assert find_misregistered(found, range(9)) == (6, 7, 8)


def test_one_pair_that_agrees_by_chance_does_not_hide_misregistered_images() -> None:
    found = support([*walk(range(6)), *walk(range(6, 9)), (3, 6)], [(4, 6), (5, 6), (5, 7), (4, 7)])
    assert find_misregistered(found, range(9)) == (6, 7, 8)


def test_one_contradicting_pair_does_not_suffice() -> None:
    found = support([pair for pair in walk(range(9)) if pair != (5, 6)], [(5, 6)])
    assert find_misregistered(found, range(9)) == ()


def test_look_alikes_do_not_outweigh_the_neighbours_of_an_image() -> None:
    found = support(walk(range(12)), [(0, 11), (1, 11)])
    assert find_misregistered(found, range(12)) == ()


def test_many_weak_pairs_of_a_facade_do_not_outweigh_a_few_strong_ones() -> None:
    """As of castle_p30's three images of a corner: neighbours agree, and pairs from far across contradict."""
    facade = dict.fromkeys(
        [(0, 9), (0, 10), (1, 10), (2, 10), (1, 9)], EpipolarSupport(num_matches=35, inlier_fraction=0.1)
    )
    found = facade | dict.fromkeys(walk(range(11)), EpipolarSupport(num_matches=400, inlier_fraction=0.9))
    assert find_misregistered(found, range(11)) == ()


def test_clusters_that_a_misregistered_cluster_contradicts_are_misregistered_as_well() -> None:
    found = support([*walk(range(6)), (6, 7), (8, 9)], [(5, 6), (4, 6), (7, 8), (7, 9)])
    assert find_misregistered(found, range(10)) == (6, 7, 8, 9)


def test_a_cluster_that_nothing_contradicts_is_left_alone() -> None:
    found = support([*walk(range(6)), *walk(range(6, 9))])
    assert find_misregistered(found, range(9)) == ()


def test_an_image_without_pairs_is_not_misregistered() -> None:
    assert find_misregistered(support(walk(range(4)), [(2, 5)]), range(7)) == (5,)


def test_without_a_majority_nothing_is_misregistered() -> None:
    assert find_misregistered(support([(0, 1), (2, 3)], [(1, 2)]), range(4)) == ()
    assert find_misregistered({}, range(4)) == ()


def test_indices_of_the_collection_need_not_begin_at_zero() -> None:
    assert find_misregistered(support([(10, 12), (12, 17)], [(17, 30)]), [10, 12, 17, 30]) == (30,)


def test_groups_that_contradict_each_other_are_found_the_largest_first() -> None:
    found = consistent_groups(support(walk(range(4)) + walk(range(4, 10)), [(0, 5), (1, 6)]), range(11))
    assert found == ((4, 5, 6, 7, 8, 9), (0, 1, 2, 3), (10,))


def test_one_contradicting_pair_does_not_part_a_group() -> None:
    assert consistent_groups(support(walk(range(10)), [(0, 9)]), range(10)) == (tuple(range(10)),)
