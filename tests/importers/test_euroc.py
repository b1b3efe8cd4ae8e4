from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from smust3r_colmap.errors import InputError
from smust3r_colmap.importers.euroc import read_euroc

HEADER = "#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []\n"
TURNED = "1403636580838555648,1,2,3,0.70710678,0,0,0.70710678,9,9,9\n"
"""A quarter turn about z, with more columns than are read."""
T_BS = """%YAML:1.0
sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: [1.0, 0.0, 0.0, 0.5,
         0.0, 0.0, -1.0, 0.0,
         0.0, 1.0, 0.0, 0.25,
         0.0, 0.0, 0.0, 1.0]
rate_hz: 20
"""
SECONDS = pytest.approx(1403636580.838555648, abs=1e-6)


@pytest.fixture
def sequence(tmp_path: Path) -> Path:
    for folder in ("state_groundtruth_estimate0", "cam0"):
        (tmp_path / "mav0" / folder).mkdir(parents=True)
    (tmp_path / "mav0/state_groundtruth_estimate0/data.csv").write_text(HEADER + TURNED)
    return tmp_path


@pytest.mark.parametrize("named", [".", "mav0", "mav0/state_groundtruth_estimate0/data.csv"])
def test_the_camera_is_moved_from_the_body(sequence: Path, named: str) -> None:
    """world_from_cam = world_from_body T_BS; a quarter turn takes the offset (0.5, 0, 0.25) to (0, 0.5, 0.25)."""
    (sequence / "mav0/cam0/sensor.yaml").write_text(T_BS)
    poses = read_euroc(sequence / named)
    np.testing.assert_allclose(poses.world_from_cam[0, :, 3], [1, 2.5, 3.25], atol=1e-7)
    np.testing.assert_allclose(poses.world_from_cam[0, :, :3], [[0, 0, 1], [1, 0, 0], [0, 1, 0]], atol=1e-7)
    assert poses.stamps_s is not None
    assert poses.stamps_s[0] == SECONDS
    assert poses.notes == ()


def test_the_times_of_images_are_read(sequence: Path) -> None:
    (sequence / "mav0/cam0/data.csv").write_text("#timestamp [ns],filename\n1403636580838555648,14036.png\n")
    assert read_euroc(sequence).image_stamps == {"14036.png": SECONDS}


def test_without_the_camera_the_body_is_said_to_be_the_truth(sequence: Path) -> None:
    poses = read_euroc(sequence)
    np.testing.assert_allclose(poses.world_from_cam[0], [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3]], atol=1e-7)
    assert "those of the body" in poses.notes[0]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (HEADER + "1,1,2,3,1,0,0\n", "line 2: 7 numbers; needed 8"),
        (HEADER + TURNED + TURNED, r"line 3: the time 1403636580838555648 was there before \(.*line 2"),
        (HEADER + "1,1,2,3,2,0,0,0\n", "line 2: the quaternion has length 2"),
        (HEADER, "has no pose"),
    ],
)
def test_broken_truth_is_refused(sequence: Path, text: str, message: str) -> None:
    (sequence / "mav0/state_groundtruth_estimate0/data.csv").write_text(text)
    with pytest.raises(InputError, match=message):
        read_euroc(sequence)


def test_a_broken_sensor_is_refused(sequence: Path) -> None:
    (sequence / "mav0/cam0/sensor.yaml").write_text("T_BS:\n  data: [1, 0]\n")
    with pytest.raises(InputError, match=r"sensor.yaml: T_BS has 2 numbers; needed 16"):
        read_euroc(sequence)
