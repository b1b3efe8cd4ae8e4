"""Exponentials and logarithms of batches of homogeneous matrices, for groups without a closed form.

SciPy's ``expm`` and ``logm`` work on one matrix at a time; a pose graph asks for 20,000 at once.
The next module to read is ``sim3``.
"""

from __future__ import annotations

import numpy as np

from smust3r_colmap.geometry.arrays import BoolArray, FloatArray

# Coefficients of the [7/7] Pade approximant of exp, and the 1-norm up to which it is exact to
# rounding. Source: Higham 2005, "The scaling and squaring method for the matrix exponential
# revisited", eq. 2.2 and table 2.3.
_PADE_7 = (17297280.0, 8648640.0, 1995840.0, 277200.0, 25200.0, 1512.0, 56.0, 1.0)
_PADE_7_NORM = 0.95

# Square roots are taken until z = (M - I) / (M + I) is below this norm (a rotation below 0.7 rad): a
# root costs as much as sixty terms of the series for the logarithm, which then needs thirty.
_SERIES_NORM = 0.5

NEGATIVE_AXIS_TOLERANCE = 1e-7
"""Radians from the negative real axis within which an eigenvalue counts as lying on it: the logarithm
loses one digit for each that the angle comes closer to pi, and half of all digits remain here."""


def matrix_exp(algebra: FloatArray) -> FloatArray:
    """Exponentials (..., 4, 4), by scaling, a Pade approximant and squaring.

    Raises:
        ValueError: an entry is not finite.
    """
    if not np.isfinite(algebra).all():
        raise ValueError("matrix_exp: an entry of a tangent vector is not finite")
    balance = _balance(algebra)
    balanced = algebra * balance
    norm = np.abs(balanced).sum(axis=-2).max(axis=-1, initial=0.0)
    halvings = np.ceil(np.log2(np.maximum(norm / _PADE_7_NORM, 1.0))).astype(int)
    result = _exp_near_zero(np.ldexp(balanced, -halvings[..., None, None]))
    for done in range(halvings.max(initial=0)):
        rows = halvings > done
        result[rows] = result[rows] @ result[rows]
    return np.asarray(result / balance)


def _exp_near_zero(x: FloatArray) -> FloatArray:
    """[7/7] Pade approximant of exp (Higham 2005, eq. 2.1)."""
    b, eye = _PADE_7, np.eye(x.shape[-1])
    x2 = x @ x
    x4 = x2 @ x2
    x6 = x4 @ x2
    odd = x @ (b[7] * x6 + b[5] * x4 + b[3] * x2 + b[1] * eye)
    even = b[6] * x6 + b[4] * x4 + b[2] * x2 + b[0] * eye
    return np.asarray(np.linalg.solve(even - odd, even + odd))


def matrix_log(matrix: FloatArray) -> FloatArray:
    """Principal logarithms (..., 4, 4), by square roots, a series near the identity and doubling.

    Raises:
        ValueError: a matrix has an eigenvalue on the closed negative real axis, such as a rotation of
            pi has, so that no real principal logarithm exists.
    """
    exists = log_exists(matrix)
    if not exists.all():
        first = tuple(int(k) for k in np.argwhere(~exists)[0])
        eigenvalues = np.array2string(np.linalg.eigvals(matrix[first]), precision=4)
        raise ValueError(
            f"no real principal logarithm: {np.count_nonzero(~exists)} of {exists.size} matrices have an eigenvalue "
            f"on the negative real axis (a rotation by pi is such a case); the first, {first}, has {eigenvalues}"
        )
    balance = _balance(matrix)
    root = matrix * balance
    z = _cayley(root)
    doublings = np.zeros(z.shape[:-2], dtype=int)
    while (far := np.linalg.norm(z, axis=(-2, -1)) >= _SERIES_NORM).any():
        root[far] = _square_root(root[far])
        z[far] = _cayley(root[far])
        doublings += far
    return np.asarray(np.ldexp(_gregory_series(z), doublings[..., None, None]) / balance)


def log_exists(matrix: FloatArray) -> BoolArray:
    """(...,) whether finite matrices (..., 4, 4) have a real principal logarithm."""
    exists = np.ones(matrix.shape[:-2], dtype=bool)
    far = _distance_from_identity(matrix) >= 1.0  # nearer, no eigenvalue can be negative
    angles = np.abs(np.angle(np.linalg.eigvals(matrix[far])))
    exists[far] = (angles < np.pi - NEGATIVE_AXIS_TOLERANCE).all(axis=-1)
    return exists


def _cayley(matrix: FloatArray) -> FloatArray:
    """(M - I) / (M + I)."""
    eye = np.eye(matrix.shape[-1])
    return np.asarray(np.linalg.solve(matrix + eye, matrix - eye))


def _gregory_series(z: FloatArray) -> FloatArray:
    """log((I + z) / (I - z)) = 2 (z + z^3/3 + z^5/5 + ...), by Horner's rule from the highest term."""
    norm = np.linalg.norm(z, axis=(-2, -1)).max(initial=1e-30)
    terms = 1 + int(np.ceil(np.log(1e-17) / (2.0 * np.log(norm))))  # z^(2 terms) is below rounding
    z2, eye = z @ z, np.eye(z.shape[-1])
    total = np.zeros_like(z)
    for power in range(2 * terms - 1, 0, -2):
        total = total @ z2 + eye / power
    return np.asarray(2.0 * (z @ total))


def _square_root(matrix: FloatArray) -> FloatArray:
    """Principal square roots (N, n, n), by the scaled Denman-Beavers iteration.

    Source: Higham 2008, "Functions of Matrices", eqs. 6.15 and 6.28 and the determinantal scaling there.
    """
    size = matrix.shape[-1]
    root, inverse_root = matrix, np.broadcast_to(np.eye(size), matrix.shape)
    distance = np.inf
    for _ in range(100):  # an angle e short of pi takes log2(1/e) + 6 steps, so 30 at the tolerance
        scale = _determinantal_scale(root, inverse_root) if distance > 0.1 else 1.0
        root, inverse_root = (
            0.5 * (scale * root + np.linalg.inv(inverse_root) / scale),
            0.5 * (scale * inverse_root + np.linalg.inv(root) / scale),
        )
        if distance < 1e-7:  # before this step, which squared it
            return np.asarray(root)
        distance = float(_distance_from_identity(root @ inverse_root).max())
    raise ValueError("no real principal logarithm: the square root of a matrix does not converge")


def _determinantal_scale(root: FloatArray, inverse_root: FloatArray) -> FloatArray:
    """(N, 1, 1) factor that keeps the two factors of the iteration of like size."""
    determinants = np.abs(np.linalg.det(root) * np.linalg.det(inverse_root))
    return np.asarray(determinants ** (-0.5 / root.shape[-1]))[:, None, None]


def _distance_from_identity(matrix: FloatArray) -> FloatArray:
    """(...,) Frobenius norm of M - I."""
    return np.asarray(np.linalg.norm(matrix - np.eye(matrix.shape[-1]), axis=(-2, -1)))


def _balance(matrix: FloatArray) -> FloatArray:
    """(..., 4, 4) factors that change the unit of length so that the two borders of a matrix are of like size.

    They are the conjugation by diag(c, c, c, 1), which exp and log commute with; c is a power of two,
    so that no digit is lost. Otherwise a translation of 1e6 would ask for twenty useless square roots.
    """
    small = 1e-12  # a border of zeros leaves c free; this keeps it finite
    column = np.linalg.norm(matrix[..., :3, 3], axis=-1) + small
    row = np.linalg.norm(matrix[..., 3, :3], axis=-1) + small
    c = np.exp2(np.round(0.5 * np.log2(column / row)))
    factors = np.ones(matrix.shape)
    factors[..., :3, 3] /= c[..., None]
    factors[..., 3, :3] *= c[..., None]
    return factors
