"""Rigid cameras for submodels that a transform moved or bent."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from helpers.scenes import CAMERA, make_submodel, points_ahead, some_sim3, walk
from scipy.spatial.transform import Rotation

from smust3r_colmap.errors import DegenerateAlignmentError
from smust3r_colmap.geometry.affine3 import Affine3
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.camera import pointmap_from_depth
from smust3r_colmap.geometry.se3 import SE3
from smust3r_colmap.geometry.sim3 import Sim3, invert_rigid
from smust3r_colmap.geometry.sl4 import SL4
from smust3r_colmap.geometry.transform import Transform
from smust3r_colmap.products import Submodel
from smust3r_colmap.stitching.resection import PlacedSubmodel, moved_cameras, place_submodel

IMAGES = tuple(range(6))


class NoMaps:
    """Maps that nobody may read."""

    def __len__(self) -> int:
        return len(IMAGES)

    def pointmap_seg(self, k: int) -> npt.NDArray[np.float32]:
        raise AssertionError(f"map {k} was read")

    depth = confidence = pointmap_seg

    def rgb(self, k: int) -> npt.NDArray[np.uint8]:
        raise AssertionError(f"image {k} was read")


class WavyMaps(NoMaps):
    """Depth between 4 and 8 before every camera of a submodel."""

    def __init__(self, submodel: Submodel, scale: float) -> None:
        self.submodel, self.scale = submodel, scale

    def pointmap_seg(self, k: int) -> npt.NDArray[np.float32]:
        y, x = np.mgrid[:24, :32]
        depth = self.scale * (6 + 2 * np.sin(0.4 * x + k) * np.cos(0.3 * y))
        pointmap = pointmap_from_depth(depth, CAMERA.resized(32, 24), self.submodel.seg_from_cam[k])
        pointmap[0, :5] = np.nan
        return pointmap

    def confidence(self, k: int) -> npt.NDArray[np.float32]:
        confidence = np.full((24, 32), 3.0, dtype=np.float32)
        confidence[-1] = 1.0
        return confidence


def some_submodel(*, num_points: int = 300, with_tracks: bool = True) -> tuple[Submodel, Sim3]:
    rng = np.random.default_rng(6)
    seg_from_world = some_sim3(rng)
    submodel = make_submodel(
        walk(len(IMAGES)), IMAGES, points_ahead(num_points, rng), seg_from_world, with_tracks=with_tracks
    )
    return submodel, seg_from_world


def bent(group: type[Affine3] | type[SL4], amount: float, *, submodel: Submodel, seed: int = 0) -> Transform:
    """A similarity after a warp of this size about the cameras, in parts of the depth."""
    rng = np.random.default_rng(seed)
    tangent = rng.normal(size=group.DOF)
    tangent[12:] /= 20.0
    assert submodel.tracks is not None
    to_centre = np.eye(4)
    to_centre[:3, 3] = -submodel.seg_from_cam[0, :, 3]
    warp = group.exp(amount * tangent / np.linalg.norm(tangent)).matrix
    return group.from_matrix(some_sim3(rng).matrix @ warp @ to_centre)


def rms_px(placed: PlacedSubmodel, poses: FloatArray) -> FloatArray:
    """(N,) distance from where ``poses`` see the moved points to where the submodel saw them, by COLMAP's camera."""
    submodel = placed.submodel
    assert submodel.tracks is not None
    moved = placed.world_from_seg.apply(submodel.tracks.points_seg)
    out = []
    for k, pose in enumerate(invert_rigid(poses)):
        own = invert_rigid(submodel.seg_from_cam[k])
        was = CAMERA.xy_img(submodel.tracks.points_seg @ own[:, :3].T + own[:, 3])
        now = CAMERA.xy_img(moved @ pose[:, :3].T + pose[:, 3])
        out.append(np.sqrt(np.mean(((was - now) ** 2).sum(axis=1))))
    return np.array(out)


# ------------------------------------------------------------------------- similarities
@pytest.mark.parametrize("group", [Sim3, SE3])
def test_groups_that_keep_angles_move_cameras_without_looking_at_points(group: type[Transform]) -> None:
    submodel, _ = some_submodel()
    similarity = some_sim3(np.random.default_rng(1))
    if group is SE3:
        similarity = replace(similarity, scale=np.array(1.0))
    placed = place_submodel(
        replace(submodel, tracks=None), NoMaps(), group.from_matrix(similarity.matrix), is_loop=True
    )
    np.testing.assert_allclose(placed.world_from_cam, similarity.move_cameras(submodel.seg_from_cam), atol=1e-12)
    assert placed.residual_px.tolist() == [0.0] * len(IMAGES)
    assert placed.is_loop


@pytest.mark.parametrize("group", [Affine3, SL4])
@pytest.mark.parametrize("with_tracks", [True, False])
def test_a_similarity_in_a_wider_group_is_still_exact(group: type[Transform], with_tracks: bool) -> None:
    submodel, seg_from_world = some_submodel(with_tracks=with_tracks)
    similarity = some_sim3(np.random.default_rng(1))
    maps = NoMaps() if with_tracks else WavyMaps(submodel, float(seg_from_world.scale))
    placed = place_submodel(submodel, maps, group.from_matrix(similarity.matrix))
    tolerance = 1e-9 if with_tracks else 1e-5  # maps are single precision
    np.testing.assert_allclose(
        placed.world_from_cam, similarity.move_cameras(submodel.seg_from_cam), atol=tolerance, rtol=tolerance
    )
    assert placed.residual_px.max() < (1e-6 if with_tracks else 1e-2)
    assert not placed.is_loop


# --------------------------------------------------------------------------------- bending
@pytest.mark.parametrize("group", [Affine3, SL4])
@pytest.mark.parametrize("seed", range(4))
def test_camera_of_a_bent_submodel_is_the_best_rigid_one(group: type[Affine3] | type[SL4], seed: int) -> None:
    submodel, _ = some_submodel()
    world_from_seg = bent(group, 0.1, submodel=submodel, seed=seed)
    placed = place_submodel(submodel, NoMaps(), world_from_seg)
    moved_only = rms_px(placed, moved_cameras(world_from_seg, submodel.seg_from_cam))
    found = rms_px(placed, placed.world_from_cam)
    np.testing.assert_allclose(placed.residual_px, found, rtol=1e-6)
    assert 1 < found.max() < 30
    assert (found <= moved_only).all()
    assert found.mean() < 0.9 * moved_only.mean()
    rng = np.random.default_rng(seed)
    extent = float(np.linalg.norm(np.ptp(placed.world_from_cam[:, :, 3], axis=0)))
    for _ in range(10):
        nearby = placed.world_from_cam.copy()
        nearby[:, :, :3] @= Rotation.from_rotvec(rng.normal(scale=1e-3, size=(len(IMAGES), 3))).as_matrix()
        nearby[:, :, 3] += rng.normal(scale=1e-3 * extent, size=(len(IMAGES), 3))
        assert (rms_px(placed, nearby) > found).all()


@pytest.mark.parametrize("group", [Affine3, SL4])
def test_residual_grows_with_the_bending(group: type[Affine3] | type[SL4]) -> None:
    submodel, _ = some_submodel()
    residuals = [
        place_submodel(submodel, NoMaps(), bent(group, amount, submodel=submodel)).residual_px.mean()
        for amount in (0.005, 0.01, 0.02)
    ]
    assert 0.05 < residuals[0] < 3
    assert residuals[1] / residuals[0] == pytest.approx(2, rel=0.1)
    assert residuals[2] / residuals[1] == pytest.approx(2, rel=0.1)


def test_residual_is_in_pixels_of_the_original_image() -> None:
    submodel, _ = some_submodel()
    doubled = replace(submodel, intrinsics=(CAMERA.resized(1280, 960),) * len(IMAGES))
    world_from_seg = bent(Affine3, 0.05, submodel=submodel)
    small, large = (place_submodel(one, NoMaps(), world_from_seg) for one in (submodel, doubled))
    np.testing.assert_allclose(large.residual_px, 2 * small.residual_px, rtol=1e-6)
    np.testing.assert_allclose(large.world_from_cam, small.world_from_cam, atol=1e-4)


def test_maps_place_cameras_where_there_are_no_tracks() -> None:
    submodel, seg_from_world = some_submodel(with_tracks=False)
    tracked, _ = some_submodel()
    world_from_seg = bent(Affine3, 0.02, submodel=tracked)
    by_tracks = place_submodel(tracked, NoMaps(), world_from_seg)
    by_maps = place_submodel(submodel, WavyMaps(submodel, float(seg_from_world.scale)), world_from_seg)
    assert 0.1 < by_maps.residual_px.min() < by_maps.residual_px.max() < 20
    relative = np.swapaxes(by_tracks.world_from_cam[:, :, :3], 1, 2) @ by_maps.world_from_cam[:, :, :3]
    turns_deg = np.degrees(Rotation.from_matrix(relative).magnitude())
    assert turns_deg.max() < 1, "other points, about the same camera"


# ------------------------------------------------------------------------- what is missing
def test_camera_with_too_few_points_moves_with_its_submodel_and_is_told(caplog: pytest.LogCaptureFixture) -> None:
    submodel, _ = some_submodel()
    assert submodel.tracks is not None
    seen = submodel.tracks.image_of_observation != 2
    kept = seen | (submodel.tracks.point_of_observation < 5)
    tracks = replace(
        submodel.tracks,
        point_of_observation=submodel.tracks.point_of_observation[kept],
        image_of_observation=submodel.tracks.image_of_observation[kept],
        feature_of_observation=submodel.tracks.feature_of_observation[kept],
    )
    world_from_seg = bent(SL4, 0.05, submodel=submodel)
    with caplog.at_level(logging.WARNING):
        placed = place_submodel(replace(submodel, tracks=tracks), NoMaps(), world_from_seg)
    assert np.isnan(placed.residual_px).tolist() == [False, False, True, False, False, False]
    np.testing.assert_allclose(placed.world_from_cam[2], moved_cameras(world_from_seg, submodel.seg_from_cam)[2])
    assert "submodel 0: 1 of 6 cameras see fewer than 6 points" in caplog.text


def test_submodel_without_any_point_is_placed_all_the_same() -> None:
    submodel, _ = some_submodel(num_points=0)
    placed = place_submodel(submodel, NoMaps(), Affine3.identity())
    assert np.isnan(placed.residual_px).all()
    np.testing.assert_allclose(placed.world_from_cam, submodel.seg_from_cam, atol=1e-12)


def test_camera_beyond_infinity_is_refused() -> None:
    submodel, _ = some_submodel()
    centres = submodel.seg_from_cam[:, :, 3]
    ahead = centres[3] - centres[0]
    warp, to_first = np.eye(4), np.eye(4)
    warp[3, :3] = -1.1 * ahead / (ahead @ ahead)  # from the first camera on, infinity is 0.9 of the way to the fourth
    to_first[:3, 3] = -centres[0]
    with pytest.raises(DegenerateAlignmentError, match=r"3 of 6 cameras lie beyond the plane .* to infinity"):
        place_submodel(submodel, NoMaps(), SL4.from_matrix(warp @ to_first))


def test_placed_cameras_must_fit_the_submodel() -> None:
    submodel, _ = some_submodel()
    placed = place_submodel(submodel, NoMaps(), Sim3.identity())
    with pytest.raises(ValueError, match=r"submodel 0: 6 images, placed \(5, 3, 4\)"):
        replace(placed, world_from_cam=placed.world_from_cam[:5])
    with pytest.raises(ValueError, match="submodel 0: a placed camera is not finite"):
        replace(placed, world_from_cam=np.full_like(placed.world_from_cam, np.nan))
