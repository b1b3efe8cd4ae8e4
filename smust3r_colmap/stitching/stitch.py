"""From edges to frames: the chain, the loops that can be believed, the pose graph (paper section III-F).

Pieces are chained along their overlaps first. Every loop segment then has to prove itself
(``loops.verification``), the sound ones become nodes of the graph, and all frames are optimised
together. What the graph rejects is taken out again. The next module to read is ``fusion``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from smust3r_colmap.config import LoopKernel
from smust3r_colmap.geometry.so3 import angles_between
from smust3r_colmap.geometry.transform import Transform
from smust3r_colmap.products import SegmentAlignment, SegmentPiece
from smust3r_colmap.segmentation.loop_segments import PlannedLoop
from smust3r_colmap.stitching.loop_verification import LoopVerdict, verify_loops
from smust3r_colmap.stitching.pose_graph.graph import TRUSTED, PoseGraph
from smust3r_colmap.stitching.pose_graph.optimise import GraphSolution, optimise
from smust3r_colmap.stitching.spanning_tree import ChainedPart, chain_pieces


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
    """One frame for whatever hangs together, without and with the loops.

    Args:
        chained: the window pieces along their spanning trees, loops left out.
        parts: the connected parts after the graph, loop pieces among their pieces.
        verdicts: one per planned loop.
        gaps: per planned loop, its gap in ``chained`` and in ``parts``.
        solution: what the optimiser says of itself.
        num_edges: of the graph.
    """

    chained: tuple[ChainedPart, ...]
    parts: tuple[ChainedPart, ...]
    verdicts: tuple[LoopVerdict, ...]
    gaps: tuple[tuple[ClosureGap, ClosureGap], ...]
    solution: GraphSolution
    num_edges: int


def stitch(
    pieces: Sequence[SegmentPiece],
    alignments: Sequence[SegmentAlignment],
    loops: Sequence[PlannedLoop],
    *,
    group: type[Transform],
    kernel: LoopKernel,
) -> Stitching:
    """Chain the windows, verify the loops, optimise the graph, take out what it rejects.

    Args:
        pieces: of windows and loop segments.
        alignments: between them, all in the group; only accepted ones are used.
        loops: as planned.
        group: of all transforms.
        kernel: what keeps a false loop from bending the graph.
    """
    loop_segments = {loop.segment.index for loop in loops}
    windows = [k for k, piece in enumerate(pieces) if piece.segment not in loop_segments]
    chained = chain_pieces(windows, alignments, group=group)
    verdicts = list(verify_loops(loops, pieces, alignments, chained))
    believed = [number for number, one in enumerate(verdicts) if one.accepted]
    loop_pieces = {_piece(verdicts[number]): k for k, number in enumerate(believed)}
    start = chain_pieces([*windows, *loop_pieces], alignments, loops=loop_pieces, group=group)
    graph, world_from_node, node_of = _graph(start, alignments, loop_pieces, group)
    solution = optimise(graph, world_from_node, kernel=kernel)
    for k in solution.rejected_loops:
        number = believed[k]
        sigmas = np.sqrt(solution.loop_distances[k] / (solution.information_scale * group.DOF))
        reason = f"the other edges of the graph contradict it by {sigmas:.1f} standard deviations"
        verdicts[number] = replace(verdicts[number], accepted=False, reason=reason)
    if solution.stop_reason != "nothing to do":
        for number in _left_open(start, verdicts, world_from_node, solution, node_of):
            reason = f"the pose graph kept the chain of windows: {solution.stop_reason}"
            verdicts[number] = replace(verdicts[number], accepted=False, reason=reason)
    kept = {_piece(one) for one in verdicts if one.accepted}
    parts = tuple(
        _placed(part, solution.world_from_node, node_of)
        for part in chain_pieces([*windows, *kept], alignments, loops=kept, group=group)
    )
    gaps = tuple(
        (closure_gap(one, pieces, alignments, chained), closure_gap(one, pieces, alignments, parts)) for one in verdicts
    )
    return Stitching(
        chained=chained,
        parts=parts,
        verdicts=tuple(verdicts),
        gaps=gaps,
        solution=solution,
        num_edges=len(graph),
    )


def _piece(verdict: LoopVerdict) -> int:
    assert verdict.piece is not None, "an accepted loop has a piece"
    return verdict.piece


def _left_open(
    start: Sequence[ChainedPart],
    verdicts: Sequence[LoopVerdict],
    world_from_node: Transform,
    solution: GraphSolution,
    node_of: Mapping[int, int],
) -> list[int]:
    """Believed loops of parts that no step improved, unless nothing else holds their windows together."""
    moved = (solution.world_from_node.matrix != world_from_node.matrix).any(axis=(-1, -2))
    at_rest = {piece for part in start if not moved[[node_of[p] for p in part.pieces]].any() for piece in part.pieces}
    return [
        number
        for number, one in enumerate(verdicts)
        if one.accepted and one.piece in at_rest and np.isfinite(one.closure_sigmas)
    ]


def _graph(
    start: Sequence[ChainedPart],
    alignments: Sequence[SegmentAlignment],
    loop_pieces: Mapping[int, int],
    group: type[Transform],
) -> tuple[PoseGraph, Transform, dict[int, int]]:
    """The graph of all parts, the frames to start from, and the node of each piece."""
    frames = {piece: frame for part in start for piece, frame in zip(part.pieces, part.world_from_seg, strict=True)}
    node_of = {piece: node for node, piece in enumerate(sorted(frames))}
    edges = [edge for edge in alignments if edge.accepted and edge.target in node_of and edge.source in node_of]
    # Points and cameras of one pair share the bending of their pieces: two edges say no more than one.
    times = Counter((edge.target, edge.source) for edge in edges)
    information = [edge.information / times[edge.target, edge.source] for edge in edges]
    graph = PoseGraph(
        num_nodes=len(node_of),
        target=np.array([node_of[edge.target] for edge in edges], dtype=np.int64),
        source=np.array([node_of[edge.source] for edge in edges], dtype=np.int64),
        target_from_source=_batch([edge.estimate.b_from_a for edge in edges], group),
        information=np.array(information).reshape(-1, group.DOF, group.DOF),
        loop=np.array([_loop_of(edge, loop_pieces) for edge in edges], dtype=np.int64),
    )
    return graph, _batch([frames[piece] for piece in node_of], group), node_of


def _batch(transforms: Sequence[Transform], group: type[Transform]) -> Transform:
    return group.from_matrix(np.array([one.matrix for one in transforms]).reshape(-1, 4, 4))


def _loop_of(edge: SegmentAlignment, loop_pieces: Mapping[int, int]) -> int:
    """Number of the loop an edge belongs to; the source is the later piece, and loops come after windows."""
    return loop_pieces.get(edge.source, TRUSTED)


def _placed(part: ChainedPart, world_from_node: Transform, node_of: Mapping[int, int]) -> ChainedPart:
    """The part with optimised frames, in that of its first piece."""
    nodes = [node_of[piece] for piece in part.pieces]
    first_from_world = world_from_node[nodes[0]].inverse()
    return replace(part, world_from_seg=tuple(first_from_world @ world_from_node[node] for node in nodes))


def closure_gap(
    verdict: LoopVerdict,
    pieces: Sequence[SegmentPiece],
    alignments: Sequence[SegmentAlignment],
    parts: Collection[ChainedPart],
) -> ClosureGap:
    """Where the window of the second end puts its cameras, against where the loop puts them.

    The loop piece hangs on the window of the first end by their edge; its cameras of the second end
    are compared with those of the other window. NaN where the loop has no edges, where nothing
    connects the two windows, and as a distance where the cameras have no extent.
    """
    if not verdict.edges:
        return UNKNOWN_GAP
    first, second = (alignments[edge] for edge in verdict.edges)
    for part in parts:
        if first.target in part.pieces and second.target in part.pieces:
            frames = dict(zip(part.pieces, part.world_from_seg, strict=True))
            world_from_loop = frames[first.target] @ first.estimate.b_from_a
            loop_piece, window = pieces[second.source], pieces[second.target]
            shared = sorted(set(loop_piece.images) & set(window.images))
            by_loop = world_from_loop.move_cameras(loop_piece.seg_from_cam[_places(loop_piece, shared)])
            by_window = frames[second.target].move_cameras(window.seg_from_cam[_places(window, shared)])
            distances = np.linalg.norm(by_loop[:, :, 3] - by_window[:, :, 3], axis=1)
            extent = _extent(part, pieces)
            return ClosureGap(
                distance=float(np.median(distances)) / extent if extent > 0 else np.nan,
                turn_deg=float(np.degrees(np.median(angles_between(by_loop[:, :, :3], by_window[:, :, :3])))),
            )
    return UNKNOWN_GAP


def _places(piece: SegmentPiece, images: Collection[int]) -> list[int]:
    return [piece.images.index(image) for image in images]


def _extent(part: ChainedPart, pieces: Sequence[SegmentPiece]) -> float:
    """Diagonal of the box around all cameras of a part."""
    centres = [
        frame.apply(pieces[piece].seg_from_cam[:, :, 3])
        for piece, frame in zip(part.pieces, part.world_from_seg, strict=True)
    ]
    return float(np.linalg.norm(np.ptp(np.concatenate(centres), axis=0)))
