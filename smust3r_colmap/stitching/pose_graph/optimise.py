"""The pose graph solved: ``optimise``, the only function that the rest of the package needs.

Each connected component by itself, with its first node held, in coordinates centred and scaled to
radius one: the linear parts, then the translations, then both, with the inlier test of the loops
in between; then the contracted graph, linearised anew about each result until the inliers no longer
change; then the whole graph under the kernel. ``loop_selection`` has the inlier test of the loops,
``start`` says why the linear parts come first.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.special import chdtri

from smust3r_colmap.geometry.arrays import BoolArray, FloatArray, IntArray
from smust3r_colmap.geometry.transform import Transform
from smust3r_colmap.stitching.pose_graph.contract import contract
from smust3r_colmap.stitching.pose_graph.graph import ODOMETRY, PoseGraph, loop_sums
from smust3r_colmap.stitching.pose_graph.levenberg import (
    cauchy,
    levenberg_marquardt,
    quadratic,
    total_cost,
    truncated,
)
from smust3r_colmap.stitching.pose_graph.linearise import NormalEquations, edge_errors, squared_distances
from smust3r_colmap.stitching.pose_graph.loop_selection import LoopInlierTest, LoopSelection, descended, loop_weights_of
from smust3r_colmap.stitching.pose_graph.normalise import Normalisation
from smust3r_colmap.stitching.pose_graph.start import (
    TRANSLATION,
    linear_part,
    only_linear,
    only_translation_of,
    part_of,
)

logger = logging.getLogger(__name__)

Kernel = Literal["cauchy", "gnc", "none"]

CONTRACTIONS = 4
"""Times that the long stretches are linearised anew; inliers change in the first two, if at all."""
RECONSIDERATIONS = 5
"""Times that the inliers may change on one small graph; 1 or 2 are typical."""
ROUNDING_COST_PER_EDGE = 1e-16
"""Squared Mahalanobis distance per edge that is rounding: the nodes stand as measured."""


@dataclass(frozen=True, kw_only=True, eq=False)
class GraphSolution:
    """The optimised nodes and the accepted loops.

    Costs are sums of squared Mahalanobis distances under the robust objective: an odometry edge counts
    with its distance, a loop with the kernel's loss of its distance, but with no more than its
    threshold, the cost of rejecting it. Both costs use the same thresholds.

    Args:
        world_from_node: batch (num_nodes,); the start, untouched, where ``improved`` is False.
        cost_before, cost_after: at the start and here.
        iterations: on the whole graph, the most of any component.
        stop_reason: ``"converged by cost"``, ``"converged by step"``, ``"iteration limit"``, ``"stuck"``
            (no step lowers the cost), ``"nothing to do"`` (all nodes stand as measured), ``"no loop accepted"``
            or ``"worse than the start"`` (the start is returned); where components differ, each reason once.
        improved: the cost fell.
        loop_weights: (L,) weight in [0, 1] that the kernel gave to each loop; 0 for rejected ones.
        loop_distances: (L,) squared Mahalanobis distance of each loop to the prediction of the rest of
            the graph; NaN where nothing was tested (kernel ``"none"``) or no other edge predicts it.
        rejected_loops: numbers of the loops that were left out, ascending.
        information_scale: factor by which squared distances were found too large, the largest of any component.
    """

    world_from_node: Transform
    cost_before: float
    cost_after: float
    iterations: int
    stop_reason: str
    improved: bool
    loop_weights: FloatArray
    loop_distances: FloatArray
    rejected_loops: IntArray
    information_scale: float


def optimise(
    graph: PoseGraph,
    world_from_node: Transform,
    *,
    kernel: Kernel = "cauchy",
    confidence: float = 1 - 1e-5,
    tolerance: float = 3.0,
    max_iterations: int = 50,
    relative_decrease: float = 1e-8,
) -> GraphSolution:
    """The states that fit all edges best, and the loops that are outliers.

    The first node of every connected component is held. Loops are tested by their leave-one-out cost
    (see ``loop_selection``); a rejected loop has no weight. ``"cauchy"`` also weighs the accepted
    loops, ``"gnc"`` gives them full weight (truncated least squares), ``"none"`` accepts all loops,
    as the paper does.

    Args:
        graph: nodes and edges.
        world_from_node: batch (num_nodes,) in the group of the edges, where to begin.
        confidence: share of the true loops that stay below the threshold; the default loses one of 100,000.
        tolerance: factor by which standard deviations may be too small without a lone true loop being
            rejected. With many loops larger factors are estimated (see ``loop_selection.information_scale``).
        max_iterations: of the descent on the whole graph.
        relative_decrease: of the cost, below which that descent has converged.

    Raises:
        ValueError: the start is of another group or length, or a parameter is out of range.
    """
    _check(graph, world_from_node, kernel, confidence, tolerance)
    matrices = world_from_node.matrix.copy()
    labels = graph.components()
    parts: list[tuple[IntArray, GraphSolution]] = []
    for label in np.flatnonzero(np.bincount(labels, minlength=1) > 1):
        nodes = np.flatnonzero(labels == label)
        component, loops = graph.subgraph(nodes)
        solution = _optimise_component(
            component,
            world_from_node[nodes],
            kernel,
            confidence=confidence,
            tolerance=tolerance,
            max_iterations=max_iterations,
            relative_decrease=relative_decrease,
        )
        if solution.improved:
            matrices[nodes[1:]] = solution.world_from_node.matrix[1:]
        parts.append((loops, solution))
    improved = any(solution.improved for _, solution in parts)
    state = type(world_from_node).from_matrix(matrices) if improved else world_from_node
    return _united(graph.num_loops, state, parts)


def _check(graph: PoseGraph, start: Transform, kernel: str, confidence: float, tolerance: float) -> None:
    if type(start) is not type(graph.target_from_source):
        raise ValueError(
            f"optimise: a start in {type(start).__name__}, edges in {type(graph.target_from_source).__name__}"
        )
    if start.batch != (graph.num_nodes,):
        raise ValueError(f"optimise: a start of shape {start.batch} for {graph.num_nodes} nodes")
    if kernel not in ("cauchy", "gnc", "none"):
        raise ValueError(f"optimise: kernel {kernel!r}; known are cauchy, gnc and none")
    if not 0.5 < confidence < 1 or tolerance < 1:
        raise ValueError(f"optimise: confidence {confidence} must be from 0.5 to 1, tolerance {tolerance} at least 1")


def _united(num_loops: int, state: Transform, parts: Sequence[tuple[IntArray, GraphSolution]]) -> GraphSolution:
    """One solution of those of the components."""
    weights, distances = np.ones(num_loops), np.full(num_loops, np.nan)
    for loops, solution in parts:
        weights[loops] = solution.loop_weights
        distances[loops] = solution.loop_distances
    rejected = [loops[solution.rejected_loops] for loops, solution in parts]
    reasons = sorted({solution.stop_reason for _, solution in parts} - {"nothing to do"}) or ["nothing to do"]
    return GraphSolution(
        world_from_node=state,
        cost_before=sum(solution.cost_before for _, solution in parts),
        cost_after=sum(solution.cost_after for _, solution in parts),
        iterations=max((solution.iterations for _, solution in parts), default=0),
        stop_reason=", ".join(reasons),
        improved=any(solution.improved for _, solution in parts),
        loop_weights=weights,
        loop_distances=distances,
        rejected_loops=np.sort(np.concatenate([np.zeros(0, dtype=np.int64), *rejected])),
        information_scale=max((solution.information_scale for _, solution in parts), default=1.0),
    )


def _optimise_component(
    graph: PoseGraph,
    start: Transform,
    kernel: Kernel,
    *,
    confidence: float,
    tolerance: float,
    max_iterations: int,
    relative_decrease: float,
) -> GraphSolution:
    """A connected graph, its first node held."""
    before = squared_distances(edge_errors(graph, start).residual, graph.information)
    if before.sum() <= ROUNDING_COST_PER_EDGE * len(graph):
        return _start_kept(graph, start, float(before.sum()), 0, "nothing to do")
    normal = Normalisation.about(start)
    unit_graph, unit_start = normal.graph(graph), normal.state(start)
    held = np.arange(graph.num_nodes) == 0
    inlier_test = (
        None if kernel == "none" or not graph.num_loops else LoopInlierTest(confidence=confidence, tolerance=tolerance)
    )
    selection = _select_loops(unit_graph, unit_start, held, inlier_test)
    threshold = _kernel_thresholds(unit_graph, selection, confidence)
    weights = loop_weights_of(selection.kept)
    loss = cauchy(weights, threshold) if kernel == "cauchy" else quadratic(weights)
    end = levenberg_marquardt(
        unit_graph,
        selection.world_from_node,
        held,
        loss,
        max_iterations=max_iterations,
        relative_decrease=relative_decrease,
    )
    full = np.ones(graph.num_loops)
    whole = quadratic(full) if kernel != "cauchy" else cauchy(full, threshold)
    objective = whole if inlier_test is None else truncated(whole, threshold)
    after = squared_distances(edge_errors(unit_graph, end.world_from_node).residual, unit_graph.information)
    cost_before, cost_after = total_cost(graph, objective, before), total_cost(graph, objective, after)
    if not cost_after < cost_before:
        reason = "worse than the start" if cost_after > cost_before else end.stop_reason
        if graph.num_loops and not selection.kept.any():
            reason = "no loop accepted"
        return _start_kept(graph, start, cost_before, end.iterations, reason, selection)
    loop_weight = np.where(selection.kept, loss.weight(loop_sums(after, graph.loop, graph.num_loops)), 0.0)
    return GraphSolution(
        world_from_node=normal.undone(end.world_from_node),
        cost_before=cost_before,
        cost_after=cost_after,
        iterations=end.iterations,
        stop_reason=end.stop_reason,
        improved=True,
        loop_weights=loop_weight,
        loop_distances=selection.distance,
        rejected_loops=np.flatnonzero(~selection.kept),
        information_scale=selection.scale,
    )


def _start_kept(
    graph: PoseGraph,
    start: Transform,
    cost: float,
    iterations: int,
    reason: str,
    selection: LoopSelection | None = None,
) -> GraphSolution:
    """The start itself as the solution, with the evidence about the loops."""
    kept = np.ones(graph.num_loops, dtype=bool) if selection is None else selection.kept
    return GraphSolution(
        world_from_node=start,
        cost_before=cost,
        cost_after=cost,
        iterations=iterations,
        stop_reason=reason,
        improved=False,
        loop_weights=kept.astype(np.float64),
        loop_distances=np.full(graph.num_loops, np.nan) if selection is None else selection.distance,
        rejected_loops=np.flatnonzero(~kept),
        information_scale=1.0 if selection is None else selection.scale,
    )


def _select_loops(
    graph: PoseGraph, start: Transform, held: BoolArray, inlier_test: LoopInlierTest | None
) -> LoopSelection:
    """The accepted loops, and a state near their minimum."""
    if graph.num_loops == 0:
        return _all_loops(graph, start)
    small = contract(graph, start, held)
    selection = _by_parts(small.graph, start[small.nodes], held[small.nodes], inlier_test)
    seen: list[BoolArray] = []
    for _ in range(CONTRACTIONS):
        selection = _settled(small.graph, selection, held[small.nodes], inlier_test)
        try:
            state = small.expand(selection.world_from_node)
        except ValueError:  # contradictory loops can crumple a small graph beyond numbers
            logger.warning(
                "pose graph: the %d loops that seemed to agree have no common solution", selection.kept.sum()
            )
            return replace(selection, world_from_node=start)
        selection = replace(selection, world_from_node=state)
        if inlier_test is None or selection.kept.all() or any((selection.kept == kept).all() for kept in seen):
            break
        seen.append(selection.kept)
        small = contract(graph, state, held)
        selection = replace(selection, world_from_node=state[small.nodes])
    return selection


def _all_loops(graph: PoseGraph, state: Transform) -> LoopSelection:
    return LoopSelection(
        world_from_node=state,
        kept=np.ones(graph.num_loops, dtype=bool),
        scale=1.0,
        threshold=np.full(graph.num_loops, np.inf),
        distance=np.full(graph.num_loops, np.nan),
    )


def _by_parts(graph: PoseGraph, start: Transform, held: BoolArray, inlier_test: LoopInlierTest | None) -> LoopSelection:
    """Linear parts, then translations, then both. Loops that the first step rejects take no part in the next."""
    group = type(start)
    part = linear_part(group)
    linear = part_of(graph, part, only_linear(graph.target_from_source))
    equations = NormalEquations(linear, held, part)
    first = _all_loops(graph, only_linear(start))
    if inlier_test is not None:
        first = _plausible(linear, first, equations, held, inlier_test)
    selection = _annealed(linear, first, equations, held, inlier_test)
    state = only_translation_of(start, selection.world_from_node)
    translation = part_of(graph, TRANSLATION, graph.target_from_source)
    equations = NormalEquations(translation, held, TRANSLATION)
    state = descended(translation, state, equations, held, loop_weights_of(selection.kept)).world_from_node
    return _annealed(graph, replace(selection, world_from_node=state), NormalEquations(graph, held), held, inlier_test)


def _plausible(
    graph: PoseGraph, selection: LoopSelection, equations: NormalEquations, held: BoolArray, inlier_test: LoopInlierTest
) -> LoopSelection:
    """The loops that the odometry edges alone allow; all of them where these allow none.

    No loop has weight here, so false loops cannot support each other. If none passes, the information
    of the odometry edges is too large, and the test is left to the next step.
    """
    no_loop = np.zeros(graph.num_loops, dtype=bool)
    state = descended(graph, selection.world_from_node, equations, held, loop_weights_of(no_loop)).world_from_node
    tested = inlier_test.apply(graph, state, equations, no_loop)
    return replace(selection, kept=tested.kept) if tested.kept.any() else selection


def _annealed(
    graph: PoseGraph,
    selection: LoopSelection,
    equations: NormalEquations,
    held: BoolArray,
    inlier_test: LoopInlierTest | None,
) -> LoopSelection:
    weights = loop_weights_of(selection.kept)
    state = descended(graph, selection.world_from_node, equations, held, weights).world_from_node
    if inlier_test is None:
        return replace(selection, world_from_node=state)
    return inlier_test.anneal(graph, state, equations, held, weights)


def _settled(
    graph: PoseGraph, selection: LoopSelection, held: BoolArray, inlier_test: LoopInlierTest | None
) -> LoopSelection:
    """Everything at once on a small graph, until no better selection of loops is found.

    Better is a lower cost of the accepted loops plus the threshold per rejected one.
    """
    equations = NormalEquations(graph, held)
    kept, state, settled, lowest = selection.kept, selection.world_from_node, selection, np.inf
    for _ in range(RECONSIDERATIONS):
        descent = descended(graph, state, equations, held, loop_weights_of(kept))
        state = descent.world_from_node
        if inlier_test is None:
            return replace(selection, world_from_node=state)
        tested = inlier_test.apply(graph, state, equations, kept)
        price = descent.cost + np.where(kept, 0.0, np.minimum(tested.threshold, tested.distance)).sum()
        if price >= lowest:
            break
        lowest, settled = price, replace(tested, kept=kept)
        if (tested.kept == kept).all():
            break
        kept = tested.kept
    return settled


def _kernel_thresholds(graph: PoseGraph, selection: LoopSelection, confidence: float) -> FloatArray:
    """(L,) squared distance of a loop's own edges at which its weight is half.

    It is the quantile of the chi-squared distribution for all directions in which the loop's edges
    can disagree, those between its two kinds of edges included, times the scale of the information.
    """
    dof = graph.target_from_source.DOF
    edges = loop_sums(np.ones(len(graph)), graph.loop, graph.num_loops)
    freedom = dof * (edges - _own_nodes(graph))
    limit: FloatArray = selection.scale * chdtri(np.maximum(freedom, dof), 1 - confidence)
    return limit


def _own_nodes(graph: PoseGraph) -> IntArray:
    """(L,) number of nodes that only the edges of one loop reach."""
    ends = np.concatenate([graph.target, graph.source])
    loop = np.concatenate([graph.loop, graph.loop])
    lowest = np.full(graph.num_nodes, np.iinfo(np.int64).max)
    highest = np.full(graph.num_nodes, ODOMETRY)
    np.minimum.at(lowest, ends, loop)
    np.maximum.at(highest, ends, loop)
    own = (lowest == highest) & (highest != ODOMETRY)
    return np.bincount(highest[own], minlength=graph.num_loops)
