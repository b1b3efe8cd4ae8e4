"""A COLMAP model and what lies around it, as plain values that every check can look at.

Nothing here is trusted: ids may repeat, tracks may name images that do not exist, numbers may be NaN. That is why this
is not a ``pycolmap.Reconstruction``, which refuses such models (or, worse, ends the process) before anything can be
reported. Poses are ``cam_from_world`` as the files have them. The next module to read is ``binary_files``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt
import pycolmap

from smust3r_colmap.geometry.arrays import BoolArray, FloatArray, IntArray

NO_POINT = -1
"""Point id of an observation that belongs to no point; COLMAP's largest unsigned number."""


@dataclass(frozen=True, kw_only=True)
class CameraModel:
    """What the files say with a model's number or name.

    Args:
        number: in binary files and databases.
        num_params, num_focal: how many parameters there are, and how many of them are focal lengths.
        perspective: image coordinates are x/z and y/z before distortion, so nothing is seen behind.
        fractional: the parameters after the principal point are distortions, far below 1 for real lenses.
    """

    number: int
    num_params: int
    num_focal: int
    perspective: bool
    fractional: bool


def _camera_models() -> dict[str, CameraModel]:
    """All models that pycolmap knows, by name, in the order of their numbers."""
    found = {}
    for name, model_id in pycolmap.CameraModelId.__members__.items():
        if name != "INVALID":
            camera = pycolmap.Camera.create_from_model_id(1, model_id, 1.0, 2, 2)
            found[name] = CameraModel(
                number=model_id.value,
                num_params=len(camera.params),
                num_focal=len(camera.focal_length_idxs()),
                perspective=camera.is_perspective_pinhole() and name not in _NOT_ON_A_PLANE,
                fractional=name not in _LARGE_DISTORTIONS,
            )
    return dict(sorted(found.items(), key=lambda item: item[1].number))


_NOT_ON_A_PLANE = frozenset({"FOV", "EUCM"})
"""They do not start from x/z and y/z, although pycolmap counts them with the pinhole cameras."""
_LARGE_DISTORTIONS = frozenset({"FULL_OPENCV", "FOV", "EUCM"})
"""A rational function, an angle, and a shape: none of them small for real lenses."""

CAMERA_MODELS: Mapping[str, CameraModel] = _camera_models()
MODEL_NAMES: Mapping[int, str] = {model.number: name for name, model in CAMERA_MODELS.items()}


@dataclass(frozen=True, kw_only=True)
class Camera:
    """One camera; ``model`` may be a name that COLMAP does not know."""

    camera_id: int
    model: str
    width: int
    height: int
    params: tuple[float, ...]

    @property
    def focal(self) -> tuple[float, ...]:
        """One or two focal lengths in pixels; none for a panorama or an unknown model."""
        known = CAMERA_MODELS.get(self.model)
        return () if known is None else self.params[: known.num_focal]

    @property
    def principal_point(self) -> tuple[float, float] | None:
        """(cx, cy) in pixels; None for a panorama or an unknown model."""
        known = CAMERA_MODELS.get(self.model)
        if known is None or known.num_focal == 0:
            return None
        cx, cy = self.params[known.num_focal : known.num_focal + 2]
        return cx, cy

    @property
    def distortion(self) -> tuple[float, ...]:
        """What comes after the principal point."""
        known = CAMERA_MODELS.get(self.model)
        return () if known is None or known.num_focal == 0 else self.params[known.num_focal + 2 :]


@dataclass(frozen=True, kw_only=True)
class Images:
    """All images and their observations, in the order of the file.

    Args:
        ids, camera_ids: (N,).
        names: N.
        quat_wxyz: (N, 4) cam_from_world, not normalised.
        translation: (N, 3).
        starts: (N + 1,); the observations of image n are rows ``starts[n]`` to ``starts[n + 1]``.
        xy_img: (M, 2).
        point_ids: (M,); ``NO_POINT`` where an observation belongs to no point.
    """

    ids: IntArray
    camera_ids: IntArray
    names: tuple[str, ...]
    quat_wxyz: FloatArray
    translation: FloatArray
    starts: IntArray
    xy_img: FloatArray
    point_ids: IntArray

    def __len__(self) -> int:
        return len(self.names)

    @cached_property
    def num_rows(self) -> IntArray:
        """(N,) observations in the file, with and without a point."""
        return np.diff(self.starts)

    @cached_property
    def num_observed(self) -> IntArray:
        """(N,) observations that name a point."""
        before = np.concatenate([[0], np.cumsum(self.point_ids != NO_POINT)])
        return np.asarray(before[self.starts[1:]] - before[self.starts[:-1]], np.int64)

    @cached_property
    def finite(self) -> BoolArray:
        """(N,) the pose is a pose: finite numbers, a quaternion that is not zero."""
        numbers = np.isfinite(self.quat_wxyz).all(1) & np.isfinite(self.translation).all(1)
        return np.asarray(numbers & (np.linalg.norm(self.quat_wxyz, axis=1) > 1e-6), np.bool_)

    @cached_property
    def rotation(self) -> FloatArray:
        """(N, 3, 3) cam_from_world; NaN where the pose is none."""
        with np.errstate(invalid="ignore", divide="ignore"):
            w, x, y, z = (self.quat_wxyz / np.linalg.norm(self.quat_wxyz, axis=1, keepdims=True)).T
        rows = (
            (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        )
        return np.asarray(np.moveaxis(np.array(rows), -1, 0), np.float64)

    @cached_property
    def centre_world(self) -> FloatArray:
        """(N, 3) centres of projection; NaN where the pose is none."""
        return np.asarray(-np.einsum("nji,nj->ni", self.rotation, self.translation), np.float64)


@dataclass(frozen=True, kw_only=True)
class Points:
    """All points and their tracks, in the order of the file.

    Args:
        ids: (P,).
        xyz: (P, 3), world.
        rgb: (P, 3).
        starts: (P + 1,); the track of point p is rows ``starts[p]`` to ``starts[p + 1]``.
        track_images, track_rows: (T,) the image id and the number of the observation in it.
    """

    ids: IntArray
    xyz: FloatArray
    rgb: npt.NDArray[np.uint8]
    starts: IntArray
    track_images: IntArray
    track_rows: IntArray

    def __len__(self) -> int:
        return len(self.ids)

    @cached_property
    def track_length(self) -> IntArray:
        """(P,)."""
        return np.diff(self.starts)

    @cached_property
    def point_of_element(self) -> IntArray:
        """(T,) index of the point that each element of a track belongs to."""
        return np.repeat(np.arange(len(self)), self.track_length)


@dataclass(frozen=True, kw_only=True)
class Rig:
    """``sensors`` are (kind, id), the reference first; kind 0 is a camera.

    ``sensor_from_rig`` are quaternion and translation of those that have a pose, by (kind, id); the reference has none.
    """

    rig_id: int
    sensors: tuple[tuple[int, int], ...]
    sensor_from_rig: Mapping[tuple[int, int], tuple[float, ...]] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Frame:
    """``data`` are (kind, sensor id, image id); the pose is rig_from_world."""

    frame_id: int
    rig_id: int
    quat_wxyz: tuple[float, ...]
    translation: tuple[float, ...]
    data: tuple[tuple[int, int, int], ...]

    @property
    def image_ids(self) -> tuple[int, ...]:
        """Of the camera images in the frame."""
        return tuple(data_id for kind, _, data_id in self.data if kind == 0)


@dataclass(frozen=True, kw_only=True)
class Defect:
    """Something that a file has and should not have.

    Args:
        rule: name of the rule that reports it.
        where: file, and line or byte.
        text: what is there.
    """

    rule: str
    where: str
    text: str


@dataclass(frozen=True, kw_only=True)
class ModelDescription:
    """What the files of one folder say.

    Args:
        folder: where they lie.
        form: which of the two sets was read; binary where both are there, as COLMAP does.
        rigs, frames: None where the file is missing, as in models from before COLMAP 3.12.
        points: None where the file is missing.
        defects: found by the parser.
        unread: files of cameras, images or points that hold something, of which not one record can be read.
    """

    folder: Path
    form: Literal["binary", "text"]
    cameras: tuple[Camera, ...]
    images: Images
    points: Points | None
    rigs: tuple[Rig, ...] | None
    frames: tuple[Frame, ...] | None
    defects: tuple[Defect, ...]
    unread: tuple[str, ...] = ()

    @cached_property
    def camera_by_id(self) -> Mapping[int, Camera]:
        """Of equal ids the last counts."""
        return {camera.camera_id: camera for camera in self.cameras}


@dataclass(frozen=True, kw_only=True)
class Projection:
    """What the tracks say, element by element (T), and what the images look at (N).

    Args:
        image_index: (T,) of the image that an element names; -1 where there is none.
        row: (T,) its observation as a row of ``Images.xy_img``; -1 where there is none.
        depth: (T,) z in the camera; NaN where image, camera, pose or point are not usable.
        error_px: (T,) distance of the projected point from its observation; NaN as above and where the
            depth is not positive.
        perspective: (T,) the camera sees nothing behind itself.
        num_in_view: (N,) sampled points that project into the image; -1 where that cannot be said.
        num_sampled: how many points were tried.
    """

    image_index: IntArray
    row: IntArray
    depth: FloatArray
    error_px: FloatArray
    perspective: BoolArray
    num_in_view: IntArray
    num_sampled: int


@dataclass(frozen=True, kw_only=True)
class ImageFile:
    """An image file by its header.

    Args:
        name: path below its folder, with forward slashes.
        width, height: of the stored pixels; 0 where the header cannot be read.
        turned: EXIF says that the picture is to be turned by a quarter.
    """

    name: str
    width: int
    height: int
    turned: bool = False

    @property
    def readable(self) -> bool:
        """The header says a size."""
        return self.width > 0 and self.height > 0

    def fits(self, width: int, height: int) -> bool:
        """The size is the camera's, as stored or turned upright."""
        sizes = {(self.width, self.height)} | ({(self.height, self.width)} if self.turned else set())
        return (width, height) in sizes


@dataclass(frozen=True, kw_only=True)
class FileFolder:
    """Image files below a folder, sorted by name."""

    folder: Path
    files: tuple[ImageFile, ...]

    @cached_property
    def by_name(self) -> Mapping[str, ImageFile]:
        """For joining with the images of a model."""
        return {file.name: file for file in self.files}


@dataclass(frozen=True, kw_only=True)
class DatabaseImage:
    """One image of a database; ``frame_id`` is None in databases from before COLMAP 3.12."""

    image_id: int
    name: str
    camera_id: int
    frame_id: int | None
    num_keypoints: int


@dataclass(frozen=True, kw_only=True)
class Database:
    """What a model must agree with if COLMAP is to continue from it.

    Args:
        cameras: (model number, width, height) by camera id.
        problem: why it could not be read; empty when it could.
    """

    path: Path
    images: tuple[DatabaseImage, ...]
    cameras: Mapping[int, tuple[int, int, int]]
    problem: str = ""


@dataclass(frozen=True, kw_only=True)
class PlyCloud:
    """The points3D.ply beside the model.

    Args:
        properties: names of the columns of its vertices.
        xyz: (N, 3).
        problem: why it could not be read; empty when it could.
    """

    path: Path
    properties: frozenset[str]
    xyz: FloatArray
    problem: str = ""


@dataclass(frozen=True, kw_only=True)
class DepthFolder:
    """Inverse depth for 3DGS: ``depth_params.json`` beside the model, and a folder of PNGs.

    Args:
        params: (scale, offset) by stem; None where there is no file.
        pngs: stems of the PNGs; None where there is no folder.
        problem: why the JSON could not be read; empty when it could.
    """

    params: Mapping[str, tuple[float, float]] | None
    pngs: frozenset[str] | None
    problem: str = ""


@dataclass(frozen=True, kw_only=True)
class DenseFolder:
    """The stereo part of a dense workspace.

    Args:
        depth_sizes: (width, height) by file name below ``stereo/depth_maps``; zeros where the header is broken.
        normal_maps: file names below ``stereo/normal_maps``.
        fusion_names: lines of fusion.cfg; None where there is none.
    """

    folder: Path
    depth_sizes: Mapping[str, tuple[int, int]]
    normal_maps: frozenset[str]
    fusion_names: tuple[str, ...] | None


@dataclass(frozen=True, kw_only=True, eq=False)
class TransformsFrame:
    """One frame of a transforms.json.

    Args:
        file_path, mask_path: as they stand there; no mask is empty.
        numbers: ``w``, ``h``, ``fl_x`` and so on, those of the whole file where the frame has none of its own; NaN
            where something else than a number stands.
        world_from_opengl: (4, 4) camera to world, y up and z backward; NaN where it is no such matrix.
    """

    file_path: str
    mask_path: str
    numbers: Mapping[str, float]
    world_from_opengl: FloatArray


@dataclass(frozen=True, kw_only=True)
class TransformsFile:
    """The transforms.json of a scene, for nerfstudio and instant-ngp.

    Args:
        camera_model: empty where none is named. ply_file_path: likewise.
        frames: in the order of the file.
        images: headers of the images and masks that it names and that are there, by path as it stands.
        images_by_ending: likewise, of paths without an ending that are there with one of ``ADDED_ENDINGS``.
        ply_is_there: the file of points exists.
        has_sharpness: the first frame by path has one, which is where instant-ngp looks for it.
        has_comments: as no JSON has, but some readers pass over.
        problem: why it could not be read; empty when it could.
    """

    path: Path
    camera_model: str
    ply_file_path: str
    frames: tuple[TransformsFrame, ...]
    images: Mapping[str, ImageFile]
    ply_is_there: bool
    images_by_ending: Mapping[str, ImageFile] = field(default_factory=dict)
    has_sharpness: bool = False
    has_comments: bool = False
    problem: str = ""


@dataclass(frozen=True, kw_only=True)
class Subject:
    """A model with its surroundings: what every rule is asked about.

    Args:
        projection: of the model's tracks.
        images: None where no folder of images is known.
        downscaled: by factor, the folders images_2, images_4 and so on.
        masks, database, ply, depth, dense, transforms: None where there is none.
        siblings: number of images in the numbered models of the same folder, by name, this one included.
        unread_by_colmap: what pycolmap said when it could not read the model; empty when it could or was not asked.
    """

    model: ModelDescription
    projection: Projection
    images: FileFolder | None = None
    downscaled: Mapping[int, FileFolder] = field(default_factory=dict)
    masks: FileFolder | None = None
    database: Database | None = None
    ply: PlyCloud | None = None
    depth: DepthFolder | None = None
    dense: DenseFolder | None = None
    transforms: TransformsFile | None = None
    siblings: Mapping[str, int] = field(default_factory=dict)
    unread_by_colmap: str = ""
