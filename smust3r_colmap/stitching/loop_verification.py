"""Geometric verification of loop closures.

Two places that look alike need not be one. A planned loop is accepted when its segment gave one submodel
that holds both ends, when that submodel has a sound edge to a window of either end, and when the
transform through the loop agrees with the chain of windows within their covariances. A long chain has
a large covariance and rejects little; then the robust kernel of the pose graph decides.
The next module to read is ``stitch``.
"""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import pairwise
from operator import matmul

import numpy as np

from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.transform import Transform
from smust3r_colmap.products import SegmentAlignment, Submodel
from smust3r_colmap.segmentation.loop_segments import PlannedLoop
from smust3r_colmap.segmentation.view_graph import ViewGraph
from smust3r_colmap.stitching.spanning_tree import ChainedPart

MIN_END_IMAGES = 3
"""Images of each end that the loop submodel must hold and share with a window."""
MAX_CLOSURE_SIGMAS = 5.0
"""Between the transform through the loop and that of the chain, per degree of freedom. The covariances are good to a
factor of two or three, so this rejects gross errors and leaves the rest to the pose graph."""
MIN_UNIT_INFORMATION = 1e-12
"""Information added to every direction of a matrix with unit diagonal."""


@dataclass(frozen=True, kw_only=True)
class LoopDecision:
    """The decision on a planned loop.

    Args:
        submodel: position of the submodel that holds both ends, or None.
        edges: positions of the alignments with a window of the first and of the second end; empty where
            one is missing.
        accepted: it takes part in the graph.
        reason: of the rejection, or empty.
        closure_sigmas: distance between the transform through the loop and that of the chain, in standard deviations
            per degree of freedom; NaN where there is no chain between the ends.
    """

    submodel: int | None
    accepted: bool
    edges: tuple[int, ...] = ()
    reason: str = ""
    closure_sigmas: float = np.nan


@dataclass(frozen=True, kw_only=True, eq=False)
class UncertainTransform:
    """A transform and the covariance (d, d) of its right perturbation."""

    b_from_a: Transform
    covariance: FloatArray

    def __matmul__(self, after: UncertainTransform) -> UncertainTransform:
        """``c_from_a = c_from_b @ b_from_a``; perturbations move to the right by the adjoint."""
        carry = after.b_from_a.inverse().adjoint()
        return UncertainTransform(
            b_from_a=self.b_from_a @ after.b_from_a,
            covariance=carry @ self.covariance @ carry.T + after.covariance,
        )

    def inverse(self) -> UncertainTransform:
        """(T exp(d))^-1 = T^-1 exp(-Ad(T) d)."""
        carry = self.b_from_a.adjoint()
        return UncertainTransform(b_from_a=self.b_from_a.inverse(), covariance=carry @ self.covariance @ carry.T)

    def sigmas_from(self, other: UncertainTransform) -> float:
        """Root of the squared Mahalanobis distance per degree of freedom.

        Infinite where the difference is a stretched half turn, which has no logarithm: no two
        measurements of one place differ by that.
        """
        between = self.b_from_a.inverse() @ other.b_from_a
        if not between.log_exists():
            return float("inf")
        difference = between.log()
        squared = difference @ np.linalg.solve(self.covariance + other.covariance, difference)
        return float(np.sqrt(squared / len(difference)))


def verify_loops(
    loops: Sequence[PlannedLoop],
    submodels: Sequence[Submodel],
    alignments: Sequence[SegmentAlignment],
    chained: Sequence[ChainedPart],
    view_graph: ViewGraph,
) -> tuple[LoopDecision, ...]:
    """One decision per loop, each on its own.

    Args:
        loops: as planned.
        submodels: of windows and loop segments.
        alignments: between them; only accepted ones count.
        chained: the windows without any loop.
        view_graph: the order of the images, which cuts a loop segment into its ends.
    """
    chain = _Chain(alignments, chained)
    return tuple(_verify(loop, view_graph.runs(loop.segment.images), submodels, alignments, chain) for loop in loops)


def _verify(
    loop: PlannedLoop,
    runs: Sequence[Sequence[int]],
    submodels: Sequence[Submodel],
    alignments: Sequence[SegmentAlignment],
    chain: _Chain,
) -> LoopDecision:
    ends = [set(run) for run in runs]
    own = [k for k, submodel in enumerate(submodels) if submodel.segment == loop.segment.index]
    held = {k: [len(end & set(submodels[k].images)) for end in ends] for k in own}
    if not own or max(min(counts) for counts in held.values()) < MIN_END_IMAGES:
        return LoopDecision(submodel=None, accepted=False, reason=_why_no_submodel(list(held.values())))
    best = max(own, key=lambda k: (min(held[k]), sum(held[k])))
    sides = [_best_edge(best, end, submodels, alignments) for end in ends]
    edges = tuple(side for side in sides if side is not None)
    if len(edges) < len(ends):
        return LoopDecision(submodel=best, accepted=False, reason=_why_no_edge(best, sides, alignments))
    first, second = (alignments[edge] for edge in edges)
    sigmas, reason = np.nan, ""
    if first.target == second.target:
        reason = f"window {submodels[first.target].name} holds both ends"
    elif chain.connects(first.target, second.target):
        through_loop = _of_edge(first) @ _of_edge(second).inverse()
        sigmas = chain.transform(first.target, second.target).sigmas_from(through_loop)
        if sigmas > MAX_CLOSURE_SIGMAS:
            reason = f"inconsistent with the chain of windows ({sigmas:.1f} sigma, at most {MAX_CLOSURE_SIGMAS:.0f})"
    return LoopDecision(submodel=best, accepted=not reason, edges=edges, reason=reason, closure_sigmas=sigmas)


def _why_no_submodel(held: Sequence[Sequence[int]]) -> str:
    """The rejection reason, from the images of each end that the submodels hold."""
    if not held:
        return "the loop segment has no submodel"
    counts = ", ".join(" + ".join(map(str, one)) for one in held)
    return f"no submodel of the loop segment holds {MIN_END_IMAGES} images of both ends (submodels of {counts})"


def _why_no_edge(loop_submodel: int, sides: Sequence[int | None], alignments: Sequence[SegmentAlignment]) -> str:
    missing = [end for end, side in zip(("first", "second"), sides, strict=True) if side is None]
    tried = [edge.reason for edge in alignments if edge.source == loop_submodel and edge.reason]
    reason = f"no sound edge between the loop segment and a window of the {' and the '.join(missing)} end"
    return "; ".join([reason, *tried[:2]])


def _best_edge(
    loop_submodel: int, end: set[int], submodels: Sequence[Submodel], alignments: Sequence[SegmentAlignment]
) -> int | None:
    """Position of the accepted edge of most inliers from the loop submodel to a window sharing enough of this end."""

    def shares_enough(window: int) -> bool:
        return len(end & set(submodels[loop_submodel].images) & set(submodels[window].images)) >= MIN_END_IMAGES

    edges = [
        position
        for position, edge in enumerate(alignments)
        if edge.accepted and edge.source == loop_submodel and shares_enough(edge.target)
    ]
    return max(edges, key=lambda position: alignments[position].estimate.num_inliers, default=None)


def _of_edge(edge: SegmentAlignment) -> UncertainTransform:
    return UncertainTransform(b_from_a=edge.estimate.b_from_a, covariance=covariance_of(edge.information))


def covariance_of(information: FloatArray) -> FloatArray:
    """(d, d) inverse of an information matrix; unmeasured directions get a very large variance.

    A pseudo-inverse would give them zero variance. The diagonal is scaled to one first, because a tangent
    vector mixes lengths, angles and their inverses.
    """
    size = np.sqrt(np.diag(information))
    units = np.outer(*2 * [np.where(size > 0, size, 1.0)])
    covariance: FloatArray = np.linalg.inv(information / units + MIN_UNIT_INFORMATION * np.eye(len(size))) / units
    return covariance


class _Chain:
    """The spanning trees of the windows, with the covariance that accumulates along them."""

    def __init__(self, alignments: Sequence[SegmentAlignment], parts: Sequence[ChainedPart]) -> None:
        self._part = {submodel: number for number, part in enumerate(parts) for submodel in part.submodels}
        self._steps: Mapping[int, dict[int, UncertainTransform]] = defaultdict(dict)
        for part in parts:
            for position in part.edges:
                edge = _of_edge(alignments[position])
                target, source = alignments[position].target, alignments[position].source
                self._steps[target][source] = edge
                self._steps[source][target] = edge.inverse()

    def connects(self, a: int, b: int) -> bool:
        """Whether a and b are in one component."""
        return self._part[a] == self._part[b]

    def transform(self, a: int, b: int) -> UncertainTransform:
        """``a_from_b`` along the tree; a and b differ and are connected."""
        before = {a: a}
        queue = deque([a])
        while b not in before:
            node = queue.popleft()
            for following in self._steps[node]:
                if following not in before:
                    before[following] = node
                    queue.append(following)
        way = [b]
        while way[-1] != a:
            way.append(before[way[-1]])
        way.reverse()
        steps = [self._steps[node][following] for node, following in pairwise(way)]
        return reduce(matmul, steps)
