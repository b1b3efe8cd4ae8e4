"""Which images see the same surface, as the stitched geometry has it.

Matching every image with every other costs the square of their number and finds look-alike places.
Here an image is paired with those that see its own surface: samples of what it sees are projected into
the others, and must come out inside the image, at the depth that the other sees there.
The next module to read is ``feature_matches``.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array

from smust3r_colmap.geometry.arrays import FloatArray, Pair
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.geometry.sim3 import invert_rigid

SAMPLES_PER_IMAGE = 64
"""Points that stand for what an image sees: an overlap is known to some 6 % then."""
CELLS = 8
"""The depth that an image sees is kept on a grid of so many cells a side."""
STITCHED_DEPTH_AGREEMENT = 0.3
"""Relative difference of depth up to which two images of a stitched model see one surface: before the adjustment poses
differ by more than the noise of depth (``geometry.depth_noise``)."""
MAX_VIEW_ANGLE_DEG = 50.0
"""SIFT does not match a surface seen from directions that differ by more."""
MIN_SCORE = 0.1
"""Pairs that share less than this part of what they see are not worth matching."""
SAME_PLACE = 2
"""Images this near in order to one that is paired already say little new."""
_VOXELS_PER_DEPTH = 4.0


@dataclass(frozen=True, kw_only=True, eq=False)
class SeenSurface:
    """One image, and samples of the surface in it.

    Args:
        image: index into the collection.
        cam_from_world: (3, 4) rigid.
        intrinsics: at the original image size.
        points_world: (S, 3) what the image sees; may be empty, then it is paired with nothing.
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


def select_pairs(surfaces: Sequence[SeenSurface], *, per_image: int, known: Collection[Pair]) -> tuple[Pair, ...]:
    """New pairs (i < j) of images that see the same surface, at most ``per_image`` chosen for each image.

    The best come first; one that is next in order to a pair that is known or chosen already is passed over,
    so that the choice reaches the other passes of the camera rather than its own neighbours.

    Args:
        surfaces: of all images of a model.
        per_image: how many new pairs an image may choose; others may choose it, too.
        known: pairs that have been matched already; none of them is returned.
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
            if any(other + step in taken for step in range(-SAME_PLACE, SAME_PLACE + 1)):
                continue
            taken.add(other)
            chosen.add((min(image, other), max(image, other)))
            new += 1
    return tuple(sorted(chosen))


def covisibility(surfaces: Sequence[SeenSurface]) -> csr_array:
    """(N, N) sparse, symmetric: the geometric mean of the parts that two images see of each other's surface.

    Entries below ``MIN_SCORE`` and the diagonal are left out. Candidates come from the voxels that two
    images share, so the cost grows with the number of overlaps, not with the square of the images.
    """
    n = len(surfaces)
    sampled = [s.points_world[sample_rows(len(s.points_world), SAMPLES_PER_IMAGE)] for s in surfaces]
    candidates = _sharing_voxels(surfaces, sampled)
    grids = [_depth_grid(surface) for surface in surfaces]
    centres = invert_rigid(np.stack([s.cam_from_world for s in surfaces]))[:, :, 3] if n else np.empty((0, 3))
    rows, columns, parts = [], [], []
    for j, surface in enumerate(surfaces):
        others = [int(i) for i in candidates.indices[candidates.indptr[j] : candidates.indptr[j + 1]] if i != j]
        if not others:
            continue
        seen = _part_seen(surface, grids[j], [sampled[i] for i in others], centres[others], centres[j])
        rows += others
        columns += [j] * len(others)
        parts += seen.tolist()
    one_way = csr_array((np.asarray(parts, dtype=np.float64), (rows, columns)), shape=(n, n))
    both = one_way.multiply(one_way.T).sqrt().tocsr()
    both.data[both.data < MIN_SCORE] = 0.0
    both.eliminate_zeros()
    return both


def _sharing_voxels(surfaces: Sequence[SeenSurface], sampled: Sequence[FloatArray]) -> csr_array:
    """(N, N) sparse, how many voxels two images share, also counting the voxels next to a sample."""
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
    """(CELLS, CELLS) median depth of what the image sees, NaN where no sample falls."""
    grid = np.full((CELLS, CELLS), np.nan)
    points_cam = _in_camera(surface, surface.points_world)
    row, column, inside = _cell_of(surface, points_cam)
    for cell in np.unique(row[inside] * CELLS + column[inside]):
        here = inside & (row * CELLS + column == cell)
        grid[cell // CELLS, cell % CELLS] = np.median(points_cam[here, 2])
    return grid


def _part_seen(
    surface: SeenSurface,
    grid: FloatArray,
    samples: Sequence[FloatArray],
    centres: FloatArray,
    centre: FloatArray,
) -> FloatArray:
    """(K,) part of each other image's samples that this image sees, from a direction not too different."""
    sizes = np.array([len(points) for points in samples])
    owner = np.repeat(np.arange(len(samples)), sizes)
    points = np.concatenate(samples)
    points_cam = _in_camera(surface, points)
    row, column, inside = _cell_of(surface, points_cam)
    seen_depth = grid[np.where(inside, row, 0), np.where(inside, column, 0)]
    # Where nothing is known (NaN) the comparison is false, and the sample passes.
    same = ~(np.abs(points_cam[:, 2] - seen_depth) > STITCHED_DEPTH_AGREEMENT * seen_depth)
    there, here = points - centres[owner], points - centre
    lengths = np.linalg.norm(there, axis=1) * np.linalg.norm(here, axis=1)
    cosine = np.einsum("ij,ij->i", there, here) / np.maximum(lengths, np.finfo(float).tiny)
    good = inside & same & (cosine > np.cos(np.deg2rad(MAX_VIEW_ANGLE_DEG)))
    part: FloatArray = np.bincount(owner[good], minlength=len(samples)) / np.maximum(sizes, 1)
    return part


def _in_camera(surface: SeenSurface, points_world: FloatArray) -> FloatArray:
    pose = surface.cam_from_world
    points: FloatArray = points_world @ pose[:, :3].T + pose[:, 3]
    return points


def _cell_of(
    surface: SeenSurface, points_cam: FloatArray
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], npt.NDArray[np.bool_]]:
    """Row and column of the grid cell of each point, and whether it lies in the image at all."""
    width, height = surface.intrinsics.width, surface.intrinsics.height
    xy = np.full((len(points_cam), 2), -1.0)
    front = points_cam[:, 2] > 0
    xy[front] = np.nan_to_num(surface.intrinsics.xy_img(points_cam[front]), nan=-1.0)
    inside = front & (xy >= 0).all(axis=1) & (xy[:, 0] < width) & (xy[:, 1] < height)
    cell = np.where(inside[:, None], xy / (width, height) * CELLS, 0).astype(np.int64)
    return cell[:, 1], cell[:, 0], inside
