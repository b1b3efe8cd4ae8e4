"""Affine(3), SL(4) and SE(3) between matched points, and what falls back to Sim(3)."""

from __future__ import annotations

import tracemalloc
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt
import pytest
from helpers.room_overlap import SIMILARITY, TURN, room_overlap
from scipy.linalg import logm
from scipy.spatial.transform import Rotation

from smust3r_colmap.alignment.seen_points import align_seen_points, implausibility
from smust3r_colmap.errors import DegenerateAlignmentError
from smust3r_colmap.estimators.affine3 import estimate_affine3
from smust3r_colmap.estimators.robust import RobustKernel, RobustLoss
from smust3r_colmap.estimators.sim3 import estimate_sim3, transformed
from smust3r_colmap.estimators.sl4 import MAX_PAIRS, dlt, estimate_sl4
from smust3r_colmap.geometry.affine3 import Affine3
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.groups import GROUPS, TransformGroup
from smust3r_colmap.geometry.se3 import SE3
from smust3r_colmap.geometry.sim3 import Sim3
from smust3r_colmap.geometry.sl4 import SL4
from smust3r_colmap.geometry.transform import Transform
from smust3r_colmap.products import TransformEstimate

BendingGroup = Literal["affine3", "sl4"]
KERNELS: tuple[RobustKernel, ...] = get_args(RobustKernel)
REDESCENDING: tuple[RobustKernel, ...] = ("cauchy", "tukey")
BENDING: tuple[BendingGroup, ...] = get_args(BendingGroup)
MOTION = SE3(rotation=TURN, translation=np.array([1.0, -2.0, 3.0]))
AFFINE = Affine3.from_matrix(SIMILARITY.matrix) @ Affine3(
    linear=np.array([[1.06, 0.03, -0.02], [0.0, 0.95, 0.02], [0.01, 0.0, 1.03]]), translation=np.zeros(3)
)
PROJECTIVE = SL4.from_matrix(AFFINE.matrix) @ SL4.exp([0.0] * 12 + [0.02, -0.03, 0.01])
WARPS: dict[TransformGroup, Transform] = {"se3": MOTION, "sim3": SIMILARITY, "affine3": AFFINE, "sl4": PROJECTIVE}
"""A ``source_from_target`` of each group; the last two bend the room by 10 to 30 cm."""


def estimate(
    group: BendingGroup,
    points_a: npt.ArrayLike,
    points_b: npt.ArrayLike,
    weights: npt.ArrayLike,
    *,
    max_error: float = 0.1,
    **arguments: Any,
) -> TransformEstimate:
    """Either estimator; ``max_error`` is for SL(4)."""
    if group == "affine3":
        return estimate_affine3(points_a, points_b, weights, **arguments)
    return estimate_sl4(points_a, points_b, weights, max_error=max_error, **arguments)


def assert_close(one: Transform, other: Transform, tolerance: float) -> None:
    """Both as the map that they are, so that groups compare."""
    a, b = (transform.matrix / transform.matrix[3, 3] for transform in (one, other))
    np.testing.assert_allclose(a, b, atol=tolerance, rtol=0)


def corner_rotation_deg(error: SL4) -> float:
    """Angle of the similarity part at the corner of the room."""
    return float(np.rad2deg(Rotation.from_matrix(error.affine_part().similarity_part().rotation).magnitude()))


# ------------------------------------------------------------------------- the estimators
@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize(("group", "count"), [("affine3", 4), ("affine3", 200), ("sl4", 8), ("sl4", 200)])
def test_exact_points_give_the_transform_to_rounding(group: BendingGroup, count: int, kernel: RobustKernel) -> None:
    points_a = np.random.default_rng(0).normal(size=(count, 3))
    found = estimate(group, points_a, WARPS[group].apply(points_a), np.ones(count), loss=RobustLoss(kernel=kernel))
    assert type(found.b_from_a) is GROUPS[group]
    assert_close(found.b_from_a, WARPS[group], 1e-10)
    assert found.num_inliers == found.num_points == count
    assert found.rms < 1e-11
    assert found.information.shape == (GROUPS[group].DOF,) * 2
    assert np.isfinite(found.information).all()


@pytest.mark.parametrize("kernel", REDESCENDING)
@pytest.mark.parametrize("group", BENDING)
def test_exact_points_with_outliers_give_the_transform_to_rounding(group: BendingGroup, kernel: RobustKernel) -> None:
    rng = np.random.default_rng(1)
    points_a = rng.normal(size=(500, 3))
    points_b = WARPS[group].apply(points_a)
    points_b[:150] += rng.uniform(0.5, 2, (150, 3))
    found = estimate(group, points_a, points_b, np.ones(500), loss=RobustLoss(kernel=kernel))
    assert_close(found.b_from_a, WARPS[group], 1e-8)
    assert found.num_inliers == 350


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("group", BENDING)
def test_warp_is_found_where_a_similarity_leaves_it(group: BendingGroup, kernel: RobustKernel) -> None:
    data = room_overlap(WARPS[group], noise=0.005)
    fit, similar = data.aligned(group, kernel), data.aligned("sim3", kernel)
    assert fit.fallback == ""
    assert 0.005 < data.map_cm(fit.estimate.b_from_a) < 0.3
    assert 3 < data.map_cm(similar.estimate.b_from_a) < 30
    assert fit.relative_residual < 0.6 * similar.relative_residual


@pytest.mark.slow
@pytest.mark.parametrize("kernel", REDESCENDING)
@pytest.mark.parametrize("group", BENDING)
def test_warp_survives_30_percent_one_sided_outliers(group: BendingGroup, kernel: RobustKernel) -> None:
    data = room_overlap(WARPS[group], count=10_000, outliers=0.3)
    fit = data.aligned(group, kernel)
    assert fit.fallback == ""
    assert 0.01 < data.map_cm(fit.estimate.b_from_a) < 0.2  # 0.3 under the plain Cauchy weight
    assert fit.inlier_share == pytest.approx(0.7, abs=0.02)
    assert fit.estimate.stop_reason == "converged"
    assert 3 <= fit.estimate.iterations <= 40


@pytest.mark.slow
def test_rotation_of_sl4_is_within_half_a_degree_in_the_worst_of_twenty_seeds() -> None:
    worst = 0.0
    for seed in range(20):
        data = room_overlap(SIMILARITY, count=3000, outliers=0.3, seed=seed)
        found = estimate_sl4(
            data.points_source,
            data.points_target,
            data.ones,
            max_error=0.05,
            seed=seed,
            residual_scale=data.depth_target,
        )
        assert isinstance(found.b_from_a, SL4)
        worst = max(worst, corner_rotation_deg(found.b_from_a @ SL4.from_matrix(SIMILARITY.matrix)))
    assert 0.01 < worst < 0.3


def test_ransac_alone_finds_a_warp_among_half_wrong_pairs() -> None:
    rng = np.random.default_rng(2)
    points_a = rng.normal(size=(3000, 3))
    points_b = PROJECTIVE.apply(points_a) + rng.normal(scale=0.005, size=(3000, 3))
    points_b[:1400] = rng.uniform(-8, 8, (1400, 3))
    first, second = (estimate_sl4(points_a, points_b, np.ones(3000), max_error=0.1, seed=3) for _ in range(2))
    np.testing.assert_array_equal(first.b_from_a.matrix, second.b_from_a.matrix)
    assert_close(first.b_from_a, PROJECTIVE, 5e-3)


@pytest.mark.parametrize("group", BENDING)
def test_swapping_the_sides_gives_the_inverse(group: BendingGroup) -> None:
    data = room_overlap(WARPS[group], outliers=0.2)
    swapped = data.aligned(
        group,
        points_source=data.points_target,
        points_target=data.points_source,
        depth_source=data.depth_target,
        depth_target=data.depth_source,
    )
    back = swapped.estimate.b_from_a.inverse()
    there = data.aligned(group).estimate.b_from_a
    apart = there.apply(data.exact_source) - back.apply(data.exact_source)
    # cm; the standard error of the fit is ten times as much
    assert 100 * np.linalg.norm(apart, axis=1).max() < {"affine3": 0.01, "sl4": 0.05}[group]


@pytest.mark.slow
@pytest.mark.parametrize("group", BENDING)
def test_volume_does_not_shrink_with_the_noise(group: BendingGroup) -> None:
    # Thickness 1 and isotropic noise of 0.1 on both sides: least squares shrinks that side by 1 %.
    logs, one_sided = [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        exact = rng.uniform(-0.5, 0.5, (1500, 3)) * [6.0, 6.0, 3.5]
        a, b = exact + rng.normal(scale=0.1, size=exact.shape), exact + rng.normal(scale=0.1, size=exact.shape)
        found = estimate(group, a, b, np.ones(1500), max_error=0.6)
        logs.append(np.log(np.linalg.det(found.b_from_a.jacobian(np.zeros((1, 3)))[0])))
        one_sided.append(np.log(np.linalg.det(np.linalg.lstsq(a, b, rcond=None)[0])))
    assert np.mean(one_sided) == pytest.approx(-0.016, abs=0.004)
    assert abs(np.mean(logs)) < 0.003
    assert 1e-3 < np.std(logs) < 2e-2


@pytest.mark.parametrize("group", BENDING)
def test_unit_and_place_of_the_scene_do_not_matter(group: BendingGroup) -> None:
    data = room_overlap(WARPS[group], outliers=0.3, count=2000)
    here = data.aligned(group).estimate
    moved = Sim3(scale=np.array(100.0), rotation=np.eye(3), translation=np.array([5e3, -5e3, 5e3]))
    there = data.aligned(
        group,
        points_source=moved.apply(data.points_source),
        points_target=moved.apply(data.points_target),
        depth_source=100 * data.depth_source,
        depth_target=100 * data.depth_target,
    ).estimate
    back = type(there.b_from_a).from_matrix(moved.inverse().matrix @ there.b_from_a.matrix @ moved.matrix)
    apart = back.apply(data.exact_source) - here.b_from_a.apply(data.exact_source)
    assert np.abs(apart).max() < 1e-5
    assert there.residual_sigma == pytest.approx(here.residual_sigma, rel=1e-4)


@pytest.mark.parametrize("group", BENDING)
def test_weight_of_two_is_two_rows(group: BendingGroup) -> None:
    data = room_overlap(WARPS[group], count=600)
    weights = np.random.default_rng(3).integers(1, 4, 600)
    arguments: dict[str, Any] = {"start": WARPS[group].inverse()}
    weighted = estimate(group, data.points_source, data.points_target, 5.0 * weights, **arguments)
    a, b = data.points_source.repeat(weights, axis=0), data.points_target.repeat(weights, axis=0)
    repeated = estimate(group, a, b, np.ones(weights.sum()), **arguments)
    apart = weighted.b_from_a.apply(data.exact_source) - repeated.b_from_a.apply(data.exact_source)
    assert np.abs(apart).max() < 1e-5


@pytest.mark.slow
def test_sl4_takes_no_more_memory_for_more_points() -> None:
    peaks = []
    for count in (20_000, 400_000):
        points_a = np.random.default_rng(4).normal(size=(count, 3)).astype(np.float32)
        points_b = PROJECTIVE.apply(points_a).astype(np.float32)
        weights = np.ones(count, dtype=np.float32)
        tracemalloc.start()
        found = estimate_sl4(points_a, points_b, weights, max_error=0.1)
        peaks.append(tracemalloc.get_traced_memory()[1] / 2**20)
        tracemalloc.stop()
        assert found.num_points == MAX_PAIRS
    assert 5 < peaks[0] < 40
    assert peaks[1] < peaks[0] + 8  # masks and row numbers: 20 bytes a point


# -------------------------------------------------------------------------------- the DLT
@pytest.mark.parametrize("count", [5, 40])
def test_dlt_gives_exact_transforms_with_the_points_in_front(count: int) -> None:
    rng = np.random.default_rng(5)
    points_a = rng.normal(size=(7, count, 3))
    homogeneous_a = np.concatenate([points_a, np.ones((7, count, 1))], axis=2)
    points_b = np.stack([PROJECTIVE.apply(points) for points in points_a])
    found = dlt(homogeneous_a, points_b, rng.uniform(0.5, 2, (7, count)))
    assert found.shape == (7, 4, 4)
    assert (np.linalg.det(found) > 0).all()
    for matrix, points in zip(found, points_a, strict=True):
        np.testing.assert_allclose(transformed(matrix, points), PROJECTIVE.apply(points), atol=1e-6)


@pytest.mark.parametrize("max_error", [1e-3, 0.1, 1.0])
def test_mirrored_points_are_refused(max_error: float) -> None:
    points_a = np.random.default_rng(6).normal(size=(2000, 3))
    with pytest.raises(DegenerateAlignmentError, match=r"no projective transform puts 8 of 2000|near a plane"):
        estimate_sl4(points_a, points_a * [1.0, 1.0, -1.0], np.ones(2000), max_error=max_error)


def test_determinant_is_positive_although_many_pairs_are_mirrored() -> None:
    points_a = np.random.default_rng(6).normal(size=(2000, 3))
    points_b = points_a * [1.0, 1.0, -1.0]
    points_b[:1100] = PROJECTIVE.apply(points_a[:1100])
    found = estimate_sl4(points_a, points_b, np.ones(2000), max_error=1e-3, max_iterations=1)
    assert np.linalg.det(found.b_from_a.matrix) == pytest.approx(1.0)
    assert_close(found.b_from_a, PROJECTIVE, 0.05)


# -------------------------------------------------------------------------- the information
def weighted_residuals(
    found: TransformEstimate, delta: FloatArray, a: FloatArray, b: FloatArray, rows: FloatArray
) -> FloatArray:
    moved = found.b_from_a @ type(found.b_from_a).exp(delta)
    return ((b - moved.apply(a)) * rows[:, None]).ravel()


@pytest.mark.parametrize("group", ["se3", "affine3", "sl4"])
def test_information_is_the_curvature_of_the_cost(group: TransformGroup) -> None:
    rng = np.random.default_rng(7)
    points_a = rng.normal(size=(60, 3)) * [3.0, 1.0, 0.5] + [4.0, -2.0, 1.0]
    weights, depth = rng.uniform(0.5, 2, 60), rng.uniform(1, 3, 60)
    points_b = WARPS[group].apply(points_a) + 1e-3 * depth[:, None] * rng.normal(size=(60, 3))
    least_squares = RobustLoss(kernel="huber", huber_delta=1.0)
    arguments: dict[str, Any] = {"loss": least_squares, "residual_scale": depth, "max_iterations": 3}
    if group == "se3":
        found = estimate_sim3(points_a, points_b, weights, fixed_scale=True, **arguments)
    else:
        found = estimate("affine3" if group == "affine3" else "sl4", points_a, points_b, weights, **arguments)
    dof, rows = GROUPS[group].DOF, np.sqrt(weights) / depth
    columns = [
        weighted_residuals(found, step, points_a, points_b, rows)
        - weighted_residuals(found, -step, points_a, points_b, rows)
        for step in 1e-6 * np.eye(dof)
    ]
    jacobian = np.column_stack(columns) / 2e-6
    variance = np.sum(weighted_residuals(found, np.zeros(dof), points_a, points_b, rows) ** 2) / (3 * 60 - dof)
    expected = jacobian.T @ jacobian / variance
    np.testing.assert_allclose(found.information, expected, rtol=1e-5, atol=1e-7 * np.abs(expected).max())


@pytest.mark.slow
@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("group", BENDING)
def test_information_predicts_the_scatter_of_the_estimate(group: BendingGroup, kernel: RobustKernel) -> None:
    rng = np.random.default_rng(8)
    points_a = rng.normal(size=(150, 3)) * [3.0, 1.0, 0.5] + [4.0, -2.0, 1.0]
    kind, dof = GROUPS[group], GROUPS[group].DOF
    distances = []
    for _ in range(40):
        points_b = WARPS[group].apply(points_a) + rng.normal(scale=0.02, size=(150, 3))
        found = estimate(group, points_a, points_b, np.ones(150), loss=RobustLoss(kernel=kernel), start=WARPS[group])
        error = (found.b_from_a.inverse() @ WARPS[group]).matrix
        delta = kind.vee(logm(error).real)
        distances.append(delta @ found.information @ delta)
    # chi square: mean dof, standard error of 40 draws 0.22 sqrt(dof) = 0.8
    assert np.mean(distances) == pytest.approx(dof, abs=0.2 * dof)


# ---------------------------------------------------------------------------------- SE(3)
def test_se3_finds_the_rigid_motion_of_a_metric_pair() -> None:
    data = room_overlap(MOTION, outliers=0.3)
    fit = data.aligned("se3", depth_source=data.depth_source / 1.7)
    assert isinstance(fit.estimate.b_from_a, SE3)
    assert fit.estimate.information.shape == (6, 6)
    assert 0.01 < data.map_cm(fit.estimate.b_from_a) < 0.5


def test_se3_of_a_pair_with_another_scale_shows_in_the_residual() -> None:
    assert room_overlap(SIMILARITY).aligned("se3").relative_residual > 0.2


# --------------------------------------------------------------------- falling back to Sim(3)
@pytest.mark.parametrize("noise", [0.0, 0.002, 0.01, 0.03])
@pytest.mark.parametrize("group", BENDING)
def test_wall_falls_back_to_sim3_and_says_so(
    group: BendingGroup, noise: float, caplog: pytest.LogCaptureFixture
) -> None:
    data = room_overlap(SIMILARITY, one_wall=True, noise=noise)
    fit, similar = data.aligned(group), data.aligned("sim3")
    assert type(fit.estimate.b_from_a) is Sim3
    assert fit.estimate.information.shape == (7, 7)
    np.testing.assert_array_equal(fit.estimate.b_from_a.matrix, similar.estimate.b_from_a.matrix)
    assert similar.fallback == ""
    assert "the common points are" in fit.fallback
    assert "needed 5 times the noise" in fit.fallback
    assert [record.message for record in caplog.records] == [f"no {group} transform, Sim(3) instead: {fit.fallback}"]


@pytest.mark.parametrize(("thickness", "falls_back"), [(0.02, True), (0.2, True), (0.8, False)])
@pytest.mark.parametrize("group", BENDING)
def test_thickness_is_measured_against_the_noise(group: BendingGroup, thickness: float, falls_back: bool) -> None:
    # Residuals of 1 % sqrt(2) at 4 m: 0.057. Root mean square thickness of a slab: 0.29 of it.
    rng = np.random.default_rng(9)
    exact = rng.uniform(-0.5, 0.5, (4000, 3)) * [6.0, 4.0, 3.5 * thickness]
    noisy = [exact + rng.normal(scale=0.04, size=exact.shape) for _ in range(2)]
    fit = align_seen_points(
        SIMILARITY.apply(noisy[0]),
        noisy[1],
        np.ones(4000),
        depth_source=np.full(4000, 6.8),
        depth_target=np.full(4000, 4.0),
        loss=RobustLoss(),
        group=group,
    )
    assert bool(fit.fallback) == falls_back


@pytest.mark.slow
@pytest.mark.parametrize("group", BENDING)
def test_absurd_stretch_falls_back_to_sim3(group: BendingGroup) -> None:
    stretch = Affine3(linear=np.diag([1.0, 1.0, 2.4]), translation=np.zeros(3))
    data = room_overlap(stretch, noise=0.001)
    fit = data.aligned(group)
    assert type(fit.estimate.b_from_a) is Sim3
    assert fit.fallback.startswith("it stretches 2.")
    mild = room_overlap(Affine3(linear=np.diag([1.0, 1.0, 1.6]), translation=np.zeros(3)), noise=0.001)
    assert mild.aligned(group).fallback == ""


def test_points_near_the_plane_at_infinity_are_absurd() -> None:
    points = np.random.default_rng(10).uniform(-1, 1, (500, 3))
    assert implausibility(SL4.identity(), points) == ""
    assert implausibility(SL4.exp([0.0] * 12 + [0.2, 0.0, 0.0]), points) == ""
    near = SL4.exp([0.0] * 12 + [0.95, 0.0, 0.0])
    assert implausibility(near, points).startswith("a point is at 0.0")
    assert implausibility(SL4.exp([0.0] * 12 + [2.0, 0.0, 0.0]), points).startswith("a point is at -")


# ------------------------------------------------------------------------------- bad input
@pytest.mark.parametrize("group", get_args(TransformGroup))
def test_rows_that_say_nothing_have_no_influence(group: TransformGroup) -> None:
    data = room_overlap(WARPS[group], count=1500)
    clean = data.aligned(group).estimate
    bad = {
        "points_source": [[np.nan, 0, 0], [1, 2, 3], [1, 2, 3], [1, 2, 3], [9, 9, 9]],
        "points_target": [[0, 0, 0], [np.inf, 0, 0], [9, 9, 9], [9, 9, 9], [1, 2, 3]],
        "weights": [1, 1, np.nan, 1, 0],
        "depth_source": [1, 1, 1, -1, 1],
        "depth_target": [1, 1, 1, 1, 1],
    }
    good: dict[str, Any] = {
        "points_source": data.points_source,
        "points_target": data.points_target,
        "weights": data.ones,
        "depth_source": data.depth_source,
        "depth_target": data.depth_target,
    }
    rows: dict[str, Any] = {name: np.concatenate([good[name], bad[name]]) for name in good}
    dirty = data.aligned(group, **rows)
    np.testing.assert_array_equal(dirty.estimate.b_from_a.matrix, clean.b_from_a.matrix)
    assert dirty.estimate.num_points == 1500
    assert dirty.num_correspondences == 1505


@pytest.mark.parametrize("group", get_args(TransformGroup))
def test_equal_confidence_is_no_confidence_and_none_is_refused(group: TransformGroup) -> None:
    data = room_overlap(WARPS[group], count=1500)
    assert_close(
        data.aligned(group, weights=7.0 * data.ones).estimate.b_from_a, data.aligned(group).estimate.b_from_a, 1e-9
    )
    with pytest.raises(DegenerateAlignmentError, match="0 point pairs"):
        data.aligned(group, weights=0.0 * data.ones)


@pytest.mark.parametrize("group", get_args(TransformGroup))
def test_negative_depths_and_missing_points_are_refused(group: TransformGroup) -> None:
    data = room_overlap(WARPS[group], count=500)
    for change in ({"depth_target": -data.depth_target}, {"points_source": np.full((500, 3), np.nan)}):
        with pytest.raises(DegenerateAlignmentError, match="0 point pairs; 3 are needed"):
            data.aligned(group, **change)


@pytest.mark.parametrize("group", get_args(TransformGroup))
def test_line_and_point_are_refused_in_every_group(group: TransformGroup) -> None:
    line = np.outer(np.linspace(0, 1, 300), [1.0, 2.0, 3.0])
    depth = np.full(300, 2.0)
    for bad in (line, np.full((300, 3), 1.1)):
        for kernel in KERNELS:
            with pytest.raises(DegenerateAlignmentError, match=r"line|are one"):
                align_seen_points(
                    bad, bad, np.ones(300), depth_source=depth, depth_target=depth,
                    loss=RobustLoss(kernel=kernel), group=group,
                )  # fmt: skip


@pytest.mark.parametrize("group", ["affine3", "sl4"])
def test_planes_lines_and_repeated_points_are_refused_by_the_estimators(group: BendingGroup) -> None:
    rng = np.random.default_rng(11)
    plane = rng.normal(size=(300, 3)) * [1.0, 1.0, 0.0] @ TURN
    line = np.outer(rng.normal(size=300), [1.0, 2.0, 3.0])
    few = rng.normal(size=(3 if group == "affine3" else 4, 3))[rng.integers(0, 3, 300)]
    for bad in (plane, line, few):
        with pytest.raises(DegenerateAlignmentError, match=r"in a plane"):
            estimate(group, bad, SIMILARITY.apply(bad), np.ones(300))
    with pytest.raises(DegenerateAlignmentError, match="all 300 points of the first side are one"):
        estimate(group, np.ones((300, 3)), plane, np.ones(300))


@pytest.mark.slow
@pytest.mark.parametrize("group", get_args(TransformGroup))
def test_contradictory_pairs_give_one_of_the_two_or_a_bad_residual(group: TransformGroup) -> None:
    data = room_overlap(WARPS[group], seed=1)
    moved = data.points_target + np.array([1.5, 0.0, -1.0])
    half = np.arange(4000) % 10 < 4
    fit = data.aligned(group, points_target=np.where(half[:, None], moved, data.points_target))
    assert data.map_cm(fit.estimate.b_from_a) < 0.5
    assert fit.inlier_share == pytest.approx(0.6, abs=0.02)
    shuffled = np.random.default_rng(12).permutation(4000)
    fit = data.aligned(group, points_target=data.points_target[shuffled])
    assert fit.relative_residual > 0.3


def test_too_few_points_for_the_group_are_refused_with_their_numbers() -> None:
    points = np.random.default_rng(13).normal(size=(7, 3))
    with pytest.raises(DegenerateAlignmentError, match=r"3 of 3 point pairs are usable .* 4 are needed"):
        estimate_affine3(points[:3], points[:3], np.ones(3))
    with pytest.raises(DegenerateAlignmentError, match=r"7 of 7 point pairs are usable .* 8 are needed"):
        estimate_sl4(points, points, np.ones(7), max_error=0.1)


@pytest.mark.parametrize("group", BENDING)
def test_three_points_fall_back_to_sim3(group: BendingGroup) -> None:
    points = np.array([[0.0, 0.0, 4.0], [1.0, 0.0, 5.0], [0.0, 1.0, 4.5]])
    depth = points[:, 2]
    fit = align_seen_points(
        SIMILARITY.apply(points), points, np.ones(3), depth_source=1.7 * depth, depth_target=depth,
        loss=RobustLoss(), group=group,
    )  # fmt: skip
    assert_close(fit.estimate.b_from_a, SIMILARITY.inverse(), 1e-9)
    assert "thick" in fit.fallback or "are needed" in fit.fallback


def test_arguments_that_make_no_sense_are_refused() -> None:
    points = np.random.default_rng(14).normal(size=(20, 3))
    with pytest.raises(ValueError, match="max_error 0 must be positive"):
        estimate_sl4(points, points, np.ones(20), max_error=0)
    for group in BENDING:
        with pytest.raises(ValueError, match="max_iterations 0"):
            estimate(group, points, points, np.ones(20), max_iterations=0)
        with pytest.raises(ValueError, match="huber_delta"):
            estimate(group, points, points, np.ones(20), loss=RobustLoss(kernel="huber", huber_delta=0.0))
        with pytest.raises(ValueError, match="20 weights are negative"):
            estimate(group, points, points, -np.ones(20))
        with pytest.raises(ValueError, match="do not fit"):
            estimate(group, points, points[:, :2], np.ones(20))
