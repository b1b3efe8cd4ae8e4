"""The table of standard deviations, read by another reader."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from smust3r_colmap.exporters.poses_uncertainty import COLUMNS, write_uncertainty
from smust3r_colmap.refinement.model_uncertainty import ModelUncertainty

FOUND = ModelUncertainty(
    names=("a,b.jpg", "c.jpg"),
    extent=2.0,
    noise_px=0.3,
    position_covariance=np.array([np.diag([1.0, 4.0, 4.0]), [[2.0, 0.5, 0.0], [0.5, 2.0, 0.25], [0.0, 0.25, 5.0]]]),
    rotation_sigma_deg=np.array([0.5, 180.0]),
    inflation=np.array([1.0, np.inf]),
    num_observations=np.array([40, 0]),
    determined=np.array([True, False]),
    links=(),
)


def test_the_table_has_a_line_per_image_and_model(tmp_path: Path) -> None:
    path = tmp_path / "poses_uncertainty.csv"
    write_uncertainty({"sparse/0": FOUND, "sparse/1": FOUND}, path)
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == COLUMNS
    assert [(row["model"], row["image"]) for row in rows] == [
        ("sparse/0", "a,b.jpg"),
        ("sparse/0", "c.jpg"),
        ("sparse/1", "a,b.jpg"),
        ("sparse/1", "c.jpg"),
    ]
    assert [float(row["position_sigma"]) for row in rows[:2]] == [3.0, 3.0]
    assert [float(rows[1][f"cov_{axes}"]) for axes in ("xx", "xy", "xz", "yy", "yz", "zz")] == [2, 0.5, 0, 2, 0.25, 5]
    assert [(row["rotation_sigma_deg"], row["contradicted"], row["determined"]) for row in rows[:2]] == [
        ("0.5", "0", "1"),
        ("180", "1", "0"),
    ]
    assert "nan" not in path.read_text(encoding="utf-8")
