"""What the verified matches of image pairs say of a model, pair by pair.

A model may have small residuals and still be folded, for its tracks are made of the matches that agree with it. The
matches of two-view verification were found without it. The next module to read is ``measure``.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from scipy.sparse import coo_array
from scipy.sparse.csgraph import reverse_cuthill_mckee

from smust3r_colmap.errors import InputError
from smust3r_colmap.features.guided_verification import MatchedFeatures, View
from smust3r_colmap.geometry.arrays import FloatArray, IntArray, Pair, UInt8Array
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.refinement.misregistration import EpipolarSupport, consistent_groups
from smust3r_colmap.refinement.reregistration import pair_support

NEAR = 5
"""Images that are at most so far apart in a sequence are neighbours: what contradicts there is not a look-alike."""
SEQUENCE_FRACTION, LONG_STEPS, SHORT_STEPS = 0.5, 0.6, 0.1
"""The order of the names is the order of a path if that part of the consecutive images has verified matches, unless
steps between them are so long beside the distance of any two images; and if they are so short, as between the frames of
a video, of which many match keyframes only. Of fewer than ``MIN_ORDERED`` images the steps tell nothing."""
MIN_ORDERED = 8
MIN_GROUP = 3
"""Images of a group that is shown."""
MAX_CELLS = 400
"""Cells of the matrix along a side; of more images several share one."""
MAX_WORST_PAIRS = 10

_STOPS = np.array([0.0, 0.5, 0.85, 1.0])
_COLOURS = np.array([[190, 30, 45], [244, 160, 70], [150, 195, 225], [20, 90, 170]], dtype=np.float64)


@dataclass(frozen=True, kw_only=True)
class Group:
    """Images that agree with each other.

    Args:
        rows: of the images, ascending.
        num_supporting, num_contradicting: pairs with images of larger groups that support or contradict the model.
    """

    rows: tuple[int, ...]
    num_supporting: int
    num_contradicting: int


@dataclass(frozen=True, kw_only=True, eq=False)
class Agreement:
    """Of the N images of a model, by row.

    Args:
        support: by pair of rows (i < j), of pairs with at least eight verified matches.
        groups: of at least ``MIN_GROUP`` images, largest first.
        is_sequence: consecutive images are near, so far apart in order is far apart on the path.
    """

    num_images: int
    support: Mapping[Pair, EpipolarSupport]
    groups: tuple[Group, ...]
    is_sequence: bool

    @classmethod
    def of(cls, support: Mapping[Pair, EpipolarSupport], centres: FloatArray) -> Agreement:
        """Group the images, whose centres are (N, 3)."""
        num_images = len(centres)
        found = [rows for rows in consistent_groups(support, range(num_images)) if len(rows) >= MIN_GROUP]
        matched = sum(j - i == 1 for i, j in support) >= SEQUENCE_FRACTION * max(num_images - 1, 1)
        step = _median_step(centres)
        return cls(
            num_images=num_images,
            support=support,
            groups=tuple(_group(rows, found[:k], support) for k, rows in enumerate(found)),
            is_sequence=matched if step is None else step < SHORT_STEPS or (matched and step <= LONG_STEPS),
        )

    @property
    def is_split(self) -> bool:
        """Groups contradict each other."""
        return any(group.num_contradicting > group.num_supporting for group in self.groups)

    def counts(self, *, near: bool) -> tuple[int, int]:
        """Pairs of neighbours in the sequence, or of all others: how many contradict the model, and how many there are.

        In images without an order all pairs are others.
        """
        chosen = [one for (i, j), one in self.support.items() if (self.is_sequence and j - i <= NEAR) == near]
        return sum(one.weight < 0 for one in chosen), len(chosen)

    def worst_pairs(self) -> list[tuple[Pair, EpipolarSupport]]:
        """Those with the most matches that do not agree; of one pair of places one, where the images are a sequence."""
        against = sorted(
            (-round(one.num_matches * (1 - one.inlier_fraction)), pair)
            for pair, one in self.support.items()
            if one.weight < 0
        )
        place = 2 * NEAR if self.is_sequence else 1
        of_places: dict[Pair, Pair] = {}
        for _, (i, j) in against:
            of_places.setdefault((i // place, j // place), (i, j))
        return [(pair, self.support[pair]) for pair in list(of_places.values())[:MAX_WORST_PAIRS]]

    def display_order(self) -> IntArray:
        """(N,) rows in the order of the matrix: that of a sequence; else by group, with those near that match."""
        if self.is_sequence:
            return np.arange(self.num_images)
        grouped = [row for group in self.groups for row in self._near_each_other(group.rows)]
        rest = sorted(set(range(self.num_images)) - set(grouped))
        return np.array([*grouped, *rest], dtype=np.int64)

    def _near_each_other(self, rows: tuple[int, ...]) -> list[int]:
        place = {row: k for k, row in enumerate(rows)}
        pairs = [(place[i], place[j]) for i, j in self.support if i in place and j in place]
        a, b = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
        graph = coo_array((np.ones(len(a)), (a, b)), shape=(len(rows), len(rows)))
        order = reverse_cuthill_mckee((graph + graph.T).tocsr(), symmetric_mode=True)
        return [rows[k] for k in order.tolist()]

    def matrix(self) -> FloatArray:
        """(S, S) fraction of the verified matches that agree, NaN without any; symmetric, see ``MAX_CELLS``."""
        size = min(self.num_images, MAX_CELLS)
        place = np.empty(self.num_images, dtype=np.int64)
        place[self.display_order()] = np.arange(self.num_images) * size // max(self.num_images, 1)
        agreeing, total = np.zeros((size, size)), np.zeros((size, size))
        for (i, j), one in self.support.items():
            for cell in {(place[i], place[j]), (place[j], place[i])}:
                agreeing[cell] += one.num_matches * one.inlier_fraction
                total[cell] += one.num_matches
        with np.errstate(invalid="ignore"):
            fractions: FloatArray = agreeing / total
        return fractions


def _median_step(centres: FloatArray) -> float | None:
    """Between consecutive images, beside the distance of any two; None where it tells nothing."""
    if len(centres) < MIN_ORDERED:
        return None
    steps = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    others = np.random.default_rng(0).permutation(len(centres))
    between = float(np.median(np.linalg.norm(centres - centres[others], axis=1)[others != np.arange(len(centres))]))
    return float(np.median(steps)) / between if between > 0 else None


def _group(rows: Sequence[int], larger: Sequence[Sequence[int]], support: Mapping[Pair, EpipolarSupport]) -> Group:
    own, others = set(rows), {row for one in larger for row in one}
    across = [one.weight for (i, j), one in support.items() if (i in own and j in others) or (j in own and i in others)]
    return Group(
        rows=tuple(rows),
        num_supporting=sum(weight > 0 for weight in across),
        num_contradicting=sum(weight < 0 for weight in across),
    )


def agreement_of(model: pycolmap.Reconstruction, features: MatchedFeatures) -> Agreement:
    """Of a model and the verified matches of its images; rows are the registered images in the order of their ids.

    Args:
        model: with cameras of every kind that COLMAP has.
        features: by image id - 1, see ``read_verified``.
    """
    image_ids = sorted(model.reg_image_ids())
    views = {
        i - 1: View(
            cam_from_world=model.image(i).cam_from_world().matrix(),
            intrinsics=Intrinsics.from_colmap(model.camera(model.image(i).camera_id)),
        )
        for i in image_ids
        if i - 1 in features.keypoints
    }
    row_of = {image_id - 1: row for row, image_id in enumerate(image_ids)}
    found = pair_support(features, views)
    support = {tuple(sorted((row_of[i], row_of[j]))): one for (i, j), one in found.items()}
    centres = np.array([model.image(i).projection_center() for i in image_ids]).reshape(-1, 3)
    return Agreement.of(dict(sorted(support.items())), centres)  # type: ignore[arg-type]  # pairs have two rows


def read_verified(database: Path, model: pycolmap.Reconstruction) -> MatchedFeatures:
    """Keypoints and verified matches of the images of a model; the database is not written to, not even its header.

    Images are those of the same name; in a database that knows none of the names, those of the same id.

    Raises:
        InputError: the file is no COLMAP database.
    """
    ids_by_name = {model.image(i).name: i for i in model.reg_image_ids()}
    try:
        # Merely read-only, SQLite would still leave its two helper files beside a database in WAL mode.
        uri = f"{database.absolute().as_uri()}?immutable=1"
        with closing(sqlite3.connect(uri, uri=True)) as connection:
            named = connection.execute("SELECT image_id, name FROM images").fetchall()
            to_model = {i: ids_by_name[name] for i, name in named if name in ids_by_name}
            to_model = to_model or {i: i for i, _ in named if i in ids_by_name.values()}
            keypoints = {
                to_model[i] - 1: np.frombuffer(data, np.float32).reshape(rows, columns)[:, :2]
                for i, rows, columns, data in connection.execute("SELECT image_id, rows, cols, data FROM keypoints")
                if i in to_model and rows
            }
            verified = {}
            for pair_id, rows, data in connection.execute("SELECT pair_id, rows, data FROM two_view_geometries"):
                a, b = pycolmap.pair_id_to_image_pair(pair_id)
                if rows and a in to_model and b in to_model:
                    matches = np.frombuffer(data, np.uint32).reshape(rows, 2)
                    i, j = to_model[a] - 1, to_model[b] - 1
                    verified[min(i, j), max(i, j)] = matches if i < j else matches[:, ::-1]
    except (sqlite3.Error, ValueError) as error:
        raise InputError(f"{database}: is no COLMAP database, or a damaged one ({error})") from error
    there = {pair: rows for pair, rows in verified.items() if pair[0] in keypoints and pair[1] in keypoints}
    return MatchedFeatures(keypoints=keypoints, raw={}, verified=there)


def count_matches(database: Path) -> dict[int, tuple[int, int, int]]:
    """Features, verified matches and images that they are with, by image id; see ``read_verified`` for the database.

    Raises:
        InputError: the file is no COLMAP database.
    """
    try:
        with closing(sqlite3.connect(f"{database.absolute().as_uri()}?immutable=1", uri=True)) as connection:
            keypoints = dict(connection.execute("SELECT image_id, rows FROM keypoints"))
            pairs = connection.execute("SELECT pair_id, rows FROM two_view_geometries WHERE rows > 0").fetchall()
    except sqlite3.Error as error:
        raise InputError(f"{database}: is no COLMAP database, or a damaged one ({error})") from error
    found = {image_id: (rows, 0, 0) for image_id, rows in keypoints.items()}
    for pair_id, rows in pairs:
        for image_id in pycolmap.pair_id_to_image_pair(pair_id):
            num_features, num_matches, num_images = found.get(image_id, (0, 0, 0))
            found[image_id] = (num_features, num_matches + rows, num_images + 1)
    return found


def coloured(fractions: FloatArray) -> UInt8Array:
    """(..., 4) RGBA: red where nothing agrees, blue where all does, transparent where there is nothing."""
    known = np.isfinite(fractions)
    filled = np.where(known, fractions, 0.0)
    rgba = np.empty((*fractions.shape, 4), np.uint8)
    for channel in range(3):
        rgba[..., channel] = np.round(np.interp(filled, _STOPS, _COLOURS[:, channel]))
    rgba[..., 3] = np.where(known, 255, 0)
    return rgba
