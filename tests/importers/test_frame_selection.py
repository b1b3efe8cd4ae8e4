"""Which frames are taken: by motion, by time, the sharpest, shot by shot; without a video file."""

from __future__ import annotations

import gc
import itertools
import weakref
from collections.abc import Iterable, Iterator, Sequence

import cv2
import numpy as np
import pytest
from helpers.videos import SIZE, blurred, view

from smust3r_colmap.geometry.arrays import FloatArray, UInt8Array
from smust3r_colmap.importers.frame_selection import TAKE_AT, TAKE_FROM, ChosenFrame, VideoFrame, choose_frames

WIDTH = SIZE[0]


def frame(time_s: float, image: UInt8Array) -> VideoFrame:
    grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
    return VideoFrame(time_s=time_s, grey=grey, rgb=lambda: image)


def film(images: Iterable[UInt8Array], *, rate: float = 10) -> Iterator[VideoFrame]:
    return (frame(k / rate, image) for k, image in enumerate(images))


def path(places: Sequence[float] | FloatArray) -> Iterator[VideoFrame]:
    """The camera at these places along the wall, in pixels."""
    return film(view(float(at)) for at in places)


def numbers(chosen: Iterable[ChosenFrame], *, rate: float = 10) -> list[int]:
    return [round(one.frame.time_s * rate) for one in chosen]


# ------------------------------------------------------------------------------- by motion
@pytest.mark.slow
@pytest.mark.parametrize("step_px", [0.4, 1.0, 2.5])
def test_frames_follow_the_motion_and_not_the_speed(step_px: float) -> None:
    places = np.arange(0, 120 * step_px, step_px)
    taken = places[numbers(choose_frames(path(places), fps=None))]
    steps = np.diff(taken)
    assert steps.min() >= TAKE_FROM * WIDTH - 0.1
    assert steps.max() <= TAKE_AT * WIDTH + 0.1
    assert steps.max() >= 0.8 * TAKE_AT * WIDTH


def test_a_standing_camera_gives_one_frame() -> None:
    rng = np.random.default_rng(0)
    noisy = (np.clip(view(50) + rng.normal(0, 3, (SIZE[1], WIDTH, 3)), 0, 255).astype(np.uint8) for _ in range(25))
    assert len(list(choose_frames(film(noisy), fps=None))) == 1


def test_a_stop_within_a_walk_is_dropped() -> None:
    places = [*np.arange(0, 60, 2.0), *[60.0] * 20, *np.arange(60, 120, 2.0)]
    taken = numbers(choose_frames(path(places), fps=None))
    assert len([k for k in taken if 32 < k < 48]) <= 1
    assert len([k for k in taken if k <= 32]) >= 6
    assert len([k for k in taken if k >= 48]) >= 6


def test_every_frame_of_a_fast_turn_is_taken() -> None:
    places = [*np.arange(0, 20, 0.5), *np.arange(20, 260, 12.0)]
    taken = numbers(choose_frames(path(places), fps=None))
    assert set(range(41, 59)) <= set(taken)


def test_blurred_frames_give_way_to_their_sharp_neighbours() -> None:
    images = [view(at) if k % 3 == 1 else blurred(view(at)) for k, at in enumerate(np.arange(0, 90, 1.5))]
    taken = numbers(choose_frames(film(images), fps=None))
    assert len(taken) > 9
    assert {k % 3 for k in taken} == {1}


def test_a_blank_wall_gives_one_frame() -> None:
    blank = [np.full((SIZE[1], WIDTH, 3), 128, np.uint8)] * 30
    assert numbers(choose_frames(film(blank), fps=None)) == [29]


def test_the_sharpness_is_the_variance_of_the_laplacian() -> None:
    (one,) = choose_frames(film([view(0)]), fps=None)
    kernel = np.array([[0, 1, 0], [1, -4, 1], [0, 1, 0]], np.float64)
    response = cv2.filter2D(one.frame.grey.astype(np.float64), -1, kernel)  # border reflected, as OpenCV's Laplacian
    assert one.sharpness == pytest.approx(response.var(), rel=1e-9)


def test_no_frames_give_no_frames() -> None:
    assert list(choose_frames([], fps=None)) == []
    assert list(choose_frames([], fps=2)) == []


# --------------------------------------------------------------------------------- by time
def test_one_frame_of_each_interval_is_taken() -> None:
    images = [view(0)] * 35
    chosen = list(choose_frames(film(images), fps=2))
    assert [int(one.frame.time_s * 2) for one in chosen] == [0, 1, 2, 3, 4, 5, 6]


def test_of_an_interval_the_sharpest_near_the_middle_is_taken() -> None:
    sharp = {0, 3, 17, 19}
    images = [view(0) if k in sharp else blurred(view(0)) for k in range(20)]
    assert numbers(choose_frames(film(images), fps=1)) == [3, 17]


def test_an_interval_without_a_frame_near_its_middle_gives_the_nearest() -> None:
    frames = [frame(time, view(0)) for time in (0.0, 0.1, 1.95, 2.5)]
    assert [one.frame.time_s for one in choose_frames(frames, fps=1)] == [0.1, 1.95, 2.5]


def test_a_rate_above_that_of_the_video_takes_every_frame() -> None:
    assert numbers(choose_frames(film([view(0)] * 12), fps=10)) == list(range(12))
    assert numbers(choose_frames(film([view(0)] * 12), fps=100)) == list(range(12))


# ------------------------------------------------------------------------------------ shots
def dark(image: UInt8Array) -> UInt8Array:
    return (image // 3).astype(np.uint8)


@pytest.mark.parametrize("fps", [None, 10])
def test_a_hard_cut_begins_a_new_shot(fps: float | None) -> None:
    images = [view(2.0 * k) for k in range(20)] + [dark(view(2.0 * k, seed=1)) for k in range(20)]
    images += [view(300 + 2.0 * k) for k in range(20)]
    chosen = list(choose_frames(film(images), fps=fps))
    shots = {number: numbers(group) for number, group in itertools.groupby(chosen, key=lambda one: one.shot)}
    assert set(shots) == {1, 2, 3}
    assert max(shots[1]) < 20 <= min(shots[2])
    assert max(shots[2]) < 40 <= min(shots[3])


def test_a_cut_in_the_last_frames_is_one() -> None:
    images = [view(2.0 * k) for k in range(20)] + [dark(view(0, seed=1))]
    assert [(one.shot, one.frame.time_s) for one in choose_frames(film(images), fps=None)][-1] == (2, 2.0)


def test_a_flash_is_no_cut_and_is_left_out() -> None:
    images = [view(2.0 * k) for k in range(40)]
    images[20] = images[21] = np.full_like(images[0], 250)
    chosen = list(choose_frames(film(images), fps=10))
    assert {one.shot for one in chosen} == {1}
    assert numbers(chosen) == [k for k in range(40) if k not in (20, 21)]


def test_a_sudden_turn_in_the_same_room_is_no_cut() -> None:
    places = [*np.arange(0, 40, 2.0), *np.arange(240, 280, 2.0)]
    assert {one.shot for one in choose_frames(path(places), fps=None)} == {1}


# ----------------------------------------------------------------------------------- memory
@pytest.mark.parametrize("fps", [None, 1])
def test_few_frames_are_in_memory(fps: float | None) -> None:
    alive: weakref.WeakSet[VideoFrame] = weakref.WeakSet()
    most = 0

    def counted() -> Iterator[VideoFrame]:
        nonlocal most
        for one in path(np.arange(0, 100, 1.0)):
            alive.add(one)
            gc.collect(0)
            most = max(most, len(alive))
            yield one

    assert sum(1 for _ in choose_frames(counted(), fps=fps)) >= 10
    assert most <= 8
