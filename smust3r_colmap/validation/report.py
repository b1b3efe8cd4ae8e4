"""The findings and their effect on each reader, as a value, as text and as JSON.

Exit codes: 0 no reader that was asked for refuses the model, 1 it cannot be read to its end, 3 a reader
refuses it. Warnings and notes do not change the code.
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from smust3r_colmap.validation.description import Subject
from smust3r_colmap.validation.readers import Reader
from smust3r_colmap.validation.rules import Evidence, Finding, Rule, Severity

EXIT_GOOD = 0
EXIT_UNREADABLE = 1
EXIT_REFUSED = 3

Verdict = Literal["ok", "warns", "refuses"]

_SEVERITY_WIDTH = 8
_NAMES_SHOWN = 4


@dataclass(frozen=True, kw_only=True)
class ReaderVerdict:
    """Whether one reader can use the model, and the rules that decide it."""

    reader: Reader
    verdict: Verdict
    rules: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Figures:
    """The size of the model; NaN where there is nothing to average.

    Args:
        num_observations: elements of tracks.
        cameras: such as ``PINHOLE 640 x 480``, each once.
    """

    form: str
    num_images: int
    num_cameras: int
    num_points: int
    num_observations: int
    mean_track_length: float
    mean_observations_per_image: float
    mean_error_px: float
    median_error_px: float
    cameras: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Report:
    """Everything that ``validate`` says.

    Args:
        model: folder.
        beside: what else was looked at, by kind (images, database, ...): a path, or why not.
        findings: worst first.
    """

    model: str
    figures: Figures
    beside: Mapping[str, str]
    findings: tuple[Finding, ...]
    verdicts: tuple[ReaderVerdict, ...]

    @property
    def exit_code(self) -> int:
        """See the module."""
        worst = max((finding.severity for finding in self.findings), default=Severity.FACT)
        return {Severity.BROKEN: EXIT_UNREADABLE, Severity.REFUSED: EXIT_REFUSED}.get(worst, EXIT_GOOD)

    def to_json_dict(self) -> dict[str, Any]:
        """For programs; numbers that do not exist are null."""
        figures = {
            name: None if isinstance(value, float) and not np.isfinite(value) else value
            for name, value in vars(self.figures).items()
        }
        return {
            "model": self.model,
            "readable": self.exit_code != EXIT_UNREADABLE,
            "exit_code": self.exit_code,
            "figures": figures,
            "beside": dict(self.beside),
            "findings": [_finding_json(finding) for finding in self.findings],
            "readers": [_verdict_json(verdict) for verdict in self.verdicts],
        }

    def render_text(self, *, width: int | None = None) -> str:
        """For people; every finding is one line, or wrapped at ``width`` letters."""
        findings = [_finding_text(finding, width) for finding in self.findings]
        which = "readable " if self.exit_code == EXIT_UNREADABLE else ""
        return "\n".join(
            [
                f"{self.model}: {_figures_text(self.figures, which)}",
                *(f"  {kind}: {place}" for kind, place in self.beside.items()),
                "",
                *(findings or ["Nothing to note."]),
                "",
                *_readers_text(self.verdicts),
                "",
                _summary(self),
            ]
        )


def assess(
    evidence: Mapping[str, Evidence], rules: Mapping[str, Rule], readers: Iterable[Reader]
) -> tuple[Finding, ...]:
    """Findings with the readers that they affect, worst first, then in the order of the rules; facts without effect are
    left out."""
    readers = tuple(readers)
    findings = []
    for name, found in evidence.items():
        refused_by = {reader.name: reader.refuses[name] for reader in readers if name in reader.refuses}
        warned_by = {reader.name: reader.warns[name] for reader in readers if name in reader.warns}
        by_readers = Severity.REFUSED if refused_by else Severity.WARNING if warned_by else Severity.FACT
        severity = max(rules[name].severity, by_readers)
        if severity > Severity.FACT:
            findings.append(
                Finding(rule=rules[name], evidence=found, severity=severity, refused_by=refused_by, warned_by=warned_by)
            )
    return tuple(sorted(findings, key=lambda finding: -finding.severity))


def verdicts(findings: Sequence[Finding], readers: Iterable[Reader]) -> tuple[ReaderVerdict, ...]:
    """The verdict for each reader."""
    return tuple(_verdict(findings, reader) for reader in readers)


def _verdict(findings: Sequence[Finding], reader: Reader) -> ReaderVerdict:
    refusing = tuple(
        finding.rule.name
        for finding in findings
        if reader.name in finding.refused_by or finding.rule.severity >= Severity.REFUSED
    )
    if refusing:
        return ReaderVerdict(reader=reader, verdict="refuses", rules=refusing)
    warning = tuple(finding.rule.name for finding in findings if reader.name in finding.warned_by)
    return ReaderVerdict(reader=reader, verdict="warns" if warning else "ok", rules=warning)


def measure(subject: Subject) -> Figures:
    """The size of the model, and how well points and observations agree."""
    model, points = subject.model, subject.model.points
    lengths = np.empty(0) if points is None else points.track_length[points.track_length > 0]
    errors = subject.projection.error_px[np.isfinite(subject.projection.error_px)]
    observed = model.images.num_observed
    return Figures(
        form=model.form,
        num_images=len(model.images),
        num_cameras=len(model.cameras),
        num_points=0 if points is None else len(points),
        num_observations=0 if points is None else len(points.track_images),
        mean_track_length=_mean(lengths),
        mean_observations_per_image=_mean(observed),
        mean_error_px=_mean(errors),
        median_error_px=float(np.median(errors)) if len(errors) else float("nan"),
        cameras=tuple(sorted({f"{camera.model} {camera.width} x {camera.height}" for camera in model.cameras})),
    )


def _mean(values: np.ndarray[Any, Any]) -> float:
    return float(values.mean()) if len(values) else float("nan")


def _figures_text(figures: Figures, which: str) -> str:
    """``which`` is put before the things that are counted; it is empty, or ends with a blank."""
    cameras = ", ".join(figures.cameras[:_NAMES_SHOWN]) + (", ..." if len(figures.cameras) > _NAMES_SHOWN else "")
    text = (
        f"{figures.form}, {_counted(figures.num_images, f'{which}image')}, "
        f"{_counted(figures.num_cameras, f'{which}camera')}{cameras and f' ({cameras})'}, "
        f"{_counted(figures.num_points, f'{which}point')}"
    )
    if figures.num_observations:
        text += (
            f", {figures.num_observations:,} observations ({figures.mean_track_length:.1f} a point with a track, "
            f"{figures.mean_observations_per_image:,.0f} an image)"
        )
    if np.isfinite(figures.mean_error_px):
        text += f", reprojection error {figures.mean_error_px:.2f} px mean, {figures.median_error_px:.2f} px median"
    return text


def _counted(number: int, unit: str) -> str:
    return f"{number:,} {unit}{'' if number == 1 else 's'}"


def _finding_text(finding: Finding, width: int | None) -> str:
    parts = [f"{finding.rule.title}: {finding.evidence.text}."]
    if finding.rule.severity >= Severity.REFUSED:
        parts.append("No reader can use it so.")
    if finding.refused_by:
        parts.append(f"Refused by {_who(finding.refused_by)}.")
    if finding.warned_by:
        parts.append(f"Worse in {_who(finding.warned_by)}.")
    parts.append(f"Do: {finding.rule.advice}{'' if finding.rule.advice.endswith('?') else '.'} [{finding.rule.name}]")
    head = f"{finding.severity.name.lower():{_SEVERITY_WIDTH}} "
    line = head + " ".join(parts)
    if width is None:
        return line
    return textwrap.fill(line, width, subsequent_indent=" " * len(head), break_on_hyphens=False, break_long_words=False)


def _who(reasons: Mapping[str, str]) -> str:
    """Readers with the same reason are named together."""
    by_reason: dict[str, list[str]] = {}
    for reader, reason in reasons.items():
        by_reason.setdefault(reason, []).append(reader)
    return "; ".join(f"{', '.join(names)} ({reason})" for reason, names in by_reason.items())


def _readers_text(verdicts: Sequence[ReaderVerdict]) -> list[str]:
    name_width = max((len(verdict.reader.name) for verdict in verdicts), default=0)
    lines = [f"{'reader':{name_width}}  verdict  because of"]
    for verdict in verdicts:
        because = ", ".join(verdict.rules) or f"reads {verdict.reader.reads}"
        seen = "" if verdict.reader.evidence == "run" else " (by its source)"
        lines.append(f"{verdict.reader.name:{name_width}}  {verdict.verdict:7}  {because}{seen}")
    return lines


def _summary(report: Report) -> str:
    refusing = [verdict.reader.name for verdict in report.verdicts if verdict.verdict == "refuses"]
    if report.exit_code == EXIT_UNREADABLE:
        return "The model cannot be read to its end."
    if report.exit_code == EXIT_REFUSED:
        return f"Refused by {len(refusing)} of {len(report.verdicts)} readers: {', '.join(refusing)}."
    return f"None of {_counted(len(report.verdicts), 'reader')} refuses the model."


def _finding_json(finding: Finding) -> dict[str, Any]:
    return {
        "rule": finding.rule.name,
        "severity": finding.severity.name.lower(),
        "title": finding.rule.title,
        "text": finding.evidence.text,
        "count": finding.evidence.count,
        "of": finding.evidence.of or None,
        "unit": finding.evidence.unit or None,
        "example": finding.evidence.example or None,
        "refused_by": dict(finding.refused_by),
        "warned_by": dict(finding.warned_by),
        "advice": finding.rule.advice,
    }


def _verdict_json(verdict: ReaderVerdict) -> dict[str, Any]:
    return {
        "name": verdict.reader.name,
        "program": verdict.reader.program,
        "reads": verdict.reader.reads,
        "evidence": verdict.reader.evidence,
        "verdict": verdict.verdict,
        "rules": list(verdict.rules),
    }
