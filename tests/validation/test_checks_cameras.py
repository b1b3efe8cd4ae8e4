"""Every rule of ``checks_cameras`` has a model that breaks it and it alone."""

from __future__ import annotations

from dataclasses import replace

import pycolmap
import pytest
from helpers.described_models import (
    CX,
    CY,
    HEIGHT,
    UNOBSERVED,
    WIDTH,
    Case,
    at,
    camera_params,
    expected,
    found_in,
    one_camera_per_image,
    second_camera,
    unobserved,
    with_camera,
    with_images,
    with_model,
)

from smust3r_colmap.validation import checks_cameras
from smust3r_colmap.validation.description import CAMERA_MODELS, Subject
from smust3r_colmap.validation.rules import Rule

FROM_BARE: dict[str, Case] = {
    "camera-model-unknown": (lambda bare: with_camera(bare, model="MIRROR"), {"-camera-model-PINHOLE"}),
    "camera-missing": (lambda bare: with_images(bare, camera_ids=at(bare.model.images.camera_ids, 0, 7)), set()),
    "camera-unused": (
        lambda bare: with_model(bare, cameras=(*bare.model.cameras, replace(bare.model.cameras[0], camera_id=2))),
        {"camera-id-not-one"},
    ),
    "camera-per-image": (one_camera_per_image, {"camera-id-not-one"}),
    "camera-id-not-one": (second_camera(), set()),
    "camera-kinds-mixed": (
        second_camera(model="OPENCV_FISHEYE", params=(300.0, 300.0, CX, CY, 0, 0, 0, 0)),
        {"camera-id-not-one", "camera-model-OPENCV_FISHEYE"},
    ),
    "camera-size-zero": (
        lambda bare: with_camera(unobserved(bare), width=0),
        {*UNOBSERVED, "principal-point-off-centre"},
    ),
    "principal-point-off-centre": (lambda bare: with_camera(bare, params=(300.0, 300.0, CX + 1.5, CY)), set()),
    "intrinsics-other-resolution": (camera_params(150.0, 150.0, CX / 2, CY / 2), UNOBSERVED),
    "principal-point-zero": (camera_params(300.0, 300.0, 0.0, 0.0), {*UNOBSERVED, "principal-point-off-centre"}),
    "focal-impossible": (camera_params(300.0, -500.0, CX, CY), UNOBSERVED),
    "focal-absurd": (camera_params(20.0, 20.0, CX, CY), UNOBSERVED),
    "focal-unequal": (camera_params(300.0, 250.0, CX, CY), UNOBSERVED),
    "distortion-absurd": (
        camera_params(300.0, CX, CY, 1.5, model="SIMPLE_RADIAL"),
        {*UNOBSERVED, "camera-model-SIMPLE_RADIAL", "-camera-model-PINHOLE"},
    ),
}


@pytest.mark.parametrize("rule", FROM_BARE)
def test_a_model_can_break_this_rule_alone(bare: Subject, rule: str) -> None:
    edit, others = FROM_BARE[rule]

    assert found_in(edit(bare)) == expected(rule, others)


def test_every_rule_of_the_module_is_in_its_tuple_and_has_a_case() -> None:
    rules = [value for value in vars(checks_cameras).values() if isinstance(value, Rule)]

    assert set(rules) <= set(checks_cameras.RULES)
    assert {rule.name for rule in checks_cameras.RULES} == set(FROM_BARE) | {
        f"camera-model-{name}" for name in CAMERA_MODELS
    }


@pytest.mark.parametrize("name", CAMERA_MODELS)
def test_every_camera_model_is_told(bare: Subject, name: str) -> None:
    camera = pycolmap.Camera.create_from_model_name(1, name, 300.0, WIDTH, HEIGHT)
    subject = with_camera(unobserved(bare), model=name, params=tuple(camera.params.tolist()))

    assert {rule for rule in found_in(subject) if rule.startswith("camera-model-")} == {f"camera-model-{name}"}
    assert CAMERA_MODELS[name].number == pycolmap.CameraModelId.__members__[name].value
