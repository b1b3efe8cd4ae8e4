"""Which loop closures are inliers.

The test statistic of a loop is its cost: how far the minimum of the whole graph falls when the loop
is left out. The residual of the loop itself is a weak statistic, because a long flexible stretch of
the sequence takes up nearly all of a contradiction (with n edges around a loop, all but 1/n). At the
minimum of the graph this cost is the squared Mahalanobis distance between the loop and the
prediction from all other edges. For a true loop it follows a chi-squared distribution, whatever the
length of the loop.

The best selection of loops minimises ``cost of the accepted ones + threshold per rejected one``
(truncated least squares). ``LoopInlierTest.anneal`` finds it from a state far off, and
``LoopInlierTest.apply`` tests all loops at one state. The next module to read is ``start``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from smust3r_colmap.geometry.arrays import BoolArray, FloatArray, IntArray
from smust3r_colmap.geometry.transform import Transform
from smust3r_colmap.stitching.pose_graph.graph import ODOMETRY, PoseGraph, edge_weights
from smust3r_colmap.stitching.pose_graph.levenberg import Descent, levenberg_marquardt, quadratic
from smust3r_colmap.stitching.pose_graph.linearise import NormalEquations, edge_errors, linearise, square_roots

SCALE_PRIOR_LOOPS = 5
"""Loops of the worst case added to the median that finds the scale of the information: with fewer
loops than this the median is the prior."""
ANNEALING_FACTOR = 4.0
"""Between two rounds of graduated non-convexity; the paper has 1.4, and 4 was seen to reject the same loops."""
REJECTED_WEIGHT = 1e-9
"""Of a rejected loop: a squared distance of a million then counts like one of a thousandth."""
MIN_REDUNDANCY = 1e-6
"""Redundancy ``1 - w g`` (geodesy's term) up to which a direction of a loop is predicted by no other edge."""
SOLVED_AT_ONCE = 2048
"""Right-hand sides per sparse solve: bounds memory, 128 MiB for 8,000 unknowns."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LoopEvidence:
    """The test statistics of each loop.

    Args:
        distance: (L,) squared Mahalanobis distance to the prediction from all other edges: what the loop
            adds, or would add, to the minimum of the cost at full weight.
        freedom: (L,) directions that the rest of the graph predicts; 0 for the only edge between two parts.
    """

    distance: FloatArray
    freedom: IntArray


def leave_one_out(graph: PoseGraph, state: Transform, weights: FloatArray, equations: NormalEquations) -> LoopEvidence:
    """The test statistics of each loop, at a state that is the minimum under the given loop weights (L,).

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
    tested = left > MIN_REDUNDANCY
    along = (np.swapaxes(directions, 1, 2) @ residual[..., None])[..., 0]
    variance = left * (left + np.maximum(gains, 0.0))
    terms = np.where(tested, along**2 / np.where(tested, variance, 1.0), 0.0)
    return terms.sum(axis=1), rank - (~tested).sum(axis=1)


def _batches_of_loops(graph: PoseGraph) -> list[tuple[IntArray, IntArray]]:
    """Loops of equally many edges, not too many at once, with their edges loop by loop."""
    edges = np.flatnonzero(graph.loop != ODOMETRY)
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

    Covariances from residuals are off by some factor, which many loops reveal. With few loops the
    largest tolerated factor is assumed.

    Args:
        tolerance: standard deviations may be too small, or too large, by this factor; a larger factor
            is taken when most loops agree on it.
    """
    tested = evidence.freedom > 0
    ratio = evidence.distance[tested] / chdtri(evidence.freedom[tested], 0.5)
    ratios = np.concatenate([ratio, np.full(SCALE_PRIOR_LOOPS, tolerance**2)])
    return max(float(np.median(ratios)), tolerance**-2)


def quantiles(evidence: LoopEvidence, confidence: float) -> FloatArray:
    """(L,) squared distance below which a true loop stays with this probability; infinite where untested."""
    quantile: FloatArray = chdtri(np.maximum(evidence.freedom, 1), 1 - confidence)
    return np.where(evidence.freedom > 0, quantile, np.inf)


@dataclass(frozen=True, kw_only=True, eq=False)
class LoopSelection:
    """A state, the loops that pass the inlier test there, and the evidence.

    Args:
        kept: (L,) accepted loops.
        scale: of squared distances, see ``information_scale``.
        threshold: (L,) squared distance beyond which a loop is rejected.
        distance: (L,) test statistic; NaN where no other edge predicts the loop.
    """

    world_from_node: Transform
    kept: BoolArray
    scale: float
    threshold: FloatArray
    distance: FloatArray


def loop_weights_of(kept: BoolArray) -> FloatArray:
    """(L,) one for accepted loops; almost zero for the others, which still hold their own nodes."""
    return np.where(kept, 1.0, REJECTED_WEIGHT)


def descended(
    graph: PoseGraph, state: Transform, equations: NormalEquations, held: BoolArray, weights: FloatArray
) -> Descent:
    """Approximate minimum under fixed loop weights (L,), accurate enough to test loops."""
    return levenberg_marquardt(
        graph, state, held, quadratic(weights), max_iterations=30, relative_decrease=1e-4, equations=equations
    )


@dataclass(frozen=True, kw_only=True)
class LoopInlierTest:
    """Accepts or rejects loops by their leave-one-out cost.

    Args:
        confidence: probability that a true loop stays below its threshold.
        tolerance: see ``information_scale``.
    """

    confidence: float
    tolerance: float

    def anneal(
        self, graph: PoseGraph, state: Transform, equations: NormalEquations, held: BoolArray, weights: FloatArray
    ) -> LoopSelection:
        """Graduated non-convexity on the cost of each loop, from the minimum with ``weights`` (L,).

        Rejected loops stay rejected. The kernel is wide at first, so that half of the loops keep their
        weight, and narrows to the threshold; the loops that most others contradict lose their weight
        first.

        Source: Yang, Antonante, Tzoumas, Carlone 2020, "Graduated Non-Convexity for Robust Spatial
        Perception", Geman-McClure, eqs. 12 and 13, with the distance of ``leave_one_out`` as the residual.
        """
        candidates = weights > 0.5
        width = worst = np.inf
        while width > 1.0 and worst > 1.0:
            evidence = leave_one_out(graph, state, weights, equations)
            relative = evidence.distance / quantiles(evidence, self.confidence)
            worst = float(relative[candidates].max(initial=0.0))
            if width == np.inf and worst <= 1.0:
                return self._selection(evidence, state, candidates)
            width = max(min(width / ANNEALING_FACTOR, 2.0 * worst), 1.0)
            weights = np.where(candidates, (width / (relative + width)) ** 2, weights)
            state = levenberg_marquardt(
                graph, state, held, quadratic(weights), max_iterations=3, relative_decrease=1e-3, equations=equations
            ).world_from_node
        # False loops may still distort the state: test all loops at the minimum of the better half.
        half = candidates & (relative <= np.median(relative[candidates]))
        state = descended(graph, state, equations, held, loop_weights_of(half)).world_from_node
        selection = self.apply(graph, state, equations, half)
        kept = selection.kept & candidates
        state = descended(graph, state, equations, held, loop_weights_of(kept)).world_from_node
        return replace(selection, world_from_node=state, kept=kept)

    def apply(self, graph: PoseGraph, state: Transform, equations: NormalEquations, kept: BoolArray) -> LoopSelection:
        """Tests all loops at ``state``, the minimum of the graph with the kept loops (L,)."""
        evidence = leave_one_out(graph, state, loop_weights_of(kept), equations)
        return self._selection(evidence, state, np.ones(graph.num_loops, dtype=bool))

    def _selection(self, evidence: LoopEvidence, state: Transform, candidates: BoolArray) -> LoopSelection:
        scale = information_scale(evidence, self.tolerance)
        threshold = scale * quantiles(evidence, self.confidence)
        return LoopSelection(
            world_from_node=state,
            kept=candidates & (evidence.distance <= threshold),
            scale=scale,
            threshold=threshold,
            distance=np.where(evidence.freedom > 0, evidence.distance, np.nan),
        )
