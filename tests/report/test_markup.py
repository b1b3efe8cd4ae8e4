"""Text becomes HTML only by way of escaping."""

from __future__ import annotations

import pytest

from smust3r_colmap.report.markup import Markup, coordinate, details, joined, number, table, tag

NASTY = "<img src=x onerror=\"alert('1')\">&.png"
ESCAPED = "&lt;img src=x onerror=&quot;alert(&#x27;1&#x27;)&quot;&gt;&amp;.png"


def test_text_and_attributes_are_escaped_and_markup_is_not_twice() -> None:
    assert tag("b", NASTY) == f"<b>{ESCAPED}</b>"
    assert tag("a", tag("b", "x"), title=NASTY) == f'<a title="{ESCAPED}"><b>x</b></a>'
    assert table((NASTY,), [(NASTY,)]).count(ESCAPED) == 2
    assert joined([Markup("<br>"), "<br>"]) == "<br>&lt;br&gt;"


def test_attributes_are_spelt_as_html_wants_them() -> None:
    assert (
        tag("rect", x=1.0, stroke_width=0.5, class_="bar", fill=None)
        == '<rect x="1" stroke-width="0.5" class="bar"></rect>'
    )
    assert tag("meta", name="viewport") == '<meta name="viewport">'
    assert details("more", is_open=False) == "<details><summary>more</summary></details>"
    assert details("more", is_open=True).startswith('<details open="">')


@pytest.mark.parametrize(
    ("value", "text"), [(0.0, "0"), (-0.001, "0"), (12.345, "12.35"), (100.0, "100"), (-2.5, "-2.5")]
)
def test_coordinates_are_short(value: float, text: str) -> None:
    assert coordinate(value) == text


@pytest.mark.parametrize(
    ("value", "text"),
    [(None, "-"), (float("nan"), "-"), (0.12345, "0.123"), (12345.6, "12,346"), (7.0, "7"), (99.96, "100")],
)
def test_numbers_have_three_digits(value: float | None, text: str) -> None:
    assert number(value) == text
