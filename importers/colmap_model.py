"""A COLMAP model that another program wrote, as initial cameras, poses and surface points.

Known defects of exports are repaired and reported with counts. Two mistakes do not show in the numbers: camera centres
in the place of translations, and rotations from camera to world. With them hardly a match agrees with the poses. The
next module to read is ``fitted_model``, which joins the model with the image files.
"""

from __future__ import annotations

import logging
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from smust3r_colmap.errors import InputError
from smust3r_colmap.geometry.arrays import FloatArray, IntArray
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.importers.colmap_records import CameraRecord, Fixes, ImageRecord, PointRecords, read_records
from smust3r_colmap.importers.intrinsics_units import in_pixels
from smust3r_colmap.importers.rig_poses import Pose, is_same_pose
from smust3r_colmap.products import EMPTY_CLOUD, PointCloud, RejectedImage

logger = logging.getLogger(__name__)


MIN_IMAGES = 2
UNUSABLE_MODELS = ("EQUIRECTANGULAR", "EUCM")
"""Camera models of COLMAP that are not adjusted: a panorama has no focal length and sees behind itself, and the shape
parameter of the other is above 1, which COLMAP's mapper takes for a broken distortion."""
QUATERNION_ROUNDING = 1e-4
"""How far the length of a quaternion may be from 1 without a word: text with five digits."""
MAX_QUATERNION_LENGTH_ERROR = 0.1
"""Beyond that it is no rotation written carelessly, but another number: a shifted column, an unscaled axis."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SurfacePoints:
    """Points of the surface, and where it is known which images see them.

    Args:
        cloud: in the world of the model; may be empty.
        point_of_observation: (M,) row of the cloud. image_of_observation: (M,) number of the image. Only points
            that two images or more see have observations, and each image is named once.
    """

    cloud: PointCloud
    point_of_observation: IntArray
    image_of_observation: IntArray

    def __post_init__(self) -> None:
        if self.point_of_observation.shape != self.image_of_observation.shape:
            raise ValueError("SurfacePoints: the arrays of observations differ in length")


@dataclass(frozen=True, kw_only=True, eq=False)
class ExternalModel:
    """A model of another program, checked, with known defects repaired.

    Args:
        folder: where its files lie.
        names: of the images that have a pose, as the model spells them, without repeats.
        camera_ids: of each image, keys of ``cameras``.
        cameras: intrinsics, at whatever image size the model says.
        cam_from_world: (N, 3, 4) rigid.
        surface: its points; images are positions in ``names``.
        unposed: images that are in the files but have no usable pose.
        fixes: what was repaired, one sentence each, with counts.
    """

    folder: Path
    names: tuple[str, ...]
    camera_ids: tuple[int, ...]
    cameras: Mapping[int, Intrinsics]
    cam_from_world: FloatArray
    surface: SurfacePoints
    unposed: tuple[RejectedImage, ...]
    fixes: tuple[str, ...]

    def __post_init__(self) -> None:
        n = len(self.names)
        if len(set(self.names)) != n or len(self.camera_ids) != n or self.cam_from_world.shape != (n, 3, 4):
            raise ValueError(f"ExternalModel: {n} names, {len(self.camera_ids)} cameras, {self.cam_from_world.shape}")
        if missing := set(self.camera_ids) - set(self.cameras):
            raise ValueError(f"ExternalModel: no intrinsics for cameras {sorted(missing)}")

    def __len__(self) -> int:
        return len(self.names)


def read_colmap_model(folder: Path) -> ExternalModel:
    """Read the model in ``folder``, binary or text; see ``colmap_records`` for where it is looked for.

    Points may be missing altogether. Tracks are kept where two images or more of the model stand in them;
    elements that name other images, such as the ``0 0`` that fill the lines of some exporters, are dropped.

    Raises:
        InputError: no model, a broken file, a duplicate image id or name, an unknown camera, a rotation that is
            none, or fewer than two images with a pose; names file, line and number.
    """
    fixes = Fixes()
    records = read_records(folder, fixes)
    images = [by_frame(record, records.poses_by_frame, fixes) for record in records.images]
    posed = [record for record in images if np.isfinite(record.numbers).all()]
    if len(posed) < MIN_IMAGES:
        raise InputError(
            f"{records.folder}: {len(posed)} of {len(records.images)} images have a pose, needed are {MIN_IMAGES}"
        )
    refuse_twins([(record.camera_id, record.place) for record in records.cameras], "camera id")
    refuse_twins([(record.image_id, record.place) for record in records.images], "image id")
    names = [tidy_name(record, fixes) for record in posed]
    refuse_twins([(name, record.place) for name, record in zip(names, posed, strict=True)], "image name")
    cameras = {record.camera_id: record for record in records.cameras}
    first_image_of = {record.camera_id: record for record in reversed(posed)}
    intrinsics = {camera_id: _intrinsics(cameras, image, fixes) for camera_id, image in sorted(first_image_of.items())}
    model = ExternalModel(
        folder=records.folder,
        names=tuple(names),
        camera_ids=tuple(record.camera_id for record in posed),
        cameras=intrinsics,
        cam_from_world=np.stack([cam_from_world_of(record, fixes) for record in posed]),
        surface=_surface(records.points, [record.image_id for record in posed], records.folder, fixes),
        unposed=tuple(
            RejectedImage(name=record.name, reason=f"its pose in the model is not finite ({record.place})")
            for record in images
            if record not in posed
        ),
        fixes=fixes.texts(),
    )
    logger.info("%s: %d images, %d points", model.folder, len(model), len(model.surface.cloud))
    return model


def refuse_twins(keys: Sequence[tuple[Hashable, str]], what: str) -> None:
    """Refuse keys, each with its place, of which two are the same."""
    place_of: dict[Hashable, str] = {}
    for key, place in keys:
        if key in place_of:
            raise InputError(f"{place}: {what} {key!r} was there before ({place_of[key]}); every {what} may stand once")
        place_of[key] = place


def by_frame(record: ImageRecord, poses: Mapping[int, Pose], fixes: Fixes) -> ImageRecord:
    """With the pose of its frame where the line of the image says another, as COLMAP reads it."""
    numbers = poses.get(record.image_id)
    if numbers is None or is_same_pose(record.numbers, numbers):
        return record
    fixes.note(
        "images have another pose in their line than by rigs and frames, which were taken as COLMAP does", record.place
    )
    return replace(record, numbers=numbers)


def tidy_name(record: ImageRecord, fixes: Fixes) -> str:
    """With forward slashes, as names are in COLMAP."""
    fixes.note("image names with backslashes", record.place, count="\\" in record.name)
    name = record.name.replace("\\", "/")
    if not name:
        raise InputError(f"{record.place}: image {record.image_id} has no name; write the name of its file")
    return name


def _intrinsics(cameras: Mapping[int, CameraRecord], image: ImageRecord, fixes: Fixes) -> Intrinsics:
    """The camera of an image, in pixels, as numbers that COLMAP can use."""
    record = cameras.get(image.camera_id)
    if record is None:
        known = ", ".join(map(str, sorted(cameras)[:5])) or "none"
        raise InputError(
            f"{image.place}: {image.name} has camera {image.camera_id}, which is not there; known: {known}"
        )
    try:
        intrinsics = Intrinsics(
            model=record.model, width=record.width, height=record.height, params=record.params, has_prior_focal=True
        )
    except ValueError as error:
        raise InputError(f"{record.place}: camera {record.camera_id} cannot be used: {error}") from error
    if record.model in UNUSABLE_MODELS:
        raise InputError(
            f"{record.place}: camera {record.camera_id} is {record.model}, which is not adjusted here; make images of "
            "a perspective or fisheye camera of it (OPENCV, OPENCV_FISHEYE, ...), and a model of these"
        )
    num_focal = len(intrinsics.colmap_camera().focal_length_idxs())
    mended = in_pixels(
        record.params,
        record.width,
        record.height,
        num_focal=num_focal,
        place=record.place,
        camera=f"camera {record.camera_id}",
    )
    fixes.note(mended.what, record.place, count=bool(mended.what))
    return replace(intrinsics, params=mended.params)


def cam_from_world_of(record: ImageRecord, fixes: Fixes) -> FloatArray:
    """(3, 4), the rotation being that of the nearest unit quaternion."""
    quat_wxyz, translation = np.asarray(record.numbers[:4]), np.asarray(record.numbers[4:])
    length = float(np.linalg.norm(quat_wxyz))
    if abs(length - 1) > MAX_QUATERNION_LENGTH_ERROR:
        raise InputError(
            f"{record.place}: the quaternion of {record.name} has length {length:.4g}, needed is 1; are the columns "
            "QW QX QY QZ TX TY TZ?"
        )
    fixes.note("quaternions were brought to length 1", record.place, count=abs(length - 1) > QUATERNION_ROUNDING)
    rotation = Rotation.from_quat(quat_wxyz[[1, 2, 3, 0]]).as_matrix()
    return np.column_stack([rotation, translation])


def _surface(points: PointRecords | None, image_ids: Sequence[int], folder: Path, fixes: Fixes) -> SurfacePoints:
    """The finite points, and of their tracks what is evidence; images by their position in ``image_ids``."""
    if points is None:
        fixes.note("files of points are missing", str(folder))
        nothing = np.empty(0, np.int64)
        return SurfacePoints(cloud=EMPTY_CLOUD, point_of_observation=nothing, image_of_observation=nothing)
    finite: npt.NDArray[np.bool_] = np.asarray(np.isfinite(points.xyz).all(axis=1))
    colours = np.nan_to_num(points.rgb[finite]).clip(0, 255).astype(np.uint8)
    fixes.note("points with a coordinate that is not finite were left out", str(folder), int((~finite).sum()))
    point, image = _evidence(points, np.asarray(image_ids), finite, folder, fixes)
    return SurfacePoints(
        cloud=PointCloud(xyz=points.xyz[finite], rgb=colours),
        point_of_observation=(np.cumsum(finite) - 1)[point],
        image_of_observation=image,
    )


def _evidence(
    points: PointRecords, image_ids: IntArray, usable: npt.NDArray[np.bool_], folder: Path, fixes: Fixes
) -> tuple[IntArray, IntArray]:
    """Row of the point and position of the image, (M,) each, each pair once, of points in two images or more."""
    order = np.argsort(image_ids)
    place = np.minimum(np.searchsorted(image_ids, points.image_id_of_element, sorter=order), len(image_ids) - 1)
    image = order[place]
    known = image_ids[image] == points.image_id_of_element
    fixes.note("track elements name an image that has no pose here", str(folder), int((~known).sum()))
    known &= usable[points.point_of_element]
    each_once = np.unique(points.point_of_element[known] * len(image_ids) + image[known])
    point, image = np.divmod(each_once, len(image_ids))
    num_views = np.bincount(point, minlength=len(points.xyz))
    alone = np.bincount(points.point_of_element, minlength=len(points.xyz)).astype(bool) & usable & (num_views < 2)
    fixes.note("points have a track that is none (fewer than two images) and lost it", str(folder), int(alone.sum()))
    seen_by_two = num_views[point] >= 2
    return point[seen_by_two], image[seen_by_two]
