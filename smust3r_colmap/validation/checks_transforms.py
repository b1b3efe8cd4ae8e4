"""Rules about transforms.json: does it name files that are there, and cameras that are those of the model?"""

from __future__ import annotations

from collections.abc import Collection
from pathlib import PurePosixPath

import numpy as np

from smust3r_colmap.errors import DegenerateAlignmentError
from smust3r_colmap.evaluation.trajectory import Evaluation, compare_trajectories
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.validation.description import Images, Subject, TransformsFile, TransformsFrame
from smust3r_colmap.validation.rules import Evidence, Severity, measured, offenders, rule
from smust3r_colmap.validation.transforms_file import INTRINSICS

_KNOWN_MODELS = (
    "",
    "SIMPLE_PINHOLE",
    "PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "OPENCV_FISHEYE",
    "EQUIRECTANGULAR",
    "OMNIDIRECTIONALSTEREO_L",
    "OMNIDIRECTIONALSTEREO_R",
    "VR180_L",
    "VR180_R",
    "ORTHOPHOTO",
    "FISHEYE624",
)
"""All that nerfstudio's table of camera models has; it takes a file that names none (the first) for a perspective
camera."""

_ROUNDING_TOLERANCE = 1e-3
"""How far a rotation may be from orthonormal, and a camera from its place over the extent of all: rounded text."""
_ROUNDING_TOLERANCE_DEG = 0.1
_MIN_COMPARED_CAMERAS = 3
_OPENCV_AXES = np.diag([1.0, -1.0, -1.0])

_WRITE_TRAINER = "write the training dataset again"
_PATHS = "its paths are relative to its own folder, with the ending of the file"


@rule(
    "transforms-unreadable",
    "transforms.json cannot be read",
    severity=Severity.WARNING,
    advice=f"delete it, or {_WRITE_TRAINER}; it is JSON with a list of frames, each with a file_path",
)
def _unreadable(subject: Subject) -> Evidence | None:
    if subject.transforms is None or not subject.transforms.problem:
        return None
    return measured(subject.transforms.problem)


@rule(
    "transforms-comments",
    "transforms.json has comments",
    severity=Severity.WARNING,
    advice="leave them out; JSON has none",
)
def _comments(subject: Subject) -> Evidence | None:
    if subject.transforms is None or not subject.transforms.has_comments:
        return None
    return measured("// or /* */ outside of its texts")


@rule(
    "transforms-image-missing",
    "transforms.json names images that are not there",
    severity=Severity.WARNING,
    advice=_PATHS,
)
def _image_missing(subject: Subject) -> Evidence | None:
    if subject.transforms is None or subject.transforms.has_sharpness:
        return None
    return _missing_images(subject.transforms)


@rule(
    "transforms-sharp-image-missing",
    "transforms.json has a sharpness for its frames, and names images that are not there",
    severity=Severity.WARNING,
    advice=_PATHS,
)
def _sharp_image_missing(subject: Subject) -> Evidence | None:
    if subject.transforms is None or not subject.transforms.has_sharpness:
        return None
    return _missing_images(subject.transforms)


def _missing_images(transforms: TransformsFile) -> Evidence | None:
    there = transforms.images.keys() | transforms.images_by_ending.keys()
    found = [repr(frame.file_path) for frame in transforms.frames if frame.file_path not in there]
    return offenders(found, of=len(transforms.frames), unit="frames")


@rule(
    "transforms-image-ending",
    "transforms.json names images without their ending",
    severity=Severity.WARNING,
    advice="write the ending of the file, such as .png",
)
def _image_ending(subject: Subject) -> Evidence | None:
    if subject.transforms is None:
        return None
    frames, there = subject.transforms.frames, subject.transforms.images_by_ending
    found = [repr(frame.file_path) for frame in frames if frame.file_path in there]
    return offenders(found, of=len(frames), unit="frames")


@rule(
    "transforms-masks-incomplete",
    "some frames of transforms.json have a mask and others none, or one that is not there",
    severity=Severity.WARNING,
    advice="name a mask for every frame, white where everything is kept, or none at all",
)
def _masks_incomplete(subject: Subject) -> Evidence | None:
    if subject.transforms is None or not any(frame.mask_path for frame in subject.transforms.frames):
        return None
    frames, there = subject.transforms.frames, subject.transforms.images
    found = [repr(frame.mask_path or frame.file_path) for frame in frames if frame.mask_path not in there]
    return offenders(found, of=len(frames), unit="frames")


@rule(
    "transforms-points-missing",
    "transforms.json names no file of points that is there",
    severity=Severity.WARNING,
    advice="write the points in the world of transforms.json, and their file as ply_file_path",
)
def _points_missing(subject: Subject) -> Evidence | None:
    transforms = subject.transforms
    if transforms is None or transforms.problem or transforms.ply_is_there:
        return None
    return measured(f"{transforms.ply_file_path!r} is not there" if transforms.ply_file_path else "no ply_file_path")


@rule(
    "transforms-camera-model",
    "transforms.json has a camera model that nerfstudio does not know",
    severity=Severity.WARNING,
    advice=f"use one of {', '.join(_KNOWN_MODELS[1:])}",
)
def _camera_model(subject: Subject) -> Evidence | None:
    if subject.transforms is None or subject.transforms.camera_model in _KNOWN_MODELS:
        return None
    return measured(repr(subject.transforms.camera_model))


@rule(
    "transforms-intrinsics",
    "frames of transforms.json lack intrinsics, or have some that no camera has",
    severity=Severity.WARNING,
    advice=f"write {', '.join(INTRINSICS)} in pixels, for the whole file or for every frame",
)
def _intrinsics(subject: Subject) -> Evidence | None:
    if subject.transforms is None:
        return None
    frames = subject.transforms.frames
    found = [f"{frame.file_path!r}: {what}" for frame in frames if (what := _wrong_intrinsics(frame))]
    return offenders(found, of=len(frames), unit="frames")


def _wrong_intrinsics(frame: TransformsFrame) -> str:
    for name in INTRINSICS:
        value = frame.numbers.get(name)
        if value is None:
            return f"no {name}"
        if not np.isfinite(value) or (value <= 0 and name not in ("cx", "cy")):
            return f"{name} is {value:g}"
    return ""


@rule(
    "transforms-size-differs",
    "images have another size than transforms.json says",
    severity=Severity.WARNING,
    advice=f"{_WRITE_TRAINER}; focal lengths and principal points are in pixels of the size w x h",
)
def _size_differs(subject: Subject) -> Evidence | None:
    if subject.transforms is None:
        return None
    found, files = [], {**subject.transforms.images, **subject.transforms.images_by_ending}
    for frame in subject.transforms.frames:
        width, height = frame.numbers.get("w", np.nan), frame.numbers.get("h", np.nan)
        if not np.isfinite([width, height]).all():
            continue
        for file in (files.get(name) for name in (frame.file_path, frame.mask_path)):
            if file is not None and file.readable and (file.width, file.height) != (width, height):
                found.append(f"{file.name!r} is {file.width} x {file.height}, not {width:g} x {height:g}")
    return offenders(found, of=len(subject.transforms.frames), unit="frames")


@rule(
    "transforms-pose-not-rigid",
    "transforms.json has matrices that are no pose of a camera",
    severity=Severity.WARNING,
    advice="transform_matrix is 4 x 4, camera to world: finite, orthonormal, right-handed, last row 0 0 0 1",
)
def _pose_not_rigid(subject: Subject) -> Evidence | None:
    if subject.transforms is None:
        return None
    frames = subject.transforms.frames
    found = [f"{frame.file_path!r}: {what}" for frame in frames if (what := _not_rigid(frame.world_from_opengl))]
    return offenders(found, of=len(frames), unit="frames")


def _not_rigid(matrix: FloatArray) -> str:
    if not np.isfinite(matrix).all():
        return "not 4 x 4 finite numbers"
    if not np.allclose(matrix[3], (0, 0, 0, 1)):
        return f"the last row is {' '.join(f'{number:g}' for number in matrix[3])}"
    rotation = matrix[:3, :3]
    with np.errstate(over="ignore", invalid="ignore"):  # of numbers without measure, which are off by NaN
        off = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if not off <= _ROUNDING_TOLERANCE:
        return f"the rotation is {off:.2g} from orthonormal"
    return "the axes are left-handed" if np.linalg.det(rotation) < 0 else ""


@rule(
    "transforms-images-differ",
    "transforms.json and the model do not have the same images",
    severity=Severity.NOTE,
    advice=f"{_WRITE_TRAINER}, unless images were left out on purpose",
)
def _images_differ(subject: Subject) -> Evidence | None:
    if subject.transforms is None or subject.transforms.problem:
        return None
    names = set(subject.model.images.names)
    of_frames = {
        _name_in_model(subject.transforms, frame, names) or frame.file_path for frame in subject.transforms.frames
    }
    found = [repr(name) for name in sorted(names ^ of_frames)]
    return offenders(found, of=len(names | of_frames), unit="images")


@rule(
    "transforms-cameras-differ",
    "the cameras of transforms.json stand elsewhere than those of the model",
    severity=Severity.WARNING,
    advice=f"{_WRITE_TRAINER}; camera axes are OpenGL's there: x right, y up, z backward",
)
def _cameras_differ(subject: Subject) -> Evidence | None:
    if subject.transforms is None:
        return None
    compared = _compared(subject.transforms, subject.model.images)
    if compared is None:
        return None
    part = compared.position_max / max(compared.extent, np.finfo(float).tiny)
    if part <= _ROUNDING_TOLERANCE and compared.rotation_max_deg <= _ROUNDING_TOLERANCE_DEG:
        return None
    return measured(
        f"up to {part:.2%} of the extent and {compared.rotation_max_deg:.2g} degrees, after the best similarity"
    )


def _compared(transforms: TransformsFile, images: Images) -> Evaluation | None:
    """The poses of both; None where too few can be compared. The world of the file may be turned and scaled."""
    posed = np.flatnonzero(images.finite).tolist()
    of_model = {images.names[k]: np.column_stack([images.rotation[k].T, images.centre_world[k]]) for k in posed}
    of_file = {
        name: np.column_stack([pose[:3, :3] @ _OPENCV_AXES, pose[:3, 3]])
        for frame in transforms.frames
        if (name := _name_in_model(transforms, frame, of_model.keys()))
        and not _not_rigid(pose := frame.world_from_opengl)
    }
    try:
        with np.errstate(over="ignore", invalid="ignore"):  # as above
            return compare_trajectories(of_file, of_model, min_compared=_MIN_COMPARED_CAMERAS)
    except DegenerateAlignmentError:  # two images, or a camera that only turned: no similarity
        return None


def _name_in_model(transforms: TransformsFile, frame: TransformsFrame, names: Collection[str]) -> str:
    """The image of a frame: images/NAME is NAME; empty where the model has none of that name."""
    with_ending = transforms.images_by_ending.get(frame.file_path)
    path = PurePosixPath(with_ending.name if with_ending else frame.file_path)
    candidates = (str(path), str(PurePosixPath(*path.parts[1:])), path.name)
    return next((name for name in candidates if name in names), "")


RULES = (
    _unreadable,
    _comments,
    _image_missing,
    _sharp_image_missing,
    _image_ending,
    _masks_incomplete,
    _points_missing,
    _camera_model,
    _intrinsics,
    _size_differs,
    _pose_not_rigid,
    _images_differ,
    _cameras_differ,
)
"""In the order in which they are reported."""
