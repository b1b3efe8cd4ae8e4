"""Which loops to believe.

The evidence against a loop is what it costs: how far the minimum of the whole graph falls when the
loop is left out. Its own residual says much less, because a long flexible stretch of the sequence
takes up nearly all of a contradiction (with n edges around a loop, all but 1/n). For a graph at its
minimum this cost is the squared Mahalanobis distance between the loop and the prediction of all the
others; it follows a chi-squared distribution for a true loop, however long the way round.

A choice of loops is good when it minimises ``cost of the kept ones + threshold per rejected one``
(truncated least squares). ``Judge.anneal`` finds its way there from a state far off, ``Judge.judged``
says what a state speaks for. The next module to read is ``start``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from smust3r_colmap.geometry.arrays import BoolArray, FloatArray, IntArray
from smust3r_colmap.geometry.transform import Transform
from smust3r_colmap.stitching.pose_graph.graph import TRUSTED, PoseGraph, edge_weights
from smust3r_colmap.stitching.pose_graph.levenberg import Descent, levenberg_marquardt, quadratic
from smust3r_colmap.stitching.pose_graph.linearise import NormalEquations, edge_errors, linearise, square_roots

SCALE_VOTES = 5
"""Votes for the worst case in the median that finds the scale of the information: below this many
loops there is nothing to measure it by."""
ANNEALING_FACTOR = 4.0
"""Between two rounds of graduated non-convexity; the paper has 1.4, and 4 was seen to reject the same loops."""
REJECTED_WEIGHT = 1e-9
"""Of a loop that is left out: a squared distance of a million then pulls like one of a thousandth."""
BRIDGE = 1e-6
"""A direction of a loop that nothing else predicts has this little of its weight left for other evidence."""
SOLVED_AT_ONCE = 2048
"""Right-hand sides per sparse solve: bounds memory, 128 MiB for 8,000 unknowns."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LoopEvidence:
    """What the rest of the graph says about each loop.

    Args:
        distance: (L,) squared Mahalanobis distance to the prediction of all the others: what the loop adds,
            or would add, to the minimum of the cost at full weight.
        freedom: (L,) directions that the rest of the graph predicts; 0 for the only link between two parts.
    """

    distance: FloatArray
    freedom: IntArray


def leave_one_out(graph: PoseGraph, state: Transform, weights: FloatArray, equations: NormalEquations) -> LoopEvidence:
    """Evidence for and against each loop, at a state that is the minimum under the given loop weights (L,).

    With whitened residual r and leverage G = J H^-1 J^T of a loop of weight w, per eigendirection of G
    with eigenvalue g: the others predict with variance g / (1 - w g), and miss the loop by r / (1 - w g), so

        distance = sum of r^2 / ((1 - w g) (1 - w g + g))
    """
    at = linearise(edge_errors(graph, state))
    hessian, _ = equations.assemble(at, edge_weights(weights, graph.loop))
    factors = equations.factorise(hessian, 1e-12 * equations.diagonal_of(hessian))
    distance, freedom = np.zeros(graph.num_loops), np.zeros(graph.num_loops, dtype=np.int64)
    for loops, edges in _batches_of_loops(graph):
        roots = square_roots(graph.information[edges])
        roots = roots[:, np.abs(roots).max(axis=(0, 2)) > 0]  # directions that none of them measures
        residual = (roots @ at.residual[edges][..., None]).reshape(len(loops), -1)
        rows = equations.rows(at, edges, roots)
        whole = (rows @ factors.solve(rows.T.toarray())).reshape(2 * residual.shape)
        leverage = whole[np.arange(len(loops)), :, np.arange(len(loops))]
        rank = np.linalg.matrix_rank(roots).reshape(len(loops), -1).sum(axis=1)
        distance[loops], freedom[loops] = _distances(leverage, residual, weights[loops], rank)
    return LoopEvidence(distance=distance, freedom=freedom)


def _distances(
    leverage: FloatArray, residual: FloatArray, weight: FloatArray, rank: IntArray
) -> tuple[FloatArray, IntArray]:
    """Distance and freedom (K,) of loops with leverage (K, n, n) and whitened residual (K, n)."""
    gains, directions = np.linalg.eigh((leverage + np.swapaxes(leverage, 1, 2)) / 2)
    left = 1.0 - weight[:, None] * gains
    tested = left > BRIDGE
    along = (np.swapaxes(directions, 1, 2) @ residual[..., None])[..., 0]
    variance = left * (left + np.maximum(gains, 0.0))
    terms = np.where(tested, along**2 / np.where(tested, variance, 1.0), 0.0)
    return terms.sum(axis=1), rank - (~tested).sum(axis=1)


def _batches_of_loops(graph: PoseGraph) -> list[tuple[IntArray, IntArray]]:
    """Loops of equally many edges, not too many at once, with their edges loop by loop."""
    edges = np.flatnonzero(graph.loop != TRUSTED)
    edges = edges[np.argsort(graph.loop[edges], kind="stable")]
    counts = np.bincount(graph.loop[edges], minlength=graph.num_loops)
    batches = []
    for count in np.unique(counts):
        loops = np.flatnonzero(counts == count)
        own = edges[counts[graph.loop[edges]] == count].reshape(len(loops), count)
        size = max(SOLVED_AT_ONCE // (int(count) * graph.information.shape[1]), 1)
        batches += [(loops[k : k + size], own[k : k + size].ravel()) for k in range(0, len(loops), size)]
    return batches


def information_scale(evidence: LoopEvidence, tolerance: float) -> float:
    """By what factor squared distances are too large: the median over all loops, most of which are true.

    Covariances from residuals are off by some factor, and the loops show it. A few loops do not, and
    for them the worst that is tolerated is assumed.

    Args:
        tolerance: standard deviations may be too small, or too large, by this factor; larger ones are
            believed when most loops agree on them.
    """
    tested = evidence.freedom > 0
    ratio = evidence.distance[tested] / chdtri(evidence.freedom[tested], 0.5)
    votes = np.concatenate([ratio, np.full(SCALE_VOTES, tolerance**2)])
    return max(float(np.median(votes)), tolerance**-2)


def quantiles(evidence: LoopEvidence, confidence: float) -> FloatArray:
    """(L,) squared distance below which a true loop stays with this probability; infinite where untested."""
    quantile: FloatArray = chdtri(np.maximum(evidence.freedom, 1), 1 - confidence)
    return np.where(evidence.freedom > 0, quantile, np.inf)


@dataclass(frozen=True, kw_only=True, eq=False)
class Belief:
    """A state, the loops (L,) to keep by what was seen there, and the evidence.

    Args:
        scale: of squared distances, see ``information_scale``.
        threshold: (L,) squared distance beyond which a loop is rejected.
        distance: (L,) that the loops were judged by; NaN where nothing else predicts the loop.
    """

    world_from_node: Transform
    kept: BoolArray
    scale: float
    threshold: FloatArray
    distance: FloatArray


def loop_weights_of(kept: BoolArray) -> FloatArray:
    """(L,) one for kept loops; next to nothing for the others, so that their own nodes do not float freely."""
    return np.where(kept, 1.0, REJECTED_WEIGHT)


def descended(
    graph: PoseGraph, state: Transform, equations: NormalEquations, held: BoolArray, weights: FloatArray
) -> Descent:
    """Roughly the minimum under fixed loop weights (L,), good enough to judge loops by."""
    return levenberg_marquardt(
        graph, state, held, quadratic(weights), max_iterations=30, relative_decrease=1e-4, equations=equations
    )


@dataclass(frozen=True, kw_only=True)
class Judge:
    """Keeps or rejects loops.

    Args:
        confidence: probability that a true loop stays below its threshold.
        tolerance: see ``information_scale``.
    """

    confidence: float
    tolerance: float

    def anneal(
        self, graph: PoseGraph, state: Transform, equations: NormalEquations, held: BoolArray, weights: FloatArray
    ) -> Belief:
        """Graduated non-convexity on the cost of each loop, from the minimum with ``weights`` (L,).

        Loops of next to no weight stay without. It begins with a kernel so wide that every other loop
        counts and narrows it to the threshold; in between, the loops that most others contradict lose
        their weight first.

        Source: Yang, Antonante, Tzoumas, Carlone 2020, "Graduated Non-Convexity for Robust Spatial
        Perception", Geman-McClure, eqs. 12 and 13, with the distance of ``leave_one_out`` as the residual.
        """
        believed = weights > 0.5
        width = worst = np.inf
        while width > 1.0 and worst > 1.0:
            evidence = leave_one_out(graph, state, weights, equations)
            relative = evidence.distance / quantiles(evidence, self.confidence)
            worst = float(relative[believed].max(initial=0.0))
            if width == np.inf and worst <= 1.0:
                return self._belief(evidence, state, believed)
            width = max(min(width / ANNEALING_FACTOR, 2.0 * worst), 1.0)
            weights = np.where(believed, (width / (relative + width)) ** 2, weights)
            state = levenberg_marquardt(
                graph, state, held, quadratic(weights), max_iterations=3, relative_decrease=1e-3, equations=equations
            ).world_from_node
        # What is wrong may still bend the rest: the half of the loops that fits best judges all of them.
        half = believed & (relative <= np.median(relative[believed]))
        state = descended(graph, state, equations, held, loop_weights_of(half)).world_from_node
        belief = self.judged(graph, state, equations, half)
        kept = belief.kept & believed
        state = descended(graph, state, equations, held, loop_weights_of(kept)).world_from_node
        return replace(belief, world_from_node=state, kept=kept)

    def judged(self, graph: PoseGraph, state: Transform, equations: NormalEquations, kept: BoolArray) -> Belief:
        """All loops judged at the minimum that the kept ones (L,) make."""
        evidence = leave_one_out(graph, state, loop_weights_of(kept), equations)
        return self._belief(evidence, state, np.ones(graph.num_loops, dtype=bool))

    def _belief(self, evidence: LoopEvidence, state: Transform, candidates: BoolArray) -> Belief:
        scale = information_scale(evidence, self.tolerance)
        threshold = scale * quantiles(evidence, self.confidence)
        return Belief(
            world_from_node=state,
            kept=candidates & (evidence.distance <= threshold),
            scale=scale,
            threshold=threshold,
            distance=np.where(evidence.freedom > 0, evidence.distance, np.nan),
        )
