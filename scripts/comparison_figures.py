"""What the comparison with COLMAP measures and what it wants: pure figures, no processes, no tables.

A ``Result`` is one method on one set; ``decisions`` holds our result against those of COLMAP's mappers.
The next module to read is ``comparison_report``, which makes tables of both; ``compare_with_colmap`` runs
the methods.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from smust3r_colmap.evaluation.trajectory import Evaluation, Trajectory

INCREMENTAL = "COLMAP incremental"
GLOBAL = "COLMAP global"

NOT_MAPPING = (
    "import",
    "features",
    "matching",
    "track matching",
    "depth",
    "fusion",
    "export",
    "trainer",
    "dense",
)
"""Our stages that are not mapping; every other stage is, whatever it is called, so that none is forgotten."""
MATCHING = ("matching", "track matching")

ALL_REGISTERED = ("office_loop", "courthouse_walk", "lund_street", "kitti_a")
"""Sets of which no image may be missing."""

JUMP_TURN_DEG = 90.0
JUMP_STEPS = 10.0

SOUND_SHARE = 0.5
"""A mapper whose largest model has fewer of the images has failed: two images are easily placed without error."""


@dataclass(frozen=True, kw_only=True)
class Cost:
    """What a child process and its own children took."""

    cpu_s: float
    wall_s: float
    peak_mib: float
    exit_code: int


@dataclass(frozen=True, kw_only=True)
class Dataset:
    """Images and their known cameras; ``unit`` is that of the truth."""

    name: str
    images: Path
    names: tuple[str, ...]
    truth: dict[str, Any]
    unit: str

    @property
    def num_images(self) -> int:
        """With a known camera or without."""
        return len(self.names)


@dataclass(frozen=True, kw_only=True)
class ModelFigures:
    """What a model says of itself.

    Args:
        num_points: that are seen by two images or more; others are no tracks.
        num_observations: of these points.
        mean_track_length: observations per point; NaN without points.
        reprojection_error_px: mean over the points of the mean over each point's observations, as COLMAP
            gives it, but computed here from cameras and points; NaN without points.
        observations_per_image: mean over the images with a pose.
    """

    num_points: int
    num_observations: int
    mean_track_length: float
    reprojection_error_px: float
    observations_per_image: float


@dataclass(frozen=True, kw_only=True)
class Jump:
    """Two consecutive images between which the camera cannot have moved so.

    Args:
        image_a, image_b: their names.
        turn_deg: angle between their orientations.
        step: distance of their centres, in medians of all steps of the trajectory.
    """

    image_a: str
    image_b: str
    turn_deg: float
    step: float


@dataclass(frozen=True, kw_only=True)
class Result:
    """One method on one set.

    Args:
        costs: by stage: features, matching, mapping and, of ours, the rest.
        registered_largest: images of the largest model; ``registered_all`` of all models together.
        figures, evaluation: of the largest model, where there is one, and a truth to compare it with.
        jumps: of the largest model that the truth does not have; None where neighbours in order of name
            need not be neighbours in space.
        workers: processes that ours used, or threads of COLMAP.
        stages: our result after each stage, by its name, the last being the result.
    """

    method: str
    costs: dict[str, Cost]
    registered_largest: int
    registered_all: int
    num_models: int
    figures: ModelFigures | None
    evaluation: Evaluation | None
    jumps: tuple[Jump, ...] | None
    note: str
    workers: int
    stages: Mapping[str, Evaluation]

    @property
    def is_ours(self) -> bool:
        """Not COLMAP's."""
        return self.method not in (INCREMENTAL, GLOBAL)


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """One figure of ours beside COLMAP's.

    Args:
        figure: its name.
        ours: the figure; ``yardstick``: what it is held against.
        ratio: of the two.
        target: in words; empty where the set has none.
        met: None without a target.
    """

    figure: str
    ours: float
    yardstick: float
    ratio: float
    target: str
    met: bool | None


# ------------------------------------------------------------------------------ figures
def figures_of(model: pycolmap.Reconstruction) -> ModelFigures:
    """Measure a model; points with fewer than two observations do not count."""
    model.update_point_3d_errors()
    tracks = [point for point in model.points3D.values() if point.track.length() >= 2]
    lengths = np.array([point.track.length() for point in tracks])
    return ModelFigures(
        num_points=len(tracks),
        num_observations=int(lengths.sum()),
        mean_track_length=float(lengths.mean()) if tracks else float("nan"),
        reprojection_error_px=float(np.mean([point.error for point in tracks])) if tracks else float("nan"),
        observations_per_image=float(lengths.sum() / max(1, model.num_reg_images())),
    )


def find_jumps(trajectory: Trajectory, names: Sequence[str]) -> tuple[Jump, ...]:
    """Consecutive images more than 90 degrees or ten medians of a step apart: a fold, or parts put together wrongly.

    Args:
        trajectory: ``world_from_cam`` (3, 4) by name.
        names: all images of the set in order; only direct neighbours are compared, since the camera
            may have gone anywhere while an image is missing.
    """
    pairs = [(a, b) for a, b in pairwise(names) if a in trajectory and b in trajectory]
    if not pairs:
        return ()
    first, second = (np.array([trajectory[pair[k]] for pair in pairs]) for k in (0, 1))
    lengths = np.linalg.norm(second[:, :, 3] - first[:, :, 3], axis=1)
    steps = lengths / max(float(np.median(lengths)), np.finfo(float).tiny)
    turns = Rotation.from_matrix(np.swapaxes(first[:, :, :3], 1, 2) @ second[:, :, :3]).magnitude()
    return tuple(
        Jump(image_a=a, image_b=b, turn_deg=float(turn_deg), step=float(step))
        for (a, b), turn_deg, step in zip(pairs, np.rad2deg(turns), steps, strict=True)
        if turn_deg > JUMP_TURN_DEG or step > JUMP_STEPS
    )


def untrue_jumps(estimated: Trajectory, truth: Trajectory, names: Sequence[str]) -> tuple[Jump, ...]:
    """Jumps of the estimate that the truth does not have at the same place."""
    true = {(jump.image_a, jump.image_b) for jump in find_jumps(truth, names)}
    return tuple(jump for jump in find_jumps(estimated, names) if (jump.image_a, jump.image_b) not in true)


def costs_by_stage(whole: Cost, stages: Sequence[Mapping[str, Any]]) -> dict[str, Cost]:
    """Our cost, parted into what COLMAP has too and the rest (depth maps, fusion, files).

    Args:
        whole: of the process.
        stages: as in ``summary.json``, with ``name``, ``cpu_s`` and ``wall_s``.
    """
    groups = {
        "features": [stage for stage in stages if stage["name"] == "features"],
        "matching": [stage for stage in stages if stage["name"] in MATCHING],
        "mapping": [stage for stage in stages if stage["name"] not in NOT_MAPPING],
    }
    costs = {
        name: replace(
            whole,
            cpu_s=sum(stage["cpu_s"] for stage in group),
            wall_s=sum(stage["wall_s"] for stage in group),
            exit_code=0,
        )
        for name, group in groups.items()
    }
    costs["rest"] = replace(
        whole,
        cpu_s=max(0.0, whole.cpu_s - sum(cost.cpu_s for cost in costs.values())),
        wall_s=max(0.0, whole.wall_s - sum(cost.wall_s for cost in costs.values())),
    )
    return costs


# ----------------------------------------------------------------------------- decisions
def decisions(dataset: Dataset, ours: Result, mappers: Sequence[Result]) -> tuple[Verdict, ...]:
    """Ours against the better of COLMAP's mappers, and its cost against the incremental one's.

    The better one is found figure by figure. A mapper that failed, that is placed less than half of the
    images or has nothing in common with the truth, is no yardstick; without one there is no decision.
    """
    sound = [one for one in mappers if is_sound(dataset, one)]
    found = [_registered(dataset, ours, mappers)]
    found += [
        _at_most("position rms", 1.0, ours.evaluation, [one.evaluation for one in sound], "position_rmse"),
        _at_most("rotation median", 1.0, ours.evaluation, [one.evaluation for one in sound], "rotation_median_deg"),
        _at_most("rotation mean", 1.0, ours.evaluation, [one.evaluation for one in sound], "rotation_mean_deg"),
        _at_most("reprojection error", 1.1, ours.figures, [one.figures for one in sound], "reprojection_error_px"),
        _track_length(ours.figures, [one.figures for one in sound]),
    ]
    incremental = next((one for one in sound if one.method == INCREMENTAL), None)
    if incremental is not None:
        found += [
            _cost("mapping CPU", ours, incremental, "cpu_s", _cpu_target(dataset.num_images)),
            _cost("mapping wall", ours, incremental, "wall_s", _wall_target(dataset.num_images, ours.workers)),
        ]
    found.append(_jumps(ours, sound))
    return tuple(one for one in found if one is not None)


def is_sound(dataset: Dataset, result: Result) -> bool:
    """Whether a result can be a yardstick."""
    enough = result.registered_largest >= SOUND_SHARE * dataset.num_images
    return enough and (result.evaluation is not None or not dataset.truth)


def _cpu_target(num_images: int) -> float | None:
    """Issue 5: as much as incremental mapping at 200-300 images, half at 1,000; smaller sets have none."""
    if num_images < 200:
        return None
    return 1.0 if num_images < 1000 else 0.5


def _wall_target(num_images: int, workers: int) -> float | None:
    """Issue 5: with two workers, from 200 images on."""
    return 0.6 if num_images >= 200 and workers == 2 else None


def _registered(dataset: Dataset, ours: Result, mappers: Sequence[Result]) -> Verdict | None:
    if not mappers:
        return None
    best = max(one.registered_largest for one in mappers)
    needed = dataset.num_images if dataset.name in ALL_REGISTERED else best
    return Verdict(
        figure="registered",
        ours=ours.registered_largest,
        yardstick=best,
        ratio=_ratio(ours.registered_largest, best),
        target="all" if dataset.name in ALL_REGISTERED else ">= better",
        met=ours.registered_largest >= max(needed, best),
    )


def _at_most(figure: str, target: float, ours: Any, theirs: Sequence[Any], attribute: str) -> Verdict | None:
    values = _finite([getattr(one, attribute) for one in theirs if one is not None])
    if ours is None or not values:
        return None
    own = float(getattr(ours, attribute))
    ratio = _ratio(own, min(values))
    return Verdict(
        figure=figure,
        ours=own,
        yardstick=min(values),
        ratio=ratio,
        target=f"<= {target:g} x better",
        met=ratio <= target,
    )


def _track_length(ours: ModelFigures | None, theirs: Sequence[ModelFigures | None]) -> Verdict | None:
    values = _finite([one.mean_track_length for one in theirs if one is not None])
    if ours is None or not values:
        return None
    ratio = _ratio(ours.mean_track_length, max(values))
    return Verdict(
        figure="track length",
        ours=ours.mean_track_length,
        yardstick=max(values),
        ratio=ratio,
        target=">= 0.9 x better",
        met=ratio >= 0.9,
    )


def _cost(figure: str, ours: Result, incremental: Result, attribute: str, target: float | None) -> Verdict | None:
    if "mapping" not in ours.costs:
        return None
    own, other = (float(getattr(one.costs["mapping"], attribute)) for one in (ours, incremental))
    ratio = _ratio(own, other)
    return Verdict(
        figure=figure,
        ours=own,
        yardstick=other,
        ratio=ratio,
        target="" if target is None else f"<= {target:g} x incremental",
        met=None if target is None else ratio <= target,
    )


def _jumps(ours: Result, sound: Sequence[Result]) -> Verdict | None:
    if ours.jumps is None:
        return None
    counts = [len(one.jumps) for one in sound if one.jumps is not None]
    return Verdict(
        figure="jumps",
        ours=len(ours.jumps),
        yardstick=min(counts, default=0),
        ratio=float("nan"),
        target="none",
        met=not ours.jumps,
    )


def _finite(values: Sequence[float]) -> list[float]:
    return [float(value) for value in values if np.isfinite(value)]


def _ratio(ours: float, other: float) -> float:
    """NaN where there is nothing to divide by, which meets no target."""
    return ours / other if other else float("nan")
