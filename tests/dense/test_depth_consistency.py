"""Maps of a run carried into an adjusted model: exact on exact maps, scaled, checked, and honest about gaps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pycolmap
import pytest
from helpers.dense_scenes import (
    NAMES,
    FloatMap,
    MapsInMemory,
    camera_and_pose,
    exact_depth,
    exact_maps,
    exact_model,
    maps_of,
    surface_depths,
    undistorted,
)

from smust3r_colmap.colmap.reconstruction import SparseObservations
from smust3r_colmap.dense import depth_consistency
from smust3r_colmap.dense.depth_consistency import ModelDepth, depth_of_model, sample_depth
from smust3r_colmap.errors import InputError
from smust3r_colmap.geometry.depth_noise import ADJACENT_PIXELS


@pytest.fixture(scope="module")
def model() -> pycolmap.Reconstruction:
    return exact_model()


@pytest.fixture(scope="module")
def pinholes(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    return undistorted(model, max_image_size=80)


def truth(pinholes: pycolmap.Reconstruction, name: str) -> FloatMap:
    return exact_depth(*camera_and_pose(pinholes, name))


def errors(found: ModelDepth, pinholes: pycolmap.Reconstruction) -> npt.NDArray[np.float64]:
    """Relative, of the pixels that have depth."""
    has = found.depth > 0
    return np.asarray(np.abs(found.depth[has] / truth(pinholes, found.name)[has] - 1), dtype=np.float64)


# ----------------------------------------------------------------------------- carrying
def test_maps_of_distorted_images_become_exact_depth_of_the_undistorted_views(
    model: pycolmap.Reconstruction, pinholes: pycolmap.Reconstruction
) -> None:
    found = list(depth_of_model(model, pinholes, maps_of(exact_maps()), consistent=False))
    assert [one.name for one in found] == list(NAMES)
    camera = pinholes.camera(1)
    for one in found:
        assert one.depth.shape == (camera.height, camera.width)
        assert one.depth.dtype == np.float32
        assert np.mean(one.depth > 0) == 1.0, "the undistorted view lies inside the original"
        assert np.median(errors(one, pinholes)) < 2e-4
        assert np.mean(errors(one, pinholes) > 0.01) < 0.04, "the rim of the ball only"


def test_depth_is_never_blended_across_the_rim_of_the_ball(
    model: pycolmap.Reconstruction, pinholes: pycolmap.Reconstruction
) -> None:
    for one in depth_of_model(model, pinholes, maps_of(exact_maps()), consistent=False):
        camera, pose = camera_and_pose(pinholes, one.name)
        _, wall = surface_depths(camera, pose)
        between = (one.depth > 3.6 + pose[2, 3]) & (one.depth < 0.97 * wall)
        assert np.count_nonzero(between) == 0


def test_maps_may_have_any_size_of_their_own(model: pycolmap.Reconstruction, pinholes: pycolmap.Reconstruction) -> None:
    depths = exact_maps() | {"b.jpg": exact_maps(48, 36)["b.jpg"], "f.png": exact_maps(160, 120)["f.png"]}
    for one in depth_of_model(model, pinholes, maps_of(depths)):
        assert np.median(errors(one, pinholes)) < 1e-3


def test_only_images_with_a_map_come_in_order_of_their_ids(
    model: pycolmap.Reconstruction, pinholes: pycolmap.Reconstruction
) -> None:
    depths = {name: depth for name, depth in exact_maps().items() if name not in ("b.jpg", "f.png")}
    found = [one.name for one in depth_of_model(model, pinholes, maps_of(depths))]
    assert found == ["a.jpg", "left/c d.jpg", "left/e.webp", "g.jpg"]


def test_a_plane_is_sampled_exactly_and_outside_is_nothing() -> None:
    x, y = np.meshgrid(np.arange(12) + 0.5, np.arange(9) + 0.5)
    depth = (1 / (0.2 + 0.002 * x - 0.001 * y)).astype(np.float32)
    columns, rows = np.random.default_rng(0).uniform(0.5, [11.5, 8.5], (200, 2)).T
    np.testing.assert_allclose(
        sample_depth(depth, columns, rows), 1 / (0.2 + 0.002 * columns - 0.001 * rows), rtol=1e-5
    )
    outside = sample_depth(depth, np.array([-0.1, 12.0, 5.0, np.nan]), np.array([4.0, 4.0, 9.0, 4.0]))
    np.testing.assert_array_equal(outside, 0)


def depth_by_the_rule(depth: FloatMap, x: float, y: float) -> float:
    """What ``sample_depth`` promises, for one place."""
    height, width = depth.shape
    if not (0 <= x < width and 0 <= y < height):
        return 0.0
    j, i = int(max(x - 0.5, 0)), int(max(y - 0.5, 0))
    four = depth[np.ix_([i, min(i + 1, height - 1)], [j, min(j + 1, width - 1)])].astype(np.float64)
    if four.min() <= 0 or four.max() > four.min() * (1 + ADJACENT_PIXELS):
        return float(depth[int(y), int(x)])
    right, down = max(x - 0.5, 0) - j, max(y - 0.5, 0) - i
    return float(1 / (np.array([1 - down, down]) @ (1 / four) @ np.array([1 - right, right])))


def test_every_place_is_sampled_by_the_rule_at_edges_holes_and_the_rim() -> None:
    rng = np.random.default_rng(5)
    depth = rng.choice([2.0, 3.0], (7, 9), p=[0.8, 0.2]) * rng.uniform(1.0, 1.02, (7, 9))
    depth[rng.random((7, 9)) < 0.1] = 0
    columns, rows = rng.uniform(-0.5, [9.5, 7.5], (600, 2)).T
    expected = [depth_by_the_rule(depth.astype(np.float32), *place) for place in zip(columns, rows, strict=True)]
    assert 0.1 < np.mean(np.array(expected) == 0) < 0.5
    found = sample_depth(depth.astype(np.float32), columns, rows)
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_pixels_of_which_nothing_is_known_stay_without_depth(
    model: pycolmap.Reconstruction, pinholes: pycolmap.Reconstruction
) -> None:
    exact = maps_of(exact_maps())
    unsure = {name: confidence.copy() for name, confidence in exact.confidences.items()}
    unsure["a.jpg"][:, 40:] = 1.0
    first = next(depth_of_model(model, pinholes, MapsInMemory(exact.depths, unsure), consistent=False))
    assert (first.depth[:, 41:] == 0).all()
    assert np.mean(first.depth[:, :38] > 0) == 1.0


# -------------------------------------------------------------------------------- scale
def test_each_map_is_brought_to_the_unit_of_the_model_by_its_own_factor(
    model: pycolmap.Reconstruction, pinholes: pycolmap.Reconstruction
) -> None:
    factors = dict(zip(NAMES, 0.3 * np.linspace(0.9, 1.1, len(NAMES)), strict=True))
    depths = {name: (depth / factors[name]).astype(np.float32) for name, depth in exact_maps().items()}
    for one in depth_of_model(model, pinholes, maps_of(depths)):
        assert one.scale == pytest.approx(factors[one.name], rel=2e-3)
        assert 100 < one.num_points <= 400
        assert np.median(errors(one, pinholes)) < 2e-3


def test_scale_survives_a_third_of_the_map_being_wrong(
    model: pycolmap.Reconstruction, pinholes: pycolmap.Reconstruction
) -> None:
    depths = exact_maps()
    depths["b.jpg"][:, :26] *= 1.7
    scales = {one.name: one.scale for one in depth_of_model(model, pinholes, maps_of(depths), consistent=False)}
    assert scales["b.jpg"] == pytest.approx(1.0, rel=5e-3)


def test_an_image_with_few_points_takes_the_scale_of_the_model(pinholes: pycolmap.Reconstruction) -> None:
    model = exact_model()
    lonely = model.find_image_with_name("left/e.webp")
    observed = [index for index, point in enumerate(lonely.points2D) if point.has_point3D()]
    for index in observed[depth_consistency.MIN_SCALE_POINTS - 1 :]:
        model.delete_observation(lonely.image_id, index)
    depths = {name: 2 * depth for name, depth in exact_maps().items()}
    depths["left/e.webp"] *= 1.1  # which its few points would say, were they asked
    found = {one.name: one for one in depth_of_model(model, pinholes, maps_of(depths), consistent=False)}
    assert found["left/e.webp"].num_points == 0
    assert found["left/e.webp"].scale == pytest.approx(0.5, rel=2e-3)
    assert found["a.jpg"].num_points > 100


@pytest.mark.parametrize(("factor", "believed"), [(1.3, True), (0.75, True), (2.0, False), (0.4, False)])
def test_an_absurd_scale_of_one_image_is_not_believed(
    model: pycolmap.Reconstruction, pinholes: pycolmap.Reconstruction, factor: float, believed: bool
) -> None:
    depths = exact_maps()
    depths["b.jpg"] = (depths["b.jpg"] / factor).astype(np.float32)
    found = {one.name: one for one in depth_of_model(model, pinholes, maps_of(depths), consistent=False)}
    assert found["b.jpg"].scale == pytest.approx(factor if believed else 1.0, rel=2e-3)
    assert (found["b.jpg"].num_points > 0) == believed


def test_without_points_the_model_is_in_the_unit_of_the_maps(
    pinholes: pycolmap.Reconstruction, caplog: pytest.LogCaptureFixture
) -> None:
    found = list(depth_of_model(pinholes, pinholes, maps_of(exact_maps())))
    assert {(one.scale, one.num_points) for one in found} == {(1.0, 0)}
    assert "6 of 6 depth maps take the scale of the whole model" in caplog.text


# -------------------------------------------------------------------------- consistency
def test_depth_that_other_views_deny_is_dropped_and_the_rest_stays(
    model: pycolmap.Reconstruction, pinholes: pycolmap.Reconstruction
) -> None:
    depths = exact_maps()
    wrong = (slice(10, 30), slice(8, 28))
    depths["left/c d.jpg"][wrong] *= 1.08
    inner = (slice(13, 27), slice(11, 25))  # undistortion moves the block by less than two pixels
    raw, checked = (
        {one.name: one.depth for one in depth_of_model(model, pinholes, maps_of(depths), consistent=consistent)}
        for consistent in (False, True)
    )
    assert np.mean(raw["left/c d.jpg"][inner] > 0) == 1.0
    assert np.mean(checked["left/c d.jpg"][inner] > 0) == 0.0
    for name in NAMES:
        assert 0.75 < np.mean(checked[name] > 0) < 1.0, "what the others do not see cannot be confirmed"


def test_one_view_that_agrees_by_chance_is_not_enough(
    model: pycolmap.Reconstruction, pinholes: pycolmap.Reconstruction
) -> None:
    depths = exact_maps()
    for name in ("left/c d.jpg", "left/e.webp"):
        depths[name] = np.where(np.arange(80) < 40, 0.9 * depths[name], depths[name]).astype(np.float32)
    checked = {one.name: one.depth for one in depth_of_model(model, pinholes, maps_of(depths))}
    assert np.mean(checked["left/c d.jpg"][:, 5:30] > 0) < 0.02


def test_two_images_confirm_each_other_and_one_stays_as_it_is(model: pycolmap.Reconstruction) -> None:
    pinholes = undistorted(model, max_image_size=80)
    depths = exact_maps()
    pair = {name: depths[name] for name in ("b.jpg", "left/c d.jpg")}
    for one in depth_of_model(model, pinholes, maps_of(pair)):
        assert 0.75 < np.mean(one.depth > 0) < 1.0
    (alone,) = depth_of_model(model, pinholes, maps_of({"b.jpg": depths["b.jpg"]}))
    assert np.mean(alone.depth > 0) == 1.0


def test_views_from_the_same_place_are_asked_last(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(depth_consistency, "CHECK_NEIGHBOURS", 2)
    xyz = np.random.default_rng(1).uniform([-1, -1, 4], [1, 1, 6], (50, 3))
    everything = np.arange(50)
    observations = SparseObservations(
        xyz=xyz,
        rgb=np.zeros((50, 3), np.uint8),
        track_lengths=np.full(50, 4.0),
        points=dict.fromkeys((1, 2, 3, 4), everything) | {4: everything[:30]},
        xy={},
    )
    base = depth_consistency._View(img_from_cam=np.eye(3), cam_from_world=np.eye(4)[:3])
    views = {1: base}
    for i, x in ((2, 0.01), (3, 0.5), (4, -0.5)):
        views[i] = replace(base, cam_from_world=np.column_stack([np.eye(3), [-x, 0, 0]]))
    assert depth_consistency._neighbours(observations, views)[1] == [3, 4]


def test_memory_for_neighbours_changes_nothing_but_time(
    model: pycolmap.Reconstruction, pinholes: pycolmap.Reconstruction, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = list(depth_of_model(model, pinholes, maps_of(exact_maps())))
    monkeypatch.setattr(depth_consistency, "CACHE_BYTES", 0)
    for one, again in zip(expected, depth_of_model(model, pinholes, maps_of(exact_maps())), strict=True):
        np.testing.assert_array_equal(one.depth, again.depth)


# ----------------------------------------------------------------------------- refusals
def test_an_image_that_the_original_model_does_not_hold_is_refused(pinholes: pycolmap.Reconstruction) -> None:
    model = exact_model()
    smaller = pycolmap.Reconstruction()
    smaller.add_camera_with_trivial_rig(model.camera(1))
    with pytest.raises(InputError, match=r"a.jpg: image 1 has no pose in the original model"):
        depth_of_model(smaller, pinholes, maps_of(exact_maps()))


def test_a_distorted_camera_is_refused_as_target(model: pycolmap.Reconstruction) -> None:
    with pytest.raises(InputError, match=r"a.jpg: camera is SIMPLE_RADIAL, needed PINHOLE; undistort it"):
        depth_of_model(model, model, maps_of(exact_maps()))
