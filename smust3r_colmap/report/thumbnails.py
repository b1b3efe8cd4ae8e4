"""Small pictures of the images of a report. The next module to read is ``facts``."""

from __future__ import annotations

import io
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from PIL import Image

from smust3r_colmap.errors import ImageError
from smust3r_colmap.importers.images import load_small

SIDE_PX = 96
MAX_BYTES = 4500
"""Of one; 400 make 2.4 MB in the page."""
QUALITIES = (70, 45, 25)
"""Of the JPEG; the first that is small enough counts, or else the last."""


def make_thumbnails(paths: Sequence[Path], *, workers: int) -> tuple[dict[Path, bytes], str]:
    """JPEG data by file, and why the first of those that could not be read could not; empty if all could."""
    with ThreadPoolExecutor(max_workers=workers) as pool:
        made = list(pool.map(_thumbnail, paths))
    problems = [f"{path.name}: {one}" for path, one in zip(paths, made, strict=True) if isinstance(one, ImageError)]
    found = {path: one for path, one in zip(paths, made, strict=True) if isinstance(one, bytes)}
    more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
    return found, f"{problems[0]}{more}" if problems else ""


def _thumbnail(path: Path) -> bytes | ImageError:
    try:
        pixels = load_small(path, SIDE_PX)
    except ImageError as error:
        return error
    image = Image.fromarray(pixels, "RGB")
    image.thumbnail((SIDE_PX, SIDE_PX))
    data = b""
    for quality in QUALITIES:
        buffer = io.BytesIO()
        image.save(buffer, "JPEG", quality=quality, optimize=True)
        data = buffer.getvalue()
        if len(data) <= MAX_BYTES:
            break
    return data
