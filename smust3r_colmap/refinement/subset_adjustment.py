"""Adjusting the cameras on a subset of the points, and the other points afterwards.

A pose needs a few hundred observations. Where an image has thousands, the rest costs time and adds little. So where
another adjustment follows, cameras are adjusted on the longest tracks, and then all points with fixed cameras.
The next module to read is ``statistics``.
"""

from __future__ import annotations

import pycolmap

from smust3r_colmap.refinement.bundle_adjustment import FUNCTION_TOLERANCE, Priors, adjust, adjust_points

TARGET_OBSERVATIONS, MIN_OBSERVATIONS_PER_IMAGE = 60_000, 300
"""Of a subset: a number that is quick to adjust, spread over the images, and a minimum for each image."""
MAX_SUBSET_FRACTION = 0.6
"""Of all observations; a larger subset saves no time."""


def subset_of_points(
    model: pycolmap.Reconstruction, *, observations_per_image: int, first: int = 0, step: int = 1
) -> pycolmap.Reconstruction:
    """A copy with every ``step``-th point from ``first`` on, longest tracks first, until each image has
    ``observations_per_image`` or no more points.
    """
    subset = pycolmap.Reconstruction(model)
    points = sorted(model.points3D.items(), key=lambda item: (-item[1].track.length(), item[0]))
    counts: dict[int, int] = {}
    chosen = set()
    for point_id, point in points[first::step]:
        images = [element.image_id for element in point.track.elements]
        if any(counts.get(image_id, 0) < observations_per_image for image_id in images):
            chosen.add(point_id)
            for image_id in images:
                counts[image_id] = counts.get(image_id, 0) + 1
    for point_id in model.point3D_ids() - chosen:
        subset.delete_point3D(point_id)
    return subset


def adjust_on_subset(
    model: pycolmap.Reconstruction,
    priors: Priors,
    *,
    calibrated: bool,
    max_iterations: int,
    threads: int,
    principal_point: bool = False,
    function_tolerance: float = FUNCTION_TOLERANCE,
) -> bool:
    """As ``adjust``; the same if there is little to leave out."""
    per_image = max(TARGET_OBSERVATIONS // max(model.num_reg_images(), 1), MIN_OBSERVATIONS_PER_IMAGE)
    subset = subset_of_points(model, observations_per_image=per_image)
    is_smaller = subset.compute_num_observations() < MAX_SUBSET_FRACTION * model.compute_num_observations()
    usable = adjust(
        subset if is_smaller else model,
        priors,
        calibrated=calibrated,
        max_iterations=max_iterations,
        threads=threads,
        principal_point=principal_point,
        function_tolerance=function_tolerance,
    )
    if not is_smaller or not usable:
        return usable
    for frame_id in model.reg_frame_ids():
        model.frame(frame_id).rig_from_world = subset.frame(frame_id).rig_from_world
    for camera_id, camera in model.cameras.items():
        camera.params = subset.camera(camera_id).params
    return adjust_points(model, threads=threads)
