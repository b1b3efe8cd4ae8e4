"""Pictures of the trajectory of a finished run: before loop closing, after it, and after bundle adjustment.

    python scripts/plot_trajectory.py OUT picture.png [--truth poses.txt [--exaggerate 50]]

The left picture is the path from above. With a ground truth, the right one has the position error of each image;
without, it is the path from the side, along the direction in which the path is narrower.

The ground truth is a ``poses.txt``, a ``transforms.json`` or the folder of a COLMAP model. Each trajectory is fitted to
it by a Sim(3), over the images that it has. Without a ground truth the trajectories share their first segment.
``--exaggerate`` draws the differences from the ground truth larger than they are, because those of a good run cannot be
seen.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from smust3r_colmap.errors import InputError
from smust3r_colmap.evaluation.trajectory import Trajectory, compare_trajectories
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.importers.model_poses import read_model_poses
from smust3r_colmap.importers.poses_txt import read_poses_txt
from smust3r_colmap.importers.transforms_poses import read_transforms_json

Trajectories = Mapping[str, Trajectory]

TRUTH = "truth"
STYLES: dict[str, dict[str, Any]] = {
    TRUTH: {"color": "0.75", "linewidth": 5.0, "solid_capstyle": "round"},
    "without loop closing": {"color": "#d1495b", "linewidth": 1.8},
    "with loop closing": {"color": "#edae49", "linewidth": 1.8},
    "with bundle adjustment": {"color": "#00798c", "linewidth": 1.8},
}


def main() -> int:
    """Read the run, fit it to the truth, draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="output folder of smust3r-colmap reconstruct")
    parser.add_argument("picture", type=Path, help="PNG to write")
    parser.add_argument("--truth", type=Path, help="poses.txt, transforms.json, or a folder with a COLMAP model")
    parser.add_argument(
        "--exaggerate", type=float, default=1.0, help="draw differences from the truth this many times as large"
    )
    arguments = parser.parse_args()
    if arguments.exaggerate != 1 and arguments.truth is None:
        parser.error("--exaggerate enlarges differences from the --truth; name one")

    found = read_run(arguments.run)
    unit = "units"
    if arguments.truth is not None:
        truth = read_truth(arguments.truth)
        unit = "m" if arguments.truth.name == "poses.txt" else unit
        for label, trajectory in found.items():
            evaluation = compare_trajectories(trajectory, truth)
            print(f"{label}: {evaluation.render_text(unit)}")
            poses = evaluation.reference_from_estimated.move_cameras(np.array(list(trajectory.values())))
            found[label] = dict(zip(trajectory, poses, strict=True))
        found[TRUTH] = truth
    draw_trajectories(found, arguments.picture, title="", unit=unit, exaggeration=arguments.exaggerate)
    return 0


def read_run(run: Path) -> dict[str, Trajectory]:
    """The trajectories of a finished run, by label; without refinement the last one is that after loop closing.

    Raises:
        InputError: the folder has no trajectory.
    """
    files = ["trajectory_without_loops_tum.txt", "trajectory_stitched_tum.txt", "trajectory_tum.txt"]
    if not (run / files[1]).exists():
        files = [files[0], files[2]]
    labels = [label for label in STYLES if label != TRUTH]
    found = {label: run / file for label, file in zip(labels, files, strict=False) if (run / file).exists()}
    if not found:
        raise InputError(f"{run}: no trajectory_tum.txt; is this the output of a finished run?")
    return {label: read_tum_by_name(run, file) for label, file in found.items()}


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
        return read_model_poses(path)
    return read_transforms_json(path) if path.suffix == ".json" else read_poses_txt(path)


# ------------------------------------------------------------------------------- drawing
def draw_trajectories(
    trajectories: Trajectories, picture: Path, *, title: str, unit: str, exaggeration: float = 1.0
) -> None:
    """Camera centres from above; beside it the position errors where there is a truth, and else the side view.

    Args:
        trajectories: ``world_from_cam`` by image name, by label; all in one frame.
        picture: PNG to write.
        unit: of length.
        exaggeration: how many times as large differences from the truth are drawn.
    """
    figure = Figure(figsize=(11, 4.4), layout="constrained")
    above, beside = figure.subplots(1, 2)
    centres = level_centres(trajectories)
    truth = centres.get(TRUTH)
    drawn = {label: exaggerated(one, truth, exaggeration) for label, one in centres.items()}
    _draw_path(above, drawn, vertical=2)
    enlarged = f", errors {exaggeration:g} times enlarged" if exaggeration != 1 else ""
    above.set_title(f"from above ({unit}){enlarged}")
    if truth is None:
        _draw_path(beside, drawn, vertical=1)
        beside.invert_yaxis()  # the y axis of a camera points down
        beside.set_title(f"from the side ({unit})")
    else:
        _draw_errors(beside, centres, unit)
    handles, labels = above.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False)
    if title:
        figure.suptitle(title)
    figure.savefig(picture, dpi=100)


def level_centres(trajectories: Trajectories) -> dict[str, dict[str, FloatArray]]:
    """(3,) camera centres by image name, by label in the order of ``STYLES``, in the level frame of the first."""
    level_from_world = level_frame(next(iter(trajectories.values())))
    return {
        label: {name: level_from_world @ trajectories[label][name][:, 3] for name in sorted(trajectories[label])}
        for label in STYLES
        if label in trajectories
    }


def exaggerated(
    centres: Mapping[str, FloatArray], truth: Mapping[str, FloatArray] | None, exaggeration: float
) -> FloatArray:
    """(N, 3) centres whose distance from the truth, where there is one, is multiplied."""
    if truth is None or exaggeration == 1:
        return np.array(list(centres.values()))
    both = [name for name in centres if name in truth]
    return np.array([truth[name] + exaggeration * (centres[name] - truth[name]) for name in both])


def _draw_path(axis: Axes, centres: Mapping[str, FloatArray], *, vertical: int) -> None:
    for label, xyz in centres.items():
        axis.plot(xyz[:, 0], xyz[:, vertical], label=label, **STYLES[label])
        for end, marker in ((0, "o"), (-1, "X")):
            axis.plot(*xyz[end, [0, vertical]], marker=marker, markersize=7, color=STYLES[label]["color"])
    axis.set_aspect("equal", adjustable="box")
    _soften(axis)


def _draw_errors(axis: Axes, centres: Mapping[str, Mapping[str, FloatArray]], unit: str) -> None:
    truth = centres[TRUTH]
    place = {name: k for k, name in enumerate(truth)}
    factor, small_unit = (1000, "mm") if unit == "m" else (1, unit)
    for label, one in centres.items():
        if label != TRUTH:
            both = [name for name in one if name in truth]
            errors = [factor * float(np.linalg.norm(one[name] - truth[name])) for name in both]
            axis.plot([place[name] for name in both], errors, **STYLES[label])
    axis.set_ylim(bottom=0)
    axis.set_title(f"position error of each image ({small_unit})")
    _soften(axis)


def _soften(axis: Axes) -> None:
    axis.grid(alpha=0.25)
    axis.spines[["top", "right"]].set_visible(False)


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
