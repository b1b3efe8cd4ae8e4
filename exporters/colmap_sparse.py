"""A scene as a COLMAP model: rigs, cameras, frames, images and points3D, binary and if wanted text.

Ids are index + 1. Every camera is a rig of its own and every image a frame of its own, which is what
COLMAP 4 wants and what older readers, which know three files only, ignore. The fused cloud is written
as points without a track: a track of one observation would make bundle adjustment refuse the model.
Building and writing a million points takes about 4 s, a further 5 s as text (pycolmap 4.2).
The next module to read is ``ply``.
"""

from __future__ import annotations

from pathlib import Path

import pycolmap

from smust3r_colmap.colmap.model_files import (
    MODEL_FILES,
    refuse_names_text_cannot_hold,
    write_binary_checked,
    write_text_checked,
)
from smust3r_colmap.products import Scene
from smust3r_colmap.storage.atomic_write import atomic_folder


def write_colmap_sparse(scene: Scene, folder: Path, *, text: bool = False) -> None:
    """Write the model into ``folder``, which is made, or replaced where an older model stands there.

    Args:
        scene: one connected model.
        folder: such as ``sparse/0``; written atomically.
        text: write ``.txt`` beside the ``.bin`` files.

    Raises:
        InputError: ``text`` is wanted and a name holds a blank; nothing is written.
        RunDirectoryError: the folder holds files that are no COLMAP model.
        StorageError: the disk refused, or took less than was written.
    """
    if text:
        refuse_names_text_cannot_hold(scene.image_names)
    model = _reconstruction(scene)
    with atomic_folder(folder, may_hold=MODEL_FILES) as partial:
        write_binary_checked(model, partial, to_be=folder)
        if text:
            write_text_checked(model, partial, to_be=folder)


def _reconstruction(scene: Scene) -> pycolmap.Reconstruction:
    """The same scene as a pycolmap object."""
    model = pycolmap.Reconstruction()
    for camera in sorted(set(scene.camera_indices)):
        model.add_camera_with_trivial_rig(scene.cameras[camera].colmap_camera(camera + 1))
    for index, name, camera, cam_from_world in zip(
        scene.image_indices, scene.image_names, scene.camera_indices, scene.cam_from_world, strict=True
    ):
        image = pycolmap.Image(name=name, camera_id=camera + 1, image_id=index + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(cam_from_world))
    no_track = pycolmap.Track()
    for xyz, rgb in zip(scene.points.xyz, scene.points.rgb, strict=True):
        model.add_point3D(xyz, no_track, rgb)
    return model
