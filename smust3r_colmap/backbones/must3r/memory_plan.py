"""How many images the network can remember in the memory that is free, decided before it runs.

What a segment takes is known from the architecture and the size of the images: the tokens remembered of every
keyframe, the largest intermediate results, the weights. ``plan_memory`` gives up speed before keyframes: first the
batches are made smaller, then the remembered form (``norm_y`` takes half of what ``kv`` takes and gives the same
results, for it makes keys and values anew each time), then the keyframes. ``fewer`` is the next smaller
plan, for another attempt when memory ran out nevertheless.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import torch
from torch import nn

from smust3r_colmap.backbones.must3r.architecture import CHANNELS, Architecture, MemoryMode
from smust3r_colmap.errors import ConfigError, ReconstructionError

_MIB, _GIB = 2**20, 2**30
_FLOAT32 = 4

_SHARE_OF_FREE = 0.85
"""The rest is for everybody else: the page cache, images and maps of this program, other programs."""
_UNKNOWN_FREE = 4 * _GIB
"""Where the system does not say what is free; a machine that runs networks has at least that."""
_FIXED = 64 * _MIB
"""Packing buffers of the linear algebra, thread pools, code that is loaded at first use."""
_FRAGMENTATION = 1.3
"""The allocator keeps freed submodels that the next request does not fit into."""
_OUTPUT_COPIES = 6
"""Of the head's output of an image: as linear layer, as map, activated, and what cameras are fitted to."""
_LARGEST_BATCH_ON_CARD = 16
"""A card is busy from about ten thousand tokens on."""
_LARGEST_BATCH_REMAKING = 4
"""Images that share the keys and values made anew for them; more save less than a twentieth."""
_SHARE_KEPT = 2 / 3
"""Of the keyframes, from one attempt to the next."""

_OUT_OF_MEMORY = ("can't allocate memory", "not enough memory", "out of memory", "alloc_failed", "bad_alloc")
"""In the messages of RuntimeError from torch's allocator on Linux, on Windows, from CUDA and its libraries."""


# --------------------------------------------------------------------------------- what is needed
@dataclass(frozen=True, kw_only=True)
class MemoryModel:
    """Bytes that a network takes at its peak.

    A plan of it foresaw 0.97 to 1.31 times the growth of the process at full size, 512 x 384 pixels: three and
    nine keyframes, both forms of memory, one and four images at once.

    Args:
        architecture: of the network; its memory mode plays no part.
        tokens: patches of the largest image.
        dtype: of the arithmetic.
        weights_bytes: of weights that are yet to come into memory, such as those mapped from a file.
        remakes_memory: the strategy removes images from the memory, which copies what stays.
        shown_again: images that are shown at once against a memory that exists, 2 where there are refinements.
    """

    architecture: Architecture
    tokens: int
    dtype: torch.dtype = torch.float32
    weights_bytes: int = 0
    remakes_memory: bool = False
    shown_again: int = 1

    def memory_bytes(self, mode: MemoryMode, num_keyframes: int) -> int:
        """Of what is remembered (network specification, sections 5.1 and 14)."""
        a = self.architecture.decoder
        copies = 2.5 if self.remakes_memory else 1.0  # the old one, and the new one with room to grow
        return int(copies * num_keyframes * self.tokens * a.depth * self._remembered_token(mode))

    def _remembered_token(self, mode: MemoryMode) -> int:
        """Bytes per layer. Layer norms give float32 always; keys and values are of the arithmetic."""
        width = self.architecture.decoder.width
        return 2 * width * self.dtype.itemsize if mode == "kv" else width * _FLOAT32

    def encoding_bytes(self, batch: int) -> int:
        """Of the intermediate results of images on their way through the encoder."""
        e = self.architecture.encoder
        pixels = 2 * 3 * e.patch_size**2  # the images, and all of them in one tensor
        return int(batch * self.tokens * _FLOAT32 * (pixels + e.width * _block_widths(e.mlp_ratio)))

    def remembering_bytes(self, mode: MemoryMode, num_keyframes: int) -> int:
        """Of an update with two images: while they go through the blocks, or while what to remember is made of them."""
        d = self.architecture.decoder
        inputs = 2 * self.tokens * _FLOAT32 * d.width * d.depth  # of every block
        blocks = 2 * self.tokens * _FLOAT32 * d.width * _block_widths(d.mlp_ratio)
        joined = self.shown_again * self._keys_values(num_keyframes) if self.shown_again > 1 else 0
        stored = 2 * self.tokens * d.depth * self._remembered_token(mode)
        return int(inputs + max(blocks + joined + self._made_anew(mode, num_keyframes), stored))

    def rendering_bytes(self, mode: MemoryMode, num_keyframes: int, batch: int) -> int:
        """Of images that are predicted against the whole memory: in the blocks, or as maps afterwards."""
        d = self.architecture.decoder
        blocks = batch * self.tokens * _FLOAT32 * d.width * _block_widths(d.mlp_ratio)
        return int(max(blocks + self._made_anew(mode, num_keyframes), batch * self._output_bytes))

    def _made_anew(self, mode: MemoryMode, num_keyframes: int) -> int:
        """Keys and values of one layer that are not stored: two halves, and both beside each other."""
        return 0 if mode == "kv" else 2 * self._keys_values(num_keyframes)

    def _keys_values(self, num_keyframes: int) -> int:
        return num_keyframes * self.tokens * 2 * self.architecture.decoder.width * self.dtype.itemsize

    @property
    def _output_bytes(self) -> int:
        pixels = self.tokens * self.architecture.decoder.patch_size**2
        return _OUTPUT_COPIES * pixels * CHANNELS * _FLOAT32


def _block_widths(mlp_ratio: float) -> float:
    """Numbers per token in a block at its fullest, in widths.

    Those are the tokens before the block, after its attention, their norm and the output, and the MLP's hidden
    layer before and after its activation.
    """
    return 4 + 2 * mlp_ratio


# ------------------------------------------------------------------------------------- the plan
@dataclass(frozen=True, kw_only=True)
class MemoryPlan:
    """What a segment is run with.

    Args:
        model: what it takes.
        budget_bytes: what it may take.
        wanted_keyframes: what was asked for.
        num_keyframes: images that the network remembers.
        memory_mode: how; results do not depend on it.
        render_batch: images predicted at once; they are encoded one by one.
    """

    model: MemoryModel
    budget_bytes: int
    wanted_keyframes: int
    num_keyframes: int
    memory_mode: MemoryMode
    render_batch: int = 1

    @property
    def memory_bytes(self) -> int:
        """Of what the network remembers."""
        return self.model.memory_bytes(self.memory_mode, self.num_keyframes)

    @property
    def working_set_bytes(self) -> int:
        """All that is needed at once at the peak: weights, memory, intermediate results."""
        model, mode, keyframes = self.model, self.memory_mode, self.num_keyframes
        passing = max(
            model.encoding_bytes(1),
            model.remembering_bytes(mode, keyframes),
            model.rendering_bytes(mode, keyframes, self.render_batch),
        )
        return int(model.weights_bytes + _FIXED + self.memory_bytes + _FRAGMENTATION * passing)

    @property
    def fits(self) -> bool:
        """Needs no more than it may take."""
        return self.working_set_bytes <= self.budget_bytes

    @property
    def is_full(self) -> bool:
        """It has all the keyframes that were asked for."""
        return self.num_keyframes == self.wanted_keyframes

    @property
    def text(self) -> str:
        """One line for people."""
        number = str(self.num_keyframes) if self.is_full else f"{self.num_keyframes} of {self.wanted_keyframes}"
        noun = "keyframe" if self.wanted_keyframes == 1 else "keyframes"
        form = "" if self.memory_mode == "kv" else ", keys and values made anew each time: slower, the same result"
        return (
            f"{number} {noun} in {self.memory_bytes / _GIB:.2f} GiB ({self.memory_mode}{form}), "
            f"{self.working_set_bytes / _GIB:.2f} of {self.budget_bytes / _GIB:.2f} GiB in all, "
            f"{self.render_batch} predicted at once"
        )


def plan_memory(
    model: MemoryModel, *, num_images: int, wanted_keyframes: int, budget_bytes: int, on_card: bool = False
) -> MemoryPlan:
    """The plan with the most keyframes, and of those the fastest, that fits.

    Args:
        model: of the network and the images.
        num_images: of the longest segment.
        wanted_keyframes: that a segment should have at most, 1 or more.
        budget_bytes: that the network may take.
        on_card: it runs on a graphics card, where batches pay. On a processor they cost: the larger
            intermediate results are new pages each time (8 % for 4 images at 512 x 384).

    Raises:
        ConfigError: not even one keyframe fits.
    """
    wanted = min(wanted_keyframes, num_images)
    smallest = MemoryPlan(
        model=model, budget_bytes=budget_bytes, wanted_keyframes=wanted, num_keyframes=1, memory_mode=_leanest(model)
    )
    if not smallest.fits:
        raise ConfigError(
            f"not even one keyframe of {model.tokens} patches fits into memory: needed are "
            f"{smallest.working_set_bytes / _GIB:.2f} GiB, {budget_bytes / _GIB:.2f} may be used. Free some memory, "
            "raise --network-memory if it was given, or take a smaller --network-size"
        )
    for mode in dict.fromkeys(("kv", _leanest(model))):
        plan = replace(smallest, num_keyframes=wanted, memory_mode=mode)
        if plan.fits:
            return _with_batches(plan, min(num_images, _largest_batch(mode, on_card=on_card)))
    return replace(smallest, num_keyframes=_most_keyframes(smallest, wanted))


def fewer(plan: MemoryPlan) -> MemoryPlan:
    """The next smaller plan: one image at a time, then the leaner memory, then a third of the keyframes less.

    Raises:
        ReconstructionError: there is none.
    """
    if plan.render_batch > 1:
        return replace(plan, render_batch=1)
    if plan.memory_mode != _leanest(plan.model):
        return replace(plan, memory_mode=_leanest(plan.model))
    if plan.num_keyframes > 1:
        return replace(plan, num_keyframes=max(1, int(plan.num_keyframes * _SHARE_KEPT)))
    raise ReconstructionError(
        f"memory ran out with a single keyframe, for which {plan.working_set_bytes / _GIB:.2f} GiB were expected; free "
        "some memory or take a smaller --network-size"
    )


def is_out_of_memory(error: BaseException) -> bool:
    """The error says that memory ran out, on the card or in the machine, rather than that something is wrong."""
    if isinstance(error, MemoryError | torch.OutOfMemoryError):
        return True
    return isinstance(error, RuntimeError) and any(words in str(error).lower() for words in _OUT_OF_MEMORY)


def _leanest(model: MemoryModel) -> MemoryMode:
    """In bfloat16 keys and values are as small as the normed tokens they are made from, which stay float32."""
    return "norm_y" if model.memory_bytes("norm_y", 1) < model.memory_bytes("kv", 1) else "kv"


def _most_keyframes(smallest: MemoryPlan, wanted: int) -> int:
    """What a plan needs grows with every keyframe by the same; by bisection."""
    fits, too_many = 1, wanted
    while too_many - fits > 1:
        middle = (fits + too_many) // 2
        if replace(smallest, num_keyframes=middle).fits:
            fits = middle
        else:
            too_many = middle
    return fits


def _largest_batch(mode: MemoryMode, *, on_card: bool) -> int:
    if on_card:
        return _LARGEST_BATCH_ON_CARD
    return 1 if mode == "kv" else _LARGEST_BATCH_REMAKING


def _with_batches(plan: MemoryPlan, largest: int) -> MemoryPlan:
    """The same keyframes with the largest batches that still fit."""
    for batch in range(largest, 1, -1):
        larger = replace(plan, render_batch=batch)
        if larger.fits:
            return larger
    return plan


# ------------------------------------------------------------------------------------ what is free
def memory_budget(device: torch.device, wanted_gib: float | Literal["auto"]) -> int:
    """Bytes that the network may take: what was asked for, or most of what is free where it runs.

    Args:
        device: where the network runs; its card must be usable.
        wanted_gib: auto takes most of what is free.
    """
    if wanted_gib != "auto":
        return int(wanted_gib * _GIB)
    if device.type == "cuda":
        return int(_SHARE_OF_FREE * torch.cuda.mem_get_info(device)[0])
    return int(_SHARE_OF_FREE * free_memory())


def free_memory(root: Path = Path("/")) -> int:
    """Bytes that this process could still take: the least of what the machine, its control group and limits leave.

    Args:
        root: where ``proc`` and ``sys`` lie.
    """
    machine = _available_in_machine(root)
    free = [_UNKNOWN_FREE if machine is None else machine, *_left_by_control_groups(root), *_left_by_limit(root)]
    return max(0, min(free))


def bytes_of_weights(*parts: nn.Module) -> int:
    """Of all weights of an encoder and a decoder; on the processor they count as yet to come while mapped."""
    return sum(weights.numel() * weights.element_size() for part in parts for weights in part.parameters())


def _available_in_machine(root: Path) -> int | None:
    available = _fields(root / "proc/meminfo").get("MemAvailable:")
    if available is not None:
        return available * 1024
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2  # macOS: how much is free it does not say
    except (AttributeError, ValueError, OSError):
        return None


def _left_by_control_groups(root: Path) -> Iterator[int]:
    """Of this process's group and of every group above it, in version 2 and in version 1."""
    for line in _lines(root / "proc/self/cgroup"):
        _, controllers, group = line.split(":", 2)
        if not controllers:
            yield from _left_in(root / "sys/fs/cgroup", group, "memory.max", "memory.current", "inactive_file")
        elif "memory" in controllers.split(","):
            folder = root / "sys/fs/cgroup/memory"
            yield from _left_in(folder, group, "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")


def _left_in(mount: Path, group: str, limit: str, usage: str, reclaimable: str) -> Iterator[int]:
    """What each group from this one upwards still allows; pages of files that nobody uses now count as free."""
    folder = mount / group.strip("/")
    for place in (folder, *folder.parents):
        limit_bytes, used_bytes = _number(place / limit), _number(place / usage)
        if limit_bytes is not None and used_bytes is not None:
            yield limit_bytes - used_bytes + _fields(place / "memory.stat").get(reclaimable, 0)
        if place == mount:
            break


def _left_by_limit(root: Path) -> Iterator[int]:
    """Address space that ``ulimit -v`` leaves."""
    words = next(
        (line for line in _lines(root / "proc/self/limits") if line.startswith("Max address space")), ""
    ).split()
    pages = next(iter(_lines(root / "proc/self/statm")), "").split()
    if len(words) > 3 and words[3].isdecimal() and pages:
        yield int(words[3]) - int(pages[0]) * os.sysconf("SC_PAGE_SIZE")


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:  # another system, or a file that only some have
        return []


def _fields(path: Path) -> dict[str, int]:
    """Names and numbers of a file with one of each per line."""
    words = (line.split() for line in _lines(path))
    return {pair[0]: int(pair[1]) for pair in words if len(pair) > 1 and pair[1].isdecimal()}


def _number(path: Path) -> int | None:
    """None where there is no such file, or it says ``max``."""
    word = next(iter(_lines(path)), "").strip()
    return int(word) if word.isdecimal() else None
