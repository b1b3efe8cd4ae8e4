"""The group Sim(3): its laws, its cameras, and what it refuses."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.sim3 import Sim3, invert_rigid
from smust3r_colmap.geometry.so3 import angles_between, nearest_rotation


def random_sim3(rng: np.random.Generator, batch: tuple[int, ...] = ()) -> Sim3:
    count = int(np.prod(batch, dtype=int))
    return Sim3(
        scale=np.exp(rng.normal(size=batch)),
        rotation=Rotation.random(count, rng=rng).as_matrix().reshape(*batch, 3, 3),
        translation=rng.normal(size=(*batch, 3)),
    )


def assert_same(one: Sim3, other: Sim3) -> None:
    np.testing.assert_allclose(one.matrix, other.matrix, atol=1e-12)


@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
def test_composition_is_associative_and_applies_in_turn(batch: tuple[int, ...]) -> None:
    rng = np.random.default_rng(0)
    d_from_c, c_from_b, b_from_a = (random_sim3(rng, batch) for _ in range(3))
    points_a = rng.normal(size=(*batch, 7, 3))
    assert_same((d_from_c @ c_from_b) @ b_from_a, d_from_c @ (c_from_b @ b_from_a))
    np.testing.assert_allclose(
        (c_from_b @ b_from_a).apply(points_a), c_from_b.apply(b_from_a.apply(points_a)), atol=1e-12
    )


@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
def test_inverse_undoes_on_both_sides(batch: tuple[int, ...]) -> None:
    b_from_a = random_sim3(np.random.default_rng(1), batch)
    assert_same(b_from_a @ b_from_a.inverse(), Sim3.identity(batch))
    assert_same(b_from_a.inverse() @ b_from_a, Sim3.identity(batch))
    np.testing.assert_allclose(b_from_a.inverse().matrix, np.linalg.inv(b_from_a.matrix), atol=1e-12)


@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
def test_identity_is_neutral(batch: tuple[int, ...]) -> None:
    b_from_a = random_sim3(np.random.default_rng(2), batch)
    assert_same(Sim3.identity(batch) @ b_from_a, b_from_a)
    assert_same(b_from_a @ Sim3.identity(batch), b_from_a)


def test_matrix_product_is_composition_and_round_trips() -> None:
    rng = np.random.default_rng(3)
    c_from_b, b_from_a = random_sim3(rng, (4,)), random_sim3(rng, (4,))
    np.testing.assert_allclose((c_from_b @ b_from_a).matrix, c_from_b.matrix @ b_from_a.matrix, atol=1e-12)
    assert_same(Sim3.from_matrix(b_from_a.matrix), b_from_a)
    assert_same(Sim3.from_matrix(b_from_a.matrix[..., :3, :]), b_from_a)


def test_the_nearest_rotation_is_one_even_to_a_mirror_image() -> None:
    rng = np.random.default_rng(5)
    rotation = Rotation.random(6, random_state=5).as_matrix()
    first = rng.normal(size=(6, 40, 3))
    second = first @ np.swapaxes(rotation, 1, 2) + 1e-3 * rng.normal(size=first.shape)
    found = nearest_rotation(np.swapaxes(second, 1, 2) @ first)
    assert angles_between(found, rotation).max() < 1e-3
    mirrored = nearest_rotation(np.diag([1.0, 1.0, -0.1]) @ rotation)
    assert np.linalg.det(mirrored) == pytest.approx(1.0)
    np.testing.assert_allclose(mirrored, rotation, atol=1e-12)
    assert np.isnan(nearest_rotation(np.full((3, 3), np.nan))).all()


def test_long_product_stays_a_rotation() -> None:
    step = Sim3(
        scale=np.array(1.0), rotation=Rotation.from_rotvec([0.1, 0.2, 0.3]).as_matrix(), translation=np.zeros(3)
    )
    total = Sim3.identity()
    for _ in range(3000):
        total = total @ step
    np.testing.assert_allclose(total.rotation @ total.rotation.T, np.eye(3), atol=1e-14)


def test_rows_that_are_not_finite_stay_so_and_spoil_no_other() -> None:
    points_a = np.array([[1.0, 2.0, 3.0], [np.nan, 0.0, 0.0]])
    points_b = random_sim3(np.random.default_rng(4)).apply(points_a)
    assert np.isfinite(points_b[0]).all()
    assert np.isnan(points_b[1]).all()


def test_moved_cameras_keep_orthonormal_axes_and_every_projection() -> None:
    rng = np.random.default_rng(5)
    b_from_a = random_sim3(rng)
    a_from_cam = np.concatenate([Rotation.random(6, rng=rng).as_matrix(), rng.normal(size=(6, 3, 1))], axis=2)
    points_a = rng.normal(size=(20, 3))
    b_from_cam = b_from_a.move_cameras(a_from_cam)
    gram = b_from_cam[:, :, :3] @ np.swapaxes(b_from_cam[:, :, :3], 1, 2)
    np.testing.assert_allclose(gram, np.broadcast_to(np.eye(3), gram.shape), atol=1e-12)
    before, after = seen_by(a_from_cam, points_a), seen_by(b_from_cam, b_from_a.apply(points_a))
    np.testing.assert_allclose(after, float(b_from_a.scale) * before, atol=1e-12)
    np.testing.assert_allclose(after[..., :2] / after[..., 2:], before[..., :2] / before[..., 2:], rtol=1e-9)


def seen_by(frame_from_cam: FloatArray, points: FloatArray) -> FloatArray:
    """(N, P, 3) points in each camera."""
    cam_from_frame = invert_rigid(frame_from_cam)
    seen: FloatArray = np.einsum("nij,pj->npi", cam_from_frame[:, :, :3], points) + cam_from_frame[:, None, :, 3]
    return seen


def test_batched_cameras_move_like_single_ones() -> None:
    rng = np.random.default_rng(6)
    b_from_a = random_sim3(rng, (2,))
    a_from_cam = np.concatenate([Rotation.random(8, rng=rng).as_matrix(), rng.normal(size=(8, 3, 1))], axis=2)
    a_from_cam = a_from_cam.reshape(2, 4, 3, 4)
    together = b_from_a.move_cameras(a_from_cam)
    for k in range(2):
        single = Sim3(scale=b_from_a.scale[k], rotation=b_from_a.rotation[k], translation=b_from_a.translation[k])
        np.testing.assert_allclose(together[k], single.move_cameras(a_from_cam[k]), atol=1e-12)


def test_invert_rigid_is_an_inverse() -> None:
    rng = np.random.default_rng(7)
    pose = np.concatenate([Rotation.random(5, rng=rng).as_matrix(), rng.normal(size=(5, 3, 1))], axis=2)
    np.testing.assert_allclose(invert_rigid(invert_rigid(pose)), pose, atol=1e-12)
    centres = -np.einsum("nji,nj->ni", pose[:, :, :3], pose[:, :, 3])
    np.testing.assert_allclose(invert_rigid(pose)[:, :, 3], centres, atol=1e-12)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("scale", 0.0, "scale must be positive"),
        ("scale", -1.0, "scale must be positive"),
        ("scale", np.nan, "scale must be positive"),
        ("translation", [0.0, np.inf, 0.0], "translation is not finite"),
        ("translation", [0.0, 0.0], "do not fit"),
        ("rotation", np.diag([1.0, 1.0, -1.0]), "not a rotation"),
        ("rotation", 1.001 * np.eye(3), "not a rotation"),
        ("rotation", np.full((3, 3), np.nan), "not a rotation"),
    ],
)
def test_what_is_no_similarity_is_refused(field: str, value: npt.ArrayLike, message: str) -> None:
    parts: dict[str, FloatArray] = {"scale": np.array(1.0), "rotation": np.eye(3), "translation": np.zeros(3)}
    parts[field] = np.asarray(value)
    with pytest.raises(ValueError, match=message):
        Sim3(**parts)
