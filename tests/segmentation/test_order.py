"""Sequence or not, by names and likeness."""

from __future__ import annotations

import numpy as np

from smust3r_colmap.segmentation.order import ImageOrder, decide_order
from smust3r_colmap.segmentation.similarity import Descriptors


def along(places: np.ndarray, *, seed: int = 0) -> Descriptors:
    """Unit descriptors of images at places along a path: near ones are alike, far ones are not."""
    rng = np.random.default_rng(seed)
    landmarks = rng.normal(size=(int(places.max()) + 20, 128))
    seen = np.stack([landmarks[int(place) : int(place) + 10].mean(axis=0) for place in places])
    noisy = seen + 0.1 * rng.normal(size=seen.shape)
    unit: Descriptors = (noisy / np.linalg.norm(noisy, axis=1, keepdims=True)).astype(np.float32)
    return unit


def decide(names: list[str], descriptors: Descriptors) -> ImageOrder:
    return decide_order(names, range(len(names)), descriptors, "auto")


def names(num_images: int, folder: str = ".") -> list[str]:
    return [f"{folder}/{k:04d}.jpg" for k in range(num_images)]


def test_a_walk_is_a_sequence() -> None:
    order = decide(names(100), along(np.arange(100) * 3))
    assert order.is_one_sequence
    assert [len(sequence) for sequence in order.chain.sequences] == [100]
    assert "one sequence" in order.reason


def test_the_same_walk_shuffled_is_in_no_order() -> None:
    places = np.random.default_rng(1).permutation(100) * 3
    order = decide(names(100), along(places))
    assert not order.is_one_sequence
    assert not order.chain.is_ordered
    assert "no order" in order.reason


def test_two_walks_in_two_folders_are_two_sequences() -> None:
    order = decide(names(60, "a") + names(60, "b"), along(np.concatenate([np.arange(60), 500 + np.arange(60)]) * 3))
    assert [len(sequence) for sequence in order.chain.sequences] == [60, 60]
    assert not order.is_one_sequence


def test_one_walk_in_two_folders_is_one_sequence() -> None:
    order = decide(names(60, "a") + names(60, "b"), along(np.arange(120) * 3))
    assert order.is_one_sequence


def test_what_is_asked_for_is_done_whatever_the_images_say() -> None:
    shuffled = along(np.random.default_rng(1).permutation(100) * 3)
    assert decide_order(names(100), range(100), shuffled, "sequence").is_one_sequence
    assert not decide_order(names(100), range(100), along(np.arange(100) * 3), "unordered").chain.is_ordered


def test_only_keyframes_follow_each_other() -> None:
    keyframes = range(0, 100, 4)
    descriptors = along(np.arange(100))
    descriptors[[k for k in range(100) if k not in keyframes]] = 0
    order = decide_order(names(100), keyframes, descriptors, "auto")
    assert order.is_one_sequence
    assert order.chain.pairs.tolist() == [[k, k + 4] for k in range(0, 96, 4)]
