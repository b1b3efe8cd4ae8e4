"""Tables of the comparison with COLMAP: for a terminal, for a Markdown page, and as JSON.

What is in them is measured in ``comparison_figures``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any

from comparison_figures import GLOBAL, INCREMENTAL, Dataset, Result, Verdict, decisions

MET, MISSED = "met", "MISSED"


# ----------------------------------------------------------------------------- terminal
def render_table(dataset: Dataset, results: Sequence[Result]) -> str:
    """One line per method, and under it the decisions on ours."""
    header = ["method", "images", "models", f"rms {dataset.unit}", "% extent", "rot deg med", "mean"]
    header += ["px", "track", "points", "obs/image", "jumps"]
    header += ["CPU/wall s feat", "match", "map", "rest", "all", "MiB", ""]
    lines = [header, *(_line(result, dataset.num_images) for result in results)]
    title = f"\n{dataset.name}: {dataset.num_images} images, {len(dataset.truth)} with a known camera"
    blocks = [title, _aligned(lines)]
    mappers = [result for result in results if not result.is_ours]
    for ours in (result for result in results if result.is_ours):
        found = decisions(dataset, ours, mappers)
        if found:
            blocks.append(f"{ours.method} beside COLMAP:\n" + "\n".join(f"  {_sentence(one)}" for one in found))
    return "\n".join(blocks)


def render_stages(dataset: Dataset, ours: Result) -> str:
    """What each stage did to the cameras, a line per stage."""
    header = ["after", "images", f"rms {dataset.unit}", "% extent", "rot deg med", "mean"]
    lines = [
        [
            stage,
            str(found.num_compared),
            f"{found.position_rmse:.4g}",
            f"{found.position_rmse_percent:.3g}",
            f"{found.rotation_median_deg:.3g}",
            f"{found.rotation_mean_deg:.3g}",
        ]
        for stage, found in ours.stages.items()
    ]
    return "\n".join([f"\n{dataset.name}, {ours.method}, stage by stage", _aligned([header, *lines])])


def _line(result: Result, num_images: int) -> list[str]:
    """The cells of a method; images of the largest model / of all models / that there are."""
    accuracy, figures = ["-"] * 4, ["-"] * 4
    if (found := result.evaluation) is not None:
        accuracy = [f"{found.position_rmse:.4g}", f"{found.position_rmse_percent:.3g}"]
        accuracy += [f"{found.rotation_median_deg:.3g}", f"{found.rotation_mean_deg:.3g}"]
    if (own := result.figures) is not None:
        figures = [f"{own.reprojection_error_px:.3f}", f"{own.mean_track_length:.2f}"]
        figures += [str(own.num_points), f"{own.observations_per_image:.0f}"]
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
        *figures,
        "-" if result.jumps is None else str(len(result.jumps)),
        *stages,
        f"{sum(cost.cpu_s for cost in costs.values()):.0f}/{sum(cost.wall_s for cost in costs.values()):.0f}",
        f"{max(cost.peak_mib for cost in costs.values()):.0f}",
        result.note,
    ]


def _sentence(decision: Verdict) -> str:
    target = f"; {decision.target}: {_mark(decision)}" if decision.target else ""
    return f"{decision.figure}: {decision.ours:.4g} to {decision.yardstick:.4g}, {_times(decision.ratio)}{target}"


def _mark(decision: Verdict) -> str:
    if decision.met is None:
        return ""
    return MET if decision.met else MISSED


def _times(ratio: float) -> str:
    return "no ratio" if math.isnan(ratio) else f"{ratio:.2f} x"


def _aligned(lines: Sequence[Sequence[str]]) -> str:
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join(
        "  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)).rstrip() for line in lines
    )


# ----------------------------------------------------------------------------- Markdown
def render_markdown(compared: Sequence[tuple[Dataset, Sequence[Result]]]) -> str:
    """One table of all sets, ours / incremental / global in every cell, and one of the stages where asked for."""
    header = ["set", *(name for name, _ in _COLUMNS)]
    rows = [_markdown_row(dataset, ours, results) for dataset, results in compared for ours in results if ours.is_ours]
    staged = [(dataset, ours) for dataset, results in compared for ours in results if ours.stages]
    parts = [
        "Each cell: ours / COLMAP incremental / COLMAP global, then our ratio to the better of the two (cost: to "
        f"the incremental one) and whether the target is {MET} or {MISSED}.",
        _markdown_table([header, *rows]),
    ]
    if staged:
        parts.append(_markdown_stages(staged))
    return "\n\n".join(parts) + "\n"


Number = Callable[[Result], str]


def _of_evaluation(attribute: str, digits: int) -> Number:
    def cell(result: Result) -> str:
        found = result.evaluation
        return "-" if found is None else f"{getattr(found, attribute):.{digits}g}"

    return cell


def _of_figures(attribute: str, form: str) -> Number:
    def cell(result: Result) -> str:
        value = math.nan if result.figures is None else getattr(result.figures, attribute)
        return "-" if math.isnan(value) else format(value, form)

    return cell


def _of_mapping(attribute: str) -> Number:
    def cell(result: Result) -> str:
        return f"{getattr(result.costs['mapping'], attribute):.0f}" if "mapping" in result.costs else "-"

    return cell


_COLUMNS: tuple[tuple[str, Number], ...] = (
    ("registered", lambda result: str(result.registered_largest)),
    ("position rms", _of_evaluation("position_rmse", 3)),
    ("rotation median", _of_evaluation("rotation_median_deg", 3)),
    ("rotation mean", _of_evaluation("rotation_mean_deg", 3)),
    ("reprojection error", _of_figures("reprojection_error_px", ".2f")),
    ("track length", _of_figures("mean_track_length", ".2f")),
    ("points", _of_figures("num_points", "d")),
    ("observations per image", _of_figures("observations_per_image", ".0f")),
    ("mapping CPU", _of_mapping("cpu_s")),
    ("mapping wall", _of_mapping("wall_s")),
    ("jumps", lambda result: "-" if result.jumps is None else str(len(result.jumps))),
)


def _markdown_row(dataset: Dataset, ours: Result, results: Sequence[Result]) -> list[str]:
    by_method = {result.method: result for result in results}
    mappers = [by_method[name] for name in (INCREMENTAL, GLOBAL) if name in by_method]
    found = {one.figure: one for one in decisions(dataset, ours, mappers)}
    cells = [f"{dataset.name} ({dataset.num_images}, {dataset.unit}), {ours.method}"]
    for name, number in _COLUMNS:
        theirs = [number(by_method[one]) if one in by_method else "-" for one in (INCREMENTAL, GLOBAL)]
        cell = " / ".join([number(ours), *theirs])
        if name in found:
            ratio = "" if math.isnan(found[name].ratio) else f" ({found[name].ratio:.2f})"
            cell = f"{cell}{ratio} {_mark(found[name])}".rstrip()
        cells.append(cell)
    return cells


def _markdown_stages(staged: Sequence[tuple[Dataset, Result]]) -> str:
    """Position rms and median of the rotation after each stage, a row per set."""
    stages = list(dict.fromkeys(stage for _, ours in staged for stage in ours.stages))
    rows = []
    for dataset, ours in staged:
        found = [ours.stages.get(stage) for stage in stages]
        cells = ["-" if one is None else f"{one.position_rmse:.3g}, {one.rotation_median_deg:.2g} deg" for one in found]
        rows.append([f"{dataset.name} ({dataset.unit}), {ours.method}", *cells])
    return _markdown_table([["position rms, rotation median", *stages], *rows])


def _markdown_table(lines: Sequence[Sequence[str]]) -> str:
    first, *others = ["| " + " | ".join(line) + " |" for line in lines]
    return "\n".join([first, "|" + "---|" * len(lines[0]), *others])


# --------------------------------------------------------------------------------- JSON
def as_json(dataset: Dataset, results: Sequence[Result]) -> list[dict[str, Any]]:
    """Everything that is known of each method, with numbers and strings only; NaN becomes null."""
    mappers = [result for result in results if not result.is_ours]
    return [
        _without_nan(
            {
                **vars(result),
                "costs": {stage: asdict(cost) for stage, cost in result.costs.items()},
                "figures": None if result.figures is None else asdict(result.figures),
                "evaluation": None if result.evaluation is None else _facts(result.evaluation),
                "jumps": None if result.jumps is None else [asdict(jump) for jump in result.jumps],
                "stages": {stage: _facts(found) for stage, found in result.stages.items()},
                "decisions": [asdict(one) for one in decisions(dataset, result, mappers)] if result.is_ours else [],
            }
        )
        for result in results
    ]


def _facts(evaluation: Any) -> dict[str, Any]:
    facts = {**vars(evaluation), "position_rmse_percent": evaluation.position_rmse_percent}
    return {key: value for key, value in facts.items() if key != "reference_from_estimated"}


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(one) for key, one in value.items()}
    if isinstance(value, list):
        return [_without_nan(one) for one in value]
    return None if isinstance(value, float) and math.isnan(value) else value
