"""Matching of pairs in child processes."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from helpers.mapped_segments import synthetic_segment

from smust3r_colmap.execution.progress import QuietReporter
from smust3r_colmap.features.matching import match_pairs


@pytest.mark.slow
def test_pairs_that_could_not_be_matched_are_not_reported_as_done(tmp_path: Path) -> None:
    path = synthetic_segment(tmp_path).task.database
    with QuietReporter(sys.stderr).stage("matching", total=2) as stage:
        done = match_pairs(path, [(0, 1), (0, 77)], workers=1, seed=0, log_file=None, stage=stage)
    assert done == {(0, 1)}
