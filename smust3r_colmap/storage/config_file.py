"""Settings in a TOML file.

One rule: a key is the flag with underscores (``--segment-length`` is ``segment_length``), and keys stand at the top
level, without tables. Keys that are left out keep their default. A file is turned into flags and read together with
those that were typed, so that there is one way from text to settings. The file that a run writes beside its result
can be given back with ``--config``.
"""

from __future__ import annotations

import difflib
import json
import re
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from smust3r_colmap.errors import ConfigError

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

Setting = bool | int | float | str | tuple[int, ...]


def config_to_toml(config: object) -> str:
    """Every setting of a dataclass such as ``RunConfig`` as TOML, under the first line of its group's docstring.

    What is not given has no value in TOML and stands there as a comment.
    """
    lines = ["# Every setting of this run; give the file back with --config to repeat it."]
    group = type(config)
    for slot in _slots(config):
        if slot.group is not group:
            group = slot.group
            lines += ["", f"# {(group.__doc__ or '').splitlines()[0]}"]
        lines.append(f"# {slot.key} is not given" if slot.value is None else f"{slot.key} = {_toml_value(slot.value)}")
    return "\n".join(lines) + "\n"


def read_settings(path: Path, group: type) -> dict[str, Setting]:
    """The keys of the file, each known and of the right type; whether the values go together is not looked at.

    Args:
        path: the TOML file.
        group: dataclass that has the settings, such as ``RunConfig``.

    Raises:
        ConfigError: the file cannot be read, is not TOML, has an unknown key, or a value of the wrong type.
    """
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"--config {path}: cannot read the settings ({error.strerror})") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"--config {path}: not TOML ({error})") from error
    slots = {slot.key: slot for slot in _slots(group())}
    return {key: _checked(path, key, value, slots) for key, value in table.items()}


def flags_from_settings(settings: Mapping[str, Setting]) -> list[str]:
    """The same settings as command-line flags, so that flags typed after them override them."""
    flags = []
    for key, value in settings.items():
        flag = key.replace("_", "-")
        if isinstance(value, bool):
            flags.append(f"--{flag}" if value else f"--no-{flag}")
        elif isinstance(value, tuple):
            flags.append(f"--{flag}={','.join(map(str, value))}")
        else:
            flags.append(f"--{flag}={value}")
    return flags


@dataclass(frozen=True, kw_only=True)
class _Slot:
    """One setting: its key, its type, the dataclass it belongs to, its value."""

    key: str
    type: Any
    group: type
    value: Any


def _slots(group: object) -> Iterator[_Slot]:
    """The settings of a dataclass: its own first, then those of the groups in it."""
    assert is_dataclass(group)
    hints = get_type_hints(type(group))
    values = [(field.name, getattr(group, field.name)) for field in fields(group)]
    for name, value in values:
        if not is_dataclass(value):
            yield _Slot(key=name, type=hints[name], group=type(group), value=value)
    for _, value in values:
        if is_dataclass(value):
            yield from _slots(value)


def _checked(path: Path, key: str, value: object, slots: Mapping[str, _Slot]) -> Setting:
    """The value of a known key in the type that it needs."""
    if isinstance(value, dict):
        raise ConfigError(f"--config {path}: [{key}] is a table; settings stand at the top level, without tables")
    if key not in slots:
        raise ConfigError(f"--config {path}: unknown setting {key!r}; {_way_out(key, value, slots)}")
    fitting = _fitting(value, slots[key].type)
    if fitting is None:
        raise ConfigError(f"--config {path}: {key} = {_toml_value(value)}; needed is {_spelt(slots[key].type)}")
    return fitting


def _fitting(value: object, wanted: Any) -> Setting | None:
    """The value as TOML has it in the type of the setting, or None where it is of another."""
    if get_origin(wanted) in (Union, UnionType):
        return next((found for one in get_args(wanted) if (found := _fitting(value, one)) is not None), None)
    if get_origin(wanted) is Literal:
        return value if isinstance(value, str) and value in get_args(wanted) else None
    if get_origin(wanted) is tuple:
        return tuple(value) if isinstance(value, list) and all(type(one) is int for one in value) else None
    if wanted is Path:
        return value if isinstance(value, str) else None
    if wanted is float and type(value) is int:
        return float(value)
    return value if type(value) is wanted and isinstance(value, Setting) else None


def _spelt(wanted: Any) -> str:
    """A type for people."""
    if get_origin(wanted) in (Union, UnionType):
        return " or ".join(_spelt(one) for one in get_args(wanted) if one is not NoneType)
    if get_origin(wanted) is Literal:
        return " or ".join(json.dumps(choice) for choice in get_args(wanted))
    names = {
        bool: "true or false",
        int: "a whole number",
        float: "a number",
        str: "a string",
        Path: "a path (a string)",
    }
    return names.get(wanted, "a list of whole numbers")


def _way_out(key: str, value: object, slots: Mapping[str, _Slot]) -> str:
    """What an unknown key may stand for: the flag that switches a setting off, or a slip of the fingers."""
    negated = re.fullmatch(r"no[_-](.+)", key)
    switches = [name for name, slot in slots.items() if slot.type is bool]
    if negated and (switch := difflib.get_close_matches(negated[1], switches, n=1, cutoff=0.8)):
        return f"did you mean {switch[0]} = {_toml_value(value is False)}?"
    near = difflib.get_close_matches(key, slots, n=3) or sorted(slots)
    return f"known are {', '.join(near)}"


def _toml_value(value: object) -> str:
    """Numbers, booleans, strings and lists, of which TOML's are spelt as JSON's (but for infinities)."""
    if isinstance(value, float):
        return repr(value)
    return json.dumps(value, ensure_ascii=False, default=str)
