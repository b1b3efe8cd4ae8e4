"""The errors themselves: cameras that drift, depth that bends, patches that lie, and the confidence.

Pure functions of arrays and random generators. The next module to read is ``backbone``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.geometry.so3 import nearest_rotation
from smust3r_colmap.synthetic.settings import REFERENCE_LENGTH, SimulationSettings, WarpGroup

FIELD_DEGREE = 3
"""Largest total degree of the polynomials of the smooth depth error: two humps across the image."""
BLOB_WIDTH = 32 / 512
"""Side of a patch over the width of the image."""
BLOB_EXCESS = (0.3, 1.0)
"""Least and most by which a patch is too deep, relative."""
TOP_CONFIDENCE = 10.0
"""Of a pixel without known error, before the noise of the confidence; the usual size in DUSt3R's family."""
HALF_CONFIDENCE_ERROR = 0.03
"""Known relative depth error at which half of what the confidence has above 1 is left: a patch, 30 % off at
least, keeps a hundredth of it."""
LEAST_DENOMINATOR = 0.2
"""Of a projective warp; what would be stretched more than five times is lost."""


# ------------------------------------------------------------------------------ cameras
def similarities(rotvec: FloatArray, translation: FloatArray, log_scale: FloatArray) -> FloatArray:
    """(N, 4, 4) of rotation vectors (N, 3), translations (N, 3) and logarithms of the scale (N,)."""
    out = np.zeros((len(rotvec), 4, 4))
    out[:, :3, :3] = np.exp(log_scale)[:, None, None] * Rotation.from_rotvec(rotvec).as_matrix()
    out[:, :3, 3] = translation
    out[:, 3, 3] = 1.0
    return out


def homogeneous(b_from_a: FloatArray) -> FloatArray:
    """(..., 4, 4) of (..., 3, 4)."""
    bottom = np.broadcast_to([0.0, 0.0, 0.0, 1.0], (*b_from_a.shape[:-2], 1, 4))
    return np.concatenate([b_from_a, bottom], axis=-2)


def drift_steps(
    num_steps: int, settings: SimulationSettings, *, typical_depth: float, rng: np.random.Generator
) -> FloatArray:
    """(num_steps, 4, 4) error of each step from one camera to the next, independent of each other.

    A walk of 60 such steps has the size of the settings: the root mean square of the angle, of the
    length of the translation and of the logarithm of the scale.
    """
    per_step = 1 / np.sqrt(REFERENCE_LENGTH)
    per_axis = per_step / np.sqrt(3)
    rotvec = rng.normal(size=(num_steps, 3)) * np.deg2rad(settings.drift_rotation_deg) * per_axis
    translation = rng.normal(size=(num_steps, 3)) * settings.drift_translation * typical_depth * per_axis
    return similarities(rotvec, translation, rng.normal(size=num_steps) * settings.drift_scale * per_step)


def chain_steps(world_from_cam: FloatArray, settings: SimulationSettings, rng: np.random.Generator) -> FloatArray:
    """(N - 1, 4, 4) error that the steps of every segment have in common: a turn about one axis of the world.

    Args:
        world_from_cam: (N, 3, 4) true.
        rng: of the axis and of the sign of the scale, in the same state for all segments.
    """
    axis_world = rng.normal(size=3)
    turn_world = axis_world / np.linalg.norm(axis_world) * np.deg2rad(settings.chain_rotation_deg) / REFERENCE_LENGTH
    turns_cam = turn_world @ world_from_cam[1:, :, :3]
    log_scale = rng.choice([-1.0, 1.0]) * settings.chain_scale / REFERENCE_LENGTH
    return similarities(turns_cam, np.zeros_like(turns_cam), np.full(len(turns_cam), log_scale))


def bent_path(world_from_cam: FloatArray, steps: FloatArray, seg_from_first: FloatArray) -> FloatArray:
    """(N, 4, 4) ``seg_from_cam`` with the scale that depths have there, each step with its error.

    Args:
        world_from_cam: (N, 3, 4) true.
        steps: (N - 1, 4, 4) similarities near the identity; a scale acts on all that comes after it.
        seg_from_first: (4, 4) similarity of the first camera.
    """
    exact = homogeneous(invert_rigid(world_from_cam[:-1])) @ homogeneous(world_from_cam[1:])
    path = [seg_from_first]
    for step in exact @ steps:
        path.append(path[-1] @ step)
    return np.array(path)


def random_gauge(*, typical_depth: float, rng: np.random.Generator) -> FloatArray:
    """(4, 4) rigid, turned anywhere and moved by some rooms."""
    out = np.eye(4)
    out[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    out[:3, 3] = 3 * typical_depth * rng.normal(size=3)
    return out


# ---------------------------------------------------------------------------------- warp
def random_warp(
    centres_seg: FloatArray, *, amount: float, group: WarpGroup, typical_depth: float, rng: np.random.Generator
) -> FloatArray:
    """(4, 4) a transform of the segment frame with the sizes of ``SimulationSettings.warp``.

    Args:
        centres_seg: (N, 3) of the cameras; the warp leaves their mean where it is, and the scene is taken
            to reach a typical depth further than they do.
        typical_depth: in units of the segment.
    """
    mean = centres_seg.mean(axis=0)
    radius = float(np.linalg.norm(centres_seg - mean, axis=1).max()) + typical_depth
    stretch = rng.normal(size=(3, 3))
    stretch = stretch + stretch.T  # a rotation would be no warp
    row = rng.normal(size=3)
    inner = np.eye(4)
    inner[:3, :3] += amount * stretch / np.linalg.norm(stretch, ord=2)
    if group == "sl4":
        inner[3, :3] = amount * row / np.linalg.norm(row)
    to_unit = np.eye(4)
    to_unit[:3, :3] /= radius
    to_unit[:3, 3] = -mean / radius
    warp: FloatArray = np.linalg.inv(to_unit) @ inner @ to_unit
    return warp


def warped_points(warp: FloatArray, points: FloatArray) -> FloatArray:
    """(..., 3) moved; NaN where the warp would carry them off to infinity."""
    moved = points @ warp[:3, :3].T + warp[:3, 3]
    denominator = points @ warp[3, :3] + warp[3, 3]
    kept = denominator > LEAST_DENOMINATOR
    return np.where(kept[..., None], moved / np.where(kept, denominator, 1.0)[..., None], np.nan)


def warped_cameras(warp: FloatArray, seg_from_cam: FloatArray, rays_cam: FloatArray) -> FloatArray:
    """(N, 3, 4) the rigid cameras that see the warped scene most nearly as before.

    The exact ones are projective, ``cam_from_seg @ warp^-1`` = (M | m). The centre is kept; the rotation
    is the one that brings the rays (P, 3) of pixels spread over the image nearest to M^-1 rays, where those
    pixels see now (Kabsch 1976).
    """
    seg_from_rays = np.linalg.inv((homogeneous(invert_rigid(seg_from_cam)) @ np.linalg.inv(warp))[:, :3, :3])
    seg_from_rays *= np.sign(np.linalg.det(seg_from_rays))[:, None, None]  # forwards, whatever the scale of the warp
    now_seg = rays_cam @ np.swapaxes(seg_from_rays, 1, 2)  # (N, P, 3)
    now_seg /= np.linalg.norm(now_seg, axis=2, keepdims=True)
    unit_cam = rays_cam / np.linalg.norm(rays_cam, axis=1, keepdims=True)
    out = np.empty_like(seg_from_cam)
    out[:, :, :3] = nearest_rotation(np.swapaxes(now_seg, 1, 2) @ unit_cam)
    out[:, :, 3] = warped_points(warp, seg_from_cam[:, :, 3])
    return out


# --------------------------------------------------------------------------------- depth
@lru_cache(maxsize=4)
def smooth_basis(height: int, width: int) -> FloatArray:
    """(M, H, W) products of Legendre polynomials over the image, without the constant, each of rms 1."""
    y, x = np.linspace(-1, 1, height), np.linspace(-1, 1, width)
    legendre = np.polynomial.legendre.legvander
    in_y, in_x = legendre(y, FIELD_DEGREE), legendre(x, FIELD_DEGREE)
    products = [
        np.outer(in_y[:, p], in_x[:, q])
        for p in range(FIELD_DEGREE + 1)
        for q in range(FIELD_DEGREE + 1 - p)
        if p + q > 0
    ]
    return np.array([one / np.sqrt(np.mean(one**2)) for one in products])


def smooth_coefficients(num_images: int, amount: float, rng: np.random.Generator) -> FloatArray:
    """(N, M) of the smooth error of the logarithm of depth in each image of a segment.

    Half of the variance is the same in all images, the rest is a random walk that reaches the other
    half at the 60th; there the sum over the M coefficients of the squares is ``amount**2`` on average.
    """
    m = (FIELD_DEGREE + 1) * (FIELD_DEGREE + 2) // 2 - 1
    first = rng.normal(size=(1, m)) * amount * np.sqrt(0.5 / m)
    steps = rng.normal(size=(num_images, m)) * amount * np.sqrt(0.5 / (m * REFERENCE_LENGTH))
    steps[0] = 0.0
    coefficients: FloatArray = first + np.cumsum(steps, axis=0)
    return coefficients


@dataclass(frozen=True, kw_only=True, eq=False)
class DepthError:
    """What is wrong with the depth of one image.

    Args:
        factor: (H, W) by which the true depth is multiplied.
        known: (H, W) relative error of which the confidence knows.
    """

    factor: FloatArray
    known: FloatArray


def depth_error(
    height: int, width: int, coefficients: FloatArray, settings: SimulationSettings, rng: np.random.Generator
) -> DepthError:
    """Smooth error (its (M,) coefficients given), noise and patches of one image."""
    smooth = np.tensordot(coefficients, smooth_basis(height, width), axes=1)
    noise = settings.depth_noise * rng.normal(size=(height, width))
    excess, noticed = _blobs(height, width, settings, rng)
    known_variance = settings.confidence_knows * (smooth**2 + settings.depth_noise**2) + (excess * noticed) ** 2
    return DepthError(factor=np.exp(smooth + noise) * (1 + excess), known=np.sqrt(known_variance))


def _blobs(
    height: int, width: int, settings: SimulationSettings, rng: np.random.Generator
) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """(H, W) each: by how much a pixel is too deep, relative, and whether the confidence notices.

    Patches are cells of a grid laid at random, so that they do not overlap and cover their share on average.
    """
    side = max(1, round(BLOB_WIDTH * width))
    y0, x0 = rng.integers(0, side, size=2)
    cells = (height // side + 2, width // side + 2)
    is_blob = rng.random(cells) < settings.blob_share
    excess = np.where(is_blob, rng.uniform(*BLOB_EXCESS, size=cells), 0.0)
    noticed = rng.random(cells) < settings.confidence_knows
    pixel_cells = np.ix_((np.arange(height) + y0) // side, (np.arange(width) + x0) // side)
    return excess[pixel_cells], noticed[pixel_cells]


def confidence_of(known: FloatArray, noise: float, rng: np.random.Generator) -> npt.NDArray[np.float32]:
    """(H, W) at least 1: c = 1 + 9 exp(noise) / (1 + (known / 0.03)^2)."""
    above_one = (TOP_CONFIDENCE - 1) * np.exp(noise * rng.normal(size=known.shape))
    return np.asarray(1 + above_one / (1 + (known / HALF_CONFIDENCE_ERROR) ** 2), dtype=np.float32)
