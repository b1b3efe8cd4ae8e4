"""The summary of a run, joined from what each stage says of its product, and written beside the result.

The next module to read is ``summary``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import pycolmap

from smust3r_colmap.alignment.stage import summarise_edges
from smust3r_colmap.backbones.base import BackboneResult
from smust3r_colmap.backbones.stage import summarise_segments
from smust3r_colmap.config import RefineConfig
from smust3r_colmap.execution.run_context import Run
from smust3r_colmap.execution.stage_clock import peak_memory_bytes
from smust3r_colmap.exporters.registry import Outputs
from smust3r_colmap.importers.fitted_model import FittedModel
from smust3r_colmap.products import Edges, FusedScene, ImageCollection, RunFeatures
from smust3r_colmap.refinement.stage import Refinement
from smust3r_colmap.report.summary import ImageNote, ModelSummary, RunSummary
from smust3r_colmap.segmentation.stage import Segments
from smust3r_colmap.stitching.stage import (
    CameraFusionSummary,
    Stitched,
    summarise_cameras,
    summarise_graph,
    summarise_loops,
)
from smust3r_colmap.storage.run_directory import write_json

SUMMARY_FILE = "summary.json"
SEGMENTS_FILE = "segments.json"
"""In ``work``: image indices of each window or cluster."""


def reconstruction(
    run: Run,
    collection: ImageCollection,
    segments: Segments,
    result: BackboneResult,
    edges: Edges,
    stitched: Stitched,
    refinement: Refinement | None,
    fused: Sequence[FusedScene],
    outputs: Outputs,
) -> RunSummary:
    """What came out of ``pipeline.reconstruct``; also as ``summary.json``."""
    # Windows come first and have the last word.
    reasons = dict.fromkeys(segments.others, "no pose was found that its matches with keyframes agree with")
    reasons |= dict.fromkeys(segments.unconnected, "matches too few other images")
    reasons |= {left.image: left.reason for one in reversed(result.reconstructions) for left in one.unregistered}
    no_features = {one.name: one.reason for one in result.rejected}
    placed = _registered(fused)
    summary = RunSummary(
        output=run.folder.root,
        num_images=len(collection),
        num_registered=len(placed),
        models=_models(run, fused, [summarise_cameras(one.cameras) for one in stitched.placed], refinement),
        rejected=_rejected(collection),
        unregistered=tuple(
            ImageNote(
                name=image.name,
                reason=no_features.get(image.name) or reasons.get(index, "its submodel was refused"),
            )
            for index, image in enumerate(collection.images)
            if index not in placed
        ),
        stages=tuple(run.clock.stages),
        segments=summarise_segments(segments, result),
        edges=summarise_edges(edges, result.submodels),
        loops=summarise_loops(segments.loops, stitched.stitching, collection),
        loops_note=segments.loops.note,
        num_keyframes=len(collection) - len(segments.others),
        order=segments.order,
        graph=summarise_graph(stitched),
        peak_memory_bytes=peak_memory_bytes(),
        refinements=() if refinement is None else refinement.results,
        missing_outputs=outputs.missing,
        notes=outputs.notes,
    )
    write_json(run.folder.work / SEGMENTS_FILE, [window.images for window in segments.windows])
    return _written(run, summary, {})


def refined_model(
    run: Run,
    fitted: FittedModel,
    features: RunFeatures,
    refinement: Refinement,
    fused: FusedScene,
    outputs: Outputs,
    settings: RefineConfig,
) -> RunSummary:
    """What came out of ``refine_model``, in the same form; nothing was segmented or stitched there."""
    placed = _registered([fused])
    is_refined = any(refinement.models)
    summary = RunSummary(
        output=run.folder.root,
        num_images=len(fitted.collection),
        num_registered=len(placed),
        models=_models(run, [fused], [None], refinement),
        rejected=_rejected(fitted.collection),
        unregistered=_unplaced(fitted.collection, placed, features, is_refined=is_refined),
        stages=tuple(run.clock.stages),
        segments=(),
        edges=(),
        loops=(),
        loops_note="",
        graph=None,
        peak_memory_bytes=peak_memory_bytes(),
        refinements=refinement.results,
        missing_outputs=outputs.missing,
        notes=(*_note_on_points(fitted, is_refined=is_refined), *outputs.notes),
    )
    return _written(run, summary, {"model_notes": fitted.notes, "settings": settings})


def _written(run: Run, summary: RunSummary, more: Mapping[str, Any]) -> RunSummary:
    write_json(run.folder.root / SUMMARY_FILE, {**summary.to_json_dict(), **more})
    return summary


def _registered(fused: Sequence[FusedScene]) -> set[int]:
    return {image for one in fused for image in one.scene.image_indices}


def _models(
    run: Run,
    fused: Sequence[FusedScene],
    cameras: Sequence[CameraFusionSummary | None],
    refinement: Refinement | None,
) -> tuple[ModelSummary, ...]:
    uncertainties = (None,) * len(fused) if refinement is None else refinement.summarised_uncertainties
    return tuple(
        ModelSummary(
            folder=run.folder.sparse_model(number).relative_to(run.folder.root).as_posix(),
            num_images=len(one.scene),
            num_points=len(one.scene.points),
            metric=one.scene.metric,
            segments=one.scene.segments,
            cameras=fusion,
            cloud=one.statistics,
            uncertainty=uncertainty,
        )
        for number, (one, fusion, uncertainty) in enumerate(zip(fused, cameras, uncertainties, strict=True))
    )


def _rejected(collection: ImageCollection) -> tuple[ImageNote, ...]:
    return tuple(ImageNote(name=one.name, reason=one.reason) for one in collection.rejected)


def _unplaced(
    collection: ImageCollection, placed: set[int], features: RunFeatures, *, is_refined: bool
) -> tuple[ImageNote, ...]:
    """The images of an external model's folder without a pose, and why they have none."""
    unreadable = {one.name: one.reason for one in features.rejected}
    notes = []
    with pycolmap.Database.open(features.database) as database:
        for index, image in enumerate(collection.images):
            if index in placed:
                continue
            if image.name in unreadable:
                reason = unreadable[image.name]
            elif not database.num_keypoints_for_image(index + 1):
                reason = "no features were found in it"
            elif not is_refined:
                reason = "the model could not be refined, and images are placed by its tracks"
            else:
                reason = "no pose was found that its matches agree with"
            notes.append(ImageNote(name=image.name, reason=reason))
    return tuple(notes)


def _note_on_points(fitted: FittedModel, *, is_refined: bool) -> tuple[str, ...]:
    untracked = len(fitted.untracked_points)
    if not untracked or not is_refined:
        return ()
    return (
        f"points.ply: {untracked} points of the given model have no track; they were moved with the cameras as a whole "
        "and are not in sparse/0",
    )
