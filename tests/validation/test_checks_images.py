"""Every rule of ``checks_images`` has a model that breaks it and it alone."""

from __future__ import annotations

from dataclasses import replace

import pytest
from helpers.described_models import HEIGHT, WIDTH, Case, expected, found_in, with_files, with_first_file

from smust3r_colmap.validation import checks_images
from smust3r_colmap.validation.description import Subject
from smust3r_colmap.validation.rules import Rule

FROM_GOOD: dict[str, Case] = {
    "image-file-missing": (lambda good: with_files(good, lambda files: files[1:]), set()),
    "image-file-extra": (
        lambda good: with_files(good, lambda files: (*files, replace(files[0], name="zz.png"))),
        set(),
    ),
    "image-file-unreadable": (with_first_file(width=0, height=0), set()),
    "image-size-resized": (with_first_file(width=2 * WIDTH, height=2 * HEIGHT), set()),
    "image-size-differs": (with_first_file(width=2 * WIDTH), set()),
    "image-exif-turned": (with_first_file(turned=True), set()),
    "image-exif-against-camera": (with_first_file(width=HEIGHT, height=WIDTH, turned=True), set()),
    "downscaled-list-differs": (
        lambda good: replace(good, downscaled={2: replace(good.downscaled[2], files=good.downscaled[2].files[1:])}),
        set(),
    ),
    "downscaled-size-differs": (lambda good: replace(good, downscaled={4: good.downscaled[2]}), set()),
}


@pytest.mark.parametrize("rule", FROM_GOOD)
def test_what_lies_beside_a_model_can_break_this_rule_alone(good: Subject, rule: str) -> None:
    edit, others = FROM_GOOD[rule]

    assert found_in(edit(good)) == expected(rule, others)


def test_every_rule_of_the_module_is_in_its_tuple_and_has_a_case() -> None:
    rules = [value for value in vars(checks_images).values() if isinstance(value, Rule)]

    assert set(rules) <= set(checks_images.RULES)
    assert {rule.name for rule in checks_images.RULES} == set(FROM_GOOD)
