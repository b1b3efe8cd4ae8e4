"""COLMAP's dense workspace: undistorted images, depth and normal maps, and the fused cloud.

    FOLDER/images/            undistorted, as large as the depth maps
    FOLDER/sparse/            the model of these images, PINHOLE
    FOLDER/stereo/depth_maps/NAME.geometric.bin      float32 z-depth in the unit of the model, 0 for none
    FOLDER/stereo/normal_maps/NAME.geometric.bin     unit vectors in the camera's axes, facing the camera
    FOLDER/stereo/consistency_graphs/                empty; only patch match reads it
    FOLDER/stereo/patch-match.cfg, fusion.cfg        all images; those that have a map
    FOLDER/fused.ply, fused.ply.vis                  by COLMAP's stereo fusion

COLMAP's ``stereo_fusion``, its meshers and OpenMVS read it. A map starts with ``width&height&channels&``
in ASCII, then float32 follows, row by row, one channel after the other. The value of row i and column j belongs to
the centre of that pixel, which lies at (j + 0.5, i + 0.5) for the cameras of the model, and at (j, i) for OpenMVS,
which moves the cameras when it reads them, and for COLMAP's fusion, which does not: see ``_fuse``.

Images are as large as the maps, because readers compare the two: COLMAP resizes the camera to the map, others refuse
maps of another size. For training or texturing at full resolution use the training dataset.
The next module to read is ``mesh``.
"""

from __future__ import annotations

import logging
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import TypeVar

import numpy as np
import numpy.typing as npt
import pycolmap
from PIL import Image

from smust3r_colmap.dense.depth_consistency import ModelDepth, depth_of_model
from smust3r_colmap.dense.normals import surface_normals
from smust3r_colmap.errors import ImageError, InputError, ReconstructionError, StorageError
from smust3r_colmap.execution.task_pool import TaskFailure, in_child, usable_cores
from smust3r_colmap.geometry.camera import Intrinsics, pixel_centres
from smust3r_colmap.geometry.depth_noise import VIEW_AGREEMENT
from smust3r_colmap.importers.images import inspect, load_rgb, open_image, stored_orientation
from smust3r_colmap.products import DepthMaps, SourceImage
from smust3r_colmap.storage.atomic_write import atomic_folder

logger = logging.getLogger(__name__)

FloatMap = npt.NDArray[np.float32]
TaskT = TypeVar("TaskT")
ResultT = TypeVar("ResultT")

WORKSPACE_ENTRIES = frozenset(
    {
        *("images", "sparse", "stereo", "fused.ply", "fused.ply.vis"),
        *("run-colmap-geometric.sh", "run-colmap-photometric.sh"),
        *("mesh_poisson.ply", "mesh_poisson.glb", "mesh_tsdf.ply", "mesh_tsdf.glb"),
        *("meshed-poisson.ply", "meshed-delaunay.ply"),
    }
)
"""What an older workspace may hold and is replaced with it."""

MIN_FUSED_VIEWS = 3
"""Pixels per fused point (COLMAP: 5). Every depth here has been confirmed by two other views, and maps of small
images seen once per place have no five."""
FUSED_REPROJECTION_PX = 1.0
"""COLMAP: 2, for maps of full size. Two pixels of a small map are a large patch: of a courtyard in 30 maps of 384
pixels 87,000 points were left instead of 158,000, and their normals scattered by a third more."""
FUSED_NORMAL_ERROR_DEG = 30.0
"""COLMAP: 10, for normals that patch match optimises; ours are fitted to depth and noisier."""
MAX_FUSED_NEIGHBOURS = 30
"""Neighbours that a point is traced through (COLMAP: 50), to bound memory and time on long sequences."""
BYTES_PER_FUSED_PIXEL = 24
"""Depth, normal, colour and the mask of pixels used, in stereo fusion."""

_COPY_JPEG_QUALITY = 95


@dataclass(frozen=True, kw_only=True)
class DenseReport:
    """What a workspace holds.

    Args:
        num_images: registered images.
        without_map: names of those that have no depth map.
        borrowed_scale: names of those whose depth has the scale of the whole model, for lack of points.
        coverage: mean part of the pixels that have depth, over the images with a map.
        num_points: of the fused cloud.
    """

    num_images: int
    without_map: tuple[str, ...]
    borrowed_scale: tuple[str, ...]
    coverage: float
    num_points: int


def write_dense_workspace(
    model: pycolmap.Reconstruction | Path,
    images: Path,
    maps: DepthMaps,
    folder: Path,
    *,
    bits: Mapping[str, int] | None = None,
    memory_gib: float = 2.0,
    log_file: Path | None = None,
) -> DenseReport:
    """Write the workspace into ``folder``, which is made; an older workspace is replaced.

    Args:
        model: an adjusted model with real tracks, or its folder. Without tracks COLMAP knows no neighbours, and the
            fused cloud is empty.
        images: folder of the original images.
        maps: depth by the names of the model's images.
        folder: written atomically.
        bits: by name, that images with more than 8 bits a channel are scaled by.
        memory_gib: maps that fusion holds in memory; larger workspaces are read submodel by submodel.
        log_file: for the messages of native code.

    Raises:
        InputError: the model cannot be read, has no image with a map, or an image is missing, unreadable or of another
            size than its camera. Nothing is written.
        ReconstructionError: COLMAP's undistortion or fusion failed.
        RunDirectoryError: the folder holds something else.
        StorageError: the disk refused.
    """
    original = _read(model)
    sources = [_look_at(images, original, i, bits or {}) for i in sorted(original.reg_image_ids())]
    with_map = [source for source in sources if source.name in maps]
    if not with_map:
        raise InputError(f"no depth map for any of the {len(sources)} images of the model; make maps first")
    with atomic_folder(folder, may_hold=WORKSPACE_ENTRIES) as partial:
        undistorted = _undistort(original, images, sources, partial, _longer_side(original, maps), log_file)
        place = {source.name: source.workspace_name for source in sources}
        written = [
            _write_maps(found, undistorted, place[found.name], partial)
            for found in depth_of_model(original, undistorted, maps)
        ]
        _write_lines(partial / "stereo/patch-match.cfg", (f"{one.workspace_name}\n__auto__, 20" for one in sources))
        _write_lines(partial / "stereo/fusion.cfg", (one.workspace_name for one in with_map))
        num_points = _fuse(partial, written, memory_gib, log_file)
    if not num_points:
        logger.warning("%s: the fused cloud is empty; images share no points, or no depth was confirmed", folder)
    return DenseReport(
        num_images=len(sources),
        without_map=tuple(source.name for source in sources if source.name not in maps),
        borrowed_scale=tuple(one.name for one in written if one.num_points == 0),
        coverage=float(np.mean([one.coverage for one in written])),
        num_points=num_points,
    )


def _read(model: pycolmap.Reconstruction | Path) -> pycolmap.Reconstruction:
    if isinstance(model, pycolmap.Reconstruction):
        return model
    try:
        return pycolmap.Reconstruction(model)
    except (ValueError, IndexError, RuntimeError) as error:
        raise InputError(f"{model}: no COLMAP model that can be read ({error})") from error


# ------------------------------------------------------------------------------ images
@dataclass(frozen=True, kw_only=True)
class _Source:
    """An original image.

    Args:
        image_id, name: in the model.
        workspace_name: in the workspace; another where COLMAP could not read the file under its old one.
        as_copy: COLMAP would read the pixels wrongly or not at all, so it gets a copy of them.
        bits: as in ``SourceImage``.
    """

    image_id: int
    name: str
    workspace_name: str
    as_copy: bool
    bits: int | None = None


def _look_at(images: Path, model: pycolmap.Reconstruction, image_id: int, bits: Mapping[str, int]) -> _Source:
    """Decode a file and compare it with its camera.

    Raises:
        InputError: the name leaves the folder.
        ImageError: the file is missing, does not decode, or has another size than the camera.
    """
    name = model.image(image_id).name
    camera = model.camera(model.image(image_id).camera_id)
    if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts:
        raise InputError(f"{name}: the name of an image must be a path below the image folder")
    try:
        data = (images / name).read_bytes()
        photo = inspect(data)
    except FileNotFoundError as error:
        raise ImageError(f"{name}: there is no such file in {images}; give the folder the model was made of") from error
    except OSError as error:
        raise ImageError(f"{name}: cannot be read: {error.strerror}") from error
    except ImageError as error:
        raise ImageError(f"{name}: {error}") from error
    upright = (photo.width, photo.height) == (camera.width, camera.height)
    if not upright and photo.stored_size != (camera.width, camera.height):
        raise ImageError(
            f"{name}: the file is {photo.width}x{photo.height} px and its camera {camera.width}x{camera.height};"
            " give the images that the model was made of"
        )
    unreadable = not data.startswith(_KNOWN_TO_COLMAP)
    return _Source(
        image_id=image_id,
        name=name,
        workspace_name=_name_for_cfg(f"{name}.png" if unreadable else name, image_id),
        as_copy=unreadable or photo.deep or (upright and _is_turned(data)),
        bits=bits.get(name),
    )


def _name_for_cfg(name: str, image_id: int) -> str:
    """Lines of COLMAP's .cfg files lose blanks at their ends, and are comments if they begin with #."""
    return name if name == name.strip() and not name.startswith("#") else f"image{image_id}_{name.strip(' #')}"


_KNOWN_TO_COLMAP = (b"\xff\xd8\xff", b"\x89PNG", b"II*\0", b"MM\0*", b"BM")
"""First bytes of JPEG, PNG, TIFF and BMP."""


def _is_turned(data: bytes) -> bool:
    """EXIF says that the pixels are stored turned or mirrored. COLMAP ignores that."""
    return stored_orientation(open_image(data)) != 1


def _longer_side(model: pycolmap.Reconstruction, maps: DepthMaps) -> int:
    """Of the largest depth map; one map of every camera is looked at."""
    one_of_camera = {
        model.image(i).camera_id: model.image(i).name for i in model.reg_image_ids() if model.image(i).name in maps
    }
    return max(int(max(maps.depth(name).shape)) for name in one_of_camera.values())


# ------------------------------------------------------------------------ undistortion
@dataclass(frozen=True, kw_only=True)
class _UndistortionTask:
    """Folders of one call of ``pycolmap.undistort_images``, which a child process makes."""

    model: Path
    images: Path
    output: Path
    longer_side: int


def _undistort(
    original: pycolmap.Reconstruction,
    images: Path,
    sources: Sequence[_Source],
    partial: Path,
    longer_side: int,
    log_file: Path | None,
) -> pycolmap.Reconstruction:
    """Make the skeleton of the workspace in ``partial`` and return its model."""
    inputs = partial / "inputs"
    (inputs / "model").mkdir(parents=True)
    original.write_binary(inputs / "model")
    if any(source.as_copy or source.workspace_name != source.name for source in sources):
        _lay_out(original, images, sources, inputs)
        images = inputs / "images"
    task = _UndistortionTask(
        model=inputs / "model", images=images.resolve(), output=partial.resolve(), longer_side=longer_side
    )
    _in_child_or_raise(_run_undistortion, task, "undistortion", log_file)
    shutil.rmtree(inputs)
    undistorted = pycolmap.Reconstruction(partial / "sparse")
    if undistorted.num_reg_images() != len(sources):
        raise StorageError(f"{partial / 'sparse'}: is not whole; is the disk full?")
    for source in sources:
        if not (partial / "images" / source.workspace_name).is_file():
            raise ImageError(f"{source.name}: COLMAP could not undistort it; convert it to an 8-bit JPEG or PNG")
    return undistorted


def _run_undistortion(task: _UndistortionTask) -> None:
    options = pycolmap.UndistortCameraOptions()
    options.max_image_size = task.longer_side
    pycolmap.undistort_images(
        task.output, task.model, task.images, undistort_options=options, num_threads=usable_cores()
    )


def _lay_out(model: pycolmap.Reconstruction, images: Path, sources: Sequence[_Source], inputs: Path) -> None:
    """Links to the images, or upright copies, below ``inputs/images``, and the model with their names."""
    renamed = pycolmap.Reconstruction(inputs / "model")
    for source in sources:
        place = inputs / "images" / source.workspace_name
        place.parent.mkdir(parents=True, exist_ok=True)
        renamed.image(source.image_id).name = source.workspace_name
        if not source.as_copy:
            place.symlink_to((images / source.name).resolve())
            continue
        camera = model.camera(model.image(source.image_id).camera_id)
        file = SourceImage(
            name=source.name,
            path=images / source.name,
            width=camera.width,
            height=camera.height,
            camera=0,
            digest="",
            bits=source.bits,
        )
        Image.fromarray(load_rgb(file)).save(place, quality=_COPY_JPEG_QUALITY)
    renamed.write_binary(inputs / "model")


# -------------------------------------------------------------------------------- maps
@dataclass(frozen=True, kw_only=True)
class _WrittenMap:
    """What is reported of one image: how much of it has depth, and on how many points its scale rests."""

    name: str
    coverage: float
    num_points: int
    num_pixels: int


def _write_maps(
    found: ModelDepth, undistorted: pycolmap.Reconstruction, workspace_name: str, workspace: Path
) -> _WrittenMap:
    """Write the depth and the normals of one image."""
    image = undistorted.find_image_with_name(workspace_name)
    pinhole = Intrinsics.from_colmap(undistorted.camera(image.camera_id))
    rays = pinhole.rays_cam(pixel_centres(pinhole.width, pinhole.height))
    normals, _ = surface_normals(found.depth, rays[:, :2].reshape(*found.depth.shape, 2))
    write_map(workspace / f"stereo/depth_maps/{workspace_name}.geometric.bin", found.depth)
    write_map(workspace / f"stereo/normal_maps/{workspace_name}.geometric.bin", normals)
    return _WrittenMap(
        name=found.name,
        coverage=float(np.mean(found.depth > 0)),
        num_points=found.num_points,
        num_pixels=found.depth.size,
    )


def write_map(path: Path, values: FloatMap) -> None:
    """Write (H, W) or (H, W, C) float32 in COLMAP's format of dense maps, one channel after the other.

    Not by pycolmap: its ``NormalMap.from_array`` (4.2.1) stores the channels of a pixel together, which COLMAP's
    fusion then reads as other numbers.

    Source: COLMAP's documentation, "Output format", section "Depth and normal maps".
    """
    planes = np.atleast_3d(values).transpose(2, 0, 1)
    channels, height, width = planes.shape
    path.parent.mkdir(parents=True, exist_ok=True)
    header = f"{width}&{height}&{channels}&".encode("ascii")
    path.write_bytes(header + np.ascontiguousarray(planes, dtype="<f4").tobytes())


def _write_lines(path: Path, lines: Iterable[str]) -> None:
    path.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")


# ------------------------------------------------------------------------------ fusion
@dataclass(frozen=True, kw_only=True)
class _FusionTask:
    """One call of ``pycolmap.stereo_fusion``, which a child process makes."""

    workspace: Path
    memory_gib: float
    fits_in_memory: bool


def _fuse(workspace: Path, written: list[_WrittenMap], memory_gib: float, log_file: Path | None) -> int:
    """Write ``fused.ply`` and return the number of its points.

    COLMAP's fusion puts the centre of the first pixel at (0, 0) and takes the cameras as they are, with (0.5, 0.5):
    its cloud is off by half a pixel, which is visible on small maps (5 cm at 30 m). So fusion gets cameras moved by
    half a pixel, and the workspace keeps the true ones.
    """
    needed = sum(one.num_pixels for one in written) * BYTES_PER_FUSED_PIXEL
    task = _FusionTask(
        workspace=workspace.resolve(), memory_gib=memory_gib, fits_in_memory=needed <= memory_gib * 2**30
    )
    cameras = workspace / "sparse/cameras.bin"
    true_cameras = cameras.read_bytes()
    _write_cameras_for_fusion(workspace / "sparse")
    num_points = _in_child_or_raise(_run_fusion, task, "stereo fusion", log_file)
    cameras.write_bytes(true_cameras)
    vertex_bytes = 6 * 4 + 3  # place, normal, colour
    arrived = (workspace / "fused.ply").stat().st_size
    if arrived < num_points * vertex_bytes:
        raise StorageError(f"{workspace / 'fused.ply'}: {arrived} bytes hold no {num_points} points; is the disk full?")
    return num_points


def _write_cameras_for_fusion(folder: Path) -> None:
    """Move the principal points of a model to where the centre of the first pixel is (0, 0)."""
    model = pycolmap.Reconstruction(folder)
    for camera in model.cameras.values():
        camera.principal_point_x -= 0.5
        camera.principal_point_y -= 0.5
    model.write_binary(folder)


def _run_fusion(task: _FusionTask) -> int:
    """Points of the fused cloud."""
    options = pycolmap.StereoFusionOptions()
    options.min_num_pixels = MIN_FUSED_VIEWS
    options.max_reproj_error = FUSED_REPROJECTION_PX
    options.max_depth_error = VIEW_AGREEMENT  # COLMAP: 0.01; every depth was confirmed within this
    options.max_normal_error = FUSED_NORMAL_ERROR_DEG
    options.check_num_images = MAX_FUSED_NEIGHBOURS
    options.num_threads = 1  # several start new points in the order of their luck, and the cloud differs every time
    options.use_cache = not task.fits_in_memory
    options.cache_size = task.memory_gib
    fused = pycolmap.stereo_fusion(
        task.workspace / "fused.ply", task.workspace, input_type="geometric", options=options, output_type="PLY"
    )
    return int(fused.num_points3D())


def _in_child_or_raise(function: Callable[[TaskT], ResultT], task: TaskT, what: str, log_file: Path | None) -> ResultT:
    """Run in a child process, so that a crash of native code stays there."""
    result = in_child(function, task, log_file=log_file)
    if isinstance(result, TaskFailure):
        raise ReconstructionError(f"{what} of the dense workspace failed: {result.reason}")
    return result
