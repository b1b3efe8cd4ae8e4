"""Pairs of look-alike places, found by the rotations of all pairs together.

A false pair says that two views of different places have a certain relative rotation. Round any cycle of pairs the
relative rotations have to make the identity, and the many true pairs of a walk from one place to the other say
something else. COLMAP's rotation averaging finds the rotations of all images that most pairs agree with; a pair that is
far from them is a look-alike. A place that looks the same from the same direction passes: no rotation tells it.

Zach, Klopschitz and Pollefeys, "Disambiguating visual relations using loop constraints", CVPR 2010; Chatterjee and
Govindu, "Efficient and robust large-scale rotation averaging", ICCV 2013. The next module to read is ``sift``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pycolmap
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from smust3r_colmap.colmap.database import open_database
from smust3r_colmap.features.view_graph_calibration import VerifiedPairs, calibrated_cameras
from smust3r_colmap.geometry.arrays import FloatArray, Pair
from smust3r_colmap.geometry.so3 import angles_between

MAX_ROTATION_ERROR_DEG = 20.0
"""Between the rotation of a pair and those of its images. In no order, of ``office_loop`` 288 of the 298 false pairs
have more and 16 of 2,700 true ones, of ``courthouse_walk`` 287 of 437 and 75 of 2,400; false ones with less have few
matches."""

METHOD_VERSION = 2
"""To be raised when the pairs found may change, so that finished folders look again."""


def look_alikes(task: VerifiedPairs) -> tuple[Pair, ...]:
    """The pairs that are ``MAX_ROTATION_ERROR_DEG`` and more from the averaged rotations, ascending."""
    far = np.flatnonzero(rotation_errors_deg(task) > MAX_ROTATION_ERROR_DEG)
    return tuple(task.pairs[k] for k in far)


def rotation_errors_deg(task: VerifiedPairs) -> npt.NDArray[np.float64]:
    """(E,) angle in degrees between the rotation of each pair and the averaged ones; NaN where there is none.

    A focal length that is twice too long halves every rotation, and no cycle closes, so cameras are calibrated first.
    """
    if not task.pairs:
        return np.zeros(0)
    relative = _relative_rotations(replace(task, cameras=calibrated_cameras(task)))
    rotations: dict[int, FloatArray] = {}
    for pairs in _components([pair for pair in task.pairs if pair in relative]):
        rotations |= _averaged(pairs, relative, task)
    errors = np.full(len(task.pairs), np.nan)
    known = [k for k, (a, b) in enumerate(task.pairs) if (a, b) in relative and a in rotations and b in rotations]
    if known:
        found = np.stack([rotations[task.pairs[k][1]] @ rotations[task.pairs[k][0]].T for k in known])
        errors[known] = np.degrees(angles_between(np.stack([relative[task.pairs[k]] for k in known]), found))
    return errors


def _relative_rotations(task: VerifiedPairs) -> dict[Pair, FloatArray]:
    """(3, 3) rotation from the first camera of a pair to the second; without pairs that have no relative pose."""
    options = pycolmap.TwoViewGeometryOptions()
    options.compute_relative_pose = True
    options.ransac.random_seed = task.seed
    options.ransac.max_num_trials = 1_000
    found: dict[Pair, FloatArray] = {}
    xy_img: dict[int, FloatArray] = {}
    with open_database(task.database) as database:
        for image in sorted({image for pair in task.pairs for image in pair}):
            xy_img[image] = np.asarray(database.read_keypoints(image + 1), dtype=np.float64)[:, :2]
        for first, second in task.pairs:
            geometry = pycolmap.estimate_calibrated_two_view_geometry(
                task.cameras[task.camera_of[first]].colmap_camera(1),
                xy_img[first],
                task.cameras[task.camera_of[second]].colmap_camera(2),
                xy_img[second],
                database.read_two_view_geometry(first + 1, second + 1).inlier_matches,
                options,
            )
            if geometry.cam2_from_cam1 is not None:
                found[first, second] = np.asarray(geometry.cam2_from_cam1.rotation.matrix())
    return found


def _components(pairs: Sequence[Pair]) -> list[list[Pair]]:
    """The pairs of every connected component."""
    if not pairs:
        return []
    images, position = np.unique(np.array(pairs), return_inverse=True)
    first, second = position.reshape(-1, 2).T
    graph = csr_array((np.ones(len(pairs)), (first, second)), shape=(len(images), len(images)))
    count, label = connected_components(graph, directed=False)
    of_component: list[list[Pair]] = [[] for _ in range(count)]
    for k, pair in zip(label[first].tolist(), pairs, strict=True):
        of_component[k].append(pair)
    return of_component


def _averaged(pairs: Sequence[Pair], relative: Mapping[Pair, FloatArray], task: VerifiedPairs) -> dict[int, FloatArray]:
    """(3, 3) rotation of every image of connected pairs, by image index; none where averaging fails."""
    graph, model = pycolmap.PoseGraph(), pycolmap.Reconstruction()
    camera = pycolmap.Camera(camera_id=1, model="SIMPLE_PINHOLE", width=2, height=2, params=[1, 1, 1])
    model.add_camera_with_trivial_rig(camera)
    for image in sorted({image for pair in pairs for image in pair}):
        model.add_image_with_trivial_frame(pycolmap.Image(name=str(image), camera_id=1, image_id=image + 1))
    with open_database(task.database) as database:
        for first, second in pairs:
            rotation = pycolmap.Rotation3d(relative[first, second])
            edge = pycolmap.PoseGraphEdge(cam2_from_cam1=pycolmap.Rigid3d(rotation, np.zeros(3)))
            edge.num_matches = len(database.read_two_view_geometry(first + 1, second + 1).inlier_matches)
            edge.valid = True
            graph.add_edge(first + 1, second + 1, edge)
    options = pycolmap.RotationEstimatorOptions()
    options.random_seed = task.seed
    options.reweighting = pycolmap.RotationAveragingReweighting.INLIER_MATCH_COUNT
    options.max_rotation_error_deg = MAX_ROTATION_ERROR_DEG
    if not pycolmap.run_rotation_averaging(options, graph, model, []):
        return {}
    return {
        image_id - 1: np.asarray(model.image(image_id).cam_from_world().rotation.matrix())
        for image_id in model.images
        if model.image(image_id).has_pose
    }
