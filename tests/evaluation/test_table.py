from __future__ import annotations

import csv
import io
import json

import numpy as np

from smust3r_colmap.evaluation.evaluate import EvaluationReport, Row
from smust3r_colmap.evaluation.table import render_csv, render_json, render_text

STATISTICS = {"rmse": 0.123456, "mean": 0.1, "median": 0.09, "std": 0.01, "min": 0.0, "max": 1.0}


def row(metric: str, values: dict[str, float | None], unit: str = "m", note: str = "") -> Row:
    return Row(
        metric=metric,
        values=values,
        unit=unit,
        alignment="sim3",
        association="image name",
        compared=9,
        in_estimate=10,
        in_reference=12,
        note=note,
    )


FOUND = EvaluationReport(
    estimate="out/sparse/0 (run, 10 poses)",
    reference="truth.txt (TUM trajectory, 12 poses)",
    rows=(
        row("ape_translation", {**STATISTICS}),
        row("aae", dict.fromkeys(STATISTICS), "deg", "not determined"),
        row("scale", {"scale": 0.5, "error_percent": -50.0}, "", "a, note"),
    ),
    warnings=("careful",),
)


def test_people_see_every_row_with_what_was_compared() -> None:
    lines = render_text(FOUND).splitlines()
    (ape,) = [line for line in lines if line.startswith("ape_translation")]
    assert ape.split() == [
        *["ape_translation", "0.1235", "0.1", "0.09", "0.01", "0", "1", "m", "sim3", "9/10/12"],
        "image",
        "name",
    ]
    (aae,) = [line for line in lines if line.startswith("aae ")]
    assert aae.split() == ["aae", "-", "-", "-", "-", "-", "-", "deg", "sim3", "9/10/12", "image", "name"]
    assert [line for line in lines if "scale 0.5, error_percent -50" in line and "9/10/12" in line]
    assert "aae: not determined" in lines


def test_json_has_all_digits_and_null_for_what_is_not_determined() -> None:
    read = json.loads(render_json(FOUND))
    assert read["rows"][0]["values"]["rmse"] == 0.123456
    assert read["rows"][1]["values"]["mean"] is None
    assert read["rows"][2] == {
        "metric": "scale",
        "values": {"scale": 0.5, "error_percent": -50.0},
        "unit": "",
        "alignment": "sim3",
        "association": "image name",
        "compared": 9,
        "in_estimate": 10,
        "in_reference": 12,
        "note": "a, note",
    }
    assert read["warnings"] == ["careful"]


def test_csv_has_a_line_for_each_figure() -> None:
    rows = list(csv.DictReader(io.StringIO(render_csv(FOUND))))
    assert len(rows) == 14
    assert rows[0]["metric"] == "ape_translation"
    assert float(rows[0]["value"]) == np.float64(0.123456)
    assert rows[6]["value"] == ""
    assert rows[-1]["note"] == "a, note"
    assert {one["compared"] for one in rows} == {"9"}
