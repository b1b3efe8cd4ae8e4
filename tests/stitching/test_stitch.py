"""Loops: their proof, their place in the graph, and what becomes of the false ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.runs import quiet_run
from helpers.scenes import CAMERA, rotation_about_y, some_sim3

from smust3r_colmap.backbones.base import BackboneResult
from smust3r_colmap.errors import DegenerateAlignmentError
from smust3r_colmap.geometry.affine3 import Affine3
from smust3r_colmap.geometry.sim3 import Sim3
from smust3r_colmap.products import (
    ImageCollection,
    Segment,
    SegmentAlignment,
    SegmentReconstruction,
    Submodel,
    TransformEstimate,
)
from smust3r_colmap.segmentation.loop_segments import PlannedLoop
from smust3r_colmap.segmentation.stage import NOT_LOOKED_FOR, Segments
from smust3r_colmap.segmentation.view_graph import ViewGraph
from smust3r_colmap.stitching import stage as stitching_stage
from smust3r_colmap.stitching import stitch as stitching
from smust3r_colmap.stitching.loop_verification import LoopDecision, UncertainTransform, covariance_of
from smust3r_colmap.stitching.pose_graph.graph import PoseGraph
from smust3r_colmap.stitching.pose_graph.optimise import GraphSolution, optimise
from smust3r_colmap.stitching.stitch import ClosureGap, Stitching, closure_gap, stitch_submodels
from smust3r_colmap.storage.dense_maps import EmptyMaps

NUM_IMAGES, LENGTH, STEP = 96, 16, 8
ORDER = ViewGraph.chain(NUM_IMAGES)
SIGMA = np.array([0.02, 0.02, 0.02, 0.01, 0.01, 0.01, 0.01])
"""Of an edge: shift, turn, log scale."""
RADIUS = 5.0


def world_from_cam_on_ring(image: int) -> np.ndarray:
    """(3, 4) camera on a circle that it walks once and a quarter, looking outwards."""
    angle_deg = 450.0 * image / NUM_IMAGES
    rotation = rotation_about_y(angle_deg)
    return np.column_stack([rotation, RADIUS * rotation[:, 2]])


class Ring:
    """Submodels in gauges of their own, exact in themselves; the edges between them are measured with noise."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.seg_from_world: list[Sim3] = []
        self.submodels: list[Submodel] = []
        self.edges: list[SegmentAlignment] = []
        self.loops: list[PlannedLoop] = []
        for number, first in enumerate(range(0, NUM_IMAGES - LENGTH + 1, STEP)):
            self.add_submodel(tuple(range(first, first + LENGTH)), number)
            if number:
                self.add_edge(number - 1, number)

    def add_submodel(self, images: tuple[int, ...], segment: int) -> int:
        seg_from_world = Sim3.identity() if not self.submodels else some_sim3(self.rng)
        world_from_cam = np.array([world_from_cam_on_ring(image) for image in images])
        self.seg_from_world.append(seg_from_world)
        self.submodels.append(
            Submodel(
                segment=segment,
                submodel=sum(submodel.segment == segment for submodel in self.submodels),
                images=images,
                seg_from_cam=seg_from_world.move_cameras(world_from_cam),
                intrinsics=(CAMERA,) * len(images),
                method="synthetic",
                reprojection_error_px=float("nan"),
                tracks=None,
            )
        )
        return len(self.submodels) - 1

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

    def add_loop(self, a: int, b: int, *, wrong: Sim3 | None = None, submodels: int = 1) -> None:
        """Between the windows a and b; a wrong one is bent between its ends."""
        ends = self.submodels[a].images[4:9], self.submodels[b].images[4:9]
        segment = Segment(
            index=1 + max(submodel.segment for submodel in self.submodels), images=ends[0] + ends[1], kind="loop"
        )
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
        if submodels == 1:
            loop = self.add_submodel(segment.images, segment.index)
            self.add_edge(a, loop)
            self.add_edge(b, loop, wrong=wrong)
        elif submodels == 2:
            for window, end in zip((a, b), ends, strict=True):
                self.add_edge(window, self.add_submodel(end, segment.index))

    def stitched(self) -> Stitching:
        return stitch_submodels(self.submodels, self.edges, self.loops, ORDER, group=Sim3, kernel="cauchy")

    def error(self, stitching: Stitching, *, closed: bool) -> float:
        """Root mean square distance of all window cameras from the truth, the first submodel held."""
        (part,) = stitching.parts if closed else stitching.chained
        squared = []
        for submodel, frame in zip(part.submodels, part.world_from_seg, strict=True):
            truth = np.array([world_from_cam_on_ring(image)[:, 3] for image in self.submodels[submodel].images])
            squared += list(((frame.apply(self.submodels[submodel].seg_from_cam[:, :, 3]) - truth) ** 2).sum(axis=1))
        return float(np.sqrt(np.mean(squared)))


FAR_OFF = Sim3(scale=np.array(1.6), rotation=rotation_about_y(120.0), translation=np.array([4.0, 1.0, -6.0]))
"""The other side of the building."""


@pytest.mark.slow
def test_a_true_loop_is_closed_and_brings_the_frames_nearer_to_the_truth() -> None:
    before, after = [], []
    gaps: list[tuple[ClosureGap, ClosureGap]] = []
    for seed in range(5):
        ring = Ring(seed)
        ring.add_loop(0, 10)
        found = ring.stitched()
        (decision,) = found.decisions
        assert decision.accepted, decision.reason
        assert decision.closure_sigmas < 2.5
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
    (decision,) = found.decisions
    assert not decision.accepted
    assert decision.closure_sigmas > 5
    assert f"inconsistent with the chain of windows ({decision.closure_sigmas:.1f} sigma" in decision.reason
    assert ring.error(found, closed=True) == pytest.approx(ring.error(found, closed=False), rel=1e-6)


def test_a_loop_wrong_within_the_uncertainty_of_the_chain_is_outvoted_in_the_graph() -> None:
    ring = Ring(1)
    for a, b in [(0, 10), (0, 9), (1, 10)]:
        ring.add_loop(a, b)
    true_alone = ring.error(ring.stitched(), closed=True)
    somewhat_off = Sim3.exp(15 * SIGMA * np.array([1, -1, 1, 1, -1, 1, 1]))
    ring.add_loop(1, 9, wrong=somewhat_off)
    found = ring.stitched()
    assert [decision.accepted for decision in found.decisions] == [True, True, True, False]
    assert "inconsistent with the other edges of the pose graph" in found.decisions[3].reason
    assert found.decisions[3].closure_sigmas < 5
    assert len(found.parts[0].submodels) == 11 + 3
    assert ring.error(found, closed=True) < 1.1 * true_alone


def test_a_loop_segment_that_fell_apart_proves_nothing() -> None:
    ring = Ring(2)
    ring.add_loop(0, 10, submodels=2)
    ring.add_loop(1, 10, submodels=0)
    found = ring.stitched()
    assert [decision.accepted for decision in found.decisions] == [False, False]
    assert "holds 3 images of both ends (submodels of 5 + 0, 0 + 5)" in found.decisions[0].reason
    assert found.decisions[1].reason == "the loop segment has no submodel"
    assert found.parts[0].submodels == tuple(range(11))


def test_a_loop_needs_a_sound_edge_at_both_ends() -> None:
    ring = Ring(3)
    ring.add_loop(0, 10)
    ring.edges[-1] = replace(ring.edges[-1], accepted=False, reason="median residual is 0.300 of the depth")
    (decision,) = ring.stitched().decisions
    assert not decision.accepted
    assert "no sound edge between the loop segment and a window of the second end" in decision.reason
    assert "median residual is 0.300" in decision.reason


def test_a_loop_joins_parts_that_the_sequence_does_not() -> None:
    ring = Ring(4)
    del ring.edges[4]
    ring.add_loop(0, 10)
    found = ring.stitched()
    assert [len(part.submodels) for part in found.chained] == [5, 6]
    (part,) = found.parts
    assert len(part.submodels) == 12
    assert np.isnan(found.decisions[0].closure_sigmas)
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
    (decision,) = found.decisions
    assert not decision.accepted
    assert decision.reason == "the pose graph kept the chain of windows: stuck"
    assert found.parts[0].submodels == tuple(range(11))


def test_without_loops_the_chain_stays_as_it_is() -> None:
    ring = Ring(5)
    found = ring.stitched()
    assert found.decisions == ()
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
    found = stitch_submodels(ring.submodels[:2], [first, second], [], ORDER, group=Sim3, kernel="cauchy")
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
    assert ring.stitched().decisions[0].closure_sigmas < 2.5


def test_the_gap_of_a_camera_that_only_turns_has_no_distance() -> None:
    ring = Ring(9)
    ring.add_loop(0, 10)
    submodels = [replace(submodel, seg_from_cam=submodel.seg_from_cam * [1, 1, 1, 0]) for submodel in ring.submodels]
    same = [replace(edge.estimate, b_from_a=Sim3.identity()) for edge in ring.edges]
    edges = [replace(edge, estimate=estimate) for edge, estimate in zip(ring.edges, same, strict=True)]
    (part,) = stitch_submodels(submodels[:-1], edges[:-2], [], ORDER, group=Sim3, kernel="none").chained
    decision = LoopDecision(submodel=11, accepted=True, edges=(10, 11))
    assert np.isnan(closure_gap(decision, submodels, edges, [part]).distance)


def test_a_chain_that_cannot_be_drawn_costs_the_comparison_and_not_the_run(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    ring = Ring(0)
    ring.add_loop(0, 10)
    found = ring.stitched()
    assert found.decisions[0].accepted
    reconstructions = tuple(
        SegmentReconstruction(
            segment=submodel.segment, submodels=(submodel,), unregistered=(), attempts=(), metric=False
        )
        for submodel in ring.submodels
    )
    maps = tuple(EmptyMaps(submodel, longer_side=8) for submodel in ring.submodels)
    result = BackboneResult(reconstructions=reconstructions, dense=maps, dense_key="", matches=None, rejected=())

    def beyond_infinity(*_: object, **__: object) -> None:
        raise DegenerateAlignmentError("2 of 16 cameras lie beyond the plane that the transform sends to infinity")

    monkeypatch.setattr(stitching_stage, "place_submodel", beyond_infinity)
    collection = ImageCollection(images=(), cameras=())
    segments = Segments(view_graph=ORDER, windows=(), loops=NOT_LOOKED_FOR)
    with quiet_run(tmp_path / "out") as run:
        assert stitching_stage._without_loops(run, result, segments, found.chained, collection) is None
