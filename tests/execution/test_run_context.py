"""``Run``: a product is computed once, and read ever after while its inputs stay the same."""

from __future__ import annotations

import io
from pathlib import Path

import pytest

from smust3r_colmap.execution.progress import QuietReporter, Stage
from smust3r_colmap.execution.run_context import Run
from smust3r_colmap.storage.codec import Codec

NUMBERS: Codec[tuple[int, ...]] = Codec(tuple[int, ...], "numbers")


def squares(output: Path, numbers: tuple[int, ...], computed: list[tuple[int, ...]]) -> tuple[tuple[int, ...], bool]:
    """The product, and whether it was that of an earlier start."""

    def compute(progress: Stage) -> tuple[int, ...]:
        computed.append(numbers)
        progress.advance(len(numbers))
        return tuple(number**2 for number in numbers)

    with Run.open(output, workers=1, seed=0, reporter=QuietReporter(io.StringIO())) as run:
        found = run.cached("squares", numbers, compute, NUMBERS, total=len(numbers), title="squaring")
        (stage,) = run.clock.stages
    assert stage.name == "squaring"
    return found, stage.reused


def test_a_product_is_computed_once_for_the_same_inputs(tmp_path: Path) -> None:
    computed: list[tuple[int, ...]] = []
    assert squares(tmp_path / "run", (1, 2, 3), computed) == ((1, 4, 9), False)
    assert squares(tmp_path / "run", (1, 2, 3), computed) == ((1, 4, 9), True)
    assert computed == [(1, 2, 3)]


def test_other_inputs_are_another_product(tmp_path: Path) -> None:
    computed: list[tuple[int, ...]] = []
    assert squares(tmp_path / "run", (1, 2), computed) == ((1, 4), False)
    assert squares(tmp_path / "run", (3,), computed) == ((9,), False)
    assert computed == [(1, 2), (3,)]


def test_a_stage_that_failed_is_computed_at_the_next_start(tmp_path: Path) -> None:
    def fail(progress: Stage) -> tuple[int, ...]:
        raise ValueError("no")

    with (
        pytest.raises(ValueError, match="no"),
        Run.open(tmp_path / "run", workers=1, seed=0, reporter=QuietReporter(io.StringIO())) as run,
    ):
        run.cached("squares", (1,), fail, NUMBERS)
    assert squares(tmp_path / "run", (1,), []) == ((1,), False)
