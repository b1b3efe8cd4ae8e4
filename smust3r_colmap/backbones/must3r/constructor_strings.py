"""The two strings by which a checkpoint names its network: parsed, and never evaluated.

An official file says ``CausalMUSt3R(img_size=(512, 512), feedback_type='single_mlp', ...)``: a Python call of
a class that is not here. ``parse_call`` takes the syntax apart, ``architecture_from_strings`` reads the meaning.
Source: network specification, section 2.2.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeAlias, TypeVar

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

_LONGEST = 4000
"""Characters; official strings have about 250, and the parser of Python may crash on very deep nesting."""
_ENCODERS = ("Dust3rEncoder",)
_DECODERS = ("MUSt3R", "CausalMUSt3R")  # one network; the second class is the one that is trained
_ENCODER_KEYWORDS = frozenset(
    {"img_size", "patch_size", "embed_dim", "depth", "num_heads", "mlp_ratio", "norm_layer", "patch_embed", "pos_embed"}
)
_DECODER_KEYWORDS = frozenset(
    {
        "img_size",
        "enc_embed_dim",
        "patch_size",
        "embed_dim",
        "output_dim",
        "depth",
        "num_heads",
        "mlp_ratio",
        "norm_layer",
        "act_layer",
        "pos_embed",
        "head",
        "feedback_type",
        "memory_mode",
        "pointmaps_activation",
    }
)
_TRAINING_KEYWORDS = frozenset(
    {
        "protected_imgs",
        "mem_dropout",
        "dropout_mode",
        "use_xformers_mask",
        "use_mem_mask",
        "landscape_only",
        "block_type",
    }
)
_PATCH_EMBEDS = ("PatchEmbedDust3R", "ManyAR_PatchEmbed")  # the same two tensors, the same tokens
_HEADS = ("Linear",)
_FEEDBACKS: Mapping[str, FeedbackKind] = {
    "None": "none",
    "single_mlp": "single_mlp",
    "single_linear": "single_linear",
}
_MEMORY_MODES: Mapping[str, MemoryMode] = {"kv": "kv", "norm_y": "norm_y", "raw": "raw"}
_ACTIVATIONS: Mapping[str, PointActivation] = {"NORM_EXP": "norm_exp", "LINEAR": "linear"}
_DEFAULT_SIZE = 224
_ROPE = re.compile(r"RoPE(?P<base>\d{1,6}(?:\.\d{1,6})?)(?:_(?P<trained>\d{1,5}):(?P<size>\d{1,5}))?", re.ASCII)

_Choice = TypeVar("_Choice")


@dataclass(frozen=True, kw_only=True)
class Reference:
    """A dotted name, such as ``ActivationType.NORM_EXP``; not looked up."""

    name: str

    @property
    def last(self) -> str:
        """The part behind the last dot."""
        return self.name.rpartition(".")[2]

    def __str__(self) -> str:
        return self.name


@dataclass(frozen=True, kw_only=True)
class Call:
    """A call as it is written; not made.

    Args:
        name: of what is called, dotted.
        positional: arguments without a name.
        keywords: the others.
    """

    name: str
    positional: tuple[Value, ...]
    keywords: Mapping[str, Value]


Value: TypeAlias = "bool | int | float | str | tuple[Value, ...] | Reference | Call | None"


# --------------------------------------------------------------------------------- syntax
def parse_call(text: str) -> Call:
    """Take apart a call whose arguments are literals, dotted names or such calls.

    Raises:
        ValueError: it is something else.
    """
    if len(text) > _LONGEST:
        raise ValueError(f"a constructor string of {len(text)} characters; {_LONGEST} at most are read")
    try:
        tree = ast.parse(text.strip(), mode="eval").body
        value = _value(tree)
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise ValueError(f"the constructor string {_shortened(text)} cannot be read: {error}") from error
    if not isinstance(value, Call):
        raise ValueError(f"the constructor string {_shortened(text)} is not a call")
    return value


def _value(node: ast.expr) -> Value:
    match node:
        case ast.Constant(value=bool() | int() | float() | str() | None as value):
            return value
        case ast.UnaryOp(op=ast.USub(), operand=ast.Constant(value=int() | float() as value)):
            return -value
        case ast.Tuple(elts=elements) | ast.List(elts=elements):
            return tuple(_value(element) for element in elements)
        case ast.Name() | ast.Attribute():
            return Reference(name=_dotted(node))
        case ast.Call(func=function, args=positional, keywords=keywords):
            named: dict[str, Value] = {}
            for keyword in keywords:
                if keyword.arg is None or keyword.arg in named:
                    raise ValueError(f"** and keywords given twice are not read ({keyword.arg or '**'})")
                named[keyword.arg] = _value(keyword.value)
            return Call(name=_dotted(function), positional=tuple(map(_value, positional)), keywords=named)
    raise ValueError(f"{_shortened(ast.unparse(node))} is neither a literal, a name nor a call")


def _dotted(node: ast.expr) -> str:
    match node:
        case ast.Name(id=name):
            return name
        case ast.Attribute(value=owner, attr=name):
            return f"{_dotted(owner)}.{name}"
    raise ValueError(f"{_shortened(ast.unparse(node))} is not a name")


def _shortened(text: str) -> str:
    return repr(text if len(text) <= 100 else f"{text[:97]}...")


# -------------------------------------------------------------------------------- meaning
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
    sides = {side for call in calls for side in _image_sides(call)}
    return all(call.has("img_size") for call in calls) and len(sides) == 1


def _encoder_call(text: str) -> _Constructor:
    return _Constructor(part="encoder", text=text, classes=_ENCODERS, known=_ENCODER_KEYWORDS)


def _decoder_call(text: str) -> _Constructor:
    return _Constructor(part="decoder", text=text, classes=_DECODERS, known=_DECODER_KEYWORDS)


def _encoder(call: _Constructor) -> EncoderArchitecture:
    call.chosen("patch_embed", _PATCH_EMBEDS)
    _check_norm(call)
    return EncoderArchitecture(
        patch_size=call.whole("patch_size", 16),
        width=call.whole("embed_dim", 1024),
        depth=call.whole("depth", 24),
        num_heads=call.whole("num_heads", 16),
        mlp_ratio=call.ratio("mlp_ratio", 4),
        rope=_rope(call),
    )


def _decoder(call: _Constructor) -> DecoderArchitecture:
    call.chosen("head", _HEADS)
    _check_norm(call)
    _check_gelu(call)
    patch_size = call.whole("patch_size", 16)
    _check_outputs(call, patch_size)
    return DecoderArchitecture(
        patch_size=patch_size,
        encoder_width=call.whole("enc_embed_dim", 1024),
        width=call.whole("embed_dim", 768),
        depth=call.whole("depth", 12),
        num_heads=call.whole("num_heads", 12),
        mlp_ratio=call.ratio("mlp_ratio", 4),
        rope=_rope(call),
        feedback=call.translated("feedback_type", _FEEDBACKS, "None"),
        memory_mode=call.translated("memory_mode", _MEMORY_MODES, "norm_y"),
        activation=call.translated("pointmaps_activation", _ACTIVATIONS, "NORM_EXP"),
    )


def _rope(call: _Constructor) -> Rope:
    """Of ``RoPE<base>`` or ``RoPE<base>_<trained size>:<size>``; the size without a suffix is ``img_size``."""
    name = call.get("pos_embed", "RoPE100")
    parts = _ROPE.fullmatch(name) if isinstance(name, str) else None
    if parts is None or float(parts["base"]) <= 1:
        raise call.error("pos_embed", f"{name!r} is not RoPE<base>, nor RoPE<base>_<trained size>:<size>")
    image_size = max(_image_sides(call))
    if parts["size"] is None:
        return Rope(base=float(parts["base"]), trained_size=image_size, size=image_size)
    trained, size = int(parts["trained"]), int(parts["size"])
    if not trained or not size or (call.has("img_size") and size != image_size):
        raise call.error("pos_embed", f"{name!r} does not fit img_size {image_size}")
    return Rope(base=float(parts["base"]), trained_size=trained, size=size)


def _image_sides(call: _Constructor) -> tuple[int, int]:
    match call.get("img_size", (_DEFAULT_SIZE, _DEFAULT_SIZE)):
        case (int() as height, int() as width) if height > 0 and width > 0:
            return height, width
        case other:
            raise call.error("img_size", f"{other!r} is not a pair of numbers, such as (512, 512)")


def _check_norm(call: _Constructor) -> None:
    match call.get("norm_layer", None):
        case None:
            return
        case Call(name="partial" | "functools.partial", positional=(Reference(last="LayerNorm"),), keywords=keywords):
            if dict(keywords) == {"eps": NORM_EPS}:
                return
    raise call.error("norm_layer", f"only a LayerNorm with eps={NORM_EPS:g} is built here")


def _check_gelu(call: _Constructor) -> None:
    match call.get("act_layer", None):
        case None | Reference(last="GELU"):
            return
    raise call.error("act_layer", "only the exact GELU is built here")


def _check_outputs(call: _Constructor, patch_size: int) -> None:
    needed = CHANNELS * patch_size**2
    given = call.whole("output_dim", CHANNELS * 16**2)
    if given != needed:
        raise call.error("output_dim", f"{given}, but {CHANNELS} numbers per pixel of a patch make {needed}")


class _Constructor:
    """One of the two strings, and what its keywords say.

    Raises:
        ValueError: not a call of one of the classes with known keywords.
    """

    def __init__(self, *, part: str, text: str, classes: tuple[str, ...], known: frozenset[str]) -> None:
        self._part, self._text = part, text
        call = parse_call(text)
        if call.name not in classes:
            raise ValueError(f"the {part} is a {call.name}, and only {' or '.join(classes)} is built here")
        if call.positional:
            raise ValueError(f"the {part} string {_shortened(text)} has arguments without a keyword")
        for keyword in sorted(call.keywords):
            if keyword not in known | _TRAINING_KEYWORDS:
                raise self.error(keyword, "unknown to this version")
        self._keywords = call.keywords

    def has(self, keyword: str) -> bool:
        """Whether the string says it; otherwise its default holds."""
        return keyword in self._keywords

    def get(self, keyword: str, default: Value) -> Value:
        """What the string says, or the default."""
        return self._keywords.get(keyword, default)

    def whole(self, keyword: str, default: int) -> int:
        """A positive whole number."""
        value = self.get(keyword, default)
        if type(value) is not int or value < 1:
            raise self.error(keyword, f"{value!r} is not a positive whole number")
        return value

    def ratio(self, keyword: str, default: float) -> float:
        """A positive number."""
        value = self.get(keyword, default)
        if isinstance(value, bool) or not isinstance(value, int | float) or value <= 0:
            raise self.error(keyword, f"{value!r} is not a positive number")
        return value

    def chosen(self, keyword: str, choices: tuple[str, ...]) -> str:
        """One of some names, the first by default."""
        return self.translated(keyword, {choice: choice for choice in choices}, choices[0])

    def translated(self, keyword: str, meanings: Mapping[str, _Choice], default: str) -> _Choice:
        """What one of some names means; ``Kind.NAME`` counts as the name ``NAME``."""
        value = self.get(keyword, default)
        name = value.last if isinstance(value, Reference) else str(value)
        if name not in meanings:
            raise self.error(keyword, f"{value} is not known, only {', '.join(meanings)}")
        return meanings[name]

    def error(self, keyword: str, what: str) -> ValueError:
        """To be raised, with the string in it."""
        return ValueError(f"{keyword} of the {self._part}: {what} (in {_shortened(self._text)})")
