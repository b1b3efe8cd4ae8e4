"""Windows over a sequence: laws over a grid of lengths, and the paper's example."""

from __future__ import annotations

import itertools

import pytest

from smust3r_colmap.errors import CollectionError, ConfigError
from smust3r_colmap.segmentation.view_graph import ViewGraph
from smust3r_colmap.segmentation.windows import plan_windows

GRID = [
    (n, length, overlap)
    for n, length in itertools.product((2, 3, 5, 9, 10, 11, 29, 30, 31, 59, 60, 61, 62, 91, 200), (2, 3, 7, 10, 30, 60))
    for overlap in sorted({1, 2, length // 2, length - 1})
    if 1 <= overlap < length
]


def windows(num_images: int, length: int, overlap: int) -> list[tuple[int, ...]]:
    return [
        segment.images for segment in plan_windows(ViewGraph.chain(num_images), segment_length=length, overlap=overlap)
    ]


def test_windows_are_the_papers() -> None:
    """Section III-B with l = 60, p = 30: images 1..60, 31..90, 61..120."""
    assert windows(120, 60, 30) == [tuple(range(0, 60)), tuple(range(30, 90)), tuple(range(60, 120))]


def test_last_window_is_shifted_back_to_the_last_image() -> None:
    assert windows(100, 60, 30) == [tuple(range(0, 60)), tuple(range(30, 90)), tuple(range(40, 100))]
    assert windows(61, 60, 30) == [tuple(range(0, 60)), tuple(range(1, 61))]


@pytest.mark.parametrize("num_images", [2, 3, 59, 60])
def test_up_to_one_length_of_images_is_one_segment(num_images: int) -> None:
    assert windows(num_images, 60, 30) == [tuple(range(num_images))]


@pytest.mark.parametrize(("num_images", "length", "overlap"), GRID)
def test_laws_of_windows(num_images: int, length: int, overlap: int) -> None:
    found = windows(num_images, length, overlap)
    assert set().union(*found) == set(range(num_images)), "every image is covered"
    assert {len(window) for window in found} == {min(length, num_images)}, "no short tail, no window too long"
    for window in found:
        assert window == tuple(range(window[0], window[-1] + 1)), "windows are gapless"
    for before, after in itertools.pairwise(found):
        shared = len(set(before) & set(after))
        assert overlap <= shared < length
        assert before[0] < after[0]
    for before, after in itertools.pairwise(found[:-1]):
        assert len(set(before) & set(after)) == overlap, "only the last overlap may be larger"
    fewest = 1 + max(0, -(-(num_images - length) // (length - overlap)))
    assert len(found) == fewest, "no more segments than the paper's"
    assert found == windows(num_images, length, overlap)


def test_indices_number_the_plan() -> None:
    plan = plan_windows(ViewGraph.chain(200), segment_length=30, overlap=10)
    assert [segment.index for segment in plan] == list(range(len(plan)))
    assert {segment.kind for segment in plan} == {"window"}


def test_appended_images_leave_finished_windows_alone() -> None:
    assert windows(205, 60, 30)[:-1] == windows(200, 60, 30)[:-1]


@pytest.mark.parametrize(
    ("length", "overlap", "message"),
    [
        (60, 60, r"overlap 60: neighbouring segments of 60 images must share between 1 and 59"),
        (60, 75, r"overlap 75: neighbouring segments of 60 images must share between 1 and 59"),
        (60, 0, r"overlap 0: "),
        (60, -5, r"overlap -5: "),
        (1, 1, r"segment length 1: a segment needs at least 2 images"),
        (0, 1, r"segment length 0: "),
    ],
)
def test_nonsense_is_refused_with_its_numbers(length: int, overlap: int, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        plan_windows(ViewGraph.chain(100), segment_length=length, overlap=overlap)


@pytest.mark.parametrize("num_images", [0, 1])
def test_fewer_than_two_images_are_refused(num_images: int) -> None:
    with pytest.raises(CollectionError, match=rf"{num_images} usable images: a reconstruction needs at least 2"):
        plan_windows(ViewGraph.chain(num_images), segment_length=60, overlap=30)
