"""Submodels in one frame: loops verified, pose graph optimised, every image placed once (paper III-F).

The next module to read is ``stitch``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from smust3r_colmap.backbones.base import BackboneResult
from smust3r_colmap.config import AlignmentConfig, LoopConfig
from smust3r_colmap.errors import DegenerateAlignmentError
from smust3r_colmap.execution.progress import Stage
from smust3r_colmap.execution.run_context import Run
from smust3r_colmap.geometry.groups import GROUPS
from smust3r_colmap.geometry.world_frame import WorldFrame
from smust3r_colmap.products import EMPTY_CLOUD, DenseMaps, Edges, ImageCollection, Scene
from smust3r_colmap.segmentation.loop_segments import LoopPlan
from smust3r_colmap.segmentation.stage import Segments
from smust3r_colmap.stitching.camera_fusion import (
    FusedCameras,
    build_scene,
    depth_in_cameras,
    fuse_cameras,
    fuse_intrinsics,
)
from smust3r_colmap.stitching.common_unit import in_common_unit
from smust3r_colmap.stitching.resection import PlacedSubmodel, place_submodel
from smust3r_colmap.stitching.spanning_tree import ChainedPart
from smust3r_colmap.stitching.stitch import Stitching, stitch_submodels
from smust3r_colmap.storage.codec import Codec
from smust3r_colmap.storage.depth_maps import DepthMapWriter, StoredDepthMaps
from smust3r_colmap.storage.run_directory import STITCHED_STAGE


@dataclass(frozen=True, kw_only=True, eq=False)
class PlacedScene:
    """A connected component of the submodels.

    Args:
        scene: without points.
        cameras: of the scene, with what the submodels say of each image.
    """

    scene: Scene
    cameras: FusedCameras


_PLACED: Codec[tuple[PlacedScene, ...]] = Codec(tuple[PlacedScene, ...], "placed")


@dataclass(frozen=True, kw_only=True, eq=False)
class Stitched:
    """All images placed.

    Args:
        placed: largest first.
        maps: depth of their images.
        stitching: frames of the submodels, decisions on loops, pose graph.
        without_loops: the largest scene as the windows alone place it; None where no loop was closed, or where
            the windows alone, in SL(4), send a camera beyond infinity.
        unit_spread_percent: see ``GraphSummary``.
    """

    placed: tuple[PlacedScene, ...]
    maps: StoredDepthMaps
    stitching: Stitching
    without_loops: Scene | None
    unit_spread_percent: float

    @property
    def scenes(self) -> tuple[Scene, ...]:
        """Largest first, without points."""
        return tuple(one.scene for one in self.placed)

    @property
    def before(self) -> dict[str, Scene]:
        """The largest scene before loops were closed, by the file that gets its trajectory."""
        return {} if self.without_loops is None else {"trajectory_without_loops_tum.txt": self.without_loops}


@dataclass(frozen=True, kw_only=True)
class LoopSummary:
    """A place that the camera may have come back to, and what became of it.

    Args:
        image_a, image_b: names of the two images that look most alike.
        similarity: cosine of their descriptors.
        segment_a, segment_b: windows that hold them. segment: the loop segment.
        accepted: it closes the loop in the result.
        reason: why not, or empty.
        closure_sigmas: how far the loop is from the chain of windows, in standard deviations per degree
            of freedom; NaN where nothing else connects the two.
        weight: in the pose graph, from 0 to 1; NaN where it took no part.
        gap_before_percent, gap_after_percent: distance between where the two windows put the cameras of
            the second end, joined through the loop, in percent of the extent of all cameras, without
            and with loop closing; NaN where it cannot be told.
        turn_before_deg, turn_after_deg: the same for their orientations.
    """

    image_a: str
    image_b: str
    similarity: float
    segment_a: int
    segment_b: int
    segment: int
    accepted: bool
    reason: str
    closure_sigmas: float
    weight: float
    gap_before_percent: float
    gap_after_percent: float
    turn_before_deg: float
    turn_after_deg: float


@dataclass(frozen=True, kw_only=True)
class GraphSummary:
    """The optimisation of all frames.

    Args:
        num_nodes, num_edges, num_loops: of the graph.
        cost_before, cost_after: of the same objective; without loops and with one edge per pair, zero.
        iterations, stop_reason: of the optimiser.
        improved: its result was used; otherwise the chain was kept.
        unit_spread_percent: robust standard deviation of the units of metric submodels; NaN without such.
    """

    num_nodes: int
    num_edges: int
    num_loops: int
    cost_before: float
    cost_after: float
    iterations: int
    stop_reason: str
    improved: bool
    unit_spread_percent: float = math.nan


@dataclass(frozen=True, kw_only=True)
class CameraFusionSummary:
    """How well the submodels of a scene agree on the cameras that they share; NaN where they share none.

    Args:
        num_shared: images that two submodels or more hold.
        num_dropped: poses that were left out because the other submodels contradict them.
        median_position_spread_percent, max_position_spread_percent: over the shared images, the largest distance
            between two of their centres, in percent of the radius of the scene.
        median_rotation_spread_deg, max_rotation_spread_deg: the same of their rotations.
    """

    num_shared: int
    num_dropped: int
    median_position_spread_percent: float
    max_position_spread_percent: float
    median_rotation_spread_deg: float
    max_rotation_spread_deg: float


def stitch(
    run: Run,
    result: BackboneResult,
    edges: Edges,
    segments: Segments,
    collection: ImageCollection,
    alignment: AlignmentConfig,
    loop_closing: LoopConfig,
) -> Stitched:
    """One frame for whatever hangs together, one pose and one depth map for every image."""
    with run.clock.stage("pose graph", total=1) as progress:
        stitching = stitch_submodels(
            result.submodels,
            edges.alignments,
            segments.loops.loops,
            segments.view_graph,
            group=GROUPS[alignment.transform_group],
            kernel=loop_closing.loop_kernel,
        )
        progress.advance()
    stitching, spread_percent = _in_common_units(stitching, result)
    if not stitching.solution.improved and len(edges.alignments):
        run.clock.note(f"pose graph: {stitching.solution.stop_reason}")
    placed, maps = _place(run, result, segments, stitching.parts, collection)
    without_loops = None
    if any(decision.accepted for decision in stitching.decisions):
        without_loops = _without_loops(run, result, segments, stitching.chained, collection)
    return Stitched(
        placed=placed,
        maps=maps,
        stitching=stitching,
        without_loops=without_loops,
        unit_spread_percent=spread_percent,
    )


def _in_common_units(stitching: Stitching, result: BackboneResult) -> tuple[Stitching, float]:
    """Metric parts in the unit of all their submodels, and the spread of the units in percent; NaN without any."""

    def is_metric(part: ChainedPart) -> bool:
        return all(result.reconstructions[result.submodels[p].segment].metric for p in part.submodels)

    def scaled(parts: Sequence[ChainedPart]) -> list[tuple[ChainedPart, float]]:
        return [in_common_unit(part) if is_metric(part) else (part, math.nan) for part in parts]

    parts, chained = scaled(stitching.parts), scaled(stitching.chained)
    spreads = [spread for _, spread in parts if math.isfinite(spread)]
    changed = replace(stitching, parts=tuple(part for part, _ in parts), chained=tuple(part for part, _ in chained))
    return changed, 100 * max(spreads, default=math.nan)


def placed_submodels(
    scene: Scene, stitched: Stitched, result: BackboneResult, segments: Segments
) -> tuple[tuple[PlacedSubmodel, ...], list[DenseMaps]]:
    """The submodels that were stitched to a scene, with their maps; the scene may have been refined since."""
    of_names = {tuple(result.submodels[p].name for p in part.submodels): part for part in stitched.stitching.parts}
    part = of_names[scene.segments]
    return _placed(part, result, segments), [result.dense[p] for p in part.submodels]


def _place(
    run: Run,
    result: BackboneResult,
    segments: Segments,
    parts: Sequence[ChainedPart],
    collection: ImageCollection,
) -> tuple[tuple[PlacedScene, ...], StoredDepthMaps]:
    """Every image once, one camera set and one depth map for every connected part, largest first."""

    def write(folder: Path, progress: Stage) -> None:
        found = []
        maps = DepthMapWriter(folder)
        for part in sorted(parts, key=lambda part: _num_images(part, result), reverse=True):
            placed = _placed(part, result, segments)
            cameras = fuse_cameras(placed, segments.view_graph)
            found.append(PlacedScene(scene=_scene(placed, cameras, result, collection), cameras=cameras))
            dense = [result.dense[p] for p in part.submodels]
            for image, depth, confidence in depth_in_cameras(placed, dense, cameras):
                maps.write(collection.images[image].name, depth, confidence)
            progress.advance()
        maps.finish()
        _PLACED.write(folder, _without_repeats(found))

    inputs = [_inputs_of(part, result, collection) for part in parts]
    kinds = [segment.kind for segment in segments.all]
    folder = run.cached_folder(
        STITCHED_STAGE, (inputs, kinds, result.dense_key), write, total=len(parts), title="placing"
    )
    return _PLACED.read(folder), StoredDepthMaps(folder)


def _without_loops(
    run: Run,
    result: BackboneResult,
    segments: Segments,
    chained: Sequence[ChainedPart],
    collection: ImageCollection,
) -> Scene | None:
    part = max(chained, key=lambda part: _num_images(part, result))
    try:
        placed = _placed(part, result, segments)
    except DegenerateAlignmentError as error:
        run.clock.note(f"no trajectory without loops: {error}")
        return None
    return _scene(placed, fuse_cameras(placed, segments.view_graph), result, collection)


def _num_images(part: ChainedPart, result: BackboneResult) -> int:
    return len({image for p in part.submodels for image in result.submodels[p].images})


def _placed(part: ChainedPart, result: BackboneResult, segments: Segments) -> tuple[PlacedSubmodel, ...]:
    return tuple(
        place_submodel(
            result.submodels[p],
            result.dense[p],
            world_from_seg,
            is_loop=result.submodels[p].segment in segments.loop_indices,
        )
        for p, world_from_seg in zip(part.submodels, part.world_from_seg, strict=True)
    )


def _scene(
    placed: tuple[PlacedSubmodel, ...], cameras: FusedCameras, result: BackboneResult, collection: ImageCollection
) -> Scene:
    intrinsics = fuse_intrinsics(placed, [image.camera for image in collection.images])
    if collection.calibrated:
        intrinsics = {camera: collection.cameras[camera] for camera in intrinsics}
    metric = all(result.reconstructions[one.submodel.segment].metric for one in placed)
    return build_scene(collection, placed, cameras, intrinsics, EMPTY_CLOUD, frame=WorldFrame(metric=metric))


def _inputs_of(part: ChainedPart, result: BackboneResult, collection: ImageCollection) -> list[tuple[object, ...]]:
    """What each submodel puts into a scene besides its maps; the names of images too, for files may be renamed."""
    inputs: list[tuple[object, ...]] = []
    for p, world_from_seg in zip(part.submodels, part.world_from_seg, strict=True):
        submodel = result.submodels[p]
        images = [collection.images[index] for index in submodel.images]
        names = [(image.name, image.camera) for image in images]
        intrinsics = collection.cameras if collection.calibrated else submodel.intrinsics
        geometry = (submodel.seg_from_cam, intrinsics, submodel.tracks)
        frame = (type(world_from_seg).__name__, world_from_seg.matrix)
        inputs.append((submodel.name, *frame, submodel.images, names, geometry))
    return inputs


def _without_repeats(placed: Sequence[PlacedScene]) -> tuple[PlacedScene, ...]:
    """Largest first, without a small one all of whose images stand in larger ones."""
    kept: list[PlacedScene] = []
    seen: set[int] = set()
    for one in sorted(placed, key=lambda one: len(one.scene), reverse=True):
        if not set(one.scene.image_indices) <= seen:
            kept.append(one)
            seen |= set(one.scene.image_indices)
    return tuple(kept)


# ---------------------------------------------------------------------------- summaries
def summarise_graph(stitched: Stitched) -> GraphSummary:
    """What the optimiser did."""
    stitching, solution = stitched.stitching, stitched.stitching.solution
    return GraphSummary(
        num_nodes=sum(len(part.submodels) for part in stitching.parts),
        num_edges=stitching.num_edges,
        num_loops=sum(decision.accepted for decision in stitching.decisions),
        cost_before=solution.cost_before,
        cost_after=solution.cost_after,
        iterations=solution.iterations,
        stop_reason=solution.stop_reason,
        improved=solution.improved,
        unit_spread_percent=stitched.unit_spread_percent,
    )


def summarise_cameras(cameras: FusedCameras) -> CameraFusionSummary:
    """How well the submodels agree on the cameras of a scene."""
    shared = cameras.num_submodels > 1
    position, rotation_deg = 100 * cameras.position_spread[shared], cameras.rotation_spread_deg[shared]
    return CameraFusionSummary(
        num_shared=int(np.count_nonzero(shared)),
        num_dropped=int(cameras.num_dropped.sum()),
        median_position_spread_percent=float(np.median(position)) if shared.any() else math.nan,
        max_position_spread_percent=float(position.max()) if shared.any() else math.nan,
        median_rotation_spread_deg=float(np.median(rotation_deg)) if shared.any() else math.nan,
        max_rotation_spread_deg=float(rotation_deg.max()) if shared.any() else math.nan,
    )


def summarise_loops(plan: LoopPlan, stitching: Stitching, collection: ImageCollection) -> tuple[LoopSummary, ...]:
    """One per planned loop."""
    return tuple(
        LoopSummary(
            image_a=collection.images[loop.image_a].name,
            image_b=collection.images[loop.image_b].name,
            similarity=loop.similarity,
            segment_a=loop.segment_a,
            segment_b=loop.segment_b,
            segment=loop.segment.index,
            accepted=decision.accepted,
            reason=decision.reason,
            closure_sigmas=decision.closure_sigmas,
            weight=weight,
            gap_before_percent=100 * before.distance,
            gap_after_percent=100 * after.distance,
            turn_before_deg=before.turn_deg,
            turn_after_deg=after.turn_deg,
        )
        for loop, decision, weight, (before, after) in zip(
            plan.loops, stitching.decisions, stitching.loop_weights, stitching.gaps, strict=True
        )
    )
