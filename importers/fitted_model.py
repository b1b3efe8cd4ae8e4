"""An external model joined with its image files.

Files are found by name, where only one file fits. Cameras are scaled to the size of the files, because many programs
write them at the size of their network. Cameras that are equal within the scatter of a network become one. The next
module to read is ``stage``.
"""

from __future__ import annotations

import unicodedata
from collections import Counter, defaultdict
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import PurePosixPath
from statistics import median

import numpy as np
import numpy.typing as npt
import pycolmap

from smust3r_colmap.config import CameraConfig
from smust3r_colmap.errors import ConfigError, InputError
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.geometry.world_frame import WorldFrame
from smust3r_colmap.importers.colmap_model import MIN_IMAGES, ExternalModel, SurfacePoints
from smust3r_colmap.importers.image_folder import FolderScan, bits_in_use, natural_key, shared_prior
from smust3r_colmap.importers.images import Photo
from smust3r_colmap.products import ImageCollection, PointCloud, RejectedImage, Scene, SourceImage

ASPECT_TOLERANCE = 0.05
"""Relative difference of width / height up to which a camera is that of the image, resized. Networks round sides to
multiples of 14 or 16 px: at most 7 px of a side of 147 px, where 518 px are the longer one. 4:3 and 3:2 differ by
an eighth."""

SAME_FOCAL_TOLERANCE = 0.1
"""Relative distance from the median focal length within which cameras are one: a network's guesses for one lens
scatter by a few percent, a zoom that was touched changes it by more."""

MIN_SEEN_POINTS = 50
"""Points by which the surface seen by an image is known; with fewer the whole cloud is taken."""

_NAMES_SHOWN = 5


@dataclass(frozen=True, kw_only=True, eq=False)
class FittedModel:
    """An external model whose images are files that can be read.

    Args:
        collection: the images of the model, in natural order of their names, and behind them those of the folder
            that shall be placed; ``rejected`` are those without pose or file. Cameras are start values at the size
            of the files.
        cam_from_world: (N, 3, 4) rigid, of the first N images of the collection.
        surface: the model's points; images by their index in the collection.
        notes: what was assumed or changed, one sentence each, with numbers.
    """

    collection: ImageCollection
    cam_from_world: npt.NDArray[np.float64]
    surface: SurfacePoints
    notes: tuple[str, ...]

    def __post_init__(self) -> None:
        n = len(self.cam_from_world)
        if self.cam_from_world.shape != (n, 3, 4) or n > len(self.collection):
            raise ValueError(f"FittedModel: {len(self.collection)} images, poses {self.cam_from_world.shape}")

    @property
    def num_posed(self) -> int:
        """Images that the model has; those behind them are to be placed."""
        return len(self.cam_from_world)

    @property
    def untracked_points(self) -> PointCloud:
        """Points that no two images are known to see: of most exports all, a dense cloud."""
        untracked = np.ones(len(self.surface.cloud), np.bool_)
        untracked[self.surface.point_of_observation] = False
        return PointCloud(xyz=self.surface.cloud.xyz[untracked], rgb=self.surface.cloud.rgb[untracked])

    def seen_by_tracks(self) -> dict[int, npt.NDArray[np.float64]]:
        """(S, 3) world points by image index, of the images in whose tracks ``MIN_SEEN_POINTS`` points stand."""
        rows_of: dict[int, list[int]] = defaultdict(list)
        for image, row in zip(
            self.surface.image_of_observation.tolist(), self.surface.point_of_observation.tolist(), strict=True
        ):
            rows_of[image].append(row)
        return {image: self.surface.cloud.xyz[rows] for image, rows in rows_of.items() if len(rows) >= MIN_SEEN_POINTS}

    def scene(self, origin: str) -> Scene:
        """As what a stitched run has before its refinement; ``origin`` says where it comes from.

        An external model never says what its unit is, so the scene is not metric.
        """
        images = self.collection.images[: self.num_posed]
        return Scene(
            image_indices=tuple(range(len(images))),
            image_names=tuple(image.name for image in images),
            camera_indices=tuple(image.camera for image in images),
            cameras=dict(enumerate(self.collection.cameras)),
            cam_from_world=self.cam_from_world,
            points=self.surface.cloud,
            frame=WorldFrame(metric=False),
            segments=(origin,),
        )


def fit_to_images(
    model: ExternalModel,
    scan: FolderScan,
    *,
    share_cameras: bool = True,
    camera_model: str | None = None,
    calibrated: bool = False,
    register_missing: bool = False,
) -> FittedModel:
    """Find the file of every image, and the camera of every file.

    Args:
        model: as ``read_colmap_model`` gives it.
        scan: the image folder.
        share_cameras: cameras that have one image each become one, where the images lie in one folder, have one
            size and one EXIF camera, and the focal lengths agree within ``SAME_FOCAL_TOLERANCE``.
        camera_model: COLMAP's name of the model that all cameras shall have; None keeps what each has, but turns
            pinholes into SIMPLE_RADIAL, since most of them are guesses and photographs are distorted.
        calibrated: the cameras are known; they are brought to the size of the files and otherwise stay.
        register_missing: files that the model has no image of join the collection, without a pose. Each has the
            camera of files like it; where there are none, a camera of its own that starts from EXIF or COLMAP's guess,
            in the model that a run of ours takes, unless the cameras are known: then it is left out.

    Raises:
        InputError: a name fits several files, two images fit one file, fewer than two images have a file, or the
            image of a camera has another shape than its file.
        ConfigError: a camera cannot be written in ``camera_model``, or ``calibrated`` contradicts it.
    """
    if calibrated and camera_model:
        raise ConfigError(
            f"--camera-model {camera_model}: with --calibrated the cameras stay as they are; leave one out"
        )
    notes = list(model.fixes)
    matched, unused, rejected = _match_files(model, scan, notes)
    order = sorted(matched, key=lambda position: natural_key(matched[position].name))
    owners = [model.camera_ids[position] for position in order]
    files = [_oriented(matched[position], model.cameras[owner]) for position, owner in zip(order, owners, strict=True)]
    _remark_on_orientation(files, notes)
    resized = [
        _resized_to_file(model.cameras[owner], file, f"{owner} of {model.folder}")
        for owner, file in zip(owners, files, strict=True)
    ]
    _remark_on_sizes([model.cameras[owner] for owner in owners], resized, notes)
    keys: list[Hashable] = [(owner, file.size) for owner, file in zip(owners, files, strict=True)]
    if share_cameras and not calibrated:
        keys = _shared_keys(keys, resized, files, notes)
    cameras, camera_of = _one_per_key(keys, resized)
    if not calibrated:
        cameras = _remodelled(cameras, camera_model, notes)
    others = [*model.unposed, *rejected]
    if register_missing:
        owned = list(zip(files, camera_of, strict=True))
        guessed_model = camera_model or CameraConfig.camera_model
        cameras, owned_by_others, without_camera = _cameras_of_others(
            unused, owned, cameras, guessed_model, calibrated, notes
        )
        files, camera_of = [*files, *owned_by_others], (*camera_of, *owned_by_others.values())
        others = [*_of_no_file(model.unposed, unused), *rejected, *without_camera]
    _remark_on_unused([] if register_missing else unused, notes)
    bits = bits_in_use(scan.records)
    images = tuple(
        SourceImage(
            name=file.name,
            path=scan.folder / file.name,
            width=file.size[0],
            height=file.size[1],
            camera=camera,
            digest=file.digest,
            bits=bits.get(file.name),
        )
        for file, camera in zip(files, camera_of, strict=True)
    )
    return FittedModel(
        collection=ImageCollection(images=images, cameras=cameras, rejected=tuple(others), calibrated=calibrated),
        cam_from_world=model.cam_from_world[order],
        surface=_renumbered(model.surface, order, len(model)),
        notes=tuple(notes),
    )


def _renumbered(surface: SurfacePoints, order: Sequence[int], num_before: int) -> SurfacePoints:
    """Images by their index in the collection; observations by images without a file are dropped."""
    index_of = np.full(num_before, -1)
    index_of[list(order)] = np.arange(len(order))
    image = index_of[surface.image_of_observation]
    num_views = np.bincount(surface.point_of_observation[image >= 0], minlength=len(surface.cloud))
    kept = (image >= 0) & (num_views[surface.point_of_observation] >= 2)
    return SurfacePoints(
        cloud=surface.cloud,
        point_of_observation=surface.point_of_observation[kept],
        image_of_observation=image[kept],
    )


# ----------------------------------------------------------------------------- names
@dataclass(frozen=True, kw_only=True)
class _File:
    """A file that decodes."""

    name: str
    digest: str
    photo: Photo
    as_stored: bool = False
    """Read without its EXIF orientation, because only so it has the shape that its camera has."""

    @property
    def size(self) -> tuple[int, int]:
        return self.photo.stored_size if self.as_stored else (self.photo.width, self.photo.height)

    @property
    def source(self) -> tuple[Hashable, ...]:
        """Equal for files that may come from one camera: folder, size and what EXIF says of the lens."""
        tags = self.photo.tags
        folder = PurePosixPath(self.name).parent
        return str(folder), self.size, tags.make, tags.model, tags.focal_mm, tags.focal_35mm, tags.digital_zoom


_SPELLINGS: Mapping[str, Callable[[str], str]] = {
    "name": lambda name: unicodedata.normalize("NFC", name),
    "base name": lambda name: unicodedata.normalize("NFC", PurePosixPath(name).name),
    "name without suffix": lambda name: unicodedata.normalize("NFC", PurePosixPath(name).stem),
}
"""How a name may be taken, the strictest first."""


def _match_files(
    model: ExternalModel, scan: FolderScan, notes: list[str]
) -> tuple[dict[int, _File], list[_File], list[RejectedImage]]:
    """The file of each image by its position in the model, files of no image, and the images without a usable file."""
    reasons = {one.name: one.reason for one in scan.unreadable}
    reasons |= {record.name: record.reason for record in scan.records if record.photo is None}
    usable = {
        record.name: _File(name=record.name, digest=record.digest, photo=record.photo)
        for record in scan.records
        if record.photo is not None
    }
    found = _found_names(model, [*usable, *reasons], scan, notes)
    matched = {position: usable[name] for position, name in found.items() if name in usable}
    rejected = [
        RejectedImage(name=model.names[p], reason=reasons[name]) for p, name in found.items() if name in reasons
    ]
    rejected += [
        RejectedImage(name=name, reason=f"has a pose, but no file of that name is in {scan.folder}")
        for position, name in enumerate(model.names)
        if position not in found
    ]
    if len(matched) < MIN_IMAGES:
        raise InputError(
            f"{scan.folder}: has usable files for {len(matched)} of {len(model)} images of {model.folder}, needed are "
            f"{MIN_IMAGES}; the model names {_few(model.names)}, the folder has {_few([*usable, *reasons])}"
        )
    unused = sorted(usable.keys() - found.values(), key=natural_key)
    return matched, [usable[name] for name in unused], rejected


def _of_no_file(images: Iterable[RejectedImage], files: Iterable[_File]) -> list[RejectedImage]:
    """The images that are none of the files, however their names are spelled."""
    left, names = list(images), [file.name for file in files]
    for spelling in _SPELLINGS.values():
        found = {spelling(one.name) for one in left} & {spelling(name) for name in names}
        left = [one for one in left if spelling(one.name) not in found]
        names = [name for name in names if spelling(name) not in found]
    return left


def _remark_on_unused(unused: Sequence[_File], notes: list[str]) -> None:
    if unused:
        names = _few(file.name for file in unused)
        notes.append(
            f"{len(unused)} files of the folder are not in the model; --register-missing would try them: {names}"
        )


def _found_names(model: ExternalModel, file_names: Sequence[str], scan: FolderScan, notes: list[str]) -> dict[int, str]:
    """File names by the position of their image; an image that no spelling finds is left out."""
    found: dict[int, str] = {}
    for how, spelling in _SPELLINGS.items():
        candidates: dict[str, list[str]] = defaultdict(list)
        for name in file_names:
            candidates[spelling(name)].append(name)
        newly = {}
        for position, name in enumerate(model.names):
            if position in found or not (fitting := candidates.get(spelling(name), [])):
                continue
            if len(fitting) > 1:
                raise InputError(
                    f"{model.folder}: image {name!r} could be {_few(fitting)} of {scan.folder}, which share its {how}; "
                    "give the image the path of its file below that folder"
                )
            newly[position] = fitting[0]
        found |= newly
        if newly and how != "name":
            position, name = next(iter(newly.items()))
            notes.append(f"{len(newly)} images found by their {how}, such as {model.names[position]!r} as {name!r}")
    image_of: dict[str, str] = {}
    for position, name in found.items():
        if name in image_of:
            raise InputError(
                f"{model.folder}: images {image_of[name]!r} and {model.names[position]!r} both fit the file {name!r}; "
                f"leave one out, or give both the paths of their files below {scan.folder}"
            )
        image_of[name] = model.names[position]
    return found


def _few(names: Iterable[str]) -> str:
    shown = [repr(name) for name in names]
    more = len(shown) - _NAMES_SHOWN
    return ", ".join(shown[:_NAMES_SHOWN]) + (f" and {more} more" if more > 0 else "") or "nothing"


# ----------------------------------------------------------------------- orientation
def _oriented(file: _File, camera: Intrinsics) -> _File:
    """As its camera means it: COLMAP and others do not turn files by their EXIF orientation."""
    stored = replace(file, as_stored=True)
    return stored if _has_shape_of(stored, camera) and not _has_shape_of(file, camera) else file


def _has_shape_of(file: _File, camera: Intrinsics) -> bool:
    width, height = file.size
    return _relative_difference(camera.width / camera.height, width / height) <= ASPECT_TOLERANCE


def _remark_on_orientation(files: Sequence[_File], notes: list[str]) -> None:
    stored = [file for file in files if file.as_stored]
    if stored:
        notes.append(
            f"{len(stored)} files are read as stored, without their EXIF orientation, because the model is of these "
            f"pixels, such as {stored[0].name!r}"
        )
    unclear = [file for file in files if not file.as_stored and file.photo.orientation != 1]
    if unclear:
        notes.append(
            f"{len(unclear)} files are turned upright by their EXIF orientation, such as {unclear[0].name!r}; if the "
            "model is of the pixels as stored, as COLMAP makes it, take the orientation out of the files"
        )


# --------------------------------------------------------------------------- cameras
def _resized_to_file(camera: Intrinsics, file: _File, owner: str) -> Intrinsics:
    """The camera at the size of the file; each axis is scaled by itself, as the network's input was.

    Raises:
        InputError: the shapes differ by more than ``ASPECT_TOLERANCE``: the image was cropped, padded or turned.
    """
    width, height = file.size
    if _has_shape_of(file, camera):
        return camera.resized(width, height)
    if _relative_difference(camera.width / camera.height, height / width) <= ASPECT_TOLERANCE:
        way_out = "the model is of the image lying on its side; turn the file"
    else:
        way_out = "it was cropped or padded; give the images that the model was made of, or cameras for these"
    raise InputError(
        f"{file.name}: is {width}x{height} px, its camera {owner} is for {camera.width}x{camera.height} px; "
        f"shapes that differ by more than {ASPECT_TOLERANCE:.0%} were not only resized: {way_out}"
    )


def _relative_difference(value: float, reference: float) -> float:
    return abs(value / reference - 1)


def _remark_on_sizes(before: Sequence[Intrinsics], after: Sequence[Intrinsics], notes: list[str]) -> None:
    changes = Counter(
        f"{old.width}x{old.height} to {new.width}x{new.height}"
        for old, new in zip(before, after, strict=True)
        if (old.width, old.height) != (new.width, new.height)
    )
    for change, count in changes.items():
        notes.append(f"{count} images had intrinsics at another size than their files: rescaled from {change} px")


def _shared_keys(
    keys: Sequence[Hashable], cameras: Sequence[Intrinsics], files: Sequence[_File], notes: list[str]
) -> list[Hashable]:
    """One key for cameras that are the same but for scatter; a camera that had several images keeps its own."""
    num_images = Counter(keys)
    groups: dict[Hashable, list[int]] = defaultdict(list)
    for k, (key, camera, file) in enumerate(zip(keys, cameras, files, strict=True)):
        if num_images[key] == 1:
            groups[file.source, camera.model].append(k)
    shared = list(keys)
    for source, members in groups.items():
        middle = median(cameras[k].focal_px for k in members)
        alike = [k for k in members if _relative_difference(cameras[k].focal_px, middle) <= SAME_FOCAL_TOLERANCE]
        if len(alike) < 2:
            continue
        for k in alike:
            shared[k] = source
        focals = sorted(cameras[k].focal_px for k in alike)
        notes.append(
            f"{len(alike)} cameras with one image each became one; their focal lengths were {focals[0]:.0f} to "
            f"{focals[-1]:.0f} px"
        )
    return shared


def _one_per_key(
    keys: Sequence[Hashable], cameras: Sequence[Intrinsics]
) -> tuple[tuple[Intrinsics, ...], tuple[int, ...]]:
    """The camera of each key, with the median of each parameter, in order of first appearance; its number by image."""
    members: dict[Hashable, list[Intrinsics]] = defaultdict(list)
    for key, camera in zip(keys, cameras, strict=True):
        members[key].append(camera)
    numbers = {key: number for number, key in enumerate(members)}
    typical = (
        replace(alike[0], params=tuple(np.median([camera.params for camera in alike], axis=0)))
        for alike in members.values()
    )
    return tuple(typical), tuple(numbers[key] for key in keys)


def _cameras_of_others(
    others: Sequence[_File],
    owned: Sequence[tuple[_File, int]],
    cameras: tuple[Intrinsics, ...],
    guessed_model: str,
    calibrated: bool,
    notes: list[str],
) -> tuple[tuple[Intrinsics, ...], dict[_File, int], list[RejectedImage]]:
    """All cameras, the number of the camera of each further file, and the files that are left out for want of one.

    A guess has ``guessed_model``, for what the model's cameras have is of another lens and may be a fisheye.
    """
    number_of: dict[Hashable, int] = {}
    for source in dict.fromkeys(file.source for file, _ in owned):
        number_of[source] = Counter(camera for file, camera in owned if file.source == source).most_common(1)[0][0]
    grown, camera_of, rejected = list(cameras), dict[_File, int](), list[RejectedImage]()
    for file in others:
        if file.source not in number_of and calibrated:
            rejected.append(RejectedImage(name=file.name, reason="no image of the model is of its size and camera"))
            continue
        if file.source not in number_of:
            number_of[file.source] = len(grown)
            alike = [other.photo for other in others if other.source == file.source]
            grown.append(shared_prior(alike, guessed_model))
        camera_of[file] = number_of[file.source]
    if guesses := len(grown) - len(cameras):
        count = sum(camera >= len(cameras) for camera in camera_of.values())
        notes.append(
            f"{guesses} cameras were guessed as {guessed_model}, from EXIF or the image size, for {count} images like "
            "none of the model"
        )
    return tuple(grown), camera_of, rejected


_PERSPECTIVE = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
"""Models that mean the same by a parameter of the same name."""


def _remodelled(cameras: Sequence[Intrinsics], wanted: str | None, notes: list[str]) -> tuple[Intrinsics, ...]:
    """All cameras in the model ``wanted``, or, where it is None, pinholes of square pixels as SIMPLE_RADIAL."""
    if wanted is not None:
        return tuple(_converted(camera, wanted) for camera in cameras)
    changed = tuple(_converted(camera, "SIMPLE_RADIAL") if _may_be_radial(camera) else camera for camera in cameras)
    count = sum(new != old for new, old in zip(changed, cameras, strict=True))
    if count:
        notes.append(
            f"pinhole cameras became SIMPLE_RADIAL ({count} of {len(cameras)}), for photographs are distorted; "
            "--camera-model PINHOLE keeps them, for undistorted images"
        )
    return changed


def _may_be_radial(camera: Intrinsics) -> bool:
    if camera.model == "PINHOLE":
        return _relative_difference(camera.params[0], camera.params[1]) <= ASPECT_TOLERANCE
    return camera.model == "SIMPLE_PINHOLE"


def _converted(camera: Intrinsics, model: str) -> Intrinsics:
    """The same camera in another perspective model: parameters by name, the others zero.

    Raises:
        ConfigError: one of the two is not perspective.
    """
    if camera.model == model:
        return camera
    if camera.model not in _PERSPECTIVE or model not in _PERSPECTIVE:
        raise ConfigError(
            f"--camera-model {model}: a camera of the model is {camera.model}; one can become another only among "
            f"{', '.join(_PERSPECTIVE)}"
        )
    old = camera.colmap_camera()
    new = pycolmap.Camera.create_from_model_name(1, model, camera.focal_px, camera.width, camera.height)
    value_of = dict(zip(_parameter_names(old), camera.params, strict=True))
    if "f" in value_of:
        value_of["fx"] = value_of["fy"] = value_of["f"]
    value_of["f"] = camera.focal_px
    params = tuple(value_of.get(name, 0.0) for name in _parameter_names(new))
    return replace(camera, model=model, params=params)


def _parameter_names(camera: pycolmap.Camera) -> list[str]:
    """As COLMAP lists them, the only radial term of a model being the first one of others."""
    names = [name.strip() for name in camera.params_info.split(",")]
    return ["k1" if name == "k" else name for name in names]
