"""A pose graph without the nodes that only pass a measurement on, and the way back.

A long sequence has few nodes with loops. The edges between two of them are compounded into one, whose
covariance is that of the whole stretch. The small graph has the same minimum to first order about the
present state and is cheap to solve. ``expand`` then restores the eliminated nodes: the change of each
stretch is distributed over its edges by their covariances. This is block elimination of the
Gauss-Newton system, in an order that eliminates whole batches of nodes at once.
The next module to read is ``levenberg``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from smust3r_colmap.geometry.arrays import BoolArray, FloatArray, IntArray
from smust3r_colmap.geometry.transform import Transform
from smust3r_colmap.stitching.pose_graph.graph import ODOMETRY, PoseGraph
from smust3r_colmap.stitching.pose_graph.linearise import edge_errors, inverse_right_jacobian

SINGULAR_RIDGE = 1e-12
"""Share of its mean diagonal added to a sum of information matrices before it is inverted: two
edges of a stretch may leave the same direction open."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Contraction:
    """A small graph with the nodes of the large one that are left, and how the others left.

    Args:
        graph: between the nodes that are left.
        nodes: (n,) their numbers in the large graph.
        state: world_from_node of the large graph about which it was contracted.
        rounds: nodes taken out, a batch at a time.
    """

    graph: PoseGraph
    nodes: IntArray
    state: Transform
    rounds: tuple[_Round, ...]

    def expand(self, world_from_left: Transform) -> Transform:
        """States of all nodes from new ones (n,) of the nodes left; first order in how far these moved.

        Raises:
            ValueError: a stretch would have to bend beyond what numbers can hold.
        """
        group = type(self.state)
        new = self.state.matrix.copy()
        new[self.nodes] = world_from_left.matrix
        for taken in reversed(self.rounds):
            hangs = taken.after < 0
            anchor = np.where(hangs, taken.before, taken.after)
            stretch = self.state[taken.before].inverse() @ self.state[anchor]
            new_anchor = group.from_matrix(new[anchor])
            new_stretch = group.from_matrix(new[taken.before]).inverse() @ new_anchor
            strain = (stretch.inverse() @ new_stretch).log() - taken.offset
            bend = taken.last_offset + (taken.share @ strain[..., None])[..., 0]
            with np.errstate(over="ignore", invalid="ignore"):  # refused by the group if it happens
                last = self.state[taken.node].inverse() @ self.state[anchor] @ group.exp(bend)
            new[taken.node] = (new_anchor @ last.inverse()).matrix
        return group.from_matrix(new)


def contract(graph: PoseGraph, state: Transform, kept: BoolArray) -> Contraction:
    """Eliminates every node that has one odometry edge only, or on two edges of one kind (odometry, or one loop).

    Parallel edges of one kind are averaged under their information first.

    Args:
        graph: any.
        state: world_from_node, batch (num_nodes,), about which stretches are linearised.
        kept: (num_nodes,) nodes that must stay, such as the held one of each component.
    """
    edges = _merged(_edges_about(graph, state), state)
    left = np.ones(graph.num_nodes, dtype=bool)
    rounds: list[_Round] = []
    while len(chosen := _independent(edges, kept)):
        taken, edges = _take_out(edges, chosen, state)
        edges = _merged(edges, state)
        left[chosen] = False
        rounds.append(taken)
    new = np.cumsum(left) - 1
    transform, information = _measured(edges, state)
    small = PoseGraph(
        num_nodes=int(left.sum()),
        target=new[edges.target],
        source=new[edges.source],
        target_from_source=transform,
        information=information,
        loop=edges.loop,
    )
    return Contraction(graph=small, nodes=np.flatnonzero(left), state=state, rounds=tuple(rounds))


@dataclass(frozen=True, eq=False)
class _Edges:
    """Edges linearised about a state: the minimum of each moves its source by ``offset`` relative to its target.

    The cost of an edge is ``(e - offset)^T information (e - offset)`` when its
    ``target_from_source`` becomes ``X_t^-1 X_s exp(e)``.
    """

    target: IntArray
    source: IntArray
    offset: FloatArray
    information: FloatArray
    loop: IntArray

    def __getitem__(self, index: BoolArray | IntArray) -> _Edges:
        return _Edges(
            self.target[index], self.source[index], self.offset[index], self.information[index], self.loop[index]
        )

    def __len__(self) -> int:
        return len(self.target)

    def turned(self, mask: BoolArray, state: Transform) -> _Edges:
        """The same with the edges under the mask read from their other end.

        ``(E exp(e))^-1 = E^-1 exp(-Ad(E) e)``: the offset becomes ``-Ad(E)`` times itself.
        """
        index = np.flatnonzero(mask)
        target, source = self.target.copy(), self.source.copy()
        target[index], source[index] = self.source[index], self.target[index]
        target_from_source = state[self.target[index]].inverse() @ state[self.source[index]]
        back = target_from_source.inverse().adjoint()
        offset, information = self.offset.copy(), self.information.copy()
        offset[index] = -_times(target_from_source.adjoint(), offset[index])
        information[index] = np.swapaxes(back, 1, 2) @ information[index] @ back
        return _Edges(target, source, offset, information, self.loop)


@dataclass(frozen=True, eq=False)
class _Round:
    """Nodes taken out together. Each stood between two others, or hung on one (then ``after`` is -1).

    Args:
        node, before, after: (K,) numbers in the large graph.
        offset, last_offset: (K, DOF) wanted by the whole stretch, and by its edge node -> after.
        share: (K, DOF, DOF) part of the strain of the stretch that its last edge takes.
    """

    node: IntArray
    before: IntArray
    after: IntArray
    offset: FloatArray
    last_offset: FloatArray
    share: FloatArray


def _edges_about(graph: PoseGraph, state: Transform) -> _Edges:
    """``r + J_r^-1(r) e`` is the residual after a move e, so that e = -r is wanted (J_r^-1(r) r = r)."""
    residual = edge_errors(graph, state).residual
    jacobian = inverse_right_jacobian(type(state), residual)
    information = np.swapaxes(jacobian, 1, 2) @ graph.information @ jacobian
    return _Edges(graph.target, graph.source, -residual, information, graph.loop)


def _measured(edges: _Edges, state: Transform) -> tuple[Transform, FloatArray]:
    """The transforms and information of a pose graph with these edges; the inverse of ``_edges_about``."""
    group = type(state)
    transform = state[edges.target].inverse() @ state[edges.source] @ group.exp(edges.offset)
    jacobian = np.linalg.inv(inverse_right_jacobian(group, -edges.offset))
    return transform, _symmetric(np.swapaxes(jacobian, 1, 2) @ edges.information @ jacobian)


def _merged(edges: _Edges, state: Transform) -> _Edges:
    """One edge for all edges of a kind that join the same two nodes: their mean under their information."""
    low, high = np.minimum(edges.target, edges.source), np.maximum(edges.target, edges.source)
    key = ((edges.loop + 1) * state.batch[0] + low) * state.batch[0] + high
    _, first, group = np.unique(key, return_index=True, return_inverse=True)
    if len(first) == len(edges):
        return edges
    edges = edges.turned(edges.target > edges.source, state)
    total = np.zeros((len(first), *edges.information.shape[1:]))
    np.add.at(total, group, edges.information)
    pull = np.zeros((len(first), edges.offset.shape[1]))
    np.add.at(pull, group, _times(edges.information, edges.offset))
    mean = _solved(_ridged(total), pull[..., None])[..., 0]
    return _Edges(edges.target[first], edges.source[first], mean, total, edges.loop[first])


def _independent(edges: _Edges, kept: BoolArray) -> IntArray:
    """Nodes that can go in one round, no two of them neighbours."""
    num_nodes = len(kept)
    ends = np.concatenate([edges.target, edges.source])
    kinds = np.concatenate([edges.loop, edges.loop])
    degree = np.bincount(ends, minlength=num_nodes)
    lowest, highest = np.full(num_nodes, np.iinfo(np.int64).max), np.full(num_nodes, -2)
    np.minimum.at(lowest, ends, kinds)
    np.maximum.at(highest, ends, kinds)
    hangs = (degree == 1) & (highest == ODOMETRY)  # a loop with a node of its own stays in the small graph
    can_go = ~kept & (hangs | ((degree == 2) & (lowest == highest)))
    # Scattered priorities (Knuth's multiplicative hash): of a row of candidates about every third goes.
    priority = np.where(can_go, np.arange(num_nodes) * 2654435761 % 2**32, -1)
    of_neighbours = np.full(num_nodes, -1)
    np.maximum.at(of_neighbours, edges.target, priority[edges.source])
    np.maximum.at(of_neighbours, edges.source, priority[edges.target])
    return np.flatnonzero(can_go & (priority > of_neighbours))


def _take_out(edges: _Edges, chosen: IntArray, state: Transform) -> tuple[_Round, _Edges]:
    """Takes out nodes that are no neighbours of each other and compounds the two edges of each."""
    place = np.full(state.batch[0], -1)
    place[chosen] = np.arange(len(chosen))
    touched = (place[edges.target] >= 0) | (place[edges.source] >= 0)
    own = edges[touched]
    own = own.turned(place[own.target] >= 0, state)  # each read as other_from_chosen
    own = own[np.argsort(place[own.source], kind="stable")]
    starts = np.searchsorted(place[own.source], np.arange(len(chosen)))
    between = np.bincount(place[own.source], minlength=len(chosen)) == 2
    first = own[starts]
    second = own[starts[between] + 1]
    second = second.turned(np.ones(len(second), dtype=bool), state)  # read as chosen_from_after
    first_between = first[between]
    # E1 exp(e1) E2 exp(e2) = E1 E2 exp(Ad(E2^-1) e1 + e2) to first order
    carry = (state[second.target].inverse() @ state[second.source]).adjoint()
    first_offset = _solved(carry, first_between.offset[..., None])[..., 0]
    first_information = np.swapaxes(carry, 1, 2) @ first_between.information @ carry
    share = _solved(_ridged(first_information + second.information), first_information)
    compound = _Edges(
        first_between.target,
        second.source,
        first_offset + second.offset,
        _symmetric(second.information @ share),
        second.loop,
    )
    taken = _Round(
        node=chosen,
        before=first.target,
        after=np.full(len(chosen), -1),
        offset=np.zeros_like(first.offset),
        # A node with one edge takes the whole offset of that edge; read as node_from_before.
        last_offset=first.turned(~between, state).offset,
        share=np.zeros_like(first.information),
    )
    taken.after[between] = second.source
    taken.offset[between], taken.last_offset[between] = compound.offset, second.offset
    taken.share[between] = share
    return taken, _joined(edges[~touched], compound)


def _joined(first: _Edges, second: _Edges) -> _Edges:
    return _Edges(
        np.concatenate([first.target, second.target]),
        np.concatenate([first.source, second.source]),
        np.concatenate([first.offset, second.offset]),
        np.concatenate([first.information, second.information]),
        np.concatenate([first.loop, second.loop]),
    )


def _times(matrix: FloatArray, vector: FloatArray) -> FloatArray:
    product: FloatArray = (matrix @ vector[..., None])[..., 0]
    return product


def _solved(matrix: FloatArray, right: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.solve(matrix, right), dtype=np.float64)


def _symmetric(matrix: FloatArray) -> FloatArray:
    return np.asarray((matrix + np.swapaxes(matrix, -1, -2)) / 2)


def _ridged(information: FloatArray) -> FloatArray:
    dof = information.shape[-1]
    size = np.trace(information, axis1=-2, axis2=-1) / dof
    return np.asarray(information + (SINGULAR_RIDGE * size + np.finfo(np.float64).tiny)[:, None, None] * np.eye(dof))
