"""HTML and SVG as values: text is escaped unless it is ``Markup`` already, so a name can never become a tag.

The next module to read is ``charts``.
"""

from __future__ import annotations

import base64
import html
import io
import math
from collections.abc import Iterable, Sequence

from PIL import Image

from smust3r_colmap.geometry.arrays import UInt8Array

VOID = frozenset({"img", "meta", "br"})
"""Elements of HTML that have no end tag."""


class Markup(str):
    """Text that is HTML or SVG already."""

    __slots__ = ()


def escaped(text: object) -> Markup:
    """As it is shown; quotes are escaped, too, so that it may stand in an attribute."""
    return text if isinstance(text, Markup) else Markup(html.escape(str(text), quote=True))


def joined(parts: Iterable[object], separator: str = "") -> Markup:
    """One after the other, escaped."""
    return Markup(separator.join(escaped(part) for part in parts))


def tag(name: str, /, *content: object, **attributes: object) -> Markup:
    """An element.

    Args:
        name: of the element.
        content: children in order; what is no ``Markup`` is text.
        attributes: underscores become hyphens, one at the end is left out (``class_``); None leaves an attribute out,
            numbers are rounded as ``coordinate`` does.
    """
    written = "".join(
        f' {key.rstrip("_").replace("_", "-")}="{escaped(coordinate(value) if isinstance(value, float) else value)}"'
        for key, value in attributes.items()
        if value is not None
    )
    return Markup(f"<{name}{written}>" if name in VOID else f"<{name}{written}>{joined(content)}</{name}>")


def coordinate(value: float) -> str:
    """A place in a drawing to a hundredth, in as few characters as possible."""
    text = f"{value:.2f}".rstrip("0").rstrip(".")
    return "0" if text in ("-0", "") else text


def number(value: float | None, digits: int = 3) -> str:
    """For people: three significant digits, whole numbers from 1,000 on; a dash for what does not exist."""
    if value is None or not math.isfinite(value):
        return "-"
    return f"{value:,.0f}" if abs(value) >= 1000 or value == round(value) else f"{value:.{digits}g}"


def jpeg_uri(data: bytes) -> str:
    """An image inside of the page."""
    return f"data:image/jpeg;base64,{base64.b64encode(data).decode()}"


def png_uri(rgba: UInt8Array) -> str:
    """(H, W, 4) as an image inside of the page."""
    buffer = io.BytesIO()
    Image.fromarray(rgba, "RGBA").save(buffer, "PNG", optimize=True)
    return f"data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode()}"


# ------------------------------------------------------------------------- parts of a page
def section(anchor: str, title: str, *content: object) -> Markup:
    """A part of the page with a heading and a name to link to."""
    return tag("section", tag("h2", title), *content, id=anchor)


def paragraph(*content: object) -> Markup:
    """Text."""
    return tag("p", *content)


def table(head: Sequence[object], rows: Iterable[Sequence[object]]) -> Markup:
    """A table that scrolls by itself where the page is narrow."""
    body = joined((tag("tr", *(tag("td", cell) for cell in row)) for row in rows), "\n")
    titles = tag("thead", tag("tr", *(tag("th", cell) for cell in head)))
    return tag("div", tag("table", titles, tag("tbody", body)), class_="scroll")


def figure(drawing: Markup, *caption: object) -> Markup:
    """A drawing and what it shows."""
    return tag("figure", drawing, tag("figcaption", *caption))


def details(title: str, *content: object, is_open: bool) -> Markup:
    """What can be folded away."""
    return tag("details", tag("summary", title), *content, open="" if is_open else None)


def sentence(text: str) -> str:
    """With a capital letter and a full stop."""
    return f"{text[:1].upper()}{text[1:]}."
