"""Depth maps of one piece, made in a child process and written as a finished stage."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from smust3r_colmap.backbones.classical.plane_sweep import ColourImage, reconstruct_depth
from smust3r_colmap.importers.images import load_rgb
from smust3r_colmap.products import SegmentPiece, SourceImage
from smust3r_colmap.run_directory import StageFolder, key_of
from smust3r_colmap.stored_maps import ImageMaps, write_maps


@dataclass(frozen=True, kw_only=True, eq=False)
class DepthTask:
    """A piece with the images it was made of, in the piece's order, and where its maps go."""

    piece: SegmentPiece
    images: tuple[SourceImage, ...]
    folder: StageFolder
    dense_size: int
    planes: int


def make_depth(task: DepthTask) -> None:
    """Sweep all images of the piece and finish the stage.

    Raises:
        ImageError: an image can no longer be read. StorageError: the disk refused.
        ValueError: the piece has no tracks.
    """
    piece = task.piece
    if piece.tracks is None:
        raise ValueError(f"piece {piece.name} has no tracks to bound its depth")

    def load(k: int) -> ColourImage:
        return load_rgb(task.images[k])

    depths = reconstruct_depth(
        load,
        images=piece.images,
        seg_from_cam=piece.seg_from_cam,
        intrinsics=piece.intrinsics,
        tracks=piece.tracks,
        dense_size=task.dense_size,
        planes=task.planes,
    )
    with task.folder.write() as folder:
        write_maps(folder, (ImageMaps(depth=d.depth, confidence=d.confidence, rgb=d.rgb) for d in depths))


def make_no_depth(task: DepthTask) -> None:
    """Write empty maps for a piece whose sweep failed, under another key: the next start sweeps again."""
    maps = []
    for intrinsics in task.piece.intrinsics:
        shrink = min(1.0, task.dense_size / max(intrinsics.width, intrinsics.height))
        shape = (max(1, round(intrinsics.height * shrink)), max(1, round(intrinsics.width * shrink)))
        maps.append(
            ImageMaps(
                depth=np.zeros(shape, np.float32),
                confidence=np.ones(shape, np.float32),
                rgb=np.zeros((*shape, 3), np.uint8),
            )
        )
    with StageFolder(path=task.folder.path, key=key_of(task.folder.key, "no depth")).write() as folder:
        write_maps(folder, maps)
