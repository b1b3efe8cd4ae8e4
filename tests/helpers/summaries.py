"""The summary of a run that ended well."""

from __future__ import annotations

from pathlib import Path

from smust3r_colmap.alignment.stage import EdgeSummary
from smust3r_colmap.backbones.stage import SegmentSummary
from smust3r_colmap.execution.stage_clock import StageSummary
from smust3r_colmap.report.summary import ModelSummary, RunSummary
from smust3r_colmap.stitching.stage import GraphSummary

GOOD = RunSummary(
    output=Path("out"),
    num_images=5,
    num_registered=5,
    models=(
        ModelSummary(
            folder="sparse/0", num_images=5, num_points=100, metric=False, segments=("0", "1"), cameras=None, cloud=None
        ),
    ),
    rejected=(),
    unregistered=(),
    stages=(
        StageSummary(name="features", wall_s=1.0, cpu_s=1.5, reused=False),
        StageSummary(name="alignment", wall_s=0.2, cpu_s=0.1, reused=True),
    ),
    segments=(
        SegmentSummary(index=0, kind="window", num_images=4, num_submodels=1, num_registered=4, method="mapping"),
    ),
    edges=(EdgeSummary(target="0", source="1", evidence="tracks", relative_residual=0.01, accepted=True),),
    loops=(),
    loops_note="",
    graph=GraphSummary(
        num_nodes=2,
        num_edges=1,
        num_loops=0,
        cost_before=0.0,
        cost_after=0.0,
        iterations=0,
        stop_reason="nothing to do",
        improved=False,
    ),
    peak_memory_bytes=3 * 2**29,
)
