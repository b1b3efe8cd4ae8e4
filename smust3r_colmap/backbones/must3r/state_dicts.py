"""Whether the tensors of a file are those of an architecture, and if not, what they probably are.

A network that loads half of its weights runs, and gives nonsense. So every name and shape is compared
before anything is built, and the difference is told in a form that leads to the right file.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

import torch
from torch import Tensor

from smust3r_colmap.backbones.must3r.architecture import (
    Architecture,
    DecoderArchitecture,
    EncoderArchitecture,
)
from smust3r_colmap.backbones.must3r.decoder import Decoder
from smust3r_colmap.backbones.must3r.encoder import Encoder

StateDict = Mapping[str, Tensor]
Shapes = Mapping[str, tuple[int, ...]]

_DEEPEST = 1000
_WIDEST = 65_536
"""Far beyond any network, and small enough that a damaged description costs no time."""
_NAMED = 3
"""Tensors of each kind in a message; the rest is counted."""


def empty_parts(architecture: Architecture) -> tuple[Encoder, Decoder]:
    """Encoder and decoder without memory for their weights, which are to be assigned.

    Raises:
        ValueError: sizes that no network has.
    """
    for part in (architecture.encoder, architecture.decoder):
        sizes = [value for value in asdict(part).values() if isinstance(value, int | float)]
        if part.depth > _DEEPEST or max(sizes) > _WIDEST:
            raise ValueError(f"no network has the sizes {part}")
    with torch.device("meta"):
        return Encoder(architecture.encoder), Decoder(architecture.decoder)


def parts_for(
    architecture: Architecture, encoder_state: StateDict, decoder_state: StateDict
) -> tuple[Encoder, Decoder]:
    """``empty_parts`` that these state dicts were found to fit, name by name and shape by shape.

    Raises:
        ValueError: names or shapes that differ, with how many, the first few, and what that probably means;
            or tensors that are not plain floating-point ones.
    """
    encoder, decoder = empty_parts(architecture)
    for part, state in ((encoder, encoder_state), (decoder, decoder_state)):
        _check_kinds(state)
        difference = _difference(shapes_of(part.state_dict()), shapes_of(state))
        if difference.any:
            cause = _probable_cause(part.architecture, difference, state)
            raise ValueError(f"the {_name(part.architecture)} does not fit its description: {difference}. {cause}")
    return encoder, decoder


def shapes_of(state: StateDict) -> Shapes:
    """Of every tensor, by its name."""
    return {key: tuple(tensor.shape) for key, tensor in state.items()}


def _check_kinds(state: StateDict) -> None:
    for key, tensor in state.items():
        if tensor.layout != torch.strided or not tensor.is_floating_point() or tensor.device.type == "meta":
            raise ValueError(f"{key} is {tensor.dtype}, {tensor.layout}, on {tensor.device}; plain floats are needed")


@dataclass(frozen=True, kw_only=True)
class _Difference:
    """Between the tensors that should be there and those that are."""

    expected: int
    missing: Sequence[str]
    unexpected: Sequence[str]
    reshaped: Sequence[str]

    @property
    def any(self) -> bool:
        return bool(self.missing or self.unexpected or self.reshaped)

    def __str__(self) -> str:
        kinds = (
            (f"of {self.expected} tensors are missing", self.missing),
            ("are unexpected", self.unexpected),
            ("have another shape", self.reshaped),
        )
        return "; ".join(f"{len(keys)} {what} ({_first(keys)})" for what, keys in kinds if keys)


def _first(keys: Sequence[str]) -> str:
    return ", ".join([*keys[:_NAMED], *(["..."] if len(keys) > _NAMED else [])])


def _difference(expected: Shapes, found: Shapes) -> _Difference:
    return _Difference(
        expected=len(expected),
        missing=[key for key in expected if key not in found],
        unexpected=[key for key in found if key not in expected],
        reshaped=[
            f"{key} {found[key]} instead of {shape}"
            for key, shape in expected.items()
            if key in found and found[key] != shape
        ],
    )


def _probable_cause(part: EncoderArchitecture | DecoderArchitecture, difference: _Difference, state: StateDict) -> str:
    name = _name(part)
    if len(difference.missing) == difference.expected:
        return "No name is the same: these are weights of another network"
    ending = name[:3]  # enc, dec
    norm = state.get(f"norm_{ending}.weight")
    if norm is not None and norm.numel() != part.width:
        return f"The file holds an {name} of width {norm.numel()}, its description says {part.width}"
    blocks = {key.split(".")[1] for key in state if key.startswith(f"blocks_{ending}.")}
    if len(blocks) > part.depth:
        return f"The file holds {len(blocks)} blocks, its description says {part.depth}"
    if difference.missing and not difference.unexpected and not difference.reshaped:
        there = difference.expected - len(difference.missing)
        return f"Only {there} of {difference.expected} tensors are there: fetch or convert the file again"
    return "These are weights of a related network, or of another version of this one"


def _name(part: EncoderArchitecture | DecoderArchitecture) -> str:
    return "encoder" if isinstance(part, EncoderArchitecture) else "decoder"
