"""The method, section by section (S-MUSt3R, paper section III).

    import        images, their order, their cameras        importers.image_folder
    segment       overlapping windows (III-B)                segmentation.windows
    reconstruct   every segment alone (III-A)                backbones
    align         neighbouring segments (III-C, III-E)       alignment.edges, confidence
    chain         one frame for what hangs together          chaining
    fuse          every image once, one cloud                fusion
    export        COLMAP, PLY, GLB, TUM                      exporters

Every section leaves a finished stage in the run directory, so that a second start goes on.
"""

from __future__ import annotations

from pathlib import Path

from smust3r_colmap import fusion
from smust3r_colmap.alignment.edges import Edges, align_pieces, candidate_pairs, needs_maps
from smust3r_colmap.backbones.base import Backbone, BackboneResult
from smust3r_colmap.backbones.classical.backbone import ClassicalBackbone
from smust3r_colmap.chaining import ChainedPart, chain_pieces
from smust3r_colmap.config import RunConfig
from smust3r_colmap.config_file import config_to_toml
from smust3r_colmap.errors import ReconstructionError
from smust3r_colmap.execution import usable_cores
from smust3r_colmap.exporters.aside import replace_file
from smust3r_colmap.exporters.colmap_sparse import MODEL_FILES, refuse_names_text_cannot_hold, write_colmap_sparse
from smust3r_colmap.exporters.glb import write_glb
from smust3r_colmap.exporters.ply import write_ply
from smust3r_colmap.exporters.tum_trajectory import write_tum
from smust3r_colmap.geometry.sim3 import Sim3
from smust3r_colmap.importers.image_folder import (
    ImportRecord,
    check_output_not_inside,
    collection_from_scan,
    scan_image_folder,
)
from smust3r_colmap.products import ImageCollection, Scene, Segment, SegmentPiece, largest_first
from smust3r_colmap.progress import Reporter
from smust3r_colmap.run_directory import RunDirectory, key_of, read_json, write_json
from smust3r_colmap.segmentation.windows import plan_windows
from smust3r_colmap.stage_clock import StageClock, peak_memory_bytes
from smust3r_colmap.stored_alignment import read_edges, write_edges
from smust3r_colmap.stored_scene import read_scenes, write_scenes
from smust3r_colmap.summary import EdgeSummary, ImageRemark, ModelSummary, RunSummary, SegmentSummary


def reconstruct(
    images: Path, output: Path, config: RunConfig, *, fresh: bool = False, reporter: Reporter
) -> RunSummary:
    """From a folder of images to COLMAP models in ``output/sparse``.

    Args:
        images: folder with the photographs, in the natural order of their names.
        output: made when missing; what an earlier run finished there is used.
        fresh: start over instead.
        reporter: told about every stage.

    Raises:
        InputError: the images or the settings cannot be used.
        ReconstructionError: no segment came out.
        RunDirectoryError: the output folder cannot be used, is held by another run, or the disk refused.
    """
    check_output_not_inside(images, output)
    with RunDirectory(output, fresh=fresh) as run:
        clock = StageClock(reporter)
        collection = _import(images, config, run, clock)
        segments = plan_windows(
            len(collection), segment_length=config.segmentation.segment_length, overlap=config.segmentation.overlap
        )
        result = _backbone(config).reconstruct(collection, segments, run, clock)
        _refuse_nothing(result, collection)
        edges = _align(result, config, run, clock)
        parts = chain_pieces(len(result.pieces), edges.alignments)
        scenes = _fuse(result, parts, collection, config, run, clock)
        _export(scenes, config, run, clock)
        summary = _summarise(collection, segments, result, edges, scenes, run, clock)
        write_json(run.root / "summary.json", summary.to_json_dict())
    return summary


def _import(images: Path, config: RunConfig, run: RunDirectory, clock: StageClock) -> ImageCollection:
    """Read the folder; files that did not change since an earlier start are not decoded again."""
    stored = run.stage("import", key=key_of("import"))
    with clock.stage("import", total=1) as stage:
        known = {}
        if stored.is_done:
            records = (ImportRecord.from_json(facts) for facts in read_json(stored.path / "records.json"))
            known = {record.name: record for record in records}
        scan = scan_image_folder(images, known=known, workers=config.workers)
        with stored.write() as folder:
            write_json(folder / "records.json", [record.to_json() for record in scan.records])
        collection = collection_from_scan(scan, config.importing)
        if config.output.text:
            refuse_names_text_cannot_hold(image.name for image in collection.images)
        stage.advance()
    for rejected in collection.rejected:
        clock.warn(f"left out: {rejected.name} ({rejected.reason})")
    return collection


def _backbone(config: RunConfig) -> Backbone:
    return ClassicalBackbone(config.classical, workers=config.workers or usable_cores(), seed=config.seed)


def _refuse_nothing(result: BackboneResult, collection: ImageCollection) -> None:
    """Say what was tried when no segment gave a single piece."""
    if result.pieces:
        return
    attempts = [f"segment {one.segment}: {'; '.join(one.attempts)}" for one in result.reconstructions]
    raise ReconstructionError(
        f"none of the {len(result.reconstructions)} segments ({len(collection)} images) could be reconstructed. "
        f"{'. '.join(attempts[:3])}. Do the images overlap, and are neighbours in name order neighbours in space?"
    )


def _align(result: BackboneResult, config: RunConfig, run: RunDirectory, clock: StageClock) -> Edges:
    """Sim(3) between all pieces that have something in common (paper eqs. 1 and 2)."""
    geometry = [(piece.name, piece.images, piece.seg_from_cam, piece.tracks) for piece in result.pieces]
    maps = result.dense_key if needs_maps(result.pieces, config.alignment) else None
    inputs = (geometry, maps, result.links)
    stored = run.stage("alignment", key=key_of("alignment", inputs, config.alignment, config.seed))
    with clock.stage("alignment", total=len(candidate_pairs(result.pieces))) as stage:
        if stored.is_done:
            stage.skip(len(candidate_pairs(result.pieces)))
        else:
            edges = align_pieces(
                result.pieces, result.dense, result.links, config.alignment, seed=config.seed, advance=stage.advance
            )
            with stored.write() as folder:
                write_edges(folder, edges)
    return read_edges(stored.path)


def _fuse(
    result: BackboneResult,
    parts: tuple[ChainedPart, ...],
    collection: ImageCollection,
    config: RunConfig,
    run: RunDirectory,
    clock: StageClock,
) -> tuple[Scene, ...]:
    """Every image once, one camera set and one cloud for every connected part, largest first."""
    inputs = [
        [_scene_input(result.pieces[p], world_from, collection) for p, world_from in _members(part)] for part in parts
    ]
    stored = run.stage("scene", key=key_of("scene", inputs, result.dense_key, config.fusion))
    camera_of_image = [image.camera for image in collection.images]
    with clock.stage("fusion", total=len(parts)) as stage:
        if stored.is_done:
            stage.skip(len(parts))
            return read_scenes(stored.path)
        scenes = []
        for part in parts:
            pieces = [result.pieces[p] for p in part.pieces]
            cameras = fusion.fuse_cameras(pieces, part.world_from_seg)
            cloud = fusion.fuse_points(
                pieces,
                [result.dense[p] for p in part.pieces],
                part.world_from_seg,
                cameras,
                max_points=config.fusion.max_points,
                min_confidence=config.fusion.min_confidence,
            ).cloud
            intrinsics = fusion.fuse_intrinsics(pieces, camera_of_image)
            metric = all(result.reconstructions[piece.segment].metric for piece in pieces)
            scenes.append(fusion.build_scene(collection, pieces, cameras, intrinsics, cloud, metric=metric))
            stage.advance()
        kept = _without_repeats(largest_first(scenes))
        with stored.write() as folder:
            write_scenes(folder, kept)
    return kept


def _members(part: ChainedPart) -> list[tuple[int, Sim3]]:
    return list(zip(part.pieces, part.world_from_seg, strict=True))


def _scene_input(piece: SegmentPiece, world_from_seg: Sim3, collection: ImageCollection) -> tuple[object, ...]:
    """What a piece puts into a scene besides its maps; the names too, for files may be renamed."""
    images = [collection.images[index] for index in piece.images]
    names = [(image.name, image.camera) for image in images]
    return piece.name, world_from_seg.matrix, piece.images, names, piece.seg_from_cam, piece.intrinsics


def _without_repeats(scenes: tuple[Scene, ...]) -> tuple[Scene, ...]:
    """Leave out a small part all of whose images stand in larger ones."""
    kept: list[Scene] = []
    placed: set[int] = set()
    for scene in scenes:
        if not set(scene.image_indices) <= placed:
            kept.append(scene)
            placed |= set(scene.image_indices)
    return tuple(kept)


def _export(scenes: tuple[Scene, ...], config: RunConfig, run: RunDirectory, clock: StageClock) -> None:
    """Every model for COLMAP; cloud, viewer file and trajectory of the largest."""
    with clock.stage("export", total=len(scenes)) as stage:
        run.clear_results(MODEL_FILES)
        for number, scene in enumerate(scenes):
            write_colmap_sparse(scene, run.sparse_model(number), text=config.output.text)
            stage.advance()
        write_ply(scenes[0].points, run.root / "points.ply")
        write_glb(scenes[0], run.root / "scene.glb")
        write_tum(scenes[0], run.root / "trajectory_tum.txt", None)
        replace_file(run.root / "config.toml", config_to_toml(config).encode())


def _summarise(
    collection: ImageCollection,
    segments: tuple[Segment, ...],
    result: BackboneResult,
    edges: Edges,
    scenes: tuple[Scene, ...],
    run: RunDirectory,
    clock: StageClock,
) -> RunSummary:
    placed = {image for scene in scenes for image in scene.image_indices}
    why = {left.image: left.reason for one in result.reconstructions for left in one.unregistered}
    no_features = {one.name: one.reason for one in result.rejected}
    names = [piece.name for piece in result.pieces]
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
        rejected=tuple(ImageRemark(name=one.name, reason=one.reason) for one in collection.rejected),
        unregistered=tuple(
            ImageRemark(
                name=image.name,
                reason=no_features.get(image.name) or why.get(index, "its segment piece was refused"),
            )
            for index, image in enumerate(collection.images)
            if index not in placed
        ),
        stages=tuple(clock.stages),
        segments=tuple(
            SegmentSummary(
                index=segment.index,
                num_images=len(segment.images),
                num_pieces=len(one.pieces),
                num_registered=len({image for piece in one.pieces for image in piece.images}),
                method=one.pieces[0].method if one.pieces else "",
            )
            for segment, one in zip(segments, result.reconstructions, strict=True)
        ),
        edges=tuple(
            EdgeSummary(
                target=names[edge.target],
                source=names[edge.source],
                relative_residual=edge.relative_residual,
                accepted=edge.accepted,
                reason=edge.reason,
            )
            for edge in edges.alignments
        )
        + tuple(
            EdgeSummary(
                target=names[failure.target],
                source=names[failure.source],
                relative_residual=float("nan"),
                accepted=False,
                reason=failure.reason,
            )
            for failure in edges.failures
        ),
        peak_memory_bytes=peak_memory_bytes(),
    )
