"""The method, section by section (S-MUSt3R, paper section III).

    import        images, their order, their cameras         importers
    segment       windows and loop segments (III-B, III-F)   segmentation
    reconstruct   every segment alone (III-A)                backbones
    align         submodels that share images (III-C, III-E) alignment
    stitch        loops verified, frames optimised (III-F)   stitching
    refine        real tracks, bundle adjustment             refinement
    fuse          one cloud on the adjusted cameras          dense
    export        COLMAP, database, trainer, dense, ...      exporters
    report        what was done and how far to trust it      report

Every stage leaves its product in the run's folder, so that a second start goes on. ``refine_model`` is the same list
for a model of another program, entered at ``refine``. The next module to read is ``segmentation.stage``.
"""

from __future__ import annotations

from pathlib import Path

from smust3r_colmap.alignment import stage as alignment
from smust3r_colmap.backbones import stage as backbones
from smust3r_colmap.backbones.base import BackboneFactory
from smust3r_colmap.backbones.registry import make_backbone
from smust3r_colmap.config import RunConfig
from smust3r_colmap.dense import stage as dense
from smust3r_colmap.execution.progress import Reporter
from smust3r_colmap.execution.run_context import Run
from smust3r_colmap.execution.task_pool import num_workers
from smust3r_colmap.exporters import registry as exporters
from smust3r_colmap.exporters.finished_run import begin_stages
from smust3r_colmap.importers import stage as importers
from smust3r_colmap.refinement import stage as refinement
from smust3r_colmap.report import summarise as report
from smust3r_colmap.report.html import failure_reported, write_report
from smust3r_colmap.report.summary import RunSummary
from smust3r_colmap.segmentation import stage as segmentation
from smust3r_colmap.stitching import stage as stitching


def reconstruct(
    images: Path,
    output: Path,
    config: RunConfig,
    *,
    overwrite: bool = False,
    reporter: Reporter,
    factory: BackboneFactory = make_backbone,
) -> RunSummary:
    """From images or videos to COLMAP models in ``output/sparse``.

    Args:
        images: folder with photographs, in the natural order of their names, and videos; or a video.
        output: made when missing; what an earlier run finished there is used.
        overwrite: start over instead.
        reporter: told about every stage.
        factory: makes the backbone; by default the one that the configuration names.

    Raises:
        InputError: the images or the settings cannot be used.
        ReconstructionError: no segment came out.
        RunDirectoryError: the output folder cannot be used, is held by another run, or the disk refused.
    """
    importers.check_folders(images, output, config.masks)
    with Run.open(output, workers=num_workers(config.workers), seed=config.seed, reporter=reporter) as run:
        source = importers.take_frames(run, images, config, overwrite=overwrite)
        scan, collection = importers.read_images(run, source, config, overwrite=overwrite)
        collection = segmentation.with_keyframes(run, collection, config, overwrite=overwrite)
        backbone = backbones.make(run, factory, collection, config)
        begin_stages(run, scan, overwrite=overwrite)
        segments = segmentation.plan(run, collection, backbone.describe, config)
        with failure_reported(run, collection, config.output):
            submodels = backbones.reconstruct(backbone, segments, collection, config.alignment)
        edges = alignment.align(run, submodels, segments, config.alignment)
        stitched = stitching.stitch(run, submodels, edges, segments, collection, config.alignment, config.loop_closing)
        initial = refinement.InitialScenes.of(stitched, segments, maps_key=submodels.dense_key)
        refined = refinement.refine(run, initial, collection, submodels.features, config.refinement, config.features)
        fused = dense.fuse(run, submodels, segments, stitched, refined, config.fusion)
        initial = dense.with_depth_of_others(run, initial, segments, refined)
        outputs = exporters.export(
            run, fused, refined, initial, source.folder, collection, config, before=stitched.before
        )
        summary = report.reconstruction(run, collection, segments, submodels, edges, stitched, refined, fused, outputs)
        write_report(run, source.folder, config.output)
        return summary
