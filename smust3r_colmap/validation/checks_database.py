"""Rules about the database: COLMAP goes on from a model only if ids and observations are the database's."""

from __future__ import annotations

from collections.abc import Iterator

from smust3r_colmap.validation.description import CAMERA_MODELS, DatabaseImage, Subject
from smust3r_colmap.validation.rules import Evidence, Severity, measured, offenders, rule

_REBUILD = (
    "build the model with the database's ids from the start (pycolmap.Reconstruction.transcribe_image_ids_to_database "
    "renames images and leaves frames and cameras)"
)


@rule(
    "database-unreadable", "the database cannot be read", severity=Severity.WARNING, advice="give COLMAP's database.db"
)
def _unreadable(subject: Subject) -> Evidence | None:
    if subject.database is None or not subject.database.problem:
        return None
    return measured(f"{subject.database.path.name}: {subject.database.problem}")


@rule(
    "database-image-missing",
    "images of the model are not in the database",
    severity=Severity.WARNING,
    advice="give the database of these images; names must be equal",
)
def _missing(subject: Subject) -> Evidence | None:
    if subject.database is None or subject.database.problem:
        return None
    known = {image.name for image in subject.database.images}
    names = subject.model.images.names
    return offenders([repr(name) for name in names if name not in known], of=len(names), unit="images")


@rule(
    "database-image-id-differs",
    "images have another id in the database",
    severity=Severity.WARNING,
    advice=_REBUILD,
)
def _image_id(subject: Subject) -> Evidence | None:
    found = [
        f"{image.name!r} is {subject.model.images.ids[index]} here, {image.image_id} there"
        for index, image in _pairs(subject)
        if subject.model.images.ids[index] != image.image_id
    ]
    return offenders(found, of=len(subject.model.images), unit="images")


@rule(
    "database-camera-id-differs",
    "images have another camera in the database",
    severity=Severity.WARNING,
    advice=_REBUILD,
)
def _camera_id(subject: Subject) -> Evidence | None:
    found = [
        f"{image.name!r} has camera {subject.model.images.camera_ids[index]} here, {image.camera_id} there"
        for index, image in _pairs(subject)
        if subject.model.images.camera_ids[index] != image.camera_id
    ]
    return offenders(found, of=len(subject.model.images), unit="images")


@rule(
    "database-frame-id-differs",
    "images have another frame in the database",
    severity=Severity.WARNING,
    advice=_REBUILD,
)
def _frame_id(subject: Subject) -> Evidence | None:
    frames = subject.model.frames
    if frames is None:
        return None
    frame_of_image = {image_id: frame.frame_id for frame in frames for image_id in frame.image_ids}
    found = []
    for index, image in _pairs(subject):
        ours = frame_of_image.get(int(subject.model.images.ids[index]))
        if None not in (ours, image.frame_id) and ours != image.frame_id:
            found.append(f"{image.name!r} is in frame {ours} here, {image.frame_id} there")
    return offenders(found, of=len(subject.model.images), unit="images")


@rule(
    "database-keypoints-differ",
    "images list another number of observations than the database has keypoints",
    severity=Severity.WARNING,
    advice="an image must list all its keypoints, or none; the observations come from another feature extraction",
)
def _keypoints(subject: Subject) -> Evidence | None:
    found = [
        f"{image.name!r} lists {subject.model.images.num_rows[index]}, the database has {image.num_keypoints}"
        for index, image in _pairs(subject)
        if subject.model.images.num_rows[index] not in (0, image.num_keypoints)
    ]
    return offenders(found, of=len(subject.model.images), unit="images")


@rule(
    "database-camera-differs",
    "cameras have another model or size in the database",
    severity=Severity.NOTE,
    advice="an undistorted model does not go with the database of the original images; take the original model",
)
def _camera(subject: Subject) -> Evidence | None:
    if subject.database is None:
        return None
    found = []
    for camera in subject.model.cameras:
        theirs = subject.database.cameras.get(camera.camera_id)
        known = CAMERA_MODELS.get(camera.model)
        if theirs is not None and known is not None and theirs != (known.number, camera.width, camera.height):
            found.append(
                f"camera {camera.camera_id} is {camera.model} {camera.width} x {camera.height} here, "
                f"model {theirs[0]} {theirs[1]} x {theirs[2]} there"
            )
    return offenders(found, of=len(subject.model.cameras), unit="cameras")


def _pairs(subject: Subject) -> Iterator[tuple[int, DatabaseImage]]:
    """Index of each image of the model that the database knows by name, and what the database says."""
    if subject.database is None:
        return
    by_name = {image.name: image for image in subject.database.images}
    for index, name in enumerate(subject.model.images.names):
        if name in by_name:
            yield index, by_name[name]


RULES = (
    _unreadable,
    _missing,
    _image_id,
    _camera_id,
    _frame_id,
    _keypoints,
    _camera,
)
"""In the order in which they are reported."""
