"""Rules about where cameras and points are: finite, in front, near each other, and true to the images."""

from __future__ import annotations

import numpy as np

from smust3r_colmap.geometry.arrays import BoolArray, FloatArray, IntArray
from smust3r_colmap.importers.rig_poses import Pose, composed, is_same_pose
from smust3r_colmap.validation.description import Frame, Rig, Subject
from smust3r_colmap.validation.rules import Evidence, Severity, measured, offenders, rule

_HIGH_ERROR_PX = 2.0
"""Mean reprojection error before any adjustment that a usable model stays below."""

_FAR_CAMERA_RADII = 10.0
_FAR_POINT_RADII = 50.0
"""Distances over the radius that half of all cameras lie in, or nine tenths of the points. Of nineteen models of
photographs by COLMAP's two mappers the sound ones stay below 4 and 24; two have a camera at 400 and at 9,000."""

_LARGE_COORDINATE = 1e5
"""Single precision then has steps of a centimetre, if the unit is a metre."""

_QUATERNION_LENGTH_TOLERANCE = 1e-3
_MAX_QUATERNION_LENGTH_ERROR = 0.1
"""Beyond that it is no rotation written carelessly, but other numbers."""


@rule(
    "pose-not-finite",
    "poses that are no numbers, or have a quaternion of zeros",
    severity=Severity.REFUSED,
    advice="leave these images out",
)
def _pose_not_finite(subject: Subject) -> Evidence | None:
    return _images(subject, ~subject.model.images.finite)


@rule(
    "pose-quaternion",
    "quaternions that are not of length one",
    severity=Severity.WARNING,
    advice="normalise them; COLMAP does it on reading, others compute with a rotation that also scales",
)
def _quaternion(subject: Subject) -> Evidence | None:
    images = subject.model.images
    error = np.abs(np.linalg.norm(images.quat_wxyz, axis=1) - 1)
    careless = (error > _QUATERNION_LENGTH_TOLERANCE) & (error <= _MAX_QUATERNION_LENGTH_ERROR)
    return _images(subject, images.finite & careless)


@rule(
    "pose-quaternion-none",
    "quaternions that are no rotation",
    severity=Severity.REFUSED,
    advice="columns are IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME: were translation and quaternion swapped, or is a "
    "column missing?",
)
def _no_quaternion(subject: Subject) -> Evidence | None:
    images = subject.model.images
    length = np.linalg.norm(images.quat_wxyz, axis=1)
    wrong = np.flatnonzero(images.finite & (np.abs(length - 1) > _MAX_QUATERNION_LENGTH_ERROR))
    found = [f"{images.names[index]!r}: length {length[index]:.4g}, needed is 1" for index in wrong]
    return offenders(found, of=len(images), unit="images")


@rule(
    "camera-not-finite",
    "cameras with parameters that are no numbers",
    severity=Severity.REFUSED,
    advice="estimate the cameras again",
)
def _camera_not_finite(subject: Subject) -> Evidence | None:
    cameras = subject.model.cameras
    found = [f"camera {camera.camera_id}" for camera in cameras if not np.isfinite(camera.params).all()]
    return offenders(found, of=len(cameras), unit="cameras")


@rule(
    "point-not-finite",
    "points at no finite place",
    severity=Severity.REFUSED,
    advice="delete them: one is enough to make every mean and every box of a trainer NaN",
)
def _point_not_finite(subject: Subject) -> Evidence | None:
    points = subject.model.points
    return None if points is None else _points(subject, np.any(~np.isfinite(points.xyz), axis=1))


@rule(
    "observation-not-finite",
    "observations at no finite place",
    severity=Severity.REFUSED,
    advice="delete them",
)
def _observation_not_finite(subject: Subject) -> Evidence | None:
    images = subject.model.images
    found = np.flatnonzero(~np.isfinite(images.xy_img).all(axis=1))
    if len(found) == 0:
        return None
    image = int(np.searchsorted(images.starts, found[0], side="right")) - 1
    return Evidence(
        count=len(found), of=len(images.xy_img), unit="observations", example=f"one in {images.names[image]!r}"
    )


@rule(
    "point-behind-camera",
    "points lie behind a camera that is said to see them",
    severity=Severity.WARNING,
    advice="if it is most of them, the poses are camera-to-world or have other axes; else drop these observations",
)
def _behind(subject: Subject) -> Evidence | None:
    points, seen = subject.model.points, subject.projection
    behind = np.flatnonzero(seen.perspective & (seen.depth <= 0))
    if points is None or len(behind) == 0:
        return None
    first = behind[0]
    example = (
        f"point {points.ids[points.point_of_element[first]]} "
        f"in {subject.model.images.names[seen.image_index[first]]!r} at depth {seen.depth[first]:.3g}"
    )
    return Evidence(count=len(behind), of=len(seen.depth), unit="observations in tracks", example=example)


@rule(
    "image-looks-away",
    "images whose view has none of the points",
    severity=Severity.WARNING,
    advice="poses must be cam_from_world with x right, y down, z forward; not camera centres, not OpenGL's axes",
)
def _looks_away(subject: Subject) -> Evidence | None:
    if subject.projection.num_sampled == 0:
        return None
    return _images(subject, subject.projection.num_in_view == 0)


@rule(
    "reprojection-high",
    "the points do not project to where they were observed",
    severity=Severity.WARNING,
    advice="`smust3r-colmap refine MODEL --images DIR`, or pycolmap.bundle_adjustment; are the intrinsics those of "
    "the full image?",
)
def _reprojection(subject: Subject) -> Evidence | None:
    errors = subject.projection.error_px[np.isfinite(subject.projection.error_px)]
    if len(errors) == 0 or errors.mean() <= _HIGH_ERROR_PX:
        return None
    return measured(f"{errors.mean():.3g} px mean, {np.median(errors):.3g} px median of {len(errors):,} observations")


@rule(
    "outlier-cameras",
    "cameras far away from all others",
    severity=Severity.WARNING,
    advice="leave these images out: they stretch the box that trainers normalise the scene to",
)
def _far_cameras(subject: Subject) -> Evidence | None:
    images = subject.model.images
    usable = np.flatnonzero(images.finite)
    if len(usable) < 3:
        return None
    relative = _relative_distance(images.centre_world[usable], 0.5)
    far = np.zeros(len(images), np.bool_)
    far[usable[relative > _FAR_CAMERA_RADII]] = True
    return _images(subject, far)


@rule(
    "outlier-points",
    "points far away from all others",
    severity=Severity.WARNING,
    advice="delete them, or write the training dataset, which leaves them out",
)
def _far_points(subject: Subject) -> Evidence | None:
    points = subject.model.points
    if points is None or len(points) < 10:
        return None
    far = np.zeros(len(points), np.bool_)
    usable = np.flatnonzero(np.isfinite(points.xyz).all(axis=1))
    far[usable] = _relative_distance(points.xyz[usable], 0.9) > _FAR_POINT_RADII
    return _points(subject, far)


def _relative_distance(xyz: FloatArray, share: float) -> FloatArray:
    """Distance from the median place over the radius that this share of the places lies in."""
    if len(xyz) == 0:
        return np.empty(0)
    distance = np.linalg.norm(xyz - np.median(xyz, axis=0), axis=1)
    radius = float(np.quantile(distance, share))
    return distance / radius if radius > 0 else np.zeros(len(xyz))


@rule(
    "coordinates-large",
    "cameras far from the origin",
    severity=Severity.NOTE,
    advice="subtract an offset and keep it beside the model: programs with 32-bit numbers round such coordinates",
)
def _large(subject: Subject) -> Evidence | None:
    centres = subject.model.images.centre_world[subject.model.images.finite]
    largest = float(np.abs(centres).max(initial=0))
    return measured(f"a coordinate of {largest:.4g}") if largest > _LARGE_COORDINATE else None


@rule(
    "points-colourless",
    "all points are black",
    severity=Severity.NOTE,
    advice="let COLMAP take the colours from the images (Reconstruction.extract_colors_for_all_images)",
)
def _colourless(subject: Subject) -> Evidence | None:
    points = subject.model.points
    if points is None or len(points) == 0 or points.rgb.any():
        return None
    return measured(f"{len(points):,} points")


@rule(
    "rig-not-trivial",
    "rigs of several sensors",
    severity=Severity.NOTE,
    advice="nothing: COLMAP 4 reads them, other programs take the poses in images",
)
def _rig_not_trivial(subject: Subject) -> Evidence | None:
    rigs = subject.model.rigs or ()
    found = [f"rig {rig.rig_id} with {len(rig.sensors)} sensors" for rig in rigs if len(rig.sensors) != 1]
    return offenders(found, of=len(rigs), unit="rigs")


@rule(
    "frame-dangling",
    "frames and images do not belong together",
    severity=Severity.WARNING,
    advice="delete rigs and frames: COLMAP then makes both up; or write the model again with pycolmap",
)
def _frame_dangling(subject: Subject) -> Evidence | None:
    frames, image_ids = subject.model.frames, subject.model.images.ids.tolist()
    if frames is None or subject.model.rigs is None:
        return None
    known, rig_ids = set(image_ids), {rig.rig_id for rig in subject.model.rigs}
    framed = {image_id for frame in frames for image_id in frame.image_ids}
    found = [f"image {image_id} is in no frame" for image_id in image_ids if image_id not in framed]
    found += [f"a frame names image {image_id}, which is not there" for image_id in sorted(framed - known)]
    found += [
        f"frame {frame.frame_id} names rig {frame.rig_id}, which is not there"
        for frame in frames
        if frame.rig_id not in rig_ids
    ]
    return offenders(found, of=len(known | framed), unit="frames and images")


@rule(
    "frame-pose-differs",
    "frames have another pose than their image",
    severity=Severity.WARNING,
    advice="COLMAP takes the frame's pose, every other program the image's; delete rigs and frames, or correct one",
)
def _frame_pose(subject: Subject) -> Evidence | None:
    rigs = {rig.rig_id: rig for rig in subject.model.rigs or ()}
    images = subject.model.images
    index_by_id = {image_id: index for index, image_id in enumerate(images.ids.tolist())}
    found, num_compared = [], 0
    for frame in subject.model.frames or ():
        for kind, sensor_id, image_id in frame.data:
            pose = _by_frame(rigs.get(frame.rig_id), (kind, sensor_id), frame)
            index = index_by_id.get(image_id)
            if pose is None or index is None or kind != 0 or not images.finite[index]:
                continue
            num_compared += 1
            if not is_same_pose((*images.quat_wxyz[index].tolist(), *images.translation[index].tolist()), pose):
                found.append(f"{images.names[index]!r} in frame {frame.frame_id}")
    return offenders(found, of=num_compared, unit="images in frames")


def _by_frame(rig: Rig | None, sensor: tuple[int, int], frame: Frame) -> Pose | None:
    """sensor_from_world; None where the rig is not there, or does not say where the sensor is."""
    rig_from_world = (*frame.quat_wxyz, *frame.translation)
    if rig is None or not rig.sensors:
        return None
    if sensor == rig.sensors[0]:
        return rig_from_world
    pose = rig.sensor_from_rig.get(sensor)
    return None if pose is None else composed(pose, rig_from_world)


def _images(subject: Subject, wrong: BoolArray) -> Evidence | None:
    names = subject.model.images.names
    return offenders([repr(names[index]) for index in np.flatnonzero(wrong)], of=len(names), unit="images")


def _points(subject: Subject, wrong: BoolArray) -> Evidence | None:
    points = subject.model.points
    found: IntArray = np.flatnonzero(wrong)
    if points is None or len(found) == 0:
        return None
    x, y, z = points.xyz[found[0]]
    example = f"point {points.ids[found[0]]} at ({x:.4g}, {y:.4g}, {z:.4g})"
    return Evidence(count=len(found), of=len(points), unit="points", example=example)


RULES = (
    _pose_not_finite,
    _quaternion,
    _no_quaternion,
    _camera_not_finite,
    _point_not_finite,
    _observation_not_finite,
    _behind,
    _looks_away,
    _reprojection,
    _far_cameras,
    _far_points,
    _large,
    _colourless,
    _rig_not_trivial,
    _frame_dangling,
    _frame_pose,
)
"""In the order in which they are reported."""
