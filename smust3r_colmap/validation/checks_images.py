"""Rules about the image files: are they there, and have they the size that the cameras say?"""

from __future__ import annotations

from collections.abc import Iterator

from smust3r_colmap.validation.description import Camera, FileFolder, ImageFile, Subject
from smust3r_colmap.validation.rules import Evidence, Severity, offenders, rule

_ASPECT_TOLERANCE = 0.02
"""Relative difference of the two ratios of sizes; a network's input is rounded to multiples of 14 or 16 pixels."""


@rule(
    "image-file-missing",
    "images of the model are no files of the image folder",
    severity=Severity.WARNING,
    advice="name the right folder with --images; names are paths below it, and upper and lower case count",
)
def _missing(subject: Subject) -> Evidence | None:
    if subject.images is None:
        return None
    by_lower = {name.lower(): name for name in subject.images.by_name}
    found = []
    for name in subject.model.images.names:
        if name not in subject.images.by_name:
            other = by_lower.get(name.lower())
            found.append(repr(name) if other is None else f"{name!r}, but there is {other!r}")
    return offenders(found, of=len(subject.model.images), unit="images")


@rule(
    "image-file-extra",
    "image files that are not in the model",
    severity=Severity.NOTE,
    advice="they got no pose, or do not belong here",
)
def _extra(subject: Subject) -> Evidence | None:
    if subject.images is None:
        return None
    known = set(subject.model.images.names)
    found = [repr(file.name) for file in subject.images.files if file.name not in known]
    return offenders(found, of=len(subject.images.files), unit="files")


@rule(
    "image-file-unreadable",
    "image files that cannot be opened",
    severity=Severity.REFUSED,
    advice="copy them again, or leave them out of the model",
)
def _unreadable(subject: Subject) -> Evidence | None:
    found = [repr(name) for name, _, file in _pairs(subject, readable=False) if not file.readable]
    return offenders(found, of=len(subject.model.images), unit="images")


@rule(
    "image-size-resized",
    "image files are larger or smaller than their cameras say",
    severity=Severity.WARNING,
    advice="scale the cameras (Camera.rescale) to the files, or give the files that the model was made from",
)
def _resized(subject: Subject) -> Evidence | None:
    return _sizes(subject, same_shape=True)


@rule(
    "image-size-differs",
    "image files have another shape than their cameras say",
    severity=Severity.REFUSED,
    advice="give the files that the model was made from: with a crop, no scaling of the camera is right",
)
def _differs(subject: Subject) -> Evidence | None:
    return _sizes(subject, same_shape=False)


def _sizes(subject: Subject, *, same_shape: bool) -> Evidence | None:
    found = [
        f"{name!r} is {file.width} x {file.height}, camera {camera.camera_id} is {camera.width} x {camera.height}"
        for name, camera, file in _pairs(subject)
        if not file.fits(camera.width, camera.height) and _has_shape(file, camera) == same_shape
    ]
    return offenders(found, of=len(subject.model.images), unit="images")


def _has_shape(file: ImageFile, camera: Camera) -> bool:
    """Resizing could have made one of the other."""
    across, down = file.width * camera.height, camera.width * file.height
    return abs(across - down) <= _ASPECT_TOLERANCE * max(across, down)


@rule(
    "image-exif-turned",
    "image files that EXIF says to turn by a quarter",
    severity=Severity.NOTE,
    advice="remove the tag and leave the pixels: the model is of them as stored, as COLMAP and trainers read them; "
    "OpenCV and browsers turn them",
)
def _turned(subject: Subject) -> Evidence | None:
    return _turned_with(subject, upright=False)


@rule(
    "image-exif-against-camera",
    "cameras have the size of the turned image, files store it lying",
    severity=Severity.WARNING,
    advice="turn the pixels and remove the tag: programs that read pixels as stored find another size",
)
def _turned_camera(subject: Subject) -> Evidence | None:
    return _turned_with(subject, upright=True)


def _turned_with(subject: Subject, *, upright: bool) -> Evidence | None:
    """Turned files whose camera has the upright size, or the stored one."""
    found = [
        repr(name)
        for name, camera, file in _pairs(subject)
        if file.turned
        and file.fits(camera.width, camera.height)
        and ((camera.width, camera.height) != (file.width, file.height)) == upright
    ]
    return offenders(found, of=len(subject.model.images), unit="images")


@rule(
    "downscaled-list-differs",
    "images_2, images_4 ... do not hold the same files as images",
    severity=Severity.WARNING,
    advice="delete these folders and write them again: they are paired with `images` by place in the sorted list, "
    "so one file too many shifts all others",
)
def _downscaled_lists(subject: Subject) -> Evidence | None:
    if subject.images is None:
        return None
    wanted = _stems(subject.images)
    found = []
    for factor, folder in subject.downscaled.items():
        stems = _stems(folder)
        if stems != wanted:
            odd = next(iter(sorted(set(stems) ^ set(wanted))), "the order")
            found.append(f"images_{factor} has {len(stems)} files, images has {len(wanted)}; {odd!r} is in one only")
    return offenders(found, of=len(subject.downscaled), unit="folders")


def _stems(folder: FileFolder) -> list[str]:
    """Names without endings (JPEG may have become PNG), in the order of the sorted files."""
    return [file.name.rpartition(".")[0] for file in folder.files]


@rule(
    "downscaled-size-differs",
    "images_2, images_4 ... hold files of another size than their names say",
    severity=Severity.WARNING,
    advice="delete these folders and write them again",
)
def _downscaled_sizes(subject: Subject) -> Evidence | None:
    if subject.images is None:
        return None
    sizes = {file.name.rpartition(".")[0]: file for file in subject.images.files}
    found, total = [], 0
    for factor, folder in subject.downscaled.items():
        for small in folder.files:
            large = sizes.get(small.name.rpartition(".")[0])
            if large is None:
                continue
            total += 1
            # Programs round down, to the nearest or up; all of them are within one pixel.
            if abs(small.width - large.width / factor) > 1 or abs(small.height - large.height / factor) > 1:
                found.append(f"images_{factor}/{small.name} is {small.width} x {small.height}")
    return offenders(found, of=total, unit="files")


def _pairs(subject: Subject, *, readable: bool = True) -> Iterator[tuple[str, Camera, ImageFile]]:
    """Images of the model with their camera and file, where both are there."""
    images, cameras = subject.model.images, subject.model.camera_by_id
    files = {} if subject.images is None else subject.images.by_name
    for name, camera_id in zip(images.names, images.camera_ids.tolist(), strict=True):
        if name in files and camera_id in cameras and (files[name].readable or not readable):
            yield name, cameras[camera_id], files[name]


RULES = (
    _missing,
    _extra,
    _unreadable,
    _resized,
    _differs,
    _turned,
    _turned_camera,
    _downscaled_lists,
    _downscaled_sizes,
)
"""In the order in which they are reported."""
