"""Descriptors of images as a network would give them, and places that only look alike.

Two images are alike as far as they see the same surface from near by. The overlap of every pair of
images is measured in the true scene; vectors with these inner products, to which all images have
something in common and places have a manner of their own, are the descriptors.
The next module to read is ``backbone``.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from smust3r_colmap.errors import ConfigError
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.synthetic.settings import SimulationSettings
from smust3r_colmap.synthetic.truth import TrueScene

POINTS_PER_IMAGE = (6, 8)
"""Rows and columns of the points by which overlap is measured; 48 of them tell it to some percent."""
SAME_SURFACE_RELATIVE_DEPTH = 0.05
"""Relative depth difference up to which a point is seen and not hidden. Wider than
``geometry.depth_noise.VISIBILITY``: it is read at the nearest pixel, also across slanted surfaces."""
ANGLE_SCALE_DEG = 30.0
"""Between two views of a point, at which it counts 1/e: descriptors stand turns of some ten degrees."""
LOG_DISTANCE_SCALE = 0.7
"""The same for the logarithm of the ratio of its depths: about twice as near."""
NO_OVERLAP = 0.02
"""Overlap up to which two images have nothing in common: one point of 48 may be chance."""

COMMON_SHARE = 0.25
"""Of the squared length of a descriptor: what all images of a collection have in common."""
MANNER_SHARE = 0.2
"""What all images of a place and its surroundings have in common; gives pairs that share no surface their spread."""
MANNER_WAVES = 6
"""Random waves over space that make it; fewer would spread more."""
CONTENT_DIMENSIONS = 256
"""At most, of the part that follows the overlap."""
FALSE_COSINE = 0.95
"""Of the images of a false pair of places, before the noise: the paper's threshold."""
FALSE_REACH = 10
"""Images on either side of false places that a loop segment takes in as well."""
FALSE_MARGIN = 0.25
"""What such surroundings may truly have in common, summed over pairs of images and relative to what the
places have in common by mistake: below one, the mistake prevails (``SimulatedBackbone``), with some to spare."""


# ------------------------------------------------------------------------------- overlap
@lru_cache(maxsize=2)
def overlap_matrix(truth: TrueScene) -> FloatArray:
    """(N, N) from 0 to 1, symmetric: how far two images see the same surface from near by.

    The share of one's points that the other sees, each counted by how far angle and depth agree;
    the geometric mean of both directions. Kept for the next backbone of the same scene, so read-only.
    """
    samples = [_samples_world(truth, k) for k in range(len(truth))]
    points_world = np.array([points for points, _ in samples])  # (N, P, 3)
    depths = np.array([depth for _, depth in samples])  # (N, P), 0 where there is none
    views = points_world - truth.world_from_cam[:, None, :, 3]
    views /= np.maximum(np.linalg.norm(views, axis=2, keepdims=True), 1e-12)
    seen = np.array([_seen_share(truth, k, points_world, depths, views) for k in range(len(truth))])
    overlap: FloatArray = np.sqrt(seen * seen.T)
    np.fill_diagonal(overlap, 1.0)
    overlap.flags.writeable = False
    return overlap


def _samples_world(truth: TrueScene, k: int) -> tuple[FloatArray, FloatArray]:
    """(P, 3) points and (P,) depths of a grid of pixels of one image; the camera itself where there is no depth."""
    depth = truth.depth(k)
    rows, columns = (
        ((np.arange(count) + 0.5) * size / count).astype(int)
        for count, size in zip(POINTS_PER_IMAGE, depth.shape, strict=True)
    )
    z = depth[np.ix_(rows, columns)].ravel().astype(np.float64)
    xy_img = np.stack(np.meshgrid(columns + 0.5, rows + 0.5), axis=-1).reshape(-1, 2)
    pose = truth.world_from_cam[k]
    return (truth.intrinsics.rays_cam(xy_img) * z[:, None]) @ pose[:, :3].T + pose[:, 3], z


def _seen_share(
    truth: TrueScene, k: int, points_world: FloatArray, depths: FloatArray, views: FloatArray
) -> FloatArray:
    """(N,) share of the points of every image that image k sees likewise."""
    cam_from_world = invert_rigid(truth.world_from_cam[k])
    points_cam = points_world.reshape(-1, 3) @ cam_from_world[:, :3].T + cam_from_world[:, 3]
    size = (truth.intrinsics.width, truth.intrinsics.height)
    in_front = np.flatnonzero((points_cam[:, 2] > 0) & (depths.ravel() > 0))
    xy_img = truth.intrinsics.xy_img(points_cam[in_front])
    inside = ((xy_img >= 0) & (xy_img < size)).all(axis=1)
    rows = in_front[inside]
    columns_img, rows_img = xy_img[inside].astype(int).T
    z, z_seen = points_cam[rows, 2], truth.depth(k)[rows_img, columns_img]
    same = np.abs(z - z_seen) <= SAME_SURFACE_RELATIVE_DEPTH * z
    rows, z = rows[same], z[same]

    from_here = points_world.reshape(-1, 3)[rows] - truth.world_from_cam[k, :, 3]
    cosine = (from_here * views.reshape(-1, 3)[rows]).sum(axis=1) / np.linalg.norm(from_here, axis=1)
    angle_deg = np.rad2deg(np.arccos(np.clip(cosine, -1, 1)))
    log_ratio = np.log(z / depths.ravel()[rows])
    likeness = np.exp(-((angle_deg / ANGLE_SCALE_DEG) ** 2) - (log_ratio / LOG_DISTANCE_SCALE) ** 2)
    per_image = np.bincount(rows // depths.shape[1], weights=likeness, minlength=len(depths))
    share: FloatArray = per_image / np.maximum((depths > 0).sum(axis=1), 1)
    return share


# --------------------------------------------------------------------------- descriptors
def descriptors_of(truth: TrueScene, overlap: FloatArray, rng: np.random.Generator) -> FloatArray:
    """(N, D) of unit length, without noise: neighbours have cosines about 0.9, unrelated images 0.1 to 0.4."""
    content = _vectors_with_products(overlap)
    manner = _waves_over_space(_places_world(truth), wavelength=2 * truth.typical_depth, rng=rng)
    common = np.ones((len(truth), 1))
    shares = np.sqrt([COMMON_SHARE, MANNER_SHARE, 1 - COMMON_SHARE - MANNER_SHARE])
    return np.hstack([share * part for share, part in zip(shares, (common, manner, content), strict=True)])


def with_noise(descriptors: FloatArray, noise: float, rng: np.random.Generator) -> npt.NDArray[np.float32]:
    """The same with a random vector of length ``noise`` added, of unit length again."""
    random = rng.normal(size=descriptors.shape) / np.sqrt(descriptors.shape[1])
    return _unit_rows(descriptors + noise * random).astype(np.float32)


def _vectors_with_products(products: FloatArray) -> FloatArray:
    """(N, D) of unit length whose inner products are the given ones, as far as such vectors exist."""
    values, axes = np.linalg.eigh(products)
    values, axes = values[::-1][:CONTENT_DIMENSIONS], axes[:, ::-1][:, :CONTENT_DIMENSIONS]
    return _unit_rows(axes * np.sqrt(np.maximum(values, 0.0)))


def _places_world(truth: TrueScene) -> FloatArray:
    """(N, 3) what each camera looks at, at the typical depth."""
    poses = truth.world_from_cam
    places: FloatArray = poses[:, :, 3] + truth.typical_depth * poses[:, :, 2]
    return places


def _waves_over_space(places: FloatArray, *, wavelength: float, rng: np.random.Generator) -> FloatArray:
    """(N, 2 W) of unit length: alike for near places, unrelated for places a wavelength apart or more."""
    directions = rng.normal(size=(3, MANNER_WAVES))
    phases = places @ (directions * 2 * np.pi / wavelength) + rng.uniform(0, 2 * np.pi, MANNER_WAVES)
    waves: FloatArray = np.hstack([np.cos(phases), np.sin(phases)]) / np.sqrt(MANNER_WAVES)
    return waves


def _unit_rows(vectors: FloatArray) -> FloatArray:
    rows: FloatArray = vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)
    return rows


# --------------------------------------------------------------------------- false loops
@dataclass(frozen=True, kw_only=True)
class FalseLoop:
    """Two places that look alike although they share nothing; ``first[m]`` is taken for ``second[m]``."""

    first: tuple[int, ...]
    second: tuple[int, ...]

    def alike(self, images_a: Collection[int], images_b: Collection[int]) -> tuple[tuple[int, int], ...]:
        """The pairs (m, m') of which ``first[m]`` is among some images and ``second[m']`` among others."""
        in_a = [m for m, image in enumerate(self.first) if image in images_a]
        in_b = [m for m, image in enumerate(self.second) if image in images_b]
        return tuple((m, other) for m in in_a for other in in_b)


def choose_false_loops(
    overlap: FloatArray, settings: SimulationSettings, rng: np.random.Generator
) -> tuple[FalseLoop, ...]:
    """As many pairs of places as the settings ask for, drawn among all that share no surface.

    No image belongs to two of them.

    Raises:
        ConfigError: the scene does not have that many.
    """
    chosen: list[FalseLoop] = []
    width, taken = settings.false_loop_images, np.zeros(len(overlap), dtype=bool)
    starts = (
        _apart(overlap, width=width, gap=settings.false_loop_gap) if settings.false_loops else np.zeros((0, 2), int)
    )
    for a, b in rng.permutation(starts).tolist():
        if len(chosen) == settings.false_loops:
            break
        if not (taken[a : a + width].any() or taken[b : b + width].any()):
            taken[a : a + width] = taken[b : b + width] = True
            chosen.append(FalseLoop(first=tuple(range(a, a + width)), second=tuple(range(b, b + width))))
    if len(chosen) < settings.false_loops:
        raise ConfigError(
            f"simulation setting false_loops: {settings.false_loops} pairs of places wanted, found {len(chosen)} of "
            f"{width} images each, {settings.false_loop_gap} images apart and without common surface"
        )
    return tuple(sorted(chosen, key=lambda loop: loop.first))


def _apart(overlap: FloatArray, *, width: int, gap: int) -> npt.NDArray[np.int64]:
    """(K, 2) first images of two windows that have nothing in common, and whose surroundings have little."""
    n = len(overlap)
    first = np.arange(n - width + 1)
    last = first + width
    inside = _block_sums(overlap > NO_OVERLAP, first, last)
    around = _block_sums(overlap, np.maximum(first - FALSE_REACH, 0), np.minimum(last + FALSE_REACH, n))
    alone = (inside < 0.5) & (around <= FALSE_MARGIN * width**2)
    return np.argwhere(alone & (first[None, :] - first[:, None] >= gap))


def _block_sums(values: npt.ArrayLike, lower: npt.NDArray[np.int64], upper: npt.NDArray[np.int64]) -> FloatArray:
    """(W, W) sums of (N, N) values over the rows of one window and the columns of another, by a summed-area table."""
    table = np.pad(np.asarray(values, dtype=np.float64).cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    sums: FloatArray = table[np.ix_(upper, upper)] - table[np.ix_(lower, upper)]
    sums += table[np.ix_(lower, lower)] - table[np.ix_(upper, lower)]
    return sums


def made_alike(descriptors: FloatArray, loops: tuple[FalseLoop, ...]) -> FloatArray:
    """Descriptors (N, D) of unit length in which every pair of images of a false loop has cosine ``FALSE_COSINE``.

    Each takes on some of the other, d_a + s d_b and d_b + s d_a, so that both still resemble their neighbours.
    With c the cosine before and t the one wanted, (1 + s^2) c + 2 s = t (1 + s^2 + 2 s c) gives
    s = q - sqrt(q^2 - 1), q = (1 - t c) / (t - c).
    """
    out: FloatArray = descriptors.copy()
    for loop in loops:
        a, b = descriptors[list(loop.first)], descriptors[list(loop.second)]
        c = (a * b).sum(axis=1, keepdims=True)
        q = (1 - FALSE_COSINE * c) / np.maximum(FALSE_COSINE - c, 1e-12)
        s = q - np.sqrt(q**2 - 1)
        out[list(loop.first)], out[list(loop.second)] = _unit_rows(a + s * b), _unit_rows(b + s * a)
    return out
