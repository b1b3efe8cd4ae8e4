"""Readers: who refuses or minds which finding."""

from __future__ import annotations

from typing import Any

import pytest
from helpers.described_models import CX, CY, Edit, one_camera_per_image, unobserved, with_camera, with_names, with_text

from smust3r_colmap.errors import ConfigError
from smust3r_colmap.validation.description import Subject
from smust3r_colmap.validation.readers import READERS, find_readers
from smust3r_colmap.validation.report import assess, verdicts
from smust3r_colmap.validation.rules import Severity, apply_rules
from smust3r_colmap.validation.validate import RULES

READER_NAMES = [reader.name for reader in READERS]


def verdicts_of(subject: Subject) -> dict[str, str]:
    findings = assess(apply_rules(subject, RULES.values()), RULES, READERS)
    return {verdict.reader.name: verdict.verdict for verdict in verdicts(findings, READERS)}


@pytest.mark.parametrize("reader", READERS, ids=READER_NAMES)
def test_a_reader_names_rules_that_exist_and_says_what_happens(reader: Any) -> None:
    named = {**reader.refuses, **reader.warns}

    assert named.keys() <= RULES.keys()
    assert not reader.refuses.keys() & reader.warns.keys()
    assert all(named.values())


@pytest.mark.parametrize(
    ("edit", "refusing", "warning"),
    [
        (lambda bare: bare, set(), set()),
        (with_names("left/a.png"), {"3DGS-2023"}, set()),
        (
            lambda bare: with_camera(bare, model="SIMPLE_RADIAL", params=(300.0, CX, CY, 0.0)),
            {"3DGS", "3DGS-2023", "OpenMVS"},
            set(),
        ),
        (with_text, {"OpenSplat"}, set()),
        (one_camera_per_image, set(), {"nerfstudio"}),
        (unobserved, {"gsplat", "instant-ngp", "3DGS-depth"}, {"COLMAP"}),
    ],
    ids=["good", "subfolders", "SIMPLE_RADIAL", "text", "camera per image", "no tracks"],
)
def test_readers_judge_as_they_were_seen_to(bare: Subject, edit: Edit, refusing: set[str], warning: set[str]) -> None:
    """The scenes on which the programs themselves were run (OpenSplat and OpenMVS: by their source)."""
    found = verdicts_of(edit(bare))

    assert {name for name, verdict in found.items() if verdict == "refuses"} == refusing
    assert {name for name, verdict in found.items() if verdict == "warns"} == warning


def test_what_is_wrong_by_itself_is_refused_by_everybody(bare: Subject) -> None:
    assert set(verdicts_of(with_names("a.png", "a.png")(bare)).values()) == {"refuses"}


def test_a_finding_is_as_bad_as_what_it_does_to_the_readers_asked_for(bare: Subject) -> None:
    evidence = apply_rules(with_names("left/a.png")(bare), RULES.values())

    (finding,) = assess(evidence, RULES, find_readers(["3dgs-2023"]))

    assert (finding.rule.name, finding.severity) == ("name-subfolder", Severity.REFUSED)
    assert assess(evidence, RULES, find_readers(["gsplat"])) == ()


def test_an_unknown_reader_is_refused_with_the_known_ones() -> None:
    with pytest.raises(ConfigError, match="--readers postshot: no such reader; there are COLMAP, 3DGS"):
        find_readers(["COLMAP", "Postshot"])


@pytest.mark.parametrize(
    ("rule", "stopped"),
    [
        ("transforms-unreadable", {"nerfstudio", "instant-ngp"}),
        ("transforms-image-missing", {"nerfstudio", "instant-ngp"}),
        ("transforms-sharp-image-missing", {"nerfstudio"}),
        ("transforms-image-ending", {"nerfstudio"}),
        ("transforms-comments", {"nerfstudio"}),
    ],
)
def test_what_instant_ngp_passes_over_stops_nerfstudio_only(rule: str, stopped: set[str]) -> None:
    assert {reader.name for reader in READERS if rule in reader.refuses} == stopped
