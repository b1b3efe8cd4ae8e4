"""``poses_uncertainty.csv``: predicted standard deviations of camera positions, as a run writes them."""

from __future__ import annotations

import csv
from pathlib import Path

from smust3r_colmap.errors import InputError
from smust3r_colmap.importers.pose_set import text_of

_COLUMNS = ("model", "image", "position_sigma")


def read_position_sigmas(path: Path, model: str) -> dict[str, float]:
    """Standard deviations by image name, in units of the model.

    Args:
        model: as in the table, such as ``sparse/0``.

    Raises:
        InputError: the file cannot be read, lacks a column, or has something else than a number above 0.
    """
    rows = csv.DictReader(text_of(path).splitlines())
    missing = [one for one in _COLUMNS if one not in (rows.fieldnames or ())]
    if missing:
        raise InputError(f"{path}: has no column {missing[0]}; needed {', '.join(_COLUMNS)}")
    found = {}
    for row in rows:
        if row["model"] == model:
            try:
                sigma = float(row["position_sigma"])
            except (TypeError, ValueError) as error:
                raise InputError(f"{path}, line {rows.line_num}: {error}") from error
            if not 0 < sigma < float("inf"):
                raise InputError(f"{path}, line {rows.line_num}: the standard deviation is {sigma}; needed above 0")
            found[row["image"]] = sigma
    return found
