"""Compare this program with COLMAP's two mappers on image sets whose cameras are known.

    python scripts/compare_with_colmap.py castle_p30 kitti_a --stages --markdown comparison.md --json comparison.json
    python scripts/compare_with_colmap.py kitchen_rgbd --reuse --rerun-ours --workers 1 2

A data set is a folder, or the name of one in $SMUST3R_DATA (default: ../shared/data beside the
repository), with ``images/`` and a truth: ``poses.txt``, ``transforms.json`` or
``reference_sparse/``. Where it has ``subset_every5.txt``, only the images named there are used,
unless ``--all-images`` is given; runs of all images then have a working folder of their own.

Every stage runs in a process of its own, so that its CPU seconds, wall time and memory are its
own; memory is the largest resident size of one process (Linux). COLMAP gets SIFT of images of at
most 1024 pixels with 6000 features; up to 50 images are matched exhaustively, longer sequences
with their 10 next and quadratically spaced neighbours and some 80 spread images exhaustively.
Accuracy is that of the largest model after a Sim(3) fit, see ``smust3r_colmap.evaluation.trajectory``. Nobody
is told the calibration: a principal point off the centre then leaves a rotation error for all.

Mapping is everything after features and matching but depth maps; COLMAP's includes the start of its
process, about a second. Jumps are neighbours in order of name with more than 90 degrees or ten
median steps between them, where the truth has none: a fold, or parts put together wrongly. What is
measured and which targets it is held against stands in ``comparison_figures``.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pycolmap
from comparison_figures import (
    GLOBAL,
    INCREMENTAL,
    Cost,
    Dataset,
    Result,
    costs_by_stage,
    figures_of,
    untrue_jumps,
)
from comparison_report import as_json, render_markdown, render_stages, render_table
from plot_trajectory import read_tum_by_name

from smust3r_colmap.config import SegmentationConfig
from smust3r_colmap.errors import DegenerateAlignmentError
from smust3r_colmap.evaluation.trajectory import Evaluation, Trajectory, compare_trajectories
from smust3r_colmap.execution.task_pool import usable_cores
from smust3r_colmap.importers.image_folder import natural_key
from smust3r_colmap.importers.model_poses import read_model_poses
from smust3r_colmap.importers.poses_txt import read_poses_txt
from smust3r_colmap.importers.transforms_poses import read_transforms_json

DATA = Path(os.environ.get("SMUST3R_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
SUBSET_FILE = "subset_every5.txt"
COLMAP_SCRIPT = Path(__file__).with_name("comparison_colmap.py")

# Segments of 60 with 30 shared images are the paper's; sets of some fifty images or fewer need
# shorter ones, or there would be nothing to stitch.
SHORT_SEGMENTS = {"castle_p30", "fountain_p11", "fox", "kitti_a", "sacre_coeur"}
# Neighbours in order of name are no neighbours in space.
UNORDERED = {"sacre_coeur"}

STAGE_FILES = {"chain": "trajectory_without_loops_tum.txt", "loops": "trajectory_stitched_tum.txt"}
"""Our trajectories before the result; a run without loops, or without refinement, does not write them."""
LAST_STAGE = "triangulation and adjustment"


def main() -> int:
    """Compare all data sets named on the command line; the exit code is 1 when a process failed."""
    arguments = parse_arguments(None)
    compared: list[tuple[Dataset, list[Result]]] = []
    for name in arguments.datasets:
        dataset = open_dataset(name, arguments.output, all_images=arguments.all_images)
        results = list(run_methods(dataset, arguments))
        compared.append((dataset, results))
        print(render_table(dataset, results), flush=True)
        for ours in (result for result in results if result.stages):
            print(render_stages(dataset, ours), flush=True)
        if arguments.json:
            report = {dataset.name: as_json(dataset, results) for dataset, results in compared}
            arguments.json.write_text(json.dumps(report, indent=1), encoding="utf-8")
        if arguments.markdown:
            arguments.markdown.write_text(render_markdown(compared), encoding="utf-8")
    return int(any(cost.exit_code for _, results in compared for one in results for cost in one.costs.values()))


def parse_arguments(words: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("datasets", nargs="+", metavar="DATASET", help="a folder, or its name in $SMUST3R_DATA")
    parser.add_argument("--output", type=Path, default=Path("comparison_out"), help="working folder (%(default)s)")
    parser.add_argument("--segment-length", type=int, help="default: 12 for the short sets, otherwise 60")
    parser.add_argument("--overlap", type=int, help="default: half of the segment length, at most 20")
    parser.add_argument("--all-images", action="store_true", help=f"use all images where there is a {SUBSET_FILE}")
    parser.add_argument(
        "--cameras",
        choices=["auto", "single"],
        default="auto",
        help="for COLMAP: what it makes of EXIF, without it a camera per image; or one for all (%(default)s)",
    )
    parser.add_argument("--skip-ours", action="store_true")
    parser.add_argument("--skip-incremental", action="store_true")
    parser.add_argument("--skip-global", action="store_true")
    parser.add_argument(
        "--workers", type=int, nargs="+", metavar="N", help="run ours once with each of these numbers of processes"
    )
    parser.add_argument("--ours-name", default="ours", help="folder of our runs beside COLMAP's (%(default)s)")
    parser.add_argument(
        "--flags", type=shlex.split, default=[], metavar="TEXT", help="for ours, such as --flags='--no-dense'"
    )
    parser.add_argument("--stages", action="store_true", help="also what each of our stages does to the cameras")
    parser.add_argument(
        "--reuse",
        action="store_true",
        help="take what an earlier comparison finished from the working folder; ours with the same settings only",
    )
    parser.add_argument("--rerun-ours", action="store_true", help="with --reuse: take only COLMAP's part")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all figures there, too")
    parser.add_argument("--markdown", type=Path, metavar="FILE", help="write the tables there, too, all sets in one")
    arguments = parser.parse_args(words)
    if arguments.rerun_ours and not arguments.reuse:
        parser.error("--rerun-ours says what --reuse leaves out; give both, or neither to run everything")
    return arguments


# ----------------------------------------------------------------------------- data
def open_dataset(name: str, output: Path, *, all_images: bool) -> Dataset:
    """Find a data set and its truth; a subset is linked into the working folder."""
    folder = Path(name) if (Path(name) / "images").is_dir() else DATA / name
    images = folder / "images"
    if not images.is_dir():
        sys.exit(f"{name}: no folder {images}; is SMUST3R_DATA set?")
    subset = folder / SUBSET_FILE
    if subset.exists() and not all_images:
        images = link_images(images, subset.read_text(encoding="utf-8").split(), output / folder.resolve().name)
    files = (path.relative_to(images).as_posix() for path in images.rglob("*") if path.is_file())
    names = sorted(files, key=natural_key)
    truth, unit = read_truth(folder)
    return Dataset(
        name=folder.resolve().name,
        images=images,
        names=tuple(names),
        truth={image: pose for image, pose in truth.items() if image in set(names)},
        unit=unit,
    )


def link_images(images: Path, names: list[str], work: Path) -> Path:
    """A folder with links to the named images and nothing else."""
    linked = work / "images"
    shutil.rmtree(linked, ignore_errors=True)
    for name in names:
        link = linked / name
        link.parent.mkdir(parents=True, exist_ok=True)
        link.symlink_to((images / name).resolve())
    return linked


def read_truth(folder: Path) -> tuple[dict[str, Any], str]:
    """The best truth that the folder has, and its unit of length."""
    if (folder / "poses.txt").exists():
        return read_poses_txt(folder / "poses.txt"), "m"
    if (folder / "transforms.json").exists():
        return read_transforms_json(folder / "transforms.json"), "units"
    return read_model_poses(folder / "reference_sparse"), "units"


def work_folder(dataset: Dataset, output: Path) -> Path:
    """Where the runs of a set lie; those of all images stand apart from those of the set's subset."""
    beside_a_subset = (dataset.images.parent / SUBSET_FILE).exists()
    return output / (f"{dataset.name}_all" if beside_a_subset else dataset.name)


# -------------------------------------------------------------------------- methods
def run_methods(dataset: Dataset, arguments: argparse.Namespace) -> Iterator[Result]:
    """Run what was asked for, one method after the other."""
    work = work_folder(dataset, arguments.output)
    if not arguments.skip_ours:
        for workers in arguments.workers or [0]:
            yield run_ours(dataset, work, arguments, workers=workers)
    mappers = [name for name in ("incremental", "global") if not getattr(arguments, f"skip_{name}")]
    if not mappers:
        return
    colmap = work / ("colmap" if arguments.cameras == "auto" else "colmap_single")
    if not arguments.reuse:
        shutil.rmtree(colmap, ignore_errors=True)
    colmap.mkdir(parents=True, exist_ok=True)
    shared = {
        stage: run_colmap_stage(stage, dataset.images, colmap, arguments.cameras) for stage in ("features", "matching")
    }
    for name in mappers:
        costs = {**shared, "mapping": run_colmap_stage(name, dataset.images, colmap, arguments.cameras)}
        yield judge({"incremental": INCREMENTAL, "global": GLOBAL}[name], dataset, colmap / name, costs)


def run_ours(dataset: Dataset, work: Path, arguments: argparse.Namespace, *, workers: int) -> Result:
    """``smust3r-colmap reconstruct`` from scratch, or what an earlier comparison left with --reuse.

    A run that was made with other settings is refused, for its figures would stand under a wrong label.
    """
    length = arguments.segment_length or (12 if dataset.name in SHORT_SEGMENTS else 60)
    overlap = arguments.overlap or min(SegmentationConfig().overlap, length // 2)
    settings = ["--segment-length", str(length), "--overlap", str(overlap), *arguments.flags]
    label = " ".join([f"{arguments.ours_name} l={length} p={overlap}", *arguments.flags])
    folder = arguments.ours_name
    if workers:
        settings += ["--workers", str(workers)]
        label += f" workers={workers}"
        folder += f"_workers{workers}"
    output, record = work / folder, work / f"{folder}.json"
    if arguments.rerun_ours or not (arguments.reuse and record.exists()):
        measure_ours(dataset, output, record, settings)
    refuse_other_settings(record, settings)
    cost = Cost(**json.loads(record.read_text(encoding="utf-8")))
    summary = output / "summary.json"
    costs = {"rest": cost}
    if summary.exists():
        costs = costs_by_stage(cost, json.loads(summary.read_text(encoding="utf-8"))["stages"])
    result = judge(label, dataset, output / "sparse", costs)
    stages = effect_of_stages(dataset, output, result) if arguments.stages else {}
    return replace(result, workers=workers or usable_cores(), stages=stages)


def measure_ours(dataset: Dataset, output: Path, record: Path, settings: list[str]) -> None:
    """Run the command on an empty output folder and write down what it took, and beside it the settings."""
    record.unlink(missing_ok=True)
    shutil.rmtree(output, ignore_errors=True)
    output.parent.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "smust3r_colmap", "reconstruct", str(dataset.images), "--output", str(output)]
    cost = run_child([*command, *settings, "--quiet"], output.with_name(f"{output.name}.log"))
    # 3 is the exit code of a run that finished with a weak result, which the table shows anyway.
    cost = replace(cost, exit_code=0 if cost.exit_code == 3 else cost.exit_code)
    settings_beside(record).write_text(shlex.join(settings), encoding="utf-8")
    record.write_text(json.dumps(asdict(cost)), encoding="utf-8")


def settings_beside(record: Path) -> Path:
    """The file with the settings that the run of a record was made with, as one would type them."""
    return record.with_suffix(".settings")


def refuse_other_settings(record: Path, settings: list[str]) -> None:
    """Leave with a message where the run of a record was made with other settings, or does not say with which."""
    file = settings_beside(record)
    found = file.read_text(encoding="utf-8") if file.exists() else "settings that it does not tell"
    if found != shlex.join(settings):
        sys.exit(
            f"{record}: was made with {found}, and asked for is {shlex.join(settings)}; "
            "give --rerun-ours to replace it, or --ours-name for a folder of its own"
        )


def effect_of_stages(dataset: Dataset, output: Path, result: Result) -> dict[str, Evaluation]:
    """How far our cameras are from the truth after each stage that the run wrote down, and in the end."""
    effects = {}
    for stage, file in STAGE_FILES.items():
        if (output / file).exists():
            effects[stage] = compare_trajectories(read_tum_by_name(output, output / file), dataset.truth)
    if result.evaluation is not None:
        refined = STAGE_FILES["loops"] in {path.name for path in output.iterdir()}
        effects[LAST_STAGE if refined else "loops"] = result.evaluation
    return effects


def judge(method: str, dataset: Dataset, sparse: Path, costs: dict[str, Cost]) -> Result:
    """Measure the largest model in a folder of models, and compare it with the truth."""
    folders = [folder for folder in sorted(sparse.glob("*")) if any(folder.glob("images.*"))]
    models = sorted(((read_model_poses(folder), folder) for folder in folders), key=lambda one: -len(one[0]))
    notes = [f"{stage}: exit code {cost.exit_code}" for stage, cost in costs.items() if cost.exit_code]
    evaluation, figures = None, None
    largest: Trajectory = {}
    if models:
        largest, folder = models[0]
        figures = figures_of(pycolmap.Reconstruction(folder))
        try:
            evaluation = compare_trajectories(largest, dataset.truth)
        except DegenerateAlignmentError as error:
            notes.append(str(error))
    else:
        notes.append("no model")
    return Result(
        method=method,
        costs=costs,
        registered_largest=len(largest),
        registered_all=len({name for trajectory, _ in models for name in trajectory}),
        num_models=len(models),
        figures=figures,
        evaluation=evaluation,
        jumps=None if dataset.name in UNORDERED else untrue_jumps(largest, dataset.truth, dataset.names),
        note="; ".join(notes),
        workers=usable_cores(),
        stages={},
    )


# ------------------------------------------------------------------ COLMAP's stages
def run_colmap_stage(stage: str, images: Path, work: Path, cameras: str) -> Cost:
    """Run a stage in a child process, unless the working folder has it."""
    record = work / f"{stage}.json"
    if not record.exists():
        command = [sys.executable, str(COLMAP_SCRIPT), stage, str(images), str(work), cameras]
        cost = run_child(command, work / f"{stage}.log")
        record.write_text(json.dumps(asdict(cost)), encoding="utf-8")
    return Cost(**json.loads(record.read_text(encoding="utf-8")))


def run_child(command: list[str], log: Path) -> Cost:
    """Run a command with its output in a log file and measure it."""
    start_s = time.monotonic()
    with log.open("wb") as stream:
        child = subprocess.Popen(command, stdout=stream, stderr=subprocess.STDOUT)
        _, status, usage = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)  # or Popen would go on waiting for it
    if child.returncode:
        print(f"{' '.join(command)}\n  ended with {child.returncode}, see {log}", file=sys.stderr)
    return Cost(
        cpu_s=usage.ru_utime + usage.ru_stime,
        wall_s=time.monotonic() - start_s,
        peak_mib=usage.ru_maxrss / 1024,  # ru_maxrss is in KiB on Linux
        exit_code=child.returncode,
    )


if __name__ == "__main__":
    sys.exit(main())
