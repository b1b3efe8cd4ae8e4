"""The encoder: every image alone, patches to features (specification, section 4)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

import torch
from torch import Tensor, nn

from smust3r_colmap.backbones.must3r.architecture import EncoderArchitecture
from smust3r_colmap.backbones.must3r.blocks import NORM_EPS, EncoderBlock
from smust3r_colmap.backbones.must3r.rope import grid_positions, rope_table


@dataclass(frozen=True, kw_only=True, eq=False)
class EncodedImage:
    """Features of one image.

    Args:
        features: (rows * columns, C), row by row.
        rows, columns: of the grid of patches.
    """

    features: Tensor
    rows: int
    columns: int

    def __post_init__(self) -> None:
        if self.features.ndim != 2 or len(self.features) != self.rows * self.columns:
            raise ValueError(f"features {tuple(self.features.shape)} for {self.rows} x {self.columns} patches")

    @property
    def grid(self) -> tuple[int, int]:
        """Rows and columns of patches."""
        return self.rows, self.columns

    @property
    def positions(self) -> Tensor:
        """(N, 2) int64 row and column of every patch."""
        return grid_positions(self.rows, self.columns, self.features.device)


class PatchEmbed(nn.Module):
    """Every patch to one vector. Portrait images go in as they are (section 4.2)."""

    def __init__(self, patch_size: int, width: int) -> None:
        super().__init__()
        self.proj = nn.Conv2d(3, width, kernel_size=patch_size, stride=patch_size)

    def forward(self, images: Tensor) -> Tensor:
        """(B, 3, H, W) -> (B, N, C)."""
        patches: Tensor = self.proj(images)  # (B, C, rows, columns)
        return patches.flatten(2).transpose(1, 2)


class Encoder(nn.Module):
    """A vision transformer without class token; positions enter by rotation alone."""

    def __init__(self, architecture: EncoderArchitecture) -> None:
        super().__init__()
        a = self.architecture = architecture
        self.patch_embed = PatchEmbed(a.patch_size, a.width)
        self.blocks_enc = nn.ModuleList(EncoderBlock(a.width, a.num_heads, a.mlp_ratio) for _ in range(a.depth))
        self.norm_enc = nn.LayerNorm(a.width, eps=NORM_EPS)

    def forward(self, images: Tensor) -> Tensor:
        """(B, 3, H, W) in [-1, 1], sides multiples of the patch -> (B, N, C)."""
        a = self.architecture
        rows, columns = (side // a.patch_size for side in images.shape[-2:])
        table = rope_table(grid_positions(rows, columns, images.device), a.width // a.num_heads, a.rope)
        tokens = self.patch_embed(images).float()  # so is the sum of the blocks: bfloat16 would double its error
        for block in self.blocks_enc:
            tokens = block(tokens, table)
        features: Tensor = self.norm_enc(tokens)
        return features

    def encode(self, images: Sequence[Tensor], *, batch_size: int) -> tuple[EncodedImage, ...]:
        """Features of (3, H, W) images; neighbours of one shape go together, ``batch_size`` at most.

        Raises:
            ValueError: a shape that is not (3, H, W) with sides that are multiples of the patch.
        """
        patch = self.architecture.patch_size
        for number, image in enumerate(images):
            if image.ndim != 3 or image.shape[0] != 3 or any(side % patch or not side for side in image.shape[1:]):
                raise ValueError(f"image {number}: {tuple(image.shape)}, needed (3, H, W), multiples of {patch}")
        encoded: list[EncodedImage] = []
        for shape, run in groupby(images, key=lambda image: image.shape):
            same_shape = list(run)
            for start in range(0, len(same_shape), batch_size):
                for features in self(torch.stack(same_shape[start : start + batch_size])):
                    encoded.append(EncodedImage(features=features, rows=shape[1] // patch, columns=shape[2] // patch))
        return tuple(encoded)
