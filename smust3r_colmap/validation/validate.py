"""The table of contents: find the model, describe it, ask every rule, ask every reader, report.

The next module to read is ``description``.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from smust3r_colmap.errors import StorageError
from smust3r_colmap.execution.task_pool import TaskFailure, in_child
from smust3r_colmap.validation import (
    binary_files,
    checks_cameras,
    checks_database,
    checks_extras,
    checks_files,
    checks_geometry,
    checks_images,
    checks_names,
    checks_tracks,
    checks_transforms,
    text_files,
)
from smust3r_colmap.validation.description import Defect, ModelDescription, Subject
from smust3r_colmap.validation.layout import Layout, UnreadableModelError, find_layout, model_files
from smust3r_colmap.validation.projection import project
from smust3r_colmap.validation.readers import READERS, Reader
from smust3r_colmap.validation.report import Report, assess, measure, verdicts
from smust3r_colmap.validation.rules import apply_rules, by_name
from smust3r_colmap.validation.surroundings import (
    read_database,
    read_dense,
    read_depth,
    read_image_folder,
    read_ply,
)
from smust3r_colmap.validation.transforms_file import read_transforms

RULES = by_name(
    *checks_files.RULES,
    *checks_names.RULES,
    *checks_cameras.RULES,
    *checks_tracks.RULES,
    *checks_geometry.RULES,
    *checks_images.RULES,
    *checks_database.RULES,
    *checks_extras.RULES,
    *checks_transforms.RULES,
)
"""By name, in the order in which they are reported."""

_POSE_TOLERANCE = 1e-6
_UNREAD = frozenset({"file-truncated", "text-bad-line"})
"""Rules of defects that keep records of a file from being read."""


def validate(
    named: Path,
    *,
    images: Path | None = None,
    database: Path | None = None,
    readers: Iterable[Reader] = READERS,
    ask_colmap: bool = True,
) -> Report:
    """Check the COLMAP model at ``named``, or where programs look below it.

    Args:
        named: folder of a model, of numbered models, of a scene, a training dataset or a dense workspace.
        images, database: taken instead of those that lie beside the model.
        readers: whose verdict counts.
        ask_colmap: also let pycolmap read the model, in a child process.

    Raises:
        InputError: a path that was given does not exist, or is a file where a folder is needed.
        UnreadableModelError: there is no model, or the files of cameras or images are missing.
        StorageError: a file of the model cannot be opened.
    """
    layout = find_layout(named, images=images, database=database)
    subject = describe(layout, ask_colmap=ask_colmap)
    readers = tuple(readers)
    findings = assess(apply_rules(subject, RULES.values()), RULES, readers)
    return Report(
        model=str(layout.model),
        figures=measure(subject),
        beside=_beside(layout, subject),
        findings=findings,
        verdicts=verdicts(findings, readers),
    )


def describe(layout: Layout, *, ask_colmap: bool) -> Subject:
    """Read the model and everything beside it.

    Raises:
        StorageError: a file of the model cannot be opened.
    """
    model = read_model(layout.model)
    return Subject(
        model=model,
        projection=project(model),
        images=None if layout.images is None else read_image_folder(layout.images),
        downscaled={factor: read_image_folder(folder) for factor, folder in layout.downscaled.items()},
        masks=None if layout.masks is None else read_image_folder(layout.masks),
        database=None if layout.database is None else read_database(layout.database),
        ply=None if layout.ply is None else read_ply(layout.ply),
        depth=read_depth(layout.depth_params, layout.depths),
        dense=read_dense(layout.scene),
        transforms=None if layout.transforms is None else read_transforms(layout.transforms),
        siblings={name: _num_images(folder) for name, folder in layout.numbered.items()},
        unread_by_colmap=_ask_colmap(layout.model) if ask_colmap and not model.unread else "",
    )


def read_model(folder: Path) -> ModelDescription:
    """The model in ``folder``; binary where both forms are there, and then also whether they agree.

    Raises:
        UnreadableModelError: cameras or images are missing in both forms.
        StorageError: a file cannot be opened.
    """
    binary, text = model_files(folder, "bin"), model_files(folder, "txt")
    needed = {"cameras", "images"}
    try:
        if not needed <= binary.keys():
            if not needed <= text.keys():
                raise UnreadableModelError(f"{folder}: has no model; cameras and images are needed")
            return _read_form(folder, "text")
        model = _read_form(folder, "binary")
        if not needed <= text.keys():
            return model
        return replace(model, defects=(*model.defects, *_second_form_defects(model, _read_form(folder, "text"))))
    except OSError as error:
        raise StorageError(f"{error.filename}: cannot be read ({error.strerror})") from error


def _read_form(folder: Path, form: Literal["binary", "text"]) -> ModelDescription:
    parser, files = (
        (binary_files, model_files(folder, "bin")) if form == "binary" else (text_files, model_files(folder, "txt"))
    )
    cameras, camera_defects = parser.read_cameras(files["cameras"])
    images, image_defects = parser.read_images(files["images"])
    points, point_defects = parser.read_points(files["points3D"]) if "points3D" in files else (None, [])
    rigs, rig_defects = parser.read_rigs(files["rigs"]) if "rigs" in files else (None, [])
    frames, frame_defects = parser.read_frames(files["frames"]) if "frames" in files else (None, [])
    parts = (
        ("cameras", cameras, camera_defects),
        ("images", images, image_defects),
        ("points3D", points, point_defects),
    )
    return ModelDescription(
        folder=folder,
        form=form,
        cameras=cameras,
        images=images,
        points=points,
        rigs=rigs,
        frames=frames,
        defects=(*camera_defects, *image_defects, *point_defects, *rig_defects, *frame_defects),
        unread=tuple(files[part].name for part, records, defects in parts if not records and _any_unread(defects)),
    )


def _any_unread(defects: Iterable[Defect]) -> bool:
    return any(defect.rule in _UNREAD for defect in defects)


def _second_form_defects(binary: ModelDescription, text: ModelDescription) -> list[Defect]:
    """Lines of the text that cannot be read; where both forms are whole, in what they differ."""
    if _any_unread((*binary.defects, *text.defects)):
        return [defect for defect in text.defects if defect.rule in _UNREAD]
    return _differences(binary, text)


def _differences(binary: ModelDescription, text: ModelDescription) -> list[Defect]:
    """Names, poses and numbers of points that are not the same in the two forms of one model."""

    def defect(what: str) -> list[Defect]:
        return [Defect(rule="text-and-binary-differ", where=str(binary.folder), text=what)]

    ours, theirs = (dict(zip(model.images.names, model.images.translation, strict=True)) for model in (binary, text))
    if ours.keys() != theirs.keys():
        name = min(ours.keys() ^ theirs.keys())
        return defect(f"image {name!r} is in one form only ({len(ours)} images in .bin, {len(theirs)} in .txt)")
    for name, translation in ours.items():
        if not np.allclose(translation, theirs[name], rtol=_POSE_TOLERANCE, atol=_POSE_TOLERANCE, equal_nan=True):
            return defect(f"image {name!r} has two poses")
    num_ours, num_theirs = (None if model.points is None else len(model.points) for model in (binary, text))
    return [] if num_ours == num_theirs else defect(f"{num_ours} points in .bin, {num_theirs} in .txt")


def _num_images(folder: Path) -> int:
    """How many images a neighbouring model has; 0 where that cannot be read."""
    files = model_files(folder, "bin")
    if "images" in files:
        with files["images"].open("rb") as file:
            return int.from_bytes(file.read(8), "little")
    return len(text_files.read_images(model_files(folder, "txt")["images"])[0])


def _ask_colmap(folder: Path) -> str:
    """What pycolmap says against the model, which it reads in a process of its own; empty when nothing."""
    failure = in_child(_load_with_pycolmap, str(folder))
    return failure.reason if isinstance(failure, TaskFailure) else ""


def _load_with_pycolmap(folder: str) -> None:
    """Raises what pycolmap raises."""
    import pycolmap  # noqa: PLC0415  (in the child)

    pycolmap.Reconstruction(folder)


def _beside(layout: Layout, subject: Subject) -> dict[str, str]:
    """What was read besides the model, and why something was not."""
    found = {"images": "none found beside the model, so sizes and files were not checked; name them with --images"}
    if subject.images is not None:
        found["images"] = f"{layout.images} ({len(subject.images.files):,} files)"
    found |= {f"images_{factor}": str(folder) for factor, folder in layout.downscaled.items()}
    others = {"masks": layout.masks, "database": layout.database, "points": layout.ply, "transforms": layout.transforms}
    found |= {kind: str(path) for kind, path in others.items() if path is not None}
    if subject.depth is not None:
        found["depth"] = f"{layout.depth_params} and {layout.depths}"
    if subject.dense is not None:
        found["dense maps"] = str(layout.scene / "stereo")
    if layout.inner_scenes:
        found["not looked at"] = f"{', '.join(map(str, layout.inner_scenes))}: models of their own, name them instead"
    return found
