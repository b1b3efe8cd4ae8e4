"""Focal lengths from pairs of images on an arc; a known one stays, and pairs that do not tell change nothing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.pairs_of_one_camera import GUESS, TRUE_FOCAL_PX, pairs_on_an_arc, pairs_straight_ahead

from smust3r_colmap.features.view_graph_calibration import VerifiedPairs, calibrated_cameras, cross_validated_cameras
from smust3r_colmap.geometry.camera import Intrinsics

Find = Callable[[VerifiedPairs], tuple[Intrinsics, ...]]


@pytest.fixture(scope="module")
def on_an_arc(tmp_path_factory: pytest.TempPathFactory) -> VerifiedPairs:
    return pairs_on_an_arc(tmp_path_factory.mktemp("arc"))


@pytest.mark.parametrize("find", [calibrated_cameras, cross_validated_cameras])
def test_pairs_on_an_arc_determine_the_focal_length(on_an_arc: VerifiedPairs, find: Find) -> None:
    (found,) = find(on_an_arc)
    assert found.focal_px == pytest.approx(TRUE_FOCAL_PX, rel=0.03)
    assert replace(found, params=GUESS.params) == GUESS


@pytest.mark.parametrize("find", [calibrated_cameras, cross_validated_cameras])
def test_a_focal_length_from_exif_stays(on_an_arc: VerifiedPairs, find: Find) -> None:
    known = replace(GUESS, has_prior_focal=True)
    assert find(replace(on_an_arc, cameras=(known,))) == (known,)


@pytest.mark.parametrize("find", [calibrated_cameras, cross_validated_cameras])
def test_a_camera_without_pairs_keeps_its_guess(on_an_arc: VerifiedPairs, find: Find) -> None:
    assert find(replace(on_an_arc, cameras=(GUESS, GUESS)))[1] == GUESS
    assert find(replace(on_an_arc, pairs=())) == (GUESS,)


def test_halves_that_disagree_change_nothing(tmp_path: Path) -> None:
    straight = pairs_straight_ahead(tmp_path)
    (found,) = calibrated_cameras(straight)
    assert abs(np.log(found.focal_px / TRUE_FOCAL_PX)) > 0.1, "forward motion does not tell the focal length"
    assert cross_validated_cameras(straight) == (GUESS,)
