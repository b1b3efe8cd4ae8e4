"""Our figures are evo's, on two recorded-like walks with other frame rates, gaps and a scale of their own.

evo (GPLv3) is asked here and nowhere else; it comes with the extra ``dev`` under Python 3.11 and later.
"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smust3r_colmap.config import EvaluateConfig
from smust3r_colmap.evaluation.evaluate import EvaluationReport, evaluate
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.importers.pose_layouts import read_pose_sets

pytest.importorskip("evo")

from evo.core import metrics, sync
from evo.core.trajectory import PoseTrajectory3D
from evo.tools import file_interface

TOLERANCE = 1e-6


def write_tum(path: Path, stamps_s: FloatArray, centres: FloatArray, rotations: Rotation) -> None:
    rows = np.column_stack([stamps_s, centres, rotations.as_quat()])
    path.write_text("".join(" ".join(f"{number:.9f}" for number in row) + "\n" for row in rows))


@pytest.fixture(scope="module")
def walks(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A truth at 100 Hz, and an estimate at about 30 Hz with noise, drift, a gap, another world and another scale."""
    folder = tmp_path_factory.mktemp("walks")
    rng = np.random.default_rng(7)
    stamps_s = 1305031100 + np.arange(0, 20, 0.01)
    t = stamps_s - stamps_s[0]
    centres = np.column_stack([3 * np.sin(0.4 * t), 2 * np.cos(0.3 * t), 0.5 * np.sin(0.9 * t) + 0.05 * t])
    rotations = Rotation.from_euler("zyx", np.column_stack([40 * np.sin(0.2 * t), 20 * np.cos(0.5 * t), 5 * t]), True)
    write_tum(folder / "truth.txt", stamps_s, centres, rotations)

    kept = np.arange(0, len(t), 3)
    kept = kept[(t[kept] < 8) | (t[kept] > 9)]
    noisy = centres[kept] + 0.02 * rng.normal(size=(len(kept), 3)) + 0.01 * t[kept, None]
    world = Rotation.from_rotvec([0.4, -1.2, 2.0])
    wobbly = rotations[kept] * Rotation.from_rotvec(0.02 * rng.normal(size=(len(kept), 3)))
    when_s = stamps_s[kept] + rng.uniform(-0.003, 0.003, len(kept))
    write_tum(folder / "estimate.txt", when_s, 0.4 * world.apply(noisy) + [5, 6, 7], world * wobbly)
    return folder / "estimate.txt", folder / "truth.txt"


def ours(walks: tuple[Path, Path], **options: object) -> EvaluationReport:
    (estimate,), (truth,) = (read_pose_sets(path) for path in walks)
    return evaluate([estimate], truth, EvaluateConfig(**options))  # type: ignore[arg-type]


def theirs(walks: tuple[Path, Path], align: str) -> tuple[PoseTrajectory3D, PoseTrajectory3D]:
    """Reference and estimate, associated and aligned."""
    estimate, truth = (file_interface.read_tum_trajectory_file(path) for path in walks)
    truth, estimate = sync.associate_trajectories(truth, estimate, max_diff=0.01)
    if align != "none":
        estimate.align(truth, correct_scale=align == "sim3")
    return truth, estimate


def assert_same(evaluation: EvaluationReport, metric: str, statistics: dict[str, float]) -> None:
    (row,) = [row for row in evaluation.rows if row.metric == metric]
    for name, value in row.values.items():
        assert value == pytest.approx(statistics[name], abs=TOLERANCE, rel=TOLERANCE), (metric, name)


@pytest.mark.slow
@pytest.mark.parametrize("align", ["sim3", "se3", "none"])
def test_absolute_errors(walks: tuple[Path, Path], align: str) -> None:
    evaluation, pair = ours(walks, align=align), theirs(walks, align)
    assert evaluation.rows[0].compared == pair[0].num_poses > 600
    for metric, relation in (
        ("ape_translation", metrics.PoseRelation.translation_part),
        ("aae", metrics.PoseRelation.rotation_angle_deg),
    ):
        error = metrics.APE(relation)
        error.process_data(pair)
        assert_same(evaluation, metric, error.get_all_statistics())


@pytest.mark.slow
@pytest.mark.parametrize("all_pairs", [False, True])
@pytest.mark.parametrize(("delta", "unit"), [(1, "frames"), (10, "frames"), (1.0, "m")])
def test_relative_errors(walks: tuple[Path, Path], delta: float, unit: str, all_pairs: bool) -> None:
    evaluation = ours(walks, rpe_delta=delta, rpe_unit=unit, rpe_all_pairs=all_pairs)
    pair = theirs(walks, "sim3")
    for metric, relation in (
        ("rpe_translation", metrics.PoseRelation.translation_part),
        ("rpe_rotation", metrics.PoseRelation.rotation_angle_deg),
    ):
        error = metrics.RPE(
            relation,
            delta=delta,
            delta_unit={"frames": metrics.Unit.frames, "m": metrics.Unit.meters}[unit],
            all_pairs=all_pairs,
            pairs_from_reference=True,
        )
        error.process_data(pair)
        assert_same(evaluation, metric, error.get_all_statistics())


@pytest.mark.slow
def test_the_scale_is_that_of_evos_alignment(walks: tuple[Path, Path]) -> None:
    estimate, truth = (file_interface.read_tum_trajectory_file(path) for path in walks)
    truth, estimate = sync.associate_trajectories(truth, estimate, max_diff=0.01)
    _, _, scale = estimate.align(truth, correct_scale=True)
    (row,) = [asdict(row)["values"] for row in ours(walks).rows if row.metric == "scale"]
    assert row["scale"] == pytest.approx(1 / scale, rel=1e-9)
