"""Image pairs to be matched, chosen without a model.

The next module to read is ``sift``.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Collection, Sequence
from itertools import combinations

import numpy as np
import numpy.typing as npt

from smust3r_colmap.geometry.arrays import FloatArray, Pair
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.products import Segment

MAX_TURN_DEG = 60.0
"""Between the viewing directions of two cameras; beyond, their images rarely overlap."""
_BLOCK = 1_024
"""Images compared with all others at once."""


def plan_pairs(segment: Segment, *, neighbours: int, exhaustive_below: int) -> tuple[Pair, ...]:
    """Pairs (i < j) of a window: all of a small one, else neighbours and doubling steps.

    Only inside the segment, because more distant pairs find look-alike places and fold the model.
    """
    images = sorted(segment.images)
    if len(images) <= exhaustive_below:
        return near_pairs(images, len(images) - 1)
    return near_pairs(images, neighbours)


def plan_loop_pairs(
    runs: Sequence[Sequence[int]], descriptors: npt.NDArray[np.float32], *, neighbours: int
) -> tuple[Pair, ...]:
    """Pairs (i < j) of a loop segment: each end like a window, and across the most similar.

    Across, each image is paired with the ``neighbours`` images of the other end with the most similar descriptors:
    half of all pairs, and nine tenths of the verified matches (six loops of two walks).

    Args:
        runs: the images of either end, in order. descriptors: (N, D) unit vectors of all images of the collection.
    """
    pairs = [pair for run in runs for pair in near_pairs(run, neighbours)]
    for first, second in combinations(runs, 2):
        similarity = descriptors[list(first)] @ descriptors[list(second)].T
        wanted = np.zeros(similarity.shape, dtype=bool)
        for axis in (0, 1):
            most_alike = np.argsort(-similarity, axis=axis, kind="stable")
            few = range(min(neighbours, similarity.shape[axis]))
            np.put_along_axis(wanted, np.take(most_alike, few, axis=axis), values=True, axis=axis)
        pairs += [(first[a], second[b]) for a, b in np.argwhere(wanted)]
    return tuple(pairs)


def near_pairs(images: Sequence[int], neighbours: int) -> tuple[Pair, ...]:
    """Pairs of a sequence: each image with its next ``neighbours`` and the images at doubling steps."""
    n = len(images)
    doubling = [2**k for k in range(1, n.bit_length()) if neighbours < 2**k < n]
    offsets = [*range(1, min(neighbours + 1, n)), *doubling]
    return tuple((images[a], images[a + offset]) for offset in offsets for a in range(n - offset))


def alike_pairs(
    descriptors: npt.NDArray[np.float32], num_posed: int, *, per_image: int, exhaustive_below: int
) -> tuple[Pair, ...]:
    """Pairs (i < j) of each image without a pose with the most similar ones; of few images, all.

    Memory grows with the number of images, not with its square.

    Args:
        descriptors: (N, D) unit vectors; zero rows are in no pair. num_posed: images from this one on have no pose.
        per_image: most similar others of each, with and without a pose.
        exhaustive_below: up to so many images every pair is taken.
    """
    n = len(descriptors)
    wanted = n - 1 if n <= exhaustive_below else min(per_image, n - 1)
    described: npt.NDArray[np.bool_] = np.any(descriptors, axis=1)
    pairs: set[Pair] = set()
    for start in range(num_posed, n, _BLOCK):
        rows = np.arange(start, min(start + _BLOCK, n))
        similarity = descriptors[rows] @ descriptors.T
        similarity[:, ~described] = -np.inf
        similarity[rows - start, rows] = -np.inf
        most_alike = np.argsort(-similarity, axis=1, kind="stable")[:, :wanted]
        for i, others in zip(rows[described[rows]].tolist(), most_alike[described[rows]].tolist(), strict=True):
            pairs |= {(min(i, j), max(i, j)) for j in others if described[j] and i != j}
    return tuple(sorted(pairs))


def further_pairs(verified: Collection[Pair], tried: Collection[Pair], *, per_image: int) -> tuple[Pair, ...]:
    """Pairs (i < j) that have not been tried, of images that match the same others: what retrieval missed.

    Args:
        verified: pairs with enough verified matches. tried: all pairs that have been matched.
        per_image: pairs chosen for an image, those with most common partners first; at least two are needed.
    """
    partners: dict[int, set[int]] = defaultdict(set)
    for i, j in verified:
        partners[i].add(j)
        partners[j].add(i)
    known = set(tried)
    found: set[Pair] = set()
    for i in sorted(partners):
        common = Counter(j for k in partners[i] for j in partners[k] if j != i)
        new = [(j, count) for j, count in common.items() if count > 1 and (min(i, j), max(i, j)) not in known]
        new.sort(key=lambda row: (-row[1], row[0]))
        found |= {(min(i, j), max(i, j)) for j, _ in new[:per_image]}
    return tuple(sorted(found))


def neighbouring_pairs(cam_from_world: FloatArray, *, per_image: int, exhaustive_below: int) -> tuple[Pair, ...]:
    """Pairs (i < j) of cameras with nearby centres and similar viewing directions; of few images, all.

    Args:
        cam_from_world: (N, 3, 4).
        per_image: nearest others of each that differ by less than ``MAX_TURN_DEG``.
        exhaustive_below: up to so many images every pair is taken.
    """
    n = len(cam_from_world)
    if n <= exhaustive_below:
        return tuple((i, j) for i in range(n) for j in range(i + 1, n))
    centres, forward = invert_rigid(cam_from_world)[:, :, 3], cam_from_world[:, 2, :3]
    pairs: set[Pair] = set()
    for i in range(n):
        distance = np.linalg.norm(centres - centres[i], axis=1)
        distance[forward @ forward[i] < np.cos(np.deg2rad(MAX_TURN_DEG))] = np.inf
        distance[i] = np.inf
        nearest = np.argsort(distance, kind="stable")[:per_image]
        pairs |= {(min(i, j), max(i, j)) for j in nearest[np.isfinite(distance[nearest])].tolist()}
    return tuple(sorted(pairs))
