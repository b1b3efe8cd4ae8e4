"""Charts as SVG, drawn by ourselves: the same bytes for the same values, readable without a script, in print and on a
phone.

Every chart is ``WIDTH`` units wide, about a phone's pixels, so that its text is as large as that around it; colours are
classes of the style sheet in ``page``. The next module to read is ``page``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from smust3r_colmap.geometry.arrays import FloatArray, IntArray, UInt8Array
from smust3r_colmap.report.markup import Markup, coordinate, joined, number, png_uri, tag
from smust3r_colmap.report.plan import Path2D

WIDTH = 360.0
NUM_COLOURS = 10
"""Of the style sheet, ``c0`` to ``c9``; further groups begin anew."""
MAX_DOTS = 1500
"""Images of a path that are drawn as dots with their names; of more, the line alone is drawn."""
MAX_STRIP = 1200
"""Cells of the strip of images; of more images several share one, which has the worst state."""
RESIDUAL_ARROW_CELLS = 0.9
"""Length of the longest arrow of a residual grid, in cells."""


def _svg(height: float, *content: object, label: str) -> Markup:
    return tag(
        "svg", tag("title", label), *content, viewBox=f"0 0 {coordinate(WIDTH)} {coordinate(height)}", role="img"
    )


def _text(x: float, y: float, text: object, *, anchor: str = "start", class_: str = "t") -> Markup:
    return tag("text", text, x=x, y=y, text_anchor=anchor, class_=class_)


def ticks(low: float, high: float, at_most: int = 5) -> list[float]:
    """Round numbers (1, 2 or 5 times a power of ten apart) between two values."""
    if not high > low:
        return [low]
    step = 10.0 ** math.floor(math.log10((high - low) / at_most))
    step *= next(factor for factor in (1, 2, 5, 10, 20) if (high - low) / (factor * step) <= at_most)
    first = math.ceil(low / step - 1e-9)
    return [k * step for k in range(first, math.floor(high / step + 1e-9) + 1)]


def polyline(xy: FloatArray, class_: str) -> Markup:
    """Places (n, 2) joined by a line."""
    return tag("polyline", points=" ".join(f"{coordinate(x)},{coordinate(y)}" for x, y in xy), class_=class_)


def histogram(values: FloatArray, edges: Sequence[float], *, unit: str, title: str) -> Markup:
    """How many values lie between consecutive edges; those beyond the last one are in the last bar.

    Args:
        values: (n,) finite.
        edges: ascending, evenly or not; all bars are equally wide.
        unit: of the values, below the axis.
    """
    counts = np.histogram(np.clip(values, edges[0], edges[-1]), bins=np.asarray(edges, dtype=np.float64))[0]
    left, right, top, bottom = 44.0, 8.0, 8.0, 36.0
    height = 170.0
    plot_width, plot_height = WIDTH - left - right, height - top - bottom
    bar = plot_width / len(counts)
    most = max(int(counts.max()), 1)
    marks = []
    for tick in ticks(0, most, 3):
        y = top + plot_height * (1 - tick / most)
        marks += [tag("line", x1=left, x2=WIDTH - right, y1=y, y2=y, class_="grid")]
        marks += [_text(left - 5, y + 4, number(tick), anchor="end")]
    for k, count in enumerate(counts.tolist()):
        tall = plot_height * count / most
        to = f"to {number(edges[k + 1])}" if k + 1 < len(counts) else "and more"
        span = f"{number(edges[k])} {to}"
        marks.append(
            tag(
                "rect",
                tag("title", f"{span} {unit}: {count}"),
                x=left + k * bar + 0.5,
                y=top + plot_height - tall,
                width=bar - 1,
                height=tall,
                class_="bar",
            )
        )
    step = max(1, -(-len(edges) // 8))
    marks += [
        _text(left + k * bar, height - bottom + 14, number(edge), anchor="middle")
        for k, edge in enumerate(edges[:-1])
        if k % step == 0
    ]
    marks.append(_text(left + plot_width / 2, height - 4, unit, anchor="middle"))
    return _svg(height, *marks, label=title)


def line_chart(values: FloatArray, *, unit: str, title: str, below: str, marks_at: Mapping[float, str]) -> Markup:
    """Values (n,) over their position, from zero.

    Args:
        below: what the positions are.
        marks_at: values with a horizontal line, and its name.
    """
    left, right, top, bottom, height = 50.0, 8.0, 10.0, 36.0, 190.0
    plot_width, plot_height = WIDTH - left - right, height - top - bottom
    most = max(float(values.max(initial=0)), *marks_at, 1e-12) * 1.05
    drawn: list[Markup] = []
    for tick in ticks(0, most, 4):
        y = top + plot_height * (1 - tick / most)
        drawn.append(tag("line", x1=left, x2=WIDTH - right, y1=y, y2=y, class_="grid"))
        drawn.append(_text(left - 5, y + 4, number(tick), anchor="end"))
    for value, name in marks_at.items():
        y = top + plot_height * (1 - value / most)
        drawn.append(tag("line", x1=left, x2=WIDTH - right, y1=y, y2=y, class_="limit"))
        drawn.append(_text(WIDTH - right, y - 3, name, anchor="end", class_="t limit-t"))
    x = left + plot_width * np.arange(len(values)) / max(len(values) - 1, 1)
    drawn.append(polyline(np.stack([x, top + plot_height * (1 - values / most)], axis=1), "line"))
    drawn += [
        _text(left + plot_width * tick / max(len(values) - 1, 1), height - bottom + 14, number(tick), anchor="middle")
        for tick in ticks(0, max(len(values) - 1, 1), 6)
    ]
    drawn.append(_text(left + plot_width / 2, height - 4, below, anchor="middle"))
    drawn.append(_text(4, top + plot_height / 2, unit, anchor="middle", class_="t up"))
    return _svg(height, *drawn, label=title)


def strip(states: Sequence[int], names: Sequence[str], labels: Sequence[str]) -> Markup:
    """One cell per image in the order of the names, coloured by its state.

    Args:
        states: of each image, an index of ``labels``, the worst highest.
        names: of the images.
    """
    size = min(len(states), MAX_STRIP)
    first = [k * len(states) // size for k in range(size)] if size else []
    cell = WIDTH / max(size, 1)
    cells = []
    for k, start in enumerate(first):
        end = first[k + 1] if k + 1 < size else len(states)
        worst = max(range(start, end), key=lambda image: states[image])
        cells.append(
            tag(
                "rect",
                tag("title", f"{names[worst]}: {labels[states[worst]]}"),
                x=k * cell,
                y=0,
                width=cell + 0.05,
                height=22,
                class_=f"s{states[worst]}",
            )
        )
    return tag(
        "svg",
        tag("title", "images in order, coloured by their state"),
        *cells,
        viewBox=f"0 0 {coordinate(WIDTH)} 22",
        preserveAspectRatio="none",
        class_="strip",
        role="img",
    )


# ------------------------------------------------------------------------------- path
def frame_of(paths: Sequence[Path2D]) -> tuple[FloatArray, FloatArray]:
    """Two corners (2,) around all paths, with a margin."""
    everything = np.concatenate([path.xy for path in paths])
    low, high = everything.min(axis=0), everything.max(axis=0)
    margin = 0.08 * max(float((high - low).max()), 1e-9)
    low, high = low - margin, high + margin
    missing = np.maximum(0.35 * (high - low).max() - (high - low), 0) / 2  # a straight path would be a thin line
    return low - missing, high + missing


def plan(
    path: Path2D,
    corners: tuple[FloatArray, FloatArray],
    *,
    colour_of: Sequence[int],
    names: Sequence[str],
    loops: Sequence[tuple[int, int, bool]] = (),
    background: UInt8Array | None = None,
    is_sequence: bool = True,
) -> Markup:
    """A path from above.

    Args:
        path: to be drawn.
        corners: of the drawing, see ``frame_of``.
        colour_of: by image of the model, the number of its colour.
        names: by image of the model.
        loops: pairs of images, and whether the loop was closed.
        background: picture of the points between the corners.
        is_sequence: images that follow each other are joined by lines.
    """
    low, high = corners
    scale = WIDTH / float((high - low)[0])
    height = scale * float((high - low)[1])
    if height > 1.2 * WIDTH:
        scale, height = scale * 1.2 * WIDTH / height, 1.2 * WIDTH
    offset = (WIDTH - scale * float((high - low)[0])) / 2
    at = np.stack([offset + scale * (path.xy[:, 0] - low[0]), height - scale * (path.xy[:, 1] - low[1])], axis=1)
    drawn: list[Markup] = []
    if background is not None:
        size = {"x": offset, "y": 0, "width": scale * float((high - low)[0]), "height": height}
        drawn.append(tag("image", href=png_uri(background), preserveAspectRatio="none", **size))
    colours = [colour_of[row] % NUM_COLOURS for row in path.rows]
    if is_sequence:
        start = 0
        for end in range(1, len(colours) + 1):
            if end == len(colours) or colours[end] != colours[start]:
                drawn.append(polyline(at[start : end + 1], f"path k{colours[start]}"))
                start = end
    place = {row: k for k, row in enumerate(path.rows)}
    for a, b, is_closed in loops:
        if a in place and b in place:
            (x1, y1), (x2, y2) = at[place[a]].tolist(), at[place[b]].tolist()
            label = tag("title", f"loop {'closed' if is_closed else 'refused'}: {names[a]} and {names[b]}")
            drawn.append(tag("line", label, x1=x1, y1=y1, x2=x2, y2=y2, class_="loop" if is_closed else "loop refused"))
    if len(path.rows) <= MAX_DOTS:
        drawn += [
            tag("circle", tag("title", names[row]), cx=x, cy=y, r=1.8, class_=f"f{colour}")
            for row, colour, (x, y) in zip(path.rows, colours, at.tolist(), strict=True)
        ]
    if is_sequence and len(at):
        for text, (x, y), lower in (("first", at[0].tolist(), -4), ("last", at[-1].tolist(), 12)):  # apart at a loop
            is_right = x > WIDTH - 40
            anchor = "end" if is_right else "start"
            drawn.append(_text(x + (-4 if is_right else 4), y + lower, text, anchor=anchor, class_="t halo"))
    return _svg(height, *drawn, label=path.title)


# ----------------------------------------------------------------------------- matrix
def matrix(rgba: UInt8Array, places: Mapping[float, str], group_spans: Sequence[tuple[float, float, int]]) -> Markup:
    """A square picture of all image pairs.

    Args:
        rgba: (S, S, 4), row 0 at the top.
        places: along both axes, from 0 to 1, and what stands there.
        group_spans: start and end of the images of a group along the axes, and its colour.
    """
    left, top = 34.0, 22.0
    side = WIDTH - left - 2
    drawn = [
        tag("rect", x=left, y=top, width=side, height=side, class_="empty"),
        tag("image", href=png_uri(rgba), x=left, y=top, width=side, height=side, class_="pixels"),
    ]
    for start, end, colour in group_spans:
        long = side * (end - start)
        drawn.append(
            tag("rect", x=left + side * start, y=top - 4, width=long, height=3, class_=f"f{colour % NUM_COLOURS}")
        )
        drawn.append(
            tag("rect", x=left - 4, y=top + side * start, width=3, height=long, class_=f"f{colour % NUM_COLOURS}")
        )
    for place, text in places.items():
        drawn.append(_text(left + side * place, top - 7, text, anchor="middle"))
        drawn.append(_text(left - 7, top + side * place + 4, text, anchor="end"))
    return _svg(top + side + 2, *drawn, label="fraction of the verified matches of each image pair that agree")


# ---------------------------------------------------------------------------- cameras
def residual_grid(mean_residuals_px: FloatArray, num_in_cell: IntArray, width: int, height: int) -> Markup:
    """Arrows of the mean residual of each cell, and how many observations it has as the tone of the cell.

    The longest arrow has ``RESIDUAL_ARROW_CELLS``; its length in pixels is printed below.
    """
    rows, columns = num_in_cell.shape
    cell = WIDTH / (width / (max(width, height) / max(rows, columns)))
    drawn = []
    most = max(int(num_in_cell.max()), 1)
    lengths = np.linalg.norm(mean_residuals_px, axis=2)
    longest = float(np.nanmax(lengths)) if np.isfinite(lengths).any() else 0.0
    image_height = WIDTH * height / width
    for row in range(rows):
        for column in range(columns):
            drawn.append(
                tag(
                    "rect",
                    x=column * cell,
                    y=row * cell,
                    width=min(cell, WIDTH - column * cell),
                    height=min(cell, image_height - row * cell),
                    class_="cell",
                    fill_opacity=0.35 * num_in_cell[row, column].item() / most,
                )
            )
    for row in range(rows):
        for column in range(columns):
            if not np.isfinite(lengths[row, column]) or not longest:
                continue
            x, y = (column + 0.5) * cell, (row + 0.5) * cell
            dx, dy = (mean_residuals_px[row, column] * (RESIDUAL_ARROW_CELLS * cell / longest)).tolist()
            label = tag("title", f"{number(float(lengths[row, column]))} px, {num_in_cell[row, column]} observations")
            drawn.append(tag("line", label, x1=x, y1=y, x2=x + dx, y2=y + dy, class_="arrow"))
            drawn.append(tag("circle", cx=x, cy=y, r=1.0, class_="arrow-start"))
    drawn.append(tag("rect", x=0.5, y=0.5, width=WIDTH - 1, height=image_height - 1, class_="frame"))
    drawn.append(_text(0, image_height + 15, f"longest arrow: {number(longest)} px"))
    return _svg(image_height + 20, *drawn, label="mean residual by place in the image")


def colour_key(entries: Sequence[tuple[str, str]]) -> Markup:
    """Names of colours.

    Args:
        entries: class of the style sheet, or a colour such as #1f5fa8, and name of each.
    """
    marks = []
    for colour, name in entries:
        attribute = {"fill" if colour.startswith("#") else "class_": colour}
        square = tag("svg", tag("rect", width=10, height=10, **attribute), viewBox="0 0 10 10")
        marks.append(tag("span", square, " ", name))
    return tag("p", joined(marks), class_="key")
