"""Rules about cameras: which model, whether the intrinsics can be true, which images they belong to."""

from __future__ import annotations

from smust3r_colmap.importers.intrinsics_units import FOCAL_RATIO_RANGE, rescaling
from smust3r_colmap.validation.description import CAMERA_MODELS, Camera, Subject
from smust3r_colmap.validation.rules import Evidence, Rule, Severity, measured, offenders, rule

_UNDISTORT = (
    "undistort the images and the model (pycolmap.undistort_images, COLMAP's image_undistorter), "
    "or use the training dataset of a run"
)

_OFF_CENTRE_PX = 1.0
"""Below, leaving the principal point out shifts a picture by less than its pixels."""

_FOCAL_RATIO_RANGE = (0.1, 10.0)
"""Focal length over the longer side; the limits of COLMAP's mapper (min_focal_length_ratio and its counterpart)."""

_FOCAL_ASPECT_RANGE = (0.9, 1.1)
_MAX_DISTORTION = 1.0
"""Limit of COLMAP's mapper (max_extra_param)."""


def camera_model_rule(model: str) -> str:
    """Name of the rule that says that there are cameras of this model."""
    return f"camera-model-{model}"


def _camera_model_rule(model: str) -> Rule:
    @rule(camera_model_rule(model), f"camera model {model}", severity=Severity.FACT, advice=_UNDISTORT)
    def check(subject: Subject) -> Evidence | None:
        found = [f"camera {camera.camera_id}" for camera in subject.model.cameras if camera.model == model]
        return offenders(found, of=len(subject.model.cameras), unit="cameras")

    return check


@rule(
    "camera-model-unknown",
    "a camera model that COLMAP does not know",
    severity=Severity.REFUSED,
    advice=f"use one of {', '.join(list(CAMERA_MODELS)[:7])}",
)
def _unknown_model(subject: Subject) -> Evidence | None:
    return _cameras(
        subject,
        [f"camera {camera.camera_id}: {camera.model}" for camera in subject.model.cameras if not _known(camera)],
    )


@rule(
    "camera-missing",
    "images name a camera that is not there",
    severity=Severity.REFUSED,
    advice="write the cameras of all images",
)
def _missing(subject: Subject) -> Evidence | None:
    images, known = subject.model.images, subject.model.camera_by_id
    found = [
        f"{name!r}: camera {camera_id}"
        for name, camera_id in zip(images.names, images.camera_ids.tolist(), strict=True)
        if camera_id not in known
    ]
    return offenders(found, of=len(images), unit="images")


@rule("camera-unused", "cameras without an image", severity=Severity.NOTE, advice="leave them out")
def _unused(subject: Subject) -> Evidence | None:
    used = set(subject.model.images.camera_ids.tolist())
    return _cameras(
        subject, [f"camera {camera.camera_id}" for camera in subject.model.cameras if camera.camera_id not in used]
    )


@rule(
    "camera-per-image",
    "every image has a camera of its own",
    severity=Severity.NOTE,
    advice="photographs of one camera should share it: focal lengths of single images are guesses that do not "
    "agree (`smust3r-colmap refine` joins them)",
)
def _per_image(subject: Subject) -> Evidence | None:
    num_used = len(set(subject.model.images.camera_ids.tolist()))
    if num_used < 3 or num_used < len(subject.model.images):
        return None
    return measured(f"{num_used} cameras for {len(subject.model.images)} images")


@rule(
    "camera-id-not-one",
    "the ids of the cameras are not just 1",
    severity=Severity.FACT,
    advice="where all images come from one camera, give them one camera with id 1",
)
def _id_not_one(subject: Subject) -> Evidence | None:
    ids = sorted(camera.camera_id for camera in subject.model.cameras)
    return None if ids in ([], [1]) else measured(f"{len(ids)} cameras, ids {_shown(ids)}")


def _shown(ids: list[int]) -> str:
    return ", ".join(map(str, ids)) if len(ids) <= 4 else f"{ids[0]}, {ids[1]} ... {ids[-1]}"


_PERSPECTIVE_FOR_NERFSTUDIO = frozenset({"SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"})


@rule(
    "camera-kinds-mixed",
    "perspective and other cameras in one model",
    severity=Severity.FACT,
    advice=_UNDISTORT,
)
def _mixed(subject: Subject) -> Evidence | None:
    kinds = {camera.model in _PERSPECTIVE_FOR_NERFSTUDIO: camera for camera in subject.model.cameras}
    if len(kinds) < 2:
        return None
    return measured(" and ".join(f"camera {camera.camera_id} is {camera.model}" for camera in kinds.values()))


@rule(
    "camera-size-zero",
    "cameras without a size",
    severity=Severity.REFUSED,
    advice="write width and height of the image files",
)
def _size_zero(subject: Subject) -> Evidence | None:
    found = [
        f"camera {camera.camera_id}: {camera.width} x {camera.height}"
        for camera in subject.model.cameras
        if camera.width <= 0 or camera.height <= 0
    ]
    return _cameras(subject, found)


@rule(
    "principal-point-off-centre",
    "the principal point is not the centre of the image",
    severity=Severity.FACT,
    advice="crop the images around it; the training dataset of a run has it in the centre",
)
def _off_centre(subject: Subject) -> Evidence | None:
    found = []
    for camera in subject.model.cameras:
        point = camera.principal_point
        if point is None or _scaled(camera):
            continue
        off = max(abs(point[0] - camera.width / 2), abs(point[1] - camera.height / 2))
        if off > _OFF_CENTRE_PX:
            found.append(f"camera {camera.camera_id}: {off:.1f} px off")
    return _cameras(subject, found)


@rule(
    "intrinsics-other-resolution",
    "the intrinsics are those of another resolution than the camera's size",
    severity=Severity.REFUSED,
    advice="multiply focal lengths and principal point by the ratio; many networks export what they saw after resizing",
)
def _other_resolution(subject: Subject) -> Evidence | None:
    found = []
    for camera in subject.model.cameras:
        point = camera.principal_point
        if point is not None and _scaled(camera):
            found.append(
                f"camera {camera.camera_id}: principal point ({point[0]:.0f}, {point[1]:.0f}) "
                f"in {camera.width} x {camera.height}"
            )
    return _cameras(subject, found)


def _scaled(camera: Camera) -> bool:
    """The principal point is the centre of a picture of the same shape and another size."""
    point = camera.principal_point
    if point is None or camera.width <= 0 or camera.height <= 0:
        return False
    return rescaling(*point, camera.width, camera.height) is not None


@rule(
    "principal-point-zero",
    "the principal point is the corner of the image",
    severity=Severity.REFUSED,
    advice="write the middle of the image, where nothing better is known (`smust3r-colmap refine` does)",
)
def _principal_point_zero(subject: Subject) -> Evidence | None:
    found = [f"camera {camera.camera_id}" for camera in subject.model.cameras if camera.principal_point == (0, 0)]
    return _cameras(subject, found)


@rule(
    "focal-impossible",
    "a focal length that cannot be one",
    severity=Severity.REFUSED,
    advice="leave out the images of this camera, or give it the focal length of the others: it was never estimated, or "
    "another number stands in its place",
)
def _focal_impossible(subject: Subject) -> Evidence | None:
    found = [
        f"camera {camera.camera_id}: {value:g} px"
        for camera in subject.model.cameras
        for value in camera.focal
        if _is_impossible(camera, value)
    ]
    return _cameras(subject, found)


def _is_impossible(camera: Camera, focal: float) -> bool:
    return focal <= 0 or focal > FOCAL_RATIO_RANGE[1] * max(camera.width, camera.height, 1)


@rule(
    "focal-absurd",
    "a focal length that no lens has",
    severity=Severity.WARNING,
    advice="focal lengths are in pixels of the full image: 0.5 to 3 times its longer side are usual",
)
def _focal_absurd(subject: Subject) -> Evidence | None:
    found = []
    for camera in subject.model.cameras:
        side = max(camera.width, camera.height)
        possible = [focal for focal in camera.focal if not _is_impossible(camera, focal)]
        if side > 0 and any(not _FOCAL_RATIO_RANGE[0] <= focal / side <= _FOCAL_RATIO_RANGE[1] for focal in possible):
            found.append(f"camera {camera.camera_id}: {camera.focal[0]:g} px for {camera.width} x {camera.height}")
    return _cameras(subject, found)


@rule(
    "focal-unequal",
    "the two focal lengths differ by more than a tenth",
    severity=Severity.WARNING,
    advice="pixels are square: were the images resized to another shape? Estimate the camera again at full size",
)
def _focal_unequal(subject: Subject) -> Evidence | None:
    found = []
    for camera in subject.model.cameras:
        if len(camera.focal) == 2 and not any(_is_impossible(camera, focal) for focal in camera.focal):
            ratio = camera.focal[0] / camera.focal[1]
            if not _FOCAL_ASPECT_RANGE[0] <= ratio <= _FOCAL_ASPECT_RANGE[1]:
                found.append(f"camera {camera.camera_id}: fx / fy = {ratio:.2f}")
    return _cameras(subject, found)


@rule(
    "distortion-absurd",
    "a distortion that no lens has",
    severity=Severity.WARNING,
    advice="estimate the camera again, with a simpler model or more images",
)
def _distortion_absurd(subject: Subject) -> Evidence | None:
    found = []
    for camera in subject.model.cameras:
        largest = max(camera.distortion, key=abs, default=0.0)
        if _known(camera) and CAMERA_MODELS[camera.model].fractional and abs(largest) > _MAX_DISTORTION:
            found.append(f"camera {camera.camera_id}: a parameter of {largest:.3g}")
    return _cameras(subject, found)


def _known(camera: Camera) -> bool:
    return camera.model in CAMERA_MODELS


def _cameras(subject: Subject, found: list[str]) -> Evidence | None:
    return offenders(found, of=len(subject.model.cameras), unit="cameras")


RULES = (
    *map(_camera_model_rule, CAMERA_MODELS),
    _unknown_model,
    _missing,
    _unused,
    _per_image,
    _id_not_one,
    _mixed,
    _size_zero,
    _off_centre,
    _other_resolution,
    _principal_point_zero,
    _focal_impossible,
    _focal_absurd,
    _focal_unequal,
    _distortion_absurd,
)
"""In the order in which they are reported."""
