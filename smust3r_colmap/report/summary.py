"""What came out of a run, for people (``render_text``), programs (``to_json_dict``) and the shell.

``summarise`` fills a ``RunSummary``; nothing here measures or decides anything about geometry. The next module to read
is ``cli.console``, which prints it.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from smust3r_colmap.execution.progress import format_seconds
from smust3r_colmap.execution.stage_clock import StageSummary
from smust3r_colmap.report.verdict import Verdict, judge, reasons_of

if TYPE_CHECKING:  # the command line imports this module, and shall not load numpy for --help
    from smust3r_colmap.alignment.stage import EdgeSummary
    from smust3r_colmap.backbones.stage import SegmentSummary
    from smust3r_colmap.exporters.registry import MissingOutput
    from smust3r_colmap.products import CloudStatistics
    from smust3r_colmap.refinement.model_uncertainty import UncertaintySummary
    from smust3r_colmap.refinement.statistics import SceneRefinement
    from smust3r_colmap.stitching.stage import CameraFusionSummary, GraphSummary, LoopSummary

SCHEMA_VERSION = 2
"""Of ``summary.json``; raised when a name in it changes its meaning or goes."""

EXIT_GOOD = 0
EXIT_DEGRADED = 3

# More names than this are counted, not listed, in the text for people; the JSON has them all.
_NAMES_SHOWN = 5


@dataclass(frozen=True, kw_only=True)
class ModelSummary:
    """One COLMAP model.

    Args:
        folder: relative to the output folder, with forward slashes, such as ``sparse/0``.
        num_images: images with a pose in this model.
        num_points: points of its fused cloud.
        metric: lengths are metres.
        segments: names of the submodels that were stitched.
        cameras: how well the submodels agree on the cameras; None where nothing was stitched.
        cloud: how the dense cloud came about; None where nothing was fused.
        uncertainty: of the adjusted poses; None where nothing was adjusted.
    """

    folder: str
    num_images: int
    num_points: int
    metric: bool
    segments: tuple[str, ...]
    cameras: CameraFusionSummary | None
    cloud: CloudStatistics | None
    uncertainty: UncertaintySummary | None = None


@dataclass(frozen=True, kw_only=True)
class ImageNote:
    """An image that is missing from the result, and why."""

    name: str
    reason: str


@dataclass(frozen=True, kw_only=True)
class RunSummary:
    """The whole run.

    Args:
        output: the output folder.
        num_images: images that could be read.
        num_registered: distinct images with a pose in at least one model.
        num_keyframes: images that were reconstructed in segments; the others were registered to the refined model.
            None where nothing was segmented.
        order: whether the images are a sequence, and why; empty where nothing was segmented.
        models: largest first.
        rejected: files that could not be used.
        unregistered: images that were read but have no pose in any model.
        stages: in the order in which they ran.
        segments: in the order of the plan.
        edges: alignments that were tried.
        loops: that were planned. loops_note: why none could be looked for, or empty.
        graph: the optimisation of the frames of all submodels; None where nothing was stitched.
        peak_memory_bytes: largest resident size of this process or of one of its children.
        refinements: one per model, in their order; empty if refinement was switched off.
        missing_outputs: parts of the result that could not be written.
        notes: what was left out of those that were written.

    Raises:
        ValueError: the counts contradict each other, or there is no model.
    """

    output: Path
    num_images: int
    num_registered: int
    models: tuple[ModelSummary, ...]
    rejected: tuple[ImageNote, ...]
    unregistered: tuple[ImageNote, ...]
    stages: tuple[StageSummary, ...]
    segments: tuple[SegmentSummary, ...]
    edges: tuple[EdgeSummary, ...]
    loops: tuple[LoopSummary, ...]
    loops_note: str
    graph: GraphSummary | None
    peak_memory_bytes: int
    refinements: tuple[SceneRefinement, ...] = ()
    missing_outputs: tuple[MissingOutput, ...] = ()
    notes: tuple[str, ...] = ()
    num_keyframes: int | None = None
    order: str = ""

    def __post_init__(self) -> None:
        if not self.models:
            raise ValueError("RunSummary: a run without a model has failed and has no summary")
        if self.num_registered + len(self.unregistered) != self.num_images:
            raise ValueError(
                f"RunSummary: {self.num_registered} registered and {len(self.unregistered)} unregistered images "
                f"do not make {self.num_images}"
            )

    @property
    def metric(self) -> bool:
        """Every model is in metres."""
        return all(model.metric for model in self.models)

    @property
    def scale_statement(self) -> str:
        """What one unit of length is."""
        return "metres" if self.metric else "arbitrary (one unit has no length in metres)"

    @property
    def weak_reasons(self) -> tuple[str, ...]:
        """Why the result falls short; empty when it does not."""
        return tuple(reason.text for reason in reasons_of(self))

    @property
    def verdict(self) -> Verdict:
        """Whether the result can be believed, and the heaviest reasons why not."""
        return judge(self)

    @property
    def exit_code(self) -> int:
        """For the shell: good, or finished with warnings."""
        return EXIT_DEGRADED if self.weak_reasons else EXIT_GOOD

    def to_json_dict(self) -> dict[str, Any]:
        """For ``summary.json``: numbers, strings, lists and null only; NaN becomes null.

        The output folder is left out, because the file lies in it and the folder may move.
        """
        facts = asdict(self)
        del facts["output"]
        facts["schema_version"] = SCHEMA_VERSION
        facts["scale"] = self.scale_statement
        facts["weak_reasons"] = list(self.weak_reasons)
        facts["verdict"] = asdict(self.verdict)
        plain = _without_nan(facts)
        assert isinstance(plain, dict)
        return plain

    def render_text(self) -> str:
        """Several lines for people, ending without a line break."""
        lines = [f"{self.num_registered} of {self.num_images} images have a pose. Scale: {self.scale_statement}."]
        lines += [f"  {_model_line(model)}" for model in self.models]
        lines += _loop_lines(self.loops, self.loops_note)
        for model, one in zip(self.models, self.refinements, strict=False):
            lines += _refinement_lines(model.folder, one)
        lines += _remark_lines("without a pose", self.unregistered)
        lines += _remark_lines("left out", self.rejected)
        lines += [f"  {note}" for note in self.notes]
        lines += [line for model in self.models for line in _uncertainty_lines(model)]
        lines += _verdict_lines(self.verdict, len(self.weak_reasons))
        lines.append(self._cost_line())
        lines.append(f"Result in {self.output}")
        return "\n".join(lines)

    def _cost_line(self) -> str:
        wall_s = sum(stage.wall_s for stage in self.stages)
        cpu_s = sum(stage.cpu_s for stage in self.stages)
        reused = [stage.name for stage in self.stages if stage.reused]
        line = f"Took {format_seconds(wall_s)} (processor time {format_seconds(cpu_s)}), "
        line += f"at most {self.peak_memory_bytes / 2**30:.1f} GiB of memory per process"
        return f"{line}; reused from an earlier run: {', '.join(reused)}" if reused else line


def _model_line(model: ModelSummary) -> str:
    segments = f"segments {', '.join(model.segments)}" if len(model.segments) > 1 else "one segment"
    return f"{model.folder}: {model.num_images} images, {model.num_points} points, {segments}"


def _refinement_lines(folder: str, one: SceneRefinement) -> list[str]:
    if not one.succeeded:
        return [f"  {folder}: no tracks ({one.reason})"]
    found = one.statistics
    lines = [
        f"  {folder}: {found.num_observations} observations of {found.num_points} points "
        f"(track length {found.mean_track_length:.2f}), reprojection error {found.reprojection_error_px:.2f} px",
        f"  {folder}: principal point {one.principal_point}",
    ]
    lines += [f"  {folder}: {step.name} rejected, {step.reason}" for step in one.steps if not step.accepted]
    for what, names in (("few observations", one.weak), ("registered by the refinement", one.registered)):
        if names:
            more = f" and {len(names) - _NAMES_SHOWN} more" if len(names) > _NAMES_SHOWN else ""
            lines.append(f"  {folder}: {what}: {', '.join(names[:_NAMES_SHOWN])}{more}")
    return lines


def _uncertainty_lines(model: ModelSummary) -> list[str]:
    found = model.uncertainty
    if found is None:
        return []
    return [
        f"  {model.folder}: predicted error {found.predicted_error_percent:.3g} % of the extent (rms), "
        f"{found.max_position_percent:.3g} % at {found.least_certain}"
    ]


def _verdict_lines(verdict: Verdict, num_reasons: int) -> list[str]:
    lines = [f"{verdict.level}: {reason.text}; {reason.advice}" for reason in verdict.reasons]
    if num_reasons > len(lines):
        lines.append(f"{verdict.level}: {num_reasons - len(lines)} more reasons, see summary.json")
    return lines or [f"{verdict.level}"]


def _loop_lines(loops: tuple[LoopSummary, ...], note: str) -> list[str]:
    if not loops:
        return [f"  no loops: {note}"] if note else []
    closed = [loop for loop in loops if loop.accepted]
    lines = [f"  {len(closed)} of {len(loops)} loops closed"]
    for loop in closed[:_NAMES_SHOWN]:
        line = f"  loop: {loop.image_a} and {loop.image_b}"
        if math.isfinite(loop.gap_before_percent):
            line += f", gap {loop.gap_before_percent:.2f} % of the extent before, {loop.gap_after_percent:.2f} % after"
        else:
            line += ", between parts that no overlap connects"
        lines.append(line)
    return lines


def _remark_lines(what: str, notes: tuple[ImageNote, ...]) -> list[str]:
    lines = [f"  {what}: {note.name} ({note.reason})" for note in notes[:_NAMES_SHOWN]]
    if len(notes) > _NAMES_SHOWN:
        lines.append(f"  {what}: {len(notes) - _NAMES_SHOWN} more, see summary.json")
    return lines


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_without_nan(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
