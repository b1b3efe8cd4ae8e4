"""Keyframes of image files: by motion, all where it is large, and the pairs of the others."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from smust3r_colmap.config import CameraConfig
from smust3r_colmap.importers.image_folder import import_image_folder
from smust3r_colmap.products import SourceImage
from smust3r_colmap.segmentation.keyframes import choose_keyframes, pairs_with_keyframes, pairs_with_neighbours

WIDTH, HEIGHT = 320, 240


def panorama() -> np.ndarray:
    rng = np.random.default_rng(0)
    small = rng.integers(0, 255, size=(40, 400), dtype=np.uint8)
    return np.asarray(cv2.resize(small, (4000, 400), interpolation=cv2.INTER_CUBIC))


def film(folder: Path, starts: np.ndarray) -> tuple[SourceImage, ...]:
    """Images cut out of a panorama, ``starts`` pixels from its left."""
    picture = panorama()
    for k, start in enumerate(starts.tolist()):
        cv2.imwrite(str(folder / f"{k:04d}.png"), picture[50 : 50 + HEIGHT, start : start + WIDTH])
    return import_image_folder(folder, CameraConfig()).images


def test_a_slow_pan_is_thinned_and_a_stop_gives_one(tmp_path: Path) -> None:
    """Two pixels an image, then a stop of 60 images, then on."""
    starts = np.concatenate([np.arange(60) * 2, np.full(60, 118), 118 + np.arange(60) * 2])
    chosen = np.array(choose_keyframes(film(tmp_path, starts), "auto", segment_length=30))
    steps_px = np.diff(starts[chosen])
    assert len(chosen) < 40
    assert steps_px.max() <= 0.055 * WIDTH, "neighbours still overlap"
    assert np.count_nonzero((chosen > 62) & (chosen < 116)) <= 1, "nothing moves there"


def test_images_that_move_enough_are_all_keyframes(tmp_path: Path) -> None:
    images = film(tmp_path, np.arange(60) * 14)
    assert choose_keyframes(images, "auto", segment_length=30) == tuple(range(60))


def test_short_collections_and_all_are_left_alone(tmp_path: Path) -> None:
    images = film(tmp_path, np.arange(40))
    assert choose_keyframes(images, "auto", segment_length=40) == tuple(range(40))
    assert choose_keyframes(images, "all", segment_length=10) == tuple(range(40))
    assert len(choose_keyframes(images, "auto", segment_length=10)) < 10


def test_a_number_is_spread_evenly(tmp_path: Path) -> None:
    images = film(tmp_path, np.arange(21))
    assert choose_keyframes(images, 5, segment_length=2) == (0, 5, 10, 15, 20)
    assert choose_keyframes(images, 100, segment_length=2) == tuple(range(21))


def test_others_are_paired_with_the_keyframes_beside_them() -> None:
    keyframes = {1, 4, 6}
    pairs = pairs_with_keyframes(8, tuple(sorted(set(range(8)) - keyframes)))
    partners = {k: sorted(sum(pair) - k for pair in pairs if k in pair) for k in (0, 2, 3, 5, 7)}
    assert partners == {0: [1, 4], 2: [1, 4], 3: [1, 4], 5: [4, 6], 7: [4, 6]}


@pytest.mark.parametrize("others", [(), (1,), (0, 3)])
def test_every_other_image_has_two_pairs(others: tuple[int, ...]) -> None:
    pairs = pairs_with_keyframes(4, others)
    for image in others:
        partners = [sum(pair) - image for pair in pairs if image in pair]
        assert len(partners) == 2
        assert not set(partners) & set(others)
    assert all(i < j for i, j in pairs)


def test_neighbours_are_two_before_and_two_after() -> None:
    assert pairs_with_neighbours(9, [0, 5]) == ((0, 1), (0, 2), (3, 5), (4, 5), (5, 6), (5, 7))
    assert pairs_with_neighbours(4, [2, 3]) == ((0, 2), (1, 2), (1, 3), (2, 3))
