"""An adjusted model as a dataset for trainers: 3DGS and its forks, gsplat, nerfstudio, instant-ngp, Brush.

    images/               undistorted, PINHOLE, principal point in the middle, flat unique names
    images_2/ ...         smaller copies, where wanted
    masks/  masks_2/ ...  white is kept; <stem>.png and <name>.png are the same
    depths/<stem>.png     16-bit inverse depth, for the depth regulariser of 3DGS
    sparse/0/             cameras, images, points3D, rigs, frames (.bin), points3D.ply, depth_params.json
    transforms.json       the same cameras for nerfstudio and instant-ngp, with sparse_pc.ply
    names.json            original name: new name

If there is one camera, its id is 1. Every point has at least two views and every image at least one point. Cameras and
points that were left out for that, or because they are far from all others, are counted. The folder is written
atomically. Next: ``transforms_json`` and ``inverse_depth`` say what two of the formats mean.
"""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
import pycolmap
from scipy.spatial import cKDTree

from smust3r_colmap.colmap.model_files import write_binary_checked
from smust3r_colmap.dense.depth_consistency import depth_of_model
from smust3r_colmap.errors import InputError
from smust3r_colmap.exporters.centred_pinhole import CentredPinhole
from smust3r_colmap.exporters.flat_names import flat_names
from smust3r_colmap.exporters.inverse_depth import common_scale, inverse_depth_values
from smust3r_colmap.exporters.ply import write_ply
from smust3r_colmap.exporters.training_images import (
    TrainingImage,
    check_scales,
    encoded,
    look_at_image,
    write_images,
    write_masks,
)
from smust3r_colmap.exporters.training_selection import LeftOut, Selection, nearest_camera_distance, select_for_training
from smust3r_colmap.exporters.transforms_json import points_saved, transforms_json
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.products import DepthMaps, PointCloud
from smust3r_colmap.storage.atomic_write import atomic_folder

logger = logging.getLogger(__name__)


MAX_DEPTH_SIDE_PX = 640
"""Longer side of the largest depth maps. Backbones give 256 to 512 pixels, so larger files hold nothing more, and
3DGS resizes them to its images anyway; at 640 a map takes 0.3 MB instead of 5 and a tenth of the time."""
NORMAL_REACH_PER_DISTANCE = 0.02
"""How near, over its distance from the camera, a point of the cloud must be to lend its normal."""

_OURS = re.compile(
    r"images|masks|depths|sparse|transforms\.json|sparse_pc\.ply|names\.json"
    r"|(images|masks)_[1-9][0-9]*"
    r"|images_[1-9][0-9]*_png"  # gsplat's own copies of JPEG
)
"""What a training dataset holds, of whatever scales."""


@dataclass(frozen=True, kw_only=True)
class TrainingReport:
    """What was written, and what was left out and why.

    Args:
        num_images, num_cameras, num_points, num_observations: in the folder.
        num_copied: images copied byte by byte.
        num_renamed: images with a new name, see ``names.json``.
        left_out: of the model.
        images_without_depth: names in the model; their maps are black and 3DGS ignores them. Empty where
            no depth was asked for.
        images_without_mask: names in the model; their masks are white. Empty where no masks were given.
    """

    num_images: int
    num_cameras: int
    num_points: int
    num_observations: int
    num_copied: int
    num_renamed: int
    left_out: LeftOut
    images_without_depth: tuple[str, ...]
    images_without_mask: tuple[str, ...]


def write_training_dataset(
    model: pycolmap.Reconstruction,
    images: Path,
    folder: Path,
    *,
    maps: DepthMaps | None,
    cloud: PointCloud | None,
    scales: tuple[int, ...] = (),
    masks: Path | None = None,
    bits: Mapping[str, int] | None = None,
    keep_outliers: bool = False,
) -> TrainingReport:
    """Write ``folder``, or replace what an earlier call has written there.

    Args:
        model: adjusted, with tracks, of the original images.
        images: the folder that holds the original images by their names in the model.
        folder: such as ``OUT/trainer``.
        maps: for ``depths/``; None leaves it out.
        cloud: in the world of the model, lends its normals to the points; those it does not reach, and all
            without it, face their cameras.
        scales: such as (2, 4, 8) for ``images_2``, ``images_4`` and ``images_8``.
        masks: a folder with a mask for each image, named as COLMAP wants it; where an image has none, its alpha is it.
        bits: by name, that images with more than 8 bits a channel are scaled by; by default each by its own brightest
            pixel.
        keep_outliers: keep cameras and points that lie far from all others.

    Raises:
        InputError: the model has no point seen twice, a camera has no pinhole, or a scale is of no use.
        ImageError: an image is missing or does not fit its camera, or a mask its image; nothing is written.
        RunDirectoryError: ``folder`` holds something that is not ours.
        StorageError: the disk refused.
    """
    cameras = {camera_id: CentredPinhole.of(model.camera(camera_id)) for camera_id in _used_cameras(model)}
    selection = select_for_training(model, cameras, keep_outliers=keep_outliers)
    sources = _look_at_images(model, images, selection, cameras, bits or {})
    check_scales(scales, list(sources.values()))
    if masks is not None and not masks.is_dir():
        raise InputError(f"{masks}: there is no such folder of masks")
    names = flat_names({source.source.name: source.suffix for source in sources.values()})
    pinholes = _pinhole_model(model, selection, cameras, names)
    points = _points(pinholes, selection, cloud)
    pixels = [(source, names[source.source.name]) for source in sources.values()]

    with atomic_folder(folder, may_hold=_ours_in(folder)) as partial:
        write_images(pixels, partial, scales)
        has_masks = masks is not None or any(source.transparent for source in sources.values())
        without_mask = write_masks(pixels, masks, partial, scales) if has_masks else ()
        sparse = partial / "sparse" / "0"
        sparse.mkdir(parents=True)
        write_binary_checked(pinholes, sparse, to_be=folder / "sparse" / "0")
        write_ply(points, sparse / "points3D.ply")
        scale = common_scale(selection.observations.depth)
        without_depth = () if maps is None else _write_depths(model, pinholes, maps, scale, partial)
        mask_of = None if not has_masks else {name: f"masks/{_stem(name)}.png" for name in names.values()}
        _write_json(transforms_json(pinholes, mask_of=mask_of), partial / "transforms.json")
        write_ply(points_saved(points), partial / "sparse_pc.ply")
        _write_json(names, partial / "names.json")

    report = TrainingReport(
        num_images=len(sources),
        num_cameras=pinholes.num_cameras(),
        num_points=len(points),
        num_observations=len(selection.observations),
        num_copied=sum(source.verbatim for source in sources.values()),
        num_renamed=sum(old != new for old, new in names.items()),
        left_out=selection.left_out,
        images_without_depth=without_depth,
        images_without_mask=without_mask,
    )
    logger.info("%s: %s", folder, report)
    return report


def _ours_in(folder: Path) -> set[str]:
    """The names in ``folder``, if it is there, that an earlier call may have written."""
    there = folder.iterdir() if folder.is_dir() else ()
    return {path.name for path in there if _OURS.fullmatch(path.name)}


def _used_cameras(model: pycolmap.Reconstruction) -> list[int]:
    return sorted({model.image(i).camera_id for i in model.reg_image_ids()})


def _look_at_images(
    model: pycolmap.Reconstruction,
    images: Path,
    selection: Selection,
    cameras: Mapping[int, CentredPinhole],
    bits: Mapping[str, int],
) -> dict[int, TrainingImage]:
    """By image id, the files of the selected images, all looked at before anything is written."""
    sources: dict[int, TrainingImage] = {}
    id_of: dict[str, int] = {}
    for i in selection.image_ids:
        name = model.image(i).name
        if name in id_of:
            raise InputError(f"{name}: images {id_of[name]} and {i} of the model have this name; one file is one image")
        id_of[name] = i
        sources[i] = look_at_image(images, name, cameras[model.image(i).camera_id], bits=bits.get(name))
    return sources


def _stem(name: str) -> str:
    return PurePosixPath(name).stem


# ------------------------------------------------------------------------------- model
def _pinhole_model(
    model: pycolmap.Reconstruction,
    selection: Selection,
    cameras: Mapping[int, CentredPinhole],
    names: Mapping[str, str],
) -> pycolmap.Reconstruction:
    """The selection as a model; image ids stay, cameras and points are numbered anew from 1."""
    pinholes = pycolmap.Reconstruction()
    used = sorted({model.image(i).camera_id for i in selection.image_ids})
    new_id = {camera_id: number for number, camera_id in enumerate(used, start=1)}
    for camera_id, number in new_id.items():
        pinholes.add_camera_with_trivial_rig(cameras[camera_id].pinhole.colmap_camera(number))

    tracks = [pycolmap.Track() for _ in selection.xyz]
    for row, i in enumerate(selection.image_ids):
        seen = selection.observations.where(selection.observations.image == row)
        for k, point in enumerate(seen.point):
            tracks[point].add_element(i, k)
        original = model.image(i)
        image = pycolmap.Image(name=names[original.name], camera_id=new_id[original.camera_id], image_id=i)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(xy) for xy in seen.xy])
        pinholes.add_image_with_trivial_frame(image, original.cam_from_world())
    for xyz, rgb, track in zip(selection.xyz, selection.rgb, tracks, strict=True):
        pinholes.add_point3D(xyz, track, rgb)
    pinholes.update_point_3d_errors()
    return pinholes


def _points(pinholes: pycolmap.Reconstruction, selection: Selection, cloud: PointCloud | None) -> PointCloud:
    """The points in the order of ``points3D.bin``, with normals."""
    centres = np.array([pinholes.image(i).projection_center() for i in selection.image_ids])
    towards = _unit(centres[selection.observations.image] - selection.xyz[selection.observations.point])
    normals = np.zeros_like(selection.xyz)
    np.add.at(normals, selection.observations.point, towards)
    normals = _unit(normals)
    if cloud is not None and cloud.normals is not None and len(cloud):
        nearest = nearest_camera_distance(centres, selection.xyz, selection.observations)
        # A balanced tree would answer no faster and take twice as long to build.
        gap, row = cKDTree(cloud.xyz, balanced_tree=False, compact_nodes=False).query(selection.xyz)
        lent = cloud.normals[row].astype(np.float64)
        lent[np.einsum("pi,pi->p", lent, normals) < 0] *= -1
        normals = np.where((gap <= NORMAL_REACH_PER_DISTANCE * nearest)[:, None], lent, normals)
    return PointCloud(xyz=selection.xyz, rgb=selection.rgb, normals=normals.astype(np.float32))


def _unit(vectors: FloatArray) -> FloatArray:
    """Along z where the length is zero."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.where(length > 0, vectors / np.maximum(length, np.finfo(float).tiny), (0.0, 0.0, 1.0))


# ------------------------------------------------------------------------------- depth
def _write_depths(
    model: pycolmap.Reconstruction, pinholes: pycolmap.Reconstruction, maps: DepthMaps, scale: float, folder: Path
) -> tuple[str, ...]:
    """``depths/`` and ``sparse/0/depth_params.json``; returns the names in the model of images without a map.

    An image without a map gets a black one and scale 0: 3DGS ends where a file is missing, and ignores those.
    """
    (folder / "depths").mkdir()
    small = _with_small_cameras(pinholes)
    missing = {model.image(i).name: pinholes.image(i) for i in sorted(pinholes.reg_image_ids())}
    params = {}
    for found in depth_of_model(model, small, maps):
        stem = _stem(missing.pop(found.name).name)
        (folder / "depths" / f"{stem}.png").write_bytes(encoded(".png", inverse_depth_values(found.depth, scale)))
        params[stem] = {"scale": scale, "offset": 0.0}
    for image in missing.values():
        camera = small.camera(image.camera_id)
        black = np.zeros((camera.height, camera.width), np.uint16)
        (folder / "depths" / f"{_stem(image.name)}.png").write_bytes(encoded(".png", black))
        params[_stem(image.name)] = {"scale": 0.0, "offset": 0.0}
    _write_json(params, folder / "sparse" / "0" / "depth_params.json")
    return tuple(missing)


def _with_small_cameras(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """The same images, without points, for depth maps of at most ``MAX_DEPTH_SIDE_PX``."""
    small = pycolmap.Reconstruction()
    for camera in model.cameras.values():
        shrink = min(1.0, MAX_DEPTH_SIDE_PX / max(camera.width, camera.height))
        resized = pycolmap.Camera(camera.todict())
        resized.rescale(max(1, round(shrink * camera.width)), max(1, round(shrink * camera.height)))
        small.add_camera_with_trivial_rig(resized)
    for i in model.reg_image_ids():
        image = pycolmap.Image(name=model.image(i).name, camera_id=model.image(i).camera_id, image_id=i)
        small.add_image_with_trivial_frame(image, model.image(i).cam_from_world())
    return small


def _write_json(document: object, path: Path) -> None:
    path.write_text(json.dumps(document, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
