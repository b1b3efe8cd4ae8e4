"""A way to the minimum that survives any drift: the linear parts of the transforms first.

At the end of a long sequence the drift is several times the size of the scene, and descending on
everything at once from there crumples the graph (scales fall to zero). The linear parts (rotation
and scale, or more) do not depend on translations; alone they converge from any drift in a few
steps. With them known, translations are a linear problem. From there the whole converges.
The next module to read is ``optimise``.

Source: the order of solving is that of Carlone, Tron, Daniilidis, Dellaert 2015, "Initialization
techniques for 3D SLAM"; here each part is solved on the group itself.
"""

from __future__ import annotations

import numpy as np

from smust3r_colmap.geometry.arrays import BoolArray, FloatArray
from smust3r_colmap.geometry.transform import Transform
from smust3r_colmap.stitching.pose_graph.graph import PoseGraph

TRANSLATION = slice(0, 3)
"""Where the translation stands in the tangent vectors of every group."""


def linear_part(group: type[Transform]) -> slice:
    """Where the linear part stands in the tangent vectors of a group; SL(4) has its projective row behind it."""
    return slice(3, min(group.DOF, 12))


def only_linear(transform: Transform) -> Transform:
    """The same without translation and projective row, which is a subgroup."""
    matrix = transform.matrix.copy()
    matrix[..., :3, 3] = 0.0
    matrix[..., 3, :3] = 0.0
    return type(transform).from_matrix(matrix)


def only_translation_of(translation: Transform, linear: Transform) -> Transform:
    """The linear part of one with the translation of the other."""
    matrix = linear.matrix.copy()
    # Homogeneous coordinates: SL(4) scales its matrices to determinant one.
    other = translation.matrix
    matrix[..., :3, 3] = other[..., :3, 3] * (matrix[..., 3, 3] / other[..., 3, 3])[..., None]
    return type(linear).from_matrix(matrix)


def part_of(graph: PoseGraph, part: slice, transform: Transform) -> PoseGraph:
    """The graph that knows only a part of each residual: information (M, DOF, DOF) marginal over the rest."""
    dof = graph.target_from_source.DOF
    inside = np.zeros(dof, dtype=bool)
    inside[part] = True
    information = np.zeros_like(graph.information)
    information[np.ix_(np.arange(len(graph)), inside, inside)] = _marginal(graph.information, inside)
    return PoseGraph(
        num_nodes=graph.num_nodes,
        target=graph.target,
        source=graph.source,
        target_from_source=transform,
        information=information,
        loop=graph.loop,
    )


def _marginal(information: FloatArray, inside: BoolArray) -> FloatArray:
    """Inverse of the covariance's block: the Schur complement, which a singular information has too."""
    own = information[:, inside][:, :, inside]
    cross = information[:, inside][:, :, ~inside]
    rest = information[:, ~inside][:, :, ~inside]
    marginal = own - cross @ np.linalg.pinv(rest, hermitian=True) @ np.swapaxes(cross, 1, 2)
    # Rounding of the difference must not leave a direction with negative information.
    values, vectors = np.linalg.eigh((marginal + np.swapaxes(marginal, 1, 2)) / 2)
    return np.asarray((vectors * np.maximum(values, 0.0)[:, None, :]) @ np.swapaxes(vectors, 1, 2))
