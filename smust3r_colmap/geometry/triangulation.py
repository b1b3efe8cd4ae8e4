"""How well two or more rays determine a point."""

from __future__ import annotations

import numpy as np

from smust3r_colmap.geometry.arrays import FloatArray


def triangulation_angle_deg(point: FloatArray, centres: FloatArray) -> float:
    """The largest angle between two of the rays to a point (3,) from camera centres (N, 3), in degrees; 0 for one."""
    rays = centres - point
    rays = rays / np.maximum(np.linalg.norm(rays, axis=1), 1e-300)[:, None]
    return float(np.degrees(np.arccos(np.clip((rays @ rays.T).min(), -1, 1))))
