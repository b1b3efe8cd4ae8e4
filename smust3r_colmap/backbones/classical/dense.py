"""Depth maps of one submodel, computed in a child process and written as a finished stage.

The next module to read is ``view_selection``.
"""

from __future__ import annotations

from dataclasses import dataclass

from smust3r_colmap.backbones.classical.plane_sweep import ColourImage, reconstruct_depth
from smust3r_colmap.importers.images import load_rgb
from smust3r_colmap.products import SourceImage, Submodel
from smust3r_colmap.storage.dense_maps import ImageMaps, write_maps
from smust3r_colmap.storage.run_directory import StageFolder


@dataclass(frozen=True, kw_only=True, eq=False)
class DepthTask:
    """A submodel with the images it was made of, in the submodel's order, and where its maps go."""

    submodel: Submodel
    images: tuple[SourceImage, ...]
    folder: StageFolder
    dense_size: int
    planes: int


def make_depth(task: DepthTask) -> None:
    """Sweep all images of the submodel and finish the stage.

    Raises:
        ImageError: an image can no longer be read. StorageError: the disk refused.
        ValueError: the submodel has no tracks.
    """
    submodel = task.submodel
    if submodel.tracks is None:
        raise ValueError(f"submodel {submodel.name} has no tracks to bound its depth")

    def load(k: int) -> ColourImage:
        return load_rgb(task.images[k])

    depths = reconstruct_depth(
        load,
        images=submodel.images,
        seg_from_cam=submodel.seg_from_cam,
        intrinsics=submodel.intrinsics,
        tracks=submodel.tracks,
        dense_size=task.dense_size,
        planes=task.planes,
    )
    with task.folder.write() as folder:
        write_maps(folder, (ImageMaps(depth=d.depth, confidence=d.confidence, rgb=d.rgb) for d in depths))
