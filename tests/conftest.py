"""Fixtures that more than one test file uses."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def data_dir() -> Callable[[str], Path]:
    """``data_dir("fox")`` is the folder of a real image set; without it the test is skipped.

    The sets lie below the folder that the environment variable SMUST3R_DATA names, by default in
    ``shared/data`` beside the checkout.
    """
    default = Path(__file__).resolve().parents[2] / "shared" / "data"
    root = Path(os.environ.get("SMUST3R_DATA", default))

    def find(name: str) -> Path:
        if not (root / name).is_dir():
            pytest.skip(f"no image set {name}: set SMUST3R_DATA to the folder that holds it")
        return root / name

    return find
