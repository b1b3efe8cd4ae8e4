"""Real tracks and bundle adjustment for a model that another program made: the list of ``pipeline``, entered later.

    import    the model and its images, at full size        importers
    match     images whose surfaces nothing tells           features
    refine    as in a run of ours                           refinement
    carry     points without tracks, to the new cameras     dense.external_points
    export    as in a run of ours                           exporters
    report    what was done and how far to trust it         report

Exports of feed-forward networks have poses that are nearly right, cameras at the size of the network and no
tracks; here such a model takes the place of the stitched one. The next module to read is ``features.stage``.
"""

from __future__ import annotations

from pathlib import Path

from smust3r_colmap.config import RefineConfig, SegmentationConfig
from smust3r_colmap.dense.external_points import fuse_external
from smust3r_colmap.execution.progress import Reporter
from smust3r_colmap.execution.run_context import Run
from smust3r_colmap.execution.task_pool import num_workers
from smust3r_colmap.exporters import registry as exporters
from smust3r_colmap.exporters.finished_run import begin_stages
from smust3r_colmap.features.stage import match_external
from smust3r_colmap.importers import stage as importers
from smust3r_colmap.importers.colmap_model import read_colmap_model
from smust3r_colmap.refinement import stage as refinement
from smust3r_colmap.report import summarise as report
from smust3r_colmap.report.html import write_report
from smust3r_colmap.report.summary import RunSummary


def refine_model(
    model: Path,
    images: Path,
    output: Path,
    config: RefineConfig,
    *,
    overwrite: bool = False,
    reporter: Reporter,
) -> RunSummary:
    """From a COLMAP model of poor poses to one with tracks in ``output/sparse/0``, and a database that goes with it.

    Args:
        model: folder of the model; it is only read.
        images: folder of its images.
        output: made when missing; what an earlier start finished there is used.
        config: what becomes of the cameras, how far the poses may be off, and the settings of the stages. With
            ``register_missing`` images of the folder that the model lacks are tried, too.
        overwrite: start over.
        reporter: told about every stage.

    Raises:
        InputError: the model, the images or the settings cannot be used.
        RunDirectoryError: the output folder cannot be used, is held by another run, or the disk refused.
    """
    importers.check_folders(images, output, config.masks)
    external = read_colmap_model(model)
    importers.check_model_is_kept(external.folder, output)
    with Run.open(output, workers=num_workers(config.workers), seed=config.seed, reporter=reporter) as run:
        scan, fitted = importers.fit_model(run, external, images, config, overwrite=overwrite)
        begin_stages(run, scan, overwrite=overwrite)
        start = fitted.scene(origin=external.folder.name)
        features = match_external(
            run, fitted.collection, start, config.features, per_image=config.refinement.track_neighbours
        )
        initial = refinement.InitialScenes.of_external(
            start, fitted.seen_by_tracks(), SegmentationConfig(), tolerance=config.pose_tolerance
        )
        refined = refinement.refine_external(
            run, initial, fitted.collection, features, config.refinement, config.features
        )
        fused = fuse_external(run, start, fitted.untracked_points, refined)
        outputs = exporters.export(run, (fused,), refined, initial, images, fitted.collection, config, before={})
        summary = report.refined_model(run, fitted, features, refined, fused, outputs, config)
        write_report(run, images, config.output)
        return summary
