"""File names that every trainer can read: no folders, one dot, no blanks, unique stems.

The original line of 3D Gaussian Splatting takes a name up to its first dot for the key of an image, other
readers stop at a blank or a comma, and Brush looks for the file whose path *ends* with the name, in any case.
The next module to read is ``centred_pinhole``.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import PurePosixPath

_NOT_IN_A_STEM = re.compile(r"[^\w-]+")


def flat_names(suffixes: Mapping[str, str]) -> dict[str, str]:
    """The new name of each image by its old one, in the given order.

    ``left/IMG 1.a.JPG`` becomes ``left_IMG_1_a.jpg``. Where two come out alike, also in another case or with
    another suffix, the later gets a number at its end. Where one name is the end of another (``1.jpg`` and
    ``11.jpg``) all of them get their number in front, as in ``01_1.jpg``, and what looks like such a number further
    on is parted by a hyphen (``02_01-1.jpg``), so that the number is where a name begins and nowhere else.

    Args:
        suffixes: by old name, the suffix of the new one, such as ``.jpg``.
    """
    stems = _all_different({name: _flat_stem(name) for name in suffixes})
    if _one_ends_another(stem + suffixes[name] for name, stem in stems.items()):
        stems = _numbered(stems)
    return {name: stem + suffixes[name] for name, stem in stems.items()}


def _flat_stem(name: str) -> str:
    return _NOT_IN_A_STEM.sub("_", str(PurePosixPath(name).with_suffix("")))


def _all_different(stems: Mapping[str, str]) -> dict[str, str]:
    """Compared without case, as the file systems of Windows and macOS do."""
    taken: set[str] = set()
    different = {}
    for name, stem in stems.items():
        candidate, number = stem, 1
        while candidate.casefold() in taken:
            number += 1
            candidate = f"{stem}_{number}"
        taken.add(candidate.casefold())
        different[name] = candidate
    return different


def _numbered(stems: Mapping[str, str]) -> dict[str, str]:
    """Numbers of one width and ``_`` in front; the stems hold no such number any more, so none ends another."""
    digits = len(str(len(stems)))
    looks_numbered = re.compile(rf"(?<=[0-9]{{{digits}}})_")
    return {
        name: f"{number:0{digits}d}_{looks_numbered.sub('-', stem)}"
        for number, (name, stem) in enumerate(stems.items(), start=1)
    }


def _one_ends_another(names: Iterable[str]) -> bool:
    folded = {name.casefold() for name in names}
    return any(name[start:] in folded for name in folded for start in range(1, len(name)))
