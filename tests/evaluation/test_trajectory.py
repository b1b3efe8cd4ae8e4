from __future__ import annotations

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from smust3r_colmap.errors import DegenerateAlignmentError
from smust3r_colmap.evaluation.trajectory import compare_trajectories
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.sim3 import Sim3

# Two made-up walks round a block: x, y, z, then yaw, pitch and roll in degrees (intrinsic z, y, x).
REFERENCE = np.array(
    [
        [0.0, 0.0, 0.0, 0, 0, 0],
        [2.0, 0.5, 0.0, 20, 5, 0],
        [4.0, 2.0, 0.3, 50, 5, 2],
        [4.5, 4.0, 0.5, 90, 0, 4],
        [3.5, 6.0, 0.6, 130, -5, 2],
        [1.5, 7.0, 0.4, 165, -10, 0],
        [-0.5, 6.5, 0.2, 200, -5, -3],
        [-2.0, 4.0, 0.0, 240, 0, -1],
    ]
)
ESTIMATE = np.array(
    [
        [10.0, -3.0, 2.0, 33, 1, -1],
        [10.8, -2.1, 2.1, 52, 6, 1],
        [10.9, -0.8, 2.3, 84, 4, 2],
        [10.0, 0.1, 2.2, 121, 1, 5],
        [8.9, 0.8, 2.5, 163, -4, 2],
        [7.5, 0.3, 2.3, 196, -11, 1],
        [7.0, -0.6, 2.0, 235, -6, -4],
        [7.2, -2.0, 2.1, 271, 2, -1],
    ]
)
SOME_SIM3 = Sim3(
    scale=np.asarray(0.3),
    rotation=Rotation.from_rotvec([0.3, -1.1, 0.6]).as_matrix(),
    translation=np.array([5.0, -2.0, 1.0]),
)


def trajectory(table: FloatArray) -> dict[str, FloatArray]:
    rotations = Rotation.from_euler("ZYX", table[:, 3:], degrees=True).as_matrix()
    poses = np.concatenate([rotations, table[:, :3, None]], axis=2)
    return {f"{k}.jpg": pose for k, pose in enumerate(poses)}


def moved(poses: dict[str, FloatArray], b_from_a: Sim3) -> dict[str, FloatArray]:
    return dict(zip(poses, b_from_a.move_cameras(np.stack(list(poses.values()))), strict=True))


def straight_drive(num_images: int = 20) -> dict[str, FloatArray]:
    """Along x, looking ahead (camera z along world x), with a little wandering of the gaze."""
    table = np.zeros((num_images, 6))
    table[:, 0] = np.arange(num_images)
    table[:, 3:] = 3 * np.sin(np.arange(3 * num_images)).reshape(-1, 3) + [0, 90, 0]
    return trajectory(table)


# -------------------------------------------------------------------------- comparing
def test_errors_are_those_that_evo_finds() -> None:
    """Numbers from evo 1.38.1: ``PosePath3D.align(correct_scale=True)`` and ``metrics.APE`` on these two tables."""
    result = compare_trajectories(trajectory(ESTIMATE), trajectory(REFERENCE))
    assert result.alignment == "centres"
    assert float(result.reference_from_estimated.scale) == pytest.approx(1.683077037886097, rel=1e-9)
    assert result.position_rmse == pytest.approx(0.41187302265412223, rel=1e-9)
    assert result.position_median == pytest.approx(0.33904841760166293, rel=1e-9)
    assert result.position_max == pytest.approx(0.6253306333556421, rel=1e-9)
    assert result.rotation_mean_deg == pytest.approx(11.752833322944896, rel=1e-9)
    assert result.rotation_median_deg == pytest.approx(11.857662593521388, rel=1e-9)
    assert result.rotation_max_deg == pytest.approx(13.272329931064705, rel=1e-9)


def test_centre_errors_are_those_of_pycolmaps_alignment() -> None:
    estimate, reference = ESTIMATE[:, :3], REFERENCE[:, :3]
    sim3 = pycolmap.estimate_sim3d(estimate, reference)
    assert sim3 is not None
    residuals = np.array([sim3 * centre for centre in estimate]) - reference
    result = compare_trajectories(trajectory(ESTIMATE), trajectory(REFERENCE))
    assert result.position_rmse == pytest.approx(np.sqrt((residuals**2).sum(axis=1).mean()), rel=1e-9)


def test_a_similarity_leaves_no_error() -> None:
    reference = trajectory(REFERENCE)
    result = compare_trajectories(moved(reference, SOME_SIM3), reference)
    assert result.position_max < 1e-12
    assert result.rotation_max_deg < 1e-5
    np.testing.assert_allclose(result.reference_from_estimated.matrix, SOME_SIM3.inverse().matrix, atol=1e-12)


def test_one_camera_turned_by_ten_degrees_is_seen_as_ten_degrees() -> None:
    reference = trajectory(REFERENCE)
    estimate = moved(reference, SOME_SIM3)
    estimate["3.jpg"][:, :3] @= Rotation.from_rotvec([0, np.deg2rad(10), 0]).as_matrix()
    result = compare_trajectories(estimate, reference)
    assert result.rotation_max_deg == pytest.approx(10, abs=1e-6)
    assert result.rotation_mean_deg == pytest.approx(10 / 8, abs=1e-5)
    assert result.rotation_median_deg < 1e-5
    assert result.position_max < 1e-12


def test_a_mirrored_trajectory_is_not_explained_by_a_reflection() -> None:
    reference = trajectory(REFERENCE)
    mirrored = {name: pose * np.array([[1, 1, 1, 1], [1, 1, 1, 1], [1, 1, 1, -1]]) for name, pose in reference.items()}
    result = compare_trajectories(mirrored, reference)
    assert 0.05 < result.position_rmse < 1
    assert np.linalg.det(result.reference_from_estimated.rotation) == pytest.approx(1)


def test_extent_and_percent_are_of_the_compared_reference_centres() -> None:
    result = compare_trajectories(trajectory(ESTIMATE), trajectory(REFERENCE))
    assert result.extent == pytest.approx(np.sqrt(6.5**2 + 7**2 + 0.6**2))
    assert result.position_rmse_percent == pytest.approx(100 * 0.411873 / 9.571311, rel=1e-5)
    assert "8 of 8 images: position 0.4119 m rms (4.3 % of 9.571)" in result.render_text("m")


def test_only_common_names_are_compared_and_the_longest_gap_is_counted() -> None:
    reference = trajectory(REFERENCE)
    estimate = moved(reference, SOME_SIM3)
    for name in ("1.jpg", "4.jpg", "5.jpg", "6.jpg"):
        del estimate[name]
    estimate["elsewhere.jpg"] = estimate["0.jpg"]
    result = compare_trajectories(estimate, reference)
    assert (result.num_compared, result.num_reference, result.largest_gap_images) == (4, 8, 3)
    assert result.position_max < 1e-12


# --------------------------------------------------------------------- straight paths
def test_a_straight_path_takes_its_roll_from_the_orientations() -> None:
    reference = straight_drive()
    result = compare_trajectories(moved(reference, SOME_SIM3), reference)
    assert result.alignment == "centres, roll from orientations"
    assert result.rotation_max_deg < 1e-5
    assert result.position_max < 1e-10


def test_noise_across_a_straight_path_does_not_turn_it() -> None:
    rng = np.random.default_rng(0)
    reference = straight_drive()
    estimate = moved(reference, SOME_SIM3)
    for pose in estimate.values():
        pose[:, 3] += rng.normal(0, 0.3 * 0.02, 3)  # 2 cm in the reference's unit
    result = compare_trajectories(estimate, reference)
    assert 0.02 < result.position_rmse < 0.05
    assert 1e-3 < result.rotation_max_deg < 0.2


def test_the_direction_of_a_straight_path_still_comes_from_the_centres() -> None:
    """All cameras mounted 5 degrees askew: the path must stay on the path, and 5 degrees remain."""
    reference = straight_drive()
    estimate = moved(reference, SOME_SIM3)
    for pose in estimate.values():
        pose[:, :3] = Rotation.from_rotvec([0, 0, np.deg2rad(5)]).as_matrix() @ pose[:, :3]
    result = compare_trajectories(estimate, reference)
    assert result.position_max < 1e-10
    assert 2 < result.rotation_mean_deg < 5


# --------------------------------------------------------------------------- refusals
def test_too_few_common_images_are_refused() -> None:
    reference = trajectory(REFERENCE)
    others = {f"photos/{name}": pose for name, pose in reference.items()}
    with pytest.raises(DegenerateAlignmentError, match=r"0 images have a pose in both.*needed 3"):
        compare_trajectories(others, reference)
    two = {name: reference[name] for name in ("0.jpg", "1.jpg")}
    with pytest.raises(DegenerateAlignmentError, match=r"2 images .*\(2 images\).*\(8\); needed 3"):
        compare_trajectories(two, reference)
    with pytest.raises(DegenerateAlignmentError, match=r"8 images .* needed 9"):
        compare_trajectories(reference, reference, min_compared=9)
    with pytest.raises(ValueError, match="min_compared is 2"):
        compare_trajectories(reference, reference, min_compared=2)


def test_centres_that_coincide_are_refused() -> None:
    reference = trajectory(REFERENCE)
    spinning = {name: np.column_stack([pose[:, :3], [100.0, 0.1, 7.0]]) for name, pose in reference.items()}
    with pytest.raises(DegenerateAlignmentError, match="estimate: all 8 camera centres coincide"):
        compare_trajectories(spinning, reference)
    with pytest.raises(DegenerateAlignmentError, match="reference: all 8 camera centres coincide"):
        compare_trajectories(reference, spinning)


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        (np.eye(4), r"estimate, 3.jpg: a pose is 3 x 4 .* found \(4, 4\)"),
        (np.full((3, 4), np.nan), "estimate, 3.jpg: a pose is 3 x 4 finite"),
        (2 * np.eye(3, 4), "estimate, 3.jpg: not a rotation"),
        (np.diag([1.0, 1.0, -1.0]) @ np.eye(3, 4), "estimate, 3.jpg: not a rotation"),
    ],
)
def test_poses_that_are_not_rigid_are_refused(pose: FloatArray, message: str) -> None:
    reference = trajectory(REFERENCE)
    with pytest.raises(ValueError, match=message):
        compare_trajectories({**reference, "3.jpg": pose}, reference)
