"""The two strings by which a checkpoint names its network: parsed, and never evaluated.

An official file says ``CausalMUSt3R(img_size=(512, 512), feedback_type='single_mlp', ...)``: a Python call of a class
that is not here. Its arguments are read as literals; what is neither a literal nor one of a few known names is refused.
Source: network specification, section 2.2.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Mapping
from typing import Any, TypeVar

from smust3r_colmap.backbones.must3r.architecture import (
    CHANNELS,
    Architecture,
    DecoderArchitecture,
    EncoderArchitecture,
    FeedbackKind,
    MemoryMode,
    PointActivation,
    Rope,
)
from smust3r_colmap.backbones.must3r.blocks import NORM_EPS

_MAX_CHARACTERS = 4000
"""Official strings have about 250, and the parser of Python may crash on very deep nesting."""

_BOTH = {"img_size", "patch_size", "embed_dim", "depth", "num_heads", "mlp_ratio", "norm_layer", "pos_embed"}
_ENCODER_KEYWORDS = _BOTH | {"patch_embed"}
_DECODER_KEYWORDS = _BOTH | {
    *("enc_embed_dim", "output_dim", "act_layer", "head", "feedback_type", "memory_mode", "pointmaps_activation")
}
_TRAINING_KEYWORDS = {
    *("protected_imgs", "mem_dropout", "dropout_mode", "use_xformers_mask", "use_mem_mask", "landscape_only"),
    "block_type",
}
"""Without a meaning for inference."""

_FEEDBACKS: Mapping[str, FeedbackKind] = {
    "None": "none",
    "single_mlp": "single_mlp",
    "single_linear": "single_linear",
}
_MEMORY_MODES: Mapping[str, MemoryMode] = {"norm_y": "norm_y", "kv": "kv", "raw": "raw"}
_ACTIVATIONS: Mapping[str, PointActivation] = {"NORM_EXP": "norm_exp", "LINEAR": "linear"}
_PATCH_EMBEDS = {name: name for name in ("PatchEmbedDust3R", "ManyAR_PatchEmbed")}
"""Both have the same two tensors and give the same tokens."""

_ROPE = re.compile(r"RoPE(?P<base>\d{1,6}(?:\.\d{1,6})?)(?:_(?P<trained>\d{1,5}):(?P<size>\d{1,5}))?", re.ASCII)
_NAME = re.compile(r"\w+(\.\w+)*", re.ASCII)
_LAYER_NORM = re.compile(rf"(functools\.)?partial\((\w+\.)*LayerNorm, eps={NORM_EPS!r}\)", re.ASCII)

_Choice = TypeVar("_Choice")


def architecture_from_strings(encoder: str, decoder: str) -> Architecture:
    """The network that two constructor strings describe, at the image size that they name.

    Args:
        encoder, decoder: as ``args.encoder`` and ``args.decoder`` of a checkpoint hold them.

    Raises:
        ValueError: what stands in a string is unknown, or contradicts itself or the other string.
    """
    return Architecture(encoder=_encoder(_encoder_call(encoder)), decoder=_decoder(_decoder_call(decoder)))


def image_size_is_named(encoder: str, decoder: str) -> bool:
    """Whether both strings say for what image size they are, as the same pair of equal numbers.

    The size plays no part in what the network computes, but without it nobody knows how to run the network at
    another one.
    """
    calls = (_encoder_call(encoder), _decoder_call(decoder))
    sides = {side for call in calls for side in call.image_sides()}
    return all("img_size" in call.values for call in calls) and len(sides) == 1


class _Call:
    """A call ``CLASS(keyword=value, ...)`` as it is written; not made.

    Args:
        part: encoder or decoder, for messages.
        classes: the names that the class may have.
        keywords: those that are read here.

    Attributes:
        values: by keyword; a name such as ``ActivationType.LINEAR`` is a string.

    Raises:
        ValueError: it is something else.
    """

    def __init__(self, *, part: str, text: str, classes: tuple[str, ...], keywords: set[str]) -> None:
        self._part, self._text = part, text if len(text) <= 100 else f"{text[:97]}..."
        call = self._parsed(text)
        if not isinstance(call, ast.Call) or not isinstance(call.func, ast.Name):
            raise ValueError(f"the {part} string {self._text!r} is not a call of {' or '.join(classes)}")
        if call.func.id not in classes:
            raise ValueError(f"the {part} is a {call.func.id}, and only {' or '.join(classes)} is built here")
        if call.args or any(keyword.arg is None for keyword in call.keywords):
            raise ValueError(f"the {part} string {self._text!r} has arguments without a keyword")
        self.values = {str(keyword.arg): self._value(str(keyword.arg), keyword.value) for keyword in call.keywords}
        if len(self.values) < len(call.keywords):
            raise ValueError(f"the {part} string {self._text!r} gives a keyword twice")
        for keyword in sorted(self.values.keys() - keywords - _TRAINING_KEYWORDS):
            raise self.error(keyword, "unknown to this version")

    def _parsed(self, text: str) -> ast.expr:
        if len(text) > _MAX_CHARACTERS:
            raise ValueError(f"the {self._part} string has {len(text)} characters; {_MAX_CHARACTERS} at most are read")
        try:
            return ast.parse(text.strip(), mode="eval").body
        except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
            raise ValueError(f"the {self._part} string {self._text!r} cannot be read: {error}") from error

    def _value(self, keyword: str, node: ast.expr) -> Any:
        try:
            value = ast.literal_eval(node)
        except (ValueError, TypeError, RecursionError, MemoryError):
            name = ast.unparse(node)
            if not _NAME.fullmatch(name) and not _LAYER_NORM.fullmatch(name):
                raise self.error(keyword, f"{name[:100]!r} is neither a literal nor a known name") from None
            return name
        return tuple(value) if isinstance(value, list) else value

    def number(self, keyword: str, default: int) -> int:
        """A positive whole number."""
        value = self.values.get(keyword, default)
        if type(value) is not int or value < 1:
            raise self.error(keyword, f"{value!r} is not a positive whole number")
        return value

    def ratio(self, keyword: str, default: float) -> float:
        """A positive number."""
        value = self.values.get(keyword, default)
        if isinstance(value, bool) or not isinstance(value, int | float) or not value > 0:
            raise self.error(keyword, f"{value!r} is not a positive number")
        return value

    def choice(self, keyword: str, meanings: Mapping[str, _Choice]) -> _Choice:
        """What one of some names means, the first by default; ``Kind.NAME`` counts as the name ``NAME``."""
        value = str(self.values.get(keyword, next(iter(meanings))))
        name = value.rpartition(".")[2]
        if name not in meanings:
            raise self.error(keyword, f"{value} is not known, only {', '.join(meanings)}")
        return meanings[name]

    def image_sides(self) -> tuple[int, int]:
        """Height and width in pixels."""
        match self.values.get("img_size", (224, 224)):
            case (int() as height, int() as width) if height > 0 and width > 0:
                return height, width
            case other:
                raise self.error("img_size", f"{other!r} is not a pair of numbers, such as (512, 512)")

    def rope(self) -> Rope:
        """Of ``RoPE<base>`` or ``RoPE<base>_<trained size>:<size>``; the size without a suffix is ``img_size``."""
        name = self.values.get("pos_embed", "RoPE100")
        parts = _ROPE.fullmatch(name) if isinstance(name, str) else None
        if parts is None or float(parts["base"]) <= 1:
            raise self.error("pos_embed", f"{name!r} is not RoPE<base>, nor RoPE<base>_<trained size>:<size>")
        image_size = max(self.image_sides())
        trained, size = (image_size if parts[key] is None else int(parts[key]) for key in ("trained", "size"))
        if not trained or not size or ("img_size" in self.values and size != image_size):
            raise self.error("pos_embed", f"{name!r} does not fit img_size {image_size}")
        return Rope(base=float(parts["base"]), trained_size=trained, size=size)

    def check_norm(self) -> None:
        """LayerNorm, which is also the default."""
        value = self.values.get("norm_layer")
        if value is not None and not (isinstance(value, str) and _LAYER_NORM.fullmatch(value)):
            raise self.error("norm_layer", f"only a LayerNorm with eps={NORM_EPS:g} is built here")

    def error(self, keyword: str, what: str) -> ValueError:
        """To be raised, with the string in it."""
        return ValueError(f"{keyword} of the {self._part}: {what} (in {self._text!r})")


def _encoder_call(text: str) -> _Call:
    return _Call(part="encoder", text=text, classes=("Dust3rEncoder",), keywords=_ENCODER_KEYWORDS)


def _decoder_call(text: str) -> _Call:
    # One network; the second class is the one that is trained.
    return _Call(part="decoder", text=text, classes=("MUSt3R", "CausalMUSt3R"), keywords=_DECODER_KEYWORDS)


def _encoder(call: _Call) -> EncoderArchitecture:
    call.choice("patch_embed", _PATCH_EMBEDS)
    call.check_norm()
    return EncoderArchitecture(
        patch_size=call.number("patch_size", 16),
        width=call.number("embed_dim", 1024),
        depth=call.number("depth", 24),
        num_heads=call.number("num_heads", 16),
        mlp_ratio=call.ratio("mlp_ratio", 4),
        rope=call.rope(),
    )


def _decoder(call: _Call) -> DecoderArchitecture:
    call.choice("head", {"Linear": None})
    call.choice("act_layer", {"None": None, "GELU": None})
    call.check_norm()
    patch_size = call.number("patch_size", 16)
    given, needed = call.number("output_dim", CHANNELS * 16**2), CHANNELS * patch_size**2
    if given != needed:
        raise call.error("output_dim", f"{given}, but {CHANNELS} numbers per pixel of a patch make {needed}")
    return DecoderArchitecture(
        patch_size=patch_size,
        encoder_width=call.number("enc_embed_dim", 1024),
        width=call.number("embed_dim", 768),
        depth=call.number("depth", 12),
        num_heads=call.number("num_heads", 12),
        mlp_ratio=call.ratio("mlp_ratio", 4),
        rope=call.rope(),
        feedback=call.choice("feedback_type", _FEEDBACKS),
        memory_mode=call.choice("memory_mode", _MEMORY_MODES),
        activation=call.choice("pointmaps_activation", _ACTIVATIONS),
    )
