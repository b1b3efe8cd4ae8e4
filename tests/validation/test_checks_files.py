"""Every rule of ``checks_files`` has a model that breaks it and it alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pycolmap
import pytest
from helpers.described_models import (
    CX,
    CY,
    Case,
    expected,
    found_in,
    images_none,
    unobserved,
    with_camera,
    with_defect,
    with_model,
    with_text,
)

from smust3r_colmap.validation import checks_files
from smust3r_colmap.validation.description import Subject
from smust3r_colmap.validation.layout import find_layout
from smust3r_colmap.validation.rules import Rule, apply_rules
from smust3r_colmap.validation.validate import RULES, describe

FROM_BARE: dict[str, Case] = {
    "images-none": (images_none, {"tracks-all-missing", "camera-unused"}),
    "points-file-missing": (lambda bare: with_model(unobserved(bare), points=None), {"image-unobserved"}),
    "rigs-incomplete": (lambda bare: with_model(bare, rigs=None), set()),
    "text-only": (with_text, set()),
    "text-simple-pinhole": (
        lambda bare: with_text(with_camera(bare, model="SIMPLE_PINHOLE", params=(300.0, CX, CY))),
        {"text-only", "camera-model-SIMPLE_PINHOLE", "-camera-model-PINHOLE"},
    ),
    "model-without-number": (lambda bare: with_model(bare, folder=Path("scene/sparse")), set()),
    "model-not-largest": (lambda bare: replace(bare, siblings={"0": 6, "1": 7}), {"model-one-of-several"}),
    "model-one-of-several": (lambda bare: replace(bare, siblings={"0": 6, "1": 2}), set()),
    "file-unreadable": (lambda bare: with_model(bare, unread=("cameras.txt",)), {"-camera-model-PINHOLE"}),
    "colmap-cannot-read": (lambda bare: replace(bare, unread_by_colmap="IndexError: at"), set()),
    "file-truncated": (with_defect("file-truncated"), set()),
    "file-trailing-bytes": (with_defect("file-trailing-bytes"), set()),
    "text-bad-line": (with_defect("text-bad-line"), set()),
    "text-observations-missing": (with_defect("text-observations-missing"), set()),
    "text-last-line-empty": (with_defect("text-last-line-empty"), set()),
    "text-and-binary-differ": (with_defect("text-and-binary-differ"), set()),
}


@pytest.mark.parametrize("rule", FROM_BARE)
def test_a_model_can_break_this_rule_alone(bare: Subject, rule: str) -> None:
    edit, others = FROM_BARE[rule]

    assert found_in(edit(bare)) == expected(rule, others)


def test_every_rule_of_the_module_is_in_its_tuple_and_has_a_case() -> None:
    rules = [value for value in vars(checks_files).values() if isinstance(value, Rule)]

    assert set(rules) <= set(checks_files.RULES)
    assert {rule.name for rule in checks_files.RULES} == set(FROM_BARE)


def test_the_largest_of_numbered_models_should_be_the_first(
    model: pycolmap.Reconstruction, scene: Path, tmp_path: Path
) -> None:
    pycolmap.Reconstruction(scene / "sparse" / "0").write_text(tmp_path / "txt")
    (tmp_path / "txt").rename(tmp_path / "0")
    (tmp_path / "bin").rename(tmp_path / "1")
    subject = describe(find_layout(tmp_path, images=None, database=None), ask_colmap=False)
    evidence = apply_rules(subject, RULES.values())

    assert evidence["model-not-largest"].text == "1 has 8 images, 0 has 6"
