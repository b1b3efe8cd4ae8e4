"""Which pose of the estimate belongs to which pose of the reference: by image name, frame number or time.

The next module to read is ``absolute_error``.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath

import numpy as np

from smust3r_colmap.config import AssociationKey
from smust3r_colmap.errors import InputError
from smust3r_colmap.geometry.arrays import FloatArray, IntArray
from smust3r_colmap.importers.pose_set import PoseSet

_NANOSECONDS = re.compile(r"\d{16,19}")
_SECONDS = re.compile(r"\d+\.\d+")


@dataclass(frozen=True, kw_only=True, eq=False)
class Association:
    """Rows of the estimate and of the reference that are of the same image, each row once.

    Args:
        estimate, reference: (K,) rows, in the order of the reference.
        how: for people, such as ``image name`` or ``time within 0.01 s``.
        by_name: both are images, so that an image of the reference without a pose is one that the estimate lacks.
    """

    estimate: IntArray
    reference: IntArray
    how: str
    by_name: bool

    def __len__(self) -> int:
        return len(self.estimate)


def associate(
    estimate: PoseSet,
    reference: PoseSet,
    how: AssociationKey = "auto",
    *,
    max_difference_s: float = 0.01,
    offset_s: float = 0.0,
) -> Association:
    """Match the poses one to one; ``auto`` takes the first of name, frame number and time that both have.

    Names are compared as they are; if none are equal, without folder and suffix, where that leaves them different. Of
    two poses that are nearest in time to the same other one, the nearer has it. Times of images come from the other
    side's list of images, or from names that are times.

    Args:
        max_difference_s: between two times. offset_s: is added to the times of the estimate.

    Raises:
        InputError: the two have no key in common, or no key is equal; the message has one of each side.
    """
    keys = {"name": _by_name, "number": _by_number}
    for key, equal in keys.items():
        found = equal(estimate, reference) if how in ("auto", key) else None
        if found is not None and len(found):
            return found
    if how in ("auto", "time"):
        return _by_time(estimate, reference, how, max_difference_s, offset_s)
    raise InputError(_nothing_common(estimate, reference, f"no {how} is the same"))


def _nothing_common(estimate: PoseSet, reference: PoseSet, what: str) -> str:
    return f"{what}: {_example(estimate)}; {_example(reference)}"


def _example(poses: PoseSet) -> str:
    keys = [f"first image {poses.names[0]}"] if poses.names else []
    keys += [f"first frame {poses.numbers[0]}"] if poses.numbers is not None else []
    if poses.stamps_s is not None:
        keys.append(f"times {poses.stamps_s.min():.3f} to {poses.stamps_s.max():.3f} s")
    return f"{poses.place} ({poses.layout}, {len(poses)} poses) has {', '.join(keys)}"


# ----------------------------------------------------------------------------- names
def _by_name(estimate: PoseSet, reference: PoseSet) -> Association | None:
    if not (estimate.names and reference.names):
        return None
    return match_names(estimate.names, reference.names)


def match_names(names_est: Sequence[str], names_ref: Sequence[str]) -> Association:
    """Rows of equal names; where there are none, of names that are equal and unique without folder and suffix."""
    exact = _equal(names_est, names_ref, "image name")
    stems_est, stems_ref = _unique_stems(names_est), _unique_stems(names_ref)
    if len(exact) or stems_est is None or stems_ref is None:
        return exact
    return _equal(stems_est, stems_ref, "image name without folder and suffix")


def _unique_stems(names: Sequence[str]) -> tuple[str, ...] | None:
    stems = tuple(PurePosixPath(name).stem for name in names)
    return stems if max(Counter(stems).values(), default=1) == 1 else None


def _by_number(estimate: PoseSet, reference: PoseSet) -> Association | None:
    if estimate.numbers is None or reference.numbers is None:
        return None
    return _equal(estimate.numbers.tolist(), reference.numbers.tolist(), "frame number")


def _equal(estimated: Sequence[object], reference: Sequence[object], how: str) -> Association:
    row_of = {key: row for row, key in enumerate(estimated)}
    pairs = [(row_of[key], row) for row, key in enumerate(reference) if key in row_of]
    rows = np.array(pairs, dtype=np.int64).reshape(-1, 2)
    return Association(estimate=rows[:, 0], reference=rows[:, 1], how=how, by_name=True)


# ------------------------------------------------------------------------------ times
def _by_time(
    estimate: PoseSet, reference: PoseSet, how: AssociationKey, max_difference_s: float, offset_s: float
) -> Association:
    if how == "auto" and (estimate.numbers is None) != (reference.numbers is None):
        numbered = next(one for one in (estimate, reference) if one.numbers is not None)
        if numbered.stamps_s is not None and not numbered.names:
            raise InputError(
                _nothing_common(estimate, reference, f"{numbered.place}: its times are numbers of frames")
                + "; give a source with times or image names, or associate by time if these are seconds"
            )
    rows_est, stamps_est = _stamps(estimate, reference.image_stamps)
    rows_ref, stamps_ref = _stamps(reference, estimate.image_stamps)
    if not (len(stamps_est) and len(stamps_ref)):
        raise InputError(_nothing_common(estimate, reference, "no image name, frame number or time is in both"))
    k_est, k_ref = nearest_in_time(stamps_est + offset_s, stamps_ref, max_difference_s)
    if not len(k_est):
        raise InputError(_nothing_common(estimate, reference, f"no two times are within {max_difference_s:g} s"))
    return Association(
        estimate=rows_est[k_est],
        reference=rows_ref[k_ref],
        how=f"time within {max_difference_s:g} s" + (f", offset {offset_s:g} s" if offset_s else ""),
        by_name=False,
    )


def _stamps(poses: PoseSet, listed: Mapping[str, float]) -> tuple[IntArray, FloatArray]:
    """Rows that have a time, and their times in seconds."""
    if poses.stamps_s is not None:
        return np.arange(len(poses)), poses.stamps_s
    by_name = {**{PurePosixPath(name).name: stamp_s for name, stamp_s in listed.items()}, **listed}
    by_name.update(poses.image_stamps)
    found = [
        (row, stamp_s)
        for row, name in enumerate(poses.names)
        if (stamp_s := by_name.get(name, by_name.get(PurePosixPath(name).name, _time_in(name)))) is not None
    ]
    return np.array([row for row, _ in found], dtype=np.int64), np.array([stamp_s for _, stamp_s in found])


def _time_in(name: str) -> float | None:
    """The time that a name is, in seconds with a fraction or in nanoseconds, as in TUM RGB-D and EuRoC."""
    stem = PurePosixPath(name).stem
    if _NANOSECONDS.fullmatch(stem):
        return int(stem) * 1e-9
    return float(stem) if _SECONDS.fullmatch(stem) else None


def nearest_in_time(stamps_a: FloatArray, stamps_b: FloatArray, max_difference_s: float) -> tuple[IntArray, IntArray]:
    """Rows (K,) of a and b, each row once, ascending in the time of b.

    For each time of the shorter list the nearest of the longer, as evo associates; where two have the same nearest,
    the nearer of them.
    """
    if len(stamps_a) > len(stamps_b):
        rows_b, rows_a = nearest_in_time(stamps_b, stamps_a, max_difference_s)
    else:
        order = np.argsort(stamps_b, kind="stable")
        ascending = stamps_b[order]
        after = np.searchsorted(ascending, stamps_a).clip(0, len(ascending) - 1)
        before = (after - 1).clip(0)
        is_before = np.abs(ascending[before] - stamps_a) <= np.abs(ascending[after] - stamps_a)
        nearest = np.where(is_before, before, after)
        differences = np.abs(ascending[nearest] - stamps_a)
        by_difference = np.argsort(differences, kind="stable")
        by_difference = by_difference[differences[by_difference] <= max_difference_s]
        _, first = np.unique(nearest[by_difference], return_index=True)
        rows_a = by_difference[first]
        rows_b = order[nearest[rows_a]]
    in_time = np.argsort(stamps_b[rows_b], kind="stable")
    return rows_a[in_time], rows_b[in_time]
