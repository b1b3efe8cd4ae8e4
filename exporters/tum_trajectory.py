"""The cameras of a scene as a trajectory in the format of the TUM RGB-D benchmark.

One line per image, ``timestamp tx ty tz qx qy qz qw``: the camera in the world (not COLMAP's inverse),
camera axes x right, y down, z forward, as evo and the benchmark's own tools read it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from smust3r_colmap.errors import InputError
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.products import Scene
from smust3r_colmap.storage.atomic_write import write_atomically

_HEADER = "# timestamp tx ty tz qx qy qz qw (camera to world; x right, y down, z forward)"


def write_tum(scene: Scene, path: Path, timestamps_s: Sequence[float] | None) -> None:
    """Write the trajectory, rows ascending in time; rows of one time keep the order of the images.

    Args:
        scene: one connected model.
        path: of the file; replaced where it exists.
        timestamps_s: one per image of the scene; None writes the image's index in the collection
            instead, so that gaps of the model stay visible.

    Raises:
        InputError: as many timestamps as images are needed, all finite.
        StorageError: the disk refused.
    """
    times = np.asarray(scene.image_indices if timestamps_s is None else timestamps_s, dtype=np.float64)
    if times.shape != (len(scene),):
        raise InputError(f"{path.name}: {times.size} timestamps for {len(scene)} images; give one per image or none")
    if not np.isfinite(times).all():
        image = scene.image_names[int(np.flatnonzero(~np.isfinite(times))[0])]
        raise InputError(f"{path.name}: the timestamp of {image} is not finite; give one per image or none")
    order = np.argsort(times, kind="stable")
    world_from_cam = invert_rigid(scene.cam_from_world)[order]
    quat_xyzw = continuous_quat_xyzw(world_from_cam[:, :, :3])
    lines = [
        f"{time:.9f} " + " ".join(f"{value:.12g}" for value in (*centre, *quat))
        for time, centre, quat in zip(times[order], world_from_cam[:, :, 3], quat_xyzw, strict=True)
    ]
    write_atomically(path, ("\n".join([_HEADER, *lines]) + "\n").encode("ascii"))


def times_of(scene: Scene, timestamps_s: Mapping[str, float]) -> tuple[float, ...] | None:
    """The time of each image of a scene, where they make one sequence; None for ``write_tum`` to number the images.

    Images without a time, or several videos that each begin anew, are no sequence.

    Args:
        scene: one connected model.
        timestamps_s: capture times by image name.
    """
    times = tuple(timestamps_s[name] for name in scene.image_names if name in timestamps_s)
    is_sequence = len(times) == len(scene) and all(a < b for a, b in pairwise(times))
    return times if is_sequence else None


def continuous_quat_xyzw(rotations: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Unit quaternions (N, 4) of rotations (N, 3, 3), each on the same half sphere as the one before.

    q and -q are the same rotation; readers that interpolate need neighbours on one side. The first
    has qw >= 0.
    """
    if len(rotations) == 0:
        return np.empty((0, 4))
    quat_xyzw = np.asarray(Rotation.from_matrix(rotations).as_quat(canonical=True), dtype=np.float64)
    turns_over = np.einsum("ij,ij->i", quat_xyzw[1:], quat_xyzw[:-1]) < 0
    sign = np.cumprod(np.concatenate([[1.0], np.where(turns_over, -1.0, 1.0)]))
    signed: npt.NDArray[np.float64] = quat_xyzw * sign[:, None]
    return signed
