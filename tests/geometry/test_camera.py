from __future__ import annotations

import numpy as np

from smust3r_colmap.geometry.camera import Intrinsics, z_buffer


def test_z_buffer_keeps_the_nearest_and_nothing_behind_the_camera() -> None:
    camera = Intrinsics(model="PINHOLE", width=4, height=2, params=(2.0, 2.0, 2.0, 1.0))
    points = np.array([[0.1, 0.1, 3.0], [0.1, 0.1, 2.0], [0.1, 0.1, -1.0], [9.0, 0.0, 1.0], [-1.9, -0.9, 2.0]])
    expected = np.zeros((2, 4), dtype=np.float32)
    expected[1, 2], expected[0, 0] = 2.0, 2.0
    np.testing.assert_array_equal(z_buffer(points, camera), expected)
