"""The network as one value, and what one can ask of it; the functions here are the package's interface."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from smust3r_colmap.backbones.must3r.architecture import Architecture, MemoryMode
from smust3r_colmap.backbones.must3r.decoder import Decoder
from smust3r_colmap.backbones.must3r.encoder import EncodedImage, Encoder
from smust3r_colmap.backbones.must3r.memory import Memory


@dataclass(frozen=True, kw_only=True, eq=False)
class Network:
    """Encoder and decoder with their weights, ready to run.

    Args:
        architecture: what the two were built from.
        device: where the weights lie.
        dtype: float32, the reference; or bfloat16, by autocast.
    """

    architecture: Architecture
    encoder: Encoder
    decoder: Decoder
    device: torch.device
    dtype: torch.dtype = torch.float32

    @contextmanager
    def running(self) -> Iterator[None]:
        """No gradients, and arithmetic in the network's number type."""
        with torch.no_grad(), torch.autocast(self.device.type, self.dtype, enabled=self.dtype != torch.float32):
            yield


def remembering_as(network: Network, mode: MemoryMode) -> Network:
    """The same weights with another form of memory; the results are the same (section 5.1)."""
    if mode == network.architecture.decoder.memory_mode:
        return network
    architecture = replace(network.architecture, decoder=replace(network.architecture.decoder, memory_mode=mode))
    with torch.device("meta"):
        decoder = Decoder(architecture.decoder)
    decoder.load_state_dict(network.decoder.state_dict(), assign=True)
    decoder.requires_grad_(False).eval()
    return replace(network, architecture=architecture, decoder=decoder)


@dataclass(frozen=True, kw_only=True, eq=False)
class MemoryUpdate:
    """A memory that holds the new images too, and the output of the head for each of them.

    Args:
        memory: the old images and the new.
        raw: one (H, W, 7) float32 per new image, before activation.
    """

    memory: Memory
    raw: tuple[Tensor, ...]


def encode(
    network: Network, images: Sequence[Tensor | npt.NDArray[np.floating[Any]]], *, batch_size: int = 1
) -> tuple[EncodedImage, ...]:
    """Features of images (3, H, W) in [-1, 1], H and W multiples of the patch (``preprocess`` makes them).

    Args:
        images: of any shapes; floating-point numbers of any width, which become float32.
        batch_size: neighbours of one shape that go together at most.

    Raises:
        ValueError: a shape or a number type that is not as said, or the batch is none.
    """
    _check_batch(batch_size)
    given = [torch.as_tensor(image) for image in images]
    for number, image in enumerate(given):
        if not image.is_floating_point():
            raise ValueError(f"image {number}: {image.dtype}, needed are floating-point numbers from -1 to 1")
    pixels = [image.to(network.device, torch.float32, non_blocking=True) for image in given]
    with network.running():
        return network.encoder.encode(pixels, batch_size=batch_size)


def init_memory(network: Network, images: Sequence[EncodedImage], *, reserve: int = 0) -> MemoryUpdate:
    """A memory of these images; the first is the reference: its camera frame is the world frame.

    Args:
        images: at least one, of any shapes, in the order in which they are numbered.
        reserve: tokens to make room for, so that later updates need not move the memory.

    Raises:
        ValueError: there is no image.
    """
    _check_some(images)
    with network.running():
        seen = network.decoder.see(images, None)
        return MemoryUpdate(memory=Memory.of(seen.remembered, reserve=reserve), raw=seen.raw)


def update_memory(network: Network, memory: Memory, images: Sequence[EncodedImage]) -> MemoryUpdate:
    """The memory with these images added in one step; the given memory stays valid.

    Raises:
        ValueError: there is no image.
    """
    _check_some(images)
    with network.running():
        seen = network.decoder.see(images, memory)
        return MemoryUpdate(memory=memory.extended(seen.remembered), raw=seen.raw)


def render(
    network: Network, memory: Memory, images: Sequence[EncodedImage], *, batch_size: int = 1
) -> tuple[Tensor, ...]:
    """(H, W, 7) float32 per image, before activation, against the whole memory; images do not see each other.

    Raises:
        ValueError: the batch is none.
    """
    _check_batch(batch_size)
    with network.running():
        return tuple(
            raw
            for start in range(0, len(images), batch_size)
            for raw in network.decoder.render(images[start : start + batch_size], memory)
        )


def _check_batch(batch_size: int) -> None:
    if batch_size < 1:
        raise ValueError(f"batch_size {batch_size}: at least 1 is needed")


def _check_some(images: Sequence[EncodedImage]) -> None:
    if not images:
        raise ValueError("no image to remember; at least 1 is needed")
