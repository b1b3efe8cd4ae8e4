from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from smust3r_colmap.errors import InputError
from smust3r_colmap.evaluation.association import associate, nearest_in_time
from smust3r_colmap.importers.pose_set import PoseSet


def poses(
    *,
    names: tuple[str, ...] = (),
    stamps: tuple[float, ...] = (),
    numbers: tuple[int, ...] = (),
    images: dict[str, float] | None = None,
) -> PoseSet:
    count = max(len(names), len(stamps), len(numbers))
    return PoseSet(
        layout="made up",
        place=Path("made.txt"),
        world_from_cam=np.broadcast_to(np.eye(3, 4), (count, 3, 4)),
        names=names,
        stamps_s=np.array(stamps) if stamps else None,
        numbers=np.array(numbers) if numbers else None,
        image_stamps=images or {},
    )


def rows(estimate: PoseSet, reference: PoseSet, **options: float) -> tuple[list[int], list[int], str]:
    found = associate(estimate, reference, **options)  # type: ignore[arg-type]
    return found.estimate.tolist(), found.reference.tolist(), found.how


def test_equal_names_are_matched_in_the_order_of_the_reference() -> None:
    found = rows(poses(names=("a/1.jpg", "a/2.jpg", "x.jpg")), poses(names=("a/2.jpg", "a/1.jpg", "y.jpg")))
    assert found == ([1, 0], [0, 1], "image name")


def test_names_without_folder_and_suffix_are_matched_where_none_are_equal() -> None:
    found = rows(poses(names=("image_0/000001.png", "image_0/000002.png")), poses(names=("000002", "000007")))
    assert found == ([1], [0], "image name without folder and suffix")


def test_names_that_are_alike_without_their_folder_are_not_matched() -> None:
    with pytest.raises(InputError, match=r"no image name, frame number or time is in both: .*first image left/1.jpg"):
        rows(poses(names=("left/1.jpg", "right/1.jpg")), poses(names=("1.png", "2.png")))


def test_frame_numbers_are_matched() -> None:
    found = rows(poses(stamps=(0, 2, 4), numbers=(0, 2, 4)), poses(names=("f0", "f1", "f2"), numbers=(0, 1, 2)))
    assert found == ([0, 1], [0, 2], "frame number")


def test_frame_numbers_are_not_taken_for_seconds() -> None:
    numbered = poses(stamps=(0, 1, 2), numbers=(0, 1, 2))
    with pytest.raises(InputError, match=r"its times are numbers of frames"):
        associate(numbered, poses(stamps=(0.0, 0.1, 1.0)))
    found = associate(numbered, poses(stamps=(0.0, 0.1, 1.0)), "time")
    assert found.reference.tolist() == [0, 2]


def test_the_nearest_time_is_matched_within_the_limit() -> None:
    estimate, reference = poses(stamps=(1.0, 2.0, 3.0)), poses(stamps=(0.9, 1.004, 2.015, 2.995, 3.001))
    assert rows(estimate, reference) == ([0, 2], [1, 4], "time within 0.01 s")
    assert rows(estimate, reference, max_difference_s=0.02)[:2] == ([0, 1, 2], [1, 2, 4])


def test_an_offset_is_added_to_the_times_of_the_estimate() -> None:
    found = rows(poses(stamps=(1.0, 2.0)), poses(stamps=(6.5, 7.5)), offset_s=5.5)
    assert found == ([0, 1], [0, 1], "time within 0.01 s, offset 5.5 s")


def test_no_pose_is_matched_twice() -> None:
    """Both 1.000 and 1.006 are nearest to 1.004; evo takes it twice."""
    a, b = nearest_in_time(np.array([1.000, 1.006]), np.array([1.004, 5.0, 6.0]), 0.01)
    assert (a.tolist(), b.tolist()) == ([1], [0])


def test_the_longer_side_is_searched_whichever_it_is() -> None:
    many, few = np.array([0.0, 0.1, 0.2, 0.3]), np.array([0.301, 0.099])
    assert [one.tolist() for one in nearest_in_time(many, few, 0.01)] == [[1, 3], [1, 0]]
    assert [one.tolist() for one in nearest_in_time(few, many, 0.01)] == [[1, 0], [1, 3]]


def test_an_exact_tie_goes_to_the_earlier_time() -> None:
    assert [one.tolist() for one in nearest_in_time(np.array([1.0]), np.array([0.75, 1.25]), 0.5)] == [[0], [0]]


@pytest.mark.parametrize(
    ("names", "images"),
    [
        (("rgb/1.png", "rgb/2.png"), {"rgb/1.png": 10.0, "rgb/2.png": 11.0}),  # as the reference lists them
        (("1.png", "2.png"), {"rgb/1.png": 10.0, "rgb/2.png": 11.0}),  # without the folder
        (("10.000.png", "rgb/11.000.png"), {}),  # seconds, as in TUM RGB-D
    ],
)
def test_images_get_their_times_from_the_list_or_from_their_names(
    names: tuple[str, ...], images: dict[str, float]
) -> None:
    reference = poses(stamps=(9.0, 10.001, 11.001), images=images)
    assert rows(poses(names=names), reference) == ([0, 1], [1, 2], "time within 0.01 s")


def test_names_in_nanoseconds_are_times() -> None:
    found = rows(poses(names=("1403636579763555584.png",)), poses(stamps=(1403636579.7636,)))
    assert found[:2] == ([0], [0])


def test_names_that_are_numbers_are_no_times() -> None:
    with pytest.raises(InputError, match="no image name, frame number or time is in both"):
        associate(poses(names=("000001.png",)), poses(stamps=(1.0, 1.5)))


def test_no_overlap_is_refused_with_both_ranges() -> None:
    with pytest.raises(InputError, match=r"no two times are within 0.01 s: .*0.500 to 1.500 s; .*7.500 to 8.500 s"):
        associate(poses(stamps=(0.5, 1.5)), poses(stamps=(7.5, 8.5)))


def test_other_names_are_refused_with_one_of_each_side() -> None:
    with pytest.raises(InputError, match=r"first image a.jpg; .* first image b.jpg"):
        associate(poses(names=("a.jpg",)), poses(names=("b.jpg",)))
    with pytest.raises(InputError, match="no name is the same"):
        associate(poses(names=("a.jpg",)), poses(names=("b.jpg",)), "name")
    with pytest.raises(InputError, match="no number is the same"):
        associate(poses(names=("a.jpg",)), poses(names=("a.jpg",)), "number")
