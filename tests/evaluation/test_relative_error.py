from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smust3r_colmap.evaluation.relative_error import pairs_at, path_lengths, relative_errors, segment_errors
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.sim3 import Sim3


def drive(num_frames: int, step: float = 1.0, turn_deg: float = 0.0) -> FloatArray:
    """Along x; every frame is turned about y by so much more than the one before."""
    turns = np.deg2rad(turn_deg) * np.arange(num_frames)
    rotations = Rotation.from_rotvec(turns[:, None] * [0.0, 1, 0]).as_matrix()
    centres = np.column_stack([step * np.arange(num_frames), np.zeros(num_frames), np.zeros(num_frames)])
    return np.concatenate([rotations, centres[:, :, None]], axis=2)


def test_pairs_in_frames() -> None:
    reference = drive(6)
    assert pairs_at(reference, 2, "frames", all_pairs=False).tolist() == [[0, 2], [2, 4]]
    assert pairs_at(reference, 2, "frames", all_pairs=True).tolist() == [[0, 2], [1, 3], [2, 4], [3, 5]]
    assert pairs_at(reference, 6, "frames", all_pairs=True).tolist() == []


def test_pairs_along_the_path() -> None:
    """At 0, 1, 2, 4, 5 and 5.05 m: the first frames at least 2 m on, and those within a tenth of 2 m."""
    reference = drive(6)
    reference[:, 0, 3] = [0, 1, 2, 4, 5, 5.05]
    assert path_lengths(reference).tolist() == [0, 1, 2, 4, 5, 5.05]
    assert pairs_at(reference, 2, "m", all_pairs=False).tolist() == [[0, 2], [2, 3]]
    assert pairs_at(reference, 2, "m", all_pairs=True).tolist() == [[0, 2], [2, 3]]
    assert pairs_at(reference, 1, "m", all_pairs=True).tolist() == [[0, 1], [1, 2], [3, 4]]


def test_a_motion_that_is_too_long_and_turns_too_much() -> None:
    """Steps of 1.1 m in place of 1 m, and 0.5 degrees more each: whatever the world of the estimate."""
    other_world = Sim3(
        scale=np.asarray(1.0), rotation=Rotation.from_rotvec([1, 2, 3]).as_matrix(), translation=np.array([9.0, 8, 7])
    )
    estimate, reference = drive(5, 1.1, 0.5), drive(5)
    estimate[:, :, :3] = reference[:, :, :3] @ estimate[:, :, :3]
    pairs = pairs_at(reference, 1, "frames", all_pairs=False)
    lengths, angles_deg = relative_errors(other_world.move_cameras(estimate), reference, pairs)
    np.testing.assert_allclose(angles_deg, 0.5, atol=1e-9)
    # Frame k looks k / 2 degrees aside and goes 1.1 m; the truth looks ahead and goes 1 m.
    turns = np.deg2rad(0.5 * np.arange(4))
    np.testing.assert_allclose(lengths, np.hypot(1.1 * np.cos(turns) - 1, 1.1 * np.sin(turns)), atol=1e-12)


def test_kittis_segments_of_a_drive_with_a_scale_and_a_turn() -> None:
    """301 frames, 1 m apart: of 100 m there are 20 segments (from 0, 10 ... 190), of 200 m 10.

    A segment ends at the first frame beyond its length, so that it is 101 m long, and its error 1.01 % of 100 m
    where the estimate is 1 % too long: (101 * 0.01) / 100.
    """
    estimate = drive(301, 1.01)
    whole, hundred, two_hundred = segment_errors(estimate, drive(301))
    assert (hundred.length_m, hundred.num_segments) == (100, 20)
    assert hundred.translation_percent == pytest.approx(1.01)
    assert (two_hundred.length_m, two_hundred.num_segments) == (200, 10)
    assert two_hundred.translation_percent == pytest.approx(1.005)
    assert (whole.length_m, whole.num_segments) == (0, 30)
    assert whole.translation_percent == pytest.approx((20 * 1.01 + 10 * 1.005) / 30)
    assert whole.rotation_deg_per_m == pytest.approx(0, abs=1e-9)


def test_kittis_rotation_error_is_per_metre_of_the_nominal_length() -> None:
    """0.01 degrees a frame: 101 frames over 100 m."""
    _, hundred = segment_errors(drive(120, 1.0, 0.01), drive(120))
    assert hundred.rotation_deg_per_m == pytest.approx(0.0101)


def test_a_path_below_100_m_has_no_segment() -> None:
    assert segment_errors(drive(101), drive(101)) == ()
    assert len(segment_errors(drive(102), drive(102))) == 2
