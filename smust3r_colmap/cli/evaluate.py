"""``smust3r-colmap evaluate``: how far are poses, and a cloud, from a reference?

The work is done in the package ``evaluation``, which is imported when the command runs, so that ``--help`` answers at
once.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from smust3r_colmap.cli.console import reporting
from smust3r_colmap.config import Auto, EvaluateConfig, PoseLayout
from smust3r_colmap.errors import ConfigError
from smust3r_colmap.report.summary import EXIT_DEGRADED, EXIT_GOOD

if TYPE_CHECKING:
    from smust3r_colmap.geometry.arrays import FloatArray
    from smust3r_colmap.importers.workspace_depth import DenseWorkspace


@dataclass(frozen=True, kw_only=True)
class Evaluate:
    """Compare camera poses with a reference: absolute, relative and pairwise errors, scale, clouds, predicted errors.

    Exit code 0: compared; 3: compared, but a warning says which figures are missing or not to be believed; 1: the poses
    do not determine what was asked for (fewer than three in common, all in one place); 2: wrong use, or a file that is
    not as it should be.
    """

    estimate: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="ESTIMATE")]
    """A run, a COLMAP model, or a trajectory."""
    reference: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="REFERENCE")]
    """A sequence of TUM RGB-D, ETH3D-SLAM, 7-Scenes, KITTI or EuRoC, a trajectory, poses.txt, or a COLMAP model."""
    estimate_layout: PoseLayout | Auto = "auto"
    """Of ESTIMATE; auto tells it from the files."""
    reference_layout: PoseLayout | Auto = "auto"
    """Of REFERENCE."""
    cloud: Annotated[Path | None, tyro.conf.arg(metavar="FILE.ply")] = None
    """Point cloud in the world of the estimate."""
    reference_cloud: Annotated[Path | None, tyro.conf.arg(metavar="FILE.ply")] = None
    """Point cloud in the world of the reference, to compare the other with."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Write all rows there as JSON."""
    csv: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Write all rows there as CSV."""
    quiet: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print warnings and errors only."""
    verbose: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print what was repaired on reading, and the traceback of an unexpected error."""
    settings: Annotated[EvaluateConfig, tyro.conf.OmitArgPrefixes, tyro.conf.arg(name="")] = field(
        default_factory=EvaluateConfig
    )


def run_evaluate(command: Evaluate) -> int:
    """Print the tables and write the files; the exit code.

    Raises:
        InputError: a file is not as it should be, or an option makes no sense.
        DegenerateAlignmentError: the poses do not determine what was asked for.
    """
    from smust3r_colmap.evaluation.evaluate import evaluate  # noqa: PLC0415  (heavy: --help shall not pay)
    from smust3r_colmap.evaluation.table import render_csv, render_json, render_text  # noqa: PLC0415
    from smust3r_colmap.importers.pose_layouts import read_pose_sets  # noqa: PLC0415
    from smust3r_colmap.storage.atomic_write import write_atomically  # noqa: PLC0415

    if (command.cloud is None) != (command.reference_cloud is None):
        raise ConfigError("--cloud and --reference-cloud: give both or neither")
    with reporting(quiet=command.quiet, verbose=command.verbose) as reporter:
        models, (reference, *_) = (
            read_pose_sets(path, None if layout == "auto" else layout)
            for path, layout in (
                (command.estimate, command.estimate_layout),
                (command.reference, command.reference_layout),
            )
        )
        found = evaluate(
            models,
            reference,
            command.settings,
            sigmas=_sigmas(models[0].place),
            clouds=_clouds(command),
            workspace=_workspace(models[0].place),
        )
        for file, render in ((command.json, render_json), (command.csv, render_csv)):
            if file is not None:
                write_atomically(file, render(found).encode())
        for warning in found.warnings:
            reporter.warn(warning)
        if not command.quiet:
            print(render_text(found))
        return EXIT_DEGRADED if found.warnings else EXIT_GOOD


def _sigmas(model: Path) -> dict[str, float] | None:
    """Predicted errors that lie beside the models of a run."""
    from smust3r_colmap.importers.uncertainty_table import read_position_sigmas  # noqa: PLC0415
    from smust3r_colmap.storage.run_directory import UNCERTAINTY_FILE  # noqa: PLC0415

    table = model.parent.parent / UNCERTAINTY_FILE
    return read_position_sigmas(table, f"{model.parent.name}/{model.name}") if table.is_file() else None


def _workspace(model: Path) -> DenseWorkspace | None:
    """The dense workspace that the model is of, or that a run has beside its largest model."""
    from smust3r_colmap.importers.workspace_depth import DenseWorkspace  # noqa: PLC0415

    places = [model.parent, *([model.parent.parent / "dense"] if model.name == "0" else [])]
    return next((DenseWorkspace.open(one) for one in places if (one / "stereo/depth_maps").is_dir()), None)


def _clouds(command: Evaluate) -> tuple[FloatArray, FloatArray] | None:
    from smust3r_colmap.importers.ply_points import read_ply_points  # noqa: PLC0415

    if command.cloud is None or command.reference_cloud is None:
        return None
    return read_ply_points(command.cloud), read_ply_points(command.reference_cloud)
