"""Rules about what programs want beside the model: PLY, inverse depth, masks, the dense workspace."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import PurePosixPath

import numpy as np
from scipy.spatial import cKDTree

from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.validation.description import DenseFolder, Subject
from smust3r_colmap.validation.rules import Evidence, Severity, measured, offenders, rule

_PLY_COLUMNS = ("nx", "ny", "nz", "red", "green", "blue")
_COMPARED_POINTS = 2000
_SAME_PLACE_RADII = 1e-3
"""Of the radius of the points; single precision and any rounding in text are far below."""

_MAX_MOVED_SHARE = 0.01
_DEPTH_SCALE_RATIO_RANGE = (0.2, 5.0)
"""Times the median scale, outside of which 3DGS leaves a depth map out."""

_WRITE_TRAINER = "write the training dataset again, which writes points3D.ply from the model"


@rule(
    "ply-unreadable",
    "points3D.ply cannot be read",
    severity=Severity.WARNING,
    advice=f"delete it, or {_WRITE_TRAINER}",
)
def _ply_unreadable(subject: Subject) -> Evidence | None:
    if subject.ply is None or not subject.ply.problem:
        return None
    return measured(f"{subject.ply.path.name}: {subject.ply.problem}")


@rule(
    "ply-incomplete",
    "points3D.ply lacks normals or colours",
    severity=Severity.NOTE,
    advice=f"delete it (3DGS then writes its own), or {_WRITE_TRAINER}; normals may be zeros",
)
def _ply_incomplete(subject: Subject) -> Evidence | None:
    if subject.ply is None or subject.ply.problem:
        return None
    missing = [column for column in _PLY_COLUMNS if column not in subject.ply.properties]
    return measured(f"no {', '.join(missing)}") if missing else None


@rule(
    "ply-stale",
    "points3D.ply holds other points than the model",
    severity=Severity.WARNING,
    advice=f"delete it, or {_WRITE_TRAINER}; leave it if it is meant to be another cloud",
)
def _ply_stale(subject: Subject) -> Evidence | None:
    ply, points = subject.ply, subject.model.points
    if ply is None or ply.problem or points is None:
        return None
    if len(ply.xyz) != len(points):
        return measured(f"{len(ply.xyz):,} vertices for {len(points):,} points")
    moved = _share_moved(points.xyz, ply.xyz)
    return measured(f"{moved:.0%} of its vertices are no point of the model") if moved > _MAX_MOVED_SHARE else None


def _share_moved(points: FloatArray, vertices: FloatArray) -> float:
    """Share of a sample of the vertices that lie where no point is."""
    finite = points[np.isfinite(points).all(axis=1)]
    vertices = vertices[np.isfinite(vertices).all(axis=1)]
    if len(finite) == 0 or len(vertices) == 0:
        return 0.0
    radius = float(np.quantile(np.linalg.norm(finite - np.median(finite, axis=0), axis=1), 0.9))
    sample = vertices[:: max(1, len(vertices) // _COMPARED_POINTS)]
    distance, _ = cKDTree(finite).query(sample)
    return float((distance > _SAME_PLACE_RADII * max(radius, 1e-12)).mean())


@rule(
    "depth-params-unreadable",
    "depth_params.json cannot be read",
    severity=Severity.WARNING,
    advice="it must be {stem: {scale: number, offset: number}}",
)
def _depth_unreadable(subject: Subject) -> Evidence | None:
    if subject.depth is None or not subject.depth.problem:
        return None
    return measured(subject.depth.problem)


@rule(
    "depth-params-without-png",
    "depth_params.json without the depth PNGs of the images",
    severity=Severity.WARNING,
    advice="write depths/<image name without ending>.png, or start 3DGS without depth",
)
def _params_without_png(subject: Subject) -> Evidence | None:
    if subject.depth is None or subject.depth.params is None or subject.depth.problem:
        return None
    return _stems_missing(subject, subject.depth.pngs or frozenset())


@rule(
    "depth-png-without-params",
    "depth PNGs without an entry in depth_params.json",
    severity=Severity.WARNING,
    advice="write depth_params.json beside the model's files, with an entry for every image",
)
def _png_without_params(subject: Subject) -> Evidence | None:
    if subject.depth is None or not subject.depth.pngs or subject.depth.problem:
        return None
    return _stems_missing(subject, subject.depth.params or {})


def _stems_missing(subject: Subject, there: Iterable[str]) -> Evidence | None:
    stems = [name.rpartition(".")[0] for name in subject.model.images.names]
    known = set(there)
    return offenders([repr(stem) for stem in stems if stem not in known], of=len(stems), unit="images")


@rule(
    "depth-scale-ignored",
    "depth scales outside 0.2 to 5 times their median",
    severity=Severity.WARNING,
    advice="3DGS leaves these maps out; scale all maps alike",
)
def _depth_scale(subject: Subject) -> Evidence | None:
    if subject.depth is None or not subject.depth.params:
        return None
    scales = {stem: scale for stem, (scale, _) in subject.depth.params.items()}
    positive = [scale for scale in scales.values() if scale > 0]
    median = float(np.median(positive)) if positive else 1.0
    low, high = _DEPTH_SCALE_RATIO_RANGE[0] * median, _DEPTH_SCALE_RATIO_RANGE[1] * median
    found = [f"{stem!r}: {scale:.3g}" for stem, scale in scales.items() if not low <= scale <= high]
    return offenders(found, of=len(scales), unit="maps")


@rule(
    "mask-missing",
    "images without a mask, where others have one",
    severity=Severity.WARNING,
    advice="write a white mask for images that need none",
)
def _mask_missing(subject: Subject) -> Evidence | None:
    if subject.masks is None:
        return None
    masks = set(subject.masks.by_name)
    names = subject.model.images.names
    found = [repr(name) for name in names if not {_mask_by_name(name), _mask_by_stem(name)} & masks]
    return offenders(found, of=len(names), unit="images")


@rule(
    "mask-one-naming",
    "masks follow one of the two rules of naming only",
    severity=Severity.NOTE,
    advice="have each mask twice: COLMAP looks for <name>.png first (a.jpg.png), nerfstudio and Brush for <stem>.png",
)
def _mask_naming(subject: Subject) -> Evidence | None:
    if subject.masks is None:
        return None
    masks, names = set(subject.masks.by_name), subject.model.images.names
    found = [repr(name) for name in names if len({_mask_by_name(name), _mask_by_stem(name)} & masks) == 1]
    return offenders(found, of=len(names), unit="images")


@rule(
    "mask-size-differs",
    "masks have another size than their images",
    severity=Severity.WARNING,
    advice="write masks of the size of the images",
)
def _mask_size(subject: Subject) -> Evidence | None:
    images, cameras = subject.model.images, subject.model.camera_by_id
    masks = {} if subject.masks is None else subject.masks.by_name
    found = []
    for name, camera_id in zip(images.names, images.camera_ids.tolist(), strict=True):
        for mask in (_mask_by_name(name), _mask_by_stem(name)):
            camera, file = cameras.get(camera_id), masks.get(mask)
            if camera and file and not file.fits(camera.width, camera.height):
                found.append(f"{mask!r} is {file.width} x {file.height}, its image {camera.width} x {camera.height}")
    return offenders(found, of=len(masks), unit="masks")


def _mask_by_name(name: str) -> str:
    return f"{name}.png"


def _mask_by_stem(name: str) -> str:
    return PurePosixPath(name).with_suffix(".png").as_posix()


@rule(
    "dense-config-dangling",
    "fusion.cfg names images that have no depth map or are not in the model",
    severity=Severity.WARNING,
    advice="name only images with stereo/depth_maps/<name>.geometric.bin",
)
def _fusion_names(subject: Subject) -> Evidence | None:
    dense = subject.dense
    if dense is None or dense.fusion_names is None or not dense.depth_sizes:
        return None
    known = set(subject.model.images.names)
    found = [repr(name) for name in dense.fusion_names if name not in known or not _maps_of(dense, name)]
    return offenders(found, of=len(dense.fusion_names), unit="images")


def _maps_of(dense: DenseFolder, name: str) -> list[str]:
    """The depth maps of an image that are there."""
    candidates = (f"{name}.{kind}.bin" for kind in ("geometric", "photometric"))
    return [candidate for candidate in candidates if candidate in dense.depth_sizes]


@rule(
    "dense-map-size",
    "depth maps have another size than their camera, or are cut short",
    severity=Severity.WARNING,
    advice="maps must have the size of the undistorted images",
)
def _map_sizes(subject: Subject) -> Evidence | None:
    if subject.dense is None:
        return None
    images, cameras = subject.model.images, subject.model.camera_by_id
    found = []
    for name, camera_id in zip(images.names, images.camera_ids.tolist(), strict=True):
        camera = cameras.get(camera_id)
        for file in _maps_of(subject.dense, name):
            width, height = subject.dense.depth_sizes[file]
            if camera is not None and (width, height) != (camera.width, camera.height):
                size = f"{width} x {height}" if width else "cut short"
                found.append(f"{file} is {size}, its camera {camera.width} x {camera.height}")
    return offenders(found, of=len(subject.dense.depth_sizes), unit="maps")


@rule(
    "dense-normals-missing",
    "depth maps without a normal map",
    severity=Severity.WARNING,
    advice="write stereo/normal_maps/<name>.geometric.bin; COLMAP's fusion stops without them",
)
def _normals_missing(subject: Subject) -> Evidence | None:
    if subject.dense is None:
        return None
    found = sorted(set(subject.dense.depth_sizes) - subject.dense.normal_maps)
    return offenders(found, of=len(subject.dense.depth_sizes), unit="maps")


RULES = (
    _ply_unreadable,
    _ply_incomplete,
    _ply_stale,
    _depth_unreadable,
    _params_without_png,
    _png_without_params,
    _depth_scale,
    _mask_missing,
    _mask_naming,
    _mask_size,
    _fusion_names,
    _map_sizes,
    _normals_missing,
)
"""In the order in which they are reported."""
