"""From edges to frames: the chain, the accepted loops, the pose graph (paper section III-F).

Submodels are chained along their overlaps first. Every loop segment is then verified
(``loop_verification``), the accepted ones become nodes of the graph, and all frames are optimised
together. Loops that the graph rejects are removed again. The next module to read is ``camera_fusion``.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from smust3r_colmap.geometry.so3 import angles_between
from smust3r_colmap.geometry.transform import Transform
from smust3r_colmap.products import SegmentAlignment, Submodel
from smust3r_colmap.segmentation.loop_segments import PlannedLoop
from smust3r_colmap.segmentation.view_graph import ViewGraph
from smust3r_colmap.stitching.loop_verification import LoopDecision, verify_loops
from smust3r_colmap.stitching.pose_graph.graph import ODOMETRY, PoseGraph
from smust3r_colmap.stitching.pose_graph.optimise import GraphSolution, Kernel, optimise
from smust3r_colmap.stitching.spanning_tree import ChainedPart, chain_submodels


@dataclass(frozen=True, kw_only=True)
class ClosureGap:
    """How far apart the two sides of a loop are, joined through the loop segment.

    Args:
        distance: median over the cameras of the second end, as a part of the extent of all cameras.
        turn_deg: the same of their orientations.
    """

    distance: float
    turn_deg: float


UNKNOWN_GAP = ClosureGap(distance=np.nan, turn_deg=np.nan)


@dataclass(frozen=True, kw_only=True, eq=False)
class Stitching:
    """One frame per connected component, without and with the loops.

    Args:
        chained: the window submodels along their spanning trees, loops left out.
        parts: the connected parts after the graph, loop submodels among their submodels.
        decisions: one per planned loop.
        loop_weights: per planned loop, its weight in the pose graph; NaN where it took no part.
        gaps: per planned loop, its gap in ``chained`` and in ``parts``.
        solution: what the optimiser reports.
        num_edges: of the graph.
    """

    chained: tuple[ChainedPart, ...]
    parts: tuple[ChainedPart, ...]
    decisions: tuple[LoopDecision, ...]
    loop_weights: tuple[float, ...]
    gaps: tuple[tuple[ClosureGap, ClosureGap], ...]
    solution: GraphSolution
    num_edges: int


def stitch_submodels(
    submodels: Sequence[Submodel],
    alignments: Sequence[SegmentAlignment],
    loops: Sequence[PlannedLoop],
    view_graph: ViewGraph,
    *,
    group: type[Transform],
    kernel: Kernel,
) -> Stitching:
    """Chain the windows, verify the loops, optimise the graph, remove the loops that it rejects.

    Args:
        submodels: of windows and loop segments.
        alignments: between them, all in the group; only accepted ones are used.
        loops: as planned.
        view_graph: of the images.
        group: of all transforms.
        kernel: what keeps a false loop from bending the graph.
    """
    loop_segments = {loop.segment.index for loop in loops}
    windows = [k for k, submodel in enumerate(submodels) if submodel.segment not in loop_segments]
    chained = chain_submodels(windows, alignments, group=group)
    decisions = list(verify_loops(loops, submodels, alignments, chained, view_graph))
    accepted = [number for number, one in enumerate(decisions) if one.accepted]
    loop_submodels = {_submodel(decisions[number]): k for k, number in enumerate(accepted)}
    start = chain_submodels([*windows, *loop_submodels], alignments, loops=loop_submodels, group=group)
    graph, world_from_node, node_of = _graph(start, alignments, loop_submodels, group)
    solution = optimise(graph, world_from_node, kernel=kernel)
    for k in solution.rejected_loops:
        number = accepted[k]
        sigmas = np.sqrt(solution.loop_distances[k] / (solution.information_scale * group.DOF))
        reason = f"inconsistent with the other edges of the pose graph ({sigmas:.1f} sigma)"
        decisions[number] = replace(decisions[number], accepted=False, reason=reason)
    if solution.stop_reason != "nothing to do":
        for number in _left_open(start, decisions, world_from_node, solution, node_of):
            reason = f"the pose graph kept the chain of windows: {solution.stop_reason}"
            decisions[number] = replace(decisions[number], accepted=False, reason=reason)
    kept = {_submodel(one) for one in decisions if one.accepted}
    parts = tuple(
        _placed(part, solution.world_from_node, node_of)
        for part in chain_submodels([*windows, *kept], alignments, loops=kept, group=group)
    )
    gaps = tuple(
        (closure_gap(one, submodels, alignments, chained), closure_gap(one, submodels, alignments, parts))
        for one in decisions
    )
    loop_weights = [math.nan] * len(decisions)
    for number, weight in zip(accepted, solution.loop_weights, strict=True):
        loop_weights[number] = float(weight)
    return Stitching(
        chained=chained,
        parts=parts,
        decisions=tuple(decisions),
        loop_weights=tuple(loop_weights),
        gaps=gaps,
        solution=solution,
        num_edges=len(graph),
    )


def _submodel(decision: LoopDecision) -> int:
    assert decision.submodel is not None, "an accepted loop has a submodel"
    return decision.submodel


def _left_open(
    start: Sequence[ChainedPart],
    decisions: Sequence[LoopDecision],
    world_from_node: Transform,
    solution: GraphSolution,
    node_of: Mapping[int, int],
) -> list[int]:
    """Accepted loops of parts that no step improved, unless nothing else holds their windows together."""
    moved = (solution.world_from_node.matrix != world_from_node.matrix).any(axis=(-1, -2))
    at_rest = {
        submodel
        for part in start
        if not moved[[node_of[p] for p in part.submodels]].any()
        for submodel in part.submodels
    }
    return [
        number
        for number, one in enumerate(decisions)
        if one.accepted and one.submodel in at_rest and np.isfinite(one.closure_sigmas)
    ]


def _graph(
    start: Sequence[ChainedPart],
    alignments: Sequence[SegmentAlignment],
    loop_submodels: Mapping[int, int],
    group: type[Transform],
) -> tuple[PoseGraph, Transform, dict[int, int]]:
    """The graph of all parts, the frames to start from, and the node of each submodel."""
    frames = {
        submodel: frame for part in start for submodel, frame in zip(part.submodels, part.world_from_seg, strict=True)
    }
    node_of = {submodel: node for node, submodel in enumerate(sorted(frames))}
    edges = [edge for edge in alignments if edge.accepted and edge.target in node_of and edge.source in node_of]
    # Points and cameras of one pair share the distortion of their submodels: two edges inform no more than one.
    times = Counter((edge.target, edge.source) for edge in edges)
    information = [edge.information / times[edge.target, edge.source] for edge in edges]
    graph = PoseGraph(
        num_nodes=len(node_of),
        target=np.array([node_of[edge.target] for edge in edges], dtype=np.int64),
        source=np.array([node_of[edge.source] for edge in edges], dtype=np.int64),
        target_from_source=_batch([edge.estimate.b_from_a for edge in edges], group),
        information=np.array(information).reshape(-1, group.DOF, group.DOF),
        loop=np.array([_loop_of(edge, loop_submodels) for edge in edges], dtype=np.int64),
    )
    return graph, _batch([frames[submodel] for submodel in node_of], group), node_of


def _batch(transforms: Sequence[Transform], group: type[Transform]) -> Transform:
    return group.from_matrix(np.array([one.matrix for one in transforms]).reshape(-1, 4, 4))


def _loop_of(edge: SegmentAlignment, loop_submodels: Mapping[int, int]) -> int:
    """Number of the loop an edge belongs to; the source is the later submodel, and loops come after windows."""
    return loop_submodels.get(edge.source, ODOMETRY)


def _placed(part: ChainedPart, world_from_node: Transform, node_of: Mapping[int, int]) -> ChainedPart:
    """The part with optimised frames, in that of its first submodel."""
    nodes = [node_of[submodel] for submodel in part.submodels]
    first_from_world = world_from_node[nodes[0]].inverse()
    return replace(part, world_from_seg=tuple(first_from_world @ world_from_node[node] for node in nodes))


def closure_gap(
    decision: LoopDecision,
    submodels: Sequence[Submodel],
    alignments: Sequence[SegmentAlignment],
    parts: Collection[ChainedPart],
) -> ClosureGap:
    """Where the window of the second end puts its cameras, against where the loop puts them.

    The loop submodel is placed by its edge to the window of the first end; its cameras of the second end
    are compared with those of the other window. NaN where the loop has no edges, where nothing
    connects the two windows, and as a distance where the cameras have no extent.
    """
    if not decision.edges:
        return UNKNOWN_GAP
    first, second = (alignments[edge] for edge in decision.edges)
    for part in parts:
        if first.target in part.submodels and second.target in part.submodels:
            frames = dict(zip(part.submodels, part.world_from_seg, strict=True))
            world_from_loop = frames[first.target] @ first.estimate.b_from_a
            loop_submodel, window = submodels[second.source], submodels[second.target]
            shared = sorted(set(loop_submodel.images) & set(window.images))
            by_loop = world_from_loop.move_cameras(loop_submodel.seg_from_cam[_places(loop_submodel, shared)])
            by_window = frames[second.target].move_cameras(window.seg_from_cam[_places(window, shared)])
            distances = np.linalg.norm(by_loop[:, :, 3] - by_window[:, :, 3], axis=1)
            extent = _extent(part, submodels)
            return ClosureGap(
                distance=float(np.median(distances)) / extent if extent > 0 else np.nan,
                turn_deg=float(np.degrees(np.median(angles_between(by_loop[:, :, :3], by_window[:, :, :3])))),
            )
    return UNKNOWN_GAP


def _places(submodel: Submodel, images: Collection[int]) -> list[int]:
    return [submodel.images.index(image) for image in images]


def _extent(part: ChainedPart, submodels: Sequence[Submodel]) -> float:
    """Diagonal of the box around all cameras of a part."""
    centres = [
        frame.apply(submodels[submodel].seg_from_cam[:, :, 3])
        for submodel, frame in zip(part.submodels, part.world_from_seg, strict=True)
    ]
    return float(np.linalg.norm(np.ptp(np.concatenate(centres), axis=0)))
