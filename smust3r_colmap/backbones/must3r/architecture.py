"""What a MUSt3R network is built of, as values; ``constructor_strings`` reads them from a checkpoint.

Source: network specification, sections 2.2 and 4 to 7.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

MemoryMode = Literal["kv", "norm_y", "raw"]
FeedbackKind = Literal["single_mlp", "single_linear", "none"]
PointActivation = Literal["norm_exp", "linear"]

CHANNELS = 7
"""Of the head per pixel: point in the world, point in the camera, confidence."""


@dataclass(frozen=True, kw_only=True)
class Rope:
    """Rotary position embedding.

    Args:
        base: of the geometric series of frequencies; the number in the name ``RoPE100``.
        trained_size, size: longer sides of the images that the positions were trained with and run with;
            the frequencies are multiplied by their ratio.
    """

    base: float = 100.0
    trained_size: int
    size: int

    @property
    def frequency_factor(self) -> float:
        """F0 of the specification, section 4.1."""
        return self.trained_size / self.size


@dataclass(frozen=True, kw_only=True)
class EncoderArchitecture:
    """A vision transformer on patches, one image at a time."""

    patch_size: int = 16
    width: int = 1024
    depth: int = 24
    num_heads: int = 16
    mlp_ratio: float = 4
    rope: Rope


@dataclass(frozen=True, kw_only=True)
class DecoderArchitecture:
    """A transformer whose blocks also look at a memory of other images."""

    patch_size: int = 16
    encoder_width: int = 1024
    width: int = 768
    depth: int = 12
    num_heads: int = 12
    mlp_ratio: float = 4
    rope: Rope
    feedback: FeedbackKind = "none"
    memory_mode: MemoryMode = "norm_y"
    activation: PointActivation = "norm_exp"


@dataclass(frozen=True, kw_only=True)
class Architecture:
    """Encoder and decoder, and the image size they run at.

    Raises:
        ValueError: the two do not fit together.
    """

    encoder: EncoderArchitecture
    decoder: DecoderArchitecture

    def __post_init__(self) -> None:
        if self.encoder.width != self.decoder.encoder_width:
            raise ValueError(
                f"the encoder gives {self.encoder.width} numbers per patch, the decoder takes "
                f"{self.decoder.encoder_width}"
            )
        if self.encoder.patch_size != self.decoder.patch_size:
            raise ValueError(f"patches of {self.encoder.patch_size} and of {self.decoder.patch_size} pixels")
        for part in (self.encoder, self.decoder):
            if part.width % (4 * part.num_heads):
                raise ValueError(f"width {part.width} over {part.num_heads} heads is not a multiple of 4 per head")

    @property
    def image_size(self) -> int:
        """Longer side of the images, in pixels."""
        return self.encoder.rope.size

    def at_size(self, size: int) -> Architecture:
        """The same weights run at another image size, positions interpolated (section 2.2)."""
        return replace(
            self,
            encoder=replace(self.encoder, rope=replace(self.encoder.rope, size=size)),
            decoder=replace(self.decoder, rope=replace(self.decoder.rope, size=size)),
        )
