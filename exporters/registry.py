"""All output formats of a finished run, by name, for ``reconstruct`` and ``export``.

A format is a function from a finished run to files in its output folder; a new one is an entry of ``FORMATS``. The
next module to read is the exporter of the format in ``exporters``.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import pycolmap

from smust3r_colmap.colmap.model_files import MODEL_FILES, refuse_names_text_cannot_hold, write_text_checked
from smust3r_colmap.config import ModelOutputConfig, OutputConfig, RefineConfig, RunConfig
from smust3r_colmap.errors import InputError, MissingDependencyError, ReconstructionError
from smust3r_colmap.execution.run_context import Run
from smust3r_colmap.execution.stage_clock import StageClock
from smust3r_colmap.exporters.colmap_sparse import write_colmap_sparse
from smust3r_colmap.exporters.dense_workspace import write_dense_workspace
from smust3r_colmap.exporters.finished_run import FinishedRun, write_finished
from smust3r_colmap.exporters.glb import write_glb
from smust3r_colmap.exporters.mesh import MeshMethod, write_mesh
from smust3r_colmap.exporters.ply import write_ply
from smust3r_colmap.exporters.poses_uncertainty import write_uncertainty
from smust3r_colmap.exporters.training_dataset import write_training_dataset
from smust3r_colmap.exporters.tum_trajectory import times_of, write_tum
from smust3r_colmap.importers.masks import masks_of
from smust3r_colmap.products import FusedScene, ImageCollection, Scene
from smust3r_colmap.refinement.stage import InitialScenes, Refinement
from smust3r_colmap.storage.atomic_write import atomic_file, atomic_folder, write_atomically
from smust3r_colmap.storage.config_file import config_to_toml
from smust3r_colmap.storage.run_directory import UNCERTAINTY_FILE

TRAINER_FOLDER, DENSE_FOLDER, DATABASE_FILE = "trainer", "dense", "database.db"
_NAMES_SHOWN = 3


@dataclass(frozen=True, kw_only=True)
class FormatSettings:
    """Settings of the formats; the names are those of ``config.OutputConfig``.

    Args:
        text: models as .txt, too.
        trainer_scales: smaller copies of the trainer's images.
        masks: a folder of masks for the trainer; None takes those of the run, if it had any.
        keep_outliers: the trainer gets cameras and points far from all others, too.
        mesh: how the mesh is made.
    """

    text: bool = False
    trainer_scales: tuple[int, ...] = ()
    masks: Path | None = None
    keep_outliers: bool = False
    mesh: MeshMethod = "poisson"

    @classmethod
    def of(cls, config: ModelOutputConfig) -> FormatSettings:
        """What the settings of a run say."""
        return cls(
            text=config.text,
            trainer_scales=config.trainer_scales or (),
            mesh=config.mesh if isinstance(config, OutputConfig) and config.mesh != "none" else "poisson",
        )


@dataclass(frozen=True, kw_only=True)
class Format:
    """One way to write a run.

    Args:
        write: raises a ``SmustrError`` if the run cannot be written in this format.
        result: the file or folder in the output folder that it makes or replaces.
        about: one line of description.
        reads_images: the original images are needed.
        reads_masks: the masks of the run are needed, where it had any and no others are named.
    """

    write: Callable[[FinishedRun, FormatSettings], Written]
    result: str
    about: str
    reads_images: bool = False
    reads_masks: bool = False


def export(
    run: Run,
    fused: Sequence[FusedScene],
    refinement: Refinement | None,
    initial: InitialScenes,
    images: Path,
    collection: ImageCollection,
    config: RunConfig | RefineConfig,
    *,
    before: Mapping[str, Scene],
) -> Outputs:
    """Write a run: every model for COLMAP, the other formats of the largest, and what led to it.

    Args:
        fused: the finished models, largest first.
        refinement: their tracks, if any.
        initial: the scenes before refinement.
        images: folder of the images.
        collection: the images.
        config: the settings, which are written, too.
        before: scenes of earlier steps, by the file below the output folder that gets their poses.
    """
    run.folder.clear_results(MODEL_FILES)
    has_tracks = refinement is not None and any(refinement.models)
    finished = FinishedRun(
        output=run.folder.root,
        native_log=run.folder.native_log,
        images=images,
        scenes=tuple(one.scene for one in fused),
        models=(None,) * len(fused) if refinement is None else refinement.models,
        database=refinement.database if refinement is not None and has_tracks else None,
        maps=initial.maps,
        masks=masks_of(collection, config.masks),
        timestamps_s={one.name: one.timestamp_s for one in collection.images if one.timestamp_s is not None},
        bits={image.name: image.bits for image in collection.images if image.bits is not None},
    )
    settings = FormatSettings.of(config.output)
    with run.clock.stage("export", total=1) as progress:
        for name in ("sparse", "ply", "glb", "tum", *(("database",) if has_tracks else ())):
            FORMATS[name].write(finished, settings)
        for name, scene in {"trajectory_stitched_tum.txt": initial.scenes[0], **before}.items():
            write_tum(scene, run.folder.root / name, times_of(scene, finished.timestamps_s))
        if refinement is not None:
            named = {f"sparse/{number}": one for number, one in enumerate(refinement.uncertainties)}
            write_uncertainty(named, run.folder.root / UNCERTAINTY_FILE)
        write_atomically(run.folder.root / "config.toml", config_to_toml(config).encode())
        write_finished(run.folder, finished)
        progress.advance()
    return write_where_possible(finished, config.output.large_formats if has_tracks else (), settings, run.clock)


def write_where_possible(
    finished: FinishedRun, names: Iterable[str], settings: FormatSettings, clock: StageClock
) -> Outputs:
    """Write slow formats, each as a stage; if one fails, the others are still written."""
    missing: list[MissingOutput] = []
    notes: list[str] = []
    for name in names:
        with clock.stage(name, total=1) as stage:
            try:
                written = FORMATS[name].write(finished, settings)
                stage.advance()
            except (InputError, ReconstructionError, MissingDependencyError) as error:
                clock.warn(f"no {name}: {error}")
                missing.append(MissingOutput(name=name, reason=str(error)))
            else:
                notes += [f"{name}: {note}" for note in written.notes]
    return Outputs(missing=tuple(missing), notes=tuple(notes))


# --------------------------------------------------------------------- models and clouds
def write_sparse(finished: FinishedRun, settings: FormatSettings) -> Written:
    """``sparse/0``, ``sparse/1`` ...: with tracks where there are any, else with the cloud as points without."""
    if settings.text:
        refuse_names_text_cannot_hold(name for scene in finished.scenes for name in scene.image_names)
    for number, (scene, model) in enumerate(zip(finished.scenes, finished.models, strict=True)):
        folder = finished.sparse_model(number)
        if model is None:
            write_colmap_sparse(scene, folder, text=settings.text)
        else:
            copy_model(model, folder, text=settings.text)
    return Written(name="sparse")


def copy_model(model: Path, folder: Path, *, text: bool) -> None:
    """Copy the binary files of a model, and write text files if wanted."""
    with atomic_folder(folder, may_hold=MODEL_FILES) as partial:
        for path in sorted(model.glob("*.bin")):
            shutil.copyfile(path, partial / path.name)
        if text:
            write_text_checked(pycolmap.Reconstruction(model), partial, to_be=folder)


def write_database(finished: FinishedRun, settings: FormatSettings) -> Written:
    """``database.db`` with the ids of the models."""
    if finished.database is None:
        raise InputError("there is no database, for the run has no tracks; was it made with --no-refine?")
    target = finished.output / DATABASE_FILE
    with atomic_file(target) as partial:
        shutil.copyfile(finished.database, partial)
    return Written(name=DATABASE_FILE)


def write_cloud(finished: FinishedRun, settings: FormatSettings) -> Written:
    """``points.ply``, the cloud of the largest model."""
    write_ply(finished.scenes[0].points, finished.output / "points.ply")
    return Written(name="points.ply")


def write_viewer_file(finished: FinishedRun, settings: FormatSettings) -> Written:
    """``scene.glb``, cloud and cameras of the largest model."""
    write_glb(finished.scenes[0], finished.output / "scene.glb")
    return Written(name="scene.glb")


def write_trajectory(finished: FinishedRun, settings: FormatSettings) -> Written:
    """``trajectory_tum.txt`` of the largest model."""
    scene = finished.scenes[0]
    write_tum(scene, finished.output / "trajectory_tum.txt", times_of(scene, finished.timestamps_s))
    return Written(name="trajectory_tum.txt")


# ----------------------------------------------------------------- folders for programs
def write_trainer(finished: FinishedRun, settings: FormatSettings) -> Written:
    """``trainer``, of the largest model."""
    report = write_training_dataset(
        _model_with_tracks(finished),
        finished.images,
        finished.output / TRAINER_FOLDER,
        maps=finished.maps,
        cloud=finished.scenes[0].points,
        scales=settings.trainer_scales,
        masks=settings.masks or (None if finished.masks is None else finished.masks.folder),
        bits=finished.bits,
        keep_outliers=settings.keep_outliers,
    )
    left_out = report.left_out
    notes = []
    if left_out.far_images or left_out.far_points:
        notes.append(
            f"{len(left_out.far_images)} cameras and {left_out.far_points} points far from all others left out"
        )
    if left_out.unobserved_images:
        notes.append(f"left out, for they see no point: {_listed(left_out.unobserved_images)}")
    if report.images_without_depth:
        notes.append(f"without depth: {_listed(report.images_without_depth)}")
    if report.images_without_mask:
        notes.append(f"without a mask: {_listed(report.images_without_mask)}")
    return Written(name=TRAINER_FOLDER, notes=tuple(notes))


def write_dense(finished: FinishedRun, settings: FormatSettings) -> Written:
    """``dense``, of the largest model."""
    if finished.maps is None:
        raise InputError("there are no depth maps to make a dense workspace of")
    report = write_dense_workspace(
        _model_with_tracks(finished),
        finished.images,
        finished.maps,
        finished.output / DENSE_FOLDER,
        bits=finished.bits,
        log_file=finished.native_log,
    )
    notes = []
    if report.without_map:
        notes.append(f"without depth: {_listed(report.without_map)}")
    if report.borrowed_scale:
        notes.append(f"depth scaled as the whole model, for lack of points: {_listed(report.borrowed_scale)}")
    if not report.num_points:
        notes.append("the fused cloud is empty")
    return Written(name=DENSE_FOLDER, notes=tuple(notes))


def write_mesh_of_workspace(finished: FinishedRun, settings: FormatSettings) -> Written:
    """A mesh in ``dense``, which must have been written before."""
    workspace = finished.output / DENSE_FOLDER
    if not workspace.is_dir():
        raise InputError(f"a mesh is made of {workspace}, which is not there; write the format dense, too")
    report = write_mesh(workspace, settings.mesh, log_file=finished.native_log)
    return Written(name=report.ply.relative_to(finished.output).as_posix())


def _model_with_tracks(finished: FinishedRun) -> pycolmap.Reconstruction:
    if finished.models[0] is None:
        raise InputError("the model has no tracks, which trainers and dense workspaces need")
    return pycolmap.Reconstruction(finished.models[0])


def _listed(names: Sequence[str]) -> str:
    more = f" and {len(names) - _NAMES_SHOWN} more" if len(names) > _NAMES_SHOWN else ""
    return f"{', '.join(names[:_NAMES_SHOWN])}{more}"


FORMATS: Mapping[str, Format] = {
    "sparse": Format(write=write_sparse, result="sparse", about="COLMAP models, as sparse/0, sparse/1 ..."),
    "database": Format(write=write_database, result=DATABASE_FILE, about="COLMAP database that goes with the models"),
    "ply": Format(write=write_cloud, result="points.ply", about="the dense cloud, with normals and colours"),
    "glb": Format(write=write_viewer_file, result="scene.glb", about="cloud and cameras for viewers"),
    "tum": Format(write=write_trajectory, result="trajectory_tum.txt", about="camera poses as text"),
    "trainer": Format(
        write=write_trainer,
        result=TRAINER_FOLDER,
        about="folder for splat and NeRF trainers: undistorted images, model, depth",
        reads_images=True,
        reads_masks=True,
    ),
    "dense": Format(
        write=write_dense,
        result=DENSE_FOLDER,
        about="COLMAP's workspace of depth and normal maps, and the fused cloud",
        reads_images=True,
    ),
    "mesh": Format(
        write=write_mesh_of_workspace, result=DENSE_FOLDER, about="a mesh of the dense workspace, PLY and textured GLB"
    ),
}
"""In the order in which they are to be written: the mesh is made of the dense workspace."""


@dataclass(frozen=True, kw_only=True)
class Written:
    """What a format has written.

    Args:
        name: the file or folder, below the output folder.
        notes: for the user, such as what was left out.
    """

    name: str
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class MissingOutput:
    """A part of the result that could not be written, and why."""

    name: str
    reason: str


@dataclass(frozen=True, kw_only=True)
class Outputs:
    """The result of several formats: which could not be written, and the notes of the others."""

    missing: tuple[MissingOutput, ...]
    notes: tuple[str, ...]
