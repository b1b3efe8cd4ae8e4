"""Which images look alike although they are far apart in the sequence (paper section III-F).

Descriptors are unit vectors, one per image; their cosine is the similarity. The next module to read
is ``loop_segments``, which plans loops from these pairs.

Sequence matching. A place that was visited twice was seen by several images both times, so images
are compared together with their neighbours: every descriptor is replaced by the mean of those around
it, with weights falling to both sides. The cosine of two such means sums the similarities of all pairs
of neighbours, in either direction of time, and at any two speeds. Measured with VLAD of SIFT, area
under the curve, single images against 3 neighbours on each side; pairs at least 48 images apart,
true within a tenth of the extent and 40 degrees, false beyond a quarter or 75 degrees:

    ============  ======  ========  ===============
    walk          single  together  AP, both
    ============  ======  ========  ===============
    office         0.871     0.949   0.38 -> 0.63
    courthouse     0.923     0.970   0.59 -> 0.77
    kitchen        0.851     0.953   0.21 -> 0.59
    ============  ======  ========  ===============

Subtracting the mean and signed square roots changed these by less than 0.01; whitening and dividing
by each image's own scatter made them worse.

No KD-tree. The paper keeps descriptors in one. With 128 dimensions or more it prunes nothing: 4,000
images took 1.2 s whether the radius admitted 10,000 pairs or 3 million, and its list of pairs grows
without bound when the camera stands still. Products of blocks find the same pairs (a test compares)
in a tenth of the time, in any number of dimensions without projecting, and in flat memory, because
each block is reduced at once to its best pair and a count.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from smust3r_colmap.errors import InputError
from smust3r_colmap.estimators.robust import mad_sigma
from smust3r_colmap.geometry.arrays import IntArray
from smust3r_colmap.segmentation.view_graph import ViewGraph

Descriptors = npt.NDArray[np.float32]

# Far enough for the view to have changed on a walk; a third where the collection is small.
_FAR_APART = 48
# Statistics take at most this many images, evenly spread: a million pairs fix a median to 0.1 %.
_SAMPLED_IMAGES = 1_500
# Descriptors are float32; a scatter below this is rounding.
_MIN_SIGMA = 1e-4
_UNIT_TOLERANCE = 1e-3
# Equal pairs come out of a product of float32 matrices equal to this; the order then decides, not the machine.
_DECIMALS = 6


@dataclass(frozen=True, kw_only=True)
class SimilarityStatistics:
    """Cosines of images in a collection.

    Args:
        far_median: of pairs far apart in order.
        far_sigma: their robust standard deviation, 1.4826 times the median deviation from the median.
        neighbour_median: of images next to each other.
    """

    far_median: float
    far_sigma: float
    neighbour_median: float

    @property
    def contrast(self) -> float:
        """How much more alike neighbours are than far images, in ``far_sigma``."""
        return (self.neighbour_median - self.far_median) / self.far_sigma


@dataclass(frozen=True, kw_only=True)
class AlikeSegments:
    """Two segments with images that look alike.

    Args:
        segment_a, segment_b: rows of the segment list, ``segment_a < segment_b``.
        image_a, image_b: the most similar images, ``image_a`` at home in ``segment_a``.
        similarity: their cosine.
        num_pairs: pairs of images at home in the two segments that are as similar as was asked for.
    """

    segment_a: int
    segment_b: int
    image_a: int
    image_b: int
    similarity: float
    num_pairs: int


def check_descriptors(descriptors: npt.NDArray[np.float32], num_images: int) -> None:
    """Refuse descriptors that would make every similarity meaningless.

    Raises:
        InputError: not (num_images, D), a value that is not finite, or a row neither zero nor of unit length.
    """
    if descriptors.ndim != 2 or len(descriptors) != num_images:
        raise InputError(f"descriptors are {descriptors.shape}, needed one row for each of {num_images} images")
    length = np.linalg.norm(descriptors, axis=1)
    broken = np.flatnonzero(~np.isfinite(length))
    if len(broken):
        raise InputError(f"image {broken[0]}: its descriptor is not finite ({len(broken)} such images)")
    uneven = np.flatnonzero((length > 0) & (np.abs(length - 1) > _UNIT_TOLERANCE))
    if len(uneven):
        image = uneven[0]
        raise InputError(f"image {image}: its descriptor has length {length[image]:.4g}, needed 1 (or 0 for none)")


def similarity_statistics(descriptors: Descriptors, graph: ViewGraph) -> SimilarityStatistics | None:
    """Cosines of far and of neighbouring images; None where fewer than two images or no far pair have one.

    Args:
        descriptors: (N, D) unit rows; zero rows are left out.
        graph: the order of the N images.
    """
    neighbours = _cosines_apart(descriptors, graph, 1)
    images = np.flatnonzero(descriptors.any(axis=1))
    images = images[np.linspace(0, len(images) - 1, min(len(images), _SAMPLED_IMAGES)).astype(int)]
    is_far = graph.steps_between(images[:, None], images[None, :]) >= far_apart(len(descriptors))
    far = (descriptors[images] @ descriptors[images].T)[np.triu(is_far)]
    if not len(far) or not len(neighbours):
        return None
    median = float(np.median(far))
    return SimilarityStatistics(
        far_median=median,
        far_sigma=max(mad_sigma(far), _MIN_SIGMA),
        neighbour_median=float(np.median(neighbours)),
    )


def far_apart(num_images: int) -> int:
    """From how many steps in order on two images count as far apart."""
    return max(1, min(_FAR_APART, num_images // 3))


def neighbours_alike(
    descriptors: Descriptors, graph: ViewGraph, statistics: SimilarityStatistics, *, at_most: int
) -> int:
    """How many images to each side show much of the same view.

    Up to there the excess over far images is at least half of that of adjacent images; 3 on the walks
    at two images a second, more in a video.

    Args:
        descriptors: (N, D) unit rows; zero rows are left out.
        graph: the order of the N images.
        statistics: of these descriptors.
        at_most: upper bound of the answer.
    """
    half = (statistics.neighbour_median + statistics.far_median) / 2
    for step in range(1, min(at_most + 1, len(descriptors))):
        cosines = _cosines_apart(descriptors, graph, step)
        if not len(cosines) or np.median(cosines) < half:
            return step - 1
    return at_most


def _cosines_apart(descriptors: Descriptors, graph: ViewGraph, steps: int) -> Descriptors:
    """Cosines of all pairs of described images so many steps apart in order."""
    pairs = graph.pairs_apart(steps)
    described: npt.NDArray[np.bool_] = np.any(descriptors, axis=1)
    first, second = pairs[described[pairs].all(axis=1)].T
    cosines: Descriptors = np.einsum("nd,nd->n", descriptors[first], descriptors[second])
    return cosines


def with_neighbours(descriptors: Descriptors, graph: ViewGraph, reach: int) -> Descriptors:
    """(N, D) unit means of each descriptor and its neighbours in order.

    Args:
        descriptors: (N, D) unit rows; zero rows stay zero.
        graph: the order of the N images.
        reach: images to each side; weights fall linearly to zero just beyond. 0 changes nothing.
    """
    total = (reach + 1) * descriptors
    for step in range(1, min(reach + 1, len(descriptors))):
        weight = reach + 1 - step
        first, second = graph.pairs_apart(step).T
        total[second] += weight * descriptors[first]
        total[first] += weight * descriptors[second]
    total[~descriptors.any(axis=1)] = 0
    unit: Descriptors = total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-9)
    return unit


def home_segments(windows: Sequence[Sequence[int]], num_images: int) -> IntArray:
    """(num_images,) the window of each image in which it lies most central, -1 where it is in none.

    Most central is farthest from the nearer end; of equals, the earlier window.

    Args:
        windows: image indices of each window, in order.
    """
    home = np.full(num_images, -1, dtype=np.int64)
    depth = np.full(num_images, -1, dtype=np.int64)
    for row, images in enumerate(windows):
        own = np.asarray(images, dtype=np.int64)
        inside = np.minimum(np.arange(len(own)), np.arange(len(own))[::-1])
        deeper = inside > depth[own]
        home[own[deeper]] = row
        depth[own[deeper]] = inside[deeper]
    return home


def alike_segments(descriptors: Descriptors, home: IntArray, *, at_least: float) -> list[AlikeSegments]:
    """Every two segments with a pair of images that is similar enough, each with its best pair.

    Of equal pairs the one with the lower ``image_a`` is the best, then the one with the lower ``image_b``.

    Args:
        descriptors: (N, D) unit rows; images with zero rows take no part.
        home: (N,) segment of each image, -1 for none.
        at_least: cosine from which a pair of images counts.
    """
    takes_part = (home >= 0) & descriptors.any(axis=1)
    images = np.flatnonzero(takes_part)
    images = images[np.argsort(home[images], kind="stable")]  # grouped by home, ascending within
    segments, starts = np.unique(home[images], return_index=True)
    groups = np.split(images, starts[1:])
    found: list[AlikeSegments] = []
    for row, own in enumerate(groups[:-1]):
        cosines = descriptors[own] @ descriptors[images[starts[row + 1] :]].T
        columns = starts[row + 1 :] - starts[row + 1]  # where every later segment begins
        num_pairs = np.add.reduceat((cosines >= at_least).sum(axis=0), columns)
        for k in np.flatnonzero(num_pairs):
            others = groups[row + 1 + k]
            block = cosines[:, columns[k] : columns[k] + len(others)].round(_DECIMALS)
            a, b = divmod(int(block.argmax()), len(others))
            found.append(
                AlikeSegments(
                    segment_a=int(segments[row]),
                    segment_b=int(segments[row + 1 + k]),
                    image_a=int(own[a]),
                    image_b=int(others[b]),
                    similarity=round(float(block[a, b]), _DECIMALS),
                    num_pairs=int(num_pairs[k]),
                )
            )
    return found
