"""The pose graph as a value: nodes are segments, edges are measured transforms between them.

Odometry edges join submodels of the sequence. The others are loop closures. All edges of a loop are
accepted or rejected together, because a false loop is false in every one of them. The next module to read
is ``linearise``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from smust3r_colmap.geometry.arrays import FloatArray, IntArray
from smust3r_colmap.geometry.transform import Transform

ODOMETRY = -1
"""Loop number of odometry edges; the robust kernel does not apply to them."""
SEMIDEFINITE_TOLERANCE = 1e-8
"""Smallest eigenvalue of an information matrix over its largest entry; rounding of a rank-deficient one."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseGraph:
    """Measured transforms between ``num_nodes`` frames.

    Args:
        num_nodes: number of frames; some may have no edge.
        target, source: (M,) nodes that an edge joins; several edges may join the same two.
        target_from_source: batch (M,), of any group.
        information: (M, DOF, DOF) inverse covariance of the right perturbation
            ``target_from_source @ exp(delta)``; it may be singular.
        loop: (M,) number of the loop that the edge belongs to, or -1 for odometry edges.
            Loops are numbered from 0 without gaps.

    Raises:
        ValueError: a shape does not fit, a node or a loop number is out of range, an edge joins a
            node to itself, or an information matrix is not finite, symmetric and positive semidefinite.
    """

    num_nodes: int
    target: IntArray
    source: IntArray
    target_from_source: Transform
    information: FloatArray
    loop: IntArray

    def __post_init__(self) -> None:
        for name in ("target", "source", "loop"):
            object.__setattr__(self, name, _integers(name, getattr(self, name)))
        object.__setattr__(self, "information", np.asarray(self.information, dtype=np.float64))
        self._check_shapes()
        self._check_numbers()
        _check_information(self.information)

    def _check_shapes(self) -> None:
        m, dof = len(self.target), self.target_from_source.DOF
        found = (self.source.shape, self.loop.shape, self.target_from_source.batch, self.information.shape)
        if found != ((m,), (m,), (m,), (m, dof, dof)):
            raise ValueError(
                f"PoseGraph: {m} targets, but source {found[0]}, loop {found[1]}, target_from_source {found[2]}, "
                f"information {found[3]}; needed ({m},) three times and ({m}, {dof}, {dof})"
            )

    def _check_numbers(self) -> None:
        for name, nodes in (("target", self.target), ("source", self.source)):
            bad = np.flatnonzero((nodes < 0) | (nodes >= self.num_nodes))
            if len(bad):
                raise ValueError(f"PoseGraph: {name} of edge {bad[0]} is node {nodes[bad[0]]} of {self.num_nodes}")
        same = np.flatnonzero(self.target == self.source)
        if len(same):
            raise ValueError(f"PoseGraph: edge {same[0]} joins node {self.target[same[0]]} to itself")
        loops = np.unique(self.loop[self.loop != ODOMETRY])
        if len(loops) and (loops[0] < 0 or loops[-1] != len(loops) - 1):
            raise ValueError(
                f"PoseGraph: loops must be numbered from 0 without gaps, found {loops[:5]} ... {loops[-1]}"
            )

    def __len__(self) -> int:
        return len(self.target)

    @property
    def num_loops(self) -> int:
        """Number of loops, each of one edge or more."""
        return int(self.loop.max(initial=ODOMETRY)) + 1

    @cached_property
    def source_from_target(self) -> Transform:
        """The measured transforms read the other way, batch (M,)."""
        return self.target_from_source.inverse()

    def components(self) -> IntArray:
        """(num_nodes,) number of the connected component of each node."""
        joins = coo_array((np.ones(len(self)), (self.target, self.source)), shape=(self.num_nodes, self.num_nodes))
        labels: IntArray = connected_components(joins, directed=False)[1].astype(np.int64)
        return labels

    def with_edges(self, edges: IntArray) -> tuple[PoseGraph, IntArray]:
        """The same nodes and some of the edges; the loops that are left, by their numbers here, are renumbered."""
        loops, loop = np.unique(self.loop[edges], return_inverse=True)
        if len(loops) and loops[0] == ODOMETRY:
            loops, loop = loops[1:], loop - 1
        graph = replace(
            self,
            target=self.target[edges],
            source=self.source[edges],
            target_from_source=self.target_from_source[edges],
            information=self.information[edges],
            loop=loop,
        )
        return graph, loops

    def subgraph(self, nodes: IntArray) -> tuple[PoseGraph, IntArray]:
        """The graph of some nodes (ascending, any edge with both ends among them), and its loops' numbers here."""
        new = np.full(self.num_nodes, -1, dtype=np.int64)
        new[nodes] = np.arange(len(nodes))
        graph, loops = self.with_edges(np.flatnonzero((new[self.target] >= 0) & (new[self.source] >= 0)))
        return replace(graph, num_nodes=len(nodes), target=new[graph.target], source=new[graph.source]), loops


def loop_sums(values: FloatArray, loop: IntArray, num_loops: int) -> FloatArray:
    """(num_loops,) sum of (M,) values over the edges of each loop."""
    member = loop != ODOMETRY
    sums: FloatArray = np.bincount(loop[member], weights=values[member], minlength=num_loops).astype(np.float64)
    return sums


def edge_weights(loop_weights: FloatArray, loop: IntArray) -> FloatArray:
    """(M,) weight of each edge: one for odometry edges, that of its loop for the others."""
    return np.concatenate([loop_weights, [1.0]])[loop]


def _integers(name: str, values: npt.ArrayLike) -> IntArray:
    array = np.asarray(values)
    if array.ndim != 1 or not (np.issubdtype(array.dtype, np.integer) or not array.size):
        raise ValueError(f"PoseGraph: {name} must be a list of integers, found {array.dtype} {array.shape}")
    return array.astype(np.int64)


def _check_information(information: FloatArray) -> None:
    finite = np.isfinite(information).all(axis=(1, 2))
    if not finite.all():
        raise ValueError(f"PoseGraph: information of edge {np.flatnonzero(~finite)[0]} is not finite")
    size = np.abs(information).max(axis=(1, 2), initial=0.0)
    skewness = np.abs(information - np.swapaxes(information, 1, 2)).max(axis=(1, 2), initial=0.0)
    smallest = np.linalg.eigvalsh(information)[:, 0]
    bad = np.flatnonzero((skewness > SEMIDEFINITE_TOLERANCE * size) | (smallest < -SEMIDEFINITE_TOLERANCE * size))
    if len(bad):
        raise ValueError(
            f"PoseGraph: information of edge {bad[0]} is not symmetric positive semidefinite "
            f"(asymmetry {skewness[bad[0]]:.2g}, smallest eigenvalue {smallest[bad[0]]:.2g})"
        )
