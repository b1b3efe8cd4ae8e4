"""Fixtures that more than one test file uses, and what several processes of tests need (``pytest -n 2``)."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from itertools import groupby
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from helpers.finished_runs import Example

ONE_OF_SEVERAL = "PYTEST_XDIST_WORKER" in os.environ

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scripts"))

if ONE_OF_SEVERAL:
    # Before numpy and torch are loaded: threads of several processes would wait for each other on the same cores.
    os.environ.setdefault("OMP_NUM_THREADS", "1")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Several processes take the files with most slow tests first, so that none is left at the end with one of them.

    Files stay together, because their tests share fixtures.
    """
    if ONE_OF_SEVERAL:
        slow_share = {
            path: fmean(item.get_closest_marker("slow") is not None for item in of_file)
            for path, of_file in groupby(items, key=lambda item: item.path)
        }
        items.sort(key=lambda item: -slow_share[item.path])


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


@pytest.fixture(scope="module")
def quiet_pycolmap() -> Iterator[None]:
    """Without what pycolmap says of models that are broken on purpose."""
    import pycolmap  # noqa: PLC0415  (heavy, and few tests need it)

    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = 3
    yield
    pycolmap.logging.minloglevel = level


@pytest.fixture(scope="session")
def finished_example(tmp_path_factory: pytest.TempPathFactory) -> Example:
    """A small finished run; it is only read, tests that change something copy it."""
    from helpers.finished_runs import make_finished_run  # noqa: PLC0415  (heavy, and few tests need it)

    return make_finished_run(tmp_path_factory.mktemp("finished"))
