"""Fewer matches for the mapper of a segment, where there are more than it needs.

A segment is a draft: its poses are adjusted again in the whole scene, on all matches. What its mapping
costs is proportional to its observations, so of each image the features that most other images see are
kept, and every match of the pairs that have few.
The next module to read is ``mapping``.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from smust3r_colmap.geometry.arrays import Pair

Matches = npt.NDArray[np.uint32]

ENOUGH_FEATURES = 600
"""Features of an image that take part in the mapping of its segment, unless a weak pair needs more ..."""
ENOUGH_IN_SEGMENT = 24_000
"""... or the segment is so short that all its images together have no more than this."""
WEAK_PAIR_MATCHES = 150
"""Pairs with fewer verified matches keep them all: they are what holds a segment together."""


def thin_matches(matches: Mapping[Pair, Matches], num_features: Mapping[int, int]) -> dict[Pair, Matches]:
    """The matches whose two features are kept; pairs without any are left out.

    A feature is kept if it is among so many of its image that are matched in most pairs, or is matched in
    a weak pair. Features of one track are matched about equally often, so tracks are kept
    or dropped as a whole, mostly.

    Args:
        matches: (M, 2) feature numbers by pair of images. num_features: by image.
    """
    pairs_of_feature = {image: np.zeros(number, dtype=np.int64) for image, number in num_features.items()}
    needed = {image: np.zeros(number, dtype=bool) for image, number in num_features.items()}
    matches = {pair: rows for pair, rows in matches.items() if len(rows)}
    for pair, rows in matches.items():
        for side, image in enumerate(pair):
            pairs_of_feature[image][rows[:, side]] += 1
            if len(rows) < WEAK_PAIR_MATCHES:
                needed[image][rows[:, side]] = True
    enough = max(ENOUGH_FEATURES, ENOUGH_IN_SEGMENT // max(len(num_features), 1))
    kept = {image: needed[image] | _is_among_most(counts, enough) for image, counts in pairs_of_feature.items()}
    thinned = {}
    for (first, second), rows in matches.items():
        stays = kept[first][rows[:, 0]] & kept[second][rows[:, 1]]
        if stays.any():
            thinned[first, second] = rows[stays]
    return thinned


def _is_among_most(counts: npt.NDArray[np.int64], number: int) -> npt.NDArray[np.bool_]:
    """(F,) True for the ``number`` largest counts; of equals the first."""
    among = np.zeros(len(counts), dtype=bool)
    among[np.argsort(-counts, kind="stable")[:number]] = True
    return among
