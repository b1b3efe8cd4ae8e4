"""The uncertainty of models: numbers for every image, whatever the model; contradictions spread it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pycolmap
import pytest
from helpers.tracked_scenes import (
    World,
    arc,
    ball,
    cam_from_world_towards,
    make_world,
    model_with_true_tracks,
    straight,
    turning,
)

from smust3r_colmap.geometry.arrays import FloatArray, Pair
from smust3r_colmap.refinement.misregistration import EpipolarSupport
from smust3r_colmap.refinement.model_uncertainty import (
    ModelUncertainty,
    adjusted_priors,
    measure_uncertainty,
    summarise_uncertainty,
)

AGREES = EpipolarSupport(num_matches=100, inlier_fraction=1.0)
CONTRADICTS = EpipolarSupport(num_matches=100, inlier_fraction=0.0)


def model_of(world: World) -> pycolmap.Reconstruction:
    return model_with_true_tracks(world, world.cam_from_world, np.random.default_rng(0), noise=0)


def world_of(cam_from_world: FloatArray, points: FloatArray) -> World:
    return make_world(cam_from_world, points, np.random.default_rng(1))


def measured(model: pycolmap.Reconstruction, support: Mapping[Pair, EpipolarSupport] | None = None) -> ModelUncertainty:
    return measure_uncertainty(model, () if support is None else (support,), calibrated=False)


def around(points: int = 120, images: int = 10) -> pycolmap.Reconstruction:
    return model_of(world_of(arc(images), ball(points, np.random.default_rng(2))))


def test_a_sound_model_is_certain_of_every_image() -> None:
    found = measured(around())
    assert found.names == tuple(f"{i:04d}.png" for i in range(10))
    assert found.determined.all()
    assert 0.01 < found.predicted_error_percent < 1
    np.testing.assert_allclose(
        found.position_sigma**2, np.trace(found.position_covariance, axis1=1, axis2=2), rtol=1e-9
    )


def test_sigmas_are_in_units_of_the_model() -> None:
    small, large = around(), around()
    large.transform(pycolmap.Sim3d(10.0, pycolmap.Rotation3d(np.eye(3)), np.array([100.0, 0, 0])))
    ratio = measured(large).position_sigma / measured(small).position_sigma
    np.testing.assert_allclose(ratio, 10, rtol=1e-3)


def test_an_image_that_most_matches_contradict_may_be_anywhere() -> None:
    support = {(i, j): CONTRADICTS if j == 9 else AGREES for i in range(10) for j in range(i + 1, 10)}
    found = measured(around(), support)
    summary = summarise_uncertainty(found)
    assert summary.contradicted == summary.contradicted_stretches == ("0009.png",)
    assert summary.least_certain == "0009.png"
    # itself by the extent, and all by a tenth of that through the alignment
    assert found.position_sigma[9] == pytest.approx(found.extent * np.sqrt(1.01), rel=1e-3)
    assert found.position_sigma[0] == pytest.approx(0.1 * found.extent, rel=0.01)
    assert summary.predicted_error_percent == pytest.approx(100 * np.sqrt(0.11), rel=0.01)


def test_consecutive_contradicted_images_are_named_as_a_stretch() -> None:
    apart = {3, 4, 5, 8}
    support = {
        (i, j): CONTRADICTS if (i in apart) != (j in apart) else AGREES for i in range(10) for j in range(i + 1, 10)
    }
    assert summarise_uncertainty(measured(around(), support)).contradicted_stretches == (
        "0003.png to 0005.png",
        "0008.png",
    )


def test_priors_have_the_covariance_of_their_image() -> None:
    model = around()
    found = measured(model)
    priors = adjusted_priors(model, found)
    assert [prior.pose_prior_id for prior in priors] == sorted(model.reg_image_ids())
    for prior, covariance in zip(priors, found.position_covariance, strict=True):
        np.testing.assert_array_equal(prior.position_covariance, covariance)
        assert np.linalg.eigvalsh(covariance).min() > 0


def plane(rng: np.random.Generator) -> FloatArray:
    return np.column_stack([rng.uniform(-2, 2, (150, 2)), np.full(150, 5.0)])


def in_front(rng: np.random.Generator, depth: float) -> FloatArray:
    return rng.uniform((-0.4, -0.3, 0.9), (0.4, 0.3, 1.1), (150, 3)) * depth


DEGENERATE = {
    "points on a plane": lambda rng: world_of(straight(8), plane(rng)),
    "points at infinity": lambda rng: world_of(straight(8), in_front(rng, 1e9)),
    "pure rotation": lambda rng: world_of(turning(8), in_front(rng, 5.0)),
    "centres on a line": lambda rng: world_of(straight(8), in_front(rng, 5.0)),
    "one image": lambda rng: world_of(arc(1), ball(50, rng)),
    "two images": lambda rng: world_of(arc(2), ball(50, rng)),
    "equal centres but one": lambda rng: world_of(
        cam_from_world_towards(np.eye(8, 3) * [1.0, 0, 0], np.array([0.0, 0, 5])), in_front(rng, 5.0)
    ),
}
BOUNDED = {"points on a plane", "centres on a line", "equal centres but one", "two images"}


@pytest.mark.parametrize("name", DEGENERATE)
def test_degenerate_models_have_numbers_and_say_what_is_not_determined(name: str) -> None:
    found = measured(model_of(DEGENERATE[name](np.random.default_rng(3))))
    summary = summarise_uncertainty(found)
    assert np.isfinite(found.position_covariance).all()
    assert np.isfinite(found.rotation_sigma_deg).all()
    assert (found.rotation_sigma_deg <= 180).all()
    assert np.isfinite(summary.predicted_error_percent)
    if name in BOUNDED:
        assert found.determined.all()
    else:
        assert not found.determined.any()


def test_a_model_without_points_determines_nothing() -> None:
    model = around()
    for point_id in sorted(model.point3D_ids()):
        model.delete_point3D(point_id)
    found = measured(model)
    assert not found.determined.any()
    assert found.predicted_error_percent > 50
    assert (found.num_observations == 0).all()


def test_an_image_without_observations_is_not_determined_and_the_others_are() -> None:
    model = around()
    for point_id in sorted(model.point3D_ids()):
        track = model.point3D(point_id).track
        of_last = [element for element in track.elements if element.image_id == 10]
        if not of_last:
            continue
        if track.length() <= 2:
            model.delete_point3D(point_id)
        else:
            model.delete_observation(10, of_last[0].point2D_idx)
    found = measured(model)
    assert summarise_uncertainty(found).undetermined == ("0009.png",)
    assert found.position_sigma[9] > 0.5 * found.extent
    assert found.position_sigma[:9].max() < 0.2 * found.extent
