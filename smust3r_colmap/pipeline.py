"""The method, section by section (S-MUSt3R, paper section III).

    import        images, their order, their cameras        importers.image_folder
    segment       overlapping windows (III-B)                segmentation.windows
    find loops    places the camera came back to (III-F)     loops
    reconstruct   every segment alone (III-A)                backbones
    align         segments that share images (III-C, III-E)  alignment.edges, confidence
    stitch        loops proven, all frames optimised (III-F) stitching, pose_graph
    place         every image once, its depth map            fusion
    refine        real tracks, bundle adjustment             refinement
    fuse          one cloud on the adjusted cameras          fusion
    export        COLMAP, database, trainer, dense, ...      exports

Every section that takes long leaves a finished stage in the run directory, so that a second start goes on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap

from smust3r_colmap.alignment.pairwise import align_submodels, candidate_pairs, needs_maps
from smust3r_colmap.backbones.base import Backbone, BackboneContext, BackboneFactory, BackboneResult
from smust3r_colmap.backbones.masked_maps import without_masked_depth
from smust3r_colmap.backbones.registry import make_backbone
from smust3r_colmap.colmap.model_files import MODEL_FILES, refuse_names_text_cannot_hold
from smust3r_colmap.config import RunConfig
from smust3r_colmap.dense.depth_consistency import depth_scales
from smust3r_colmap.dense.point_cloud import fuse_points
from smust3r_colmap.errors import (
    ConfigError,
    DegenerateAlignmentError,
    ReconstructionError,
)
from smust3r_colmap.execution.progress import Reporter
from smust3r_colmap.execution.stage_clock import StageClock, peak_memory_bytes
from smust3r_colmap.execution.task_pool import usable_cores
from smust3r_colmap.exporters.registry import FORMATS, FormatSettings, Outputs, write_where_possible
from smust3r_colmap.exporters.tum_trajectory import write_tum
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.groups import GROUPS
from smust3r_colmap.geometry.transform import Transform
from smust3r_colmap.importers.image_folder import (
    FolderScan,
    check_image_folder,
    check_masks_not_inside,
    check_output_not_inside,
    collection_from_scan,
)
from smust3r_colmap.importers.masks import masks_of, names_without_mask, with_masks
from smust3r_colmap.products import (
    EMPTY_CLOUD,
    DenseMaps,
    DepthMaps,
    Edges,
    ImageCollection,
    PointCloud,
    Scene,
    Segment,
    Submodel,
    largest_first,
)
from smust3r_colmap.refinement.stage import Refinement, refine
from smust3r_colmap.report.summary import (
    EdgeSummary,
    GraphSummary,
    ImageNote,
    LoopSummary,
    ModelSummary,
    RefinementStep,
    RefinementSummary,
    RunSummary,
    SegmentSummary,
)
from smust3r_colmap.segmentation.loop_segments import LoopPlan, plan_loops
from smust3r_colmap.segmentation.windows import plan_windows
from smust3r_colmap.stitching.camera_fusion import (
    FusedCameras,
    build_scene,
    depth_in_cameras,
    fuse_cameras,
    fuse_intrinsics,
)
from smust3r_colmap.stitching.resection import PlacedSubmodel, place_submodel
from smust3r_colmap.stitching.spanning_tree import ChainedPart
from smust3r_colmap.stitching.stitch import Stitching, stitch
from smust3r_colmap.storage.alignments import read_edges, write_edges
from smust3r_colmap.storage.atomic_write import write_atomically
from smust3r_colmap.storage.config_file import config_to_toml
from smust3r_colmap.storage.depth_maps import DepthMapWriter, StoredDepthMaps
from smust3r_colmap.storage.finished_run import FinishedRun, begin_stages, write_finished
from smust3r_colmap.storage.image_scan import scan_changed_files
from smust3r_colmap.storage.run_directory import RunDirectory, key_of, read_json, write_json
from smust3r_colmap.storage.scenes import read_scenes, write_scenes

NOT_LOOKED_FOR = LoopPlan(threshold=None, weak_threshold=None, neighbours=0, statistics=None)


def reconstruct(
    images: Path,
    output: Path,
    config: RunConfig,
    *,
    overwrite: bool = False,
    reporter: Reporter,
    factory: BackboneFactory = make_backbone,
) -> RunSummary:
    """From a folder of images to COLMAP models in ``output/sparse``.

    Args:
        images: folder with the photographs, in the natural order of their names.
        output: made when missing; what an earlier run finished there is used.
        overwrite: start over instead.
        reporter: told about every stage.
        factory: makes the backbone; by default the one that the configuration names.

    Raises:
        InputError: the images or the settings cannot be used.
        ReconstructionError: no segment came out.
        RunDirectoryError: the output folder cannot be used, is held by another run, or the disk refused.
    """
    check_output_not_inside(images, output)
    check_masks_not_inside(images, config.importing.masks)
    check_image_folder(images)
    with RunDirectory(output) as run:
        clock = StageClock(reporter)
        scan, collection = _import(images, config, run, clock, overwrite=overwrite)
        backbone = _backbone(factory, collection, config, run, clock)
        begin_stages(run, scan, overwrite=overwrite)
        windows = plan_windows(
            len(collection), segment_length=config.segmentation.segment_length, overlap=config.segmentation.overlap
        )
        plan = _find_loops(backbone, windows, config, run, clock)
        segments = (*windows, *(loop.segment for loop in plan.loops))
        result = backbone.reconstruct(segments, with_maps=_segments_with_maps(backbone, segments, config))
        result = without_masked_depth(result, collection)
        _refuse_nothing(result, collection)
        edges = _align(result, segments, config, run, clock)
        stitching = _stitch(result, edges, plan, config, run, clock)
        stitched = _place(result, segments, stitching.parts, collection, run, clock)
        refinement = _refine(stitched, result, windows, collection, config, run, clock)
        scenes = _fuse(refinement, stitched, result, segments, stitching.parts, config, run, clock)
        unclosed = _without_loops(result, segments, stitching, collection, clock)
        outputs = _export(scenes, stitched, refinement, unclosed, images, collection, config, run, clock)
        summary = _summarise(
            collection, segments, plan, result, edges, stitching, scenes, refinement, outputs, run, clock
        )
        write_json(run.root / "summary.json", summary.to_json_dict())
    return summary


def _import(
    images: Path, config: RunConfig, run: RunDirectory, clock: StageClock, *, overwrite: bool
) -> tuple[FolderScan, ImageCollection]:
    """Read the folder, and change nothing in the run's."""
    with clock.stage("import", total=1) as stage:
        scan = scan_changed_files(images, run, overwrite=overwrite, workers=config.workers)
        collection = collection_from_scan(scan, config.importing)
        if config.output.text:
            refuse_names_text_cannot_hold(image.name for image in collection.images)
        collection = masked_as_wanted(collection, config.importing.masks, clock)
        stage.advance()
    for rejected in collection.rejected:
        clock.warn(f"left out: {rejected.name} ({rejected.reason})")
    return scan, collection


def masked_as_wanted(collection: ImageCollection, masks: str, reporter: Reporter) -> ImageCollection:
    """With the masks of the folder ``masks``, where one is named; also for a model from elsewhere."""
    if not masks:
        return collection
    masked = with_masks(collection, Path(masks))
    if whole := names_without_mask(masked.images):
        reporter.warn(f"{len(whole)} of {len(masked)} images have no mask and are used as a whole, such as {whole[0]}")
    return masked


def _backbone(
    factory: BackboneFactory, collection: ImageCollection, config: RunConfig, run: RunDirectory, clock: StageClock
) -> Backbone:
    backbone = factory(
        BackboneContext(
            collection=collection,
            config=config,
            run=run,
            reporter=clock,
            workers=config.workers or usable_cores(),
        )
    )
    if config.alignment.alignment_source == "tracks" and not backbone.has_tracks:
        raise ConfigError(f"--alignment-source tracks: the backbone {backbone.name} has no tracks; take pointmaps")
    return backbone


def _find_loops(
    backbone: Backbone, windows: tuple[Segment, ...], config: RunConfig, run: RunDirectory, clock: StageClock
) -> LoopPlan:
    """Images that look alike though far apart in the sequence, and a segment for each such place."""
    settings = config.loop_closing
    if not settings.loops:
        return NOT_LOOKED_FOR
    descriptors = backbone.describe()
    stored = run.stage("loops", key=key_of("loops", descriptors, windows, settings))
    with clock.stage("loops", total=1) as stage:
        if stored.is_done:
            stage.skip(1)
        else:
            plan = plan_loops(
                descriptors,
                windows,
                similarity=settings.loop_similarity,
                min_candidates=settings.loop_min_candidates,
                min_distance=settings.loop_min_distance,
                half_width=settings.loop_half_width,
            )
            with stored.write() as folder:
                write_json(folder / "plan.json", plan.to_json())
            stage.advance()
    return LoopPlan.from_json(read_json(stored.path / "plan.json"))


def _segments_with_maps(backbone: Backbone, segments: tuple[Segment, ...], config: RunConfig) -> frozenset[int]:
    """Windows make the cloud; loops only tie the graph, and need maps where the edges are made of them."""
    source = config.alignment.alignment_source
    edges_from_maps = source == "pointmaps" or (source == "auto" and not backbone.has_tracks)
    return frozenset(segment.index for segment in segments if segment.kind == "window" or edges_from_maps)


def _refuse_nothing(result: BackboneResult, collection: ImageCollection) -> None:
    """Say what was tried when no segment gave a single submodel."""
    if result.submodels:
        return
    attempts = [f"segment {one.segment}: {'; '.join(one.attempts)}" for one in result.reconstructions]
    raise ReconstructionError(
        f"none of the {len(result.reconstructions)} segments ({len(collection)} images) could be reconstructed. "
        f"{'. '.join(attempts[:3])}. Do the images overlap, did the camera move, and are neighbours in name order "
        "neighbours in space?"
    )


def _align(
    result: BackboneResult, segments: tuple[Segment, ...], config: RunConfig, run: RunDirectory, clock: StageClock
) -> Edges:
    """Transforms between all submodels that have something in common (paper eqs. 1 to 3)."""
    loops = frozenset(segment.index for segment in segments if segment.kind == "loop")
    num_pairs = len(candidate_pairs(result.submodels, loops))
    geometry = [
        (submodel.name, submodel.images, submodel.seg_from_cam, submodel.tracks) for submodel in result.submodels
    ]
    maps = result.dense_key if needs_maps(result.submodels, config.alignment) else None
    inputs = (geometry, maps, result.matches, sorted(loops))
    stored = run.stage("alignment", key=key_of("alignment", inputs, config.alignment, config.seed))
    with clock.stage("alignment", total=num_pairs) as stage:
        if stored.is_done:
            stage.skip(num_pairs)
        else:
            edges = align_submodels(
                result.submodels,
                result.dense,
                result.matches,
                config.alignment,
                loop_segments=loops,
                seed=config.seed,
                advance=stage.advance,
            )
            with stored.write() as folder:
                write_edges(folder, edges)
    return _with_warnings(read_edges(stored.path), config, clock)


def _with_warnings(edges: Edges, config: RunConfig, clock: StageClock) -> Edges:
    fallen_back = [edge for edge in edges.alignments if edge.fallback]
    if fallen_back:
        clock.warn(
            f"{len(fallen_back)} of {len(edges.alignments)} edges are similarities instead of "
            f"{config.alignment.transform_group}, such as: {fallen_back[0].fallback}"
        )
    return edges


def _stitch(
    result: BackboneResult, edges: Edges, plan: LoopPlan, config: RunConfig, run: RunDirectory, clock: StageClock
) -> Stitching:
    """Loops proven or refused, one frame for whatever hangs together."""
    with clock.stage("pose graph", total=1) as stage:
        stitching = stitch(
            result.submodels,
            edges.alignments,
            plan.loops,
            group=GROUPS[config.alignment.transform_group],
            kernel=config.loop_closing.loop_kernel,
        )
        stage.advance()
    if not stitching.solution.improved and len(edges.alignments):
        clock.note(f"pose graph: {stitching.solution.stop_reason}")
    return stitching


@dataclass(frozen=True, kw_only=True)
class _Stitched:
    """The scenes as stitching placed them, without points, and the depth of their images."""

    scenes: tuple[Scene, ...]
    maps: StoredDepthMaps


def _place(
    result: BackboneResult,
    segments: tuple[Segment, ...],
    parts: tuple[ChainedPart, ...],
    collection: ImageCollection,
    run: RunDirectory,
    clock: StageClock,
) -> _Stitched:
    """Every image once, one camera set and one depth map for every connected part, largest first."""
    inputs = [
        [_scene_input(result.submodels[p], world_from, collection) for p, world_from in _members(part)]
        for part in parts
    ]
    kinds = [segment.kind for segment in segments]
    stored = run.stage("stitched", key=key_of("stitched", inputs, kinds, result.dense_key))
    with clock.stage("placing", total=len(parts)) as stage:
        if stored.is_done:
            stage.skip(len(parts))
        else:
            with stored.write() as folder:
                scenes = []
                maps = DepthMapWriter(folder)
                for part in sorted(parts, key=lambda part: -_num_images(part, result)):
                    placed = _placed_submodels(part, result, segments)
                    cameras = fuse_cameras(placed)
                    scenes.append(_scene(placed, cameras, EMPTY_CLOUD, result, collection))
                    for image, depth, confidence in depth_in_cameras(placed, _dense(part, result), cameras):
                        maps.write(collection.images[image].name, depth, confidence)
                    stage.advance()
                maps.finish()
                write_scenes(folder, _without_repeats(largest_first(scenes)))
    return _Stitched(scenes=read_scenes(stored.path), maps=StoredDepthMaps(stored.path))


def _refine(
    stitched: _Stitched,
    result: BackboneResult,
    windows: tuple[Segment, ...],
    collection: ImageCollection,
    config: RunConfig,
    run: RunDirectory,
    clock: StageClock,
) -> Refinement | None:
    """Tracks across the whole scene, and cameras adjusted to them; None where that was not wanted."""
    if not config.refinement.refine:
        return None
    return refine(
        stitched.scenes,
        collection,
        stitched.maps,
        result.features,
        config,
        run,
        clock,
        parts=[window.images for window in windows],
        maps_key=result.dense_key,
    )


def _fuse(
    refinement: Refinement | None,
    stitched: _Stitched,
    result: BackboneResult,
    segments: tuple[Segment, ...],
    parts: tuple[ChainedPart, ...],
    config: RunConfig,
    run: RunDirectory,
    clock: StageClock,
) -> tuple[Scene, ...]:
    """One cloud for every scene, hung on its cameras as they are now."""
    scenes = stitched.scenes if refinement is None else refinement.scenes
    inputs = [(scene.image_names, scene.cam_from_world, scene.cameras, scene.segments) for scene in scenes]
    stored = run.stage("scene", key=key_of("scene", inputs, result.dense_key, config.fusion))
    part_of = {tuple(result.submodels[p].name for p in part.submodels): part for part in parts}
    with clock.stage("fusion", total=len(scenes)) as stage:
        if stored.is_done:
            stage.skip(len(scenes))
            return read_scenes(stored.path)
        fused = []
        for number, scene in enumerate(scenes):
            part = part_of[scene.segments]
            placed = _placed_submodels(part, result, segments)
            cameras, scale = _cameras_of(scene, fuse_cameras(placed), number, refinement, stitched.maps)
            cloud = fuse_points(
                placed,
                _dense(part, result),
                cameras,
                max_points=config.fusion.max_points,
                min_confidence=config.fusion.min_confidence,
                depth_scale=scale,
            ).cloud
            fused.append(replace(scene, points=cloud))
            stage.advance()
        with stored.write() as folder:
            write_scenes(folder, tuple(fused))
    return tuple(fused)


def _cameras_of(
    scene: Scene, fused: FusedCameras, number: int, refinement: Refinement | None, maps: DepthMaps
) -> tuple[FusedCameras, FloatArray | None]:
    """The fused cameras with the poses of the scene, and what each depth map is to be multiplied with."""
    model = None if refinement is None else refinement.models[number]
    if model is None:
        return fused, None
    position = {image: k for k, image in enumerate(scene.image_indices)}
    poses = scene.cam_from_world[[position[image] for image in fused.images]]
    scales = depth_scales(pycolmap.Reconstruction(model), maps)
    return replace(fused, cam_from_world=poses), np.array([scales[image + 1] for image in fused.images])


def _dense(part: ChainedPart, result: BackboneResult) -> list[DenseMaps]:
    return [result.dense[p] for p in part.submodels]


def _num_images(part: ChainedPart, result: BackboneResult) -> int:
    return len({image for p in part.submodels for image in result.submodels[p].images})


def _placed_submodels(
    part: ChainedPart, result: BackboneResult, segments: tuple[Segment, ...]
) -> tuple[PlacedSubmodel, ...]:
    return tuple(
        place_submodel(
            result.submodels[p],
            result.dense[p],
            world_from_seg,
            is_loop=segments[result.submodels[p].segment].kind == "loop",
        )
        for p, world_from_seg in _members(part)
    )


def _scene(
    placed: tuple[PlacedSubmodel, ...],
    cameras: FusedCameras,
    cloud: PointCloud,
    result: BackboneResult,
    collection: ImageCollection,
) -> Scene:
    intrinsics = fuse_intrinsics(placed, [image.camera for image in collection.images])
    if collection.calibrated:
        intrinsics = {camera: collection.cameras[camera] for camera in intrinsics}
    metric = all(result.reconstructions[one.submodel.segment].metric for one in placed)
    return build_scene(collection, placed, cameras, intrinsics, cloud, metric=metric)


def _members(part: ChainedPart) -> list[tuple[int, Transform]]:
    return list(zip(part.submodels, part.world_from_seg, strict=True))


def _scene_input(submodel: Submodel, world_from_seg: Transform, collection: ImageCollection) -> tuple[object, ...]:
    """What a submodel puts into a scene besides its maps; the names too, for files may be renamed."""
    images = [collection.images[index] for index in submodel.images]
    names = [(image.name, image.camera) for image in images]
    intrinsics = collection.cameras if collection.calibrated else submodel.intrinsics
    geometry = (submodel.seg_from_cam, intrinsics, submodel.tracks)
    return submodel.name, type(world_from_seg).__name__, world_from_seg.matrix, submodel.images, names, geometry


def _without_repeats(scenes: tuple[Scene, ...]) -> tuple[Scene, ...]:
    """Leave out a small part all of whose images stand in larger ones."""
    kept: list[Scene] = []
    placed: set[int] = set()
    for scene in scenes:
        if not set(scene.image_indices) <= placed:
            kept.append(scene)
            placed |= set(scene.image_indices)
    return tuple(kept)


def _without_loops(
    result: BackboneResult,
    segments: tuple[Segment, ...],
    stitching: Stitching,
    collection: ImageCollection,
    clock: StageClock,
) -> Scene | None:
    """The cameras of the largest part as the chain alone puts them, to compare with.

    None where no loop was closed, or where the chain alone, in SL(4), sends a camera beyond infinity.
    """
    if not any(decision.accepted for decision in stitching.decisions):
        return None
    part = max(stitching.chained, key=lambda part: len({i for p in part.submodels for i in result.submodels[p].images}))
    try:
        placed = _placed_submodels(part, result, segments)
    except DegenerateAlignmentError as error:
        clock.note(f"no trajectory without loops: {error}")
        return None
    return _scene(placed, fuse_cameras(placed), EMPTY_CLOUD, result, collection)


def _export(
    scenes: tuple[Scene, ...],
    stitched: _Stitched,
    refinement: Refinement | None,
    unclosed: Scene | None,
    images: Path,
    collection: ImageCollection,
    config: RunConfig,
    run: RunDirectory,
    clock: StageClock,
) -> Outputs:
    """Every model for COLMAP; the other formats of the largest, and how its trajectory was before; what failed."""
    run.clear_results(MODEL_FILES)
    finished = FinishedRun(
        output=run.root,
        native_log=run.native_log,
        images=images,
        scenes=scenes,
        models=(None,) * len(scenes) if refinement is None else refinement.models,
        database=None if refinement is None or not any(refinement.models) else refinement.database,
        maps=stitched.maps,
        masks=masks_of(collection, config.importing.masks),
    )
    with clock.stage("export", total=1) as stage:
        settings = FormatSettings.of(config.output)
        for name in ("sparse", "ply", "glb", "tum", *(("database",) if finished.database else ())):
            FORMATS[name].write(finished, settings)
        write_tum(stitched.scenes[0], run.root / "trajectory_stitched_tum.txt", None)
        if unclosed is not None:
            write_tum(unclosed, run.root / "trajectory_without_loops_tum.txt", None)
        write_atomically(run.root / "config.toml", config_to_toml(config).encode())
        write_finished(run, finished)
        stage.advance()
    large = config.output.large_formats if finished.database else ()
    return write_where_possible(finished, large, settings, clock)


def _summarise(
    collection: ImageCollection,
    segments: tuple[Segment, ...],
    plan: LoopPlan,
    result: BackboneResult,
    edges: Edges,
    stitching: Stitching,
    scenes: tuple[Scene, ...],
    refinement: Refinement | None,
    outputs: Outputs,
    run: RunDirectory,
    clock: StageClock,
) -> RunSummary:
    placed = {image for scene in scenes for image in scene.image_indices}
    # Windows come first and have the last word.
    why = {left.image: left.reason for one in reversed(result.reconstructions) for left in one.unregistered}
    no_features = {one.name: one.reason for one in result.rejected}
    return RunSummary(
        output=run.root,
        num_images=len(collection),
        num_registered=len(placed),
        models=tuple(
            ModelSummary(
                folder=run.sparse_model(number).relative_to(run.root).as_posix(),
                num_images=len(scene),
                num_points=len(scene.points),
                metric=scene.metric,
                segments=scene.segments,
            )
            for number, scene in enumerate(scenes)
        ),
        rejected=tuple(ImageNote(name=one.name, reason=one.reason) for one in collection.rejected),
        unregistered=tuple(
            ImageNote(
                name=image.name,
                reason=no_features.get(image.name) or why.get(index, "its submodel was refused"),
            )
            for index, image in enumerate(collection.images)
            if index not in placed
        ),
        stages=tuple(clock.stages),
        segments=tuple(
            SegmentSummary(
                index=segment.index,
                kind=segment.kind,
                num_images=len(segment.images),
                num_submodels=len(one.submodels),
                num_registered=len({image for submodel in one.submodels for image in submodel.images}),
                method=one.submodels[0].method if one.submodels else "",
                warnings=one.warnings,
            )
            for segment, one in zip(segments, result.reconstructions, strict=True)
        ),
        edges=_edge_summaries(edges, [submodel.name for submodel in result.submodels]),
        loops=_loop_summaries(plan, stitching, collection),
        loops_note=plan.note,
        graph=GraphSummary(
            num_nodes=sum(len(part.submodels) for part in stitching.parts),
            num_edges=stitching.num_edges,
            num_loops=sum(decision.accepted for decision in stitching.decisions),
            cost_before=stitching.solution.cost_before,
            cost_after=stitching.solution.cost_after,
            iterations=stitching.solution.iterations,
            stop_reason=stitching.solution.stop_reason,
            improved=stitching.solution.improved,
        ),
        peak_memory_bytes=peak_memory_bytes(),
        refinements=() if refinement is None else refinement_summaries(refinement, collection, run),
        missing_outputs=outputs.missing,
        notes=outputs.notes,
    )


def refinement_summaries(
    refinement: Refinement, collection: ImageCollection, run: RunDirectory
) -> tuple[RefinementSummary, ...]:
    """One per scene; also for a model from elsewhere."""
    return tuple(
        RefinementSummary(
            folder=run.sparse_model(number).relative_to(run.root).as_posix(),
            kept=one.kept,
            reason=one.reason,
            num_points=one.final.num_points,
            num_observations=one.final.num_observations,
            mean_track_length=one.final.mean_track_length,
            reprojection_error_px=one.final.reprojection_error_px,
            num_pairs=one.num_pairs,
            num_matches=one.num_matches,
            num_refused_pairs=one.num_refused_pairs,
            weak=tuple(collection.images[i].name for i in one.weak),
            registered=tuple(collection.images[i].name for i in one.registered),
            principal_point=one.principal_point,
            warnings=one.warnings,
            steps=tuple(
                RefinementStep(
                    name=step.name,
                    observations_before=step.before.num_observations,
                    observations_after=step.after.num_observations,
                    error_before_px=step.before.reprojection_error_px,
                    error_after_px=step.after.reprojection_error_px,
                    track_length_before=step.before.mean_track_length,
                    track_length_after=step.after.mean_track_length,
                    images_before=step.before.num_images,
                    images_after=step.after.num_images,
                    moved_percent=step.moved_percent,
                    max_moved_percent=step.max_moved_percent,
                    turned_deg=step.turned_deg,
                    kept=step.kept,
                    reason=step.reason,
                )
                for step in one.steps
            ),
        )
        for number, one in enumerate(refinement.figures)
    )


def _edge_summaries(edges: Edges, names: list[str]) -> tuple[EdgeSummary, ...]:
    found = tuple(
        EdgeSummary(
            target=names[edge.target],
            source=names[edge.source],
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
            target=names[failure.target],
            source=names[failure.source],
            evidence=failure.evidence,
            relative_residual=math.nan,
            accepted=False,
            reason=failure.reason,
        )
        for failure in edges.failures
    )
    return found + not_found


def _loop_summaries(plan: LoopPlan, stitching: Stitching, collection: ImageCollection) -> tuple[LoopSummary, ...]:
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
            gap_before_percent=100 * before.distance,
            gap_after_percent=100 * after.distance,
            turn_before_deg=before.turn_deg,
            turn_after_deg=after.turn_deg,
        )
        for loop, decision, (before, after) in zip(plan.loops, stitching.decisions, stitching.gaps, strict=True)
    )
