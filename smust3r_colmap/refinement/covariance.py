"""Covariance of the camera poses of a model after bundle adjustment, by the reduced camera system.

Points are eliminated by the Schur complement; the distortion of each camera is in the system with priors for what a
camera model may lack. The gauge is that of comparisons with ground truth: after the similarity that aligns the camera
centres best, where all images count the same that anything holds. Memory is bounded: beyond ``MAX_NODES`` images
consecutive ones move as one body, and what each does within its body is added.

Source: Triggs et al. 2000, "Bundle adjustment: a modern synthesis", sections 6.1 and 9.
The next module to read is ``links``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import csr_array

from smust3r_colmap.geometry.arrays import BoolArray, FloatArray, IntArray
from smust3r_colmap.refinement.linearised_model import NUM_DISTORTIONS, LinearisedModel, similarity_generators

MAX_NODES = 600
"""Images or bodies of the dense system: 3600 to 4200 unknowns, 140 MB, three seconds."""
UNBOUNDED = 1.0
"""Standard deviation of the prior of every centre, in extents, and of every rotation, in radians. It fixes the gauge
and makes the system regular. What comes out near it is not determined by observations."""
ORIENTATION_WEIGHT = 0.02
"""Of a rotation in radians beside a centre in extents, in the alignment."""
UNMODELLED_FRACTION = 0.001
"""Of the longer image side: standard deviation of a distortion that a camera model may lack, at half that side from the
middle. A pixel for most cameras, which is what richer models change."""
PRINCIPAL_POINT_FRACTION = 0.01
"""Of the longer image side: standard deviation of a principal point; real ones lie within a percent or two."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseCovariance:
    """Covariance of each pose in the aligned gauge, for N images.

    Args:
        blocks: (N, 6, 6) of centre and rotation; centres in units of the extent, rotations in radians.
    """

    blocks: FloatArray

    @property
    def position_sigma(self) -> FloatArray:
        """(N,) root of the summed variance of the three axes: what a root mean square distance is compared with."""
        return _sigma(self.blocks[:, :3, :3])

    @property
    def rotation_sigma_rad(self) -> FloatArray:
        """(N,) likewise of the rotation."""
        return _sigma(self.blocks[:, 3:, 3:])


def _sigma(covariances: FloatArray) -> FloatArray:
    sigma: FloatArray = np.sqrt(np.maximum(np.trace(covariances, axis1=1, axis2=2), 0))
    return sigma


def pose_covariance(
    linear: LinearisedModel, *, calibrated: bool, centre_sigma: float = UNBOUNDED, max_nodes: int = MAX_NODES
) -> PoseCovariance:
    """Covariance of the poses.

    Args:
        linear: N images.
        calibrated: the intrinsics were fixed; otherwise focal length and radial distortion were adjusted.
        centre_sigma: standard deviation of each axis of a centre before the adjustment, in extents, if the initial
            poses are evidence of their own.
        max_nodes: at least 1; see the module.
    """
    n = len(linear)
    group = max(1, -(-n // max_nodes))
    body_of = np.arange(n) // group
    bases, width = _bases(linear.centres, body_of, group)
    own, information = _eliminated(linear, bases, body_of, width)
    size = width * (int(body_of[-1]) + 1)
    of_body = 1 / np.repeat([centre_sigma, UNBOUNDED], [3, width - 3]) ** 2
    priors = [np.tile(of_body, size // width), _distortion_priors(linear, calibrated=calibrated)]
    information[np.diag_indices_from(information)] += np.concatenate(priors)
    factor = cho_factor(information, lower=True, overwrite_a=True, check_finite=False)
    wanted = np.eye(len(information), size)
    covariance = cho_solve(factor, wanted, overwrite_b=True, check_finite=False)[:size]
    alone = np.asarray(np.linalg.inv(own + np.eye(6) / UNBOUNDED**2), dtype=np.float64)
    held = _sigma(alone[:, :3, :3]) < UNBOUNDED
    blocks = _aligned_blocks(linear.centres, held, covariance, bases, body_of, width)
    if group > 1:
        blocks = blocks + alone
    return PoseCovariance(blocks=blocks)


def parameter_covariance(linear: LinearisedModel, *, max_nodes: int = MAX_NODES) -> FloatArray:
    """(C K, C K) covariance of the K camera parameters of each of C cameras, all poses and points being unknown.

    Args:
        linear: its ``by_distortion`` is (M, 2, K), the Jacobian by the parameters of the camera of each observation;
            zero in columns that a camera has no parameter for, whose covariance means nothing.
        max_nodes: see the module.
    """
    n = len(linear)
    group = max(1, -(-n // max_nodes))
    body_of = np.arange(n) // group
    sizes = np.sqrt((linear.by_distortion**2).sum(axis=(0, 1)))
    units = np.where(sizes > 0, 1 / np.where(sizes > 0, sizes, 1), 1)  # so that focal lengths and distortions are alike
    bases, width = _bases(linear.centres, body_of, group)
    scaled = replace(linear, by_distortion=linear.by_distortion * units)
    _, information = _eliminated(scaled, bases, body_of, width)
    size = width * (int(body_of[-1]) + 1)
    information[np.arange(size), np.arange(size)] += 1 / UNBOUNDED**2
    lengths = np.zeros((linear.num_cameras, len(units)))
    np.add.at(lengths, linear.cameras[linear.image_of], (scaled.by_distortion**2).sum(axis=1))
    # A parameter that is not determined gets a million times the sigma that it had if all else were known.
    priors = np.where(lengths > 0, 1e-12 * lengths / linear.noise_px**2, 1).ravel()
    information[np.arange(size, len(information)), np.arange(size, len(information))] += priors
    coupling = information[:size, size:]
    factor = cho_factor(information[:size, :size], lower=True, check_finite=False)
    reduced = information[size:, size:] - coupling.T @ cho_solve(factor, coupling, check_finite=False)
    every = np.tile(units, linear.num_cameras)
    covariance: FloatArray = np.linalg.inv((reduced + reduced.T) / 2) * np.outer(every, every)
    return covariance


def _bases(centres: FloatArray, body_of: IntArray, group: int) -> tuple[FloatArray, int]:
    """(N, 6, D) how the parameters of its body move an image, and D: 6 of an image alone, 7 of a body."""
    if group == 1:
        return np.broadcast_to(np.eye(6), (len(centres), 6, 6)), 6
    counts = np.bincount(body_of)
    middles = np.stack([np.bincount(body_of, centres[:, k]) / counts for k in range(3)], axis=1)
    return similarity_generators(centres - middles[body_of], np.zeros(3)), 7


def _eliminated(
    linear: LinearisedModel, bases: FloatArray, body_of: IntArray, width: int
) -> tuple[FloatArray, FloatArray]:
    """Normal equations with points eliminated.

    Returns:
        (N, 6, 6) information of each pose, all else fixed; (D, D) of bodies and distortions, points being unknown.
    """
    root = np.sqrt(linear.weights)[:, None, None]
    by_point = linear.by_point * root
    by_pose, by_distortion = linear.by_pose * root, linear.by_distortion * root
    num_bodies = int(body_of[-1]) + 1
    first, num_distortions = width * num_bodies, by_distortion.shape[2]
    columns = np.concatenate([by_pose @ bases[linear.image_of], by_distortion], axis=2)
    bodies, cameras = body_of[linear.image_of], linear.cameras[linear.image_of]
    rows = np.concatenate(
        [
            width * bodies[:, None] + np.arange(width),
            first + num_distortions * cameras[:, None] + np.arange(num_distortions),
        ],
        axis=1,
    )
    size = first + num_distortions * linear.num_cameras
    own, mixed = np.zeros((len(linear), 6, 6)), np.zeros((size, size))
    ends = np.searchsorted(linear.image_of, np.arange(len(linear) + 1))
    for image, (start, end) in enumerate(pairwise(ends.tolist())):
        if start == end:
            continue
        own[image] = np.einsum("mri,mrj->ij", by_pose[start:end], by_pose[start:end], optimize=True)
        flat = columns[start:end].reshape(-1, columns.shape[2])
        mixed[np.ix_(rows[start], rows[start])] += flat.T @ flat
    whitening = _whitening(by_point, linear.point_of, len(linear.points))
    crossed = columns.transpose(0, 2, 1) @ by_point @ whitening[linear.point_of]
    at = np.broadcast_to(3 * linear.point_of[:, None, None] + np.arange(3), crossed.shape)
    coupling = csr_array(
        (crossed.ravel(), (np.broadcast_to(rows[:, :, None], crossed.shape).ravel(), at.ravel())),
        shape=(size, 3 * len(linear.points)),
    )
    information = np.asarray(mixed - (coupling @ coupling.T).toarray())
    return own / linear.noise_px**2, information / linear.noise_px**2


def _whitening(by_point: FloatArray, point_of: IntArray, num_points: int) -> FloatArray:
    """(P, 3, 3) W with ``W W^T`` the inverse information of each point; directions without information do not count."""
    information = np.zeros((num_points, 3, 3))
    np.add.at(information, point_of, by_point.transpose(0, 2, 1) @ by_point)
    values, vectors = np.linalg.eigh(information)
    known = values > 1e-9 * values[:, -1:]
    return vectors * np.where(known, 1 / np.sqrt(np.where(known, values, 1)), 0)[:, None, :]


def _distortion_priors(linear: LinearisedModel, *, calibrated: bool) -> FloatArray:
    """(10 C,) information of the priors of the distortions of the cameras."""
    fractions = np.full(NUM_DISTORTIONS, UNMODELLED_FRACTION)
    if not calibrated:  # principal point, focal length and the first radial distortion
        fractions[:4] = PRINCIPAL_POINT_FRACTION, PRINCIPAL_POINT_FRACTION, 1.0, 1.0
    priors: FloatArray = 1 / np.outer(linear.longer_side_px, fractions).ravel() ** 2
    return priors


def _alignment(generators: FloatArray, held: BoolArray) -> FloatArray:
    """(7, N, 6) the similarity that takes perturbed poses back best, from their perturbations.

    Images that nothing holds have no part in it. Orientations count little beside the centres, but give the roll that
    centres on a line leave free.
    """
    n = len(generators)
    rows = np.repeat([1.0, ORIENTATION_WEIGHT], 3) * held[:, None]
    inverse = np.linalg.pinv((generators * rows[:, :, None]).reshape(6 * n, 7), rcond=1e-9)
    fit: FloatArray = inverse.reshape(7, n, 6) * rows
    return fit


def _aligned_blocks(
    centres: FloatArray, held: BoolArray, covariance: FloatArray, bases: FloatArray, body_of: IntArray, width: int
) -> FloatArray:
    """(N, 6, 6) covariance of each pose after the similarity that aligns the centres best.

    A perturbation x becomes ``x - G K x``: K gives the similarity that fits its shifts of the centres, G applies it."""
    generators = similarity_generators(centres, np.zeros(3))
    by_image = np.einsum("snk,nkd->snd", _alignment(generators, held), bases)
    by_body = np.zeros((int(body_of[-1]) + 1, 7, width))
    np.add.at(by_body, body_of, by_image.transpose(1, 0, 2))
    fitted = by_body.transpose(1, 0, 2).reshape(7, -1)
    k_c = fitted @ covariance
    k_c_k = k_c @ fitted.T
    k_c = k_c.reshape(7, -1, width)[:, body_of]  # (7, N, D)
    bodies = covariance.reshape(-1, width, covariance.shape[0] // width, width)
    own = bases @ bodies[body_of, :, body_of] @ bases.transpose(0, 2, 1)
    cross = generators @ np.einsum("snd,nkd->nsk", k_c, bases)
    blocks: FloatArray = own - cross - cross.transpose(0, 2, 1) + generators @ k_c_k @ generators.transpose(0, 2, 1)
    return blocks
