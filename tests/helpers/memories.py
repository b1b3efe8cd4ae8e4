"""What the memory of a MUSt3R network holds of one image."""

from __future__ import annotations

from smust3r_colmap.backbones.must3r.memory import Memory, RememberedImage


def tokens_of(memory: Memory, label: int) -> RememberedImage:
    """A copy of the image's tokens, (N, width) for every layer; N is 0 where no image has the label."""
    return tuple(layer[memory.labels == label] for layer in memory.layers)
