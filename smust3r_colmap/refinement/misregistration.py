"""Images that the model holds at a wrong pose, found by the verified matches of image pairs.

In a sound model nearly all verified matches of nearby images satisfy the epipolar constraint. A single pair proves
little: look-alike places match where nothing is wrong, and a few epipolar lines fit by chance. So images are grouped
by weighted agglomerative clustering. The weight of a pair is positive where its matches support the model and
negative where they contradict it. A cluster that the largest cluster contradicts is misregistered.
The next module to read is ``reregistration``.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass

from smust3r_colmap.geometry.arrays import Pair

MIN_CONTRADICTING_MATCHES = 30
"""Verified matches of a pair that may contradict the model; COLMAP's minimum for registration."""
MIN_SUPPORTING_FRACTION, MAX_CONTRADICTING_FRACTION = 0.85, 0.7
"""Of a pair's verified matches that satisfy the epipolar constraint. Sound models of nine collections are connected by
pairs above 0.85. Two-view verification errs on repetitive facades, whose pairs fall to 0.75 in sound models."""


@dataclass(frozen=True, kw_only=True)
class EpipolarSupport:
    """How the verified matches of one pair fit the model.

    Args:
        num_matches: of the pair.
        inlier_fraction: of them that satisfy the epipolar constraint.
    """

    num_matches: int
    inlier_fraction: float

    @property
    def weight(self) -> int:
        """Positive: the pair supports the model. Negative: it contradicts it. 0: undecided, or too few matches.

        Its size is the square root of the number of matches, because pairs from across a repetitive facade are many,
        and each has few matches.
        """
        size = math.isqrt(self.num_matches)
        if self.inlier_fraction >= MIN_SUPPORTING_FRACTION:
            return size
        contradicts = self.inlier_fraction < MAX_CONTRADICTING_FRACTION
        return -size if contradicts and self.num_matches >= MIN_CONTRADICTING_MATCHES else 0


def find_misregistered(support: Mapping[Pair, EpipolarSupport], images: Collection[int]) -> tuple[int, ...]:
    """Images of clusters that contradict the largest cluster, directly or through another such cluster; ascending.

    Args:
        support: by pair (i < j) of image indices.
        images: indices of all images of the model.

    Returns:
        Empty, too, if the largest cluster has at most half of the images: then it is not known which part is wrong.
    """
    clusters = _cluster({pair: found.weight for pair, found in support.items() if found.weight}, images)
    largest = max(clusters.members, key=lambda cluster: (len(clusters.members[cluster]), -cluster))
    if 2 * len(clusters.members[largest]) <= len(images):
        return ()
    contradicted, waiting = {largest}, [largest]
    while waiting:
        for other, connection in clusters.connections[waiting.pop()].items():
            if connection.weight < 0 and other not in contradicted:
                contradicted.add(other)
                waiting.append(other)
    return tuple(sorted(i for cluster in contradicted - {largest} for i in clusters.members[cluster]))


def consistent_groups(support: Mapping[Pair, EpipolarSupport], images: Collection[int]) -> tuple[tuple[int, ...], ...]:
    """The images in groups that agree with each other, see the module; the largest first.

    Args:
        support, images: as in ``find_misregistered``.
    """
    clusters = _cluster({pair: found.weight for pair, found in support.items() if found.weight}, images)
    groups = [tuple(sorted(members)) for members in clusters.members.values()]
    return tuple(sorted(groups, key=lambda group: (-len(group), group)))


@dataclass(frozen=True, kw_only=True)
class _Connection:
    """Between two clusters: the sum of the weights, and how many pairs support it."""

    weight: int
    num_supporting: int

    def __add__(self, other: _Connection) -> _Connection:
        return _Connection(weight=self.weight + other.weight, num_supporting=self.num_supporting + other.num_supporting)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Clusters:
    members: dict[int, list[int]]
    connections: dict[int, dict[int, _Connection]]


def _cluster(weights: Mapping[Pair, int], images: Collection[int]) -> _Clusters:
    """Merge clusters, the heaviest connection first, while one has a supporting pair and no negative weight."""
    members = {i: [i] for i in sorted(images)}
    connections: dict[int, dict[int, _Connection]] = {i: {} for i in members}
    for (i, j), weight in weights.items():
        connections[i][j] = connections[j][i] = _Connection(weight=weight, num_supporting=int(weight > 0))
    queue = [entry for a in connections for entry in _candidates(connections, a) if entry[1] < entry[2]]
    heapq.heapify(queue)
    while queue:
        negative_weight, a, b = heapq.heappop(queue)
        if a not in connections or b not in connections[a] or connections[a][b].weight != -negative_weight:
            continue  # the cluster has grown since
        members[a] += members.pop(b)
        for other, connection in connections.pop(b).items():
            del connections[other][b]
            if other != a:
                grown = connections[a].get(other, _Connection(weight=0, num_supporting=0)) + connection
                connections[a][other] = connections[other][a] = grown
        for entry in _candidates(connections, a):
            heapq.heappush(queue, entry)
    return _Clusters(members=members, connections=connections)


def _candidates(connections: Mapping[int, Mapping[int, _Connection]], a: int) -> Iterator[tuple[int, int, int]]:
    """Clusters that may be merged with ``a``, as entries of the queue."""
    for b, connection in connections[a].items():
        if connection.num_supporting and connection.weight >= 0:
            yield -connection.weight, min(a, b), max(a, b)
