from __future__ import annotations

from pathlib import Path

import pytest

from smust3r_colmap.errors import InputError
from smust3r_colmap.importers.uncertainty_table import read_position_sigmas

HEADER = "model,image,position_sigma,rotation_sigma_deg\n"


def test_the_sigmas_of_one_model_are_read(tmp_path: Path) -> None:
    path = tmp_path / "poses_uncertainty.csv"
    path.write_text(HEADER + 'sparse/0,a.jpg,0.5,1\nsparse/0,"b, c.jpg",0.25,1\nsparse/1,a.jpg,9,1\n')
    assert read_position_sigmas(path, "sparse/0") == {"a.jpg": 0.5, "b, c.jpg": 0.25}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("model,image\n", "has no column position_sigma"),
        ("", "has no column model"),
        (HEADER + "sparse/0,a.jpg,x,1\n", "line 2: could not convert"),
        (HEADER + "sparse/0,a.jpg,nan,1\n", "line 2: the standard deviation is nan"),
        (HEADER + "sparse/0,a.jpg,0,1\n", "line 2: the standard deviation is 0.0"),
    ],
)
def test_broken_tables_are_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "poses_uncertainty.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        read_position_sigmas(path, "sparse/0")
