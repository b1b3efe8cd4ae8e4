"""Residuals of a pose graph, their Jacobians, and the sparse normal equations.

An edge's residual is ``r = log(Z^-1 X_t^-1 X_s)`` with ``Z = target_from_source`` and X the
``world_from_node`` of its two nodes. Both nodes move by a right perturbation ``X @ exp(delta)``:

    dr/ddelta_s = J_r^-1(r)        dr/ddelta_t = -J_r^-1(r) Ad(X_s^-1 X_t)

Source: Sola, Deray, Atchuthan 2018, "A micro Lie theory for state estimation in robotics",
eqs. 41, 46, 67-82. The next module to read is ``contract``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.sparse import bsr_array, coo_array, csc_array, csr_array, eye_array
from scipy.sparse.linalg import SuperLU, splu

from smust3r_colmap.geometry.arrays import FloatArray, IntArray
from smust3r_colmap.geometry.transform import Transform
from smust3r_colmap.stitching.pose_graph.graph import PoseGraph

UNMEASURED = 1e-12
"""Curvature, over the largest, of a direction that no edge measures; damping needs some to hold on to."""
EVERYTHING = slice(None)
"""All of a tangent vector."""
SERIES_RADIUS = 0.3
"""Norm of ad(r) up to which the series of J_r^-1 stops after its fourth power; the first term left out
is ad^6 / 30240, below 3e-8."""
SERIES_TERMS = 8
"""Of the exponential within that radius: what is left out is 0.3^9 / 10!, below 6e-12."""


@dataclass(frozen=True, kw_only=True, eq=False)
class EdgeErrors:
    """All edges at one state: ``target_from_source`` there, a batch (M,), and the residuals (M, DOF)."""

    target_from_source: Transform
    residual: FloatArray


def edge_errors(graph: PoseGraph, world_from_node: Transform) -> EdgeErrors:
    """How far all edges are from their measurements; residuals are zero where the nodes stand as measured."""
    target_from_world = world_from_node[graph.target].inverse()
    target_from_source = target_from_world @ world_from_node[graph.source]
    residual = _log(graph.source_from_target @ target_from_source)
    return EdgeErrors(target_from_source=target_from_source, residual=residual)


def _log(errors: Transform) -> FloatArray:
    """(M, DOF) logarithms; ``E - I``, their first order, where a stretched turn by about pi has none.

    Such an edge is wrong or far from its place, and all that counts is that its residual is large.
    """
    exists = errors.log_exists()
    if exists.all():
        return errors.log()
    residual = type(errors).vee(errors.matrix - np.eye(4))
    residual[exists] = errors[exists].log()
    return residual


def squared_distances(residual: FloatArray, information: FloatArray) -> FloatArray:
    """(M,) squared Mahalanobis norms of residuals (M, DOF) under information (M, DOF, DOF)."""
    weighted: FloatArray = (information @ residual[..., None])[..., 0]
    squared: FloatArray = np.einsum("mi,mi->m", weighted, residual)
    return squared


def square_roots(information: FloatArray) -> FloatArray:
    """(M, DOF, DOF) symmetric R with ``R @ R = information``; rounding below zero counts as zero."""
    values, vectors = np.linalg.eigh(information)
    scaled = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    return np.asarray(scaled @ np.swapaxes(vectors, 1, 2))


def inverse_right_jacobian(group: type[Transform], tangent: FloatArray) -> FloatArray:
    """(M, DOF, DOF) ``J_r^-1(r)``, so that ``log(exp(r) exp(d)) = r + J_r^-1(r) d`` to first order in d.

    Small tangents by the series ``I + ad/2 + ad^2/12 - ad^4/720``, the others by inverting ``J_r``.
    """
    ad = group.small_adjoint(tangent)
    square = ad @ ad
    out: FloatArray = np.eye(group.DOF) + ad / 2 + square / 12 - square @ square / 720
    large = np.linalg.norm(ad, axis=(-2, -1)) > SERIES_RADIUS
    if large.any():
        out[large] = np.linalg.inv(_mean_exponential(-ad[large]))
    return out


def _mean_exponential(matrix: FloatArray) -> FloatArray:
    """Mean of ``exp(u A)`` over u from 0 to 1, of matrices (M, n, n), by halving, a series and doubling.

    With E(A) = exp(A) and J(A) this mean: E(2A) = E(A)^2 and J(2A) = (I + E(A)) J(A) / 2.
    """
    size = np.linalg.norm(matrix, axis=(-2, -1)).max()
    doublings = max(int(np.ceil(np.log2(size / SERIES_RADIUS))), 0)
    halved, eye = np.ldexp(matrix, -doublings), np.eye(matrix.shape[-1])
    mean = eye + halved / (SERIES_TERMS + 1)
    for k in range(SERIES_TERMS, 1, -1):
        mean = eye + halved @ mean / k
    exponential = eye + halved @ mean
    for _ in range(doublings):
        mean = (eye + exponential) @ mean / 2
        exponential = exponential @ exponential
    return mean


@dataclass(frozen=True, kw_only=True, eq=False)
class Linearisation:
    """All edges at one state: residual (M, DOF) and its derivatives (M, DOF, DOF) by the two perturbations."""

    residual: FloatArray
    by_target: FloatArray
    by_source: FloatArray


def linearise(errors: EdgeErrors) -> Linearisation:
    """Jacobians of all edges."""
    by_source = inverse_right_jacobian(type(errors.target_from_source), errors.residual)
    by_target = -by_source @ errors.target_from_source.inverse().adjoint()
    return Linearisation(residual=errors.residual, by_target=by_target, by_source=by_source)


class NormalEquations:
    """Gauss-Newton's linear system of a graph with its pattern prepared once: ``hessian @ step = -gradient``.

    Nodes marked in ``held`` do not move and have no rows. The free ones are ordered once, on the
    graph of nodes, so that the factors stay sparse.

    Args:
        graph: gives the pattern and the information.
        held: (num_nodes,) nodes that stay where they are.
        moving: the part of a tangent vector in which nodes may move.
    """

    def __init__(self, graph: PoseGraph, held: npt.NDArray[np.bool_], moving: slice = EVERYTHING) -> None:
        self._moving = moving
        self._dof = len(range(graph.target_from_source.DOF)[moving])
        self._information = graph.information
        free = np.flatnonzero(~held)
        rank = np.full(graph.num_nodes, -1, dtype=np.int64)
        rank[free] = np.arange(len(free))
        order = _fill_reducing_order(rank[graph.target], rank[graph.source], len(free))
        self._free = free[order]
        rank[self._free] = np.arange(len(free))
        self._target, self._source = rank[graph.target], rank[graph.source]
        self._prepare_pattern()

    def _prepare_pattern(self) -> None:
        n, t, s = len(self._free), self._target, self._source
        ends = np.concatenate([t, s])
        self._edges_of_node = _summation(ends, n)
        inner = np.flatnonzero((t >= 0) & (s >= 0))
        pairs, slot = np.unique(np.minimum(t, s)[inner] * n + np.maximum(t, s)[inner], return_inverse=True)
        self._inner, self._turned = inner, (t > s)[inner]
        self._edges_of_pair = _summation(slot, len(pairs))
        low, high = pairs // n, pairs % n
        rows = np.concatenate([np.arange(n), low, high])
        cols = np.concatenate([np.arange(n), high, low])
        block_order = np.lexsort((rows, cols))
        size, dof = n * self._dof, self._dof
        # Row-compressed blocks of the transpose are column-compressed blocks; the matrix is symmetric.
        indptr = np.concatenate([[0], np.cumsum(np.bincount(cols, minlength=n))])
        numbers = np.arange(len(rows) * dof * dof, dtype=np.float64).reshape(-1, dof, dof)
        numbered = csr_array(bsr_array((numbers[block_order], rows[block_order], indptr), shape=(size, size)))
        numbered.sort_indices()
        self._entry = numbered.data.astype(np.int64)
        self._indices, self._indptr = numbered.indices, numbered.indptr
        entry_cols = np.repeat(np.arange(size), np.diff(numbered.indptr))
        self._diagonal = np.flatnonzero(numbered.indices == entry_cols)

    def assemble(self, at: Linearisation, edge_weight: FloatArray) -> tuple[csc_array, FloatArray]:
        """Hessian (F * DOF, F * DOF) and gradient (F * DOF,) of half the weighted cost, F free nodes.

        Args:
            at: the edges at the present state.
            edge_weight: (M,) factor on each edge's information.
        """
        dof = self._dof
        weighted = edge_weight[:, None, None] * self._information
        by_target, by_source = at.by_target[..., self._moving], at.by_source[..., self._moving]
        target_side = np.swapaxes(by_target, 1, 2) @ weighted
        source_side = np.swapaxes(by_source, 1, 2) @ weighted
        own = np.concatenate([target_side @ by_target, source_side @ by_source])
        cross = (target_side @ by_source)[self._inner]
        cross[self._turned] = np.swapaxes(cross[self._turned], 1, 2)
        pulls = np.concatenate([target_side @ at.residual[..., None], source_side @ at.residual[..., None]])
        diagonal = (self._edges_of_node @ own.reshape(len(own), dof * dof)).reshape(-1, dof, dof)
        upper = (self._edges_of_pair @ cross.reshape(len(cross), dof * dof)).reshape(-1, dof, dof)
        blocks = np.concatenate([diagonal, np.swapaxes(upper, 1, 2), upper]).ravel()
        shape = (len(self._indptr) - 1,) * 2
        hessian = csc_array((blocks[self._entry], self._indices, self._indptr), shape=shape)
        gradient: FloatArray = (self._edges_of_node @ pulls[..., 0]).ravel()
        return hessian, gradient

    def rows(self, at: Linearisation, edges: IntArray, roots: FloatArray) -> csr_array:
        """(len(edges) * DOF, F * DOF) derivatives of the whitened residuals of some edges by the free nodes.

        Args:
            roots: (len(edges), DOF, DOF) square roots of the information of these edges.
        """
        target, source = self._target[edges], self._source[edges]
        sides = ((target, at.by_target), (source, at.by_source))
        blocks = np.stack([roots @ by[edges][..., self._moving] for _, by in sides], axis=2)
        height, width = roots.shape[1], self._dof
        columns = np.stack([node for node, _ in sides], axis=1)[:, None, :, None] * width + np.arange(width)
        columns = np.broadcast_to(columns, (len(edges), height, 2, width))
        rows = np.broadcast_to(np.arange(len(edges) * height).reshape(-1, height, 1, 1), columns.shape)
        free = columns >= 0
        shape = (len(edges) * height, len(self._free) * width)
        return csr_array(coo_array((blocks[free], (rows[free], columns[free])), shape=shape))

    def diagonal_of(self, hessian: csc_array) -> FloatArray:
        """(F * DOF,) of an assembled Hessian; what no edge measures counts as measured a little."""
        values: FloatArray = hessian.data[self._diagonal]
        return np.asarray(np.maximum(values, UNMEASURED * values.max(initial=0.0)))

    def factorise(self, hessian: csc_array, damping: FloatArray) -> SuperLU:
        """LU factors of the Hessian with ``damping`` (F * DOF,) added to its diagonal.

        Raises:
            RuntimeError: the matrix is singular.
        """
        data = hessian.data.copy()
        data[self._diagonal] += damping
        damped = csc_array((data, hessian.indices, hessian.indptr), shape=hessian.shape)
        # Symmetric positive definite: no pivoting, and the order was chosen already.
        return splu(damped, permc_spec="NATURAL", diag_pivot_thresh=0.0, options={"SymmetricMode": True})

    def move(self, world_from_node: Transform, step: FloatArray) -> Transform:
        """The state after each free node moved by its part of ``step`` (F * DOF,)."""
        tangent = np.zeros((world_from_node.batch[0], world_from_node.DOF))
        tangent[self._free, self._moving] = step.reshape(-1, self._dof)
        return world_from_node @ type(world_from_node).exp(tangent)


def _summation(group: IntArray, num_groups: int) -> csr_array:
    """(num_groups, len(group)) matrix that sums rows by group; rows of group -1 are left out."""
    member = np.flatnonzero(group >= 0)
    ones = np.ones(len(member))
    return csr_array(coo_array((ones, (group[member], member)), shape=(num_groups, len(group))))


def _fill_reducing_order(target: IntArray, source: IntArray, num_nodes: int) -> IntArray:
    """Minimum degree order of the nodes; edges with an end of -1 have a held end and do not count."""
    inner = (target >= 0) & (source >= 0)
    ends = (np.concatenate([target[inner], source[inner]]), np.concatenate([source[inner], target[inner]]))
    pattern = csc_array(coo_array((np.full(len(ends[0]), -1.0), ends), shape=(num_nodes, num_nodes)))
    pattern.data[:] = -1.0  # parallel edges were added up
    degrees = np.bincount(ends[0], minlength=num_nodes)
    dominant = csc_array(pattern + eye_array(num_nodes, format="csc").multiply(degrees + 1.0))
    factors = splu(dominant, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    order: IntArray = np.argsort(factors.perm_c).astype(np.int64)
    return order
