"""Scenes on disk, so that a finished run can be exported again without computing anything."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy.typing as npt

from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.products import PointCloud, Scene
from smust3r_colmap.storage.run_directory import read_arrays, read_json, write_arrays, write_json


def write_scenes(folder: Path, scenes: tuple[Scene, ...]) -> None:
    """Write all models of a run into an existing folder."""
    for number, scene in enumerate(scenes):
        arrays: dict[str, npt.NDArray[Any]] = {
            "cam_from_world": scene.cam_from_world,
            "xyz": scene.points.xyz,
            "rgb": scene.points.rgb,
        }
        if scene.points.normals is not None:
            arrays["normals"] = scene.points.normals
        write_arrays(folder / f"scene_{number}.safetensors", arrays)
    facts = [
        {
            "image_indices": scene.image_indices,
            "image_names": scene.image_names,
            "camera_indices": scene.camera_indices,
            "cameras": {str(index): asdict(camera) for index, camera in scene.cameras.items()},
            "metric": scene.metric,
            "segments": scene.segments,
        }
        for scene in scenes
    ]
    write_json(folder / "scenes.json", facts)


def read_scenes(folder: Path) -> tuple[Scene, ...]:
    """What ``write_scenes`` wrote."""
    scenes = []
    for number, facts in enumerate(read_json(folder / "scenes.json")):
        arrays = read_arrays(folder / f"scene_{number}.safetensors")
        scenes.append(
            Scene(
                image_indices=tuple(facts["image_indices"]),
                image_names=tuple(facts["image_names"]),
                camera_indices=tuple(facts["camera_indices"]),
                cameras={int(index): Intrinsics(**camera) for index, camera in facts["cameras"].items()},
                cam_from_world=arrays["cam_from_world"],
                points=PointCloud(xyz=arrays["xyz"], rgb=arrays["rgb"], normals=arrays.get("normals")),
                metric=facts["metric"],
                segments=tuple(facts["segments"]),
            )
        )
    return tuple(scenes)
