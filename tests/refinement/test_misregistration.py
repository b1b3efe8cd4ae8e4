"""Pairs vote, groups grow together, and what the largest group contradicts is bent."""

from __future__ import annotations

from collections.abc import Iterable

import pytest

from smust3r_colmap.geometry.arrays import Pair
from smust3r_colmap.refinement.misregistration import DENYING_SHARE, SOUND_SHARE, STRONG_MATCHES, Agreement, bent_images


def votes(sound: Iterable[Pair] = (), denied: Iterable[Pair] = ()) -> dict[Pair, Agreement]:
    """Pairs for the model, and strong ones against it."""
    return {
        **dict.fromkeys(sound, Agreement(num_matches=STRONG_MATCHES, share=1.0)),
        **dict.fromkeys(denied, Agreement(num_matches=STRONG_MATCHES, share=0.6)),
    }


def walk(images: Iterable[int], reach: int = 2) -> list[Pair]:
    there = sorted(images)
    return [(i, j) for i in there for j in there if 0 < j - i <= reach]


@pytest.mark.parametrize(
    ("num_matches", "share", "vote"),
    [
        (STRONG_MATCHES, SOUND_SHARE, 5),
        (8, SOUND_SHARE, 2),
        (400, SOUND_SHARE, 20),
        (STRONG_MATCHES, SOUND_SHARE - 0.01, 0),
        (STRONG_MATCHES, DENYING_SHARE, 0),
        (STRONG_MATCHES, DENYING_SHARE - 0.01, -5),
        (400, 0.0, -20),
        (STRONG_MATCHES - 1, 0.0, 0),
    ],
)
def test_few_matches_may_speak_for_the_model_but_not_against_it(num_matches: int, share: float, vote: int) -> None:
    assert Agreement(num_matches=num_matches, share=share).vote == vote


def test_what_lies_beyond_denied_pairs_is_bent() -> None:
    found = votes([*walk(range(6)), *walk(range(6, 9))], [(4, 6), (5, 6), (5, 7)])
    assert bent_images(found, range(9)) == (6, 7, 8)


def test_one_pair_that_agrees_by_chance_does_not_hide_a_bend() -> None:
    found = votes([*walk(range(6)), *walk(range(6, 9)), (3, 6)], [(4, 6), (5, 6), (5, 7), (4, 7)])
    assert bent_images(found, range(9)) == (6, 7, 8)


def test_one_denied_pair_does_not_make_a_bend() -> None:
    found = votes([pair for pair in walk(range(9)) if pair != (5, 6)], [(5, 6)])
    assert bent_images(found, range(9)) == ()


def test_look_alikes_do_not_outweigh_the_neighbours_of_an_image() -> None:
    found = votes(walk(range(12)), [(0, 11), (1, 11)])
    assert bent_images(found, range(12)) == ()


def test_many_weak_pairs_of_a_facade_do_not_outweigh_a_few_strong_ones() -> None:
    """As of castle_p30's three images of a corner: neighbours agree, and pairs from far across deny."""
    facade = dict.fromkeys([(0, 9), (0, 10), (1, 10), (2, 10), (1, 9)], Agreement(num_matches=35, share=0.1))
    found = facade | dict.fromkeys(walk(range(11)), Agreement(num_matches=400, share=0.9))
    assert bent_images(found, range(11)) == ()


def test_what_hangs_on_a_bent_group_is_bent_as_well() -> None:
    found = votes([*walk(range(6)), (6, 7), (8, 9)], [(5, 6), (4, 6), (7, 8), (7, 9)])
    assert bent_images(found, range(10)) == (6, 7, 8, 9)


def test_an_island_that_nothing_contradicts_is_left_alone() -> None:
    found = votes([*walk(range(6)), *walk(range(6, 9))])
    assert bent_images(found, range(9)) == ()


def test_an_image_of_which_no_pair_speaks_is_not_called_bent() -> None:
    assert bent_images(votes(walk(range(4)), [(2, 5)]), range(7)) == (5,)


def test_without_a_bulk_nothing_can_be_told() -> None:
    assert bent_images(votes([(0, 1), (2, 3)], [(1, 2)]), range(4)) == ()
    assert bent_images({}, range(4)) == ()


def test_indices_of_the_collection_need_not_begin_at_zero() -> None:
    assert bent_images(votes([(10, 12), (12, 17)], [(17, 30)]), [10, 12, 17, 30]) == (30,)
