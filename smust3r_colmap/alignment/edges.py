"""Every edge between the pieces of a run, and the tests that keep broken ones out of the chain.

Neighbouring pieces are joined by what they share, in this order: feature tracks (as exact as dense
pixels at a twentieth of the cost), else pointmaps; pieces that share too few images, by verified
matches between their images. The next module to read is ``chaining``.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import numpy.typing as npt

from smust3r_colmap.alignment.from_pointmaps import align_pointmaps
from smust3r_colmap.alignment.from_tracks import align_tracks, match_links
from smust3r_colmap.alignment.irls import PieceFit
from smust3r_colmap.config import AlignmentConfig
from smust3r_colmap.errors import DegenerateAlignmentError
from smust3r_colmap.products import DenseMaps, FeatureLinks, SegmentAlignment, SegmentPiece

logger = logging.getLogger(__name__)

MAX_RELATIVE_RESIDUAL = 0.05
"""Median residual over depth; sound edges have 0.0003 to 0.046, broken ones 0.15 to 0.76
(measured on six real sets)."""
MIN_SHARED_TRACKS = 30
"""Fewer common points than COLMAP wants for one image do not carry a segment."""
MIN_LINK_INLIERS = 12
"""Inliers of an edge that rests on matches between images; a Sim(3) needs 3."""
MIN_LINK_SHARE = 0.3
"""Share of the linked points that must fit; wrong matches agree on nothing."""
MAX_CAMERA_TURN_DEG = 10.0
"""Median difference in rotation of the shared cameras after the fit; sound edges have 0.1 to 1.8."""


@dataclass(frozen=True, kw_only=True)
class TriedAlignment:
    """Two pieces for which no transform was found, and why."""

    target: int
    source: int
    evidence: str
    reason: str


@dataclass(frozen=True, kw_only=True)
class Edges:
    """All alignments of a run, accepted or not, and the pairs that gave none."""

    alignments: tuple[SegmentAlignment, ...]
    failures: tuple[TriedAlignment, ...]


def align_pieces(
    pieces: Sequence[SegmentPiece],
    dense: Sequence[DenseMaps],
    links: FeatureLinks | None,
    settings: AlignmentConfig,
    *,
    seed: int,
    advance: Callable[[int], None],
) -> Edges:
    """Align every pair of pieces that could have something in common.

    Args:
        pieces: all of the run. dense: their maps, in the same order.
        links: verified matches, for pieces that share too few images; None where there are none.
        settings: source of correspondences, kernel, weighting.
        seed: of the searches for a robust start.
        advance: called with 1 after each pair of ``candidate_pairs``.
    """
    alignments: list[SegmentAlignment] = []
    failures: list[TriedAlignment] = []
    for target, source in candidate_pairs(pieces):
        for outcome in _align_pair(target, source, pieces, dense, links, settings, seed):
            if isinstance(outcome, SegmentAlignment):
                alignments.append(outcome)
            else:
                failures.append(outcome)
        advance(1)
    return Edges(alignments=tuple(alignments), failures=tuple(failures))


def needs_maps(pieces: Sequence[SegmentPiece], settings: AlignmentConfig) -> bool:
    """Whether any pair may be aligned by its pointmaps."""
    return settings.alignment_source == "pointmaps" or (
        settings.alignment_source == "auto" and any(piece.tracks is None for piece in pieces)
    )


def candidate_pairs(pieces: Sequence[SegmentPiece]) -> tuple[tuple[int, int], ...]:
    """Pairs that share an image, or belong to the same or to neighbouring segments."""
    images = [set(piece.images) for piece in pieces]
    return tuple(
        (a, b)
        for a, b in combinations(range(len(pieces)), 2)
        if images[a] & images[b] or abs(pieces[a].segment - pieces[b].segment) <= 1
    )


def _align_pair(
    target: int,
    source: int,
    pieces: Sequence[SegmentPiece],
    dense: Sequence[DenseMaps],
    links: FeatureLinks | None,
    settings: AlignmentConfig,
    seed: int,
) -> Iterator[SegmentAlignment | TriedAlignment]:
    """The edge from what is shared; where that is refused, one from matches between images."""
    a, b = pieces[target], pieces[source]
    accepted = False
    if set(a.images) & set(b.images):
        evidence = _evidence(a, b, settings)
        try:
            if evidence == "tracks":
                fit = align_tracks(a, b, settings, seed=seed)
            else:
                fit = align_pointmaps(a, b, dense[target], dense[source], settings, seed=seed)
        except DegenerateAlignmentError as error:
            yield TriedAlignment(target=target, source=source, evidence=evidence, reason=str(error))
        else:
            edge = _edge(target, source, fit, evidence, _refusal(a, b, fit))
            accepted = edge.accepted
            yield edge
    if accepted or links is None or a.tracks is None or b.tracks is None:
        return
    try:
        fit = _align_by_links(a, b, links, settings, seed)
    except DegenerateAlignmentError as error:
        yield TriedAlignment(target=target, source=source, evidence="links", reason=str(error))
        return
    yield _edge(target, source, fit, "links", _refusal_of_links(a, b, fit))


def _evidence(a: SegmentPiece, b: SegmentPiece, settings: AlignmentConfig) -> str:
    if settings.alignment_source != "auto":
        return settings.alignment_source
    return "tracks" if a.tracks is not None and b.tracks is not None else "pointmaps"


def _align_by_links(
    a: SegmentPiece, b: SegmentPiece, links: FeatureLinks, settings: AlignmentConfig, seed: int
) -> PieceFit:
    """Matches run from the lower to the higher image; take them both ways."""
    in_a, in_b = np.array(a.images), np.array(b.images)
    forward = np.isin(links.image_a, in_a) & np.isin(links.image_b, in_b)
    backward = np.isin(links.image_b, in_a) & np.isin(links.image_a, in_b)

    def both(first: npt.NDArray[np.int64], second: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        return np.concatenate([first[forward], second[backward]])

    return match_links(
        a,
        b,
        settings,
        image_a=both(links.image_a, links.image_b),
        feature_a=both(links.feature_a, links.feature_b),
        image_b=both(links.image_b, links.image_a),
        feature_b=both(links.feature_b, links.feature_a),
        seed=seed,
    )


def _edge(target: int, source: int, fit: PieceFit, evidence: str, reason: str) -> SegmentAlignment:
    return SegmentAlignment(
        target=target,
        source=source,
        estimate=fit.estimate,
        evidence=evidence,
        relative_residual=fit.relative_residual,
        accepted=not reason,
        reason=reason,
    )


def _refusal(a: SegmentPiece, b: SegmentPiece, fit: PieceFit) -> str:
    """Why an edge from shared images cannot be believed, or nothing."""
    if not fit.relative_residual <= MAX_RELATIVE_RESIDUAL:
        return f"median residual is {fit.relative_residual:.3f} of the depth, at most {MAX_RELATIVE_RESIDUAL}"
    if fit.num_correspondences < MIN_SHARED_TRACKS:
        return f"{fit.num_correspondences} common points, needed {MIN_SHARED_TRACKS}"
    return _camera_refusal(a, b, fit)


def _camera_refusal(a: SegmentPiece, b: SegmentPiece, fit: PieceFit) -> str:
    if not set(a.images) & set(b.images):
        return ""
    turn_deg = camera_turn_deg(a, b, fit)
    if turn_deg > MAX_CAMERA_TURN_DEG:
        return f"shared cameras differ by {turn_deg:.1f} degrees after the fit, at most {MAX_CAMERA_TURN_DEG}"
    return ""


def _refusal_of_links(a: SegmentPiece, b: SegmentPiece, fit: PieceFit) -> str:
    """The same for an edge from matches; cameras that are shared all the same have to agree."""
    if fit.estimate.num_inliers < MIN_LINK_INLIERS:
        return f"{fit.estimate.num_inliers} matched points fit, needed {MIN_LINK_INLIERS}"
    if fit.inlier_share < MIN_LINK_SHARE:
        return f"{fit.inlier_share:.0%} of the matched points fit, needed {MIN_LINK_SHARE:.0%}"
    return _camera_refusal(a, b, fit)


def camera_turn_deg(a: SegmentPiece, b: SegmentPiece, fit: PieceFit) -> float:
    """Median angle in degrees between the cameras of the shared images after the fit."""
    shared = sorted(set(a.images) & set(b.images))
    in_a = [a.images.index(image) for image in shared]
    in_b = [b.images.index(image) for image in shared]
    moved = fit.estimate.b_from_a.move_cameras(b.seg_from_cam[in_b])
    relative = np.swapaxes(a.seg_from_cam[in_a][..., :3], -1, -2) @ moved[..., :3]
    cosine = (np.trace(relative, axis1=-2, axis2=-1) - 1) / 2
    return float(np.median(np.degrees(np.arccos(np.clip(cosine, -1, 1)))))
