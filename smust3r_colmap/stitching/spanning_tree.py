"""From alignments between submodels to one frame per connected part.

The chain is the best spanning tree of the accepted edges: the one whose edges rest on most inliers.
In a plain sequence that is the chain of neighbouring segments. Submodels that no edge reaches are parts
of their own. The pose graph takes the chain as its start; the next module to read is ``stitch``.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree

from smust3r_colmap.geometry.sim3 import Sim3
from smust3r_colmap.geometry.transform import Transform
from smust3r_colmap.products import SegmentAlignment

LOOP_STRENGTH_FACTOR = 1e-6
"""Factor on the strength of edges to loops: they belong to the tree only where nothing else connects."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ChainedPart:
    """Connected submodels, in the frame of the first of them.

    Args:
        submodels: positions in the list of all submodels; the first is the world frame.
        world_from_seg: one per submodel, the first the identity, or a scale (``common_unit``); all in one group.
        edges: positions of the alignments in the spanning tree.
    """

    submodels: tuple[int, ...]
    world_from_seg: tuple[Transform, ...]
    edges: tuple[int, ...]


def chain_submodels(
    nodes: Sequence[int],
    alignments: Sequence[SegmentAlignment],
    *,
    loops: Collection[int] = (),
    group: type[Transform] = Sim3,
) -> tuple[ChainedPart, ...]:
    """Connected parts of the submodels, each chained along its best spanning tree.

    Args:
        nodes: positions of the submodels that take part; the lowest is its part's world frame (paper
            III-B: everything is expressed in the first segment's frame).
        alignments: edges; only accepted ones between two nodes are used.
        loops: nodes that are loop segments; the tree runs through one only where nothing else connects.
        group: of the transforms, which are all in it.
    """
    place = {node: k for k, node in enumerate(sorted(nodes))}
    strength = {}
    best: dict[tuple[int, int], int] = {}
    for position, edge in enumerate(alignments):
        if not edge.accepted or edge.target not in place or edge.source not in place:
            continue
        strength[position] = _strength(edge) * (
            LOOP_STRENGTH_FACTOR if edge.target in loops or edge.source in loops else 1.0
        )
        pair = (min(edge.target, edge.source), max(edge.target, edge.source))
        if pair not in best or strength[position] > strength[best[pair]]:
            best[pair] = position
    cost = scipy.sparse.lil_matrix((len(place), len(place)))
    for (a, b), position in best.items():
        cost[place[a], place[b]] = 1.0 / strength[position]
    tree = minimum_spanning_tree(cost.tocsr())
    count, label = connected_components(tree, directed=False)
    in_order = sorted(nodes)
    parts = []
    for part in range(count):
        root = int(np.flatnonzero(label == part)[0])
        order, parent = breadth_first_order(tree, root, directed=False)
        world_from = {in_order[root]: group.identity()}
        used = []
        for number in order[1:]:
            node, before = in_order[number], in_order[parent[number]]
            position = best[min(before, node), max(before, node)]
            edge = alignments[position]
            before_from_node = edge.estimate.b_from_a if edge.target == before else edge.estimate.b_from_a.inverse()
            world_from[node] = world_from[before] @ before_from_node
            used.append(position)
        submodels = tuple(sorted(world_from))
        parts.append(
            ChainedPart(
                submodels=submodels,
                world_from_seg=tuple(world_from[submodel] for submodel in submodels),
                edges=tuple(sorted(used)),
            )
        )
    return tuple(parts)


def _strength(edge: SegmentAlignment) -> float:
    """How well an edge is founded: its inliers, discounted where they do not fit well.

    A relative residual of one percent halves the count; sound edges have 0.0003 to 0.046.
    """
    return max(edge.estimate.num_inliers, 1) / (1.0 + edge.relative_residual / 0.01)
