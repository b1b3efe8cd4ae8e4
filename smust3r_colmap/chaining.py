"""From alignments between pieces to one frame per connected part.

The chain is the best spanning tree of the accepted edges: the one whose edges rest on most inliers.
In a plain sequence that is the chain of neighbouring segments; where a segment came out in pieces,
it is whatever holds them together. What no edge reaches stays a part of its own.
The next module to read is ``fusion``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree

from smust3r_colmap.geometry.sim3 import Sim3
from smust3r_colmap.products import SegmentAlignment


@dataclass(frozen=True, kw_only=True)
class ChainedPart:
    """Pieces that hang together, in the frame of the first of them.

    Args:
        pieces: positions in the list of all pieces; the first is the world frame.
        world_from_seg: one per piece, the first the identity.
        edges: positions of the alignments in the spanning tree.
    """

    pieces: tuple[int, ...]
    world_from_seg: tuple[Sim3, ...]
    edges: tuple[int, ...]


def chain_pieces(num_pieces: int, alignments: Sequence[SegmentAlignment]) -> tuple[ChainedPart, ...]:
    """Connected parts of the pieces, each chained along its best spanning tree.

    Args:
        num_pieces: nodes 0 .. num_pieces - 1; the one of lowest number is its part's world frame
            (paper III-B: everything is expressed in the first segment's frame).
        alignments: edges; only accepted ones are used.
    """
    best: dict[tuple[int, int], int] = {}
    for position, edge in enumerate(alignments):
        if edge.accepted:
            pair = (min(edge.target, edge.source), max(edge.target, edge.source))
            if pair not in best or _strength(edge) > _strength(alignments[best[pair]]):
                best[pair] = position
    cost = scipy.sparse.lil_matrix((num_pieces, num_pieces))
    for pair, position in best.items():
        cost[pair] = 1.0 / _strength(alignments[position])
    tree = minimum_spanning_tree(cost.tocsr())
    count, label = connected_components(tree, directed=False)
    parts = []
    for part in range(count):
        root = int(np.flatnonzero(label == part)[0])
        order, parent = breadth_first_order(tree, root, directed=False)
        world_from = {root: Sim3.identity()}
        used = []
        for node in order[1:]:
            before = int(parent[node])
            position = best[min(before, int(node)), max(before, int(node))]
            edge = alignments[position]
            before_from_node = edge.estimate.b_from_a if edge.target == before else edge.estimate.b_from_a.inverse()
            world_from[int(node)] = world_from[before] @ before_from_node
            used.append(position)
        pieces = (root, *sorted(set(world_from) - {root}))
        parts.append(
            ChainedPart(
                pieces=pieces,
                world_from_seg=tuple(world_from[piece] for piece in pieces),
                edges=tuple(sorted(used)),
            )
        )
    return tuple(parts)


def _strength(edge: SegmentAlignment) -> float:
    """How well an edge is founded: its inliers, discounted where they do not fit well.

    A relative residual of one percent halves the count; sound edges have 0.0003 to 0.046.
    """
    return max(edge.estimate.num_inliers, 1) / (1.0 + edge.relative_residual / 0.01)
