"""Every rule of ``checks_names`` has a model that breaks it and it alone."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.described_models import (
    NUM_IMAGES,
    Case,
    expected,
    found_in,
    renamed_point,
    with_camera,
    with_images,
    with_model,
    with_names,
    with_text,
)

from smust3r_colmap.validation import checks_names
from smust3r_colmap.validation.description import Subject
from smust3r_colmap.validation.rules import Rule

FROM_BARE: dict[str, Case] = {
    "name-blank": (with_names("my image.png"), set()),
    "name-blank-in-text": (lambda bare: with_text(with_names("my image.png")(bare)), {"name-blank", "text-only"}),
    "name-comma": (with_names("a,b.png"), set()),
    "name-subfolder": (with_names("left/a.png"), set()),
    "name-two-dots": (with_names("a.b.png"), set()),
    "name-not-relative": (with_names("C:a.png"), set()),
    "name-duplicate": (with_names("a.png", "a.png"), set()),
    "name-case-clash": (with_names("a.png", "A.png"), set()),
    "name-stem-clash": (with_names("a.png", "a.jpg"), set()),
    "name-ending-clash": (with_names("1.png", "11.png"), set()),
    "id-duplicate": (lambda bare: with_model(bare, cameras=bare.model.cameras * 2), {"camera-id-not-one"}),
    "id-zero": (renamed_point(1, 0), set()),
    "id-too-large": (
        lambda bare: with_camera(with_images(bare, camera_ids=np.full(NUM_IMAGES, 2**31)), camera_id=2**31),
        {"camera-id-not-one"},
    ),
    "point-id-huge": (renamed_point(1, 10**9), set()),
}


@pytest.mark.parametrize("rule", FROM_BARE)
def test_a_model_can_break_this_rule_alone(bare: Subject, rule: str) -> None:
    edit, others = FROM_BARE[rule]

    assert found_in(edit(bare)) == expected(rule, others)


def test_every_rule_of_the_module_is_in_its_tuple_and_has_a_case() -> None:
    rules = [value for value in vars(checks_names).values() if isinstance(value, Rule)]

    assert set(rules) <= set(checks_names.RULES)
    assert {rule.name for rule in checks_names.RULES} == set(FROM_BARE)
