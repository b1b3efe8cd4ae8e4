"""From tokens to pixels: the linear head and the activation (specification, sections 6 and 7)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import get_args

import torch
from torch import Tensor, nn

from smust3r_colmap.backbones.must3r.architecture import CHANNELS, PointActivation

_SMALLEST_NORM = 1e-8


class LinearHead(nn.Module):
    """One linear layer that gives every pixel of a patch its seven numbers, in float32 always."""

    def __init__(self, width: int, patch_size: int) -> None:
        super().__init__()
        self.patch_size = patch_size
        self.proj = nn.Linear(width, CHANNELS * patch_size**2)

    def forward(self, tokens: Tensor, rows: int, columns: int) -> Tensor:
        """(B, rows * columns, D) -> (B, H, W, 7)."""
        p = self.patch_size
        with torch.autocast(tokens.device.type, enabled=False):
            values: Tensor = self.proj(tokens.float())
        grid = values.view(-1, rows, columns, CHANNELS, p, p)  # output index = channel, row, column in the patch
        return grid.permute(0, 1, 4, 2, 5, 3).reshape(-1, rows * p, columns * p, CHANNELS)


@dataclass(frozen=True, kw_only=True, eq=False)
class Pointmaps:
    """What the network says about the pixels of an image, in its own units (metres where it was trained so).

    Args:
        points_world: (..., H, W, 3) in the camera frame of the reference image.
        points_cam: (..., H, W, 3) in the image's own camera frame: x right, y down, z forward.
        confidence: (..., H, W), more than 1.
    """

    points_world: Tensor
    points_cam: Tensor
    confidence: Tensor


def activate(raw: Tensor, activation: PointActivation = "norm_exp") -> Pointmaps:
    """(..., H, W, 7) output of the head to points and confidence.

    Raises:
        ValueError: the last axis is not that of the channels, or the activation is unknown.
    """
    if raw.shape[-1] != CHANNELS:
        raise ValueError(f"raw output {tuple(raw.shape)}; (..., H, W, {CHANNELS}) is needed")
    if activation not in get_args(PointActivation):
        raise ValueError(f"activation {activation!r}: one of {', '.join(get_args(PointActivation))}")
    return Pointmaps(
        points_world=_activate_points(raw[..., :3], activation),
        points_cam=_activate_points(raw[..., 3:6], activation),
        confidence=1 + raw[..., 6].exp(),
    )


def _activate_points(raw: Tensor, activation: PointActivation) -> Tensor:
    if activation == "linear":
        return raw
    norm = raw.norm(dim=-1, keepdim=True)
    points: Tensor = raw / norm.clamp(min=_SMALLEST_NORM) * torch.expm1(norm)
    return points
