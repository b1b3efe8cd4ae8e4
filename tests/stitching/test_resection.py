"""Rigid cameras for pieces that a transform moved or bent."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from helpers.scenes import CAMERA, make_piece, points_ahead, some_sim3, walk
from scipy.spatial.transform import Rotation

from smust3r_colmap.errors import DegenerateAlignmentError
from smust3r_colmap.geometry.affine3 import Affine3
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.camera import pointmap_from_depth
from smust3r_colmap.geometry.se3 import SE3
from smust3r_colmap.geometry.sim3 import Sim3, invert_rigid
from smust3r_colmap.geometry.sl4 import SL4
from smust3r_colmap.geometry.transform import Transform
from smust3r_colmap.products import SegmentPiece
from smust3r_colmap.stitching.resection import PlacedPiece, moved_cameras, place_piece

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
    """Depth between 4 and 8 before every camera of a piece."""

    def __init__(self, piece: SegmentPiece, scale: float) -> None:
        self.piece, self.scale = piece, scale

    def pointmap_seg(self, k: int) -> npt.NDArray[np.float32]:
        y, x = np.mgrid[:24, :32]
        depth = self.scale * (6 + 2 * np.sin(0.4 * x + k) * np.cos(0.3 * y))
        pointmap = pointmap_from_depth(depth, CAMERA.resized(32, 24), self.piece.seg_from_cam[k])
        pointmap[0, :5] = np.nan
        return pointmap

    def confidence(self, k: int) -> npt.NDArray[np.float32]:
        confidence = np.full((24, 32), 3.0, dtype=np.float32)
        confidence[-1] = 1.0
        return confidence


def some_piece(*, num_points: int = 300, with_tracks: bool = True) -> tuple[SegmentPiece, Sim3]:
    rng = np.random.default_rng(6)
    seg_from_world = some_sim3(rng)
    piece = make_piece(
        walk(len(IMAGES)), IMAGES, points_ahead(num_points, rng), seg_from_world, with_tracks=with_tracks
    )
    return piece, seg_from_world


def bent(group: type[Affine3] | type[SL4], amount: float, *, piece: SegmentPiece, seed: int = 0) -> Transform:
    """A similarity after a warp of this size about the cameras, in parts of the depth."""
    rng = np.random.default_rng(seed)
    tangent = rng.normal(size=group.DOF)
    tangent[12:] /= 20.0
    assert piece.tracks is not None
    to_centre = np.eye(4)
    to_centre[:3, 3] = -piece.seg_from_cam[0, :, 3]
    warp = group.exp(amount * tangent / np.linalg.norm(tangent)).matrix
    return group.from_matrix(some_sim3(rng).matrix @ warp @ to_centre)


def rms_px(placed: PlacedPiece, poses: FloatArray) -> FloatArray:
    """(N,) distance between where ``poses`` see the moved points and where the piece saw them, by COLMAP's camera."""
    piece = placed.piece
    assert piece.tracks is not None
    moved = placed.world_from_seg.apply(piece.tracks.points_seg)
    out = []
    for k, pose in enumerate(invert_rigid(poses)):
        own = invert_rigid(piece.seg_from_cam[k])
        was = CAMERA.xy_img(piece.tracks.points_seg @ own[:, :3].T + own[:, 3])
        now = CAMERA.xy_img(moved @ pose[:, :3].T + pose[:, 3])
        out.append(np.sqrt(np.mean(((was - now) ** 2).sum(axis=1))))
    return np.array(out)


# ------------------------------------------------------------------------- similarities
@pytest.mark.parametrize("group", [Sim3, SE3])
def test_groups_that_keep_angles_move_cameras_without_looking_at_points(group: type[Transform]) -> None:
    piece, _ = some_piece()
    similarity = some_sim3(np.random.default_rng(1))
    if group is SE3:
        similarity = replace(similarity, scale=np.array(1.0))
    placed = place_piece(replace(piece, tracks=None), NoMaps(), group.from_matrix(similarity.matrix), is_loop=True)
    np.testing.assert_allclose(placed.world_from_cam, similarity.move_cameras(piece.seg_from_cam), atol=1e-12)
    assert placed.residual_px.tolist() == [0.0] * len(IMAGES)
    assert placed.is_loop


@pytest.mark.parametrize("group", [Affine3, SL4])
@pytest.mark.parametrize("with_tracks", [True, False])
def test_a_similarity_in_a_wider_group_is_still_exact(group: type[Transform], with_tracks: bool) -> None:
    piece, seg_from_world = some_piece(with_tracks=with_tracks)
    similarity = some_sim3(np.random.default_rng(1))
    maps = NoMaps() if with_tracks else WavyMaps(piece, float(seg_from_world.scale))
    placed = place_piece(piece, maps, group.from_matrix(similarity.matrix))
    tolerance = 1e-9 if with_tracks else 1e-5  # maps are single precision
    np.testing.assert_allclose(
        placed.world_from_cam, similarity.move_cameras(piece.seg_from_cam), atol=tolerance, rtol=tolerance
    )
    assert placed.residual_px.max() < (1e-6 if with_tracks else 1e-2)
    assert not placed.is_loop


# --------------------------------------------------------------------------------- bending
@pytest.mark.parametrize("group", [Affine3, SL4])
@pytest.mark.parametrize("seed", range(4))
def test_camera_of_a_bent_piece_is_the_best_rigid_one(group: type[Affine3] | type[SL4], seed: int) -> None:
    piece, _ = some_piece()
    world_from_seg = bent(group, 0.1, piece=piece, seed=seed)
    placed = place_piece(piece, NoMaps(), world_from_seg)
    moved_only = rms_px(placed, moved_cameras(world_from_seg, piece.seg_from_cam))
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
    piece, _ = some_piece()
    residuals = [
        place_piece(piece, NoMaps(), bent(group, amount, piece=piece)).residual_px.mean()
        for amount in (0.005, 0.01, 0.02)
    ]
    assert 0.05 < residuals[0] < 3
    assert residuals[1] / residuals[0] == pytest.approx(2, rel=0.1)
    assert residuals[2] / residuals[1] == pytest.approx(2, rel=0.1)


def test_residual_is_in_pixels_of_the_original_image() -> None:
    piece, _ = some_piece()
    doubled = replace(piece, intrinsics=(CAMERA.resized(1280, 960),) * len(IMAGES))
    world_from_seg = bent(Affine3, 0.05, piece=piece)
    small, large = (place_piece(one, NoMaps(), world_from_seg) for one in (piece, doubled))
    np.testing.assert_allclose(large.residual_px, 2 * small.residual_px, rtol=1e-9)
    np.testing.assert_allclose(large.world_from_cam, small.world_from_cam, atol=1e-9)


def test_maps_place_cameras_where_there_are_no_tracks() -> None:
    piece, seg_from_world = some_piece(with_tracks=False)
    tracked, _ = some_piece()
    world_from_seg = bent(Affine3, 0.02, piece=tracked)
    by_tracks = place_piece(tracked, NoMaps(), world_from_seg)
    by_maps = place_piece(piece, WavyMaps(piece, float(seg_from_world.scale)), world_from_seg)
    assert 0.1 < by_maps.residual_px.min() < by_maps.residual_px.max() < 20
    relative = np.swapaxes(by_tracks.world_from_cam[:, :, :3], 1, 2) @ by_maps.world_from_cam[:, :, :3]
    turns_deg = np.degrees(Rotation.from_matrix(relative).magnitude())
    assert turns_deg.max() < 1, "other points, about the same camera"


# ------------------------------------------------------------------------- what is missing
def test_camera_with_too_few_points_moves_with_its_piece_and_is_told(caplog: pytest.LogCaptureFixture) -> None:
    piece, _ = some_piece()
    assert piece.tracks is not None
    seen = piece.tracks.image_of_observation != 2
    kept = seen | (piece.tracks.point_of_observation < 5)
    tracks = replace(
        piece.tracks,
        point_of_observation=piece.tracks.point_of_observation[kept],
        image_of_observation=piece.tracks.image_of_observation[kept],
        feature_of_observation=piece.tracks.feature_of_observation[kept],
    )
    world_from_seg = bent(SL4, 0.05, piece=piece)
    with caplog.at_level(logging.WARNING):
        placed = place_piece(replace(piece, tracks=tracks), NoMaps(), world_from_seg)
    assert np.isnan(placed.residual_px).tolist() == [False, False, True, False, False, False]
    np.testing.assert_allclose(placed.world_from_cam[2], moved_cameras(world_from_seg, piece.seg_from_cam)[2])
    assert "piece 0: 1 of 6 cameras see fewer than 6 points" in caplog.text


def test_piece_without_any_point_is_placed_all_the_same() -> None:
    piece, _ = some_piece(num_points=0)
    placed = place_piece(piece, NoMaps(), Affine3.identity())
    assert np.isnan(placed.residual_px).all()
    np.testing.assert_allclose(placed.world_from_cam, piece.seg_from_cam, atol=1e-12)


def test_camera_beyond_infinity_is_refused() -> None:
    piece, _ = some_piece()
    centres = piece.seg_from_cam[:, :, 3]
    ahead = centres[3] - centres[0]
    warp, to_first = np.eye(4), np.eye(4)
    warp[3, :3] = -1.1 * ahead / (ahead @ ahead)  # from the first camera on, infinity is 0.9 of the way to the fourth
    to_first[:3, 3] = -centres[0]
    with pytest.raises(DegenerateAlignmentError, match=r"3 of 6 cameras lie beyond the plane .* to infinity"):
        place_piece(piece, NoMaps(), SL4.from_matrix(warp @ to_first))


def test_placed_cameras_must_fit_the_piece() -> None:
    piece, _ = some_piece()
    placed = place_piece(piece, NoMaps(), Sim3.identity())
    with pytest.raises(ValueError, match=r"piece 0: 6 images, placed \(5, 3, 4\)"):
        replace(placed, world_from_cam=placed.world_from_cam[:5])
    with pytest.raises(ValueError, match="piece 0: a placed camera is not finite"):
        replace(placed, world_from_cam=np.full_like(placed.world_from_cam, np.nan))
