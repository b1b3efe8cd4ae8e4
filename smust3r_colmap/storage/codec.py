"""How a product lies on disk: one way for every dataclass of ``products`` and of the stages.

Numbers, text and nested dataclasses go into ``NAME.json``, arrays into ``NAME.safetensors`` under the path of their
field. What is read is checked by the dataclass itself, which refuses what does not fit. The next module to read is
``run_directory``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Generic, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
import numpy.typing as npt

from smust3r_colmap.geometry.groups import GROUPS
from smust3r_colmap.geometry.transform import Transform
from smust3r_colmap.storage.run_directory import read_arrays, read_json, write_arrays, write_json

T = TypeVar("T")
Arrays = dict[str, npt.NDArray[Any]]

_GROUP_NAMES = {group: name for name, group in GROUPS.items()}


class Codec(Generic[T]):
    """Writes and reads values of one type.

    Args:
        kind: a dataclass, a tuple or mapping of such, or anything else that is made of numbers, text, paths, arrays
            and transforms of space.
        name: of the files, without suffix.
    """

    def __init__(self, kind: Any, name: str) -> None:
        self._kind = kind
        self._name = name

    def is_in(self, folder: Path) -> bool:
        """Whether a value was written into ``folder``."""
        return (folder / f"{self._name}.json").is_file()

    def write(self, folder: Path, value: T) -> None:
        """Write ``value`` into an existing folder."""
        arrays: Arrays = {}
        write_json(folder / f"{self._name}.json", _plain(value, "", arrays))
        if arrays:
            write_arrays(folder / f"{self._name}.safetensors", arrays)

    def read(self, folder: Path) -> T:
        """What ``write`` wrote, to the last bit.

        Raises:
            StorageError: a file is missing or damaged.
        """
        arrays_file = folder / f"{self._name}.safetensors"
        arrays = read_arrays(arrays_file) if arrays_file.exists() else {}
        value: T = _value(self._kind, read_json(folder / f"{self._name}.json"), "", arrays)
        return value


def _plain(value: Any, path: str, arrays: Arrays) -> Any:  # noqa: PLR0911  (one for each kind of value)
    """``value`` as JSON has it; arrays are put aside under their path."""
    if isinstance(value, np.ndarray):
        arrays[path] = value
        return None
    if isinstance(value, Transform):
        return {"group": _GROUP_NAMES[type(value)], "matrix": value.matrix.tolist()}
    if is_dataclass(value) and not isinstance(value, type):
        return {one.name: _plain(getattr(value, one.name), f"{path}.{one.name}", arrays) for one in fields(value)}
    if isinstance(value, Mapping):
        return {str(key): _plain(item, f"{path}.{key}", arrays) for key, item in value.items()}
    if isinstance(value, (tuple, list)):
        return [_plain(item, f"{path}.{k}", arrays) for k, item in enumerate(value)]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)  # JSON has neither NaN nor infinity
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"{path or 'the value'}: {type(value).__name__} has no place in a stored product")


def _value(kind: Any, facts: Any, path: str, arrays: Arrays) -> Any:  # noqa: PLR0911  (one for each kind)
    """The inverse of ``_plain``, by the type that is expected at this path."""
    origin = get_origin(kind)
    if origin is np.ndarray:
        return arrays[path]
    if origin in (Union, UnionType):
        (one,) = (option for option in get_args(kind) if option is not NoneType)
        absent = facts is None and path not in arrays
        return None if absent else _value(one, facts, path, arrays)
    if origin is Literal:
        return facts
    if origin is tuple:
        return _tuple(get_args(kind), facts, path, arrays)
    if origin in (dict, Mapping):
        key_kind, item_kind = get_args(kind)
        return {key_kind(key): _value(item_kind, item, f"{path}.{key}", arrays) for key, item in facts.items()}
    if isinstance(kind, type) and issubclass(kind, Transform):
        return GROUPS[facts["group"]].from_matrix(facts["matrix"])
    if isinstance(kind, type) and is_dataclass(kind):
        hints = _hints(kind)
        return kind(**{name: _value(hints[name], item, f"{path}.{name}", arrays) for name, item in facts.items()})
    return kind(facts)


def _tuple(kinds: tuple[Any, ...], facts: Any, path: str, arrays: Arrays) -> tuple[Any, ...]:
    if kinds[-1] is Ellipsis:
        kinds = (kinds[0],) * len(facts)
    return tuple(
        _value(kind, item, f"{path}.{k}", arrays) for k, (kind, item) in enumerate(zip(kinds, facts, strict=True))
    )


@cache
def _hints(kind: type) -> dict[str, Any]:
    return get_type_hints(kind)
