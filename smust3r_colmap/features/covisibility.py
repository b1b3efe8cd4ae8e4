"""Image pairs that see the same surface, by the known geometry.

Matching all pairs costs the square of the number of images and finds look-alike places. Here samples of the surface
that an image sees are projected into other images. A sample counts if it falls into the image at the depth that is
seen there. The next module to read is ``matching``.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array

from smust3r_colmap.geometry.arrays import FloatArray, Pair
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.geometry.sim3 import invert_rigid

SAMPLES_PER_IMAGE = 64
"""Points that represent what an image sees; they give an overlap to about 6 %."""
GRID_CELLS = 8
"""Along each side of the grid that holds the depth of an image."""
STITCHED_DEPTH_AGREEMENT = 0.3
"""Relative difference of depth up to which two images of a stitched model see one surface: before the adjustment poses
differ by more than the noise of depth (``geometry.depth_noise``)."""
MAX_VIEW_ANGLE_DEG = 50.0
"""Between the directions from which two images see a point; SIFT does not match beyond."""
MIN_COVISIBILITY = 0.1
"""Pairs with less are not matched."""
SAME_PLACE_IMAGES = 2
"""Images this near in order to a partner add little."""
_VOXELS_PER_DEPTH = 4.0


@dataclass(frozen=True, kw_only=True, eq=False)
class SeenSurface:
    """One image, and samples of the surface in it.

    Args:
        image: index into the collection.
        cam_from_world: (3, 4) rigid.
        intrinsics: at the original image size.
        points_world: (S, 3) what the image sees; if empty, the image gets no pairs.
    """

    image: int
    cam_from_world: FloatArray
    intrinsics: Intrinsics
    points_world: FloatArray

    def __post_init__(self) -> None:
        if self.cam_from_world.shape != (3, 4) or self.points_world.shape != (len(self.points_world), 3):
            raise ValueError(f"SeenSurface: pose {self.cam_from_world.shape}, points {self.points_world.shape}")


def sample_rows(count: int, wanted: int) -> npt.NDArray[np.int64]:
    """At most ``wanted`` of ``count`` rows, evenly spread."""
    rows: npt.NDArray[np.int64] = np.unique(np.linspace(0, max(count - 1, 0), min(count, wanted)).astype(np.int64))
    return rows if count else rows[:0]


def select_pairs(
    surfaces: Sequence[SeenSurface],
    *,
    per_image: int,
    known: Collection[Pair],
    around: Callable[[int, int], Iterable[int]],
) -> tuple[Pair, ...]:
    """New pairs (i < j) of images that see the same surface, at most ``per_image`` chosen for each image.

    The highest covisibility comes first. Images next in order to an existing partner are left out, so that pairs reach
    other passes of the camera rather than neighbours of neighbours.

    Args:
        surfaces: of all images of a model.
        per_image: new pairs chosen for an image; it can be chosen by others, too.
        known: matched pairs, which are not returned.
        around: the images at most so many steps before or after an image, see ``ViewGraph.around``.
    """
    scores = covisibility(surfaces)
    images = np.array([surface.image for surface in surfaces], dtype=np.int64)
    partners: dict[int, set[int]] = {int(image): set() for image in images}
    for i, j in known:
        if i in partners and j in partners:
            partners[i].add(j)
            partners[j].add(i)
    chosen: set[Pair] = set()
    for row, image in enumerate(images.tolist()):
        columns = scores.indices[scores.indptr[row] : scores.indptr[row + 1]]
        values = scores.data[scores.indptr[row] : scores.indptr[row + 1]]
        taken = set(partners[image])
        new = 0
        for column in columns[np.argsort(-values, kind="stable")]:
            other = int(images[column])
            if new == per_image:
                break
            if not taken.isdisjoint(np.asarray(around(other, SAME_PLACE_IMAGES)).tolist()):
                continue
            taken.add(other)
            chosen.add((min(image, other), max(image, other)))
            new += 1
    return tuple(sorted(chosen))


def covisibility(surfaces: Sequence[SeenSurface]) -> csr_array:
    """(N, N) sparse, symmetric: the geometric mean of the fractions that two images see of each other's surface.

    Entries below ``MIN_COVISIBILITY`` and the diagonal are left out. Candidates are images with
    a common voxel, so the cost grows with the number of overlaps, not with the square of the number of images.
    """
    n = len(surfaces)
    sampled = [s.points_world[sample_rows(len(s.points_world), SAMPLES_PER_IMAGE)] for s in surfaces]
    candidates = _sharing_voxels(surfaces, sampled)
    grids = [_depth_grid(surface) for surface in surfaces]
    centres = invert_rigid(np.stack([s.cam_from_world for s in surfaces]))[:, :, 3] if n else np.empty((0, 3))
    rows, columns, fractions = [], [], []
    for j, surface in enumerate(surfaces):
        others = [int(i) for i in candidates.indices[candidates.indptr[j] : candidates.indptr[j + 1]] if i != j]
        if not others:
            continue
        seen = _fraction_seen(surface, grids[j], [sampled[i] for i in others], centres[others], centres[j])
        rows += others
        columns += [j] * len(others)
        fractions += seen.tolist()
    one_way = csr_array((np.asarray(fractions, dtype=np.float64), (rows, columns)), shape=(n, n))
    both = one_way.multiply(one_way.T).sqrt().tocsr()
    both.data[both.data < MIN_COVISIBILITY] = 0.0
    both.eliminate_zeros()
    return both


def _sharing_voxels(surfaces: Sequence[SeenSurface], sampled: Sequence[FloatArray]) -> csr_array:
    """(N, N) sparse, the number of voxels that two images share, including the voxels next to a sample."""
    depths = [
        np.median(points @ s.cam_from_world[2, :3] + s.cam_from_world[2, 3])
        for s, points in zip(surfaces, sampled, strict=True)
        if len(points)
    ]
    if not depths:
        return csr_array((len(surfaces), len(surfaces)))
    size = max(float(np.median(np.abs(depths))) / _VOXELS_PER_DEPTH, np.finfo(float).tiny)
    shifts = np.stack(np.meshgrid(*[(-0.5, 0.5)] * 3), axis=-1).reshape(-1, 3)  # the 8 voxels around a point
    cells, owners = [], []
    for row, points in enumerate(sampled):
        mine = np.unique(np.floor(points[:, None] / size + shifts).reshape(-1, 3), axis=0)
        cells.append(mine)
        owners.append(np.full(len(mine), row))
    _, names = np.unique(np.concatenate(cells), axis=0, return_inverse=True)
    names = names.reshape(-1)
    holds = csr_array(
        (np.ones(len(names), dtype=np.int32), (np.concatenate(owners), names)),
        shape=(len(surfaces), int(names.max()) + 1 if len(names) else 1),
    )
    return (holds @ holds.T).tocsr()


def _depth_grid(surface: SeenSurface) -> FloatArray:
    """(GRID_CELLS, GRID_CELLS) median depth of the samples in each cell, NaN without samples."""
    grid = np.full((GRID_CELLS, GRID_CELLS), np.nan)
    points_cam = _in_camera(surface, surface.points_world)
    row, column, inside = _cell_of(surface, points_cam)
    for cell in np.unique(row[inside] * GRID_CELLS + column[inside]):
        here = inside & (row * GRID_CELLS + column == cell)
        grid[cell // GRID_CELLS, cell % GRID_CELLS] = np.median(points_cam[here, 2])
    return grid


def _fraction_seen(
    surface: SeenSurface,
    grid: FloatArray,
    samples: Sequence[FloatArray],
    centres: FloatArray,
    centre: FloatArray,
) -> FloatArray:
    """(K,) fraction of each other image's samples that this image sees, within ``MAX_VIEW_ANGLE_DEG``.

    The angles are not pycolmap's ``calculate_triangulation_angle``, which takes one point at a time.
    """
    sizes = np.array([len(points) for points in samples])
    owner = np.repeat(np.arange(len(samples)), sizes)
    points = np.concatenate(samples)
    points_cam = _in_camera(surface, points)
    row, column, inside = _cell_of(surface, points_cam)
    seen_depth = grid[np.where(inside, row, 0), np.where(inside, column, 0)]
    # False where the depth is unknown (NaN), so the sample counts.
    same = ~(np.abs(points_cam[:, 2] - seen_depth) > STITCHED_DEPTH_AGREEMENT * seen_depth)
    there, here = points - centres[owner], points - centre
    lengths = np.linalg.norm(there, axis=1) * np.linalg.norm(here, axis=1)
    cosine = np.einsum("ij,ij->i", there, here) / np.maximum(lengths, np.finfo(float).tiny)
    good = inside & same & (cosine > np.cos(np.deg2rad(MAX_VIEW_ANGLE_DEG)))
    fraction: FloatArray = np.bincount(owner[good], minlength=len(samples)) / np.maximum(sizes, 1)
    return fraction


def _in_camera(surface: SeenSurface, points_world: FloatArray) -> FloatArray:
    pose = surface.cam_from_world
    points: FloatArray = points_world @ pose[:, :3].T + pose[:, 3]
    return points


def _cell_of(
    surface: SeenSurface, points_cam: FloatArray
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], npt.NDArray[np.bool_]]:
    """Row and column of the grid cell of each point, and whether it lies in the image."""
    width, height = surface.intrinsics.width, surface.intrinsics.height
    xy = np.full((len(points_cam), 2), -1.0)
    front = points_cam[:, 2] > 0
    xy[front] = np.nan_to_num(surface.intrinsics.xy_img(points_cam[front]), nan=-1.0)
    inside = front & (xy >= 0).all(axis=1) & (xy[:, 0] < width) & (xy[:, 1] < height)
    cell = np.where(inside[:, None], xy / (width, height) * GRID_CELLS, 0).astype(np.int64)
    return cell[:, 1], cell[:, 0], inside
