"""Sim(3) between submodels: the robust solver, and what finds its points."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import get_args

import numpy as np
import numpy.typing as npt
import pytest
from helpers.room_overlap import ROOM_M, TURN, Overlap, room_overlap
from helpers.room_overlap import SIMILARITY as SOURCE_FROM_TARGET
from scipy.spatial.transform import Rotation

from smust3r_colmap.alignment.from_pointmaps import align_pointmaps
from smust3r_colmap.alignment.from_tracks import align_matches, align_tracks, point_depths
from smust3r_colmap.alignment.seen_points import SubmodelFit, align_seen_points
from smust3r_colmap.errors import DegenerateAlignmentError, ReconstructionError
from smust3r_colmap.estimators.confidence import ConfidenceWeighting
from smust3r_colmap.estimators.robust import RobustKernel, RobustLoss
from smust3r_colmap.estimators.sim3 import consensus_sim3, estimate_sim3
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.geometry.groups import GROUPS, TransformGroup
from smust3r_colmap.geometry.se3 import SE3
from smust3r_colmap.geometry.sim3 import Sim3
from smust3r_colmap.geometry.transform import Transform
from smust3r_colmap.products import InterSegmentMatches, Submodel, Tracks, TransformEstimate

KERNELS: tuple[RobustKernel, ...] = get_args(RobustKernel)
REDESCENDING: tuple[RobustKernel, ...] = ("cauchy", "tukey")


def assert_close(one: Transform, other: Transform, tolerance: float) -> None:
    np.testing.assert_allclose(one.matrix, other.matrix, atol=tolerance, rtol=0)


def sim3_of(estimate: TransformEstimate) -> Sim3:
    assert isinstance(estimate.b_from_a, Sim3)
    return estimate.b_from_a


# ------------------------------------------------------------------------------ the solver
@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("count", [3, 4, 200])
def test_exact_points_give_the_transform_to_rounding(kernel: RobustKernel, count: int) -> None:
    points_a = np.random.default_rng(0).normal(size=(count, 3))
    estimate = estimate_sim3(
        points_a, SOURCE_FROM_TARGET.apply(points_a), np.ones(count), loss=RobustLoss(kernel=kernel)
    )
    assert_close(estimate.b_from_a, SOURCE_FROM_TARGET, 1e-12)
    assert estimate.stop_reason == "converged"
    assert estimate.num_inliers == estimate.num_points == count
    assert estimate.rms < 1e-12
    assert np.isfinite(estimate.information).all()


@pytest.mark.parametrize("kernel", REDESCENDING)
def test_exact_points_with_outliers_give_the_transform_to_rounding(kernel: RobustKernel) -> None:
    rng = np.random.default_rng(1)
    points_a = rng.normal(size=(500, 3))
    points_b = SOURCE_FROM_TARGET.apply(points_a)
    points_b[:150] += rng.uniform(0.5, 2, (150, 3))
    estimate = estimate_sim3(points_a, points_b, np.ones(500), loss=RobustLoss(kernel=kernel))
    assert_close(estimate.b_from_a, SOURCE_FROM_TARGET, 1e-9)
    assert estimate.num_inliers == 350


@pytest.mark.parametrize(
    ("kernel", "lowest_cm", "highest_cm"), [("cauchy", 0.005, 0.3), ("tukey", 0.005, 0.1), ("huber", 3.0, 9.0)]
)
def test_sim3_survives_30_percent_one_sided_outliers_except_with_huber(
    kernel: RobustKernel, lowest_cm: float, highest_cm: float
) -> None:
    data = room_overlap(SOURCE_FROM_TARGET, count=10_000, outliers=0.3)
    fit = align_room(data, kernel)
    assert lowest_cm < data.map_cm(fit) < highest_cm


def align_room(data: Overlap, kernel: RobustKernel) -> Sim3:
    fit = align_seen_points(
        data.points_source,
        data.points_target,
        data.ones,
        depth_source=data.depth_source,
        depth_target=data.depth_target,
        loss=RobustLoss(kernel=kernel),
    )
    return sim3_of(fit.estimate)


@pytest.mark.parametrize("kernel", REDESCENDING)
def test_robust_start_survives_45_percent_where_the_plain_start_is_lost(kernel: RobustKernel) -> None:
    data = room_overlap(SOURCE_FROM_TARGET, count=10_000, outliers=0.45)
    plain = estimate_sim3(data.points_source, data.points_target, data.ones, loss=RobustLoss(kernel=kernel))
    assert data.map_cm(plain.b_from_a) > 20
    assert data.map_cm(align_room(data, kernel)) < 0.3


@pytest.mark.parametrize("kernel", REDESCENDING)
@pytest.mark.parametrize("unit", [0.1, 100.0])
def test_unit_of_the_scene_does_not_matter(kernel: RobustKernel, unit: float) -> None:
    data = room_overlap(SOURCE_FROM_TARGET, count=3000, outliers=0.3)
    scaled = replace(
        data,
        points_source=unit * data.points_source,
        points_target=unit * data.points_target,
        depth_source=unit * data.depth_source,
        depth_target=unit * data.depth_target,
    )
    here, there = align_room(data, kernel), align_room(scaled, kernel)
    assert float(there.scale) == pytest.approx(float(here.scale), rel=1e-9)
    np.testing.assert_allclose(there.rotation, here.rotation, atol=1e-9)
    np.testing.assert_allclose(there.translation, unit * here.translation, atol=1e-9 * unit)


def test_unit_of_the_scene_does_matter_to_huber() -> None:
    data = room_overlap(SOURCE_FROM_TARGET, count=3000, outliers=0.3)
    small = sim3_of(
        estimate_sim3(0.1 * data.points_source, 0.1 * data.points_target, data.ones, loss=RobustLoss(kernel="huber"))
    )
    metre = estimate_sim3(data.points_source, data.points_target, data.ones, loss=RobustLoss(kernel="huber")).b_from_a
    assert data.map_cm(replace(small, translation=10 * small.translation)) > 3 * data.map_cm(metre)


@pytest.mark.parametrize("kernel", KERNELS)
def test_place_of_the_scene_does_not_matter(kernel: RobustKernel) -> None:
    data = room_overlap(SOURCE_FROM_TARGET, count=3000, outliers=0.3)
    far = Sim3(scale=np.array(1.0), rotation=np.eye(3), translation=np.array([1000.0, -1000.0, 1000.0]))
    moved = replace(data, points_source=far.apply(data.points_source), points_target=far.apply(data.points_target))
    assert_close(far.inverse() @ align_room(moved, kernel) @ far, align_room(data, kernel), 1e-8)


@pytest.mark.parametrize("kernel", REDESCENDING)
def test_swapping_the_sides_gives_the_inverse(kernel: RobustKernel) -> None:
    data = room_overlap(SOURCE_FROM_TARGET, count=5000, outliers=0.2)
    swapped = replace(
        data,
        points_source=data.points_target,
        points_target=data.points_source,
        depth_source=data.depth_target,
        depth_target=data.depth_source,
    )
    assert_close(align_room(swapped, kernel).inverse(), align_room(data, kernel), 1e-4)


@pytest.mark.slow
def test_scale_does_not_shrink_with_the_noise() -> None:
    # A least-squares (Umeyama) scale is 0.09 % too small here, at every edge of a chain.
    logs = [
        np.log(
            1.7
            * float(
                align_room(
                    room_overlap(SOURCE_FROM_TARGET, count=4000, outliers=0.0, noise=0.03, seed=k), "cauchy"
                ).scale
            )
        )
        for k in range(20)
    ]
    assert abs(np.mean(logs)) < 4e-4
    assert 2e-4 < np.std(logs) < 2e-3


def test_huber_parity_gives_the_value_found_by_hand() -> None:
    # Six points on the axes; the two on x are twice as far out in b. Rotation and translation stay
    # zero by symmetry. Start: s^2 = (4 * 1 + 2 * 4) / 6 = 2. Residuals sqrt(2) - 1 = 0.4142 and
    # 2 - sqrt(2) = 0.5858, weights 0.1 / r = 0.24142 and 0.17071.
    # s^2 = (4 * 0.24142 * 1 + 2 * 0.17071 * 4) / (4 * 0.24142 + 2 * 0.17071) = 2.33137 / 1.30711.
    points_a = np.vstack([np.eye(3), -np.eye(3)])
    points_b = points_a * [2.0, 1.0, 1.0]
    once = estimate_sim3(points_a, points_b, np.ones(6), loss=RobustLoss(kernel="huber"), max_iterations=1)
    assert float(sim3_of(once).scale) == pytest.approx(np.sqrt(2.33137 / 1.30711), rel=1e-5)
    assert (once.iterations, once.stop_reason) == (1, "iteration limit")
    scale_squared = 2.0
    for _ in range(5):
        near, far = 0.1 / (np.sqrt(scale_squared) - 1), 0.1 / (2 - np.sqrt(scale_squared))
        scale_squared = (4 * near + 8 * far) / (4 * near + 2 * far)
    five = estimate_sim3(points_a, points_b, np.ones(6), loss=RobustLoss(kernel="huber"))
    assert float(sim3_of(five).scale) == pytest.approx(np.sqrt(scale_squared), rel=1e-12)
    assert (five.iterations, five.stop_reason) == (5, "iteration limit")


def test_fixed_scale_keeps_one_and_finds_the_rigid_motion() -> None:
    points_a = np.random.default_rng(2).normal(size=(50, 3))
    rigid = Sim3(scale=np.array(1.0), rotation=TURN, translation=np.array([5.0, 0.0, 1.0]))
    grown = rigid @ Sim3(scale=np.array(1.01), rotation=np.eye(3), translation=np.zeros(3))
    centred = points_a - points_a.mean(axis=0)
    estimate = estimate_sim3(centred, grown.apply(centred), np.ones(50), fixed_scale=True)
    assert isinstance(estimate.b_from_a, SE3)
    assert estimate.information.shape == (6, 6)
    assert_close(estimate.b_from_a, rigid, 1e-2)
    free = estimate_sim3(centred, grown.apply(centred), np.ones(50))
    assert float(sim3_of(free).scale) == pytest.approx(1.01)


def test_rows_without_weight_or_value_have_no_influence() -> None:
    data = room_overlap(SOURCE_FROM_TARGET, count=400, outliers=0.0)
    clean = estimate_sim3(data.points_source, data.points_target, data.ones)
    points = np.vstack([data.points_source, np.array([[np.nan, 0, 0], [1, 2, 3], [9, 9, 9]])])
    targets = np.vstack([data.points_target, np.array([[0, 0, 0], [np.inf, 0, 0], [-90, 9, 9]])])
    scale = np.append(data.ones, [1.0, 1.0, 1.0])
    dirty = estimate_sim3(points, targets, np.append(data.ones, [1.0, 1.0, 0.0]), residual_scale=scale)
    assert_close(dirty.b_from_a, clean.b_from_a, 1e-12)
    assert dirty.num_points == clean.num_points == 400
    scale[-1] = 0.0
    dropped = estimate_sim3(points, targets, np.append(data.ones, [1.0, 1.0, 1.0]), residual_scale=scale)
    assert dropped.num_points == 400


def test_weight_of_two_is_two_rows() -> None:
    data = room_overlap(SOURCE_FROM_TARGET, count=300, outliers=0.2)
    weights = np.random.default_rng(3).integers(1, 4, 300)
    weighted = estimate_sim3(data.points_source, data.points_target, weights)
    repeated = estimate_sim3(
        data.points_source.repeat(weights, axis=0), data.points_target.repeat(weights, axis=0), np.ones(weights.sum())
    )
    assert_close(weighted.b_from_a, repeated.b_from_a, 1e-6)
    scaled = estimate_sim3(data.points_source, data.points_target, 1000.0 * weights)
    assert_close(scaled.b_from_a, weighted.b_from_a, 1e-12)
    largest = np.abs(weighted.information).max()
    np.testing.assert_allclose(scaled.information, weighted.information, rtol=1e-9, atol=1e-12 * largest)


def test_evidence_reports_noise_and_inliers() -> None:
    data = room_overlap(SOURCE_FROM_TARGET, count=10_000, outliers=0.3)
    estimate = estimate_sim3(data.points_source, data.points_target, data.ones, residual_scale=data.depth_source / 1.7)
    assert 0.013 < estimate.residual_sigma < 0.0155  # sqrt(2) times 1 %
    assert 0.012 < estimate.rms < 0.0155
    assert 6800 < estimate.num_inliers < 7100
    assert estimate.stop_reason == "converged"
    assert 3 <= estimate.iterations <= 40


# -------------------------------------------------------------------------- its information
def exp_sim3(delta: FloatArray) -> Sim3:
    """exp of (translation, rotation vector, log scale), by the series of the 4 x 4 generator."""
    x, y, z = delta[3:6]
    generator = np.zeros((4, 4))
    generator[:3, :3] = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) + delta[6] * np.eye(3)
    generator[:3, 3] = delta[:3]
    term = total = np.eye(4)
    for k in range(1, 20):
        term = term @ generator / k
        total = total + term
    return Sim3.from_matrix(total)


def test_information_is_the_curvature_of_the_cost() -> None:
    rng = np.random.default_rng(4)
    points_a = rng.normal(size=(60, 3)) * [3.0, 1.0, 0.5] + [4.0, -2.0, 1.0]
    weights, depth = rng.uniform(0.5, 2, 60), rng.uniform(1, 3, 60)
    points_b = SOURCE_FROM_TARGET.apply(points_a) + 1e-3 * depth[:, None] * rng.normal(size=(60, 3))
    estimate = estimate_sim3(
        points_a,
        points_b,
        weights,
        loss=RobustLoss(kernel="huber", huber_delta=1.0),
        residual_scale=depth,
        max_iterations=1,
    )

    def residuals(delta: FloatArray) -> FloatArray:
        moved = (estimate.b_from_a @ exp_sim3(delta)).apply(points_a)
        return ((points_b - moved) * (np.sqrt(weights) / depth)[:, None]).ravel()

    steps = 1e-6 * np.eye(7)
    jacobian = np.column_stack([(residuals(step) - residuals(-step)) / 2e-6 for step in steps])
    variance = np.sum(residuals(np.zeros(7)) ** 2) / (3 * 60 - 7)
    expected = jacobian.T @ jacobian / variance
    np.testing.assert_allclose(estimate.information, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())


@pytest.mark.slow
@pytest.mark.parametrize("kernel", KERNELS)
def test_information_predicts_the_scatter_of_the_estimate(kernel: RobustKernel) -> None:
    rng = np.random.default_rng(5)
    points_a = rng.normal(size=(150, 3)) * [3.0, 1.0, 0.5] + [4.0, -2.0, 1.0]
    distances = []
    for _ in range(120):
        points_b = SOURCE_FROM_TARGET.apply(points_a) + rng.normal(scale=0.02, size=(150, 3))
        estimate = estimate_sim3(points_a, points_b, np.ones(150), loss=RobustLoss(kernel=kernel))
        error = (estimate.b_from_a.inverse() @ SOURCE_FROM_TARGET).matrix
        delta = np.array(
            [
                *error[:3, 3],
                *Rotation.from_matrix(error[:3, :3] / np.cbrt(np.linalg.det(error[:3, :3]))).as_rotvec(),
                np.log(np.linalg.det(error[:3, :3])) / 3,
            ]
        )
        distances.append(delta @ estimate.information @ delta)
    # chi square with 7 degrees of freedom: mean 7, standard error of 120 draws 0.34
    assert 6.0 < np.mean(distances) < 8.2


# ------------------------------------------------------------------------------- refusals
POINTS = np.random.default_rng(6).normal(size=(20, 3))


@pytest.mark.parametrize("offset", [0.0, 1000.0])
@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("side", ["first", "second"])
def test_points_that_leave_a_turn_free_are_refused(side: str, kernel: RobustKernel, offset: float) -> None:
    line = np.outer(np.linspace(0, 1, 20), [1.0, 2.0, 3.0]) + offset
    point = np.full((20, 3), 1.1) + offset
    for bad, message in (
        (line, f"20 points of the {side} side lie on a line"),
        (point, f"all 20 points of the {side}"),
    ):
        a, b = (bad, POINTS) if side == "first" else (POINTS, bad)
        with pytest.raises(DegenerateAlignmentError, match=message):
            estimate_sim3(a, b, np.ones(20), loss=RobustLoss(kernel=kernel))


def test_too_few_usable_points_are_refused_with_their_numbers() -> None:
    with pytest.raises(DegenerateAlignmentError, match=r"2 of 2 point pairs are usable \(0 are not finite\); 3"):
        estimate_sim3(POINTS[:2], POINTS[:2], np.ones(2))
    broken = POINTS.copy()
    broken[:18] = np.nan
    with pytest.raises(DegenerateAlignmentError, match=r"2 of 20 point pairs are usable \(18 are not finite\)"):
        estimate_sim3(broken, POINTS, np.ones(20))
    with pytest.raises(DegenerateAlignmentError, match="0 of 20 point pairs"):
        estimate_sim3(POINTS, POINTS, np.zeros(20))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"weights": np.ones(19)}, "do not fit"),
        ({"points_b": POINTS[:, :2]}, "do not fit"),
        ({"residual_scale": np.ones(3)}, "do not fit"),
        ({"weights": -np.ones(20)}, "20 weights are negative"),
        ({"max_iterations": 0}, "max_iterations 0"),
    ],
)
def test_arguments_that_make_no_sense_are_refused(change: dict[str, object], message: str) -> None:
    arguments = {"points_a": POINTS, "points_b": POINTS, "weights": np.ones(20)} | change
    with pytest.raises(ValueError, match=message):
        estimate_sim3(**arguments)  # type: ignore[arg-type]


def test_consensus_is_repeatable_and_finds_a_minority() -> None:
    rng = np.random.default_rng(7)
    points_a = rng.normal(size=(3000, 3))
    points_b = SOURCE_FROM_TARGET.apply(points_a)
    points_b[:2100] = rng.uniform(-4, 4, (2100, 3))
    first, second = (consensus_sim3(points_a, points_b, max_error=0.05, seed=3) for _ in range(2))
    np.testing.assert_array_equal(first.matrix, second.matrix)
    assert_close(first, SOURCE_FROM_TARGET, 0.05)


def test_consensus_takes_a_wall_but_no_line() -> None:
    wall = np.random.default_rng(8).uniform(-1, 1, (200, 3)) * [1.0, 1.0, 0.0]
    found = consensus_sim3(wall, SOURCE_FROM_TARGET.apply(wall), max_error=0.01)
    assert_close(found, SOURCE_FROM_TARGET, 1e-6)
    line = wall * [1.0, 0.0, 0.0]
    with pytest.raises(DegenerateAlignmentError, match="or they lie on a line"):
        consensus_sim3(line, line, max_error=0.01)
    with pytest.raises(DegenerateAlignmentError, match="2 point pairs; 3 are needed"):
        consensus_sim3(wall[:2], wall[:2], max_error=0.01)


# ------------------------------------------------------------------------------ pointmaps
@dataclass(frozen=True, kw_only=True, eq=False)
class Maps:
    """`DenseMaps` in memory."""

    points: npt.NDArray[np.float32]
    depths: npt.NDArray[np.float32]
    confidences: npt.NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.depths)

    def pointmap_seg(self, k: int) -> npt.NDArray[np.float32]:
        pointmap: npt.NDArray[np.float32] = self.points[k]
        return pointmap

    def depth(self, k: int) -> npt.NDArray[np.float32]:
        depth: npt.NDArray[np.float32] = self.depths[k]
        return depth

    def confidence(self, k: int) -> npt.NDArray[np.float32]:
        confidence: npt.NDArray[np.float32] = self.confidences[k]
        return confidence

    def rgb(self, k: int) -> npt.NDArray[np.uint8]:
        return np.zeros(self.points[k].shape, dtype=np.uint8)


CAMERA = Intrinsics(model="SIMPLE_PINHOLE", width=64, height=48, params=(60.0, 32.0, 24.0))


def submodel_of(images: tuple[int, ...], *, segment: int = 0, tracks: Tracks | None = None) -> Submodel:
    return Submodel(
        segment=segment,
        submodel=0,
        images=images,
        seg_from_cam=np.tile(np.eye(3, 4), (len(images), 1, 1)),
        intrinsics=(CAMERA,) * len(images),
        method="synthetic",
        reprojection_error_px=0.5,
        tracks=tracks,
    )


def room_maps(*, noise: float, blobs: float, seed: int = 0) -> tuple[Maps, Maps]:
    """Target with images 0..5, source with images 3..8, of 48 x 64 pixels; blobs of 8 x 8 in the target."""
    rng = np.random.default_rng(seed)
    pixel_rays = CAMERA.rays_cam(
        np.stack(np.meshgrid(np.arange(64) + 0.5, np.arange(48) + 0.5), axis=-1).reshape(-1, 2)
    )
    turns = Rotation.from_rotvec(np.linspace(-1.0, 1.0, 9)[:, None] * [0, 1, 0]).as_matrix()
    centres = ROOM_M / 2 + np.linspace(-1, 1, 9)[:, None] * [1.0, 0.1, 0.3]
    rays = np.einsum("nij,pj->npi", turns, pixel_rays)
    depth = ((np.where(rays > 0, ROOM_M, 0.0) - centres[:, None]) / rays).min(axis=2)
    sides = []
    for first, gauge, share in ((0, Sim3.identity(), blobs), (3, SOURCE_FROM_TARGET, 0.0)):
        shown = slice(first, first + 6)
        factor = np.where(rng.random((6, 6, 8)) < share, rng.uniform(1.3, 2.0, (6, 6, 8)), 1.0)
        factor = factor.repeat(8, axis=1).repeat(8, axis=2).reshape(6, -1)
        seen = depth[shown] * factor * (1 + noise * rng.standard_normal((6, 48 * 64)))
        points = gauge.apply((centres[shown, None] + seen[..., None] * rays[shown]).reshape(-1, 3))
        sides.append(
            Maps(
                points=points.reshape(6, 48, 64, 3).astype(np.float32),
                depths=(float(gauge.scale) * seen).reshape(6, 48, 64).astype(np.float32),
                confidences=np.full((6, 48, 64), 3.0, dtype=np.float32),
            )
        )
    return sides[0], sides[1]


TARGET, SOURCE = submodel_of((0, 1, 2, 3, 4, 5)), submodel_of((3, 4, 5, 6, 7, 8), segment=1)
TARGET_FROM_SOURCE = SOURCE_FROM_TARGET.inverse()


def test_pointmaps_without_noise_give_the_transform_to_single_precision() -> None:
    fit = align_pointmaps(TARGET, SOURCE, *room_maps(noise=0, blobs=0))
    assert_close(fit.estimate.b_from_a, TARGET_FROM_SOURCE, 1e-5)
    assert fit.relative_residual < 1e-6


@pytest.mark.parametrize("weighting", ["relative", "paper", "off"])
@pytest.mark.parametrize("kernel", REDESCENDING)
def test_pointmaps_survive_30_percent_blobs(kernel: RobustKernel, weighting: ConfidenceWeighting) -> None:
    maps = room_maps(noise=0.01, blobs=0.3)
    fit = align_pointmaps(TARGET, SOURCE, *maps, loss=RobustLoss(kernel=kernel), weighting=weighting)
    exact = np.random.default_rng(0).uniform(0, 1, (500, 3)) * ROOM_M
    apart = fit.estimate.b_from_a.apply(SOURCE_FROM_TARGET.apply(exact)) - exact
    assert 1e-4 < np.linalg.norm(apart, axis=1).mean() < 2e-2
    assert 0.01 < fit.relative_residual < 0.03
    assert fit.inlier_share == pytest.approx(0.7, abs=0.1)


@pytest.mark.parametrize("group", ["affine3", "sl4"])
def test_pointmaps_of_one_wall_fall_back_from_the_group(group: TransformGroup) -> None:
    maps = room_maps(noise=0.01, blobs=0.3)  # the three shared images see one wall of the room
    fit = align_pointmaps(TARGET, SOURCE, *maps, group=group, num_pixels=2000)
    assert type(fit.estimate.b_from_a) is Sim3
    assert "the common points are" in fit.fallback


def test_pointmaps_are_aligned_rigidly_in_se3() -> None:
    maps = room_maps(noise=0, blobs=0)
    fit = align_pointmaps(TARGET, SOURCE, *maps, group="se3", num_pixels=2000)
    assert type(fit.estimate.b_from_a) is SE3


def test_number_of_pixels_is_bounded_and_the_choice_repeats() -> None:
    maps = room_maps(noise=0.01, blobs=0.1)
    first, second = (align_pointmaps(TARGET, SOURCE, *maps, num_pixels=500) for _ in range(2))
    assert first.num_correspondences == 500
    np.testing.assert_array_equal(first.estimate.b_from_a.matrix, second.estimate.b_from_a.matrix)


@pytest.mark.parametrize("spoil", ["confidence 1", "low confidence", "no depth", "no point"])
def test_pixels_without_confidence_or_geometry_take_no_part(spoil: str) -> None:
    target_maps, source_maps = room_maps(noise=0, blobs=0)
    wrong = np.zeros((6, 48, 64), dtype=bool)
    wrong[:, :, :26] = True  # coherent, and 40 % of the pixels
    target_maps.points[wrong] += np.float32(0.5)
    if spoil == "confidence 1":
        target_maps.confidences[wrong] = 1.0
    elif spoil == "low confidence":
        target_maps.confidences[wrong] = 1.4  # below half of the median, 1.5
    elif spoil == "no depth":
        target_maps.depths[wrong] = 0.0
    else:
        target_maps.points[wrong] = np.nan
    huber = RobustLoss(kernel="huber")  # would be drawn by every wrong pixel
    fit = align_pointmaps(TARGET, SOURCE, target_maps, source_maps, loss=huber)
    assert_close(fit.estimate.b_from_a, TARGET_FROM_SOURCE, 1e-5)
    assert fit.num_correspondences == pytest.approx(3 * 48 * 38, rel=0.02)


def test_submodels_without_shared_images_are_refused() -> None:
    maps, _ = room_maps(noise=0, blobs=0)
    apart = submodel_of((10, 11, 12, 13, 14, 15), segment=7)
    with pytest.raises(DegenerateAlignmentError, match="submodels 0 and 7 share no image"):
        align_pointmaps(TARGET, apart, maps, maps)


def test_maps_without_confident_pixels_are_refused_by_name() -> None:
    target_maps, source_maps = room_maps(noise=0, blobs=0)
    target_maps.confidences[:] = 1.0
    with pytest.raises(
        DegenerateAlignmentError, match="submodels 0 and 1, confident pixels of 3 images: 0 point pairs"
    ):
        align_pointmaps(TARGET, SOURCE, target_maps, source_maps)


def test_maps_of_two_sizes_are_refused() -> None:
    target_maps, source_maps = room_maps(noise=0, blobs=0)
    small = Maps(
        points=source_maps.points[:, ::2, ::2],
        depths=source_maps.depths[:, ::2, ::2],
        confidences=source_maps.confidences[:, ::2, ::2],
    )
    with pytest.raises(ReconstructionError, match=r"image 3: the maps are \(48, 64\) in submodel 0 and \(24, 32\)"):
        align_pointmaps(TARGET, SOURCE, target_maps, small)
    with pytest.raises(ValueError, match="submodel 1: 2 images, 6 dense maps"):
        align_pointmaps(TARGET, submodel_of((3, 4), segment=1), target_maps, source_maps)


# --------------------------------------------------------------------------------- tracks
NUM_POINTS = 400


def track_submodel(
    images: tuple[int, ...], gauge: Sim3, *, segment: int, noise: float = 0.0, feature_offset: int = 0
) -> Submodel:
    """Every image sees every point of one cloud; point p is feature (p * 7 + image) % P + offset."""
    rng = np.random.default_rng(segment)
    cloud = np.random.default_rng(99).uniform(-1, 1, (NUM_POINTS, 3)) * [3.0, 2.0, 1.5] + [0.0, 0.0, 5.0]
    points = gauge.apply(cloud * (1 + noise * rng.standard_normal((NUM_POINTS, 1))))
    order = rng.permutation(NUM_POINTS)
    image, point = (grid.ravel() for grid in np.meshgrid(images, np.arange(NUM_POINTS), indexing="ij"))
    tracks = Tracks(
        points_seg=points[order],
        point_of_observation=np.argsort(order)[point],
        image_of_observation=image,
        feature_of_observation=(point * 7 + image) % NUM_POINTS + feature_offset,
    )
    submodel = submodel_of(images, segment=segment, tracks=tracks)
    at_origin = np.tile(np.eye(3, 4), (len(images), 1, 1))
    return replace(submodel, seg_from_cam=gauge.move_cameras(at_origin))


def test_tracks_without_noise_give_the_transform_to_rounding() -> None:
    target = track_submodel((0, 1, 2), Sim3.identity(), segment=0)
    source = track_submodel((2, 3, 4), SOURCE_FROM_TARGET, segment=1)
    fit = align_tracks(target, source)
    assert_close(fit.estimate.b_from_a, TARGET_FROM_SOURCE, 1e-9)
    assert fit.num_correspondences == fit.estimate.num_inliers == NUM_POINTS
    assert fit.relative_residual < 1e-12


@pytest.mark.parametrize("group", ["affine3", "sl4"])
def test_tracks_are_aligned_in_the_group(group: TransformGroup) -> None:
    target = track_submodel((0, 1, 2), Sim3.identity(), segment=0, noise=0.002)
    source = track_submodel((2, 3, 4), SOURCE_FROM_TARGET, segment=1, noise=0.002)
    fit = align_tracks(target, source, group=group)
    assert type(fit.estimate.b_from_a) is GROUPS[group]
    assert fit.relative_residual < 0.004


@pytest.mark.parametrize("kernel", KERNELS)
def test_noisy_tracks_report_their_relative_residual(kernel: RobustKernel) -> None:
    target = track_submodel((0, 1, 2), Sim3.identity(), segment=0, noise=0.01)
    source = track_submodel((1, 2, 3), SOURCE_FROM_TARGET, segment=1, noise=0.01)
    fit = align_tracks(target, source, loss=RobustLoss(kernel=kernel))
    assert float(sim3_of(fit.estimate).scale) == pytest.approx(1 / 1.7, rel=5e-3)
    # the median of |N(0, sqrt(2) %)|, over z-depths that are shorter than the rays
    assert 0.008 < fit.relative_residual < 0.013


def test_pair_of_points_counts_once_and_weighs_its_shared_observations() -> None:
    images = (0, 1, 2, 3, 4, 5, 6)
    target, source = (track_submodel(images, Sim3.identity(), segment=k) for k in (0, 1))
    assert target.tracks is not None
    # Half of the points are seen together in one image only, and displaced.
    point_of_row = target.tracks.point_of_observation
    kept = (point_of_row % 2 == 0) | (target.tracks.image_of_observation == 0)
    moved = target.tracks.points_seg.copy()
    moved[1::2] += [0.01, 0.0, 0.0]
    tracks = Tracks(
        points_seg=moved,
        point_of_observation=point_of_row[kept],
        image_of_observation=target.tracks.image_of_observation[kept],
        feature_of_observation=target.tracks.feature_of_observation[kept],
    )
    least_squares = RobustLoss(kernel="huber", huber_delta=1e3)  # a weighted mean
    fit = align_tracks(replace(target, tracks=tracks), source, loss=least_squares)
    assert fit.num_correspondences == NUM_POINTS
    centre = source.tracks.points_seg.mean(axis=0) if source.tracks is not None else np.zeros(3)
    shift = (fit.estimate.b_from_a.apply(centre[None]) - centre)[0, 0]
    assert shift == pytest.approx(0.01 / 6, rel=0.1)  # 1 against 5 of the 7, by the cap


def test_tracks_of_other_features_are_not_shared() -> None:
    target = track_submodel((0, 1, 2), Sim3.identity(), segment=0)
    with pytest.raises(DegenerateAlignmentError, match="submodels 0 and 1, shared track points: 0 point pairs; 3"):
        align_tracks(target, track_submodel((3, 4), SOURCE_FROM_TARGET, segment=1))
    other = track_submodel((0, 1, 2), SOURCE_FROM_TARGET, segment=1, feature_offset=NUM_POINTS + 7)
    with pytest.raises(DegenerateAlignmentError, match="0 point pairs"):
        align_tracks(target, other)


def test_depth_of_a_point_passes_over_cameras_that_it_is_behind() -> None:
    tracks = Tracks(
        points_seg=np.array([[0.0, 0.0, 4.0], [0.0, 0.0, -1.0], [1.0, 1.0, 1.0]]),
        point_of_observation=np.array([0, 0, 1, 0]),
        image_of_observation=np.array([5, 6, 5, 7]),
        feature_of_observation=np.array([0, 0, 1, 0]),
    )
    submodel = submodel_of((5, 6, 7), tracks=tracks)
    poses = submodel.seg_from_cam.copy()
    poses[1, 2, 3] = 3.0  # at depth 1 from image 6
    poses[2, 2, 3] = 9.0  # behind image 7
    depths = point_depths(replace(submodel, seg_from_cam=poses))
    np.testing.assert_allclose(depths, [2.0, np.nan, np.nan])  # sqrt(4 * 1)


def test_submodels_without_usable_tracks_are_refused() -> None:
    target = track_submodel((0, 1), Sim3.identity(), segment=0)
    with pytest.raises(ValueError, match="submodel 3 has no tracks"):
        align_tracks(target, submodel_of((0, 1), segment=3))
    external = replace(track_submodel((0, 9), Sim3.identity(), segment=4), images=(0, 1))
    with pytest.raises(ValueError, match=r"submodel 4: tracks name images \[9\]"):
        align_tracks(target, external)


# -------------------------------------------------------------------------------- matches
def matches_between(wrong: float, *, seed: int = 0) -> InterSegmentMatches:
    """Matches of image 1 of one submodel with image 5 of the other; the wrong ones name any feature."""
    rng = np.random.default_rng(seed)
    point = np.arange(NUM_POINTS)
    other = np.where(rng.random(NUM_POINTS) < wrong, rng.integers(0, NUM_POINTS, NUM_POINTS), point)
    return InterSegmentMatches(
        image_a=np.full(NUM_POINTS, 1),
        feature_a=(point * 7 + 1) % NUM_POINTS,
        image_b=np.full(NUM_POINTS, 5),
        feature_b=(other * 7 + 5) % NUM_POINTS,
    )


def fit_to_matches(
    target: Submodel, source: Submodel, matches: InterSegmentMatches, kernel: RobustKernel = "cauchy"
) -> SubmodelFit:
    return align_matches(
        target,
        source,
        image_a=matches.image_a,
        feature_a=matches.feature_a,
        image_b=matches.image_b,
        feature_b=matches.feature_b,
        loss=RobustLoss(kernel=kernel),
    )


@pytest.mark.parametrize("kernel", REDESCENDING)
@pytest.mark.parametrize("wrong", [0.4, 0.7])
def test_align_matches_survives_wrong_matches(kernel: RobustKernel, wrong: float) -> None:
    target = track_submodel((0, 1, 2), Sim3.identity(), segment=0, noise=0.005)
    source = track_submodel((4, 5, 6), SOURCE_FROM_TARGET, segment=1, noise=0.005)
    fit = fit_to_matches(target, source, matches_between(wrong), kernel)
    assert float(sim3_of(fit.estimate).scale) == pytest.approx(1 / 1.7, rel=4e-3)
    np.testing.assert_allclose(sim3_of(fit.estimate).rotation, TARGET_FROM_SOURCE.rotation, atol=5e-3)
    assert fit.num_correspondences == NUM_POINTS
    assert fit.inlier_share == pytest.approx(1 - wrong, abs=0.06)
    assert (fit.relative_residual < 0.05) == (wrong < 0.5)


def test_align_matches_without_noise_or_wrong_matches_is_exact() -> None:
    target = track_submodel((0, 1, 2), Sim3.identity(), segment=0)
    source = track_submodel((4, 5, 6), SOURCE_FROM_TARGET, segment=1)
    fit = fit_to_matches(target, source, matches_between(0.0))
    assert_close(fit.estimate.b_from_a, TARGET_FROM_SOURCE, 1e-9)


def test_matches_of_no_point_are_ignored() -> None:
    target = track_submodel((0, 1, 2), Sim3.identity(), segment=0)
    source = track_submodel((4, 5, 6), SOURCE_FROM_TARGET, segment=1)
    matches = matches_between(0.0)
    matches.feature_a[:50] += 10_000
    matches.image_b[50:70] = 77
    assert fit_to_matches(target, source, matches).num_correspondences == NUM_POINTS - 70
    matches.image_b[:] = 77
    with pytest.raises(DegenerateAlignmentError, match="submodels 0 and 1, matched points: 0 point pairs"):
        fit_to_matches(target, source, matches)


def test_matches_of_different_length_are_refused() -> None:
    target = track_submodel((0, 1), Sim3.identity(), segment=0)
    row = np.zeros(5, dtype=np.int64)
    with pytest.raises(ValueError, match=r"needed \(M,\) each"):
        align_matches(target, target, image_a=row, feature_a=row, image_b=row[:-1], feature_b=row)
