"""Compare this program with COLMAP's two mappers on image sets whose cameras are known.

    python scripts/compare_with_colmap.py castle_p30 kitti_a --json comparison.json

A data set is a folder, or the name of one in $SMUST3R_DATA (default: ../shared/data beside the
repository), with ``images/`` and a truth: ``poses.txt``, ``transforms.json`` or
``reference_sparse/``. Where it has ``subset_every5.txt``, only the images named there are used,
unless ``--all-images`` is given.

Every stage runs in a process of its own, so that its CPU seconds, wall time and memory are its
own; memory is the largest resident size of one process (Linux). COLMAP gets SIFT of images of at
most 1024 pixels with 6000 features; up to 50 images are matched exhaustively, longer sequences
with their 10 next and quadratically spaced neighbours and some 80 spread images exhaustively.
Accuracy is that of the largest model after a Sim(3) fit, see ``smust3r_colmap.evaluation``. Nobody
is told the calibration: a principal point off the centre then leaves a rotation error for all.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import pycolmap

from smust3r_colmap.errors import DegenerateAlignmentError
from smust3r_colmap.evaluation import (
    Evaluation,
    compare_trajectories,
    read_poses_txt,
    read_reference_sparse,
    read_transforms_json,
)

DATA = Path(os.environ.get("SMUST3R_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
SUBSET_FILE = "subset_every5.txt"

# Segments of 60 with 30 shared images are the paper's; sets of some fifty images or fewer need
# shorter ones, or there would be nothing to stitch.
SHORT_SEGMENTS = {"castle_p30", "fountain_p11", "fox", "kitti_a", "sacre_coeur"}

SIFT_IMAGE_SIZE = 1024
SIFT_FEATURES = 6000
EXHAUSTIVE_UP_TO = 50
SEQUENTIAL_OVERLAP = 10
SPREAD_IMAGES = 80

OUR_MAPPING_STAGES = ("mapping", "mapping without the global mapper", "calibration", "alignment")


@dataclass(frozen=True, kw_only=True)
class Cost:
    """What a child process and its own children took."""

    cpu_s: float
    wall_s: float
    peak_mib: float
    exit_code: int


@dataclass(frozen=True, kw_only=True)
class Dataset:
    """Images and their known cameras; ``unit`` is that of the truth."""

    name: str
    images: Path
    num_images: int
    truth: dict[str, Any]
    unit: str


@dataclass(frozen=True, kw_only=True)
class Result:
    """A row of the table."""

    method: str
    costs: dict[str, Cost]
    registered_largest: int
    registered_all: int
    num_models: int
    evaluation: Evaluation | None
    remark: str


def main() -> int:
    """Compare all data sets named on the command line; the exit code is 1 when a process failed."""
    if sys.argv[1:2] == ["--stage"]:
        stage, images, work = sys.argv[2:]
        COLMAP_STAGES[stage](Path(images), Path(work))
        return 0
    arguments = parse_arguments()
    report: dict[str, Any] = {}
    failed = False
    for name in arguments.datasets:
        dataset = open_dataset(name, arguments.output, all_images=arguments.all_images)
        results = list(run_methods(dataset, arguments))
        print(render_table(dataset, results), flush=True)
        report[dataset.name] = [as_json(result) for result in results]
        failed |= any(cost.exit_code for result in results for cost in result.costs.values())
        if arguments.json:
            arguments.json.write_text(json.dumps(report, indent=1), encoding="utf-8")
    return int(failed)


def parse_arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("datasets", nargs="+", metavar="DATASET", help="a folder, or its name in $SMUST3R_DATA")
    parser.add_argument("--output", type=Path, default=Path("comparison_out"), help="working folder (%(default)s)")
    parser.add_argument("--segment-length", type=int, help="default: 12 for the short sets, otherwise 60")
    parser.add_argument("--overlap", type=int, help="default: half of the segment length")
    parser.add_argument("--all-images", action="store_true", help=f"use all images where there is a {SUBSET_FILE}")
    parser.add_argument("--skip-ours", action="store_true")
    parser.add_argument("--skip-incremental", action="store_true")
    parser.add_argument("--skip-global", action="store_true")
    parser.add_argument(
        "--reuse", action="store_true", help="take what an earlier comparison finished from the working folder"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all figures there, too")
    return parser.parse_args()


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
    present = {path.relative_to(images).as_posix() for path in images.rglob("*") if path.is_file()}
    truth, unit = read_truth(folder)
    return Dataset(
        name=folder.resolve().name,
        images=images,
        num_images=len(present),
        truth={image: pose for image, pose in truth.items() if image in present},
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
    return read_reference_sparse(folder / "reference_sparse"), "units"


# -------------------------------------------------------------------------- methods
def run_methods(dataset: Dataset, arguments: argparse.Namespace) -> Iterator[Result]:
    """Run what was asked for, one method after the other."""
    work = arguments.output / dataset.name
    if not arguments.skip_ours:
        yield run_ours(dataset, work / "ours", arguments)
    mappers = [name for name in ("incremental", "global") if not getattr(arguments, f"skip_{name}")]
    if not mappers:
        return
    colmap = work / "colmap"
    if not arguments.reuse:
        shutil.rmtree(colmap, ignore_errors=True)
    colmap.mkdir(parents=True, exist_ok=True)
    shared = {stage: run_colmap_stage(stage, dataset.images, colmap) for stage in ("features", "matching")}
    for name in mappers:
        costs = {**shared, "mapping": run_colmap_stage(name, dataset.images, colmap)}
        yield judge(f"COLMAP {name}", dataset, colmap / name, costs)


def run_ours(dataset: Dataset, output: Path, arguments: argparse.Namespace) -> Result:
    """``smust3r-colmap reconstruct`` from scratch, or what an earlier comparison left with --reuse."""
    length = arguments.segment_length or (12 if dataset.name in SHORT_SEGMENTS else 60)
    overlap = arguments.overlap or length // 2
    record = output.parent / "ours.json"
    if not (arguments.reuse and record.exists()):
        measure_ours(dataset, output, record, length=length, overlap=overlap)
    cost = Cost(**json.loads(record.read_text(encoding="utf-8")))
    return judge(f"ours l={length} p={overlap}", dataset, output / "sparse", costs_by_stage(cost, output))


def measure_ours(dataset: Dataset, output: Path, record: Path, *, length: int, overlap: int) -> None:
    """Run the command on an empty output folder and write down what it took."""
    shutil.rmtree(output, ignore_errors=True)
    output.parent.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "smust3r_colmap", "reconstruct", str(dataset.images), "--output", str(output)]
    settings = ["--segment-length", str(length), "--overlap", str(overlap), "--quiet"]
    cost = run_child([*command, *settings], output.parent / "ours.log")
    # 3 is the exit code of a run that finished with a weak result, which the table shows anyway.
    cost = Cost(**{**asdict(cost), "exit_code": 0 if cost.exit_code == 3 else cost.exit_code})
    record.write_text(json.dumps(asdict(cost)), encoding="utf-8")


def costs_by_stage(cost: Cost, output: Path) -> dict[str, Cost]:
    """The whole cost, parted into what COLMAP has too and the rest (depth maps, fusion, files)."""
    summary = output / "summary.json"
    if not summary.exists():
        return {"rest": cost}
    stages = json.loads(summary.read_text(encoding="utf-8"))["stages"]
    costs = {}
    for name in ("features", "matching", "mapping"):
        # Mapping is everything up to one model: the segments, their common calibration, their alignment.
        parts = [name] if name != "mapping" else [*OUR_MAPPING_STAGES]
        chosen = [stage for stage in stages if stage["name"] in parts]
        costs[name] = replace(
            cost,
            cpu_s=sum(stage["cpu_s"] for stage in chosen),
            wall_s=sum(stage["wall_s"] for stage in chosen),
            exit_code=0,
        )
    named = list(costs.values())
    costs["rest"] = replace(
        cost,
        cpu_s=max(0.0, cost.cpu_s - sum(one.cpu_s for one in named)),
        wall_s=max(0.0, cost.wall_s - sum(one.wall_s for one in named)),
    )
    return costs


def judge(method: str, dataset: Dataset, sparse: Path, costs: dict[str, Cost]) -> Result:
    """Compare the largest model in a folder of models with the truth."""
    folders = [folder for folder in sorted(sparse.glob("*")) if any(folder.glob("images.*"))]
    models = sorted((read_reference_sparse(folder) for folder in folders), key=len, reverse=True)
    remarks = [f"{stage}: exit code {cost.exit_code}" for stage, cost in costs.items() if cost.exit_code]
    evaluation = None
    if models:
        try:
            evaluation = compare_trajectories(models[0], dataset.truth)
        except DegenerateAlignmentError as error:
            remarks.append(str(error))
    else:
        remarks.append("no model")
    return Result(
        method=method,
        costs=costs,
        registered_largest=len(models[0]) if models else 0,
        registered_all=len({name for model in models for name in model}),
        num_models=len(models),
        evaluation=evaluation,
        remark="; ".join(remarks),
    )


# ------------------------------------------------------------------ COLMAP's stages
def run_colmap_stage(stage: str, images: Path, work: Path) -> Cost:
    """Run a stage in a child process, unless the working folder has it."""
    record = work / f"{stage}.json"
    if not record.exists():
        command = [sys.executable, __file__, "--stage", stage, str(images), str(work)]
        cost = run_child(command, work / f"{stage}.log")
        record.write_text(json.dumps(asdict(cost)), encoding="utf-8")
    return Cost(**json.loads(record.read_text(encoding="utf-8")))


def extract_features(images: Path, work: Path) -> None:
    """SIFT of all images; cameras are shared where COLMAP thinks they are."""
    options = pycolmap.FeatureExtractionOptions(max_image_size=SIFT_IMAGE_SIZE)
    options.sift.max_num_features = SIFT_FEATURES
    (work / "database.db").unlink(missing_ok=True)
    pycolmap.extract_features(work / "database.db", images, extraction_options=options)


def match_features(images: Path, work: Path) -> None:
    """All pairs of a small set; neighbours and spread images of a sequence."""
    names = sorted(path.relative_to(images).as_posix() for path in images.rglob("*") if path.is_file())
    if len(names) <= EXHAUSTIVE_UP_TO:
        pycolmap.match_exhaustive(work / "database.db")
        return
    neighbours = pycolmap.SequentialPairingOptions(overlap=SEQUENTIAL_OVERLAP, quadratic_overlap=True)
    pycolmap.match_sequential(work / "database.db", pairing_options=neighbours)
    spread = names[:: -(-len(names) // SPREAD_IMAGES)]
    pair_list = work / "pairs.txt"
    pair_list.write_text("".join(f"{a} {b}\n" for a, b in combinations(spread, 2)), encoding="utf-8")
    pairs = pycolmap.ImportedPairingOptions(match_list_path=pair_list)
    pycolmap.match_image_pairs(work / "database.db", pairing_options=pairs)


def map_incrementally(images: Path, work: Path) -> None:
    """COLMAP's incremental mapper with its defaults."""
    pycolmap.incremental_mapping(work / "database.db", images, emptied(work / "incremental"))


def map_globally(images: Path, work: Path) -> None:
    """COLMAP's global mapper (GLOMAP) with its defaults."""
    pycolmap.global_mapping(work / "database.db", images, emptied(work / "global"))


def emptied(folder: Path) -> Path:
    """The folder without what an interrupted run may have left in it."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    return folder


COLMAP_STAGES: dict[str, Callable[[Path, Path], None]] = {
    "features": extract_features,
    "matching": match_features,
    "incremental": map_incrementally,
    "global": map_globally,
}


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


# --------------------------------------------------------------------------- report
def render_table(dataset: Dataset, results: list[Result]) -> str:
    """One line per method."""
    header = ["method", "images", "models", f"rms {dataset.unit}", "% extent", "rot deg med", "mean"]
    header += ["CPU/wall s feat", "match", "map", "rest", "all", "MiB", ""]
    lines = [header, *(table_line(result, dataset.num_images) for result in results)]
    widths = [max(len(line[column]) for line in lines) for column in range(len(header))]
    rows = ["  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)).rstrip() for line in lines]
    return "\n".join(
        [f"\n{dataset.name}: {dataset.num_images} images, {len(dataset.truth)} with a known camera", *rows]
    )


def table_line(result: Result, num_images: int) -> list[str]:
    """The cells of a method: images of the largest model / of all models / that there are."""
    found = result.evaluation
    accuracy = ["-"] * 4
    if found is not None:
        accuracy = [f"{found.position_rmse:.4g}", f"{found.position_rmse_percent:.3g}"]
        accuracy += [f"{found.rotation_median_deg:.3g}", f"{found.rotation_mean_deg:.3g}"]
    costs = result.costs
    stages = [
        f"{costs[stage].cpu_s:.0f}/{costs[stage].wall_s:.0f}" if stage in costs else "-"
        for stage in ("features", "matching", "mapping", "rest")
    ]
    return [
        result.method,
        f"{result.registered_largest}/{result.registered_all}/{num_images}",
        str(result.num_models),
        *accuracy,
        *stages,
        f"{sum(cost.cpu_s for cost in costs.values()):.0f}/{sum(cost.wall_s for cost in costs.values()):.0f}",
        f"{max(cost.peak_mib for cost in costs.values()):.0f}",
        result.remark,
    ]


def as_json(result: Result) -> dict[str, Any]:
    """Everything that is known of a method, with numbers and strings only."""
    found = result.evaluation
    record = {**vars(result), "costs": {stage: asdict(cost) for stage, cost in result.costs.items()}}
    if found is not None:
        facts = {**vars(found), "position_rmse_percent": found.position_rmse_percent}
        record["evaluation"] = {key: value for key, value in facts.items() if key != "reference_from_estimated"}
    return record


if __name__ == "__main__":
    sys.exit(main())
