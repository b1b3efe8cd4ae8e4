"""Coordinates in which a graph's nodes lie in a ball of radius one about the origin.

In SL(4) lengths mix with the projective row, and a solver that meets coordinates of hundreds of
units stops at once. Nodes become ``S C X S^-1`` and edges ``S Z S^-1``, with C moving the centre of
the nodes to the origin and S scaling: the world moves, and every frame changes its unit of length.
The next module to read is ``loop_selection``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.transform import Transform
from smust3r_colmap.stitching.pose_graph.graph import PoseGraph


@dataclass(frozen=True, kw_only=True, eq=False)
class Normalisation:
    """New coordinates, (x - centre) / radius, for the world; lengths are divided by radius in every frame.

    Args:
        centre: (3,) in the world.
        radius: positive, in the unit of the world.
    """

    centre: FloatArray
    radius: float

    @classmethod
    def about(cls, world_from_node: Transform) -> Normalisation:
        """That of the origins of the nodes, (N,)."""
        origins = world_from_node.apply(np.zeros((1, 3)))[:, 0]
        origins = origins[np.isfinite(origins).all(axis=1)]
        centre = origins.mean(axis=0) if len(origins) else np.zeros(3)
        radius = float(np.linalg.norm(origins - centre, axis=1).max(initial=0.0))
        return cls(centre=centre, radius=radius if radius > 0 else 1.0)

    def state(self, world_from_node: Transform) -> Transform:
        """Nodes in the new coordinates."""
        matrices = self._scaled(self._moved(-self.centre) @ world_from_node.matrix, 1.0 / self.radius)
        return type(world_from_node).from_matrix(matrices)

    def undone(self, world_from_node: Transform) -> Transform:
        """Nodes back in the old ones."""
        matrices = self._moved(self.centre) @ self._scaled(world_from_node.matrix, self.radius)
        return type(world_from_node).from_matrix(matrices)

    def graph(self, graph: PoseGraph) -> PoseGraph:
        """The same edges between the nodes in the new coordinates.

        ``S Z exp(d) S^-1 = S Z S^-1 exp(Ad(S) d)``, so the information becomes ``Ad(S)^-T I Ad(S)^-1``.
        """
        group = type(graph.target_from_source)
        back = group.vee(self._scaled(group.hat(np.eye(group.DOF)), self.radius)).T  # Ad(S^-1), column by column
        return PoseGraph(
            num_nodes=graph.num_nodes,
            target=graph.target,
            source=graph.source,
            target_from_source=group.from_matrix(self._scaled(graph.target_from_source.matrix, 1.0 / self.radius)),
            information=back.T @ graph.information @ back,
            loop=graph.loop,
        )

    @staticmethod
    def _moved(offset: FloatArray) -> FloatArray:
        matrix = np.eye(4)
        matrix[:3, 3] = offset
        return matrix

    @staticmethod
    def _scaled(matrix: FloatArray, factor: float) -> FloatArray:
        """``S M S^-1`` with S = diag(factor, factor, factor, 1)."""
        scales = np.array([factor, factor, factor, 1.0])
        scaled: FloatArray = matrix * (scales[:, None] / scales)
        return scaled
