"""Options that only one backbone has: ``--backbone-options "size=392,device=cpu"`` as a dataclass of that backbone.

The next module to read is ``registry``.
"""

from __future__ import annotations

import types
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from smust3r_colmap.errors import ConfigError

OptionsT = TypeVar("OptionsT")


@dataclass(frozen=True, kw_only=True)
class NoOptions:
    """Of a backbone all of whose settings are in the configuration."""


def parse_options(text: str, options: type[OptionsT], backbone: str) -> OptionsT:
    """The options of a backbone from the command line.

    Args:
        text: ``"a=b,c=d"``; a value may hold ``=``, but no comma.
        options: dataclass with fields of type str, int, float, bool, Path, a Literal of strings, or one of these or
            None, which an empty value gives.
        backbone: its name, for messages.

    Raises:
        ConfigError: a part is not name=value, a name is unknown or comes twice, a value is not of the field's type, or
            an option without a default is missing.
    """
    given = _split(text)
    known = {field.name: field for field in fields(options)}  # type: ignore[arg-type]  # any dataclass
    if unknown := sorted(given.keys() - known.keys()):
        takes = f"knows {', '.join(sorted(known))}" if known else "takes no options"
        raise ConfigError(f"--backbone-options {', '.join(unknown)}: the backbone {backbone} {takes}")
    missing = [
        name
        for name, field in known.items()
        if name not in given and field.default is MISSING and field.default_factory is MISSING
    ]
    if missing:
        raise ConfigError(
            f"--backbone {backbone}: needs --backbone-options {','.join(f'{name}=...' for name in missing)}"
        )
    kinds = get_type_hints(options)
    return options(**{name: _value(name, value, kinds[name]) for name, value in given.items()})


def _split(text: str) -> dict[str, str]:
    options: dict[str, str] = {}
    for part in (part.strip() for part in text.split(",") if part.strip()):
        name, equals, value = (word.strip() for word in part.partition("="))
        if not equals or not name:
            raise ConfigError(f"--backbone-options: {part!r} is not name=value (a value cannot hold a comma)")
        if name in options:
            raise ConfigError(f"--backbone-options: {name} is given twice, as {options[name]!r} and {value!r}")
        options[name] = value
    return options


_BOOLS: Mapping[str, bool] = {"true": True, "false": False}


def _value(name: str, text: str, kind: Any) -> Any:
    if get_origin(kind) in {Union, types.UnionType}:
        if not text:
            return None
        (kind,) = (one for one in get_args(kind) if one is not types.NoneType)
    if get_origin(kind) is Literal:
        if text in get_args(kind):
            return text
        needed = f"one of {', '.join(get_args(kind))}"
    elif kind is bool:
        if text in _BOOLS:
            return _BOOLS[text]
        needed = "true or false"
    else:
        assert kind in {str, int, float, Path}, f"option {name} has the type {kind}"
        try:
            return kind(text)
        except ValueError:
            needed = {int: "a whole number", float: "a number"}[kind]
    raise ConfigError(f"--backbone-options {name}={text}: needed {needed}")
