"""What the decoder remembers of the images it has seen (specification, section 5.1)."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

RememberedImage = tuple[Tensor, ...]
"""One image's tokens in stored form, (N, width) for every layer."""


@dataclass(eq=False)
class _Storage:
    """Rows of every layer with room for more; ``used`` of them belong to the longest memory that shares it."""

    layers: tuple[Tensor, ...]
    used: int


class Memory:
    """Tokens of every layer with the running number of their image.

    A value: ``extended`` and ``without`` give new memories. An extended memory shares the rows of the one
    it came from wherever it can, so adding an image costs that image alone. ``overwrite_`` changes
    in place what all that share the rows see.

    Args:
        layers: L tensors (M, width).
        labels: (M,) int64 running number of the image of each token.
        num_images: the number that the next image gets.
    """

    def __init__(self, layers: Sequence[Tensor], labels: Tensor, num_images: int) -> None:
        self._storage = _Storage(tuple(layers), len(labels))
        self.labels = labels
        self.num_images = num_images

    @classmethod
    def of(cls, images: Sequence[RememberedImage], *, reserve: int = 0) -> Memory:
        """A memory of these images alone, with room for ``reserve`` tokens in all before it has to move."""
        first = images[0]
        room = max(reserve, 0)
        empty = cls([layer.new_empty((room, layer.shape[1])) for layer in first], _no_labels(first[0]), 0)
        return empty.extended(images)

    def __len__(self) -> int:
        return len(self.labels)

    @property
    def layers(self) -> tuple[Tensor, ...]:
        """L tensors (M, width)."""
        return tuple(layer[: len(self)] for layer in self._storage.layers)

    @property
    def num_bytes(self) -> int:
        """Of the tokens and the room reserved for more."""
        return sum(layer.untyped_storage().nbytes() for layer in self._storage.layers)

    def extended(self, images: Sequence[RememberedImage]) -> Memory:
        """This memory and the images after it, labelled from ``num_images`` on."""
        counts = torch.tensor([len(image[0]) for image in images])
        numbers = torch.arange(self.num_images, self.num_images + len(images))
        new_labels = torch.repeat_interleave(numbers, counts).to(self.labels.device)
        longer = Memory.__new__(Memory)
        longer.labels = torch.cat((self.labels, new_labels))
        longer.num_images = self.num_images + len(images)
        if any(tokens.requires_grad for image in images for tokens in image):
            joined = [torch.cat((old, *new)) for old, *new in zip(self.layers, *images, strict=True)]
            longer._storage = _Storage(tuple(joined), len(longer))
            return longer
        longer._storage = self._storage_for(len(longer))
        for layer, *new in zip(longer._storage.layers, *images, strict=True):
            torch.cat(new, out=layer[len(self) : len(longer)])
        longer._storage.used = len(longer)
        return longer

    def _storage_for(self, needed: int) -> _Storage:
        """Our own rows if no other memory has written behind them and there is room, else a copy with room to grow."""
        own = self._storage
        if own.used == len(self) and needed <= len(own.layers[0]):
            return own
        room = needed if not len(self) else needed + needed // 2
        layers = [layer.new_empty((room, layer.shape[1])) for layer in own.layers]
        for new, old in zip(layers, self.layers, strict=True):
            new[: len(self)] = old
        return _Storage(tuple(layers), len(self))

    def overwrite_(self, label: int, image: RememberedImage) -> None:
        """Put fresh tokens in the place of an image's old ones (refinement, section 9.2).

        Raises:
            KeyError: no image has this label.
        """
        rows = torch.nonzero(self.labels == label)[:, 0]
        if not len(rows):
            raise KeyError(f"the memory has no image {label}")
        for layer, fresh in zip(self.layers, image, strict=True):
            layer[rows] = fresh

    def without(self, labels: Collection[int]) -> Memory:
        """This memory with all tokens of some images taken out; the other labels stay."""
        keep = ~torch.isin(self.labels, torch.tensor(sorted(labels), dtype=torch.int64, device=self.labels.device))
        return Memory([layer[keep] for layer in self.layers], self.labels[keep], self.num_images)

    def relabelled(self, label: int, new_label: int) -> Memory:
        """The same tokens, one image under another number; shares the rows."""
        labels = torch.where(self.labels == label, new_label, self.labels)
        return self._with(labels, self.num_images)

    def counting(self, num_images: int) -> Memory:
        """The same tokens; the next image gets this number. Shares the rows."""
        return self._with(self.labels, num_images)

    def _with(self, labels: Tensor, num_images: int) -> Memory:
        other = Memory.__new__(Memory)
        other._storage, other.labels, other.num_images = self._storage, labels, num_images
        return other


def _no_labels(like: Tensor) -> Tensor:
    return torch.empty(0, dtype=torch.int64, device=like.device)
