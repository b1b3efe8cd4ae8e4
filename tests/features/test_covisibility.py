"""Pairs of images that see the same surface: a walk along a wall and back, the back of the wall, other scales."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.tracked_scenes import CAMERA, arc, cam_from_world_towards, straight

from smust3r_colmap.features.covisibility import (
    MIN_COVISIBILITY,
    SAME_PLACE_IMAGES,
    SeenSurface,
    covisibility,
    sample_rows,
    select_pairs,
)
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.camera import Intrinsics, pixel_centres
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.segmentation.view_graph import ViewGraph

WALL_Z = 4.0


def sees_wall(image: int, pose: FloatArray, wall_z: float = WALL_Z) -> SeenSurface:
    """What a camera sees of the plane z = ``wall_z``, on a grid of 12 x 9 pixels."""
    small = CAMERA.resized(12, 9)
    world_from_cam = invert_rigid(pose)
    rays = small.rays_cam(pixel_centres(12, 9)) @ world_from_cam[:, :3].T
    length = (wall_z - world_from_cam[2, 3]) / rays[:, 2]
    points = world_from_cam[:, 3] + length[:, None] * rays
    return SeenSurface(image=image, cam_from_world=pose, intrinsics=CAMERA, points_world=points[length > 0])


around = ViewGraph.chain(30).around


def walk_and_back(num_each: int) -> list[SeenSurface]:
    """Along the wall, and back a little higher; image ``2 n - 1 - k`` is where image k was."""
    there = straight(num_each, step=0.5)
    back = there[::-1].copy()
    back[:, 1, 3] -= 0.3
    return [sees_wall(k, pose) for k, pose in enumerate([*there, *back])]


def test_score_of_parallel_views_is_the_fraction_of_the_wall_that_both_see() -> None:
    surfaces = walk_and_back(6)
    scores = covisibility(surfaces[:6]).toarray()
    width_m = WALL_Z * CAMERA.width / CAMERA.focal_px
    for step in range(1, 6):
        expected = max(0.0, 1 - 0.5 * step / width_m)
        found = scores[0, step]
        assert abs(found - expected) < 0.1, f"{step} steps apart: {found:.2f}, of the wall {expected:.2f}"
    np.testing.assert_array_equal(scores, scores.T)
    assert (np.diag(scores) == 0).all()
    assert scores[scores > 0].min() >= MIN_COVISIBILITY


def test_images_of_the_two_sides_of_a_wall_share_nothing() -> None:
    front = sees_wall(0, straight(1)[0])
    behind = cam_from_world_towards(np.array([[0.0, 0.0, 2 * WALL_Z]]), np.array([0.0, 0.0, 0.0]))[0]
    back = SeenSurface(image=1, cam_from_world=behind, intrinsics=CAMERA, points_world=front.points_world)
    beside = sees_wall(2, straight(2, step=0.2)[1])
    scores = covisibility([front, back, beside]).toarray()
    assert scores[0, 1] == scores[1, 2] == 0, "seen from opposite sides"
    assert 0.85 < scores[0, 2] <= 1


def test_a_surface_hidden_by_a_nearer_one_is_not_seen() -> None:
    """One image sees a wall 2.8 m away, the other, from the same place, 4.2 m, but for a few points of the first."""
    pose = straight(1)[0]
    near, far = sees_wall(0, pose, wall_z=2.8), sees_wall(1, pose, wall_z=4.2)
    mostly_far = replace(far, points_world=np.concatenate([far.points_world, near.points_world[:3]]))
    assert covisibility([near, mostly_far]).nnz == 0
    less_far = replace(mostly_far, points_world=mostly_far.points_world * 0.8)
    assert covisibility([near, less_far]).nnz == 2, "3.4 m are the same wall in a model that bends"


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
def test_the_choice_does_not_depend_on_the_unit_of_length(scale: float) -> None:
    surfaces = walk_and_back(8)
    scaled = []
    for one in surfaces:
        pose = one.cam_from_world.copy()
        pose[:, 3] *= scale
        scaled.append(
            SeenSurface(image=one.image, cam_from_world=pose, intrinsics=CAMERA, points_world=one.points_world * scale)
        )
    assert select_pairs(scaled, per_image=3, known=(), around=around) == select_pairs(
        surfaces, per_image=3, known=(), around=around
    )


def test_choice_reaches_the_other_pass_when_neighbours_are_matched() -> None:
    n = 12
    surfaces = walk_and_back(n)
    known = {(a, b) for a in range(2 * n) for b in range(a + 1, min(a + 5, 2 * n))}
    chosen = select_pairs(surfaces, per_image=1, known=known, around=around)
    assert not set(chosen) & known
    best = {image: {a + b - image for a, b in chosen if image in (a, b)} for image in range(n - 4)}
    for image, partners in best.items():
        there_again = 2 * n - 1 - image
        assert any(abs(partner - there_again) <= 1 for partner in partners), f"image {image} got {partners}"


def test_pairs_ascend_are_new_and_at_most_so_many_of_each_image() -> None:
    surfaces = walk_and_back(12)
    known = {(0, 1), (3, 20), (4, 19)}
    for per_image in (1, 3):
        chosen = select_pairs(surfaces, per_image=per_image, known=known, around=around)
        assert list(chosen) == sorted(set(chosen))
        assert all(a < b for a, b in chosen)
        assert not set(chosen) & known
        assert len(surfaces) / 2 <= len(chosen) <= per_image * len(surfaces)


def test_an_image_passes_over_what_is_next_in_order_to_its_partners() -> None:
    """Image 1 was matched with 22, so 0 is no news for 22; and 22 none for image 0, which was matched with 23."""
    surfaces = walk_and_back(12)
    few = [surfaces[image] for image in (0, 1, 22, 23)]
    assert SAME_PLACE_IMAGES == 2
    assert select_pairs([few[0], few[2]], per_image=4, known=(), around=around) == ((0, 22),)
    assert select_pairs(few, per_image=4, known=[(0, 1), (0, 23), (1, 22), (22, 23)], around=around) == ()


def test_images_that_see_nothing_are_paired_with_nothing() -> None:
    blind = SeenSurface(image=7, cam_from_world=straight(1)[0], intrinsics=CAMERA, points_world=np.empty((0, 3)))
    chosen = select_pairs([*walk_and_back(2), blind], per_image=5, known=(), around=around)
    assert chosen
    assert all(7 not in pair for pair in chosen)
    assert select_pairs([blind], per_image=5, known=(), around=around) == ()
    assert select_pairs([], per_image=5, known=(), around=around) == ()


def test_points_behind_or_beyond_the_lens_model_do_no_harm() -> None:
    wide = Intrinsics(model="SIMPLE_RADIAL", width=640, height=480, params=(200.0, 320.0, 240.0, -0.4))
    points = np.array([[0.0, 0, 4], [30, 0, 1], [0, 0, -4], [0, 0, 0], [1, 1, 4]])
    pose = straight(2, step=0.1)
    both = [SeenSurface(image=k, cam_from_world=pose[k], intrinsics=wide, points_world=points) for k in range(2)]
    assert np.isfinite(covisibility(both).toarray()).all()


def test_images_keep_their_indices_if_some_of_the_collection_are_missing() -> None:
    surfaces = [sees_wall(image, pose) for image, pose in zip((3, 10, 17), arc(3, angle=0.1), strict=True)]
    assert set(select_pairs(surfaces, per_image=2, known=(), around=around)) == {(3, 10), (3, 17), (10, 17)}


@pytest.mark.parametrize(("count", "wanted"), [(0, 5), (1, 5), (5, 5), (6, 5), (1000, 7)])
def test_samples_are_distinct_rows_from_first_to_last(count: int, wanted: int) -> None:
    rows = sample_rows(count, wanted)
    assert len(rows) == min(count, wanted)
    assert len(set(rows.tolist())) == len(rows)
    if count > 1:
        assert (rows[0], rows[-1]) == (0, count - 1)


def test_wrong_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match=r"points \(2, 2\)"):
        SeenSurface(image=0, cam_from_world=straight(1)[0], intrinsics=CAMERA, points_world=np.zeros((2, 2)))
    with pytest.raises(ValueError, match=r"pose \(4, 4\)"):
        SeenSurface(image=0, cam_from_world=np.eye(4), intrinsics=CAMERA, points_world=np.zeros((2, 3)))
