"""Which layout a file or a folder of poses has, and its reader.

One reader per layout. A layout is found by the names of the files in a folder, and by the number of words on the first
line of a file.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import get_args

from smust3r_colmap.config import PoseLayout as Layout
from smust3r_colmap.errors import InputError
from smust3r_colmap.importers.euroc import TRUTH, read_euroc
from smust3r_colmap.importers.kitti_odometry import read_kitti
from smust3r_colmap.importers.model_poses import read_models
from smust3r_colmap.importers.pose_set import PoseSet, data_lines
from smust3r_colmap.importers.poses_txt import read_named_poses
from smust3r_colmap.importers.seven_scenes import POSE_FILES, read_seven_scenes
from smust3r_colmap.importers.transforms_poses import read_transforms
from smust3r_colmap.importers.tum_rgbd import read_tum, read_tum_folder


def _tum(path: Path) -> tuple[PoseSet, ...]:
    return (read_tum_folder(path) if path.is_dir() else read_tum(path),)


_READERS: Mapping[Layout, Callable[[Path], tuple[PoseSet, ...]]] = {
    "tum": _tum,
    "eth3d-slam": _tum,
    "7-scenes": lambda path: (read_seven_scenes(path),),
    "kitti": lambda path: (read_kitti(path),),
    "euroc": lambda path: (read_euroc(path),),
    "poses-txt": lambda path: (read_named_poses(path),),
    "transforms": lambda path: (read_transforms(path),),
    "colmap": read_models,
}


def read_pose_sets(path: Path, layout: Layout | None = None) -> tuple[PoseSet, ...]:
    """The poses of a file or folder; several sets, largest first, where it has several COLMAP models.

    Args:
        path: a trajectory, a data set, a COLMAP model, or the folder of a run.
        layout: None finds it.

    Raises:
        InputError: it is not there, its layout is not known, or it is not as the layout has it.
    """
    if not path.exists():
        raise InputError(f"{path}: there is no such file or folder")
    return _READERS[layout or find_layout(path)](path)


def find_layout(path: Path) -> Layout:
    """The layout of a file or folder; a folder that looks like none of the data sets is taken for a COLMAP model.

    Raises:
        InputError: the first line of a file is that of none.
    """
    return _layout_of_folder(path) if path.is_dir() else _layout_of_file(path)


def _layout_of_folder(folder: Path) -> Layout:
    has = {
        name: (folder / name).exists()
        for name in ("groundtruth.txt", "calibration.txt", "poses.txt", "transforms.json", "sparse", "mav0", TRUTH)
    }
    if has["poses.txt"]:
        return _layout_of_file(folder / "poses.txt")
    signs: dict[Layout, bool] = {
        "7-scenes": next(folder.glob(POSE_FILES), None) is not None,
        "eth3d-slam": has["groundtruth.txt"] and has["calibration.txt"],
        "tum": has["groundtruth.txt"],
        "euroc": has["mav0"] or has[TRUTH],
        "kitti": (folder / "times.txt").is_file() and (folder / "calib.txt").is_file(),
        "transforms": has["transforms.json"] and not has["sparse"],
    }
    return next((layout for layout, is_there in signs.items() if is_there), "colmap")


def _layout_of_file(path: Path) -> Layout:
    if path.suffix == ".json":
        return "transforms"
    if path.suffix == ".csv":
        return "euroc"
    place, words = next(data_lines(path), (str(path), []))
    if not words:
        raise InputError(f"{path}: has no pose")
    by_count: dict[tuple[int, bool], Layout] = {(8, True): "tum", (8, False): "poses-txt", (12, True): "kitti"}
    found = by_count.get((len(words), _is_number(words[0])))
    if found is None:
        raise InputError(
            f"{place}: {len(words)} words; needed 8 (a time or a name, position and quaternion) or 12 (a 3 x 4 "
            f"matrix); else name the layout: {', '.join(get_args(Layout))}"
        )
    return found


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
