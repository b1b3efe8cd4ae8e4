"""Random weights of a MUSt3R network for tests and benchmarks, the same on every machine.

They keep the activations of a network of any size in range and use every path (the feedback too, which is zero in
a freshly made network). Depth is positive, so that focal lengths and poses are well conditioned; the geometry is
meaningless.
Source: the weight recipe of the reference vectors of the network specification.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from smust3r_colmap.backbones.must3r.architecture import CHANNELS, Architecture
from smust3r_colmap.backbones.must3r.network import Network
from smust3r_colmap.backbones.must3r.state_dicts import Shapes, empty_parts, shapes_of

_NUM_POINT_CHANNELS = CHANNELS - 1
"""All but the confidence."""


def random_network_weights(architecture: Architecture, seed: int) -> Network:
    """A network on the CPU, encoder made from ``seed`` and decoder from ``seed + 1``."""
    encoder, decoder = empty_parts(architecture)
    for part, part_seed in ((encoder, seed), (decoder, seed + 1)):
        part.load_state_dict(random_state(shapes_of(part.state_dict()), part_seed), assign=True)
        part.eval()
    return Network(architecture=architecture, encoder=encoder, decoder=decoder, device=torch.device("cpu"))


def random_state(shapes: Shapes, seed: int) -> dict[str, Tensor]:
    """float32 tensors for the shapes of an encoder's or a decoder's state dict."""
    return {
        key: _weights_of(key, np.random.default_rng([seed, number]), shapes[key])
        for number, key in enumerate(sorted(shapes))
    }


def _weights_of(key: str, rng: np.random.Generator, shape: tuple[int, ...]) -> Tensor:
    z = torch.from_numpy(rng.standard_normal(shape, dtype=np.float32))
    module = key.rpartition(".")[0].rpartition(".")[2]
    if key == "image2_embed":
        return 0.3 * z
    if key == "head_dec.proj.weight":
        return z * _gain(shape) * _gain_of_channels(shape[0])
    if len(shape) >= 2:
        return z * _gain(shape)
    if key.endswith("weight") and "norm" in module:
        return 1 + 0.2 * z
    if key == "head_dec.proj.bias":
        return 0.1 * z + _ramps(shape[0])
    return 0.1 * z


def _gain(shape: tuple[int, ...]) -> float:
    """Keeps the size of activations from layer to layer; multiplied, because a division rounds differently."""
    return float(1 / np.sqrt(np.prod(shape[1:])))


def _gain_of_channels(rows: int) -> Tensor:
    """(rows, 1) of the head: points vary little about the ramps, the confidence more."""
    gain = torch.full((rows, 1), 0.5)
    gain[: rows * _NUM_POINT_CHANNELS // CHANNELS] = 0.15
    return gain


def _ramps(rows: int) -> Tensor:
    """(rows,) bias of the head: x grows with the column, y with the row, depth is 1.5."""
    patch = round((rows / CHANNELS) ** 0.5)
    centred = 0.08 * (torch.arange(patch, dtype=torch.float32) - (patch - 1) / 2)
    ramps = torch.zeros(CHANNELS, patch, patch)
    for first in (0, 3):  # the point in the world, the point in the camera
        ramps[first] += centred
        ramps[first + 1] += centred[:, None]
        ramps[first + 2] += 1.5
    return ramps.flatten()
