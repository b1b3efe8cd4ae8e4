"""One vector per image, by which loops are found: the mean of the encoder's features, or a trained head's.

The mean needs nothing (paper section III-F). The head that is published beside the checkpoints weighs the
features first (network specification, section 13). It was made for ASMK, which compares all local features of
two images by way of a codebook. That is not built: its arithmetic has no reference to be checked against, and
the codebook is a pickle of its own. Ranking images by the cosine of their global descriptors needs neither.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from smust3r_colmap.backbones.must3r.encoder import EncodedImage
from smust3r_colmap.backbones.must3r.restricted_pickle import read_pickled
from smust3r_colmap.errors import CheckpointError

Descriptor = npt.NDArray[np.float32]

_PROJECTOR = "projector."
_LAYERS_PER_STEP = 3
"""Linear, layer norm, GELU; the numbering of the projector's keys counts all of them."""


def mean_descriptor(image: EncodedImage) -> Descriptor:
    """(C,) mean of the features at unit length; zero where they are not finite or cancel.

    Source: paper, section III-F ("average-pooled to obtain a compact global feature vector").
    """
    return _unit(image.features.detach().double().mean(dim=0))


@dataclass(frozen=True, kw_only=True, eq=False)
class Whitening:
    """x -> (x - mean) @ projection in float64. mean: (1, C). projection: (C, D)."""

    mean: Tensor
    projection: Tensor

    def __call__(self, features: Tensor) -> Tensor:
        """(N, C) -> (N, D) in the type of the features."""
        return ((features.double() - self.mean) @ self.projection).to(features.dtype)


@dataclass(frozen=True, kw_only=True, eq=False)
class RetrievalHead:
    """Trained on top of the encoder to tell places apart (network specification, section 13).

    Args:
        prewhiten, postwhiten: before and after everything else, where trained.
        projector: linear layers with layer norm and GELU between them; may be empty.
        residual: the projector's output is added to its input.
    """

    prewhiten: Whitening | None
    projector: nn.Sequential
    residual: bool
    postwhiten: Whitening | None

    @classmethod
    def load(cls, path: Path) -> RetrievalHead:
        """The head in a published file, on the CPU.

        Raises:
            CheckpointError: not such a file, or a head that is not built here.
        """
        content = read_pickled(path)
        options, state = content.get("args"), content.get("model")
        if not isinstance(options, argparse.Namespace) or not isinstance(state, dict):
            raise CheckpointError(
                f"{path} is no retrieval head: it holds {sorted(content)}, needed args and model. The file is named "
                "like its checkpoint with _retrieval_trainingfree"
            )
        try:
            return _head_from(vars(options), state)
        except ValueError as error:
            raise CheckpointError(f"{path} is not a retrieval head as published: {error}") from error

    def global_descriptor(self, image: EncodedImage) -> Descriptor:
        """(D,) mean of all features weighted by attention, at unit length; zero where they are not finite.

        Raises:
            ValueError: the encoder has another width than the head.
        """
        features, attention = self._weighed(image)
        return _unit(attention.double() @ features.double())

    def _weighed(self, image: EncodedImage) -> tuple[Tensor, Tensor]:
        """(N, D) features and the (N,) attention of each."""
        features = image.features.detach().float().cpu()
        if self._width not in {None, features.shape[1]}:
            raise ValueError(
                f"features of width {features.shape[1]}, the head takes {self._width}; it is another model's"
            )
        with torch.no_grad():
            if self.prewhiten is not None:
                features = self.prewhiten(features)
            projected: Tensor = self.projector(features)
            if self.residual:
                projected = projected + features
            attention = projected.norm(dim=-1)
            if self.postwhiten is not None:
                projected = self.postwhiten(projected)
        return projected, attention

    @property
    def _width(self) -> int | None:
        """Of the features that the head takes; None where it takes any."""
        if self.prewhiten is not None:
            return len(self.prewhiten.projection)
        first = next(iter(self.projector), None)
        return first.in_features if isinstance(first, nn.Linear) else None


# -------------------------------------------------------------------------------- from a file
def _head_from(options: Mapping[str, object], state: Mapping[str, object]) -> RetrievalHead:
    """Raises ValueError saying what does not fit."""
    if options.get("featweights", "l2norm") != "l2norm":
        raise ValueError(f"features weighted by {options['featweights']!r}, built is l2norm")
    if not all(isinstance(values, Tensor) for values in state.values()):
        raise ValueError("the model holds more than tensors")
    tensors = {key: values for key, values in state.items() if isinstance(values, Tensor)}
    head = RetrievalHead(
        prewhiten=_whitening(tensors, "prewhiten", wanted=options.get("prewhiten") is not None),
        projector=_projector(tensors, _widths(options.get("hdims"))),
        residual=bool(options.get("residual")),
        postwhiten=_whitening(tensors, "postwhiten", wanted=options.get("postwhiten") is not None),
    )
    _check_residual(head)
    if tensors:
        raise ValueError(f"{len(tensors)} tensors have no place, such as {sorted(tensors)[0]}")
    return head


def _check_residual(head: RetrievalHead) -> None:
    linear = [layer for layer in head.projector if isinstance(layer, nn.Linear)]
    if head.residual and linear and linear[0].in_features != linear[-1].out_features:
        raise ValueError(
            f"the projector gives {linear[-1].out_features} numbers, to be added to its {linear[0].in_features}"
        )


def _widths(hdims: object) -> tuple[int, ...]:
    """Of the projector's layers, from ``1024_512``; an empty string is no projector."""
    if not isinstance(hdims, str):
        raise ValueError(f"hdims is {hdims!r}, needed widths such as '1024_512'")
    words = [word for word in hdims.split("_") if word]
    if not all(word.isdecimal() and int(word) for word in words):
        raise ValueError(f"hdims is {hdims!r}, needed widths such as '1024_512'")
    return tuple(int(word) for word in words)


def _whitening(tensors: dict[str, Tensor], name: str, *, wanted: bool) -> Whitening | None:
    """Takes its two tensors out of the dictionary."""
    if not wanted:
        return None
    mean, projection = _take(tensors, f"{name}.m"), _take(tensors, f"{name}.p")
    if projection.ndim != 2 or mean.shape != (1, len(projection)):
        raise ValueError(f"{name} takes {tuple(mean.shape)} by {tuple(projection.shape)}, needed (1, C) by (C, D)")
    return Whitening(mean=mean.double(), projection=projection.double())


def _projector(tensors: dict[str, Tensor], widths: tuple[int, ...]) -> nn.Sequential:
    """Takes its tensors out of the dictionary; (N, C) -> (N, widths[-1])."""
    layers: list[nn.Module] = []
    for number, width in enumerate(widths):
        if number:
            norm = nn.LayerNorm(widths[number - 1])
            layers += [_filled(norm, tensors, len(layers)), nn.GELU()]
        weights = tensors.get(f"{_PROJECTOR}{number * _LAYERS_PER_STEP}.weight")
        if weights is None or weights.ndim != 2:
            raise ValueError(f"{len(widths)} linear layers are named, number {number + 1} is missing")
        layers.append(_filled(nn.Linear(weights.shape[1], width), tensors, len(layers)))
    return nn.Sequential(*layers).eval()


def _filled(layer: nn.Module, tensors: dict[str, Tensor], number: int) -> nn.Module:
    for name, empty in layer.state_dict().items():
        weights = _take(tensors, f"{_PROJECTOR}{number}.{name}")
        if weights.shape != empty.shape:
            raise ValueError(f"{_PROJECTOR}{number}.{name} is {tuple(weights.shape)}, needed {tuple(empty.shape)}")
        empty.copy_(weights)
    return layer


def _take(tensors: dict[str, Tensor], key: str) -> Tensor:
    if key not in tensors:
        raise ValueError(f"{key} is missing")
    return tensors.pop(key)


def _unit(vector: Tensor) -> Descriptor:
    norm = vector.norm()
    if not torch.isfinite(norm) or norm == 0:
        return np.zeros(len(vector), np.float32)
    unit: Descriptor = (vector / norm).float().cpu().numpy()
    return unit
