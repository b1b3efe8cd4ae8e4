"""Loops: their proof, their place in the graph, and what becomes of the false ones."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest
from helpers.scenes import CAMERA, rotation_about_y, some_sim3

from smust3r_colmap import pipeline
from smust3r_colmap.backbones.base import BackboneResult
from smust3r_colmap.errors import DegenerateAlignmentError
from smust3r_colmap.execution.progress import QuietReporter
from smust3r_colmap.execution.stage_clock import StageClock
from smust3r_colmap.geometry.affine3 import Affine3
from smust3r_colmap.geometry.sim3 import Sim3
from smust3r_colmap.products import (
    ImageCollection,
    Segment,
    SegmentAlignment,
    SegmentPiece,
    SegmentReconstruction,
    TransformEstimate,
)
from smust3r_colmap.segmentation.loop_segments import PlannedLoop
from smust3r_colmap.stitching import stitch as stitching
from smust3r_colmap.stitching.loop_verification import LoopVerdict, UncertainTransform, covariance_of
from smust3r_colmap.stitching.pose_graph.graph import PoseGraph
from smust3r_colmap.stitching.pose_graph.optimise import GraphSolution, optimise
from smust3r_colmap.stitching.stitch import ClosureGap, Stitching, closure_gap, stitch
from smust3r_colmap.storage.dense_maps import EmptyMaps

NUM_IMAGES, LENGTH, STEP = 96, 16, 8
SIGMA = np.array([0.02, 0.02, 0.02, 0.01, 0.01, 0.01, 0.01])
"""Of an edge: shift, turn, log scale."""
RADIUS = 5.0


def world_from_cam_on_ring(image: int) -> np.ndarray:
    """(3, 4) camera on a circle that it walks once and a quarter, looking outwards."""
    angle_deg = 450.0 * image / NUM_IMAGES
    rotation = rotation_about_y(angle_deg)
    return np.column_stack([rotation, RADIUS * rotation[:, 2]])


class Ring:
    """Pieces in gauges of their own, exact in themselves; the edges between them are measured with noise."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.seg_from_world: list[Sim3] = []
        self.pieces: list[SegmentPiece] = []
        self.edges: list[SegmentAlignment] = []
        self.loops: list[PlannedLoop] = []
        for number, first in enumerate(range(0, NUM_IMAGES - LENGTH + 1, STEP)):
            self.add_piece(tuple(range(first, first + LENGTH)), number)
            if number:
                self.add_edge(number - 1, number)

    def add_piece(self, images: tuple[int, ...], segment: int) -> int:
        seg_from_world = Sim3.identity() if not self.pieces else some_sim3(self.rng)
        world_from_cam = np.array([world_from_cam_on_ring(image) for image in images])
        self.seg_from_world.append(seg_from_world)
        self.pieces.append(
            SegmentPiece(
                segment=segment,
                piece=sum(piece.segment == segment for piece in self.pieces),
                images=images,
                seg_from_cam=seg_from_world.move_cameras(world_from_cam),
                intrinsics=(CAMERA,) * len(images),
                method="synthetic",
                reprojection_error_px=float("nan"),
                tracks=None,
            )
        )
        return len(self.pieces) - 1

    def add_edge(self, target: int, source: int, *, wrong: Sim3 | None = None) -> None:
        """Measured with noise in the world's unit, about the source's place in the world."""
        noise = Sim3.exp(SIGMA * self.rng.normal(size=7))
        world_from_source = self.seg_from_world[source].inverse()
        moved = noise if wrong is None else noise @ wrong
        target_from_source = self.seg_from_world[target] @ moved @ world_from_source
        carry = world_from_source.adjoint()
        information = carry.T @ np.diag(1 / SIGMA**2) @ carry
        estimate = TransformEstimate(
            b_from_a=target_from_source,
            num_points=1000,
            num_inliers=1000,
            rms=0.001,
            residual_sigma=0.001,
            iterations=3,
            stop_reason="converged",
            information=information,
        )
        self.edges.append(
            SegmentAlignment(
                target=target,
                source=source,
                estimate=estimate,
                evidence="pointmaps",
                relative_residual=0.001,
                information=information,
                accepted=True,
            )
        )

    def add_loop(self, a: int, b: int, *, wrong: Sim3 | None = None, pieces: int = 1) -> None:
        """Between the windows a and b; a wrong one is bent between its ends."""
        ends = self.pieces[a].images[4:9], self.pieces[b].images[4:9]
        segment = Segment(index=1 + max(piece.segment for piece in self.pieces), images=ends[0] + ends[1], kind="loop")
        self.loops.append(
            PlannedLoop(
                segment=segment,
                image_a=ends[0][2],
                image_b=ends[1][2],
                segment_a=a,
                segment_b=b,
                similarity=0.9,
            )
        )
        if pieces == 1:
            loop = self.add_piece(segment.images, segment.index)
            self.add_edge(a, loop)
            self.add_edge(b, loop, wrong=wrong)
        elif pieces == 2:
            for window, end in zip((a, b), ends, strict=True):
                self.add_edge(window, self.add_piece(end, segment.index))

    def stitched(self) -> Stitching:
        return stitch(self.pieces, self.edges, self.loops, group=Sim3, kernel="cauchy")

    def error(self, stitching: Stitching, *, closed: bool) -> float:
        """Root mean square distance of all window cameras from the truth, the first piece held."""
        (part,) = stitching.parts if closed else stitching.chained
        squared = []
        for piece, frame in zip(part.pieces, part.world_from_seg, strict=True):
            truth = np.array([world_from_cam_on_ring(image)[:, 3] for image in self.pieces[piece].images])
            squared += list(((frame.apply(self.pieces[piece].seg_from_cam[:, :, 3]) - truth) ** 2).sum(axis=1))
        return float(np.sqrt(np.mean(squared)))


FAR_OFF = Sim3(scale=np.array(1.6), rotation=rotation_about_y(120.0), translation=np.array([4.0, 1.0, -6.0]))
"""The other side of the building."""


def test_a_true_loop_is_closed_and_brings_the_frames_nearer_to_the_truth() -> None:
    before, after = [], []
    gaps: list[tuple[ClosureGap, ClosureGap]] = []
    for seed in range(5):
        ring = Ring(seed)
        ring.add_loop(0, 10)
        found = ring.stitched()
        (verdict,) = found.verdicts
        assert verdict.accepted, verdict.reason
        assert verdict.closure_sigmas < 2.5
        gaps += found.gaps
        before.append(ring.error(found, closed=False))
        after.append(ring.error(found, closed=True))
    assert np.mean(after) < 0.75 * np.mean(before)
    assert np.mean([gap.distance for _, gap in gaps]) < 0.5 * np.mean([gap.distance for gap, _ in gaps])
    assert np.mean([gap.turn_deg for _, gap in gaps]) < 0.5 * np.mean([gap.turn_deg for gap, _ in gaps])


def test_a_loop_that_contradicts_the_chain_beyond_its_uncertainty_is_refused() -> None:
    ring = Ring(0)
    ring.add_loop(0, 6, wrong=FAR_OFF)
    found = ring.stitched()
    (verdict,) = found.verdicts
    assert not verdict.accepted
    assert verdict.closure_sigmas > 5
    assert f"contradicts the chain of windows by {verdict.closure_sigmas:.1f} standard deviations" in verdict.reason
    assert ring.error(found, closed=True) == pytest.approx(ring.error(found, closed=False), rel=1e-6)


def test_a_loop_wrong_within_the_uncertainty_of_the_chain_is_outvoted_in_the_graph() -> None:
    ring = Ring(1)
    for a, b in [(0, 10), (0, 9), (1, 10)]:
        ring.add_loop(a, b)
    true_alone = ring.error(ring.stitched(), closed=True)
    somewhat_off = Sim3.exp(15 * SIGMA * np.array([1, -1, 1, 1, -1, 1, 1]))
    ring.add_loop(1, 9, wrong=somewhat_off)
    found = ring.stitched()
    assert [verdict.accepted for verdict in found.verdicts] == [True, True, True, False]
    assert "the other edges of the graph contradict it" in found.verdicts[3].reason
    assert found.verdicts[3].closure_sigmas < 5
    assert len(found.parts[0].pieces) == 11 + 3
    assert ring.error(found, closed=True) < 1.1 * true_alone


def test_a_loop_segment_that_fell_apart_proves_nothing() -> None:
    ring = Ring(2)
    ring.add_loop(0, 10, pieces=2)
    ring.add_loop(1, 10, pieces=0)
    found = ring.stitched()
    assert [verdict.accepted for verdict in found.verdicts] == [False, False]
    assert "holds 3 images of both ends (pieces of 5 + 0, 0 + 5)" in found.verdicts[0].reason
    assert found.verdicts[1].reason == "nothing came out of the loop segment"
    assert found.parts[0].pieces == tuple(range(11))


def test_a_loop_needs_a_sound_edge_at_both_ends() -> None:
    ring = Ring(3)
    ring.add_loop(0, 10)
    ring.edges[-1] = replace(ring.edges[-1], accepted=False, reason="median residual is 0.300 of the depth")
    (verdict,) = ring.stitched().verdicts
    assert not verdict.accepted
    assert "no sound edge between the loop segment and a window of the second end" in verdict.reason
    assert "median residual is 0.300" in verdict.reason


def test_a_loop_joins_parts_that_the_sequence_does_not() -> None:
    ring = Ring(4)
    del ring.edges[4]
    ring.add_loop(0, 10)
    found = ring.stitched()
    assert [len(part.pieces) for part in found.chained] == [5, 6]
    (part,) = found.parts
    assert len(part.pieces) == 12
    assert np.isnan(found.verdicts[0].closure_sigmas)
    assert np.isnan(found.gaps[0][0].distance)
    assert ring.error(found, closed=True) < 0.5


def test_a_loop_that_the_graph_could_not_use_is_not_called_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    def stuck(graph: PoseGraph, world_from_node: Sim3, *, kernel: str) -> GraphSolution:
        solution = optimise(graph, world_from_node, kernel="none")
        return replace(solution, world_from_node=world_from_node, improved=False, stop_reason="stuck")

    monkeypatch.setattr(stitching, "optimise", stuck)
    ring = Ring(0)
    ring.add_loop(0, 10)
    found = ring.stitched()
    (verdict,) = found.verdicts
    assert not verdict.accepted
    assert verdict.reason == "the pose graph kept the chain of windows: stuck"
    assert found.parts[0].pieces == tuple(range(11))


def test_without_loops_the_chain_stays_as_it_is() -> None:
    ring = Ring(5)
    found = ring.stitched()
    assert found.verdicts == ()
    for chained, placed in zip(found.chained[0].world_from_seg, found.parts[0].world_from_seg, strict=True):
        np.testing.assert_allclose(chained.matrix, placed.matrix, rtol=1e-9, atol=1e-9)


def test_two_edges_of_a_pair_are_averaged_by_their_information() -> None:
    ring = Ring(6)
    first = ring.edges[0]
    shifted = Sim3.exp(np.array([0.003, 0, 0, 0, 0, 0, 0.0]))
    second = replace(
        first,
        evidence="poses",
        estimate=replace(first.estimate, b_from_a=first.estimate.b_from_a @ shifted),
        information=first.information / 2,
    )
    found = stitch(ring.pieces[:2], [first, second], [], group=Sim3, kernel="cauchy")
    between = first.estimate.b_from_a.inverse() @ found.parts[0].world_from_seg[1]
    np.testing.assert_allclose(between.log(), [0.001, 0, 0, 0, 0, 0, 0], atol=1e-6)


def test_uncertainties_are_carried_through_products_and_inverses_as_samples_are() -> None:
    rng = np.random.default_rng(7)
    transforms = [some_sim3(rng), some_sim3(rng)]
    sigmas = [1e-3 * rng.uniform(0.5, 2.0, 7) for _ in range(2)]
    uncertain = [
        UncertainTransform(b_from_a=one, covariance=np.diag(sigma**2))
        for one, sigma in zip(transforms, sigmas, strict=True)
    ]
    found = uncertain[0] @ uncertain[1].inverse()
    noise = [Sim3.exp(sigma * rng.normal(size=(20_000, 7))) for sigma in sigmas]
    samples = transforms[0] @ noise[0] @ (transforms[1] @ noise[1]).inverse()
    deviations = (found.b_from_a.inverse() @ samples).log()
    expected = np.cov(deviations, rowvar=False)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(found.covariance / scale, expected / scale, atol=0.04)


def test_a_stretched_half_turn_without_logarithm_is_infinitely_far() -> None:
    covariance = 1e-4 * np.eye(12)
    here = UncertainTransform(b_from_a=Affine3.identity(), covariance=covariance)
    half_turn = Affine3.from_matrix(np.diag([-1.1, -0.9, 1.0, 1.0]))
    assert here.sigmas_from(UncertainTransform(b_from_a=half_turn, covariance=covariance)) == np.inf


def test_a_direction_that_no_measurement_knows_denies_nothing() -> None:
    known = np.array([4e6, 1.0, 1.0, 1e4, 1e4, 1e4, 0.0])
    covariance = covariance_of(np.diag(known))
    np.testing.assert_allclose(np.diag(covariance)[:6], 1 / known[:6], rtol=1e-9)
    measured = UncertainTransform(b_from_a=Sim3.identity(), covariance=covariance)
    three_times = replace(measured, b_from_a=Sim3.exp([0, 0, 0, 0, 0, 0, np.log(3.0)]))
    shifted = replace(measured, b_from_a=Sim3.exp([0.01, 0, 0, 0, 0, 0, 0]))
    assert measured.sigmas_from(three_times) < 0.01
    assert measured.sigmas_from(shifted) == pytest.approx(20 / np.sqrt(2 * 7), rel=1e-6)


def test_a_loop_whose_scale_nothing_knows_is_not_refused_for_its_scale() -> None:
    ring = Ring(8)
    ring.add_loop(0, 10, wrong=Sim3.exp([0, 0, 0, 0, 0, 0, np.log(3.0)]))
    for position in (-1, -2):
        edge = ring.edges[position]
        carry = ring.seg_from_world[edge.source].inverse().adjoint()
        unscaled = carry.T @ np.diag([*1 / SIGMA[:6] ** 2, 0]) @ carry
        ring.edges[position] = replace(edge, information=unscaled)
    assert ring.stitched().verdicts[0].closure_sigmas < 2.5


def test_the_gap_of_a_camera_that_only_turns_has_no_distance() -> None:
    ring = Ring(9)
    ring.add_loop(0, 10)
    pieces = [replace(piece, seg_from_cam=piece.seg_from_cam * [1, 1, 1, 0]) for piece in ring.pieces]
    same = [replace(edge.estimate, b_from_a=Sim3.identity()) for edge in ring.edges]
    edges = [replace(edge, estimate=estimate) for edge, estimate in zip(ring.edges, same, strict=True)]
    (part,) = stitch(pieces[:-1], edges[:-2], [], group=Sim3, kernel="none").chained
    verdict = LoopVerdict(piece=11, accepted=True, edges=(10, 11))
    assert np.isnan(closure_gap(verdict, pieces, edges, [part]).distance)


def test_a_chain_that_cannot_be_drawn_costs_the_comparison_and_not_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    ring = Ring(0)
    ring.add_loop(0, 10)
    found = ring.stitched()
    assert found.verdicts[0].accepted
    reconstructions = tuple(
        SegmentReconstruction(segment=piece.segment, pieces=(piece,), unregistered=(), attempts=(), metric=False)
        for piece in ring.pieces
    )
    maps = tuple(EmptyMaps(piece, longer_side=8) for piece in ring.pieces)
    result = BackboneResult(reconstructions=reconstructions, dense=maps, dense_key="", links=None, rejected=())

    def beyond_infinity(*_: object) -> None:
        raise DegenerateAlignmentError("2 of 16 cameras lie beyond the plane that the transform sends to infinity")

    monkeypatch.setattr(pipeline, "_placed_pieces", beyond_infinity)
    clock = StageClock(QuietReporter(sys.stderr))
    collection = ImageCollection(images=(), cameras=())
    assert pipeline._without_loops(result, (), found, collection, clock) is None
