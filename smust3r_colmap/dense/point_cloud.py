"""One point cloud from the dense maps of all images, averaged over voxels.

Submodels overlap, so most images have several maps; one per image is used, at the fused pose, so that
cloud and cameras agree. Maps are read one image at a time. The next modules to read are the exporters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from smust3r_colmap.dense.normals import surface_normals
from smust3r_colmap.geometry.arrays import FloatArray, IntArray
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.products import CloudStatistics, DenseMaps, PointCloud
from smust3r_colmap.stitching.camera_fusion import FusedCameras, points_in_camera
from smust3r_colmap.stitching.resection import PlacedSubmodel

SAMPLES_PER_POINT = 4
"""Pixels gathered per fused point: enough for every voxel to be an average, few enough for memory."""
MIN_FILL_RATIO = 0.9
"""The search for the voxel size ends with at least this fraction of ``max_points``."""
MIN_MULTIVIEW_RATIO = 0.5
"""Voxels seen by one image only are dropped where at least this fraction of the cloud remains."""
NO_NORMAL_WEIGHT = 1e-3
"""Weight of the viewing direction where a pixel has no normal: it counts where nothing else does."""

_CELL_BITS = 21  # three axes of 21 bits fill an int64 without its sign


@dataclass(frozen=True, kw_only=True, eq=False)
class FusedPoints:
    """The cloud of a connected part, in the world frame, with normals, and what became of the pixels."""

    cloud: PointCloud
    statistics: CloudStatistics


@dataclass(frozen=True, kw_only=True, eq=False)
class _Samples:
    """Pixels in space, ordered by image; positions relative to an origin so that float32 holds them."""

    xyz: npt.NDArray[np.float32]  # (S, 3)
    normals: npt.NDArray[np.float32]  # (S, 3), length 1, or NO_NORMAL_WEIGHT where unknown
    rgb: npt.NDArray[np.uint8]  # (S, 3)
    image: npt.NDArray[np.int32]  # (S,)

    def __len__(self) -> int:
        return len(self.xyz)

    @classmethod
    def joined(cls, parts: Sequence[_Samples]) -> _Samples:
        return cls(
            xyz=np.concatenate([part.xyz for part in parts]),
            normals=np.concatenate([part.normals for part in parts]),
            rgb=np.concatenate([part.rgb for part in parts]),
            image=np.concatenate([part.image for part in parts]),
        )

    def selected(self, rows: npt.NDArray[np.bool_]) -> _Samples:
        return _Samples(xyz=self.xyz[rows], normals=self.normals[rows], rgb=self.rgb[rows], image=self.image[rows])


@dataclass(frozen=True, kw_only=True, eq=False)
class _MapSamples:
    """Of the confident pixels of one map some that are evenly spread, in its camera's axes and in world units."""

    points_cam: FloatArray  # (M, 3)
    normals_cam: FloatArray  # (M, 3)
    rgb: npt.NDArray[np.uint8]  # (M, 3)
    spacing: float  # median distance of neighbouring confident pixels, NaN where there are none
    num_pixels: int  # confident ones

    def in_world(self, image: int, world_from_cam: FloatArray, origin: FloatArray) -> _Samples:
        """Turned into the world and moved by ``-origin``."""
        rotation, centre = world_from_cam[:, :3], world_from_cam[:, 3]
        return _Samples(
            xyz=(self.points_cam @ rotation.T + (centre - origin)).astype(np.float32),
            normals=(self.normals_cam @ rotation.T).astype(np.float32),
            rgb=self.rgb,
            image=np.full(len(self.points_cam), image, dtype=np.int32),
        )


def fuse_points(
    submodels: Sequence[PlacedSubmodel],
    dense: Sequence[DenseMaps],
    cameras: FusedCameras,
    *,
    max_points: int,
    min_confidence: float,
    depth_scale: FloatArray | None = None,
) -> FusedPoints:
    """The confident pixels of all maps as one cloud, averaged over the cells of a regular grid.

    Each image gives its map once, from ``cameras.best_submodel``. The pointmap goes into the world by the
    submodel's transform, into the camera by the pose that the submodel itself placed there, and back into
    the world by the *fused* pose. For maps that are depth unprojected, under a similarity, this is depth
    times scale along the rays of the submodel's own intrinsics (those made the depth, the fused ones did
    not); maps that carry more than depth keep it, and a transform that bends them bends the cloud.

    Cells start at the median distance of neighbouring pixels and grow until ``max_points`` suffice.
    Cells that one image only saw are dropped where at least half of the cloud stays. Normals come from
    windows of pixels, face the camera, and are averaged; where no pixel of a cell has one (outlines,
    single pixels) the normal points to the cameras. The result depends on nothing but the arguments.

    Memory: about 100 bytes x ``SAMPLES_PER_POINT`` x ``max_points``, and one image's maps.

    Args:
        submodels, dense: one each, of one connected part.
        cameras: ``fuse_cameras`` of the same submodels.
        max_points: upper bound of the cloud, at least 1.
        min_confidence: pixels below are left out.
        depth_scale: (N,) what each image's map is multiplied with, where the cameras were adjusted since; 1 if
            not given.

    Raises:
        ValueError: numbers of submodels and maps differ, or ``max_points`` is below 1.
    """
    if len(submodels) != len(dense):
        raise ValueError(f"fusion: {len(submodels)} submodels and {len(dense)} sets of maps; needed one each")
    if max_points < 1:
        raise ValueError(f"max_points is {max_points}, needed at least 1")
    quota = -(-SAMPLES_PER_POINT * max_points // len(cameras.images))
    origin = np.median(invert_rigid(cameras.cam_from_world)[:, :, 3], axis=0)
    samples, spacing, num_pixels = _gathered(
        submodels,
        dense,
        cameras,
        np.ones(len(cameras.images)) if depth_scale is None else depth_scale,
        origin=origin,
        quota=quota,
        min_confidence=min_confidence,
    )
    if not len(samples):
        return FusedPoints(
            cloud=PointCloud(
                xyz=np.empty((0, 3)), rgb=np.empty((0, 3), np.uint8), normals=np.empty((0, 3), np.float32)
            ),
            statistics=CloudStatistics(voxel_size=np.nan, num_pixels=0, num_samples=0, num_far=0, num_seen_once=0),
        )
    near = _within_reach(samples.xyz, spacing)
    nearby = samples if near.all() else samples.selected(near)
    voxel_size = _voxel_size(nearby.xyz, spacing, max_points)
    cloud, num_seen_once = _averaged(nearby, _cells(nearby.xyz, voxel_size), origin)
    return FusedPoints(
        cloud=cloud,
        statistics=CloudStatistics(
            voxel_size=voxel_size,
            num_pixels=num_pixels,
            num_samples=len(samples),
            num_far=len(samples) - len(nearby),
            num_seen_once=num_seen_once,
        ),
    )


def _unit(vectors: FloatArray) -> FloatArray:
    unit: FloatArray = vectors / _lengths(vectors)[..., None]
    return unit


def _lengths(vectors: FloatArray) -> FloatArray:
    """(...) of vectors (..., 3); numpy's norm takes several times as long along so short an axis."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    return np.asarray(np.sqrt(x * x + y * y + z * z))


def _finite(vectors: FloatArray) -> npt.NDArray[np.bool_]:
    """(...) for which vectors (..., 3) all coordinates are finite."""
    x, y, z = np.moveaxis(np.isfinite(vectors), -1, 0)
    return np.asarray(x & y & z)


def _normals(points_cam: FloatArray) -> FloatArray:
    """(H, W, 3) of a pointmap in its camera's axes: length 1, or ``NO_NORMAL_WEIGHT`` towards the camera."""
    with np.errstate(invalid="ignore", divide="ignore"):
        z = points_cam[..., 2]
        seen = _finite(points_cam) & (z > 0)
        normals, determined = surface_normals(
            np.where(seen, z, 0).astype(np.float32), points_cam[..., :2] / z[..., None]
        )
    return np.where(determined[..., None], normals, NO_NORMAL_WEIGHT * normals)


def _sampled(
    placed: PlacedSubmodel, maps: DenseMaps, k: int, depth_scale: float, *, min_confidence: float, quota: int
) -> _MapSamples:
    """At most ``quota`` confident pixels of image ``k`` of a submodel."""
    points_cam = points_in_camera(placed, maps, k) * depth_scale
    with np.errstate(invalid="ignore"):
        confident = _finite(points_cam) & (maps.confidence(k) >= min_confidence) & (points_cam[..., 2] > 0)
        to_neighbour = _lengths(np.diff(points_cam, axis=1)[confident[:, 1:]])
    to_neighbour = to_neighbour[np.isfinite(to_neighbour)]
    pixels = np.flatnonzero(confident)
    count = min(quota, len(pixels))
    rows, columns = np.divmod(pixels[np.arange(count) * len(pixels) // max(count, 1)], points_cam.shape[1])
    return _MapSamples(
        points_cam=points_cam[rows, columns],
        normals_cam=_normals(points_cam)[rows, columns],
        rgb=maps.rgb(k)[rows, columns],
        spacing=float(np.median(to_neighbour)) if len(to_neighbour) else np.nan,
        num_pixels=len(pixels),
    )


def _gathered(
    submodels: Sequence[PlacedSubmodel],
    dense: Sequence[DenseMaps],
    cameras: FusedCameras,
    depth_scale: FloatArray,
    *,
    origin: FloatArray,
    quota: int,
    min_confidence: float,
) -> tuple[_Samples, float, int]:
    """Samples of all images, the median distance of neighbouring pixels, and the number of pixels."""
    parts, spacings, num_pixels = [], [], 0
    world_from_cam = invert_rigid(cameras.cam_from_world)
    each = zip(cameras.images, cameras.best_submodel, depth_scale, world_from_cam, strict=True)
    for image, best, scale, pose in each:
        k = submodels[best].submodel.images.index(image)
        sampled = _sampled(submodels[best], dense[best], k, float(scale), min_confidence=min_confidence, quota=quota)
        parts.append(sampled.in_world(image, pose, origin))
        spacings += [sampled.spacing] if np.isfinite(sampled.spacing) else []
        num_pixels += sampled.num_pixels
    samples = _Samples.joined(parts)
    spacing = float(np.median(spacings)) if spacings else 0.0
    if spacing == 0 and len(samples):  # maps one pixel wide, or all pixels in one place
        spacing = float(np.ptp(samples.xyz, axis=0).max()) * 2.0 ** (1 - _CELL_BITS) or 1.0
    return samples, spacing, num_pixels


def _within_reach(xyz: npt.NDArray[np.float32], spacing: float) -> npt.NDArray[np.bool_]:
    """(S,) which samples a grid of the finest cells around the middle can number."""
    reach = spacing * 2 ** (_CELL_BITS - 1)
    near: npt.NDArray[np.bool_] = (np.abs(xyz - np.median(xyz, axis=0)) < reach).all(axis=-1)
    return near


def _cells(xyz: npt.NDArray[np.float32], voxel_size: float) -> IntArray:
    """(S,) one number per cell of a grid that starts at the lowest corner."""
    x, y, z = (((along - along.min()) / np.float64(voxel_size)).astype(np.int64) for along in xyz.T)
    cells: IntArray = (x << 2 * _CELL_BITS) | (y << _CELL_BITS) | z
    return cells


def _num_occupied(xyz: npt.NDArray[np.float32], voxel_size: float) -> int:
    """Cells that hold a sample. Sorting takes a fiftieth of the time of ``np.unique``, which hashes."""
    cells = np.sort(_cells(xyz, voxel_size))
    return int(np.count_nonzero(np.diff(cells))) + 1


def _voxel_size(xyz: npt.NDArray[np.float32], finest: float, max_points: int) -> float:
    """The smallest size, not below ``finest``, at which at most ``max_points`` cells are occupied.

    Found by growing, then halving the bracket, to within ``MIN_FILL_RATIO`` or 2 percent of the size.
    """
    too_small, size = finest, finest
    count = _num_occupied(xyz, size)
    while count > max_points:
        too_small = size
        size *= 1.05 * np.sqrt(count / max_points)  # a surface occupies cells as size ** -2
        count = _num_occupied(xyz, size)
    while count < MIN_FILL_RATIO * max_points and size > 1.02 * too_small:
        middle = float(np.sqrt(too_small * size))
        count_middle = _num_occupied(xyz, middle)
        if count_middle > max_points:
            too_small = middle
        else:
            size, count = middle, count_middle
    return float(size)


def _averaged(samples: _Samples, cells: IntArray, origin: FloatArray) -> tuple[PointCloud, int]:
    """One point per cell, by rising cell number, and how many cells were dropped as seen once."""
    order = np.argsort(cells, kind="stable")
    starts = np.flatnonzero(np.diff(cells[order], prepend=-1))
    ends = np.append(starts[1:], len(order))
    # Samples are ordered by image and the sort is stable, so first and last tell of a second image.
    seen_twice = samples.image[order[starts]] != samples.image[order[ends - 1]]
    kept = seen_twice if seen_twice.mean() >= MIN_MULTIVIEW_RATIO else np.ones_like(seen_twice)

    def sums(values: npt.NDArray[np.float32] | npt.NDArray[np.uint8]) -> FloatArray:
        columns = [np.add.reduceat(column[order].astype(np.float64), starts)[kept] for column in values.T]
        return np.column_stack(columns)

    counts = (ends - starts)[kept, None]
    normals = sums(samples.normals)
    cancelled = np.linalg.norm(normals, axis=1) < NO_NORMAL_WEIGHT / 2  # thin walls seen from both sides
    normals[cancelled] = samples.normals[order[starts[kept][cancelled]]]
    cloud = PointCloud(
        xyz=origin + sums(samples.xyz) / counts,
        rgb=np.rint(sums(samples.rgb) / counts).astype(np.uint8),
        normals=_unit(normals).astype(np.float32),
    )
    return cloud, int(np.count_nonzero(~kept))
