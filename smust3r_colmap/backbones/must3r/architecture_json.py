"""An architecture as JSON and back, for the header of our own weight files."""

from __future__ import annotations

import json
from dataclasses import asdict, fields, is_dataclass
from typing import Any, get_args, get_type_hints

from smust3r_colmap.backbones.must3r.architecture import Architecture


def architecture_to_json(architecture: Architecture) -> str:
    """Every field by its name."""
    return json.dumps(asdict(architecture))


def architecture_from_json(text: str) -> Architecture:
    """What ``architecture_to_json`` wrote.

    Raises:
        ValueError: not JSON, a field that is missing or unknown, or one with a value that it cannot have.
    """
    try:
        facts = json.loads(text)
    except RecursionError as error:
        raise ValueError("architecture: nested too deeply") from error
    architecture: Architecture = _read(Architecture, facts, "architecture")
    return architecture


def _read(kind: Any, facts: object, name: str) -> Any:
    """A value of the type of a field: a dataclass, one of some names, or a positive number."""
    if is_dataclass(kind):
        return _read_fields(kind, facts, name)
    if get_args(kind):
        fits = facts in get_args(kind)
    else:
        fits = isinstance(facts, int | kind) and not isinstance(facts, bool) and 0 < facts < float("inf")
    if not fits:
        raise ValueError(f"{name} is {facts!r}")
    return facts


def _read_fields(kind: Any, facts: object, name: str) -> Any:
    names = {field.name for field in fields(kind)}
    if not isinstance(facts, dict) or facts.keys() != names:
        raise ValueError(f"{name} is {facts!r}, not a dictionary of {', '.join(sorted(names))}")
    types = get_type_hints(kind)
    return kind(**{key: _read(types[key], facts[key], f"{name}.{key}") for key in facts})
