"""Every rule of ``checks_geometry`` has a model that breaks it and it alone."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.described_models import (
    CX,
    NAN,
    NUM_POINTS,
    Case,
    at,
    expected,
    far_camera,
    found_in,
    free_row,
    misplaced_observations,
    opposite,
    outlier_point,
    point_behind,
    point_nowhere,
    shifted_world,
    with_camera,
    with_frame,
    with_images,
    with_model,
    with_points,
    without_frames,
)

from smust3r_colmap.validation import checks_geometry
from smust3r_colmap.validation.description import Rig, Subject
from smust3r_colmap.validation.rules import Rule

FROM_BARE: dict[str, Case] = {
    "camera-not-finite": (lambda bare: with_camera(bare, params=(300.0, 300.0, CX, NAN)), set()),
    "image-looks-away": (opposite, {"image-unobserved"}),
    "points-colourless": (lambda bare: with_points(bare, rgb=np.zeros((NUM_POINTS, 3), np.uint8)), set()),
    "observation-not-finite": (
        lambda bare: with_images(bare, xy_img=at(bare.model.images.xy_img, (free_row(bare), 0), NAN)),
        set(),
    ),
    "reprojection-high": (misplaced_observations, set()),
    "pose-not-finite": (
        lambda bare: with_images(bare, translation=at(bare.model.images.translation, (0, 1), NAN)),
        set(),
    ),
    "pose-quaternion": (
        lambda bare: with_images(without_frames(bare), quat_wxyz=bare.model.images.quat_wxyz * 1.01),
        set(),
    ),
    "pose-quaternion-none": (
        lambda bare: with_images(without_frames(bare), quat_wxyz=bare.model.images.quat_wxyz * 10),
        set(),
    ),
    "coordinates-large": (shifted_world(1e6), set()),
    "outlier-cameras": (far_camera, {"image-unobserved"}),
    "outlier-points": (outlier_point, {"track-none"}),
    "point-behind-camera": (point_behind, set()),
    "point-not-finite": (point_nowhere, set()),
    "rig-not-trivial": (lambda bare: with_model(bare, rigs=(Rig(rig_id=1, sensors=((0, 1), (0, 2))),)), set()),
    "frame-dangling": (with_frame(data=((0, 1, 77),)), set()),
    "frame-pose-differs": (with_frame(translation=(1.0, 2.0, 3.0)), set()),
}


@pytest.mark.parametrize("rule", FROM_BARE)
def test_a_model_can_break_this_rule_alone(bare: Subject, rule: str) -> None:
    edit, others = FROM_BARE[rule]

    assert found_in(edit(bare)) == expected(rule, others)


def test_every_rule_of_the_module_is_in_its_tuple_and_has_a_case() -> None:
    rules = [value for value in vars(checks_geometry).values() if isinstance(value, Rule)]

    assert set(rules) <= set(checks_geometry.RULES)
    assert {rule.name for rule in checks_geometry.RULES} == set(FROM_BARE)


@pytest.mark.parametrize(
    ("sensor_from_rig", "differs"), [((1.0, 0, 0, 0, 0, 0, 0), False), ((1.0, 0, 0, 0, 0.5, 0, 0), True)]
)
def test_frames_of_rigs_with_several_sensors_are_compared_with_their_images(
    bare: Subject, sensor_from_rig: tuple[float, ...], differs: bool
) -> None:
    """The camera of the images is the second sensor, in the place of the first or half a unit beside it."""
    rigs = tuple(
        Rig(rig_id=rig.rig_id, sensors=((0, 9), *rig.sensors), sensor_from_rig={rig.sensors[0]: sensor_from_rig})
        for rig in bare.model.rigs or ()
    )

    assert rigs
    assert ("frame-pose-differs" in found_in(with_model(bare, rigs=rigs))) == differs
