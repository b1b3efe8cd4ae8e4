"""Rules about the names of the images, which is what every program joins files by."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable
from itertools import pairwise
from pathlib import PurePosixPath, PureWindowsPath

from smust3r_colmap.validation.description import Subject
from smust3r_colmap.validation.rules import Evidence, Severity, measured, offenders, rule

_FLATTEN = "rename the images, or let `smust3r-colmap export` write the training dataset, which has flat names"


def _names(subject: Subject, wrong: Callable[[str], bool]) -> Evidence | None:
    names = subject.model.images.names
    return offenders([repr(name) for name in names if wrong(name)], of=len(names), unit="images")


@rule("name-blank", "blanks in names", severity=Severity.NOTE, advice="rename the images without blanks")
def _blank(subject: Subject) -> Evidence | None:
    return _names(subject, _has_blank)


def _has_blank(name: str) -> bool:
    return not name or any(letter.isspace() for letter in name)


@rule(
    "name-blank-in-text",
    "blanks in names of a text model",
    severity=Severity.WARNING,
    advice="rename the images; text has a name end at the first blank",
)
def _blank_in_text(subject: Subject) -> Evidence | None:
    return _names(subject, _has_blank) if subject.model.form == "text" else None


@rule("name-comma", "commas in names", severity=Severity.FACT, advice="rename the images without commas")
def _comma(subject: Subject) -> Evidence | None:
    return _names(subject, lambda name: "," in name)


@rule("name-subfolder", "names with subfolders", severity=Severity.FACT, advice=_FLATTEN)
def _subfolder(subject: Subject) -> Evidence | None:
    return _names(subject, lambda name: "/" in name)


@rule("name-two-dots", "names with more than one dot", severity=Severity.FACT, advice=_FLATTEN)
def _two_dots(subject: Subject) -> Evidence | None:
    return _names(subject, lambda name: PurePosixPath(name).name.count(".") > 1)


@rule(
    "name-not-relative",
    "names that are no path below the image folder",
    severity=Severity.WARNING,
    advice="names must be relative, with forward slashes and without `..`",
)
def _not_relative(subject: Subject) -> Evidence | None:
    return _names(subject, _leaves_folder)


def _leaves_folder(name: str) -> bool:
    windows = PureWindowsPath(name)
    return "\\" in name or bool(windows.drive or windows.root) or ".." in PurePosixPath(name).parts


@rule(
    "name-duplicate",
    "several images have the same name",
    severity=Severity.REFUSED,
    advice="keep one image per file; COLMAP reads such a model without a word and joins by name later",
)
def _duplicate(subject: Subject) -> Evidence | None:
    return _clashes(subject, lambda name: name, alike=_any_pair)


@rule(
    "name-case-clash",
    "names that differ in upper and lower case only",
    severity=Severity.WARNING,
    advice="rename the images; on Windows and macOS they are the same file",
)
def _case_clash(subject: Subject) -> Evidence | None:
    return _clashes(subject, str.lower, alike=_distinct)


@rule(
    "name-stem-clash",
    "images with the same file name without folder and ending",
    severity=Severity.FACT,
    advice=_FLATTEN,
)
def _stem_clash(subject: Subject) -> Evidence | None:
    return _clashes(subject, lambda name: PurePosixPath(name).stem, alike=_distinct)


def _any_pair(names: list[str]) -> bool:
    return len(names) > 1


def _distinct(names: list[str]) -> bool:
    return len(set(names)) > 1


def _clashes(subject: Subject, key: Callable[[str], str], *, alike: Callable[[list[str]], bool]) -> Evidence | None:
    """Images whose names have the same key as another's."""
    groups = defaultdict[str, list[str]](list)
    for name in subject.model.images.names:
        groups[key(name)].append(name)
    found = [name for names in groups.values() if alike(names) for name in names]
    if not found:
        return None
    first = [name for name in found if key(name) == key(found[0])]
    other = next((name for name in first if name != first[0]), first[0])
    return Evidence(
        count=len(found), of=len(subject.model.images), unit="images", example=f"{first[0]!r} and {other!r}"
    )


@rule(
    "name-ending-clash",
    "names that are the ending of another image's name",
    severity=Severity.FACT,
    advice="give the numbers in the names leading zeros (01.png, 11.png), or rename the images",
)
def _ending_clash(subject: Subject) -> Evidence | None:
    files = () if subject.images is None else subject.images.by_name
    pairs = _name_endings(subject.model.images.names, (*subject.model.images.names, *files))
    found = [f"{name!r}, with which {longer!r} ends" for name, longer in pairs]
    return offenders(found, of=len(subject.model.images), unit="images")


def _name_endings(names: Iterable[str], candidates: Iterable[str]) -> list[tuple[str, str]]:
    """Each name with a longer candidate that ends with it, upper and lower case being the same.

    Read backwards and sorted, whatever ends with a name stands right behind it.
    """
    wanted = {name.lower()[::-1]: name for name in names}
    backwards = sorted({name.lower()[::-1]: name for name in candidates}.items())
    return [
        (wanted[short], longer_name)
        for (short, _), (longer, longer_name) in pairwise(backwards)
        if short in wanted and longer.startswith(short)
    ]


@rule(
    "id-duplicate",
    "an id occurs twice",
    severity=Severity.REFUSED,
    advice="give every camera, image and point a number of its own",
)
def _duplicate_id(subject: Subject) -> Evidence | None:
    found, total = [], 0
    for kind, ids in _ids(subject):
        total += len(ids)
        found += [f"{kind} {one_id} ({times} times)" for one_id, times in Counter(ids).items() if times > 1]
    return offenders(found, of=total, unit="ids")


@rule(
    "id-zero",
    "an id is 0",
    severity=Severity.NOTE,
    advice="count from 1, as COLMAP and its databases do",
)
def _zero_id(subject: Subject) -> Evidence | None:
    found = [f"{kind} 0" for kind, ids in _ids(subject) if 0 in ids]
    return offenders(found, of=sum(len(ids) for _, ids in _ids(subject)), unit="ids")


_LARGEST_IMAGE_ID = 2**31 - 2
"""COLMAP numbers a pair of images by ``id_1 * 2147483647 + id_2``."""


@rule(
    "id-too-large",
    "ids of images or cameras that no database can hold",
    severity=Severity.WARNING,
    advice=f"keep ids of cameras and images from 1 to {_LARGEST_IMAGE_ID}",
)
def _large_id(subject: Subject) -> Evidence | None:
    ids = [(kind, one_id) for kind, ids in _ids(subject) if kind != "point" for one_id in ids]
    found = [f"{kind} {one_id}" for kind, one_id in ids if not 0 <= one_id <= _LARGEST_IMAGE_ID]
    return offenders(found, of=len(ids), unit="ids")


_HUGE_POINT_ID = 100_000_000
"""An array of that length takes a gigabyte with 8 bytes a row, which a training script should not need."""


@rule(
    "point-id-huge",
    "the largest point id is far above the number of points",
    severity=Severity.NOTE,
    advice="number the points from 1 without gaps",
)
def _huge_point_id(subject: Subject) -> Evidence | None:
    points = subject.model.points
    if points is None or len(points) == 0:
        return None
    largest = int(points.ids.max())
    outside = largest > _HUGE_POINT_ID or int(points.ids.min()) < 0
    return measured(f"id {largest} among {len(points):,} points") if outside else None


def _ids(subject: Subject) -> tuple[tuple[str, list[int]], ...]:
    model = subject.model
    return (
        ("camera", [camera.camera_id for camera in model.cameras]),
        ("image", model.images.ids.tolist()),
        ("point", [] if model.points is None else model.points.ids.tolist()),
    )


RULES = (
    _blank,
    _blank_in_text,
    _comma,
    _subfolder,
    _two_dots,
    _not_relative,
    _duplicate,
    _case_clash,
    _stem_clash,
    _ending_clash,
    _duplicate_id,
    _zero_id,
    _large_id,
    _huge_point_id,
)
"""In the order in which they are reported."""
