"""Rotary position embedding in two dimensions (specification, section 4.1).

The first half of a head is turned by the row of its patch, the second half by the column. Angles are
float32 whatever the tokens are: in bfloat16 a position of 31 would be off by 0.06 rad.
"""

from __future__ import annotations

import torch
from torch import Tensor

from smust3r_colmap.backbones.must3r.architecture import Rope

RopeTable = tuple[Tensor, Tensor]


def grid_positions(rows: int, columns: int, device: torch.device | None = None) -> Tensor:
    """(rows * columns, 2) int64 (row, column) of every patch, row by row."""
    return torch.cartesian_prod(torch.arange(rows, device=device), torch.arange(columns, device=device))


def rope_table(positions: Tensor, head_width: int, rope: Rope) -> RopeTable:
    """Cosine and signed sine of every angle, for positions (..., N, 2).

    Each is (..., N, 2, 2, head_width / 4): row and column, the two numbers of a pair, the pairs.
    """
    half = head_width // 2
    exponents = torch.arange(0, half, 2, dtype=torch.float32, device=positions.device) / half
    frequencies = rope.frequency_factor / rope.base**exponents  # (head_width / 4,)
    angles = positions[..., None].float() * frequencies  # (..., N, 2, head_width / 4)
    cos, sin = angles.cos(), angles.sin()
    return torch.stack((cos, cos), dim=-2), torch.stack((-sin, sin), dim=-2)


def rotate(heads: Tensor, table: RopeTable) -> Tensor:
    """(..., H, N, d) queries or keys turned by the table of their N positions."""
    cos, sin = (values.unsqueeze(-5) for values in table)  # one for all heads
    # (..., H, N, d) -> axis (row, column), the two numbers j and j + d / 4 of a pair, j
    pairs = heads.view(*heads.shape[:-1], 2, 2, -1)
    turned = torch.addcmul(pairs * cos, pairs.flip(-2), sin)
    return turned.flatten(-3).to(heads.dtype)
