"""Every rule of ``checks_database`` has a model that breaks it and it alone."""

from __future__ import annotations

import pytest
from helpers.described_models import HEIGHT, WIDTH, Case, expected, found_in, part, with_database_image

from smust3r_colmap.validation import checks_database
from smust3r_colmap.validation.description import Subject
from smust3r_colmap.validation.rules import Rule

FROM_GOOD: dict[str, Case] = {
    "database-unreadable": (part("database", problem="file is not a database"), set()),
    "database-image-missing": (with_database_image(name="other.png"), set()),
    "database-image-id-differs": (with_database_image(image_id=99), set()),
    "database-camera-id-differs": (with_database_image(camera_id=99), set()),
    "database-frame-id-differs": (with_database_image(frame_id=99), set()),
    "database-keypoints-differ": (with_database_image(num_keypoints=99), set()),
    "database-camera-differs": (part("database", cameras={1: (1, 2 * WIDTH, HEIGHT)}), set()),
}


@pytest.mark.parametrize("rule", FROM_GOOD)
def test_what_lies_beside_a_model_can_break_this_rule_alone(good: Subject, rule: str) -> None:
    edit, others = FROM_GOOD[rule]

    assert found_in(edit(good)) == expected(rule, others)


def test_every_rule_of_the_module_is_in_its_tuple_and_has_a_case() -> None:
    rules = [value for value in vars(checks_database).values() if isinstance(value, Rule)]

    assert set(rules) <= set(checks_database.RULES)
    assert {rule.name for rule in checks_database.RULES} == set(FROM_GOOD)
