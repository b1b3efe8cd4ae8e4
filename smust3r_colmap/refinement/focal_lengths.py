"""Whether image pairs agree with the focal lengths of a model.

A camera on an arc round what it looks at can be adjusted to a focal length that is wrong by a factor of two, with a
strong distortion, small reprojection errors and small standard deviations: only the shape of the model is wrong. The
fundamental matrices of the pairs know nothing of the model, so they are asked.
The next module to read is ``global_refinement``.
"""

from __future__ import annotations

import logging
from collections import Counter
from pathlib import Path

import pycolmap

from smust3r_colmap.colmap.database import open_database
from smust3r_colmap.colmap.reconstruction import cameras_of
from smust3r_colmap.execution.task_pool import TaskFailure, in_child
from smust3r_colmap.features.guided_verification import MIN_VERIFIED
from smust3r_colmap.features.view_graph_calibration import VerifiedPairs, cross_validated_cameras
from smust3r_colmap.products import ImageCollection

logger = logging.getLogger(__name__)

MAX_RATIO = 1.4
"""Between the two. Where the pairs tell, they are within 5 % of right models; one that was wrong had a ratio of 2.2.
Strong distortion, which fundamental matrices do not know, was seen to make 20 %."""
MIN_IMAGES = 8
"""Registered images of a camera; the pairs of fewer may agree by chance."""


def contradicted_focal_lengths(
    model: pycolmap.Reconstruction, database: Path, collection: ImageCollection
) -> tuple[str, ...]:
    """Sentences about the cameras of a model whose focal length the verified pairs contradict.

    Cameras with a focal length from EXIF or from the user are not asked about.

    Args:
        model: with camera ids of index + 1.
        database: of the run, with two-view geometries; image ids are index + 1.
        collection: with the guesses that the pairs' focal lengths are estimated from.
    """
    count = Counter(model.image(i).camera_id - 1 for i in model.reg_image_ids())
    asked = {k for k, n in count.items() if n >= MIN_IMAGES and not collection.cameras[k].has_prior_focal}
    if not asked:
        return ()
    images = {i - 1 for i in model.reg_image_ids() if model.image(i).camera_id - 1 in asked}
    with open_database(database) as opened:
        ids, counts = opened.read_two_view_geometry_num_inliers()
    pairs = (pycolmap.pair_id_to_image_pair(one) for one, n in zip(ids, counts, strict=True) if n >= MIN_VERIFIED)
    verified = VerifiedPairs(
        database=database,
        pairs=tuple(sorted((a - 1, b - 1) for a, b in pairs if {a - 1, b - 1} <= images)),
        cameras=collection.cameras,
        camera_of={k: image.camera for k, image in enumerate(collection.images)},
        seed=0,
    )
    found = in_child(cross_validated_cameras, verified)
    if isinstance(found, TaskFailure):
        logger.warning("the pairs were not asked about focal lengths: %s", found.reason)
        return ()
    adjusted = cameras_of(model, collection.cameras)
    texts = []
    for k in sorted(asked):
        here, told = adjusted[k].focal_px, found[k].focal_px
        if found[k] != collection.cameras[k] and max(here, told) > MAX_RATIO * min(here, told):
            texts.append(
                f"camera {k + 1} has a focal length of {here:.0f} px, but its image pairs agree on {told:.0f} px; try "
                "again with --camera-params, or with images from more directions"
            )
    return tuple(texts)
