"""Where a model and its files lie, whichever folder of the scene was named.

Programs agree on SCENE/images and SCENE/sparse/0; COLMAP's dense workspace has SCENE/sparse. This is
the only module of the package that knows names of folders. The next module to read is ``rules``.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from smust3r_colmap.errors import InputError

_PARTS = ("cameras", "images", "points3D", "rigs", "frames")
_MODEL_PLACES = (".", "sparse/0", "sparse", "colmap/sparse/0", "0")
"""Below the folder that was named, in the order in which programs look."""

_INNER_SCENES = ("trainer", "dense")
"""What a run of this program puts below its own model; each is a scene by itself."""

_DOWNSCALED = re.compile(r"images_(\d+)")
_SPARSE_FOLDERS = frozenset({"sparse", "distorted", "colmap"})


@dataclass(frozen=True, kw_only=True)
class Layout:
    """Places, of which all but ``model`` may be missing.

    Args:
        model: folder of the model's files.
        scene: folder that holds images, masks and so on.
        numbered: models 0, 1, ... that lie beside this one, this one included, by name.
        downscaled: by factor.
        inner_scenes: folders below the scene with models of their own, which are not looked at.
    """

    model: Path
    scene: Path
    numbered: Mapping[str, Path]
    images: Path | None
    downscaled: Mapping[int, Path]
    masks: Path | None
    database: Path | None
    depths: Path
    depth_params: Path
    ply: Path | None
    transforms: Path | None
    inner_scenes: tuple[Path, ...]


class UnreadableModelError(InputError):
    """There is no model, or not enough of one to look at."""


def model_files(folder: Path, suffix: str) -> Mapping[str, Path]:
    """The files of one form, ``bin`` or ``txt``, that are there, by name without ending."""
    paths = {part: folder / f"{part}.{suffix}" for part in _PARTS}
    return {part: path for part, path in paths.items() if path.is_file()}


def find_layout(named: Path, *, images: Path | None, database: Path | None) -> Layout:
    """Find a model at ``named`` or where programs look below it, and what belongs to it.

    Args:
        named: folder of a model, of numbered models, of a scene, a training dataset or a dense workspace.
        images, database: where they are given they are taken; else they are looked for.

    Raises:
        InputError: a path that was given does not exist, or is a file where a folder is needed.
        UnreadableModelError: there is no model, or the files of cameras or images are missing.
    """
    if named.exists() and not named.is_dir():
        raise InputError(f"{named}: is a file; give the folder of the model")
    if not named.is_dir():
        raise InputError(f"{named}: no such folder; name the folder of a COLMAP model")
    if images is not None and not images.is_dir():
        what = "is a file; give the folder that holds the images" if images.exists() else "no such folder"
        raise InputError(f"--images {images}: {what}")
    if database is not None and not database.is_file():
        raise InputError(f"--database {database}: no such file")
    model = _find_model(named)
    scene = _scene_of(model)
    numbered = {path.name: path for path in sorted(model.parent.iterdir()) if path.name.isdigit() and _is_model(path)}
    return Layout(
        model=model,
        scene=scene,
        numbered=numbered if model.name in numbered else {},
        images=images or _folder(scene / "images"),
        downscaled=_downscaled(scene),
        masks=_folder(scene / "masks"),
        database=database or _file(scene / "database.db"),
        depths=scene / "depths",
        depth_params=model / "depth_params.json",
        ply=_file(model / "points3D.ply"),
        transforms=_file(scene / "transforms.json"),
        inner_scenes=tuple(
            scene / name
            for name in _INNER_SCENES
            if any(_is_model(scene / name / place) for place in ("sparse/0", "sparse"))
        ),
    )


def _find_model(named: Path) -> Path:
    """The first place that holds cameras and images in one form."""
    places = [named if place == "." else named / place for place in _MODEL_PLACES]
    for place in places:
        if _is_model(place):
            return place
    for place in places:
        for suffix in ("bin", "txt"):
            found = model_files(place, suffix)
            if found:
                have = ", ".join(path.name for path in found.values())
                raise UnreadableModelError(
                    f"{place}: has {have}, but a model needs cameras.{suffix} and images.{suffix} at least"
                )
    raise UnreadableModelError(
        f"{named}: no COLMAP model here: looked for cameras and images, .bin or .txt, in this folder and in its "
        f"{', '.join(_MODEL_PLACES[1:])}"
    )


def _is_model(folder: Path) -> bool:
    return any({"cameras", "images"} <= model_files(folder, suffix).keys() for suffix in ("bin", "txt"))


def _scene_of(model: Path) -> Path:
    """Above SCENE/sparse/0, SCENE/sparse or SCENE/0; the folder of the model itself elsewhere."""
    folder = model.resolve()
    if folder.name.isdigit():
        folder = folder.parent
    while folder.name in _SPARSE_FOLDERS:
        folder = folder.parent
    return folder


def _downscaled(scene: Path) -> Mapping[int, Path]:
    found = {}
    for path in scene.iterdir():
        matched = _DOWNSCALED.fullmatch(path.name)
        if matched and path.is_dir():
            found[int(matched[1])] = path
    return dict(sorted(found.items()))


def _folder(path: Path) -> Path | None:
    return path if path.is_dir() else None


def _file(path: Path) -> Path | None:
    return path if path.is_file() else None
