"""Loops from simulated descriptors: what must be found, what must not, and bounds whatever the images are."""

from __future__ import annotations

from collections import Counter
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial import KDTree

from smust3r_colmap.errors import InputError
from smust3r_colmap.products import Segment
from smust3r_colmap.segmentation.loop_segments import LoopCandidate, LoopPlan, images_around, plan_loops
from smust3r_colmap.segmentation.similarity import (
    alike_segments,
    home_segments,
    neighbours_alike,
    similarity_statistics,
    with_neighbours,
)
from smust3r_colmap.segmentation.view_graph import ViewGraph
from smust3r_colmap.segmentation.windows import plan_windows
from smust3r_colmap.storage.codec import Codec

Array = npt.NDArray[np.float32]
DIMENSIONS = 512
STATIONS_APART = 4.0  # images; adjacent images then look as alike as VLAD finds them on a walk


def unit(rows: npt.NDArray[np.float64]) -> Array:
    normalised: Array = (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)
    return normalised


def see(places: npt.ArrayLike, *, noise: float = 1.5, seed: int = 0) -> Array:
    """Descriptors of images taken at places on a path, each with a disturbance of its own.

    Places are positions in images; a random direction stands at every few of them, blended linearly.
    A noise of 1.6 leaves adjacent images a cosine of about 0.25, as measured with VLAD.
    """
    rng = np.random.default_rng(seed)
    position = np.asarray(places, dtype=float) / STATIONS_APART
    stations = rng.normal(size=(int(position.max()) + 2, DIMENSIONS))
    stations /= np.linalg.norm(stations, axis=1, keepdims=True)
    before, part = np.divmod(position, 1)
    signal = (1 - part)[:, None] * stations[before.astype(int)] + part[:, None] * stations[before.astype(int) + 1]
    return unit(signal + noise * rng.normal(size=signal.shape) / np.sqrt(DIMENSIONS))


def straight(num_images: int) -> npt.NDArray[np.float64]:
    return np.arange(num_images, dtype=float)


def with_revisit(num_images: int, first: int, second: int, length: int, *, backwards: bool = False) -> Array:
    """Images ``second ...`` see the places of images ``first ...`` again, perhaps against their order."""
    places = straight(num_images)
    again = places[first : first + length]
    places[second : second + length] = again[::-1] if backwards else again
    return see(places)


def plan(
    descriptors: Array,
    *,
    length: int = 60,
    overlap: int = 30,
    similarity: float | Literal["auto"] = "auto",
    min_candidates: int = 3,
    min_distance: int = 3,
    half_width: int = 10,
) -> LoopPlan:
    graph = ViewGraph.chain(len(descriptors))
    return plan_loops(
        descriptors,
        graph,
        plan_windows(graph, segment_length=length, overlap=overlap),
        similarity=similarity,
        min_candidates=min_candidates,
        min_distance=min_distance,
        half_width=half_width,
    )


def ends(found: LoopPlan) -> list[tuple[int, int]]:
    return [(loop.image_a, loop.image_b) for loop in found.loops]


# ------------------------------------------------------------------------------ finding
def test_simulated_neighbours_are_as_alike_as_real_ones() -> None:
    statistics = similarity_statistics(see(straight(300)), ViewGraph.chain(300))
    assert statistics is not None
    assert 0.15 < statistics.neighbour_median < 0.35
    assert abs(statistics.far_median) < 0.02
    assert 3 < statistics.contrast < 8


@pytest.mark.parametrize("backwards", [False, True])
def test_one_revisit_is_one_loop_in_either_direction(backwards: bool) -> None:
    found = plan(with_revisit(300, 20, 240, 25, backwards=backwards))
    assert len(found.loops) == 1
    a, b = ends(found)[0]
    expected = 240 + (24 - (a - 20) if backwards else a - 20)
    assert 20 <= a < 45
    assert abs(b - expected) <= 4
    loop = found.loops[0]
    assert (loop.segment_a, loop.segment_b) in {(0, 7), (0, 8), (1, 7), (1, 8)}
    assert loop.segment.index == 9
    assert loop.segment.kind == "loop"
    assert {a, b} < set(loop.segment.images)


def test_a_second_lap_is_tied_at_several_places() -> None:
    found = plan(see(straight(300) % 150))
    assert 3 <= len(found.loops) <= 6
    for a, b in ends(found):
        assert abs(b - a - 150) <= 3
    for (a, b), (c, d) in ((one, other) for one in ends(found) for other in ends(found) if one != other):
        assert max(abs(a - c), abs(b - d)) > 30, "one revisit is one loop"


@pytest.mark.parametrize("seed", range(10))
def test_a_walk_that_never_comes_back_has_no_loop(seed: int) -> None:
    found = plan(see(straight(300), seed=seed))
    assert found.loops == ()
    assert found.note == "", "it was searched"
    assert found.threshold is not None


def test_neighbours_in_time_find_a_loop_that_single_images_do_not() -> None:
    """A faint revisit: the cosines of its image pairs lie within the scatter of all pairs."""
    places = straight(300)
    places[240:265] = places[20:45]
    descriptors = see(places, noise=3.0)
    singles = descriptors[20:45] @ descriptors[240:265].T
    statistics = similarity_statistics(descriptors, ViewGraph.chain(len(descriptors)))
    assert statistics is not None
    assert np.median(np.diag(singles)) < statistics.far_median + 2.5 * statistics.far_sigma
    found = plan(descriptors)
    assert len(found.loops) == 1
    assert abs(ends(found)[0][1] - ends(found)[0][0] - 220) <= 4


def test_the_best_few_loops_may_lie_below_the_threshold() -> None:
    """Coming back all the time widens the scatter until four deviations are out of reach."""
    found = plan(see(straight(400) % 24))
    assert found.threshold is not None
    assert found.weak_threshold is not None
    weak = [loop for loop in found.loops if loop.similarity < found.threshold]
    assert len(found.loops) == 5
    assert 1 <= len(weak) <= 5
    assert all(loop.similarity >= found.weak_threshold for loop in weak)
    assert all(abs((b - a + 12) % 24 - 12) <= 3 for a, b in ends(found))
    assert any(one.reason.startswith("below the threshold") for one in found.candidates)


def test_a_given_similarity_is_compared_with_single_images() -> None:
    descriptors = with_revisit(300, 20, 240, 25)
    best = float((descriptors[:60] @ descriptors[200:].T).max())
    assert plan(descriptors, similarity=best + 0.01).candidates == ()
    found = plan(descriptors, similarity=best - 0.01, min_candidates=1)
    assert len(found.loops) == 1
    assert found.loops[0].similarity == pytest.approx(best, abs=1e-6)
    assert found.neighbours == 0
    assert found.threshold == found.weak_threshold == best - 0.01


# ------------------------------------------------------------------- what is not a loop
@pytest.mark.parametrize("noise", [0.0, 0.1, 1.6])
def test_a_standing_camera_gives_nothing_and_says_so(noise: float) -> None:
    found = plan(see(np.zeros(300), noise=noise))
    assert found.loops == ()
    assert found.candidates == ()
    assert "the camera stood still" in found.note


@pytest.mark.parametrize("similarity", ["auto", 0.5])
def test_standing_for_a_while_is_not_coming_back(similarity: float | Literal["auto"]) -> None:
    places = np.concatenate([straight(100), np.full(250, 100.0), 101 + straight(150)])
    found = plan(see(places, noise=0.5), similarity=similarity)
    assert found.loops == ()
    decisions = Counter(one.reason for one in found.candidates)
    assert decisions["the camera did not leave the place in between"] >= 5


def test_unordered_images_are_not_searched() -> None:
    order = np.random.default_rng(3).permutation(300)
    found = plan(see(straight(300))[order])
    assert found.loops == ()
    assert "in no order" in found.note


@pytest.mark.parametrize("num_images", [2, 3, 5, 10, 60, 61, 90])
def test_few_images_give_no_loop_and_no_error(num_images: int) -> None:
    assert plan(see(straight(num_images))).loops == ()
    assert plan(np.zeros((num_images, DIMENSIONS), np.float32)).loops == ()


def test_segments_near_in_order_are_no_loop() -> None:
    descriptors = with_revisit(300, 50, 115, 12)
    found = plan(descriptors)
    assert found.loops == ()
    assert any(one.reason.startswith("too near in order: 2 segments apart, needed 3") for one in found.candidates)
    assert len(plan(descriptors, min_distance=2).loops) == 1


def test_segments_that_share_images_are_not_even_candidates() -> None:
    windows = plan_windows(ViewGraph.chain(100), segment_length=40, overlap=35)
    found = plan(see(straight(100)), length=40, overlap=35, min_distance=1)
    for one in found.candidates:
        assert set(windows[one.segment_a].images).isdisjoint(windows[one.segment_b].images)


def test_too_few_pairs_are_refused_with_their_number() -> None:
    descriptors = see(straight(300), noise=0.5)
    descriptors[250] = descriptors[30]
    found = plan(descriptors, similarity=0.9)
    assert found.loops == ()
    assert [one.reason for one in found.candidates] == ["only 1 image pairs look alike, needed 3"]
    assert ends(plan(descriptors, similarity=0.9, min_candidates=1)) == [(30, 250)]


def test_images_without_features_take_no_part() -> None:
    descriptors = with_revisit(300, 20, 240, 25)
    descriptors[[25, 30, 100, 250]] = 0
    found = plan(descriptors)
    assert len(found.loops) == 1
    blank = see(straight(300))
    blank[10:40] = blank[200:230] = 0
    assert plan(blank).loops == ()
    assert not with_neighbours(blank, ViewGraph.chain(len(blank)), 3)[10:40].any()


# --------------------------------------------------------------------------------- laws
def places_of(kind: str) -> npt.NDArray[np.float64]:
    rng = np.random.default_rng(7)
    if kind == "rounds":
        return straight(400) % 70
    if kind == "back and forth":
        return np.abs(straight(400) % 200 - 100)
    return np.abs(np.cumsum(rng.normal(0, 1.5, 400)))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["rounds", "back and forth", "wandering"])
@pytest.mark.parametrize(
    ("length", "overlap", "similarity"), [(60, 30, 0.0), (20, 10, 0.0), (20, 10, 0.1), (12, 8, 0.1)]
)
def test_laws_of_plans(kind: str, length: int, overlap: int, similarity: float) -> None:
    descriptors = see(places_of(kind))
    windows = plan_windows(ViewGraph.chain(400), segment_length=length, overlap=overlap)
    found = plan(descriptors, length=length, overlap=overlap, similarity=similarity)
    assert found == plan(descriptors, length=length, overlap=overlap, similarity=similarity)
    used = Counter(segment for loop in found.loops for segment in (loop.segment_a, loop.segment_b))
    assert max(used.values(), default=0) <= 3
    assert [loop.segment.index for loop in found.loops] == [len(windows) + k for k in range(len(found.loops))]
    assert len({(loop.segment_a, loop.segment_b) for loop in found.loops}) == len(found.loops)
    for loop in found.loops:
        first, second = windows[loop.segment_a].images, windows[loop.segment_b].images
        assert loop.segment_b - loop.segment_a >= 3
        assert set(first).isdisjoint(second)
        side_a = [image for image in loop.segment.images if image in set(first)]
        side_b = [image for image in loop.segment.images if image in set(second)]
        assert list(loop.segment.images) == side_a + side_b == sorted(loop.segment.images)
        assert len(side_a) == len(side_b) == min(21, length)
        assert loop.image_a in side_a
        assert loop.image_b in side_b
    assert len(found.candidates) <= 20 * len(windows)
    assert all(before.similarity >= after.similarity for before, after in pairwise(found.candidates))
    assert all(one.reason and one.similarity >= (found.weak_threshold or 0.0) for one in found.candidates)
    assert all(one.reason.startswith("taken") == one.taken for one in found.candidates)


@pytest.mark.slow
def test_what_is_not_looked_at_is_counted() -> None:
    found = plan(see(straight(1200) % 70, noise=0.5), length=12, overlap=1, similarity=0.1)
    assert len(found.candidates) == 20 * len(plan_windows(ViewGraph.chain(1200), segment_length=12, overlap=1))
    assert found.num_left_out > 0
    assert any("better loops already" in one.reason for one in found.candidates)


def test_ties_go_to_the_earlier_images() -> None:
    """Every image of the second visit is the copy of one image: all its pairs are equal."""
    descriptors = see(straight(300), noise=0.5)
    descriptors[30] = descriptors[33] = descriptors[240:250] = descriptors[36]
    assert ends(plan(descriptors, similarity=0.9)) == [(30, 240)]


def test_time_reversed_gives_the_same_loops() -> None:
    descriptors = see(straight(330) % 150)
    forward = ends(plan(descriptors))
    backward = ends(plan(descriptors[::-1].copy()))
    assert {(329 - b, 329 - a) for a, b in backward} == set(forward)


def test_pairs_are_those_of_a_kd_tree() -> None:
    """The paper searches a KD-tree by radius; |x - y|^2 = 2 - 2 cos."""
    descriptors = see(places_of("wandering"))
    home = home_segments(
        [window.images for window in plan_windows(ViewGraph.chain(400), segment_length=60, overlap=30)], 400
    )
    counted: Counter[tuple[int, int]] = Counter()
    for a, b in KDTree(descriptors).query_pairs(np.sqrt(2 - 2 * 0.2)):
        if home[a] != home[b]:
            counted[min(home[a], home[b]), max(home[a], home[b])] += 1
    found = alike_segments(descriptors, home, at_least=0.2)
    assert {(pair.segment_a, pair.segment_b): pair.num_pairs for pair in found} == dict(counted)
    assert sum(counted.values()) > 1000


def test_best_pairs_are_those_of_all_cosines() -> None:
    descriptors = see(places_of("rounds"))
    home = home_segments(
        [window.images for window in plan_windows(ViewGraph.chain(400), segment_length=50, overlap=10)], 400
    )
    home[:10] = -1
    cosines = descriptors @ descriptors.T
    for pair in alike_segments(descriptors, home, at_least=0.3):
        block = cosines[np.ix_(home == pair.segment_a, home == pair.segment_b)]
        assert pair.similarity == pytest.approx(block.max(), abs=1e-6)
        assert pair.similarity == pytest.approx(cosines[pair.image_a, pair.image_b], abs=1e-6)
        assert 0 <= home[pair.image_a] == pair.segment_a < pair.segment_b == home[pair.image_b]


def test_home_is_where_an_image_lies_most_central() -> None:
    home = home_segments([range(0, 10), range(5, 15), range(10, 20)], 21)
    assert home.tolist() == [0] * 8 + [1] * 5 + [2] * 7 + [-1]


def test_smoothing_keeps_unit_length_and_its_weights_are_a_triangle() -> None:
    basis = np.eye(9, dtype=np.float32)
    smooth = with_neighbours(basis, ViewGraph.chain(9), 2)
    np.testing.assert_allclose(smooth[4], np.array([0, 0, 1, 2, 3, 2, 1, 0, 0]) / np.sqrt(19), atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(smooth, axis=1), 1, atol=1e-6)
    np.testing.assert_array_equal(with_neighbours(basis, ViewGraph.chain(9), 0), basis)


def test_slower_walks_are_compared_with_more_neighbours() -> None:
    reaches = []
    for slowness in (1, 2, 4):
        descriptors = see(straight(400) / slowness)
        statistics = similarity_statistics(descriptors, ViewGraph.chain(len(descriptors)))
        assert statistics is not None
        reaches.append(neighbours_alike(descriptors, ViewGraph.chain(len(descriptors)), statistics, at_most=10))
    assert 1 <= reaches[0] < reaches[1] < reaches[2] <= 10
    assert reaches[0] <= 4


@pytest.mark.parametrize(
    ("end", "expected"), [(50, (40, 61)), (31, (30, 51)), (30, (30, 51)), (89, (69, 90)), (80, (69, 90))]
)
def test_sides_are_shifted_into_their_segment_not_shortened(end: int, expected: tuple[int, int]) -> None:
    assert images_around(range(30, 90), end, 10) == tuple(range(*expected))


def test_a_short_segment_gives_all_its_images() -> None:
    assert images_around(range(6, 18), 7, 10) == tuple(range(6, 18))


def test_ends_that_touch_are_no_loop() -> None:
    places = straight(120)
    places[72:84] = places[57:45:-1]
    windows = [Segment(index=k, images=tuple(range(60 * k, 60 * k + 60))) for k in range(2)]
    settings = {"similarity": 0.3, "min_candidates": 1, "min_distance": 1}
    touching = plan_loops(
        see(places, noise=0.3),
        ViewGraph.chain(120),
        windows,
        half_width=30,
        **settings,  # type: ignore[arg-type]
    )
    assert [one.reason for one in touching.candidates] == ["the images around the two ends touch"]


# ------------------------------------------------------------------------------ storage
@pytest.mark.parametrize("places", [straight(300) % 150, np.zeros(100), straight(5)])
def test_plans_survive_the_disk(places: npt.NDArray[np.float64], tmp_path: Path) -> None:
    found = plan(see(places))
    codec: Codec[LoopPlan] = Codec(LoopPlan, "plan")
    codec.write(tmp_path, found)
    assert codec.read(tmp_path) == found


# ----------------------------------------------------------------------------- refusals
def test_descriptors_that_are_not_finite_are_refused() -> None:
    descriptors = see(straight(100))
    descriptors[17, 3] = np.nan
    descriptors[40, 0] = np.inf
    with pytest.raises(InputError, match=r"image 17: its descriptor is not finite \(2 such images\)"):
        plan(descriptors)


def test_descriptors_of_other_lengths_are_refused() -> None:
    descriptors = see(straight(100))
    descriptors[23] *= 2
    with pytest.raises(InputError, match="image 23: its descriptor has length 2, needed 1"):
        plan(descriptors)


@pytest.mark.parametrize("shape", [(99, 8), (101, 8), (100,)])
def test_descriptors_that_do_not_fit_the_collection_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(InputError, match="needed one row for each of 100 images"):
        plan_loops(
            np.zeros(shape, np.float32),
            ViewGraph.chain(100),
            plan_windows(ViewGraph.chain(100), segment_length=60, overlap=30),
            similarity="auto",
            min_candidates=3,
            min_distance=3,
            half_width=10,
        )


def test_a_plan_whose_verdicts_and_loops_differ_is_refused() -> None:
    taken = LoopCandidate(
        image_a=1, image_b=99, similarity=0.5, segment_a=0, segment_b=4, num_pairs=9, taken=True, reason="taken"
    )
    with pytest.raises(ValueError, match="1 candidates were taken for 0 loops"):
        LoopPlan(threshold=0.3, weak_threshold=0.2, neighbours=3, statistics=None, candidates=(taken,))
