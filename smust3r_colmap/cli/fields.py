"""How the dataclasses of commands and settings become flags and their help.

Two things differ from tyro's own rules: the help of a flag is its docstring as one paragraph, without the line breaks
of the source; and a setting that may be left out is called optional, with the type it has when it is given.
"""

from __future__ import annotations

import ast
import inspect
import textwrap
from dataclasses import MISSING, fields, is_dataclass
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import tyro
from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
    StructConstructorSpec,
    StructFieldSpec,
    StructTypeInfo,
)

REGISTRY = ConstructorRegistry()

_METAVARS = {
    str | None: "STR",
    Path | None: "PATH",
    int | None: "INT",
    float | None: "FLOAT",
    tuple[int, ...] | None: "INT,INT,...",
}


@cache
def field_docs(group: type) -> dict[str, str]:
    """The docstrings below the fields of a dataclass and of those it inherits from, each as one paragraph."""
    docs: dict[str, str] = {}
    for owner in reversed(group.__mro__):
        if is_dataclass(owner):
            (body,) = ast.parse(textwrap.dedent(inspect.getsource(owner))).body
            assert isinstance(body, ast.ClassDef)
            for field, text in zip(body.body, body.body[1:], strict=False):
                match field, text:
                    case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str() as doc)):
                        docs[name] = " ".join(doc.split())
    return docs


def _doc_of(group: type, name: str) -> str | None:
    return field_docs(group).get(name)


@REGISTRY.struct_rule
def _dataclass(info: StructTypeInfo) -> StructConstructorSpec | None:
    """Our dataclasses as tyro reads them, but for the help."""
    group = info.type
    if not (isinstance(group, type) and is_dataclass(group) and group.__module__.startswith("smust3r_colmap.")):
        return None
    hints = get_type_hints(group, include_extras=True)
    specs = []
    for field in fields(group):
        if is_dataclass(info.default) and not isinstance(info.default, type):
            default = getattr(info.default, field.name)
        elif field.default is not MISSING:
            default = field.default
        elif field.default_factory is not MISSING:
            default = field.default_factory()
        else:
            default = tyro.MISSING
        wanted: Any = hints[field.name]
        if wanted in _METAVARS:
            wanted = Annotated[wanted, tyro.conf.arg(metavar=_METAVARS[wanted], help_behavior_hint="(optional)")]
        specs.append(
            StructFieldSpec(name=field.name, type=wanted, default=default, helptext=partial(_doc_of, group, field.name))
        )
    return StructConstructorSpec(instantiate=group, fields=tuple(specs))


@REGISTRY.primitive_rule
def _whole_numbers(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[tuple[int, ...] | None] | None:
    """A list of whole numbers, given as ``2,4,8`` or as ``2 4 8``."""
    if info.type != tuple[int, ...] | None:
        return None
    return PrimitiveConstructorSpec(
        nargs="*",
        metavar="INT,INT,...",
        instance_from_str=_numbers_from_words,
        is_instance=lambda value: value is None or isinstance(value, tuple),
        str_from_instance=lambda value: ["None"] if value is None else [",".join(map(str, value))],
    )


def _numbers_from_words(words: list[str]) -> tuple[int, ...] | None:
    if words == ["None"]:
        return None
    return tuple(int(number) for word in words for number in word.split(","))
