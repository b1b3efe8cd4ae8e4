"""The parts of the page that show the model: path, matches, links, cameras, points. The next module is ``style``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.refinement.misregistration import MAX_CONTRADICTING_FRACTION, MIN_CONTRADICTING_MATCHES
from smust3r_colmap.report import charts
from smust3r_colmap.report.agreement import MAX_CELLS, NEAR, Agreement, coloured
from smust3r_colmap.report.facts import ImageFacts, ModelFacts
from smust3r_colmap.report.markup import (
    Markup,
    escaped,
    figure,
    joined,
    jpeg_uri,
    number,
    paragraph,
    section,
    sentence,
    table,
    tag,
)
from smust3r_colmap.report.measure import GRID_CELLS, MIN_IN_CELL, CameraFacts
from smust3r_colmap.report.plan import RESULT, points_from_above
from smust3r_colmap.report.verdict import WEAK_IMAGE_PERCENT, WEAK_PERCENT

MAX_LINKS = 8
MAX_GROUPS = 8
MAX_STRETCHES = 4
STRONG_CORRELATION = 0.9
"""From which on two parameters of a camera can hardly be told apart; printed in bold."""
KEY_FRACTIONS = (0.0, 0.25, 0.5, 0.7, 0.85, 1.0)

TRACK_LENGTHS = (2, 3, 4, 5, 6, 8, 10, 15, 20, 30, 50)
ERRORS_PX = (0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.75, 1, 1.5, 2, 3, 4)
ANGLES_DEG = (0, 0.5, 1, 1.5, 2, 3, 5, 8, 15, 30, 60, 90)
OBSERVATIONS = (0, 15, 30, 60, 100, 200, 300, 500, 1000, 2000, 4000)
"""Edges of the histograms; values spread over decades, so the bars are not evenly spaced."""


def anchor_of(image: ImageFacts) -> str:
    """Where the thumbnail of an image stands in the page; any name may be an id in this form."""
    return f"image-{image.name.encode().hex()}"


def link_to(image: ImageFacts) -> Markup:
    """Its name, that leads to its thumbnail where there is one."""
    return tag("a", image.name, href=f"#{anchor_of(image)}") if image.thumbnail else escaped(image.name)


# ------------------------------------------------------------------------------ the path
def plan(model: ModelFacts, summary: Mapping[str, Any]) -> Markup:
    """The path from above: before loops, before bundle adjustment, in the end."""
    is_sequence = model.agreement is None or model.agreement.is_sequence
    corners = charts.frame_of(model.paths)
    row_of = {name: row for row, name in enumerate(model.names)}
    loops = [
        (row_of[one["image_a"]], row_of[one["image_b"]], one["accepted"])
        for one in summary.get("loops", ())
        if one["image_a"] in row_of and one["image_b"] in row_of
    ]
    background = points_from_above(model.observed.xyz, model.axes, *corners)
    by_segment = "; colours are segments" if model.colour_of else ""
    figures = [
        figure(
            charts.plan(
                path,
                corners,
                colour_of=model.colour_of or (0,) * len(model.names),
                names=model.names,
                loops=loops,
                background=background if path.title == RESULT else None,
                is_sequence=is_sequence,
            ),
            f"{path.title.capitalize()}{by_segment}",
        )
        for path in model.paths
    ]
    if model.agreement is not None and model.agreement.is_split:
        colours = _group_colours(model.agreement)
        drawing = charts.plan(model.paths[-1], corners, colour_of=colours, names=model.names, is_sequence=is_sequence)
        figures.append(figure(drawing, "Result; colours are the groups of images that agree, see the matrix"))
    said = ["The camera positions from above"]
    if loops:
        said.append(", with loops that were closed (green) and refused (red, dashed)")
    if len(model.paths) > 1:
        said.append("; earlier steps are moved to fit the result best")
    if not is_sequence:
        said.append(". The names are in no order of the path, so they are not joined by lines")
    return section("plan", f"Path of {model.folder}", paragraph(*said, "."), tag("div", *figures, class_="figures"))


def _group_colours(agreement: Agreement) -> list[int]:
    """By row; images of no group have the last colour."""
    colours = [charts.NUM_COLOURS - 1] * agreement.num_images
    for k, group in enumerate(agreement.groups):
        for row in group.rows:
            colours[row] = k % (charts.NUM_COLOURS - 1)
    return colours


# ---------------------------------------------------------------------------- the matrix
def verification_matrix(model: ModelFacts, images: Sequence[ImageFacts]) -> Markup:
    """Which pairs of images agree with the model, and which groups of images do with each other."""
    agreement = model.agreement
    title = "Verification matrix"
    if agreement is None:
        return section("matrix", title, paragraph(sentence(model.agreement_note)))
    order = agreement.display_order()
    colours = _group_colours(agreement)
    spans = _spans([colours[row] for row in order]) if len(agreement.groups) > 1 else []
    places = {k / len(order): number(k) for k in map(int, charts.ticks(0, len(order) - 1, 6))}
    drawing = charts.matrix(coloured(agreement.matrix()), places, spans)
    key = charts.colour_key([(_hex(fraction), f"{fraction:.0%}") for fraction in KEY_FRACTIONS])
    picture = tag("figure", drawing, key, tag("figcaption", _explanation(agreement)))
    content = [
        *(paragraph(line) for line in _counts(agreement)),
        *_groups(agreement, model.names),
        tag("div", picture, _worst_pairs(images, agreement), class_="figures"),
    ]
    if model.agreement_note:
        content.append(tag("p", sentence(model.agreement_note), class_="rule"))
    return section("matrix", title, *content)


def _explanation(agreement: Agreement) -> str:
    said = (
        "Each cell is a pair of images: the fraction of its verified matches that lie on their epipolar lines in this "
        "model, red for none, blue for all. The matches were found without the model. "
    )
    if agreement.is_sequence:
        said += (
            "Red far from the diagonal may be look-alike places that the model rightly refused, or a place that it "
            "does not recognise; red at the diagonal, or whole groups that contradict each other, is a model that is "
            "folded or torn."
        )
    else:
        said += (
            "The names are in no order, so the images are sorted by group, and those that match are near each other."
        )
    return said + (f" Several of the {agreement.num_images} images share a cell." * (agreement.num_images > MAX_CELLS))


def _counts(agreement: Agreement) -> Iterator[str]:
    rule = f"fewer than {MAX_CONTRADICTING_FRACTION:.0%} of at least {MIN_CONTRADICTING_MATCHES} matches agree"
    near, far = agreement.counts(near=True), agreement.counts(near=False)
    if agreement.is_sequence:
        yield (
            f"{near[0]} of {near[1]} pairs of images at most {NEAR} apart contradict the model ({rule}), and "
            f"{far[0]} of {far[1]} pairs farther apart."
        )
    else:
        yield f"{far[0]} of {far[1]} pairs contradict the model ({rule})."


def _groups(agreement: Agreement, names: Sequence[str]) -> list[Markup]:
    """What the groups are, if they contradict each other."""
    if not agreement.is_split:
        return []
    shown = agreement.groups[:MAX_GROUPS]
    said = (
        f"The images fall into groups of {', '.join(str(len(group.rows)) for group in shown)} that agree inside and "
        "contradict each other: the model is folded or torn between them."
    )
    rows = [
        (
            k + 1,
            len(group.rows),
            _stretches(group.rows, names),
            group.num_supporting if k else "-",
            group.num_contradicting if k else "-",
        )
        for k, group in enumerate(shown)
    ]
    head = ("group", "images", "which", "pairs with larger groups that agree", "that contradict")
    return [paragraph(tag("b", said)), table(head, rows)]


def _stretches(rows: Sequence[int], names: Sequence[str]) -> str:
    """The longest runs of consecutive images, in their order."""
    runs = np.split(np.asarray(rows), np.flatnonzero(np.diff(rows) > 1) + 1)
    longest = sorted(sorted(runs, key=len, reverse=True)[:MAX_STRETCHES], key=lambda run: int(run[0]))
    said = [names[run[0]] if len(run) == 1 else f"{names[run[0]]} to {names[run[-1]]}" for run in longest]
    more = len(runs) - len(longest)
    return "; ".join(said) + (f"; {more} more stretches" if more else "")


def _spans(colours: Sequence[int]) -> list[tuple[float, float, int]]:
    """Runs of one colour along the axis of the matrix."""
    edges = [0, *(np.flatnonzero(np.diff(colours)) + 1).tolist(), len(colours)]
    return [(a / len(colours), b / len(colours), colours[a]) for a, b in pairwise(edges)]


def _hex(fraction: float) -> str:
    return "#" + "".join(f"{int(value):02x}" for value in coloured(np.array(fraction))[:3])


def _worst_pairs(images: Sequence[ImageFacts], agreement: Agreement) -> Markup:
    worst = agreement.worst_pairs()
    if not worst:
        return Markup("")
    image_of = {image.row: image for image in images if image.row is not None}
    rows = [
        (_pictured(image_of[i]), _pictured(image_of[j]), one.num_matches, f"{one.inlier_fraction:.0%}")
        for (i, j), one in worst
    ]
    title = tag("h3", "Pairs that contradict the most")
    return tag("div", title, table(("image", "and", "matches", "agree"), rows))


def _pictured(image: ImageFacts) -> Markup:
    if not image.thumbnail:
        return link_to(image)
    return joined([tag("img", src=jpeg_uri(image.thumbnail), alt="", class_="small"), tag("br"), link_to(image)])


# ----------------------------------------------------------------------------- the links
def weakest_links(model: ModelFacts) -> Markup:
    """How uncertain each position is, and what holds the two sides of every cut together."""
    found = model.uncertainty
    if found is None or not found.names:
        return section("links", "Weakest links", paragraph("The poses of this model have no standard deviations."))
    figures = [
        _over_images(
            100 * found.position_sigma / found.extent,
            "image",
            WEAK_IMAGE_PERCENT,
            "Standard deviation of each camera position, after the best alignment of all",
        )
    ]
    rows: list[tuple[object, ...]] = []
    if found.links:
        figures.append(
            _over_images(
                np.array([link.side_percent for link in found.links]),
                "cut between consecutive images",
                WEAK_PERCENT,
                "By how much the smaller side of a cut may be off the other, if both are rigid",
            )
        )
        rows = [
            (
                link.before,
                link.after,
                link.num_smaller,
                number(link.num_points),
                number(round(link.num_scale_points)),
                f"± {number(link.scale_percent)} %",
                f"± {number(link.rotation_deg)}°",
                f"± {number(link.side_percent)} %",
            )
            for link in sorted(found.links, key=lambda link: -link.side_percent)[:MAX_LINKS]
        ]
    said = "A path hangs together by the points that both sides of a cut see: few or far ones leave the scale free."
    if model.agreement is not None and not model.agreement.is_sequence:
        said += " These images are in no order, so that a cut between consecutive names has little meaning."
    head = (
        *("between", "and", "images of the smaller side", "points across", "that carry the scale"),
        *("scale", "rotation", "smaller side may be off"),
    )
    parts = [paragraph(said), tag("div", *figures, class_="figures"), *([table(head, rows)] if rows else [])]
    return section("links", "Weakest links", *parts)


def _over_images(percent: FloatArray, below: str, limit: float, caption: str) -> Markup:
    """A chart in percent of the extent, with the limit of the verdict where it is near."""
    limits = {limit: "weak"} if percent.max() > 0.3 * limit else {}
    drawing = charts.line_chart(percent, unit="% of the extent", title=caption, below=below, marks_at=limits)
    return figure(drawing, caption)


# --------------------------------------------------------------------------- the cameras
def cameras(model: ModelFacts) -> Markup:
    """Parameters with standard deviations and correlations, and mean residuals by place in the image."""
    if not len(model.observed.image_of):
        return section("cameras", "Cameras", paragraph("The model has no tracks, hence no residuals."))
    content = [_camera(camera) for camera in model.cameras]
    if model.num_cameras > len(content):
        shown = f"{len(content)} of {model.num_cameras} cameras, those with the most observations."
        content.insert(0, paragraph(shown))
    said = (
        "Arrows are the mean residual (projection minus observation) of the cells of the image, "
        f"{GRID_CELLS} along its longer side, with at least {MIN_IN_CELL} observations. A pattern, such as arrows that "
        "all point outwards, is distortion that the camera model lacks. Standard deviations hold with all poses and "
        "points unknown."
    )
    return section("cameras", "Cameras", *content, tag("p", said, class_="rule"))


def _camera(camera: CameraFacts) -> Markup:
    rows = [
        (name, f"{value:.6g}", f"± {number(sigma)}" if np.isfinite(sigma) else "-" if k in camera.free else "fixed")
        for k, (name, value, sigma) in enumerate(
            zip(camera.names, camera.values.tolist(), camera.sigmas.tolist(), strict=True)
        )
    ]
    tables = [table(("parameter", "value", "standard deviation"), rows)]
    if len(camera.correlation) > 1:
        names = [camera.names[k] for k in camera.free]
        correlations = [
            (name, *(_correlation(value, is_own=j == k) for j, value in enumerate(row)))
            for k, (name, row) in enumerate(zip(names, camera.correlation.tolist(), strict=True))
        ]
        tables += [tag("h4", "Correlations"), table(("", *names), correlations)]
    grid = charts.residual_grid(camera.mean_residuals_px, camera.num_in_cell, camera.width, camera.height)
    title = f"Camera {camera.camera_id}: {camera.model}, {camera.width} x {camera.height}, {camera.num_images} images"
    drawn = figure(grid, "Mean residuals; the stronger the tone of a cell, the more observations")
    return tag("div", tag("h3", title), tag("div", drawn, tag("div", *tables), class_="figures"))


def _correlation(value: float, *, is_own: bool) -> Markup:
    text = f"{value:.2f}" if np.isfinite(value) else "-"
    return tag("b", text) if abs(value) >= STRONG_CORRELATION and not is_own else escaped(text)


# ------------------------------------------------------------------------ the histograms
def histograms(model: ModelFacts) -> Markup:
    """Of points and observations."""
    observed = model.observed
    if not len(observed.image_of):
        return Markup("")
    shown = (
        ("Track length", observed.track_lengths, TRACK_LENGTHS, "images of a point"),
        ("Reprojection error", observed.errors_px, ERRORS_PX, "px"),
        ("Triangulation angle", observed.angles_deg, ANGLES_DEG, "degrees"),
        ("Observations", observed.num_observations.astype(np.float64), OBSERVATIONS, "observations of an image"),
    )
    figures = [
        figure(
            charts.histogram(values, edges, unit=unit, title=title),
            f"{title}: median {number(float(np.median(values)))}" if len(values) else title,
        )
        for title, values, edges, unit in shown
    ]
    return section("histograms", "Points and observations", tag("div", *figures, class_="figures"))
