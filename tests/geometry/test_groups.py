"""The four groups of transforms: one set of laws for all, then what each has of its own."""

from __future__ import annotations

import itertools
import time
from typing import TypeVar, get_args

import numpy as np
import pytest
import scipy.linalg
from scipy.spatial.transform import Rotation

from smust3r_colmap.config import TransformGroup
from smust3r_colmap.geometry.affine3 import Affine3
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.groups import GROUPS, embed
from smust3r_colmap.geometry.matrix_functions import log_exists, matrix_exp, matrix_log
from smust3r_colmap.geometry.se3 import SE3
from smust3r_colmap.geometry.sim3 import Sim3
from smust3r_colmap.geometry.sl4 import SL4
from smust3r_colmap.geometry.transform import Transform

Group = type[Transform]
AnyTransform = TypeVar("AnyTransform", bound=Transform)

BATCHES: list[tuple[int, ...]] = [(), (5,), (2, 3), (0,)]
every_group = pytest.mark.parametrize("group", list(GROUPS.values()), ids=list(GROUPS))
every_batch = pytest.mark.parametrize("batch", BATCHES, ids=str)
rotating_group = pytest.mark.parametrize("group", [Sim3, SE3])
bending_group = pytest.mark.parametrize("group", [Affine3, SL4])


def tangents(group: Group, batch: tuple[int, ...], *, size: float = 0.4, seed: int = 0) -> FloatArray:
    return size * np.random.default_rng(seed).normal(size=(*batch, group.DOF))


def elements(group: type[AnyTransform], batch: tuple[int, ...], *, seed: int = 0) -> AnyTransform:
    return group.exp(tangents(group, batch, seed=seed))


def near_origin(batch: tuple[int, ...], *, seed: int = 0) -> FloatArray:
    """(..., 7, 3) points that lie before the plane that any of ``elements`` sends to infinity."""
    return 0.1 * np.random.default_rng(seed).normal(size=(*batch, 7, 3))


def assert_same(one: Transform, other: Transform, *, rtol: float = 1e-13) -> None:
    """Relative to the largest entry of each matrix."""
    assert type(one) is type(other)
    assert one.batch == other.batch
    assert matrix_error(one.matrix, other.matrix) < rtol


def matrix_error(one: FloatArray, other: FloatArray) -> float:
    size = np.abs(other).max(axis=(-2, -1), keepdims=True)
    return float((np.abs(one - other) / size).max(initial=0.0))


def test_every_name_of_the_setting_is_a_group() -> None:
    assert set(GROUPS) == set(get_args(TransformGroup))
    assert [group.DOF for group in (SE3, Sim3, Affine3, SL4)] == [6, 7, 12, 15]


# ------------------------------------------------------------------------- group axioms
@every_group
@every_batch
def test_composition_is_associative_and_the_matrix_product(group: Group, batch: tuple[int, ...]) -> None:
    d_from_c, c_from_b, b_from_a = (elements(group, batch, seed=k) for k in range(3))
    assert_same((d_from_c @ c_from_b) @ b_from_a, d_from_c @ (c_from_b @ b_from_a))
    assert matrix_error((c_from_b @ b_from_a).matrix, c_from_b.matrix @ b_from_a.matrix) < 1e-14


@every_group
@every_batch
def test_identity_is_neutral_and_inverse_undoes_on_both_sides(group: Group, batch: tuple[int, ...]) -> None:
    b_from_a, one = elements(group, batch), group.identity(batch)
    assert one.batch == batch
    assert_same(one @ b_from_a, b_from_a)
    assert_same(b_from_a @ one, b_from_a)
    assert_same(b_from_a @ b_from_a.inverse(), one)
    assert_same(b_from_a.inverse() @ b_from_a, one)


@every_group
@pytest.mark.parametrize("batch", BATCHES[:3], ids=str)
def test_a_product_applies_in_turn(group: Group, batch: tuple[int, ...]) -> None:
    c_from_b, b_from_a, points_a = elements(group, batch, seed=1), elements(group, batch), near_origin(batch)
    points_c = (c_from_b @ b_from_a).apply(points_a)
    seen = np.isfinite(in_turn := c_from_b.apply(b_from_a.apply(points_a))).all(axis=-1)
    assert seen.mean() > 0.5
    np.testing.assert_allclose(points_c[seen], in_turn[seen], rtol=1e-11, atol=1e-13)
    np.testing.assert_allclose(b_from_a.inverse().apply(b_from_a.apply(points_a)), points_a, atol=1e-13)


@every_group
def test_batches_broadcast_against_a_single_one(group: Group) -> None:
    many, single = elements(group, (2, 3)), elements(group, (), seed=1)
    points_a = near_origin(())
    for left, right in ((many, single), (single, many)):
        product = left @ right
        assert product.batch == (2, 3)
        one = (many[1, 2], single) if left is many else (single, many[1, 2])
        assert_same(product[1, 2], one[0] @ one[1])
    assert many.apply(points_a).shape == many.jacobian(points_a).shape[:-1] == (2, 3, 7, 3)
    assert single.apply(near_origin((4,))).shape == single.jacobian(near_origin((4,))).shape[:-1] == (4, 7, 3)


@every_group
def test_long_products_stay_in_the_group(group: Group) -> None:
    turn = Rotation.from_rotvec([0.1, 0.2, 0.3]).as_matrix()
    step = group.from_matrix(SE3(rotation=turn, translation=np.zeros(3)).matrix)
    total = group.identity()
    for _ in range(3000):
        total = total @ step
    expected = Rotation.from_rotvec(np.array([0.1, 0.2, 0.3]) * 3000).as_matrix()
    np.testing.assert_allclose(total.matrix[:3, :3], expected, atol=1e-11)
    drift = abs(np.linalg.det(total.matrix) - 1.0)
    assert drift < {SE3: 1e-14, Sim3: 1e-11, Affine3: 1e-11, SL4: 2e-12}[group]  # scale is free in the middle two


@rotating_group
def test_rotations_of_single_precision_become_exact_when_composed(group: Group) -> None:
    rough = elements(group, (50,)).matrix
    rough[:, :3, :3] = np.float32(rough[:, :3, :3])
    turn = (group.from_matrix(rough) @ group.identity()).matrix[:, :3, :3]
    gram = turn @ np.swapaxes(turn, 1, 2)
    size = np.trace(gram, axis1=1, axis2=2)[:, None, None] / 3.0
    np.testing.assert_allclose(gram / size, np.broadcast_to(np.eye(3), gram.shape), atol=2e-14)


# ------------------------------------------------------------------ exponential, logarithm
@every_group
@every_batch
def test_log_undoes_exp(group: Group, batch: tuple[int, ...]) -> None:
    delta = tangents(group, batch)
    np.testing.assert_allclose(group.exp(delta).log(), delta, atol=2e-14)


@every_group
@pytest.mark.parametrize("size", [1e-14, 1e-10, 1e-8, 1e-7, 1e-5, 1e-3])
def test_log_undoes_exp_near_the_identity(group: Group, size: float) -> None:
    delta = tangents(group, (50,), size=size)
    np.testing.assert_allclose(group.exp(delta).log(), delta, rtol=1e-13, atol=1e-15)
    np.testing.assert_allclose(group.exp(delta).matrix, np.eye(4) + group.hat(delta), atol=20 * size**2 + 1e-15)


@every_group
def test_the_identity_and_zero_correspond_to_the_last_bit(group: Group) -> None:
    np.testing.assert_array_equal(group.identity((3,)).log(), np.zeros((3, group.DOF)))
    np.testing.assert_array_equal(group.exp(np.zeros((3, group.DOF))).matrix, group.identity((3,)).matrix)


@every_group
@pytest.mark.parametrize("size", [0.01, 1.0, 2.0])
def test_exp_is_the_matrix_exponential_of_scipy(group: Group, size: float) -> None:
    delta = tangents(group, (40,), size=size)
    expected = scipy.linalg.expm(group.hat(delta))
    assert matrix_error(group.exp(delta).matrix, expected) < 2e-12


@pytest.mark.slow
@every_group
def test_log_is_the_matrix_logarithm_of_scipy(group: Group) -> None:
    some = group.exp(tangents(group, (12,), size=0.8))
    some = some[some.log_exists()]
    assert some.batch[0] > 8
    expected = np.stack([scipy.linalg.logm(matrix) for matrix in some.matrix])
    np.testing.assert_allclose(some.log(), group.vee(expected), atol=1e-12)


@every_group
def test_exp_undoes_log_of_whatever_has_one(group: Group) -> None:
    some = group.exp(tangents(group, (300,), size=1.5))
    exists = some.log_exists()
    assert exists.mean() > (0.999 if group in {Sim3, SE3} else 0.7)
    assert_same(group.exp(some[exists].log()), some[exists], rtol=2e-12)


@every_group
def test_log_of_the_inverse_is_minus_log(group: Group) -> None:
    some = elements(group, (50,))
    np.testing.assert_allclose(some.inverse().log(), -some.log(), atol=1e-13)


@rotating_group
@pytest.mark.parametrize("short_of_pi", [1e-2, 1e-5, 1e-8, 1e-12])
@pytest.mark.parametrize("log_scale", [0.0, 1e-9, -1e-3, 1.0, -13.8, 13.8])
def test_log_undoes_exp_near_pi(group: Group, short_of_pi: float, log_scale: float) -> None:
    delta = turning(group, np.pi - short_of_pi, log_scale)
    np.testing.assert_allclose(group.exp(delta).log(), delta, atol=1e-13)


@rotating_group
@pytest.mark.parametrize("log_scale", [0.0, 1e-9, -13.8, 13.8])
def test_log_at_exactly_pi_is_one_of_the_two(group: Group, log_scale: float) -> None:
    some = group.exp(turning(group, np.pi, log_scale))
    found = some.log()
    np.testing.assert_allclose(np.linalg.norm(found[:, 3:6], axis=1), np.pi, rtol=1e-14)
    assert_same(group.exp(found), some)


def turning(group: Group, angle: float, log_scale: float) -> FloatArray:
    """(30, DOF) tangent vectors of rotations by ``angle`` about any axis."""
    delta = tangents(group, (30,), size=1.0)
    delta[:, 3:6] *= angle / np.linalg.norm(delta[:, 3:6], axis=1, keepdims=True)
    delta[:, 6:] = log_scale
    return delta


@rotating_group
def test_a_rotation_beyond_pi_comes_back_the_short_way(group: Group) -> None:
    beyond = turning(group, 3 * np.pi / 2, 0.3)
    found = group.exp(beyond).log()
    np.testing.assert_allclose(found[:, 3:6], -beyond[:, 3:6] / 3, atol=1e-14)
    assert_same(group.exp(found), group.exp(beyond))


# ------------------------------------------------------------------- no logarithm
def around_z(angle: float) -> FloatArray:
    turn: FloatArray = Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix()
    return turn


@bending_group
@pytest.mark.parametrize(
    "linear",
    [around_z(np.pi), around_z(np.pi - 1e-9), np.diag([-1.0, -2.0, 3.0])],
    ids=["pi", "almost pi", "stretched"],
)
def test_what_has_no_logarithm_is_refused(group: Group, linear: FloatArray) -> None:
    without = group.from_matrix(Affine3(linear=linear, translation=np.ones(3)).matrix)
    both = group.stack([elements(group, ()), without, without])
    np.testing.assert_array_equal(both.log_exists(), [True, False, False])
    with pytest.raises(ValueError, match=r"no real principal logarithm: 2 of 3 matrices.*rotation by pi.*\(1,\)"):
        both.log()


@bending_group
@pytest.mark.parametrize(("short_of_pi", "tolerance"), [(1e-6, 1e-8), (1e-3, 1e-11)])
def test_a_rotation_just_short_of_pi_still_has_a_logarithm(group: Group, short_of_pi: float, tolerance: float) -> None:
    delta = embed(group, SE3) @ np.array([1.0, 2.0, 3.0, 0.0, 0.0, np.pi - short_of_pi])
    np.testing.assert_allclose(group.exp(delta).log(), delta, atol=tolerance)


def test_minus_a_projective_map_has_no_logarithm_and_sees_no_point() -> None:
    minus = SL4(homogeneous=-receding().matrix)
    assert not minus.log_exists()
    assert np.isnan(minus.apply(near_origin(()))).all()


@every_group
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_tangent_vector_that_is_not_finite_is_refused(group: Group, value: float) -> None:
    for k in range(group.DOF):
        delta = np.zeros(group.DOF)
        delta[k] = value
        with np.errstate(invalid="ignore"), pytest.raises(ValueError, match=r"finite|not a rotation"):
            group.exp(delta)


# --------------------------------------------------------------------------- adjoints
@every_group
@pytest.mark.parametrize("batch", BATCHES[:3], ids=str)
def test_adjoint_moves_a_perturbation_to_the_other_side(group: Group, batch: tuple[int, ...]) -> None:
    b_from_a, delta = elements(group, batch), tangents(group, batch, size=0.2, seed=1)
    moved = (b_from_a.adjoint() @ delta[..., None])[..., 0]
    assert_same(b_from_a @ group.exp(delta), group.exp(moved) @ b_from_a)


@every_group
def test_adjoint_is_a_homomorphism(group: Group) -> None:
    c_from_b, b_from_a = elements(group, (9,), seed=1), elements(group, (9,))
    product = c_from_b.adjoint() @ b_from_a.adjoint()
    assert matrix_error((c_from_b @ b_from_a).adjoint(), product) < 1e-14
    undone = b_from_a.inverse().adjoint() @ b_from_a.adjoint()
    np.testing.assert_allclose(undone, np.broadcast_to(np.eye(group.DOF), undone.shape), atol=1e-13)


@every_group
@pytest.mark.parametrize("batch", BATCHES[:3], ids=str)
def test_small_adjoint_is_the_bracket(group: Group, batch: tuple[int, ...]) -> None:
    x, y = tangents(group, batch), tangents(group, batch, seed=1)
    bracket = group.hat(x) @ group.hat(y) - group.hat(y) @ group.hat(x)
    found = (group.small_adjoint(x) @ y[..., None])[..., 0]
    np.testing.assert_allclose(group.hat(found), bracket, atol=1e-15)


@every_group
def test_small_adjoint_generates_the_adjoint(group: Group) -> None:
    x = tangents(group, (9,))
    np.testing.assert_allclose(group.exp(x).adjoint(), scipy.linalg.expm(group.small_adjoint(x)), atol=2e-13)


@every_group
def test_brackets_obey_jacobi(group: Group) -> None:
    x, y, z = (tangents(group, (), seed=k) for k in range(3))

    def bracket(a: FloatArray, b: FloatArray) -> FloatArray:
        out: FloatArray = group.small_adjoint(a) @ b
        return out

    around = bracket(x, bracket(y, z)) + bracket(y, bracket(z, x)) + bracket(z, bracket(x, y))
    assert np.abs(bracket(x, bracket(y, z))).max() > 1e-2
    np.testing.assert_allclose(around, 0.0, atol=1e-15)


# --------------------------------------------------------------------------- hat, vee
@every_group
@every_batch
def test_vee_undoes_hat(group: Group, batch: tuple[int, ...]) -> None:
    delta = tangents(group, batch)
    assert group.hat(delta).shape == (*batch, 4, 4)
    np.testing.assert_allclose(group.vee(group.hat(delta)), delta, atol=1e-16)


@every_group
def test_vee_projects_at_right_angles(group: Group) -> None:
    anything = np.random.default_rng(0).normal(size=(6, 4, 4))
    lost = anything - group.hat(group.vee(anything))
    basis = group.hat(np.eye(group.DOF))
    np.testing.assert_allclose(np.einsum("nij,kij->nk", lost, basis), 0.0, atol=1e-15)
    assert np.linalg.matrix_rank(basis.reshape(group.DOF, 16)) == group.DOF


def test_tangents_are_in_the_stated_order() -> None:
    delta = np.arange(1.0, 16.0)
    spin = np.array([[0, -6.0, 5], [6, 0, -4], [-5, 4, 0]])
    linear = np.arange(4.0, 13.0).reshape(3, 3)
    for group in GROUPS.values():
        np.testing.assert_array_equal(group.hat(delta[: group.DOF])[:3, 3], [1, 2, 3])
    np.testing.assert_array_equal(SE3.hat(delta[:6])[:3, :3], spin)
    np.testing.assert_array_equal(Sim3.hat(delta[:7])[:3, :3], spin + 7 * np.eye(3))
    np.testing.assert_array_equal(Affine3.hat(delta[:12])[:3, :3], linear)
    np.testing.assert_array_equal(SL4.hat(delta)[:3, :3], linear - 6 * np.eye(3))
    np.testing.assert_array_equal(SL4.hat(delta)[3], [13, 14, 15, -6])


# ------------------------------------------------------------------- batches as values
@every_group
@pytest.mark.parametrize(
    "index",
    [1, -1, slice(None, None, -1), (1, 2), (..., 0), (slice(None), [2, 0]), np.array([[0], [1]]), None, ...],
    ids=str,
)
def test_indexing_is_that_of_an_array_over_the_batch(group: Group, index: int) -> None:
    many = elements(group, (2, 3))
    numbers = np.arange(6).reshape(2, 3)[index]
    assert many[index].batch == np.shape(numbers)
    np.testing.assert_array_equal(many[index].matrix, many.matrix.reshape(6, 4, 4)[numbers])


@every_group
def test_a_mask_picks_and_what_is_outside_is_refused(group: Group) -> None:
    many = elements(group, (4,))
    np.testing.assert_array_equal(many[np.array([True, False, False, True])].matrix, many.matrix[[0, 3]])
    with pytest.raises(IndexError):
        many[4]
    with pytest.raises(IndexError):
        many[0][0]


@every_group
def test_stack_undoes_taking_apart(group: Group) -> None:
    many = elements(group, (4,))
    np.testing.assert_array_equal(group.stack([many[k] for k in range(4)]).matrix, many.matrix)
    pairs = elements(group, (2, 3))
    np.testing.assert_array_equal(group.stack([pairs[0], pairs[1]]).matrix, pairs.matrix)
    assert group.stack([]).batch == (0,)


@every_group
def test_twenty_thousand_at_once_take_no_loop(group: Group) -> None:
    """A loop over the batch in Python takes many seconds; measured are 0.2 s (SE(3)) to 0.6 s (SL(4))."""
    delta, other = tangents(group, (20_000,), size=0.02), elements(group, (20_000,), seed=1)
    start = time.process_time()
    (group.exp(delta) @ other).inverse().adjoint()
    group.exp(delta).log()
    group.small_adjoint(delta)
    assert time.process_time() - start < 1.5


# ------------------------------------------------------------------------ derivatives
@every_group
@pytest.mark.parametrize("batch", BATCHES[:3], ids=str)
def test_jacobian_is_the_derivative_of_apply(group: Group, batch: tuple[int, ...]) -> None:
    b_from_a, points_a, step = elements(group, batch), near_origin(batch), 1e-6
    columns = [(b_from_a.apply(points_a + step * e) - b_from_a.apply(points_a - step * e)) for e in np.eye(3)]
    differences = np.stack(columns, axis=-1) / (2 * step)
    np.testing.assert_allclose(b_from_a.jacobian(points_a), differences, rtol=1e-8, atol=1e-8)


@every_group
def test_jacobian_follows_the_chain_rule(group: Group) -> None:
    c_from_b, b_from_a = group.exp(tangents(group, (), size=0.2)), group.exp(tangents(group, (), size=0.2, seed=1))
    points_a = near_origin(())
    chained = c_from_b.jacobian(b_from_a.apply(points_a)) @ b_from_a.jacobian(points_a)
    np.testing.assert_allclose((c_from_b @ b_from_a).jacobian(points_a), chained, rtol=1e-12, atol=1e-13)


@every_group
def test_rows_that_are_not_finite_stay_so_and_spoil_no_other(group: Group) -> None:
    points_b = elements(group, ()).apply([[0.1, 0.2, 0.3], [np.nan, 0.0, 0.0]])
    assert np.isfinite(points_b[0]).all()
    assert np.isnan(points_b[1]).all()


# ------------------------------------------------------------------- groups in groups
BY_SIZE: list[Group] = [SE3, Sim3, Affine3, SL4]
INSIDE = list(itertools.combinations(BY_SIZE, 2))


@pytest.mark.parametrize(("smaller", "larger"), INSIDE)
def test_an_embedded_tangent_is_the_same_map(smaller: Group, larger: Group) -> None:
    into, delta = embed(larger, smaller), tangents(smaller, (6,))
    assert into.shape == (larger.DOF, smaller.DOF)
    small, large = smaller.exp(delta), larger.exp(delta @ into.T)
    assert_same(large, larger.from_matrix(small.matrix))
    np.testing.assert_allclose(large.apply(near_origin((6,))), small.apply(near_origin((6,))), atol=1e-14)
    np.testing.assert_allclose(large.log(), delta @ into.T, atol=1e-14)
    assert matrix_error(large.adjoint() @ into, into @ small.adjoint()) < 1e-14


def test_embeddings_chain_and_a_group_is_inside_itself() -> None:
    for smallest, middle, largest in itertools.combinations(BY_SIZE, 3):
        np.testing.assert_allclose(embed(largest, middle) @ embed(middle, smallest), embed(largest, smallest))
    for group in GROUPS.values():
        np.testing.assert_allclose(embed(group, group), np.eye(group.DOF), atol=1e-16)


@pytest.mark.parametrize(("smaller", "larger"), INSIDE)
def test_a_larger_group_is_not_inside_a_smaller(smaller: Group, larger: Group) -> None:
    with pytest.raises(ValueError, match=f"{larger.__name__} is not a subgroup of {smaller.__name__}"):
        embed(smaller, larger)


@pytest.mark.parametrize(("smaller", "larger"), INSIDE)
def test_an_element_outside_a_smaller_group_is_refused(smaller: Group, larger: Group) -> None:
    with pytest.raises(ValueError, match=r"not a rotation|transform is projective"):
        smaller.from_matrix(elements(larger, ()).matrix)


def test_elements_of_two_groups_do_not_compose() -> None:
    for one, other in itertools.permutations(GROUPS.values(), 2):
        with pytest.raises(TypeError, match=f"{one.__name__} @ {other.__name__}: not of one group"):
            one.identity() @ other.identity()


def test_three_rows_are_enough_for_affine_groups() -> None:
    for group in (SE3, Sim3, Affine3):
        some = elements(group, (4,))
        assert_same(group.from_matrix(some.matrix[:, :3]), some)
        with pytest.raises(ValueError, match=r"found \(3, 3\)"):
            group.from_matrix(np.eye(3))


# ---------------------------------------------------------------------- float extremes
@pytest.mark.parametrize("group", [Sim3, Affine3, SL4])
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("shift", [1e-6, 1e6])
def test_extreme_scales_and_shifts_round_trip(group: Group, scale: float, shift: float) -> None:
    rng = np.random.default_rng(0)
    similarity = Sim3(
        scale=np.full(20, scale),
        rotation=Rotation.random(20, rng=rng).as_matrix(),
        translation=shift * rng.normal(size=(20, 3)),
    )
    b_from_a, points_a = group.from_matrix(similarity.matrix), rng.normal(size=(20, 7, 3))
    seen, expected = b_from_a.apply(points_a), similarity.apply(points_a)
    np.testing.assert_allclose(seen, expected, atol=1e-14 * np.abs(expected).max())
    np.testing.assert_allclose(b_from_a.inverse().apply(seen), points_a, atol=1e-14 * max(1.0, shift / scale))
    assert_same(group.exp(b_from_a.log()), b_from_a, rtol=1e-12)
    assert_same(b_from_a @ b_from_a.inverse(), group.identity((20,)), rtol=1e-14 * max(1.0, shift, shift / scale))


def test_a_long_translation_costs_the_logarithm_no_digit() -> None:
    delta = tangents(SL4, (20,), size=0.1)
    delta[:, :3] *= 1e8
    delta[:, 12:] *= 1e-8
    unit = np.concatenate([np.full(3, 1e8), np.ones(9), np.full(3, 1e-8)])
    np.testing.assert_allclose(SL4.exp(delta).log() / unit, delta / unit, atol=1e-14)


def test_a_tiny_angle_beside_a_large_scale_is_exact() -> None:
    """Closed forms that divide by the angle lose here what (exp(z) - 1) / z keeps."""
    for angle in (1e-3, 1e-7, 1e-9, 1e-200):
        delta = np.array([1.0, 2.0, 3.0, angle, 0.0, 0.0, 2.0])
        mean = np.expm1(2.0) / 2.0
        # Around x, to first order in the angle: the mean of u exp(2u) is (exp(2) + 1) / 4.
        side = angle * (np.exp(2.0) + 1.0) / 4.0
        expected = [mean, 2 * mean - 3 * side, 3 * mean + 2 * side]
        np.testing.assert_allclose(Sim3.exp(delta).translation, expected, rtol=2e-15 + 2 * angle**2)


# ----------------------------------------------------------------- refused at birth
@pytest.mark.parametrize(
    ("group", "fields", "message"),
    [
        (SE3, {"rotation": np.eye(3), "translation": np.zeros(2)}, "do not fit"),
        (SE3, {"rotation": np.eye(4), "translation": np.zeros(4)}, "do not fit"),
        (SE3, {"rotation": np.eye(3), "translation": np.full(3, np.nan)}, "translation is not finite"),
        (SE3, {"rotation": np.diag([1.0, 1.0, -1.0]), "translation": np.zeros(3)}, "not a rotation"),
        (SE3, {"rotation": 1.001 * np.eye(3), "translation": np.zeros(3)}, "not a rotation"),
        (SE3, {"rotation": np.full((3, 3), np.nan), "translation": np.zeros(3)}, "not a rotation"),
        (Affine3, {"linear": np.eye(3), "translation": np.zeros((2, 3))}, "do not fit"),
        (Affine3, {"linear": np.full((3, 3), np.inf), "translation": np.zeros(3)}, "not finite"),
        (Affine3, {"linear": np.eye(3), "translation": np.full(3, np.nan)}, "not finite"),
        (Affine3, {"linear": np.diag([1.0, 1.0, -2.0]), "translation": np.zeros(3)}, "must be positive, found -2"),
        (Affine3, {"linear": np.diag([1.0, 1.0, 0.0]), "translation": np.zeros(3)}, "must be positive, found 0"),
        (SL4, {"homogeneous": np.eye(3)}, "does not fit"),
        (SL4, {"homogeneous": np.full((4, 4), np.nan)}, "not finite"),
        (SL4, {"homogeneous": np.diag([1.0, 1.0, 1.0, -3.0])}, "must be positive, found -3"),
        (SL4, {"homogeneous": np.diag([1.0, 1.0, 1.0, 0.0])}, "must be positive, found 0"),
    ],
)
def test_what_is_not_in_the_group_is_refused(group: Group, fields: dict[str, FloatArray], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        group(**fields)


@pytest.mark.parametrize("group", [Sim3, SE3, Affine3])
def test_a_projective_row_is_refused_with_its_size(group: Group) -> None:
    matrix = np.eye(4)
    matrix[3, 0] = 0.25
    with pytest.raises(ValueError, match=r"last row is not \(0, 0, 0, 1\) but 0.25 off"):
        group.from_matrix(matrix)


# -------------------------------------------------------------------------- cameras
@every_group
def test_moved_cameras_are_rigid_and_moved_by_their_similarity_part(group: Group) -> None:
    rng = np.random.default_rng(2)
    a_from_cam = np.concatenate([Rotation.random(6, rng=rng).as_matrix(), near_origin(())[:6, :, None]], axis=2)
    b_from_a = elements(group, ())
    b_from_cam = b_from_a.move_cameras(a_from_cam)
    SE3.from_matrix(b_from_cam)
    np.testing.assert_array_equal(b_from_cam[:, :, 3], b_from_a.apply(a_from_cam[:, :, 3]))
    for k in range(6):
        centre = a_from_cam[k, :, 3]
        near = SL4.from_matrix(b_from_a.matrix).affine_part(centre).similarity_part(centre)
        np.testing.assert_allclose(b_from_cam[k], near.move_cameras(a_from_cam[k : k + 1])[0], atol=1e-13)


def test_a_camera_behind_the_plane_at_infinity_becomes_nan_and_spoils_no_other() -> None:
    a_from_cam = np.tile(np.eye(3, 4), (2, 1, 1))
    a_from_cam[1, :, 3] = [0.0, 0.0, -2.0]
    b_from_cam = receding().move_cameras(a_from_cam)
    np.testing.assert_allclose(b_from_cam[0], np.eye(3, 4), atol=1e-15)
    assert np.isnan(b_from_cam[1]).all()


# ------------------------------------------------------------------ what SL(4) has alone
def receding() -> SL4:
    """Sends the plane z = -1 to infinity and leaves the origin where it is, with derivative one."""
    matrix = np.eye(4)
    matrix[3, 2] = 1.0
    return SL4.from_matrix(matrix)


def test_points_on_and_behind_the_plane_at_infinity_become_nan() -> None:
    points_a = np.array([[0.0, 0.0, 1.0], [3.0, 4.0, -0.5], [1.0, 1.0, -1.0], [0.0, 0.0, -2.0]])
    points_b = receding().apply(points_a)
    np.testing.assert_allclose(points_b[:2], np.array([[0.0, 0.0, 0.5], [6.0, 8.0, -1.0]]), atol=1e-14)
    assert np.isnan(points_b[2:]).all()
    jacobian = receding().jacobian(points_a)
    assert np.isfinite(jacobian[:2]).all()
    assert np.isnan(jacobian[2:]).all()


def test_the_determinant_is_one_and_positive_factors_do_not_matter() -> None:
    some = elements(SL4, (5,))
    np.testing.assert_allclose(np.linalg.det(some.matrix), 1.0, rtol=1e-14)
    for factor in (1e-30, 0.3, 1e30):
        assert_same(SL4.from_matrix(factor * some.matrix), some)


def test_stored_elements_come_back_to_the_last_bit() -> None:
    some = elements(SL4, (200,))
    np.testing.assert_array_equal(SL4.from_matrix(some.matrix).matrix, some.matrix)


def test_orientation_is_kept_wherever_a_point_has_an_image() -> None:
    points_a = np.random.default_rng(3).normal(size=(30, 200, 3))
    jacobian = elements(SL4, (30,)).jacobian(points_a)
    seen = np.isfinite(jacobian).all(axis=(-2, -1))
    assert 0.5 < seen.mean() < 1.0
    assert (np.linalg.det(jacobian[seen]) > 0).all()


def test_the_affine_part_touches_at_its_centre() -> None:
    b_from_a, centre = elements(SL4, (5,)), near_origin((5,))[:, 0]
    touching, step = b_from_a.affine_part(centre), 1e-4 * np.eye(3)
    assert touching.batch == (5,)
    around = centre[:, None] + step
    off_second_order = np.abs(touching.apply(around) - b_from_a.apply(around)).max()
    assert 0 < off_second_order < 1e-6
    np.testing.assert_allclose(touching.apply(centre[:, None]), b_from_a.apply(centre[:, None]), atol=1e-13)
    with pytest.raises(ValueError, match="on or behind the plane"):
        receding().affine_part([0.0, 0.0, -1.0])


# --------------------------------------------------------------- what Affine(3) has alone
def test_the_similarity_part_of_a_similarity_is_itself() -> None:
    similarity = elements(Sim3, (5,))
    affine = Affine3.from_matrix(similarity.matrix)
    assert_same(affine.similarity_part(np.ones((5, 3))), similarity)
    np.testing.assert_allclose(affine.anisotropy, 1.0, atol=1e-13)


def test_a_stretch_is_told_apart_from_rotation_and_scale() -> None:
    turn = Rotation.from_rotvec([0.3, -0.2, 0.9]).as_matrix()
    affine = Affine3(linear=turn @ np.diag([1.0, 2.0, 4.0]), translation=np.array([1.0, 2.0, 3.0]))
    centre = np.array([[0.0, 0.0, 0.0], [5.0, -1.0, 2.0]])
    near = affine.similarity_part(centre)
    np.testing.assert_allclose(near.scale, 2.0, rtol=1e-14)
    np.testing.assert_allclose(near.rotation, np.stack([turn, turn]), atol=1e-14)
    np.testing.assert_allclose(near.apply(centre[:, None])[:, 0], affine.apply(centre), atol=1e-13)
    np.testing.assert_allclose(affine.anisotropy, 4.0, rtol=1e-14)


# -------------------------------------------------------------------- matrix functions
@pytest.mark.slow
@pytest.mark.parametrize("size", [1e-9, 0.1, 0.5, 1.0])
def test_matrix_functions_agree_with_scipy(size: float) -> None:
    algebra = size * np.random.default_rng(4).normal(size=(12, 4, 4))
    matrices = matrix_exp(algebra)
    assert matrix_error(matrices, scipy.linalg.expm(algebra)) < 1e-12
    matrices = matrices[log_exists(matrices)]
    assert len(matrices) > 8
    expected = np.stack([scipy.linalg.logm(matrix) for matrix in matrices])
    np.testing.assert_allclose(matrix_log(matrices), expected, atol=4e-15 + 1e-12 * size)


def test_the_series_is_exact_up_to_where_roots_begin() -> None:
    factors = np.concatenate([np.linspace(1.01, 3.2, 40), 1.0 / np.linspace(1.01, 3.2, 40)])
    for factor in factors:  # one at a time: the worst of a batch sets the number of terms
        found = matrix_log(np.diag([factor, 1.0, 1.0, 1.0]))
        np.testing.assert_allclose(found, np.diag([np.log(factor), 0.0, 0.0, 0.0]), rtol=2e-15, atol=0.0)


def test_matrices_that_cannot_be_diagonalised_have_their_logarithm() -> None:
    nilpotent = np.diag([1.0, 2.0, 3.0], k=1)
    np.testing.assert_allclose(matrix_log(matrix_exp(nilpotent[None]))[0], nilpotent, atol=1e-13)
