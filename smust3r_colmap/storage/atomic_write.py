"""Atomic writes: a reader sees the old result or the new one, never half of one.

The result is written beside its place, as ``.NAME.partial``, and renamed when it is complete. A crash or a full disk
thus never leaves a file that looks finished.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from smust3r_colmap.errors import RunDirectoryError, StorageError


def write_atomically(path: Path, content: bytes) -> None:
    """Write ``content`` to ``path``; the folder is made where it is missing.

    Raises:
        StorageError: the disk refused; a file that was at ``path`` before is unchanged.
    """
    with atomic_file(path) as partial:
        partial.write_bytes(content)


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """A path to write to; the file there is renamed to ``path`` when the block ends without an error.

    Raises:
        StorageError: the disk refused; a file that was at ``path`` before is unchanged.
    """
    partial = path.with_name(f".{path.name}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield partial
        os.replace(partial, path)
    except OSError as error:
        raise StorageError(f"{path}: cannot be written ({error.strerror or error})") from error
    finally:
        with suppress(OSError):  # gone when all went well
            partial.unlink()


@contextmanager
def atomic_folder(folder: Path, *, may_hold: Collection[str]) -> Iterator[Path]:
    """An empty folder to write into; it replaces ``folder`` when the block ends without an error.

    Args:
        folder: where the result belongs; parents are made.
        may_hold: names of the files that may be lost when ``folder`` exists already.

    Raises:
        RunDirectoryError: ``folder`` is a file, or holds something else than ``may_hold``.
        StorageError: the disk refused.
    """
    _refuse_other_content(folder, may_hold)
    partial = folder.with_name(f".{folder.name}.partial")
    replaced = folder.with_name(f".{folder.name}.replaced")
    try:
        for leftover in (partial, replaced):
            shutil.rmtree(leftover, ignore_errors=True)
        partial.mkdir(parents=True)
        yield partial
        if folder.exists():
            os.rename(folder, replaced)
        os.rename(partial, folder)
    except OSError as error:
        raise StorageError(f"{folder}: cannot be written ({error.strerror})") from error
    finally:
        for leftover in (partial, replaced):
            shutil.rmtree(leftover, ignore_errors=True)


def _refuse_other_content(folder: Path, may_hold: Collection[str]) -> None:
    """The old folder is removed as a whole, so it must hold nothing but an older result."""
    if folder.exists() and not folder.is_dir():
        raise RunDirectoryError(f"{folder} is a file, a folder is needed; move it away")
    others = sorted({entry.name for entry in folder.iterdir()} - set(may_hold)) if folder.exists() else []
    if others:
        raise RunDirectoryError(f"{folder} holds {others[0]!r}, which is not ours to replace; move it away")
