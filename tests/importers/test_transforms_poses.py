from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from smust3r_colmap.errors import InputError
from smust3r_colmap.importers.transforms_poses import read_transforms_json


def test_transforms_json_is_turned_to_opencv_axes(tmp_path: Path) -> None:
    path = tmp_path / "transforms.json"
    # An OpenGL camera looks along -z with y up; as OpenCV it looks along the world's -z, its y axis down.
    matrix = [[1, 0, 0, 7], [0, 1, 0, 8], [0, 0, 1, 9], [0, 0, 0, 1]]
    frames = [{"file_path": name, "transform_matrix": matrix} for name in ("images/1.jpg", "./images/a/2.jpg", "3.jpg")]
    path.write_text(json.dumps({"fl_x": 1.0, "frames": frames}))
    poses = read_transforms_json(path)
    assert list(poses) == ["1.jpg", "a/2.jpg", "3.jpg"]
    np.testing.assert_array_equal(poses["a/2.jpg"], [[1, 0, 0, 7], [0, -1, 0, 8], [0, 0, -1, 9]])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "not a transforms.json: JSONDecodeError"),
        ("{}", "not a transforms.json: KeyError 'frames'"),
        ('{"frames": [{"file_path": "1.jpg"}]}', "not a transforms.json: KeyError 'transform_matrix'"),
        ('{"frames": [{"file_path": "1.jpg", "transform_matrix": "no"}]}', "1.jpg: transform_matrix is not numbers"),
        ('{"frames": [{"file_path": "1.jpg", "transform_matrix": [[1]]}]}', "1.jpg: .* not a rigid 4 x 4 matrix"),
    ],
)
def test_broken_transforms_json_is_refused(tmp_path: Path, content: str, message: str) -> None:
    path = tmp_path / "transforms.json"
    path.write_text(content)
    with pytest.raises(InputError, match=message):
        read_transforms_json(path)
