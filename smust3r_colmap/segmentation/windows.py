"""Cutting an ordered collection into overlapping windows (paper section III-B).

The next module to read is ``backbones``.
"""

from __future__ import annotations

from smust3r_colmap.errors import CollectionError, ConfigError
from smust3r_colmap.products import Segment
from smust3r_colmap.segmentation.view_graph import ViewGraph


def plan_windows(graph: ViewGraph, *, segment_length: int, overlap: int) -> tuple[Segment, ...]:
    """Windows of l images over every sequence, neighbours sharing at least p: 1..l, l-p+1..2l-p, and so on.

    Where the last window would run past the end it is shifted back until it ends at the last image.
    Every window so has exactly l images and no short tail can arise: a tail of a few images has little
    baseline and is what a backbone most easily gets wrong, while the shift costs no further segment
    and makes the last overlap only larger. Growing the window before it instead would exceed the
    length that memory was planned for. Only the last window depends on the number of images, so
    images appended to a collection leave the finished windows as they are.

    Args:
        graph: of at least 2 images; up to l images of a sequence make one segment. An image that is next to no other
            is in none.
        segment_length: l, at least 2.
        overlap: p, from 1 to l - 1.

    Raises:
        ConfigError: l or p is outside these bounds.
        CollectionError: fewer than 2 images.
    """
    if segment_length < 2:
        raise ConfigError(f"segment length {segment_length}: a segment needs at least 2 images")
    if not 1 <= overlap < segment_length:
        raise ConfigError(
            f"overlap {overlap}: neighbouring segments of {segment_length} images must share "
            f"between 1 and {segment_length - 1}"
        )
    if graph.num_images < 2:
        raise CollectionError(f"{graph.num_images} usable images: a reconstruction needs at least 2")
    windows: list[tuple[int, ...]] = []
    for images in (sequence.tolist() for sequence in graph.sequences if len(sequence) > 1):
        length = min(segment_length, len(images))
        last_start = len(images) - length
        starts = [*range(0, last_start, segment_length - overlap), last_start]
        windows += [tuple(images[start : start + length]) for start in starts]
    return tuple(Segment(index=index, images=images) for index, images in enumerate(windows))
