"""The hash by which files, arrays and settings are told apart."""

from __future__ import annotations

import hashlib


def digest_of(content: bytes) -> str:
    """40 hexadecimal digits (BLAKE2b) that are the same exactly when the bytes are."""
    return hashlib.blake2b(content, digest_size=20).hexdigest()
