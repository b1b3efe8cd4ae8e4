"""Errors of depth maps against a sensor: mean and median relative error, and shares within a factor.

The readings of the sensor are points; they are drawn into the pixels of the view that the map belongs to, of several in
a pixel the nearest, and compared there without blending either. The next module to read is ``predicted_error``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from smust3r_colmap.config import DepthRegistration
from smust3r_colmap.geometry.arrays import Float32Array, FloatArray
from smust3r_colmap.geometry.camera import Intrinsics, pixel_centres, z_buffer

KINECT_COLOUR_FROM_SENSOR = np.array(
    [
        [0.99996518, 0.00267651, -0.00790410, -0.02555894],
        [-0.00274093, 0.99996303, -0.00815045, 0.00010110],
        [0.00788199, 0.00817183, 0.99993555, 0.00203183],
    ]
)
"""Nominal (3, 4) of a Kinect, in metres, as commonly used with 7-Scenes: the colour camera sits 26 mm to the side."""
VIEW_FROM_SENSOR: dict[DepthRegistration, FloatArray] = {"kinect": KINECT_COLOUR_FROM_SENSOR, "none": np.eye(3, 4)}
"""By registration; with ``none`` the colour camera is where the sensor is and looks the same way."""

_READINGS_PER_PIXEL = 1.5
"""Along each axis, at least: fewer would leave holes in a surface, through which the one behind it is seen."""


@dataclass(frozen=True, kw_only=True)
class DepthErrors:
    """How good depth is; NaN where nothing could be compared.

    Args:
        what: an image, or what all of them are taken for.
        num_compared: pixels, or points.
        abs_rel: mean of abs(d - t) / t, with t the sensor's depth and d that of the map.
        median_rel: median of the same.
        delta_105, delta_125: share with max(d / t, t / d) below 1.05 and 1.25.
        coverage: share of the pixels with a reading that have depth in the map, too; NaN for points.
    """

    what: str
    num_compared: int
    abs_rel: float
    median_rel: float
    delta_105: float
    delta_125: float
    coverage: float

    @classmethod
    def of(cls, what: str, ratios: FloatArray, num_true: int | None) -> DepthErrors:
        """Of ratios (P,) above 0, after the scale, 1 where depth is right; ``num_true`` None for no coverage.

        Source: Eigen et al. 2014, section 4.2, for the measures; 1.05 and 1.25 are thresholds of their delta.
        """
        errors = np.abs(ratios - 1)
        factors = np.maximum(ratios, 1 / ratios)
        return cls(
            what=what,
            num_compared=len(ratios),
            abs_rel=_mean_of(errors),
            median_rel=float(np.median(errors)) if len(errors) else math.nan,
            delta_105=_mean_of(factors < 1.05),
            delta_125=_mean_of(factors < 1.25),
            coverage=len(ratios) / num_true if num_true else math.nan,
        )


def _mean_of(values: npt.NDArray[np.float64] | npt.NDArray[np.bool_]) -> float:
    return float(values.mean()) if len(values) else math.nan


def depth_in_view(
    depth: Float32Array, sensor: Intrinsics, view_from_sensor: FloatArray, view: Intrinsics
) -> Float32Array:
    """(H, W) what a sensor measured, as a camera beside it sees it; 0 where there is no reading.

    Args:
        depth: (h, w) z-depth of the sensor, 0 for none.
        sensor: of an image of w x h pixels.
        view_from_sensor: (3, 4) rigid, in the unit of the depth.
        view: the camera, of H x W pixels.
    """
    repeats = math.ceil(_READINGS_PER_PIXEL * max(view.width / sensor.width, view.height / sensor.height))
    dense = np.repeat(np.repeat(depth, repeats, axis=0), repeats, axis=1).ravel()
    read = dense > 0
    rays = sensor.resized(sensor.width * repeats, sensor.height * repeats).rays_cam(
        pixel_centres(sensor.width * repeats, sensor.height * repeats)
    )
    points_sensor = rays[read] * dense[read, None]
    return z_buffer(points_sensor @ view_from_sensor[:, :3].T + view_from_sensor[:, 3], view)


def map_ratios(depth: Float32Array, truth: Float32Array) -> FloatArray:
    """(P,) of two maps (H, W), at the pixels where both have depth."""
    both = (depth > 0) & (truth > 0)
    ratios: FloatArray = depth[both].astype(np.float64) / truth[both]
    return ratios
