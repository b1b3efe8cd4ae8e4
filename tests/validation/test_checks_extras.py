"""Every rule of ``checks_extras`` has a model that breaks it and it alone."""

from __future__ import annotations

from dataclasses import replace

import pytest
from helpers.described_models import ALWAYS, Case, expected, found_in, part, with_masks

from smust3r_colmap.validation import checks_extras
from smust3r_colmap.validation.description import Subject
from smust3r_colmap.validation.rules import Rule

FROM_GOOD: dict[str, Case] = {
    "mask-missing": (with_masks(lambda files: files[2:]), set()),
    "mask-one-naming": (with_masks(lambda files: files[1:]), set()),
    "mask-size-differs": (with_masks(lambda files: (replace(files[0], width=3), *files[1:])), set()),
    "ply-unreadable": (part("ply", problem="it has no PLY header"), set()),
    "ply-incomplete": (part("ply", properties=frozenset({"x", "y", "z", "nx", "ny", "nz"})), set()),
    "ply-stale": (lambda good: part("ply", xyz=1.1 * good.ply.xyz)(good), set()),  # type: ignore[union-attr]
    "depth-params-unreadable": (part("depth", problem="KeyError: 'scale'"), set()),
    "depth-params-without-png": (part("depth", pngs=frozenset()), set()),
    "depth-png-without-params": (part("depth", params=None), set()),
    "depth-scale-ignored": (
        lambda good: part("depth", params={**good.depth.params, next(iter(good.depth.params)): (9.0, 0.0)})(good),  # type: ignore[union-attr, arg-type, dict-item]
        set(),
    ),
    "dense-config-dangling": (part("dense", fusion_names=("nobody.png",)), set()),
    "dense-map-size": (
        lambda good: part("dense", depth_sizes=dict.fromkeys(good.dense.depth_sizes, (8, 6)))(good),  # type: ignore[union-attr]
        set(),
    ),
    "dense-normals-missing": (part("dense", normal_maps=frozenset()), set()),
}


@pytest.mark.parametrize("rule", FROM_GOOD)
def test_what_lies_beside_a_model_can_break_this_rule_alone(good: Subject, rule: str) -> None:
    edit, others = FROM_GOOD[rule]

    assert found_in(edit(good)) == expected(rule, others)


def test_every_rule_of_the_module_is_in_its_tuple_and_has_a_case() -> None:
    rules = [value for value in vars(checks_extras).values() if isinstance(value, Rule)]

    assert set(rules) <= set(checks_extras.RULES)
    assert {rule.name for rule in checks_extras.RULES} == set(FROM_GOOD)


def test_a_ply_of_the_same_points_in_another_order_is_not_stale(good: Subject) -> None:
    assert good.ply is not None
    shuffled = replace(good.ply, xyz=good.ply.xyz[::-1])

    assert found_in(replace(good, ply=shuffled)) == ALWAYS
