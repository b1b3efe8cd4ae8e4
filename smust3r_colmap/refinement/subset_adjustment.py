"""Adjusting the cameras on a part of the points, and the other points after them.

Poses need a few hundred observations of each image; where an image has thousands, the rest costs time and
says the same again. So where another adjustment follows, cameras are adjusted on the longest tracks, and then
all points with the cameras fixed, each by itself. The next module to read is ``principal_point``.
"""

from __future__ import annotations

import pycolmap

from smust3r_colmap.refinement.bundle_adjustment import FUNCTION_TOLERANCE, Priors, adjust, adjust_points

OBSERVATIONS, MIN_OBSERVATIONS_PER_IMAGE = 60_000, 300
"""Of a part: as many as are quick to adjust, spread over the images, but of each image some."""
WORTH_IT = 0.6
"""A part with more of the observations saves nothing."""


def part_of(
    model: pycolmap.Reconstruction, *, observations_per_image: int, first: int = 0, step: int = 1
) -> pycolmap.Reconstruction:
    """A copy with every ``step``-th point from ``first`` on, the longest tracks before others, until each image has
    ``observations_per_image`` or no more points.
    """
    part = pycolmap.Reconstruction(model)
    points = sorted(model.points3D.items(), key=lambda item: (-item[1].track.length(), item[0]))
    seen: dict[int, int] = {}
    chosen = set()
    for point_id, point in points[first::step]:
        images = [element.image_id for element in point.track.elements]
        if any(seen.get(image_id, 0) < observations_per_image for image_id in images):
            chosen.add(point_id)
            for image_id in images:
                seen[image_id] = seen.get(image_id, 0) + 1
    for point_id in model.point3D_ids() - chosen:
        part.delete_point3D(point_id)
    return part


def adjust_on_part(
    model: pycolmap.Reconstruction,
    priors: Priors,
    *,
    calibrated: bool,
    max_iterations: int,
    threads: int,
    principal_point: bool = False,
    function_tolerance: float = FUNCTION_TOLERANCE,
) -> bool:
    """As ``adjust``; of models without much to leave out the same."""
    enough = max(OBSERVATIONS // max(model.num_reg_images(), 1), MIN_OBSERVATIONS_PER_IMAGE)
    part = part_of(model, observations_per_image=enough)
    is_part = part.compute_num_observations() < WORTH_IT * model.compute_num_observations()
    adjusted = part if is_part else model
    usable = adjust(
        adjusted,
        priors,
        calibrated=calibrated,
        max_iterations=max_iterations,
        threads=threads,
        principal_point=principal_point,
        function_tolerance=function_tolerance,
    )
    if not is_part or not usable:
        return usable
    for frame_id in model.reg_frame_ids():
        model.frame(frame_id).rig_from_world = part.frame(frame_id).rig_from_world
    for camera_id, camera in model.cameras.items():
        camera.params = part.camera(camera_id).params
    return adjust_points(model, threads=threads)
