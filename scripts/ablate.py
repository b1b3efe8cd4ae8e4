"""The questions of the paper's section IV-C, asked of any image set with truth.

    python scripts/ablate.py kitchen_rgbd demo --output ablation.md
    python scripts/ablate.py castle_p30 --backbone classical --segment-length 12 --lengths 8 12 16 20

    lengths      (a) images per segment, with an overlap of half of them
    overlaps         images that neighbouring segments share, which the paper does not ask
    groups       (b) transform group between segments
    loops        (c) loop closing off and on, and with places that only look alike
    edges        (d) edges from points, from camera poses, or both
    weighting    (e) confidence weighting

One setting is changed at a time; the others keep their defaults. A set is a folder, the name of one in
$SMUST3R_DATA, or ``demo`` for the rendered room. By default segments are simulated
from a set with depth, and figures are means over seeds. With the classical backbone every configuration
is a whole run; those of one segment length share a run directory, and so features and mapping.

APE is the root mean square distance of camera centres after a Sim(3) fit, AAE the mean angle between
orientations, both of the largest model (``smust3r_colmap.evaluation.trajectory``); "of the chain" is the spanning
tree of the windows before the pose graph, which by itself weighs both edges of every pair.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from statistics import fmean
from typing import Literal, get_args

import numpy as np
from compare_with_colmap import DATA, SUBSET_FILE, open_dataset
from plot_trajectory import Trajectories, draw_trajectories, read_tum_by_name

from smust3r_colmap.alignment.pairwise import align_submodels
from smust3r_colmap.backbones.base import BackboneResult
from smust3r_colmap.config import (
    AlignmentEdges,
    ConfidenceWeighting,
    LoopKernel,
    RunConfig,
    TransformGroup,
)
from smust3r_colmap.errors import ConfigError, SmustrError
from smust3r_colmap.evaluation.trajectory import Evaluation, Trajectory, compare_trajectories
from smust3r_colmap.execution.progress import QuietReporter
from smust3r_colmap.geometry.groups import GROUPS
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.pipeline import reconstruct
from smust3r_colmap.products import Edges
from smust3r_colmap.segmentation.loop_segments import plan_loops
from smust3r_colmap.segmentation.stage import NOT_LOOKED_FOR, Segments
from smust3r_colmap.segmentation.view_graph import ViewGraph
from smust3r_colmap.segmentation.windows import plan_windows
from smust3r_colmap.stitching.camera_fusion import fuse_cameras
from smust3r_colmap.stitching.resection import PlacedSubmodel, place_submodel
from smust3r_colmap.stitching.spanning_tree import ChainedPart
from smust3r_colmap.stitching.stitch import Stitching, stitch_submodels
from smust3r_colmap.synthetic.backbone import SimulatedBackbone, simulated_maps
from smust3r_colmap.synthetic.room import write_demo
from smust3r_colmap.synthetic.settings import PRESETS, REFERENCE_LENGTH, SimulationSettings
from smust3r_colmap.synthetic.truth import TrueScene, collection_of

DriftOf = Literal["image", "segment"]

QUESTIONS = ("lengths", "overlaps", "groups", "loops", "edges", "weighting")
LENGTHS = (20, 40, 60, 80, 100, 200)
"""The paper's."""
OVERLAPS = (1 / 6, 1 / 4, 1 / 3, 1 / 2, 2 / 3)
"""Of the length of a segment."""
FALSE_SHARE = 0.3
"""Of all loops that are tried, where false ones are injected."""


# ------------------------------------------------------------------------ configurations
@dataclass(frozen=True, kw_only=True)
class Configuration:
    """A row of a table: what is changed, and how the row is called."""

    question: str
    label: str
    config: RunConfig
    false_share: float = 0.0


def questions(
    base: RunConfig, *, num_images: int, lengths: Sequence[int], metric: bool, simulated: bool
) -> tuple[Configuration, ...]:
    """Every configuration of every question.

    Args:
        base: what is not asked about.
        num_images: of the set; a longer segment than that cannot be cut.
        lengths: of segments, for the first question.
        metric: segments come in one unit, so that a rigid group makes sense.
        simulated: false loops can be injected.
    """
    return (
        *(
            Configuration(
                question="lengths", label=f"l = {length}, p = {length // 2}", config=with_length(base, length)
            )
            for length in lengths
            if length <= num_images
        ),
        *(_with_overlap(base, round(share * base.segmentation.segment_length)) for share in OVERLAPS),
        *(
            _changed("groups", base, transform_group=group)
            for group in get_args(TransformGroup)
            if _fits(group, metric)
        ),
        *_loop_configurations(base, simulated=simulated),
        *(_changed("edges", base, alignment_edges=kind) for kind in reversed(get_args(AlignmentEdges))),
        *(_changed("weighting", _from_maps(base), confidence_weighting=way) for way in _weightings()),
    )


def with_length(base: RunConfig, length: int) -> RunConfig:
    """The same with another segment length; half of each segment is shared with the next."""
    return replace(base, segmentation=replace(base.segmentation, segment_length=length, overlap=length // 2))


def _with_overlap(base: RunConfig, overlap: int) -> Configuration:
    config = replace(base, segmentation=replace(base.segmentation, overlap=overlap))
    label = f"l = {base.segmentation.segment_length}, p = {overlap}"
    return Configuration(question="overlaps", label=label, config=config)


def _loop_configurations(base: RunConfig, *, simulated: bool) -> Iterator[Configuration]:
    def with_loops(label: str, false_share: float = 0.0, **changes: bool | LoopKernel) -> Configuration:
        config = replace(base, loop_closing=replace(base.loop_closing, **changes))  # type: ignore[arg-type]
        return Configuration(question="loops", label=label, config=config, false_share=false_share)

    yield with_loops("off", loop_closure=False)
    yield with_loops("on")
    yield with_loops("on, no kernel", loop_kernel="none")
    if simulated:
        yield with_loops(f"on, {FALSE_SHARE:.0%} false", FALSE_SHARE)
        yield with_loops(f"on, {FALSE_SHARE:.0%} false, no kernel", FALSE_SHARE, loop_kernel="none")


def _changed(
    question: str, base: RunConfig, **changes: TransformGroup | AlignmentEdges | ConfidenceWeighting
) -> Configuration:
    (label,) = changes.values()
    config = replace(base, alignment=replace(base.alignment, **changes))  # type: ignore[arg-type]
    return Configuration(question=question, label=label, config=config)


def _fits(group: TransformGroup, metric: bool) -> bool:
    return metric or group != "se3"


def _weightings() -> tuple[ConfidenceWeighting, ...]:
    return ("off", "paper", "relative")


def _from_maps(base: RunConfig) -> RunConfig:
    """Confidence is a matter of maps: tracks have none, so a backbone that has tracks must do without them."""
    return replace(base, alignment=replace(base.alignment, alignment_source="pointmaps"))


# ------------------------------------------------------------------------------ outcomes
@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What one run of one configuration gave; numbers that do not apply are NaN.

    Args:
        ape, ape_percent, aae_deg: after loop closing, the position in the unit of the truth and in
            percent of the extent. ape_before, aae_before_deg: of the chain alone.
        placed: images in the largest model. models: connected parts.
        fallbacks: edges that are similarities though a wider group was asked for. edges: accepted ones.
        residual_px: median over the images of what rigid cameras leave (``resection``).
        found, closed: loops that were tried, and accepted. found_false, closed_false: of these, the
            ones of places that only look alike.
        seconds: of CPU for alignment and graph, or of the clock for a whole run.
    """

    ape: float
    ape_percent: float
    aae_deg: float
    ape_before: float
    aae_before_deg: float
    placed: float
    models: float
    fallbacks: float
    edges: float
    residual_px: float
    found: float
    closed: float
    found_false: float
    closed_false: float
    seconds: float


@dataclass(frozen=True, kw_only=True)
class Row:
    """A configuration and all its outcomes, one per seed; ``failures`` are the runs that gave none."""

    configuration: Configuration
    outcomes: tuple[Outcome, ...]
    failures: tuple[str, ...]

    def mean(self, name: str) -> float:
        """Over the seeds; NaN where nothing came out."""
        values = [getattr(one, name) for one in self.outcomes]
        return fmean(values) if values else math.nan


@dataclass(frozen=True, kw_only=True)
class Solved:
    """The back end's work on one reconstruction."""

    edges: Edges
    stitching: Stitching
    before: Trajectory
    after: Trajectory
    residual_px: float


def solve(
    result: BackboneResult,
    segments: Segments,
    names: Sequence[str],
    config: RunConfig,
) -> Solved:
    """Alignment, loop closing and fusion of cameras as in ``pipeline``, without a run directory.

    Args:
        result: of all segments. segments: as planned.
        names: of the images of the collection.

    Raises:
        DegenerateAlignmentError: a projective chain sends a camera to infinity.
    """
    edges = align_submodels(
        result.submodels,
        result.dense,
        result.matches,
        config.alignment,
        next_windows=segments.next_windows,
        loop_segments=segments.loop_indices,
        seed=config.seed,
        advance=lambda _: None,
    )
    stitching = stitch_submodels(
        result.submodels,
        edges.alignments,
        segments.loops.loops,
        segments.view_graph,
        group=GROUPS[config.alignment.transform_group],
        kernel=config.loop_closing.loop_kernel,
    )
    before, _ = largest_trajectory(result, stitching.chained, segments, names)
    after, residual_px = largest_trajectory(result, stitching.parts, segments, names)
    return Solved(edges=edges, stitching=stitching, before=before, after=after, residual_px=residual_px)


def largest_trajectory(
    result: BackboneResult, parts: Sequence[ChainedPart], segments: Segments, names: Sequence[str]
) -> tuple[dict[str, np.ndarray], float]:
    """``world_from_cam`` by name of the part with most images, and its median residual in pixels."""
    part = max(parts, key=lambda part: len({image for p in part.submodels for image in result.submodels[p].images}))
    cameras = fuse_cameras(placed_submodels(result, part, segments.loop_indices), segments.view_graph)
    trajectory = {
        names[image]: pose for image, pose in zip(cameras.images, invert_rigid(cameras.cam_from_world), strict=True)
    }
    residual_px = cameras.residual_px[np.isfinite(cameras.residual_px)]
    return trajectory, float(np.median(residual_px)) if len(residual_px) else math.nan


def placed_submodels(
    result: BackboneResult, part: ChainedPart, loop_segments: frozenset[int]
) -> tuple[PlacedSubmodel, ...]:
    """The submodels of a part with their cameras in its world."""
    return tuple(
        place_submodel(
            result.submodels[p], result.dense[p], world_from_seg, is_loop=result.submodels[p].segment in loop_segments
        )
        for p, world_from_seg in zip(part.submodels, part.world_from_seg, strict=True)
    )


# ----------------------------------------------------------------------------- simulated
@dataclass(frozen=True, kw_only=True, eq=False)
class SimulatedSet:
    """A scene to simulate from.

    Args:
        truth: the scene. errors: simulated, drift for a segment of ``REFERENCE_LENGTH`` images.
        drift_of: whether drift grows with every image (``"image"``), or is the same at the end of a segment
            of any length (``"segment"``), as with a network that sees the whole segment at once.
    """

    truth: TrueScene
    errors: SimulationSettings
    drift_of: DriftOf = "image"

    def run(self, configuration: Configuration, seed: int) -> tuple[Outcome, Trajectories]:
        """One configuration with one seed.

        Raises:
            SmustrError: no trajectory came out of it.
        """
        config = replace(configuration.config, seed=seed)
        num_false = self.num_false_loops(config, configuration.false_share)
        backbone = self._backbone(config, num_false)
        segments = plan_segments(backbone, config)
        result = backbone.reconstruct(segments.all, segments.view_graph, with_maps=range(len(segments.all)))
        false_loops = {maps.submodel.segment for maps in simulated_maps(result) if maps.geometry.false_loop}
        started = time.process_time()
        solved = solve(result, segments, self.truth.names, config)
        seconds = time.process_time() - started
        truth = dict(zip(self.truth.names, self.truth.world_from_cam, strict=True))
        before, after = (compare_trajectories(one, truth) for one in (solved.before, solved.after))
        false = [loop.segment.index in false_loops for loop in segments.loops.loops]
        accepted = [decision.accepted for decision in solved.stitching.decisions]
        sound = [edge for edge in solved.edges.alignments if edge.accepted]
        outcome = Outcome(
            ape=after.position_rmse,
            ape_percent=after.position_rmse_percent,
            aae_deg=after.rotation_mean_deg,
            ape_before=before.position_rmse,
            aae_before_deg=before.rotation_mean_deg,
            placed=len(solved.after),
            models=len(solved.stitching.parts),
            fallbacks=sum(bool(edge.fallback) for edge in sound),
            edges=len(sound),
            residual_px=solved.residual_px,
            found=len(segments.loop_indices),
            closed=sum(accepted),
            found_false=sum(false),
            closed_false=sum(one and other for one, other in zip(false, accepted, strict=True)),
            seconds=seconds,
        )
        return outcome, {
            "without loop closing": moved(solved.before, before),
            "with loop closing": moved(solved.after, after),
            "truth": truth,
        }

    def num_false_loops(self, config: RunConfig, share: float) -> int:
        """Places that only look alike, so that their part of all loops tried is as wanted, or what the scene has."""
        if share == 0:
            return 0
        segments = plan_segments(self._backbone(config, 0), config)
        wanted = math.ceil(len(segments.loop_indices) * share / (1 - share))
        return next(number for number in range(wanted, -1, -1) if self._has_false_loops(config, number))

    def _has_false_loops(self, config: RunConfig, number: int) -> bool:
        try:
            return len(self._backbone(config, number).false_loops) == number
        except ConfigError:
            return False

    def _backbone(self, config: RunConfig, num_false: int) -> SimulatedBackbone:
        errors = self.errors
        if self.drift_of == "segment":
            errors = with_drift_of_segments(errors, config.segmentation.segment_length)
        settings = replace(errors, false_loops=num_false)
        return SimulatedBackbone(self.truth, collection_of(self.truth), settings, seed=config.seed)


def with_drift_of_segments(errors: SimulationSettings, length: int) -> SimulationSettings:
    """The same errors, but a segment of this length drifts as one of ``REFERENCE_LENGTH`` would."""
    shorter = REFERENCE_LENGTH / length
    return replace(
        errors,
        drift_rotation_deg=errors.drift_rotation_deg * math.sqrt(shorter),  # a random walk
        drift_translation=errors.drift_translation * math.sqrt(shorter),
        drift_scale=errors.drift_scale * math.sqrt(shorter),
        chain_rotation_deg=errors.chain_rotation_deg * shorter,  # a steady bend
        chain_scale=errors.chain_scale * shorter,
    )


def plan_segments(backbone: SimulatedBackbone, config: RunConfig) -> Segments:
    """Windows, and the loops between them."""
    graph = ViewGraph.chain(len(backbone.collection))
    windows = plan_windows(
        graph,
        segment_length=config.segmentation.segment_length,
        overlap=config.segmentation.overlap,
    )
    closing = config.loop_closing
    if not closing.loop_closure:
        return Segments.of(graph, windows, NOT_LOOKED_FOR)
    loops = plan_loops(
        backbone.describe(),
        graph,
        windows,
        similarity=closing.loop_similarity,
        min_candidates=closing.loop_min_candidates,
        min_distance=closing.loop_min_distance,
        half_width=closing.loop_window,
    )
    return Segments.of(graph, windows, loops)


def moved(trajectory: Trajectory, evaluation: Evaluation) -> Trajectory:
    """A trajectory in the frame of the truth."""
    names = list(trajectory)
    poses = evaluation.reference_from_estimated.move_cameras(np.array([trajectory[name] for name in names]))
    return dict(zip(names, poses, strict=True))


# ----------------------------------------------------------------------------- classical
@dataclass(frozen=True, kw_only=True, eq=False)
class ClassicalSet:
    """Photographs with known cameras.

    Args:
        images: their folder. truth: ``world_from_cam`` by name. work: one run directory per segment length.
    """

    images: Path
    truth: Trajectory
    work: Path

    def run(self, configuration: Configuration, seed: int) -> tuple[Outcome, Trajectories]:
        """A whole run; what an earlier one with the same segments left is used.

        Raises:
            SmustrError: nothing came out of it.
        """
        config = replace(configuration.config, seed=seed)
        output = self.work / f"segments of {config.segmentation.segment_length}"
        started = time.monotonic()
        summary = reconstruct(self.images, output, config, reporter=QuietReporter(sys.stderr))
        seconds = time.monotonic() - started
        unclosed = output / "trajectory_without_loops_tum.txt"
        with_loops = read_tum_by_name(output, output / "trajectory_tum.txt")
        without = read_tum_by_name(output, unclosed) if unclosed.exists() else with_loops
        before, after = (compare_trajectories(one, self.truth) for one in (without, with_loops))
        sound = [edge for edge in summary.edges if edge.accepted]
        outcome = Outcome(
            ape=after.position_rmse,
            ape_percent=after.position_rmse_percent,
            aae_deg=after.rotation_mean_deg,
            ape_before=before.position_rmse,
            aae_before_deg=before.rotation_mean_deg,
            placed=len(with_loops),
            models=len(summary.models),
            fallbacks=sum(bool(edge.fallback) for edge in sound),
            edges=len(sound),
            residual_px=math.nan,
            found=len(summary.loops),
            closed=sum(loop.accepted for loop in summary.loops),
            found_false=math.nan,
            closed_false=math.nan,
            seconds=seconds,
        )
        return outcome, {
            "without loop closing": moved(without, before),
            "with loop closing": moved(with_loops, after),
            "truth": self.truth,
        }


# -------------------------------------------------------------------------------- tables
@dataclass(frozen=True, kw_only=True)
class Column:
    """How a column is called, and what it says of a row."""

    name: str
    cell: Callable[[Row], str]


def _number(name: str, digits: int = 3) -> Callable[[Row], str]:
    def cell(row: Row) -> str:
        value = row.mean(name)
        return "-" if math.isnan(value) else f"{value:.{digits}g}"

    return cell


def columns(question: str, unit: str) -> tuple[Column, ...]:
    """The columns of the table of one question."""
    always = (
        Column(name=question, cell=lambda row: row.configuration.label),
        Column(name=f"APE {unit}", cell=_number("ape")),
        Column(name="% of extent", cell=_number("ape_percent")),
        Column(name="AAE deg", cell=_number("aae_deg")),
    )
    without = (
        Column(name=f"APE {unit} of the chain", cell=_number("ape_before")),
        Column(name="AAE deg of the chain", cell=_number("aae_before_deg")),
    )
    of_group = (
        Column(name="fallbacks", cell=_number("fallbacks")),
        Column(name="edges", cell=_number("edges")),
        Column(name="resection px", cell=_number("residual_px")),
    )
    of_loops = (
        Column(name="loops found", cell=_number("found")),
        Column(name="closed", cell=_number("closed")),
        Column(name="false found", cell=_number("found_false")),
        Column(name="false closed", cell=_number("closed_false")),
    )
    own = {"groups": (*without, *of_group), "loops": (*without, *of_loops)}.get(question, without)
    return (
        *always,
        *own,
        Column(name="images", cell=_number("placed", 4)),
        Column(name="models", cell=_number("models")),
        Column(name="s", cell=_number("seconds", 2)),
        Column(name="not run", cell=lambda row: "; ".join(row.failures)),
    )


def table(question: str, rows: Sequence[Row], unit: str) -> str:
    """A table in Markdown, padded to be read as it stands; a column of empty cells is left out."""
    cells = [[column.name, *(column.cell(row) for row in rows)] for column in columns(question, unit)]
    cells = [column for column in cells if any(column[1:])]
    widths = [max(map(len, column)) for column in cells]
    lines = [
        "| " + " | ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)) + " |"
        for line in zip(*cells, strict=True)
    ]
    rule = "|" + "|".join("-" * (width + 1) + ":" for width in widths) + "|"
    return "\n".join([lines[0], rule, *lines[1:]])


def as_json(row: Row) -> dict[str, object]:
    """All figures of a row, seed by seed."""
    outcomes = [
        {name: None if math.isnan(value) else value for name, value in asdict(one).items()} for one in row.outcomes
    ]
    return {"label": row.configuration.label, "outcomes": outcomes, "failures": list(row.failures)}


# ---------------------------------------------------------------------------- the script
@dataclass(frozen=True, kw_only=True, eq=False)
class AblatedSet:
    """A set, the configurations that it is put through, and what came of them."""

    name: str
    unit: str
    num_images: int
    metric: bool
    seeds: tuple[int, ...]
    run: Callable[[Configuration, int], tuple[Outcome, Trajectories]]
    rows: list[Row] = field(default_factory=list)


def main() -> int:
    """Ask all questions of all sets; the exit code is 1 when a configuration gave nothing."""
    arguments = parse_arguments()
    sets = []
    for name in arguments.sets:
        one = open_set(name, arguments)
        sets.append(one)
        print(f"\n## {one.name}: {one.num_images} images, {describe_runs(arguments)}", flush=True)
        for question in arguments.only or QUESTIONS:
            rows = [
                run_all(one, each, arguments.pictures) for each in asked(one, arguments) if each.question == question
            ]
            one.rows.extend(rows)
            print(f"\n{table(question, rows, one.unit)}", flush=True)
            if arguments.output:
                write_report(arguments.output, sets, describe_runs(arguments))
    return int(any(row.failures for one in sets for row in one.rows))


def parse_arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sets", nargs="+", metavar="SET", help="a folder, its name in $SMUST3R_DATA, or demo")
    parser.add_argument("--backbone", choices=["simulated", "classical"], default="simulated")
    parser.add_argument("--preset", choices=sorted(PRESETS), default="network", help="simulated errors (%(default)s)")
    parser.add_argument(
        "--drift-of",
        choices=get_args(DriftOf),
        default="image",
        help="the simulated drift grows with every image, or is the same in every segment (%(default)s)",
    )
    parser.add_argument("--seeds", type=int, default=3, help="simulated runs per configuration (%(default)s)")
    parser.add_argument("--only", nargs="+", choices=QUESTIONS, help="these questions; all by default")
    parser.add_argument("--segment-length", type=int, default=60, help="where it is not asked about (%(default)s)")
    parser.add_argument("--lengths", type=int, nargs="+", default=LENGTHS, help="that are asked about (the paper's)")
    parser.add_argument("--all-images", action="store_true", help=f"use all images where there is a {SUBSET_FILE}")
    # An alignment takes a few thousand of a segment's pixels anyway.
    parser.add_argument("--map-size", type=int, default=96, help="of the simulated maps in pixels (%(default)s)")
    parser.add_argument("--demo-images", type=int, default=300, help="of the rendered room (%(default)s)")
    parser.add_argument("--work", type=Path, default=Path("ablation_out"), help="for whole runs (%(default)s)")
    parser.add_argument("--pictures", type=Path, metavar="FOLDER", help="draw the trajectories of the first seed there")
    parser.add_argument("--output", type=Path, metavar="FILE", help="write the tables there: .json, or else Markdown")
    return parser.parse_args()


def describe_runs(arguments: argparse.Namespace) -> str:
    """What stands above the tables."""
    length = arguments.segment_length
    by_default = f"l = {length}, p = {length // 2} where nothing else is said"
    if arguments.backbone == "classical":
        return f"classical backbone, {by_default}"
    errors = f"simulated '{arguments.preset}' with drift of each {arguments.drift_of}"
    return f"{errors}, mean of {arguments.seeds} seeds, {by_default}"


def open_set(name: str, arguments: argparse.Namespace) -> AblatedSet:
    """Find a set by its name."""
    if arguments.backbone == "classical":
        return open_classical(name, arguments)
    if name == "demo":
        truth = TrueScene.from_demo(arguments.demo_images, arguments.map_size * 3 // 4, arguments.map_size)
    else:
        folder = Path(name) if (Path(name) / "images").is_dir() else DATA / name
        subset = folder / SUBSET_FILE
        names = subset.read_text(encoding="utf-8").split() if subset.exists() and not arguments.all_images else None
        truth = TrueScene.from_rgbd_folder(folder, names, max_size=arguments.map_size)
    seeds = tuple(range(arguments.seeds))
    opened = SimulatedSet(truth=truth, errors=PRESETS[arguments.preset], drift_of=arguments.drift_of)
    return AblatedSet(
        name=Path(name).name, unit="m", num_images=len(truth), metric=truth.metric, seeds=seeds, run=opened.run
    )


def open_classical(name: str, arguments: argparse.Namespace) -> AblatedSet:
    """Photographs; the room is rendered first."""
    if name == "demo":
        name = str(arguments.work / "demo" / "set")
        write_demo(Path(name), num_images=arguments.demo_images)
    dataset = open_dataset(name, arguments.work, all_images=arguments.all_images)
    opened = ClassicalSet(images=dataset.images, truth=dataset.truth, work=arguments.work / dataset.name)
    return AblatedSet(
        name=dataset.name, unit=dataset.unit, num_images=dataset.num_images, metric=False, seeds=(0,), run=opened.run
    )


def asked(one: AblatedSet, arguments: argparse.Namespace) -> tuple[Configuration, ...]:
    """The configurations of a set."""
    return questions(
        with_length(RunConfig(), arguments.segment_length),
        num_images=one.num_images,
        lengths=arguments.lengths,
        metric=one.metric,
        simulated=arguments.backbone == "simulated",
    )


def run_all(one: AblatedSet, configuration: Configuration, pictures: Path | None) -> Row:
    """A configuration with every seed; a run that gives nothing is written down as such."""
    outcomes, failures = [], []
    for seed in one.seeds:
        try:
            outcome, trajectories = one.run(configuration, seed)
        except SmustrError as error:
            failures.append(f"seed {seed}: {error}")
            continue
        outcomes.append(outcome)
        if pictures is not None and seed == one.seeds[0]:
            title = f"{one.name}, {configuration.question}: {configuration.label}"
            file = "_".join("".join(c if c.isalnum() else " " for c in title).split()) + ".png"
            pictures.mkdir(parents=True, exist_ok=True)
            draw_trajectories(trajectories, pictures / file, title=title, unit=one.unit)
    return Row(configuration=configuration, outcomes=tuple(outcomes), failures=tuple(failures))


def write_report(path: Path, sets: Sequence[AblatedSet], runs: str) -> None:
    """All tables so far: every seed's figures as JSON, or the means as Markdown."""
    if path.suffix == ".json":
        report: Mapping[str, object] = {
            one.name: {
                question: [as_json(row) for row in one.rows if row.configuration.question == question]
                for question in QUESTIONS
            }
            for one in sets
        }
        path.write_text(json.dumps(report, indent=1), encoding="utf-8")
        return
    parts = []
    for one in sets:
        parts.append(f"## {one.name}: {one.num_images} images, {runs}")
        for question in QUESTIONS:
            rows = [row for row in one.rows if row.configuration.question == question]
            if rows:
                parts.append(table(question, rows, one.unit))
    path.write_text("\n\n".join(parts) + "\n", encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
