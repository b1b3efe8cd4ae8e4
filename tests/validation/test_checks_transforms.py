"""Every rule of ``checks_transforms`` has a model that breaks it and it alone."""

from __future__ import annotations

import json
import math
import random
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from helpers.described_models import (
    ALWAYS,
    HEIGHT,
    NAN,
    WIDTH,
    Case,
    colmap_axes,
    expected,
    found_in,
    moved,
    part,
    transforms_of,
    with_first_frame,
    with_first_matrix,
    without_endings,
)

from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.validation import checks_transforms
from smust3r_colmap.validation.description import Subject
from smust3r_colmap.validation.rules import Rule, apply_rules
from smust3r_colmap.validation.transforms_file import read_transforms
from smust3r_colmap.validation.validate import RULES

FROM_GOOD: dict[str, Case] = {
    "transforms-unreadable": (part("transforms", problem="it has no list of frames", frames=()), set()),
    "transforms-image-missing": (
        lambda good: part("transforms", images={k: v for k, v in good.transforms.images.items() if k[0] != "i"})(good),  # type: ignore[union-attr]
        set(),
    ),
    "transforms-sharp-image-missing": (
        lambda good: part("transforms", images={k: v for k, v in good.transforms.images.items() if k[0] != "i"})(  # type: ignore[union-attr]
            part("transforms", has_sharpness=True)(good)
        ),
        set(),
    ),
    "transforms-image-ending": (without_endings, set()),
    "transforms-comments": (part("transforms", has_comments=True), set()),
    "transforms-masks-incomplete": (with_first_frame(mask_path=""), set()),
    "transforms-points-missing": (part("transforms", ply_is_there=False), set()),
    "transforms-camera-model": (part("transforms", camera_model="FOV"), set()),
    "transforms-intrinsics": (with_first_frame(numbers={"w": WIDTH, "h": HEIGHT, "fl_x": 0.0}), set()),
    "transforms-size-differs": (
        with_first_frame(numbers={"w": 512.0, "h": HEIGHT, "fl_x": 1.0, "fl_y": 1.0, "cx": 0.0, "cy": 0.0}),
        set(),
    ),
    "transforms-pose-not-rigid": (with_first_matrix(lambda matrix: matrix * 1.1), set()),
    "transforms-images-differ": (
        lambda good: part("transforms", frames=good.transforms.frames[1:])(good),  # type: ignore[union-attr]
        set(),
    ),
    "transforms-cameras-differ": (with_first_matrix(moved), set()),
}


@pytest.mark.parametrize("rule", FROM_GOOD)
def test_what_lies_beside_a_model_can_break_this_rule_alone(good: Subject, rule: str) -> None:
    edit, others = FROM_GOOD[rule]

    assert found_in(edit(good)) == expected(rule, others)


def test_every_rule_of_the_module_is_in_its_tuple_and_has_a_case() -> None:
    rules = [value for value in vars(checks_transforms).values() if isinstance(value, Rule)]

    assert set(rules) <= set(checks_transforms.RULES)
    assert {rule.name for rule in checks_transforms.RULES} == set(FROM_GOOD)


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (lambda matrix: matrix * np.array([[1, 1, 1, 1]] * 3 + [[2] * 4]), "the last row is 0 0 0 2"),
        (lambda matrix: matrix @ np.diag([-1, 1, 1, 1]), "the axes are left-handed"),
        (lambda matrix: matrix @ np.diag([1.01, 1, 1, 1]), "from orthonormal"),
        (lambda matrix: matrix * NAN, "not 4 x 4 finite numbers"),
    ],
)
def test_it_is_said_why_a_matrix_is_no_pose(
    good: Subject, change: Callable[[FloatArray], FloatArray], what: str
) -> None:
    found = apply_rules(with_first_matrix(change)(good), RULES.values())

    assert set(found) == ALWAYS | {"transforms-pose-not-rigid"}
    assert what in found["transforms-pose-not-rigid"].text


def test_axes_of_colmap_are_told_by_half_a_turn(good: Subject) -> None:
    found = apply_rules(colmap_axes(good), RULES.values())

    assert set(found) == ALWAYS | {"transforms-cameras-differ"}
    assert "1.8e+02 degrees" in found["transforms-cameras-differ"].text


NASTY: tuple[Any, ...] = (
    *(None, True, "", "x" * 400, "\0", "\ud800", "/", "..", [], {}, [[1]], [[NAN] * 4] * 4, {"file_path": "a"}),
    *(0, -1, 10**400, -(10**400), 1e308, -1e200, math.inf, NAN),
)
"""What a program with a bug, or somebody who means harm, may write in place of anything."""


def with_something_nasty(document: Any, rng: random.Random) -> Any:
    """The document with one of its values, wherever it lies, replaced."""
    if not isinstance(document, (dict, list)) or not document or rng.random() < 0.1:
        return rng.choice(NASTY)
    if isinstance(document, dict):
        key = rng.choice(sorted(document))
        return {**document, key: with_something_nasty(document[key], rng)}
    place = rng.randrange(len(document))
    return [*document[:place], with_something_nasty(document[place], rng), *document[place + 1 :]]


@pytest.mark.slow
def test_no_transforms_file_stops_a_check(good: Subject, tmp_path: Path) -> None:
    """Numbers beyond all floats, names that no file can have, matrices of texts: all of it is a finding, or none."""
    model, rng = pycolmap.Reconstruction(good.model.folder), random.Random(0)
    document = transforms_of(model)
    rules = [rule for name, rule in RULES.items() if name.startswith("transforms-")]
    path, seen = tmp_path / "transforms.json", set[str]()
    for _ in range(200):
        path.write_text(json.dumps(with_something_nasty(with_something_nasty(document, rng), rng)))
        found = apply_rules(replace(good, transforms=read_transforms(path)), rules)
        seen |= found.keys()
        "".join(evidence.text for evidence in found.values()).encode()  # can be printed
    assert {"transforms-unreadable", "transforms-intrinsics", "transforms-pose-not-rigid"} <= seen


@pytest.mark.parametrize("field", ["ply_file_path", "camera_model"])
def test_texts_of_half_a_letter_can_be_reported(good: Subject, field: str) -> None:
    broken = part("transforms", **{field: "\ud800", "ply_is_there": False})(good)
    for evidence in apply_rules(broken, RULES.values()).values():
        evidence.text.encode()


@pytest.mark.parametrize("model", ["VR180_L", "ORTHOPHOTO", "FISHEYE624", "OMNIDIRECTIONALSTEREO_R"])
def test_camera_models_of_nerfstudio_alone_are_known(good: Subject, model: str) -> None:
    assert found_in(part("transforms", camera_model=model)(good)) == ALWAYS


def test_an_image_that_pillow_cannot_read_has_no_size_to_differ(good: Subject) -> None:
    assert good.transforms is not None
    images = {name: replace(file, width=0, height=0) for name, file in good.transforms.images.items()}

    assert found_in(part("transforms", images=images)(good)) == ALWAYS
