"""Every edge between the submodels of a run, and the tests that reject wrong ones.

Two submodels that share images are joined twice (paper section III-E): by the points that both saw,
as feature tracks (as accurate as dense pixels at a twentieth of the cost) or else as pointmaps, and by
the cameras of the shared images. Submodels that share too few images are joined by verified matches
between their images. The next module to read is ``stitching.spanning_tree``.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Literal, Protocol

import numpy as np
import numpy.typing as npt

from smust3r_colmap.alignment.from_pointmaps import align_pointmaps
from smust3r_colmap.alignment.from_poses import align_poses
from smust3r_colmap.alignment.from_tracks import align_matches, align_tracks, point_depths
from smust3r_colmap.alignment.seen_points import SubmodelFit
from smust3r_colmap.alignment.uncertainty import inflated_information, overlap_centre
from smust3r_colmap.errors import DegenerateAlignmentError
from smust3r_colmap.estimators.confidence import ConfidenceWeighting
from smust3r_colmap.estimators.robust import RobustKernel, RobustLoss, evenly_chosen
from smust3r_colmap.geometry.arrays import Pair
from smust3r_colmap.geometry.depth_noise import SUBMODEL_AGREEMENT
from smust3r_colmap.geometry.groups import GROUPS, TransformGroup, embed
from smust3r_colmap.geometry.so3 import angles_between
from smust3r_colmap.geometry.transform import Transform
from smust3r_colmap.products import (
    DenseMaps,
    Edges,
    InterSegmentMatches,
    SegmentAlignment,
    Submodel,
    TransformEstimate,
    TriedAlignment,
)

logger = logging.getLogger(__name__)

MIN_SHARED_TRACKS = 30
"""Common points; COLMAP asks for 30 to register a single image."""
MIN_MATCH_INLIERS = 12
"""Inliers of an edge that rests on matches between images; a Sim(3) needs 3."""
MIN_MATCH_INLIER_RATIO = 0.3
"""Inliers over matched points; wrong matches agree on nothing."""
MIN_POSE_INLIER_RATIO = 0.3
"""Inliers over shared cameras, by centre and orientation; a broken pair had 3 of 14."""
MAX_DISAGREEMENT_SIGMAS = 5.0
"""Between the edge from points and the one from cameras, per degree of freedom."""
MEDIAN_DEPTH_IMAGES = 8
"""Maps read for the median depth of a submodel."""
MAX_CAMERA_TURN_DEG = 10.0
"""Median difference in rotation of the shared cameras after the fit; sound edges have 0.1 to 1.8."""


class AlignmentOptions(Protocol):
    """How submodels are aligned, by the names of the settings of the stage."""

    @property
    def transform_group(self) -> TransformGroup:
        """Of all edges."""

    @property
    def alignment_edges(self) -> Literal["both", "points", "poses"]:
        """Kinds of edges."""

    @property
    def alignment_source(self) -> Literal["auto", "tracks", "pointmaps"]:
        """Correspondences of the edges from points."""

    @property
    def confidence_weighting(self) -> ConfidenceWeighting:
        """Of pointmaps."""

    @property
    def robust_kernel(self) -> RobustKernel:
        """Of all fits."""

    @property
    def huber_delta(self) -> float:
        """Of the huber kernel, in units of the target."""


def align_submodels(
    submodels: Sequence[Submodel],
    dense: Sequence[DenseMaps],
    matches: InterSegmentMatches | None,
    options: AlignmentOptions,
    *,
    next_windows: Collection[Pair],
    loop_segments: Collection[int] = (),
    seed: int,
    advance: Callable[[int], None],
) -> Edges:
    """Align every pair of submodels that could have something in common.

    A pair gives up to two edges (paper section III-E): one from the points that both see, one from
    the cameras of the images that both hold. Where both are sound but inconsistent, the one from points is
    accepted, since it rests on more data.

    Args:
        submodels: all of the run. dense: their maps, in the same order.
        matches: verified matches, for submodels that share too few images; None where there are none.
        options: group, kinds of edges, source of correspondences, loss, weighting.
        next_windows: indices of the windows that follow each other, the lower one first.
        loop_segments: indices of the segments that are loops, not windows of the sequence.
        seed: of the searches for a robust start.
        advance: called with 1 after each pair of ``candidate_pairs``.
    """
    aligner = _Aligner(submodels=submodels, dense=dense, matches=matches, options=options, seed=seed)
    outcomes: list[SegmentAlignment | TriedAlignment] = []
    for target, source in candidate_pairs(submodels, next_windows, loop_segments):
        outcomes += aligner.align(target, source)
        advance(1)
    return Edges(
        alignments=tuple(one for one in outcomes if isinstance(one, SegmentAlignment)),
        failures=tuple(one for one in outcomes if isinstance(one, TriedAlignment)),
    )


def needs_maps(submodels: Sequence[Submodel], options: AlignmentOptions) -> bool:
    """Whether any pair may be aligned by its pointmaps."""
    return options.alignment_source == "pointmaps" or (
        options.alignment_source == "auto" and any(submodel.tracks is None for submodel in submodels)
    )


def candidate_pairs(
    submodels: Sequence[Submodel], next_windows: Collection[Pair], loop_segments: Collection[int] = ()
) -> tuple[tuple[int, int], ...]:
    """Pairs that share an image, or belong to the same window or to two that follow each other; never two loops."""
    images = [set(submodel.images) for submodel in submodels]
    is_loop = [submodel.segment in loop_segments for submodel in submodels]

    def worth_it(a: int, b: int) -> bool:
        if is_loop[a] and is_loop[b]:
            return False
        first, second = sorted((submodels[a].segment, submodels[b].segment))
        return first == second or (first, second) in next_windows or not images[a].isdisjoint(images[b])

    return tuple((a, b) for a, b in combinations(range(len(submodels)), 2) if worth_it(a, b))


@dataclass(frozen=True, kw_only=True, eq=False)
class _Aligner:
    """All that aligning a pair of submodels needs."""

    submodels: Sequence[Submodel]
    dense: Sequence[DenseMaps]
    matches: InterSegmentMatches | None
    options: AlignmentOptions
    seed: int
    _depths: dict[int, float] = field(default_factory=dict)

    @property
    def _loss(self) -> RobustLoss:
        return RobustLoss(kernel=self.options.robust_kernel, huber_delta=self.options.huber_delta)

    def align(self, target: int, source: int) -> list[SegmentAlignment | TriedAlignment]:
        """Every edge between two submodels that was tried."""
        outcomes: list[SegmentAlignment | TriedAlignment] = []
        shared = bool(set(self.submodels[target].images) & set(self.submodels[source].images))
        if self.options.alignment_edges != "poses":
            if shared:
                outcomes.append(self._by_points(target, source))
            if not any(_is_accepted(one) for one in outcomes) and self._has_matches(target, source):
                outcomes.append(self._by_matches(target, source))
        if shared and self.options.alignment_edges != "points":
            outcomes.append(self._by_poses(target, source, beside=tuple(outcomes)))
        return outcomes

    def _by_points(self, target: int, source: int) -> SegmentAlignment | TriedAlignment:
        a, b = self.submodels[target], self.submodels[source]
        evidence = _evidence(a, b, self.options)
        try:
            if evidence == "tracks":
                fit = align_tracks(a, b, loss=self._loss, group=self.options.transform_group, seed=self.seed)
            else:
                fit = align_pointmaps(
                    a,
                    b,
                    self.dense[target],
                    self.dense[source],
                    loss=self._loss,
                    group=self.options.transform_group,
                    weighting=self.options.confidence_weighting,
                    seed=self.seed,
                )
            return self._edge(target, source, fit, evidence, _rejection(a, b, fit))
        except DegenerateAlignmentError as error:
            return TriedAlignment(target=target, source=source, evidence=evidence, reason=str(error))

    def _has_matches(self, target: int, source: int) -> bool:
        tracks = (self.submodels[target].tracks, self.submodels[source].tracks)
        return self.matches is not None and None not in tracks

    def _by_matches(self, target: int, source: int) -> SegmentAlignment | TriedAlignment:
        assert self.matches is not None
        a, b = self.submodels[target], self.submodels[source]
        try:
            fit = _align_by_matches(a, b, self.matches, self._loss, self.options.transform_group, self.seed)
        except DegenerateAlignmentError as error:
            return TriedAlignment(target=target, source=source, evidence="matches", reason=str(error))
        return self._edge(target, source, fit, "matches", _rejection_of_matches(a, b, fit))

    def _by_poses(
        self, target: int, source: int, *, beside: Sequence[SegmentAlignment | TriedAlignment]
    ) -> SegmentAlignment | TriedAlignment:
        a, b = self.submodels[target], self.submodels[source]
        group: Literal["sim3", "se3"] = "se3" if self.options.transform_group == "se3" else "sim3"
        try:
            fit = align_poses(a, b, depth_target=self._depth(target), kernel=self.options.robust_kernel, group=group)
            edge = self._edge(target, source, fit, "poses", _rejection_of_poses(a, b, fit))
        except DegenerateAlignmentError as error:
            return TriedAlignment(target=target, source=source, evidence="poses", reason=str(error))
        return replace(edge, accepted=False, reason=reason) if (reason := _inconsistency(edge, beside)) else edge

    def _edge(self, target: int, source: int, fit: SubmodelFit, evidence: str, reason: str) -> SegmentAlignment:
        """The fit with inflated covariance, in the group of the run."""
        b = self.submodels[source]
        shared = set(self.submodels[target].images) & set(b.images)
        group = GROUPS[self.options.transform_group]
        information = inflated_information(
            fit.estimate,
            num_images=max(len(shared), 1),
            centre_source=overlap_centre(b, shared or set(b.images), self._depth(source)),
            depth_source=self._depth(source),
            group=group,
        )
        return SegmentAlignment(
            target=target,
            source=source,
            estimate=_in_group(fit.estimate, group),
            evidence=evidence,
            relative_residual=fit.relative_residual,
            information=information,
            accepted=not reason,
            reason=reason,
            fallback=fit.fallback,
        )

    def _depth(self, position: int) -> float:
        """Median depth of a submodel, measured once."""
        if position not in self._depths:
            submodel = self.submodels[position]
            self._depths[position] = median_depth(submodel, self.dense[position] if submodel.tracks is None else None)
        return self._depths[position]


def _in_group(estimate: TransformEstimate, group: type[Transform]) -> TransformEstimate:
    """The same estimate as an element of a larger group, of which it knows nothing more."""
    small = type(estimate.b_from_a)
    if small is group:
        return estimate
    small_from_large = np.linalg.pinv(embed(group, small))
    return replace(
        estimate,
        b_from_a=group.from_matrix(estimate.b_from_a.matrix),
        information=small_from_large.T @ estimate.information @ small_from_large,
    )


def median_depth(submodel: Submodel, maps: DenseMaps | None) -> float:
    """Median depth of what a submodel sees, in its units: of its track points, else of some of its maps.

    Raises:
        DegenerateAlignmentError: there is no depth at all.
    """
    if submodel.tracks is not None:
        depths = point_depths(submodel)
    elif maps is None:
        raise ValueError(f"submodel {submodel.name} has neither tracks nor maps")
    else:
        some = evenly_chosen(len(submodel.images), MEDIAN_DEPTH_IMAGES)
        depths = np.concatenate([maps.depth(int(k))[::4, ::4].ravel() for k in some]).astype(np.float64)
    known = depths[np.isfinite(depths) & (depths > 0)]
    if not len(known):
        raise DegenerateAlignmentError(f"submodel {submodel.name} has no depth anywhere")
    return float(np.median(known))


def _is_accepted(outcome: SegmentAlignment | TriedAlignment) -> bool:
    return isinstance(outcome, SegmentAlignment) and outcome.accepted


def _evidence(a: Submodel, b: Submodel, options: AlignmentOptions) -> str:
    if options.alignment_source != "auto":
        return options.alignment_source
    return "tracks" if a.tracks is not None and b.tracks is not None else "pointmaps"


def _align_by_matches(
    a: Submodel, b: Submodel, matches: InterSegmentMatches, loss: RobustLoss, group: TransformGroup, seed: int
) -> SubmodelFit:
    """Matches run from the lower to the higher image; take them both ways."""
    in_a, in_b = np.array(a.images), np.array(b.images)
    forward = np.isin(matches.image_a, in_a) & np.isin(matches.image_b, in_b)
    backward = np.isin(matches.image_b, in_a) & np.isin(matches.image_a, in_b)

    def both(first: npt.NDArray[np.int64], second: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        return np.concatenate([first[forward], second[backward]])

    return align_matches(
        a,
        b,
        image_a=both(matches.image_a, matches.image_b),
        feature_a=both(matches.feature_a, matches.feature_b),
        image_b=both(matches.image_b, matches.image_a),
        feature_b=both(matches.feature_b, matches.feature_a),
        loss=loss,
        group=group,
        seed=seed,
    )


def _rejection(a: Submodel, b: Submodel, fit: SubmodelFit) -> str:
    """Why an edge from shared images is rejected, or empty."""
    if not fit.relative_residual <= SUBMODEL_AGREEMENT:
        return f"median residual is {fit.relative_residual:.3f} of the depth, at most {SUBMODEL_AGREEMENT}"
    if fit.num_correspondences < MIN_SHARED_TRACKS:
        return f"{fit.num_correspondences} common points, needed {MIN_SHARED_TRACKS}"
    return _camera_rejection(a, b, fit)


def _camera_rejection(a: Submodel, b: Submodel, fit: SubmodelFit) -> str:
    if not set(a.images) & set(b.images):
        return ""
    turn_deg = camera_turn_deg(a, b, fit)
    if not turn_deg <= MAX_CAMERA_TURN_DEG:
        return f"shared cameras differ by {turn_deg:.1f} degrees after the fit, at most {MAX_CAMERA_TURN_DEG}"
    return ""


def _rejection_of_matches(a: Submodel, b: Submodel, fit: SubmodelFit) -> str:
    """The same for an edge from matches; cameras that are shared as well have to agree."""
    if fit.estimate.num_inliers < MIN_MATCH_INLIERS:
        return f"{fit.estimate.num_inliers} matched points fit, needed {MIN_MATCH_INLIERS}"
    if fit.inlier_share < MIN_MATCH_INLIER_RATIO:
        return f"{fit.inlier_share:.0%} of the matched points fit, needed {MIN_MATCH_INLIER_RATIO:.0%}"
    return _camera_rejection(a, b, fit)


def _rejection_of_poses(a: Submodel, b: Submodel, fit: SubmodelFit) -> str:
    """The same for an edge from cameras."""
    if not fit.relative_residual <= SUBMODEL_AGREEMENT:
        return f"the centres differ by {fit.relative_residual:.3f} of the depth, at most {SUBMODEL_AGREEMENT}"
    if fit.inlier_share < MIN_POSE_INLIER_RATIO:
        return f"{fit.inlier_share:.0%} of {fit.num_correspondences} cameras fit, needed {MIN_POSE_INLIER_RATIO:.0%}"
    return _camera_rejection(a, b, fit)


def _inconsistency(edge: SegmentAlignment, beside: Sequence[SegmentAlignment | TriedAlignment]) -> str:
    """Why an edge from cameras is rejected in favour of those from points, or empty."""
    if not edge.accepted:
        return ""
    sound = [one for one in beside if isinstance(one, SegmentAlignment) and one.accepted]
    if not sound and any(isinstance(one, SegmentAlignment) for one in beside):
        return "the edge from points of the same images was rejected"
    for other in sound:
        distance = disagreement_sigmas(edge, other)
        if distance > MAX_DISAGREEMENT_SIGMAS:
            return f"inconsistent with the edge from {other.evidence} ({distance:.1f} sigma)"
    return ""


def disagreement_sigmas(first: SegmentAlignment, second: SegmentAlignment) -> float:
    """How far apart two edges between the same submodels are, per degree of freedom, in standard deviations.

    Infinite where the difference is a stretched half turn, which has no logarithm.
    """
    between = first.estimate.b_from_a.inverse() @ second.estimate.b_from_a
    if not between.log_exists():
        return float("inf")
    difference = between.log()
    # The inverse of the sum of both covariances, also where one of them does not measure a direction.
    both = first.information @ np.linalg.pinv(first.information + second.information) @ second.information
    return float(np.sqrt(difference @ both @ difference / len(difference)))


def camera_turn_deg(a: Submodel, b: Submodel, fit: SubmodelFit) -> float:
    """Median angle in degrees between the cameras of the shared images after the fit."""
    shared = sorted(set(a.images) & set(b.images))
    poses_a = a.seg_from_cam[[a.images.index(image) for image in shared]]
    poses_b = b.seg_from_cam[[b.images.index(image) for image in shared]]
    moved = fit.estimate.b_from_a.move_cameras(poses_b)
    return float(np.degrees(np.median(angles_between(poses_a[..., :3], moved[..., :3]))))
