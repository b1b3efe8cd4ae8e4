"""Levenberg-Marquardt on a pose graph whose loops carry a kernel.

The next module to read is ``normalise``.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.sparse import csc_array

from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.transform import Transform
from smust3r_colmap.stitching.pose_graph.graph import PoseGraph, edge_weights, loop_sums
from smust3r_colmap.stitching.pose_graph.linearise import (
    EdgeErrors,
    NormalEquations,
    edge_errors,
    linearise,
    squared_distances,
)

logger = logging.getLogger(__name__)

FIRST_DAMPING = 1e-12
"""Of the Hessian's diagonal: Gauss-Newton. More would hold back the slow bending of a long sequence, whose
curvature is 1e-8 of the diagonal and less."""
RETRY_DAMPING = 1e-8
"""Least damping after a rejected step; it doubles, then quadruples, and so on, until a step helps."""
LAST_DAMPING = 1e8
"""With this much damping a step is a minute move downhill; if it does not help, rounding is all there is."""
SMALL_STEP = 1e-10
"""Largest entry of a tangent step that counts as none, in coordinates of radius one."""


@dataclass(frozen=True, kw_only=True)
class Descent:
    """Where a minimisation ended. ``cost`` is in units of the squared Mahalanobis distance."""

    world_from_node: Transform
    cost: float
    iterations: int
    stop_reason: str


@dataclass(frozen=True, kw_only=True)
class Loss:
    """Kernel on the squared Mahalanobis distance of each loop: its cost (L,) and its weight (L,), the slope."""

    cost: Callable[[FloatArray], FloatArray]
    weight: Callable[[FloatArray], FloatArray]


def quadratic(weights: FloatArray) -> Loss:
    """Fixed weights (L,) on the loops; ones mean no kernel."""
    return Loss(cost=lambda squared: weights * squared, weight=lambda squared: weights)


def cauchy(weights: FloatArray, threshold: FloatArray) -> Loss:
    """``c^2 log(1 + s / c^2)`` with c^2 = threshold (L,), times fixed weights (L,)."""
    return Loss(
        cost=lambda squared: weights * threshold * np.log1p(squared / threshold),
        weight=lambda squared: weights / (1.0 + squared / threshold),
    )


def truncated(loss: Loss, threshold: FloatArray) -> Loss:
    """A loss that is never more than the threshold (L,), the price of rejecting a loop."""
    return Loss(cost=lambda squared: np.minimum(loss.cost(squared), threshold), weight=loss.weight)


def total_cost(graph: PoseGraph, loss: Loss, squared: FloatArray) -> float:
    """Squared distances (M,) of the odometry edges plus the loss of the loops."""
    odometry = squared[graph.loop < 0].sum()
    return float(odometry + loss.cost(loop_sums(squared, graph.loop, graph.num_loops)).sum())


def levenberg_marquardt(
    graph: PoseGraph,
    start: Transform,
    held: npt.NDArray[np.bool_],
    loss: Loss,
    *,
    max_iterations: int,
    relative_decrease: float,
    equations: NormalEquations | None = None,
) -> Descent:
    """Minimises the cost from ``start``; it never ends higher than it began.

    Damping by Marquardt's diagonal scaling, steered by the gain ratio (Nielsen 1999; Madsen, Nielsen,
    Tingleff 2004, algorithm 3.16). The kernel enters by its weights, taken anew after every step.

    Args:
        held: (num_nodes,) nodes that do not move.
        max_iterations: of accepted and rejected steps together.
        relative_decrease: of the cost, below which it has converged.
        equations: the pattern of the graph, if it was prepared before.
    """
    equations = equations or NormalEquations(graph, held)
    at = _evaluated(graph, start, loss)
    system = _system(graph, at, loss, equations)
    damping, growth = FIRST_DAMPING, 2.0
    for iteration in range(1, max_iterations + 1):
        step = _step(equations, system, damping)
        if np.abs(step).max(initial=0.0) < SMALL_STEP:
            return Descent(
                world_from_node=at.state, cost=at.cost, iterations=iteration, stop_reason="converged by step"
            )
        # Decrease of the quadratic model, twice as much as of half the cost.
        predicted = float(step @ (damping * system.diagonal * step - system.gradient))
        moved = _moved(graph, at, step, loss, equations)
        decrease = at.cost - moved.cost if moved else -np.inf
        logger.debug("iteration %d: cost %.6g, decrease %.3g, damping %.1g", iteration, at.cost, decrease, damping)
        small = relative_decrease * at.cost
        if moved and decrease >= 0 and predicted > 0:
            at = moved
            if decrease > small:
                system = _system(graph, at, loss, equations)
                slower = max(1 / 3, 1 - (2 * decrease / predicted - 1) ** 3)
                damping, growth = max(damping * slower, FIRST_DAMPING), 2.0
                continue
        if decrease >= 0 or predicted <= small:
            return Descent(
                world_from_node=at.state, cost=at.cost, iterations=iteration, stop_reason="converged by cost"
            )
        damping, growth = max(damping * growth, RETRY_DAMPING), growth * 2.0
        if damping > LAST_DAMPING:
            return Descent(world_from_node=at.state, cost=at.cost, iterations=iteration, stop_reason="stuck")
    return Descent(world_from_node=at.state, cost=at.cost, iterations=max_iterations, stop_reason="iteration limit")


@dataclass(frozen=True, eq=False)
class _Point:
    """A state with all that is known of the cost there; squared distances (M,) of the edges."""

    state: Transform
    errors: EdgeErrors
    squared: FloatArray
    cost: float


@dataclass(frozen=True, eq=False)
class _System:
    """Gauss-Newton's equations at a point."""

    hessian: csc_array
    gradient: FloatArray
    diagonal: FloatArray


def _evaluated(graph: PoseGraph, state: Transform, loss: Loss) -> _Point:
    errors = edge_errors(graph, state)
    squared = squared_distances(errors.residual, graph.information)
    return _Point(state, errors, squared, total_cost(graph, loss, squared))


def _system(graph: PoseGraph, at: _Point, loss: Loss, equations: NormalEquations) -> _System:
    weights = loss.weight(loop_sums(at.squared, graph.loop, graph.num_loops))
    hessian, gradient = equations.assemble(linearise(at.errors), edge_weights(weights, graph.loop))
    return _System(hessian, gradient, equations.diagonal_of(hessian))


def _step(equations: NormalEquations, system: _System, damping: float) -> FloatArray:
    """The damped step; not a number where the matrix is singular, which more damping cures."""
    try:
        factors = equations.factorise(system.hessian, damping * system.diagonal)
    except RuntimeError:
        return np.full_like(system.gradient, np.nan)
    return -np.asarray(factors.solve(system.gradient))


def _moved(graph: PoseGraph, at: _Point, step: FloatArray, loss: Loss, equations: NormalEquations) -> _Point | None:
    """The point after a step, or None where it leaves the group or has no finite cost."""
    if not np.isfinite(step).all():
        return None
    try:
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            moved = _evaluated(graph, equations.move(at.state, step), loss)
    except ValueError:
        return None
    return moved if np.isfinite(moved.cost) else None
