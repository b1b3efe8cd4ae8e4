"""Writing aside, then renaming: a reader meets the old result or the new one, never half of one.

Every exporter ends here, so that a crash or a full disk cannot leave a file that looks finished.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

from smust3r_colmap.errors import RunDirectoryError, StorageError


def replace_file(path: Path, content: bytes) -> None:
    """Write ``content`` to ``path``; the folder is made where it is missing.

    Raises:
        StorageError: the disk refused; what stood at ``path`` before still stands.
    """
    partial = path.with_name(f".{path.name}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial.write_bytes(content)
        os.replace(partial, path)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise StorageError(f"{path}: cannot be written ({error.strerror})") from error


@contextmanager
def replaced_folder(folder: Path, *, may_hold: Collection[str]) -> Iterator[Path]:
    """An empty folder beside ``folder`` that takes its place when the block ends well.

    Args:
        folder: where the result belongs; parents are made.
        may_hold: names of the files that may be lost when ``folder`` stands there already.

    Raises:
        RunDirectoryError: ``folder`` is a file, or holds something else than ``may_hold``.
        StorageError: the disk refused.
    """
    _refuse_foreign_content(folder, may_hold)
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


def _refuse_foreign_content(folder: Path, may_hold: Collection[str]) -> None:
    """The old folder goes away as a whole, so it must hold nothing but an older result."""
    if folder.exists() and not folder.is_dir():
        raise RunDirectoryError(f"{folder} is a file, a folder is needed; move it away")
    external = sorted({entry.name for entry in folder.iterdir()} - set(may_hold)) if folder.exists() else []
    if external:
        raise RunDirectoryError(f"{folder} holds {external[0]!r}, which is not ours to replace; move it away")
