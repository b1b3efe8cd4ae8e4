"""Where the network runs and in which number type, and the weights made ready for it.

float32 is the reference and what ``auto`` takes unless the hardware multiplies bfloat16 itself. What was
tried besides at full size with random weights, on a processor with AVX2 alone: CPU seconds of the encoder relative to
float32, and how far points end up from those of float32, in shares of their distance (median).

    bfloat16                          7.2     0.0013
    int8 linear layers, dynamic       0.65    0.0087, cameras turned by 0.7 degrees
    oneDNN's packed linear layers     1.15    0
    torch.compile                     1.00    0
    channels-last patches             0.97    0, less than the noise of the clock

So float32 runs as it is written, bfloat16 only where it is fast, and int8 not at all: it costs as much accuracy
as a careful reconstruction has.
"""

from __future__ import annotations

import platform
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple, get_args

import torch
from torch import Tensor, nn

from smust3r_colmap.backbones.must3r.network import Network
from smust3r_colmap.backbones.must3r.state_dicts import empty_parts
from smust3r_colmap.config import Device, Precision
from smust3r_colmap.errors import ConfigError

_CPU_INFO = Path("/proc/cpuinfo")
_FAST_BFLOAT16 = {"amx_bf16": "AMX", "avx512_bf16": "AVX512-BF16"}
"""Instructions that multiply bfloat16, as Linux and torch spell them; fastest first."""
_HEAD = "head_dec."
"""The head is float32 always (network specification, section 6)."""


class PrecisionChoice(NamedTuple):
    """The number type of the arithmetic, and why, for people."""

    dtype: torch.dtype
    reason: str


def choose_device(wanted: Device) -> torch.device:
    """Where the network runs; ``auto`` takes a CUDA card if there is one.

    Raises:
        ConfigError: a card is asked for and torch finds none, or the word is unknown.
    """
    if wanted not in get_args(Device):
        raise ConfigError(f"--device {wanted}: one of {', '.join(get_args(Device))}")
    if wanted == "cpu" or (wanted == "auto" and not torch.cuda.is_available()):
        return torch.device("cpu")
    if torch.cuda.is_available():
        return torch.device("cuda")
    raise ConfigError(f"--device cuda: {_why_no_card()}; take --device cpu")


def choose_precision(wanted: Precision, device: torch.device) -> PrecisionChoice:
    """float32 or bfloat16; ``auto`` takes bfloat16 where the hardware multiplies it.

    Raises:
        ConfigError: the word is unknown.
    """
    fast = _fast_bfloat16(device)
    match wanted:
        case "float32":
            return PrecisionChoice(torch.float32, "float32, as asked for")
        case "bfloat16" if fast:
            return PrecisionChoice(torch.bfloat16, f"bfloat16, as asked for; {fast}")
        case "bfloat16":
            return PrecisionChoice(
                torch.bfloat16, "bfloat16, as asked for; it is emulated here and several times slower"
            )
        case "auto" if fast:
            return PrecisionChoice(torch.bfloat16, f"bfloat16, for {fast}")
        case "auto":
            return PrecisionChoice(torch.float32, "float32, for bfloat16 would only be emulated")
    raise ConfigError(f"--precision {wanted}: one of {', '.join(get_args(Precision))}")


def describe_precision() -> tuple[str, ...]:
    """Lines for people: what the network would run on here, and in which number type."""
    devices = [torch.device("cpu"), *(torch.device("cuda", k) for k in range(torch.cuda.device_count()))]
    return tuple(f"{_name(device)}: {choose_precision('auto', device).reason}" for device in devices)


def prepare(network: Network, dtype: torch.dtype) -> Network:
    """The same network, to run in another number type.

    In bfloat16 the linear layers before the head hold their weights in it. Converting them once rather than in each
    call halves the memory they take and what has to be read of it for every image. Layer norms, embeddings
    and the head stay float32, as does everything for a float32 network, which is given back as it was.

    Args:
        network: with float32 weights. It stays usable, and shares all weights that are not converted.

    Raises:
        ValueError: the weights are not float32 and so cannot become it again.
    """
    if dtype == network.dtype:
        return network
    if any(weights.dtype != torch.float32 for weights in network.encoder.parameters()):
        raise ValueError(f"a network prepared for {network.dtype} cannot be prepared for {dtype}")
    if dtype == torch.float32:
        return replace(network, dtype=dtype)
    encoder, decoder = empty_parts(network.architecture)
    for part, source in ((encoder, network.encoder), (decoder, network.decoder)):
        part.load_state_dict(_linear_layers_in(dtype, source), assign=True)
        part.requires_grad_(False).eval()
    return replace(network, encoder=encoder, decoder=decoder, dtype=dtype)


def _linear_layers_in(dtype: torch.dtype, part: nn.Module) -> dict[str, Tensor]:
    """The state dict of an encoder or a decoder."""
    prefixes = tuple(
        f"{name}."
        for name, module in part.named_modules()
        if isinstance(module, nn.Linear) and not name.startswith(_HEAD)
    )
    return {
        key: weights.to(dtype) if key.startswith(prefixes) else weights for key, weights in part.state_dict().items()
    }


# ------------------------------------------------------------------------------------ the hardware
def _fast_bfloat16(device: torch.device) -> str:
    """What multiplies bfloat16 there, or nothing."""
    if device.type == "cuda":
        major, minor = torch.cuda.get_device_capability(device)
        return f"{_name(device)} has compute capability {major}.{minor}" if major >= 8 else ""  # Ampere and later
    flags = _processor_flags()
    return next((f"this processor has {name}" for flag, name in _FAST_BFLOAT16.items() if flag in flags), "")


def _processor_flags() -> frozenset[str]:
    """Names of the instruction sets of this processor, from torch where it tells, else from Linux."""
    capabilities = getattr(torch.cpu, "get_capabilities", None)  # newer torch alone
    if capabilities is not None:
        return frozenset(name for name, present in capabilities().items() if present is True)
    try:
        lines = _CPU_INFO.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:  # not Linux: nothing is known to be fast
        return frozenset()
    return frozenset(next((line.partition(":")[2] for line in lines if line.startswith("flags")), "").split())


def _name(device: torch.device) -> str:
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    return f"this processor ({platform.machine()}, {torch.backends.cpu.get_cpu_capability()})"


def _why_no_card() -> str:
    if torch.version.cuda is None:
        return f"torch {torch.__version__} was built without CUDA"
    try:
        torch.cuda.current_device()
    except RuntimeError as error:
        return f"torch says: {str(error).splitlines()[0]}"
    return "torch finds no card"
