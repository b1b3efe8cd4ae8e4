"""Whether a file is as published."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

from smust3r_colmap.backbones.weights.catalogue import find_official, official_with_sum
from smust3r_colmap.errors import CheckpointError

_BLOCK_BYTES = 2**20


@dataclass(frozen=True, kw_only=True)
class ChecksumResult:
    """The result of comparing the sum of a file.

    Args:
        sound: the file is as published, and under its own name if the name is an official one.
        text: for people, beginning with the path.
    """

    sound: bool
    text: str


def verify(path: Path) -> ChecksumResult:
    """Compare the file with the published sums: with its own if its name is official, else with all.

    Raises:
        CheckpointError: it cannot be read.
    """
    found = md5_of(path)
    wanted = find_official(path.name)
    if wanted is not None and found != wanted.md5:
        text = f"has MD5 {found}, published is {wanted.md5}: damaged or changed; delete it and fetch it again"
        return ChecksumResult(sound=False, text=f"{path}: {text}")
    known = official_with_sum(found)
    if known is None:
        return ChecksumResult(sound=False, text=f"{path}: has MD5 {found}, which is none of the published sums")
    return ChecksumResult(sound=True, text=f"{path}: is {known.name} as published (MD5 {found})")


def md5_of(path: Path) -> str:
    """The MD5 sum as 32 hexadecimal digits: it detects damage, not forgery.

    Raises:
        CheckpointError: the file cannot be read.
    """
    digest = hashlib.md5(usedforsecurity=False)
    try:
        with path.open("rb") as file:
            while block := file.read(_BLOCK_BYTES):
                digest.update(block)
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read ({error.strerror or error})") from error
    return digest.hexdigest()
