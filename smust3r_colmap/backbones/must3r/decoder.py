"""The decoder: images against a memory of the images before them (specification, section 5).

Two ways in. ``see`` is the update: the images become part of the memory. ``render`` only looks:
against a memory that stays as it is. A ``Seen`` is given back rather than a longer memory, for drivers
decide about the image by what the network saw.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

import torch
from torch import Tensor, nn

from smust3r_colmap.backbones.must3r.architecture import DecoderArchitecture
from smust3r_colmap.backbones.must3r.blocks import NORM_EPS, DecoderBlock, Mlp
from smust3r_colmap.backbones.must3r.encoder import EncodedImage
from smust3r_colmap.backbones.must3r.head import LinearHead
from smust3r_colmap.backbones.must3r.memory import Memory, RememberedImage
from smust3r_colmap.backbones.must3r.rope import RopeTable, grid_positions, rope_table

FEEDBACK_NORM_EPS = 1e-5


@dataclass(frozen=True, kw_only=True, eq=False)
class Seen:
    """An update: what to remember of each image, and what the network says of it.

    Args:
        remembered: one per image, in stored form, feedback included.
        raw: one (H, W, 7) per image, before activation; empty when no outputs were asked for.
    """

    remembered: tuple[RememberedImage, ...]
    raw: tuple[Tensor, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Batch:
    """Neighbours of one shape on their way through the blocks: tokens (B, N, D)."""

    tokens: Tensor
    rows: int
    columns: int
    table: RopeTable


class Decoder(nn.Module):
    """Blocks with a memory, the feedback into it, and the head."""

    def __init__(self, architecture: DecoderArchitecture) -> None:
        super().__init__()
        a = self.architecture = architecture
        self.feat_embed_enc_to_dec = nn.Linear(a.encoder_width, a.width)
        self.image2_embed = nn.Parameter(torch.zeros(1, 1, a.width))
        self.blocks_dec = nn.ModuleList(DecoderBlock(a.width, a.num_heads, a.mlp_ratio) for _ in range(a.depth))
        if a.feedback != "none":
            self.feedback_norm = nn.LayerNorm(a.width, eps=FEEDBACK_NORM_EPS)
            self.feedback_layer = (
                Mlp(a.width, 4 * a.width) if a.feedback == "single_mlp" else nn.Linear(a.width, a.width)
            )
        self.norm_dec = nn.LayerNorm(a.width, eps=NORM_EPS)
        self.head_dec = LinearHead(a.width, a.patch_size)

    # ---------------------------------------------------------------------- two ways in
    def see(self, images: Sequence[EncodedImage], memory: Memory | None, *, with_outputs: bool = True) -> Seen:
        """Update (section 5.2): each image looks at the memory and at the other images of this call.

        Args:
            images: at least one, in the order in which they will be labelled.
            memory: None creates one: the first image is then the reference, whose camera is the world.
            with_outputs: False leaves out the last block and the head, which the memory does not need.
        """
        batches = self._start(images, creates_memory=memory is None)
        alone_in_new_memory = memory is None and len(images) == 1
        inputs: list[list[Tensor]] = []  # of every block, by batch: what is remembered
        for number, block in enumerate(self._blocks()):
            inputs.append([batch.tokens for batch in batches])
            if number == len(self.blocks_dec) - 1 and not with_outputs:
                break
            old = None if memory is None else self._keys_values(block, memory.layers[number])
            fresh: list[Tensor] = []
            if memory is None or len(images) > 1:  # a single image never looks at its own fresh tokens
                fresh = [own for tokens in inputs[-1] for own in block.cross_attn.keys_values(block.norm_y(tokens))]
            contexts = _contexts(old, fresh, own_too=alone_in_new_memory)
            batches = self._through(block, batches, contexts)
        remembered = self._remember(inputs)
        return Seen(remembered=remembered, raw=self._finish(batches) if with_outputs else ())

    def render(self, images: Sequence[EncodedImage], memory: Memory) -> tuple[Tensor, ...]:
        """(H, W, 7) of each image against the whole memory, which stays as it is (section 5.4)."""
        batches = self._start(images, creates_memory=False)
        for number, block in enumerate(self._blocks()):
            keys_values = self._keys_values(block, memory.layers[number])
            batches = self._through(block, batches, [keys_values])
        return self._finish(batches)

    # -------------------------------------------------------------------------- the way
    def _blocks(self) -> list[DecoderBlock]:
        return [block for block in self.blocks_dec if isinstance(block, DecoderBlock)]

    def _start(self, images: Sequence[EncodedImage], *, creates_memory: bool) -> list[_Batch]:
        a = self.architecture
        batches: list[_Batch] = []
        for (rows, columns), run in groupby(images, key=lambda image: image.grid):
            features = torch.stack([image.features for image in run])
            tokens = self.feat_embed_enc_to_dec(features)  # (B, N, C) -> (B, N, D)
            marked = tokens + self.image2_embed
            if creates_memory and not batches:
                marked = torch.cat((tokens[:1].to(marked.dtype), marked[1:]))  # the reference goes unmarked
            positions = grid_positions(rows, columns, features.device)
            table = rope_table(positions, a.width // a.num_heads, a.rope)
            batches.append(_Batch(tokens=marked, rows=rows, columns=columns, table=table))
        return batches

    def _through(self, block: DecoderBlock, batches: Sequence[_Batch], contexts: Sequence[Tensor]) -> list[_Batch]:
        """One block. ``contexts``: keys and values for every image in order, or one for all of them."""
        done, first = [], 0
        for batch in batches:
            tokens = block.look_at_itself(batch.tokens, batch.table)
            if len(contexts) == 1:
                tokens = block.look_at_others(tokens, contexts[0])
            else:
                own = contexts[first : first + len(tokens)]
                tokens = torch.stack([block.look_at_others(*pair) for pair in zip(tokens, own, strict=True)])
            first += len(tokens)
            tokens = block.think(tokens)
            done.append(_Batch(tokens=tokens, rows=batch.rows, columns=batch.columns, table=batch.table))
        return done

    def _finish(self, batches: Sequence[_Batch]) -> tuple[Tensor, ...]:
        return tuple(
            raw for batch in batches for raw in self.head_dec(self.norm_dec(batch.tokens), batch.rows, batch.columns)
        )

    # ----------------------------------------------------------------------- the memory
    def _remember(self, inputs: Sequence[Sequence[Tensor]]) -> tuple[RememberedImage, ...]:
        """Inputs of all blocks, corrected by the feedback of the last one, in stored form (section 5.3)."""
        by_layer: list[list[Tensor]] = []
        last = len(inputs) - 1
        offsets = [self._feedback(tokens) for tokens in inputs[last]]
        for number, (block, batches) in enumerate(zip(self._blocks(), inputs, strict=True)):
            corrected = batches if number == last else [b + o for b, o in zip(batches, offsets, strict=True)]
            by_layer.append([tokens for batch in corrected for tokens in self._stored(block, batch)])
        return tuple(zip(*by_layer, strict=True))

    def _feedback(self, tokens: Tensor) -> Tensor | float:
        if self.architecture.feedback == "none":
            return 0.0
        offset: Tensor = self.feedback_layer(self.feedback_norm(tokens))
        return offset

    def _stored(self, block: DecoderBlock, tokens: Tensor) -> Tensor:
        """(..., D) raw tokens in the form that the memory holds (section 5.1)."""
        match self.architecture.memory_mode:
            case "raw":
                return tokens
            case "norm_y":
                normed: Tensor = block.norm_y(tokens)
                return normed
            case "kv":
                return block.cross_attn.keys_values(block.norm_y(tokens))

    def _keys_values(self, block: DecoderBlock, stored: Tensor) -> Tensor:
        """(M, width) of the memory -> (M, 2 D)."""
        match self.architecture.memory_mode:
            case "raw":
                return block.cross_attn.keys_values(block.norm_y(stored))
            case "norm_y":
                return block.cross_attn.keys_values(stored)
            case "kv":
                return stored


def _contexts(old: Tensor | None, fresh: Sequence[Tensor], *, own_too: bool) -> list[Tensor]:
    """What each image of an update may look at: the memory and the others, never itself."""
    if own_too:
        return list(fresh)
    if not fresh:
        assert old is not None, "an image without memory and without company"
        return [old]
    before = [] if old is None else [old]
    return [torch.cat([*before, *(other for j, other in enumerate(fresh) if j != i)]) for i in range(len(fresh))]
