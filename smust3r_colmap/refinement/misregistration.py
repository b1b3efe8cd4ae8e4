"""Which images the model holds in a wrong place: what verified matches say of its pairs, and who is tied to whom.

In a sound model nearly all verified matches of near images lie on their epipolar lines; over a bend a good part
does not. But one pair proves little: look-alike places match where nothing is wrong, and an epipolar line or two runs
right over any bend. So pairs vote, groups of images grow together where more votes are for it than against, and
a group that the largest one contradicts is bent. The next module to read is ``replacement``.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass

from smust3r_colmap.geometry.arrays import Pair

STRONG_MATCHES = 30
"""Verified matches of a pair that may speak against the model; COLMAP's own bar for registration."""
SOUND_SHARE, DENYING_SHARE = 0.85, 0.7
"""Of a pair's verified matches, on their epipolar lines. Sound models of nine collections are tied together by pairs
above 0.85; verification errs on repeating facades, whose pairs come down to 0.75 where nothing is wrong."""


@dataclass(frozen=True, kw_only=True)
class Agreement:
    """What the verified matches of one pair say of the model.

    Args:
        num_matches: how many there are.
        share: the part that lies on its epipolar lines.
    """

    num_matches: int
    share: float

    @property
    def vote(self) -> int:
        """Above 0 for the model, below against it; 0 from a pair that is undecided, or has too few matches to deny it.

        A pair's word counts as the root of its matches: those of a repeating facade, seen from far apart, are few.
        """
        word = math.isqrt(self.num_matches)
        if self.share >= SOUND_SHARE:
            return word
        return -word if self.share < DENYING_SHARE and self.num_matches >= STRONG_MATCHES else 0


def bent_images(agreements: Mapping[Pair, Agreement], images: Collection[int]) -> tuple[int, ...]:
    """Images of the groups that the bulk contradicts, and of those that hang on such a group; ascending.

    Args:
        agreements: by pair (i < j) of image indices.
        images: indices of all images of the model.

    Returns:
        Empty, too, where no bulk of more than half of the images is tied together: then nothing can be told.
    """
    groups = _groups({pair: found.vote for pair, found in agreements.items() if found.vote}, images)
    bulk = max(groups.members, key=lambda group: (len(groups.members[group]), -group))
    if 2 * len(groups.members[bulk]) <= len(images):
        return ()
    contradicted, waiting = {bulk}, [bulk]
    while waiting:
        for other, link in groups.links[waiting.pop()].items():
            if link.net < 0 and other not in contradicted:
                contradicted.add(other)
                waiting.append(other)
    return tuple(sorted(i for group in contradicted - {bulk} for i in groups.members[group]))


@dataclass(frozen=True, kw_only=True)
class _Link:
    """Between two groups: votes for less votes against, and how many there are for."""

    net: int
    ties: int

    def __add__(self, other: _Link) -> _Link:
        return _Link(net=self.net + other.net, ties=self.ties + other.ties)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Groups:
    members: dict[int, list[int]]
    links: dict[int, dict[int, _Link]]


def _groups(votes: Mapping[Pair, int], images: Collection[int]) -> _Groups:
    """Images that grow together, the best tied first, as long as some pair ties them and not more pairs deny it."""
    members = {i: [i] for i in sorted(images)}
    links: dict[int, dict[int, _Link]] = {i: {} for i in members}
    for (i, j), vote in votes.items():
        links[i][j] = links[j][i] = _Link(net=vote, ties=int(vote > 0))
    queue = [entry for a in links for entry in _candidates(links, a) if entry[1] < entry[2]]
    heapq.heapify(queue)
    while queue:
        against, a, b = heapq.heappop(queue)
        if a not in links or b not in links[a] or links[a][b].net != -against:
            continue  # of groups that have grown since
        members[a] += members.pop(b)
        for other, link in links.pop(b).items():
            del links[other][b]
            if other != a:
                grown = links[a].get(other, _Link(net=0, ties=0)) + link
                links[a][other] = links[other][a] = grown
        for entry in _candidates(links, a):
            heapq.heappush(queue, entry)
    return _Groups(members=members, links=links)


def _candidates(links: Mapping[int, Mapping[int, _Link]], a: int) -> Iterator[tuple[int, int, int]]:
    """What may grow together with group ``a``, as the queue holds it."""
    for b, link in links[a].items():
        if link.ties and link.net >= 0:
            yield -link.net, min(a, b), max(a, b)
