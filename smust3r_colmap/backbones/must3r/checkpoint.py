"""Weights from a file, in either of two forms.

The official form is a file of ``torch.save`` with options, two state dicts and two strings that name the
network (``restricted_pickle`` opens it, ``constructor_strings`` reads the strings). Our own is one safetensors
file with the architecture in its header, which opens at once and holds no code. Both
are mapped into memory rather than read: the weights are there once, and pages come when they are used.
Source: network specification, sections 2 and 15.
"""

from __future__ import annotations

import argparse
import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import get_args

import safetensors
import safetensors.torch
import torch
from torch import Tensor

from smust3r_colmap.backbones.must3r.architecture import Architecture, MemoryMode
from smust3r_colmap.backbones.must3r.architecture_json import architecture_from_json, architecture_to_json
from smust3r_colmap.backbones.must3r.constructor_strings import architecture_from_strings, image_size_is_named
from smust3r_colmap.backbones.must3r.network import Network
from smust3r_colmap.backbones.must3r.restricted_pickle import read_pickled
from smust3r_colmap.backbones.must3r.state_dicts import StateDict, parts_for
from smust3r_colmap.errors import CheckpointError, ConfigError, StorageError
from smust3r_colmap.storage.atomic_write import atomic_file

_log = logging.getLogger(__name__)

_PARTS = ("encoder", "decoder")
_ARCHITECTURE = "must3r architecture, version 1"
"""The one entry of our header; with more of them safetensors would write the same file differently each time."""
_TRAINED_AT = {224: "MUSt3R_224_cvpr.pth", 512: "MUSt3R_512.pth"}


def load_checkpoint(
    path: Path | str,
    *,
    image_size: int | None = None,
    memory_mode: MemoryMode | None = None,
    device: torch.device | str = "cpu",
    dtype: torch.dtype = torch.float32,
) -> Network:
    """The network in a file, ready to run.

    Args:
        path: of the official form or of ours; its content tells which, not its name.
        image_size: longer side of the images to run at; by default the size that the file names.
        memory_mode: what the decoder remembers; by default as the file says. Results are the same.
        device: where the weights go.
        dtype: of the arithmetic, float32 or bfloat16; the weights are float32 always, and are converted where the
            file has others.

    Raises:
        CheckpointError: the file is damaged, of another network, incomplete, or names what is not built here.
        ConfigError: an image size, memory, device or number type that cannot be.
    """
    if dtype not in (torch.float32, torch.bfloat16):
        raise ConfigError(f"number type {dtype}: torch.float32 or torch.bfloat16")
    stored = _read(Path(path))
    architecture = _at_size(stored, image_size)
    if memory_mode is not None:
        if memory_mode not in get_args(MemoryMode):
            raise ConfigError(f"memory mode {memory_mode!r}: one of {', '.join(get_args(MemoryMode))}")
        architecture = replace(architecture, decoder=replace(architecture.decoder, memory_mode=memory_mode))
    target = _usable(device)
    with _damage_named(stored.path):
        encoder, decoder = parts_for(architecture, stored.states["encoder"], stored.states["decoder"])
    for part, name in ((encoder, "encoder"), (decoder, "decoder")):
        part.load_state_dict(_in_float32(stored.states[name], stored.path), assign=True)
        part.to(target).eval()
    return Network(architecture=architecture, encoder=encoder, decoder=decoder, device=target, dtype=dtype)


def read_architecture(path: Path | str) -> Architecture:
    """What network a file holds; its tensors are neither read nor compared.

    Raises:
        CheckpointError: as for ``load_checkpoint``.
    """
    path = Path(path)
    if not _is_safetensors(path):
        return _read_official(path).architecture
    with _damage_named(path), safetensors.safe_open(path, framework="pt") as file:
        return _architecture_in_header(file.metadata())


def convert_checkpoint(source: Path, target: Path) -> None:
    """Write a file of either form as one of ours; number types stay.

    Raises:
        CheckpointError: as for ``load_checkpoint``, or the file does not name its image size.
        StorageError: the disk refused to take the new file; what was at ``target`` is untouched.
    """
    stored = _read(source)
    if not stored.size_is_named:
        raise CheckpointError(f"{source} does not say at which image size it was trained (img_size in both strings)")
    with _damage_named(source):
        write_safetensors_checkpoint(target, stored.architecture, stored.states["encoder"], stored.states["decoder"])


def write_safetensors_checkpoint(
    path: Path, architecture: Architecture, encoder_state: StateDict, decoder_state: StateDict
) -> None:
    """Write weights in our form, atomically.

    Raises:
        ValueError: the state dicts are not those of the architecture.
        StorageError: the disk refused.
    """
    parts_for(architecture, encoder_state, decoder_state)
    tensors = {
        f"{part}.{key}": tensor.detach().contiguous()
        for part, state in zip(_PARTS, (encoder_state, decoder_state), strict=True)
        for key, tensor in state.items()
    }
    with atomic_file(path) as partial:
        partial.touch()
        usual_mode = partial.stat().st_mode  # safetensors would leave a file that only its owner can read
        try:
            safetensors.torch.save_file(tensors, partial, {_ARCHITECTURE: architecture_to_json(architecture)})
        except safetensors.SafetensorError as error:  # also what it makes of an error of the disk
            raise StorageError(f"{path}: cannot be written ({error})") from error
        partial.chmod(usual_mode)


# ------------------------------------------------------------------------------- reading
@dataclass(frozen=True, kw_only=True, eq=False)
class _Stored:
    """What a file holds: tensors still in the file, not yet compared with the architecture.

    Args:
        states: of the encoder and of the decoder, by these names.
        size_is_named: the image size of the architecture is more than a default.
    """

    path: Path
    architecture: Architecture
    states: Mapping[str, StateDict]
    size_is_named: bool


def _read(path: Path) -> _Stored:
    return _read_ours(path) if _is_safetensors(path) else _read_official(path)


def _is_safetensors(path: Path) -> bool:
    """By its first bytes: eight of a length, then JSON."""
    try:
        with path.open("rb") as file:
            return file.read(9)[8:] == b"{"
    except OSError as error:
        raise CheckpointError(f"{path} cannot be read: {error.strerror or error}") from error


@contextmanager
def _damage_named(path: Path) -> Iterator[None]:
    """Errors about the content, with the file in front."""
    try:
        yield
    except (ValueError, safetensors.SafetensorError, OSError) as error:
        raise CheckpointError(f"{path}: {error}") from error


def _read_ours(path: Path) -> _Stored:
    states: dict[str, dict[str, Tensor]] = {part: {} for part in _PARTS}
    with _damage_named(path), safetensors.safe_open(path, framework="pt") as file:
        architecture = _architecture_in_header(file.metadata())
        for name in file.keys():  # noqa: SIM118  (no dictionary)
            part, _, key = name.partition(".")
            if part not in states:
                raise ValueError(f"the tensor {name} belongs neither to the encoder nor to the decoder")
            states[part][key] = file.get_tensor(name)
    return _Stored(path=path, architecture=architecture, states=states, size_is_named=True)


def _architecture_in_header(metadata: Mapping[str, str] | None) -> Architecture:
    header = metadata or {}
    if _ARCHITECTURE not in header:
        raise ValueError(
            f"a safetensors file with {', '.join(sorted(header)) or 'nothing'} in its header and no {_ARCHITECTURE!r}: "
            "it was not written by `weights convert` of this version"
        )
    return architecture_from_json(header[_ARCHITECTURE])


def _read_official(path: Path) -> _Stored:
    content = read_pickled(path)
    missing = [key for key in ("args", *_PARTS) if key not in content]
    if missing:
        raise CheckpointError(
            f"{path} is no MUSt3R checkpoint: it holds {', '.join(content) or 'nothing'}, but no "
            f"{' and no '.join(missing)}. {_what_it_may_be(content)}"
        )
    strings = tuple(_constructor_string(path, content["args"], part) for part in _PARTS)
    with _damage_named(path):
        return _Stored(
            path=path,
            architecture=architecture_from_strings(*strings),
            states={part: _state_dict(content[part], part) for part in _PARTS},
            size_is_named=image_size_is_named(*strings),
        )


def _what_it_may_be(content: Mapping[str, object]) -> str:
    args = content.get("args")
    if isinstance(args, argparse.Namespace) and "nclusters" in vars(args):
        return "It is the head for retrieval, an extra to the weights of the network (--retrieval-weights)"
    if "model" in content:
        return "It looks like DUSt3R or MASt3R, which are other networks; `weights list` names those of MUSt3R"
    return "`weights list` names the files that can be used"


def _constructor_string(path: Path, args: object, part: str) -> str:
    text = vars(args).get(part) if isinstance(args, argparse.Namespace) else None
    if not isinstance(text, str):
        raise CheckpointError(f"{path} does not say what its {part} is: args.{part} is no string")
    return text


def _state_dict(state: object, part: str) -> StateDict:
    if not isinstance(state, dict):
        raise ValueError(f"the {part} is a {type(state).__name__}, not a dictionary of tensors")
    for key, tensor in state.items():
        if not isinstance(key, str) or not isinstance(tensor, Tensor):
            raise ValueError(f"the {part} holds {key!r}, a {type(tensor).__name__}; only named tensors belong there")
    return state


# ---------------------------------------------------------------------------- as asked for
def _at_size(stored: _Stored, image_size: int | None) -> Architecture:
    architecture, path = stored.architecture, stored.path
    if image_size is None or image_size == architecture.image_size:
        return architecture
    patch = architecture.encoder.patch_size
    if image_size < patch:
        raise ConfigError(f"image size {image_size}: {patch} pixels at least, for that is one patch")
    if not stored.size_is_named:
        raise CheckpointError(
            f"{path} does not say at which image size it was trained (the same square img_size in both strings), so it "
            f"runs at {architecture.image_size} pixels only, not at {image_size}"
        )
    better = f"; {_TRAINED_AT[image_size]} was trained for it" if image_size in _TRAINED_AT else ""
    _log.warning(
        "%s is for images of %d pixels and will run at %d by interpolated positions, which costs accuracy%s",
        *(path, architecture.image_size, image_size, better),
    )
    return architecture.at_size(image_size)


def _usable(device: torch.device | str) -> torch.device:
    try:
        usable = torch.device(device)
    except RuntimeError as error:
        raise ConfigError(f"device {device!r}: {error}") from error
    if usable.type == "cuda" and not torch.cuda.is_available():
        raise ConfigError(f"device {usable}: torch finds no CUDA card here; take cpu")
    return usable


def _in_float32(state: StateDict, path: Path) -> dict[str, Tensor]:
    """Contiguous and float32; tensors that are so already stay mapped."""
    others = {str(tensor.dtype).removeprefix("torch.") for tensor in state.values()} - {"float32"}
    if others:
        _log.info("%s: weights in %s are converted to float32", path, ", ".join(sorted(others)))
    return {key: tensor.detach().to(torch.float32).contiguous() for key, tensor in state.items()}
