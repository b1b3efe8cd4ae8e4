"""Files of ``torch.save`` opened without running code from them.

torch's own unpickler for weights knows tensors and plain containers, and refuses every other name. Files
from a training loop hold more: their options, in an ``argparse.Namespace``, and members of classes that
are not installed here. So the names are listed first, without loading; the namespace is allowed, and
every other name becomes a stand-in that accepts any arguments and does nothing. torch before
2.10 has a hole in that unpickler (CVE-2026-24747).
"""

from __future__ import annotations

import argparse
import logging
import pickle
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

import torch

from smust3r_colmap.errors import CheckpointError

_log = logging.getLogger(__name__)

_NAMESPACE = "argparse.Namespace"
_ZIP_START = b"PK\x03\x04"

_Allowed: TypeAlias = Callable[..., Any] | tuple[Callable[..., Any], str]
_SIGNS_OF_DAMAGE = (
    pickle.UnpicklingError,
    struct.error,
    EOFError,
    RuntimeError,
    AssertionError,
    AttributeError,
    LookupError,
    TypeError,
    ValueError,
)
"""What the unpickler lets through: a file can ask for wrong arguments, wrong types and missing records alike."""


class StandIn:
    """Replaces an object of a class that is not trusted or not installed; it holds nothing."""

    def __new__(cls, *_arguments: object, **_keywords: object) -> StandIn:
        """Any arguments do."""
        return super().__new__(cls)

    def __init__(self, *_arguments: object, **_keywords: object) -> None:
        pass

    def __setstate__(self, _state: object) -> None:
        pass


def read_pickled(path: Path) -> dict[str, object]:
    """The dictionary in a file of ``torch.save``; its tensors are mapped from the file, not read.

    Tensors come to the CPU. What is neither a tensor, a plain container or value, nor an
    ``argparse.Namespace`` is a ``StandIn``.

    Raises:
        CheckpointError: not such a file, truncated, not a dictionary, or it asks for what torch refuses.

    Source: network specification, section 2.1.
    """
    _check_form(path)
    try:
        names = torch.serialization.get_unsafe_globals_in_checkpoint(path)
        allowed: list[_Allowed] = [(argparse.Namespace if name == _NAMESPACE else StandIn, name) for name in names]
        with torch.serialization.safe_globals(allowed):
            content = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except _SIGNS_OF_DAMAGE as error:
        raise CheckpointError(
            f"{path} cannot be opened as weights: {_reason(error)}. Nothing in it was run. Fetch the file again from "
            "where it was published"
        ) from error
    unknown = sorted(set(names) - {_NAMESPACE})
    if unknown:
        _log.debug("%s: left out what is unknown here: %s", path, ", ".join(unknown))
    if not isinstance(content, dict) or not all(isinstance(key, str) for key in content):
        raise CheckpointError(f"{path} holds a {type(content).__name__}, not a dictionary of named parts")
    return content


def _reason(error: Exception) -> str:
    """In one line, and without torch's advice to load the file unrestricted, which it wraps around its reason."""
    wrapped = isinstance(error, pickle.UnpicklingError) and error.__context__
    lines = str(wrapped or error).strip().splitlines()
    return lines[0].rstrip(".") if lines else type(error).__name__


def _check_form(path: Path) -> None:
    """A whole zip archive, as torch has written since version 1.6; older forms had pickles of their own."""
    try:
        with path.open("rb") as file:
            start = file.read(len(_ZIP_START))
        size = path.stat().st_size
    except OSError as error:
        raise CheckpointError(f"{path} cannot be read: {error.strerror or error}") from error
    if start != _ZIP_START:
        raise CheckpointError(
            f"{path} is no checkpoint: it starts with {start!r}, where a zip archive of torch.save starts with "
            f"{_ZIP_START!r}. Name another file, or fetch this one again"
        )
    if not _has_end(path):
        raise CheckpointError(f"{path} is cut off after {size} bytes: its end is missing. Fetch it again")


def _has_end(path: Path) -> bool:
    try:
        return zipfile.is_zipfile(path)
    except zipfile.BadZipFile:  # an end that speaks of other files
        return False
