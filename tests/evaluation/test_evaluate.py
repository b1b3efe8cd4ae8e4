from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smust3r_colmap.config import EvaluateConfig
from smust3r_colmap.errors import DegenerateAlignmentError
from smust3r_colmap.evaluation.evaluate import EvaluationReport, Row, evaluate
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.sim3 import Sim3
from smust3r_colmap.importers.pose_set import PoseSet

RNG = np.random.default_rng(3)
CENTRES = RNG.uniform(-2, 2, (12, 3))
ROTATIONS = Rotation.from_rotvec(RNG.uniform(-1, 1, (12, 3)))
OTHER_WORLD = Sim3(
    scale=np.asarray(0.5), rotation=Rotation.from_rotvec([0.3, 2, 1]).as_matrix(), translation=np.array([4.0, 5, 6])
)


def pose_set(
    centres: FloatArray = CENTRES,
    rotations: Rotation = ROTATIONS,
    *,
    world: Sim3 | None = None,
    first: int = 0,
    named: bool = True,
) -> PoseSet:
    poses = np.concatenate([rotations.as_matrix(), centres[:, :, None]], axis=2)
    n = len(poses)
    return PoseSet(
        layout="made up",
        place=Path("made.txt"),
        world_from_cam=poses if world is None else world.move_cameras(poses),
        names=tuple(f"{first + k}.jpg" for k in range(n)) if named else (),
        stamps_s=None if named else np.arange(0.5, n),
    )


def row(evaluation: EvaluationReport, metric: str) -> Row:
    (found,) = [one for one in evaluation.rows if one.metric == metric]
    return found


def value(evaluation: EvaluationReport, metric: str, statistic: str) -> float:
    found = row(evaluation, metric).values[statistic]
    assert found is not None
    return found


def test_another_world_and_scale_leave_no_error_but_that_of_scale() -> None:
    found = evaluate([pose_set(world=OTHER_WORLD)], pose_set(), EvaluateConfig())
    for metric in ("ape_translation", "aae", "aae_rotation_aligned", "rpe_translation", "rpe_rotation"):
        assert value(found, metric, "max") == pytest.approx(0, abs=1e-6)
    assert value(found, "scale", "scale") == pytest.approx(0.5)
    assert value(found, "scale", "error_percent") == pytest.approx(-50)
    for metric in ("auc_colmap", "auc_colmap_compared", "auc_vggt"):
        assert value(found, metric, "at_5_deg") == pytest.approx(100, rel=1e-5)
    assert found.warnings == ()


def test_the_scale_is_stated_when_it_is_not_corrected() -> None:
    found = evaluate([pose_set(world=OTHER_WORLD)], pose_set(), EvaluateConfig(align="se3"))
    assert row(found, "ape_translation").alignment == "se3"
    assert value(found, "ape_translation", "rmse") > 0.5
    assert value(found, "scale", "scale") == pytest.approx(0.5)


def test_errors_in_percent_are_of_the_box_of_the_compared_centres() -> None:
    reference = pose_set(np.array([[0.0, 0, 0], [3, 0, 0], [3, 4, 0], [0, 4, 0]]), ROTATIONS[:4])
    estimate = replace(reference, world_from_cam=reference.world_from_cam + [[0, 0, 0, 0.1]] * 3)
    found = evaluate([estimate], reference, EvaluateConfig(align="none"))
    assert value(found, "ape_of_extent", "extent") == pytest.approx(5)
    assert value(found, "ape_of_extent", "rmse_percent") == pytest.approx(100 * np.sqrt(0.03) / 5)


def test_every_row_says_what_was_compared_and_how() -> None:
    """Images 2 to 11 and 12 to 13 against 0 to 11."""
    estimate = pose_set(np.vstack([CENTRES[2:], CENTRES[:2]]), ROTATIONS, world=OTHER_WORLD, first=2)
    found = evaluate([estimate], pose_set(), EvaluateConfig())
    assert {(one.compared, one.in_estimate, one.in_reference) for one in found.rows} == {(10, 12, 12)}
    assert {one.association for one in found.rows} == {"image name"}
    assert {one.alignment for one in found.rows} == {"sim3", "none", "mean rotation"}


def test_images_that_only_one_side_has_count_in_colmaps_definition_only() -> None:
    """10 of 12 are right (90 ordered pairs); 132 - 90 pairs have no pose, and 2 unknown images make 42 more."""
    kept = np.r_[2:12]
    centres = np.vstack([CENTRES[kept], CENTRES[:2]])
    estimate = pose_set(centres, ROTATIONS[np.r_[kept, 0, 1]], world=OTHER_WORLD, first=2)
    found = evaluate([estimate], pose_set(), EvaluateConfig())
    assert value(found, "auc_colmap", "at_5_deg") == pytest.approx(100 * 90 / (132 + 42), rel=1e-5)
    assert "2 images of the reference have no pose and 2 of the estimate are unknown" in row(found, "auc_colmap").note
    assert value(found, "auc_colmap_compared", "at_5_deg") == pytest.approx(100, rel=1e-5)
    assert value(found, "auc_vggt", "at_5_deg") == pytest.approx(100)


def test_all_models_count_in_colmaps_definition_and_the_largest_in_all_else() -> None:
    """7 and 5 of 12 images: 42 + 20 of 132 ordered pairs are in one model."""
    largest = pose_set(CENTRES[:7], ROTATIONS[:7], world=OTHER_WORLD)
    other = pose_set(CENTRES[7:], ROTATIONS[7:], first=7)
    found = evaluate([largest, other], pose_set(), EvaluateConfig())
    assert value(found, "auc_colmap", "at_1_deg") == pytest.approx(100 * 62 / 132, rel=1e-5)
    assert row(found, "ape_translation").compared == 7
    assert "largest model" in found.notes[0]


def test_another_model_of_images_that_the_reference_lacks_counts_as_wrong() -> None:
    """12 images are right, and 3 others are in a model of their own: 132 of 132 + 6 ordered pairs."""
    unknown = pose_set(CENTRES[:3], ROTATIONS[:3], first=100)
    found = evaluate([pose_set(world=OTHER_WORLD), unknown], pose_set(), EvaluateConfig())
    assert value(found, "auc_colmap", "at_1_deg") == pytest.approx(100 * 132 / 138, rel=1e-5)
    assert "3 of the estimate are unknown" in row(found, "auc_colmap").note


def test_a_trajectory_by_time_has_no_missing_images() -> None:
    found = evaluate([pose_set(named=False, world=OTHER_WORLD)], pose_set(named=False), EvaluateConfig())
    assert "auc_colmap" not in {one.metric for one in found.rows}
    assert value(found, "auc_colmap_compared", "at_1_deg") == pytest.approx(100, rel=1e-4)


def test_kittis_segments_need_metres() -> None:
    along = np.column_stack([np.arange(150.0), 8 * np.sin(np.arange(150) / 40), 8 * np.cos(np.arange(150) / 40)])
    rotations = Rotation.from_rotvec(np.zeros((150, 3)))
    reference, estimate = pose_set(along, rotations), pose_set(1.01 * along, rotations)
    options = EvaluateConfig(align="none")
    assert not [one for one in evaluate([estimate], reference, options).rows if one.metric.startswith("kitti")]
    found = evaluate([estimate], reference, replace(options, unit="m"))
    assert 0.9 < value(found, "kitti_100m", "translation_percent") < 1.2
    assert {one.unit for one in found.rows if one.metric == "ape_translation"} == {"m"}


# ------------------------------------------------------------------------------- lines
def on_a_line(spread: float) -> FloatArray:
    across = spread * np.random.default_rng(0).normal(size=(12, 2))
    return np.column_stack([np.arange(12.0), across])


def test_centres_on_a_line_do_not_determine_the_average_angle() -> None:
    line = on_a_line(0.0)
    found = evaluate([pose_set(line, world=OTHER_WORLD)], pose_set(line), EvaluateConfig())
    assert set(row(found, "aae").values.values()) == {None}
    assert "the centres are on a line" in row(found, "aae").note
    assert value(found, "aae_rotation_aligned", "max") == pytest.approx(0, abs=1e-6)
    assert value(found, "ape_translation", "max") == pytest.approx(0, abs=1e-9)
    assert "on a line" in found.warnings[0]


def test_centres_nearly_on_a_line_are_warned_of() -> None:
    reference, estimate = pose_set(on_a_line(0.05)), pose_set(on_a_line(0.05), world=OTHER_WORLD)
    found = evaluate([estimate], reference, EvaluateConfig())
    assert value(found, "aae", "max") == pytest.approx(0, abs=1e-5)
    assert "nearly on a line" in found.warnings[0]
    assert evaluate([estimate], reference, EvaluateConfig(align="none")).warnings == ()


def test_an_angle_that_is_the_alignments_is_warned_of() -> None:
    """A camera that turns on the spot: its centres are noise, so that their fit says nothing of the rotation."""
    rng = np.random.default_rng(4)
    reference, estimate = (pose_set(0.01 * rng.normal(size=(12, 3))) for _ in range(2))
    found = evaluate([estimate], reference, EvaluateConfig())
    assert value(found, "aae", "mean") > 10
    assert value(found, "aae_rotation_aligned", "max") == pytest.approx(0, abs=1e-5)
    assert len(found.warnings) == 1
    assert "is mostly that of the alignment" in found.warnings[0]


def test_orientations_do_not_matter_for_the_position_of_a_straight_path_and_do_for_its_cloud() -> None:
    line = on_a_line(1e-5)
    cloud = np.array([[0.0, 3, 0], [5, 0, 3], [9, -2, 1]])
    found = evaluate(
        [pose_set(line, world=OTHER_WORLD)],
        pose_set(line),
        EvaluateConfig(),
        clouds=(OTHER_WORLD.apply(cloud), cloud),
    )
    assert row(found, "cloud_accuracy").alignment == "sim3 (centres, roll from orientations)"
    assert value(found, "cloud_accuracy", "max") < 1e-4
    with pytest.raises(DegenerateAlignmentError, match="do not determine where the cloud goes"):
        evaluate([pose_set(line)], pose_set(line), EvaluateConfig(align="se3"), clouds=(cloud, cloud))


# ---------------------------------------------------------------------- sigmas, clouds
def test_predicted_errors_are_scaled_with_the_model() -> None:
    """Errors are those of one axis, 0.2 in the reference's unit, so about 0.1 in that of the model."""
    rng = np.random.default_rng(5)
    estimate = pose_set(CENTRES + 0.2 * rng.normal(size=CENTRES.shape), world=OTHER_WORLD)
    sigmas = dict.fromkeys(estimate.names[:-1], 0.5)
    found = evaluate([estimate], pose_set(), EvaluateConfig(), sigmas=sigmas)
    assert 0.8 < value(found, "predicted_error", "predicted_rmse") < 1.2  # 0.5 / 0.5
    assert 0.15 < value(found, "predicted_error", "true_rmse") < 0.4
    assert value(found, "predicted_error", "within_1_sigma_percent") == 100
    assert "11 images with a sigma" in row(found, "predicted_error").note
    nothing = evaluate([estimate], pose_set(), EvaluateConfig(), sigmas={"other.jpg": 1.0})
    assert set(row(nothing, "predicted_error").values.values()) == {None}


def test_a_cloud_is_moved_with_the_cameras() -> None:
    cloud = np.random.default_rng(1).uniform(-3, 3, (40, 3))
    found = evaluate(
        [pose_set(world=OTHER_WORLD)],
        pose_set(),
        EvaluateConfig(cloud_thresholds=(0.001,)),
        clouds=(OTHER_WORLD.apply(cloud[:30]), cloud),
    )
    shares = row(found, "cloud_within_0.001_units").values
    assert shares == pytest.approx({"accuracy": 100, "completeness": 75, "f_score": 2 * 75 * 100 / 175})
    assert "30 points of the estimate, 40 of the reference" in row(found, "cloud_chamfer").note


# --------------------------------------------------------------------------- bad input
def test_fewer_than_three_common_poses_are_refused() -> None:
    with pytest.raises(DegenerateAlignmentError, match=r"2 poses by image name are in both .*\(12 poses\).*needed 3"):
        evaluate([pose_set(first=10)], pose_set(), EvaluateConfig())


def test_a_scalar_at_the_wrong_end_is_noticed() -> None:
    """A file with columns qw qx qy qz that was read as qx qy qz qw."""
    wrong = Rotation.from_quat((OTHER_WORLD_ROTATION * ROTATIONS).as_quat()[:, [3, 0, 1, 2]])
    estimate = pose_set(OTHER_WORLD.apply(CENTRES), wrong, named=False)
    found = evaluate([estimate], pose_set(named=False), EvaluateConfig())
    assert value(found, "aae_rotation_aligned", "mean") > 20
    assert len(found.warnings) == 1
    assert "are its columns qw qx qy qz?" in found.warnings[0]


OTHER_WORLD_ROTATION = Rotation.from_matrix(OTHER_WORLD.rotation)


def test_what_the_readers_noted_is_a_warning_and_a_model_as_reference_a_note() -> None:
    reference = replace(pose_set(), notes=("poses are those of the body",), is_model=True)
    found = evaluate([pose_set()], reference, EvaluateConfig())
    assert found.warnings == ("poses are those of the body",)
    assert found.notes == ("the reference is a reconstruction: its errors count as errors of the estimate",)


def test_a_step_longer_than_the_path_has_no_figure() -> None:
    found = evaluate([pose_set()], pose_set(), EvaluateConfig(rpe_delta=12))
    for metric in ("rpe_translation", "rpe_rotation"):
        assert set(row(found, metric).values.values()) == {None}
        assert "0 pairs" in row(found, metric).note


COLMAP_AUC = {
    0.0: (9.492655643386524, 35.52107032126364, 40.98477334029917),
    0.01: (9.488557282730786, 36.591956966149006, 42.28304303214842),
    0.5: (11.904850505547428, 37.39738804042121, 42.76630167671175),
}
"""At 1, 3 and 5 degrees, by the accuracy of the reference."""


def test_pairs_count_as_in_colmaps_own_benchmark() -> None:
    """Two models that share images, unknown images, missing ones, noise, baselines below the accuracy.

    Numbers from COLMAP's benchmark/reconstruction/evaluation/utils.py at commit 5d968cf
    (``compute_grouped_rel_errors`` and ``compute_auc``) on these poses.
    """
    rng = np.random.default_rng(11)
    centres, rotvecs = rng.uniform(-2, 2, (12, 3)), rng.uniform(-1, 1, (12, 3))
    centres[1] = centres[0] + 0.001
    noisy = centres + 0.01 * rng.normal(size=centres.shape)
    turned = Rotation.from_rotvec(0.005 * rng.normal(size=(12, 3))) * Rotation.from_rotvec(rotvecs)
    reference = pose_set(centres[:10], Rotation.from_rotvec(rotvecs[:10]))
    models = [
        pose_set(noisy[3:], turned[3:], world=OTHER_WORLD, first=3),
        pose_set(noisy[:5], turned[:5]),
    ]
    for accuracy, expected in COLMAP_AUC.items():
        found = evaluate(models, reference, EvaluateConfig(reference_accuracy=accuracy))
        assert list(row(found, "auc_colmap").values.values()) == pytest.approx(expected, abs=1e-6)


def test_too_many_poses_for_all_pairs_have_no_area(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("smust3r_colmap.evaluation.evaluate._MAX_IMAGES_IN_PAIRS", 11)
    found = evaluate([pose_set()], pose_set(), EvaluateConfig())
    assert set(row(found, "auc_vggt").values.values()) == {None}
    assert "12 poses have too many pairs" in row(found, "auc_colmap_compared").note
