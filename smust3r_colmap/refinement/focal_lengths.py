"""Whether image pairs agree with the focal lengths of a model.

A camera on an arc round what it looks at can be adjusted to a focal length that is wrong by a factor of two, with a
strong distortion, small reprojection errors and small standard deviations: only the shape of the model is wrong. The
fundamental matrices of the pairs know nothing of the model, so they are asked.
The next module to read is ``global_refinement``.
"""

from __future__ import annotations

import logging
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pycolmap

from smust3r_colmap.colmap.reconstruction import cameras_of
from smust3r_colmap.execution.task_pool import TaskFailure, in_child
from smust3r_colmap.features.guided_verification import count_verified
from smust3r_colmap.features.view_graph_calibration import VerifiedPairs, cross_validated_cameras
from smust3r_colmap.products import ImageCollection

logger = logging.getLogger(__name__)

MAX_RATIO = 1.4
"""Between the two. Where the pairs tell, they are within 5 % of right models; one that was wrong had a ratio of 2.2.
Strong distortion, which fundamental matrices do not know, was seen to make 20 %."""
MAX_PAIRS = 600
"""Evenly chosen of the pairs, which take 10 ms each where they were verified with a known focal length."""
_PERSPECTIVE = frozenset({"SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"})
"""Fundamental matrices know no fisheye."""
MIN_IMAGES = 8
"""Registered images of a camera; the pairs of fewer may agree by chance."""


def contradicted_focal_lengths(
    model: pycolmap.Reconstruction, database: Path, collection: ImageCollection
) -> tuple[str, ...]:
    """Sentences about the cameras of a model whose focal length the verified pairs contradict.

    The pairs are asked beginning with the model's focal length, so that they contradict it only if they leave it. What
    EXIF or another program said about a camera does not count, because the model is free to leave that, too.

    Args:
        model: with camera ids of index + 1.
        database: of the run, with matches and two-view geometries; image ids are index + 1.
        collection: says which image has which camera.
    """
    count = Counter(model.image(i).camera_id - 1 for i in model.reg_image_ids())
    asked = {k for k, n in count.items() if n >= MIN_IMAGES and collection.cameras[k].model in _PERSPECTIVE}
    if not asked:
        return ()
    images = {i - 1 for i in model.reg_image_ids() if model.image(i).camera_id - 1 in asked}
    pairs = [pair for pair in count_verified(database) if images.issuperset(pair)]
    adjusted = cameras_of(model, collection.cameras)
    starts = tuple(replace(one, has_prior_focal=False) for one in adjusted)
    verified = VerifiedPairs.of(
        database, pairs[:: -(-len(pairs) // MAX_PAIRS) or 1], replace(collection, cameras=starts), seed=0
    )
    found = in_child(cross_validated_cameras, verified)
    if isinstance(found, TaskFailure):
        logger.warning("the pairs were not asked about focal lengths: %s", found.reason)
        return ()
    texts = []
    for k in sorted(asked):
        here, told = adjusted[k].focal_px, found[k].focal_px
        if max(here, told) > MAX_RATIO * min(here, told):
            texts.append(
                f"camera {k + 1} has a focal length of {here:.0f} px, but its image pairs agree on {told:.0f} px; try "
                "again with --camera-params, or with images from more directions"
            )
    return tuple(texts)
