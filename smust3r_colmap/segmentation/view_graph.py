"""Which images may see the same place: pairs of images, each with a weight and a reason.

A sequence gives the pairs of consecutive images; retrieval, and the user, add others. Segmentation, backbones,
alignment and stitching ask here which images are neighbours, or how far apart they are in order.
The next module to read is ``windows``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

from smust3r_colmap.geometry.arrays import FloatArray, IntArray, Pair, UInt8Array

Reason = Literal["order", "retrieval", "user"]
REASONS: tuple[Reason, ...] = get_args(Reason)

NO_WAY = np.iinfo(np.int64).max
"""Steps between images of different sequences."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ViewGraph:
    """Images, and the pairs of them that may see the same place.

    A pair of reason ``"order"`` is an image and the next one of its sequence. So the pairs of this reason form chains,
    the sequences; an image without such a pair is a sequence by itself.

    Args:
        num_images: of the collection.
        pairs: (E, 2) int64 indices into the collection, ``i < j`` in every row; rows ascend, without repeats.
        weights: (E,) verified matches of the two where they have been matched; else the cosine of their descriptors, or
            1 where order or the user says so.
        reasons: (E,) uint8, positions in ``REASONS``.

    Raises:
        ValueError: an array does not fit, or an image has two predecessors or two successors in order.
    """

    num_images: int
    pairs: IntArray
    weights: FloatArray
    reasons: UInt8Array

    def __post_init__(self) -> None:
        e = len(self.pairs)
        if self.pairs.shape != (e, 2) or self.weights.shape != (e,) or self.reasons.shape != (e,):
            raise ValueError(
                f"ViewGraph: pairs {self.pairs.shape}, weights {self.weights.shape}, reasons {self.reasons.shape}"
            )
        first, second = self.pairs.T
        if e and not 0 <= first.min() <= second.max() < self.num_images:
            raise ValueError(f"ViewGraph: a pair names an image that is not one of {self.num_images}")
        if (first >= second).any() or (np.diff(first * self.num_images + second) <= 0).any():
            raise ValueError("ViewGraph: pairs must be i < j, ascending and without repeats")
        if not np.isfinite(self.weights).all():
            raise ValueError("ViewGraph: a weight is not finite")
        if e and self.reasons.max() >= len(REASONS):
            raise ValueError(f"ViewGraph: a reason is not one of {len(REASONS)}")
        for one in self._in_order.T:
            if len(np.unique(one)) < len(one):
                raise ValueError("ViewGraph: in order an image has at most one predecessor and one successor")

    @classmethod
    def chain(cls, num_images: int) -> ViewGraph:
        """The graph of one sequence: every image and the next."""
        images = np.arange(num_images, dtype=np.int64)
        return cls(
            num_images=num_images,
            pairs=np.column_stack([images[:-1], images[1:]]),
            weights=np.ones(max(num_images - 1, 0)),
            reasons=np.full(max(num_images - 1, 0), REASONS.index("order"), dtype=np.uint8),
        )

    @classmethod
    def without_pairs(cls, num_images: int) -> ViewGraph:
        """The graph of images of which nothing is known."""
        return cls(
            num_images=num_images,
            pairs=np.zeros((0, 2), dtype=np.int64),
            weights=np.zeros(0),
            reasons=np.zeros(0, dtype=np.uint8),
        )

    def with_pairs(
        self, pairs: Sequence[Pair] | IntArray, reason: Reason, *, weights: npt.ArrayLike = 1.0
    ) -> ViewGraph:
        """The graph with further pairs; one that is in it already, or named twice, keeps its first weight and reason.

        Args:
            pairs: of different images, in any order.
            weights: one of each pair, or one for all.

        Raises:
            ValueError: the graph would not be one.
        """
        added = np.sort(np.asarray(pairs, dtype=np.int64).reshape(-1, 2), axis=1)
        together = np.concatenate([self.pairs, added])
        _, kept = np.unique(together[:, 0] * self.num_images + together[:, 1], return_index=True)
        new_weights = np.broadcast_to(np.asarray(weights, dtype=np.float64), len(added))
        new_reasons = np.full(len(added), REASONS.index(reason), dtype=np.uint8)
        return ViewGraph(
            num_images=self.num_images,
            pairs=together[kept],
            weights=np.concatenate([self.weights, new_weights])[kept],
            reasons=np.concatenate([self.reasons, new_reasons])[kept],
        )

    def within(self, images: Sequence[int]) -> ViewGraph:
        """The graph with the pairs between these images only."""
        is_inside = np.zeros(self.num_images, dtype=np.bool_)
        is_inside[list(images)] = True
        kept = is_inside[self.pairs].all(axis=1)
        return replace(self, pairs=self.pairs[kept], weights=self.weights[kept], reasons=self.reasons[kept])

    # --------------------------------------------------------------------------- pairs
    @property
    def tuples(self) -> tuple[Pair, ...]:
        """The pairs, ascending."""
        return tuple((i, j) for i, j in self.pairs.tolist())

    def neighbours(self, image: int) -> IntArray:
        """Images in a pair with this one, for whatever reason, ascending."""
        starts, others = self._adjacency
        return others[starts[image] : starts[image + 1]]

    def are_neighbours(self, i: int, j: int) -> bool:
        """Whether the two are a pair, for whatever reason."""
        others = self.neighbours(i)
        place = np.searchsorted(others, j)
        return bool(place < len(others) and others[place] == j)

    # --------------------------------------------------------------------------- order
    @property
    def is_ordered(self) -> bool:
        """Whether any image has a next one."""
        return bool(len(self._in_order))

    @property
    def sequences(self) -> tuple[IntArray, ...]:
        """The images of every sequence, in order; the sequence of the lowest image first."""
        images, _, first = self._order
        return tuple(np.split(images, np.flatnonzero(np.diff(first[images])) + 1))

    def steps_between(self, i: npt.ArrayLike, j: npt.ArrayLike) -> IntArray:
        """How far apart images are along their sequence, ``NO_WAY`` in different ones; 1 is the next image.

        Args:
            i, j: images, of shapes that broadcast.
        """
        _, rank, first = self._order
        from_, to = np.asarray(i, dtype=np.int64), np.asarray(j, dtype=np.int64)
        return np.where(first[from_] == first[to], np.abs(rank[from_] - rank[to]), NO_WAY)

    def pairs_apart(self, steps: int) -> IntArray:
        """(M, 2) all images and the one ``steps`` (at least 1) later in order."""
        images, _, first = self._order
        pairs = np.column_stack([images[:-steps], images[steps:]])
        of_one_sequence: IntArray = pairs[first[pairs[:, 0]] == first[pairs[:, 1]]]
        return of_one_sequence

    def around(self, image: int, steps: int) -> IntArray:
        """Images at most so many steps before or after this one, in order; it is one of them."""
        images, rank, first = self._order
        near = images[max(rank[image] - steps, 0) : rank[image] + steps + 1]
        of_its_sequence: IntArray = near[first[near] == first[image]]
        return of_its_sequence

    def between(self, i: int, j: int) -> IntArray:
        """Images after ``i`` and before ``j`` in order; none where they are in different sequences."""
        images, rank, first = self._order
        return images[rank[i] + 1 : rank[j]] if first[i] == first[j] else images[:0]

    def runs(self, images: Sequence[int], *, max_steps: int = 1) -> tuple[tuple[int, ...], ...]:
        """Images cut into those that follow each other in order, such as the two sides of a loop segment.

        Args:
            images: distinct.
            max_steps: from one image of a run to the next; 1 cuts wherever one is missing.
        """
        _, rank, _ = self._order
        ordered = np.asarray(images, dtype=np.int64)
        ordered = ordered[np.argsort(rank[ordered])]
        cuts = np.flatnonzero(self.steps_between(ordered[:-1], ordered[1:]) > max_steps) + 1
        return tuple(tuple(run.tolist()) for run in np.split(ordered, cuts))

    # ------------------------------------------------------------------------- look-up
    @property
    def _in_order(self) -> IntArray:
        """(M, 2) the pairs of reason ``"order"``."""
        pairs: IntArray = self.pairs[self.reasons == REASONS.index("order")]
        return pairs

    @cached_property
    def _adjacency(self) -> tuple[IntArray, IntArray]:
        """(N + 1,) where the neighbours of each image start, and (2 E,) the neighbours."""
        # Pairs ascend, so stable sorts suffice: of every image first the lower neighbours, then the higher ones.
        lower = self.pairs[np.argsort(self.pairs[:, 1], kind="stable"), ::-1]
        both = np.concatenate([lower, self.pairs])
        image, other = both[np.argsort(both[:, 0], kind="stable")].T
        return np.searchsorted(image, np.arange(self.num_images + 1)), other

    @cached_property
    def _order(self) -> tuple[IntArray, IntArray, IntArray]:
        """(N,) images, one sequence after another; (N,) place of each image there; (N,) first image of its sequence."""
        first = list(range(self.num_images))
        for before, after in self._in_order.tolist():  # ascending, so `before` has its final value
            first[after] = first[before]
        images = np.argsort(np.array(first, dtype=np.int64), kind="stable")
        rank = np.empty_like(images)
        rank[images] = np.arange(self.num_images)
        return images, rank, np.array(first, dtype=np.int64)
