"""Pictures of the trajectory of a finished run: from above and from the side, before and after loop closing.

    python scripts/plot_trajectory.py OUT picture.png [--truth poses.txt]

The truth is a ``poses.txt``, a ``transforms.json`` or the folder of a COLMAP model; both trajectories are
then fitted to it by a Sim(3) each, over the images that it has. Without a truth they share their first
segment. The side view is along the direction in which the path is narrower.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pycolmap
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from smust3r_colmap.errors import InputError
from smust3r_colmap.evaluation.readers import read_poses_txt, read_reference_sparse, read_transforms_json
from smust3r_colmap.evaluation.trajectory import Trajectory, compare_trajectories
from smust3r_colmap.geometry.arrays import FloatArray

Trajectories = Mapping[str, Trajectory]

STYLES = {
    "truth": {"color": "0.6", "linewidth": 3.0},
    "without loop closing": {"color": "tab:red", "linewidth": 1.0},
    "with loop closing": {"color": "tab:blue", "linewidth": 1.2},
}


def main() -> int:
    """Read the run, fit it to the truth, draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="output folder of smust3r-colmap reconstruct")
    parser.add_argument("picture", type=Path, help="PNG to write")
    parser.add_argument("--truth", type=Path, help="poses.txt, transforms.json, or a folder with a COLMAP model")
    arguments = parser.parse_args()

    files = {
        "without loop closing": arguments.run / "trajectory_without_loops_tum.txt",
        "with loop closing": arguments.run / "trajectory_tum.txt",
    }
    found = {label: read_tum_by_name(arguments.run, file) for label, file in files.items() if file.exists()}
    if not found:
        raise InputError(f"{arguments.run}: no trajectory_tum.txt; is this the output of a finished run?")
    unit = "units"
    if arguments.truth is not None:
        truth = read_truth(arguments.truth)
        unit = "m" if arguments.truth.name == "poses.txt" else unit
        for label, trajectory in found.items():
            evaluation = compare_trajectories(trajectory, truth)
            print(f"{label}: {evaluation.render_text(unit)}")
            poses = evaluation.reference_from_estimated.move_cameras(np.array(list(trajectory.values())))
            found[label] = dict(zip(trajectory, poses, strict=True))
        found["truth"] = truth
    draw_trajectories(found, arguments.picture, title=arguments.run.resolve().name, unit=unit)
    return 0


def read_tum_by_name(run: Path, file: Path) -> dict[str, FloatArray]:
    """``world_from_cam`` by image name of a trajectory of a run, whose times are indices into the collection.

    Raises:
        InputError: the file is no such trajectory, or the run has no model to tell the names.
    """
    try:
        names = {image.image_id - 1: image.name for image in _images(run)}
        rows = np.loadtxt(file, ndmin=2)
        poses = np.concatenate([Rotation.from_quat(rows[:, 4:8]).as_matrix(), rows[:, 1:4, None]], axis=2)
        return {names[int(index)]: pose for index, pose in zip(rows[:, 0], poses, strict=True)}
    except (OSError, ValueError, IndexError, KeyError) as error:
        raise InputError(f"{file}: not a trajectory of the models in {run / 'sparse'}: {error!r}") from error


def _images(run: Path) -> list[pycolmap.Image]:
    """Of all models: an image that only the trajectory without loops has may stand in another than the first."""
    return [
        image
        for folder in sorted((run / "sparse").glob("*"))
        if (folder / "images.bin").exists()
        for image in pycolmap.Reconstruction(folder).images.values()
    ]


def read_truth(path: Path) -> dict[str, FloatArray]:
    """``world_from_cam`` by name, from whatever the path is."""
    if path.is_dir():
        return read_reference_sparse(path)
    return read_transforms_json(path) if path.suffix == ".json" else read_poses_txt(path)


# ------------------------------------------------------------------------------- drawing
def draw_trajectories(trajectories: Trajectories, picture: Path, *, title: str, unit: str) -> None:
    """Camera centres from above and from the side, beside each other, to one scale.

    Args:
        trajectories: ``world_from_cam`` by image name, by label; all in one frame.
        picture: PNG to write.
    """
    level_from_world = level_frame(next(iter(trajectories.values())))
    figure = Figure(figsize=(14, 7), layout="tight")
    axes = figure.subplots(1, 2)
    for label in sorted(trajectories, key=list(STYLES).index):
        trajectory = trajectories[label]
        centres = np.array([trajectory[name][:, 3] for name in sorted(trajectory)]) @ level_from_world.T
        for axis, vertical in zip(axes, (2, 1), strict=True):
            axis.plot(centres[:, 0], centres[:, vertical], label=label, **STYLES[label])
            axis.plot(*centres[0, [0, vertical]], marker="o", color=STYLES[label]["color"])
            axis.plot(*centres[-1, [0, vertical]], marker="x", color=STYLES[label]["color"])
    for axis, view in zip(axes, ("from above", "from the side"), strict=True):
        axis.set_aspect("equal", adjustable="box")
        axis.set_title(f"{view} ({unit}); o first, x last image")
        axis.grid(alpha=0.3)
    axes[1].invert_yaxis()  # the y axis of a camera points down
    axes[0].legend()
    figure.suptitle(title)
    figure.savefig(picture, dpi=80)


def level_frame(trajectory: Trajectory) -> FloatArray:
    """(3, 3) rotation to axes along the path's long horizontal direction, down, and across.

    Down is the mean of what the cameras take for it. A path without a horizontal extent, or cameras
    without a common down, get any axes.
    """
    poses = np.array(list(trajectory.values()))
    down = poses[:, :, 1].mean(axis=0)
    length = np.linalg.norm(down)
    down = down / length if length > 1e-9 else np.array([0.0, 1.0, 0.0])
    centred = poses[:, :, 3] - poses[:, :, 3].mean(axis=0)
    horizontal = centred - np.outer(centred @ down, down)
    _, _, directions = np.linalg.svd(np.vstack([horizontal, 1e-9 * np.eye(3)]), full_matrices=False)
    along = directions[0] - (directions[0] @ down) * down
    along /= np.linalg.norm(along)
    return np.array([along, down, np.cross(along, down)])


if __name__ == "__main__":
    sys.exit(main())
