"""Keyframes: the images of a dense sequence that carry its reconstruction.

Where neighbours overlap almost wholly, as in video at its full rate, segments of consecutive images see hardly any
parallax and disagree about everything. Keyframes are chosen by the motion of the image, as frames of a video are
(``importers.frame_selection``): a stretch without motion gives one, a turn gives many. The other images are registered
to the refined model. The next module to read is ``order``.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from typing import Literal

import numpy as np

from smust3r_colmap.geometry.arrays import Pair
from smust3r_colmap.importers.frame_selection import TAKE_FROM, VideoFrame, choose_frames, displacement
from smust3r_colmap.importers.images import load_grey, load_rgb
from smust3r_colmap.products import SourceImage

MAX_SHARE = 0.5
"""Of the images that keyframes may be; with more, leaving the others out saves little and all are used."""
_TESTED_PAIRS = 20
"""Pairs of neighbours, evenly spread, that tell whether a collection can be dense at all."""
_NEAR_IMAGES = 2
"""Before and after a blurred image, that it is matched with."""


def choose_keyframes(
    images: Sequence[SourceImage], wanted: int | Literal["auto", "all"], *, segment_length: int
) -> tuple[int, ...]:
    """Indices of the keyframes, ascending; all images where they are no dense sequence.

    Args:
        images: in name order.
        wanted: that many, evenly spread; ``"auto"`` takes those between which the image moves enough, if they are
            less than half of all and the images are more than one segment.
        segment_length: images of one segment.
    """
    n = len(images)
    everything = tuple(range(n))
    if wanted == "all" or n <= segment_length:
        return everything
    if wanted != "auto":
        return tuple(np.unique(np.linspace(0, n - 1, min(wanted, n)).round().astype(int)).tolist())
    if len({(image.width, image.height) for image in images}) > 1 or not _may_be_dense(images):
        return everything
    chosen = tuple(round(one.frame.time_s) for one in choose_frames(_frames(images), fps=None))
    return chosen if len(chosen) <= MAX_SHARE * n else everything


def pairs_with_keyframes(num_images: int, others: Sequence[int]) -> tuple[Pair, ...]:
    """Pairs (i < j) of every other image with the keyframes before and after it, or with the nearest two at an end.

    Args:
        num_images: of the collection. others: that are no keyframes, ascending; at least two images are.
    """
    keyframes = np.setdiff1d(np.arange(num_images), others)
    after = np.clip(np.searchsorted(keyframes, others), 1, len(keyframes) - 1)
    beside = [(int(keyframes[k]), int(i)) for k, i in zip([*(after - 1), *after], [*others, *others], strict=True)]
    return tuple(sorted((min(pair), max(pair)) for pair in beside))


def pairs_with_neighbours(num_images: int, images: Iterable[int]) -> tuple[Pair, ...]:
    """Pairs (i < j) of each of the images with the ``_NEAR_IMAGES`` before and after it, ascending.

    Blurred images match each other, but no keyframe farther away.
    """
    steps = [step for step in range(-_NEAR_IMAGES, _NEAR_IMAGES + 1) if step]
    beside = [(image, image + step) for image in images for step in steps if 0 <= image + step < num_images]
    return tuple(sorted({(min(pair), max(pair)) for pair in beside}))


def _may_be_dense(images: Sequence[SourceImage]) -> bool:
    """Neighbours that move by less than half of what keyframes do, in the median."""
    first = np.unique(np.linspace(0, len(images) - 2, _TESTED_PAIRS).astype(int)).tolist()
    moved = [displacement(load_grey(images[k]), load_grey(images[k + 1])) for k in first]
    return float(np.median(moved)) < MAX_SHARE * TAKE_FROM


def _frames(images: Sequence[SourceImage]) -> Iterator[VideoFrame]:
    for k, image in enumerate(images):
        yield VideoFrame(time_s=float(k), grey=load_grey(image), rgb=partial(load_rgb, image))
