"""The comparison with COLMAP: what it measures, what it holds against what, and what it writes."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import compare_with_colmap as compare
import numpy as np
import pycolmap
import pytest
from comparison_figures import (
    GLOBAL,
    INCREMENTAL,
    NOT_MAPPING,
    Cost,
    Dataset,
    ModelFigures,
    Result,
    Verdict,
    costs_by_stage,
    decisions,
    figures_of,
    find_jumps,
    untrue_jumps,
)
from comparison_report import as_json, render_markdown, render_stages, render_table
from helpers.scenes import rotation_about_y, walk

from smust3r_colmap.evaluation.trajectory import compare_trajectories
from smust3r_colmap.exporters.tum_trajectory import write_tum
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.geometry.world_frame import WorldFrame
from smust3r_colmap.products import EMPTY_CLOUD, Scene

NUM_IMAGES = 20
NAMES = tuple(f"{k:03d}.jpg" for k in range(NUM_IMAGES))
TRUTH = dict(zip(NAMES, walk(NUM_IMAGES), strict=True))


def disturbed(size: float) -> dict[str, FloatArray]:
    """The truth with its centres moved at random."""
    rng = np.random.default_rng(3)
    return {name: pose + np.column_stack([np.zeros((3, 3)), size * rng.normal(size=3)]) for name, pose in TRUTH.items()}


def dataset(name: str = "walk", num_images: int = NUM_IMAGES) -> Dataset:
    names = tuple(f"{k:03d}.jpg" for k in range(num_images))
    return Dataset(name=name, images=Path("images"), names=names, truth=TRUTH, unit="m")


def cost(cpu_s: float = 10.0, wall_s: float = 10.0) -> Cost:
    return Cost(cpu_s=cpu_s, wall_s=wall_s, peak_mib=100.0, exit_code=0)


def figures(error_px: float = 0.5, track_length: float = 5.0) -> ModelFigures:
    return ModelFigures(
        num_points=100,
        num_observations=500,
        mean_track_length=track_length,
        reprojection_error_px=error_px,
        observations_per_image=25.0,
    )


EQUAL = Result(
    method="ours",
    costs={"features": cost(), "matching": cost(), "mapping": cost()},
    registered_largest=NUM_IMAGES,
    registered_all=NUM_IMAGES,
    num_models=1,
    figures=figures(),
    evaluation=compare_trajectories(disturbed(0.01), TRUTH),
    jumps=(),
    note="",
    workers=2,
    stages={},
)


def judged(ours: Result, *mappers: Result, of: Dataset | None = None) -> dict[str, Verdict]:
    return {one.figure: one for one in decisions(of or dataset(), ours, mappers)}


# ------------------------------------------------------------------------------ figures
def synthetic_model(noise_px: float) -> pycolmap.Reconstruction:
    pycolmap.set_random_seed(5)
    options = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_frames_per_rig=6, num_points3D=200)
    model = pycolmap.synthesize_dataset(options)
    rng = np.random.default_rng(5)
    for image in model.images.values():
        for point in image.points2D:
            if point.has_point3D():
                point.xy = point.xy + noise_px * rng.normal(size=2)
    return model


def test_reprojection_error_is_measured_anew_and_is_that_of_the_noise() -> None:
    # The length of a vector of two normal numbers is sqrt(pi / 2) in the mean.
    assert figures_of(synthetic_model(0.0)).reprojection_error_px < 1e-6
    measured = figures_of(synthetic_model(0.8)).reprojection_error_px
    assert measured == pytest.approx(0.8 * math.sqrt(math.pi / 2), rel=0.05)


def test_points_that_fewer_than_two_images_see_are_no_tracks() -> None:
    model = synthetic_model(0.0)
    alone = figures_of(model)
    assert alone.num_points == 200
    assert alone.observations_per_image == pytest.approx(alone.num_observations / 6)
    assert alone.mean_track_length == pytest.approx(alone.num_observations / alone.num_points)
    for _ in range(50):
        model.add_point3D(np.array([0.0, 0.0, 5.0]), pycolmap.Track(), np.zeros(3, np.uint8))
    assert figures_of(model) == alone


def test_a_model_without_tracks_has_no_error_rather_than_none_at_all() -> None:
    model = synthetic_model(0.0)
    for point in list(model.points3D):
        model.delete_point3D(point)
    found = figures_of(model)
    assert (found.num_points, found.num_observations) == (0, 0)
    assert math.isnan(found.reprojection_error_px)
    assert math.isnan(found.mean_track_length)


# -------------------------------------------------------------------------------- jumps
def test_a_walk_has_no_jumps_and_every_break_in_it_is_one() -> None:
    assert find_jumps(TRUTH, NAMES) == ()
    moved = {
        name: pose + np.column_stack([np.zeros((3, 3)), [0.0, 0.0, 30.0 * (name >= NAMES[12])]])
        for name, pose in TRUTH.items()
    }
    (jump,) = find_jumps(moved, NAMES)
    assert (jump.image_a, jump.image_b) == (NAMES[11], NAMES[12])
    assert 60 < jump.step < 140  # thirty units by steps of some 0.3
    turned = {
        name: np.column_stack([pose[:, :3] @ rotation_about_y(120.0 * (name >= NAMES[5])), pose[:, 3]])
        for name, pose in TRUTH.items()
    }
    (jump,) = find_jumps(turned, NAMES)
    assert (jump.image_a, jump.image_b) == (NAMES[4], NAMES[5])
    assert jump.turn_deg == pytest.approx(121.0, abs=1.0)


def test_what_the_truth_does_as_well_is_no_jump() -> None:
    def hopping(at: int) -> dict[str, FloatArray]:
        return {
            name: pose + np.column_stack([np.zeros((3, 3)), [0.0, 50.0 * (name >= NAMES[at]), 0.0]])
            for name, pose in TRUTH.items()
        }

    assert untrue_jumps(hopping(7), hopping(7), NAMES) == ()
    assert len(untrue_jumps(hopping(7), TRUTH, NAMES)) == 1
    assert len(untrue_jumps(hopping(7), hopping(9), NAMES)) == 1


def test_across_a_missing_image_nothing_is_a_jump() -> None:
    away = np.column_stack([np.zeros((3, 3)), [0.0, 0.0, 30.0]])
    moved = {name: pose + away * (name >= NAMES[12]) for name, pose in TRUTH.items()}
    assert len(find_jumps(moved, NAMES)) == 1
    del moved[NAMES[12]]
    assert find_jumps(moved, NAMES) == ()
    assert find_jumps({NAMES[0]: TRUTH[NAMES[0]]}, NAMES) == ()


# --------------------------------------------------------------------------------- cost
def test_every_stage_but_those_named_is_mapping() -> None:
    names = [*NOT_MAPPING, "mapping", "calibration", "alignment", "pose graph", "loops", "triangulation", "adjustment"]
    stages = [{"name": name, "cpu_s": 2.0**k, "wall_s": 1.0} for k, name in enumerate(names)]
    total = 2.0 ** len(names)
    costs = costs_by_stage(cost(total, 100.0), stages)
    by_name = {name: 2.0**k for k, name in enumerate(names)}
    assert costs["features"].cpu_s == by_name["features"]
    assert costs["matching"].cpu_s == by_name["matching"] + by_name["track matching"]
    assert costs["mapping"].cpu_s == sum(by_name[name] for name in names[len(NOT_MAPPING) :])
    assert costs["mapping"].wall_s == 7.0
    assert sum(one.cpu_s for one in costs.values()) == pytest.approx(total)


# ----------------------------------------------------------------------------- decisions
def test_as_good_as_colmap_meets_everything() -> None:
    found = judged(EQUAL, replace(EQUAL, method=INCREMENTAL), replace(EQUAL, method=GLOBAL))
    assert all(one.met is not False for one in found.values())
    assert {name for name, one in found.items() if one.met} == {
        "registered",
        "position rms",
        "rotation median",
        "rotation mean",
        "reprojection error",
        "track length",
        "jumps",
    }


@pytest.mark.parametrize(
    ("figure", "just_good", "just_bad"),
    [
        ("reprojection error", {"figures": figures(error_px=0.549)}, {"figures": figures(error_px=0.551)}),
        ("track length", {"figures": figures(track_length=4.51)}, {"figures": figures(track_length=4.49)}),
        ("registered", {"registered_largest": NUM_IMAGES}, {"registered_largest": NUM_IMAGES - 1}),
        (
            "position rms",
            {"evaluation": compare_trajectories(disturbed(0.0099), TRUTH)},
            {"evaluation": compare_trajectories(disturbed(0.0101), TRUTH)},
        ),
    ],
)
def test_targets_lie_where_the_issue_puts_them(
    figure: str, just_good: Mapping[str, object], just_bad: Mapping[str, object]
) -> None:
    mapper = replace(EQUAL, method=GLOBAL)
    assert judged(replace(EQUAL, **just_good), mapper)[figure].met is True  # type: ignore[arg-type]
    assert judged(replace(EQUAL, **just_bad), mapper)[figure].met is False  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("num_images", "ratio", "cpu", "wall"),
    [
        (199, 0.4, None, None),
        (200, 0.59, True, True),
        (200, 0.61, True, False),
        (300, 1.01, False, False),
        (1000, 0.49, True, True),
        (1000, 0.51, False, True),
    ],
)
def test_cost_is_held_against_incremental_mapping_by_the_size_of_the_set(
    num_images: int, ratio: float, cpu: bool | None, wall: bool | None
) -> None:
    ours = replace(EQUAL, costs={"mapping": cost(ratio * 10, ratio * 10)}, registered_largest=num_images)
    mapper = replace(EQUAL, method=INCREMENTAL, registered_largest=num_images)
    found = judged(ours, mapper, of=dataset(num_images=num_images))
    assert (found["mapping CPU"].met, found["mapping wall"].met) == (cpu, wall)
    assert found["mapping CPU"].ratio == pytest.approx(ratio)
    alone = judged(replace(ours, workers=1), mapper, of=dataset(num_images=num_images))
    assert alone["mapping wall"].met is None


def test_each_figure_has_the_better_mapper_for_a_yardstick() -> None:
    first = replace(EQUAL, method=INCREMENTAL, figures=figures(error_px=0.4, track_length=4.0))
    second = replace(EQUAL, method=GLOBAL, figures=figures(error_px=0.9, track_length=6.0))
    found = judged(EQUAL, first, second)
    assert found["reprojection error"].yardstick == 0.4
    assert found["track length"].yardstick == 6.0


@pytest.mark.parametrize(
    "failed",
    [
        {"registered_largest": NUM_IMAGES // 2 - 1},
        {"evaluation": None, "note": "nothing in common"},
    ],
)
def test_a_mapper_that_failed_is_no_yardstick_but_for_its_images(failed: Mapping[str, object]) -> None:
    mapper = replace(EQUAL, method=INCREMENTAL, figures=figures(error_px=0.01, track_length=50.0), **failed)  # type: ignore[arg-type]
    assert set(judged(EQUAL, mapper)) == {"registered", "jumps"}


def test_some_sets_must_be_complete_whatever_colmap_does() -> None:
    ours = replace(EQUAL, registered_largest=NUM_IMAGES - 1)
    mapper = replace(EQUAL, method=GLOBAL, registered_largest=NUM_IMAGES - 5)
    assert judged(ours, mapper)["registered"].met is True
    assert judged(ours, mapper, of=dataset("kitti_a"))["registered"].met is False


def test_a_model_without_tracks_and_a_jump_miss_their_targets() -> None:
    jumps = find_jumps({**TRUTH, NAMES[3]: TRUTH[NAMES[3]] + 100 * np.eye(3, 4, k=3)}, NAMES)
    assert len(jumps) == 2
    none = figures(error_px=math.nan, track_length=math.nan)
    found = judged(replace(EQUAL, figures=none, jumps=jumps), replace(EQUAL, method=GLOBAL))
    assert not found["reprojection error"].met
    assert not found["track length"].met
    assert not found["jumps"].met


# -------------------------------------------------------------------------------- report
def three_results() -> list[Result]:
    staged = {"chain": EQUAL.evaluation, "loops": EQUAL.evaluation}
    ours = replace(EQUAL, stages={name: one for name, one in staged.items() if one is not None})
    failed = replace(EQUAL, method=INCREMENTAL, registered_largest=2, evaluation=None, figures=None, jumps=None)
    better = replace(EQUAL, method=GLOBAL, figures=figures(error_px=0.25))
    return [ours, failed, better]


def test_tables_show_ratios_and_say_what_is_missed() -> None:
    results = three_results()
    text = render_table(dataset(), results)
    assert "reprojection error: 0.5 to 0.25, 2.00 x; <= 1.1 x better: MISSED" in text
    assert "track length: 5 to 5, 1.00 x; >= 0.9 x better: met" in text
    assert all(result.method in text for result in results)
    stages = render_stages(dataset(), results[0]).splitlines()
    assert [line.split()[0] for line in stages[2:]] == ["after", "chain", "loops"]


def test_markdown_holds_one_row_per_set_and_as_many_cells_as_columns() -> None:
    results = three_results()
    text = render_markdown([(dataset("walk"), results), (dataset("kitti_a"), results)])
    tables = [block.splitlines() for block in text.split("\n\n") if block.startswith("|")]
    assert [len(table) for table in tables] == [4, 4]
    for table in tables:
        assert len({line.count("|") for line in table}) == 1
    assert "0.50 / - / 0.25 (2.00) MISSED" in tables[0][2]
    assert "20 / 2 / 20 (1.00) met" in tables[0][2]


def test_json_can_be_read_by_strict_readers() -> None:
    results = three_results()
    results[2] = replace(results[2], figures=figures(error_px=math.nan))
    records = json.loads(json.dumps(as_json(dataset(), results), allow_nan=False))
    assert records[2]["figures"]["reprojection_error_px"] is None
    assert {one["figure"] for one in records[0]["decisions"]} >= {"registered", "track length"}
    assert records[1]["decisions"] == []
    assert "reference_from_estimated" not in records[0]["evaluation"]


# ---------------------------------------------------------------------------- the script
def write_model(folder: Path, trajectory: Mapping[str, FloatArray]) -> None:
    folder.mkdir(parents=True)
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=1, model="SIMPLE_PINHOLE", width=64, height=48, params=[60.0, 32.0, 24.0])
    )
    for name, pose in trajectory.items():
        number = NAMES.index(name) + 1
        model.add_image_with_trivial_frame(
            pycolmap.Image(name=name, camera_id=1, image_id=number), pycolmap.Rigid3d(invert_rigid(pose[None])[0])
        )
    model.write_binary(folder)


def write_path(path: Path, trajectory: Mapping[str, FloatArray]) -> None:
    """As the run writes it; only the cameras count."""
    scene = Scene(
        image_indices=tuple(range(NUM_IMAGES)),
        image_names=NAMES,
        camera_indices=(0,) * NUM_IMAGES,
        cam_from_world=invert_rigid(np.array(list(trajectory.values()))),
        cameras={0: Intrinsics(model="SIMPLE_PINHOLE", width=64, height=48, params=(60.0, 32.0, 24.0))},
        points=EMPTY_CLOUD,
        frame=WorldFrame(metric=False),
        segments=("0",),
    )
    write_tum(scene, path, None)


@pytest.fixture
def finished(tmp_path: Path) -> Path:
    """A working folder with the records of an earlier comparison, and the set itself in it."""
    work = tmp_path / "work" / "walk"
    images = tmp_path / "walk" / "images"
    images.mkdir(parents=True)
    for name in NAMES:
        (images / name).touch()
    write_model(tmp_path / "walk" / "reference_sparse", TRUTH)
    write_model(work / "ours" / "sparse" / "0", disturbed(0.01))
    write_path(work / "ours" / "trajectory_without_loops_tum.txt", disturbed(0.04))
    write_path(work / "ours" / "trajectory_stitched_tum.txt", disturbed(0.02))
    stages = [{"name": "features", "cpu_s": 5.0, "wall_s": 4.0}, {"name": "adjustment", "cpu_s": 3.0, "wall_s": 2.0}]
    (work / "ours" / "summary.json").write_text(json.dumps({"stages": stages}))
    record = json.dumps(vars(cost(20.0, 15.0)))
    (work / "ours.json").write_text(record)
    (work / "ours.settings").write_text("--segment-length 60 --overlap 20")
    for mapper in ("incremental", "global"):
        write_model(work / "colmap" / mapper / "0", disturbed(0.02))
    for stage in ("features", "matching", "incremental", "global"):
        (work / "colmap" / f"{stage}.json").write_text(record)
    return tmp_path


def run_script(folder: Path, monkeypatch: pytest.MonkeyPatch, *words: str) -> dict[str, Result]:
    """The results by method; the working folder is that of ``finished``."""
    monkeypatch.chdir(folder)
    arguments = compare.parse_arguments(["walk", "--output", "work", *words])
    opened = compare.open_dataset("walk", arguments.output, all_images=arguments.all_images)
    return {result.method: result for result in compare.run_methods(opened, arguments)}


def never(*_: object, **__: object) -> Cost:
    raise AssertionError("ran, though the result was there")


def test_reuse_runs_nothing_and_measures_what_is_there(finished: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compare, "run_child", never)
    results = run_script(finished, monkeypatch, "--reuse", "--stages")
    ours = results["ours l=60 p=20"]
    assert set(results) == {ours.method, INCREMENTAL, GLOBAL}
    assert {stage: one.cpu_s for stage, one in ours.costs.items()} == {
        "features": 5.0,
        "matching": 0.0,
        "mapping": 3.0,
        "rest": 12.0,
    }
    errors = {stage: found.position_rmse for stage, found in ours.stages.items()}
    assert list(errors) == ["chain", "loops", compare.LAST_STAGE]
    assert errors["chain"] / errors[compare.LAST_STAGE] == pytest.approx(4.0, rel=0.05)
    assert errors["loops"] / errors[compare.LAST_STAGE] == pytest.approx(2.0, rel=0.05)
    position = judged(ours, results[INCREMENTAL], results[GLOBAL])["position rms"]
    assert position.ratio == pytest.approx(0.5, rel=0.05)


def test_without_refinement_the_result_is_the_stitched_one(finished: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (finished / "work" / "walk" / "ours" / "trajectory_stitched_tum.txt").unlink()
    monkeypatch.setattr(compare, "run_child", never)
    results = run_script(finished, monkeypatch, "--reuse", "--stages")
    assert list(results["ours l=60 p=20"].stages) == ["chain", "loops"]


def test_ours_is_run_again_beside_what_colmap_left(finished: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    commands: list[list[str]] = []

    def record(command: list[str], log: Path) -> Cost:
        commands.append(command)
        write_model(Path(command[command.index("--output") + 1]) / "sparse" / "0", disturbed(0.01))
        return replace(cost(), exit_code=3)

    monkeypatch.setattr(compare, "run_child", record)
    words = ["--reuse", "--rerun-ours", "--workers", "1", "2", "--flags=--no-dense --track-source both"]
    results = run_script(finished, monkeypatch, *words, "--ours-name", "tried")
    assert [command[3] for command in commands] == ["reconstruct", "reconstruct"]
    for workers, command in zip("12", commands, strict=True):
        assert command[command.index("--workers") + 1] == workers
        assert command[command.index("--track-source") + 1] == "both"
        assert Path(command[command.index("--output") + 1]).name == f"tried_workers{workers}"
    assert [result.workers for result in results.values()][:2] == [1, 2]
    assert [one.exit_code for result in results.values() for one in result.costs.values() if result.is_ours] == [0, 0]
    # What an earlier comparison left under the same name is run again as well, and only when that is asked for.
    run_script(finished, monkeypatch, "--reuse")
    assert len(commands) == 2
    run_script(finished, monkeypatch, "--reuse", "--rerun-ours")
    assert Path(commands[2][commands[2].index("--output") + 1]).name == "ours"


@pytest.mark.parametrize(
    "words", [["--flags=--no-dense"], ["--segment-length", "12"], ["--overlap", "3"], ["--workers", "1"]]
)
def test_a_run_with_other_settings_is_not_reused_under_their_name(
    words: list[str], finished: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    work = finished / "work" / "walk"
    for end in ("json", "settings"):
        (work / f"ours_workers1.{end}").write_text((work / f"ours.{end}").read_text())
    monkeypatch.setattr(compare, "run_child", never)
    with pytest.raises(SystemExit, match=r"made with --segment-length 60 --overlap 20, and asked for .*--rerun-ours"):
        run_script(finished, monkeypatch, "--reuse", *words)


def test_a_run_that_does_not_tell_its_settings_is_not_reused(finished: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (finished / "work" / "walk" / "ours.settings").unlink()
    monkeypatch.setattr(compare, "run_child", never)
    with pytest.raises(SystemExit, match=r"ours\.json: was made with settings that it does not tell.*--rerun-ours"):
        run_script(finished, monkeypatch, "--reuse")


def test_a_run_that_was_broken_off_leaves_no_record_of_the_one_before(
    finished: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def break_off(*_: object) -> Cost:
        raise KeyboardInterrupt

    monkeypatch.setattr(compare, "run_child", break_off)
    with pytest.raises(KeyboardInterrupt):
        run_script(finished, monkeypatch, "--reuse", "--rerun-ours")
    assert not (finished / "work" / "walk" / "ours.json").exists()


def test_all_images_lie_apart_from_the_subset_and_only_where_there_is_one(
    finished: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    outputs: list[Path] = []

    def record(command: list[str], log: Path) -> Cost:
        outputs.append(Path(command[command.index("--output") + 1] if "--output" in command else command[4]))
        return cost()

    monkeypatch.setattr(compare, "run_child", record)
    words = ["--all-images", "--skip-global"]
    run_script(finished, monkeypatch, *words)
    assert {path.parent for path in outputs} == {Path("work/walk")}
    outputs.clear()
    (finished / "walk" / compare.SUBSET_FILE).write_text("\n".join(NAMES[::5]))
    run_script(finished, monkeypatch, *words)
    assert {path.parent for path in outputs} == {Path("work/walk_all")}
    outputs.clear()
    run_script(finished, monkeypatch, "--skip-global")
    assert {path.parent for path in outputs} == {Path("work/walk")}


def test_rerunning_ours_alone_needs_reuse(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        compare.parse_arguments(["walk", "--rerun-ours"])
    assert "--reuse" in capsys.readouterr().err


def test_one_camera_for_all_lies_apart_from_a_camera_per_image(finished: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stages: list[str] = []

    def record(command: list[str], log: Path) -> Cost:
        stages.append(" ".join([command[2], Path(command[4]).name, command[5]]))
        return cost()

    monkeypatch.setattr(compare, "run_child", record)
    results = run_script(finished, monkeypatch, "--reuse", "--skip-ours", "--skip-global", "--cameras", "single")
    assert stages == [f"{stage} colmap_single single" for stage in ("features", "matching", "incremental")]
    assert results[INCREMENTAL].note == "no model"
    assert results[INCREMENTAL].evaluation is None
