"""Rules about the files of the model: missing, cut short, or not as their format wants them."""

from __future__ import annotations

from smust3r_colmap.validation.description import Subject
from smust3r_colmap.validation.rules import (
    UNREAD_RULE,
    Evidence,
    Severity,
    defects_as_evidence,
    measured,
    offenders,
    rule,
)

_MAX_MESSAGE_LETTERS = 200


@rule(
    UNREAD_RULE,
    "nothing in a file can be read, so the rest was not checked",
    severity=Severity.BROKEN,
    advice="copy or write the model again; is it a model of COLMAP at all?",
)
def _unreadable(subject: Subject) -> Evidence | None:
    return measured(", ".join(subject.model.unread)) if subject.model.unread else None


@rule(
    "file-truncated",
    "a file ends early",
    severity=Severity.BROKEN,
    advice="copy or write the model again; was the disk full?",
)
def _truncated(subject: Subject) -> Evidence | None:
    return defects_as_evidence(subject, "file-truncated")


@rule(
    "file-trailing-bytes",
    "bytes follow the last record",
    severity=Severity.WARNING,
    advice="read the model with pycolmap and write it again",
)
def _trailing(subject: Subject) -> Evidence | None:
    return defects_as_evidence(subject, "file-trailing-bytes")


@rule(
    "images-none",
    "the model has no images",
    severity=Severity.REFUSED,
    advice="images without a pose are not written; look at why none was registered",
)
def _no_images(subject: Subject) -> Evidence | None:
    return None if len(subject.model.images) else measured("0 images with a pose")


@rule(
    "points-file-missing",
    "there is no points3D file",
    severity=Severity.WARNING,
    advice="triangulate points (`smust3r-colmap refine`), or write the model with pycolmap, which writes an empty file",
)
def _no_points_file(subject: Subject) -> Evidence | None:
    if subject.model.points is not None:
        return None
    return measured(f"no points3D.{'bin' if subject.model.form == 'binary' else 'txt'} beside the images")


@rule(
    "rigs-incomplete",
    "only one of the files rigs and frames is there",
    severity=Severity.WARNING,
    advice="delete the one that is there: COLMAP then makes both up; or write the model again with pycolmap",
)
def _rigs_incomplete(subject: Subject) -> Evidence | None:
    model = subject.model
    if (model.rigs is None) == (model.frames is None):
        return None
    return measured("rigs is missing" if model.rigs is None else "frames is missing")


@rule(
    "text-only",
    "the model is there as text only",
    severity=Severity.FACT,
    advice="write it as binary too: pycolmap.Reconstruction(folder).write_binary(folder)",
)
def _text_only(subject: Subject) -> Evidence | None:
    return measured("no .bin files") if subject.model.form == "text" else None


@rule(
    "text-bad-line",
    "a line cannot be read",
    severity=Severity.REFUSED,
    advice="correct the line, or have the program that wrote it corrected",
)
def _bad_line(subject: Subject) -> Evidence | None:
    return defects_as_evidence(subject, "text-bad-line")


@rule(
    "text-observations-missing",
    "images.txt lacks lines of observations, so lines no longer come in pairs",
    severity=Severity.REFUSED,
    advice="`smust3r-colmap refine MODEL --images DIR` reads it all the same and writes a whole model; or give every "
    "image a second line, which is empty where it has no observations",
)
def _odd_lines(subject: Subject) -> Evidence | None:
    return defects_as_evidence(subject, "text-observations-missing")


@rule(
    "text-last-line-empty",
    "images.txt ends with an empty line of observations",
    severity=Severity.FACT,
    advice="write the model as binary too",
)
def _last_line_empty(subject: Subject) -> Evidence | None:
    return defects_as_evidence(subject, "text-last-line-empty")


@rule(
    "text-simple-pinhole",
    "a text model with SIMPLE_PINHOLE cameras",
    severity=Severity.FACT,
    advice="write it as binary, or with PINHOLE cameras",
)
def _text_simple_pinhole(subject: Subject) -> Evidence | None:
    if subject.model.form != "text":
        return None
    found = [f"camera {camera.camera_id}" for camera in subject.model.cameras if camera.model == "SIMPLE_PINHOLE"]
    return offenders(found, of=len(subject.model.cameras), unit="cameras")


@rule(
    "text-and-binary-differ",
    "the .bin and the .txt files are two different models",
    severity=Severity.REFUSED,
    advice="delete the older set: some programs take one, some the other",
)
def _forms_differ(subject: Subject) -> Evidence | None:
    return defects_as_evidence(subject, "text-and-binary-differ")


@rule(
    "model-not-largest",
    "another model of the same folder has more images",
    severity=Severity.WARNING,
    advice="rename the folders so that 0 is the largest: most programs take 0 without looking",
)
def _not_largest(subject: Subject) -> Evidence | None:
    own = subject.siblings.get(subject.model.folder.name, 0)
    largest = max(subject.siblings, key=lambda name: subject.siblings[name], default="")
    if not largest or subject.siblings[largest] <= own:
        return None
    return measured(f"{largest} has {subject.siblings[largest]} images, {subject.model.folder.name} has {own}")


@rule(
    "model-one-of-several",
    "the reconstruction fell into several models",
    severity=Severity.NOTE,
    advice="look at the others too; programs take one of them and leave the images of the others out",
)
def _several(subject: Subject) -> Evidence | None:
    if len(subject.siblings) < 2:
        return None
    return measured(", ".join(f"{name} with {count} images" for name, count in subject.siblings.items()))


@rule(
    "model-without-number",
    "the files lie in sparse, not in sparse/0",
    severity=Severity.FACT,
    advice="move or copy them into sparse/0",
)
def _without_number(subject: Subject) -> Evidence | None:
    return measured(f"{subject.model.folder}") if subject.model.folder.name == "sparse" else None


@rule(
    "colmap-cannot-read",
    "pycolmap cannot read the model",
    severity=Severity.FACT,
    advice="see the other findings; the message is that of COLMAP",
)
def _unread(subject: Subject) -> Evidence | None:
    return measured(subject.unread_by_colmap[:_MAX_MESSAGE_LETTERS]) if subject.unread_by_colmap else None


RULES = (
    _unreadable,
    _truncated,
    _trailing,
    _no_images,
    _no_points_file,
    _rigs_incomplete,
    _text_only,
    _bad_line,
    _odd_lines,
    _last_line_empty,
    _text_simple_pinhole,
    _forms_differ,
    _not_largest,
    _several,
    _without_number,
    _unread,
)
"""In the order in which they are reported."""
