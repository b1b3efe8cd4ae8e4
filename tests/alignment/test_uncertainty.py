"""What an edge may claim to know, in every group and wherever its origin lies."""

from __future__ import annotations

import re
from itertools import combinations_with_replacement

import numpy as np
import pytest
from helpers.scenes import make_submodel, some_sim3, walk

from smust3r_colmap.alignment.uncertainty import (
    OBSERVATIONS_PER_IMAGE,
    SIGMA_FLOOR,
    SIGMA_UNMEASURED,
    inflated_information,
    overlap_centre,
)
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.groups import GROUPS, embed
from smust3r_colmap.geometry.sim3 import Sim3
from smust3r_colmap.geometry.transform import Transform
from smust3r_colmap.products import TransformEstimate

CENTRE = np.array([30.0, -20.0, 50.0])
DEPTH = 8.0
ALL_GROUPS = pytest.mark.parametrize("group", GROUPS.values(), ids=list(GROUPS))
NESTED = [GROUPS[name] for name in ("se3", "sim3", "affine3", "sl4")]


def estimate_of(b_from_a: Transform, information: FloatArray, *, num_points: int = 1000) -> TransformEstimate:
    return TransformEstimate(
        b_from_a=b_from_a,
        num_points=num_points,
        num_inliers=num_points,
        rms=0.01,
        residual_sigma=0.01,
        iterations=5,
        stop_reason="converged",
        information=information,
    )


def honest(
    estimate: TransformEstimate,
    *,
    num_images: int = 30,
    centre: FloatArray = CENTRE,
    depth: float = DEPTH,
    group: type[Transform] | None = None,
) -> FloatArray:
    return inflated_information(estimate, num_images=num_images, centre_source=centre, depth_source=depth, group=group)


def some_information(dof: int, *, size: float = 1e4) -> FloatArray:
    root = np.random.default_rng(dof).normal(size=(dof, dof))
    information: FloatArray = size * root @ root.T
    return information


def at(group: type[Transform], place: FloatArray) -> FloatArray:
    """Adjoint of the shift from a frame with its origin there."""
    matrix = np.eye(4)
    matrix[:3, 3] = place
    return group.from_matrix(matrix).adjoint()


# -------------------------------------------------------------------------------- limits
@ALL_GROUPS
def test_no_evidence_beats_the_floor_at_the_middle_of_the_overlap(group: type[Transform]) -> None:
    sure = estimate_of(group.identity(), 1e16 * np.eye(group.DOF))
    adjoint = at(group, CENTRE)
    covariance = np.linalg.inv(adjoint.T @ honest(sure) @ adjoint)
    deviations = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(deviations[:3], SIGMA_FLOOR * DEPTH, rtol=1e-3)
    if group.DOF <= 7:
        np.testing.assert_allclose(deviations[3:], SIGMA_FLOOR, rtol=1e-3)
    else:  # one entry of the linear part is a turn and a shear, or a scale and a stretch
        assert (deviations[3:12] > SIGMA_FLOOR).all()
        assert (deviations[3:12] < 2 * SIGMA_FLOOR).all()
    np.testing.assert_allclose(deviations[12:], SIGMA_FLOOR / DEPTH, rtol=1e-3)


@ALL_GROUPS
def test_no_evidence_stays_none(group: type[Transform]) -> None:
    nothing = estimate_of(group.identity(), np.zeros((group.DOF, group.DOF)))
    np.testing.assert_allclose(honest(nothing), 0, atol=1e-12)


@ALL_GROUPS
def test_weak_evidence_is_what_it_says(group: type[Transform]) -> None:
    """Far below the floor's certainty, and with as many rows as count, nothing changes."""
    information = some_information(group.DOF, size=1e-9)
    weak = estimate_of(group.identity(), information, num_points=3)
    np.testing.assert_allclose(honest(weak), information, rtol=1e-4, atol=1e-14)


@ALL_GROUPS
def test_result_is_symmetric_definite_and_less_than_the_solver_claims(group: type[Transform]) -> None:
    information = some_information(group.DOF)
    result = honest(estimate_of(group.identity(), information))
    np.testing.assert_allclose(result, result.T, rtol=1e-9, atol=1e-9 * np.abs(result).max())
    assert np.linalg.eigvalsh(result).min() > 0
    assert np.linalg.eigvalsh(information - result).min() > 0


# ---------------------------------------------------------------------------------- rows
def test_ten_thousand_pixels_of_thirty_images_count_as_three() -> None:
    per_row = some_information(7, size=1e-3)
    assert round(30 * OBSERVATIONS_PER_IMAGE) == 3
    many = honest(estimate_of(Sim3.identity(), 10_000 * per_row, num_points=10_000), num_images=30)
    three = honest(estimate_of(Sim3.identity(), 3 * per_row, num_points=3), num_images=30)
    np.testing.assert_allclose(many, three, rtol=1e-7)


def test_fewer_rows_than_count_are_not_made_more() -> None:
    information = some_information(7, size=1e-9)
    np.testing.assert_allclose(
        honest(estimate_of(Sim3.identity(), information, num_points=2), num_images=1000), information, rtol=1e-4
    )


# --------------------------------------------------------------------------------- frames
@pytest.mark.parametrize(
    ("group", "factor"),
    [(group, factor) for group in NESTED for factor in (1.0, 100.0) if group.DOF > 6 or factor == 1],
)
def test_result_does_not_depend_on_the_frame_of_the_source(group: type[Transform], factor: float) -> None:
    """The same edge in a source frame that is turned, moved, and in another unit."""
    rng = np.random.default_rng(1)
    moved = some_sim3(rng)
    a_from_other = group.from_matrix(
        Sim3(scale=np.array(1.0), rotation=moved.rotation, translation=moved.translation).matrix
    )
    zoom = np.diag([factor, factor, factor, 1.0])
    a_from_other = a_from_other.compose(group.from_matrix(zoom))
    information = some_information(group.DOF)
    adjoint = a_from_other.adjoint()
    here = honest(estimate_of(group.identity(), information))
    there = honest(
        estimate_of(a_from_other, adjoint.T @ information @ adjoint),
        centre=a_from_other.inverse().apply(CENTRE[None])[0],
        depth=DEPTH / factor,
    )
    expected = adjoint.T @ here @ adjoint
    np.testing.assert_allclose(there, expected, rtol=1e-5, atol=1e-7 * np.abs(expected).max())


def test_far_from_the_origin_a_turn_stays_a_turn_about_the_overlap() -> None:
    """A floor at the origin would shift an overlap 60 away by 0.3, the floor at the overlap by 0.04."""
    sure = estimate_of(Sim3.identity(), 1e16 * np.eye(7))
    covariance = np.linalg.inv(honest(sure))
    moves = np.linalg.inv(at(Sim3, CENTRE))[:3]
    shift = np.sqrt(np.trace(moves @ covariance @ moves.T))
    assert shift == pytest.approx(np.sqrt(3) * SIGMA_FLOOR * DEPTH, rel=1e-6)
    origin = np.sqrt(np.trace(covariance[:3, :3]))
    assert origin > 5 * shift


# --------------------------------------------------------------------------------- groups
@pytest.mark.parametrize(("small", "large"), list(combinations_with_replacement(NESTED, 2)))
def test_in_a_wider_group_the_known_directions_keep_what_is_known(
    small: type[Transform], large: type[Transform]
) -> None:
    information = some_information(small.DOF)
    estimate = estimate_of(small.identity(), information)
    narrow, wide = honest(estimate), honest(estimate, group=large)
    assert wide.shape == (large.DOF, large.DOF)
    inside = embed(large, small)
    np.testing.assert_allclose(inside.T @ wide @ inside, narrow, rtol=1e-6, atol=1e-7 * np.abs(narrow).max())


def test_shear_between_submodels_related_by_a_similarity_is_vaguely_none() -> None:
    group = GROUPS["affine3"]
    wide = honest(estimate_of(Sim3.identity(), some_information(7)), group=group, centre=np.zeros(3))
    shear = np.zeros((4, 4))
    shear[0, 1] = shear[1, 0] = 1.0
    tangent = group.vee(shear)
    assert tangent @ wide @ tangent == pytest.approx(1 / (SIGMA_UNMEASURED**2 + SIGMA_FLOOR**2), rel=1e-6)


# ------------------------------------------------------------------------------- refusals
@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"depth": 0.0}, "depth 0.0, 30 shared images"),
        ({"depth": np.nan}, "depth nan, 30 shared images"),
        ({"num_images": 0}, "0 shared images, 1000 rows: all must be positive"),
        ({"group": GROUPS["se3"]}, "(7, 7) of a transform in Sim3 for SE3 (6 degrees of freedom)"),
    ],
)
def test_what_makes_no_sense_is_refused(changes: dict[str, object], match: str) -> None:
    with pytest.raises(ValueError, match=re.escape(match)):
        honest(estimate_of(Sim3.identity(), np.eye(7)), **changes)  # type: ignore[arg-type]


def test_information_must_fit_the_transform() -> None:
    with pytest.raises(ValueError, match=r"information \(6, 6\) of a transform in Sim3"):
        honest(estimate_of(Sim3.identity(), np.eye(6)))


# ---------------------------------------------------------------------------------- middle
def test_middle_of_the_overlap_lies_before_the_shared_cameras() -> None:
    poses = walk(9, turn_deg=0.0)
    submodel = make_submodel(poses, tuple(range(9)), np.zeros((0, 3)), Sim3.identity())
    centre = overlap_centre(submodel, {5, 6, 7, 100}, 4.0)
    np.testing.assert_allclose(centre, poses[6, :, 3] + [0, 0, 4], atol=0.1)
    with pytest.raises(ValueError, match="submodel 0 holds none of the 1 shared images"):
        overlap_centre(submodel, {100}, 4.0)
