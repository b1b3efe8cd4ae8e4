"""Triangulation of tags, and which of them are wrong."""

from __future__ import annotations

import numpy as np
import pytest

from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.georeferencing.tags import (
    View,
    reprojection_errors,
    tag_limit_px,
    tags_on_one_pixel,
    triangulate,
    without_wrong_tags,
)

CAMERA = Intrinsics(model="SIMPLE_RADIAL", width=1280, height=853, params=(1000.0, 640.0, 426.5, -0.05))
CENTRES = np.array([[0.0, 0, 0], [3, 0.5, 0], [6, -0.5, 0.3], [2, 3, 0]])


def views(point: FloatArray, *, count: int = 4, off: dict[int, tuple[float, float]] | None = None) -> list[View]:
    """Cameras that look along z at a point, with tags off by so many pixels."""
    found = []
    for k, centre in enumerate(CENTRES[:count]):
        pose = np.column_stack([np.eye(3), -centre])
        xy = CAMERA.xy_img((point - centre)[None])[0] + (off or {}).get(k, (0, 0))
        found.append(View(image=f"{k}.jpg", xy=xy, camera=CAMERA, cam_from_model=pose))
    return found


POINT = np.array([2.5, 0.4, 10.0])


def test_exact_tags_give_the_point_through_distortion() -> None:
    found = triangulate(views(POINT))
    assert found is not None
    np.testing.assert_allclose(found.point_model, POINT, atol=1e-8)
    np.testing.assert_allclose(found.errors_px, 0, atol=1e-6)


def test_one_tag_and_parallel_rays_give_none() -> None:
    assert triangulate(views(POINT, count=1)) is None
    assert triangulate(views(np.array([1.0, 0, 4000]), count=3)) is None


def test_behind_a_camera_is_infinitely_wrong() -> None:
    errors = reprojection_errors(np.array([2.5, 0.4, -10.0]), views(POINT))
    assert np.isinf(errors).all()


@pytest.mark.parametrize("wrong", [0, 1, 3])
def test_a_wrong_tag_is_found_by_leaving_each_out(wrong: int) -> None:
    tagged = views(POINT, off={wrong: (150, -230)})
    (found,) = without_wrong_tags(tagged, 4.0)
    assert list(found.left_out) == [wrong]
    assert found.left_out[wrong] == "275 px from where its 3 other tags put it"
    np.testing.assert_allclose(found.point_model, POINT, atol=1e-6)


def test_the_wrong_one_of_three_tags_is_found() -> None:
    (found,) = without_wrong_tags(views(POINT, count=3, off={1: (0, 400)}), 4.0)
    assert list(found.left_out) == [1]


def test_two_tags_that_contradict_give_no_answer() -> None:
    assert without_wrong_tags(views(POINT, count=2, off={1: (0, 100)}), 4.0) == []


def test_a_tag_moved_along_the_ray_leaves_more_than_one_answer() -> None:
    """Two cameras beside each other: a shift along the base is another depth, so any of the three may be wrong."""
    base = [
        View(image=f"{k}", xy=xy, camera=CAMERA, cam_from_model=np.column_stack([np.eye(3), [-2.0 * k, 0, 0]]))
        for k, xy in enumerate(CAMERA.xy_img(POINT - np.array([[0.0, 0, 0], [2, 0, 0], [4, 0, 0]])))
    ]
    moved = View(image="2", xy=base[2].xy + np.array([60, 0]), camera=CAMERA, cam_from_model=base[2].cam_from_model)
    answers = without_wrong_tags([*base[:2], moved], 4.0)
    assert len(answers) > 1


def test_the_limit_follows_the_errors_and_has_a_floor() -> None:
    exact, noisy = (
        triangulate(views(POINT)),
        triangulate(views(POINT, off={0: (9, 0), 1: (0, 9), 2: (-9, 0), 3: (0, 9)})),
    )
    assert exact is not None
    assert noisy is not None
    assert tag_limit_px([exact], 1280) == pytest.approx(3.84)
    assert tag_limit_px([noisy], 1280) == pytest.approx(6 * 1.4826 * np.median(noisy.errors_px))
    assert tag_limit_px([], 4000) == pytest.approx(12)


def test_two_labels_on_one_pixel_are_named() -> None:
    a, b = views(POINT), views(POINT + np.array([0.5, 0, 0]))
    shifted = View(
        image=b[1].image, xy=a[1].xy + np.array([1, -0.7]), camera=CAMERA, cam_from_model=b[1].cam_from_model
    )
    assert tags_on_one_pixel({"gcp00": a, "gcp04": [b[0], shifted]}) == [("1.jpg", "gcp00", "gcp04")]
    assert tags_on_one_pixel({"gcp00": a, "gcp04": b}) == []
