"""Settings in a TOML file.

One rule: a key is the flag with underscores (``--segment-length`` is ``segment_length``), and keys
stand at the top level, without tables. Keys that are left out keep their default. The file that a
run writes beside its result has every key and can be given back with ``--config``.
"""

from __future__ import annotations

import difflib
import json
import re
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from smust3r_colmap.config import RunConfig
from smust3r_colmap.errors import ConfigError

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

Setting = bool | int | float | str
_Group = TypeVar("_Group")


def config_from_toml(path: Path) -> RunConfig:
    """The defaults, overridden by the file.

    Raises:
        ConfigError: the file cannot be read, is not TOML, has an unknown key, or a value of the
            wrong type or out of range.
    """
    settings = read_settings(path)
    try:
        return _filled(RunConfig, settings)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error


def config_to_toml(config: RunConfig) -> str:
    """Every setting as TOML, under the name of its group; read back by ``config_from_toml``."""
    lines = ["# Every setting of this run; give the file back with --config to repeat it."]
    group = RunConfig
    for slot in _slots(config):
        if slot.group is not group:
            group = slot.group
            lines += ["", f"# {(group.__doc__ or '').splitlines()[0]}"]
        lines.append(f"{slot.key} = {_toml_value(slot.value)}")
    return "\n".join(lines) + "\n"


def read_settings(path: Path) -> dict[str, Setting]:
    """The keys of the file, each known and of the right type; the values may still contradict each other.

    Raises:
        ConfigError: as ``config_from_toml``, but for values out of range.
    """
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot read the settings ({error.strerror})") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: not TOML ({error})") from error
    slots = {slot.key: slot for slot in _slots(RunConfig())}
    return {key: _checked(path, key, value, slots) for key, value in table.items()}


def flags_from_settings(settings: Mapping[str, Setting]) -> list[str]:
    """The same settings as command-line flags, so that flags typed after them override them."""
    flags = []
    for key, value in settings.items():
        flag = key.replace("_", "-")
        if isinstance(value, bool):
            flags.append(f"--{flag}" if value else f"--no-{flag}")
        else:
            flags.append(f"--{flag}={value}")
    return flags


@dataclass(frozen=True, kw_only=True)
class _Slot:
    """One setting: its key, its type, the dataclass it belongs to, its value."""

    key: str
    type: Any
    group: type
    value: Setting


def _slots(group: Any) -> Iterator[_Slot]:
    """The settings of a dataclass: its own first, then those of the groups in it."""
    hints = get_type_hints(type(group))
    values = [(field.name, getattr(group, field.name)) for field in fields(group)]
    for name, value in values:
        if not is_dataclass(value):
            yield _Slot(key=name, type=hints[name], group=type(group), value=value)
    for _, value in values:
        if is_dataclass(value):
            yield from _slots(value)


def _filled(group: type[_Group], settings: Mapping[str, Setting]) -> _Group:
    """A dataclass of settings, and the groups in it, from the flat settings."""
    arguments: dict[str, Any] = {}
    for name, wanted in get_type_hints(group).items():
        if is_dataclass(wanted):
            assert isinstance(wanted, type)
            arguments[name] = _filled(wanted, settings)
        elif name in settings:
            arguments[name] = settings[name]
    return group(**arguments)


def _checked(path: Path, key: str, value: object, slots: Mapping[str, _Slot]) -> Setting:
    """The value of a known key in the type that it needs."""
    if isinstance(value, dict):
        raise ConfigError(f"{path}: [{key}] is a table; settings stand at the top level, without tables")
    if key not in slots:
        raise ConfigError(f"{path}: unknown setting {key!r}; {_way_out(key, value, slots)}")
    wanted = slots[key].type
    if get_origin(wanted) is Literal:
        if value not in get_args(wanted):
            choices = ", ".join(repr(choice) for choice in get_args(wanted))
            raise ConfigError(f"{path}: {key} = {value!r}; choose one of {choices}")
    elif wanted is float and type(value) is int:
        return float(value)
    elif type(value) is not wanted:
        raise ConfigError(f"{path}: {key} = {value!r} is a {type(value).__name__}; needed is a {wanted.__name__}")
    assert isinstance(value, Setting)
    return value


def _way_out(key: str, value: object, slots: Mapping[str, _Slot]) -> str:
    """What an unknown key may stand for: the flag that switches a setting off, or a slip of the fingers."""
    negated = re.fullmatch(r"no[_-](.+)", key)
    switches = [name for name, slot in slots.items() if slot.type is bool]
    if negated and (switch := difflib.get_close_matches(negated[1], switches, n=1, cutoff=0.8)):
        return f"did you mean {switch[0]} = {_toml_value(value is False)}?"
    near = difflib.get_close_matches(key, slots, n=3) or sorted(slots)
    return f"known are {', '.join(near)}"


def _toml_value(value: Setting) -> str:
    """Numbers, booleans and strings, of which TOML's are spelt as JSON's (but for infinities)."""
    if isinstance(value, float):
        return repr(value)
    return json.dumps(value, ensure_ascii=False)
