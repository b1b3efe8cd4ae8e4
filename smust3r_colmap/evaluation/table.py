"""The rows of an evaluation for people, as JSON and as CSV."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from dataclasses import asdict, fields

from smust3r_colmap.evaluation.absolute_error import Statistics
from smust3r_colmap.evaluation.evaluate import EvaluationReport, Row

_STATISTICS = tuple(one.name for one in fields(Statistics))
_CSV_COLUMNS = (
    "metric",
    "statistic",
    "value",
    "unit",
    "alignment",
    "association",
    "compared",
    "in_estimate",
    "in_reference",
    "note",
)


def render_text(evaluation: EvaluationReport) -> str:
    """Two tables: errors with their statistics, and all other figures."""
    with_statistics = [row for row in evaluation.rows if tuple(row.values) == _STATISTICS]
    others = [row for row in evaluation.rows if tuple(row.values) != _STATISTICS]
    poses = "compared/estimate/reference"
    first = [["", *_STATISTICS, "unit", "alignment", poses, "association"]]
    first += [[row.metric, *map(_number, row.values.values()), row.unit, *_facts(row)] for row in with_statistics]
    second = [["", "figures", "alignment", poses, "association"]]
    second += [[row.metric, _figures(row), *_facts(row)] for row in others]
    explained: dict[str, str] = {}  # by the note, the metrics that have it
    for row in evaluation.rows:
        if row.note:
            explained[row.note] = f"{explained[row.note]}, {row.metric}" if row.note in explained else row.metric
    lines = [f"estimate:  {evaluation.estimate}", f"reference: {evaluation.reference}", "", *_aligned(first), ""]
    lines += [*_aligned(second), "", *(f"{metrics}: {note}" for note, metrics in explained.items())]
    return "\n".join([*lines, *evaluation.notes])


def render_json(evaluation: EvaluationReport) -> str:
    """An object; a figure that is not determined is null."""
    return json.dumps(asdict(evaluation), indent=1) + "\n"


def render_csv(evaluation: EvaluationReport) -> str:
    """One line per figure; the value of one that is not determined is empty."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(_CSV_COLUMNS)
    for row in evaluation.rows:
        facts = [row.unit, row.alignment, row.association, row.compared, row.in_estimate, row.in_reference, row.note]
        for statistic, value in row.values.items():
            writer.writerow([row.metric, statistic, "" if value is None else repr(value), *facts])
    return text.getvalue()


def _facts(row: Row) -> list[str]:
    return [row.alignment, f"{row.compared}/{row.in_estimate}/{row.in_reference}", row.association]


def _figures(row: Row) -> str:
    unit = f" ({row.unit})" if row.unit else ""
    return ", ".join(f"{name} {_number(value)}" for name, value in row.values.items()) + unit


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"


def _aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
