"""The page of a report: one HTML file that needs nothing from elsewhere and runs no script.

The policy in its head forbids every request. The order is that of the questions of a reader: can I trust it, which
images are in it, what shape has it, do all matches agree, where is it weak, are the cameras sound, what did it cost.
The next module to read is ``model_sections``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from smust3r_colmap.execution.progress import format_seconds
from smust3r_colmap.report import charts
from smust3r_colmap.report.facts import REGISTERED, STATES, ImageFacts, ModelFacts, ReportFacts
from smust3r_colmap.report.markup import (
    Markup,
    details,
    joined,
    jpeg_uri,
    number,
    paragraph,
    section,
    sentence,
    table,
    tag,
)
from smust3r_colmap.report.model_sections import (
    anchor_of,
    cameras,
    histograms,
    link_to,
    plan,
    verification_matrix,
    weakest_links,
)
from smust3r_colmap.report.style import STYLE
from smust3r_colmap.report.verdict import FAILED_PERCENT, WEAK_IMAGE_PERCENT, WEAK_PERCENT

POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'"
"""Nothing may be loaded, nothing may run; pictures are in the page."""
MAX_ROWS = 500
"""Of the tables of images with a problem and of loops."""
MAX_OPEN_ROWS, MAX_OPEN_THUMBNAILS = 40, 60
"""More are folded away at first."""


def render(facts: ReportFacts) -> str:
    """The whole page."""
    model = facts.model
    sections = [
        _head(facts),
        _verdict(facts),
        _images(facts),
        *(() if model is None else _sections_of(model, facts)),
        _loops(facts.summary),
        _models(facts.summary),
        _cost(facts.summary),
        _georeference(facts.geo),
        _products(facts),
        _settings(facts),
    ]
    head = tag(
        "head",
        tag("meta", charset="utf-8"),
        tag("meta", http_equiv="Content-Security-Policy", content=POLICY),
        tag("meta", name="viewport", content="width=device-width, initial-scale=1"),
        tag("meta", name="generator", content="smust3r-colmap"),
        tag("title", f"Reconstruction of {facts.what}: {facts.verdict.level}"),
        tag("style", Markup(STYLE)),
    )
    body = tag("body", tag("main", joined(sections, "\n")))
    return f"<!DOCTYPE html>\n{tag('html', head, body, lang='en')}\n"


def _sections_of(model: ModelFacts, facts: ReportFacts) -> Iterator[Markup]:
    yield plan(model, facts.summary)
    yield verification_matrix(model, facts.images)
    yield weakest_links(model)
    yield cameras(model)
    yield histograms(model)


def _head(facts: ReportFacts) -> Markup:
    num_posed = sum(image.model != "" for image in facts.images)
    tiles = [("images with a pose", f"{num_posed} of {len(facts.images)}")]
    if facts.model is not None:
        tiles += _tiles(facts.model, facts.summary)
    return tag(
        "header",
        tag("h1", f"Reconstruction of {facts.what}"),
        tag("p", facts.verdict.level, class_=f"level {facts.verdict.level}"),
        tag("dl", *(tag("div", tag("dt", name), tag("dd", value)) for name, value in tiles)),
    )


def _tiles(model: ModelFacts, summary: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """The most important numbers, and what they are."""
    errors = model.observed.errors_px
    yield "models", str(len(summary["models"]) if "models" in summary else 1)
    yield "points", number(len(model.observed.track_lengths))
    yield "reprojection error", f"{number(float(errors.mean()))} px" if len(errors) else "-"
    if model.uncertainty is not None:
        yield "predicted error", f"{number(model.uncertainty.predicted_error_percent)} % of the extent"
    if "scale" in summary:
        yield "one unit of length", summary["scale"].split(" (")[0]


def _verdict(facts: ReportFacts) -> Markup:
    reasons = [tag("li", tag("b", reason.text), ". ", sentence(reason.advice)) for reason in facts.verdict.reasons]
    content = [tag("ol", *reasons)] if reasons else [paragraph("Nothing speaks against the result.")]
    if facts.num_more_reasons > 0:
        content.append(paragraph(f"{facts.num_more_reasons} more reasons are in summary.json."))
    notes = (note for key in ("notes", "model_notes") for note in facts.summary.get(key, ()))
    content += [paragraph(sentence(note)) for note in notes]
    rule = (
        f"Weak: any reason, among them a predicted error of {WEAK_PERCENT:g} % of the extent of the path, or "
        f"{WEAK_IMAGE_PERCENT:g} % for one image. Failed: {FAILED_PERCENT:g} %, or a largest model without tracks. "
        "The predicted error is the root mean square of the standard deviations of the camera positions."
    )
    return section("verdict", "Verdict", *content, tag("p", rule, class_="rule"))


# ---------------------------------------------------------------------------- the images
def _images(facts: ReportFacts) -> Markup:
    images = facts.images
    counts = [sum(image.state == state for image in images) for state in range(len(STATES))]
    key = [(f"s{state}", f"{STATES[state]}: {count}") for state, count in enumerate(counts) if count]
    content = [
        charts.strip([image.state for image in images], [image.name for image in images], STATES),
        charts.colour_key(key),
    ]
    troubled = [image for image in images if image.state != REGISTERED]
    if troubled:
        rows = [
            (link_to(image), f"{STATES[image.state]}{f': {image.note}' if image.note else ''}")
            for image in troubled[:MAX_ROWS]
        ]
        title = f"{len(troubled)} images with a problem"
        shown = table(("image", "state"), rows)
        content.append(details(title, shown, is_open=len(troubled) <= MAX_OPEN_ROWS))
        if len(troubled) > MAX_ROWS:
            content.append(paragraph(f"{len(troubled) - MAX_ROWS} more are in summary.json."))
    if facts.thumbnails_note:
        content.append(tag("p", sentence(facts.thumbnails_note), class_="rule"))
    cards = [_card(image) for image in images if image.thumbnail]
    if cards:
        pictures = tag("ul", joined(cards, "\n"), class_="cards")
        content.append(details(f"{len(cards)} thumbnails", pictures, is_open=len(cards) <= MAX_OPEN_THUMBNAILS))
    return section("images", "Images", *content)


def _card(image: ImageFacts) -> Markup:
    said = [STATES[image.state]] if image.state != REGISTERED else []
    if image.note:
        said.append(image.note)
    if np.isfinite(image.num_observations):
        said.append(f"{number(image.num_observations)} observations, {number(image.error_px)} px")
    if np.isfinite(image.sigma_percent):
        said.append(f"± {number(image.sigma_percent)} % of the extent")
    picture = tag("img", src=jpeg_uri(image.thumbnail), alt="")
    lines = (tag("span", one) for one in said)
    return tag("li", picture, tag("b", image.name), *lines, id=anchor_of(image), class_=f"b{image.state}")


# ------------------------------------------------------------------ what the summary says
def _loops(summary: Mapping[str, Any]) -> Markup:
    loops = summary.get("loops", ())
    if not loops:
        note = summary.get("loops_note", "")
        return section("loops", "Loops", paragraph(sentence(f"no loops: {note}"))) if note else Markup("")
    rows = [
        (
            one["image_a"],
            one["image_b"],
            "closed" if one["accepted"] else f"refused: {one['reason']}",
            number(one["gap_before_percent"]),
            number(one["gap_after_percent"]),
            number(one["closure_sigmas"]),
        )
        for one in loops[:MAX_ROWS]
    ]
    head = ("image", "and", "", "gap before, % of the extent", "after", "before, in standard deviations")
    return section("loops", "Loops", table(head, rows))


def _models(summary: Mapping[str, Any]) -> Markup:
    models = summary.get("models", ())
    if not models:
        return Markup("")
    refinements = [*summary["refinements"], *[None] * len(models)]
    rows = [
        (
            one["folder"],
            one["num_images"],
            number(one["num_points"]),
            "-" if refined is None else "yes" if refined["succeeded"] else f"no: {refined['reason']}",
            "-" if one["uncertainty"] is None else f"{number(one['uncertainty']['predicted_error_percent'])} %",
        )
        for one, refined in zip(models, refinements, strict=False)
    ]
    head = ("model", "images", "points of the cloud", "adjusted to tracks", "predicted error")
    return section("models", "Models", table(head, rows))


def _cost(summary: Mapping[str, Any]) -> Markup:
    stages = summary.get("stages", ())
    if not stages:
        return Markup("")
    most = max(*(stage["wall_s"] for stage in stages), 1e-9)
    rows: list[tuple[object, ...]] = [
        (
            stage["name"],
            tag("span", class_="wall", style=f"width: {100 * stage['wall_s'] / most:.1f}%"),
            "reused" if stage["reused"] else format_seconds(stage["wall_s"]),
            format_seconds(stage["cpu_s"]),
        )
        for stage in stages
    ]
    wall_s, cpu_s = (sum(stage[key] for stage in stages) for key in ("wall_s", "cpu_s"))
    rows.append((tag("b", "all"), "", tag("b", format_seconds(wall_s)), tag("b", format_seconds(cpu_s))))
    memory = f"The largest process took {summary['peak_memory_bytes'] / 2**30:.1f} GiB of memory."
    return section("cost", "Cost", table(("stage", "", "time", "processor time"), rows), paragraph(memory))


def _georeference(geo: Mapping[str, Any]) -> Markup:
    """Where on earth the model is, and how far the survey is from it."""
    if not geo:
        return Markup("")
    crs = "coordinates of a site"
    if geo["crs"] is not None:
        code = f"EPSG:{geo['crs']['epsg']} ({geo['crs']['name']})" if geo["crs"]["epsg"] else geo["crs"]["name"]
        crs = f"{code}, vertical datum: {geo['crs']['vertical']}"
    said = f"{sentence(crs)} One unit of the model is {number(geo['metres_per_unit'], 6)} m. Placed by {geo['basis']}."
    rows = [
        (
            name.replace("_", " "),
            one["count"],
            *(f"{value:.3f}" if value is not None else "-" for value in one["rmse"]),
            *(f"{one[key]:.3f}" if one[key] is not None else "-" for key in ("horizontal", "spatial", "ce90", "le90")),
        )
        for name, one in geo["accuracy_m"].items()
    ]
    head = ("surveyed less computed, m", "n", "RMSE x", "y", "z", "horizontal", "3D", "CE90", "LE90")
    notes = [paragraph(sentence(note)) for key in ("faults", "warnings") for note in geo[key]]
    return section("georeference", "Georeference", paragraph(said), table(head, rows), *notes)


def _products(facts: ReportFacts) -> Markup:
    if not facts.products:
        return Markup("")
    links = [tag("li", tag("a", name, href=name)) for name in facts.products]
    missing = [tag("li", f"no {one['name']}: {one['reason']}") for one in facts.summary.get("missing_outputs", ())]
    return section("products", "Files", tag("ul", *links, *missing))


def _settings(facts: ReportFacts) -> Markup:
    versions = ", ".join(f"{name} {version}" for name, version in facts.versions.items())
    settings = [details("Settings of the run", tag("pre", facts.settings), is_open=False)] if facts.settings else []
    written = paragraph(f"This report was written by {versions}.")
    return section("settings", "Settings and versions", *settings, written)
