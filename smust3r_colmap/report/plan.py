"""The path of the cameras from above, before and after loops. The next module to read is ``facts``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from smust3r_colmap.estimators.similarity import fit_similarity
from smust3r_colmap.geometry.arrays import FloatArray, UInt8Array

UPRIGHT = 0.7
"""Length of the mean y axis of the cameras from which they are held upright; below, the path is seen along its
narrowest direction."""
RESULT = "result"
"""Title of the path that the model has."""
MAX_PIXELS = 300
"""Of the picture of the points, along its longer side."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Path2D:
    """A path as seen from above.

    Args:
        title: which it is.
        rows: (n,) images of the model, in order. xy: (n, 2) places, x to the right and y away from the viewer.
    """

    title: str
    rows: tuple[int, ...]
    xy: FloatArray


def plan_axes(centres: FloatArray, down: FloatArray) -> FloatArray:
    """(2, 3) directions to the right and up of the plan, unit vectors at a right angle, not mirrored.

    The longest direction of the path is to the right, and the first image on the left.

    Args:
        centres: (N, 3). down: (N, 3) unit y axes of the cameras.
    """
    arms = centres - centres.mean(axis=0)
    mean_down = down.mean(axis=0)
    if np.linalg.norm(mean_down) >= UPRIGHT:
        up = -mean_down / np.linalg.norm(mean_down)
    else:
        up = np.linalg.svd(arms, full_matrices=True)[2][2]
        up = -up if up @ mean_down > 0 else up
    flat = arms - np.outer(arms @ up, up)
    right = np.linalg.svd(np.vstack([flat, np.zeros((3, 3))]))[2][0]
    right -= (right @ up) * up
    if np.linalg.norm(right) < 1e-9:  # a single place, seen from anywhere
        right = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    right /= np.linalg.norm(right)
    if flat[0] @ right > 0:
        right = -right
    return np.stack([right, np.cross(up, right)])


def read_centres(path: Path) -> dict[str, FloatArray]:
    """(3,) camera centres of a trajectory of ours by the text of its times, in the order of the file."""
    lines = path.read_text(encoding="ascii").splitlines()
    rows = [line.split() for line in lines if line and not line.startswith("#")]
    return {row[0]: np.array(row[1:4], dtype=np.float64) for row in rows}


def earlier_path(
    title: str, earlier: Mapping[str, FloatArray], final: Mapping[str, FloatArray], axes: FloatArray
) -> Path2D:
    """A trajectory of an earlier step, moved by the similarity that fits it to the final one best.

    Args:
        earlier, final: as ``read_centres`` gives them; the final one is that of the model, image by image.
        axes: of the plan.
    """
    row_of = {time: row for row, time in enumerate(final)}
    times = [time for time in earlier if time in row_of]
    points = np.array([earlier[time] for time in times]).reshape(-1, 3)
    targets = np.array([final[time] for time in times]).reshape(-1, 3)
    if len(times) > 1 and np.ptp(points, axis=0).any():
        points = fit_similarity(points, targets).apply(points)
    return Path2D(title=title, rows=tuple(row_of[time] for time in times), xy=points @ axes.T)


def points_from_above(xyz: FloatArray, axes: FloatArray, low: FloatArray, high: FloatArray) -> UInt8Array:
    """(H, W, 4) grey RGBA picture of how many points lie where, between two corners of the plan; row 0 is the top."""
    size = high - low
    pixel = size.max() / MAX_PIXELS
    columns, rows = np.maximum(np.ceil(size / pixel).astype(int), 1)
    across, up = (xyz @ axes.T).T
    shape = (int(columns), int(rows))
    counts, _, _ = np.histogram2d(across, up, bins=shape, range=np.stack([low, high], axis=1))
    occupied = counts[counts > 0]
    full = np.quantile(occupied, 0.95) if len(occupied) else 1.0
    rgba = np.full((rows, columns, 4), 128, np.uint8)
    rgba[..., 3] = np.round(200 * np.minimum(np.sqrt(counts / full), 1)).T[::-1]
    return rgba
