"""Transforms between submodels that have something in common (paper III-C and III-E, eqs. 1 to 3).

The next module to read is ``pairwise``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from smust3r_colmap.alignment.pairwise import align_submodels, candidate_pairs, needs_maps
from smust3r_colmap.backbones.base import BackboneResult
from smust3r_colmap.config import AlignmentConfig
from smust3r_colmap.execution.progress import Stage
from smust3r_colmap.execution.run_context import Run
from smust3r_colmap.products import Edges, Submodel
from smust3r_colmap.segmentation.stage import Segments
from smust3r_colmap.storage.codec import Codec

_EDGES: Codec[Edges] = Codec(Edges, "edges")


@dataclass(frozen=True, kw_only=True)
class EdgeSummary:
    """An alignment between two submodels.

    Args:
        target, source: names of the submodels.
        evidence: what it rests on: tracks, pointmaps, poses or matches.
        relative_residual: median residual divided by depth; NaN when no transform was found.
        accepted: it took part in the stitching.
        reason: why it was refused, or empty.
        fallback: why a smaller group than asked for was taken, or empty.
    """

    target: str
    source: str
    evidence: str
    relative_residual: float
    accepted: bool
    reason: str = ""
    fallback: str = ""


def align(run: Run, result: BackboneResult, segments: Segments, options: AlignmentConfig) -> Edges:
    """Edges between all pairs of submodels that could have something in common."""
    loops, next_windows = segments.loop_indices, segments.next_windows
    geometry = [(one.name, one.images, one.seg_from_cam, one.tracks) for one in result.submodels]
    maps = result.dense_key if needs_maps(result.submodels, options) else None

    def compute(progress: Stage) -> Edges:
        return align_submodels(
            result.submodels,
            result.dense,
            result.matches,
            options,
            next_windows=next_windows,
            loop_segments=loops,
            seed=run.seed,
            advance=progress.advance,
        )

    inputs = (geometry, maps, result.matches, sorted(next_windows), sorted(loops), options, run.seed)
    num_pairs = len(candidate_pairs(result.submodels, next_windows, loops))
    edges = run.cached("alignment", inputs, compute, _EDGES, total=num_pairs)
    fallbacks = [edge.fallback for edge in edges.alignments if edge.fallback]
    if fallbacks:
        run.clock.warn(
            f"{len(fallbacks)} of {len(edges.alignments)} edges are similarities instead of "
            f"{options.transform_group}, such as: {fallbacks[0]}"
        )
    return edges


def summarise_edges(edges: Edges, submodels: Sequence[Submodel]) -> tuple[EdgeSummary, ...]:
    """Those that were found, and after them those that were tried in vain."""
    found = tuple(
        EdgeSummary(
            target=submodels[edge.target].name,
            source=submodels[edge.source].name,
            evidence=edge.evidence,
            relative_residual=edge.relative_residual,
            accepted=edge.accepted,
            reason=edge.reason,
            fallback=edge.fallback,
        )
        for edge in edges.alignments
    )
    not_found = tuple(
        EdgeSummary(
            target=submodels[failure.target].name,
            source=submodels[failure.source].name,
            evidence=failure.evidence,
            relative_residual=math.nan,
            accepted=False,
            reason=failure.reason,
        )
        for failure in edges.failures
    )
    return found + not_found
