"""When the frames of a video were seen: the table ``frames.csv`` beside them.

Its columns are the name of the frame below the folder of the table, the video, the seconds since the start of the
video, and the sharpness. The next module to read is ``image_folder``.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path

from smust3r_colmap.errors import CollectionError

FRAMES_FILE = "frames.csv"
COLUMNS = ["name", "video", "timestamp_s", "sharpness"]


def frame_times(folder: Path) -> Mapping[str, float]:
    """Seconds in its video of each frame below the folder, by name; tables with other columns are passed over.

    Raises:
        CollectionError: a time is no number.
    """
    times = {}
    for path in sorted(folder.rglob(FRAMES_FILE)):
        with path.open(newline="", encoding="utf-8", errors="replace") as table:
            header, *rows = [*csv.reader(table)] or [[]]
        if header != COLUMNS:
            continue
        for number, row in enumerate(rows, start=2):
            try:
                name, _, time_s, _ = row
                times[(path.parent.relative_to(folder) / name).as_posix()] = float(time_s)
            except ValueError:
                raise CollectionError(f"{path}, line {number}: needed are a name and a time, not {row}") from None
    return times
