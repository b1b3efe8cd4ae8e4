"""The parts that transformer blocks are made of (specification, sections 4 and 5).

Names of modules are those of the official state dicts, so that checkpoints load without translation.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from smust3r_colmap.backbones.must3r.rope import RopeTable, rotate

NORM_EPS = 1e-6
"""Of every layer norm but the one before the feedback."""


def split_heads(tokens: Tensor, num_heads: int) -> Tensor:
    """(..., N, H * d) -> (..., H, N, d), without a copy."""
    return tokens.view(*tokens.shape[:-1], num_heads, -1).transpose(-2, -3)


def join_heads(heads: Tensor) -> Tensor:
    """(..., H, N, d) -> (..., N, H * d)."""
    return heads.transpose(-2, -3).flatten(-2)


class Mlp(nn.Module):
    """Two linear layers with the exact GELU between them."""

    def __init__(self, width: int, hidden: int) -> None:
        super().__init__()
        self.fc1 = nn.Linear(width, hidden)
        self.fc2 = nn.Linear(hidden, width)

    def forward(self, tokens: Tensor) -> Tensor:
        """(..., width) -> (..., width)."""
        hidden: Tensor = self.fc1(tokens)
        output: Tensor = self.fc2(functional.gelu(hidden))
        return output


class SelfAttention(nn.Module):
    """Tokens of one image look at each other and know where they are."""

    def __init__(self, width: int, num_heads: int) -> None:
        super().__init__()
        self.num_heads = num_heads
        self.qkv = nn.Linear(width, 3 * width)
        self.proj = nn.Linear(width, width)

    def forward(self, tokens: Tensor, table: RopeTable) -> Tensor:
        """(B, N, C) -> (B, N, C); the table is that of the N positions."""
        q, k, v = (split_heads(part, self.num_heads) for part in self.qkv(tokens).chunk(3, dim=-1))  # (B, H, N, d)
        seen = functional.scaled_dot_product_attention(rotate(q, table), rotate(k, table), v)
        output: Tensor = self.proj(join_heads(seen))
        return output


class CrossAttention(nn.Module):
    """Tokens of an image look at those of other images, which have no position."""

    def __init__(self, width: int, num_heads: int) -> None:
        super().__init__()
        self.num_heads = num_heads
        self.projq = nn.Linear(width, width)
        self.projk = nn.Linear(width, width)
        self.projv = nn.Linear(width, width)
        self.proj = nn.Linear(width, width)

    def keys_values(self, normed: Tensor) -> Tensor:
        """(..., M, D) normed tokens -> (..., M, 2 D) keys beside values."""
        return torch.cat((self.projk(normed), self.projv(normed)), dim=-1)

    def forward(self, tokens: Tensor, keys_values: Tensor) -> Tensor:
        """(..., N, D) tokens, (..., M, 2 D) keys and values -> (..., N, D). N may run over many images."""
        query = split_heads(self.projq(tokens), self.num_heads)  # (H, N, d)
        key, value = (split_heads(part, self.num_heads) for part in keys_values.chunk(2, dim=-1))  # (H, M, d)
        seen = functional.scaled_dot_product_attention(query[None], key[None], value[None])[0]
        output: Tensor = self.proj(join_heads(seen))
        return output


class EncoderBlock(nn.Module):
    """Pre-norm transformer block."""

    def __init__(self, width: int, num_heads: int, mlp_ratio: float) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(width, eps=NORM_EPS)
        self.attn = SelfAttention(width, num_heads)
        self.norm2 = nn.LayerNorm(width, eps=NORM_EPS)
        self.mlp = Mlp(width, int(mlp_ratio * width))

    def forward(self, tokens: Tensor, table: RopeTable) -> Tensor:
        """(B, N, C) -> (B, N, C)."""
        tokens = tokens + self.attn(self.norm1(tokens), table)
        output: Tensor = tokens + self.mlp(self.norm2(tokens))
        return output


class DecoderBlock(nn.Module):
    """Self-attention, a look at the memory, MLP; the three steps are taken one by one by the decoder.

    What one image may look at differs from that of its neighbours in a batch, hence the steps.
    """

    def __init__(self, width: int, num_heads: int, mlp_ratio: float) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(width, eps=NORM_EPS)
        self.attn = SelfAttention(width, num_heads)
        self.norm2 = nn.LayerNorm(width, eps=NORM_EPS)
        self.norm_y = nn.LayerNorm(width, eps=NORM_EPS)
        self.cross_attn = CrossAttention(width, num_heads)
        self.norm3 = nn.LayerNorm(width, eps=NORM_EPS)
        self.mlp = Mlp(width, int(mlp_ratio * width))

    def look_at_itself(self, tokens: Tensor, table: RopeTable) -> Tensor:
        """(B, N, D) -> (B, N, D)."""
        output: Tensor = tokens + self.attn(self.norm1(tokens), table)
        return output

    def look_at_others(self, tokens: Tensor, keys_values: Tensor) -> Tensor:
        """(..., N, D) -> (..., N, D), all against the same (M, 2 D) keys and values."""
        seen: Tensor = self.cross_attn(self.norm2(tokens).flatten(0, -2), keys_values)
        return tokens + seen.view_as(tokens)

    def think(self, tokens: Tensor) -> Tensor:
        """(..., D) -> (..., D)."""
        output: Tensor = tokens + self.mlp(self.norm3(tokens))
        return output
