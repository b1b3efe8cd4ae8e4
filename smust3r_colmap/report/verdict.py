"""Whether a result can be believed: good, weak or failed, with the reasons in order of weight.

A reason weighs what it may spoil: a part of the images, or the predicted error as a part of ``FAILED_PERCENT``.
The next module to read is ``summary``.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from smust3r_colmap.refinement.model_uncertainty import UncertaintySummary
    from smust3r_colmap.report.summary import RunSummary

Level = Literal["good", "weak", "failed"]

MAX_REASONS = 5
WEAK_PERCENT = 1.0
"""Predicted error in percent of the extent from which a result is weak: what users notice in a splat or a mesh."""
WEAK_IMAGE_PERCENT = 3.0
"""The same of a single image; in sound models the largest sigma is about twice the mean."""
FAILED_PERCENT = 10.0
"""Predicted error from which it has failed: the shape of the path is not known."""
_NAMES_SHOWN = 3

_MORE_OVERLAP = "take images between them, with more overlap and a step to the side"
_CHECK = "compare these images in a viewer, and run again without them if they are wrong"


@dataclass(frozen=True, kw_only=True)
class Reason:
    """Why a result is not good.

    Args:
        text: with its numbers.
        advice: what to do.
        weight: from 0 to 1, the part of the result that it may spoil.
    """

    text: str
    advice: str
    weight: float


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """The level, and at most ``MAX_REASONS`` reasons, the heaviest first."""

    level: Level
    reasons: tuple[Reason, ...]


def judge(summary: RunSummary) -> Verdict:
    """Good without any reason; failed if the largest model has no tracks or its shape is not known."""
    reasons = sorted(reasons_of(summary), key=lambda reason: -reason.weight)
    level: Level = "good" if not reasons else "failed" if _has_failed(summary) else "weak"
    return Verdict(level=level, reasons=tuple(reasons[:MAX_REASONS]))


def _has_failed(summary: RunSummary) -> bool:
    if summary.refinements and not summary.refinements[0].succeeded:
        return True
    largest = summary.models[0].uncertainty
    return largest is not None and largest.predicted_error_percent >= FAILED_PERCENT


def reasons_of(summary: RunSummary) -> Iterator[Reason]:
    """All that speaks against a result, in the order of the method."""
    yield from _about_images(summary)
    yield from _about_segments(summary)
    yield from _about_refinement(summary)
    for model in summary.models:
        if model.uncertainty is not None:
            share = model.num_images / max(summary.num_images, 1)
            yield from reasons_about(model.folder, model.uncertainty, share)
    for one in summary.missing_outputs:
        yield Reason(text=f"no {one.name}: {one.reason}", advice="export it again", weight=0.0)


def _about_images(summary: RunSummary) -> Iterator[Reason]:
    images = max(summary.num_images, 1)
    if summary.rejected:
        files = summary.num_images + len(summary.rejected)
        yield Reason(
            text=f"{len(summary.rejected)} of {files} files could not be used",
            advice="convert or remove them",
            weight=len(summary.rejected) / files,
        )
    if summary.unregistered:
        yield Reason(
            text=f"{len(summary.unregistered)} of {summary.num_images} images got no pose",
            advice="add images between them and their neighbours, or try --register-missing",
            weight=len(summary.unregistered) / images,
        )
    if len(summary.models) > 1:
        yield Reason(
            text=f"the images fall into {len(summary.models)} models that could not be connected; "
            f"the largest has {summary.models[0].num_images} of {summary.num_images} images",
            advice="add images between them, or use each model by itself",
            weight=1 - summary.models[0].num_images / images,
        )


def _about_segments(summary: RunSummary) -> Iterator[Reason]:
    segments = summary.segments
    empty = [str(one.index) for one in segments if one.kind != "loop" and not one.num_submodels]
    if empty:
        yield Reason(
            text=f"nothing came out of segment {', '.join(empty)}",
            advice="look at its images: blur, bare walls and turning on the spot are the usual causes",
            weight=len(empty) / len(segments),
        )
    doubted = [one for one in segments if one.warnings]
    if doubted:
        yield Reason(
            text=f"the geometry of {len(doubted)} of {len(segments)} segments should not be trusted, such as "
            f"segment {doubted[0].index}: {doubted[0].warnings[0]}",
            advice="compare the cameras of these segments in a viewer",
            weight=len(doubted) / len(segments),
        )


def _about_refinement(summary: RunSummary) -> Iterator[Reason]:
    if summary.refinements and not summary.refinements[0].succeeded:
        yield Reason(
            text=f"the largest model has no tracks: {summary.refinements[0].reason}",
            advice="take more texture and overlap; its poses are the initial ones",
            weight=1.0,
        )
    folders = [model.folder for model in summary.models]
    refined = [(name, one) for name, one in zip(folders, summary.refinements, strict=False) if one.succeeded]
    num_weak = sum(len(one.weak) for _, one in refined)
    if num_weak:
        yield Reason(
            text=f"{num_weak} images have too few observations; they keep their initial pose",
            advice="leave them out, or add images beside them",
            weight=num_weak / max(summary.num_images, 1),
        )
    for folder, one in refined:
        for warning in one.warnings:
            yield Reason(text=f"{folder}: {warning}", advice=_CHECK, weight=0.5)


def reasons_about(folder: str, found: UncertaintySummary, share: float) -> Iterator[Reason]:
    """What the uncertainty of a model with this share of all images says against it."""
    error = found.predicted_error_percent
    if found.contradicted:
        yield Reason(
            text=f"{folder}: most matches contradict {len(found.contradicted)} of {found.num_images} images "
            f"({_listed(found.contradicted_stretches)})",
            advice=_CHECK,
            weight=share * len(found.contradicted) / found.num_images,
        )
    if found.undetermined:
        yield Reason(
            text=f"{folder}: no observations determine the pose of {len(found.undetermined)} images "
            f"({_listed(found.undetermined)})",
            advice=_MORE_OVERLAP,
            weight=share * len(found.undetermined) / found.num_images,
        )
    if error >= WEAK_PERCENT or found.max_position_percent >= WEAK_IMAGE_PERCENT:
        yield Reason(
            text=f"{folder}: predicted error {error:.3g} % of the extent, {found.max_position_percent:.3g} % "
            f"at {found.least_certain}",
            advice="add images where the weak links are",
            weight=share * min(error / FAILED_PERCENT, 1.0),
        )
    for link in found.weak_links:
        if link.side_percent >= WEAK_PERCENT:
            yield Reason(
                text=f"{folder}: between {link.before} and {link.after} the scale rests on {link.num_scale_points:.0f} "
                f"of {link.num_points} points, +-{link.scale_percent:.2g} %, the rotation +-{link.rotation_deg:.2g} "
                f"deg; {link.num_smaller} images may be off by {link.side_percent:.2g} % of the extent",
                advice=_MORE_OVERLAP,
                weight=share * min(link.side_percent / FAILED_PERCENT, 1.0),
            )


def _listed(names: tuple[str, ...]) -> str:
    more = f" and {len(names) - _NAMES_SHOWN} more" if len(names) > _NAMES_SHOWN else ""
    return f"{', '.join(names[:_NAMES_SHOWN])}{more}"
