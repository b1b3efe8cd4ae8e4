"""Every rule of ``checks_tracks`` has a model that breaks it and it alone."""

from __future__ import annotations

from pathlib import Path

import pycolmap
import pytest
from helpers.described_models import (
    ALWAYS,
    NUM_POINTS,
    Case,
    at,
    edit_lines,
    expected,
    found_in,
    free_row,
    observations_outside,
    points_none,
    track_of_free_row,
    unobserved,
    with_first_tracks,
    with_images,
    with_observed,
)

from smust3r_colmap.validation import checks_tracks
from smust3r_colmap.validation.description import Subject
from smust3r_colmap.validation.projection import project
from smust3r_colmap.validation.rules import Rule, apply_rules
from smust3r_colmap.validation.validate import RULES, read_model

FROM_BARE: dict[str, Case] = {
    "image-unobserved": (with_observed(0, 0), set()),
    "image-weak": (with_observed(0, 14), set()),
    "points-none": (points_none, {"image-unobserved"}),
    "tracks-all-missing": (unobserved, {"image-unobserved"}),
    "tracks-short": (with_first_tracks(NUM_POINTS // 2 + 1, lambda track: track[:2]), set()),
    "track-none": (with_first_tracks(3, lambda track: []), set()),
    "track-single": (with_first_tracks(3, lambda track: track[:1]), set()),
    "track-pseudo-zero": (with_first_tracks(3, lambda track: [(0, 0)] * 3), set()),
    "track-repeats": (with_first_tracks(3, lambda track: [*track, track[-1]]), set()),
    "track-dangling": (with_first_tracks(3, lambda track: [*track, (77, 0)]), set()),
    "track-disagrees": (track_of_free_row, set()),
    "observation-dangling": (
        lambda bare: with_images(bare, point_ids=at(bare.model.images.point_ids, free_row(bare), 9999)),
        set(),
    ),
    "observation-one-sided": (
        lambda bare: with_images(bare, point_ids=at(bare.model.images.point_ids, free_row(bare), 5)),
        set(),
    ),
    "observation-outside": (observations_outside, set()),
}


@pytest.mark.parametrize("rule", FROM_BARE)
def test_a_model_can_break_this_rule_alone(bare: Subject, rule: str) -> None:
    edit, others = FROM_BARE[rule]

    assert found_in(edit(bare)) == expected(rule, others)


def test_every_rule_of_the_module_is_in_its_tuple_and_has_a_case() -> None:
    rules = [value for value in vars(checks_tracks).values() if isinstance(value, Rule)]

    assert set(rules) <= set(checks_tracks.RULES)
    assert {rule.name for rule in checks_tracks.RULES} == set(FROM_BARE)


def test_fifteen_observations_are_enough_and_half_of_the_points_are_not_most(bare: Subject) -> None:
    half_short = with_first_tracks(NUM_POINTS // 2, lambda track: track[:2])

    assert found_in(with_observed(0, 15)(bare)) == ALWAYS
    assert found_in(half_short(bare)) == ALWAYS


def test_exports_with_made_up_tracks_are_told(model: pycolmap.Reconstruction, tmp_path: Path) -> None:
    """As a neighbouring project writes them: three pairs `0 0` for every point, no observations."""
    edit_lines(
        tmp_path / "txt" / "points3D.txt", lambda lines: [" ".join([*line.split()[:8], *"000000"]) for line in lines]
    )
    edit_lines(
        tmp_path / "txt" / "images.txt",
        lambda lines: [line if number % 2 == 0 else "" for number, line in enumerate(lines)],
    )
    read = read_model(tmp_path / "txt")
    evidence = apply_rules(Subject(model=read, projection=project(read)), RULES.values())

    assert evidence["track-pseudo-zero"].count == 9
    assert "track-dangling" not in evidence
    assert "track-repeats" not in evidence
