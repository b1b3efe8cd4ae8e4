"""What is drawn is where it belongs: bars, paths, cells."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET

import numpy as np
import pytest

from smust3r_colmap.report import charts
from smust3r_colmap.report.markup import Markup
from smust3r_colmap.report.plan import Path2D

SQUARE = Path2D(title="result", rows=(0, 1, 2, 3), xy=np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]))
NAMES = ("a.jpg", "<b>.jpg", "c.jpg", "d.jpg")


def elements(drawing: Markup, kind: str) -> list[ET.Element]:
    return ET.fromstring(drawing).findall(f".//{kind}")


def points_of(line: ET.Element) -> list[list[float]]:
    return [[float(value) for value in one.split(",")] for one in line.get("points", "").split()]


@pytest.mark.parametrize(
    ("low", "high", "found"),
    [
        (0, 10, [0, 2, 4, 6, 8, 10]),
        (0, 0.35, [0, 0.1, 0.2, 0.3]),
        (0, 7, [0, 2, 4, 6]),
        (3, 3, [3]),
        (95, 105, [96, 98, 100, 102, 104]),
    ],
)
def test_ticks_are_round(low: float, high: float, found: list[float]) -> None:
    assert charts.ticks(low, high) == pytest.approx(found)


def test_bars_are_as_tall_as_the_counts() -> None:
    drawing = charts.histogram(np.array([0.5, 0.6, 1.5, 9.0]), (0, 1, 2, 3), unit="px", title="errors")
    bars = elements(drawing, "rect")
    heights = [float(bar.get("height", "")) for bar in bars]
    assert heights[0] == pytest.approx(2 * heights[1], abs=0.02)
    assert heights[1] == heights[2] > 0
    assert [bar.find("title").text for bar in bars] == ["0 to 1 px: 2", "1 to 2 px: 1", "2 and more px: 1"]  # type: ignore[union-attr]


def test_the_path_is_drawn_to_scale_with_y_up() -> None:
    corners = (np.array([-1.0, -1.0]), np.array([2.0, 2.0]))
    drawing = charts.plan(SQUARE, corners, colour_of=(0, 0, 0, 0), names=NAMES)
    (line,) = elements(drawing, "polyline")
    assert points_of(line) == [[120, 240], [240, 240], [240, 120], [120, 120]]
    assert line.get("class") == "path k0"
    assert [dot.find("title").text for dot in elements(drawing, "circle")] == list(NAMES)  # type: ignore[union-attr]


def test_segments_have_their_colours_and_the_lines_between_them_no_gap() -> None:
    corners = charts.frame_of([SQUARE])
    first, second = elements(charts.plan(SQUARE, corners, colour_of=(0, 0, 11, 11), names=NAMES), "polyline")
    assert (first.get("class"), second.get("class")) == ("path k0", "path k1")
    assert (len(points_of(first)), len(points_of(second))) == (3, 2)
    assert points_of(first)[-1] == points_of(second)[0]


def test_images_without_an_order_are_not_joined() -> None:
    drawing = charts.plan(SQUARE, charts.frame_of([SQUARE]), colour_of=(0,) * 4, names=NAMES, is_sequence=False)
    assert not elements(drawing, "polyline")
    assert len(elements(drawing, "circle")) == 4


def test_closed_and_refused_loops_differ_and_those_of_other_images_are_left_out() -> None:
    loops = [(0, 3, True), (1, 3, False), (0, 9, True)]
    drawing = charts.plan(SQUARE, charts.frame_of([SQUARE]), colour_of=(0,) * 4, names=(*NAMES, *"56789x"), loops=loops)
    assert [line.get("class") for line in elements(drawing, "line")] == ["loop", "loop refused"]


def test_of_many_images_a_cell_has_the_worst_state() -> None:
    states = [0] * 5000
    states[4321] = 3
    drawing = charts.strip(states, [f"{k}.jpg" for k in range(5000)], ("good", "few", "loose", "wrong"))
    cells = elements(drawing, "rect")
    assert len(cells) == charts.MAX_STRIP
    (wrong,) = [cell for cell in cells if cell.get("class") == "s3"]
    assert wrong.find("title").text == "4321.jpg: wrong"  # type: ignore[union-attr]


def test_a_matrix_has_its_places_along_both_axes() -> None:
    drawing = charts.matrix(np.zeros((4, 4, 4), np.uint8), {0.0: "0", 0.5: "2"}, [(0.0, 0.5, 0), (0.5, 1.0, 1)])
    assert [text.text for text in elements(drawing, "text")] == ["0", "0", "2", "2"]
    assert re.search(r'href="data:image/png;base64,[A-Za-z0-9+/=]+"', drawing)


def test_the_longest_residual_spans_nine_tenths_of_a_cell() -> None:
    residuals = np.full((3, 4, 2), np.nan)
    residuals[0, 0], residuals[2, 3] = (0.5, 0.0), (0.0, -0.25)
    drawing = charts.residual_grid(residuals, np.full((3, 4), 30), 400, 300)
    first, second = elements(drawing, "line")
    assert float(first.get("x2", "")) - float(first.get("x1", "")) == pytest.approx(0.9 * 90, abs=0.02)
    assert float(second.get("y2", "")) - float(second.get("y1", "")) == pytest.approx(-0.45 * 90, abs=0.02)
    assert "longest arrow: 0.5 px" in drawing
