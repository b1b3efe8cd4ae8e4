"""Keypoints and matches as a value: what it refuses, and two sources as one."""

from __future__ import annotations

import numpy as np
import pytest

from smust3r_colmap.features.correspondences import Correspondences, joined


def points(count: int, start: float = 0.0) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    return (start + np.arange(2 * count, dtype=np.float32)).reshape(count, 2)


def rows(*pairs: tuple[int, int]) -> np.ndarray[tuple[int, ...], np.dtype[np.uint32]]:
    return np.array(pairs, dtype=np.uint32).reshape(-1, 2)


def test_matches_are_counted_over_all_pairs() -> None:
    both = Correspondences(
        keypoints={0: points(3), 1: points(2), 5: points(1)},
        matches={(0, 1): rows((0, 0), (2, 1)), (0, 5): rows((1, 0)), (1, 5): rows()},
    )
    assert both.num_matches == 3


@pytest.mark.parametrize(
    ("pair", "matches", "message"),
    [
        ((1, 0), rows((0, 0)), r"pair \(1, 0\) is not ascending"),
        ((0, 0), rows((0, 0)), r"pair \(0, 0\) is not ascending"),
        ((0, 2), rows((0, 0)), r"pair \(0, 2\) .* names an unknown image"),
        ((0, 1), rows((3, 0)), r"pair \(0, 1\) names a keypoint that does not exist"),
        ((0, 1), rows((2, 1), (0, 2)), r"pair \(0, 1\) names a keypoint that does not exist"),
        ((0, 1), np.zeros(2, np.uint32), r"matches of pair \(0, 1\) are \(2,\), needed \(M, 2\)"),
        ((0, 1), np.zeros((2, 3), np.uint32), r"matches of pair \(0, 1\) are \(2, 3\), needed \(M, 2\)"),
    ],
)
def test_matches_must_name_what_is_there(
    pair: tuple[int, int], matches: np.ndarray[tuple[int, ...], np.dtype[np.uint32]], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        Correspondences(keypoints={0: points(3), 1: points(2)}, matches={pair: matches})


def test_keypoints_have_two_coordinates() -> None:
    with pytest.raises(ValueError, match=r"keypoints of image 4 are \(3, 4\), needed \(K, 2\)"):
        Correspondences(keypoints={4: np.zeros((3, 4), np.float32)}, matches={})


def test_joined_sources_keep_the_first_rows_and_shift_the_second() -> None:
    first = Correspondences(keypoints={0: points(2), 1: points(3)}, matches={(0, 1): rows((1, 2))})
    second = Correspondences(
        keypoints={0: points(1, 50), 1: points(1, 60), 2: points(2, 70)},
        matches={(0, 1): rows((0, 0)), (1, 2): rows((0, 1))},
    )
    both = joined(first, second)
    assert {image: len(xy) for image, xy in both.keypoints.items()} == {0: 3, 1: 4, 2: 2}
    np.testing.assert_array_equal(both.keypoints[1], [[0, 1], [2, 3], [4, 5], [60, 61]])
    assert {pair: matches.tolist() for pair, matches in both.matches.items()} == {
        (0, 1): [[1, 2], [2, 3]],
        (1, 2): [[3, 1]],
    }
    assert all(matches.dtype == np.uint32 for matches in both.matches.values())
    assert all(xy.dtype == np.float32 for xy in both.keypoints.values())


def test_joining_nothing_changes_nothing() -> None:
    first = Correspondences(keypoints={0: points(2), 1: points(3)}, matches={(0, 1): rows((1, 2))})
    nothing = Correspondences(keypoints={}, matches={})
    for both in (joined(first, nothing), joined(nothing, first)):
        assert {image: xy.tolist() for image, xy in both.keypoints.items()} == {
            0: points(2).tolist(),
            1: points(3).tolist(),
        }
        assert both.matches[0, 1].tolist() == [[1, 2]]
